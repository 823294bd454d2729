"""Let the ROS 2 node run for long among others that come, go, break and interfere, and check that it loses nothing.

    python bench/soak.py [--minutes 30] [--rate 60] [--memory 2] [--untimed] [--results FOLDER]
    python bench/soak.py --draw FOLDER

Around the node, each a process of its own: a camera, which sends pictures of changing encodings and sizes, most of them
640×480, one in twenty of them broken, and which is killed or ended and started again; a client that sets parameters ten
times a second, some of them impossible; a listener that subscribes to one output after the other, and is killed, too.
This process takes all segments and samples memory, threads and descriptors of the node each second. It publishes a
/clock, which the node goes by and which jumps back. Fast DDS has config/fastdds_large_images.xml.

What is checked, and shown in the table with what was measured: status 0 unless something fails. Own memory is resident
memory without that which is shared with other processes, whose pictures lie in it. Frames at the edges are those that a
camera sent before the first and after the last of its pictures that was answered: no one can tell if they ever left it.
With --untimed the latency is only shown. --draw draws the curves of an earlier run, where matplotlib is.
"""

import argparse
import array
import contextlib
import itertools
import json
import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from node import PROFILE, Case, Row, Watched, draw_panels, environment, render

if '--draw' not in sys.argv:
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from node import spin_until, wait_until
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.parameter import Parameter
    from rclpy.parameter_client import AsyncParameterClient
    from rclpy.qos import QoSProfile, QoSReliabilityPolicy
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import CompressedImage, Image, PointCloud2
    from std_msgs.msg import Header
    from visualization_msgs.msg import ImageMarker

    from line_feature_node.node import RCLError

NAMESPACE = '/line_feature_soak'
NODE = f'{NAMESPACE}/line_feature_node'
#: What the camera sends: encodings, each in each size, of which most are the first. Each for so many frames.
ENCODINGS = ('mono8', 'bgr8', 'rgba8', 'mono16', '32FC1', 'yuv422_yuy2', 'bayer_rggb8')
SIZES = ((640, 480), (320, 240), (640, 480), (641, 479))
RUN = 7
#: Share of broken frames.
BAD = 0.05
#: Seconds that a camera and a listener live, and between two jumps of the clock.
CAMERA_LIFE, LISTENER_LIFE, JUMP = 15.0, 11.0, 5.0
#: Seconds for a process to end, and until others give it up when it was killed.
PATIENCE, LEASE = 10.0, 30.0
#: Seconds between two changes of parameters, and until one must be answered, for which kernels may have to be compiled.
CHANGE, ANSWER = 0.1, 60.0
MINUTE = 60.0
#: How many times the latency of the second minute that of the last may be.
LATENCY = 1.5
#: Seconds of frames at the edges of a life of a camera that may be: more is a node that does not hear any more.
EDGE = 1.0
#: A frame in the camera's file: its stamp, and whether it was a good one.
SENT = struct.Struct('<q?')
#: What is set, in turn; each change undoes the one before it where that is needed.
CHANGES: list[dict[str, Any]] = [
    {'T1': 8.0, 'T2': 4.0}, {'T1': 3.0, 'T2': 5.0}, {'T1': 4.0, 'T2': 2.0}, {'operator': 'sobel'}, {'alpha': 0.7},
    {'operator': 'dog', 'sigma': 1.5}, {'operator': 'scharr'}, {'alpha': float('inf')}, {'min_length': 20.0},
    {'operator': 'deriche', 'alpha': float('nan')}, {'refine': False}, {'n': 6}, {'refine': True, 'n': 4},
    {'profile': 'paper'}, {'roi': [0.1, 0.1, 0.5, 0.5]}, {'roi': [0.0, 0.0, 0.0, 0.0]}, {'profile': 'corridor'},
    {'scale': 0.5}, {'profile': 'nobody'}, {'max_segments': 50}, {'grouping': 'codes'}, {'jpeg_quality': 60},
    {'thinning': 'morphological'}, {'lazy': False}, {'profile': 'default'}, {'lazy': True}, {'min_chain': 12},
    {'false_alarms': 1.0, 'min_snr': 10.0}, {'theta_min': 0.5, 'theta_max': 1.0}, {'profile': 'default'},
]


# The camera


def encoded(picture: Any, encoding: str) -> Any:
    """A picture in BGR as rows of an encoding."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    if encoding == 'mono16':
        return grey.astype(np.uint16) * 257
    if encoding == '32FC1':
        depth = grey.astype(np.float32)
        depth[40:60, 30:90] = np.nan
        return depth
    if encoding == 'yuv422_yuy2':
        return np.dstack([grey, np.full_like(grey, 128)])
    return {'bgr8': picture, 'rgba8': cv2.cvtColor(picture, cv2.COLOR_BGR2RGBA)}.get(encoding, grey)


def messages(pictures: Any) -> list[list[Any]]:
    """For each encoding in each size some pictures, ready to be sent but for their stamps."""
    made = []
    for size, encoding in itertools.product(SIZES, ENCODINGS):
        made.append([])
        for picture in pictures:
            rows = np.ascontiguousarray(encoded(cv2.resize(picture, size), encoding))
            made[-1].append(Image(height=size[1], width=size[0], encoding=encoding, step=rows[0].nbytes,
                                  data=array.array('B', rows.tobytes())))
    return made


def broken(chance: random.Random) -> Any:
    """A message that is no picture, one way or another."""
    data = array.array('B', chance.randbytes(4800))
    changes = chance.choice([
        {'encoding': 'yuv444'}, {'data': data[:100]}, {'data': array.array('B')}, {'step': 0}, {'height': 2**32 - 1},
        {'width': 2**32 - 1}, {'height': 0}, {'encoding': '32FC1'},
        {'encoding': '32FC1', 'width': 20, 'data': array.array('B', np.full(1200, np.nan, np.float32).tobytes())}])
    return Image(**{'height': 60, 'width': 80, 'encoding': 'mono8', 'step': 80, 'data': data, **changes})


def camera(folder: Path, life: int, rate: float) -> None:
    """Publish until the end; what is published stands in a file before it goes out, as a kill may come at any time."""
    chance = random.Random(life)
    pictures = messages(np.load(folder / '640.npy')[:2])
    with spinning('camera') as (node, executor), (folder / f'sent-{life}').open('wb', buffering=0) as sent:
        publisher = node.create_publisher(Image, 'image', QoSProfile(
            depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT))
        wait_until(lambda: publisher.get_subscription_count() > 0, executor)
        spin_until(time.monotonic_ns() + 5 * 10**8, executor)  # the node is to know of the camera, too
        begin = time.monotonic_ns()
        for k in itertools.count():
            spin_until(begin + int(k / rate * 1e9), executor)
            run = (k // RUN + life * 5) % len(pictures)
            good = k == 0 or chance.random() >= BAD
            message = pictures[run][k % 2] if good else broken(chance)
            now = time.monotonic_ns()
            message.header = Header(frame_id='camera')
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
            sent.write(SENT.pack(now, good))
            publisher.publish(message)


# The client of parameters


def client(folder: Path) -> None:
    """Set parameters until the end, and keep count of the answers in a file."""
    counts = {'set': 0, 'refused': 0, 'unanswered': 0}
    with spinning('client') as (node, executor):
        parameters = AsyncParameterClient(node, NODE)
        wait_until(parameters.services_are_ready, executor)
        begin = time.monotonic_ns()
        for k in itertools.count():
            spin_until(begin + int(k * CHANGE * 1e9), executor)
            change = CHANGES[k % len(CHANGES)]
            future = parameters.set_parameters_atomically([Parameter(name, value=change[name]) for name in change])
            executor.spin_until_future_complete(future, ANSWER)
            if not future.done():
                counts['unanswered'] += 1
            else:
                counts['set' if future.result().result.successful else 'refused'] += 1
            replace(folder / 'client.json', counts)


def replace(path: Path, value: Any) -> None:
    """Write a file that another process may be reading."""
    fresh = path.with_suffix('.new')
    fresh.write_text(json.dumps(value))
    fresh.rename(path)


# The listener


def listener(life: int) -> None:
    """Subscribe to one output after the other until the end, for up to a second and a half each.

    In its first life, which a kill ends, to all of them: the node keeps the last messages of each for it until it is
    given up, and what that takes belongs to the first minute.
    """
    chance = random.Random(life)
    kinds = {'segments': PointCloud2, 'markers': ImageMarker, 'overlay': Image, 'edges': Image,
             'overlay/compressed': CompressedImage}
    with spinning('listener') as (node, executor):
        while True:
            for topics in [list(kinds)] if life == 0 else [[topic] for topic in chance.sample(list(kinds), len(kinds))]:
                subscriptions = [node.create_subscription(kinds[topic], f'{NODE}/{topic}', lambda _: None, 5)
                                 for topic in topics]
                spin_until(time.monotonic_ns() + int(chance.uniform(0.1, 1.5) * 1e9 + (life == 0) * 1e12), executor)
                for subscription in subscriptions:
                    node.destroy_subscription(subscription)


@contextlib.contextmanager
def spinning(name: str) -> Iterator[tuple[Any, Any]]:
    """A node in this process, until SIGTERM ends what is done with it."""
    rclpy.init()
    node = rclpy.create_node(name, namespace=NAMESPACE)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        yield node, executor
    except (KeyboardInterrupt, ExternalShutdownException, RCLError):
        if rclpy.ok():
            raise
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()


# The judge


@dataclass
class Judge:
    """What came of the node: when each frame was answered, and what it says of itself."""

    came: dict[int, int] = field(default_factory=dict)
    figures: dict[str, str] = field(default_factory=dict)
    told: int = 0

    def take_segments(self, message: Any) -> None:
        """Note when an answer came."""
        stamp = message.header.stamp
        self.came[stamp.sec * 10**9 + stamp.nanosec] = time.monotonic_ns()

    def take_diagnostics(self, message: Any) -> None:
        """Note what the node says."""
        for status in message.status:
            if status.name.startswith(NODE):
                self.figures = {value.key: value.value for value in status.values}
                self.told += 1


class Companion:
    """A process that is ended and started again, killed every other time."""

    def __init__(self, env: dict[str, str], life: float, command: Callable[[int], list[str]]) -> None:
        self._env, self._life, self._command = env, life, command
        self._left: dict[Path, float] = {}
        self.lives = 0
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen([sys.executable, __file__, *self._command(self.lives)], env=self._env,
                                         start_new_session=True)
        self.lives += 1
        self._ending = False
        self._due = time.monotonic() + self._life

    def _signal(self, number: int) -> None:
        due = time.monotonic() + LEASE
        self._left |= dict.fromkeys(segments_of_process(self._process.pid), due)
        self._ending, self._due = True, time.monotonic() + PATIENCE
        self._process.send_signal(number)

    def _clean(self, now: float) -> None:
        """Remove what killed processes left in the shared memory, when nobody knows of them any more."""
        for path in [path for path, due in self._left.items() if due < now]:
            path.unlink(missing_ok=True)
            del self._left[path]

    def live(self) -> None:
        """See to its end and its beginning; never wait for it."""
        status, now = self._process.poll(), time.monotonic()
        self._clean(now)
        if status is not None:
            if status and not self._ending:
                sys.exit(f'{" ".join(self._command(self.lives - 1))} ended with status {status}')
            self._start()
        elif now > self._due:
            self._signal(signal.SIGKILL if self._ending or self.lives % 2 else signal.SIGTERM)

    def stop(self) -> None:
        """Tell it to end for good."""
        self._signal(signal.SIGTERM)

    def gone(self) -> bool:
        """Whether it ended."""
        return self._process.poll() is not None

    def close(self) -> None:
        """Leave nothing behind."""
        if not self.gone():
            self._signal(signal.SIGKILL)
            self._process.wait()
        self._clean(float('inf'))


def segments_of_process(pid: int) -> list[Path]:
    """Files of Fast DDS in the shared memory that a process holds locks on: its own segments and ports."""
    found = []
    with contextlib.suppress(OSError):
        for entry in Path(f'/proc/{pid}/fd').iterdir():
            name = str(entry.readlink())
            if name.startswith('/dev/shm/fastrtps_') and name.endswith('_el') and 'port' not in name:
                found += [Path(name), Path(name.removesuffix('_el'))]
    return found


def sample(watched: Watched, begin: int, before: Row) -> Row:
    """The node now."""
    now, folder = time.monotonic_ns(), Path(f'/proc/{watched.pid}')
    lines = dict(line.split(':', 1) for line in (folder / 'status').read_text().splitlines())
    resident, anonymous, file = (int(lines[name].split()[0]) / 1024 for name in ('VmRSS', 'RssAnon', 'RssFile'))
    spent = float(watched.spent()[0])
    busy = np.array([int(number) for number in Path('/proc/stat').read_text().splitlines()[0].split()[1:9]])
    row = {'now': now, 'time': (now - begin) * 1e-9, 'resident': resident, 'own': anonymous + file,
           'threads': int(lines['Threads']), 'descriptors': len(list((folder / 'fd').iterdir())),
           'spent': spent, 'busy': [int(busy.sum()), int(busy[3] + busy[4])]}
    if before:
        total, idle = (a - b for a, b in zip(row['busy'], before['busy'], strict=True))
        row['cpu'] = (spent - before['spent']) / ((now - before['now']) * 1e-9)
        row['machine'] = 1 - idle / max(total, 1)
    return row


def soak(folder: Path, options: argparse.Namespace) -> Row:
    """Run everything for the time asked for; what was measured."""
    env = environment('profile', folder, PROFILE)
    env['ROS_DOMAIN_ID'] = os.environ.get('ROS_DOMAIN_ID', env['ROS_DOMAIN_ID'])
    os.environ.update(env)
    override = f'qos_overrides.{NODE}/segments.publisher.depth:=100'
    with (folder / 'log').open('w') as log:
        process = subprocess.Popen(
            [sys.executable, '-m', 'line_feature_node', '--ros-args', '-r', f'__ns:={NAMESPACE}', '-p', override,
             '-p', 'use_sim_time:=true'], env=env, stdout=log, stderr=log, start_new_session=True)
    companions: list[Companion] = []
    try:
        with spinning('judge') as (node, executor):
            judge = Judge()
            node.create_subscription(PointCloud2, f'{NODE}/segments', judge.take_segments, 100)
            node.create_subscription(DiagnosticArray, '/diagnostics', judge.take_diagnostics, 10)
            clock = node.create_publisher(Clock, '/clock', 10)
            wait_until(lambda: judge.told > 0 or process.poll() is not None, executor)
            companions.append(Companion(env, float('inf'), lambda _: ['--client', str(folder)]))
            # All kernels are there before the first frame.
            wait_until(lambda: answered_once(folder) or process.poll() is not None, executor)
            companions += [
                Companion(env, CAMERA_LIFE, lambda life: ['--camera', str(folder), str(life), str(options.rate)]),
                Companion(env, LISTENER_LIFE, lambda life: ['--listener', str(life)])]
            samples = attend(process, companions, judge, lambda: tick(clock, executor), options.minutes * MINUTE)
            for companion in companions:
                companion.stop()
            wait_until(lambda: all(companion.gone() for companion in companions), executor)
            told = judge.told
            wait_until(lambda: judge.told >= told + 3 or process.poll() is not None, executor)
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE)
    finally:
        for companion in companions:
            companion.close()
        process.kill()
        process.wait()
    return {'status': process.returncode, 'tracebacks': (folder / 'log').read_text().count('Traceback'),
            'log': (folder / 'log').read_text()[-5000:], 'samples': samples, 'client': json.loads(
                (folder / 'client.json').read_text()), 'lives': companions[1].lives, 'listeners': companions[2].lives,
            'figures': judge.figures, **account(folder, judge, samples)}


def answered_once(folder: Path) -> bool:
    """Whether every change of parameters was made once."""
    path = folder / 'client.json'
    return path.exists() and sum(json.loads(path.read_text()).values()) >= len(CHANGES)


def tick(clock: Any, executor: Any) -> None:
    """Publish the simulated time, which runs fast and jumps back, and take messages for a little while."""
    now = time.monotonic()
    message = Clock()
    simulated = 1000 + 3 * (now % JUMP)
    message.clock.sec, message.clock.nanosec = int(simulated), int(simulated % 1 * 1e9)
    clock.publish(message)
    spin_until(time.monotonic_ns() + 5 * 10**7, executor)


def attend(
    process: Any, companions: list[Companion], judge: Judge, work: Callable[[], None], seconds: float,
) -> list[Row]:
    """Sample the node each second from the first answer on, and see to the companions."""
    watched, samples, begin, patience = Watched(process.pid), [], 0, time.monotonic() + 60
    while not begin or time.monotonic_ns() - begin < seconds * 1e9:
        work()
        if process.poll() is not None:
            sys.exit(f'the node ended with status {process.returncode}')
        if not begin and time.monotonic() > patience:
            sys.exit('the node did not answer the first frames')
        for companion in companions:
            companion.live()
        begin = begin or (time.monotonic_ns() if judge.came else 0)
        if begin and time.monotonic_ns() - begin >= len(samples) * 10**9:
            samples.append(sample(watched, begin, samples[-1] if samples else {}))
    return samples


def account(folder: Path, judge: Judge, samples: list[Row]) -> Row:
    """What became of the frames, and the latency in each second."""
    counts = {'sent': 0, 'good': 0, 'answered': 0, 'edges': 0, 'longest edge': 0}
    latencies: list[list[float]] = [[] for _ in samples]
    begin = samples[0]['now']
    for path in folder.glob('sent-*'):
        frames = list(SENT.iter_unpack(path.read_bytes()[:path.stat().st_size // SENT.size * SENT.size]))
        answered = [k for k, (stamp, _) in enumerate(frames) if stamp in judge.came]
        edges = [answered[0], len(frames) - 1 - answered[-1]] if answered else [len(frames)]
        counts['sent'] += len(frames)
        counts['good'] += sum(good for _, good in frames)
        counts['answered'] += len(answered)
        counts['edges'] += sum(edges)
        counts['longest edge'] = max(counts['longest edge'], *edges)
        for k in answered:
            stamp = frames[k][0]
            second = (stamp - begin) // 10**9
            if 0 <= second < len(latencies):
                latencies[second].append((judge.came[stamp] - stamp) * 1e-6)
    return {'counts': counts, 'latencies': latencies}


# What is shown


@dataclass(frozen=True)
class Line:
    """A figure of the result, with what it must be."""

    name: str
    measured: str
    expected: str
    met: bool


def lines(result: Row, options: argparse.Namespace) -> list[Line]:
    """All figures."""
    untimed = options.untimed
    samples, counts = result['samples'], result['counts']
    seconds = len(samples)
    # A run of a minute has half of one to warm up.
    warm = min(int(MINUTE), seconds // 2)
    part = max(min(10, warm // 2), 1)
    early, late = samples[warm - part:warm], samples[-part:]
    own, resident = (
        [float(np.median([row[name] for row in rows])) for rows in (early, late)] for name in ('own', 'resident'))
    second = result['latencies'][warm:2 * warm]
    p99 = [float(np.percentile(list(itertools.chain(*rows)) or [np.nan], 99))
           for rows in (second, result['latencies'][-warm:])]
    frames = {name: int(result['figures'][f'frames {name}']) for name in ('received', 'processed', 'dropped', 'failed')}
    missing = counts['sent'] - frames['received'] - frames['dropped']
    bad = counts['sent'] - counts['good']
    made = [
        Line('own memory, MiB', f'{own[0]:.1f} at {warm} s, {own[1]:.1f} at {seconds} s',
             f'{options.memory:g} more at most', own[1] - own[0] <= options.memory),
        Line('resident memory with what is shared, MiB', f'{resident[0]:.1f}, {resident[1]:.1f}', '', True)]
    for name in ('threads', 'descriptors'):
        usual = [int(np.median([row[name] for row in rows])) for rows in (samples[:2 * warm], samples[-warm:])]
        made.append(Line(name, f'{usual[0]} at first, {usual[1]} in the end', 'no more', usual[1] <= usual[0]))
    made += [
        Line('latency p99, ms', f'{p99[0]:.1f} in the second minute, {p99[1]:.1f} in the last',
             '' if untimed else f'{LATENCY:g} times at most', untimed or p99[1] <= LATENCY * p99[0]),
        Line('frames sent', f'{counts["sent"]}, {bad} of them broken, by {result["lives"]} cameras', '', True),
        Line('frames by the node', ', '.join(f'{count} {name}' for name, count in frames.items()),
             'received = processed + failed', frames['received'] == frames['processed'] + frames['failed']),
        Line('answers that came', f'{counts["answered"]}', 'all processed', counts['answered'] == frames['processed']),
        Line('failed', f'{frames["failed"]} of {bad} broken', 'none that is good', frames['failed'] <= bad),
        Line('neither received nor dropped', f'{missing} of {counts["edges"]} at edges', 'none but at edges',
             0 <= missing <= counts['edges']),
        Line('longest edge, frames', f'{counts["longest edge"]}', f'{EDGE * options.rate:g} at most',
             counts['longest edge'] <= EDGE * options.rate),
        Line('parameters', ', '.join(f'{count} {name}' for name, count in result['client'].items()),
             'all answered, some set, some refused',
             not result['client']['unanswered'] and min(result['client']['set'], result['client']['refused']) > 0),
        Line('status and tracebacks', f'{result["status"]}, {result["tracebacks"]}', 'none',
             result['status'] == 0 == result['tracebacks']),
        Line('processors, node and machine', ' and '.join(
            f'{np.mean([row[name] for row in samples[1:]]):.0%}' for name in ('cpu', 'machine')), '', True)]
    return made


def table(made: list[Line]) -> str:
    """In Markdown."""
    rows = [('', 'measured', 'expected', ''), ('---',) * 4]
    rows += [(line.name, line.measured, line.expected, 'met' if line.met else '**not met**') for line in made]
    return '\n'.join(f'| {" | ".join(row)} |' for row in rows)


def seconds(result: Row) -> list[Row]:
    """What is drawn of each second."""
    names = ('time', 'resident', 'own', 'threads', 'descriptors')
    rows = [{name: round(row[name], 2) for name in names} for row in result['samples']]
    for row, latencies in zip(rows, result['latencies'], strict=True):
        for percent in (50, 99):
            row[f'p{percent}'] = round(float(np.percentile(latencies, percent)), 1) if latencies else None
    return rows


def draw(rows: list[Row], path: Path) -> None:
    """Memory, handles and latency over time."""
    draw_panels(rows, [
        ('memory of the node', 'MiB', {'resident': 'resident, with what is shared', 'own': 'its own'}),
        ('threads and descriptors of the node', '', {'threads': 'threads', 'descriptors': 'descriptors'}),
        ('latency', 'ms', {'p99': 'p99 of a second', 'p50': 'p50 of a second'}),
    ], path)


def run(options: argparse.Namespace) -> int:
    """Measure, check, print and write; the exit status."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        render(folder, [Case(640, 480, 'bgr8', options.rate)])
        result = soak(folder, options)
    made = lines(result, options)
    print(f'{options.minutes:g} min at {options.rate:g} Hz\n\n{table(made)}')
    if options.results:
        options.results.mkdir(parents=True, exist_ok=True)
        rows = seconds(result)
        (options.results / 'soak.json').write_text(json.dumps(rows))
        draw(rows, options.results / 'soak.png')
    failed = [line.name for line in made if not line.met]
    if failed:
        print(f'not met: {", ".join(failed)}; the node said at last\n{result["log"]}', file=sys.stderr)
    return 1 if failed else 0


def main() -> int | None:
    roles: dict[str, Callable[..., None]] = {
        '--camera': lambda folder, life, rate: camera(Path(folder), int(life), float(rate)),
        '--client': lambda folder: client(Path(folder)), '--listener': lambda life: listener(int(life))}
    if sys.argv[1:2] and sys.argv[1] in roles:
        return roles[sys.argv[1]](*sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--minutes', type=float, default=30.0)
    parser.add_argument('--rate', type=float, default=60.0, help='frames a second')
    parser.add_argument('--memory', type=float, default=2.0, metavar='MIB', help='by which its own memory may grow')
    parser.add_argument('--untimed', action='store_true', help='let the latency be what it is')
    parser.add_argument('--results', type=Path, metavar='FOLDER')
    parser.add_argument('--draw', type=Path, metavar='FOLDER', help='only draw what was measured')
    options = parser.parse_args()
    if options.draw:
        return draw(json.loads((options.draw / 'soak.json').read_text()), options.draw / 'soak.png')
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit(1))
    with contextlib.suppress(KeyboardInterrupt):
        return run(options)
    return 130


if __name__ == '__main__':
    sys.exit(main())

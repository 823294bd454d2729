"""Time the ROS 2 node between two processes of one machine, beside an empty node that only receives and sends.

    python bench/node.py [--seconds 4] [--rounds 3] [--reliability reliable] [--soak MINUTES] [--results FOLDER]
    python bench/node.py --draw FOLDER

One process is the camera: it publishes rendered corridors at a fixed rate and takes the segments that come back. The
other is the node, or in its place an empty one, which takes the same images and answers with as many points; what that
costs is the transport. Each case is measured with the default transport, with a profile of Fast DDS, by default
config/fastdds_large_images.xml, and with the profile and a C library that keeps its memory. Every figure is the median
of the rounds: ours is the latency p50 less that of the empty node, beyond is what of that is not extraction, pages are
those that the kernel gives the node anew for each frame. Milliseconds differ between machines and hours; losses and
ratios last.
 case is measured with the default transport and with a profile of Fast DDS, by default
config/fastdds_large_images.xml. Every figure is the median of the rounds. Milliseconds differ between machines and
hours; losses and ratios last.

With --soak the node runs for so many minutes at 1920×1080 and 60 Hz, with the profile and kept memory, and its memory
and latency are sampled each second. They are drawn where matplotlib is installed, or later, from the files in the
folder, with --draw.
"""

import argparse
import array
import contextlib
import json
import os
import signal
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

from line_feature_node.scenes import Camera, corridor

try:
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.qos import QoSProfile, QoSReliabilityPolicy
    from sensor_msgs.msg import Image, PointCloud2, PointField
    from std_msgs.msg import Header
except ImportError as error:
    if '--draw' not in sys.argv:
        sys.exit(f'ROS 2 is needed ({error}): make bench-node installs it, or source its setup.bash')

Row = dict[str, Any]
PROFILE = Path(__file__).resolve().parent.parent / 'config' / 'fastdds_large_images.xml'
#: Settings of the C library under which memory for large messages is kept, not given back and zeroed for each frame.
KEPT_MEMORY = {'MALLOC_MMAP_THRESHOLD_': str(32 * 2**20), 'MALLOC_TRIM_THRESHOLD_': str(256 * 2**20)}
#: Each with whether the profile is used, and settings of both processes.
TRANSPORTS: dict[str, tuple[bool, dict[str, str]]] = {
    'default': (False, {}), 'profile': (True, {}), 'profile, memory kept': (True, KEPT_MEMORY)}
#: Different pictures that the camera shows in turn.
PICTURES = 8
#: Seconds at the beginning that do not count, until both sides are warm.
WARM_UP = 1.5
#: Seconds to wait for the node, which may have to compile its kernels, and for its last answers.
READY, LAST = 240.0, 1.0
#: Others may be in the domain by chance: their topics have other names.
NAMESPACE = '/line_feature_bench_'
#: Bytes a point, as the node's segments have them.
POINT_STEP = 52


@dataclass(frozen=True)
class Case:
    """What the camera sends."""

    width: int
    height: int
    encoding: str
    rate: float

    @property
    def name(self) -> str:
        """In a few words."""
        return f'{self.width}×{self.height} {self.encoding} {self.rate:g} Hz'


CASES = (Case(640, 480, 'mono8', 30), Case(640, 480, 'bgr8', 30), Case(1920, 1080, 'bgr8', 30),
         Case(1920, 1080, 'bgr8', 60))


# The camera: a process of its own, as the middleware reads its profile once


@dataclass
class Answers:
    """What came back: when each frame was published and when its answer was there, in ns of the monotonic clock."""

    namespace: str
    sent: list[int] = field(default_factory=list)
    came: dict[int, int] = field(default_factory=dict)
    points: list[int] = field(default_factory=list)
    extraction: float | None = None
    since: int = 0

    def take_segments(self, message: Any) -> None:
        """Note when an answer came."""
        now = time.monotonic_ns()
        stamp = message.header.stamp
        self.came[stamp.sec * 10**9 + stamp.nanosec] = now
        self.points.append(message.width)

    def take_diagnostics(self, message: Any) -> None:
        """Note what the node says of its own time."""
        for status in message.status:
            for value in status.values if status.name.startswith(self.namespace) else ():
                if value.key == 'extraction (ms)':
                    self.extraction = float(value.value)

    def between(self, begin: int, end: int) -> Row:
        """Latencies in ms and losses of the frames published in an interval."""
        sent = [stamp for stamp in self.sent if begin <= stamp < end]
        latencies = [(self.came[stamp] - stamp) * 1e-6 for stamp in sent if stamp in self.came]
        p50, p99 = np.percentile(latencies, (50, 99)).tolist() if latencies else (None, None)
        return {'p50': p50, 'p99': p99, 'sent': len(sent), 'lost': 1 - len(latencies) / max(len(sent), 1)}


@dataclass(frozen=True)
class Watched:
    """Another process, watched by its files in /proc."""

    pid: int

    def spent(self) -> Any:
        """Since its start: seconds on all processors, and pages of memory that the kernel had to give it."""
        fields = Path(f'/proc/{self.pid}/stat').read_text().rsplit(')', 1)[1].split()
        return np.array([(int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK'), int(fields[7])])

    def memory(self) -> tuple[float, float]:
        """Resident MiB, and those of them that are its own and not shared."""
        lines = dict(line.split(':', 1) for line in Path(f'/proc/{self.pid}/status').read_text().splitlines())
        return int(lines['VmRSS'].split()[0]) / 1024, int(lines['RssAnon'].split()[0]) / 1024


def largest_segment() -> float:
    """The largest shared memory mapped for Fast DDS by this process, in MiB: tells if the profile is in effect."""
    maps = Path('/proc/self/maps').read_text().splitlines()
    spans = [line.split()[0].split('-') for line in maps if '/fastrtps_' in line]
    return max((int(end, 16) - int(begin, 16) for begin, end in spans), default=0) / 2**20


def messages(case: Case, folder: Path) -> list[Any]:
    """The camera's pictures, ready to be sent but for their stamps."""
    made = []
    for picture in np.load(folder / f'{case.width}.npy'):
        pixels = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if case.encoding == 'mono8' else picture
        made.append(Image(height=case.height, width=case.width, encoding=case.encoding, step=pixels[0].nbytes,
                          data=array.array('B', pixels.tobytes())))
    return made


def qos(reliability: str) -> Any:
    return QoSProfile(depth=1, reliability=QoSReliabilityPolicy[reliability.upper()])


def run_camera(task: Row, result: Path) -> None:
    """Publish for a time, and write what was measured."""
    case, watched, answers = Case(**task['case']), Watched(task['watch']), Answers(task['namespace'])
    images = messages(case, result.parent)
    rclpy.init()
    node = rclpy.create_node('camera', namespace=answers.namespace)
    publisher = node.create_publisher(Image, 'image', qos(task['reliability']))
    segments = node.create_subscription(PointCloud2, 'line_feature_node/segments', answers.take_segments, 10)
    node.create_subscription(DiagnosticArray, '/diagnostics', answers.take_diagnostics, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    wait_until(lambda: publisher.get_subscription_count() > 0 and segments.get_publisher_count() > 0, executor)
    samples: list[Row] = []
    publish_at_rate(publisher, images, answers, executor, case.rate, WARM_UP)
    begin, before, answers.points = time.monotonic_ns(), watched.spent(), []
    publish_at_rate(publisher, images, answers, executor, case.rate, task['seconds'],
                    (lambda: samples.append(sample(answers, watched))) if task['sample'] else None)
    end, (processors, pages) = time.monotonic_ns(), watched.spent() - before
    spin_until(time.monotonic_ns() + int(LAST * 1e9), executor)
    seconds = (end - begin) * 1e-9
    row = answers.between(begin, end)
    row |= {'rate': row['sent'] / seconds, 'cpu': processors / seconds, 'pages': pages / row['sent'],
            'extraction': answers.extraction, 'points': int(np.median(answers.points or [0])),
            'segment': largest_segment(), 'samples': samples}
    result.write_text(json.dumps(row))
    node.destroy_node()
    rclpy.try_shutdown()


def wait_until(condition: Callable[[], bool], executor: Any) -> None:
    deadline = time.monotonic() + READY
    while not condition():
        if time.monotonic() > deadline:
            sys.exit(f'the node was not there after {READY:.0f} s')
        executor.spin_once(timeout_sec=0.05)


def spin_until(due: int, executor: Any) -> None:
    """Take messages until a time of the monotonic clock."""
    while (left := due - time.monotonic_ns()) > 0:
        executor.spin_once(timeout_sec=left * 1e-9)


def publish_at_rate(
    publisher: Any, images: list[Any], answers: Answers, executor: Any, rate: float, seconds: float,
    each_second: Callable[[], None] | None = None,
) -> None:
    """Publish images in turn, each when it is due, and take the answers in between."""
    begin = time.monotonic_ns()
    told = begin
    for k in range(round(rate * seconds)):
        spin_until(begin + int(k / rate * 1e9), executor)
        now = time.monotonic_ns()
        message = images[k % len(images)]
        message.header = Header(frame_id='camera')
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
        publisher.publish(message)
        answers.sent.append(now)
        if each_second and now - told >= 10**9:
            told = now
            each_second()
    spin_until(begin + int(seconds * 1e9), executor)


def sample(answers: Answers, watched: Watched) -> Row:
    """Memory of the node now, and its latency over a second, which ended a little ago so that its answers are there."""
    now = time.monotonic_ns()
    end = now - 5 * 10**8
    row = answers.between(end - 10**9, end)
    resident, own = watched.memory()
    answers.since = answers.since or now
    return {'time': (now - answers.since) * 1e-9, 'resident': resident, 'own': own, **row}


# The empty node


def run_empty(points: int, reliability: str, namespace: str) -> None:
    """Answer every image with a PointCloud2 of so many points, until SIGTERM."""
    rclpy.init()
    node = rclpy.create_node('line_feature_node', namespace=namespace)
    publisher = node.create_publisher(PointCloud2, '~/segments', 5)
    names = ('x', 'y', 'z', 'x1', 'y1', 'x2', 'y2', 'length', 'theta', 'intercept', 'rho', 'code', 'size')
    answer = PointCloud2(
        height=1, width=points, point_step=POINT_STEP, row_step=POINT_STEP * points, is_dense=True,
        fields=[PointField(name=name, offset=4 * k, datatype=7, count=1) for k, name in enumerate(names)],
        data=array.array('B', bytes(POINT_STEP * points)))

    def on_image(message: Any, _: Any) -> None:
        answer.header = message.header
        publisher.publish(answer)

    node.create_subscription(Image, 'image', on_image, qos(reliability))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()


# Both as processes


def environment(transport: str, folder: Path, profile: Path) -> dict[str, str]:
    """For a pair of processes that see nobody else."""
    foreign = ('FASTDDS_', 'FASTRTPS_', 'MALLOC_')
    kept = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
    kept |= {'ROS_DOMAIN_ID': str(1 + os.getpid() % 101), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
             'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp', 'ROS_LOG_DIR': str(folder)}
    profiled, settings = TRANSPORTS[transport]
    if profiled:
        # The first is the name for Fast DDS 2, the second that for Fast DDS 3.
        kept |= {f'FAST{name}_DEFAULT_PROFILES_FILE': str(profile.resolve()) for name in ('RTPS', 'DDS')}
    return kept | settings


@contextlib.contextmanager
def process(command: list[str], env: dict[str, str]) -> Iterator['subprocess.Popen[bytes]']:
    """A process that does not outlive the block. Ctrl-C reaches this script only, which ends it."""
    started = subprocess.Popen([sys.executable, *command], env=env, start_new_session=True, stdout=subprocess.DEVNULL,
                               stderr=subprocess.PIPE if '--camera' not in command else None)
    try:
        yield started
    finally:
        started.terminate()
        try:
            started.communicate(timeout=5)
        except subprocess.TimeoutExpired:
            started.kill()
            started.communicate()


def namespace() -> str:
    return f'{NAMESPACE}{os.getpid()}'


def node_command(reliability: str) -> list[str]:
    """The node, by its own entry point."""
    override = f'qos_overrides.{namespace()}/image.subscription.reliability:={reliability}'
    return ['-m', 'line_feature_node', '--ros-args', '-r', f'__ns:={namespace()}', '-p', override,
            '--log-level', 'error']


def empty_command(points: int, reliability: str) -> list[str]:
    return [__file__, '--empty', str(points), reliability, namespace()]


def measure(command: list[str], env: dict[str, str], folder: Path, task: Row) -> Row:
    """Run the camera and what answers it; what the camera measured."""
    result = folder / 'result.json'
    result.unlink(missing_ok=True)
    with process(command, env) as answering:
        task = {**task, 'watch': answering.pid, 'namespace': namespace()}
        with process([__file__, '--camera', json.dumps(task), str(result)], env) as camera:
            while camera.poll() is None:
                if answering.poll() is not None:
                    raise SystemExit(f'the node ended with status {answering.returncode}')
                time.sleep(0.1)
    if camera.returncode or not result.exists():
        raise SystemExit(f'the camera ended with status {camera.returncode}')
    return dict(json.loads(result.read_text()))


def one_round(case: Case, env: dict[str, str], folder: Path, options: argparse.Namespace) -> Row:
    """The node and the empty one, each for some seconds, and their difference."""
    task = {'case': vars(case), 'reliability': options.reliability, 'seconds': options.seconds, 'sample': False}
    node = measure(node_command(options.reliability), env, folder, task)
    empty = measure(empty_command(node['points'], options.reliability), env, folder, task)
    row = {'points': node['points'], 'segment': node['segment'], 'extraction': node['extraction'], 'rate': node['rate']}
    for name, measured in (('node', node), ('empty', empty)):
        row |= {f'{name} {key}': measured[key] for key in ('p50', 'p99', 'lost', 'cpu', 'pages')}
    if None not in (node['p50'], empty['p50'], node['extraction']):
        row['ours'] = node['p50'] - empty['p50']
        row['beyond'] = row['ours'] - node['extraction']
    return row


def median_of(rows: list[Row]) -> Row:
    """Each figure's median over the rounds that have it."""
    names = dict.fromkeys(name for row in rows for name in row)
    values = {name: [row[name] for row in rows if row.get(name) is not None] for name in names}
    return {name: float(np.median(found)) if found else None for name, found in values.items()}


def compare(cases: list[Case], folder: Path, options: argparse.Namespace) -> dict[str, dict[str, Row]]:
    """All cases with both transports; in each round all of them, so that what else the machine does meets all."""
    rounds: dict[tuple[Case, str], list[Row]] = {(case, transport): [] for case in cases for transport in TRANSPORTS}
    for k in range(options.rounds):
        for (case, transport), rows in rounds.items():
            print(f'round {k + 1} of {options.rounds}: {case.name}, {transport}', file=sys.stderr, flush=True)
            rows.append(one_round(case, environment(transport, folder, options.profile), folder, options))
    result: dict[str, dict[str, Row]] = {case.name: {} for case in cases}
    for (case, transport), rows in rounds.items():
        result[case.name][transport] = {**median_of(rows), 'rounds': rows}
    return result


# What is shown


def table(result: dict[str, dict[str, Row]]) -> str:
    """All cases, in Markdown."""
    head = ('images', 'transport', 'latency p50 / p99', 'empty node p50 / p99', 'ours', 'extraction', '**beyond**',
            'lost, node / empty', 'CPU, node / empty', 'pages a frame')
    lines = [head, ('---',) * len(head)]
    for name, transports in result.items():
        for transport, row in transports.items():
            lines.append((
                name, transport, *(f'{_ms(row[f"{who} p50"])} / {_ms(row[f"{who} p99"])}' for who in ('node', 'empty')),
                _ms(row.get('ours')), _ms(row['extraction']), f'**{_ms(row.get("beyond"))}**',
                *(f'{row[f"node {what}"]:.1%} / {row[f"empty {what}"]:.1%}' for what in ('lost', 'cpu')),
                f'{row["node pages"]:.0f}'))
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def _ms(value: float | None) -> str:
    return '–' if value is None else f'{value:.2f}'


def verdict(samples: list[Row]) -> str:
    """Memory and latency at the beginning and at the end, in a sentence each."""
    part = min(60, len(samples) // 2)
    last = samples[-part:]
    second = samples[part:2 * part] if len(samples) >= 3 * part else samples[:part]

    def late(rows: list[Row]) -> float:
        return float(np.median([row['p99'] for row in rows if row['p99'] is not None] or [np.nan]))

    first, end = samples[part - 1], samples[-1]
    lost = 1 - sum(row['sent'] * (1 - row['lost']) for row in samples) / max(sum(row['sent'] for row in samples), 1)
    return (f'resident memory after {first["time"]:.0f} s {first["resident"]:.1f} MiB (its own {first["own"]:.1f}), '
            f'after {end["time"]:.0f} s {end["resident"]:.1f} MiB ({end["own"]:.1f}); latency p99 of a second, median '
            f'of {second[0]["time"]:.0f} to {second[-1]["time"]:.0f} s {late(second):.1f} ms, of '
            f'{last[0]["time"]:.0f} to {last[-1]["time"]:.0f} s {late(last):.1f} ms; {lost:.1%} of the frames lost')


def soak(folder: Path, options: argparse.Namespace) -> list[Row]:
    """The node at 1920×1080 and 60 Hz, second by second."""
    task = {'case': vars(CASES[-1]), 'reliability': options.reliability, 'seconds': options.soak * 60, 'sample': True}
    env = environment('profile, memory kept', folder, options.profile)
    return list(measure(node_command(options.reliability), env, folder, task)['samples'])


def draw(samples: list[Row], path: Path) -> None:
    """Memory and latency over time."""
    draw_panels(samples, [
        ('memory of the node', 'MiB', {'resident': 'resident', 'own': 'its own, without shared memory'}),
        (f'latency, {CASES[-1].name}', 'ms', {'p99': 'p99 of a second', 'p50': 'p50 of a second'}),
    ], path)


def draw_panels(samples: list[Row], panels: list[tuple[str, str, dict[str, str]]], path: Path) -> None:
    """Draw curves over time; where matplotlib is missing, say so.

    Args:
        samples: What was measured, each with its `time`.
        panels: Of each title, unit, and the names in the samples with what they are called.
        path: The picture.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print(f'the curves are not drawn, as matplotlib is not installed: where it is, --draw {path.parent} draws them')
        return
    figure = Figure((5.2 * len(panels), 4.2), layout='constrained')
    times = [row['time'] for row in samples]
    for axes, (title, unit, names) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for name, label in names.items():
            axes.plot(times, [np.nan if row[name] is None else row[name] for row in samples], label=label)
        axes.set(xlabel='s', ylabel=unit, title=title, ylim=(0, None))
        axes.legend()
    figure.savefig(path, dpi=110)
    print(f'curves: {path}')


def render(folder: Path, cases: list[Case]) -> None:
    """Write what the camera sees as it moves, once for all processes."""
    for width, height in {(case.width, case.height) for case in cases}:
        cameras = [Camera(x=2.0 + 0.4 * k) for k in range(PICTURES)]
        pictures = [corridor(camera, width=width, height=height, seed=k).image for k, camera in enumerate(cameras)]
        np.save(folder / f'{width}.npy', pictures)


def run(options: argparse.Namespace) -> None:
    """Measure, print and write."""
    suffix = '' if options.reliability == 'best_effort' else f'-{options.reliability}'
    results: Path | None = options.results
    if results:
        results.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cases = [case for case in CASES if options.case in case.name] if options.rounds else []
        render(folder, cases + [CASES[-1]] * bool(options.soak))
        if cases:
            result = compare(cases, folder, options)
            print(f'{options.reliability}, ms\n\n{table(result)}')
            if results:
                (results / f'node{suffix}.json').write_text(json.dumps(result, indent=1))
        if options.soak:
            samples = soak(folder, options)
            print(f'{CASES[-1].name} for {options.soak:g} min: {verdict(samples)}')
            if results:
                (results / f'node-soak{suffix}.json').write_text(json.dumps(samples))
                draw(samples, results / f'node-soak{suffix}.png')


def main() -> None:
    if sys.argv[1:2] == ['--camera']:
        return run_camera(json.loads(sys.argv[2]), Path(sys.argv[3]))
    if sys.argv[1:2] == ['--empty']:
        return run_empty(int(sys.argv[2]), *sys.argv[3:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=4.0, help='length of each measurement')
    parser.add_argument('--rounds', type=int, default=3, help='how often all are measured; 0 for the soak only')
    parser.add_argument('--reliability', choices=('best_effort', 'reliable'), default='best_effort')
    parser.add_argument('--case', default='', help='measure only those whose name has this in it: bgr8 30')
    parser.add_argument('--profile', type=Path, default=PROFILE, metavar='FILE', help='another than the default one')
    parser.add_argument('--soak', type=float, default=0.0, metavar='MINUTES')
    parser.add_argument('--results', type=Path, metavar='FOLDER')
    parser.add_argument('--draw', type=Path, metavar='FOLDER', help='only draw what was measured')
    options = parser.parse_args()
    if options.draw:
        for path in options.draw.glob('node-soak*.json'):
            draw(json.loads(path.read_text()), path.with_suffix('.png'))
        return None
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit(1))
    with contextlib.suppress(KeyboardInterrupt):
        return run(options)
    sys.exit(130)


if __name__ == '__main__':
    main()

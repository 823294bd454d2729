"""Time `line_features bag` over rendered recordings, beside the bare extractor in memory and bare reading.

    python bench/bag.py [--rounds 3] [--case "1920×1080"] [--scale 1] [--results FOLDER]

Every case has a short recording and one ten times as long, of the same frames in turn: mcap without compression, as
`ros2 bag record` writes it. All contestants take turns in each round, and medians count. The rate of a run is that of
the frames by which the long recording is longer, so without the start of the processes, which is given apart. Bare is
one thread of this process with the frames in memory: the extraction, and before it the decoding of the message. It is
timed before and after each run. The share is what a run does of that; its writer is a process of its own. CPU is what
a run takes of the processors, for each frame, over what bare takes.
Memory is the sum over all processes of a run, sampled.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from line_feature_node.bag import VERSION
from line_feature_node.core import LineFeatureExtractor, Parameters
from line_feature_node.overlay import encode_jpeg
from line_feature_node.recordings import DECODERS, deserialize, typestore
from line_feature_node.scenes import Camera, corridor
from line_feature_node.slices import MESSAGES

TOPIC = '/camera/image'
IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
#: Different pictures that are shown in turn.
PICTURES = 24
#: How many times as long the long recording is.
LONG = 10
#: Nanoseconds: when the recordings begin, and from frame to frame.
BEGIN, PERIOD = 1_800_000_000 * 10**9, 33_333_333
PROGRAM = 'from line_feature_node.command import main; main()'
#: Seconds between two looks at the memory.
LOOK = 0.02


@dataclass(frozen=True)
class Case:
    """What is recorded."""

    name: str
    width: int
    height: int
    jpeg: bool
    frames: int


CASES = (Case('640×480 mono8', 640, 480, jpeg=False, frames=400),
         Case('640×480 bgr8 JPEG', 640, 480, jpeg=True, frames=400),
         Case('1920×1080 mono8', 1920, 1080, jpeg=False, frames=100))


def messages(case: Case) -> list[bytes]:
    """The frames of a case, serialised."""
    types = typestore(ros1=False)
    kind = types.types
    header = kind['std_msgs/msg/Header'](stamp=kind['builtin_interfaces/msg/Time'](sec=0, nanosec=0), frame_id='camera')
    made = []
    for number in range(PICTURES):
        scene = corridor(Camera(x=2.0 + 0.4 * number), width=case.width, height=case.height, seed=number)
        grey = np.asarray(cv2.cvtColor(scene.image, cv2.COLOR_BGR2GRAY), np.uint8)
        message = (MESSAGES.compressed_image(encode_jpeg(scene.image, 90).reshape(-1), header) if case.jpeg
                   else MESSAGES.image(grey, header))
        made.append(bytes(types.serialize_cdr(message, COMPRESSED if case.jpeg else IMAGE)))
    return made


def record(path: Path, case: Case, made: list[bytes], frames: int) -> None:
    writer = Writer(path, version=VERSION, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection(TOPIC, COMPRESSED if case.jpeg else IMAGE, typestore=typestore(ros1=False))
        for number in range(frames):
            writer.write(connection, BEGIN + number * PERIOD, made[number % PICTURES])


# Contestants: each gives seconds of the clock and of the processors for a frame


def timed(work: Callable[[], int]) -> dict[str, float]:
    clock, cpu = time.perf_counter(), time.process_time()
    frames = work()
    return {'clock': (time.perf_counter() - clock) / frames, 'cpu': (time.process_time() - cpu) / frames}


def bare(case: Case, made: list[bytes], extractor: LineFeatureExtractor) -> dict[str, dict[str, float]]:
    """The extraction alone, and with the decoding of the messages."""
    kind = COMPRESSED if case.jpeg else IMAGE

    def decoded(data: bytes) -> Any:
        return DECODERS[kind](deserialize(Path('x.mcap'), data, kind))

    images = [decoded(data) for data in made]

    def extraction() -> int:
        for number in range(case.frames):
            extractor.extract(images[number % PICTURES])
        return case.frames

    def both() -> int:
        for number in range(case.frames):
            extractor.extract(decoded(made[number % PICTURES]))
        return case.frames

    return {'extraction': timed(extraction), 'decoding and extraction': timed(both)}


def reading(path: Path) -> int:
    with Reader(path) as reader:
        return sum(1 for _ in reader.messages())


def run(path: Path, workers: int, *, everything: bool) -> dict[str, float]:
    """Seconds of the clock and of the processors of a run, and its memory at most, MB."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        command = [sys.executable, '-c', PROGRAM, 'bag', str(path), '--out', f'{folder}/out', '--workers', str(workers),
                   '--quiet', *(() if everything else ('--only-segments',))]
        peak = 0
        begin = time.perf_counter()
        process = subprocess.Popen(command)

        def look() -> None:
            nonlocal peak
            while process.returncode is None:
                peak = max(peak, sum(map(resident, tree(process.pid))))
                time.sleep(LOOK)

        watcher = threading.Thread(target=look)
        watcher.start()
        _, status, used = os.wait4(process.pid, 0)
        clock = time.perf_counter() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        watcher.join()
    if process.returncode:
        raise SystemExit(f'the run ended with status {process.returncode}')
    return {'clock': clock, 'cpu': used.ru_utime + used.ru_stime, 'memory': peak / 1e6}


def tree(pid: int) -> list[int]:
    """A process and all those that it started."""
    try:
        children = [int(child) for path in Path(f'/proc/{pid}/task').iterdir()
                    for child in (path / 'children').read_text().split()]
    except OSError:  # it has ended
        return []
    return [pid, *(other for child in children for other in tree(child))]


def resident(pid: int) -> int:
    try:
        return int(Path(f'/proc/{pid}/statm').read_text().split()[1]) * os.sysconf('SC_PAGE_SIZE')
    except OSError:
        return 0


def one_round(case: Case, folder: Path, made: list[bytes], extractor: LineFeatureExtractor) -> dict[str, Any]:
    """All contestants in turn; what a machine does changes from minute to minute, so each run has bare ones around."""
    short, long = folder / f'{case.name}-short', folder / f'{case.name}-long'
    result: dict[str, Any] = {'reading': timed(lambda: reading(long))}
    alone = [bare(case, made, extractor)]
    for everything in (False, True):
        for workers in dict.fromkeys((1, len(os.sched_getaffinity(0)))):
            some, all_ = (run(path, workers, everything=everything) for path in (short, long))
            alone.append(bare(case, made, extractor))
            around = [one['decoding and extraction'] for one in alone[-2:]]
            name = f'{"everything" if everything else "segments"}, {workers}'
            result[name] = with_rates(case, some, all_, {key: statistics.mean(one[key] for one in around)
                                                         for key in ('clock', 'cpu')})
    for name in alone[0]:
        result[name] = {key: statistics.median(one[name][key] for one in alone) for key in alone[0][name]}
    return result


def with_rates(
    case: Case, some: dict[str, float], all_: dict[str, float], alone: dict[str, float],
) -> dict[str, float]:
    """Of a run over a short and a long recording: seconds for each further frame, those before any, and shares."""
    more = case.frames * (LONG - 1)
    clock, cpu = ((all_[key] - some[key]) / more for key in ('clock', 'cpu'))
    return {'clock': clock, 'cpu': cpu, 'share': alone['clock'] / clock, 'times': cpu / alone['cpu'],
            'start': some['clock'] - case.frames * clock, 'whole': all_['clock'] / (case.frames * LONG),
            'memory, short': some['memory'], 'memory, long': all_['memory']}


def medians(rounds: list[dict[str, Any]]) -> dict[str, Any]:
    return {name: {key: statistics.median(one[name][key] for one in rounds) for key in rounds[0][name]}
            for name in rounds[0]}


def show(case: Case, found: dict[str, Any]) -> None:
    """A table of one case."""
    print(f'\n{case.name}, {case.frames} and {case.frames * LONG} frames')
    print(f'{"":26}{"frames/s":>10}{"share":>8}{"CPU":>8}{"start, s":>10}{"whole run":>11}{"MB, short":>11}{"long":>7}')
    for name, row in found.items():
        line = f'{name:26}{1 / row["clock"]:10.0f}'
        if 'start' in row:
            line += f'{row["share"]:8.2f}{row["times"]:8.2f}{row["start"]:10.2f}{1 / row["whole"]:11.0f}'
            line += f'{row["memory, short"]:11.0f}{row["memory, long"]:7.0f}'
        print(line, flush=True)
    workers = len(os.sched_getaffinity(0))
    for name in ('segments', 'everything') if workers > 1 else ():
        gain = found[f'{name}, 1']['clock'] / found[f'{name}, {workers}']['clock']
        print(f'{name}: {gain:.2f} times as many frames/s with {workers} workers as with one', flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--case', default='', help='only cases with this in their names')
    parser.add_argument('--scale', type=float, default=1.0, help='of the numbers of frames')
    parser.add_argument('--results', type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    cases = [Case(case.name, case.width, case.height, case.jpeg, max(1, round(case.frames * options.scale)))
             for case in CASES if options.case in case.name]
    extractor = LineFeatureExtractor(Parameters())
    results = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for case in cases:
            made = messages(case)
            for ending, frames in (('short', case.frames), ('long', case.frames * LONG)):
                record(folder / f'{case.name}-{ending}', case, made, frames)
            bare(case, made, extractor)  # memory and kernels are there from now on
            rounds = [one_round(case, folder, made, extractor) for _ in range(options.rounds)]
            results[case.name] = medians(rounds)
            show(case, results[case.name])
    if options.results:
        options.results.mkdir(parents=True, exist_ok=True)
        (options.results / 'bag.json').write_text(json.dumps(results, indent=1))


if __name__ == '__main__':
    main()

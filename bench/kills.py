"""Kill `line_features bag` at random moments and spoil what it needs, and see that nothing broken comes of it.

    python bench/kills.py [--runs 200] [--faults 100] [--every-step] [--seed 1] [--results FOLDER]

The recordings are bags/corridor at a quarter of its size, shown several times, in all three formats. An undisturbed run
of each setup says what is to come out. Then, so many times:

- A run is killed (SIGKILL), half of the time at a random moment of the clock, half right before a random one of the
  steps in which it opens, makes, renames or removes something of its target. It is gone on with by --resume, which is
  killed, too, some of the time. A bag may be in the place of the target before. After each kill the target must be what
  it was before, or whole; no process may be left; and in the end all messages must be those of the undisturbed run,
  byte for byte.
- A fault, by turns: the disk is full at a random size (a file system of its own, by unshare), the right to write the
  target or to read the recording is taken away at a random moment, the recording is cut or grows. The run must end by
  itself with sentences, or with the right result; and when the fault is gone --resume must give the right result.

It prints what happened how often, and ends with status 1 if anything was not as it must be.
"""

import argparse
import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer

from line_feature_node.bag import TABLE, VERSION
from line_feature_node.recordings import DECODERS, RecordingError, deserialize, told, typestore

CORRIDOR = Path(__file__).resolve().parents[1] / 'bags' / 'corridor'
IMAGE, TOPIC = 'sensor_msgs/msg/Image', '/camera'
#: Nanoseconds: when the recordings begin, and from frame to frame.
BEGIN, PERIOD = 1_800_000_000 * 10**9, 33_333_333
#: Seconds after which a run hangs, and in which workers must end with the process that they work for.
HANGS, AFTER = 120.0, 10.0
#: The command; before the step of that number it kills itself, and with 0 it says in the end how many there were.
PROGRAM = """
import atexit, os, signal, sys
from line_feature_node.command import main
last, place, steps = int(sys.argv.pop(1)), sys.argv.pop(1), 0
EVENTS = {'open', 'os.mkdir', 'os.remove', 'os.rename', 'os.rmdir', 'os.truncate', 'shutil.rmtree'}
def watch(event, arguments):
    global steps
    if event in EVENTS and place in str(arguments[0]):
        steps += 1
        if steps == last:
            os.kill(os.getpid(), signal.SIGKILL)
if last >= 0:
    sys.addaudithook(watch)
if last == 0:
    atexit.register(lambda: print(steps))
main()
"""
#: Never kills itself, and does not count.
ONLY_RUN = -1
#: Runs a command in a small file system at a folder, lists it, makes it large, and copies what is in it then.
SMALL_DISK = """
mount -t tmpfs -o size="$1" none "$2" || exit; cd "$2"; from=$3; shift 3
"$@"; echo "status $?"; ls
mount -o remount,size=200m none .
"$@" --resume; echo "status $?"; ls
cp -r out "$from"
"""
#: Root may do everything, unless it gives that up.
AS_ANYBODY = ('setpriv', '--bounding-set=-dac_override,-dac_read_search') if os.geteuid() == 0 else ()


@dataclass(frozen=True)
class Setup:
    """What is run, and how that ends."""

    name: str
    source: str
    options: tuple[str, ...]
    status: int = 0


SETUPS = (
    Setup('segments', 'mcap', ('--only-segments', '--workers', '1')),
    Setup('everything, with a table, by two workers, to sqlite3', 'sqlite3',
          ('--csv', '--workers', '2', '--storage', 'sqlite3')),
    Setup('segments, and copies of ROS 1', 'ros1', ('--only-segments', '--copy', '--workers', '1')),
    Setup('salvage of what is cut off', 'cut', ('--only-segments', '--salvage', '--workers', '1'), status=1),
)

#: Topic, stamp and bytes of the messages of a bag, and its table.
Content = tuple[list[tuple[str, int, bytes]], bytes]


@dataclass
class Expected:
    """What an undisturbed run of a setup makes, and took."""

    content: Content
    seconds: float
    steps: int
    size: int


@dataclass
class Findings:
    """What happened how often, and what must not have."""

    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def expect(self, condition: object, what: str) -> None:
        """Note it where a condition does not hold."""
        if not condition:
            self.wrong.append(what)
            print(f'NOT AS IT MUST BE: {what}', file=sys.stderr, flush=True)


# Recordings


def pictures() -> list[Any]:
    """The frames of the sample recording, small and grey."""
    with AnyReader([CORRIDOR]) as reader:
        messages = [(data, connection.msgtype) for connection, _, data in reader.messages()
                    if connection.msgtype in DECODERS]
    return [cv2.resize(DECODERS[kind](deserialize(CORRIDOR, data, kind)), (160, 120), interpolation=cv2.INTER_AREA)
            for data, kind in messages]


def record(path: Path, kind: str, frames: int) -> Path:
    """A recording of so many frames, or one that was cut off amid them; the path may have an ending more."""
    if kind == 'cut':
        record(path, 'mcap', frames)
        [file] = path.glob('*.mcap')
        os.truncate(file, file.stat().st_size * 3 // 4)
        return path
    ros1 = kind == 'ros1'
    types = typestore(ros1=ros1)
    shown = pictures()
    path = path.with_suffix('.bag') if ros1 else path
    if ros1:
        writer: Any = Writer1(path)
        writer.chunk_threshold = 200_000
    else:
        writer = Writer(path, version=VERSION, storage_plugin=StoragePlugin[kind.upper()])
    with writer:
        connection = writer.add_connection(TOPIC, IMAGE, typestore=types)
        for number in range(frames):
            pixels = shown[number % len(shown)]
            stamp = BEGIN + number * PERIOD
            time_ = types.types['builtin_interfaces/msg/Time'](sec=stamp // 10**9, nanosec=stamp % 10**9)
            more = {'seq': number} if ros1 else {}
            message = types.types[IMAGE](
                header=types.types['std_msgs/msg/Header'](**more, stamp=time_, frame_id='camera'), encoding='mono8',
                height=120, width=160, step=160, is_bigendian=0, data=np.ascontiguousarray(pixels).reshape(-1))
            writer.write(connection, stamp, (types.serialize_ros1 if ros1 else types.serialize_cdr)(message, IMAGE))
    return path


def content_of(bag: Path) -> Content:
    """All that is in a bag, in one order: sqlite3 has none for messages of one stamp.

    Raises:
        RecordingError: It is broken.
    """
    with told(bag), AnyReader([bag]) as reader:
        messages = sorted((connection.topic, stamp, bytes(data)) for connection, stamp, data in reader.messages())
    table = bag / TABLE
    return messages, table.read_bytes() if table.exists() else b''


def files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(path.iterdir())


# Runs


def command(setup: Setup, source: Path, target: Path, *more: str, last: int = ONLY_RUN) -> list[str]:
    return [sys.executable, '-c', PROGRAM, str(last), str(target), 'bag', str(source), '--out', str(target), '--quiet',
            *setup.options, *more]


def started(arguments: list[str]) -> subprocess.Popen[str]:
    """A process, and those that it starts, in a session of their own."""
    return subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                            start_new_session=True)


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Status, standard output and standard error of a process; one that hangs is killed."""
    try:
        out, errors = process.communicate(timeout=HANGS)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return process.wait(), '', 'it hangs'
    return process.returncode, out, errors


def of_session(session: int) -> list[int]:
    """Processes of a session that are not dead."""
    found = []
    for path in Path('/proc').glob('[0-9]*/stat'):
        with contextlib.suppress(OSError):
            state, _, _, own = path.read_text().rpartition(')')[2].split()[:4]
            if int(own) == session and state != 'Z':
                found.append(int(path.parent.name))
    return found


def all_gone(session: int) -> bool:
    """Whether all of a session end in time."""
    end = time.monotonic() + AFTER
    while of_session(session):
        if time.monotonic() > end:
            os.killpg(session, signal.SIGKILL)
            return False
        time.sleep(0.01)
    return True


class Campaign:
    """Recordings, what is to come of them, and what was found."""

    def __init__(self, folder: Path, frames: int, seed: int, setups: tuple[Setup, ...] = SETUPS) -> None:
        self.folder = folder
        self.random = random.Random(seed)
        self.findings = Findings()
        self.sources = {setup: record(folder / f'recording{number}', setup.source, frames)
                        for number, setup in enumerate(setups)}
        self.expected = {setup: self._undisturbed(setup) for setup in setups}

    def _undisturbed(self, setup: Setup) -> Expected:
        with self.place() as place:
            begin = time.monotonic()
            status, steps, errors = ended(started(command(setup, self.sources[setup], place / 'out', last=0)))
            if status != setup.status:
                raise SystemExit(f'an undisturbed run of {setup.name} ended with status {status}: {errors}')
            seconds = time.monotonic() - begin
            size = sum(file.stat().st_size for file in (place / 'out').iterdir())
            return Expected(content_of(place / 'out'), seconds, int(steps), size)

    @contextlib.contextmanager
    def place(self) -> Iterator[Path]:
        """An empty folder."""
        with tempfile.TemporaryDirectory(dir=self.folder) as name:
            yield Path(name)

    # Kills

    def kill(self) -> None:
        """A run of a random setup that is killed, once or several times, and gone on with."""
        setup = self.random.choice(list(self.sources))
        moments = self.random.choice((1, 1, 1, 2, 3))
        self._kill(setup, [self._random_step(setup) for _ in range(moments)], old=self.random.random() < 0.3)

    def every_step(self, setup: Setup, *, old: bool) -> None:
        """Runs of a setup, one killed right before each of its steps."""
        for step in range(1, self.expected[setup].steps + 1):
            self._kill(setup, [step], old=old)

    def _random_step(self, setup: Setup) -> int:
        """The step of a run before which it is to be killed, or none where that goes by the clock."""
        return ONLY_RUN if self.random.random() < 0.5 else self.random.randint(1, self.expected[setup].steps)

    def _kill(self, setup: Setup, moments: list[int], *, old: bool) -> None:
        with self.place() as place:
            target = place / 'out'
            if old:
                shutil.copytree(next(source for source in self.sources.values() if source.is_dir()), target)
            more = ['--overwrite'] if old else []
            before = content_of(target) if old else None
            for last in moments:
                moment = self._one_kill(setup, target, more, last)
                self.findings.counts[f'kills {moment}'] += 1
                if self._is_whole(setup, target, before, moment):
                    self.findings.counts['targets that were there when the kill came'] += 1
                    return
                more = [*(['--overwrite'] if old else []), '--resume']
            self._go_on(setup, self.sources[setup], target, more)

    def _one_kill(self, setup: Setup, target: Path, more: list[str], last: int) -> str:
        """Let a run be killed; at which kind of moment, in words."""
        by_clock = last == ONLY_RUN
        process = started(command(setup, self.sources[setup], target, *more, last=last))
        if by_clock:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(self.random.uniform(0, self.expected[setup].seconds))
            process.kill()
        status, _, errors = ended(process)
        self.findings.expect(all_gone(process.pid), f'{setup.name}: workers lived on')
        self.findings.expect(status in (setup.status, -signal.SIGKILL), f'{setup.name}: status {status}: {errors}')
        if status == setup.status:
            return 'that came too late'
        partial = target.with_name('out.partial')
        if not partial.exists():
            return 'before anything was written, or after all was'
        stage = 'while slices were done' if (partial / 'slices').exists() else 'while the folder was made or removed'
        return f'{stage}, by the {"clock" if by_clock else "step"}'

    def _is_whole(self, setup: Setup, target: Path, before: Content | None, moment: str) -> bool:
        """Whether the target is there, as it must be if it is."""
        replaced = target.with_name('out.partial') / 'replaced'
        if not target.exists():
            self.findings.expect(before is None or (replaced.exists() and content_of(replaced) == before),
                                 f'{setup.name}: the old bag is lost after a kill {moment}')
            return False
        try:
            found = content_of(target)
        except RecordingError as error:
            self.findings.expect(False, f'{setup.name}: a broken target after a kill {moment}: {error}')
            return True
        if found == before:
            return False
        self.findings.expect(found == self.expected[setup].content,
                             f'{setup.name}: a wrong target after a kill {moment}')
        return True

    def _go_on(self, setup: Setup, source: Path, target: Path, more: list[str]) -> None:
        """Resume undisturbed, and compare."""
        status, _, errors = ended(started(command(setup, source, target, *more)))
        self.findings.expect((status, bool(errors)) == (setup.status, bool(setup.status)),
                             f'{setup.name}: resumed: status {status}: {errors}')
        if status == setup.status:
            self.findings.expect(content_of(target) == self.expected[setup].content,
                                 f'{setup.name}: the resumed result is another')
            self.findings.expect([path.name for path in target.parent.glob('out*')] == ['out'],
                                 f'{setup.name}: something is left beside the target')
            self.findings.counts['resumed results that were equal'] += 1

    # Faults

    def fault(self, kind: Callable[['Campaign', Setup], None]) -> None:
        """A fault of a kind, in a random setup of those that end with status 0."""
        kind(self, self.random.choice([setup for setup in self.sources if not setup.status]))

    def full_disk(self, setup: Setup) -> None:
        """A file system that is too small, mostly."""
        size = int(self.random.uniform(0.02, 3.0) * self.expected[setup].size)
        with self.place() as place:
            (place / 'disk').mkdir()
            run = command(setup, self.sources[setup], Path('out'))
            done = started(['env', 'unshare', '-rm', 'sh', '-c', SMALL_DISK, 'sh', str(size), str(place / 'disk'),
                            str(place), *run])
            _, out, errors = ended(done)
            if 'status' not in out:
                self.findings.counts['disks that could not be mounted here, left out'] += 1
                return
            first, second = re.findall(r'status (\d+)\n([^s]*)', out) or [('', ''), ('', '')]
            what = f'{setup.name}, disk of {size} bytes: {out!r} {errors!r}'
            if first[0] == '0':
                self.findings.counts['disks that were large enough'] += 1
                self.findings.expect(first[1].split() == ['out'], what)
            else:
                self.findings.counts['disks that were full, a sentence'] += 1
                self.findings.expect(first[0] == '2' and first[1].split() in ([], ['out.partial']), what)
                self.findings.expect(second == ('0', 'out\n') and len(errors.splitlines()) == 1, what)
            self.findings.expect((place / 'out').exists() and content_of(place / 'out') == self.expected[setup].content,
                                 f'{setup.name}: another result after a full disk')

    def no_permission(self, setup: Setup) -> None:
        """The right to write or to read is taken away at a random moment, and given back."""
        with self.place() as place:
            source, target = self._copied(setup, place), place / 'made' / 'out'
            target.parent.mkdir()
            partial = target.with_name('out.partial')
            taken = self.random.choice([target.parent, partial, partial / 'slices', partial / 'bag', *files_of(source)])

            def take() -> None:
                with contextlib.suppress(FileNotFoundError):
                    taken.chmod(0o500 if taken.is_dir() else 0)

            status = self._disturbed(setup, source, target, take, 'permission taken away', AS_ANYBODY)
            with contextlib.suppress(FileNotFoundError):
                taken.chmod(0o700)
            if status:
                self._go_on(setup, source, target, ['--resume'])

    def cut_input(self, setup: Setup) -> None:
        """The recording becomes shorter at a random moment, and is as it was after that."""
        def cut(file: Path) -> None:
            os.truncate(file, self.random.randrange(file.stat().st_size))

        self._changed_input(setup, cut, 'input cut')

    def growing_input(self, setup: Setup) -> None:
        """The recording becomes longer at a random moment, and is as it was after that."""
        def grow(file: Path) -> None:
            with file.open('ab') as end:
                end.write(self.random.randbytes(self.random.randrange(1, 100_000)))

        self._changed_input(setup, grow, 'input grown')

    def _changed_input(self, setup: Setup, change: Callable[[Path], None], what: str) -> None:
        with self.place() as place:
            source, target = self._copied(setup, place), place / 'out'
            file = max(files_of(source), key=lambda file: file.stat().st_size)
            status = self._disturbed(setup, source, target, lambda: change(file), what)
            if status:
                [original] = [path for path in files_of(self.sources[setup]) if path.suffix == file.suffix]
                shutil.copy2(original, file)
                more = ['--resume', *(['--overwrite'] if target.exists() else [])]
                self._go_on(setup, source, target, more)

    def _copied(self, setup: Setup, place: Path) -> Path:
        source = self.sources[setup]
        (place / 'in').mkdir()
        copy = place / 'in' / source.name
        if source.is_dir():
            shutil.copytree(source, copy)
        else:
            shutil.copy2(source, copy)
        return copy

    def _disturbed(
        self, setup: Setup, source: Path, target: Path, disturb: Callable[[], None], what: str,
        wrapper: tuple[str, ...] = (),
    ) -> int:
        """Do something during a run; its status, which must go with what it says and leaves."""
        process = started([*wrapper, *command(setup, source, target)])
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(self.random.uniform(0, self.expected[setup].seconds))
        disturb()
        status, _, errors = ended(process)
        said = f'{setup.name}, {what}: status {status}: {errors}'
        self.findings.counts[f'{what}: status {status}'] += 1
        self.findings.expect(all_gone(process.pid), f'{setup.name}, {what}: workers lived on')
        self.findings.expect(status in (0, 1, 2) and 'Traceback' not in errors, said)
        self.findings.expect(bool(errors) == bool(status), said)
        if status == 2:
            self.findings.expect(not target.exists() and len(errors.splitlines()) == 1, said)
        if target.exists():
            found, right = content_of(target), self.expected[setup].content
            self.findings.expect(found == right or (status == 1 and set(found[0]) <= set(right[0])),
                                 f'{said}: the target')
        return status


KINDS = (Campaign.full_disk, Campaign.no_permission, Campaign.cut_input, Campaign.growing_input)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=200, help='that are killed')
    parser.add_argument('--faults', type=int, default=100, help='of the other kinds, by turns')
    parser.add_argument('--frames', type=int, default=240, help='of each recording')
    parser.add_argument('--every-step', action='store_true', help='kill a run before each step, too')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--results', type=Path)
    options = parser.parse_args()
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        campaign = Campaign(Path(name), options.frames, options.seed)
        for number in range(options.runs):
            campaign.kill()
            if (number + 1) % 20 == 0:
                print(f'{number + 1} runs, {len(campaign.findings.wrong)} findings', file=sys.stderr, flush=True)
        if options.every_step:
            for setup in campaign.sources:
                campaign.every_step(setup, old=True)
        for number in range(options.faults):
            campaign.fault(KINDS[number % len(KINDS)])
    findings = campaign.findings
    for what, count in sorted(findings.counts.items()):
        print(f'{count:6d}  {what}')
    print(f'{len(findings.wrong):6d}  findings, in {time.monotonic() - begin:.0f} s')
    if options.results:
        options.results.mkdir(parents=True, exist_ok=True)
        (options.results / 'kills.json').write_text(json.dumps(
            {'runs': options.runs, 'faults': options.faults, 'seed': options.seed, 'counts': findings.counts,
             'findings': findings.wrong}, indent=1))
    return 1 if findings.wrong else 0


if __name__ == '__main__':
    sys.exit(main())

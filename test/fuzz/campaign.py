"""Send inputs with something wrong through every door of the package, and report what does not end as documented.

    python test/fuzz/campaign.py [--inputs 100000] [--seed 1] [--doors image segments] [--results build/fuzz]
    python test/fuzz/campaign.py --doors image --seed 1 --number 1234

An input must give a result or the documented error, a sentence. Findings are any other exception or warning, the end
of the process, more than 10 seconds, and memory beyond a multiple of the image. Each door is tried in a process of its
own, which is replaced when it ends, with a limit on its memory. Inputs follow from the door, the seed and their number;
those with findings are written to the results. The second form has one of them taken in this process, for a debugger.
"""

import argparse
import contextlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
from doors import DOORS, Door, Input

import line_feature_node

#: Seconds that an input may take, and those that the preparations may.
PATIENCE, PREPARATION = 10.0, 900.0
#: Bytes that any input may take, whatever the image.
ALLOWANCE = 64 * 2**20
#: Bytes of address space that a process may have beyond what it begins with.
SPACE = 4 * 2**30
#: Longest sentence.
SENTENCE = 2000
#: Findings of one kind that are written.
KEPT = 3
#: Inputs between two reports of a process, whose number is lost when it ends in between.
REPORT = 50
COLUMNS = ('door', 'inputs', 'results', 'refused', 'kinds of findings', 'slowest, ms', 'most memory, MB', 'inputs/s')
#: What is tried, and what tries it.
PACKAGE, HERE = Path(line_feature_node.__file__).parent, Path(__file__).resolve().parent


@dataclass
class Tally:
    """What came of the inputs of a door.

    Attributes:
        inputs, results: How many there were, and how many gave a result.
        seconds: What all took.
        slowest: What the slowest took.
        memory: Bytes that one took at most.
        findings: How often each kind was found.
    """

    inputs: int = 0
    results: int = 0
    seconds: float = 0.0
    slowest: float = 0.0
    memory: int = 0
    findings: Counter[str] = field(default_factory=Counter)

    def add(self, other: 'Tally') -> None:
        """Count in what a process reports."""
        self.inputs += other.inputs
        self.results += other.results
        self.seconds += other.seconds
        self.slowest, self.memory = max(self.slowest, other.slowest), max(self.memory, other.memory)


def draw_of(door: str, seed: int, number: int) -> Random:
    """The source of all that is by chance in an input."""
    return Random(f'{door} {seed} {number}')


def taken(door: Door, fields: Input, folder: Path) -> tuple[int, str, str]:
    """Have an input taken.

    Returns:
        Bytes of the image, or -1 for a documented error; what kind of finding it is, '' for none; and its traceback.
    """
    try:
        return door.check(fields, folder), '', ''
    except (TypeError, ValueError) as error:
        text = str(error)
        if text and '\n' not in text and len(text) <= SENTENCE and _is_raised_here(error):
            return -1, '', ''
        return -1, f'no sentence: {_kind(error)}', traceback.format_exc()
    except Exception as error:
        return -1, _kind(error), traceback.format_exc()


def _is_raised_here(error: Exception) -> bool:
    """Whether the package says it, and not a library or the interpreter."""
    return Path(traceback.extract_tb(error.__traceback__)[-1].filename).is_relative_to(PACKAGE)


def _kind(error: Exception) -> str:
    """The exception and where in the package it came from."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__)
              if any(Path(frame.filename).is_relative_to(place) for place in (PACKAGE, HERE))]
    place = f'{Path(frames[-1].filename).name}:{frames[-1].lineno} {frames[-1].name}' if frames else ''
    return f'{type(error).__name__} in {place}'


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _forget_peak() -> int:
    """The memory that is taken now, from which the peak is counted anew."""
    with contextlib.suppress(OSError):
        Path('/proc/self/clear_refs').write_text('5')
    return _peak()


def _limit(space: int) -> None:
    pages = int(Path('/proc/self/statm').read_text().split()[0])
    limit = pages * resource.getpagesize() + space
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def work(name: str, seed: int, numbers: range, at: Any, pipe: Connection, folder: Path) -> None:
    """Take inputs, in a process of its own; `at` is told which one is under way, and the pipe what came of them."""
    with Path(os.devnull).open('w') as nothing:  # libraries of images say there what they find wrong
        os.dup2(nothing.fileno(), 2)
    warnings.simplefilter('error')
    warnings.filterwarnings('ignore', category=ResourceWarning)
    door = DOORS[name]
    door.prepare()
    _limit(SPACE)
    tally, low = Tally(), _forget_peak()
    for number in numbers:
        at.value = number
        fields = door.make(draw_of(name, seed, number))
        begin = time.perf_counter()
        size, kind, details = taken(door, fields, folder)
        seconds = time.perf_counter() - begin
        peak = _peak()
        if peak > low + 2**20:
            tally.memory = max(tally.memory, peak - low)
            if peak - low > ALLOWANCE + door.multiple * max(0, size):
                kind, details = kind or 'memory', f'{peak - low} bytes for an image of {size}\n{details}'
            low = _forget_peak()
        if seconds > PATIENCE and not kind:
            kind = 'slow'
        tally.add(Tally(1, int(size >= 0 and not kind), seconds, seconds))
        if kind:
            pipe.send((number, kind, details))
        if tally.inputs == REPORT or kind:
            pipe.send(tally)
            tally = Tally()
    pipe.send(tally)
    pipe.send(None)


class Campaign:
    """Tries a door, and keeps what is found in a folder."""

    def __init__(self, seed: int, results: Path) -> None:
        self._seed, self._results = seed, results
        self._context = multiprocessing.get_context('fork')

    def run(self, name: str, count: int) -> Tally:
        """Try a door with so many inputs."""
        tally, begin = Tally(), 0
        shutil.rmtree(self._results / name, ignore_errors=True)
        while begin < count:
            begin = self._process(name, range(begin, count), tally)
        return tally

    def _process(self, name: str, numbers: range, tally: Tally) -> int:
        """Try them until the process ends; the number of the first that is left is returned."""
        at = self._context.RawValue('q', -1)
        ours, theirs = self._context.Pipe(duplex=False)
        with tempfile.TemporaryDirectory(dir=_memory_disk(), prefix='fuzz-') as folder:
            process = self._context.Process(target=work, args=(name, self._seed, numbers, at, theirs, Path(folder)))
            process.start()
            theirs.close()
            hung = self._listen(name, process, ours, at, tally)
            process.join()
        if hung is None and process.exitcode == 0:
            return numbers.stop
        number = at.value
        if number < 0:
            raise SystemExit(f'{name}: the process ended before its first input, with status {process.exitcode}')
        died = f'ended by {signal.Signals(-process.exitcode).name}' if process.exitcode < 0 else 'ended'
        tally.add(Tally(1))
        self._found(name, number, hung or f'the process was {died}', '', tally)
        return number + 1

    def _listen(self, name: str, process: Any, pipe: Connection, at: Any, tally: Tally) -> str | None:
        """Take in what a process tells; it is killed, and why is returned, where an input takes too long."""
        last, since = at.value, time.monotonic()
        while True:
            for told in _told(pipe):
                if told is None:
                    return None
                if isinstance(told, Tally):
                    tally.add(told)
                else:
                    self._found(name, *told, tally)
            if at.value != last:
                last, since = at.value, time.monotonic()
            elif time.monotonic() - since > (PATIENCE + 2 if last >= 0 else PREPARATION):
                process.kill()
                return 'it hangs'

    def _found(self, name: str, number: int, kind: str, details: str, tally: Tally) -> None:
        tally.findings[kind] += 1
        if tally.findings[kind] > KEPT:
            return
        place = self._results / name / str(number)
        place.mkdir(parents=True, exist_ok=True)
        fields = DOORS[name].make(draw_of(name, self._seed, number))
        again = f'{sys.executable} {" ".join(sys.argv[:1])} --doors {name} --seed {self._seed} --number {number}'
        (place / 'finding.txt').write_text(f'{kind}\n{again}\n\n{details}\n{fields!r}\n', errors='backslashreplace')
        for key, value in fields.items():
            if isinstance(value, bytes):
                (place / f'{key}.bin').write_bytes(value)
            elif isinstance(value, np.ndarray) and value.dtype.kind != 'O':
                np.save(place / f'{key}.npy', value)


def _told(pipe: Connection) -> Iterator[Any]:
    """What there is to be heard within a moment; None when there is nothing more to come."""
    wait = 0.1
    while pipe.poll(wait):
        wait = 0
        try:
            told = pipe.recv()
        except EOFError:
            told = None
        yield told
        if told is None:
            return


def _memory_disk() -> Path | None:
    place = Path('/dev/shm')
    return place if os.access(place, os.W_OK) else None


def one(name: str, seed: int, number: int) -> None:
    """Take one input in this process."""
    fields = DOORS[name].make(draw_of(name, seed, number))
    DOORS[name].prepare()
    warnings.simplefilter('error')
    with tempfile.TemporaryDirectory() as folder:
        size, kind, details = taken(DOORS[name], fields, Path(folder))
    print(fields, kind or f'as documented, {size} bytes', details, sep='\n')


def _row(name: str, tally: Tally) -> tuple[str, ...]:
    refused = tally.inputs - tally.results - tally.findings.total()
    return (name, str(tally.inputs), str(tally.results), str(refused), str(len(tally.findings)),
            f'{tally.slowest * 1e3:.0f}', f'{tally.memory / 1e6:.0f}', f'{tally.inputs / max(tally.seconds, 1e-9):.0f}')


def main() -> int:
    """The command; 1 where there are findings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    # A door has the same inputs whether the others are tried or not.
    whole = sum(door.share for door in DOORS.values())
    parser.add_argument('--inputs', type=int, default=whole, help='of all doors, which have their shares')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--doors', nargs='+', choices=DOORS, default=[*DOORS])
    parser.add_argument('--number', type=int, help='of the only input')
    parser.add_argument('--results', type=Path, default=Path('build/fuzz'))
    options = parser.parse_args()
    if options.number is not None:
        one(options.doors[0], options.seed, options.number)
        return 0
    cv2.setNumThreads(1)  # threads and forks do not go together
    campaign = Campaign(options.seed, options.results)
    print(f'| {" | ".join(COLUMNS)} |')
    total = Tally()
    for name in options.doors:
        tally = campaign.run(name, -(-options.inputs * DOORS[name].share // whole))
        total.add(tally)
        total.findings.update({f'{name}: {kind}': number for kind, number in tally.findings.items()})
        print(f'| {" | ".join(_row(name, tally))} |', flush=True)
    for kind, number in total.findings.items():
        print(f'found {number} times: {kind}')
    print(f'| {" | ".join(_row("all", total))} |')
    if total.findings:
        print(f'inputs with findings are in {options.results}')
    return 1 if total.findings else 0


if __name__ == '__main__':
    sys.exit(main())

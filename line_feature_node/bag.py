"""The offline run over a recording: slices to workers, what comes back to a bag, and nothing half done.

Beside the target there is a folder for what is under way, with a file for each slice that is done, so that a run that
was killed can go on. The target is there when all of it is, by a rename.
"""

import bisect
import contextlib
import errno
import fcntl
import hashlib
import heapq
import importlib.metadata
import json
import math
import os
import shutil
import sqlite3
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from rosbags.interfaces import (
    Connection,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from line_feature_node.core import SEGMENT_DTYPE
from line_feature_node.frames import Frames
from line_feature_node.recordings import (
    METADATA,
    OUTPUTS,
    SALVAGE,
    SALVAGED,
    Buffer,
    RecordingError,
    Salvage,
    Slice,
    as_ros2,
    is_ros1,
    opened,
    plan,
    told,
    typestore,
)
from line_feature_node.slices import CSV, Frame, Job, process_slice, rests, unpack
from line_feature_node.workers import Workers, in_order, inline
from line_feature_node.yaml_text import parsed

#: What is offered with results, as the node does: reliable, of depth 5.
QOS = Qos(QosHistory.KEEP_LAST, 5, QosReliability.RELIABLE, QosDurability.VOLATILE, QosTime(0, 0), QosTime(0, 0),
          QosLiveliness.SYSTEM_DEFAULT, QosTime(0, 0), avoid_ros_namespace_conventions=False)
#: Latest version of the metadata of bags.
VERSION: Literal[9] = 9
#: What is said of a recording without images, or without any in the time that was asked for.
NO_IMAGES = 'no images to be processed'
#: What definitions that are wrong or missing raise: the parser, the table of types, and their use.
UNKNOWN_TYPES = (AssertionError, KeyError, TypesysError, ValueError)
#: Name of the segments as a table in a bag.
TABLE = 'segments.csv'
#: Files of messages in a bag, by their ending.
OF_BAGS = ('.db3', '.mcap')
#: How a rename says that something is there, be it a folder with something in it or a file.
TAKEN = (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR)


class TargetError(OSError):
    """The result cannot be written where it is to be; the message is a sentence for users."""


@dataclass(frozen=True)
class Run:
    """What is asked for, of one recording or many.

    Attributes:
        job: What is done with every slice.
        topics: Topics of images; empty for all.
        start, end: Seconds from the beginning of a recording.
        every: One of so many frames is processed.
        storage: 'mcap' or 'sqlite3'.
        copy: Whether everything of the input is copied, too.
        overwrite: Whether a target that exists is replaced.
        resume: Whether what an earlier run left is used.

    Raises:
        ValueError: There is no time between start and end.
    """

    job: Job
    topics: tuple[str, ...] = ()
    start: float | None = None
    end: float | None = None
    every: int = 1
    storage: str = 'mcap'
    copy: bool = False
    overwrite: bool = False
    resume: bool = False

    def __post_init__(self) -> None:
        begin, stop = self.start or 0.0, math.inf if self.end is None else self.end
        if not begin < stop:
            raise ValueError(f'end must be later than start, got {stop:g} s and {begin:g} s')


@dataclass
class Outcome:
    """What became of a recording.

    Attributes:
        source, target: The recording and the bag that was made of it.
        frames: All of them, without their messages.
        error: Why nothing came of it, a sentence that does not begin with its path; '' where something did.
        uncopied: Topics that could not be copied, for want of their types.
        spoilt: How many messages could not be copied, by topic and reason.
        salvaged: What was salvaged of the recording, where that was needed.
    """

    source: Path
    target: Path
    frames: Frames = field(default_factory=Frames)
    error: str = ''
    uncopied: list[str] = field(default_factory=list)
    spoilt: Counter[str] = field(default_factory=Counter)
    salvaged: Salvage | None = None

    @property
    def failed(self) -> Counter[str]:
        """How many frames failed, by reason."""
        return self.frames.failed

    @property
    def segments(self) -> int:
        """How many segments were found."""
        return int(self.frames.table['segments'].sum())


def process_recording(
    source: Path, target: Path, run: Run, workers: Workers, watch: Callable[[int, int, Frame | None], None],
    reading: Path | None = None, say: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Process one recording into a bag.

    Args:
        source: The recording.
        target: The folder of the bag.
        run: What is asked for.
        workers: Who does the work.
        watch: Told of each frame that is done, with the number of slices that are done, and of all that are known of,
            which grows where frames come in bursts; None for no frame.
        reading: What is read in place of the recording.
        say: Told, in a sentence, of slices that were done and are discarded, as the run does not resume.

    Raises:
        RecordingError: The recording cannot be read.
        TargetError: The target exists, or cannot be written.
        WorkersError: The workers die.
    """
    # A target that is a link stays one: what it leads to is made.
    here, there = Path(os.path.realpath(source)), Path(os.path.realpath(target))
    if here == there or here in there.parents or there in here.parents:
        raise TargetError(f'{target} is the recording itself, or one of the two is in the other')
    if there in (Path.cwd(), *Path.cwd().parents):
        raise TargetError(f'{target} is the folder that this is started in, or above it: name a new one')
    _check(target, there, overwrite=run.overwrite)
    reading = reading or source
    slices = [replace(part, path=reading.absolute())  # workers may be in other folders
              for part in plan(reading, topics=list(run.topics), start=run.start, end=run.end, every=run.every)]
    outcome = Outcome(source, target)
    if not slices:
        outcome.error = NO_IMAGES
        return outcome
    with (_told(target), _Work(reading, there, run, slices, say) as work,
          contextlib.closing(work.results(workers)) as results):
        for done, (part, data) in enumerate(results, 1):
            for frame in work.write(part, unpack(data), outcome):
                watch(done - 1, done + work.left, frame)
            watch(done, done + work.left, None)
        outcome.uncopied, outcome.spoilt = work.uncopied, work.spoilt
        work.finish()
    return outcome


def partial_folder(target: Path) -> Path:
    """The folder for what is under way, beside the target.

    Raises:
        TargetError: Nothing can be beside it.
    """
    there = Path(os.path.realpath(target))
    if not there.name:
        raise TargetError(f'{target} is the root of the file system: name a new folder in it')
    return there.with_name(f'{there.name}.partial')


def _check(target: Path, there: Path, *, overwrite: bool) -> None:
    """See that nothing is lost where a target is to be: only bags, and folders with nothing in them, are replaced.

    Args:
        target: As its user calls it.
        there: The place that it leads to.
        overwrite: Whether they are replaced.

    Raises:
        TargetError: There is something that stays.
    """
    with _told(target):
        if not os.path.lexists(there):
            return
        other = _not_of_a_bag(there)
    if other:
        raise TargetError(f'{target} exists and is not replaced, as it is no bag: {other}')
    if not overwrite:
        raise TargetError(f'{target} exists: --overwrite replaces it')


def _not_of_a_bag(path: Path) -> str:
    """Why what is there is more or other than a bag or an empty folder; '' where it is not."""
    if not path.is_dir():
        return 'it is no folder'
    entries = sorted(path.iterdir())
    for entry in entries:
        if entry.is_dir() or not (entry.name in (METADATA, TABLE) or entry.suffix in OF_BAGS):
            return f'{entry.name} is in it'
    if entries and not _describes_a_bag(path / METADATA):
        return f'it has no {METADATA} of one'
    return ''


def _describes_a_bag(metadata: Path) -> bool:
    try:
        content = parsed(metadata.read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and 'rosbag2_bagfile_information' in content


@contextlib.contextmanager
def _told(target: Path) -> Iterator[None]:
    """Make a sentence of what the file system says, and SQLite where it writes."""
    try:
        yield
    except (TargetError, RecordingError):
        raise
    except OSError as error:
        raise TargetError(f'cannot write {target}: {error.strerror or error}') from error
    except sqlite3.Error as error:
        raise TargetError(f'cannot write {target}: {error}') from error
    except OverflowError as error:
        raise TargetError(f'cannot write {target}: a stamp is beyond what the storage can have ({error})') from error


class _Work:
    """The folder for what is under way, and the bag in it that is being written."""

    def __init__(
        self, source: Path, target: Path, run: Run, slices: list[Slice], say: Callable[[str], None],
    ) -> None:
        self._target = target
        self._run = run
        self._slices = slices
        self._say = say
        self._folder = partial_folder(target)
        self._journal = self._folder / 'slices'
        self._replaced = self._folder / 'replaced'
        self._bag = self._folder / 'bag' / target.name  # the file in it has the name of its folder
        self._lock = -1
        self._writer: Any = None
        self._source = source
        self._stack = contextlib.ExitStack()
        self._offsets = dict.fromkeys(slices[0].topics, 0)
        self._copied = None if run.start is None else slices[0].start  # up to where
        self.uncopied: list[str] = []
        self.spoilt: Counter[str] = Counter()
        self.left = len(slices)

    def __enter__(self) -> '_Work':
        self._folder.mkdir(parents=True, exist_ok=True)
        self._see_that_all_is_ours()
        place = self._folder / 'lock'
        self._lock = os.open(place, os.O_CREAT | os.O_RDWR)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.path.samestat(os.fstat(self._lock), place.stat()):
                raise BlockingIOError  # another run has just ended and cleared up, and yet another begun
        except (BlockingIOError, FileNotFoundError):
            os.close(self._lock)
            raise TargetError(f'another run is writing {self._target}') from None
        try:
            self._begin()
        except BaseException:
            self._clear_up()
            raise
        return self

    def _see_that_all_is_ours(self) -> None:
        """The folder is removed in the end, with all that is in it."""
        ours = {'lock', 'run.json', 'run.json.new', SALVAGED, TABLE, *(
            folder.name for folder in (self._journal, self._replaced, self._bag.parent))}
        for entry in self._folder.iterdir():
            if entry.name not in ours and not entry.name.startswith(SALVAGE):
                raise TargetError(f'{self._folder} is not what an earlier run left, {entry.name} is in it: '
                                  f'move it away')

    def _begin(self) -> None:
        described = json.dumps(self._description(), default=str, sort_keys=True)
        record = self._folder / 'run.json'
        self._settle()
        _check(self._target, self._target, overwrite=self._run.overwrite)
        same = record.exists() and record.read_text() == described
        if self._run.resume and record.exists() and not same:
            raise TargetError(f'{self._folder} is of a run with other settings, another recording or another version: '
                              f'remove it, or run without --resume')
        done = sum(made for _, _, made in self._pieces()) if same and not self._run.resume else 0
        if done:  # those of another run would be of no use
            self._say(f'{done} slices that an interrupted run had done are discarded; --resume would have used them')
        for old in (self._bag.parent, *(() if self._run.resume else (self._journal,))):
            with contextlib.suppress(FileNotFoundError):
                shutil.rmtree(old)
        self._journal.mkdir(exist_ok=True)
        _write_whole(record, described.encode())
        self._writer = Writer(self._bag, version=VERSION,
                              storage_plugin=StoragePlugin[self._run.storage.upper()])
        if self._run.storage == 'mcap':
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        self._connections = {
            (topic, name): self._writer.add_connection(
                f'{topic}/{name}', OUTPUTS[name], typestore=typestore(ros1=False), offered_qos_profiles=[QOS])
            for topic in self._slices[0].topics for name in self._run.job.outputs}
        self._copier = _Copier(self._stack.enter_context(opened(self._source)), self._source, self._writer,
                               {f'{topic}/{name}' for topic, name in self._connections}) if self._run.copy else None
        if self._copier:
            self.uncopied, self.spoilt = self._copier.left_out, self._copier.spoilt
        self._csv = None
        if self._run.job.csv:
            self._csv = self._stack.enter_context((self._folder / TABLE).open('w', newline=''))
            self._csv.write(','.join(('stamp', 'topic', 'frame', *(SEGMENT_DTYPE.names or ()))) + '\n')

    def _description(self) -> dict[str, Any]:
        """All that the results of the slices depend on; where the recording lies is not of it."""
        source = self._source.resolve()
        files = [source] if source.is_file() else sorted(source.iterdir())
        mask = self._run.job.mask
        job = {**asdict(self._run.job), 'mask': '' if mask is None else hashlib.sha256(mask.tobytes()).hexdigest()}
        del job['parameters']['threads']
        return {'version': importlib.metadata.version('line_feature_node'), 'job': job,
                'files': [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files],
                'slices': [asdict(replace(part, path=Path())) for part in self._slices]}

    def results(self, workers: Workers) -> Generator[tuple[Slice, bytes], None, None]:
        """The slices, each up to where it was done, with what was made of them; some may be from the journal."""
        pieces = deque(self._pieces())
        missing = [(part, self._run.job) for _, part, made in pieces if not made]
        if len(missing) == 1:
            workers = inline()
        with contextlib.closing(in_order(workers, process_slice, missing, _left)) as made:
            while pieces:
                path, part, there = pieces.popleft()
                data = path.read_bytes() if there else next(made)
                left = rests(part, data)
                if not there:
                    _write_whole(path, data)
                    pieces.extendleft((self._path(rest), rest, False) for rest in reversed(left))
                self.left = len(pieces)
                yield replace(part, stop=left[0].start) if left else part, data

    def _pieces(self) -> Iterator[tuple[Path, Slice, bool]]:
        """The slices and what is known to be left of them, in order: their place in the journal, and if it is there."""
        parts = deque(self._slices)
        while parts:
            part = parts.popleft()
            path = self._path(part)
            made = path.exists()
            if made:
                parts.extendleft(reversed(rests(part, path.read_bytes())))
            yield path, part, made

    def _path(self, part: Slice) -> Path:
        number = bisect.bisect(self._slices, part.start, key=lambda each: each.start) - 1
        rest = '' if part == self._slices[number] else f'-{part.start}-{part.stop}-{part.after}'
        return self._journal / f'{number:06d}{rest}'

    def write(self, part: Slice, frames: list[Frame], outcome: Outcome) -> Iterator[Frame]:
        """Write what was made of a slice, and what is copied of its time, in the order of time."""
        for frame in frames:
            if not part.skipped:
                frame.number += self._offsets[frame.topic]
        for topic in self._offsets:
            self._offsets[topic] += sum(frame.topic == topic for frame in frames)
        self._write_messages(part, frames)
        for frame in frames:
            self._write_text(frame)
            bare = replace(frame, messages={})
            outcome.frames.append(bare)
            yield bare

    def _write_messages(self, part: Slice, frames: list[Frame]) -> None:
        made: Iterator[tuple[int, Any, Any]] = (
            (frame.stamp, self._connections[frame.topic, name], data)
            for frame in frames for name, data in frame.messages.items() if name != CSV)
        if self._copier:
            # What was before the first image, and after the last, belongs to the first and the last slice.
            stop = part.stop if self.left or self._run.end is not None else None
            made = heapq.merge(self._copier.messages(self._copied, stop), made, key=lambda message: message[0])
            self._copied = stop
        for stamp, connection, data in made:
            self._writer.write(connection, stamp, data)

    def _write_text(self, frame: Frame) -> None:
        if self._csv is not None and frame.messages.get(CSV):
            head = f'{frame.stamp},{frame.topic},{frame.number},'
            self._csv.writelines(f'{head}{line}\n' for line in frame.messages[CSV].decode().split('\n'))

    def finish(self) -> None:
        """Make the target of what was written, by a rename, and clear up.

        Raises:
            TargetError: A target came up meanwhile, which is not to be replaced.
        """
        self._writer.close()
        self._writer = None
        self._stack.close()
        if self._csv is not None:
            (self._folder / TABLE).rename(self._bag / TABLE)
        for file in self._bag.iterdir():
            _sync(file)
        self._put_in_place()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _put_in_place(self) -> None:
        came_up = (f'{self._target} came up during the run and stays as it is: once it is away, --resume puts the new '
                   f'bag there without doing the work again')
        if self._run.overwrite:
            _check(self._target, self._target, overwrite=True)  # something else may have come up during the run
            with contextlib.suppress(FileNotFoundError):
                self._target.rename(self._replaced)
        elif self._target.exists():
            raise TargetError(came_up)
        try:
            self._bag.rename(self._target)
        except OSError as error:  # what came up in this very moment is not replaced either, but for an empty folder
            if error.errno in TAKEN:
                raise TargetError(came_up) from None
            raise

    def _settle(self) -> None:
        """Put back the old target where no new one came in its place; where one did, the old one is done with."""
        if not self._replaced.exists():
            return
        if not self._target.exists():
            self._replaced.rename(self._target)
        else:
            shutil.rmtree(self._replaced)

    def __exit__(self, *_: object) -> None:
        self._clear_up()

    def _clear_up(self) -> None:
        """Leave the journal for a later run where this one did not finish, and nothing else."""
        with contextlib.suppress(Exception):
            self._stack.close()
        if self._writer is not None:
            with contextlib.suppress(Exception):
                self._writer.abort()
        shutil.rmtree(self._bag.parent, ignore_errors=True)
        with contextlib.suppress(OSError):  # then the next run does it
            self._settle()
        os.close(self._lock)


class _Copier:
    """Copies messages of the input as they are; those of ROS 1 are serialised as ROS 2 does."""

    def __init__(self, reader: Any, source: Path, writer: Writer, taken: set[str]) -> None:
        self._reader = reader
        self._ros1 = is_ros1(source)
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._targets: dict[int, Connection] = {}
        self._sources: list[Connection] = []
        self._path = source
        self.left_out: list[str] = []
        self.spoilt: Counter[str] = Counter()
        for connection in reader.connections:
            if connection.topic in taken:
                continue
            try:
                self._targets[connection.id] = self._add(connection, writer)
                self._sources.append(connection)
            except UNKNOWN_TYPES:
                self.left_out.append(connection.topic)

    def _add(self, connection: Connection, writer: Writer) -> Connection:
        same = [known for known in self._targets.values()
                if (known.topic, known.msgtype) == (connection.topic, connection.msgtype)]
        if same:  # two publishers of one topic
            return same[0]
        qos = getattr(connection.ext, 'offered_qos_profiles', [])
        if self._ros1:
            self._learn(get_types_from_msg(connection.msgdef.data, connection.msgtype))
            return writer.add_connection(connection.topic, connection.msgtype, typestore=self._types)
        if connection.msgdef.data:
            return writer.add_connection(connection.topic, connection.msgtype, msgdef=connection.msgdef.data,
                                         rihs01=connection.digest or _hash(connection), offered_qos_profiles=qos)
        return writer.add_connection(connection.topic, connection.msgtype, typestore=typestore(ros1=False),
                                     offered_qos_profiles=qos)

    def _learn(self, types: Any) -> None:
        """Take up types of ROS 1; those that ROS 2 has must have the same fields there, whatever their names.

        Raises:
            ValueError: One has not. A header has a number in ROS 1, which is left out in the conversion.
        """
        known = self._types.fielddefs
        for name, (_, fields) in types.items():
            if (name in known and name != 'std_msgs/msg/Header'
                    and [kind for _, kind in fields] != [kind for _, kind in known[name][1]]):
                raise ValueError(f'{name} is another in ROS 2')
        self._types.register({name: definition for name, definition in types.items() if name not in known})

    def messages(self, start: int | None, stop: int | None) -> Iterator[tuple[int, Connection, bytes]]:
        """Stamp, connection of the new bag, and bytes of the messages in a span of time; what is spoilt is counted.

        Raises:
            RecordingError: The recording cannot be read on.
        """
        with told(self._path):
            for connection, stamp, data in self._reader.messages(self._sources, start, stop) if self._sources else ():
                copied = self._converted(connection, stamp, data)
                if copied is not None:
                    yield stamp, self._targets[connection.id], copied

    def _converted(self, connection: Connection, stamp: int, data: bytes) -> bytes | None:
        try:
            if not isinstance(stamp, int) or stamp < 0:  # tables of sqlite3 have anything anywhere
                raise ValueError(f'no time: {stamp!r} where nanoseconds are expected')
            if not isinstance(data, Buffer):
                raise ValueError(f'no {connection.msgtype}: {type(data).__name__} where bytes are expected')
            return as_ros2(self._types, data, connection.msgtype) if self._ros1 else data
        except ValueError as error:
            self.spoilt[f'{connection.topic}: {error}'] += 1
            return None


def _hash(connection: Connection) -> str:
    """The hash of a type, by the definition that a recording has of it; a lone mcap lacks hashes."""
    types = get_typestore(Stores.EMPTY)
    idl = connection.msgdef.format == MessageDefinitionFormat.IDL
    types.register(get_types_from_idl(connection.msgdef.data) if idl else
                   get_types_from_msg(connection.msgdef.data, connection.msgtype))
    return types.hash_rihs01(connection.msgtype)


def _left(piece: tuple[Slice, Job], data: bytes) -> list[tuple[Slice, Job]]:
    """What a piece of work leaves to be done."""
    part, job = piece
    return [(rest, job) for rest in rests(part, data)]


def _write_whole(path: Path, data: bytes) -> None:
    """Write a file that is whole when it is there, even if the machine is switched off."""
    beside = path.with_name(f'{path.name}.new')
    beside.write_bytes(data)
    _sync(beside)
    beside.rename(path)


def _sync(path: Path) -> None:
    """Have a file on the disk; some file systems say only now that there is no room for it."""
    with path.open('rb') as file:
        os.fsync(file.fileno())

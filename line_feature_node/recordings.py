"""Recordings of ROS 1 and ROS 2 as they lie on disk: found, opened, and divided into slices of time."""

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_typestore

from line_feature_node.images import compressed_image_of, image_of

#: How the picture of a message is had, by its type.
DECODERS = {'sensor_msgs/msg/Image': image_of, 'sensor_msgs/msg/CompressedImage': compressed_image_of}
#: What is made of a frame, by the ending of its topic, with the type of the message.
OUTPUTS = {
    'segments': 'sensor_msgs/msg/PointCloud2', 'markers': 'visualization_msgs/msg/ImageMarker',
    'overlay': 'sensor_msgs/msg/CompressedImage',
}
#: Files that are recordings, or parts of one.
SUFFIXES = ('.bag', '.db3', '.mcap')
METADATA = 'metadata.yaml'
#: Things wrong with a recording that are told of; there may be one a chunk.
TOLD = 3
#: Frames in a slice, about: few enough to be kept in memory, enough to be worth opening the recording for.
SLICE = 32
#: Bytes on the disk that a frame takes at least, about: what a damaged recording says of their number may be anything.
LEAST_FRAME = 128

Reader = Reader1 | Reader2
#: What messages are in; a damaged table of sqlite3 may have anything in its place.
Buffer = bytes | bytearray | memoryview


class RecordingError(ValueError):
    """A recording cannot be read; the message is a sentence for users."""


class DamagedError(RecordingError):
    """What is in the files of a recording makes no sense, or the name is that of one that was not finished."""


@dataclass(frozen=True)
class Slice:
    """The images of a recording in a span of time: what one worker does at a time.

    Attributes:
        path: The recording.
        topics: Topics of images.
        start, stop: Nanoseconds, the first that belongs to it and the first that no longer does.
        every: One of so many frames of a topic is processed.
        skipped: Frames of each topic that came before it, to count on from.
        after: Messages at its beginning, in the order in which they are read, that do not belong to it.
    """

    path: Path
    topics: tuple[str, ...]
    start: int
    stop: int
    every: int = 1
    skipped: tuple[int, ...] = ()
    after: int = 0


#: In the folder for what is under way: says that a salvaged recording was gone over, and begins the names of those.
SALVAGED, SALVAGE = 'salvaged', 'salvage-'


@dataclass(frozen=True)
class Salvage:
    """What was salvaged of a recording.

    Attributes:
        path: The clean recording.
        messages: How many it has.
        begin, until: Stamps of its first and its last message, nanoseconds.
        damage: What is wrong with the recording, in a few words each.
    """

    path: Path
    messages: int
    begin: int
    until: int
    damage: tuple[str, ...]

    def __str__(self) -> str:
        wrong = '; '.join(self.damage[:TOLD]) or 'only its index or metadata is damaged'
        more = f' and {len(self.damage) - TOLD} more' if len(self.damage) > TOLD else ''
        return (f'salvaged {self.messages} messages, until {(self.until - self.begin) / 1e9:.2f} s after the first '
                f'(stamp {self.until / 1e9:.3f}): {wrong}{more}')


def find_recordings(paths: list[Path]) -> list[Path]:
    """The recordings themselves, and of folders that are none those inside, at any depth.

    Raises:
        RecordingError: There is nothing of that name, or no recording in a folder.
    """
    found: list[Path] = []
    for path in paths:
        try:
            path.stat()
            inside = list(_inside(path, set()))
        except FileNotFoundError:
            raise RecordingError(f'{path}: no such file or folder') from None
        except OSError as error:
            raise RecordingError(f'{error.filename or path}: {error.strerror}') from None
        if not inside:
            raise RecordingError(f'{path}: no recordings ({", ".join(SUFFIXES)}) in this folder')
        found += inside
    return found


def _inside(path: Path, seen: set[Path]) -> Iterator[Path]:
    """The recordings in a folder that is in none of those seen, as links may lead back to them."""
    if not path.is_dir() or (path / METADATA).exists():
        yield path
        return
    place = path.resolve()
    if place in seen:
        return
    seen.add(place)
    for entry in sorted(path.iterdir()):
        if entry.is_dir() or entry.suffix in SUFFIXES:
            yield from _inside(entry, seen)


@contextmanager
def opened(path: Path) -> Iterator[Reader]:
    """A recording, open for reading while the block lasts.

    Only the types of images are needed from it, which are known: definitions that it lacks or has wrong do not matter.

    Raises:
        RecordingError: It cannot be read.
        DamagedError: What is read of it, in the block too, makes no sense.
    """
    with told(path), _reader(path) as reader:
        yield reader


@contextmanager
def kept_open(path: Path) -> Iterator[Reader]:
    """As :func:`opened`, but it stays open for this thread until that asks for another one, or for the changed file.

    To open a recording takes longer the longer it is, as its index is read; a slice of it does not.
    """
    with told(path):
        state = _state(path)
        kept: _Kept | None = getattr(_OF_THREAD, 'kept', None)
        if kept is None or kept.state != state:
            _OF_THREAD.kept = None
            kept = _OF_THREAD.kept = _Kept(state, _reader(path))
        try:
            yield kept.reader
        except BaseException:
            _OF_THREAD.kept = None
            raise


_OF_THREAD = threading.local()


class _Kept:
    """A recording that is open until it is forgotten."""

    def __init__(self, state: object, reader: Reader) -> None:
        reader.open()
        self.state, self.reader = state, reader

    def __del__(self) -> None:
        if hasattr(self, 'reader'):
            self.reader.close()


def _state(path: Path) -> object:
    """Which files a recording has, and which versions of them."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stats = [file.stat() for file in files]
    return path, [(file, stat.st_ino, stat.st_size, stat.st_mtime_ns) for file, stat in zip(files, stats, strict=True)]


def _reader(path: Path) -> Reader:
    if path.is_file() and path.stat().st_size == 0:
        raise RecordingError(f'{path}: the file is empty')
    if path.is_file() and path.suffix not in SUFFIXES:
        raise DamagedError(f'{path}: not a recording, expected one of {", ".join(SUFFIXES)} or a folder')
    return Reader1(path) if is_ros1(path) else Reader2(path)


@contextmanager
def told(path: Path) -> Iterator[None]:
    """Make a sentence of what a library says of a recording.

    Raises:
        DamagedError: It cannot be read.
    """
    try:
        yield
    except (RecordingError, GeneratorExit):
        raise
    except OSError as error:
        raise DamagedError(f'{path}: {error.strerror or error}') from error
    except Exception as error:
        # Whatever the library makes of bytes that are noise: its own errors, and those of what it is built on.
        raise DamagedError(f'{path}: cannot be read ({_reason(error)})') from error


def _reason(error: Exception) -> str:
    # Some have a tuple of their words instead of words.
    [text] = error.args if len(error.args) == 1 else [error]
    words = ' '.join(map(str, text)) if isinstance(text, tuple) else str(error)
    return ' '.join(words.split()).rstrip('.') or type(error).__name__


def is_ros1(path: Path) -> bool:
    """Whether a recording is one of ROS 1; a folder is one of ROS 2, whatever its name."""
    return path.suffix == '.bag' and not path.is_dir()


def image_topics(reader: Reader) -> dict[str, str]:
    """Topics that have images, with their message types."""
    return {connection.topic: connection.msgtype for connection in reader.connections
            if connection.msgtype in DECODERS}


def _overlays(reader: Reader) -> set[str]:
    """Topics of overlays that an earlier run made: they are beside its segments."""
    present = {(connection.topic, connection.msgtype) for connection in reader.connections}
    bases = {topic.removesuffix('/segments') for topic, _ in present if topic.endswith('/segments')}
    return {f'{base}/overlay' for base in bases
            if {(f'{base}/{name}', OUTPUTS[name]) for name in ('segments', 'overlay')} <= present}


@cache
def typestore(*, ros1: bool) -> Any:
    """The types of messages as ROS 1 or ROS 2 has them."""
    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)


def deserialize(path: Path, data: bytes, msgtype: str) -> Any:
    """A message from the bytes that a recording has.

    Raises:
        ValueError: They are none.
    """
    if not isinstance(data, Buffer):
        raise ValueError(f'no {msgtype}: {type(data).__name__} where bytes are expected')
    try:
        if is_ros1(path):
            return typestore(ros1=True).deserialize_ros1(memoryview(data), msgtype)
        return typestore(ros1=False).deserialize_cdr(memoryview(data), msgtype)
    except Exception as error:
        # The code that the library generates for a type reads on, and fails in as many ways as bytes can be wrong.
        raise ValueError(f'{len(data)} bytes that are no {msgtype}: {_reason(error)}') from error


def as_ros2(types: Any, data: bytes, msgtype: str) -> bytes:
    """A message of ROS 1 as ROS 2 serialises it.

    Raises:
        ValueError: The bytes are none; the message says so whatever their number, so that such messages can be counted.
    """
    try:
        return bytes(types.ros1_to_cdr(data, msgtype))
    except Exception as error:
        raise ValueError(f'no {msgtype}: {_reason(error)}') from error


def plan(
    path: Path, *, topics: list[str], start: float | None = None, end: float | None = None, every: int = 1,
) -> list[Slice]:
    """Divide the images of a recording into slices of equal time, of SLICE frames on average; the same ones each time.

    Args:
        path: The recording.
        topics: Topics to be processed; empty for all that have images, but for overlays of an earlier run.
        start, end: Seconds from the beginning of the recording, up to infinity.
        every: One of so many frames of a topic is to be processed.

    Returns:
        Slices in the order of time; none where there are no images.

    Raises:
        RecordingError: The recording cannot be read, or lacks a topic.
    """
    with opened(path) as reader:
        known = image_topics(reader)
        for topic in topics:
            if topic not in known:
                raise RecordingError(f'{path}: no images on {topic!r}, but on {", ".join(sorted(known)) or "no topic"}')
        chosen = tuple(dict.fromkeys(topics or sorted(known.keys() - _overlays(reader))))
        connections = [connection for connection in reader.connections if connection.topic in chosen]
        count = min(sum(connection.msgcount for connection in connections), 1 + _size(path) // LEAST_FRAME)
        if not connections or not count:
            return []
        duration = reader.end_time - reader.start_time
        begin, stop = (reader.start_time + round(min(seconds * 1e9, duration))
                       for seconds in (start or 0, math.inf if end is None else end))
        if begin >= stop:
            return []
        share = (stop - begin) / duration
        number = max(1, math.ceil(count * share / SLICE))
        edges = [begin + (stop - begin) * k // number for k in range(number + 1)]
        slices = [Slice(path, chosen, first, last, every) for first, last in pairwise(edges) if first < last]
        return _counted(reader, slices) if every > 1 else slices


def _size(path: Path) -> int:
    """Bytes of the files of a recording."""
    return sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]))


def _counted(reader: Reader, slices: list[Slice]) -> list[Slice]:
    """Slices that know how many frames came before them; that is read from the recording."""
    topics = slices[0].topics
    seen = dict.fromkeys(topics, 0)
    counted = []
    connections = [connection for connection in reader.connections if connection.topic in topics]
    for part in slices:
        counted.append(Slice(part.path, topics, part.start, part.stop, part.every, tuple(seen.values())))
        for connection, _, _ in reader.messages(connections, part.start, part.stop):
            seen[connection.topic] += 1
    return counted

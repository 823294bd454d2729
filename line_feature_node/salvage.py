"""Recordings that were cut off or damaged: what can still be read of one becomes a clean recording for the while."""

import contextlib
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys.msg import normalize_msgtype

from line_feature_node.recordings import METADATA, SALVAGE, SALVAGED, TOLD, RecordingError, Salvage
from line_feature_node.remains import MCAP, ROS1, SQLITE3, ZSTD, Channel, Message, kind_of, readable, remains
from line_feature_node.yaml_text import parsed


@contextlib.contextmanager
def salvaged(source: Path, place: Path) -> Iterator[Salvage]:
    """A clean recording of what can still be read of one, as long as the block lasts.

    Args:
        source: The recording; it is not changed.
        place: Folder that it is made in, for the while; a mark in it stays if others put something there.

    Raises:
        RecordingError: Nothing can be read, or the clean recording cannot be written.
    """
    try:
        with contextlib.ExitStack() as stack:
            try:
                place.mkdir(parents=True, exist_ok=True)
                folder = stack.enter_context(
                    tempfile.TemporaryDirectory(prefix=SALVAGE, dir=place, ignore_cleanup_errors=True))
                found = _save(source, Path(folder))
                (place / SALVAGED).touch()
            except OSError as error:
                raise RecordingError(f'{source}: what is left of it cannot be written to {place}: '
                                     f'{error.strerror or error}') from error
            yield found
    finally:
        with contextlib.suppress(OSError):
            if {path.name for path in place.iterdir()} <= {SALVAGED}:
                (place / SALVAGED).unlink(missing_ok=True)
                place.rmdir()


def was_salvaged(place: Path) -> bool:
    """Whether a run that was ended went over a salvaged recording."""
    return (place / SALVAGED).exists()


def may_help(source: Path) -> bool:
    """Whether anything can be salvaged."""
    return any(readable(part) for part in _parts(source, []))


def _save(source: Path, folder: Path) -> Salvage:
    damage: list[str] = []
    scratch = folder / 'scratch'
    scratch.mkdir()
    messages = _messages(source, scratch, damage)
    ros1 = any(kind_of(part) == ROS1 for part in _parts(source, []))
    name = re.sub(r'\.(bag|mcap|db3)$', '', source.name)
    path = folder / f'{name}{".bag" if ros1 else ".mcap"}'
    count, begin, until = (_write_ros1 if ros1 else _write_mcap)(path, messages)
    scratch.rmdir()
    newest = max(part.stat().st_mtime_ns for part in [source, *_parts(source, [])])
    os.utime(path, ns=(newest, newest))  # a later run goes by it
    if not count:
        raise RecordingError(f'{source}: nothing can be salvaged ({"; ".join(damage[:TOLD]) or "it has no messages"})')
    return Salvage(path, count, begin, until, tuple(damage))


def _messages(source: Path, folder: Path, damage: list[str]) -> Iterator[Message]:
    """What is left of all parts, one after the other."""
    for part in _parts(source, damage):
        yield from remains(part, folder, damage)


def _parts(source: Path, damage: list[str]) -> list[Path]:
    """The files of a recording, in the order of its metadata where that can be read, else of the numbers in names."""
    if source.is_file():
        return [source]
    listed: list[str] = []
    try:
        information = parsed((source / METADATA).read_text(encoding='utf-8'))['rosbag2_bagfile_information']
        listed = [Path(name).name for name in information['relative_file_paths']]
    except (OSError, ValueError, KeyError, TypeError):
        damage.append(f'{METADATA} cannot be read')
    present = {path.name for path in source.iterdir()
               if path.is_file() and kind_of(path) in (MCAP, SQLITE3, ZSTD)}
    damage += [f'{name} is missing, or no recording' for name in listed if name not in present]
    others = sorted(present - set(listed), key=lambda name: [int(part) if part.isdigit() else 0
                                                             for part in re.split(r'(\d+)', name)])
    return [source / name for name in [*(name for name in listed if name in present), *others]]


def _write_mcap(path: Path, messages: Iterator[Message]) -> tuple[int, int, int]:
    """Write messages of ROS 2; how many, and the stamps that they begin and end with, are returned."""
    numbers: dict[Channel, int] = {}
    schemas: dict[tuple[str, str, str], int] = {}
    span = _Span()
    with path.open('wb') as file:
        writer = McapWriter(file)
        writer.start(profile='ros2', library='line_feature_node')
        for channel, stamp, data in messages:
            if channel not in numbers:
                schema = channel.msgtype, channel.format, channel.definition
                if schema not in schemas:
                    schemas[schema] = writer.register_schema(*schema[:2], schema[2].encode())
                numbers[channel] = writer.register_channel(
                    channel.topic, 'cdr', schemas[schema], dict(channel.properties))
            writer.add_message(numbers[channel], stamp, data, stamp)
            span.add(stamp)
        writer.finish()
    return span.count, span.begin, span.until


def _write_ros1(path: Path, messages: Iterator[Message]) -> tuple[int, int, int]:
    """Write messages of ROS 1; how many, and the stamps that they begin and end with, are returned."""
    span = _Span()
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat.LZ4)
    with writer:
        connections = {}
        for channel, stamp, data in messages:
            if channel not in connections:
                more = dict(channel.properties)
                latching = more.get('latching', '')
                connections[channel] = writer.add_connection(
                    channel.topic, normalize_msgtype(channel.msgtype), msgdef=channel.definition,
                    md5sum=more.get('md5sum') or '*', callerid=more.get('callerid'),
                    latching=int(latching) if latching.isdecimal() else None)
            writer.write(connections[channel], stamp, data)
            span.add(stamp)
    return span.count, span.begin, span.until


class _Span:
    """How many messages there were, and from when to when."""

    def __init__(self) -> None:
        self.count, self.begin, self.until = 0, 2**63, 0

    def add(self, stamp: int) -> None:
        self.count += 1
        self.begin, self.until = min(self.begin, stamp), max(self.until, stamp)

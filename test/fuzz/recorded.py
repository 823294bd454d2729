"""Damaged recordings in all formats, and what must come of them."""

import dataclasses
import shutil
import sqlite3
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import zstandard
from mutations import edge, mutated
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from line_feature_node import cli_bag
from line_feature_node.bag import VERSION, Run, partial_folder
from line_feature_node.core import Parameters
from line_feature_node.recordings import METADATA, find_recordings, opened, typestore
from line_feature_node.remains import ZSTD, kind_of, readable, remains
from line_feature_node.slices import Job
from line_feature_node.workers import inline

IMAGE, COMPRESSED, TEXT = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage', 'std_msgs/msg/String'
BEGIN, STEP = 1_700_000_000_123_456_789, 10_000_000
FRAMES = 3
JOB = Job(Parameters.profile('default'), outputs=('segments',))


def _messages(*, ros1: bool) -> Iterator[tuple[str, str, int, bytes]]:
    """Topic, type, stamp and bytes of a few small images, with a text between them."""
    store = typestore(ros1=ros1)
    types: Any = store.types
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    for number in range(FRAMES):
        pixels = np.full((12, 16), 30, np.uint8)
        pixels[:, 5 + number:] = 200
        stamp = types['builtin_interfaces/msg/Time'](sec=5, nanosec=number)
        header = types['std_msgs/msg/Header'](**({'seq': number} if ros1 else {}), stamp=stamp, frame_id='camera')
        picture = types[IMAGE](header=header, height=12, width=16, encoding='mono8', is_bigendian=0, step=16,
                               data=pixels.reshape(-1))
        yield '/camera', IMAGE, BEGIN + STEP * number, bytes(serialize(picture, IMAGE))
        yield '/text', TEXT, BEGIN + STEP * number + 1, bytes(serialize(types[TEXT](data='words'), TEXT))


def _ros2(path: Path, storage: str, mode: CompressionMode) -> None:
    writer = Writer(path, version=VERSION, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topics = {topic: writer.add_connection(topic, kind, typestore=typestore(ros1=False))
                  for topic, kind in (('/camera', IMAGE), ('/text', TEXT))}
        for topic, _, stamp, data in _messages(ros1=False):
            writer.write(topics[topic], stamp, data)


def _ros1(path: Path, compression: str) -> None:
    writer = Writer1(path)
    writer.chunk_threshold = 300
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression])
    with writer:
        topics = {topic: writer.add_connection(topic, kind, typestore=typestore(ros1=True))
                  for topic, kind in (('/camera', IMAGE), ('/text', TEXT))}
        for topic, _, stamp, data in _messages(ros1=True):
            writer.write(topics[topic], stamp, data)


@cache
def seeds() -> dict[str, dict[str, bytes]]:
    """Good recordings: the names and contents of their files; a single file is a recording by itself."""
    found: dict[str, dict[str, bytes]] = {}
    with TemporaryDirectory() as name:
        folder = Path(name)
        for compression in ('', 'LZ4', 'BZ2'):
            path = folder / f'ros1{compression}.bag'
            _ros1(path, compression)
            found[path.stem] = {path.name: path.read_bytes()}
        for storage in ('mcap', 'sqlite3'):
            for mode in CompressionMode:
                if storage == 'sqlite3' and mode == CompressionMode.STORAGE:
                    continue  # it has none
                path = folder / f'{storage}-{mode.name.lower()}'
                _ros2(path, storage, mode)
                found[path.name] = {file.name: file.read_bytes() for file in sorted(path.iterdir())}
                if mode == CompressionMode.NONE:
                    [file] = [file for file in path.iterdir() if file.name != METADATA]
                    found[f'{path.name}-alone'] = {file.name: file.read_bytes()}
    return found


def recording(draw: Random) -> dict[str, Any]:
    """The files of a recording, one of them or two damaged, and how they are read."""
    name = draw.choice([*seeds()])
    files = dict(seeds()[name])
    for _ in range(draw.choice((1, 1, 1, 2))):
        damaged = draw.choice([*files])
        files[damaged] = _damaged(files[damaged], draw)
    return {'files': files, 'alone': len(files) == 1, 'copy': draw.random() < 0.2, 'every': draw.choice((1, 1, 2)),
            'start': draw.choice((None, None, 0.01)), 'storage': draw.choice(('mcap', 'mcap', 'sqlite3'))}


def _damaged(data: bytes, draw: Random) -> bytes:
    if data.startswith(b'SQLite format 3\0') and draw.random() < 0.6:
        return _other_rows(data, draw)
    if data.startswith(b'rosbag2_bagfile') and draw.random() < 0.5:
        return _other_line(data, draw)
    return mutated(data, draw)


VALUES = ("'x'", "''", 'NULL', '-1', '0', '1', '1.5', '9223372036854775807', '-9223372036854775808', "x'00ff'",
          '4.0e300', "'sensor_msgs/msg/Image'", "'std_msgs/msg/Nothing'", "'/camera'", "'cdr'", 'zeroblob(9)')
COLUMNS = {'topics': ('id', 'name', 'type', 'serialization_format', 'offered_qos_profiles'),
           'messages': ('id', 'topic_id', 'timestamp', 'data'), 'schema': ('schema_version', 'ros_distro')}


def _other_rows(data: bytes, draw: Random) -> bytes:
    """A database whose tables lack a column, or have what nobody expects in it."""
    with TemporaryDirectory() as name:
        path = Path(name) / 'a.db3'
        path.write_bytes(data)
        database = sqlite3.connect(path)
        try:
            database.execute('PRAGMA synchronous = OFF')
            table = draw.choice([*COLUMNS])
            column, value = draw.choice(COLUMNS[table]), draw.choice(VALUES)
            where = draw.choice(('', 'WHERE rowid = 1', 'WHERE rowid = 2'))
            with database:
                database.execute(draw.choice((
                    f'UPDATE {table} SET {column} = {value} {where}', f'UPDATE {table} SET {column} = {value} {where}',
                    f'ALTER TABLE {table} RENAME COLUMN {column} TO other', f'ALTER TABLE {table} RENAME TO other',
                    f'DELETE FROM {table} {where}', f'DROP TABLE {table}')))
        except sqlite3.Error:
            pass  # a type that the column cannot have, or a table that this version lacks
        finally:
            database.close()
        return path.read_bytes()


def _other_line(data: bytes, draw: Random) -> bytes:
    """Metadata in which a value is another, or a line is missing."""
    lines = data.decode(errors='replace').split('\n')
    place = draw.randrange(len(lines))
    head, colon, _ = lines[place].partition(':')
    values = ('', '5', '-1', str(edge(draw)), '9' * 30, '.inf', 'null', '[]', '{}', 'x', "''", '../../x', '[[1]]', '*a',
              '!!int ""', '1:' * 200 + '1.5')
    lines[place] = draw.choice((head + colon + ' ' + draw.choice(values), '', lines[draw.randrange(len(lines))]))
    return '\n'.join(lines).encode()


def _written(fields: dict[str, Any], folder: Path) -> Path:
    place = folder / 'in'
    place.mkdir()
    for name, data in fields['files'].items():
        (place / name).write_bytes(data)
    return place / next(iter(fields['files'])) if fields['alone'] else place


def check_recording(fields: dict[str, Any], folder: Path) -> int:
    """What the offline run makes of a recording, salvaging where it must: a whole bag or a sentence."""
    source, target = _written(fields, folder), folder / 'out'
    try:
        [found] = find_recordings([source])
        run = Run(JOB, start=fields['start'], every=fields['every'], storage=fields['storage'], copy=fields['copy'])
        outcome = cli_bag._process(found, target, run, inline(), quiet=True, salvage=True)
        assert target.exists() != bool(outcome.error), outcome.error
        assert outcome.error or not partial_folder(target).exists()
        if outcome.error:
            assert '\n' not in outcome.error
            return -1
        with opened(target) as reader:
            assert reader.message_count >= len(outcome.frames.good)
        return len(outcome.frames)
    finally:
        for path in (folder / 'in', target, partial_folder(target)):
            shutil.rmtree(path, ignore_errors=True)


def damaged_file(draw: Random) -> dict[str, Any]:
    """One file of a recording, damaged, or compressed and damaged then."""
    files = [data for files in seeds().values() for name, data in files.items() if name != METADATA]
    data = draw.choice(files)
    if draw.random() < 0.05:
        return {'data': mutated(zstandard.compress(_damaged(data, draw)), draw)}
    return {'data': _damaged(data, draw)}


def check_remains(fields: dict[str, Any], folder: Path) -> int:
    """What is left of a file: messages that are what they say, and words on what is not; never an error."""
    path = folder / 'file.rec'
    path.write_bytes(fields['data'])
    messages, size, damage = 0, 0, []
    for message in remains(path, folder, damage):
        assert isinstance(message.data, bytes)
        assert isinstance(message.stamp, int)
        assert all(isinstance(value, str) for value in dataclasses.astuple(message.channel)[:4])
        messages, size = messages + 1, size + len(message.data)
    assert all('\n' not in words for words in damage)
    if readable(path) and kind_of(path) != ZSTD and not messages and not damage:
        raise AssertionError('nothing is left of what is readable')
    assert [entry.name for entry in folder.iterdir()] == ['file.rec']
    return size

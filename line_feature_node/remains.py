"""What can still be read of a file of a recording that was cut off or damaged, from its beginning on.

No index is needed for it: the records of ROS 1 and mcap follow each other, and the rows of sqlite3 have numbers. A
chunk that is damaged is left out where the next one can be found; of one that is cut off the messages before the cut
are had.
"""

import bz2
import contextlib
import errno
import io
import os
import shutil
import sqlite3
import struct
import zlib
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple, Protocol
from urllib.parse import quote

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, Schema

#: What files begin with.
ROS1, MCAP, SQLITE3, ZSTD = b'#ROSBAG V2.0\n', b'\x89MCAP0\r\n', b'SQLite format 3\0', b'\x28\xb5\x2f\xfd'
#: No record is as large, nor a chunk once decompressed, so that what is damaged or malicious does not fill the memory.
LARGEST = 2**30
#: Bytes that are decompressed at a time.
PIECE = 2**16
#: Errors of writing a temporary file, not of reading.
FULL = (errno.EDQUOT, errno.EFBIG, errno.ENOSPC)
#: How a database is opened that is not to be changed, and is not.
READ_ONLY = 'mode=ro&immutable=1'
#: What libraries make of bytes that are none of theirs, lengths without measure among them.
NONSENSE = (McapError, MemoryError, OverflowError, ValueError, struct.error)
#: Rows that cannot be read are skipped in steps that double, up to this.
LARGEST_STEP = 2**24
#: The largest number of a row.
LARGEST_ROW = 2**63 - 1


@dataclass(frozen=True)
class Channel:
    """Where messages belong.

    Attributes:
        topic: Their topic.
        msgtype: Their type, as the file writes it.
        definition: Of the type; '' where the file has none.
        format: Of the definition: 'ros2msg', 'ros2idl'; '' for ROS 1 and for none.
        properties: What else the file says of it, QoS and the like.
    """

    topic: str
    msgtype: str
    definition: str = ''
    format: str = ''
    properties: tuple[tuple[str, str], ...] = ()


class Message(NamedTuple):
    """A message as it was recorded: stamp in nanoseconds, and its bytes."""

    channel: Channel
    stamp: int
    data: bytes


class _Decompressor(Protocol):
    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


def kind_of(path: Path) -> bytes:
    """What a file is by its beginning: ROS1, MCAP, SQLITE3 or ZSTD; nothing where it is none of them."""
    try:
        with path.open('rb') as file:
            head = file.read(16)
    except OSError:
        return b''
    return next((kind for kind in (ROS1, MCAP, SQLITE3, ZSTD) if head.startswith(kind)), b'')


def remains(path: Path, folder: Path, damage: list[str]) -> Iterator[Message]:
    """The messages of a file that can still be read, in its order.

    Args:
        path: The file; it is not changed.
        folder: For temporary files.
        damage: What is found to be wrong is put in here, a few words each.

    Raises:
        OSError: There is no room for temporary files.
    """
    readers = {ROS1: _ros1, MCAP: _mcap, SQLITE3: _sqlite3, ZSTD: _compressed}
    reader = readers.get(kind_of(path))
    if reader is None:
        damage.append(f'{path.name} is not a recording, or its beginning is lost')
        return
    try:
        yield from reader(path, folder, damage)
    except OSError as error:
        if error.errno in FULL:
            raise
        # A disk that fails, say.
        damage.append(f'{path.name}: {error.strerror or error}')


def readable(path: Path) -> bool:
    """Whether there is a message in a file that can be read; of one that was compressed as a whole it is believed."""
    kind = kind_of(path)
    if kind == SQLITE3:  # without the copy that may be needed to read all of it
        return next(_rows(path, READ_ONLY, []), None) is not None
    return kind == ZSTD or next(remains(path, path.parent, []), None) is not None


# mcap

RECORD, MESSAGE = struct.Struct('<BQ'), struct.Struct('<HIQQ')
#: Records that are read; the others, attachments among them, are skipped.
USED = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END}


def _mcap(path: Path, _: Path, damage: list[str]) -> Iterator[Message]:
    with path.open('rb') as file:
        channels = _Channels()
        channels.take_summary(file)
        file.seek(len(MCAP))
        size = os.fstat(file.fileno()).st_size
        for op, content, whole in _mcap_records(file, size):
            if op == Opcode.CHUNK:
                yield from _of_chunk(content, path.name, channels, damage, whole=whole)
            elif op == Opcode.DATA_END:
                return
            elif whole:
                yield from channels.take(op, content, path.name, damage)
        damage.append(f'{path.name} ends amid its messages, after {min(file.tell(), size)} bytes')


def _mcap_records(file: IO[bytes], size: int) -> Iterator[tuple[int, bytes, bool]]:
    """Opcode and content of each record, and whether it is whole; only the last one may not be."""
    while len(head := file.read(RECORD.size)) == RECORD.size:
        op, length = RECORD.unpack(head)
        if length > LARGEST:
            return
        if op in USED:
            content = file.read(length)
            yield op, content, len(content) == length
        else:
            file.seek(length, os.SEEK_CUR)
        if file.tell() >= size:
            return


class _Channels:
    """The channels that were seen, by their number."""

    def __init__(self) -> None:
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, Channel] = {}

    def take_summary(self, file: IO[bytes]) -> None:
        """Learn them from the end of the file, where that is there: the chunk that has them may be damaged."""
        try:
            summary = make_reader(file).get_summary()
        except (*NONSENSE, OSError):
            return
        for schema in summary.schemas.values() if summary else ():
            self._schemas[schema.id] = schema.name, schema.encoding, schema.data.decode(errors='replace')
        for channel in summary.channels.values() if summary else ():
            self._add(channel.id, channel.schema_id, channel.topic, channel.message_encoding, channel.metadata)

    def take(self, op: int, content: bytes, name: str, damage: list[str]) -> Iterator[Message]:
        """The message in a record, if there is one; channels are kept."""
        stream = ReadDataStream(io.BytesIO(content))
        try:
            if op == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema.name, schema.encoding, schema.data.decode()
            elif op == Opcode.CHANNEL:
                channel = ChannelRecord.read(stream)
                self._add(channel.id, channel.schema_id, channel.topic, channel.message_encoding, channel.metadata)
            elif op == Opcode.MESSAGE:
                number, _, stamp, _ = MESSAGE.unpack_from(content)
                if number in self._channels:
                    yield Message(self._channels[number], stamp, _inflated(content[MESSAGE.size:]))
        except NONSENSE:
            damage.append(f'{name} has a record that makes no sense')

    def _add(self, number: int, schema: int, topic: str, encoding: str, properties: dict[str, str]) -> None:
        """What is not serialised as ROS 2 does, or has no type, is left out."""
        if encoding == 'cdr' and schema in self._schemas:
            msgtype, kind, definition = self._schemas[schema]
            self._channels[number] = Channel(topic, msgtype, definition, kind, tuple(properties.items()))


def _of_chunk(
    content: bytes, name: str, channels: _Channels, damage: list[str], *, whole: bool,
) -> Iterator[Message]:
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(content)))
    except NONSENSE:  # cut off before its messages
        return
    data = _decompressed(chunk.compression, chunk.data)
    wrong = len(data) != chunk.uncompressed_size or (
        chunk.uncompressed_crc != 0 and zlib.crc32(data) != chunk.uncompressed_crc)
    if whole and wrong:
        damage.append(f'{name} has a damaged chunk')
        return
    for op, inner, complete in _mcap_records(io.BytesIO(data), len(data)):
        if complete:
            yield from channels.take(op, inner, name, damage)


def _decompressed(compression: str, data: bytes) -> bytes:
    """What can be had of a chunk: all of it, or what precedes a cut or the damage, or is more than there can be."""
    if compression in ('', 'none'):
        return data
    found = io.BytesIO()
    with contextlib.suppress(EOFError, OSError, RuntimeError, ValueError, zstandard.ZstdError):
        for piece in _pieces(compression, data):
            found.write(piece)
            if found.tell() > LARGEST:  # a few bytes may stand for any number of them
                break
    return found.getvalue()


def _pieces(compression: str, data: bytes) -> Iterator[bytes]:
    makers = {'bz2': bz2.BZ2Decompressor, 'lz4': lz4.frame.LZ4FrameDecompressor}
    if compression == 'zstd':
        reader = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data))
        while piece := reader.read(PIECE):
            yield piece
    elif compression in makers:
        decompressor: _Decompressor = makers[compression]()
        for place in range(0, len(data), PIECE):
            yield decompressor.decompress(data[place:place + PIECE], LARGEST)


def _inflated(data: bytes) -> bytes:
    """A message that may have been compressed by itself: serialised ones begin with a zero."""
    return _decompressed('zstd', data) if data.startswith(ZSTD) else data


# ROS 1

LENGTH, TIME, NUMBER = struct.Struct('<I'), struct.Struct('<II'), struct.Struct('<I')
MESSAGE_DATA, CHUNK, CHUNK_INFO, CONNECTION = b'\x02', b'\x05', b'\x06', b'\x07'


def _ros1(path: Path, _: Path, damage: list[str]) -> Iterator[Message]:
    with path.open('rb') as file:
        size = os.fstat(file.fileno()).st_size
        channels: dict[bytes, Channel] = {}
        _take_index(file, size, channels)
        file.seek(len(ROS1))
        for fields, data, whole in _ros1_records(file, size):
            op = fields.get(b'op')
            if op == CHUNK_INFO:  # all of the chunks were before
                return
            if op != CHUNK:
                yield from _taken(fields, data, channels) if whole else ()
                continue
            inner = _decompressed(fields.get(b'compression', b'').decode(errors='replace'), data)
            if whole and fields.get(b'size') != LENGTH.pack(len(inner)):
                damage.append(f'{path.name} has a damaged chunk')
                continue
            for fields, data, complete in _ros1_records(io.BytesIO(inner), len(inner)):
                yield from _taken(fields, data, channels) if complete else ()
        damage.append(f'{path.name} ends amid its messages, or before its index, after {file.tell()} bytes')


def _take_index(file: IO[bytes], size: int, channels: dict[bytes, Channel]) -> None:
    """Learn the connections from the index, where that is there: the chunk that has them may be damaged."""
    file.seek(len(ROS1))
    header = next(_ros1_records(file, size), ({}, b'', False))[0]
    place = int.from_bytes(header.get(b'index_pos', b''), 'little')
    if 0 < place < size:
        file.seek(place)
        for fields, data, whole in _ros1_records(file, size):
            if not whole or fields.get(b'op') != CONNECTION:
                return
            next(_taken(fields, data, channels), None)


def _ros1_records(file: IO[bytes], size: int) -> Iterator[tuple[dict[bytes, bytes], bytes, bool]]:
    """Header and data of each record, and whether it is whole; only the last one may not be."""
    while (header := _sized(file)) is not None:
        head = file.read(LENGTH.size)
        if len(head) < LENGTH.size or LENGTH.unpack(head)[0] > LARGEST:
            return
        length = LENGTH.unpack(head)[0]
        data = file.read(length)
        yield _fields(header), data, len(data) == length
        if file.tell() >= size:
            return


def _sized(file: IO[bytes]) -> bytes | None:
    """Bytes after their number; None where they are not all there, or more than there can be."""
    head = file.read(LENGTH.size)
    length = LENGTH.unpack(head)[0] if len(head) == LENGTH.size else LARGEST + 1
    content = file.read(length) if length <= LARGEST else b''
    return content if len(content) == length else None


def _fields(header: bytes) -> dict[bytes, bytes]:
    """The fields name=value of a header; what makes no sense is left out."""
    fields = {}
    stream = io.BytesIO(header)
    while field := _sized(stream):
        name, _, value = field.partition(b'=')
        fields[name] = value
    return fields


def _taken(fields: dict[bytes, bytes], data: bytes, channels: dict[bytes, Channel]) -> Iterator[Message]:
    """The message in a record, if there is one; connections are kept."""
    number, op = fields.get(b'conn', b''), fields.get(b'op')
    if op == CONNECTION:
        more = {name.decode(errors='replace'): value.decode(errors='replace') for name, value in _fields(data).items()}
        channels[number] = Channel(
            fields.get(b'topic', b'').decode(errors='replace'), more.pop('type', ''),
            more.pop('message_definition', ''), '', tuple(sorted(more.items())))
    elif op == MESSAGE_DATA and number in channels and len(fields.get(b'time', b'')) == TIME.size:
        seconds, nanoseconds = TIME.unpack(fields[b'time'])
        yield Message(channels[number], seconds * 10**9 + nanoseconds, data)


# sqlite3

def _sqlite3(path: Path, folder: Path, damage: list[str]) -> Iterator[Message]:
    """The rows; of a copy where the last page is there in part, or what was written last is beside the file."""
    log = path.with_name(f'{path.name}-wal')
    with path.open('rb') as file:
        page = int.from_bytes(file.read(18)[16:], 'big') or 1
    page = 2**16 if page == 1 else page
    size = path.stat().st_size
    copied = bool(size % page) or (log.exists() and log.stat().st_size > 0)
    if not copied:
        yield from _rows(path, READ_ONLY, damage)
        return
    copy = folder / 'pages.db3'
    try:
        shutil.copyfile(path, copy)
        os.truncate(copy, size - size % page)
        if log.exists():
            shutil.copyfile(log, copy.with_name(f'{copy.name}-wal'))
        yield from _rows(copy, 'mode=rw', damage, path.name)
    finally:
        for file_ in folder.glob(f'{copy.name}*'):
            file_.unlink()


def _rows(path: Path, options: str, damage: list[str], name: str = '') -> Iterator[Message]:
    name = name or path.name
    database = sqlite3.connect(f'file:{quote(str(path))}?{options}', uri=True)
    # A letter that is wrong in a definition is not worth the messages.
    database.text_factory = lambda text: text.decode(errors='replace')
    try:
        # Or a file that is shorter than it says is not read at all.
        database.execute('PRAGMA writable_schema = ON')
        channels = _topics(database, name, damage)
        had, starts = _Numbers(), [-1]
        while starts:
            start, step, errors = starts.pop(), 0, ['']
            fresh: list[int] = []
            while errors and not fresh and step < LARGEST_STEP and start + step <= LARGEST_ROW:
                errors, found, again = [], _Numbers(), 0
                for number, topic, stamp, data in _rows_behind(database, start + step, errors):
                    if not isinstance(number, int):
                        continue
                    # Where numbers are damaged, too, rows come that were had before, and would for ever.
                    known = number in had
                    again += known or not found.add(number)
                    if again > had.count + found.count:
                        errors.append('rows come again and again')
                        break
                    if known:
                        continue
                    fresh = [*fresh[-1:], number]
                    if not isinstance(stamp, int) or stamp < 0:
                        damage.append(f'{name} has a stamp that makes no sense in row {number}')
                    elif topic in channels and isinstance(data, bytes):
                        yield Message(channels[topic], stamp, _inflated(data))
                had.update(found)
                if errors and (fresh or step == 0 > start):
                    damage.append(f'{name}: {errors[0]} after row {[start, *fresh][-1]}')
                step = 2 * step or 1
            if errors and fresh:
                # A number that does not follow the one before may be a damaged one.
                starts += fresh[-1:] if fresh[-1] == fresh[0] + 1 else fresh
    except sqlite3.Error as error:
        damage.append(f'{name}: {" ".join(str(error).split())}')
    finally:
        database.close()


class _Numbers:
    """Whole numbers, kept as ranges, as most follow each other.

    Attributes:
        count: How many there are.
        starts, ends: The first of each range, and what is behind its last.
    """

    def __init__(self) -> None:
        self.count = 0
        self.starts: list[int] = []
        self.ends: list[int] = []

    def __contains__(self, number: int) -> bool:
        k = bisect_right(self.starts, number)
        return k > 0 and number < self.ends[k - 1]

    def add(self, number: int) -> bool:
        """Whether it was not there before."""
        return self._add(number, number + 1)

    def update(self, others: '_Numbers') -> None:
        """Add others, none of which is there."""
        for start, end in zip(others.starts, others.ends, strict=True):
            self._add(start, end)

    def _add(self, start: int, end: int) -> bool:
        k = bisect_right(self.starts, start)
        if k and start < self.ends[k - 1]:
            return False
        if k and start == self.ends[k - 1]:
            self.ends[k - 1] = end
        else:
            self.starts.insert(k, start)
            self.ends.insert(k, end)
        self.count += end - start
        return True


def _rows_behind(
    database: sqlite3.Connection, number: int, errors: list[str],
) -> Iterator[tuple[object, int, int, object]]:
    """Rows with larger numbers, up to one that cannot be read."""
    try:
        yield from database.execute(
            'SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id', (number,))
    except sqlite3.Error as error:
        errors.append(str(error))


def _topics(database: sqlite3.Connection, name: str, damage: list[str]) -> dict[int, Channel]:
    """Topics by their number, of whatever version of the format: columns that it lacks are left out."""
    definitions: dict[str, tuple[str, str]] = {}
    tables = {table for table, in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if 'message_definitions' in tables:
        for msgtype, kind, text in database.execute(
                'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'):
            if isinstance(text, str) and isinstance(kind, str):
                definitions[msgtype] = text, kind
    rows = database.execute('SELECT * FROM topics')
    columns = [column[0] for column in rows.description]
    channels = {}
    for row in rows:
        values = dict(zip(columns, row, strict=True))
        number, topic, msgtype = (values.get(column) for column in ('id', 'name', 'type'))
        if not (isinstance(number, int) and isinstance(topic, str) and isinstance(msgtype, str)):
            damage.append(f'{name} has a topic that makes no sense')
            continue
        text, kind = definitions.get(msgtype, ('', ''))
        properties = [('offered_qos_profiles', values.get('offered_qos_profiles')),
                      ('topic_type_hash', values.get('type_description_hash'))]
        channels[number] = Channel(topic, msgtype, text, kind,
                                   tuple((key, value) for key, value in properties if value and isinstance(value, str)))
    return channels


def _compressed(path: Path, folder: Path, damage: list[str]) -> Iterator[Message]:
    """A file that was compressed as a whole."""
    inner = folder / path.stem
    with path.open('rb') as file, inner.open('wb') as target:
        reader = zstandard.ZstdDecompressor().stream_reader(file)
        try:
            while piece := reader.read(PIECE):
                target.write(piece)
        except zstandard.ZstdError as error:
            damage.append(f'{path.name}: {error}')
    try:
        if kind_of(inner) == ZSTD:
            return
        yield from remains(inner, folder, damage)
    finally:
        inner.unlink()

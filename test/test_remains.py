"""Files of recordings that these tests write, and cut off or damage."""

import bz2
import re
import shutil
import sqlite3
import tempfile
from functools import cache
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionMode
from test_recordings import (
    IMAGE,
    ROS1,
    ROS2,
    contents,
    film,
    image,
    lone,
    picture,
    shared,
    stamp_of,
    text,
    write,
    write_ros1,
)

from line_feature_node import remains as module
from line_feature_node.remains import MCAP, kind_of, readable, remains

FRAMES = 120


def entries(types=ROS2):
    """Frames, each with words beside it."""
    return [entry for number, frame in enumerate(film(FRAMES, types=types)) for entry in (
        frame, ('/words', 'std_msgs/msg/String', stamp_of(number) + 5, text(f'word {number}', types)))]


def mcap(tmp_path, **options):
    """As the recorder of ROS 2 and others write it: by the library for mcap."""
    path = tmp_path / 'rec.mcap'
    with path.open('wb') as file:
        writer = McapWriter(file, **options)
        writer.start(profile='ros2')
        channels = {}
        for topic, kind, stamp, message in entries():
            if topic not in channels:
                schema = writer.register_schema(kind, 'ros2msg', ROS2.generate_msgdef(kind, ros_version=2)[0].encode())
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channels[topic], stamp, bytes(ROS2.serialize_cdr(message, kind)), stamp)
        writer.finish()
    return path


MAKERS = {
    'mcap': lambda tmp_path: lone(write(tmp_path / 'rec', entries()), tmp_path / 'rec.mcap'),
    'mcap of zstd': lambda tmp_path: lone(write(tmp_path / 'rec', entries(), mode=CompressionMode.STORAGE),
                                          tmp_path / 'rec.mcap'),
    'mcap of small chunks': lambda tmp_path: mcap(tmp_path, chunk_size=10_000, compression=CompressionType.NONE),
    'mcap of small chunks of zstd': lambda tmp_path: mcap(tmp_path, chunk_size=10_000),
    'mcap of lz4': lambda tmp_path: mcap(tmp_path, chunk_size=10_000, compression=CompressionType.LZ4),
    'mcap without chunks': lambda tmp_path: mcap(tmp_path, use_chunking=False),
    'sqlite3': lambda tmp_path: lone(write(tmp_path / 'rec', entries(), 'sqlite3'), tmp_path / 'rec.db3'),
    'ROS 1': lambda tmp_path: write_ros1(tmp_path / 'rec.bag', entries(ROS1)),
    'ROS 1 of bz2': lambda tmp_path: write_ros1(tmp_path / 'rec.bag', entries(ROS1), 'bz2'),
    'ROS 1 of lz4': lambda tmp_path: write_ros1(tmp_path / 'rec.bag', entries(ROS1), 'lz4'),
}
#: In them the bytes of messages lie one after the other.
PLAIN = ('mcap', 'mcap of small chunks', 'mcap without chunks', 'ROS 1')


@cache
def made(kind):
    """Name and bytes of a recording."""
    with tempfile.TemporaryDirectory() as folder:
        path = MAKERS[kind](Path(folder))
        return path.name, path.read_bytes()


def make(tmp_path, kind):
    name, content = made(kind)
    (tmp_path / name).write_bytes(content)
    return tmp_path / name


@pytest.fixture(params=MAKERS)
def recording(request, tmp_path):
    return make(tmp_path, request.param)


@pytest.fixture(params=PLAIN)
def plain(request, tmp_path):
    return make(tmp_path, request.param)


def left(path):
    """Topic, stamp and bytes of what remains, and what is wrong."""
    damage = []
    found = [(channel.topic, stamp, bytes(data)) for channel, stamp, data in remains(path, path.parent, damage)]
    return found, damage


def cut(path, size):
    """The same file with fewer bytes; negative sizes are of what is cut off."""
    data = path.read_bytes()[:size]
    beside = path.with_name(f'cut{path.suffix}')
    beside.write_bytes(data)
    return beside


def test_of_a_whole_file_everything_remains(recording):
    found, damage = left(recording)
    assert found == contents(recording)
    assert len(found) == 2 * FRAMES
    assert damage == []


@pytest.mark.parametrize('share', [0.03, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95])
def test_what_precedes_a_cut_remains(recording, share):
    whole, _ = left(recording)
    path = cut(recording, int(recording.stat().st_size * share))
    found, damage = left(path)
    assert found == whole[:len(found)]
    # A block of zstd, 128 KB, is a third of the largest chunk.
    assert len(found) >= 2 * FRAMES * (share - 0.4)
    [reason] = damage
    assert reason.startswith(path.name)
    assert '\n' not in reason


@pytest.mark.parametrize('missing', [1, 8, 9, 40])
def test_without_the_last_bytes_all_but_the_last_messages_remain(recording, missing):
    whole, _ = left(recording)
    found, _ = left(cut(recording, -missing))
    assert found == whole[:len(found)]
    assert len(found) >= 2 * FRAMES - 4  # a page of sqlite3 has some


@pytest.mark.parametrize('size', [0, 1, 5, 13, 20, 40, 100])
def test_of_the_beginning_nothing_remains(recording, size):
    found, damage = left(cut(recording, size))
    assert found == []
    assert len(damage) == 1


def test_every_message_that_is_there_to_its_last_byte_remains(plain):
    data = plain.read_bytes()
    messages, ends, place = contents(plain), [], 0
    for _, _, message in messages:
        place = data.index(message, place) + len(message)
        ends.append(place)
    for k in (0, 1, 2, 17, 38, 239):
        assert left(cut(plain, ends[k]))[0] == messages[:k + 1]
        assert left(cut(plain, ends[k] - 1))[0] == messages[:k]


@pytest.mark.parametrize('name', [
    'mcap of small chunks of zstd', 'mcap of lz4', 'mcap of small chunks', 'ROS 1 of bz2'])  # they have checksums
@pytest.mark.parametrize('share', [0.02, 0.5])
def test_a_damaged_chunk_is_left_out_and_those_behind_it_remain(tmp_path, name, share):
    path = make(tmp_path, name)
    whole, _ = left(path)
    data = bytearray(path.read_bytes())
    # The bag's header has 4 KB; in mcap the first chunk has the channels.
    middle = 4096 + 1000 if share < 0.1 and path.suffix == '.bag' else max(900, int(len(data) * share))
    data[middle:middle + 8] = bytes(byte ^ 0x55 for byte in data[middle:middle + 8])
    path.write_bytes(data)
    found, damage = left(path)
    assert damage == [f'{path.name} has a damaged chunk']
    assert set(found) < set(whole)
    assert len(found) > 0.5 * len(whole)
    assert found[-1] == whole[-1]


@pytest.mark.parametrize(('name', 'compress'), [
    ('zstd', zstandard.compress), ('lz4', lz4.frame.compress), ('bz2', bz2.compress)])
def test_what_is_small_and_would_be_beyond_all_measure_is_not_decompressed_to_its_end(name, compress, monkeypatch):
    monkeypatch.setattr(module, 'LARGEST', 2**20)
    bomb = compress(bytes(2**26))
    assert len(bomb) < 2**19
    assert 2**20 <= len(module._decompressed(name, bomb)) <= 2**21


def test_noise_ends_it(recording):
    size = recording.stat().st_size // 2
    path = cut(recording, size)
    with path.open('ab') as file:
        file.write(b'\xff' * 1000)
    found, damage = left(path)
    # In what has no checksums the noise may be the end of a message.
    assert found[:-1] == contents(recording)[:max(0, len(found) - 1)]
    assert damage


def test_pages_that_are_noise_are_stepped_over(tmp_path):
    path = make(tmp_path, 'sqlite3')
    whole, _ = left(path)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2 // 4096 * 4096
    data[middle:middle + 4096] = b'\xff' * 4096
    path.write_bytes(data)
    found, _ = left(path)
    assert len(found) > 0.7 * len(whole)
    assert found[-1] == whole[-1]


def test_what_was_not_yet_taken_over_from_the_log_of_sqlite3_remains(tmp_path):
    path = make(tmp_path, 'sqlite3')
    whole, _ = left(path)
    live = sqlite3.connect(path)
    live.execute('PRAGMA journal_mode = WAL')
    live.executemany('INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)',
                     [(1, stamp_of(FRAMES + number), b'\0\1\0\0more') for number in range(3)])
    live.commit()
    (tmp_path / 'killed').mkdir()
    for name in ('rec.db3', 'rec.db3-wal'):
        shutil.copy(tmp_path / name, tmp_path / 'killed')
    live.close()
    before = {file.name: file.read_bytes() for file in (tmp_path / 'killed').iterdir()}
    damage = []
    found = list(remains(tmp_path / 'killed' / 'rec.db3', tmp_path, damage))
    assert len(found) == len(whole) + 3
    assert damage == []
    assert {file.name: file.read_bytes() for file in (tmp_path / 'killed').iterdir()} == before
    assert not list(tmp_path.glob('pages*'))


def changed(tmp_path, *statements):
    """A recording of sqlite3 after some SQL."""
    path = make(tmp_path, 'sqlite3')
    database = sqlite3.connect(path)
    with database:
        for statement in statements:
            database.execute(statement)
    database.close()
    return path


@pytest.mark.parametrize('stamp', ["'noon'", '-1', '4.0e300', "x'00'"])
def test_rows_with_stamps_that_make_no_sense_are_left_out(tmp_path, stamp):
    path = changed(tmp_path, f'UPDATE messages SET timestamp = {stamp} WHERE id = 2')
    found, damage = left(path)
    assert len(found) == 2 * FRAMES - 1
    assert damage == ['rec.db3 has a stamp that makes no sense in row 2']


@pytest.mark.parametrize('change', ["name = x'2f61'", 'name = 5.5', "type = x'00'", 'type = zeroblob(9)'])
def test_topics_that_make_no_sense_are_left_out(tmp_path, change):
    path = changed(tmp_path, f'UPDATE topics SET {change} WHERE id = 1')
    found, damage = left(path)
    if change == 'name = 5.5':  # the column makes a text of it
        assert {topic for topic, _, _ in found} == {'5.5', '/words'}
        return
    assert {topic for topic, _, _ in found} == {'/words'}
    assert damage == ['rec.db3 has a topic that makes no sense']


@pytest.mark.parametrize('column', ['id', 'name', 'type'])
def test_topics_without_a_column_are_left_out(tmp_path, column):
    found, damage = left(changed(tmp_path, f'ALTER TABLE topics RENAME COLUMN {column} TO other'))
    assert not found
    assert set(damage) == {'rec.db3 has a topic that makes no sense'}


def test_a_wrong_letter_in_a_definition_costs_no_message(tmp_path):
    path = changed(
        tmp_path, "UPDATE message_definitions SET encoded_message_definition = CAST(x'610aff' AS TEXT)",
        "UPDATE topics SET offered_qos_profiles = x'ff'")
    found, damage = left(path)
    assert (len(found), damage) == (2 * FRAMES, [])


def test_what_sqlite_says_is_one_line(tmp_path):
    _, damage = left(changed(tmp_path, 'ALTER TABLE messages RENAME TO "a\nb"'))
    assert damage
    assert not any('\n' in words for words in damage)


def test_a_chunk_that_claims_more_than_there_can_be_is_stepped_over(tmp_path):
    """Its length is followed by two stamps, a size, a checksum and a name, before the length of what is in it."""
    path = make(tmp_path, 'mcap of small chunks')
    data = bytearray(path.read_bytes())
    place = next(place for op, place in records_of(data) if op == 6)
    place += 28 + 4 + int.from_bytes(data[place + 28:place + 32], 'little')
    data[place:place + 8] = b'\xff' * 8
    path.write_bytes(data)
    assert FRAMES < len(left(path)[0]) < 2 * FRAMES


def test_a_summary_that_claims_more_than_there_can_be_does_not_matter(tmp_path):
    path = make(tmp_path, 'mcap')
    data = bytearray(path.read_bytes())
    start = int.from_bytes(data[-28:-20], 'little')
    data[start + 1:start + 9] = (2**62).to_bytes(8, 'little')
    path.write_bytes(data)
    assert len(left(path)[0]) == 2 * FRAMES


def records_of(data):
    """Opcode of each record of an mcap file, and where its content begins."""
    place = 8
    while place + 9 <= len(data) - 8:
        length = int.from_bytes(data[place + 1:place + 9], 'little')
        yield data[place], place + 9
        place += 9 + length


def test_rows_of_old_recordings_have_no_definitions(tmp_path):
    path = tmp_path / 'old.db3'
    database = sqlite3.connect(path)
    database.executescript("""
        CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
        INSERT INTO topics VALUES (7, '/camera', 'sensor_msgs/msg/Image', 'cdr');""")
    data = bytes(ROS2.serialize_cdr(image(picture()), IMAGE))
    database.execute('INSERT INTO messages VALUES (1, 7, 5, ?)', (data,))
    database.commit()
    database.close()
    [(channel, stamp, found)] = remains(path, tmp_path, [])
    assert (channel.topic, channel.msgtype, channel.definition, channel.properties) == ('/camera', IMAGE, '', ())
    assert (stamp, found) == (5, data)


def table(path, numbers, size):
    """A recording of sqlite3 with rows of numbers, which are their stamps, too; its bytes."""
    database = sqlite3.connect(path)
    database.executescript("""
        PRAGMA page_size = 4096;
        CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
        INSERT INTO topics VALUES (1, '/words', 'std_msgs/msg/String', 'cdr');""")
    database.executemany('INSERT INTO messages VALUES (?, 1, ?, ?)', [(k, k, bytes(size)) for k in numbers])
    database.commit()
    database.close()
    return bytearray(path.read_bytes())


def leaves_of(data):
    """Where the pages of four rows begin, and where the numbers of these are."""
    starts = [start for start in range(0, len(data), 4096) if data[start] == 13 and data[start + 4] == 4]
    return [(start, [start + int.from_bytes(data[start + k:start + k + 2], 'big') + 2 for k in (8, 10, 12, 14)])
            for start in starts]


@pytest.mark.parametrize('bit', range(7))
def test_a_row_with_the_number_of_another_costs_neither(tmp_path, bit):
    path = tmp_path / 'rec.db3'
    data = table(path, range(1, 101), 900)
    _, cells = leaves_of(data)[5]
    data[cells[1]] ^= 1 << bit
    path.write_bytes(data)
    assert [stamp for _, stamp, _ in remains(path, tmp_path, [])] == list(range(1, 101))


def test_rows_of_the_largest_numbers_remain(tmp_path):
    """What is behind them has no number."""
    path = tmp_path / 'rec.db3'
    data = table(path, range(2**63 - 60, 2**63), 900)
    last = max(start for start in range(0, len(data), 4096) if data[start] == 13)
    data[last:] = b'\xff' * (len(data) - last)
    path.write_bytes(data)
    damage = []
    assert len(list(remains(path, tmp_path, damage))) > 40
    assert damage


@pytest.mark.parametrize('place', range(4))
@pytest.mark.parametrize('number', [3, 120])
def test_rows_in_a_wrong_order_remain_once_each(tmp_path, place, number):
    """One of the four rows of a page has the number of another place, and the page behind it is damaged.

    So that is gone on behind, at rows that were had before.
    """
    path, stamps = tmp_path / 'rec.db3', range(1, 101)
    data = table(path, stamps, 900)
    leaves = leaves_of(data)
    _, cells = leaves[len(leaves) // 2]
    first = data[cells[0]]
    assert [data[cell] for cell in cells] == list(range(first, first + 4))
    data[cells[place]] = number
    behind, _ = leaves[len(leaves) // 2 + 1]
    data[behind:behind + 4096] = b'\xff' * 4096
    path.write_bytes(data)
    damage = []
    found = [stamp for _, stamp, _ in remains(path, tmp_path, damage)]
    assert len(set(found)) == len(found)
    assert set(stamps) - set(range(first, first + 16)) <= set(found)
    assert damage


@pytest.mark.parametrize('content', [b'', b'hello', b'version https://git-lfs.github.com/spec/v1', bytes(5000)])
def test_what_is_no_recording_has_no_remains(tmp_path, content):
    (tmp_path / 'rec.bag').write_bytes(content)
    assert kind_of(tmp_path / 'rec.bag') == b''
    assert left(tmp_path / 'rec.bag') == ([], ['rec.bag is not a recording, or its beginning is lost'])
    assert not readable(tmp_path / 'rec.bag')


def test_the_name_does_not_matter(tmp_path):
    """ROS 1 calls what it has not finished .bag.active."""
    path = make(tmp_path, 'mcap')
    path.rename(tmp_path / 'rec.bag.active')
    assert kind_of(tmp_path / 'rec.bag.active') == MCAP
    assert len(left(tmp_path / 'rec.bag.active')[0]) == 2 * FRAMES


def test_readable_is_what_has_a_message(recording):
    assert readable(recording)
    assert readable(cut(recording, int(recording.stat().st_size * 0.9)))
    assert not readable(cut(recording, 60))


@pytest.mark.parametrize(('name', 'count'), [
    ('empty-file.bag', 0), ('empty_mcap_no_messages.mcap', 0), ('git_lfs_pointer.bag', 0), ('git_lfs_pointer.db3', 0),
    ('no-messages.bag', 0), ('test_sample_truncated.mcap', 14), ('test_truncated.bag', 3), ('test_unindexed.bag', 14),
    ('bag-with-empty-message-definition.bag', 14)])
def test_remains_of_bad_recordings_of_the_world(tmp_path, name, count):
    damage = []
    found = list(remains(shared('bad') / name, tmp_path, damage))
    assert len(found) == count
    assert all(re.fullmatch(r'[ -~]+', reason) for reason in damage)

"""Recordings that these tests write themselves, and, where they are beside the project, some of the outside world."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from line_feature_node import recordings
from line_feature_node.recordings import (
    OUTPUTS,
    DamagedError,
    RecordingError,
    deserialize,
    find_recordings,
    image_topics,
    is_ros1,
    kept_open,
    opened,
    plan,
)

#: Recordings of the outside world, where they are there.
BAGS = Path(__file__).resolve().parents[2] / 'shared' / 'data' / 'bags'

IMAGE, COMPRESSED, TEXT = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage', 'std_msgs/msg/String'
#: When the recordings begin, nanoseconds; between frames there are 10 ms.
BEGIN, STEP = 1_700_000_000_123_456_789, 10_000_000
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)


def picture(number=0):
    """A bright rectangle on dark noise, elsewhere in each frame."""
    pixels = np.random.default_rng(number).normal(30, 3, (48, 64))
    pixels[10:38, 8 + number % 30:50] = 200
    return pixels.clip(0, 255).astype(np.uint8)


def image(pixels, number=0, encoding='mono8', frame_id='camera', stamp=None, types=ROS2, **changes):
    """A sensor_msgs/Image; `changes` are fields that are to be wrong."""
    fields = {
        'header': header(number, frame_id, stamp, types), 'height': pixels.shape[0], 'width': pixels.shape[1],
        'encoding': encoding, 'is_bigendian': 0, 'step': pixels[0].nbytes, 'data': pixels.reshape(-1).view(np.uint8)}
    return types.types[IMAGE](**{**fields, **changes})


def header(number=0, frame_id='camera', stamp=None, types=ROS2):
    """What the camera says is a little before what the recording says."""
    sec, nanosec = stamp or divmod(BEGIN + STEP * number - 1_000_001, 10**9)
    time = types.types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
    more = {'seq': number} if types is ROS1 else {}
    return types.types['std_msgs/msg/Header'](**more, stamp=time, frame_id=frame_id)


def text(words, types=ROS2):
    return types.types[TEXT](data=words)


def stamp_of(number):
    return BEGIN + STEP * number


def film(count, topic='/camera', first=0, types=ROS2, offset=0):
    """Topic, type, stamp and message of frames."""
    return [(topic, IMAGE, stamp_of(number) + offset, image(picture(number), number, types=types))
            for number in range(first, first + count)]


def write(path, entries, storage='mcap', mode=CompressionMode.NONE, qos=(), types=ROS2, empty=()):
    """A recording of ROS 2; `entries` have a message, or its bytes; `empty` are topics and types without messages."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind in [*empty, *((topic, kind) for topic, kind, *_ in entries)]:
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(
                    topic, kind, typestore=types, offered_qos_profiles=dict(qos).get(topic, ()))
        for topic, kind, stamp, message in entries:
            data = message if isinstance(message, bytes) else types.serialize_cdr(message, kind)
            writer.write(connections[topic, kind], stamp, data)
    return path


def write_ros1(path, entries, compression=None, threshold=30_000, types=ROS1):
    """A recording of ROS 1, with small chunks."""
    writer = Writer1(path)
    writer.chunk_threshold = threshold
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    with writer:
        connections = {}
        for topic, kind, stamp, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            data = message if isinstance(message, bytes) else types.serialize_ros1(message, kind)
            writer.write(connections[topic], stamp, data)
    return path


def write_split(path, parts, storage='mcap'):
    """A recording of ROS 2 in several files, as `ros2 bag record --max-bag-size` makes it."""
    path.mkdir()
    infos = []
    for number, entries in enumerate(parts):
        part = write(path.with_name(f'{path.name}_{number}'), entries, storage)
        [file] = [file for file in part.iterdir() if file.name != 'metadata.yaml']
        infos.append(yaml.safe_load((part / 'metadata.yaml').read_text())['rosbag2_bagfile_information'])
        shutil.move(file, path / file.name)
        shutil.rmtree(part)
    whole = infos[0]
    begin = min(info['starting_time']['nanoseconds_since_epoch'] for info in infos)
    end = max(info['starting_time']['nanoseconds_since_epoch'] + info['duration']['nanoseconds'] for info in infos)
    for info in infos[1:]:
        whole['relative_file_paths'] += info['relative_file_paths']
        whole['files'] += info['files']
        whole['message_count'] += info['message_count']
        for topic, more in zip(whole['topics_with_message_count'], info['topics_with_message_count'], strict=True):
            topic['message_count'] += more['message_count']
    whole['starting_time']['nanoseconds_since_epoch'] = begin
    whole['duration']['nanoseconds'] = end - begin
    (path / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': whole}))
    return path


def lone(folder, path):
    """The file of a recording without its metadata."""
    [file] = [file for file in folder.iterdir() if file.name != 'metadata.yaml']
    shutil.move(file, path)
    return path


def shared(name):
    path = BAGS / name
    if not path.exists():
        pytest.skip(f'{path} is not there')
    return path


def contents(path, topics=None, start=None, stop=None):
    """Topic, stamp and bytes of what is in a recording, by the module under test."""
    with opened(path) as reader:
        chosen = [connection for connection in reader.connections if topics is None or connection.topic in topics]
        return [(connection.topic, stamp, bytes(data)) for connection, stamp, data
                in (reader.messages(chosen, start, stop) if chosen else ())]


def planned(path, topics=(), **options):
    """Stamps of each topic that the slices of a plan have, slice by slice as workers read them."""
    slices = plan(path, topics=list(topics), **options)
    stamps = {}
    for part in slices:
        for topic, stamp, _ in contents(part.path, part.topics, part.start, part.stop):
            stamps.setdefault(topic, []).append(stamp)
    return slices, stamps


def partition(slices):
    """Whether the slices follow each other without gap or overlap."""
    return (all(one.stop == other.start for one, other in pairwise(slices))
            and all(part.start <= part.stop for part in slices))


def one_sentence(error):
    """The message of an error, which must be one line that users can read."""
    message = str(error.value)
    assert message
    assert '\n' not in message
    assert 'Traceback' not in message
    return message


@pytest.fixture
def recording(tmp_path):
    return write(tmp_path / 'rec', film(100))


# Finding

def test_files_and_folders_of_ros2_are_recordings_themselves(tmp_path):
    bag = write_ros1(tmp_path / 'one.bag', film(1, types=ROS1))
    folder = write(tmp_path / 'two', film(1))
    mcap = lone(write(tmp_path / 'x', film(1)), tmp_path / 'three.mcap')
    db3 = lone(write(tmp_path / 'y', film(1), 'sqlite3'), tmp_path / 'four.db3')
    assert find_recordings([bag, folder, mcap, db3]) == [bag, folder, mcap, db3]


def test_folders_stand_for_the_recordings_inside_at_any_depth(tmp_path):
    outer = tmp_path / 'outer'
    (outer / 'day' / 'morning').mkdir(parents=True)
    (outer / 'nothing').mkdir()
    (outer / 'notes.txt').write_text('no recording')
    (outer / 'b.bag').write_bytes(b'whatever')
    (outer / 'day' / 'a.mcap').write_bytes(b'whatever')
    write(outer / 'day' / 'morning' / 'rec', film(1))
    assert find_recordings([outer]) == [outer / 'b.bag', outer / 'day' / 'a.mcap', outer / 'day' / 'morning' / 'rec']


def test_files_of_a_split_recording_are_not_found_by_themselves(tmp_path):
    split = write_split(tmp_path / 'split', [film(3), film(3, first=3)])
    assert find_recordings([tmp_path]) == [split]
    assert find_recordings([split]) == [split]


def test_a_folder_may_have_the_name_of_a_bag(tmp_path):
    folder = write(tmp_path / 'rec.bag', film(1))
    assert find_recordings([tmp_path]) == [folder]
    assert not is_ros1(folder)
    assert len(contents(folder)) == 1


def test_what_is_named_keeps_its_order_and_folders_are_sorted(tmp_path):
    for name in 'cab':
        (tmp_path / f'{name}.bag').write_bytes(b'x')
    assert [path.stem for path in find_recordings([tmp_path])] == ['a', 'b', 'c']
    assert [path.stem for path in find_recordings([tmp_path / 'c.bag', tmp_path / 'a.bag'])] == ['c', 'a']


@pytest.mark.parametrize(('name', 'sentence'), [('missing', 'no such file or folder'), ('empty', 'no recordings')])
def test_nothing_there_is_a_sentence(tmp_path, name, sentence):
    (tmp_path / 'empty' / 'deeper').mkdir(parents=True)
    with pytest.raises(RecordingError, match=sentence) as error:
        find_recordings([tmp_path / name])
    assert str(tmp_path / name) in one_sentence(error)


def test_a_loop_of_links_is_gone_round_once(tmp_path):
    (tmp_path / 'rec.bag').write_bytes(b'x')
    (tmp_path / 'loop').symlink_to(tmp_path, target_is_directory=True)
    assert len(find_recordings([tmp_path])) <= 2


def test_a_name_that_is_too_long_is_a_sentence(tmp_path):
    with pytest.raises(RecordingError):
        find_recordings([tmp_path / ('x' * 300)])


def test_a_folder_that_may_not_be_read_is_a_sentence(tmp_path, monkeypatch):
    def denied(self):
        raise PermissionError(13, 'Permission denied', str(self))

    monkeypatch.setattr(Path, 'iterdir', denied)
    with pytest.raises(RecordingError, match='Permission denied'):
        find_recordings([tmp_path])


# Opening

@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('mode', [*CompressionMode])
def test_every_storage_and_compression_is_read(tmp_path, storage, mode):
    if storage == 'sqlite3' and mode == CompressionMode.STORAGE:
        pytest.skip('there is no such thing')
    entries = film(40)
    path = write(tmp_path / 'rec', entries, storage, mode)
    expected = [(topic, stamp, bytes(ROS2.serialize_cdr(message, kind))) for topic, kind, stamp, message in entries]
    assert contents(path) == expected
    slices, stamps = planned(path)
    assert len(slices) == 2
    assert stamps == {'/camera': [stamp for _, _, stamp, _ in entries]}


@pytest.mark.parametrize(('storage', 'suffix'), [('mcap', '.mcap'), ('sqlite3', '.db3')])
def test_a_lone_file_is_read_without_its_metadata(tmp_path, storage, suffix):
    whole = write(tmp_path / 'rec', film(40), storage)
    expected = contents(whole)
    file = lone(whole, tmp_path / f'lone{suffix}')
    assert contents(file) == expected
    assert planned(file)[1] == {'/camera': [stamp_of(number) for number in range(40)]}


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_split_recording_is_one(tmp_path, storage):
    path = write_split(tmp_path / 'rec', [film(30), film(30, first=30), film(10, first=60)], storage)
    slices, stamps = planned(path)
    assert len(slices) == 3
    assert partition(slices)
    assert stamps == {'/camera': [stamp_of(number) for number in range(70)]}


@pytest.mark.parametrize('compression', [None, 'bz2', 'lz4'])
def test_ros1_is_read_with_any_compression(tmp_path, compression):
    path = write_ros1(tmp_path / 'rec.bag', film(70, types=ROS1), compression)
    assert is_ros1(path)
    slices, stamps = planned(path)
    assert len(slices) == 3
    assert stamps == {'/camera': [stamp_of(number) for number in range(70)]}
    [(_, _, data)] = contents(path, stop=BEGIN + 1)
    message = deserialize(path, data, IMAGE)
    assert message.header.seq == 0
    assert bytes(message.data) == picture(0).tobytes()


def test_image_topics_are_those_with_images(tmp_path):
    jpeg = ROS2.types[COMPRESSED](header=header(), format='jpeg', data=np.zeros(3, np.uint8))
    path = write(tmp_path / 'rec', [*film(1), ('/small', COMPRESSED, BEGIN, jpeg), ('/words', TEXT, BEGIN, text('a'))])
    with opened(path) as reader:
        assert image_topics(reader) == {'/camera': IMAGE, '/small': COMPRESSED}


def test_overlays_of_an_earlier_run_are_processed_only_if_named(tmp_path):
    segments, overlay = OUTPUTS['segments'], OUTPUTS['overlay']
    path = write(tmp_path / 'rec', film(2), empty=[
        ('/camera/segments', segments), ('/camera/overlay', overlay), ('/other/segments', TEXT),
        ('/other/overlay', overlay), ('/alone/overlay', overlay), ('/raw/segments', segments), ('/raw/overlay', IMAGE)])
    chosen = '/alone/overlay', '/camera', '/other/overlay', '/raw/overlay'
    assert {part.topics for part in plan(path, topics=[])} == {chosen}
    named = '/camera', '/camera/overlay'
    assert {part.topics for part in plan(path, topics=list(named))} == {named}


@pytest.mark.parametrize(('error', 'words'), [
    (LookupError(('Header could', 'not be read.')), 'Header could not be read'), (LookupError('a', 1), r"\('a', 1\)"),
    (LookupError(('Header is cut.',)), 'Header is cut'), (LookupError(()), 'LookupError'), (KeyError('a'), "'a'")])
def test_what_a_library_says_is_told_as_words(recording, error, words):
    with pytest.raises(DamagedError, match=rf'rec: cannot be read \({words}\)$'), opened(recording):
        raise error


def test_an_error_in_the_block_is_a_sentence_and_those_of_this_package_stay(recording):
    with pytest.raises(RecordingError, match=r'rec: cannot be read \(two lines\)') as error, opened(recording):
        raise LookupError('two\n   lines.')
    one_sentence(error)
    with pytest.raises(RecordingError, match=r'^mine$'), opened(recording):
        raise RecordingError('mine')
    with pytest.raises(RecordingError, match='rec: No space left on device'), opened(recording):
        raise OSError(28, 'No space left on device')
    with pytest.raises(RecordingError, match='AssertionError'), opened(recording):
        raise AssertionError
    with pytest.raises(KeyboardInterrupt), opened(recording):
        raise KeyboardInterrupt


def refused(path):
    """The sentence that a recording is refused with, by whoever looks at it first."""
    with pytest.raises(RecordingError) as error:
        planned(path)
    assert str(error.value).startswith(f'{path}: ')
    return one_sentence(error)


@pytest.mark.parametrize('suffix', ['.bag', '.mcap', '.db3'])
def test_an_empty_file_is_a_sentence(tmp_path, suffix):
    (tmp_path / f'rec{suffix}').touch()
    assert 'empty' in refused(tmp_path / f'rec{suffix}')


@pytest.mark.parametrize('name', ['rec.txt', 'rec', 'rec.jpg', '.bag'])
def test_another_suffix_is_a_sentence(tmp_path, name):
    (tmp_path / name).write_text('words')
    assert 'not a recording, expected one of .bag, .db3, .mcap' in refused(tmp_path / name)


@pytest.mark.parametrize('suffix', ['.bag', '.mcap', '.db3'])
@pytest.mark.parametrize('data', [
    b'x', b'version https://git-lfs.github.com/spec/v1\n' * 3, bytes(5000), bytes(range(256)) * 20,
    b'#ROSBAG V2.0\n', b'#ROSBAG V1.2\n' + bytes(99), b'\x89MCAP0\r\n', b'\x89MCAP0\r\n' * 20, b'SQLite format 3\0',
    b'SQLite format 3\0' + bytes(5000)])
def test_noise_is_a_sentence(tmp_path, suffix, data):
    path = tmp_path / f'rec{suffix}'
    path.write_bytes(data)
    refused(path)


@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=300), suffix=st.sampled_from(['.bag', '.mcap', '.db3']),
       magic=st.sampled_from([b'', b'#ROSBAG V2.0\n', b'\x89MCAP0\r\n', b'SQLite format 3\0']))
def test_bytes_of_all_kinds_are_a_sentence_or_a_recording(tmp_path_factory, data, suffix, magic):
    path = tmp_path_factory.mktemp('noise') / f'rec{suffix}'
    path.write_bytes(magic + data)
    reason = ''
    try:
        planned(path)
    except RecordingError as error:
        reason = str(error)
    assert '\n' not in reason


def test_a_folder_whose_metadata_are_wrong_is_a_sentence(recording):
    metadata = recording / 'metadata.yaml'
    good = metadata.read_text()
    for bad in ('', 'words', '- 1', '{', 'rosbag2_bagfile_information: 3', good.replace('mcap', 'tape'),
                good.replace('rec.mcap', 'gone.mcap'), good.replace('version: 9', 'version: 99'),
                good.replace('duration', 'age'), '\0'):
        metadata.write_text(bad)
        refused(recording)
    metadata.write_bytes(b'\xff\xfe\xfd')
    refused(recording)


def test_a_folder_without_metadata_is_a_sentence_when_opened(tmp_path):
    (tmp_path / 'rec').mkdir()
    with pytest.raises(RecordingError) as error, opened(tmp_path / 'rec'):
        pass
    one_sentence(error)


def test_what_cannot_be_opened_is_a_sentence(recording, monkeypatch):
    def denied(self, *arguments, **options):
        raise PermissionError(13, 'Permission denied', str(self))

    bag = write_ros1(recording.with_name('one.bag'), film(1, types=ROS1))
    monkeypatch.setattr(Path, 'open', denied)
    assert 'Permission denied' in refused(bag)
    assert 'Permission denied' in refused(recording)


CUTS = [0.02, 0.1, 0.3, 0.5, 0.75, 0.9, 0.99]


@pytest.mark.parametrize('share', CUTS)
@pytest.mark.parametrize('kind', ['mcap', 'mcap-zstd', 'bag', 'bag-bz2', 'bag-lz4'])
def test_a_cut_file_is_a_sentence(tmp_path, kind, share):
    kind, _, compression = kind.partition('-')
    if kind == 'mcap':
        mode = CompressionMode.STORAGE if compression else CompressionMode.NONE
        path = lone(write(tmp_path / 'rec', film(40), mode=mode), tmp_path / 'cut.mcap')
    else:
        path = write_ros1(tmp_path / 'cut.bag', film(40, types=ROS1), compression)
    path.write_bytes(path.read_bytes()[:int(path.stat().st_size * share)])
    refused(path)


@pytest.mark.parametrize('lost', [1, 4, 8, 9, 37, 100])
@pytest.mark.parametrize('kind', ['mcap', 'bag'])
def test_a_file_cut_by_a_few_bytes_is_a_sentence(tmp_path, kind, lost):
    if kind == 'mcap':
        path = lone(write(tmp_path / 'rec', film(5)), tmp_path / 'cut.mcap')
    else:
        path = write_ros1(tmp_path / 'cut.bag', film(5, types=ROS1))
    path.write_bytes(path.read_bytes()[:-lost])
    refused(path)


@pytest.mark.parametrize('whole', [True, False])
@pytest.mark.parametrize('share', CUTS)
def test_a_cut_database_is_a_sentence(tmp_path, share, whole):
    folder = write(tmp_path / 'rec', film(40), 'sqlite3')
    [file] = folder.glob('*.db3')
    file.write_bytes(file.read_bytes()[:int(file.stat().st_size * share)])
    path = folder if whole else lone(folder, tmp_path / 'cut.db3')
    if share < 0.98:
        refused(path)
    else:  # what is missing is empty
        assert planned(path)[1] == {'/camera': [stamp_of(number) for number in range(40)]}


def test_flipped_bytes_in_a_compressed_chunk_are_a_sentence(tmp_path):
    path = lone(write(tmp_path / 'rec', film(40), mode=CompressionMode.STORAGE), tmp_path / 'bad.mcap')
    data = bytearray(path.read_bytes())
    middle = len(data) // 3
    data[middle:middle + 200] = bytes(200)
    path.write_bytes(data)
    refused(path)


@pytest.mark.parametrize('name', [
    'empty-file.bag', 'git_lfs_pointer.bag', 'git_lfs_pointer.db3', 'test_sample_truncated.mcap', 'test_truncated.bag',
    'test_unindexed.bag'])
def test_bad_recordings_of_the_world_are_a_sentence(name):
    refused(shared('bad') / name)


@pytest.mark.parametrize('name', [
    'bag-with-empty-message-definition.bag', 'empty_mcap_no_messages.mcap', 'no-messages.bag'])
def test_recordings_of_the_world_without_images_have_no_slices(name):
    path = shared('bad') / name
    reason = ''
    try:
        assert plan(path, topics=[]) == []
    except RecordingError as error:
        reason = str(error)
    assert '\n' not in reason


def test_recordings_of_the_world_are_planned_whole():
    found = find_recordings([shared('good')])
    assert len(found) >= 7
    for path in found:
        slices, stamps = planned(path)
        with opened(path) as reader:
            counts = {connection.topic: connection.msgcount for connection in reader.connections
                      if connection.topic in image_topics(reader)}
        assert partition(slices)
        assert {topic: len(found) for topic, found in stamps.items()} == {k: v for k, v in counts.items() if v}


# Kept open

def kept(path):
    with kept_open(path) as reader:
        return reader, [(connection.topic, stamp, bytes(data)) for connection, stamp, data in reader.messages()]


@pytest.mark.parametrize('kind', ['ros1', 'mcap', 'sqlite3', 'lone'])
def test_a_recording_that_is_kept_open_is_opened_once(tmp_path, kind):
    path = (write_ros1(tmp_path / 'rec.bag', film(8, types=ROS1)) if kind == 'ros1' else
            lone(write(tmp_path / 'rec', film(8)), tmp_path / 'rec.mcap') if kind == 'lone' else
            write(tmp_path / 'rec', film(8), kind))
    first, found = kept(path)
    again, same = kept(path)
    assert first is again
    assert found == same == contents(path)


def test_only_one_is_kept_open(tmp_path):
    paths = [lone(write(tmp_path / f'{number}', film(2 + number)), tmp_path / f'{number}.mcap') for number in range(2)]
    first, _ = kept(paths[0])
    assert first.is_open
    second, found = kept(paths[1])
    assert (first.is_open, second.is_open) == (False, True)
    assert len(found) == 3


def test_a_recording_that_changed_is_opened_anew(tmp_path):
    path = lone(write(tmp_path / 'first', film(2)), tmp_path / 'rec.mcap')
    assert len(kept(path)[1]) == 2
    lone(write(tmp_path / 'second', film(3)), path)
    assert len(kept(path)[1]) == 3


def test_one_that_failed_is_not_kept(tmp_path):
    path = lone(write(tmp_path / 'rec', film(2)), tmp_path / 'rec.mcap')
    with pytest.raises(DamagedError, match=r'rec\.mcap: cannot be read \(noise\)'), kept_open(path) as reader:
        raise AssertionError('noise')
    assert not reader.is_open
    assert len(kept(path)[1]) == 2
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DamagedError, match=r'rec\.mcap: cannot be read'):
        kept(path)


def test_each_thread_keeps_its_own(tmp_path):
    path = write(tmp_path / 'rec', film(2), 'sqlite3')
    with ThreadPoolExecutor(1) as pool:
        other, _ = pool.submit(kept, path).result()
        assert other.is_open
        assert kept(path)[0] is not other
    assert not other.is_open


# Planning

def test_slices_share_out_the_time_and_every_frame_is_in_one(recording):
    slices, stamps = planned(recording)
    assert len(slices) == 4
    assert partition(slices)
    assert slices[0].start == BEGIN
    assert slices[-1].stop == stamp_of(99) + 1
    assert stamps == {'/camera': [stamp_of(number) for number in range(100)]}
    assert all(part.path == recording and part.topics == ('/camera',) for part in slices)


def test_a_plan_is_the_same_each_time(recording):
    assert plan(recording, topics=[]) == plan(recording, topics=[])
    assert plan(recording, topics=[], every=3) == plan(recording, topics=[], every=3)


@settings(max_examples=25, deadline=None)
@given(gaps=st.lists(st.integers(0, 10**9), min_size=0, max_size=40), size=st.integers(1, 9),
       start=st.none() | st.floats(0, 20), length=st.none() | st.floats(0, 20))
def test_no_frame_is_lost_or_read_twice_whatever_the_stamps(tmp_path_factory, gaps, size, start, length):
    stamps = [BEGIN + int(sum(gaps[:k])) for k in range(len(gaps) + 1)]
    data = bytes(ROS2.serialize_cdr(image(picture()), IMAGE))
    path = write(tmp_path_factory.mktemp('plan') / 'rec', [('/camera', IMAGE, stamp, data) for stamp in stamps])
    end = None if length is None else (start or 0) + length
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recordings, 'SLICE', size)
        slices, found = planned(path, start=start, end=end)
    first = BEGIN + round((start or 0) * 1e9)
    last = stamps[-1] + 1 if end is None else min(stamps[-1] + 1, BEGIN + round(end * 1e9))
    assert found.get('/camera', []) == [stamp for stamp in stamps if first <= stamp < last]
    assert partition(slices)


def test_start_and_end_are_seconds_from_the_beginning(recording):
    _, stamps = planned(recording, start=0.2, end=0.5)
    assert stamps == {'/camera': [stamp_of(number) for number in range(20, 50)]}
    _, stamps = planned(recording, start=0.985)
    assert stamps == {'/camera': [stamp_of(99)]}
    _, stamps = planned(recording, end=0.005)
    assert stamps == {'/camera': [BEGIN]}


def test_the_beginning_is_that_of_the_recording_whatever_was_first_in_it(tmp_path):
    path = write(tmp_path / 'rec', [('/words', TEXT, BEGIN - 10**9, text('first')), *film(100)])
    _, stamps = planned(path, start=1.5)
    assert stamps == {'/camera': [stamp_of(number) for number in range(50, 100)]}


@pytest.mark.parametrize('options', [
    {'start': 5.0}, {'start': 0.5, 'end': 0.5}, {'start': 0.7, 'end': 0.2}, {'end': 0}])
def test_no_time_is_no_slice(recording, options):
    assert plan(recording, topics=[], **options) == []


def test_an_end_behind_the_end_is_the_end(recording):
    assert plan(recording, topics=[], end=1e6) == plan(recording, topics=[])


@pytest.mark.parametrize('make', [lambda path: write(path, film(1)), lambda path: write(path, film(1), 'sqlite3'),
                                  lambda path: write_ros1(path.with_suffix('.bag'), film(1, types=ROS1))])
def test_one_frame_is_one_slice(tmp_path, make):
    slices, stamps = planned(make(tmp_path / 'rec'))
    assert len(slices) == 1
    assert stamps == {'/camera': [BEGIN]}


@pytest.mark.parametrize('make', [write, lambda path, entries: write(path, entries, 'sqlite3')])
def test_many_frames_at_one_time_are_one_slice(tmp_path, make):
    slices, stamps = planned(make(tmp_path / 'rec', [(*entry[:2], BEGIN, entry[3]) for entry in film(80)]))
    assert stamps == {'/camera': [BEGIN] * 80}
    assert partition(slices)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_no_messages_and_no_images_are_no_slices(tmp_path, storage):
    assert plan(write(tmp_path / 'a', [], storage, empty=[('/camera', IMAGE)]), topics=[]) == []
    assert plan(write(tmp_path / 'b', [('/words', TEXT, BEGIN, text('a'))], storage), topics=[]) == []
    assert plan(write(tmp_path / 'c', [('/words', TEXT, BEGIN, text('a'))], storage, empty=[('/camera', IMAGE)]),
                topics=[]) == []


def test_all_topics_of_images_are_taken_unless_some_are_named(tmp_path):
    entries = sorted([*film(50, '/left'), *film(50, '/right', offset=77)], key=lambda entry: entry[2])
    path = write(tmp_path / 'rec', [*entries, ('/words', TEXT, BEGIN, text('a'))])
    left, right = ([stamp_of(number) + offset for number in range(50)] for offset in (0, 77))
    slices, stamps = planned(path)
    assert slices[0].topics == ('/left', '/right')
    assert len(slices) == 4
    assert stamps == {'/left': left, '/right': right}
    slices, stamps = planned(path, ['/right'])
    assert slices[0].topics == ('/right',)
    assert stamps == {'/right': right}
    assert planned(path, ['/right', '/left'])[1] == {'/left': left, '/right': right}


@pytest.mark.parametrize('topic', ['/words', '/nothing', 'camera', ''])
def test_a_topic_without_images_is_a_sentence_that_names_those_with(tmp_path, topic):
    path = write(tmp_path / 'rec', [*film(3), ('/words', TEXT, BEGIN, text('a'))])
    with pytest.raises(RecordingError, match='but on /camera') as error:
        plan(path, topics=['/camera', topic])
    assert repr(topic) in one_sentence(error)


def test_with_every_the_frames_before_each_slice_are_counted(tmp_path):
    entries = sorted([*film(100, '/left'), *film(25, '/right', offset=77)], key=lambda entry: entry[2])
    path = write(tmp_path / 'rec', entries)
    slices = plan(path, topics=[], every=7)
    assert partition(slices)
    for part in slices:
        before = contents(path, None, None, part.start)
        assert part.every == 7
        assert dict(zip(part.topics, part.skipped, strict=True)) == {
            topic: sum(entry[0] == topic for entry in before) for topic in ('/left', '/right')}


def test_every_counts_from_the_start_that_was_asked_for(recording):
    slices = plan(recording, topics=[], start=0.2, every=4)
    assert slices[0].skipped == (0,)
    assert slices[-1].skipped == (len(contents(recording, None, slices[0].start, slices[-1].start)),)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_slices_are_no_more_than_there_is_room_for(tmp_path, storage):
    """What metadata say of the number of messages may be anything."""
    path = write(tmp_path / 'rec', film(40), storage)
    honest = plan(path, topics=[])
    metadata = path / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('message_count: 40', 'message_count: 100000000000'))
    claimed = plan(path, topics=[])
    assert len(honest) == 2
    assert 2 <= len(claimed) < 100
    assert (claimed[0].start, claimed[-1].stop) == (honest[0].start, honest[-1].stop)

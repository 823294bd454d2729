import csv
import dataclasses
import errno
import fcntl
import hashlib
import importlib.metadata
import math
import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, Reader, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_recordings import (
    BEGIN,
    IMAGE,
    ROS1,
    ROS2,
    TEXT,
    film,
    image,
    lone,
    picture,
    shared,
    stamp_of,
    text,
    write,
    write_ros1,
    write_split,
)
from test_slices import CLOUD, cloud, found
from test_workers import ENVIRONMENT

from line_feature_node import bag
from line_feature_node.bag import Run, TargetError, process_recording
from line_feature_node.core import SEGMENT_DTYPE, LineFeatureExtractor, Parameters
from line_feature_node.images import decode
from line_feature_node.messages import segments_of
from line_feature_node.recordings import OUTPUTS, RecordingError, deserialize, find_recordings
from line_feature_node.slices import Job
from line_feature_node.workers import Workers, WorkersError, cluster, inline, local

CORRIDOR = Path(__file__).resolve().parents[1] / 'bags' / 'corridor'
TOPIC = '/camera/image/compressed'
JOB = Job(Parameters())
SEGMENTS = Job(Parameters(), outputs=('segments',))
ENDINGS = tuple(OUTPUTS)


def process(source, target, workers=None, watch=lambda *_: None, job=JOB, **options):
    return process_recording(source, target, Run(job, **options), workers or inline(), watch)


def read(path):
    """Topic, stamp and bytes of all messages, as others read them."""
    with AnyReader([path]) as reader:
        return [(connection.topic, stamp, bytes(data)) for connection, stamp, data in reader.messages()]


def topics(path):
    with AnyReader([path]) as reader:
        return {connection.topic: connection for connection in reader.connections}


def of(messages, *endings):
    return [message for message in messages if message[0].endswith(endings)]


def hashes(path):
    """Of all files under a path, with their times and permissions."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob('*') if file.is_file())
    return {file: (hashlib.sha256(file.read_bytes()).hexdigest(), file.stat().st_mtime_ns, file.stat().st_mode)
            for file in files}


def one_sentence(error):
    message = str(error.value)
    assert message
    assert '\n' not in message
    return message


@pytest.fixture(scope='module')
def source(tmp_path_factory):
    return write(tmp_path_factory.mktemp('source') / 'rec', film(100))


@pytest.fixture(scope='module')
def result(source, tmp_path_factory):
    """What an undisturbed run makes of it."""
    target = tmp_path_factory.mktemp('result') / 'out'
    process(source, target, job=dataclasses.replace(JOB, csv=True))
    return target


@pytest.fixture
def counted(monkeypatch):
    """The slices that are worked on, by workers of this process."""
    slices = []

    def count(part, job):
        slices.append(part)
        return work(part, job)

    work = bag.process_slice
    monkeypatch.setattr(bag, 'process_slice', count)
    return slices


class Stop(BaseException):
    """Ends a run from within."""


def stopper(after):
    """Stops a run after so many slices."""
    def watch(done, slices, frame):
        if frame is None and done == after:
            raise Stop
    return watch


# Results

def test_every_frame_has_its_results_under_its_stamp_and_in_order(source, result):
    messages = read(result)
    assert [stamp for _, stamp, _ in messages] == sorted(stamp for _, stamp, _ in messages)
    for name in ENDINGS:
        assert [stamp for _, stamp, _ in of(messages, f'/camera/{name}')] == [stamp_of(k) for k in range(100)]
    assert len(messages) == 300
    for number, (_, _, data) in enumerate(of(messages, '/segments')):
        message = ROS2.deserialize_cdr(data, CLOUD)
        assert segments_of(message).tobytes() == found(picture(number)).tobytes()
        assert message.header.frame_id == 'camera'


@pytest.mark.parametrize('workers', [lambda: local(1), lambda: local(2), inline], ids=['one', 'two', 'inline'])
def test_results_do_not_depend_on_the_number_of_workers(source, result, tmp_path, workers):
    outcome = process(source, tmp_path / 'out', workers(), job=dataclasses.replace(JOB, csv=True))
    assert read(tmp_path / 'out') == read(result)
    assert (tmp_path / 'out' / 'segments.csv').read_bytes() == (result / 'segments.csv').read_bytes()
    assert [frame.number for frame in outcome.frames] == list(range(100))


def test_the_size_of_the_slices_does_not_matter(source, result, tmp_path, monkeypatch):
    for size in (7, 1000):
        monkeypatch.setattr('line_feature_node.recordings.SLICE', size)
        process(source, tmp_path / str(size))
        assert read(tmp_path / str(size)) == read(result)


def test_a_worker_that_dies_costs_nothing(source, result, tmp_path):
    class Dying:
        """Kills one of its processes after the first results."""

        made = 0

        def __call__(self):
            Dying.made += 1
            return local(2).make()

    def watch(done, slices, frame):
        if frame is None and done == 1 and Dying.made == 1:
            for pid in children():
                os.kill(pid, signal.SIGKILL)

    process(source, tmp_path / 'out', Workers(2, Dying()), watch)
    assert read(tmp_path / 'out') == read(result)


def children():
    """Processes that this one has spawned to work for it."""
    pids = [pid for task in Path('/proc/self/task').iterdir() for pid in (task / 'children').read_text().split()]
    return [int(pid) for pid in pids if b'spawn_main' in Path(f'/proc/{pid}/cmdline').read_bytes()]


def test_a_cluster_that_loses_one_of_two_workers_makes_the_same(source, result, tmp_path, fleet):
    fleet = fleet(2)

    def watch(done, slices, frame):
        if frame is None and done == 1:
            fleet.workers[0].kill()

    process(source, tmp_path / 'out', cluster(fleet.address), watch)
    assert read(tmp_path / 'out') == read(result)


def test_workers_that_all_die_are_an_error_without_a_target(source, tmp_path, monkeypatch):
    @contextmanager
    def broken():
        raise bag.in_order.__globals__['BrokenExecutor']
        yield

    with pytest.raises(WorkersError):
        process(source, tmp_path / 'out', Workers(1, broken))
    assert not (tmp_path / 'out').exists()


def test_every_kind_of_input_gives_the_same(result, tmp_path):
    sources = [write(tmp_path / 'db', film(100), 'sqlite3'),
               write_ros1(tmp_path / 'a.bag', film(100, types=ROS1), 'lz4'),
               lone(write(tmp_path / 'x', film(100)), tmp_path / 'lone.mcap'),
               write_split(tmp_path / 'split', [film(60), film(40, first=60)])]
    for number, path in enumerate(sources):
        process(path, tmp_path / f'out{number}')
        assert read(tmp_path / f'out{number}') == read(result)


@pytest.fixture(scope='module')
def burst(tmp_path_factory):
    """Frames that come in two bursts, one of them all at once, and words between them."""
    stamps = [*(BEGIN + number * 1000 for number in range(250)), *[BEGIN + 10**11] * 150]
    entries = []
    for number, stamp in enumerate(stamps):
        entries += [('/camera', IMAGE, stamp, image(picture(number % 7), number)),
                    ('/words', TEXT, stamp, text(str(number)))]
    return write(tmp_path_factory.mktemp('burst') / 'rec', entries)


@pytest.fixture(scope='module')
def burst_result(burst, tmp_path_factory):
    target = tmp_path_factory.mktemp('burst') / 'out'
    process(burst, target, copy=True, job=SEGMENTS)
    return target


def test_a_burst_has_its_results_in_order(burst, burst_result):
    made = of(read(burst_result), '/segments')
    headers = [ROS2.deserialize_cdr(data, CLOUD).header.stamp for _, _, data in made]
    assert [stamp.sec * 10**9 + stamp.nanosec for stamp in headers] == [
        stamp_of(number) - 1_000_001 for number in range(400)]
    assert of(read(burst_result), '/words') == of(read(burst), '/words')


@pytest.mark.parametrize('count', [1, 2])
def test_results_of_a_burst_do_not_depend_on_the_workers(burst, burst_result, tmp_path, count):
    outcome = process(burst, tmp_path / 'out', local(count), copy=True, job=SEGMENTS)
    assert read(tmp_path / 'out') == read(burst_result)
    assert [frame.number for frame in outcome.frames] == list(range(400))


def test_a_burst_is_written_in_the_order_of_time(burst, tmp_path, monkeypatch):
    stamps = []
    put = Writer.write

    def write_and_note(self, connection, stamp, data):
        stamps.append(stamp)
        put(self, connection, stamp, data)

    monkeypatch.setattr(Writer, 'write', write_and_note)
    process(burst, tmp_path / 'out', copy=True, job=SEGMENTS)
    assert len(stamps) == 1200
    assert stamps == sorted(stamps)


@pytest.mark.parametrize('after', range(1, 9))
def test_a_burst_can_be_gone_on_with(burst, burst_result, tmp_path, counted, after):
    with pytest.raises(Stop):
        process(burst, tmp_path / 'out', copy=True, job=SEGMENTS, watch=stopper(after))
    stopped = len(list((tmp_path / 'out.partial' / 'slices').iterdir()))
    counted.clear()
    outcome = process(burst, tmp_path / 'out', copy=True, job=SEGMENTS, resume=True)
    again = len(counted)
    counted.clear()
    process(burst, tmp_path / 'whole', copy=True, job=SEGMENTS)
    assert stopped >= after
    assert again == len(counted) - stopped
    assert read(tmp_path / 'out') == read(burst_result)
    assert [frame.number for frame in outcome.frames] == list(range(400))


def test_the_progress_through_a_burst_comes_to_its_end(burst, tmp_path):
    news = []
    process(burst, tmp_path / 'out', job=SEGMENTS, watch=lambda *some: news.append(some))
    done = [(done, known) for done, known, frame in news if frame is None]
    assert [number for number, _ in done] == list(range(1, len(done) + 1))
    assert done[-1] == (len(done), len(done))
    assert all(number <= known for number, known in done)


def test_the_outcome_has_every_frame(source, tmp_path):
    seen = []
    outcome = process(source, tmp_path / 'out', watch=lambda *news: seen.append(news))
    assert (outcome.source, outcome.target, outcome.error, outcome.uncopied) == (source, tmp_path / 'out', '', [])
    assert [(frame.topic, frame.number, frame.stamp) for frame in outcome.frames] == [
        ('/camera', number, stamp_of(number)) for number in range(100)]
    assert all(frame.messages == {} for frame in outcome.frames)
    assert outcome.segments == sum(len(found(picture(number))) for number in range(100))
    assert not outcome.failed
    assert [news[2] for news in seen if news[2] is not None] == [
        dataclasses.replace(frame, seconds=news[2].seconds, orientations=news[2].orientations)
        for frame, news in zip(outcome.frames, [news for news in seen if news[2] is not None], strict=True)]
    assert all(sum(frame.orientations) > 0 for frame in outcome.frames)
    assert [news[:2] for news in seen if news[2] is None] == [(done, 4) for done in range(1, 5)]


def test_several_topics_have_results_of_their_own(tmp_path):
    entries = sorted([*film(50, '/left'), *film(40, '/right', offset=77)], key=lambda entry: entry[2])
    outcome = process(write(tmp_path / 'rec', entries), tmp_path / 'out')
    messages = read(tmp_path / 'out')
    for topic, offset, count in (('/left', 0, 50), ('/right', 77, 40)):
        mine = of(messages, f'{topic}/segments')
        assert [stamp for _, stamp, _ in mine] == [stamp_of(number) + offset for number in range(count)]
        assert [frame.number for frame in outcome.frames if frame.topic == topic] == list(range(count))
    assert set(topics(tmp_path / 'out')) == {f'{topic}/{name}' for topic in ('/left', '/right') for name in ENDINGS}


def test_topics_times_and_every_are_chosen(tmp_path):
    entries = sorted([*film(50, '/left'), *film(40, '/right', offset=77)], key=lambda entry: entry[2])
    path = write(tmp_path / 'rec', entries)
    outcome = process(path, tmp_path / 'out', topics=('/left',), start=0.1, end=0.3, every=3)
    assert [frame.stamp for frame in outcome.frames] == [stamp_of(number) for number in range(10, 30, 3)]
    assert {topic for topic, _, _ in read(tmp_path / 'out')} == {f'/left/{name}' for name in ENDINGS}


def test_a_topic_that_is_named_twice_is_there_once(source, result, tmp_path):
    process(source, tmp_path / 'out', topics=('/camera', '/camera'))
    assert read(tmp_path / 'out') == read(result)


def test_frames_that_fail_are_counted_by_reason_and_the_rest_goes_on(tmp_path):
    entries = film(40)
    for number in (3, 5, 35):
        entries[number] = (*entries[number][:3], image(picture(), encoding='mono12'))
    entries[20] = (*entries[20][:3], image(picture(), step=3))
    outcome = process(write(tmp_path / 'rec', entries), tmp_path / 'out', job=dataclasses.replace(JOB, csv=True))
    assert sorted(outcome.failed.values()) == [1, 3]
    assert len(outcome.frames) == 40
    good = [stamp_of(number) for number in range(40) if number not in (3, 5, 20, 35)]
    assert [stamp for _, stamp, _ in of(read(tmp_path / 'out'), '/segments')] == good


@pytest.mark.parametrize(('start', 'end'), [(2.0, 2.0), (2.0, 1.0), (None, 0.0), (math.nan, None), (None, math.nan),
                                            (math.inf, None), (math.inf, math.inf)])
def test_no_time_between_start_and_end_is_refused(start, end):
    with pytest.raises(ValueError, match='end must be later than start, got '):
        Run(JOB, start=start, end=end)


def test_times_beyond_the_recording_mean_its_end(source, result, tmp_path):
    process(source, tmp_path / 'out', start=0.0, end=math.inf)
    assert read(tmp_path / 'out') == read(result)
    process(source, tmp_path / 'far', end=1e300)
    assert read(tmp_path / 'far') == read(result)
    assert process(source, tmp_path / 'none', start=1e300).error == bag.NO_IMAGES


def test_without_images_there_is_a_sentence_and_no_target(tmp_path):
    path = write(tmp_path / 'rec', [('/words', TEXT, BEGIN, text('a'))])
    assert process(path, tmp_path / 'out').error == bag.NO_IMAGES
    assert process(write(tmp_path / 'more', film(3)), tmp_path / 'out', start=5).error == bag.NO_IMAGES
    assert sorted(path.name for path in tmp_path.iterdir()) == ['more', 'rec']


@pytest.mark.parametrize('change', [{'topics': ('/nothing',)}, {}])
def test_a_recording_that_cannot_be_read_leaves_nothing(tmp_path, change):
    path = write(tmp_path / 'rec', film(3))
    if not change:
        (path / 'rec.mcap').write_bytes(b'noise')
    with pytest.raises(RecordingError):
        process(path, tmp_path / 'out', **change)
    assert [path.name for path in tmp_path.iterdir()] == ['rec']


# The new bag

def test_mcap_with_compressed_chunks_is_the_default(result):
    assert {path.name for path in result.iterdir()} == {'metadata.yaml', 'out.mcap', 'segments.csv'}
    assert (result / 'out.mcap').read_bytes().count(b'\x04\0\0\0zstd')
    info = yaml.safe_load((result / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert (info['storage_identifier'], info['message_count']) == ('mcap', 300)
    assert info['starting_time']['nanoseconds_since_epoch'] == BEGIN


def test_sqlite3_has_the_same_messages(source, result, tmp_path):
    process(source, tmp_path / 'out', storage='sqlite3')
    assert {path.name for path in (tmp_path / 'out').iterdir()} == {'metadata.yaml', 'out.db3'}
    assert sorted(read(tmp_path / 'out')) == sorted(read(result))


def test_the_file_is_readable_by_itself(result, tmp_path):
    shutil.copy(result / 'out.mcap', tmp_path)
    assert read(tmp_path / 'out.mcap') == read(result)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_types_and_qualities_of_service_are_there(source, tmp_path, storage):
    process(source, tmp_path / 'out', storage=storage)
    for topic, connection in topics(tmp_path / 'out').items():
        assert connection.msgtype == OUTPUTS[topic.rpartition('/')[2]]
        assert connection.digest.startswith('RIHS01_')
        assert connection.msgdef.data
        assert connection.msgcount == 100
        [qos] = connection.ext.offered_qos_profiles
        assert (qos.reliability, qos.durability) == (QosReliability.RELIABLE, QosDurability.VOLATILE)
        assert (qos.history, qos.depth) == (QosHistory.KEEP_LAST, 5)


def test_only_what_is_wanted_has_topics(source, tmp_path):
    process(source, tmp_path / 'out', job=SEGMENTS)
    assert set(topics(tmp_path / 'out')) == {'/camera/segments'}


def test_segments_as_a_table(source, result):
    with (result / 'segments.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ['stamp', 'topic', 'frame', *SEGMENT_DTYPE.names]
    for number in (0, 31, 32, 99):
        mine = [row for row in rows if row['frame'] == str(number)]
        segments = found(picture(number))
        assert len(mine) == len(segments) > 0
        for row, segment in zip(mine, segments, strict=True):
            assert (row['stamp'], row['topic']) == (str(stamp_of(number)), '/camera')
            for name in SEGMENT_DTYPE.names:
                np.testing.assert_array_equal(SEGMENT_DTYPE[name].type(float(row[name])), segment[name])


def test_the_table_has_a_head_even_without_segments(tmp_path):
    path = write(tmp_path / 'rec', [('/camera', IMAGE, BEGIN, image(np.full((48, 64), 90, np.uint8)))])
    process(path, tmp_path / 'out', job=dataclasses.replace(JOB, csv=True))
    assert (tmp_path / 'out' / 'segments.csv').read_text().splitlines() == [
        ','.join(('stamp', 'topic', 'frame', *SEGMENT_DTYPE.names))]


def test_recordings_of_the_world_are_processed(tmp_path):
    for path in find_recordings([shared('good')]):
        target = tmp_path / f'{path.name}-out'
        outcome = process(path, target, copy=True, end=1.0)
        assert outcome.frames
        assert not outcome.failed
        assert outcome.uncopied == [] or path.suffix == '.bag'
        messages = read(target)
        assert len(of(messages, '/segments')) == len(outcome.frames)
        assert [stamp for _, stamp, _ in messages] == sorted(stamp for _, stamp, _ in messages)


# Copies

LATCHED = Qos(QosHistory.KEEP_ALL, 7, QosReliability.BEST_EFFORT, QosDurability.TRANSIENT_LOCAL, QosTime(1, 2),
              QosTime(3, 4), QosLiveliness.AUTOMATIC, QosTime(5, 6), avoid_ros_namespace_conventions=False)
OWN = 'robot_msgs/msg/Own'


def with_own(store):
    """Types of a ROS, and one that nobody else has."""
    types = get_typestore(store)
    types.register(get_types_from_msg('int32 number\nstring name\nstd_msgs/String words\n', OWN))
    return types


def own(types, number):
    return types.types[OWN](number=number, name=f'n{number}', words=types.types[TEXT](data='w'))


def rich(types, count=70):
    """Images, and around and between them other messages."""
    entries = [('/words', TEXT, BEGIN - 10**9, types.types[TEXT](data='before'))]
    for number, entry in enumerate(film(count, types=ROS1 if OWN in types.types and types.fielddefs.get(
            'std_msgs/msg/Header', ((), ()))[1][0][0] == 'seq' else ROS2)):
        entries += [entry, ('/own', OWN, entry[2], own(types, number)),
                    ('/words', TEXT, entry[2] + 5, types.types[TEXT](data=str(number)))]
    return [*entries, ('/words', TEXT, stamp_of(count) + 10**9, types.types[TEXT](data='after'))]


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_everything_of_ros2_is_copied_as_it_is_and_in_the_order_of_time(tmp_path, storage):
    path = write(tmp_path / 'rec', rich(with_own(Stores.ROS2_JAZZY)), storage, types=with_own(Stores.ROS2_JAZZY),
                 qos={'/words': [LATCHED], '/camera': [LATCHED]}.items(), empty=[('/silent', TEXT)])
    outcome = process(path, tmp_path / 'out', copy=True)
    messages, before = read(tmp_path / 'out'), read(path)
    assert outcome.uncopied == []
    assert sorted(message for message in messages if not message[0].endswith(ENDINGS)) == sorted(before)
    assert len(messages) == len(before) + 3 * 70
    assert [stamp for _, stamp, _ in messages] == sorted(stamp for _, stamp, _ in messages)
    for topic, connection in topics(path).items():
        copy = topics(tmp_path / 'out')[topic]
        assert (copy.msgtype, copy.digest, copy.msgcount) == (
            connection.msgtype, connection.digest, connection.msgcount)
        assert copy.msgdef.data.strip() == connection.msgdef.data.strip()
        assert copy.ext.offered_qos_profiles == connection.ext.offered_qos_profiles


def test_messages_are_written_in_the_order_of_time(tmp_path, monkeypatch):
    """Not only read so: a file that is played while it lies on a disk is read as it was written."""
    stamps = []
    put = Writer.write

    def write_and_note(self, connection, stamp, data):
        stamps.append(stamp)
        put(self, connection, stamp, data)

    path = write(tmp_path / 'rec', rich(with_own(Stores.ROS2_JAZZY)), types=with_own(Stores.ROS2_JAZZY))
    monkeypatch.setattr(Writer, 'write', write_and_note)
    process(path, tmp_path / 'out', copy=True)
    assert stamps == sorted(stamps)


@pytest.mark.parametrize('compression', [None, 'lz4'])
def test_everything_of_ros1_is_copied_as_ros2_has_it(tmp_path, compression):
    types = with_own(Stores.ROS1_NOETIC)
    path = write_ros1(tmp_path / 'rec.bag', rich(types), compression, types=types)
    outcome = process(path, tmp_path / 'out', copy=True)
    assert outcome.uncopied == []
    with AnyReader([path]) as before, AnyReader([tmp_path / 'out']) as after:
        old = [(connection.topic, stamp, before.deserialize(data, connection.msgtype))
               for connection, stamp, data in before.messages()]
        new = [(connection.topic, stamp, after.deserialize(data, connection.msgtype))
               for connection, stamp, data in after.messages() if not connection.topic.endswith(ENDINGS)]
    assert len(old) == len(new) == 2 + 3 * 70
    assert [stamp for _, stamp, _ in new] == sorted(stamp for _, stamp, _ in new)
    for one, other in zip(sorted(old, key=lambda m: m[:2]), sorted(new, key=lambda m: m[:2]), strict=True):
        assert one[:2] == other[:2]
        if one[0] == '/words':
            assert one[2].data == other[2].data
        elif one[0] == '/own':
            assert (one[2].number, one[2].name, one[2].words.data) == (
                other[2].number, other[2].name, other[2].words.data)
        else:
            assert one[2].data.tobytes() == other[2].data.tobytes()
            assert one[2].header.frame_id == other[2].header.frame_id


def test_two_publishers_of_a_topic_are_both_copied(tmp_path):
    path = tmp_path / 'rec.bag'
    with Writer1(path) as writer:
        camera = writer.add_connection('/camera', IMAGE, typestore=ROS1)
        words = [writer.add_connection('/words', TEXT, typestore=ROS1, callerid=name) for name in ('/a', '/b')]
        for number, (_, _, stamp, message) in enumerate(film(4, types=ROS1)):
            writer.write(camera, stamp, ROS1.serialize_ros1(message, IMAGE))
            writer.write(words[number % 2], stamp, ROS1.serialize_ros1(text(str(number), ROS1), TEXT))
    process(path, tmp_path / 'out', copy=True)
    copied = [ROS2.deserialize_cdr(data, TEXT).data for topic, _, data in read(tmp_path / 'out') if topic == '/words']
    assert copied == ['0', '1', '2', '3']


def test_only_the_time_that_was_asked_for_is_copied(tmp_path):
    types = with_own(Stores.ROS2_JAZZY)
    path = write(tmp_path / 'rec', rich(types), types=types)
    process(path, tmp_path / 'out', copy=True, start=1.2, end=1.4)
    stamps = [stamp for topic, stamp, _ in read(tmp_path / 'out') if topic == '/words']
    assert stamps == [stamp_of(number) + 5 for number in range(20, 40)]


def test_what_was_made_before_is_made_anew_not_copied(source, tmp_path):
    process(source, tmp_path / 'first', copy=True, job=SEGMENTS)
    process(tmp_path / 'first', tmp_path / 'second', copy=True, job=SEGMENTS)
    assert sorted(read(tmp_path / 'second')) == sorted(read(tmp_path / 'first'))


def test_types_that_ros2_has_otherwise_are_left_out_and_said(tmp_path):
    types = get_typestore(Stores.ROS1_NOETIC)
    del types.fielddefs[TEXT]
    types.register(get_types_from_msg('int32 data', TEXT))
    entries = [*film(3, types=ROS1), ('/words', TEXT, BEGIN, types.types[TEXT](data=3))]
    outcome = process(write_ros1(tmp_path / 'rec.bag', entries, types=types), tmp_path / 'out', copy=True)
    assert outcome.uncopied == ['/words']
    assert {topic for topic, _, _ in read(tmp_path / 'out')} == {'/camera', *(f'/camera/{name}' for name in ENDINGS)}


def test_types_that_a_lone_file_defines_are_copied(tmp_path):
    types = with_own(Stores.ROS2_JAZZY)
    path = lone(write(tmp_path / 'rec', rich(types, 3), types=types), tmp_path / 'lone.mcap')
    outcome = process(path, tmp_path / 'out', copy=True)
    assert outcome.uncopied == []
    assert len([topic for topic, _, _ in read(tmp_path / 'out') if topic == '/own']) == 3


def test_definitions_of_a_lone_file_give_the_hashes_of_ros2(tmp_path):
    types = with_own(Stores.ROS2_JAZZY)
    path = write(tmp_path / 'rec', rich(types, 3), types=types)
    hashes = {topic: connection.digest for topic, connection in topics(path).items()}
    process(lone(path, tmp_path / 'lone.mcap'), tmp_path / 'out', copy=True)
    copied = topics(tmp_path / 'out')
    assert {topic: copied[topic].digest for topic in hashes} == hashes


def altered(folder, statement):
    """A recording of sqlite3, of images and a text, after some SQL."""
    path = write(folder / 'rec', [*film(3), ('/words', TEXT, stamp_of(2) + 1, text('good'))], 'sqlite3')
    database = sqlite3.connect(next(path.glob('*.db3')))
    with database:
        database.execute(statement)
    database.close()
    return path


@pytest.mark.parametrize(('value', 'kind'), [("'text'", 'str'), ('4.0e300', 'float'), ('5', 'int')])
def test_what_a_table_has_in_the_place_of_messages_is_counted(tmp_path, value, kind):
    path = altered(tmp_path, f'UPDATE messages SET data = {value} WHERE id IN (2, 4)')
    outcome = process(path, tmp_path / 'out', copy=True)
    assert dict(outcome.failed) == {f'no {IMAGE}: {kind} where bytes are expected': 1}
    assert dict(outcome.spoilt) == {f'/camera: no {IMAGE}: {kind} where bytes are expected': 1,
                                    f'/words: no {TEXT}: {kind} where bytes are expected': 1}
    assert len(outcome.frames.good) == 2


@pytest.mark.parametrize('value', ["'noon'", "x'00'", '4.5'])
@pytest.mark.parametrize('row', [2, 4])
def test_messages_with_something_else_in_the_place_of_their_time_are_not_copied(tmp_path, value, row):
    path = altered(tmp_path, f'UPDATE messages SET timestamp = {value} WHERE id = {row}')
    outcome = process(path, tmp_path / 'out', copy=True)
    assert len(outcome.frames.good) == 3 - (row == 2)
    assert all(': no time: ' in name for name in outcome.spoilt)


def test_bad_messages_are_not_copied_but_counted_and_the_rest_goes_on(tmp_path):
    entries = [*film(3, types=ROS1), ('/words', TEXT, stamp_of(2), text('good', ROS1)),
               *(('/words', TEXT, stamp_of(number), b'\xff\0\0\0') for number in (0, 1))]
    outcome = process(write_ros1(tmp_path / 'rec.bag', entries), tmp_path / 'out', copy=True)
    [(reason, count)] = outcome.spoilt.items()
    assert reason.startswith('/words: no std_msgs/msg/String: ')
    assert '\n' not in reason
    assert count == 2
    copied = [ROS2.deserialize_cdr(data, TEXT).data for topic, _, data in read(tmp_path / 'out') if topic == '/words']
    assert copied == ['good']
    assert not outcome.failed


def test_a_recording_that_cannot_be_read_on_for_the_copies_is_a_sentence(tmp_path, monkeypatch):
    """The images are in other chunks, which are whole."""
    entries = [('/words', TEXT, BEGIN, text('w' * 2_000_000)), *film(3)]
    path = write(tmp_path / 'rec', entries, mode=CompressionMode.STORAGE)
    [file] = path.glob('*.mcap')
    data = bytearray(file.read_bytes())
    data[data.index(b'\x28\xb5\x2f\xfd') + 9] ^= 0xff  # in the first chunk
    file.write_bytes(data)
    with pytest.raises(RecordingError) as error:
        process(path, tmp_path / 'out', copy=True)
    assert str(path) in one_sentence(error)
    assert not (tmp_path / 'out').exists()


def test_a_stamp_that_the_new_bag_cannot_have_is_a_sentence(tmp_path):
    path = write(tmp_path / 'rec', [('/camera', IMAGE, 2**63 + number, image(picture())) for number in range(3)])
    assert [frame.stamp for frame in process(path, tmp_path / 'out').frames] == [2**63 + k for k in range(3)]
    with pytest.raises(TargetError, match='a stamp is beyond') as error:
        process(path, tmp_path / 'other', storage='sqlite3')
    one_sentence(error)


# The truth

def test_the_truth_is_compared_with(tmp_path):
    entries = []
    for number, entry in enumerate(film(40)):
        entries += [entry, ('/camera/truth', CLOUD, entry[2], cloud(found(picture(number)), number))]
    path = write(tmp_path / 'rec', entries)
    outcome = process(path, tmp_path / 'out', job=dataclasses.replace(JOB, truth=True), copy=True)
    assert all(frame.agreement[:2] == pytest.approx([1, 1], abs=1e-3) for frame in outcome.frames)
    assert len([topic for topic, _, _ in read(tmp_path / 'out') if topic == '/camera/truth']) == 40


# Targets

def old_bag(path):
    """What an earlier run made there."""
    path.mkdir(parents=True)
    (path / 'metadata.yaml').write_text('rosbag2_bagfile_information: {}')
    for name in ('old.mcap', 'old.db3', 'segments.csv'):
        (path / name).touch()


def is_old(path):
    return {entry.name for entry in path.iterdir()} == {'metadata.yaml', 'old.mcap', 'old.db3', 'segments.csv'}


@pytest.mark.parametrize('make', [Path.mkdir, old_bag])
def test_a_target_that_exists_is_refused_before_anything_is_done(source, tmp_path, counted, make):
    target = tmp_path / 'out'
    make(target)
    before = sorted(tmp_path.rglob('*'))
    with pytest.raises(TargetError, match='--overwrite') as error:
        process(source, target)
    assert str(target) in one_sentence(error)
    assert sorted(tmp_path.rglob('*')) == before
    assert counted == []


@pytest.mark.parametrize('make', [Path.mkdir, old_bag])
def test_overwriting_replaces_the_whole_target(source, result, tmp_path, make):
    target = tmp_path / 'out'
    make(target)
    process(source, target, overwrite=True)
    assert read(target) == read(result)
    assert {path.name for path in target.iterdir()} == {'metadata.yaml', 'out.mcap'}
    assert [path.name for path in tmp_path.iterdir()] == ['out']


def with_thesis(path):
    old_bag(path)
    (path / 'thesis.txt').write_text('of somebody')


def with_folder(path):
    old_bag(path)
    (path / 'more.mcap').mkdir()


def without_metadata(path):
    old_bag(path)
    (path / 'metadata.yaml').unlink()


def with_other_metadata(path):
    old_bag(path)
    (path / 'metadata.yaml').write_text('title: photographs')


def with_metadata_that_is_noise(path):
    old_bag(path)
    (path / 'metadata.yaml').write_bytes(b'\xff{')


@pytest.mark.parametrize(('make', 'reason'), [
    (with_thesis, 'thesis.txt is in it'), (with_folder, 'more.mcap is in it'),
    (without_metadata, 'it has no metadata.yaml of one'), (with_other_metadata, 'it has no metadata.yaml of one'),
    (with_metadata_that_is_noise, 'it has no metadata.yaml of one'), (Path.touch, 'it is no folder')])
@pytest.mark.parametrize('overwrite', [False, True])
def test_what_is_no_bag_is_never_replaced(source, tmp_path, counted, make, reason, overwrite):
    make(tmp_path / 'out')
    before = sorted(tmp_path.rglob('*'))
    with pytest.raises(TargetError) as error:
        process(source, tmp_path / 'out', overwrite=overwrite)
    assert one_sentence(error) == f'{tmp_path}/out exists and is not replaced, as it is no bag: {reason}'
    assert sorted(tmp_path.rglob('*')) == before
    assert counted == []


def test_what_is_put_into_the_old_one_during_the_run_is_not_lost(source, result, tmp_path, counted):
    target = tmp_path / 'out'
    old_bag(target)
    with pytest.raises(TargetError, match='thesis.txt is in it'):
        process(source, target, overwrite=True, watch=lambda *_: (target / 'thesis.txt').touch())
    (target / 'thesis.txt').unlink()
    assert is_old(target)
    counted.clear()
    process(source, target, overwrite=True, resume=True)
    assert counted == []
    assert read(target) == read(result)


@pytest.mark.parametrize('root', ['/', '//', '/..'])
def test_the_root_of_the_file_system_is_no_target(source, root):
    for work in (lambda: process(source, Path(root), overwrite=True), lambda: bag.partial_folder(Path(root))):
        with pytest.raises(TargetError) as error:
            work()
        one_sentence(error)


def test_the_old_one_stays_while_the_run_goes_on_and_when_it_fails(source, tmp_path):
    target = tmp_path / 'out'
    old_bag(target)
    with pytest.raises(Stop):
        process(source, target, watch=stopper(2), overwrite=True)
    assert is_old(target)
    (tmp_path / 'bad.mcap').write_bytes(b'noise')
    with pytest.raises(RecordingError):
        process(tmp_path / 'bad.mcap', target, overwrite=True)
    assert is_old(target)
    assert process(source, target, start=1e6, overwrite=True).error == bag.NO_IMAGES
    assert is_old(target)


def test_the_old_one_stays_when_the_new_one_cannot_be_put_in_its_place(source, tmp_path, monkeypatch):
    target = tmp_path / 'out'
    old_bag(target)
    rename = Path.rename

    def failing(self, other):
        if Path(other) == target and self.name == target.name and (self / 'metadata.yaml').exists():
            raise OSError(errno.EIO, 'Input/output error')
        return rename(self, other)

    monkeypatch.setattr(Path, 'rename', failing)
    with pytest.raises(TargetError, match='Input/output error'):
        process(source, target, overwrite=True)
    assert is_old(target)


@pytest.mark.parametrize('resume', [False, True])
def test_a_run_that_was_killed_when_it_had_replaced_the_old_one_is_in_nobodys_way(source, tmp_path, resume):
    target = tmp_path / 'out'
    for path in (target, tmp_path / 'out.partial' / 'replaced'):
        old_bag(path)
    process(source, target, overwrite=True, resume=resume)
    assert (target / 'metadata.yaml').exists()
    assert [path.name for path in tmp_path.iterdir()] == ['out']


def test_what_a_run_took_away_and_did_not_replace_is_put_back_and_kept_unless_it_may_be_replaced(source, tmp_path):
    target = tmp_path / 'out'
    old_bag(tmp_path / 'out.partial' / 'replaced')
    with pytest.raises(TargetError, match='out exists: --overwrite'):
        process(source, target)
    assert is_old(target)
    process(source, target, overwrite=True)
    assert not is_old(target)
    assert [path.name for path in tmp_path.iterdir()] == ['out']


def test_a_run_that_is_killed_between_the_two_renames_costs_nothing(source, result, tmp_path):
    target = tmp_path / 'out'
    old_bag(target)
    run_and_die(tmp_path, source, 'pass', 'Path.rename = die_before_the_second')
    assert [path.name for path in tmp_path.iterdir()] == ['out.partial']
    with pytest.raises(Stop):
        process(source, target, overwrite=True, resume=True, watch=stopper(1))
    assert is_old(target)
    process(source, target, overwrite=True, resume=True)
    assert read(target) == read(result)


def comes_up(target):
    target.mkdir()
    (target / 'mine.txt').write_text('of somebody else')


def test_a_target_that_comes_up_during_the_run_is_not_replaced(source, result, tmp_path, counted):
    target = tmp_path / 'out'
    with pytest.raises(TargetError, match='came up during the run') as error:
        process(source, target, watch=lambda done, slices, frame: (
            comes_up(target) if frame is None and done == slices else None))
    one_sentence(error)
    assert [path.name for path in target.iterdir()] == ['mine.txt']
    counted.clear()
    shutil.rmtree(target)
    process(source, target, resume=True)
    assert counted == []
    assert read(target) == read(result)


@pytest.mark.parametrize('overwrite', [False, True])
def test_a_target_that_comes_up_in_the_moment_of_the_rename_is_not_replaced(
        source, tmp_path, monkeypatch, overwrite):
    target = tmp_path / 'out'
    rename = Path.rename

    def late(self, other):
        if Path(other) == target and (self / 'metadata.yaml').exists():
            comes_up(target)
        return rename(self, other)

    monkeypatch.setattr(Path, 'rename', late)
    with pytest.raises(TargetError, match='came up during the run'):
        process(source, target, overwrite=overwrite)
    assert [path.name for path in target.iterdir()] == ['mine.txt']


def test_an_interrupt_right_after_the_old_one_was_taken_away_puts_it_back(source, tmp_path, monkeypatch):
    target = tmp_path / 'out'
    old_bag(target)
    rename = Path.rename

    def interrupted(self, other):
        rename(self, other)
        if self == target:
            raise Stop

    monkeypatch.setattr(Path, 'rename', interrupted)
    with pytest.raises(Stop):
        process(source, target, overwrite=True)
    assert is_old(target)


def test_a_link_is_followed_to_where_the_result_is_to_be(source, result, tmp_path):
    (tmp_path / 'disk').mkdir()
    (tmp_path / 'out').symlink_to(tmp_path / 'disk' / 'real')
    process(source, tmp_path / 'out')
    with pytest.raises(TargetError, match='exists'):
        process(source, tmp_path / 'out')
    process(source, tmp_path / 'out', overwrite=True)
    assert (tmp_path / 'out').is_symlink()
    assert read(tmp_path / 'disk' / 'real') == read(result)
    assert sorted(path.name for path in tmp_path.rglob('*') if not path.is_file()) == ['disk', 'out', 'real']


def test_a_link_that_leads_to_itself_is_a_sentence(source, tmp_path):
    (tmp_path / 'out').symlink_to(tmp_path / 'out')
    with pytest.raises(TargetError) as error:
        process(source, tmp_path / 'out')
    one_sentence(error)


@pytest.mark.parametrize('target', ['.', '..', '../here'])
def test_the_folder_one_is_in_is_not_replaced(source, tmp_path, monkeypatch, target):
    (tmp_path / 'here').mkdir()
    monkeypatch.chdir(tmp_path / 'here')
    with pytest.raises(TargetError, match='the folder that this is started in'):
        process(source, Path(target), overwrite=True)


def test_folders_above_the_target_are_made(source, tmp_path):
    process(source, tmp_path / 'a' / 'b' / 'out', job=SEGMENTS)
    assert [path.name for path in (tmp_path / 'a' / 'b').iterdir()] == ['out']


def test_a_name_with_points_stays(source, tmp_path):
    process(source, tmp_path / 'out.v1.2', job=SEGMENTS)
    assert (tmp_path / 'out.v1.2' / 'out.v1.2.mcap').exists()
    assert [path.name for path in tmp_path.iterdir()] == ['out.v1.2']


def test_a_place_that_cannot_be_written_to_is_a_sentence(source, tmp_path):
    (tmp_path / 'file').write_text('a file')
    with pytest.raises(TargetError, match='cannot write') as error:
        process(source, tmp_path / 'file' / 'out')
    one_sentence(error)


def test_the_input_is_never_changed(tmp_path):
    types = with_own(Stores.ROS2_JAZZY)
    sources = [write(tmp_path / 'mcap', rich(types), types=types), write(tmp_path / 'sqlite', film(40), 'sqlite3'),
               write_ros1(tmp_path / 'a.bag', film(40, types=ROS1)),
               lone(write(tmp_path / 'x', film(40), 'sqlite3'), tmp_path / 'lone.db3')]
    shutil.rmtree(tmp_path / 'x')
    before = [hashes(path) for path in sources]
    for number, path in enumerate(sources):
        process(path, tmp_path / f'out{number}', copy=True)
        with pytest.raises(Stop):
            process(path, tmp_path / f'out{number}', copy=True, overwrite=True, watch=stopper(1))
        process(path, tmp_path / f'out{number}', copy=True, overwrite=True, resume=True)
    assert [hashes(path) for path in sources] == before
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        'a.bag', 'lone.db3', 'mcap', 'out0', 'out1', 'out2', 'out3', 'sqlite']


@pytest.mark.parametrize('where', ['itself', 'above', 'file', 'link'])
def test_the_input_is_not_replaced_even_if_it_is_the_target(tmp_path, where):
    source = write(tmp_path / 'folder' / 'rec', film(3))
    target = {'itself': source, 'above': source.parent, 'file': tmp_path / 'lone.mcap', 'link': source}[where]
    if where == 'file':
        source = lone(source, target)
    if where == 'link':
        (tmp_path / 'link').symlink_to(source)
        source = tmp_path / 'link'
    before = {path.name: value for path, value in hashes(source).items()}
    with pytest.raises((TargetError, RecordingError)):
        process(source, target, overwrite=True)
    assert {path.name: value for path, value in hashes(source).items()} == before


# Going on

def test_a_run_that_was_stopped_leaves_a_journal_and_no_target(source, tmp_path):
    with pytest.raises(Stop):
        process(source, tmp_path / 'out', watch=stopper(2))
    assert [path.name for path in tmp_path.iterdir()] == ['out.partial']
    left = {path.name for path in (tmp_path / 'out.partial').iterdir()}
    assert {'lock', 'run.json', 'slices'} <= left
    assert not (tmp_path / 'out.partial' / 'bag').exists()


@pytest.mark.parametrize('after', [1, 2, 3, 4])
def test_resuming_does_only_what_is_not_done_and_gives_the_same(source, result, tmp_path, counted, after):
    job = dataclasses.replace(JOB, csv=True)
    with pytest.raises(Stop):
        process(source, tmp_path / 'out', watch=stopper(after), job=job)
    stopped = len(list((tmp_path / 'out.partial' / 'slices').iterdir()))
    counted.clear()
    outcome = process(source, tmp_path / 'out', job=job, resume=True)
    assert len(counted) == 4 - stopped
    assert stopped >= after
    assert read(tmp_path / 'out') == read(result)
    assert (tmp_path / 'out' / 'segments.csv').read_bytes() == (result / 'segments.csv').read_bytes()
    assert [frame.number for frame in outcome.frames] == list(range(100))
    assert [path.name for path in tmp_path.iterdir()] == ['out']


def test_resuming_again_and_again_comes_to_an_end(source, result, tmp_path, counted):
    for after in (1, 2, 3):
        with pytest.raises(Stop):
            process(source, tmp_path / 'out', watch=stopper(after), resume=True)
    process(source, tmp_path / 'out', resume=True)
    assert read(tmp_path / 'out') == read(result)
    assert len(counted) < 4 + 2 * 3


def said(source, target, **options):
    """What a run says of what it finds."""
    sentences = []
    process_recording(source, target, Run(JOB, **options), inline(), lambda *_: None, say=sentences.append)
    return sentences


def test_without_resume_all_is_done_again_and_it_is_said(source, result, tmp_path, counted):
    with pytest.raises(Stop):
        process(source, tmp_path / 'out', watch=stopper(2))
    done = len(list((tmp_path / 'out.partial' / 'slices').iterdir()))
    counted.clear()
    assert said(source, tmp_path / 'out') == [
        f'{done} slices that an interrupted run had done are discarded; --resume would have used them']
    assert len(counted) == 4
    assert read(tmp_path / 'out') == read(result)


@pytest.mark.parametrize('options', [{'resume': True}, {'every': 2}])
def test_nothing_is_said_to_be_discarded_where_it_is_used_or_could_not_be(source, tmp_path, options):
    with pytest.raises(Stop):
        process(source, tmp_path / 'out', watch=stopper(2))
    assert said(source, tmp_path / 'out', **options) == []


def test_resuming_what_was_never_begun_is_a_run(source, result, tmp_path):
    process(source, tmp_path / 'out', resume=True)
    assert read(tmp_path / 'out') == read(result)


def test_resuming_works_with_every_and_workers_and_copies(source, tmp_path):
    process(source, tmp_path / 'whole', every=3, copy=True)
    with pytest.raises(Stop):
        process(source, tmp_path / 'out', watch=stopper(2), every=3, copy=True)
    outcome = process(source, tmp_path / 'out', local(2), every=3, copy=True, resume=True)
    assert read(tmp_path / 'out') == read(tmp_path / 'whole')
    assert [frame.number for frame in outcome.frames] == list(range(0, 100, 3))


@pytest.mark.parametrize('change', [
    {'job': Job(Parameters(T1=9.0))}, {'job': SEGMENTS}, {'job': Job(Parameters(), np.ones((48, 64), np.uint8))},
    {'job': Job(Parameters(), csv=True)}, {'start': 0.1}, {'every': 2}, {'job': Job(Parameters(), jpeg_quality=50)}])
def test_resuming_with_other_settings_is_refused_and_costs_nothing(source, result, tmp_path, change):
    with pytest.raises(Stop):
        process(source, tmp_path / 'out', watch=stopper(2))
    before = hashes(tmp_path / 'out.partial' / 'slices')
    with pytest.raises(TargetError, match='other settings') as error:
        process(source, tmp_path / 'out', resume=True, **change)
    one_sentence(error)
    assert hashes(tmp_path / 'out.partial' / 'slices') == before
    process(source, tmp_path / 'out', resume=True)
    assert read(tmp_path / 'out') == read(result)


def test_resuming_with_another_recording_is_refused(source, tmp_path):
    path = shutil.copytree(source, tmp_path / 'rec')
    with pytest.raises(Stop):
        process(path, tmp_path / 'out', watch=stopper(2))
    shutil.rmtree(path)
    write(path, [(*entry[:3], image(picture(7))) for entry in film(100)])
    with pytest.raises(TargetError, match='another recording'):
        process(path, tmp_path / 'out', resume=True)


@pytest.mark.parametrize('way', ['relative', 'folder of links', 'link'])
def test_resuming_finds_the_recording_by_another_way_to_it(source, result, tmp_path, monkeypatch, counted, way):
    with pytest.raises(Stop):
        process(source, tmp_path / 'out', watch=stopper(2))
    counted.clear()
    monkeypatch.chdir(source.parent)
    (tmp_path / 'link').symlink_to(source)
    (tmp_path / 'links').symlink_to(source.parent)
    path = {'relative': Path(source.name), 'folder of links': tmp_path / 'links' / source.name,
            'link': tmp_path / 'link'}[way]
    process(path, tmp_path / 'out', resume=True)
    assert len(counted) <= 2
    assert read(tmp_path / 'out') == read(result)


def test_resuming_what_another_version_began_is_refused(source, tmp_path, monkeypatch):
    with pytest.raises(Stop):
        process(source, tmp_path / 'out', watch=stopper(2))
    monkeypatch.setattr(importlib.metadata, 'version', lambda _: '0.0.1')
    with pytest.raises(TargetError, match='another version'):
        process(source, tmp_path / 'out', resume=True)


def test_workers_in_another_folder_find_the_recording(source, tmp_path, monkeypatch):
    monkeypatch.chdir(source.parent)
    pool = ThreadPoolExecutor(1)

    @contextmanager
    def elsewhere():
        monkeypatch.chdir(tmp_path)
        yield pool

    process(Path(source.name), tmp_path / 'out', Workers(1, elsewhere))
    assert len(read(tmp_path / 'out')) == 300


def test_a_slice_that_was_half_written_is_done_again(source, result, tmp_path):
    with pytest.raises(Stop):
        process(source, tmp_path / 'out', watch=stopper(2))
    (tmp_path / 'out.partial' / 'slices' / '000003.new').write_bytes(b'half')
    process(source, tmp_path / 'out', resume=True)
    assert read(tmp_path / 'out') == read(result)


def run_and_die(folder, source, line, before='pass'):
    """Another Python that runs, and kills itself."""
    script = folder / 'die.py'
    script.write_text(
        'import os, signal\nfrom pathlib import Path\nfrom line_feature_node import bag\n'
        'from line_feature_node.bag import Run, process_recording\nfrom line_feature_node.core import Parameters\n'
        'from line_feature_node.slices import Job\nfrom line_feature_node.workers import local\n'
        'def die():\n    os.kill(os.getpid(), signal.SIGKILL)\n'
        'def die_before_the_second(self, other, rename=Path.rename):\n'
        '    if self.parent.name == "bag": die()\n    rename(self, other)\n'
        f'def watch(done, slices, frame):\n    {line}\n'
        f'if __name__ == "__main__":\n    {before}\n'
        f'    process_recording(Path({str(source)!r}), Path({str(folder / "out")!r}), '
        'Run(Job(Parameters()), overwrite=True), local(2), watch)\n')
    done = subprocess.run([sys.executable, script], env=ENVIRONMENT, check=False, capture_output=True, timeout=60)
    assert done.returncode == -signal.SIGKILL, done.stderr
    script.unlink()


def test_a_run_that_is_killed_leaves_no_target_and_can_be_gone_on_with(source, result, tmp_path, counted):
    run_and_die(tmp_path, source, 'if frame is None and done == 2: die()')
    assert [path.name for path in tmp_path.iterdir()] == ['out.partial']
    process(source, tmp_path / 'out', resume=True, overwrite=True)
    assert len(counted) <= 2
    assert read(tmp_path / 'out') == read(result)
    assert [path.name for path in tmp_path.iterdir()] == ['out']


def test_a_run_that_is_killed_leaves_the_old_target(source, tmp_path):
    old_bag(tmp_path / 'out')
    run_and_die(tmp_path, source, 'if frame is None and done == slices: die()')
    assert is_old(tmp_path / 'out')


def test_two_runs_at_once_are_refused_by_the_lock(source, result, tmp_path):
    refusals = []

    def watch(done, slices, frame):
        if frame is None:
            for resume in (False, True):
                with pytest.raises(TargetError, match='another run is writing') as error:
                    process(source, tmp_path / 'out', resume=resume)
                refusals.append(one_sentence(error))

    process(source, tmp_path / 'out', watch=watch)
    assert len(refusals) == 8
    assert read(tmp_path / 'out') == read(result)


@pytest.mark.parametrize('anew', [False, True])
def test_a_lock_that_was_cleared_up_meanwhile_is_none(source, tmp_path, monkeypatch, anew):
    """Another run ends between the opening of its lock and the locking, and a third may have begun."""
    lock = fcntl.flock

    def late(file, how):
        shutil.rmtree(tmp_path / 'out.partial')
        if anew:
            (tmp_path / 'out.partial').mkdir()
            (tmp_path / 'out.partial' / 'lock').touch()
        lock(file, how)

    monkeypatch.setattr(fcntl, 'flock', late)
    with pytest.raises(TargetError, match='another run is writing'):
        process(source, tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


# A full disk

abort = Writer.abort
FULL = OSError(errno.ENOSPC, 'No space left on device')


def refused(source, target, job=JOB, **options):
    with pytest.raises(TargetError, match='cannot write') as error:
        process(source, target, job=job, **options)
    assert str(target) in one_sentence(error)
    assert not target.exists()
    return str(error.value)


@pytest.mark.parametrize('place', ['write', 'add_connection', 'open', 'close'])
def test_a_disk_that_is_full_is_a_sentence(source, tmp_path, monkeypatch, place):
    def failing(*arguments, **options):
        raise FULL

    path = write(tmp_path / 'rec', film(40))
    with monkeypatch.context() as patch:
        patch.setattr(Writer, place, failing)
        assert 'No space left on device' in refused(path, tmp_path / 'out')
    process(path, tmp_path / 'out', resume=True)
    assert len(read(tmp_path / 'out')) == 120
    assert sorted(path.name for path in tmp_path.iterdir()) == ['out', 'rec']


@pytest.mark.parametrize(('place', 'name'), [(os, 'fsync'), (Path, 'rename')])
def test_a_disk_that_is_full_for_the_journal_is_a_sentence(source, result, tmp_path, monkeypatch, place, name):
    def failing(*_):
        raise FULL

    monkeypatch.setattr(place, name, failing)
    assert 'No space left on device' in refused(source, tmp_path / 'out')
    monkeypatch.undo()
    process(source, tmp_path / 'out', resume=True)
    assert read(tmp_path / 'out') == read(result)


@pytest.mark.parametrize('place', ['add_connection', 'close'])
def test_the_file_is_closed_when_the_disk_is_full(source, tmp_path, monkeypatch, place):
    def failing(*arguments, **options):
        raise FULL

    aborted = []
    monkeypatch.setattr(Writer, place, failing)
    monkeypatch.setattr(Writer, 'abort', lambda writer: aborted.append(abort(writer)))
    refused(source, tmp_path / 'out')
    assert aborted


@contextmanager
def largest_file(size):
    """No file of this process may grow larger: as with a disk that is full, for all that writes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize('size', [0, 1000, 50_000])
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_files_that_may_not_grow_are_a_sentence(source, tmp_path, storage, size):
    with largest_file(size):
        refused(source, tmp_path / 'out', storage=storage)
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_bag_that_may_not_grow_is_a_sentence(tmp_path, storage):
    path = write(tmp_path / 'rec', film(300))
    with largest_file(600_000):
        refused(path, tmp_path / 'out', storage=storage, copy=True)
    process(path, tmp_path / 'out', storage=storage, copy=True, resume=True)
    assert len(read(tmp_path / 'out')) == 4 * 300


def test_a_result_is_a_recording_like_any_other(source, tmp_path):
    process(source, tmp_path / 'out')
    assert find_recordings([tmp_path]) == [tmp_path / 'out']
    assert process(tmp_path / 'out', tmp_path / 'again', job=SEGMENTS).error == bag.NO_IMAGES
    outcome = process(tmp_path / 'out', tmp_path / 'again', job=SEGMENTS, topics=('/camera/overlay',))
    assert {frame.topic for frame in outcome.frames} == {'/camera/overlay'}


# The sample recordings

def sample(target, job=SEGMENTS, workers=None, source=CORRIDOR, **options):
    return process_recording(source, target, Run(job, end=4.0, **options), workers or inline(), lambda *_: None)


def test_every_frame_has_its_segments_under_its_stamp_and_header(tmp_path):
    outcome = sample(tmp_path / 'out')
    assert [frame.number for frame in outcome.frames] == list(range(40))
    pictures = {stamp: data for topic, stamp, data in read(CORRIDOR) if topic == TOPIC}
    made = read(tmp_path / 'out')
    assert len(made) == 40
    for topic, stamp, data in made:
        assert topic == f'{TOPIC}/segments'
        cloud = deserialize(tmp_path / 'out', data, 'sensor_msgs/msg/PointCloud2')
        image = deserialize(CORRIDOR, pictures[stamp], 'sensor_msgs/msg/CompressedImage')
        assert vars(cloud.header.stamp) == vars(image.header.stamp)
        assert cloud.header.frame_id == 'camera'
        expected = LineFeatureExtractor().extract(decode(bytes(image.data), grey=True))
        assert segments_of(cloud).tobytes() == expected.tobytes()


def test_results_of_samples_do_not_depend_on_the_workers(tmp_path):
    job = Job(Parameters())
    sample(tmp_path / 'one', job)
    sample(tmp_path / 'two', job, local(2))
    assert read(tmp_path / 'one') == read(tmp_path / 'two')
    assert {topic for topic, *_ in read(tmp_path / 'one')} == {f'{TOPIC}/{name}' for name in OUTPUTS}


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_everything_is_copied_in_the_order_of_time(tmp_path, storage):
    run = Run(SEGMENTS, storage=storage, copy=True)
    process_recording(CORRIDOR, tmp_path / 'out', run, inline(), lambda *_: None)
    made = read(tmp_path / 'out')
    assert [entry for entry in made if not entry[0].endswith('/segments')] == read(CORRIDOR)
    assert [stamp for _, stamp, _ in made] == sorted(stamp for _, stamp, _ in made)
    with Reader(tmp_path / 'out') as reader:
        assert all(connection.ext.offered_qos_profiles == [bag.QOS] for connection in reader.connections)


def test_the_table_has_a_row_for_each_segment(tmp_path):
    outcome = sample(tmp_path / 'out', Job(Parameters(), outputs=('segments',), csv=True), every=20)
    head, *rows = (tmp_path / 'out' / 'segments.csv').read_text().splitlines()
    assert head.split(',') == ['stamp', 'topic', 'frame', *SEGMENT_DTYPE.names]
    assert len(rows) == outcome.segments > 100
    assert {row.split(',')[2] for row in rows} == {'0', '20'}


def test_segments_agree_with_the_truth(tmp_path):
    outcome = sample(tmp_path / 'out', Job(Parameters(), outputs=('segments',), truth=True))
    precision, recall, *_ = np.median([frame.agreement for frame in outcome.frames], axis=0)
    assert precision > 0.8
    assert recall > 0.7


@pytest.mark.parametrize('options', [{}, {'resume': True}, {'overwrite': True}])
def test_a_folder_of_others_in_the_place_of_what_is_under_way_is_left_alone(source, tmp_path, options):
    thesis = tmp_path / 'out.partial' / 'thesis.txt'
    thesis.parent.mkdir()
    thesis.write_text('mine')
    with pytest.raises(TargetError, match='is not what an earlier run left, thesis.txt is in it') as error:
        process(source, tmp_path / 'out', **options)
    one_sentence(error)
    assert [path.name for path in tmp_path.rglob('*') if path.parent != source] == ['out.partial', 'thesis.txt']
    assert thesis.read_text() == 'mine'


def test_a_target_that_exists_is_refused_or_replaced_as_a_whole(tmp_path):
    target = tmp_path / 'out'
    old_bag(target)
    with pytest.raises(TargetError, match='--overwrite'):
        sample(target)
    assert is_old(target)
    sample(target, overwrite=True)
    assert not is_old(target)
    assert len(read(target)) == 40
    assert [path.name for path in tmp_path.iterdir()] == ['out']


@pytest.mark.parametrize('place', ['.', '..', 'inside'])
def test_the_input_is_not_replaced(place):
    with pytest.raises(TargetError, match='the recording itself, or one of the two is in the other'):
        sample(CORRIDOR / place, overwrite=True)


def interrupted(number, _, frame):
    """Stop after the first slice."""
    if frame is None:
        raise KeyboardInterrupt


def test_what_an_interrupted_run_left_is_used_and_the_result_is_the_same(tmp_path, monkeypatch):
    sample(tmp_path / 'undisturbed')
    with pytest.raises(KeyboardInterrupt):
        process_recording(CORRIDOR, tmp_path / 'out', Run(SEGMENTS, end=4.0), inline(), interrupted)
    assert not (tmp_path / 'out').exists()
    assert len(list((tmp_path / 'out.partial' / 'slices').iterdir())) == 1
    calls = []
    make = bag.process_slice
    monkeypatch.setattr(bag, 'process_slice', lambda *arguments: calls.append(1) or make(*arguments))
    sample(tmp_path / 'out', resume=True)
    assert len(calls) == 1
    assert read(tmp_path / 'out') == read(tmp_path / 'undisturbed')
    assert not (tmp_path / 'out.partial').exists()


def test_what_is_left_of_other_settings_is_not_used(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        process_recording(CORRIDOR, tmp_path / 'out', Run(SEGMENTS), inline(), interrupted)
    with pytest.raises(TargetError, match='other settings'):
        sample(tmp_path / 'out', Job(Parameters(T1=20.0), outputs=('segments',)), resume=True)


def test_a_full_disk_is_a_sentence_and_leaves_no_target(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(bag, '_write_whole', full)
    with pytest.raises(TargetError, match='No space left on device'):
        sample(tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


def test_the_input_is_not_changed_and_a_bad_one_is_a_sentence(tmp_path):
    before = hashlib.sha256((CORRIDOR / 'corridor.mcap').read_bytes()).digest()
    sample(tmp_path / 'out')
    assert hashlib.sha256((CORRIDOR / 'corridor.mcap').read_bytes()).digest() == before
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes((CORRIDOR / 'corridor.mcap').read_bytes()[:100000])
    with pytest.raises(RecordingError, match='cut.mcap: cannot be read'):
        sample(tmp_path / 'none', source=cut)
    assert not (tmp_path / 'none').exists()

import hashlib
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from line_feature_node import bag
from line_feature_node.bag import Run, TargetError, process_recording
from line_feature_node.core import SEGMENT_DTYPE, LineFeatureExtractor, Parameters
from line_feature_node.images import decode
from line_feature_node.messages import segments_of
from line_feature_node.recordings import RecordingError, deserialize
from line_feature_node.slices import OUTPUTS, Job
from line_feature_node.workers import inline, local

CORRIDOR = Path(__file__).resolve().parents[1] / 'bags' / 'corridor'
TOPIC = '/camera/image/compressed'
SEGMENTS_ONLY = Job(Parameters(), outputs=('segments',))


def process(target, job=SEGMENTS_ONLY, workers=None, source=CORRIDOR, **options):
    return process_recording(source, target, Run(job, end=4.0, **options), workers or inline(), lambda *_: None)


def messages(path):
    """Topic, stamp and bytes of everything in a recording."""
    with AnyReader([path]) as reader:
        return [(connection.topic, stamp, bytes(data)) for connection, stamp, data in reader.messages()]


def test_every_frame_has_its_segments_under_its_stamp_and_header(tmp_path):
    outcome = process(tmp_path / 'out')
    assert [frame.number for frame in outcome.frames] == list(range(40))
    pictures = {stamp: data for topic, stamp, data in messages(CORRIDOR) if topic == TOPIC}
    made = messages(tmp_path / 'out')
    assert len(made) == 40
    for topic, stamp, data in made:
        assert topic == f'{TOPIC}/segments'
        cloud = deserialize(tmp_path / 'out', data, 'sensor_msgs/msg/PointCloud2')
        image = deserialize(CORRIDOR, pictures[stamp], 'sensor_msgs/msg/CompressedImage')
        assert vars(cloud.header.stamp) == vars(image.header.stamp)
        assert cloud.header.frame_id == 'camera'
        expected = LineFeatureExtractor().extract(decode(bytes(image.data), grey=True))
        assert segments_of(cloud).tobytes() == expected.tobytes()


def test_results_do_not_depend_on_the_workers(tmp_path):
    job = Job(Parameters())
    process(tmp_path / 'one', job)
    process(tmp_path / 'two', job, local(2))
    assert messages(tmp_path / 'one') == messages(tmp_path / 'two')
    assert {topic for topic, *_ in messages(tmp_path / 'one')} == {f'{TOPIC}/{name}' for name in OUTPUTS}


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_everything_is_copied_in_the_order_of_time(tmp_path, storage):
    run = Run(SEGMENTS_ONLY, storage=storage, copy=True)
    process_recording(CORRIDOR, tmp_path / 'out', run, inline(), lambda *_: None)
    made = messages(tmp_path / 'out')
    assert [entry for entry in made if not entry[0].endswith('/segments')] == messages(CORRIDOR)
    assert [stamp for _, stamp, _ in made] == sorted(stamp for _, stamp, _ in made)
    with Reader(tmp_path / 'out') as reader:
        assert all(connection.ext.offered_qos_profiles == [bag.QOS] for connection in reader.connections)


def test_the_table_has_a_row_for_each_segment(tmp_path):
    outcome = process(tmp_path / 'out', Job(Parameters(), outputs=('segments',), csv=True), every=20)
    head, *rows = (tmp_path / 'out' / 'segments.csv').read_text().splitlines()
    assert head.split(',') == ['stamp', 'topic', 'frame', *SEGMENT_DTYPE.names]
    assert len(rows) == outcome.segments > 100
    assert {row.split(',')[2] for row in rows} == {'0', '20'}


def test_segments_agree_with_the_truth(tmp_path):
    outcome = process(tmp_path / 'out', Job(Parameters(), outputs=('segments',), truth=True))
    precision, recall, *_ = np.median([frame.agreement for frame in outcome.frames], axis=0)
    assert precision > 0.8
    assert recall > 0.7


def test_a_target_that_exists_is_refused_or_replaced_as_a_whole(tmp_path):
    target = tmp_path / 'out'
    target.mkdir()
    (target / 'old').touch()
    with pytest.raises(TargetError, match='--overwrite'):
        process(target)
    assert (target / 'old').exists()
    process(target, overwrite=True)
    assert not (target / 'old').exists()
    assert len(messages(target)) == 40
    assert [path.name for path in tmp_path.iterdir()] == ['out']


@pytest.mark.parametrize('place', ['.', '..', 'inside'])
def test_the_input_is_not_replaced(place):
    with pytest.raises(TargetError, match='the recording itself, or one of the two is in the other'):
        process(CORRIDOR / place, overwrite=True)


def interrupted(number, _, frame):
    """Stop after the first slice."""
    if frame is None:
        raise KeyboardInterrupt


def test_what_an_interrupted_run_left_is_used_and_the_result_is_the_same(tmp_path, monkeypatch):
    process(tmp_path / 'undisturbed')
    with pytest.raises(KeyboardInterrupt):
        process_recording(CORRIDOR, tmp_path / 'out', Run(SEGMENTS_ONLY, end=4.0), inline(), interrupted)
    assert not (tmp_path / 'out').exists()
    assert len(list((tmp_path / 'out.partial' / 'slices').iterdir())) == 1
    calls = []
    make = bag.process_slice
    monkeypatch.setattr(bag, 'process_slice', lambda *arguments: calls.append(1) or make(*arguments))
    process(tmp_path / 'out', resume=True)
    assert len(calls) == 1
    assert messages(tmp_path / 'out') == messages(tmp_path / 'undisturbed')
    assert not (tmp_path / 'out.partial').exists()


def test_what_is_left_of_other_settings_is_not_used(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        process_recording(CORRIDOR, tmp_path / 'out', Run(SEGMENTS_ONLY), inline(), interrupted)
    with pytest.raises(TargetError, match='other settings'):
        process(tmp_path / 'out', Job(Parameters(T1=20.0), outputs=('segments',)), resume=True)


def test_a_full_disk_is_a_sentence_and_leaves_no_target(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(bag, '_write_whole', full)
    with pytest.raises(TargetError, match='No space left on device'):
        process(tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


def test_the_input_is_not_changed_and_a_bad_one_is_a_sentence(tmp_path):
    before = hashlib.sha256((CORRIDOR / 'corridor.mcap').read_bytes()).digest()
    process(tmp_path / 'out')
    assert hashlib.sha256((CORRIDOR / 'corridor.mcap').read_bytes()).digest() == before
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes((CORRIDOR / 'corridor.mcap').read_bytes()[:100000])
    with pytest.raises(RecordingError, match='cut.mcap: cannot be read'):
        process(tmp_path / 'none', source=cut)
    assert not (tmp_path / 'none').exists()

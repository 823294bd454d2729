"""What others read of the bags that are written: readers of mcap of PyPI and npm, and what rosbag2 wants to find."""

import base64
import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from test_bag import CORRIDOR, TOPIC

from line_feature_node.bag import Run, process_recording
from line_feature_node.core import Parameters
from line_feature_node.messages import segments_of
from line_feature_node.recordings import OUTPUTS, deserialize, opened
from line_feature_node.slices import Job
from line_feature_node.workers import inline

NPM = Path(__file__).resolve().parent / 'npm'
COUNT = 10
#: What rmw makes of a policy's name, and of what a publisher can offer.
POLICIES = {
    'history': {'keep_last', 'keep_all', 'system_default'},
    'reliability': {'reliable', 'best_effort', 'system_default'},
    'durability': {'transient_local', 'volatile', 'system_default'},
    'liveliness': {'automatic', 'manual_by_topic', 'system_default'}}


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """The first second of the corridor drive, with everything, in each format."""
    folder = tmp_path_factory.mktemp('bags')
    for storage in ('mcap', 'sqlite3'):
        run = Run(Job(Parameters()), end=1.0, storage=storage, copy=True)
        process_recording(CORRIDOR, folder / storage, run, inline(), lambda *_: None)
    return folder


@pytest.fixture(params=['mcap', 'sqlite3'])
def bag(request, bags):
    return bags / request.param


@pytest.fixture
def mcap(bags):
    return bags / 'mcap' / 'mcap.mcap'


def expected(bag):
    """Topic, stamp and message of all that is in a bag, as rosbags reads it."""
    with opened(bag) as reader:
        return [(connection.topic, stamp, deserialize(bag, bytes(data), connection.msgtype))
                for connection, stamp, data in reader.messages()]


def definitions(bag):
    """What is written of types, by their names."""
    with Reader(bag) as reader:
        return {connection.msgtype: connection.msgdef.data for connection in reader.connections}


# mcap of PyPI

def test_the_python_reader_finds_schemas_and_channels(mcap):
    with mcap.open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        messages = list(reader.iter_messages())
    assert {schema.name: (schema.encoding, schema.data.decode()) for schema in summary.schemas.values()} == {
        name: ('ros2msg', text) for name, text in definitions(mcap.parent).items()}
    assert {channel.topic for channel in summary.channels.values()} == {
        TOPIC, f'{TOPIC}/truth', *(f'{TOPIC}/{name}' for name in OUTPUTS)}
    assert {channel.message_encoding for channel in summary.channels.values()} == {'cdr'}
    assert all(yaml.safe_load(channel.metadata['offered_qos_profiles'])[0]['reliability'] == 'reliable'
               for channel in summary.channels.values())
    assert summary.statistics.message_count == len(messages) == len(expected(mcap.parent)) == 5 * COUNT
    assert {chunk.compression for chunk in summary.chunk_indexes} == {'zstd'}


def test_the_python_reader_decodes_every_message(mcap):
    factory = pytest.importorskip('mcap_ros2.decoder').DecoderFactory()
    with mcap.open('rb') as file:
        found = list(make_reader(file, decoder_factories=[factory]).iter_decoded_messages())
    for (_, channel, message, decoded), (topic, stamp, known) in zip(found, expected(mcap.parent), strict=True):
        assert (channel.topic, message.log_time) == (topic, stamp)
        assert decoded.header.stamp.sec == known.header.stamp.sec
        assert decoded.header.stamp.nanosec == known.header.stamp.nanosec
        assert decoded.header.frame_id == known.header.frame_id == 'camera'
        if topic.endswith(('/segments', '/truth')):
            assert segments_of(decoded).tobytes() == segments_of(known).tobytes()
            assert len(segments_of(decoded)) > 50
        elif topic.endswith('/markers'):
            assert [(point.x, point.y) for point in decoded.points] == [(point.x, point.y) for point in known.points]
        else:
            assert decoded.format == known.format
            picture = cv2.imdecode(np.frombuffer(decoded.data, np.uint8), cv2.IMREAD_COLOR)
            assert picture.shape == (480, 640, 3)


# mcap of npm

def test_the_readers_of_foxglove_decode_every_message(mcap):
    if not shutil.which('node') or not (NPM / 'node_modules').exists():
        pytest.skip('npm install --prefix test/npm has not been run')
    done = subprocess.run(['node', NPM / 'read.mjs', mcap], capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == ''
    found = json.loads(done.stdout)
    assert found['profile'] == 'ros2'
    for entry, (topic, stamp, known) in zip(found['messages'], expected(mcap.parent), strict=True):
        assert (entry['topic'], entry['encoding'], int(entry['stamp'])) == (topic, 'cdr', stamp)
        assert entry['header'] == {'stamp': {'sec': known.header.stamp.sec, 'nanosec': known.header.stamp.nanosec},
                                   'frame_id': 'camera'}
        if topic.endswith('/markers'):
            assert entry['points'] == len(known.points)
        else:
            assert base64.b64decode(entry['data']) == bytes(known.data)
            assert entry.get('width') == getattr(known, 'width', None)


# rosbag2

def test_the_metadata_is_what_rosbag2_of_jazzy_reads(bag):
    """Its parser takes every one of these, of these types, and fails for want of one."""
    [(key, found)] = yaml.safe_load((bag / 'metadata.yaml').read_text()).items()
    assert key == 'rosbag2_bagfile_information'
    assert found['version'] == 9
    assert found['storage_identifier'] in ('mcap', 'sqlite3')
    assert found['message_count'] == 5 * COUNT == sum(
        topic['message_count'] for topic in found['topics_with_message_count'])
    assert (found['compression_format'], found['compression_mode']) == ('', '')  # chunks are no concern of rosbag2's
    [name] = found['relative_file_paths']
    assert (bag / name).exists()
    [file] = found['files']
    assert (file['path'], file['message_count']) == (name, 5 * COUNT)
    stamps = [stamp for _, stamp, _ in expected(bag)]
    for entry in (found, file):
        assert entry['starting_time'] == {'nanoseconds_since_epoch': min(stamps)}
        assert entry['duration'] == {'nanoseconds': max(stamps) - min(stamps)}
    assert not found['custom_data']
    assert isinstance(found['ros_distro'], str)


def test_qos_profiles_are_what_rosbag2_of_jazzy_reads(bag):
    found = yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    for topic in found['topics_with_message_count']:
        metadata = topic['topic_metadata']
        assert metadata['serialization_format'] == 'cdr'
        [profile] = metadata['offered_qos_profiles']  # a list since version 9, text before
        assert set(profile) == {*POLICIES, 'depth', 'deadline', 'lifespan', 'liveliness_lease_duration',
                                'avoid_ros_namespace_conventions'}
        for policy, names in POLICIES.items():
            assert profile[policy] in names
        assert profile['depth'] > 0
        assert profile['avoid_ros_namespace_conventions'] is False
        for time in ('deadline', 'lifespan', 'liveliness_lease_duration'):
            assert set(profile[time]) == {'sec', 'nsec'}


def test_hashes_of_types_are_those_of_ros(bag):
    checked = 0
    found = yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    for topic in found['topics_with_message_count']:
        name = topic['topic_metadata']['type']
        path = Path(sys.prefix, 'share', f'{name}.json')
        if path.exists():
            hashes = {entry['type_name']: entry['hash_string'] for entry in json.loads(path.read_text())['type_hashes']}
            assert topic['topic_metadata']['type_description_hash'] == hashes[name]
            checked += 1
    if not checked:
        pytest.skip('ROS 2 is not there')
    assert checked == len(found['topics_with_message_count'])

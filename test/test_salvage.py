"""Damaged recordings that become clean ones; what remains of single files is tested beside them."""

import hashlib
import json
import resource
import sys
import tracemalloc
from pathlib import Path

import pytest
import yaml
from rosbags.rosbag2 import CompressionMode
from test_cli_bag import run
from test_recordings import ROS1, contents, film, lone, stamp_of, text, write, write_ros1, write_split

from line_feature_node import bag
from line_feature_node.bag import Run, partial_folder, process_recording
from line_feature_node.core import Parameters
from line_feature_node.recordings import SALVAGED, RecordingError, opened
from line_feature_node.salvage import may_help, salvaged, was_salvaged
from line_feature_node.slices import Job
from line_feature_node.workers import inline

CORRIDOR = Path(__file__).resolve().parents[1] / 'bags' / 'corridor'
SEGMENTS_ONLY = Job(Parameters(), outputs=('segments',))


def cut(path, share=0.7):
    path.write_bytes(path.read_bytes()[:int(path.stat().st_size * share)])
    return path


def storages(folder):
    return sorted(path for path in folder.iterdir() if path.name != 'metadata.yaml')


def make(tmp_path, kind, count=40, name='rec'):
    """A recording in one file, or in a folder where it is compressed in ways of its own."""
    if kind == 'ros1':
        return write_ros1(tmp_path / f'{name}.bag', film(count, types=ROS1), 'lz4')
    storage, _, mode = kind.partition(' ')
    folder = write(tmp_path / name, film(count), storage, CompressionMode[(mode or 'none').upper()],
                   qos={'/camera': [bag.QOS]})
    return folder if mode else lone(folder, tmp_path / f'{name}.{"mcap" if storage == "mcap" else "db3"}')


@pytest.mark.parametrize('kind', [
    'ros1', 'mcap', 'sqlite3', 'mcap file', 'sqlite3 file', 'sqlite3 message', 'mcap message', 'mcap storage'])
def test_a_clean_recording_is_made_of_what_is_left(tmp_path, kind):
    source = make(tmp_path, kind, 120)
    whole = contents(source)
    with opened(source) as reader:
        [before] = reader.connections
    file = cut(source if source.is_file() else storages(source)[0], 0.8)
    content = file.read_bytes()
    assert may_help(source)
    with salvaged(source, tmp_path / 'place') as found:
        assert contents(found.path) == whole[:found.messages]
        assert 40 <= found.messages < 120
        assert (found.begin, found.until) == (stamp_of(0), stamp_of(found.messages - 1))
        with opened(found.path) as reader:
            [after] = reader.connections
        assert (after.topic, after.msgtype, after.ext) == (before.topic, before.msgtype, before.ext)
        assert after.msgdef == before.msgdef
        assert was_salvaged(tmp_path / 'place')
        assert [path.name for path in found.path.parent.iterdir()] == [found.path.name]
    assert file.read_bytes() == content
    assert not (tmp_path / 'place').exists()


def test_it_is_told_how_much_there_is_and_what_is_wrong(tmp_path):
    source = cut(make(tmp_path, 'mcap'), 0.5)
    with salvaged(source, tmp_path / 'place') as found:
        assert str(found) == (
            f'salvaged {found.messages} messages, until {(found.messages - 1) / 100:.2f} s after the first (stamp '
            f'{found.until / 1e9:.3f}): rec.mcap ends amid its messages, after {source.stat().st_size} bytes')


def test_an_index_alone_may_be_damaged(tmp_path):
    source = make(tmp_path, 'mcap')
    source.write_bytes(source.read_bytes()[:-20])
    with salvaged(source, tmp_path / 'place') as found:
        assert found.messages == 40
        assert str(found).endswith(': only its index or metadata is damaged')


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('wrong', ['cut', 'empty', 'missing', 'noise'])
def test_of_a_split_recording_the_other_parts_are_left(tmp_path, storage, wrong):
    source = write_split(tmp_path / 'rec', [film(10), film(10, first=10), film(10, first=20)], storage)
    middle = storages(source)[1]
    if wrong == 'missing':
        middle.unlink()
    elif wrong == 'noise':
        middle.write_bytes(b'\xff' * 10_000)
    else:
        cut(middle, {'cut': 0.6, 'empty': 0}[wrong])
    with salvaged(source, tmp_path / 'place') as found:
        stamps = [stamp for _, stamp, _ in contents(found.path)]
        with opened(found.path) as reader:
            assert len(reader.connections) == 1
    kept = len(stamps) - 20
    assert 2 <= kept < 10 if wrong == 'cut' else kept == 0
    assert stamps == [stamp_of(number) for number in [*range(10 + kept), *range(20, 30)]]
    assert any(middle.name in reason for reason in found.damage)


@pytest.mark.parametrize('content', [
    None, '', '{', 'a: &a [*a]', 'rosbag2_bagfile_information: 5', '\0\1\2', '!!int ""', '!!timestamp x',
    '1:' * 200 + '1.5'])
def test_parts_are_found_without_metadata(tmp_path, content):
    source = write_split(tmp_path / 'rec', [film(2, first=2 * number) for number in range(11)])
    for number, path in enumerate(storages(source)):
        path.rename(source / f'part_{10 - number}.mcap')  # 10 is after 9
    if content is None:
        (source / 'metadata.yaml').unlink()
    else:
        (source / 'metadata.yaml').write_text(content)
    with salvaged(source, tmp_path / 'place') as found:
        assert found.messages == 22
        assert contents(found.path) == sorted(contents(found.path), key=lambda message: message[1])
    assert found.damage == ('metadata.yaml cannot be read',)


def test_topics_of_all_parts_are_there(tmp_path):
    words = ('/words', 'std_msgs/msg/String', stamp_of(50), text('hello'))
    for number, entries in enumerate([film(3), [*film(3, first=3), words]]):
        lone(write(tmp_path / f'part{number}', entries), tmp_path / f'{number}.mcap')
    (tmp_path / 'rec').mkdir()
    for number in range(2):
        (tmp_path / f'{number}.mcap').rename(tmp_path / 'rec' / f'{number}.mcap')
    with salvaged(tmp_path / 'rec', tmp_path / 'place') as found:
        assert [topic for topic, *_ in contents(found.path)] == ['/camera'] * 6 + ['/words']


@pytest.mark.parametrize('content', [
    b'', b'hello', b'\x89MCAP0\r\n', b'#ROSBAG V2.0\n', b'SQLite format 3\0' + bytes(99)])
def test_of_nothing_nothing_is_left(tmp_path, content):
    source = tmp_path / 'rec.bag'
    source.write_bytes(content)
    assert not may_help(source)
    with (pytest.raises(RecordingError, match=r'rec.bag: nothing can be salvaged \(.+\)$'),
          salvaged(source, tmp_path / 'place')):
        raise AssertionError('there is something')
    assert not (tmp_path / 'place').exists()


@pytest.mark.parametrize('error', [KeyboardInterrupt, RuntimeError])
def test_it_is_cleared_up_whatever_happens(tmp_path, error):
    source = cut(make(tmp_path, 'mcap'))
    with pytest.raises(error), salvaged(source, tmp_path / 'place'):
        raise error
    assert not (tmp_path / 'place').exists()


def test_what_a_run_leaves_for_a_later_one_stays(tmp_path):
    source = cut(make(tmp_path, 'mcap'))
    with salvaged(source, tmp_path / 'place'):
        (tmp_path / 'place' / 'run.json').touch()
    assert {path.name for path in (tmp_path / 'place').iterdir()} == {SALVAGED, 'run.json'}


def test_it_is_the_same_each_time(tmp_path):
    source = cut(make(tmp_path, 'sqlite3'))
    made = []
    for _ in range(2):
        with salvaged(source, tmp_path / 'place') as found:
            made.append((found.path.name, found.path.read_bytes(), found.path.stat().st_mtime_ns))
    assert made[0] == made[1]


def test_where_it_cannot_be_written_is_a_sentence(tmp_path):
    source = cut(make(tmp_path, 'mcap'))
    (tmp_path / 'file').touch()
    with (pytest.raises(RecordingError, match=r'rec.mcap: what is left of it cannot be written to .*: '),
          salvaged(source, tmp_path / 'file' / 'place')):
        raise AssertionError('it can')


@pytest.mark.parametrize('kind', ['ros1', 'mcap'])
def test_a_full_disk_is_a_sentence(tmp_path, kind):
    source = cut(make(tmp_path, kind), 0.95)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with (pytest.raises(RecordingError, match='cannot be written to .*: File too large'),
              salvaged(source, tmp_path / 'place')):
            raise AssertionError('it can')
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not (tmp_path / 'place').exists()


@pytest.mark.parametrize('kind', ['ros1', 'mcap', 'sqlite3'])
def test_memory_does_not_grow_with_the_recording(tmp_path, kind):
    def peak(count):
        source = cut(make(tmp_path, kind, count, f'rec{count}'), 0.9)
        tracemalloc.start()
        with salvaged(source, tmp_path / 'place') as found:
            size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size, found.messages

    short, some = peak(800)
    long, many = peak(2400)
    assert many > 2.5 * some
    assert long < short + 700_000  # the index; it has a third of a megabyte, the frames have 5


def test_metadata_that_lists_a_part_that_is_missing(tmp_path):
    source = make(tmp_path, 'mcap storage')
    path = source / 'metadata.yaml'
    content = yaml.safe_load(path.read_text())
    content['rosbag2_bagfile_information']['relative_file_paths'].append('rec_1.mcap')
    path.write_text(yaml.safe_dump(content))
    with salvaged(source, tmp_path / 'place') as found:
        assert found.messages == 40
    assert found.damage == ('rec_1.mcap is missing, or no recording',)


def test_the_sentence_names_some_damages_only(tmp_path):
    source = write_split(tmp_path / 'rec', [film(3, first=3 * number) for number in range(6)])
    for path in storages(source)[1:]:
        path.unlink()
    with salvaged(source, tmp_path / 'place') as found:
        assert str(found).endswith('_3.mcap is missing, or no recording and 2 more')


# The command

def interrupted(done, slices, frame):
    """Stop after the first slice."""
    if frame is None:
        raise KeyboardInterrupt


@pytest.fixture
def broken(tmp_path):
    """The first half of the corridor drive, which was cut off."""
    path = tmp_path / 'in' / 'drive.mcap'
    path.parent.mkdir()
    path.write_bytes((CORRIDOR / 'corridor.mcap').read_bytes())
    return cut(path, 0.5)


def test_a_cut_recording_is_processed_up_to_the_cut_with_status_1(tmp_path, broken):
    before = hashlib.sha256(broken.read_bytes()).digest()
    result = run(broken, '--out', tmp_path / 'out', '--salvage', '--only-segments', '--json')
    assert result.exit_code == 1
    [line] = result.stderr.splitlines()
    assert line.startswith(f'{broken}: salvaged ')
    [summary] = json.loads(result.stdout)['recordings']
    assert summary['source'] == str(broken)
    assert summary['frames'] >= 25
    assert summary['salvaged']['messages'] - 2 * summary['frames'] in (0, -1)  # the last one may be without its truth
    assert summary['error'] == ''
    assert run(CORRIDOR, '--out', tmp_path / 'whole', '--only-segments', '--quiet').exit_code == 0
    assert contents(tmp_path / 'out') == contents(tmp_path / 'whole')[:summary['frames']]
    assert {path.name for path in tmp_path.iterdir()} == {'in', 'out', 'whole'}
    assert hashlib.sha256(broken.read_bytes()).digest() == before


def test_without_the_option_it_is_named_where_it_helps(tmp_path, broken):
    result = run(broken, '--out', tmp_path / 'out')
    assert result.exit_code == 2
    assert result.stderr == (f'{broken}: cannot be read (File end magic is invalid): --salvage processes what can '
                             f'still be read\n')
    cut(broken, 0.0001)
    assert '--salvage' not in run(broken, '--out', tmp_path / 'out').stderr
    assert '--salvage' not in run(CORRIDOR, '--out', tmp_path / 'out', '--topic', '/nothing').stderr


def test_one_that_is_damaged_in_the_middle_is_processed_without_that(tmp_path, broken):
    data = bytearray((CORRIDOR / 'corridor.mcap').read_bytes())
    frame = data.index(b'\x28\xb5\x2f\xfd', len(data) // 2)  # of zstd
    data[frame:frame + 8] = bytes(8)
    broken.write_bytes(data)
    result = run(broken, '--out', tmp_path / 'out', '--salvage', '--only-segments')
    assert result.exit_code == 1
    assert 'drive.mcap has a damaged chunk' in result.stderr
    assert 40 <= len(contents(tmp_path / 'out')) < len(contents(CORRIDOR)) // 2


def test_what_ros_1_had_not_finished_is_salvaged(tmp_path):
    path = make(tmp_path, 'ros1').rename(tmp_path / 'drive.bag.active')
    cut(path, 0.8)
    assert '--salvage' in run(path, '--out', tmp_path / 'out').stderr
    result = run(path, '--out', tmp_path / 'out', '--salvage', '--only-segments', '--quiet')
    assert result.exit_code == 1
    assert 20 <= len(contents(tmp_path / 'out')) < 40


@pytest.mark.parametrize('name', ['none.bag', 'none.mcap', 'none.db3', 'none.txt'])
def test_of_what_cannot_be_salvaged_it_is_said_what_is_wrong(tmp_path, name):
    (tmp_path / name).write_bytes(b'version https://git-lfs.github.com/spec/v1')
    results = [run(tmp_path / name, '--out', tmp_path / 'out', *more) for more in ((), ('--salvage',))]
    assert [result.exit_code for result in results] == [2, 2]
    assert results[0].stderr == results[1].stderr
    assert '--salvage' not in results[0].stderr


def test_good_recordings_are_processed_as_ever(tmp_path):
    result = run(CORRIDOR, '--out', tmp_path / 'out', '--end', 0.5, '--salvage', '--json')
    assert (result.exit_code, result.stderr) == (0, '')
    assert 'salvaged' not in json.loads(result.stdout)['recordings'][0]


@pytest.mark.parametrize(('options', 'reason'), [
    (('--topic', '/nothing'), "no images on '/nothing', but on /camera/image/compressed"), ((), 'exists: --overwrite')])
def test_what_goes_wrong_after_salvaging_is_told_of_the_recording(tmp_path, broken, options, reason):
    if not options:
        (tmp_path / 'out').mkdir()
    result = run(broken, '--out', tmp_path / 'out', '--salvage', *options)
    assert result.exit_code == 2
    [line] = result.stderr.splitlines()
    assert reason in line
    assert 'partial' not in line
    assert not (tmp_path / 'out.partial').exists()


def test_a_run_over_what_was_salvaged_is_resumed(tmp_path, broken, monkeypatch):
    broken.write_bytes((CORRIDOR / 'corridor.mcap').read_bytes())
    cut(broken, 0.9)
    out = tmp_path / 'out'
    with pytest.raises(KeyboardInterrupt), salvaged(broken, partial_folder(out)) as found:
        process_recording(broken, out, Run(SEGMENTS_ONLY), inline(), interrupted, reading=found.path)
    assert was_salvaged(partial_folder(out))
    assert [path.name for path in (partial_folder(out) / 'slices').iterdir()] == ['000000']
    calls = []
    make = bag.process_slice
    monkeypatch.setattr(bag, 'process_slice', lambda *arguments: calls.append(1) or make(*arguments))
    result = run(broken, '--out', out, '--salvage', '--resume', '--only-segments', '--quiet')
    assert result.exit_code == 1
    assert len(calls) == 1
    monkeypatch.undo()
    assert run(CORRIDOR, '--out', tmp_path / 'whole', '--only-segments', '--quiet').exit_code == 0
    found = contents(out)
    assert found == contents(tmp_path / 'whole')[:len(found)]


def test_without_the_package_for_it_the_rest_works(tmp_path, broken, monkeypatch):
    monkeypatch.delitem(sys.modules, 'line_feature_node.salvage')
    monkeypatch.delitem(sys.modules, 'line_feature_node.remains')
    monkeypatch.setitem(sys.modules, 'mcap.reader', None)
    result = run(broken, '--out', tmp_path / 'out', '--salvage')
    assert result.exit_code == 2
    assert result.stderr.startswith('--salvage needs the Python packages lz4, mcap and zstandard')
    assert run(CORRIDOR, '--out', tmp_path / 'out', '--end', 0.1, '--quiet').exit_code == 0

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from test_recordings import BEGIN, IMAGE, ROS1, ROS2, TEXT, film, image, picture, stamp_of, text, write, write_ros1
from test_slices import CLOUD, cloud, found
from test_workers import alive, until
from typer.testing import CliRunner

from line_feature_node.cli import app
from line_feature_node.core import LineFeatureExtractor, Parameters
from line_feature_node.messages import segments_of

BAGS = Path(__file__).resolve().parents[1] / 'bags'
CONFIG = Path(__file__).resolve().parents[1] / 'config'


def run(*arguments):
    return CliRunner().invoke(app, ['bag', *map(str, arguments)], env={'COLUMNS': '200'})


def test_recordings_of_a_folder_become_bags_of_a_folder(tmp_path):
    result = run(BAGS, '--out', tmp_path / 'out', '--end', 1, '--only-segments', '--truth', '--json')
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)['recordings']
    assert [Path(entry['target']).name for entry in summary] == ['corridor', 'road']
    for entry in summary:
        assert entry['frames'] == entry['truth']['frames'] == 10
        assert entry['failed'] == {}
        assert (tmp_path / 'out' / Path(entry['target']).name / 'metadata.yaml').exists()


def test_quiet_says_nothing(tmp_path):
    result = run(BAGS / 'corridor', '--out', tmp_path / 'out', '--end', 0.5, '--quiet')
    assert (result.exit_code, result.output) == (0, '')


@pytest.mark.parametrize(('name', 'content', 'reason'), [
    ('empty.bag', b'', 'the file is empty'), ('lfs.bag', b'version https://git-lfs', 'cannot be read'),
    ('text.txt', b'hello', 'not a recording'), ('cut.mcap', b'\x89MCAP0\r\n' + bytes(50), 'cannot be read')])
def test_what_cannot_be_read_is_a_sentence_and_status_2(tmp_path, name, content, reason):
    (tmp_path / name).write_bytes(content)
    result = run(tmp_path / name, '--out', tmp_path / 'out')
    assert result.exit_code == 2
    [line] = result.stderr.splitlines()
    assert line.startswith(f'{tmp_path}/{name}: {reason}')
    assert not (tmp_path / 'out').exists()


def test_one_that_cannot_be_read_is_status_1_and_the_others_go_on(tmp_path):
    (tmp_path / 'in').mkdir()
    (tmp_path / 'in' / 'empty.bag').touch()
    (tmp_path / 'in' / 'corridor').symlink_to(BAGS / 'corridor')
    result = run(tmp_path / 'in', '--out', tmp_path / 'out', '--end', 0.3)
    assert result.exit_code == 1
    assert (tmp_path / 'out' / 'corridor').exists()


def test_a_topic_that_is_not_there_is_told_with_those_that_are(tmp_path):
    result = run(BAGS / 'corridor', '--out', tmp_path / 'out', '--topic', '/nothing')
    assert result.exit_code == 2
    assert "no images on '/nothing', but on /camera/image/compressed" in result.stderr


@pytest.mark.parametrize(('number', 'status'), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_leave_no_target(tmp_path, number, status):
    code = 'from line_feature_node.command import main; main()'
    command = [sys.executable, '-c', code, 'bag', str(BAGS), '--out', str(tmp_path / 'out')]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 60
    while not list(tmp_path.glob('out/*.partial')) and time.monotonic() < end:
        time.sleep(0.01)
    process.send_signal(number)
    errors = process.communicate(timeout=60)[1]
    assert process.returncode == status
    assert '--resume goes on from there' in errors
    assert 'Traceback' not in errors
    assert not (tmp_path / 'out' / 'corridor').exists()


def test_a_page_about_the_run_is_written(tmp_path):
    report = tmp_path / 'report.html'
    arguments = (BAGS, '--out', tmp_path / 'out', '--end', 0.5, '--quiet', '--profile', 'corridor', '--report', report)
    result = run(*arguments)
    assert (result.exit_code, result.output) == (0, '')
    page = report.read_text(encoding='utf-8')
    assert 'Line features of 2 recordings' in page
    assert 'Profile corridor' in page
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stderr.strip() == f'the report {report} exists: --overwrite replaces it'


def test_a_page_that_cannot_be_written_is_told_before_the_work(tmp_path):
    result = run(BAGS, '--out', tmp_path / 'out', '--report', tmp_path / 'none' / 'report.html')
    assert result.exit_code == 2
    assert result.stderr.strip() == (
        f'cannot write {tmp_path}/none/report.html: there is no folder {tmp_path}/none')
    assert not (tmp_path / 'out').exists()


def test_a_page_tells_of_recordings_that_cannot_be_read(tmp_path):
    (tmp_path / 'empty.bag').touch()
    result = run(tmp_path / 'empty.bag', '--out', tmp_path / 'out', '--report', tmp_path / 'report.html')
    assert result.exit_code == 2
    assert 'the file is empty' in (tmp_path / 'report.html').read_text(encoding='utf-8')


# Recordings that the tests write

class Command:
    """The command as a process, with process group of its own, as a terminal starts it."""

    def __init__(self, *arguments):
        self.process = subprocess.Popen(
            [sys.executable, '-c', 'from line_feature_node.command import main; main()', 'bag', *map(str, arguments)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)

    def end(self, number):
        """Status and standard error after a signal to the whole group."""
        os.killpg(self.process.pid, number)
        errors = self.process.communicate(timeout=60)[1]
        return self.process.returncode, errors


def until_there(path, command):
    until(lambda: path.exists() or command.process.poll() is not None, str(path))
    assert command.process.poll() is None, command.process.communicate()


@pytest.fixture
def recording(tmp_path):
    return write(tmp_path / 'rec', film(10))


@pytest.fixture(scope='module')
def long(tmp_path_factory):
    """A recording that takes a while."""
    data = bytes(ROS2.serialize_cdr(image(picture()), IMAGE))
    entries = [('/camera', IMAGE, stamp_of(number), data) for number in range(3000)]
    return write(tmp_path_factory.mktemp('long') / 'rec', entries)


def count_of(path):
    with AnyReader([path]) as reader:
        return {connection.topic: connection.msgcount for connection in reader.connections}


def one_line(result):
    """Standard error, one line without a traceback."""
    assert result.stdout == ''
    [line] = result.stderr.splitlines()
    assert 'Traceback' not in line
    return line


def usage(result):
    """The last line of standard error where options are wrong."""
    assert result.exit_code == 2
    assert isinstance(result.exception, SystemExit)
    return result.stderr.splitlines()[-1]


def test_one_recording_becomes_the_bag_that_is_named(recording, tmp_path):
    result = run(recording, '--out', tmp_path / 'out')
    assert (result.exit_code, result.stderr) == (0, '')
    assert count_of(tmp_path / 'out') == dict.fromkeys(('/camera/segments', '/camera/markers', '/camera/overlay'), 10)
    assert '10' in result.stdout
    assert 'written to' in result.stdout


def test_the_table_has_the_whole_path_of_the_new_bag(recording, tmp_path):
    target = tmp_path / ('a-long-name-' * 8) / ('and-another-' * 8)
    assert str(target) in run(recording, '--out', target).stdout.replace('\n', '')


def test_all_options_reach_the_run(tmp_path):
    entries = sorted([*film(20, '/left'), *film(20, '/right', offset=7), ('/words', TEXT, BEGIN, text('a'))],
                     key=lambda entry: entry[2])
    path = write(tmp_path / 'rec', entries)
    result = run(path, '--out', tmp_path / 'out', '--topic', '/left', '--start', 0.05, '--end', 0.15, '--every', 2,
                 '--storage', 'sqlite3', '--csv', '--only-segments', '--workers', 1, '--copy', '--json')
    assert result.exit_code == 0, result.output
    assert (tmp_path / 'out' / 'out.db3').exists()
    assert (tmp_path / 'out' / 'segments.csv').exists()
    assert count_of(tmp_path / 'out') == {'/left': 10, '/right': 10, '/words': 0, '/left/segments': 5}


def test_a_truth_that_is_missing_is_said(tmp_path):
    path = write(tmp_path / 'rec', film(3))
    result = run(path, '--out', tmp_path / 'out', '--truth', '--only-segments', '--json')
    assert result.exit_code == 0
    assert result.stderr == f'{path}: no frame had a truth on /camera/truth\n'


def test_of_frames_that_all_fail_no_truth_is_missed(tmp_path):
    path = write(tmp_path / 'rec', [(*entry[:3], image(picture(), encoding='mono12')) for entry in film(3)])
    assert 'truth' not in run(path, '--out', tmp_path / 'out', '--truth').stderr


def test_two_topics_are_named_one_by_one(tmp_path):
    path = write(tmp_path / 'rec', [*film(3, '/a'), *film(3, '/b'), *film(3, '/c')])
    assert run(path, '--out', tmp_path / 'out', '--topic', '/a', '--topic', '/c', '--only-segments').exit_code == 0
    assert set(count_of(tmp_path / 'out')) == {'/a/segments', '/c/segments'}


def test_json_is_one_line_and_nothing_else(recording, tmp_path):
    result = run(recording, '--out', tmp_path / 'out', '--json')
    assert result.stderr == ''
    assert result.stdout.count('\n') == 1
    [summary] = json.loads(result.stdout)['recordings']
    assert summary == {'source': str(recording), 'target': str(tmp_path / 'out'), 'error': '', 'frames': 10,
                       'failed': {}, 'segments': sum(len(found(picture(number))) for number in range(10))}


def test_json_says_what_failed(tmp_path):
    entries = film(4)
    entries[1] = (*entries[1][:3], image(picture(), step=3))
    (tmp_path / 'in').mkdir()
    write(tmp_path / 'in' / 'rec', entries)
    (tmp_path / 'in' / 'bad.bag').write_bytes(b'noise')
    result = run(tmp_path / 'in', '--out', tmp_path / 'out', '--json')
    assert result.exit_code == 1
    bad, good = json.loads(result.stdout)['recordings']
    assert bad['error'].startswith('cannot be read')
    assert (good['frames'], sum(good['failed'].values()), good['error']) == (4, 1, '')
    assert len(result.stderr.splitlines()) == 2


@pytest.mark.parametrize('name', ['empty.bag', 'words', 'rec'])
def test_json_has_no_path_before_the_error(recording, tmp_path, monkeypatch, name):
    (tmp_path / 'empty.bag').touch()
    write(tmp_path / 'words', [('/words', TEXT, BEGIN, text('a'))])
    monkeypatch.chdir(tmp_path)
    result = run(name, '--out', 'out', '--topic', '/nothing', '--json')
    [summary] = json.loads(result.stdout)['recordings']
    assert name not in summary['error']
    assert result.stderr == f'{name}: {summary["error"]}\n'


def strict(data):
    """JSON without what only Python takes for it."""
    def refuse(constant):
        raise ValueError(constant)

    return json.loads(data, parse_constant=refuse)


def test_json_without_any_agreement_is_json(tmp_path):
    truth = ('/camera/truth', CLOUD, BEGIN, cloud(found(picture())))
    path = write(tmp_path / 'rec', [('/camera', IMAGE, BEGIN, image(np.full((48, 64), 90, np.uint8))), truth])
    result = run(path, '--out', tmp_path / 'out', '--truth', '--json')
    assert result.stderr == ''
    assert strict(result.stdout)['recordings'][0]['truth']['recall'] == 0


def test_quiet_is_silent_unless_something_is_wrong(tmp_path):
    entries = film(4)
    entries[1] = (*entries[1][:3], image(picture(), step=3))
    result = run(write(tmp_path / 'rec', entries), '--out', tmp_path / 'out', '--quiet')
    assert result.exit_code == 1
    assert 'rec: 1 frames failed: step is 3' in one_line(result)


def test_a_recording_without_images_is_status_0_with_a_sentence(tmp_path):
    path = write(tmp_path / 'rec', [('/words', TEXT, BEGIN, text('a'))])
    result = run(path, '--out', tmp_path / 'out')
    assert result.exit_code == 0
    assert one_line(result) == f'{path}: no images to be processed'
    assert not (tmp_path / 'out').exists()


def test_status_2_when_every_frame_fails(tmp_path):
    path = write(tmp_path / 'rec', [(*entry[:3], image(picture(), encoding='mono12')) for entry in film(3)])
    result = run(path, '--out', tmp_path / 'out')
    assert result.exit_code == 2
    assert 'rec: 3 frames failed: unknown encoding' in result.stderr
    assert 'Traceback' not in result.output


def test_status_2_when_nothing_is_there(tmp_path):
    (tmp_path / 'folder').mkdir()
    for name in ('missing', 'folder'):
        result = run(tmp_path / name, '--out', tmp_path / 'out')
        assert result.exit_code == 2
        assert str(tmp_path / name) in one_line(result)


def test_a_target_that_exists_is_refused_and_replaced_on_request(recording, tmp_path):
    write(tmp_path / 'out', film(2))
    result = run(recording, '--out', tmp_path / 'out')
    assert result.exit_code == 2
    assert f'{tmp_path}/out exists: --overwrite replaces it' in one_line(result)
    assert count_of(tmp_path / 'out') == {'/camera': 2}
    assert run(recording, '--out', tmp_path / 'out', '--overwrite').exit_code == 0
    assert count_of(tmp_path / 'out')['/camera/segments'] == 10


@pytest.mark.parametrize('salvage', [(), ('--salvage',)])
def test_the_root_of_the_file_system_is_no_target(recording, salvage):
    result = run(recording, '--out', '/', '--overwrite', *salvage)
    assert result.exit_code == 2
    assert one_line(result) == f'{recording}: / is the root of the file system: name a new folder in it'


def test_a_folder_of_one_recording_makes_a_folder_of_one_bag(tmp_path):
    write(tmp_path / 'in' / 'rec', film(2))
    result = run(tmp_path / 'in', '--out', tmp_path / 'out', '--only-segments')
    assert result.exit_code == 0, result.output
    assert [path.name for path in (tmp_path / 'out').iterdir()] == ['rec']
    assert count_of(tmp_path / 'out' / 'rec') == {'/camera/segments': 2}


def test_a_place_that_cannot_be_written_to_is_a_sentence(recording, tmp_path):
    (tmp_path / 'file').touch()
    result = run(recording, '--out', tmp_path / 'file' / 'out')
    assert result.exit_code == 2
    assert 'cannot write' in one_line(result)


def test_names_that_come_twice_are_numbered(tmp_path):
    for folder, count in (('a', 3), ('b', 4)):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / 'rec', film(count))
    write_ros1(tmp_path / 'b' / 'rec.bag', film(5, types=ROS1))
    result = run(tmp_path / 'a', tmp_path / 'b', '--out', tmp_path / 'out', '--only-segments')
    assert result.exit_code == 0, result.output
    counts = {path.name: count_of(path)['/camera/segments'] for path in (tmp_path / 'out').iterdir()}
    assert counts == {'rec': 3, 'rec-2': 4, 'rec-3': 5}


def test_names_with_numbers_do_not_meet_others(tmp_path):
    for place in ('a/rec', 'b/rec', 'c/rec-2'):
        (tmp_path / place).parent.mkdir()
        write(tmp_path / place, film(3))
    result = run(*(tmp_path / folder for folder in 'abc'), '--out', tmp_path / 'out', '--only-segments')
    assert result.exit_code == 0, result.output
    assert len(list((tmp_path / 'out').iterdir())) == 3


@pytest.mark.parametrize(('arguments', 'sentence'), [
    (['--storage', 'tape'], 'storage must be mcap or sqlite3'), (['--every', 0], '--every'),
    (['--workers', 0], '--workers'), (['--start', -1], '--start'), (['--start', 'nan'], '--start'),
    (['--end', 'nan'], '--end'), (['--start', 'soon'], '--start'),
    (['--T1', 2], 'T2 must be less than T1'), (['--profile', 'fast'], 'profile must be one of'),
    (['--params-file', 'missing.yaml'], 'missing.yaml: No such file'), (['--nonsense'], 'No such option')])
def test_options_that_make_no_sense_are_a_sentence(recording, tmp_path, arguments, sentence):
    assert sentence in usage(run(recording, '--out', tmp_path / 'out', *arguments))
    assert [path.name for path in tmp_path.iterdir()] == ['rec']


@pytest.mark.parametrize('arguments', [('', '--out', 'out'), ('rec', '', '--out', 'out'), ('rec', '--out', '')])
def test_a_path_that_is_empty_is_a_sentence(recording, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob('*'))
    assert "a path is expected, got ''" in usage(run(*arguments))
    assert sorted(tmp_path.rglob('*')) == before


def test_a_mask_that_cannot_be_read_is_a_sentence(recording, tmp_path):
    result = run(recording, '--out', tmp_path / 'out', '--mask-file', tmp_path / 'none.png')
    assert result.exit_code == 2
    assert 'none.png: No such file' in one_line(result)


def test_the_mask_hides_edges(recording, tmp_path):
    cv2.imwrite(str(tmp_path / 'mask.png'), np.zeros((48, 64), np.uint8))
    result = run(recording, '--out', tmp_path / 'out', '--mask-file', tmp_path / 'mask.png', '--json')
    assert json.loads(result.stdout)['recordings'][0]['segments'] == 0


@pytest.mark.parametrize(('times', 'sentence'), [
    (('--start', 1, '--end', 1), 'end must be later than start, got 1 s and 1 s'),
    (('--start', 'inf'), 'end must be later than start, got inf s and inf s'),
    (('--end', '0'), 'end must be later than start, got 0 s and 0 s')])
def test_times_that_make_no_sense_are_a_sentence(recording, tmp_path, times, sentence):
    result = run(recording, '--out', tmp_path / 'out', *times)
    assert (result.exit_code, one_line(result)) == (2, sentence)
    assert [path.name for path in tmp_path.iterdir()] == ['rec']


def test_times_beyond_the_recording_mean_its_end(recording, tmp_path):
    result = run(recording, '--out', tmp_path / 'out', '--end', 'inf', '--json')
    assert json.loads(result.stdout)['recordings'][0]['frames'] == 10
    result = run(recording, '--out', tmp_path / 'none', '--start', '1e300')
    assert (result.exit_code, one_line(result)) == (0, f'{recording}: no images to be processed')


def test_copies_that_cannot_be_made_are_status_1(tmp_path):
    entries = [*film(3, types=ROS1), ('/words', TEXT, BEGIN, b'\xff\0\0\0')]
    path = write_ros1(tmp_path / 'rec.bag', entries)
    result = run(path, '--out', tmp_path / 'out', '--copy', '--json')
    assert result.exit_code == 1
    [line] = result.stderr.splitlines()
    assert line.startswith(f'{path}: 1 messages not copied: /words: no std_msgs/msg/String: ')
    [summary] = json.loads(result.stdout)['recordings']
    assert list(summary['uncopied']['messages'].values()) == [1]


def test_the_folder_one_is_in_is_refused_as_target(recording, tmp_path, monkeypatch):
    (tmp_path / 'here').mkdir()
    monkeypatch.chdir(tmp_path / 'here')
    result = run(recording, '--out', '.', '--overwrite')
    assert result.exit_code == 2
    assert one_line(result) == f'{recording}: . is the folder that this is started in, or above it: name a new one'


def segments_in(path):
    with AnyReader([path]) as reader:
        return [segments_of(reader.deserialize(data, CLOUD)) for connection, _, data in reader.messages()
                if connection.topic.endswith('/segments')]


def test_the_file_of_a_node_is_accepted_as_it_is(recording, tmp_path):
    result = run(recording, '--out', tmp_path / 'out', '--params-file', CONFIG / 'corridor.yaml')
    assert (result.exit_code, result.stderr) == (0, '')
    extractor = LineFeatureExtractor(Parameters.profile('corridor'))
    for number, segments in enumerate(segments_in(tmp_path / 'out')):
        assert segments.tobytes() == extractor.extract(picture(number)).tobytes()


def test_options_win_over_the_file_and_unknown_names_are_warned_of(recording, tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text('/front/**: {ros__parameters: {profile: paper, T1: 20, T2: 9, lazy: false, T3: 4}}')
    result = run(recording, '--out', tmp_path / 'out', '--params-file', path, '--T2', 4)
    assert result.exit_code == 0
    assert one_line_of_errors(result) == f"{path}: there is no parameter 'T3', what it is set to has no effect"
    extractor = LineFeatureExtractor(Parameters.profile('paper', T1=20.0, T2=4.0))
    for number, segments in enumerate(segments_in(tmp_path / 'out')):
        assert segments.tobytes() == extractor.extract(picture(number)).tobytes()


def one_line_of_errors(result):
    [line] = result.stderr.splitlines()
    return line


def masks_all(path):
    cv2.imwrite(str(path), np.zeros((48, 64), np.uint8))


@pytest.mark.parametrize('place', ['whole', 'relative'])
def test_what_the_file_says_of_the_mask_holds_here_too(recording, tmp_path, monkeypatch, place):
    """Relative to where one is, as the node takes it."""
    (tmp_path / 'here').mkdir()
    masks_all(tmp_path / 'here' / 'mask.png')
    monkeypatch.chdir(tmp_path / 'here')
    path = tmp_path / 'some.yaml'
    folder = tmp_path / 'here' if place == 'whole' else '.'
    path.write_text(f'/**: {{ros__parameters: {{mask_file: {folder}/mask.png}}}}')
    result = run(recording, '--out', tmp_path / 'out', '--params-file', path, '--json')
    assert json.loads(result.stdout)['recordings'][0]['segments'] == 0


def test_the_mask_of_the_command_wins_over_that_of_the_file(recording, tmp_path):
    masks_all(tmp_path / 'all.png')
    cv2.imwrite(str(tmp_path / 'none.png'), np.full((48, 64), 255, np.uint8))
    path = tmp_path / 'some.yaml'
    path.write_text(f'/**: {{ros__parameters: {{mask_file: {tmp_path}/all.png}}}}')
    result = run(recording, '--out', tmp_path / 'out', '--params-file', path, '--mask-file', tmp_path / 'none.png',
                 '--json')
    assert json.loads(result.stdout)['recordings'][0]['segments'] > 0


@pytest.mark.parametrize(('setting', 'sentence'), [
    ('mask_file: nowhere.png', 'nowhere.png: No such file'), ('jpeg_quality: 500', 'jpeg_quality'),
    ('jpeg_quality: fine', 'jpeg_quality')])
def test_what_the_file_says_and_cannot_be_is_a_sentence(recording, tmp_path, setting, sentence):
    path = tmp_path / 'some.yaml'
    path.write_text(f'/**: {{ros__parameters: {{{setting}}}}}')
    result = run(recording, '--out', tmp_path / 'out', '--params-file', path)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert 'Traceback' not in result.output
    assert not (tmp_path / 'out').exists()


def test_what_the_file_says_of_the_quality_of_overlays_holds_here_too(recording, tmp_path):
    sizes = []
    for quality in (5, 95):
        path = tmp_path / f'{quality}.yaml'
        path.write_text(f'/**: {{ros__parameters: {{jpeg_quality: {quality}}}}}')
        run(recording, '--out', tmp_path / str(quality), '--params-file', path)
        with AnyReader([tmp_path / str(quality)]) as reader:
            sizes.append(sum(len(data) for connection, _, data in reader.messages()
                             if connection.topic == '/camera/overlay'))
    assert sizes[0] < sizes[1] / 2


# A full disk

#: Mounts a file system of a size at a folder, for a command and what it starts, and lists what is left in it.
SMALL = 'mount -t tmpfs -o size="$0" none "$1" && cd "$1" && shift && "$@"; status=$?; ls; exit $status'


def on_small_disk(size, folder, *command):
    """Run a command in a folder that is a file system of that size, which nobody else sees."""
    folder.mkdir(exist_ok=True)
    return subprocess.run(['unshare', '-rm', 'sh', '-c', SMALL, size, folder, *map(str, command)],
                          check=False, capture_output=True, text=True, timeout=120)


@pytest.fixture
def small_disk(tmp_path):
    if not shutil.which('unshare') or on_small_disk('64k', tmp_path / 'disk', 'true').returncode:
        pytest.skip('no file system can be mounted here')
    return tmp_path / 'disk'


@pytest.mark.parametrize('size', ['16k', '300k', '700k', '800k'])
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_disk_that_is_really_full_is_one_line_and_no_target(small_disk, tmp_path, storage, size):
    path = write(tmp_path / 'rec', film(200))
    code = 'from line_feature_node.command import main; main()'
    result = on_small_disk(size, small_disk, sys.executable, '-c', code, 'bag', path, '--out', 'out', '--copy',
                           '--storage', storage, '--workers', 1)
    assert result.returncode == 2
    [line] = result.stderr.splitlines()
    assert line.startswith(f'{path}: cannot write out: ')
    assert line.endswith(('No space left on device', 'database or disk is full'))
    assert result.stdout.splitlines() == ['out.partial']


# Signals

def children_of(pid):
    return [child for task in Path(f'/proc/{pid}/task').iterdir() for child in (task / 'children').read_text().split()]


def command_of(pid):
    with contextlib.suppress(OSError):
        return Path(f'/proc/{pid}/cmdline').read_bytes()
    return b''


@pytest.mark.parametrize(('number', 'status'), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_in_the_midst_end_cleanly_and_the_run_can_be_gone_on_with(long, tmp_path, number, status):
    command = Command(long, '--out', tmp_path / 'out', '--only-segments', '--workers', 1)
    until_there(tmp_path / 'out.partial' / 'slices' / '000002', command)
    children = children_of(command.process.pid)
    if number == signal.SIGTERM:
        command.process.send_signal(number)
        errors = command.process.communicate(timeout=60)[1]
    else:
        _, errors = command.end(number)
    assert command.process.returncode == status
    assert errors == f'{number.name}: ended before all was done; --resume goes on from there\n'
    assert [path.name for path in tmp_path.iterdir()] == ['out.partial']
    assert children
    until(lambda: not any(map(alive, children)), 'end of the workers', 5)
    done = sum(not path.name.endswith('.new') for path in (tmp_path / 'out.partial' / 'slices').iterdir())
    assert 3 <= done < 94
    shutil.copytree(tmp_path / 'out.partial', tmp_path / 'again.partial')
    again = run(long, '--out', tmp_path / 'again', '--only-segments', '--quiet', '--workers', 1)
    assert one_line(again) == (
        f'{long}: {done} slices that an interrupted run had done are discarded; --resume would have used them')
    assert run(long, '--out', tmp_path / 'out', '--only-segments', '--resume', '--quiet', '--workers', 1).exit_code == 0
    assert count_of(tmp_path / 'out') == {'/camera/segments': 3000}


@pytest.mark.parametrize('delay', [0, 0.1, 0.2, 0.4])
def test_interrupts_while_workers_start_are_one_line(long, tmp_path, delay):
    command = Command(long, '--out', tmp_path / 'out', '--only-segments', '--workers', 2)
    until(lambda: b'spawn_main' in b''.join(map(command_of, children_of(command.process.pid))), 'a worker')
    time.sleep(delay)
    os.killpg(command.process.pid, signal.SIGINT)
    time.sleep(0.02)
    status, errors = command.end(signal.SIGINT)
    assert status == 130
    assert errors == 'SIGINT: ended before all was done; --resume goes on from there\n'


def test_scripts_get_their_line_when_nothing_is_there_to_be_read(tmp_path):
    result = run(tmp_path / 'none', '--out', tmp_path / 'out', '--json')
    assert result.exit_code == 2
    assert json.loads(result.stdout) == {
        'recordings': [], 'error': f'{tmp_path / "none"}: no such file or folder'}

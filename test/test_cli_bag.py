import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from line_feature_node.cli import app

BAGS = Path(__file__).resolve().parents[1] / 'bags'


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
    code = 'from line_feature_node.cli import main; main()'
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

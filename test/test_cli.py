import csv
import importlib.metadata
import os
import sys

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from line_feature_node.cli import app
from line_feature_node.core import SEGMENT_DTYPE, Parameters, extract

STEP = np.repeat(np.where(np.arange(120) < 60, 40, 200).astype(np.uint8)[None], 90, 0)


@pytest.fixture
def run(tmp_path):
    def run(*arguments):
        return CliRunner().invoke(app, [*map(str, arguments)], env={'COLUMNS': '200'})

    return run


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / 'photo.png'
    cv2.imwrite(str(path), STEP)
    return path


def test_refinement_is_turned_off_by_an_option(run, photo, tmp_path):
    """Of segments that are not refined the last fields are not known."""
    result = run('image', photo, '--out', tmp_path / 'out', '--no-refine')
    assert result.exit_code == 0, result.output
    with (tmp_path / 'out' / 'photo-segments.csv').open() as file:
        assert {row['sigma_theta'] for row in csv.DictReader(file)} == {'nan'}
    assert run('image', photo, '--out', tmp_path / 'again', '--refine').exit_code == 0
    assert '--refine / --no-refine' in run('image', '--help').output
    assert 'default --roi 0 0 1 1' in run('image', '--help').output


def test_an_image_gives_an_overlay_and_a_table(run, photo, tmp_path):
    result = run('image', photo, '--out', tmp_path / 'out')
    assert result.exit_code == 0, result.output
    assert '120x90, 1 segments, 1 after linking or refinement' in result.output
    assert 'normalization' in result.output
    overlay = cv2.imread(str(tmp_path / 'out' / 'photo-overlay.png'))
    assert overlay.shape == (90, 120, 3)
    with (tmp_path / 'out' / 'photo-segments.csv').open() as file:
        rows = list(csv.DictReader(file))
    [segment] = extract(STEP)
    assert list(rows[0]) == list(SEGMENT_DTYPE.names)
    for name in SEGMENT_DTYPE.names:
        np.testing.assert_array_equal(np.float32(rows[0][name]), np.float32(segment[name]))


def test_a_bad_file_is_one_line_and_the_others_go_on(run, photo, tmp_path):
    (tmp_path / 'text.jpg').write_text('no picture')
    result = run('image', tmp_path / 'missing.png', tmp_path / 'text.jpg', photo, '--out', tmp_path / 'out')
    assert result.exit_code == 1
    assert f'{tmp_path}/missing.png: No such file or directory\n' in result.stderr
    assert f'{tmp_path}/text.jpg: not an image that OpenCV can decode\n' in result.stderr
    assert len(result.stderr.splitlines()) == 2
    assert (tmp_path / 'out' / 'photo-overlay.png').exists()
    assert '1 of 3 files done' in result.stdout


def test_status_2_when_nothing_could_be_read(run, tmp_path):
    result = run('image', tmp_path / 'missing.png', '--out', tmp_path / 'out')
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1


def test_a_folder_stands_for_its_images(run, photo, tmp_path):
    (tmp_path / 'notes.txt').write_text('not an image')
    cv2.imwrite(str(tmp_path / 'photo.bmp'), STEP)
    result = run('image', tmp_path, '--out', tmp_path / 'out')
    assert result.exit_code == 0
    assert '2 of 2 files done' in result.output
    assert {path.name for path in (tmp_path / 'out').glob('*.csv')} == {'photo-segments.csv', 'photo-2-segments.csv'}


def test_an_empty_folder_is_said(run, tmp_path):
    result = run('image', tmp_path, '--out', tmp_path / 'out')
    assert result.exit_code == 2
    assert 'no image files' in result.stderr


def test_hundreds_of_files_keep_their_order(run, photo, tmp_path):
    result = run('image', *[photo] * 150, '--out', tmp_path / 'out')
    assert result.exit_code == 0
    assert '150 of 150 files done' in result.output
    assert len(list((tmp_path / 'out').glob('*.csv'))) == 150


def test_every_parameter_is_an_option_and_reaches_the_extractor(run, photo, tmp_path):
    output = run('image', '--help').output
    for name in Parameters.specs():
        assert f'--{name} ' in output
    result = run('image', photo, '--out', tmp_path / 'out', '--T1', 900, '--profile', 'paper')
    assert '0 segments, 0 after linking or refinement' in result.output


@pytest.mark.parametrize(('arguments', 'sentence'), [
    (['--T1', '2'], 'T2 must be less than T1'),
    (['--n', '-1'], 'n must be 0 to 10000'),
    (['--operator', 'canny'], 'operator must be one of deriche, sobel'),
    (['--profile', 'fast'], 'profile must be one of default, paper'),
    (['--T3', '1'], 'No such option'),
])
def test_a_bad_parameter_is_one_sentence(run, photo, tmp_path, arguments, sentence):
    result = run('image', photo, '--out', tmp_path / 'out', *arguments)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert 'Traceback' not in result.output
    assert not (tmp_path / 'out').exists()


def test_a_folder_that_cannot_be_made_is_one_sentence(run, photo):
    result = run('image', photo, '--out', photo / 'out')
    assert result.exit_code == 2
    assert result.stderr.startswith('cannot write to ')


def test_sixteen_bits_and_colour(run, tmp_path):
    cv2.imwrite(str(tmp_path / 'deep.png'), STEP.astype(np.uint16) * 16)
    cv2.imwrite(str(tmp_path / 'colour.png'), np.dstack([STEP] * 3))
    result = run('image', tmp_path, '--out', tmp_path / 'out', '--intensity_max', 4080)
    assert '1 of 2' not in result.output
    assert 'deep.png: 120x90, 1 segments' in result.output
    overlay = cv2.imread(str(tmp_path / 'out' / 'deep-overlay.png'))
    assert overlay[50, 30].max() < overlay[50, 100].min()


def test_stages_are_written_beside_the_overlay(run, photo, tmp_path):
    result = run('image', photo, '--out', tmp_path / 'out', '--stages')
    assert result.exit_code == 0, result.output
    names = sorted(path.name for path in (tmp_path / 'out').glob('photo-*'))
    assert len(names) == 11
    assert {'photo-1-edges.png', 'photo-5-blobs.png', 'photo-stages.png'} <= set(names)


def test_compare_draws_the_panels_of_an_image(run, photo, tmp_path):
    result = run('compare', photo, '--out', tmp_path / 'out')
    assert result.exit_code == 0, result.output
    assert cv2.imread(str(tmp_path / 'out' / 'photo-section3.png')) is not None
    assert 'suppression' not in result.output


def test_compare_of_a_bad_file_is_one_sentence(run, tmp_path):
    result = run('compare', tmp_path / 'missing.png', '--out', tmp_path / 'out')
    assert result.exit_code == 2
    assert result.stderr == f'{tmp_path}/missing.png: No such file or directory\n'


def test_compare_of_a_file_that_is_no_image_is_one_sentence(run, tmp_path):
    (tmp_path / 'text.png').write_text('no picture')
    result = run('compare', tmp_path / 'text.png', '--out', tmp_path / 'out')
    assert result.exit_code == 2
    assert result.stderr == f'{tmp_path}/text.png: not an image that OpenCV can decode\n'


def test_compare_says_where_it_cannot_write(run, photo):
    result = run('compare', photo, '--out', photo / 'out')
    assert result.exit_code == 2
    assert result.stderr == f'cannot write to {photo}/out: Not a directory\n'


def test_compare_without_an_image_measures_each_combination(run, tmp_path):
    result = run('compare', '--out', tmp_path / 'out')
    assert result.exit_code == 0, result.output
    assert (tmp_path / 'out' / 'corridor-section3.png').exists()
    rows = [[cell.strip() for cell in line.split('│')[1:-1]] for line in result.output.splitlines() if '│' in line]
    assert {row[0] for row in rows} == set(Parameters.specs()['thinning'].choices)
    assert {row[1] for row in rows} == set(Parameters.specs()['orientation'].choices)
    for *_, precision, recall, angle, offset in rows:
        assert 0 < float(precision) <= 1
        assert 0 < float(recall) <= 1
        assert angle.endswith(' deg')
        assert offset.endswith(' px')


def test_the_demo_without_ros_says_where_it_cannot_write(run, photo, monkeypatch):
    monkeypatch.setitem(sys.modules, 'line_feature_node.demo', None)
    result = run('demo', '--out', photo / 'out')
    assert result.exit_code == 2
    assert result.stderr.splitlines()[1:] == [f'cannot write to {photo}/out: Not a directory']


def test_the_demo_without_ros_says_where_nothing_of_the_truth_was_found(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'line_feature_node.demo', None)
    result = run('demo', '--out', tmp_path, '--T1', 900, '--T2', 899)
    assert result.exit_code == 0, result.output
    assert 'against the ground truth: nothing of it was found' in result.output


def test_the_demo_without_ros_ends_where_its_picture_cannot_be_read(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'line_feature_node.demo', None)
    result = run('demo', '--out', tmp_path, '--intensity_min', 300)
    assert result.exit_code == 2
    assert 'intensity_min must be less than intensity_max' in result.stderr


def test_the_demo_without_ros_makes_do_with_a_picture(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'line_feature_node.demo', None)
    result = run('demo', '--out', tmp_path, '--profile', 'paper')
    assert result.exit_code == 0, result.output
    assert (tmp_path / 'corridor-overlay.png').exists()
    assert result.output.splitlines()[-1] == f'overlay: {tmp_path}/corridor-overlay.png'
    recall = float(result.output.split('recall ')[1].split(',')[0])
    assert recall > 0.6
    assert result.stderr.startswith('ROS 2 is not there')
    assert len(result.stderr.splitlines()) == 1


def test_files_that_cannot_be_are_reported_and_the_others_go_on(run, photo, tmp_path):
    (tmp_path / 'empty').mkdir()
    folder = tmp_path / 'folder'
    folder.mkdir()
    (folder / 'broken.png').write_bytes(b'')
    os.mkfifo(tmp_path / 'pipe')
    long = tmp_path / ('x' * 300)
    result = run('image', tmp_path / 'empty', folder, tmp_path / 'pipe', long, photo, '--out', tmp_path / 'out')
    assert result.exit_code == 1
    lines = result.stderr.splitlines()
    assert [line.rsplit(': ', 1)[1] for line in lines] == [
        'no image files in this folder', 'expected a compressed image', 'not a regular file', 'File name too long']
    assert '1 of 5 files done' in result.stdout


def test_a_target_that_cannot_be_written_is_named(run, photo, tmp_path):
    (tmp_path / 'out' / 'photo-overlay.png').mkdir(parents=True)
    result = run('image', photo, '--out', tmp_path / 'out')
    assert result.exit_code == 2
    assert result.stderr == f'{photo}: cannot write {tmp_path}/out/photo-overlay.png: Is a directory\n'


def test_overlays_of_an_earlier_run_are_not_images_of_the_next(run, photo, tmp_path):
    for _ in range(2):
        result = run('image', tmp_path, '--out', tmp_path)
        assert '1 of 1 files done' in result.output


def test_a_picture_that_uses_little_of_its_range_gives_a_hint(run, tmp_path):
    cv2.imwrite(str(tmp_path / 'deep.png'), STEP.astype(np.uint16))
    result = run('image', tmp_path / 'deep.png', '--out', tmp_path / 'out')
    assert result.exit_code == 0
    assert 'nothing found; pixels from 40 to 200 are 0.2% of the range' in result.stderr


def test_brackets_in_a_name_are_no_markup(run, photo, tmp_path):
    result = run('image', photo, '--out', tmp_path / '[red]x')
    assert f'are in {tmp_path}/[red]x' in result.output


def test_version(run):
    assert run('--version').output.strip() == importlib.metadata.version('line_feature_node')

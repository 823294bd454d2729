import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from line_feature_node.core import LineFeatureExtractor, Parameters
from line_feature_node.files import FOLDERS, MOST_BYTES, displayable, find_images, process, read_mask

STEP = np.repeat(np.where(np.arange(120) < 60, 40, 200).astype(np.uint8)[None], 90, 0)


def test_outcomes_come_in_order_with_any_number_of_workers(tmp_path):
    paths = []
    for k in range(12):
        paths.append(tmp_path / f'{k}.png')
        cv2.imwrite(str(paths[-1]), STEP[:, :70 + k])
    runs = [list(process(paths, tmp_path / f'out{workers}', Parameters(), workers=workers)) for workers in (1, 4)]
    for one, four in zip(*runs, strict=True):
        assert one.path == four.path
        assert one.segments.tobytes() == four.segments.tobytes()
        assert one.table.read_bytes() == four.table.read_bytes()
    assert [outcome.width for outcome in runs[0]] == [70 + k for k in range(12)]


def test_a_broken_first_file_does_not_spoil_the_times_of_the_second(tmp_path):
    """The first frame takes new memory, and loads the kernels: it is extracted twice, whichever file it comes from."""
    (tmp_path / 'a.png').write_bytes(b'junk')
    cv2.imwrite(str(tmp_path / 'b.png'), STEP)
    calls = []
    original = LineFeatureExtractor.extract

    def counted(self, image):
        calls.append(image.shape)
        return original(self, image)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LineFeatureExtractor, 'extract', counted)
        list(process([tmp_path / 'a.png', *[tmp_path / 'b.png'] * 2], tmp_path / 'out', Parameters(), workers=1))
    assert len(calls) == 3


def test_results_of_files_with_one_name_do_not_overwrite_each_other(tmp_path):
    for folder in ('a', 'b'):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / 'x.png'), STEP)
    cv2.imwrite(str(tmp_path / 'x-2.png'), STEP)
    paths = [tmp_path / 'a' / 'x.png', tmp_path / 'b' / 'x.png', tmp_path / 'x-2.png']
    tables = [outcome.table for outcome in process(paths, tmp_path / 'out', Parameters())]
    assert len(set(tables)) == 3
    assert all(table.exists() for table in tables)


def test_a_type_of_pixel_that_is_not_supported_is_said(tmp_path):
    cv2.imwrite(str(tmp_path / 'signed.tiff'), STEP.astype(np.int16))
    [outcome] = process([tmp_path / 'signed.tiff'], tmp_path, Parameters())
    assert outcome.error == 'image must be uint8, uint16 or float32, got int16'


def test_folders_are_read_in_order_and_files_taken_as_they_are(tmp_path):
    for name in ('b.png', 'a.jpg', 'c.txt'):
        (tmp_path / name).write_bytes(cv2.imencode(Path(name).suffix, STEP)[1].tobytes() if 'txt' not in name else b'x')
    assert [path.name for path in find_images([tmp_path])] == ['a.jpg', 'b.png']
    assert find_images([Path('nowhere.png')]) == [Path('nowhere.png')]


@pytest.mark.parametrize(('image', 'parameters', 'expected'), [
    (np.array([[0, 255]], np.uint8), Parameters(), [0, 255]),
    (np.array([[0, 65535]], np.uint16), Parameters(), [0, 255]),
    (np.array([[0, 4095, 9000]], np.uint16), Parameters(intensity_max=4095), [0, 255, 255]),
    (np.array([[-1, 0, 1]], np.float32), Parameters(intensity_min=-1, intensity_max=1), [0, 127, 255]),
])
def test_displayable_shows_the_range_of_intensities(image, parameters, expected):
    assert displayable(image, parameters)[0].tolist() == expected


@pytest.fixture
def masks(tmp_path):
    """Folders with a mask each, and one with links to them."""
    for name in ('mine', 'mine-too', 'theirs'):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / 'mask.png'), STEP)
    (tmp_path / 'links').mkdir()
    for name in ('mine', 'theirs'):
        (tmp_path / 'links' / f'{name}.png').symlink_to(tmp_path / name / 'mask.png')
    return tmp_path


@pytest.mark.parametrize('folders', [None, '', ':'])
def test_masks_may_be_anywhere_unless_the_operator_names_folders(masks, monkeypatch, folders):
    monkeypatch.delenv(FOLDERS, raising=False)
    if folders is not None:
        monkeypatch.setenv(FOLDERS, folders)
    assert read_mask(masks / 'theirs' / 'mask.png').shape == STEP.shape


@pytest.mark.parametrize(('path', 'allowed'), [
    ('mine/mask.png', True), ('links/mine.png', True), ('theirs/../mine/mask.png', True), ('theirs/mask.png', False),
    ('mine-too/mask.png', False), ('mine/../theirs/mask.png', False), ('links/theirs.png', False),
    ('theirs/none.png', False)])
def test_masks_are_read_from_the_folders_of_the_operator_alone(masks, monkeypatch, path, allowed):
    monkeypatch.setenv(FOLDERS, f'{masks / "none"}:{masks / "mine"}')
    if allowed:
        assert read_mask(masks / path).shape == STEP.shape
        return
    with pytest.raises(ValueError, match=f'^mask_file {masks / path}: is {masks}/.*, and {FOLDERS} allows files in '
                                         f'{masks / "none"}, {masks / "mine"} only$'):
        read_mask(masks / path)


def test_folders_of_the_operator_may_be_links_and_relative(masks, monkeypatch):
    (masks / 'link').symlink_to(masks / 'mine')
    monkeypatch.chdir(masks)
    for folder in ('link', 'mine', '.'):
        monkeypatch.setenv(FOLDERS, folder)
        assert read_mask(Path('mine/mask.png')).shape == STEP.shape


def test_what_may_have_no_end_is_not_read(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'large').touch()
    os.truncate(tmp_path / 'large', MOST_BYTES + 1)
    for path, reason in ((Path('/dev/zero'), 'not a regular file'), (tmp_path / 'pipe', 'not a regular file'),
                         (tmp_path, 'not a regular file'), (tmp_path / 'large', '1073741825 bytes: expected')):
        with pytest.raises(ValueError, match=f'mask_file {path}: {reason}'):
            read_mask(path)
    [outcome] = process([tmp_path / 'large'], tmp_path / 'out', Parameters())
    assert outcome.error == '1073741825 bytes: expected 1073741824 at most'

from pathlib import Path

import cv2
import numpy as np
import pytest

from line_feature_node.core import LineFeatureExtractor, Parameters
from line_feature_node.files import displayable, find_images, process

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

import numpy as np
import pytest

from line_feature_node.core import LineFeatureExtractor, Parameters
from line_feature_node.figures import CODE_COLOURS, hues, scaled, sheet, stage_pictures

STEP = np.repeat(np.where(np.arange(120) < 60, 40, 200).astype(np.uint8)[None], 90, 0)


@pytest.fixture(scope='module')
def stages():
    return LineFeatureExtractor(Parameters.paper()).stages(STEP)


def test_every_step_has_its_picture_of_one_size(stages):
    pictures = stage_pictures(STEP, stages)
    assert list(pictures) == ['image', 'edges', 'chains', 'codes-before', 'codes-after', 'blobs', 'segments-unlinked',
                              'segments']
    assert {picture.shape for picture in pictures.values()} == {(90 * 8, 120 * 8, 3)}


def test_a_vertical_step_is_one_column_in_the_colour_of_code_1(stages):
    codes = stage_pictures(STEP, stages)['codes-after'][::8, ::8]
    columns = np.flatnonzero(codes.any((0, 2)))
    assert columns.tolist() == [59]
    assert np.all(codes[:, 59] == CODE_COLOURS[1])


def test_segments_are_drawn_in_the_middle_of_the_enlarged_pixels(stages):
    picture = stage_pictures(STEP, stages)['segments'].max(-1)
    weight = picture[360].astype(float)
    assert (weight @ np.arange(960)) / weight.sum() == pytest.approx(59 * 8 + 3.5, abs=0.6)


def test_blank_images_have_black_pictures():
    blank = np.full((30, 40), 90, np.uint8)
    pictures = stage_pictures(blank, LineFeatureExtractor().stages(blank))
    assert not any(picture.any() for name, picture in pictures.items() if name != 'image')


def test_hues_differ_between_neighbours():
    colours = hues(np.arange(8)).astype(int)
    assert np.abs(np.diff(colours, axis=0)).sum(1).min() > 60
    assert hues(np.arange(0)).shape == (0, 3)


def test_scaling_keeps_pixel_centres(stages):
    [segment] = scaled(stages.segments, 3)
    assert segment['x'] == pytest.approx(59 * 3 + 1)


def test_a_sheet_has_all_pictures_in_rows():
    pictures = {name: np.full((50, 80, 3), value, np.uint8) for name, value in zip('abc', (60, 120, 180), strict=True)}
    result = sheet(pictures, columns=2)
    assert result.shape == (2 * (50 + 26 + 4), 2 * 84, 3)
    for value in (60, 120, 180):
        assert (result == value).all(-1).sum() >= 50 * 80

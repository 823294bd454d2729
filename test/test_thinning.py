import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from line_feature_node.core import LineFeatureExtractor, Parameters, extract
from line_feature_node.core.edges import OPEN, STRONG
from line_feature_node.core.thinning import connected, thin

BOTH = pytest.mark.parametrize('profile', ['default', 'paper'])
BAR = np.pad(np.full((6, 60), 1 | OPEN | STRONG, np.uint8), 12)


def picture(seed: int = 0) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    image = np.full((120, 160), 90, np.uint8)
    for _ in range(5):
        corners = rng.uniform((0, 0), (160, 120), (3, 2)).astype(np.int32)
        cv2.fillPoly(image, [corners], int(rng.integers(0, 255)))
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)


def test_weak_edges_stay_only_beside_strong_ones():
    marks = np.zeros((8, 16), np.uint8)
    marks[2, 2:6] = 3
    marks[3, 6] = 2 | OPEN | STRONG
    marks[6, 9:13] = 3
    expected = np.zeros((8, 16), np.uint8)
    expected[2, 2:6] = expected[3, 6] = 1
    np.testing.assert_array_equal(connected(marks), expected)


def test_no_marks_no_edges():
    assert not connected(np.zeros((8, 16), np.uint8)).any()


def test_a_thick_bar_becomes_a_line_along_its_middle():
    marks = BAR.copy()
    thin(marks)
    rows, columns = np.nonzero(marks)
    middle = rows[(columns > 20) & (columns < 64)]
    assert set(middle) <= {14, 15}
    assert len(middle) == 43
    assert np.all(marks[marks != 0] == BAR.max())


@pytest.mark.parametrize('seed', range(4))
def test_thinning_keeps_what_hangs_together_and_nothing_thick(seed):
    """As many parts and holes as before, and no square of four left but at crossings."""
    marks = np.zeros((90, 96), np.uint8)
    for x1, y1, x2, y2 in np.random.default_rng(seed).integers(8, 82, (6, 4)).tolist():
        cv2.line(marks, (x1, y1), (x2, y2), 1 | OPEN | STRONG, 5)
    before = (marks != 0).astype(np.uint8)
    thin(marks)
    after = (marks != 0).astype(np.uint8)
    assert np.all(after <= before)
    assert cv2.connectedComponents(after)[0] == cv2.connectedComponents(before)[0]
    holes = [cv2.connectedComponents(1 - marked, connectivity=4)[0] for marked in (before, after)]
    assert holes[0] == holes[1]
    squares = cv2.erode(after, np.ones((2, 2), np.uint8)).sum()
    assert squares < 0.02 * after.sum()


@BOTH
@pytest.mark.parametrize('seed', range(3))
def test_thick_edges_hold_what_suppression_leaves(profile, seed):
    """The same thresholds: hysteresis alone has every pixel that stays when non-maxima are taken away first."""
    thick, thinned = (LineFeatureExtractor(Parameters.profile(profile, thinning=way)).stages(picture(seed))
                      for way in ('none', 'suppression'))
    assert np.all((thinned.edges != 0) <= (thick.edges != 0))
    assert (thick.edges != 0).sum() > 2 * (thinned.edges != 0).sum()


@BOTH
def test_thick_edges_have_no_chains_and_blobs_of_all_pixels(profile):
    stages = LineFeatureExtractor(Parameters.profile(profile, thinning='none')).stages(picture())
    assert stages.chain_offsets.tolist() == [0]
    assert (stages.chain_directions == 255).all()
    assert len(stages.blob_pixels) == (stages.edges != 0).sum() > 0
    np.testing.assert_array_equal(stages.codes_before, stages.codes_after)
    for code in (1, 2, 3, 4):
        count = cv2.connectedComponents((stages.edges == code).astype(np.uint8))[0] - 1
        assert (stages.blobs['dir'][stages.blobs['select']] == code).sum() == count


@BOTH
@pytest.mark.parametrize('thinning', ['none', 'morphological'])
@pytest.mark.parametrize('shape', [(1, 1), (1, 9), (9, 1), (40, 50)])
def test_any_size_and_blank_images(profile, thinning, shape):
    assert len(extract(np.full(shape, 77, np.uint8), thinning=thinning, profile=profile)) == 0
    noise = np.random.default_rng(0).integers(0, 255, shape, np.uint8)
    found = extract(noise, thinning=thinning, profile=profile)
    assert np.all(found['x1'] >= -0.5)


@BOTH
def test_morphological_edges_are_chained_and_thin(profile):
    stages = LineFeatureExtractor(Parameters.profile(profile, thinning='morphological')).stages(picture())
    assert len(stages.chain_offsets) > 2
    squares = cv2.erode((stages.candidates != 0).astype(np.uint8), np.ones((2, 2), np.uint8)).sum()
    assert squares < 0.05 * (stages.candidates != 0).sum()

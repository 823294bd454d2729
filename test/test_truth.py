import numpy as np
import pytest

from line_feature_node.truth import compare

LINE = np.array([[10.0, 10.0, 110.0, 10.0]])
NONE = np.zeros((0, 4))


def test_the_truth_agrees_with_itself():
    result = compare(LINE, LINE)
    assert (result.precision, result.recall, result.angle, result.offset) == (1, 1, 0, 0)


def test_direction_of_a_segment_does_not_matter():
    assert compare(LINE[:, [2, 3, 0, 1]], LINE) == compare(LINE, LINE)


def test_half_found():
    result = compare(np.array([[10.0, 10.0, 60.0, 10.0]]), LINE)
    assert result.precision == pytest.approx(1)
    assert result.recall == pytest.approx(0.5)


def test_two_segments_on_one_line_cover_it_once():
    both = np.array([[10.0, 10.0, 90.0, 10.0], [30.0, 11.0, 110.0, 11.0]])
    assert compare(both, LINE).recall == pytest.approx(1)


@pytest.mark.parametrize(('shift', 'found'), [(1.9, 1), (2.1, 0)])
def test_distance_limit(shift, found):
    assert compare(LINE + [0, shift, 0, shift], LINE).recall == pytest.approx(found)


@pytest.mark.parametrize(('degrees', 'found'), [(2.8, True), (3.2, False)])
def test_angle_limit_and_error(degrees, found):
    half = 20 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    turned = np.array([[*(np.array([60, 10]) - half), *(np.array([60, 10]) + half)]])
    result = compare(turned, LINE)
    assert (result.recall > 0) == found
    if found:
        assert np.degrees(result.angle) == pytest.approx(degrees)


def test_what_lies_on_weak_edges_does_not_count_against():
    elsewhere = LINE + [0, 50, 0, 50]
    assert compare(np.vstack([LINE, elsewhere]), LINE).precision == pytest.approx(0.5)
    assert compare(np.vstack([LINE, elsewhere]), LINE, elsewhere).precision == pytest.approx(1)


def test_nothing_found_and_nothing_to_find():
    assert compare(NONE, LINE).recall == 0
    assert np.isnan(compare(NONE, LINE).precision)
    assert np.isnan(compare(LINE, NONE).recall)
    assert compare(LINE, NONE).precision == 0

"""Refined segments lie where the edges are, tell how well that is known, and are there for edges alone."""

import base64
import math
import os
import subprocess
import sys
import zlib
from collections.abc import Callable
from functools import cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from test_pipeline import half_plane, scene

from line_feature_node.core import SEGMENT_DTYPE, LineFeatureExtractor, end_points, extract
from line_feature_node.core.refinement import (
    COUNT_COLUMNS,
    KEY_SHIFT,
    KEYS,
    NORM_BIN,
    NORM_BINS,
    RAREST,
    RIDGE_DTYPE,
    claim,
    claimed,
    count_norms,
    leave,
    rank_norms,
    strongest_first,
    within,
)

Image = npt.NDArray[Any]
Segments = npt.NDArray[np.void]
#: Known of refined segments only.
FIELDS = ('sigma_theta', 'sigma_offset', 'contrast', 'polarity', 'log_nfa')


def rendered(
    inside: Callable[[Image, Image], Image], height: int, width: int, samples: int = 8,
) -> npt.NDArray[np.float64]:
    """Share of each pixel's area that is inside."""
    places = (np.arange(samples) + 0.5) / samples - 0.5
    rows, columns = ((np.arange(size)[:, None] + places).reshape(-1) for size in (height, width))
    found = inside(columns[None, :], rows[:, None])
    return np.broadcast_to(found, (height * samples, width * samples)).reshape(
        height, samples, width, samples).mean((1, 3))


def picture(level: Any, sigma: float = 0.0, seed: int = 0) -> npt.NDArray[np.uint8]:
    """Grey levels with noise, as a camera rounds them."""
    level = np.asarray(level)
    noise = np.random.default_rng(seed).normal(0, sigma, level.shape) if sigma else 0
    return np.clip(np.round(level + noise), 0, 255).astype(np.uint8)


def direction(degrees: float) -> tuple[float, float]:
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


def bar(degrees: float, length: float, thickness: float, size: int = 120, centre: float = 60.3) -> Image:
    """Share of each pixel that is in a rectangle."""
    cos, sin = direction(degrees)
    return rendered(lambda x, y: (abs((x - centre) * cos + (y - centre) * sin) < length / 2)
                    & (abs((y - centre) * cos - (x - centre) * sin) < thickness / 2), size, size)


def bar_corners(degrees: float, length: float, thickness: float, centre: float = 60.3) -> Image:
    cos, sin = direction(degrees)
    along, across = np.array([cos, sin]) * length / 2, np.array([-sin, cos]) * thickness / 2
    return centre + np.array([-along - across, along - across, along + across, -along + across])


def same(first: Segments, second: Segments) -> bool:
    """Byte for byte."""
    return first.dtype == second.dtype and first.tobytes() == second.tobytes()


def offset_of(segment: Any, degrees: float, x: float, y: float) -> float:
    """Of a segment's mid-point from the line through a point, along its normal (-sin, cos)."""
    cos, sin = direction(degrees)
    return float((segment['y'] - y) * cos - (segment['x'] - x) * sin)


def turn_of(segment: Any, degrees: float) -> float:
    """Of a segment from an orientation, in radians."""
    return float((segment['theta'] - math.radians(degrees) + math.pi / 2) % math.pi - math.pi / 2)


# Where a line is in the picture

NOT_FINITE = [math.nan, math.inf, -math.inf, 1e300]


@pytest.mark.parametrize(('slope', 'intercept', 'first', 'last', 'expected'), [
    (0.0, 10.0, 2.5, 7.5, (3, 7)), (0.0, 10.0, -50.0, 1e9, (0, 99)), (0.0, 49.5, 0.0, 9.0, (0, 9)),
    (1.0, -20.0, 0.0, 99.0, (20, 69)), (-1.0, 20.0, 0.0, 99.0, (0, 20)), (0.1, 4.0, 10.0, 12.0, (10, 12))])
def test_where_a_line_is_within_the_picture(
    slope: float, intercept: float, first: float, last: float, expected: tuple[int, int],
) -> None:
    assert within(slope, intercept, first, last, 0.5, 100, 50) == expected


@pytest.mark.parametrize(('slope', 'intercept', 'first', 'last'), [
    (0.0, 60.0, 0.0, 9.0), (0.0, 10.0, 7.0, 6.0), (1e-300, 1e6, 0.0, 99.0), (1.0, 100.0, 0.0, 99.0),
    (0.0, 10.0, 120.0, 130.0), (0.0, 10.0, -9.0, -1.0),
    *((value, 0.0, 0.0, 5.0) for value in NOT_FINITE), *((0.0, value, 0.0, 5.0) for value in NOT_FINITE),
    *((0.0, 0.0, value, 5.0) for value in NOT_FINITE), *((0.0, 0.0, 0.0, value) for value in NOT_FINITE)])
def test_a_line_that_is_nowhere_in_the_picture(slope: float, intercept: float, first: float, last: float) -> None:
    """No place is looked at, as it would lie outside the memory of the picture."""
    low, high = within(slope, intercept, first, last, 0.5, 100, 50)
    assert high < low
    assert low >= 0
    assert high >= -1


def test_norms_are_counted_from_the_top() -> None:
    gradient = np.random.default_rng(0).normal(0, 300, (40, 50, 2)).astype(np.float32)
    counts = np.ones(NORM_BINS, np.int64)
    count_norms(gradient, 2, 36, 46, counts)
    rows = [0, 12, 17, 30, 35]  # one in COUNT_ROWS, at another place among them each time
    norms = np.concatenate([np.hypot(*gradient[row + 2, 2 + k % COUNT_COLUMNS:48:COUNT_COLUMNS].T)
                            for k, row in enumerate(rows) if row < 36])
    assert counts[0] == norms.size
    assert counts.tolist() == [np.count_nonzero(norms >= NORM_BIN * k) for k in range(NORM_BINS)]


def test_rarity_of_a_norm_is_the_share_of_those_as_large() -> None:
    gradient = np.random.default_rng(0).normal(0, 300, (40, 50, 2)).astype(np.float32)
    counts, rarities = np.ones(NORM_BINS, np.int64), np.ones(NORM_BINS)
    rank_norms(gradient, 2, 36, 46, counts, rarities)
    assert len(set(counts.tolist())) > 50
    np.testing.assert_allclose(rarities, -np.log10(np.maximum(counts / counts[0], RAREST)), rtol=1e-12)


def test_strongest_come_first() -> None:
    """By the first bits, and equal ones in the order of the list; also what is no number has its place."""
    strengths = np.random.default_rng(0).lognormal(3, 2, 500).astype(np.float32)
    strengths[[3, 40, 400, 401, 402]] = np.inf, 0, 0, np.nan, 1e-40
    strengths[100:110] = strengths[100]
    order, bits = np.full(500, -1, np.int64), strengths.view(np.uint32)
    strongest_first(bits, np.ones(KEYS, np.int64), order)
    np.testing.assert_array_equal(order, np.argsort(-(bits.astype(np.int64) >> KEY_SHIFT), kind='stable'))
    ordered = strengths[order]
    assert np.isnan(ordered[0])
    assert (ordered[2:-4] >= 0.969 * ordered[3:-3]).all()


# Claims

def ridge(first: float, last: float, sign: float = 1.0, steep: bool = False, intercept: float = 30.0) -> Any:
    """A line along an axis of a picture."""
    lines = np.zeros(1, RIDGE_DTYPE)
    lines['steep'], lines['intercept'], lines['sign'] = steep, intercept, sign
    lines['first'], lines['last'] = first, last
    lines['begin'], lines['end'] = first, last
    return lines[0]


@pytest.mark.parametrize('steep', [False, True])
@pytest.mark.parametrize(('ends', 'kept', 'share'), [
    ((20, 120), (50, 120), 0), ((0, 40), (0, 10), 0), ((60, 120), (60, 120), 0), ((51, 90), (51, 90), 0.05),
    ((0, 100), (0, 100), 0.41), ((20, 40), None, 1), ((8, 40), (8, 10), 0)])
def test_a_line_leaves_its_ends_to_those_who_claim_them(
    ends: tuple[float, float], kept: tuple[float, float] | None, share: float, steep: bool,
) -> None:
    """Not what is claimed in its middle, nor a few pixels where it meets another."""
    claims = np.zeros(2 * 100 * 100, np.uint8)
    claim(ridge(10, 50, steep=steep), claims, 200, 200)
    line = ridge(*ends, steep=steep)
    assert leave(line, claims, 200, 200) == pytest.approx(share, abs=0.03)
    if kept is not None:
        assert (line['begin'], line['end']) == pytest.approx(kept, abs=2.5)
    other = ridge(*ends, -1.0, steep)
    assert leave(other, claims, 200, 200) == 0
    assert (other['begin'], other['end']) == ends


def test_claims_of_both_sides_of_a_thin_line_stand_beside_each_other() -> None:
    """Whichever comes first: the second one is claimed for those who come then, too."""
    claims = np.zeros(2 * 50 * 50, np.uint8)
    for sign in (1.0, -1.0):
        assert claimed(ridge(10, 90, sign), claims, 100, 100) == 0
        claim(ridge(10, 90, sign), claims, 100, 100)
        assert claimed(ridge(10, 90, sign), claims, 100, 100) == 1


# Straight edges

@pytest.mark.parametrize('degrees', [0, 10, 45, 80, 90, 100, 135, 170])
def test_code_is_that_of_the_pixels(degrees: float) -> None:
    """The direction of the gradient, as edge extraction has it."""
    stages = LineFeatureExtractor().stages(picture(60 + 100 * half_plane(40, 40, degrees, 20.3, 19.8)))
    codes = stages.candidates[8:-8, 8:-8]
    assert len(stages.segments) == 1
    assert stages.segments['code'][0] == np.bincount(codes[codes > 0]).argmax()


@cache
def errors_of_edges(sigma: float, count: int = 250, size: int = 120) -> npt.NDArray[np.float64]:
    """What is wrong with the segments of edges in any position.

    Returns:
        Rows of: offset along the normal, that in x and in y, angle, both in standard deviations of their own, the
        contrast by the true one, how many segments there were, and whether the polarity is right.
    """
    rng = np.random.default_rng(round(sigma) + 100)
    extractor = LineFeatureExtractor()
    rows = []
    for seed in range(count):
        degrees, low, step = rng.uniform(0, 360), rng.uniform(20, 100), rng.uniform(50, 130)
        x, y = size / 2 + rng.uniform(-20, 20, 2)
        image = picture(low + step * half_plane(size, size, degrees, x, y), sigma, seed)
        found = extractor.extract(image)
        assert len(found) > 0
        segment = found[found['length'].argmax()]
        offset, turn = offset_of(segment, degrees, x, y), turn_of(segment, degrees)
        cos, sin = direction(degrees)
        # The bright side is that of (-sin, cos) of the edge; the segment's normal is that or its opposite.
        right = np.sign(math.cos(segment['theta']) * cos + math.sin(segment['theta']) * sin) == segment['polarity']
        rows.append((offset, -sin * offset, cos * offset, turn, offset / max(segment['sigma_offset'], 1e-12),
                     turn / max(segment['sigma_theta'], 1e-12), segment['contrast'] / step, len(found), right))
    return np.array(rows, np.float64)


@pytest.mark.compiled
@pytest.mark.parametrize(('sigma', 'offset', 'degrees'), [
    (0, 0.01, 0.01), (2, 0.01, 0.02), (5, 0.02, 0.03), (10, 0.035, 0.05), (20, 0.06, 0.1)])
def test_edge_is_where_it_is(sigma: float, offset: float, degrees: float) -> None:
    """On average within a fraction of a pixel, whatever its orientation, and to no side of it."""
    errors = errors_of_edges(sigma)
    assert abs(errors[:, 0]).mean() < offset
    assert np.degrees(abs(errors[:, 3])).mean() < degrees
    assert abs(errors[:, 0]).max() < 6 * offset
    for shift in errors[:, :3].T:
        assert abs(shift.mean()) < 0.003 + 3 * shift.std() / math.sqrt(len(shift))


@pytest.mark.compiled
@pytest.mark.parametrize('sigma', [0, 2, 5, 10])
def test_one_edge_is_one_segment(sigma: float) -> None:
    """None is found twice, or in parts."""
    assert (errors_of_edges(sigma)[:, 7] == 1).all()


@pytest.mark.compiled
@pytest.mark.parametrize('sigma', [0, 5, 10, 20])
def test_polarity_is_the_bright_side(sigma: float) -> None:
    assert errors_of_edges(sigma)[:, 8].all()


@pytest.mark.compiled
@pytest.mark.parametrize('sigma', [0, 5, 10, 20])
def test_contrast_is_that_of_the_step(sigma: float) -> None:
    """A step between pixels at an angle is a little less smooth than one along an axis; none is far off."""
    contrast = errors_of_edges(sigma)[:, 6]
    assert contrast.mean() == pytest.approx(1, abs=0.06)
    assert contrast.std() < 0.06


@pytest.mark.compiled
@pytest.mark.parametrize('sigma', [1, 2, 3, 5, 10, 20])
def test_standard_deviations_are_honest(sigma: float) -> None:
    """Errors in units of them have a standard deviation of about one."""
    errors = errors_of_edges(sigma)
    for normalised in errors[:, 4:6].T:
        # With hardly any noise peaks scatter by where the edge lies between pixels, which evens out along it.
        assert (0.8 if sigma >= 3 else 0.5) < normalised.std() < 1.25
        assert np.mean(abs(normalised) < 2) > 0.9


@pytest.mark.compiled
def test_standard_deviations_of_shorter_edges_are_honest() -> None:
    """Also of what is between the corners of a rectangle, and over all lengths and noises."""
    rng = np.random.default_rng(5)
    extractor = LineFeatureExtractor()
    normalised = []
    for seed in range(60):
        degrees, length, thickness = rng.uniform(0, 180), rng.uniform(40, 80), rng.uniform(25, 50)
        image = picture(60 + 110 * bar(degrees, length, thickness), rng.uniform(3, 12), seed)
        found = extractor.extract(image)
        corners = bar_corners(degrees, length, thickness)
        for k in range(4):
            first, second = corners[k], corners[(k + 1) % 4]
            angle = math.degrees(math.atan2(*(second - first)[::-1]))
            near = [segment for segment in found if abs(turn_of(segment, angle)) < 0.1 and math.hypot(
                *(np.array([segment['x'], segment['y']]) - (first + second) / 2)) < 6]
            normalised += [(offset_of(segment, angle, *first) / segment['sigma_offset'],
                            turn_of(segment, angle) / segment['sigma_theta']) for segment in near]
    assert len(normalised) > 200
    offset, turn = np.std(normalised, axis=0)
    assert 0.8 < offset < 1.25
    assert 0.8 < turn < 1.25


@pytest.mark.parametrize('degrees', [0, 30, 45, 90])
def test_no_edge_is_known_for_certain(degrees: float) -> None:
    """Whole grey levels alone leave some doubt: an edge along an axis looks the same a little aside."""
    [segment] = extract(picture(60 + 100 * half_plane(120, 120, degrees, 60.2, 60.2)))
    assert 1e-4 < segment['sigma_offset'] < 0.1
    assert 1e-6 < segment['sigma_theta'] < 1e-2


@pytest.mark.parametrize('degrees', [0, 20, 45, 70, 110, 135])
def test_orientation_and_offset_are_known_from_the_same_peaks(degrees: float) -> None:
    """Of peaks that are spread evenly over a length l the one is known sqrt(12) / l times as well as the other."""
    image = picture(60 + 100 * half_plane(80, 80, degrees, 39.3, 39.6), 4)
    [segment] = extract(image)
    ratio = segment['sigma_theta'] / segment['sigma_offset'] * segment['length']
    assert ratio == pytest.approx(math.sqrt(12), rel=0.15)


@pytest.mark.compiled
def test_longer_and_clearer_edges_are_known_better() -> None:
    def known(step: float, size: int) -> tuple[float, float, float]:
        found = [extract(picture(60 + step * half_plane(size, size, 25, size / 2, size / 2), 5, seed))[0]
                 for seed in range(8)]
        return tuple(float(np.mean([segment[name] for segment in found]))
                     for name in ('sigma_offset', 'sigma_theta', 'log_nfa'))

    usual = known(60, 100)
    assert all(worse > better for worse, better in zip(known(60, 50), usual, strict=True))
    assert all(worse > better for worse, better in zip(known(30, 100)[:2], usual[:2], strict=True))


# Ends

@pytest.mark.compiled
@pytest.mark.parametrize(('sigma', 'usual', 'worst'), [(0, 0.8, 1.25), (5, 0.8, 1.35), (10, 0.95, 1.75)])
def test_rectangle_has_four_sides_with_their_ends(sigma: float, usual: float, worst: float) -> None:
    """A smoothed corner is round: up to about a pixel is missing of each side."""
    rng = np.random.default_rng(round(sigma))
    extractor = LineFeatureExtractor()
    errors = []
    for seed in range(30):
        degrees, length, thickness = rng.uniform(0, 90), rng.uniform(30, 70), rng.uniform(30, 60)
        found = extractor.extract(picture(60 + 120 * bar(degrees, length, thickness), sigma, seed))
        assert len(found) == 4
        corners, ends = bar_corners(degrees, length, thickness), end_points(found).reshape(-1, 2, 2)
        sides = np.stack([corners, np.roll(corners, -1, 0)], 1)
        away = np.hypot(*np.moveaxis(ends[:, None, :, None] - sides[None, :, None, :], -1, 0))
        apart = np.minimum(np.maximum(away[..., 0, 0], away[..., 1, 1]), np.maximum(away[..., 0, 1], away[..., 1, 0]))
        assert sorted(apart.argmin(1)) == [0, 1, 2, 3]
        errors += apart.min(1).tolist()
    assert np.mean(errors) < usual
    assert max(errors) < worst


@pytest.mark.parametrize('sigma', [0, 5])
@pytest.mark.parametrize('degrees', [0, 8, 30, 45, 71, 90, 120, 155])
def test_edge_ends_at_the_border_of_the_picture(degrees: float, sigma: float) -> None:
    height, width = 90, 130
    found = extract(picture(60 + 100 * half_plane(height, width, degrees, 65, 45), sigma))
    assert len(found) == 1
    cos, sin = direction(degrees)
    whole = min((width - 1) / max(abs(cos), 1e-9), (height - 1) / max(abs(sin), 1e-9))
    assert whole - 6 < found['length'][0] <= whole + 0.01
    assert (end_points(found) >= 0).all()
    assert (end_points(found) <= [width - 1, height - 1] * 2).all()


@pytest.mark.parametrize('place', [1, 2, 3, 5])
@pytest.mark.parametrize('side', ['left', 'right', 'top', 'bottom'])
def test_edges_beside_the_border_of_the_picture(side: str, place: int) -> None:
    """The first rows and columns are no less good than others, but for what the border cuts off of the smoothing."""
    image = np.full((70, 80), 60, np.uint8)
    image[:, :place] = 180
    image = {'left': image, 'right': image[:, ::-1], 'top': image.T, 'bottom': image.T[::-1]}[side]
    [segment] = extract(image)
    expected = {'left': place - 0.5, 'top': place - 0.5}.get(side, 80 - place - 0.5)
    assert segment['x' if side in ('left', 'right') else 'y'] == pytest.approx(expected, abs=0.3 if place < 3 else 0.05)
    assert segment['length'] > 66


@pytest.mark.parametrize('degrees', [0, 20, 45, 70, 90])
@pytest.mark.parametrize(('deep', 'wide'), [(0.5, 4), (0.6, 8), (0.7, 3)])
def test_line_goes_on_where_the_edge_is_weak(deep: float, wide: float, degrees: float) -> None:
    """It fades and comes back, and is one edge."""
    y, x = np.mgrid[:160, :160]
    cos, sin = direction(degrees)
    place = (x - 80.3) * cos + (y - 80.3) * sin
    contrast = 100 * (1 - deep * np.exp(-place**2 / (2 * wide**2)))
    image = picture(120 + contrast * (half_plane(160, 160, degrees, 80.3, 80.3) - 0.5), 2)
    along = [segment for segment in extract(image) if segment['length'] > 40 and abs(turn_of(segment, degrees)) < 0.1]
    assert len(along) == 1
    assert along[0]['length'] > 150
    assert abs(offset_of(along[0], degrees, 80.3, 80.3)) < 0.1


@pytest.mark.parametrize('degrees', [0, 20, 45, 70, 90])
@pytest.mark.parametrize('gap', [12, 20, 40])
def test_two_edges_on_one_line_stay_two(degrees: float, gap: float) -> None:
    """With nothing between them."""
    cos, sin = direction(degrees)
    shape = rendered(lambda x, y: (abs((x - 80.3) * cos + (y - 80.3) * sin) > gap / 2)
                     & (abs((y - 80.3) * cos - (x - 80.3) * sin) < 15), 160, 160)
    for segment in extract(picture(60 + 120 * shape)):
        ends = np.array([segment['x1'], segment['x2']]), np.array([segment['y1'], segment['y2']])
        if abs(turn_of(segment, degrees)) < 0.1:
            places = (ends[0] - 80.3) * cos + (ends[1] - 80.3) * sin
            assert places[0] * places[1] > 0
            assert abs(places).min() > gap / 2 - 1


# Lines beside each other

@pytest.mark.parametrize('sigma', [0, 5])
@pytest.mark.parametrize('degrees', [0, 10, 30, 45, 80, 90, 120])
@pytest.mark.parametrize(('thickness', 'slack'), [(2, 0.35), (3, 0.15), (4, 0.1), (6, 0.1), (12, 0.1)])
def test_both_edges_of_a_bar_are_found(thickness: float, slack: float, degrees: float, sigma: float) -> None:
    """Once each, with their bright side inside; where their gradients overlap they push each other outwards."""
    found = extract(picture(60 + 120 * bar(degrees, 80, thickness), sigma))
    sides = found[found['length'] > 40]
    assert len(sides) == 2
    offsets = [offset_of(segment, degrees, 60.3, 60.3) for segment in sides]
    assert sorted(offsets) == pytest.approx([-thickness / 2, thickness / 2], abs=slack + 0.01 * sigma)
    for segment, offset in zip(sides, offsets, strict=True):
        cos, sin = direction(degrees)
        turned = np.sign(math.cos(segment['theta']) * cos + math.sin(segment['theta']) * sin)
        assert segment['polarity'] == -np.sign(offset) * turned


def test_stairs_of_one_polarity_are_told_apart() -> None:
    """From five pixels on."""
    for degrees in (0, 25, 45, 90, 140):
        for apart in (5, 8):
            cos, sin = direction(degrees)
            level = sum(40 * half_plane(120, 120, degrees, 60 - k * apart * sin, 60 + k * apart * cos)
                        for k in (-1, 0, 1))
            found = extract(picture(60 + level))
            assert len(found) == 3
            offsets = sorted(offset_of(segment, degrees, 60, 60) for segment in found)
            assert offsets == pytest.approx([-apart, 0, apart], abs=0.3)


@pytest.mark.compiled
@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('sigma', [0, 5, 15])
def test_no_segment_runs_along_another(seed: int, sigma: float) -> None:
    """In the same direction and with the same polarity, for more than a part of its length."""
    found = extract(scene(240, 320, seed=seed, sigma=sigma))
    assert len(found) >= 4
    for k, segment in enumerate(found):
        cos, sin = math.cos(segment['theta']), math.sin(segment['theta'])
        for other in np.delete(found, k):
            points = np.linspace([other['x1'], other['y1']], [other['x2'], other['y2']], 50)
            along = (points[:, 0] - segment['x']) * cos + (points[:, 1] - segment['y']) * sin
            beside = (points[:, 1] - segment['y']) * cos - (points[:, 0] - segment['x']) * sin
            turn = abs((other['theta'] - segment['theta'] + math.pi / 2) % math.pi - math.pi / 2)
            if turn < 0.2 and other['polarity'] == segment['polarity']:
                assert np.mean((abs(along) < segment['length'] / 2) & (abs(beside) < 1.5)) < 0.7


# What is no line

@pytest.mark.compiled
@pytest.mark.parametrize('sigma', [2, 3, 5, 10, 20, 30, 45, 60])
@pytest.mark.parametrize('level', [128, 20])
def test_noise_has_no_segments(level: float, sigma: float) -> None:
    for seed in range(2):
        assert len(extract(picture(np.full((480, 640), level), sigma, seed))) == 0
    noise = np.random.default_rng(9).normal(level, sigma, (240, 320)).astype(np.float32)
    assert len(extract(noise)) == 0


def worst_of_curve(radius: float, share: float, turn: float, sigma: float, seed: int) -> tuple[float, float]:
    """How far any point of a segment is from the ellipse; the sum of lengths by its circumference.

    Args:
        radius: The longer half axis.
        share: The shorter one, as a part of it.
        turn: The angle of the longer one, radians.
        sigma: Of the noise.
        seed: Of the noise, and the place of the centre.
    """
    size = 2 * math.ceil(radius) + 30
    x, y = size / 2 + np.random.default_rng(seed).uniform(-1, 1, 2)
    cos, sin = math.cos(turn), math.sin(turn)
    shape = rendered(lambda column, row: ((column - x) * cos + (row - y) * sin)**2
                     + (((row - y) * cos - (column - x) * sin) / share)**2 < radius**2, size, size, 4)
    found = extract(picture(60 + 120 * shape, sigma, seed))
    angles = np.linspace(0, 2 * math.pi, round(40 * radius), endpoint=False)
    curve = np.stack([x + radius * (np.cos(angles) * cos - share * np.sin(angles) * sin),
                      y + radius * (np.cos(angles) * sin + share * np.sin(angles) * cos)], 1).astype(np.float32)
    worst = 0.0
    for x1, y1, x2, y2 in end_points(found):
        points = np.linspace([x1, y1], [x2, y2], 15).astype(np.float32)
        worst = max(worst, float(np.sqrt(((points[:, None] - curve)**2).sum(2).min(1)).max()))
    circumference = np.hypot(*np.diff(curve, axis=0, append=curve[:1]).T).sum()
    return worst, float(found['length'].sum() / circumference)


@pytest.mark.parametrize('radius', [10, 12, 15, 20, 30, 50, 75, 100, 150, 200, 300])
@pytest.mark.parametrize('share', [1.0, 0.6], ids=['circle', 'ellipse'])
@pytest.mark.parametrize('sigma', [0, 5])
def test_segments_stay_on_curves(radius: float, share: float, sigma: float) -> None:
    """Within a pixel; of large circles most is found."""
    share = max(share, 10 / radius)
    for seed in range(3 if radius < 100 else 1):
        worst, found = worst_of_curve(radius, share, 0.4 + seed, sigma, seed)
        assert worst < 1
        assert found > 0.5 or radius < 75
        assert found < 1.1


# The picture's place, range and type

def test_new_fields_of_a_region_are_those_of_the_crop() -> None:
    image = scene(200, 260, seed=3)
    found, of_crop = extract(image, roi=(30, 20, 200, 150)), extract(image[20:170, 30:230].copy())
    assert len(found) == len(of_crop) > 3
    for name in FIELDS:
        np.testing.assert_array_equal(found[name], of_crop[name], err_msg=name)


@pytest.mark.parametrize('factor', [2, 4])
def test_new_fields_of_a_smaller_picture_are_in_pixels_of_the_full_one(factor: int) -> None:
    """Only that of length is another there."""
    image = scene(400, 480, seed=2)
    small = cv2.resize(image, (480 // factor, 400 // factor), interpolation=cv2.INTER_AREA)
    found, of_small = extract(image, scale=1 / factor), extract(small)
    assert len(found) == len(of_small) > 2
    for name in FIELDS:
        times = factor if name == 'sigma_offset' else 1
        np.testing.assert_allclose(found[name], of_small[name] * times, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize(('dtype', 'factor', 'shift', 'given'), [
    (np.uint16, 257, 0, {}), (np.uint16, 16, 0, {'intensity_max': 16 * 255.0}), (np.float32, 1, 0, {}),
    (np.float32, 2.0**-8, -0.5, {'intensity_min': -0.5, 'intensity_max': 255 / 256 - 0.5})])
def test_other_types_and_ranges_have_the_same_segments(
    dtype: Any, factor: float, shift: float, given: dict[str, float],
) -> None:
    """Contrasts are in grey levels in all of them."""
    image = scene(150, 200, seed=1)
    found, expected = extract((image.astype(np.float64) * factor + shift).astype(dtype), **given), extract(image)
    assert len(found) == len(expected) > 2
    # The last digit of a grey level may move an end.
    for name in set(SEGMENT_DTYPE.names or ()) - {'intercept'}:
        assert np.isclose(found[name], expected[name], rtol=2e-3, atol=2e-3).mean() > 0.8, name


def test_negative_of_a_picture_has_the_opposite_polarities() -> None:
    image = scene(150, 200, seed=1)
    found, expected = extract(255 - image), extract(image)
    assert len(found) == len(expected) > 2
    np.testing.assert_array_equal(found['polarity'], -expected['polarity'])
    for name in ('x', 'y', 'length', 'theta', 'contrast', 'sigma_offset'):
        np.testing.assert_allclose(found[name], expected[name], rtol=5e-3, atol=2e-2, err_msg=name)


@pytest.mark.compiled
@pytest.mark.parametrize('seed', range(3))
def test_more_alarms_less_clearness_and_less_certainty_let_more_through(seed: int) -> None:
    """What is accepted meets what was asked for."""
    image = scene(150, 200, seed=seed, sigma=15)
    counts = [len(extract(image, false_alarms=alarms)) for alarms in (1e-30, 1e-6, 0.1, 1e6)]
    assert counts == sorted(counts)
    counts = [len(extract(image, min_snr=ratio)) for ratio in (400, 100, 25)]
    assert counts == sorted(counts)
    for alarms in (1e-6, 0.1):
        assert (extract(image, false_alarms=alarms)['log_nfa'] <= math.log10(alarms) + 1e-4).all()
    every = extract(image, max_sigma_theta=10.0)
    for sigma in (0.0, 0.002, 0.02):
        certain = every[every['sigma_theta'] <= np.float32(sigma)]
        assert extract(image, max_sigma_theta=float(np.float32(sigma))).tobytes() == certain.tobytes()
    assert 0 < np.count_nonzero(every['sigma_theta'] <= 0.002) < len(every)


# Masks

@pytest.mark.compiled
@pytest.mark.parametrize('degrees', [0, 20, 45, 90, 130])
@pytest.mark.parametrize('sigma', [0, 8])
def test_no_segment_goes_far_into_what_is_masked(degrees: float, sigma: float) -> None:
    image = picture(60 + 120 * half_plane(160, 160, degrees, 80, 80), sigma)
    y, x = np.mgrid[:160, :160]
    masks = [abs(x - 80) > 25, abs(y - 80) > 25, np.hypot(x - 80, y - 80) > 30, x + y > 170]
    for mask in masks:
        inside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
        for segment in end_points(extract(image, mask)):
            points = np.round(np.linspace(segment[:2], segment[2:], 200)).astype(int)
            assert inside[points[:, 1], points[:, 0]].max() <= 2.5


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf, 3e38])
def test_masked_pixels_may_be_anything(value: float) -> None:
    image = (60 + 120 * half_plane(160, 160, 20, 80, 80)).astype(np.float32)
    mask = np.ones(image.shape, bool)
    mask[60:100, 70:90] = False
    image[~mask] = value
    found = extract(image, mask)
    assert len(found) >= 2
    for name in FIELDS:
        assert np.isfinite(found[name]).all()
    assert abs(offset_of(found[0], 20, 80, 80)) < 1


# Images of all kinds

def test_small_images() -> None:
    """Of any size up to 20 pixels, whatever is in them."""
    rng = np.random.default_rng(0)
    extractor = LineFeatureExtractor()
    for height in range(1, 21):
        for width in range(1, 21):
            noise = rng.integers(0, 256, (height, width), np.uint8)
            step = np.zeros((height, width), np.uint8)
            step[height // 2:, width // 3:] = 255
            for image in (noise, noise.astype(np.uint16) * 257, noise.astype(np.float32), step):
                ends = end_points(extractor.extract(image))
                assert (ends >= 0).all()
                assert (ends <= [width - 1, height - 1] * 2).all()


@pytest.mark.parametrize('height', [9, 10, 12, 20])
def test_line_in_a_small_image_is_found(height: int) -> None:
    """From its least length on, which is nine pixels."""
    image = np.zeros((height, 16), np.uint8)
    image[:, 8:] = 255
    found = extract(image)
    assert len(found) == (height > 9)
    assert found['x'] == pytest.approx([7.5] * len(found), abs=0.05)


@pytest.mark.parametrize('image', [
    np.zeros((60, 80), np.uint8), np.full((60, 80), 255, np.uint8), np.full((60, 80), 65535, np.uint16),
    np.full((60, 80), -3e38, np.float32), np.full((60, 80), 1e-45, np.float32), np.zeros((60, 80), np.float32),
], ids=['black', 'white', 'bright', 'least', 'denormal', 'zero'])
def test_constant_images_have_no_segments(image: Image) -> None:
    assert len(extract(image)) == 0


def test_saturated_edges_are_as_good_as_others() -> None:
    """From black to white, in an overexposed picture and in a dark one."""
    side = half_plane(120, 120, 20, 60, 60)
    for level in (np.clip(600 * side - 100, 0, 255), np.clip(150 + 400 * side, 0, 255), 30 * side):
        [segment] = extract(picture(level))
        assert abs(turn_of(segment, 20)) < math.radians(0.1)
        assert segment['length'] > 120


# As plain Python, without the contraction of products and sums, the pixels beside the two largest steps are no tie.
@pytest.mark.parametrize('value', [
    1e3, 1e6, pytest.param(1e9, marks=pytest.mark.compiled), pytest.param(1e12, marks=pytest.mark.compiled)])
def test_large_values_are_as_good_as_others(value: float) -> None:
    image = np.where(np.arange(80) > 40, value, 0).astype(np.float32)[None].repeat(60, 0)
    for sign in (1, -1):
        [segment] = extract(sign * image)
        assert segment['x'] == pytest.approx(40.5, abs=0.01)
        assert segment['contrast'] == pytest.approx(value, rel=0.1)


# Memory

@pytest.mark.parametrize('layout', [
    lambda image: image[:, ::-1].copy()[:, ::-1], np.asfortranarray, lambda image: np.repeat(image, 2, 1)[:, ::2],
    lambda image: np.frombuffer(image.tobytes(), image.dtype).reshape(image.shape)],
    ids=['mirrored', 'fortran', 'every other', 'read-only'])
@pytest.mark.parametrize('dtype', [np.uint8, np.uint16, np.float32])
def test_layout_in_memory_does_not_matter(layout: Any, dtype: Any) -> None:
    image = scene(120, 160, dtype=dtype)
    expected = extract(image)
    assert len(expected) > 2
    assert same(extract(layout(image)), expected)


@pytest.mark.compiled
def test_same_picture_has_the_same_segments_whatever_was_before() -> None:
    extractor = LineFeatureExtractor()
    pictures = [scene(*shape, seed=seed, sigma=sigma) for seed, (shape, sigma) in enumerate([
        ((90, 120), 4), ((97, 121), 20), ((90, 120), 0), ((33, 200), 4), ((240, 320), 10), ((5, 5), 0)])]
    expected = [LineFeatureExtractor().extract(image) for image in pictures]
    assert sum(len(found) for found in expected) > 10
    for k in (0, 4, 3, 2, 1, 5, 4, 0, 2, 2, 5, 1):
        assert same(extractor.extract(pictures[k]), expected[k])


@pytest.mark.compiled
def test_every_subset_of_the_new_steps_works_by_itself() -> None:
    """Refinement of blobs of codes; straight stretches that are linked; neither."""
    image = picture(60 + 120 * bar(20, 80, 50), 3)
    corners = bar_corners(20, 80, 50)
    for grouping in ('codes', 'straightness'):
        for refine in (False, True):
            for given in ({}, {'alpha': 1.0}, {'noise_T1': 0.0, 'noise_T2': 0.0}, {'operator': 'sobel'}):
                found = extract(image, grouping=grouping, refine=refine, **given)
                long = found[found['length'] > 40]
                assert len(long) == 4
                for point in end_points(long).reshape(-1, 2):
                    assert np.hypot(*(corners - point).T).min() < 6
                assert (found['polarity'] != 0).all() == refine


SMALL = """
import sys
import numpy as np
from line_feature_node.core import extract
image = np.load(sys.argv[1])
np.save(sys.argv[2], extract(image))
"""


@pytest.mark.parametrize('value', [1e15, 1e20, 1e30, 3e38])
def test_kernels_stay_within_their_memory_for_huge_values(value: float, tmp_path: Any) -> None:
    """Python finds what compiled code would write elsewhere."""
    noise = np.random.default_rng(0).uniform(-value, value, (24, 30)).astype(np.float32)
    np.save(tmp_path / 'image.npy', noise)
    subprocess.run([sys.executable, '-W', 'ignore', '-c', SMALL, tmp_path / 'image.npy', tmp_path / 'found.npy'],
                   check=True, env={**os.environ, 'NUMBA_DISABLE_JIT': '1'})
    assert len(extract(noise)) == len(np.load(tmp_path / 'found.npy')) == 0


def test_kernels_without_the_compiler_give_the_same(tmp_path: Any) -> None:
    """What Python makes of them, which checks every index, is what the compiled ones do."""
    np.save(tmp_path / 'image.npy', scene(30, 40))
    subprocess.run([sys.executable, '-c', SMALL, tmp_path / 'image.npy', tmp_path / 'found.npy'], check=True, env={
        **os.environ, 'NUMBA_DISABLE_JIT': '1'})
    found, expected = np.load(tmp_path / 'found.npy'), extract(scene(30, 40))
    assert len(found) == len(expected) > 0
    for name in set(SEGMENT_DTYPE.names or ()):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-3, atol=1e-3, err_msg=name)


#: Lines, levels 0 to 4 of 41×36 pixels, that the fuzzing campaign drew.
DRAWN = (
    'c-qC3OA>$}3`0rV`=41<M1E~`V6+Qe_$DFKNC>}-yoTU2@P!a&m<+)`HT-BT!adWgbkN9%*=HIl?Yvwf+S;-otkv>uWJB;e68+#8'
    '34Ym-^NFRB@`+_cWI+ju(EiXFI)?dt(>PN4ctJIGr8b~)*R>z%b;we7V^~V7&;D9WUN*Ao)><a?d^XFZ0f7'
)
LEVELS = np.array([0, 5.07e37, 1.768e38, 2.717e38, 3.172e38], np.float32)


def test_gradients_that_are_no_numbers_end_no_process() -> None:
    """The window in which an end is looked for was that of a NaN, made a whole number."""
    drawn = np.frombuffer(zlib.decompress(base64.b85decode(DRAWN)), np.uint8).reshape(41, 36)
    segments = extract(LEVELS[drawn], profile='welding_panel', thinning='none', operator='prewitt')
    assert all(np.isfinite(end_points(segments)).ravel())


# Edges side by side

@pytest.mark.parametrize('period', [3, 4, 5, 8])
@pytest.mark.parametrize('size', [160, 600, 1200])
@pytest.mark.parametrize('turned', [False, True])
def test_edges_side_by_side_are_each_found_once(period: int, size: int, turned: bool) -> None:
    """In stripes of a few pixels what one edge claims must not keep its neighbours from being claimed."""
    image = np.broadcast_to(np.where(np.arange(size) // period % 2, 200, 50), (900, size)).astype(np.uint8)
    found = extract(np.ascontiguousarray(image.T) if turned else image)
    x = np.sort(found['y' if turned else 'x'])
    assert len(found) >= size // period - 2
    assert (np.diff(x) > period - 0.5).all()
    assert (found['length'] > 890).all()


@pytest.mark.parametrize('degrees', [1.4, 0.7, 20, 44, 46])
def test_edges_side_by_side_are_each_found_once_at_any_angle(degrees: float) -> None:
    """Also where the codes of opposite directions are not half of the circle apart."""
    rows, columns = np.mgrid[:400, :300] * 1.0
    across = columns * math.cos(math.radians(degrees)) + rows * math.sin(math.radians(degrees))
    found = extract((125 + 75 * np.clip(3 * np.sin(across * math.pi / 4), -1, 1)).astype(np.uint8))
    offsets = np.sort(found['x'] * math.cos(math.radians(degrees)) + found['y'] * math.sin(math.radians(degrees)))
    assert len(found) > 50
    assert (np.diff(offsets) > 3).mean() > 0.97
    assert found['length'].sum() < 1.1 * 400 * 300 / 4


def test_a_line_that_is_cut_is_told_of_by_the_rest() -> None:
    """A weak edge that goes on as a strong one, at a slightly different angle, does not get its contrast."""
    rows, columns = np.mgrid[:200, :400]
    step = np.where(columns < 120, 12, 100)
    bend = np.where(columns < 120, 0, 0.03 * (columns - 120))
    image = (60 + step * np.clip(rows - 100 - bend + 0.5, 0, 1)).astype(np.uint8)
    found = extract(image)
    weak = found[(found['x'] < 115) & (abs(found['theta']) < 0.1)]
    assert len(weak) == 1
    assert weak['contrast'][0] == pytest.approx(12, abs=6)
    assert weak['size'][0] <= weak['length'][0] + 2
    assert found['contrast'].max() == pytest.approx(100, rel=0.1)

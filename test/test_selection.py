import dataclasses
import itertools
import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from line_feature_node.core import SEGMENT_DTYPE, LineFeatureExtractor, Parameters, end_points, extract
from line_feature_node.core.selection import REACH, check_mask, filled, placed, region, selected, smaller

Image = npt.NDArray[Any]
Segments = npt.NDArray[np.void]
TYPES = [np.uint8, np.uint16, np.float32]
BOTH = pytest.mark.parametrize('profile', ['default', 'paper'])
THINNINGS = Parameters.specs()['thinning'].choices
CORNERS = np.array([(0.1, 0.15), (0.7, 0.05), (0.95, 0.5), (0.5, 0.55), (0.6, 0.95), (0.05, 0.8), (0.3, 0.45)])


def scene(height: int = 90, width: int = 120, dtype: Any = np.uint8, channels: int = 1, seed: int = 0) -> Image:
    """A bright polygon with a dark one in it, and a little noise; each channel has another contrast."""
    drawn = np.full((height, width), 60, np.uint8)
    for corners, value in ((CORNERS, 170), (0.5 + (CORNERS[::2] - 0.5) * 0.4, 20)):
        points = (corners * (width, height) * 16).astype(np.int32)
        cv2.fillPoly(drawn, [points], value, cv2.LINE_AA, 4)
    rng = np.random.default_rng(seed)
    image = drawn[..., None] * np.linspace(1, 0.7, channels) + rng.normal(0, 3, (height, width, channels))
    image = np.clip(image, 0, 255)
    image = np.round(image * 257 if dtype == np.uint16 else image).astype(dtype)
    return image[..., 0] if channels == 1 else image


def half_plane(height: int, width: int, degrees: float, x: float, y: float) -> npt.NDArray[np.float32]:
    """A step of 120 grey levels along a line through (x, y): each pixel the mean over its area, exactly."""
    rows, columns = np.mgrid[:height, :width]
    radians = math.radians(degrees)
    distance = (rows - y) * math.cos(radians) - (columns - x) * math.sin(radians)
    small, large = sorted((abs(math.cos(radians)), abs(math.sin(radians))))
    if small < 1e-9:
        share = np.clip(distance + 0.5, 0, 1)
    else:
        a, b = (large + small) / 2, (large - small) / 2
        share = sum(sign * np.maximum(distance + shift, 0)**2 / 2
                    for shift, sign in ((a, 1), (b, -1), (-b, -1), (-a, 1))) / (small * large)
    return (60 + 120 * share).astype(np.float32)


def padded(image: Image) -> Image:
    """The same in rows that are longer."""
    wide = np.full((image.shape[0], image.shape[1] + 5, *image.shape[2:]), 99, image.dtype)
    wide[:, :image.shape[1]] = image
    return wide[:, :image.shape[1]]


def same(first: Segments, second: Segments) -> bool:
    """Byte for byte."""
    return first.dtype == second.dtype and first.tobytes() == second.tobytes()


def made(*lines: tuple[float, float, float, float]) -> Segments:
    """Segments between end points, all their fields consistent."""
    segments = np.zeros(len(lines), SEGMENT_DTYPE)
    for segment, (x1, y1, x2, y2) in zip(segments, lines, strict=True):
        theta = math.atan2(y2 - y1, x2 - x1)
        theta -= math.pi * round(theta / math.pi - 1e-9)
        segment['x1'], segment['y1'], segment['x2'], segment['y2'] = x1, y1, x2, y2
        segment['x'], segment['y'] = (x1 + x2) / 2, (y1 + y2) / 2
        segment['theta'], segment['length'] = theta, math.hypot(x2 - x1, y2 - y1)
        segment['rho'] = segment['y'] * math.cos(theta) - segment['x'] * math.sin(theta)
        segment['intercept'] = math.nan if x1 == x2 else y1 - (y2 - y1) / (x2 - x1) * x1
    segments['code'] = 1 + np.arange(len(lines)) % 4
    segments['size'] = 7 + np.arange(len(lines))
    return segments


def turned(lengths: list[float], thetas: list[float]) -> Segments:
    """Segments with a length and an orientation, told apart by their size."""
    segments = np.zeros(len(lengths), SEGMENT_DTYPE)
    segments['length'], segments['theta'] = lengths, thetas
    segments['size'] = np.arange(len(lengths))
    return segments


def kept(segments: Segments, **parameters: Any) -> list[int]:
    return selected(segments, Parameters(**parameters))['size'].tolist()


def check_consistent(segments: Segments) -> None:
    """Length, orientation, intercept and rho are those of the end points."""
    x, y, x1, y1, x2, y2, length, theta, intercept, rho = (
        segments[name].astype(np.float64)
        for name in ('x', 'y', 'x1', 'y1', 'x2', 'y2', 'length', 'theta', 'intercept', 'rho'))
    cos, sin = np.cos(theta), np.sin(theta)
    assert (theta > -np.float32(math.pi / 2)).all()
    assert (theta <= np.float32(math.pi / 2)).all()
    np.testing.assert_allclose(length, np.hypot(x2 - x1, y2 - y1), atol=1e-4)
    np.testing.assert_allclose((y2 - y1) * cos - (x2 - x1) * sin, 0, atol=2e-3)
    np.testing.assert_allclose(y1 * cos - x1 * sin, rho, atol=2e-3)
    np.testing.assert_allclose(y * cos - x * sin, rho, atol=2e-3)
    assert np.isnan(intercept[cos < 5e-7]).all()
    sloped = cos > 2e-6
    np.testing.assert_allclose((intercept * cos)[sloped], rho[sloped], atol=2e-3, rtol=1e-3)


def check_shifted(found: Segments, of_crop: Segments, x: float, y: float) -> None:
    """They are those of the crop in another place, up to the rounding of float32."""
    assert len(found) == len(of_crop) > 0
    for name in ('z', 'code', 'size', 'theta'):
        np.testing.assert_array_equal(found[name], of_crop[name], err_msg=name)
    for names, start in ((('x', 'x1', 'x2'), x), (('y', 'y1', 'y2'), y)):
        for name in names:
            np.testing.assert_allclose(found[name], of_crop[name].astype(float) + start, rtol=2e-7, atol=2e-5)
    np.testing.assert_allclose(found['length'], of_crop['length'], atol=1e-4)
    check_consistent(found)


# The region of interest, in pixels of a picture.

@pytest.mark.parametrize(('roi', 'expected'), [
    ((0, 0, 1, 1), (0, 0, 640, 480)),
    ((0.25, 0.5, 0.5, 0.25), (160, 240, 320, 120)),
    ((0.75, 0.75, 0.5, 0.5), (480, 360, 160, 120)),
    ((1 / 3, 1 / 3, 1 / 3, 1 / 3), (213, 160, 214, 160)),
    ((0, 0, 0.001, 0.002), (0, 0, 1, 1)),
    ((10, 20, 30, 40), (10, 20, 30, 40)),
    ((0, 0, 2, 1), (0, 0, 2, 1)),
    ((639, 479, 1, 1), (639, 479, 1, 1)),
    ((600, 400, 100, 100), (600, 400, 40, 80)),
    ((0, 0, 1e6, 1e6), (0, 0, 640, 480)),
], ids=str)
def test_region(roi: tuple[float, float, float, float], expected: tuple[int, ...]) -> None:
    found = region(roi, 640, 480)
    assert found == expected
    assert [type(value) for value in found] == [int] * 4


@pytest.mark.parametrize('roi', [
    (640, 0, 10, 10), (0, 480, 10, 10), (1000, 1000, 5, 5), (1, 0, 1, 1), (0, 1, 1, 1), (0.5, 0.5, 0.0001, 1),
    (0.5, 0.5, 1, 0.0001)], ids=str)
def test_region_outside(roi: tuple[float, float, float, float]) -> None:
    """The message has the region and the size of the picture."""
    with pytest.raises(ValueError, match='^roi .* leaves nothing of an image of 640×480 pixels') as caught:
        region(roi, 640, 480)
    assert str(list(roi)) in str(caught.value)


@pytest.mark.parametrize('parts', [1, 2, 4, 8])
@pytest.mark.parametrize('size', [8, 11, 13, 100, 479])
def test_regions_of_neighbouring_shares_leave_no_pixel_out(size: int, parts: int) -> None:
    share = 1 / parts
    columns = [region((k * share, 0, share, 1), size, 9)[::2] for k in range(parts)]
    rows = [region((0, k * share, 1, share), 9, size)[1::2] for k in range(parts)]
    for bands in (columns, rows):
        assert sum(extent for _, extent in bands) == size
        assert all(start + extent == following for (start, extent), (following, _) in itertools.pairwise(bands))


# Masks.

@pytest.mark.parametrize('mask', [np.zeros((4, 5), bool), np.ones((4, 5), np.uint8), np.zeros((8, 10), bool)[::2, ::2]])
def test_right_masks(mask: Image) -> None:
    check_mask(mask, (4, 5))
    check_mask(mask, (4, 5, 3))


@pytest.mark.parametrize(('mask', 'error', 'message'), [
    ([[True]], TypeError, 'mask must be a numpy array, got list'),
    (True, TypeError, 'mask must be a numpy array, got bool'),
    ('mask.png', TypeError, 'mask must be a numpy array, got str'),
    (np.ones((90, 120), np.float32), TypeError, 'mask must be bool or uint8, got float32'),
    (np.ones((90, 120), np.int8), TypeError, 'mask must be bool or uint8, got int8'),
    (np.ones((90, 120), np.int64), TypeError, 'mask must be bool or uint8, got int64'),
    (np.ones((90, 120), object), TypeError, 'mask must be bool or uint8, got object'),
    (np.ones((120, 90), bool), ValueError, 'mask must have the shape of the image, (90, 120), got (120, 90)'),
    (np.ones((90, 120, 1), bool), ValueError, 'mask must have the shape of the image, (90, 120), got (90, 120, 1)'),
    (np.ones((1, 1), bool), ValueError, 'mask must have the shape of the image, (90, 120), got (1, 1)'),
    (np.ones(90 * 120, bool), ValueError, 'mask must have the shape of the image, (90, 120), got (10800,)'),
    (np.array(True), ValueError, 'mask must have the shape of the image, (90, 120), got ()'),
], ids=str)
def test_wrong_masks(mask: Any, error: type[Exception], message: str) -> None:
    """Also for a colour image, with a region of interest and made smaller: the mask is of the full picture."""
    for shape in ((90, 120), (90, 120, 3)):
        for parameters in ({}, {'roi': (0, 0, 1, 0.5)}, {'scale': 0.5}):
            with pytest.raises(error) as caught:
                extract(np.zeros(shape, np.uint8), mask, **parameters)
            assert str(caught.value) == message


@BOTH
@pytest.mark.parametrize('value', [1, 128, 255])
@pytest.mark.parametrize('dtype', TYPES)
def test_mask_of_everything_changes_nothing(profile: str, dtype: Any, value: int) -> None:
    for channels in (1, 3):
        image = scene(dtype=dtype, channels=channels)
        expected = extract(image, profile=profile)
        assert len(expected) > 5
        assert same(extract(image, np.full((90, 120), value, np.uint8), profile=profile), expected)
        assert same(extract(image, np.ones((90, 120), bool), profile=profile), expected)
        assert same(extract(image, mask=None, profile=profile), expected)


@BOTH
def test_mask_of_nothing_leaves_nothing(profile: str) -> None:
    for dtype in (bool, np.uint8):
        assert len(extract(scene(), np.zeros((90, 120), dtype), profile=profile)) == 0


def masks() -> list[Image]:
    """Left half, a stripe of one row, a frame, single pixels, all as bool."""
    left, stripe, frame = np.zeros((90, 120), bool), np.ones((90, 120), bool), np.ones((90, 120), bool)
    left[:, :60] = True
    stripe[45] = False
    frame[20:70, 30:90] = False
    return [left, stripe, frame, np.random.default_rng(0).random((90, 120)) < 0.95]


@BOTH
@pytest.mark.parametrize('mask', masks(), ids=['left', 'stripe', 'frame', 'pixels'])
@pytest.mark.parametrize('thinning', THINNINGS)
@pytest.mark.parametrize('max_gap', [0, 2, 8])
def test_no_edge_where_the_mask_is_0(profile: str, mask: Image, thinning: str, max_gap: int) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile, thinning=thinning, max_gap=max_gap))
    extractor.extract(scene(), mask)
    edges = extractor.edges()
    assert edges.any()
    assert not edges[~mask].any()


@BOTH
@pytest.mark.parametrize('mask', masks(), ids=['left', 'stripe', 'frame', 'pixels'])
def test_mask_takes_candidates_away_and_no_more(profile: str, mask: Image) -> None:
    """Whether bool or uint8 or with strides, and not even the pixel beside a masked one is another.

    Nothing is adapted to the picture here: that looks at the pixels that are not masked.
    """
    extractor = LineFeatureExtractor(Parameters.profile(profile, alpha=1.0, noise_T1=0.0, noise_T2=0.0))
    whole = extractor.stages(scene())
    masked = extractor.stages(scene(), mask)
    np.testing.assert_array_equal(masked.candidates, np.where(mask, whole.candidates, 0))
    np.testing.assert_array_equal(masked.strong, whole.strong & mask)
    assert 0 < (masked.candidates != 0).sum() < (whole.candidates != 0).sum()
    for other in (mask.astype(np.uint8), mask * np.uint8(200), padded(mask), np.asfortranarray(mask),
                  mask[::-1].copy()[::-1]):
        assert same(extractor.extract(scene(), other), masked.segments)


@BOTH
def test_segments_end_at_the_mask(profile: str) -> None:
    image = half_plane(80, 100, 90, 50.2, 40)
    mask = np.zeros((80, 100), np.uint8)
    mask[20:60] = 1
    found = extract(image, mask, profile=profile)
    assert len(found) == 1
    assert sorted((found['y1'][0], found['y2'][0])) == pytest.approx([20, 59], abs=1)


@BOTH
def test_mask_is_of_the_full_picture_with_a_region(profile: str) -> None:
    for mask in masks():
        of_crop = extract(scene()[10:80, 20:110], mask[10:80, 20:110], profile=profile)
        check_shifted(extract(scene(), mask, roi=(20, 10, 90, 70), profile=profile), of_crop, 20, 10)


# Pixels that are not finite, under a mask.

HOLES = [np.s_[30:50, 40:70], np.s_[:25, :30], np.s_[80:, 10:110], np.s_[44:46, :], np.s_[30, 40], np.s_[:, 119]]


@BOTH
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('hole', HOLES, ids=str)
@pytest.mark.parametrize('alpha', [0.3, 1.0])
def test_border_of_a_hole_is_no_edge(profile: str, hole: Any, value: float, alpha: float) -> None:
    """Neither in a picture that rises by a little less than the thresholds, nor where an edge runs into it."""
    rows, columns = np.mgrid[:90, :120]
    image = (100 + 1.5 * columns + 0.7 * rows).astype(np.float32)
    mask = np.ones(image.shape, bool)
    image[hole], mask[hole] = value, False
    extractor = LineFeatureExtractor(Parameters.profile(profile, alpha=alpha, T1=2.5, T2=1.8))
    assert len(extractor.extract(image, mask)) == 0
    image[:, :60] -= 300
    found = extractor.extract(image, mask)
    assert len(found) >= 1
    assert abs(end_points(found)[:, ::2] - 59.5).max() <= 1.5


@BOTH
@pytest.mark.parametrize('hole', HOLES, ids=str)
def test_edges_elsewhere_are_unchanged_by_a_hole(profile: str, hole: Any) -> None:
    """With an operator of 3×3 all but the pixels within reach are the same; with Deriche's those further away."""
    image = scene(dtype=np.float32)
    mask = np.ones(image.shape, bool)
    mask[hole] = False
    holed = np.where(mask, image, np.float32(np.nan))
    for operator, reach in (('sobel', REACH), ('deriche', 12)):
        # The noise, by which alpha and the thresholds are chosen, is that of the whole picture.
        extractor = LineFeatureExtractor(Parameters.profile(
            profile, operator=operator, alpha=1.0, noise_T1=0.0, noise_T2=0.0))
        away = cv2.erode(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2)) != 0
        whole, found = extractor.stages(image).candidates, extractor.stages(holed, mask).candidates
        assert (whole[away] != 0).any()
        np.testing.assert_array_equal(found[away], whole[away])
        assert not found[~mask].any()


@BOTH
def test_pixels_beside_a_hole_do_not_count(profile: str) -> None:
    """Those within reach of what is not finite, however large the mask."""
    image = scene(dtype=np.float32)
    mask = np.ones(image.shape, bool)
    mask[20:60, 30:70] = False
    image[20:60, 30:70] = np.nan
    image[60, 70] = np.nan
    mask[60, 70] = False
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    extractor.extract(image, mask)
    near = cv2.dilate((~mask).astype(np.uint8), np.ones((2 * REACH + 1,) * 2)) != 0
    assert not extractor.edges()[near].any()
    assert extractor.edges().any()


@BOTH
@pytest.mark.parametrize('channels', [3, 4])
def test_hole_in_one_channel(profile: str, channels: int) -> None:
    image = scene(dtype=np.float32, channels=channels)
    mask = np.ones(image.shape[:2], bool)
    mask[40:50, 40:60] = False
    image[40:50, 40:60, 1] = np.nan
    assert len(extract(image, mask, profile=profile)) > 5
    with pytest.raises(ValueError, match='^image must be finite'):
        extract(image, profile=profile)


@pytest.mark.parametrize('scale', [1, 0.5, 0.3])
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_image_of_nothing_finite(value: float, scale: float) -> None:
    image = np.full((30, 40), value, np.float32)
    with pytest.raises(ValueError, match='^image must have finite pixels, got none'):
        extract(image, np.zeros((30, 40), bool), scale=scale)
    with pytest.raises(ValueError, match='^image must be finite'):
        extract(image, np.ones((30, 40), bool), scale=scale)
    with pytest.raises(ValueError, match='^image must be finite'):
        extract(image, scale=scale)


@pytest.mark.parametrize('scale', [1, 0.5])
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_pixel_that_is_neither_finite_nor_masked(value: float, scale: float) -> None:
    image, mask = scene(dtype=np.float32), np.ones((90, 120), bool)
    mask[:45] = False
    image[44:46, 3] = value
    with pytest.raises(ValueError, match='^image must be finite where it is not masked, got pixels that are NaN'):
        extract(image, mask, scale=scale)
    mask[45, 3] = False
    assert len(extract(image, mask, scale=scale)) > 0


@BOTH
def test_what_is_not_finite_outside_the_region_does_not_matter(profile: str) -> None:
    image = scene(dtype=np.float32)
    expected = extract(image, roi=(20, 10, 90, 70), profile=profile)
    image[:10], image[:, :20], image[80:], image[:, 110:] = np.nan, np.inf, -np.inf, np.nan
    assert same(extract(image, roi=(20, 10, 90, 70), profile=profile), expected)
    with pytest.raises(ValueError, match='^image must be finite'):
        extract(image, roi=(19, 10, 91, 70), profile=profile)


def test_filled_takes_the_nearest() -> None:
    """Up to the error of the distance's approximation; what is known stays."""
    rng = np.random.default_rng(0)
    grey = np.arange(30 * 41, dtype=np.float32).reshape(30, 41)
    unknown = cv2.dilate((rng.random(grey.shape) < 0.03).astype(np.uint8), np.ones((5, 5))) != 0
    unknown[:8, :9] = True
    holed = np.where(unknown, np.float32(np.nan), grey)
    result, mask = filled(holed, np.where(unknown, 0, 255).astype(np.uint8))
    np.testing.assert_array_equal(result[~unknown], grey[~unknown])
    known = np.argwhere(~unknown)
    for y, x in np.argwhere(unknown):
        source = np.array(divmod(int(result[y, x]), 41))
        assert not unknown[tuple(source)]
        assert np.hypot(*(source - (y, x))) <= 1.15 * np.hypot(*(known - (y, x)).T).min()
    expected = cv2.dilate(unknown.astype(np.uint8), np.ones((2 * REACH + 1,) * 2)) == 0
    np.testing.assert_array_equal(mask, np.where(expected, 255, 0))
    assert result.dtype == np.float32
    assert mask.dtype == np.uint8


def test_filled_leaves_what_it_was_given() -> None:
    grey, mask = np.ones((19, 19), np.float32), np.full((19, 19), 255, np.uint8)
    assert filled(grey, mask)[0] is grey
    assert filled(grey, mask)[1] is mask
    grey[9, 9], mask[9, 9] = np.nan, 0
    before = grey.copy(), mask.copy()
    result, around = filled(grey, mask)
    np.testing.assert_array_equal(grey, before[0])
    np.testing.assert_array_equal(mask, before[1])
    np.testing.assert_array_equal(result, 1)
    assert (around == 0).sum() == (2 * REACH + 1) ** 2


def test_filled_with_one_known_pixel() -> None:
    for place in ((0, 0), (4, 6), (8, 12)):
        grey, mask = np.full((9, 13), np.inf, np.float32), np.zeros((9, 13), np.uint8)
        grey[place] = 7
        result, around = filled(grey, mask)
        np.testing.assert_array_equal(result, 7)
        assert not around.any()


# The picture made smaller.

@pytest.mark.parametrize(('size', 'scale', 'expected'), [
    (100, 0.5, 50), (101, 0.5, 50), (103, 0.5, 52), (7, 0.73, 5), (1, 0.05, 1), (9, 0.05, 1), (31, 0.05, 2)])
def test_size_of_the_smaller_picture(size: int, scale: float, expected: int) -> None:
    for shape, small in (((size, 20), (expected, round(20 * scale))), ((20, size), (round(20 * scale), expected))):
        image, mask = smaller(np.zeros(shape, np.uint8), np.ones(shape, np.uint8), scale)
        assert image.shape == mask.shape == small
    assert smaller(np.zeros((size, 20), np.uint8), None, scale)[1] is None


@pytest.mark.parametrize('dtype', TYPES)
def test_smaller_is_the_mean(dtype: Any) -> None:
    image = scene(96, 120, dtype)
    for factor in (2, 3, 4):
        expected = image.astype(float).reshape(96 // factor, factor, 120 // factor, factor).mean((1, 3))
        result, _ = smaller(image, None, 1 / factor)
        assert result.dtype == dtype
        np.testing.assert_allclose(result, expected, atol=1e-3 if dtype == np.float32 else 0.51)
    result, _ = smaller(image, None, 0.73)
    assert result.astype(float).mean() == pytest.approx(image.astype(float).mean(), rel=2e-3)


@pytest.mark.parametrize('shape', [(69, 69), (129, 129), (58, 200), (97, 31), (40, 40)], ids=str)
@pytest.mark.parametrize('scale', [0.05, 0.25, 0.5, 0.73, 0.9])
def test_smaller_counts_where_all_of_it_does(shape: tuple[int, int], scale: float) -> None:
    """A single pixel that is masked takes every smaller pixel away that has a share of it, and no other."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        y, x = rng.integers(shape[0]), rng.integers(shape[1])
        mask = np.full(shape, 255, np.uint8)
        mask[y, x] = 0
        _, small = smaller(np.zeros(shape, np.uint8), mask, scale)
        expected = np.full(small.shape, 255)
        (top, bottom), (left, right) = (
            (place * few // many, -(-(place + 1) * few // many))
            for place, few, many in zip((int(y), int(x)), small.shape, shape, strict=True))
        expected[top:bottom, left:right] = 0
        np.testing.assert_array_equal(small, expected)


@BOTH
@pytest.mark.parametrize('scale', [0.25, 0.5, 0.73, 0.9])
def test_no_edge_where_the_mask_is_0_in_a_smaller_picture(profile: str, scale: float) -> None:
    rng = np.random.default_rng(0)
    extractor = LineFeatureExtractor(Parameters.profile(
        profile, scale=scale, alpha=1, T1=2, T2=1, noise_T1=0, noise_T2=0, min_chain=1, max_gap=0))
    some = 0
    for _ in range(60):
        shape = tuple(rng.integers(20, 120, 2))
        mask = rng.random(shape) > 0.01
        extractor.extract(rng.integers(0, 256, shape, np.uint8), mask)
        assert not extractor.edges()[~mask].any()
        some += extractor.edges().any()
    assert some > 50


SCALED = [(0.25, (320, 400)), (0.25, (323, 389)), (0.5, (240, 320)), (0.5, (211, 303)), (0.73, (211, 303)),
          (0.73, (240, 321))]


@BOTH
@pytest.mark.parametrize(('scale', 'shape'), SCALED)
@pytest.mark.parametrize('degrees', [17, 31, 52, 71, 100, 152])
def test_step_is_where_it_is_in_the_full_picture(
    profile: str, scale: float, shape: tuple[int, int], degrees: float,
) -> None:
    """A slanted edge, with its mid-point, angle, length and ends in full pixels, wherever it lies between pixels."""
    height, width = shape
    radians = math.radians(degrees)
    cos, sin = math.cos(radians), math.sin(radians)
    whole = min(width / max(abs(cos), 1e-9), height / max(abs(sin), 1e-9))
    for shift in (0, 1.3, 2.6):
        x, y = width / 2 - shift * sin, height / 2 + shift * cos
        found = extract(half_plane(height, width, degrees, x, y), scale=scale, profile=profile)
        segment = found[found['length'].argmax()]
        assert abs((segment['y'] - y) * cos - (segment['x'] - x) * sin) < 0.3
        assert abs((segment['theta'] - radians + math.pi / 2) % math.pi - math.pi / 2) < math.radians(0.5)
        assert 0.85 * whole < segment['length'] < 1.02 * whole + 2
        for end_x, end_y in (('x1', 'y1'), ('x2', 'y2')):
            assert abs((segment[end_y] - y) * cos - (segment[end_x] - x) * sin) < 0.7 / scale
        check_consistent(found)


@BOTH
@pytest.mark.parametrize(('scale', 'shape'), SCALED)
@pytest.mark.parametrize('degrees', [0, 90])
def test_upright_step_is_where_it_is_in_the_full_picture(
    profile: str, scale: float, shape: tuple[int, int], degrees: float,
) -> None:
    """It lies in one row or column of the smaller picture: half a pixel of that off at most, and not to one side."""
    height, width = shape
    rows = degrees == 0
    errors = []
    for shift in (np.arange(16) + 0.5) / 16 / scale:
        x, y = width // 2 + shift, height // 2 + shift
        found = extract(half_plane(height, width, degrees, x, y), scale=scale, profile=profile)
        assert len(found) == 1
        errors.append(float(found['y'][0] - y if rows else found['x'][0] - x))
        assert found['length'][0] == pytest.approx((width if rows else height) - 1, abs=1 / scale + 1)
        check_consistent(found)
    assert max(abs(error) for error in errors) < 0.5 / scale + 0.1
    assert abs(np.mean(errors)) < 0.3


@BOTH
@pytest.mark.parametrize('degrees', [0, 90])
def test_step_in_the_middle_of_a_smaller_pixel(profile: str, degrees: float) -> None:
    """Nothing is rounded then."""
    for scale, place in ((0.5, 50.5), (0.25, 49.5), (0.25, 53.5), (0.2, 52)):
        found = extract(half_plane(100, 100, degrees, place, place), scale=scale, profile=profile)
        assert len(found) == 1
        assert found['y' if degrees == 0 else 'x'][0] == pytest.approx(place, abs=1e-4)
        assert found['theta'][0] == pytest.approx(math.radians(degrees), abs=1e-6)
        low, high = sorted((found['x1'][0], found['x2'][0]) if degrees == 0 else (found['y1'][0], found['y2'][0]))
        assert low == pytest.approx(0.5 / scale - 0.5, abs=1e-4)
        assert high == pytest.approx(99.5 - 0.5 / scale, abs=1e-4)


@BOTH
def test_sizes_that_are_rounded_turn_the_segments(profile: str) -> None:
    """Where the scale across is another than down, angles are of the full picture all the same."""
    for height, width in ((19, 400), (400, 19), (29, 290)):
        degrees = math.degrees(math.atan2(height, width))
        image = half_plane(height, width, degrees, width / 2, height / 2)
        found = extract(image, scale=0.25, min_chain=3, min_size=3, profile=profile)
        assert len(found) > 0
        check_consistent(found)
        segment = found[found['length'].argmax()]
        assert math.degrees(segment['theta']) == pytest.approx(degrees, abs=1.5)


@BOTH
@pytest.mark.parametrize('dtype', TYPES)
@pytest.mark.parametrize('channels', [1, 3, 4])
def test_scale_is_that_of_the_smaller_picture(profile: str, dtype: Any, channels: int) -> None:
    """Extracted from the means; brought to full pixels about the corner of the picture, not the centre of a pixel."""
    image = scene(96, 120, dtype, channels)
    grey = image if channels == 1 else cv2.cvtColor(
        np.ascontiguousarray(image[..., :3]), cv2.COLOR_BGR2GRAY)
    small = cv2.resize(grey, (60, 48), interpolation=cv2.INTER_AREA)
    expected, found = extract(small, profile=profile), extract(image, scale=0.5, profile=profile)
    assert len(found) == len(expected) > 5
    np.testing.assert_allclose(end_points(found), (end_points(expected) + 0.5) * 2 - 0.5, atol=1e-4)
    np.testing.assert_allclose(found['length'], 2 * expected['length'], atol=1e-4)
    np.testing.assert_array_equal(found['theta'], expected['theta'])
    np.testing.assert_array_equal(found['size'], expected['size'])
    check_consistent(found)
    assert same(extract(padded(image), scale=0.5, profile=profile), found)


def test_scale_that_changes_no_size() -> None:
    """Of a small picture nothing is left to make smaller; nor has it segments that are long enough to be refined."""
    image = np.tile(np.array([[20, 220]], np.uint8).repeat(3, 1), (6, 1))
    given = {'profile': 'paper', 'T1': 2, 'T2': 1, 'min_chain': 1, 'min_size': 2}
    assert len(extract(image, **given)) > 0
    assert same(extract(image, scale=0.95, **given), extract(image, **given))


@BOTH
def test_scale_within_a_region(profile: str) -> None:
    """The region is cut out first and then made smaller."""
    image = scene(dtype=np.float32)
    of_crop = extract(image[10:81, 20:109].copy(), scale=0.6, profile=profile)
    found = extract(image, scale=0.6, roi=(20, 10, 89, 71), profile=profile)
    check_shifted(found, of_crop, 20, 10)
    assert same(extract(image, np.ones(image.shape, bool), scale=0.6, roi=(20, 10, 89, 71), profile=profile), found)


# The region of interest, in the result.

@BOTH
@pytest.mark.parametrize('layout', [np.asarray, padded, np.asfortranarray, lambda image: image[::-1].copy()[::-1]],
                         ids=['plain', 'padded', 'fortran', 'upside down'])
@pytest.mark.parametrize('channels', [1, 3, 4])
@pytest.mark.parametrize('dtype', TYPES)
def test_region_is_extracting_the_crop(profile: str, dtype: Any, channels: int, layout: Any) -> None:
    image = scene(dtype=dtype, channels=channels)
    of_crop = extract(np.ascontiguousarray(image[18:72, 30:90]), profile=profile)
    given = layout(image)
    in_pixels = extract(given, roi=(30, 18, 60, 54), profile=profile)
    check_shifted(in_pixels, of_crop, 30, 18)
    assert same(extract(given, roi=(0.25, 0.2, 0.5, 0.6), profile=profile), in_pixels)
    assert same(extract(given, roi=np.array([30, 18, 60, 54]), profile=profile), in_pixels)


@BOTH
def test_region_at_the_first_pixel_is_the_crop_to_the_bit(profile: str) -> None:
    image = scene()
    of_crop = extract(image[:54, :60].copy(), profile=profile)
    found = extract(image, roi=(0, 0, 60, 54), profile=profile)
    assert len(found) > 0
    for name in set(SEGMENT_DTYPE.names or ()) - {'length', 'intercept', 'rho'}:
        np.testing.assert_array_equal(found[name], of_crop[name], err_msg=name)


@BOTH
def test_region_is_clipped_at_the_border(profile: str) -> None:
    image = scene()
    of_crop = extract(image[40:, 50:].copy(), profile=profile)
    clipped = extract(image, roi=(50, 40, 1000, 1000), profile=profile)
    assert same(clipped, extract(image, roi=(50, 40, 70, 50), profile=profile))
    check_shifted(clipped, of_crop, 50, 40)
    assert same(extract(image, roi=(0, 0, 120, 90), profile=profile), extract(image, profile=profile))
    assert same(extract(image, roi=(0, 0, 1e6, 1e6), profile=profile), extract(image, profile=profile))


@pytest.mark.parametrize('roi', [(120, 0, 5, 5), (0, 90, 5, 5), (1, 1, 1, 1), (0.5, 0, 0.001, 1)], ids=str)
def test_region_outside_the_image(roi: tuple[float, ...]) -> None:
    extractor = LineFeatureExtractor(Parameters(roi=roi))
    for call in (extractor.extract, extractor.stages):
        for channels in (1, 3):
            with pytest.raises(ValueError, match='^roi .*120×90') as caught:
                call(scene(channels=channels))
            assert str([float(value) for value in roi]) in str(caught.value)


@BOTH
def test_region_of_one_pixel(profile: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile, roi=(119, 89, 1, 1)))
    assert len(extractor.extract(scene())) == 0
    assert extractor.stages(scene()).grey.tolist() == [[scene()[89, 119]]]


def test_kernels_are_warmed_up_whatever_the_region() -> None:
    extractor = LineFeatureExtractor(Parameters(roi=(1000, 1000, 5, 5), scale=0.05))
    extractor.warm_up()
    assert extractor.edges().shape == (0, 0)


# Segments brought to the full picture.

LINES = [(3, 4, 20, 4), (5, 30, 5, 2), (1, 2, 40, 50), (30, 5, 9, 35), (10, 10, 10.001, 30), (0, 0, 7, 0.0)]


def test_placed_shifts() -> None:
    expected = made(*((x1 + 100, y1 + 50, x2 + 100, y2 + 50) for x1, y1, x2, y2 in LINES))
    found = placed(made(*LINES), 100, 50, 1, 1)
    for name in SEGMENT_DTYPE.names or ():
        steep = np.abs(expected['intercept']) > 1e4
        np.testing.assert_allclose(found[name][~steep], expected[name][~steep], atol=1e-4, err_msg=name)
    check_consistent(found)


@pytest.mark.parametrize(('across', 'down'), [(2, 2), (4, 4), (1, 2), (3, 1.5), (1.01, 1), (20, 29)])
def test_placed_scales(across: float, down: float) -> None:
    """About the corner of the first pixel, which is at (-0.5, -0.5)."""
    expected = made(*(((x1 + 0.5) * across + 6.5, (y1 + 0.5) * down + 1.5, (x2 + 0.5) * across + 6.5,
                       (y2 + 0.5) * down + 1.5) for x1, y1, x2, y2 in LINES))
    found = placed(made(*LINES), 7, 2, across, down)
    for name in SEGMENT_DTYPE.names or ():
        if name not in ('intercept', 'rho'):
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-5, atol=1e-4, err_msg=name)
    np.testing.assert_allclose(found['rho'], expected['rho'], rtol=1e-4, atol=2e-3)
    check_consistent(found)


def test_placed_is_in_place() -> None:
    segments = made(*LINES)
    assert placed(segments, 1, 2, 3, 4) is segments
    assert len(placed(np.empty(0, SEGMENT_DTYPE), 1, 2, 3, 4)) == 0


@pytest.mark.parametrize(('across', 'down'), [(1, 1), (2, 2), (4.1, 3.9), (1, 1.4)])
def test_placed_keeps_the_range_of_orientations(across: float, down: float) -> None:
    """Vertical is pi/2, has no intercept, and what is just short of it does not become -pi/2."""
    segments = made(*[(5, 2, 5, 30)] * 4)
    segments['theta'][1:] = [np.nextafter(np.float32(math.pi / 2), np.float32(0)),
                             -np.nextafter(np.float32(math.pi / 2), np.float32(0)), 1.5]
    found = placed(segments, 3, 4, across, down)
    assert found['theta'][0] == np.float32(math.pi / 2)
    assert np.isnan(found['intercept'][:3]).all()
    assert np.isfinite(found['intercept'][3])
    assert (found['theta'] > -np.float32(math.pi / 2)).all()
    assert (found['theta'] <= np.float32(math.pi / 2)).all()
    assert found['theta'][2] < -1.57
    assert found['rho'][0] == pytest.approx(-found['x'][0], abs=1e-4)


# What is kept of the segments.

@pytest.mark.parametrize(('min_length', 'expected'), [
    (0, [0, 1, 2, 3]), (2.5, [0, 1, 2, 3]), (2.6, [1, 2, 3]), (7, [1, 2, 3]), (math.nextafter(7, 8), [1, 2, 3]),
    (7.001, [3]), (21, [3]), (21.001, [])])
def test_min_length(min_length: float, expected: list[int]) -> None:
    """What is just as long is kept; lengths are float32."""
    assert kept(turned([2.5, 7, 7, 21], [0] * 4), min_length=min_length) == expected


@BOTH
def test_min_length_of_a_float32(profile: str) -> None:
    """A length that was read from the result keeps the segment it came from."""
    segments = extract(scene(), profile=profile)
    for length in segments['length']:
        assert (extract(scene(), min_length=float(length), profile=profile)['length'] >= length).all()
        assert length in extract(scene(), min_length=float(length), profile=profile)['length']
        assert length not in extract(scene(), min_length=float(length) + 1e-3, profile=profile)['length']


@BOTH
def test_min_length_is_of_the_full_picture(profile: str) -> None:
    image = half_plane(100, 100, 90, 51, 50)
    length = float(extract(image, scale=0.25, profile=profile)['length'][0])
    assert 90 < length < 100
    assert len(extract(image, scale=0.25, min_length=90, profile=profile)) == 1
    assert len(extract(image, scale=0.25, min_length=length + 0.1, profile=profile)) == 0


@pytest.mark.parametrize(('count', 'expected'), [
    (0, [0, 1, 2, 3, 4, 5]), (1, [3]), (2, [1, 3]), (3, [1, 3, 5]), (4, [0, 1, 3, 5]), (5, [0, 1, 2, 3, 5]),
    (6, [0, 1, 2, 3, 4, 5]), (7, [0, 1, 2, 3, 4, 5]), (1000000, [0, 1, 2, 3, 4, 5])])
def test_max_segments(count: int, expected: list[int]) -> None:
    """The longest, in the order they had."""
    assert kept(turned([4, 8, 3, 9, 1, 5], [0] * 6), max_segments=count) == expected


def test_max_segments_of_equal_length_are_the_first() -> None:
    lengths = [5.0, 7, 5, 5, 7, 5, 3] * 9
    for count in range(1, 64):
        order = sorted(range(63), key=lambda k: (-lengths[k], k))
        assert kept(turned(lengths, [0] * 63), max_segments=count) == sorted(order[:count])


@BOTH
def test_max_segments_of_an_image(profile: str) -> None:
    everything = extract(scene(), profile=profile)
    assert len(everything) > 5
    for count in (1, 3, 5):
        longest = sorted(np.argsort(-everything['length'], kind='stable')[:count])
        assert same(extract(scene(), max_segments=count, profile=profile), everything[longest])
    assert same(extract(scene(), max_segments=len(everything), profile=profile), everything)


THETAS = [-1.5, -0.7, -0.25, 0.0, 0.25, 0.7, 1.5, math.pi / 2]


@pytest.mark.parametrize(('low', 'high', 'expected'), [
    (-1.5708, 1.5708, [0, 1, 2, 3, 4, 5, 6, 7]),
    (-math.pi / 2, math.pi / 2, [0, 1, 2, 3, 4, 5, 6, 7]),
    (-1.5708, 0.25, [0, 1, 2, 3, 4]),
    (-0.25, 1.5708, [2, 3, 4, 5, 6, 7]),
    (-0.25, 0.25, [2, 3, 4]),
    (-0.2499, 0.2499, [3]),
    (0.25, 0.25, [4]),
    (0.7, math.pi / 2, [5, 6, 7]),
    (0.7, 1.5708, [5, 6, 7]),
    (0.7, 1.5707, [5, 6]),
    (math.pi / 2, math.pi / 2, [7]),
    (1.5, -1.5, [0, 6, 7]),
    (1.51, -1.51, [7]),
    (0.7, -0.7, [0, 1, 5, 6, 7]),
    (0.25, -0.25, [0, 1, 2, 4, 5, 6, 7]),
    (0.1, 0.0, [0, 1, 2, 3, 4, 5, 6, 7]),
    (1.5708, -1.5708, []),
    (1.5708, -1.4, [0]),
    (1.4, -1.5708, [6, 7]),
])
def test_band_of_orientations(low: float, high: float, expected: list[int]) -> None:
    """Both ends belong to it; with the first above the last it goes through the vertical."""
    assert kept(turned([5.0] * 8, THETAS), theta_min=low, theta_max=high) == expected


def test_every_orientation_is_in_a_band_or_the_one_around_it() -> None:
    thetas = np.linspace(-math.pi / 2, math.pi / 2, 200)[1:].tolist()
    segments = turned([5.0] * 199, thetas)
    for low, high in ((-1, 0.5), (0.123, 1.234), (-1.3, -0.2)):
        inside, around = (kept(segments, theta_min=a, theta_max=b) for a, b in ((low, high), (high, low)))
        assert sorted(inside + around) == list(range(199))
        assert 0 < len(inside) < 199


@BOTH
@pytest.mark.parametrize('degrees', [0, 30, 90, 150])
def test_band_of_orientations_of_an_image(profile: str, degrees: float) -> None:
    image = half_plane(100, 120, degrees, 60, 50)
    theta = (math.radians(degrees) + math.pi / 2) % math.pi - math.pi / 2
    theta = math.pi / 2 if degrees == 90 else theta
    low, high = theta - 0.05, theta + 0.05
    high -= math.pi * (high > 1.5708)
    expected = extract(image, profile=profile)
    assert len(expected) == 1
    assert same(extract(image, theta_min=low, theta_max=high, profile=profile), expected)
    assert len(extract(image, theta_min=high, theta_max=low, profile=profile)) == 0


@BOTH
def test_vertical_is_a_right_angle(profile: str) -> None:
    found = extract(half_plane(100, 120, 90, 60.5, 50), theta_min=math.pi / 2, theta_max=math.pi / 2, profile=profile)
    assert found['theta'].tolist() == [np.float32(math.pi / 2)]


def test_longest_of_those_in_the_band() -> None:
    """Length and orientation are looked at before the longest are taken."""
    segments = turned([9, 2, 8, 7, 6, 3], [1.0, 0, 0, 1.0, 0, 0])
    assert kept(segments, theta_min=-0.5, theta_max=0.5, max_segments=3) == [2, 4, 5]
    assert kept(segments, theta_min=-0.5, theta_max=0.5, max_segments=3, min_length=5) == [2, 4]


def test_nothing_to_select_from() -> None:
    nothing = np.empty(0, SEGMENT_DTYPE)
    found = selected(nothing, Parameters(min_length=1, max_segments=1, theta_min=0))
    assert found.shape == (0,)
    assert found.dtype == SEGMENT_DTYPE


def test_selection_leaves_what_it_was_given() -> None:
    segments = turned([9, 2, 8], [1.0, 0, 0])
    before = segments.copy()
    assert len(selected(segments, Parameters(min_length=3, theta_max=0.5, max_segments=1))) == 1
    assert same(segments, before)


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(st.integers(0, 12), st.integers(-15, 15)), max_size=30), st.integers(0, 12),
       st.integers(0, 10), st.integers(-15, 15), st.integers(-15, 15))
def test_selection_is_as_it_is_described(
    lines: list[tuple[int, int]], min_length: int, count: int, low: int, high: int,
) -> None:
    segments = turned([length for length, _ in lines], [theta / 10 for _, theta in lines])
    expected = [k for k, (length, theta) in enumerate(lines) if length >= min_length
                and (low <= theta <= high if low <= high else theta >= low or theta <= high)]
    if count:
        expected = sorted(sorted(expected, key=lambda k: -lines[k][0])[:count])
    assert kept(segments, min_length=min_length, max_segments=count, theta_min=low / 10,
                theta_max=high / 10) == expected


# The picture of the edges.

@BOTH
@pytest.mark.parametrize('thinning', THINNINGS)
@pytest.mark.parametrize('shape', [(90, 120), (1, 1), (61, 47)], ids=str)
def test_edges_are_those_of_the_stages(profile: str, thinning: str, shape: tuple[int, int]) -> None:
    """Pixels that fill gaps are none."""
    image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    for max_gap in (0, 8):
        extractor = LineFeatureExtractor(Parameters.profile(profile, thinning=thinning, max_gap=max_gap, T1=15, T2=8))
        stages = extractor.stages(image)
        expected = np.where(stages.edges != 0, 255, 0)
        for call in (extractor.stages, extractor.extract):
            call(image)
            edges = extractor.edges()
            assert edges.dtype == np.uint8
            np.testing.assert_array_equal(edges, expected)
        assert expected.any() == (shape != (1, 1))


@BOTH
def test_edges_in_a_region(profile: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile, roi=(30, 18, 60, 54), max_gap=0))
    stages = extractor.stages(scene())
    edges = extractor.edges()
    assert edges.shape == (90, 120)
    np.testing.assert_array_equal(edges[18:72, 30:90], np.where(stages.edges != 0, 255, 0))
    assert edges.any()
    edges[18:72, 30:90] = 0
    assert not edges.any()


@BOTH
@pytest.mark.parametrize('scale', [0.25, 0.5, 0.73, 0.9])
@pytest.mark.parametrize('roi', [(0, 0, 1, 1), (11, 7, 83, 61)], ids=str)
def test_edges_of_a_smaller_picture_are_enlarged(profile: str, scale: float, roi: tuple[int, ...]) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(
        profile, scale=scale, roi=roi, alpha=1, noise_T1=0, noise_T2=0, max_gap=0, min_chain=2))
    small = extractor.stages(scene()).edges
    x, y, width, height = region(roi, 120, 90)
    assert small.shape == (round(height * scale), round(width * scale))
    expected = np.zeros((90, 120))
    rows, columns = (np.arange(size) * few // size for size, few in zip((height, width), small.shape, strict=True))
    expected[y:y + height, x:x + width] = np.where(small != 0, 255, 0)[rows][:, columns]
    assert expected.any()
    np.testing.assert_array_equal(extractor.edges(), expected)


def test_edges_before_the_first_frame() -> None:
    edges = LineFeatureExtractor().edges()
    assert edges.shape == (0, 0)
    assert edges.dtype == np.uint8


@BOTH
def test_edges_are_not_overwritten(profile: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    extractor.extract(scene())
    edges = extractor.edges()
    before = edges.copy()
    edges[:] = 7
    np.testing.assert_array_equal(extractor.edges(), before)
    edges = extractor.edges()
    extractor.extract(scene(seed=1))
    np.testing.assert_array_equal(edges, before)
    extractor.extract(np.zeros((30, 20), np.uint8))
    assert extractor.edges().shape == (30, 20)
    assert not extractor.edges().any()


@pytest.mark.parametrize(('image', 'parameters'), [
    (np.zeros((200, 300), np.uint8), {'intensity_min': 300.0}), (np.full((20, 30), np.nan, np.float32), {}),
    (np.zeros((20, 30), np.uint8), {'roi': (40, 0, 5, 5)}), (None, {}),
], ids=['intensity', 'nan', 'roi', 'none'])
def test_edges_after_an_error_are_of_the_frame_before(image: Any, parameters: dict[str, Any]) -> None:
    extractor = LineFeatureExtractor()
    extractor.extract(scene())
    before = extractor.edges()
    extractor.parameters = Parameters(**parameters)
    with pytest.raises((TypeError, ValueError)):
        extractor.extract(image)
    after = extractor.edges()
    assert after.shape == before.shape
    np.testing.assert_array_equal(after, before)


# One extractor, other parameters, other frames.

CHOSEN = [
    {}, {'roi': (0.1, 0.2, 0.7, 0.6)}, {'scale': 0.5}, {'scale': 0.6, 'roi': (7, 9, 100, 70)}, {'max_segments': 3},
    {'theta_min': 1.0, 'theta_max': -1.0}, {'min_length': 20}, {'operator': 'sobel', 'scale': 0.8}, {'n': 0},
    {'thinning': 'morphological', 'roi': (0, 0, 50, 50)}, {'thinning': 'none', 'scale': 0.7}]


@BOTH
def test_parameters_may_be_replaced_between_frames(profile: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    mask = masks()[2]
    frames = [(scene(), None), (scene(dtype=np.float32, channels=3), mask), (scene(150, 70, np.uint16), None)]
    results = set()
    for chosen in [*CHOSEN, *reversed(CHOSEN)]:
        for image, given_mask in frames:
            extractor.parameters = Parameters.profile(profile, **chosen)
            fresh = LineFeatureExtractor(Parameters.profile(profile, **chosen))
            expected = fresh.extract(image, given_mask)
            assert same(extractor.extract(image, given_mask), expected)
            np.testing.assert_array_equal(extractor.edges(), fresh.edges())
            results.add(expected.tobytes())
    assert len(results) > 2 * len(CHOSEN)


@pytest.mark.parametrize('chosen', CHOSEN, ids=str)
def test_same_input_gives_the_same_bytes(chosen: dict[str, Any]) -> None:
    """After an error too; and the image and the mask are left alone, which may be read-only."""
    extractor = LineFeatureExtractor(Parameters(**chosen))
    for dtype, channels in ((np.uint8, 1), (np.uint16, 3), (np.float32, 1), (np.float32, 4)):
        image, mask = scene(dtype=dtype, channels=channels), masks()[0]
        if dtype == np.float32:
            image[60:70, 80:90] = np.nan
        image.flags.writeable = mask.flags.writeable = False
        before = image.tobytes(), mask.tobytes()
        expected = extractor.extract(image, mask)
        assert len(extract(image, mask, **{**chosen, 'theta_min': -1.5708, 'theta_max': 1.5708})) > 0
        edges = extractor.edges()
        assert same(extractor.extract(image, mask), expected)
        for wrong in (None, np.zeros((0, 5), np.uint8), np.full((90, 120), np.inf, np.float32)):
            with pytest.raises((TypeError, ValueError)):
                extractor.extract(wrong, mask)
        with pytest.raises(ValueError, match='^mask must have'):
            extractor.extract(image, mask[1:])
        assert same(extractor.extract(image, mask), expected)
        assert same(extractor.stages(image, mask).segments, expected)
        assert same(extract(image, mask, **chosen), expected)
        np.testing.assert_array_equal(extractor.edges(), edges)
        assert (image.tobytes(), mask.tobytes()) == before


@BOTH
def test_stages_are_of_the_working_picture(profile: str) -> None:
    """But for the segments, which are those of linking that are selected, in full pixels."""
    parameters = Parameters.profile(profile, roi=(20, 10, 90, 70), scale=0.5, min_length=9, max_segments=3,
                                    theta_min=-1, theta_max=1.4)
    stages = LineFeatureExtractor(parameters).stages(scene())
    small = cv2.resize(scene()[10:80, 20:110], (45, 35), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(stages.grey, small)
    plain = LineFeatureExtractor(Parameters.profile(profile)).stages(small)
    for name in ('candidates', 'strong', 'edges', 'chain_pixels', 'codes_after', 'blob_pixels', 'unlinked', 'linked'):
        assert getattr(stages, name).tobytes() == getattr(plain, name).tobytes(), name
    assert same(plain.linked, plain.segments)
    assert 0 < len(stages.segments) < len(stages.linked)
    assert same(stages.segments, selected(placed(stages.linked.copy(), 20, 10, 2, 2), parameters))


# Truths that hold for every image.

@st.composite
def cases(draw: Any) -> tuple[Image, Image | None, Parameters]:
    height, width = draw(st.integers(1, 60)), draw(st.integers(1, 60))
    dtype, channels = draw(st.sampled_from(TYPES)), draw(st.sampled_from([1, 1, 3, 4]))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    image = rng.uniform(0, 65535 if dtype == np.uint16 else 255, (height, width, channels))
    image = cv2.GaussianBlur(image, (0, 0), draw(st.sampled_from([0.1, 0.5, 1]))).reshape(image.shape).astype(dtype)
    mask = None
    if draw(st.booleans()):
        mask = np.asarray(rng.random((height, width)) < draw(st.sampled_from([0.98, 0.5, 0, 1])),
                          draw(st.sampled_from([np.uint8, bool])))
    if dtype == np.float32 and draw(st.integers(0, 3)):
        bad = rng.random((height, width)) < 0.01 if mask is None or draw(st.booleans()) else mask == 0
        image[bad] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    roi = draw(st.just((0, 0, 1, 1)) | st.tuples(*[st.floats(0, 0.4)] * 2, *[st.floats(0.2, 1)] * 2)
               | st.tuples(*[st.integers(0, 20)] * 2, *[st.integers(1, 70)] * 2)
               | st.tuples(*[st.floats(0, 1)] * 2, *[st.floats(1e-3, 1)] * 2))
    scale = draw(st.just(1.0) | st.floats(0.3, 1) | st.floats(0.05, 1))
    others = draw(st.fixed_dictionaries({}, optional={
        'min_length': st.floats(0, 9), 'max_segments': st.integers(0, 5), 'theta_min': st.floats(-1.5708, 1.5708),
        'theta_max': st.floats(-1.5708, 1.5708), 'thinning': st.sampled_from(THINNINGS),
        'operator': st.sampled_from(['deriche', 'sobel', 'dog'])}))
    return image[..., 0] if channels == 1 else image, mask, Parameters.profile(
        draw(st.sampled_from(['default', 'paper'])), T1=3, T2=1, min_chain=2, min_size=2, roi=roi, scale=scale,
        **others)


def why_not(image: Image, mask: Image | None, roi: tuple[float, ...]) -> str:
    """How the message begins that says why there can be no result; '' where there can."""
    height, width = image.shape[:2]
    x, y, w, h = roi if max(roi) > 1 else (roi[0] * width, roi[1] * height, roi[2] * width, roi[3] * height)
    part = (slice(round(y), min(round(y + h), height)), slice(round(x), min(round(x + w), width)))
    if 0 in image[part].shape[:2]:
        return '^roi .* leaves nothing of an image'
    finite = np.isfinite(image[part])
    if finite.ndim == 3:
        finite = finite[..., :3].all(2)
    if not finite.all() and (mask is None or not finite[mask[part] != 0].all()):
        return '^image must be finite'
    return '' if finite.any() else '^image must have finite pixels, got none'


@settings(max_examples=400, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(cases())
def test_any_image_mask_and_region(case: tuple[Image, Image | None, Parameters]) -> None:
    image, mask, parameters = case
    height, width = image.shape[:2]
    extractor = LineFeatureExtractor(parameters)
    reason = why_not(image, mask, parameters.roi)
    if reason:
        with pytest.raises(ValueError, match=reason):
            extractor.extract(image, mask)
        return
    found = extractor.extract(image, mask)
    assert found.dtype == SEGMENT_DTYPE
    unknown = {'intercept'} if parameters.refine else {
        'intercept', 'sigma_theta', 'sigma_offset', 'contrast', 'log_nfa'}
    for name in SEGMENT_DTYPE.names or ():
        assert np.isfinite(found[name]).all() or name in unknown, name
    x, y, w, h = region(parameters.roi, width, height)
    for end, low, size in (('x1', x, w), ('x2', x, w), ('y1', y, h), ('y2', y, h)):
        assert (found[end] >= low - 0.5 - 1e-4).all()
        assert (found[end] <= low + size - 0.5 + 1e-4).all()
    check_consistent(found)
    assert (found['length'] >= np.float32(parameters.min_length)).all()
    assert parameters.max_segments == 0 or len(found) <= parameters.max_segments
    edges = extractor.edges()
    assert edges.shape == (height, width)
    inside = np.zeros((height, width), bool)
    inside[y:y + h, x:x + w] = True
    assert not edges[~inside].any()
    assert same(LineFeatureExtractor(parameters).extract(image, mask), found)
    if mask is not None and parameters.scale == 1:
        everything = dataclasses.replace(parameters, max_gap=0)
        extractor.parameters = everything
        extractor.extract(image, mask)
        assert not extractor.edges()[mask == 0].any()

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from line_feature_node.core.blobs import BLOB_DTYPE, Blobs
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.features import LINE_DTYPE, SEGMENT_DTYPE, compute_lines, segments_of
from line_feature_node.core.parameters import Parameters

Pixel = tuple[int, int]

#: Far from the border of this image end points are not clipped.
LARGE = (4000, 4000)


def blobs_of(
    attributes: NDArray[np.void], pixels: NDArray[np.integer], offsets: NDArray[np.integer], filled: NDArray[np.bool_],
) -> Blobs:
    """Blobs of pixels (x, y), with the sums of 1, x, y, x^2, x y and y^2 over those that do not fill a gap."""
    x, y = pixels.T.astype(float)
    parts = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], -1) * ~filled[:, None]
    moments = np.array([parts[first:last].sum(0) for first, last in pairwise(offsets)]).reshape(-1, 6)
    return Blobs(attributes, moments, offsets[:-1], offsets[1:], np.arange(len(attributes), dtype=np.int32))


def segments(
    blobs: list[list[Pixel]], shape: tuple[int, int] = LARGE, codes: list[int] | None = None,
    bridged: set[Pixel] = frozenset(), **parameters: Any,
) -> NDArray[np.void]:
    """The segments of line-blobs, each given as its pixels (x, y)."""
    pixels = np.array([pixel for blob in blobs for pixel in blob], np.int64).reshape(-1, 2)
    attributes = np.zeros(len(blobs), BLOB_DTYPE)
    for k, blob in enumerate(blobs):
        x, y = zip(*blob, strict=True)
        attributes[k] = (codes[k] if codes else 1, len(blob), min(y), max(y), min(x), max(x), True)
    offsets = np.cumsum([0] + [len(blob) for blob in blobs]).astype(np.int32)
    filled = np.array([tuple(pixel) in bridged for pixel in pixels.tolist()], np.bool_)
    lines, count = compute_lines(blobs_of(attributes, pixels, offsets, filled), shape,
                                 Parameters(**{'min_size': 2, **parameters}), Buffers())
    assert lines.size >= 2 * count
    return segments_of(lines, np.ones(count, np.bool_))


def segment(blob: list[Pixel], **options: Any) -> Any:
    [only] = segments([blob], **options)
    return only


def ends(record: Any) -> list[float]:
    return [float(record[name]) for name in ('x1', 'y1', 'x2', 'y2')]


def moments(blob: list[Pixel]) -> tuple[float, float, float, float, float]:
    """Mid-point (A.1) and central moments mu20, mu11, mu02 (A.3); no rounding makes a zero of them something else."""
    n = len(blob)
    x, y = np.array(blob, np.int64).T
    mu20, mu11, mu02 = (int(n * (a * b).sum() - a.sum() * b.sum()) / n for a, b in ((x, x), (x, y), (y, y)))
    return x.mean(), y.mean(), mu20, mu11, mu02


def line(*steps: Pixel, start: Pixel = (100, 200), repeat: int = 7) -> list[Pixel]:
    """A digital line that repeats its steps."""
    pixels = [start]
    for x, y in steps * repeat:
        pixels.append((pixels[-1][0] + x, pixels[-1][1] + y))
    return pixels


def block(width: int, height: int) -> list[Pixel]:
    return [(30 + x, 40 + y) for x in range(width) for y in range(height)]


PLUS = [(50, 50), (49, 50), (51, 50), (50, 49), (50, 51)]
BLOB = st.lists(st.tuples(st.integers(1000, 1030), st.integers(2000, 2030)), min_size=2, max_size=25, unique=True)


@pytest.mark.parametrize('orientation', ['principal_axis', 'least_squares'])
@pytest.mark.parametrize(('blob', 'theta'), [
    (line((1, 0)), 0),
    (line((-1, 0)), 0),
    (block(9, 2), 0),
    (block(3, 2), 0),
    (line((0, 1)), math.pi / 2),
    (line((0, -1)), math.pi / 2),
    (block(2, 9), math.pi / 2),
    (block(2, 3), math.pi / 2),
    (line((1, 1)), math.pi / 4),
    (line((-1, -1)), math.pi / 4),
    (line((1, -1)), -math.pi / 4),
    (line((-1, 1)), -math.pi / 4),
    ([(7, 9), (8, 9)], 0),
    ([(7, 9), (7, 8)], math.pi / 2),
    ([(7, 9), (8, 8)], -math.pi / 4),
])
def test_special_cases(blob: list[Pixel], theta: float, orientation: str) -> None:
    """(A.2) where it divides by zero, and on the diagonals."""
    found = segment(blob, orientation=orientation)['theta']
    assert found == np.float32(theta)
    assert not np.signbit(found) or theta < 0


@pytest.mark.parametrize('orientation', ['principal_axis', 'least_squares'])
@pytest.mark.parametrize('blob', [
    block(2, 2), block(3, 3), PLUS, [(x, y) for x in (0, 4) for y in (0, 4)],
    [(10, 10), (11, 11), (10, 12), (9, 11)],
    [(10, 10), (9, 9), (11, 11), (9, 11), (11, 9)],
], ids=['2x2', '3x3', 'plus', 'corners', 'diamond', 'X'])
def test_blob_without_orientation(blob: list[Pixel], orientation: str) -> None:
    assert segments([blob], orientation=orientation).size == 0
    # The blobs beside it are not touched.
    both = segments([line((1, 0)), blob, line((0, 1))], orientation=orientation)
    assert both['theta'].tolist() == [0, np.float32(math.pi / 2)]


@settings(max_examples=300, deadline=None)
@given(BLOB)
def test_principal_axis(blob: list[Pixel]) -> None:
    """The eigenvector of the greatest second moment."""
    x, y, mu20, mu11, mu02 = moments(blob)
    values, vectors = np.linalg.eigh([[mu20, mu11], [mu11, mu02]])
    assume(values[1] - values[0] > 1e-6 * values[1])
    found = segment(blob)
    assert found['x'] == np.float32(x)
    assert found['y'] == np.float32(y)
    assert found['z'] == 0
    theta = float(found['theta'])
    assert -math.pi / 2 < theta <= np.float32(math.pi / 2)
    across = vectors[0, 1] * math.sin(theta) - vectors[1, 1] * math.cos(theta)
    assert abs(across) < 1e-6


@settings(max_examples=300, deadline=None)
@given(BLOB)
def test_least_squares(blob: list[Pixel]) -> None:
    """The regression of y on x, of x on y for a blob that is rather steep."""
    x, y, mu20, mu11, mu02 = moments(blob)
    assume(mu11 or mu20 != mu02)
    found = segment(blob, orientation='least_squares')
    theta, points = float(found['theta']), np.array(blob, np.float64) - (x, y)
    if mu20 >= mu02:
        slope, _ = np.polyfit(points[:, 0], points[:, 1], 1)
        expected = math.atan2(slope, 1)
    else:
        slope, _ = np.polyfit(points[:, 1], points[:, 0], 1)
        expected = math.atan2(1, slope)
    assert abs(math.sin(theta - expected)) < 1e-6
    assert (found['x'], found['y']) == (np.float32(x), np.float32(y))


def literal_ends(blob: list[Pixel]) -> tuple[list[float], float]:
    """(A.4), (A.5) and (A.6) with the slope of the rectangle; and by how much the one case is nearer than the other."""
    x, y, mu20, mu11, mu02 = moments(blob)
    tan = math.tan(math.atan2(2 * mu11, mu20 - mu02) / 2)
    intercept = y - tan * x
    (x0, y0), (x1, y1) = np.min(blob, 0).tolist(), np.max(blob, 0).tolist()
    slope = (y1 - y0) / (x1 - x0)
    if abs(tan) > slope:
        return [(y0 - intercept) / tan, y0, (y1 - intercept) / tan, y1], abs(tan) - slope
    return [x0, tan * x0 + intercept, x1, tan * x1 + intercept], slope - abs(tan)


@settings(max_examples=500, deadline=None)
@given(BLOB)
def test_end_points(blob: list[Pixel]) -> None:
    assume(moments(blob)[3] and len({x for x, _ in blob}) > 1)
    expected, margin = literal_ends(blob)
    assume(margin > 1e-9)
    # Far from the border, and not where the line of a round blob runs away.
    assume(all(0 <= value < 4000 for value in expected))
    found = segment(blob)
    np.testing.assert_allclose(ends(found), expected, atol=2e-3)
    np.testing.assert_allclose(found['length'], math.dist(expected[:2], expected[2:]), atol=2e-3)


@pytest.mark.parametrize(('steps', 'first', 'last'), [
    ([(1, 0)], (100, 200), (107, 200)),
    ([(-1, 0)], (93, 200), (100, 200)),
    ([(0, 1)], (100, 200), (100, 207)),
    ([(0, -1)], (100, 193), (100, 200)),
    ([(1, 1)], (100, 200), (107, 207)),
    ([(-1, -1)], (93, 193), (100, 200)),
    # Neither is greater on a diagonal: (A.6), the smaller column first.
    ([(1, -1)], (100, 200), (107, 193)),
    ([(-1, 1)], (93, 207), (100, 200)),
])
@pytest.mark.parametrize('orientation', ['principal_axis', 'least_squares'])
def test_end_points_of_thin_lines_are_exact(
    steps: list[Pixel], first: Pixel, last: Pixel, orientation: str,
) -> None:
    found = segment(line(*steps), orientation=orientation)
    np.testing.assert_array_almost_equal_nulp(
        np.array(ends(found), np.float32), np.array([*first, *last], np.float32), 0 if 0 in steps[0] else 1)
    assert found['length'] == pytest.approx(math.dist(first, last), rel=1e-6)


@pytest.mark.parametrize('length', [2, 3, 8, 51, 1000, 3000])
@pytest.mark.parametrize('where', [(0, 0), (1, 17), (999, 613)])
def test_axis_parallel_lines_are_exact(length: int, where: Pixel) -> None:
    x, y = where
    across = segment([(x + k, y) for k in range(length)])
    assert ends(across) == [x, y, x + length - 1, y]
    assert (across['length'], across['theta'], across['intercept'], across['rho']) == (length - 1, 0, y, y)
    upright = segment([(x, y + k) for k in range(length)])
    assert ends(upright) == [x, y, x, y + length - 1]
    assert (upright['length'], upright['theta'], upright['rho']) == (length - 1, np.float32(math.pi / 2), -x)
    assert np.isnan(upright['intercept'])


@pytest.mark.parametrize(('steps', 'column_first'), [
    ([(3, 1)], True), ([(3, -1)], True), ([(-3, 1)], True), ([(-3, -1)], True),
    ([(1, 3)], False), ([(1, -3)], False), ([(-1, 3)], False), ([(-1, -3)], False),
])
def test_first_end(steps: list[Pixel], column_first: bool) -> None:
    """Of thick lines; (A.6) begins at the smallest column, (A.5) at the smallest row, and both end at the largest."""
    thin = line(*steps)
    # Thickness across the larger extent brings the rectangle's slope to one side of the line's.
    thick = sorted({(x + (not column_first) * k, y + column_first * k) for x, y in thin for k in range(2)})
    found = segment(thick)
    low, high = np.min(thick, 0), np.max(thick, 0)
    if column_first:
        assert (found['x1'], found['x2']) == (low[0], high[0])
    else:
        assert (found['y1'], found['y2']) == (low[1], high[1])


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 20)), min_size=2, max_size=20, unique=True))
def test_end_points_are_clipped_along_the_line(blob: list[Pixel]) -> None:
    """An image that the blob just fits in: ends stay on the line and inside, and move only when they were outside."""
    x, y, mu20, mu11, mu02 = moments(blob)
    assume(mu11 and len({x for x, _ in blob}) > 1)
    expected, margin = literal_ends(blob)
    assume(margin > 1e-9)
    shape = max(y for _, y in blob) + 1, max(x for x, _ in blob) + 1
    found = segment(blob, shape=shape)
    theta = math.atan2(2 * mu11, mu20 - mu02) / 2
    for (x0, y0), (x1, y1) in zip([expected[:2], expected[2:]], [ends(found)[:2], ends(found)[2:]], strict=True):
        assert -0.5 <= x1 <= shape[1] - 0.5
        assert -0.5 <= y1 <= shape[0] - 0.5
        assert abs((x1 - x) * math.sin(theta) - (y1 - y) * math.cos(theta)) < 1e-4
        if -0.5 <= x0 <= shape[1] - 0.5 and -0.5 <= y0 <= shape[0] - 0.5:
            assert (x1, y1) == pytest.approx((x0, y0), abs=1e-4)
        else:
            # On the border, between the mid-point and where the formula has it.
            assert min(abs(x1 + 0.5), abs(x1 - shape[1] + 0.5), abs(y1 + 0.5), abs(y1 - shape[0] + 0.5)) < 1e-4
            assert (x1 - x) * (x0 - x) + (y1 - y) * (y0 - y) >= -1e-4


def test_bent_blob_beside_the_border() -> None:
    """A long arm along the top and a hook down: the line leaves the image above, and is cut there."""
    hook = [(x, 0) for x in range(20)] + [(19, y) for y in range(1, 8)]
    far, near = segment([(x + 100, y + 100) for x, y in hook]), segment(hook, shape=(8, 20))
    assert far['y1'] - 100 < -0.5
    assert near['y1'] == -0.5
    assert near['x1'] > 0
    assert near['theta'] == far['theta']
    assert near['length'] < far['length']
    assert ends(near)[2:] == pytest.approx([far['x2'] - 100, far['y2'] - 100], abs=1e-4)


@settings(max_examples=200, deadline=None)
@given(BLOB)
def test_intercept_and_rho(blob: list[Pixel]) -> None:
    x, y, mu20, mu11, mu02 = moments(blob)
    assume(np.hypot(2 * mu11, mu20 - mu02) > 0)
    found = segment(blob)
    theta = math.atan2(2 * mu11, mu20 - mu02) / 2
    cos, sin = math.cos(theta), math.sin(theta)
    # The direction that points to the right, or down.
    rho = y * cos - x * sin
    if mu11 == 0 and mu20 < mu02:
        assert np.isnan(found['intercept'])
        assert found['rho'] == pytest.approx(-x, rel=1e-6)
    else:
        assert found['intercept'] == pytest.approx(y - math.tan(theta) * x, rel=1e-5, abs=1e-3 / cos)
        assert found['rho'] == pytest.approx(rho, rel=1e-5, abs=1e-3)
        # The line meets the y axis in the intercept; its distance from the origin is |rho|.
        assert found['rho'] == pytest.approx(found['intercept'] * cos, rel=1e-4, abs=1e-2)


@pytest.mark.parametrize(('blob', 'rho'), [
    (line((1, 0), start=(50, 30)), 30),
    (line((0, 1), start=(50, 30)), -50),
    (line((1, 1), start=(0, 0)), 0),
    (line((1, 1), start=(0, 10)), 10 / math.sqrt(2)),
    (line((1, 1), start=(10, 0)), -10 / math.sqrt(2)),
    (line((1, -1), start=(10, 20)), 30 / math.sqrt(2)),
])
def test_sign_of_rho(blob: list[Pixel], rho: float) -> None:
    assert segment(blob)['rho'] == pytest.approx(rho, abs=1e-5)


@pytest.mark.parametrize('height', [2 * 10**6, 10**8])
@pytest.mark.parametrize('leaning', [0, 1])
def test_nearly_vertical(height: int, leaning: int) -> None:
    """Below a cosine of 1e-6 there is no intercept, and an angle that rounds to -pi/2 is pi/2."""
    found = segment([(leaning, 0), (1 - leaning, height - 1)], shape=(height, 2))
    assert np.isnan(found['intercept'])
    assert np.isfinite(found['rho'])
    assert found['theta'] != np.float32(-math.pi / 2)
    assert math.cos(float(found['theta'])) == pytest.approx(1 / height, abs=2e-7)
    assert found['length'] == pytest.approx(height - 1)


@pytest.mark.parametrize(('size', 'min_size', 'count'), [(5, 5, 1), (4, 5, 0), (2, 2, 1), (1, 2, 0), (30, 31, 0)])
def test_min_size(size: int, min_size: int, count: int) -> None:
    assert segments([line((1, 0), repeat=size - 1)], min_size=min_size).size == count


def test_a_line_just_short_of_vertical_is_told_one_way_round() -> None:
    """To the digits of theta it is vertical: its ends, rho and theta are those of a line that goes down."""
    lines = np.zeros(1, LINE_DTYPE)
    lines[0] = 2, *[0] * 10, 5, 10, 1e-9, -1, 5, 20, 5, 0
    found = segments_of(lines, np.ones(1, np.bool_))[0]
    assert ends(found) == [5, 0, 5, 20]
    assert (found['theta'], found['rho'], found['length']) == (np.float32(math.pi / 2), -5, 20)


def test_labels_not_in_use_give_nothing() -> None:
    attributes = np.zeros(2, BLOB_DTYPE)
    attributes[1] = (3, 6, 4, 4, 10, 15, True)
    pixels, offsets = np.array([(x, 4) for x in range(10, 16)]), np.array([0, 0, 6], np.int32)
    lines, count = compute_lines(blobs_of(attributes, pixels, offsets, np.zeros(6, np.bool_)), (20, 38), Parameters(),
                                 Buffers())
    assert count == 1
    assert ends(segments_of(lines, np.ones(1, np.bool_))[0]) == [10, 4, 15, 4]


def test_bridged_pixels_do_not_count() -> None:
    straight = line((1, 0), start=(20, 20), repeat=9)
    gap = {(23, 20), (24, 20)}
    filled, whole = segment(straight, bridged=gap), segment(straight)
    assert (filled['size'], whole['size']) == (8, 10)
    assert filled['x'] == np.mean([x for x, y in straight if (x, y) not in gap])
    assert segments([straight], bridged=gap, min_size=8).size == 1
    assert segments([straight], bridged=gap, min_size=9).size == 0


def test_bridged_pixels_do_not_bend_the_line() -> None:
    """They are where no edge was found."""
    left, right = [(x, 20) for x in range(10, 20)], [(x, 20) for x in range(22, 30)]
    bulge = [(20, 21), (21, 21)]
    assert segment([*left, *bulge, *right], bridged=set(bulge))['theta'] == 0
    assert segment([*left, *bulge, *right])['theta'] != 0


@pytest.mark.parametrize('code', [1, 2, 3, 4])
def test_code(code: int) -> None:
    found = segments([line((1, 0)), line((0, 1))], codes=[code, 5 - code])
    assert found['code'].tolist() == [code, 5 - code]


def test_what_refinement_finds_out_is_unknown() -> None:
    found = segments([line((1, 0)), line((0, 1)), line((3, 2))])
    for name in ('sigma_theta', 'sigma_offset', 'contrast', 'log_nfa'):
        assert np.isnan(found[name]).all(), name
    assert (found['polarity'] == 0).all()


def test_layout() -> None:
    """Every field has four bytes, as in the message."""
    assert SEGMENT_DTYPE.names[:13] == (
        'x', 'y', 'z', 'x1', 'y1', 'x2', 'y2', 'length', 'theta', 'intercept', 'rho', 'code', 'size')
    for name in SEGMENT_DTYPE.names:
        kind = {'code': np.uint32, 'size': np.uint32, 'polarity': np.int32}.get(name, np.float32)
        assert SEGMENT_DTYPE[name] == kind
    assert SEGMENT_DTYPE.itemsize == 4 * len(SEGMENT_DTYPE.names)
    assert segments([line((1, 0))]).dtype == SEGMENT_DTYPE

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.edges import (
    CODE,
    MARGIN,
    OPEN,
    PAD,
    STENCILS,
    STRONG,
    combine_columns,
    deriche_stencil,
    extract_edges,
    gradient,
    kept_gradient,
    recur,
)
from line_feature_node.core.parameters import Parameters

Floats = npt.NDArray[np.floating[Any]]
USUAL: list[dict[str, Any]] = [
    *({'operator': operator} for operator in ('sobel', 'prewitt', 'scharr', 'dog')),
    *({'operator': 'deriche', 'alpha': alpha} for alpha in (0.7, 1.0, 1.8)),
]
OPERATORS = [*USUAL, *({'operator': 'deriche', 'alpha': alpha} for alpha in (0.2, 5.0))]
#: Smoothing across the derivative [-1 0 1].
STENCIL_SMOOTHING = {'sobel': [1.0, 2, 1], 'prewitt': [1.0, 1, 1], 'scharr': [3.0, 10, 3]}
SIZES = [1, 2, 3, 5, 7, 8, 15, 16, 17, 31, 32, 33, 40]


def named(parameters: dict[str, Any]) -> str:
    return ' '.join(str(value) for value in parameters.values())


class Shelf(Buffers):
    """Buffers that can be looked into."""

    def __init__(self) -> None:
        super().__init__()
        self.images: dict[str, npt.NDArray[Any]] = {}

    def image(self, name: str, height: int, width: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        self.images[name] = super().image(name, height, width, dtype)
        return self.images[name]


def marks_of(image: npt.NDArray[Any], buffers: Buffers | None = None, **parameters: Any) -> npt.NDArray[np.uint8]:
    """The marks of an image without their margin, the same ones whether the gradient is kept or not."""
    height, width = image.shape
    kept = extract_edges(
        np.ascontiguousarray(image), Parameters.profile('paper', **parameters, refine=True), Buffers())
    marks = extract_edges(np.ascontiguousarray(image), Parameters.profile('paper', **parameters), buffers or Buffers())
    np.testing.assert_array_equal(kept, marks)
    outside = marks.copy()
    outside[MARGIN:MARGIN + height, MARGIN:MARGIN + width] = 0
    assert not outside.any()
    return marks[MARGIN:MARGIN + height, MARGIN:MARGIN + width].copy()


def gradient_of(
    image: npt.NDArray[Any], operator: str = 'deriche', alpha: float = 1.0,
) -> tuple[Floats, Floats, Floats]:
    """gx, gy and norm of each pixel, from the plane that the sweep reads and with its kernels."""
    buffers = Shelf()
    marks_of(image, buffers, operator=operator, alpha=alpha)
    plane = buffers.images['smoothed' if operator == 'dog' else 'plane']
    if operator == 'deriche':
        for row in range(image.shape[0] + PAD - 1, -1, -1):
            recur(plane[row], plane[row + 1], plane[row + 2], np.float32(math.exp(-alpha)))
    stencil = deriche_stencil(alpha) if operator == 'deriche' else STENCILS[operator]
    side, centre = (np.float32(weight) for weight in stencil)
    across, along = np.zeros((2, plane.shape[1]), np.float32)
    found = np.zeros((3, image.shape[0], plane.shape[1]), np.float32)
    for row in range(image.shape[0]):
        above = row + PAD - 1
        combine_columns(plane[above], plane[above + 1], plane[above + 2], side, centre, across, along)
        gradient(across, along, side, centre, *found[:, row])
    gx, gy, norm = found[:, :, PAD:PAD + image.shape[1]]
    return gx, gy, norm


def responses(operator: str, alpha: float = 1.0) -> tuple[Floats, Floats]:
    """Derivative and smoothing of an operator as weights of the pixels around one, by their definition."""
    if operator in STENCIL_SMOOTHING:
        derivative, smoothing = np.array([-1.0, 0, 1]), np.array(STENCIL_SMOOTHING[operator])
        n = np.arange(-1, 2)
    elif operator == 'dog':
        # A Gaussian of one pixel, cut off at four, and the central difference of it.
        n = np.arange(-5, 6)
        smoothing = np.where(abs(n) <= 4, np.exp(-n * n / 2), 0)
        derivative = np.convolve(smoothing, [1, 0, -1], 'same')
    else:
        n = np.arange(-math.ceil(30 / alpha), math.ceil(30 / alpha) + 1)
        derivative, smoothing = n * np.exp(-alpha * abs(n)), (alpha * abs(n) + 1) * np.exp(-alpha * abs(n))
    return derivative / (n * derivative).sum(), smoothing / smoothing.sum()


def reference(image: npt.NDArray[Any], operator: str, alpha: float = 1.0) -> tuple[Floats, Floats]:
    """gx and gy by direct convolution over replicated borders, for the image and one pixel more on each side."""
    derivative, smoothing = responses(operator, alpha)
    reach = derivative.size // 2
    padded = np.pad(image.astype(np.float64), reach + 1, 'edge')

    def filtered(weights_y: Floats, weights_x: Floats) -> Floats:
        rows = np.lib.stride_tricks.sliding_window_view(padded, weights_y.size, 0) @ weights_y
        return np.lib.stride_tricks.sliding_window_view(rows, weights_x.size, 1) @ weights_x

    return filtered(smoothing, derivative), filtered(derivative, smoothing)


def excess(gx: Floats, gy: Floats) -> tuple[Floats, Floats]:
    """Norm of the inner pixels, and by which part of it it exceeds the greater norm of the two beside it.

    These lie where the gradient's direction meets the ring of the eight neighbours, between two of them.
    """
    norm = np.hypot(gx, gy)
    height, width = norm.shape
    parts = np.zeros((height, width))
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            x, y = gx[row, column], gy[row, column]
            x, y = np.array([x, y]) / max(abs(x), abs(y), 1e-300)
            beside = []
            for sign in (1, -1):
                at_x, at_y = column + sign * x, row + sign * y
                left, top = min(math.floor(at_x), width - 2), min(math.floor(at_y), height - 2)
                u, v = at_x - left, at_y - top
                beside.append((1 - v) * ((1 - u) * norm[top, left] + u * norm[top, left + 1])
                              + v * ((1 - u) * norm[top + 1, left] + u * norm[top + 1, left + 1]))
            parts[row, column] = (norm[row, column] - max(beside)) / max(norm[row, column], 1e-300)
    return norm[1:-1, 1:-1], parts[1:-1, 1:-1]


def kept_of(
    image: npt.NDArray[Any], buffers: Buffers, **parameters: Any,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """gx and gy as later steps see them, with the pixel of padding that they may look at."""
    extract_edges(np.ascontiguousarray(image), Parameters.profile('paper', **parameters, refine=True), buffers)
    around = slice(PAD - 1, PAD + image.shape[0] + 1), slice(PAD - 1, PAD + image.shape[1] + 1)
    values, unit = kept_gradient(buffers)
    gx, gy = np.moveaxis(values[around] * np.float32(unit), 2, 0)
    return gx, gy


def noise(height: int, width: int, seed: int = 0) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)


def ramp(size: int, slope: float, angle: float) -> npt.NDArray[np.float32]:
    y, x = np.mgrid[:size, :size] - size // 2
    radians = math.radians(angle)
    return (slope * (x * math.cos(radians) + y * math.sin(radians))).astype(np.float32)


def step(size: int, at: int, low: float, high: float, axis: int) -> npt.NDArray[np.float32]:
    """Low before row or column `at`, high from it on."""
    image = np.full((size, size), low, np.float32)
    (image.T if axis == 1 else image)[at:] = high
    return image


def border_of(operator: str, alpha: float = 1.0) -> int:
    """Pixels from the border at which its replication is no longer felt."""
    return 3 if operator == 'sobel' else math.ceil(14 / alpha)


@pytest.mark.parametrize('operator', OPERATORS, ids=named)
@pytest.mark.parametrize('slope', [0.05, 1.0, 20.0])
@pytest.mark.parametrize('angle', [0, 10, 22.5, 45, 63, 90, 135, 157.5, 180, 250, 315])
def test_ramp(operator: dict[str, Any], slope: float, angle: float) -> None:
    """The norm is the slope, whatever the operator; and there is no edge in the interior."""
    border = border_of(**operator)
    image = ramp(2 * border + 20, slope, angle)
    inside = slice(border, -border), slice(border, -border)
    gx, gy, norm = (part[inside] for part in gradient_of(image, **operator))
    np.testing.assert_allclose(norm, slope, rtol=2e-4)
    np.testing.assert_allclose(gx, slope * math.cos(math.radians(angle)), atol=2e-4 * slope)
    np.testing.assert_allclose(gy, slope * math.sin(math.radians(angle)), atol=2e-4 * slope)
    assert not marks_of(image, T1=0.02, T2=0.01, **operator)[inside].any()


@pytest.mark.parametrize('alpha', [0.2, 0.7, 1.0, 1.8, 5.0])
def test_impulse_response(alpha: float) -> None:
    """Deriche's closed form: k n exp(-alpha |n|) times k' (alpha |n| + 1) exp(-alpha |n|), of unit gain on a ramp."""
    size = 2 * math.ceil(16 / alpha) + 1
    image = np.zeros((size, size), np.float32)
    image[size // 2, size // 2] = 200
    n, q = size // 2 - np.arange(size), math.exp(-alpha)
    derivative = (1 - q)**3 / (2 * q * (1 + q)) * n * q**abs(n)
    smoothing = (1 - q)**2 / (1 + 2 * alpha * q - q * q) * (alpha * abs(n) + 1) * q**abs(n)
    gx, gy, _ = gradient_of(image, 'deriche', alpha)
    np.testing.assert_allclose(gx, 200 * np.outer(smoothing, derivative), atol=1e-4)
    np.testing.assert_allclose(gy, 200 * np.outer(derivative, smoothing), atol=1e-4)


@pytest.mark.parametrize('operator', OPERATORS, ids=named)
@pytest.mark.parametrize(
    'shape', [(1, 1), (1, 2), (2, 1), (1, 40), (40, 1), (2, 2), (3, 70), (31, 33), (32, 48), (65, 64)], ids=str)
def test_gradient_is_direct_convolution(operator: dict[str, Any], shape: tuple[int, int]) -> None:
    """The recursions and their starts at the borders are exact: the border is replicated for ever."""
    image = noise(*shape)
    gx, gy, norm = gradient_of(image, **operator)
    expected_x, expected_y = (part[1:-1, 1:-1] for part in reference(image, **operator))
    np.testing.assert_allclose(gx, expected_x, atol=2e-4)
    np.testing.assert_allclose(gy, expected_y, atol=2e-4)
    np.testing.assert_allclose(norm, np.hypot(expected_x, expected_y), atol=2e-4)


@pytest.mark.parametrize('operator', USUAL, ids=named)
def test_gradient_of_every_width_and_height(operator: dict[str, Any]) -> None:
    for size in range(1, 71):
        image = noise(4, size, size)
        for picture in (image, np.ascontiguousarray(image.T)):
            gx, gy, _ = gradient_of(picture, **operator)
            expected_x, expected_y = (part[1:-1, 1:-1] for part in reference(picture, **operator))
            np.testing.assert_allclose(gx, expected_x, atol=1e-4, err_msg=str(picture.shape))
            np.testing.assert_allclose(gy, expected_y, atol=1e-4, err_msg=str(picture.shape))


@pytest.mark.parametrize(('operator', 'peak'), [
    ({'operator': 'deriche', 'alpha': 0.7}, 0.168), ({'operator': 'deriche', 'alpha': 1.0}, 0.231),
    ({'operator': 'deriche', 'alpha': 1.8}, 0.358), ({'operator': 'sobel'}, 0.5),
])
def test_peak_at_a_step(operator: dict[str, Any], peak: float) -> None:
    """For Deriche tanh(alpha / 2) / 2 for each grey level of the step."""
    norm = gradient_of(step(61, 30, 20, 120, axis=1), **operator)[2]
    assert norm.max() / 100 == pytest.approx(peak, abs=5e-4)
    if 'alpha' in operator:
        assert norm.max() / 100 == pytest.approx(math.tanh(operator['alpha'] / 2) / 2, rel=1e-4)


@pytest.mark.parametrize('operator', OPERATORS, ids=named)
@pytest.mark.parametrize('shape', [(1, 30), (30, 1), (2, 9), (33, 47)], ids=str)
def test_suppression_and_thresholds(operator: dict[str, Any], shape: tuple[int, int]) -> None:
    """What stays is above T2 and greater than the norms beside it; STRONG says that it is above T1."""
    for seed in range(2):
        image = noise(*shape, seed)
        norm, parts = excess(*reference(image, **operator))
        T1, T2 = (float(part) + 0.001 for part in np.quantile(norm, (0.8, 0.5)))
        marks = marks_of(image, T1=T1, T2=T2, **operator)
        clear = (abs(parts) > 2e-3) & (abs(norm - T2) > 1e-3) & (abs(norm - T1) > 1e-3)
        stays, strong = (marks & CODE) != 0, (marks & STRONG) != 0
        np.testing.assert_array_equal(stays[clear], ((parts > 0) & (norm > T2))[clear])
        np.testing.assert_array_equal(strong[clear], (stays & (norm > T1))[clear])
        assert not (marks & ~np.uint8(CODE | OPEN | STRONG)).any()
        np.testing.assert_array_equal(stays, (marks & OPEN) != 0)
        assert (norm[stays] > T2 - 1e-3).all()
        assert clear.mean() > 0.8


@pytest.mark.parametrize(('T1', 'T2', 'mark'), [
    (8.0, 2.0, OPEN | 1), (7.9, 2.0, OPEN | STRONG | 1), (9.0, 8.0, 0), (9.0, 7.9, OPEN | 1)])
def test_a_gradient_of_just_a_threshold_does_not_exceed_it(T1: float, T2: float, mark: int) -> None:
    """That of Sobel's operator is exactly 8 at a step of 16 grey levels."""
    marks = marks_of(step(16, 8, 100, 116, axis=1), operator='sobel', T1=T1, T2=T2)
    assert marks.max() == mark


@pytest.mark.parametrize('operator', USUAL, ids=named)
def test_direction_codes(operator: dict[str, Any]) -> None:
    """Four sections of 45 degrees of the gradient's angle modulo pi, centred on 0, 45, 90 and 135 degrees."""
    image = noise(64, 64, seed=3)
    gx, gy = (part[1:-1, 1:-1] for part in reference(image, **operator))
    section = (np.degrees(np.arctan2(gy, gx)) % 180 + 22.5) / 45
    codes = marks_of(image, T1=0.02, T2=0.01, **operator) & CODE
    clear = (codes != 0) & (abs(section - np.round(section)) > 1e-4)
    np.testing.assert_array_equal(codes[clear], (np.floor(section[clear]) % 4 + 1))
    assert set(codes[clear]) == {1, 2, 3, 4}


@pytest.mark.parametrize(('angle', 'code'), [
    (0, 1), (22.4, 1), (22.6, 2), (45, 2), (67.4, 2), (67.6, 3), (90, 3), (112.4, 3), (112.6, 4), (135, 4), (157.4, 4),
    (157.6, 1), (179.9, 1),
])
@pytest.mark.parametrize('turn', [0, 180])
def test_section_borders(angle: float, code: int, turn: int) -> None:
    """The gradient's angle decides, not its sign; sections meet at 22.5 degrees and every 45 from there."""
    y, x = np.mgrid[:41, :41] - 20
    radians = math.radians(angle + turn)
    across = x * math.cos(radians) + y * math.sin(radians)
    image = (100 * np.tanh(across / 4)).astype(np.float32)
    codes = marks_of(image, T1=4, T2=2)[14:27, 14:27] & CODE
    assert codes.any()
    assert set(codes[codes != 0]) == {code}


@pytest.mark.compiled
@pytest.mark.parametrize('axis', [0, 1], ids=['rows', 'columns'])
@pytest.mark.parametrize(('low', 'high'), [(0, 255), (100, 140), (215, 255), (0, 40), (240, 250)])
@pytest.mark.parametrize('operator', USUAL, ids=named)
def test_step_leaves_the_pixel_before_it(operator: dict[str, Any], low: float, high: float, axis: int) -> None:
    """A step lies between two pixels of equal norm; the left or upper one stays, whichever of them is brighter."""
    size = 50
    for at in range(1, size):
        expected = np.zeros((size, size), bool)
        (expected.T if axis == 1 else expected)[at - 1] = True
        for image in (step(size, at, low, high, axis), step(size, at, high, low, axis)):
            codes = marks_of(image, T1=0.6, T2=0.5, **operator) & CODE
            np.testing.assert_array_equal(codes != 0, expected, err_msg=f'at {at}')
            assert set(codes[expected]) == {1 if axis == 1 else 3}


@pytest.mark.compiled
@pytest.mark.parametrize(('alpha', 'low', 'high'), [(0.2, 215, 255), (0.3, 250, 240), (0.5, 250, 240)])
def test_step_in_a_bright_image_with_much_smoothing(alpha: float, low: float, high: float) -> None:
    """As above where the gradient is small beside the grey levels, and rounding large beside the gradient."""
    for size in (50, 130):
        for at in (5, 33, size // 2):
            stays = marks_of(step(size, at, low, high, axis=1), T1=0.3, T2=0.2, alpha=alpha) != 0
            assert np.flatnonzero(stays.any(axis=0)).tolist() == [at - 1]


@pytest.mark.parametrize('operator', USUAL, ids=named)
def test_blurred_step_leaves_one_pixel(operator: dict[str, Any]) -> None:
    """A step that takes several pixels is one edge still; one so wide that it is a ramp is one at most."""
    for width in range(1, 41):
        profile = 20 + 200 * np.clip((np.arange(120) - 40) / width, 0, 1)
        found = (marks_of(np.tile(profile, (3, 1)).astype(np.float32), T1=0.6, T2=0.5, **operator) != 0).sum(axis=1)
        assert set(found) <= ({1} if width <= 6 / operator.get('alpha', 1) else {0, 1}), width


@pytest.mark.compiled
@pytest.mark.parametrize('operator', OPERATORS, ids=named)
@pytest.mark.parametrize('value', [0, 1, 137, 255])
def test_constant_image_has_no_edge(operator: dict[str, Any], value: int) -> None:
    for height in SIZES:
        for width in SIZES:
            for dtype in (np.uint8, np.float32):
                image = np.full((height, width), value, dtype)
                assert not marks_of(image, T1=0.02, T2=0.01, **operator).any(), image.shape


@pytest.mark.parametrize(('dtype', 'value'), [
    (np.uint16, 0), (np.uint16, 65535), (np.float32, -500), (np.float32, 5e4),
])
def test_constant_image_of_other_types(dtype: type, value: float) -> None:
    for shape in [(1, 1), (1, 50), (50, 1), (37, 53)]:
        assert not marks_of(np.full(shape, value, dtype), T1=0.4, T2=0.2).any()


@pytest.mark.compiled
@pytest.mark.parametrize('operator', USUAL, ids=named)
def test_no_edge_is_invented_by_the_size(operator: dict[str, Any]) -> None:
    """An image that varies along one axis only is the same edges in each row, or column, of any length."""
    profile = np.repeat(np.array([30, 30, 200, 90, 90, 140, 60], np.float32), 6)
    column = marks_of(profile[:, None], T1=8, T2=3, **operator)
    assert column.any()
    for size in range(1, 71):
        image = np.repeat(profile[:, None], size, 1)
        marks = marks_of(image, T1=8, T2=3, **operator)
        np.testing.assert_array_equal(marks, np.repeat(column, size, 1), err_msg=f'width {size}')
        turned = marks_of(image.T, T1=8, T2=3, **operator)
        np.testing.assert_array_equal(turned != 0, (marks != 0).T, err_msg=f'height {size}')


@pytest.mark.parametrize('operator', USUAL, ids=named)
def test_border_adds_no_edge(operator: dict[str, Any]) -> None:
    """A picture in the middle of a wide even ground has the same edges as on a narrow one."""
    picture = noise(20, 24, seed=5)
    narrow, wide = (np.pad(picture, pad, constant_values=100) for pad in (9, 40))
    narrow_marks, wide_marks = (marks_of(image, T1=8, T2=3, **operator) for image in (narrow, wide))
    crop = slice(33, -33)
    inner = slice(2, -2)
    np.testing.assert_array_equal(narrow_marks[inner, inner], wide_marks[crop, crop])


def rescaled(image: npt.NDArray[np.uint8], dtype: type, factor: float, shift: float) -> npt.NDArray[Any]:
    return (image.astype(np.float64) * factor + shift).astype(dtype)


@pytest.mark.parametrize('operator', USUAL, ids=named)
@pytest.mark.parametrize(('dtype', 'factor', 'shift', 'low', 'high'), [
    (np.uint16, 257, 0, math.nan, math.nan),        # the type's own range
    (np.uint16, 16, 0, math.nan, 16 * 255),         # 12 bits in 16
    (np.uint16, 16, 1000, 1000, 1000 + 16 * 255),
    (np.uint16, 1, 0, 0, 255),
    (np.float32, 1, 0, math.nan, math.nan),         # 0 to 255
    (np.float32, 1 / 256, 0, math.nan, 255 / 256),
    (np.float32, 1 / 256, -0.5, -0.5, 255 / 256 - 0.5),
    (np.float32, 8, 500, 500, 500 + 8 * 255),
])
def test_intensity_range(
    operator: dict[str, Any], dtype: type, factor: float, shift: float, low: float, high: float,
) -> None:
    """Equal pictures in other types and units give equal marks once their range is known."""
    image = noise(40, 50, seed=7).astype(np.uint8)
    expected = marks_of(image, **operator)
    found = marks_of(rescaled(image, dtype, factor, shift), intensity_min=low, intensity_max=high, **operator)
    assert expected.any()
    np.testing.assert_array_equal(found, expected)


def test_part_of_the_range_stretches_uint8() -> None:
    image = noise(40, 50, seed=8).astype(np.uint8) // 4
    stretched = (image * np.float32(4)).astype(np.float32)
    np.testing.assert_array_equal(marks_of(image, intensity_max=255 / 4), marks_of(stretched))


@pytest.mark.compiled
def test_buffers_keep_nothing_of_the_frame_before() -> None:
    buffers = Buffers()
    for seed, (height, width) in enumerate([(40, 50), (40, 50), (33, 50), (40, 51), (1, 1), (40, 50)]):
        for operator in USUAL:
            image = noise(height, width, seed)
            np.testing.assert_array_equal(marks_of(image, buffers, **operator), marks_of(image, **operator))


@pytest.mark.parametrize('operator', USUAL, ids=named)
def test_gradient_that_is_kept_is_that_of_the_definition(operator: dict[str, Any]) -> None:
    """Also beside the picture, and whatever picture was there before."""
    buffers = Buffers()
    for seed, (height, width) in enumerate([(40, 50), (33, 50), (40, 51), (1, 1), (3, 17), (40, 50)]):
        image = noise(height, width, seed)
        for found, expected in zip(kept_of(image, buffers, **operator), reference(image, **operator), strict=True):
            np.testing.assert_allclose(found, expected, atol=2e-3)

"""Step 1, edge extraction: gradient, non-maximum suppression, thresholds and direction codes (section 2.1).

Deriche's operator (reference 15 of the paper) with q = exp(-alpha) has the derivative n q^|n| along one axis and the
smoothing (alpha |n| + 1) q^|n| along the other. With E(n) = q^|n| both are short stencils on one smoothed image:
n q^|n| is [-1 0 1] * (E * E), and (alpha |n| + 1) q^|n| is [b a b] * (E * E), up to scale. So the whole operator is
E * E along x and along y, four recursions of second order, and then a 3x3 stencil like Sobel's. The other operators are
such a stencil alone, on the image itself or, for the derivative of a Gaussian, on the smoothed one.

All arrays of a frame are padded: the planes by two replicated rows and columns on each side, the marks by one of zeros.
"""

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.parameters import Parameters
from line_feature_node.core.team import ALONE, Team
from line_feature_node.core.vectors import LANES, TILE, load, store, transpose

#: In a mark: the direction code, 1 to 4, of a pixel that passed the suppression and exceeds T2; 0 is background.
CODE = 7
#: In a mark: the pixel also exceeds T1.
STRONG = 8
#: In a mark: there is a code, and no chain has the pixel yet.
OPEN = 128

#: Replicated pixels on each side of a plane, and of zeros on each side of the marks.
PAD, MARGIN = 2, 1
#: Columns on both sides of a part of the picture whose smoothed grey levels tell on its edges.
HALO = 2
#: Pixels whose norms differ by less than this part count as equal, so that a ramp has no edge in its interior.
FLAT = np.float32(1e-3)
#: Norms that differ by less than this part, or this much, are a tie, which the first along the gradient wins: above
#: rounding, which is relative to the norm in the stencils and to the grey levels, a few hundred, in the recursions.
TIE, ROUNDING = np.float32(2e-5), np.float32(1e-4)
ONE = np.float32(1)
#: Marks as single bytes, so that a row of them is computed as bytes.
NO_MARK, STRONG_MARK = np.uint8(0), np.uint8(STRONG)
CODE_1, CODE_2, CODE_3, CODE_4 = (np.uint8(OPEN | code) for code in (1, 2, 3, 4))
#: Half a section of the gradient space is 22.5 degrees.
SECTION = np.float32(math.tan(math.pi / 8))
#: White, where parameters do not say it, by the kind and the bytes of pixels.
WHITE = {('u', 1): 255.0, ('u', 2): 65535.0, ('f', 4): 255.0}
#: The largest number that the gradient of 8-bit images is kept as: that of black and white side by side, at most. The
#: unit of others is about the same.
LARGEST, UNIT = 32767, 1 / 128
#: Added to every pixel: the recursion would fade into denormal numbers, which are slow, beside a black area.
PEDESTAL = 1.0


def extract_edges(
    image: NDArray[Any], parameters: Parameters, buffers: Buffers, team: Team = ALONE,
) -> NDArray[np.uint8]:
    """Mark the edge candidates of an image.

    Hysteresis is left to edge scanning, which follows candidates from strong ones.

    Args:
        image: H×W uint8, uint16 or float32, C-contiguous.
        parameters: operator, alpha, sigma, T1, T2, thinning, intensity_min and intensity_max are used.
        buffers: Memory to work in.
        team: Who does the work.

    Returns:
        Marks, uint8: OPEN and the CODE of each pixel that passed the suppression (where that is the way of thinning)
        and exceeds T2, with STRONG where it exceeds T1, and 0 elsewhere; padded by MARGIN on each side, and at the
        right to a multiple of eight columns.
    """
    # Before anything of the last frame is written over: it may raise.
    scale, offset = intensity_map(image.dtype, parameters)
    height, width = image.shape
    # Whole strips of rows and whole tiles of columns fit in, with the padding.
    lines, columns = -(-height // LANES) * LANES, -(-(width + 2 * PAD) // TILE) * TILE
    plane = buffers.image('plane', lines + 2 * PAD, columns, np.float32)
    whole = image.dtype == np.uint8
    kept = buffers.image('gradient', lines + 2 * PAD if parameters.refine else 0, 2 * columns,
                         np.int16 if whole else np.float32)
    marks = buffers.image('marks', height + 2 * MARGIN, -(-(width + 2 * MARGIN) // 8) * 8, np.uint8)
    # An image of another width may have had the same padded one, and pixels where the padding is now.
    marks[:, MARGIN + width:] = 0
    q = math.exp(-parameters.alpha)
    recursive = parameters.operator == 'deriche'
    if recursive:
        side, centre = deriche_stencil(parameters.alpha)
        smooth_image(image, scale, offset + PEDESTAL, q, plane, buffers, team)
    else:
        side, centre = STENCILS[parameters.operator]
        copy_replicated(image, scale, offset, plane)
    if parameters.operator == 'dog':
        smoothed = buffers.image('smoothed', lines + 2 * PAD, columns, np.float32)
        inside = slice(height + 2 * PAD), slice(width + 2 * PAD)
        cv2.GaussianBlur(plane[inside], (0, 0), parameters.sigma, dst=smoothed[inside], borderType=cv2.BORDER_REPLICATE)
        plane = smoothed
    unit = buffers.array('unit', 1, np.float64)
    unit[0] = abs(scale) * 255 / LARGEST if whole else UNIT
    thin = parameters.thinning == 'suppression'

    def sweep_some(left: int, right: int, memory: Buffers) -> None:
        seen = min(right + HALO, columns) - max(left - HALO, 0)
        sweep(height, width, left, right, recursive, q, side, centre, parameters.T1, parameters.T2, thin, plane,
              memory.array('rows', 14 * columns, np.float32)[:14 * seen].reshape(14, seen), 1 / unit[0], whole, kept,
              marks)

    team.each(sweep_some, team.shares(columns, TILE), buffers.parts(team.size))
    return marks


def smooth_image(
    image: NDArray[Any], scale: float, offset: float, q: float, plane: NDArray[np.float32], buffers: Buffers,
    team: Team,
) -> None:
    """Smooth the rows by E * E, and the columns by its causal half; the sweep does the other half on its way up.

    The causal half needs all rows before. So one of a team does both in its part of the rows, the first, while others
    smooth those below, and then all go down the columns there.
    """
    height, columns = image.shape[0], plane.shape[1]
    last = buffers.array('last row', columns, np.float32)
    below = height if team.size == 1 else min(max(height // LANES // team.size, 1) * LANES, height)

    def smooth_some(first: int, end: int, memory: Buffers) -> None:
        strip = memory.array('strip', columns * LANES, np.float32)
        smooth_strips(image, first, end, first == 0, scale, offset, q, strip, plane, last)

    def go_down_some(left: int, right: int) -> None:
        smooth_down(below, height, left, right, height, q, plane, last)

    shares = [(below + first, below + end) for first, end in team.shares(height - below, LANES)]
    team.each(smooth_some, [(0, below), *shares], buffers.parts(team.size))
    if shares:
        team.each(go_down_some, team.shares(columns, TILE))


class Gradient(NamedTuple):
    """The gradient of an image.

    Attributes:
        values: Components along x and y, H×W×2, padded by PAD: int16 of 8-bit images, of which no gradient is too
            steep for that, as that takes half of the memory, and of the cache; float32 of others.
        unit: What they are multiples of, in grey levels a pixel.
    """

    values: NDArray[Any]
    unit: float


def kept_gradient(buffers: Buffers) -> Gradient:
    """The gradient of the last image, where lines are refined."""
    values = buffers.last_image('gradient')
    return Gradient(values.reshape(values.shape[0], -1, 2), float(buffers.array('unit', 1, np.float64)[0]))


def intensity_map(dtype: 'np.dtype[Any]', parameters: Parameters) -> tuple[float, float]:
    """Scale and offset that bring pixel values to grey levels.

    Raises:
        ValueError: One end of the range is given, and beyond the other, which the type sets.
    """
    low, high = parameters.intensity_min, parameters.intensity_max
    low = 0.0 if math.isnan(low) else low
    if math.isnan(high):
        high = WHITE[dtype.kind, dtype.itemsize]
    if low >= high:
        raise ValueError(f'intensity_min must be less than intensity_max, got {low:g} and {high:g} for {dtype} pixels')
    scale = 255.0 / (high - low)
    return scale, -scale * low


#: Side and centre of the smoothing that goes with the derivative [-1 0 1]; together they have unit gain on a ramp. The
#: derivative of a Gaussian is a central difference of the smoothed image, which needs no smoothing besides.
STENCILS = {'sobel': (1 / 8, 2 / 8), 'prewitt': (1 / 6, 1 / 6), 'scharr': (3 / 32, 10 / 32), 'dog': (0.0, 1 / 2)}


def deriche_stencil(alpha: float) -> tuple[float, float]:
    """The smoothing [b a b] that makes Deriche's operator of E * E, so that a ramp gives its slope."""
    q = math.exp(-alpha)
    t = (1 + q * q) / (1 - q * q) - 1 / alpha
    side = t / ((1 / q - q) - t * (q + 1 / q))
    return side / (2 * (1 + 2 * side)), 1 / (2 * (1 + 2 * side))


@kernel
def copy_replicated(image: Any, scale: float, offset: float, plane: Any) -> None:
    """Copy the image as grey levels into the plane and replicate its border."""
    height, width = image.shape
    for row in range(height + 2 * PAD):
        source = image[min(max(row - PAD, 0), height - 1)]
        target = plane[row]
        for column in range(width):
            target[column + PAD] = np.float32(scale) * np.float32(source[column]) + np.float32(offset)
        for k in range(PAD):
            target[k] = target[PAD]
            target[width + PAD + k] = target[width + PAD - 1]


@kernel
def smooth_strips(
    image: Any, first: int, end: int, downwards: bool, scale: float, offset: float, q: float, strip: Any, plane: Any,
    last: Any,
) -> None:
    """Smooth rows from the first to the end, and, if asked for, down the columns as :func:`smooth_down`.

    The strip holds LANES rows, column after column, as many columns as the plane has.
    """
    height, width = image.shape
    for row in range(first, end, LANES):
        load_rows(image, row, np.float32(scale), np.float32(offset), plane)
        turn(plane, row + PAD, strip)
        smooth_strip(strip, width, np.float32(q))
        turn_back(strip, plane, row + PAD)
        if downwards:
            go_down(row, min(row + LANES, end), 0, plane.shape[1], height, np.float32(q), plane, last)


@kernel
def smooth_down(
    first: int, end: int, left: int, right: int, height: int, q: float, plane: Any, last: Any,
) -> None:
    """Smooth columns, of the plane, by the causal half of E * E, in rows of the image."""
    go_down(first, end, left, right, height, np.float32(q), plane, last)


@inlined
def go_down(first: int, end: int, left: int, right: int, height: int, q: Any, plane: Any, last: Any) -> None:
    """As :func:`smooth_down`. The two rows below the image receive the start values of the other half."""
    if first == 0:
        copy_row(plane[PAD, left:right], plane[0, left:right])
        copy_row(plane[PAD, left:right], plane[1, left:right])
    bottom = height + PAD - 1
    for row in range(first + PAD, end + PAD):
        if row == bottom:
            copy_row(plane[row, left:right], last[left:right])
        recur(plane[row, left:right], plane[row - 1, left:right], plane[row - 2, left:right], q)
    if end == height:
        start_upwards(last[left:right], plane[bottom, left:right], plane[bottom - 1, left:right],
                      plane[bottom + 1, left:right], plane[bottom + 2, left:right], q)


@inlined
def copy_row(source: Any, target: Any) -> None:
    """Copy a row; an assignment of slices would take the compiler four times as long."""
    for i in range(target.size):
        target[i] = source[i]


@inlined
def load_rows(image: Any, first: int, scale: Any, offset: Any, plane: Any) -> None:
    """Bring LANES rows of the image into the plane as grey levels, the last row standing in for those below it."""
    height, width = image.shape
    for lane in range(LANES):
        source = image[min(first + lane, height - 1)]
        target = plane[first + lane + PAD, PAD:PAD + width]
        for column in range(width):
            target[column] = scale * np.float32(source[column]) + offset


@inlined
def turn(plane: Any, first: int, strip: Any) -> None:
    """Bring LANES rows of the plane into the strip."""
    rows, stride = plane.reshape(-1), plane.shape[1]
    for column in range(0, stride, TILE):
        for lane in range(0, LANES, TILE):
            transpose(rows, (first + lane) * stride + column, stride, strip, column * LANES + lane, LANES)


@inlined
def turn_back(strip: Any, plane: Any, first: int) -> None:
    """Bring the strip into LANES rows of the plane."""
    rows, stride = plane.reshape(-1), plane.shape[1]
    for column in range(0, stride, TILE):
        for lane in range(0, LANES, TILE):
            transpose(strip, column * LANES + lane, LANES, rows, (first + lane) * stride + column, stride)


@inlined
def smooth_strip(strip: Any, width: int, q: Any) -> None:
    """Smooth along x, all lanes at once: E * E as a causal and an anticausal pass over the replicated rows."""
    gain, first, second = (1 - q) * (1 - q), 2 * q, -q * q
    end = (width + PAD) * LANES
    x = load(strip, end - LANES)
    y1 = y2 = load(strip, PAD * LANES)
    store(strip, 0, y1)
    store(strip, LANES, y1)
    for k in range(PAD * LANES, end, LANES):
        y = first * y1 + (second * y2 + gain * load(strip, k))
        store(strip, k, y)
        y1, y2 = y, y1
    of_x, of_u, of_u1 = start_weights(q, 1)
    v1 = of_x * x + (of_u * y1 + of_u1 * y2)
    of_x, of_u, of_u1 = start_weights(q, 2)
    v2 = of_x * x + (of_u * y1 + of_u1 * y2)
    store(strip, end, v1)
    store(strip, end + LANES, v2)
    y1, y2 = v1, v2
    for k in range(end - LANES, -1, -LANES):
        y = first * y1 + (second * y2 + gain * load(strip, k))
        store(strip, k, y)
        y1, y2 = y, y1


@kernel
def start_weights(q: Any, k: int) -> tuple[Any, Any, Any]:
    """The exact start of the anticausal pass v, k steps behind the end, where x goes on for ever.

    There the causal pass u decays to x as (A + B j) q^j, with A and B from its last two values, and v is the
    anticausal pass over that decay: a sum in closed form (Triggs and Sdika, 2006, solve for it in general).

    Returns:
        Weights of x, of the last u and of the u before it.
    """
    r = q * q
    share = (1 - q) * (1 - q) / ((1 - r) * (1 - r)) * (q if k == 1 else r)
    tail = 2 * r / (1 - r)
    of_u = share * (k + 1 + tail)
    of_u1 = -share * q * (k + tail)
    return np.float32(1 - of_u - of_u1), np.float32(of_u), np.float32(of_u1)


@inlined
def recur(y: Any, y1: Any, y2: Any, q: Any) -> None:
    """One step of y = (1 - q)^2 x + 2 q y1 - q^2 y2, elementwise and in place of x: (n + 1) q^n, half of E * E.

    The weights are in double precision, as 1 and 2 are whole numbers, and so is the sum: with single precision, which
    would save 1 % of all time, large grey levels lose their edges, and where parts of a picture meet bits differ.
    """
    gain, first, second = (1 - q) * (1 - q), 2 * q, -q * q
    for i in range(y.size):
        y[i] = first * y1[i] + (second * y2[i] + gain * y[i])


@inlined
def recur_into(x: Any, y1: Any, y2: Any, y: Any, q: Any) -> None:
    """As :func:`recur`, into a row of its own: a row that is x and y at once looks to the compiler like a hazard."""
    gain, first, second = (1 - q) * (1 - q), 2 * q, -q * q
    for i in range(y.size):
        y[i] = first * y1[i] + (second * y2[i] + gain * x[i])


@kernel
def start_upwards(x: Any, u: Any, u1: Any, v1: Any, v2: Any, q: Any) -> None:
    """Write the two rows below the image with which the vertical anticausal pass starts."""
    for k, v in ((1, v1), (2, v2)):
        of_x, of_u, of_u1 = start_weights(q, k)
        for i in range(x.size):
            v[i] = of_x * x[i] + (of_u * u[i] + of_u1 * u1[i])


@kernel
def sweep(
    height: int, width: int, left: int, right: int, recursive: bool, q: float, side: float, centre: float, T1: float,
    T2: float, thin: bool, plane: Any, rows: Any, per_unit: float, whole: bool, kept: Any, marks: Any,
) -> None:
    """From the bottom up: finish the smoothing of a row, then gradient, norm and suppression of the rows below it.

    Three rows each of the smoothed image, of the gradient and of the norm are used in turn. The gradient is kept if
    there is room. But for that only a few rows are written besides the marks; to smooth the plane in place would push
    the marks out of the cache, which are read next. It takes columns of the plane from the left to the right one, and
    looks at HALO more on both sides.
    """
    low, high = max(left - HALO, 0), min(right + HALO, plane.shape[1])
    # The outermost columns of the plane have no neighbours, and no gradient.
    first, end = max(left, 1), min(right, plane.shape[1] - 1)
    first_pixel, end_pixel = max(left - PAD, 0), min(right - PAD, width)
    b, a = np.float32(side), np.float32(centre)
    across, along, norm, smooth, gx, gy = rows[0], rows[1], rows[2:5], rows[5:8], rows[8:11], rows[11:14]
    for row in (height + PAD, height + PAD + 1):
        copy_row(plane[row, low:high], smooth[row % 3])
    for row in range(height + PAD - 1, -1, -1):
        below, middle, above = row % 3, (row + 2) % 3, (row + 1) % 3
        if recursive:
            recur_into(plane[row, low:high], smooth[above], smooth[middle], smooth[below], np.float32(q))
        else:
            copy_row(plane[row, low:high], smooth[below])
        combine_columns(smooth[below], smooth[above], smooth[middle], b, a, across, along)
        gradient(across, along, b, a, gx[above], gy[above], norm[above])
        if kept.size > 0:
            keep(gx[above, first - low:end - low], gy[above, first - low:end - low], np.float32(per_unit), whole,
                 kept[row + 1, 2 * first:2 * end])
        if row < height:
            suppress(norm[above], norm[middle], norm[below], gx[middle], gy[middle], np.float32(T1), np.float32(T2),
                     thin, marks[row + MARGIN, MARGIN + first_pixel:MARGIN + end_pixel])


@inlined
def combine_columns(above: Any, middle: Any, below: Any, side: Any, centre: Any, across: Any, along: Any) -> None:
    """The vertical half of the 3x3 stencils: smoothed for the derivative across, differentiated for that along."""
    for i in range(middle.size):
        across[i] = centre * middle[i] + side * (above[i] + below[i])
        along[i] = below[i] - above[i]


@inlined
def gradient(across: Any, along: Any, side: Any, centre: Any, gx: Any, gy: Any, norm: Any) -> None:
    """The horizontal half of the 3x3 stencils, and the norm of the gradient."""
    for i in range(1, across.size - 1):
        x = across[i + 1] - across[i - 1]
        y = centre * along[i] + side * (along[i - 1] + along[i + 1])
        gx[i] = x
        gy[i] = y
        norm[i] = np.sqrt(x * x + y * y)


@inlined
def keep(gx: Any, gy: Any, per_unit: Any, whole: bool, kept: Any) -> None:
    """Put down a row of the gradient, in whole numbers if asked for, both components of a pixel beside each other."""
    for i in range(gx.size):
        x, y = gx[i] * per_unit, gy[i] * per_unit
        kept[2 * i] = np.rint(x) if whole else x
        kept[2 * i + 1] = np.rint(y) if whole else y


@inlined
def suppress(
    above: Any, middle: Any, below: Any, gx: Any, gy: Any, T1: Any, T2: Any, thin: bool, marks: Any,
) -> None:
    """Non-maximum suppression, unless edges are to stay thick, thresholds and direction codes of one row.

    The norm of a pixel is compared with two norms one step along the gradient, forward (to the right, or down where
    the gradient is steep) and backward, each interpolated between the two neighbours that straddle it: with weights
    |gx| - |gy| and |gy| for a flat gradient, so that all sides of a comparison are multiplied by |gx| instead of
    dividing. It stays when greater than both.

    A tie is won by its first pixel: forward may be equal, backward not. That holds for codes 1 and 3. Of a diagonal
    tie neither pixel stays: the two touch at a corner, and between the other two pixels there runs the ridge. Where it
    runs between diagonal neighbours' sides instead, along a 45 degree edge between pixels, both sides of it stay: they
    touch each other, but the pixels one step along the gradient from each are lower.
    """
    for i in range(marks.size):
        j = i + PAD
        x, y = gx[j], gy[j]
        ax, ay = abs(x), abs(y)
        steep, same = ay > ax, x * y > 0
        aside = ax if steep else ay
        ahead = (ay if steep else ax) - aside
        north, south, east, west = above[j], below[j], middle[j + 1], middle[j - 1]
        northeast, northwest, southeast, southwest = above[j + 1], above[j - 1], below[j + 1], below[j - 1]
        norm = middle[j]
        across = ahead + aside
        code_1, code_3 = ay <= SECTION * ax, ax <= SECTION * ay
        slack = TIE * norm + ROUNDING
        least_forward = (norm + (slack if code_1 | code_3 else -slack)) * across
        least_backward = (norm - slack) * across
        within_ramp = (ONE - FLAT) * norm * across
        # Both answers are computed: to select among the neighbours first would make gather instructions of the loads.
        flat_maximum = is_maximum(
            ahead * east + aside * (southeast if same else northeast), least_forward,
            ahead * west + aside * (northwest if same else southwest), least_backward, within_ramp)
        steep_maximum = is_maximum(
            ahead * south + aside * (southeast if same else southwest), least_forward,
            ahead * north + aside * (northwest if same else northeast), least_backward, within_ramp)
        maximum = (steep & steep_maximum) | ((not steep) & flat_maximum) | (not thin)
        code = CODE_2 if same else CODE_4
        code = CODE_3 if code_3 else code
        code = CODE_1 if code_1 else code
        code = code | (STRONG_MARK if norm > T1 else NO_MARK)
        marks[i] = code if maximum & (norm > T2) else NO_MARK


@inlined
def is_maximum(forward: Any, least_forward: Any, backward: Any, least_backward: Any, within_ramp: Any) -> bool:
    """Whether the norms beside a pixel are below what they must be, and one of them by more than within a ramp."""
    return ((forward < least_forward) & (backward < least_backward)
            & ((forward < within_ramp) | (backward < within_ramp)))

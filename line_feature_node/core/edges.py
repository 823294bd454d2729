"""Step 1, edge extraction: gradient, non-maximum suppression, thresholds and direction codes (section 2.1).

Deriche's operator (reference 15 of the paper) with q = exp(-alpha) has the derivative n q^|n| along one axis and the
smoothing (alpha |n| + 1) q^|n| along the other. With E(n) = q^|n| both are short stencils on one smoothed image:
n q^|n| is [-1 0 1] * (E * E), and (alpha |n| + 1) q^|n| is [b a b] * (E * E), up to scale. So the whole operator is
E * E along x and along y, four recursions of second order, and then a 3x3 stencil like Sobel's. Sobel is that stencil
alone, with b : a = 1 : 2.

All arrays of a frame are padded: the planes by two replicated rows and columns on each side, the marks by one of zeros.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import kernel
from line_feature_node.core.parameters import Parameters

#: In a mark: the direction code, 1 to 4, of a pixel that passed the suppression and exceeds T2; 0 is background.
CODE = 7
#: In a mark: the pixel also exceeds T1.
STRONG = 8

#: Replicated pixels on each side of a plane, and of zeros on each side of the marks.
PAD, MARGIN = 2, 1
#: Rows that the horizontal recursion takes at once. Several vector registers hide the latency of its steps; a power
#: of two would put all of a column's rows into the same few cache sets (16, 32, 48, 64: 1.13, 1.21, 1, 1.25 in time).
LANES = 48
#: Pixels whose norms differ by less than this part count as equal, so that a ramp has no edge in its interior.
FLAT = np.float32(1e-3)
#: Norms that differ by less than this part are a tie, which the first along the gradient wins: far above rounding.
TIE = np.float32(2e-5)
#: Half a section of the gradient space is 22.5 degrees.
SECTION = np.float32(math.tan(math.pi / 8))
#: Added to every pixel: the recursion would fade into denormal numbers, which are slow, beside a black area.
PEDESTAL = 1.0


def extract_edges(image: NDArray[Any], parameters: Parameters, buffers: Buffers) -> NDArray[np.uint8]:
    """Mark the edge candidates of an image.

    Hysteresis is left to edge scanning, which follows candidates from strong ones.

    Args:
        image: H×W uint8, uint16 or float32, C-contiguous.
        parameters: operator, alpha, T1, T2, intensity_min and intensity_max are used.
        buffers: Memory to work in.

    Returns:
        Marks, uint8: the CODE of each pixel that passed the suppression and exceeds T2, with STRONG where it exceeds
        T1, and 0 elsewhere; padded by MARGIN on each side, and at the right to a multiple of eight columns.
    """
    height, width = image.shape
    # Whole strips of rows and whole registers of columns fit in, with the padding.
    plane = buffers.image('plane', -(-height // LANES) * LANES + 2 * PAD, -(-(width + 2 * PAD) // 16) * 16, np.float32)
    rows = buffers.image('rows', 12, plane.shape[1], np.float32)
    marks = buffers.image('marks', height + 2 * MARGIN, -(-(width + 2 * MARGIN) // 8) * 8, np.uint8)
    scale, offset = intensity_map(image.dtype, parameters)
    q = math.exp(-parameters.alpha)
    recursive = parameters.operator == 'deriche'
    if recursive:
        side, centre = deriche_stencil(parameters.alpha)
        strip = buffers.image('strip', width + 2 * PAD, LANES, np.float32)
        smooth_forward(image, scale, offset, q, strip, plane, rows[0])
    else:
        side, centre = STENCILS[parameters.operator]
        copy_replicated(image, scale, offset, plane)
    sweep(height, width, recursive, q, side, centre, parameters.T1, parameters.T2, plane, rows, marks)
    return marks


def intensity_map(dtype: 'np.dtype[Any]', parameters: Parameters) -> tuple[float, float]:
    """Scale and offset that bring pixel values to grey levels."""
    low, high = parameters.intensity_min, parameters.intensity_max
    low = 0.0 if math.isnan(low) else low
    if math.isnan(high):
        high = float(np.iinfo(dtype).max) if dtype.kind == 'u' else 255.0
    scale = 255.0 / (high - low)
    return scale, PEDESTAL - scale * low


#: The 3x3 operators as side and centre of their smoothing; derivative and smoothing together have unit gain on a ramp.
STENCILS = {'sobel': (1 / 8, 2 / 8)}


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
def smooth_forward(
    image: Any, scale: float, offset: float, q: float, strip: Any, plane: Any, last: Any,
) -> None:
    """Smooth the rows by E * E, and the columns by its causal half; the sweep does the other half on its way up.

    The two rows below the image receive the start values of that half.
    """
    height, width = image.shape
    for first in range(0, height, LANES):
        load_transposed(image, first, np.float32(scale), np.float32(offset), strip)
        smooth_strip(strip, np.float32(q))
        store_transposed(strip, plane, first + PAD)
        if first == 0:
            plane[0] = plane[PAD]
            plane[1] = plane[PAD]
        for row in range(first + PAD, min(first + LANES, height) + PAD):
            if row == height + PAD - 1:
                last[:] = plane[row]
            recur(plane[row], plane[row - 1], plane[row - 2], np.float32(q))
    bottom = height + PAD - 1
    anticausal_start(last, plane[bottom], plane[bottom - 1], plane[bottom + 1], plane[bottom + 2], np.float32(q))


@kernel
def load_transposed(image: Any, first: int, scale: Any, offset: Any, strip: Any) -> None:
    """Bring LANES rows of the image into the strip as grey levels, the last row standing in for those below it."""
    height, width = image.shape
    for lane in range(LANES):
        source = image[min(first + lane, height - 1)]
        for column in range(width):
            strip[column + PAD, lane] = scale * np.float32(source[column]) + offset


@kernel
def store_transposed(strip: Any, plane: Any, first: int) -> None:
    """Write the strip into LANES rows of the plane."""
    for lane in range(LANES):
        target = plane[first + lane]
        for column in range(strip.shape[0]):
            target[column] = strip[column, lane]


@kernel
def smooth_strip(strip: Any, q: Any) -> None:
    """Smooth along x, all lanes at once: E * E as a causal and an anticausal pass over the replicated row."""
    end = strip.shape[0] - PAD
    x = np.empty(LANES, np.float32)
    x[:] = strip[end - 1]
    strip[0] = strip[PAD]
    strip[1] = strip[PAD]
    gain, first, second = (1 - q) * (1 - q), 2 * q, -q * q
    for column in range(PAD, end):
        for i in range(LANES):
            strip[column, i] = first * strip[column - 1, i] + (second * strip[column - 2, i] + gain * strip[column, i])
    anticausal_start(x, strip[end - 1], strip[end - 2], strip[end], strip[end + 1], q)
    for column in range(end - 1, -1, -1):
        for i in range(LANES):
            strip[column, i] = first * strip[column + 1, i] + (second * strip[column + 2, i] + gain * strip[column, i])


@kernel
def recur(y: Any, y1: Any, y2: Any, q: Any) -> None:
    """One step of y = (1 - q)^2 x + 2 q y1 - q^2 y2, elementwise, in place of x; response (n + 1) q^n, half of E * E."""
    gain, first, second = (1 - q) * (1 - q), 2 * q, -q * q
    for i in range(y.size):
        y[i] = first * y1[i] + (second * y2[i] + gain * y[i])


@kernel
def anticausal_start(x: Any, u: Any, u1: Any, v1: Any, v2: Any, q: Any) -> None:
    """The exact start of the anticausal pass where x goes on for ever (after Triggs and Sdika, 2006).

    Behind the end the causal pass u decays to x as (A + B k) q^k; v1 and v2 are the anticausal pass over that decay,
    one and two steps behind the end.
    """
    r = q * q
    share = (1 - q) * (1 - q) / ((1 - r) * (1 - r))
    tail = 2 * r / (1 - r)
    for i in range(x.size):
        a = u[i] - x[i]
        b = a - q * (u1[i] - x[i])
        v1[i] = x[i] + share * q * (a + b * (1 + tail))
        v2[i] = x[i] + share * r * (a + b * (2 + tail))


@kernel
def sweep(
    height: int, width: int, recursive: bool, q: float, side: float, centre: float, T1: float, T2: float,
    plane: Any, rows: Any, marks: Any,
) -> None:
    """From the bottom up: finish the smoothing of a row, then gradient, norm and suppression of the rows below it."""
    side, centre = np.float32(side), np.float32(centre)
    across, along = rows[0], rows[1]
    gx, gy, norm = rows[3:6], rows[6:9], rows[9:12]
    for row in range(height + PAD - 1, -1, -1):
        if recursive:
            recur(plane[row], plane[row + 1], plane[row + 2], np.float32(q))
        below, middle, above = (row + 3) % 3, (row + 2) % 3, (row + 1) % 3
        combine_columns(plane[row], plane[row + 1], plane[row + 2], side, centre, across, along)
        gradient(across, along, side, centre, gx[above], gy[above], norm[above])
        if row < height:
            suppress(norm[above], norm[middle], norm[below], gx[middle], gy[middle], np.float32(T1), np.float32(T2),
                     marks[row + MARGIN, MARGIN:MARGIN + width])


@kernel
def combine_columns(above: Any, middle: Any, below: Any, side: Any, centre: Any, across: Any, along: Any) -> None:
    """The vertical half of the 3x3 stencils: smoothed for the derivative across, differentiated for that along."""
    for i in range(middle.size):
        across[i] = centre * middle[i] + side * (above[i] + below[i])
        along[i] = below[i] - above[i]


@kernel
def gradient(across: Any, along: Any, side: Any, centre: Any, gx: Any, gy: Any, norm: Any) -> None:
    """The horizontal half of the 3x3 stencils, and the norm of the gradient."""
    for i in range(1, across.size - 1):
        x = across[i + 1] - across[i - 1]
        y = centre * along[i] + side * (along[i - 1] + along[i + 1])
        gx[i] = x
        gy[i] = y
        norm[i] = np.sqrt(x * x + y * y)


@kernel
def suppress(above: Any, middle: Any, below: Any, gx: Any, gy: Any, T1: Any, T2: Any, marks: Any) -> None:
    """Non-maximum suppression, thresholds and direction codes of one row.

    The norm of a pixel is compared with two norms one step along the gradient, forward (to the right, or down where
    the gradient is steep) and backward, each interpolated between the two neighbours that straddle it: with weights
    |gx| - |gy| and |gy| for a flat gradient, so that all sides of a comparison are multiplied by |gx| instead of
    dividing. It stays when greater than both. A tie is won by its first pixel: forward may be equal, backward not.
    """
    low, high, flat = np.float32(1) - TIE, np.float32(1) + TIE, np.float32(1) - FLAT
    for i in range(marks.size):
        j = i + PAD
        x, y = gx[j], gy[j]
        ax, ay = abs(x), abs(y)
        steep = ay > ax
        same = x * y > 0
        large, small = max(ax, ay), min(ax, ay)
        north, south, east, west = above[j], below[j], middle[j + 1], middle[j - 1]
        northeast, northwest, southeast, southwest = above[j + 1], above[j - 1], below[j + 1], below[j - 1]
        ahead = south if steep else east
        behind = north if steep else west
        across_ahead = southwest if steep else northeast
        across_behind = northeast if steep else southwest
        ahead_beside = southeast if same else across_ahead
        behind_beside = northwest if same else across_behind
        forward = (large - small) * ahead + small * ahead_beside
        backward = (large - small) * behind + small * behind_beside
        norm = middle[j]
        own = norm * large
        code = 1 if ay <= SECTION * ax else (3 if ax <= SECTION * ay else (2 if same else 4))
        maximal = (forward <= high * own) & (backward < low * own) & (min(forward, backward) < flat * own)
        mark = code + STRONG if norm > T1 else code
        marks[i] = np.uint8(mark if maximal & (norm > T2) else 0)

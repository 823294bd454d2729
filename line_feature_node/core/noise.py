"""Noise and clutter of an image, measured in the image itself, and what edge extraction makes of them."""

import dataclasses
import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.edges import STENCILS, deriche_stencil, intensity_map
from line_feature_node.core.parameters import Parameters

#: The noise is measured in this many rows, or a few more, and in one of at least so many; in this many columns, or up
#: to twice as many.
ROWS, EVERY, COLUMNS = 30, 16, 320
#: Bins of the histogram that the median is taken from, and how many there are to a grey level.
BINS, RESOLUTION = 4096, 4
#: The median of |x| of a normal distribution, in standard deviations.
MEDIAN = 0.67449
#: The second difference along x and y, [1 -2 1] by [1 -2 1], multiplies the noise by this.
GAIN = 6.0
#: Sobel's gradient is the sum of its weights times the gradient.
SOBEL = 8.0
#: Standard deviation of its components where that of the pixels is 1.
SOBEL_NOISE = math.sqrt(12) / 8
#: Shares of the pixels that may exceed T1 and T2: where most of a picture is texture, what is weaker than half of it
#: is no line that could be told from chance, and would cost the most time.
STRONG_SHARE, WEAK_SHARE = 0.4, 0.5
#: Rounding to whole grey levels is noise of this standard deviation, even where the picture has no other.
ROUNDING = math.sqrt(1 / 12)
#: Knots of alpha over the noise: little smoothing of a clean picture, as much as helps in a noisy one.
ALPHA_NOISE, ALPHA = (2.0, 8.0, 24.0), (2.2, 1.2, 0.7)
#: The mask of a picture all of which counts.
ALL = np.zeros((0, 0), np.uint8)
#: T2 is less than T1.
LARGEST_SHARE = 0.999
#: Steps in which the noise is rounded, so that a video needs few sets of parameters.
STEP = 0.05


class Quality(NamedTuple):
    """What an image is like.

    Attributes:
        noise: Standard deviation of the noise, in grey levels: that of rounding at least.
        strong, weak: Gradients that the shares STRONG_SHARE and WEAK_SHARE of the pixels exceed.
    """

    noise: float
    strong: float = 0.0
    weak: float = 0.0


def measure(
    image: NDArray[Any], parameters: Parameters, buffers: Buffers, keep: NDArray[np.uint8] | None = None,
) -> Quality:
    """Noise and clutter of an image, from some of its rows.

    The second difference along both axes vanishes on edges along an axis and on slopes (Immerkaer, 1996); its median
    leaves out what other edges and texture there are. Gradients are those of Sobel's operator.

    Args:
        image: H×W uint8, uint16 or float32, C-contiguous.
        parameters: intensity_min and intensity_max are used.
        buffers: Memory to work in.
        keep: H×W, 0 where pixels don't count; None where all do.
    """
    scale, _ = intensity_map(image.dtype, parameters)
    sums = buffers.array('noise sums', 2 * BINS, np.int64)[:2 * BINS].reshape(2, BINS)
    total = count_differences(image, ALL if keep is None else keep, scale * RESOLUTION, sums)
    if total == 0:
        return Quality(ROUNDING)
    differences, gradients = sums
    noise = max(quantile(differences, 0.5 * total) / (RESOLUTION * MEDIAN * GAIN), ROUNDING)
    strong, weak = (exceeded_by(share, gradients, total, noise) for share in (STRONG_SHARE, WEAK_SHARE))
    return Quality(noise, strong, weak)


def exceeded_by(share: float, sums: NDArray[np.int64], total: int, noise: float) -> float:
    """The gradient that a share of the pixels exceeds, without what the noise adds to its square.

    Of noise alone the norm has Rayleigh's distribution, which a share s exceeds sqrt(-2 ln s) standard deviations.
    """
    gradient = quantile(sums, (1 - share) * total) / (RESOLUTION * SOBEL)
    of_noise = math.sqrt(-2 * math.log(share)) * SOBEL_NOISE * noise
    return math.sqrt(max(gradient**2 - of_noise**2, 0.0))


def quantile(sums: NDArray[np.int64], wanted: float) -> float:
    """The value below which so many are, from the sums of a histogram of whole numbers that stand for what is around.

    Args:
        sums: How many values are in each bin and those before.
        wanted: How many are to be below, more than 0.
    """
    k = int(np.searchsorted(sums, math.ceil(wanted)))  # as a float it would have all sums converted
    before = int(sums[k - 1]) if k else 0
    return max(k - 0.5 + (wanted - before) / max(int(sums[k]) - before, 1), 0.0)


@inlined
def count(counts: Any, row: int, value: Any) -> None:
    """Count a value, rounded, in a row of the histograms; what is too large for them, or no number, in the last bin."""
    counts[row, np.uint64(value + np.float32(0.5)) if value < np.float32(BINS - 1) else np.uint64(BINS - 1)] += 1


@kernel
def count_differences(image: Any, keep: Any, scale: float, sums: Any) -> int:
    """Count absolute second differences, and norms of Sobel's gradient, of each size or less, multiplied by the scale.

    Pixels with a neighbour above or below that does not count, or that do not count themselves, are left out; `keep` is
    empty where all count.

    Returns:
        How many pixels were looked at; none where the image is too small.
    """
    height, width = image.shape
    factor = np.float32(scale)
    for k in range(BINS):
        sums[0, k], sums[1, k] = 0, 0
    total = 0
    every, turns = max(height // ROWS, EVERY), max(width // COLUMNS, 1)
    for row in range(max(min(1 + every // 2, height // 2), 1), height - 1, every):
        above, middle, below = image[row - 1], image[row], image[row + 1]
        # Rows take turns at the columns, or upright stripes might be seen at one place of them only.
        for i in range(1 + row // every % turns, width - 1, turns):
            if keep.size > 0 and not (keep[row - 1, i] and keep[row, i] and keep[row + 1, i]
                                      and keep[row, i - 1] and keep[row, i + 1]):
                continue
            # Unsigned indices spare the test whether to count from the end.
            before, here, after = np.uint64(i - 1), np.uint64(i), np.uint64(i + 1)
            left = np.float32(above[before]) + np.float32(below[before])
            centre = np.float32(above[here]) + np.float32(below[here])
            right = np.float32(above[after]) + np.float32(below[after])
            west, east = np.float32(middle[before]), np.float32(middle[after])
            second = left + right - 2 * (centre + west + east) + 4 * np.float32(middle[here])
            across = right - left + 2 * (east - west)
            along = (np.float32(below[before]) - np.float32(above[before]) + np.float32(below[after])
                     - np.float32(above[after]) + 2 * (np.float32(below[here]) - np.float32(above[here])))
            count(sums, 0, abs(second) * factor)
            count(sums, 1, np.sqrt(across * across + along * along) * factor)
            total += 1
    for k in range(1, BINS):
        sums[0, k] += sums[0, k - 1]
        sums[1, k] += sums[1, k - 1]
    return total


def adapted(parameters: Parameters, quality: Quality) -> Parameters:
    """The parameters with alpha, T1 and T2 as the image demands them.

    An alpha that is unset is chosen from the noise; T1 and T2 are raised to noise_T1 and noise_T2 times the noise of
    the gradient, and to what a share of the pixels exceeds, `clutter` times as much at most.
    """
    return _adapted(parameters, *(round(value / STEP) * STEP for value in quality))


@lru_cache(maxsize=1024)
def _adapted(parameters: Parameters, noise: float, strong: float, weak: float) -> Parameters:
    p = parameters
    alpha = float(np.interp(noise, ALPHA_NOISE, ALPHA)) if math.isnan(p.alpha) else p.alpha
    chosen = dataclasses.replace(p, alpha=alpha)
    of_gradient = noise * gradient_noise(chosen)
    T1 = min(max(p.T1, p.noise_T1 * of_gradient, min(strong, p.clutter * p.T1)), p.specs()['T1'].high)
    T2 = min(max(p.T2, p.noise_T2 * of_gradient, min(weak, p.clutter * p.T2)), LARGEST_SHARE * T1)
    return dataclasses.replace(chosen, T1=T1, T2=T2)


@lru_cache(maxsize=256)
def gradient_noise(parameters: Parameters) -> float:
    """Standard deviation of a component of the gradient where that of the pixels is 1 and they are independent."""
    derivative, smoothing = responses(parameters)
    return math.sqrt(float((derivative**2).sum() * (smoothing**2).sum()))


@lru_cache(maxsize=256)
def step_response(parameters: Parameters) -> float:
    """The gradient, at its peak, of a step of one grey level between two pixels, along an axis."""
    derivative, _ = responses(parameters)
    return float(np.abs(np.cumsum(derivative)).max())


@lru_cache(maxsize=256)
def correlation_length(parameters: Parameters) -> float:
    """Pixels along an edge whose noise counts as one: (sum s)^2 / sum s^2 of the smoothing s along it."""
    _, smoothing = responses(parameters)
    return float(smoothing.sum()**2 / (smoothing**2).sum())


def responses(parameters: Parameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivative across an edge and smoothing along it, of the operator, as weights of the pixels around one."""
    p = parameters
    if p.operator == 'deriche':
        side, centre = deriche_stencil(p.alpha)
        reach = np.arange(-80, 81)
        decay = math.exp(-p.alpha)**np.abs(reach).astype(float)
        smoothed = np.convolve(decay, decay)
    else:
        side, centre = STENCILS[p.operator]
        smoothed = np.ones(1)
        if p.operator == 'dog':
            smoothed = np.exp(-np.arange(-80, 81)**2 / (2 * p.sigma**2))
    smoothed = smoothed / smoothed.sum()
    return np.convolve(smoothed, [1, 0, -1]) * (2 * side + centre), np.convolve(smoothed, [side, centre, side]) / (
        2 * side + centre)

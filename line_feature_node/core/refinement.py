"""Beyond the paper: lines are laid along the ridge of the gradient, grown as far as it goes, and judged.

The line of a line-blob is a first guess. Each is aligned with the gradient itself: it is shifted and turned to where
the gradient across it peaks. Then it grows at both ends while the gradient goes on, aligned anew as it gets longer, so
that it crosses the gaps that noise or a weak stretch made in its chain. The ends are where the gradient falls to half,
as the smoothed gradient does at the end of an edge. Lines are taken in the order of their strength, and each claims the
pixels along itself: a later one leaves its ends to those who claim them in the same direction, and one that runs mostly
over claimed pixels is the same edge found twice. What is left must be stronger than noise makes it, and than texture of
the picture does by chance.

A line here is q = slope p + intercept, where p is the axis that it follows more closely, the major one: x for flat
lines, y for steep ones. All along it is looked at in whole steps of p.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.features import SEGMENT_DTYPE, VERTICAL, points_up
from line_feature_node.core.parameters import Parameters
from line_feature_node.core.vectors import (
    CACHE_LINE,
    STEPS,
    every,
    fetch,
    floats,
    floor,
    integers,
    larger,
    pairs,
    ramp,
    smaller,
    store,
    total,
    where,
)

#: A line while it grows.
RIDGE_DTYPE = np.dtype([
    ('steep', np.bool_),                                # whether p is y
    ('slope', np.float64), ('intercept', np.float64),
    ('first', np.float64), ('last', np.float64),        # its ends, p
    ('begin', np.float64), ('end', np.float64),         # the ends of what no other line claims of it, p
    ('sign', np.float64),                               # 1 where the gradient points to larger q, else -1
    ('response', np.float64),                           # mean gradient across it
    ('variance', np.float64),                           # of the peaks of the gradient around it, q
    ('size', np.int64),                                 # how many peaks that are
    ('moment', np.float64),                             # sum of the squared distances, p, of the peaks from their mean
    ('alive', np.bool_),
])

#: To align it while it grows, one of at most SPARSEST steps of a line is looked at: of one longer than so many steps
#: every second, and so on.
ROUGH, SPARSEST = 16, 2
#: Rounds of growing; in each but the last a line gets at most twice as long, and STEP at least at each end.
ROUNDS, STEP = 3, 10.0
#: What gets longer by less than this factor in a round has its length.
GROWS = 1.25
#: An end that moves outwards by no more than this, in steps of p, stays where it is.
STAYS = 2.0
#: In the last round nothing bounds it, but the size of the largest picture.
UNBOUNDED = 1e9
#: Pixels at both ends that the alignment leaves out, as corners bend the ridge; and their largest share of the line.
TRIM, LARGEST_TRIM = 2.0, 0.2
#: The farthest that an end moves sideways in one alignment, while growing and at last.
MOVE, LAST_MOVE = 1.0, 0.5
#: A line that moved by less is not aligned once more.
SETTLED = 0.1
#: The gradient must be curved across the line by this part of itself at least, or it has no peak there.
CURVED = 0.05
#: The farthest peak from the line that counts, as a part of a pixel.
FARTHEST_PEAK = np.float32(0.8)
#: The line ends where the gradient, as the mean of a window, falls below this part of what it was before.
END = 0.5
#: Window in pixels: at least, by the square of noise over gradient, and at most.
WINDOW, WINDOW_NOISE, LARGEST_WINDOW = 3.0, 4.0, 24.0
#: Beyond the first guess the response is averaged over about so many steps.
MEMORY = 24
#: The search for an end begins so many steps and half a window inside.
INSIDE = 3
#: A pixel supports the line where the gradient along it is at most this part of that across it, ...
TANGENT = np.float32(0.8)
#: ... and that across it does not grow beside it, both but for so many standard deviations of noise.
TOLERANCE = 2.5
#: Shorter lines are dropped, in pixels; while growing, in steps of p.
SHORTEST, SHORTEST_GROWING = 9.0, 4.0
#: A first guess grows when it has this part of what is asked of a line in the end, and what has grown is aligned to
#: peaks when it has this.
HOPE, GROWN = 0.45, 0.85
#: Claims are kept in cells of so many pixels squared. A line claims those within this distance, in pixels. A first
#: guess of which more than the one part is claimed does not grow, and what has grown is dropped where more than the
#: other part is claimed of what it leaves no other line.
CELL, CLAIM, CLAIMED, REST_CLAIMED = 2, 2.0, 0.6, 0.75
#: In place of its size: it is not known yet what a line grows to.
PENDING = -1
#: What is claimed of a line at an end is left to others where it is so long, in steps of p.
LEFT = 4
#: Between the centres of two pixels.
HALF = 0.5
#: Single precision is enough for what is seen of the gradient, and for sums along a line; with double precision most of
#: the time would go into conversions.
ZERO, ONE = np.float32(0), np.float32(1)
#: What lies beyond this is no place in a picture.
FARTHEST = 1e12
#: atan s = s (pi/4 + ARC (1 - s)), about, for s from 0 to 1 (Rajan and others, 2006).
ARC = 0.273
#: Claims keep the direction of the gradient in so many steps of the full circle, with a bit that says that it is one.
DIRECTIONS, IS_CLAIMED = 128, 128
#: Claims count where the directions differ by at most so many steps, 25 degrees.
SAME_DIRECTION = 9
#: Lines are put into order by so many kinds of strengths, which are 3 % apart, and bits of a float that do not tell on
#: them.
KEYS, KEY_SHIFT = 1 << 13, 18
#: How many lines before their turn what is along them is asked for, and they themselves are.
AHEAD, FAR_AHEAD = 2, 10
#: Pixels whose gradients, in whole numbers, come from memory together.
TOGETHER = CACHE_LINE // 4
#: The part of the correlation length along an edge from which on peaks are independent, as measured.
INDEPENDENT = 0.8
#: Peaks are known to a fiftieth of a pixel at best, in whole grey levels.
LEAST_VARIANCE = 0.02**2
#: Norms are counted in every so many rows and columns, in fewer of a large picture, about so many of each, and in bins
#: of so many units of the gradient.
COUNT_ROWS, COUNT_COLUMNS, MOST_ROWS, MOST_COLUMNS, NORM_BINS, NORM_BIN = 8, 2, 60, 320, 4096, 4
#: From one row where norms are counted to the next the place among so many rows moves by this part of them: the
#: golden section, so that it is soon everywhere among them.
SCATTER = (math.sqrt(5) - 1) / 2
#: No gradient is rarer than this share of the pixels, as so many are looked at.
RAREST = 1e-4


class Ridges(NamedTuple):
    """What refinement reads, besides the lines.

    Attributes:
        gradient: H×W×2, padded: its components along x and y, in some unit.
        pad: Its padding on each side.
        height, width: Of the picture.
        noise: Standard deviation of the noise of a component, in that unit.
        step: The gradient of a step of one grey level, in that unit.
        correlation: Pixels along an edge whose noise counts as one.
    """

    gradient: NDArray[Any]
    pad: int
    height: int
    width: int
    noise: float
    step: float
    correlation: float


class Demands(NamedTuple):
    """What is asked of a line in a picture.

    Attributes:
        rarities: Of the norms of the picture's gradients, by their bins; the extractor's own.
        strength: What its response by root of length must be.
        evidence: What -l log10 H must be, for its length l and the share H of the pixels that have such a gradient.
        tests: log10 of the number of lines that can be drawn.
        sigma_theta: The largest standard deviation that its orientation may have.
    """

    rarities: NDArray[np.float64]
    strength: float
    evidence: float
    tests: float
    sigma_theta: float


class Guesses(NamedTuple):
    """First guesses. The arrays are the extractor's own.

    Attributes:
        ridges: RIDGE_DTYPE.
        strengths: float32, how clear each is.
        grown: RIDGE_DTYPE, what became of each that has grown, as :func:`grow` leaves them; the guesses themselves
            where none has.
    """

    ridges: NDArray[np.void]
    strengths: NDArray[np.float32]
    grown: NDArray[np.void]


def demands(ridges: Ridges, parameters: Parameters, buffers: Buffers) -> Demands:
    """What is asked of a line, by the picture; min_snr, false_alarms and max_sigma_theta are used."""
    rarities = buffers.array('rarities', NORM_BINS, np.float64)[:NORM_BINS]
    rank_norms(ridges.gradient, ridges.pad, ridges.height, ridges.width,
               buffers.array('norm counts', NORM_BINS, np.int64)[:NORM_BINS], rarities)
    tests = 2 * math.log10(ridges.height * ridges.width)
    return Demands(rarities, parameters.min_snr * ridges.noise, tests - math.log10(parameters.false_alarms), tests,
                   parameters.max_sigma_theta)


def first_guesses(lines: NDArray[np.void], count: int, ridges: Ridges, buffers: Buffers) -> Guesses:
    """Look at the gradient along lines.

    Args:
        lines: LINE_DTYPE.
        count: How many there are.
        ridges: The gradient.
        buffers: Memory to work in.
    """
    first = buffers.array('first ridges', count, RIDGE_DTYPE)[:count]
    strengths = buffers.array('strengths', count, np.float32)[:count]
    gradient = ridges.gradient
    lay(lines, gradient.reshape(-1), gradient.shape[1], ridges.pad, ridges.height, ridges.width, first, strengths)
    return Guesses(first, strengths, first)


def grown_ahead(guesses: Guesses, ridges: Ridges, asked: Demands, buffers: Buffers) -> Guesses:
    """Let part of a picture's guesses grow, those that need it as far as that part can tell."""
    grown = buffers.array('grown', guesses.ridges.size, RIDGE_DTYPE)[:guesses.ridges.size]
    grown.view(np.uint8)[:] = guesses.ridges.view(np.uint8)  # records would be copied field by field
    guesses = guesses._replace(grown=grown)
    grow_in_order(guesses, ridges, asked, buffers)
    return guesses


def grow_in_order(guesses: Guesses, ridges: Ridges, asked: Demands, buffers: Buffers) -> NDArray[np.int64]:
    """As :func:`grow`, strongest first, to 3 %; returns their places in that order."""
    gradient, pad, height, width, noise = ridges[:5]
    count, cells_twice = guesses.strengths.size, 2 * -(-height // CELL) * -(-width // CELL)
    order = buffers.array('order', count, np.int64)[:count]
    strongest_first(guesses.strengths.view(np.uint32), buffers.array('strength counts', KEYS, np.int64)[:KEYS], order)
    grow(order, guesses.ridges, asked.rarities, (asked.strength, asked.evidence), gradient.reshape(-1),
         gradient.shape[1], pad, height, width, noise,
         buffers.array('claims', cells_twice, np.uint8)[:cells_twice],
         buffers.array('responses', 2 * (height + width) + 4 * MEMORY, np.float32), guesses.grown)
    return order


def joined_guesses(parts: list[Guesses], buffers: Buffers) -> Guesses:
    """Those of all parts, one after the other."""
    if len(parts) == 1:
        return parts[0]
    strengths = np.concatenate([part.strengths for part in parts])
    ridges = together('ridges', [part.ridges for part in parts], buffers)
    return Guesses(ridges, strengths, together('all grown', [part.grown for part in parts], buffers))


def together(name: str, parts: list[NDArray[np.void]], buffers: Buffers) -> NDArray[np.void]:
    """All lines of some lists, in memory of a name."""
    size = sum(part.size for part in parts)
    lines = buffers.array(name, size, RIDGE_DTYPE)[:size]
    # Records would be copied field by field.
    np.concatenate([part.view(np.uint8) for part in parts], out=lines.view(np.uint8))
    return lines


def refine_lines(parts: list[Guesses], ridges: Ridges, asked: Demands, buffers: Buffers) -> NDArray[np.void]:
    """Align, grow, claim and judge.

    Args:
        parts: First guesses.
        ridges: The gradient, and what is known of its noise.
        asked: What is asked of a line.
        buffers: Memory to work in.

    Returns:
        SEGMENT_DTYPE, strongest first guess first, to 3 %, a new array.
    """
    gradient, pad, height, width, _, step, correlation = ridges
    guesses = joined_guesses(parts, buffers)
    order = grow_in_order(guesses, ridges, asked, buffers)
    kept = judge((asked.strength, asked.evidence), asked.sigma_theta, asked.rarities, correlation, order,
                 gradient.reshape(-1), gradient.shape[1], pad, height, width, guesses.grown)
    segments = np.empty(kept, SEGMENT_DTYPE)
    write(order, guesses.grown, step, correlation, asked.tests, asked.rarities, segments)
    return segments


# Looking at a line

class Axes(NamedTuple):
    """How a line sees the picture.

    Attributes:
        origin: The first pixel of the picture, among those of the gradient.
        step_p, step_q: What a step along p and along q adds to the number of a pixel.
        size_p, size_q: How many steps of p and of q the picture has.
    """

    origin: int
    step_p: int
    step_q: int
    size_p: int
    size_q: int


@inlined
def axes_of(line: Any, stride: int, pad: int, height: int, width: int) -> Axes:
    """Those of a line, where rows of the gradient have so many pixels."""
    origin = pad * (stride + 1)
    if line['steep']:
        return Axes(origin, stride, 1, height, width)
    return Axes(origin, 1, stride, width, height)


@inlined
def normal_of(line: Any) -> tuple[Any, Any]:
    """The unit normal of a line that the gradient points along, its parts along x and y."""
    slope = line['slope']
    scale = line['sign'] / math.sqrt(1 + slope * slope)
    if line['steep']:
        return np.float32(scale), np.float32(-slope * scale)
    return np.float32(-slope * scale), np.float32(scale)


@inlined
def across(gradient: Any, pixels: Any, nx: Any, ny: Any) -> Any:
    """The gradient across a line at pixels, its part along the normal."""
    x, y = pairs(gradient, pixels)
    return nx * x + ny * y


@inlined
def profile(gradient: Any, pixels: Any, step_q: int, nx: Any, ny: Any) -> tuple[Any, Any, Any]:
    """The gradient across a line at pixels, and at those beside them, towards smaller and larger q."""
    return (across(gradient, pixels - step_q, nx, ny), across(gradient, pixels, nx, ny),
            across(gradient, pixels + step_q, nx, ny))


@inlined
def pixel_at(p: int, line: Any, axes: Axes) -> tuple[Any, int]:
    """Where a line is in a step of p: how far beyond a whole q, and the pixel there.

    Along a line q is counted from that pixel: single precision is enough for it then, however large the picture is.
    """
    q = line['slope'] * p + line['intercept']
    whole = math.floor(q)
    return np.float32(q - whole), axes.origin + p * axes.step_p + whole * axes.step_q


@inlined
def steps(first: int, size: int) -> tuple[Any, Any]:
    """STEPS steps from one on, of which there are so many in all: which are there, and the last one for the others."""
    numbers = ramp(first)
    return numbers < size, smaller(numbers, size - 1)


@inlined
def within(
    slope: float, intercept: float, first: float, last: float, beyond: float, size_p: int, size_q: int,
) -> tuple[int, int]:
    """The first and the last whole p between two where a line is in the picture, or no farther than that beyond it.

    Where it is nowhere, the last is less than the first; so it is for what is no number. By rounding the line may be
    a little farther out there.
    """
    least, most = -beyond, size_q - 1 + beyond
    at_first, at_last = slope * first + intercept, slope * last + intercept
    # Nearly all lines are inside, with no need to divide.
    if 0 <= first <= last <= size_p - 1 and min(at_first, at_last) >= least and max(at_first, at_last) <= most:
        return math.ceil(first), math.floor(last)
    # Of a number and what is none, min and max give the one or the other.
    if not (abs(slope) < FARTHEST and abs(intercept) < FARTHEST and abs(first) < FARTHEST and abs(last) < FARTHEST):
        return 0, -1
    low, high = max(first, 0.0), min(last, size_p - 1.0)
    if slope != 0:
        at_least, at_most = (least - intercept) / slope, (most - intercept) / slope
        low, high = max(low, min(at_least, at_most)), min(high, max(at_least, at_most))
    elif not least <= intercept <= most:
        high = -1.0
    high = max(high, -1.0)
    return math.ceil(min(low, high + 1)), math.floor(high)


@inlined
def mean_response(line: Any, gradient: Any, axes: Axes) -> float:
    """The mean gradient across a line, in STEPS places along it at most; arguments as for :func:`align`."""
    low, high = within(line['slope'], line['intercept'], line['first'], line['last'], HALF, axes.size_p, axes.size_q)
    if high < low:
        return 0.0
    stride = 1 + (high - low) // STEPS
    n = (high - low) // stride + 1
    nx, ny = normal_of(line)
    beyond, pixel = pixel_at(low + (high - low) % stride // 2, line, axes)
    there, s = steps(0, n)
    r = integers(floor(np.float32(line['slope'] * stride) * floats(s) + (beyond + HALF)))
    at = across(gradient, s * (stride * axes.step_p) + r * axes.step_q + pixel, nx, ny)
    return float(total(where(there, at, ZERO))) / n


@inlined
def fetch_along(line: Any, gradient: Any, axes: Axes, claims: Any, height: int, width: int) -> None:
    """Ask for what will be looked at along a line: that comes while others grow."""
    low, high = within(line['slope'], line['intercept'], line['first'], line['last'], HALF, axes.size_p, axes.size_q)
    step_p, step_q, _, __ = cells(line['steep'], height, width)
    # Pixels across a steep line are beside each other in memory, and those along a flat one.
    pace = CELL if line['steep'] else TOGETHER
    for p in range(low, high + pace, pace):
        _, pixel = pixel_at(p, line, axes)
        fetch(claims, p // CELL * step_p + int(line['slope'] * p + line['intercept']) // CELL * step_q)
        fetch(gradient, 2 * pixel)
        fetch(gradient, 2 * (pixel + max(axes.step_p, axes.step_q)))
        if not line['steep']:
            fetch(gradient, 2 * (pixel - axes.step_q))


# Aligning

@kernel
def align(line: Any, gradient: Any, axes: Axes, move: float) -> None:
    """Shift and turn a line to about where the gradient across it peaks.

    In each step of p the peak would be that of the parabola through the gradient at three pixels across. In the noise
    a single parabola may have none, so all have their mean curvature here.

    Args:
        line: It is changed, and receives its mean response.
        gradient: Its components, flat.
        axes: Those of the line.
        move: The farthest that an end moves.
    """
    trim = min(TRIM, LARGEST_TRIM * (line['last'] - line['first']))
    low, high = within(line['slope'], line['intercept'], line['first'] + trim, line['last'] - trim, HALF, axes.size_p,
                       axes.size_q)
    if high - low + 1 < SHORTEST_GROWING:
        return
    stride = min(1 + (high - low) // ROUGH, SPARSEST)
    n = (high - low) // stride + 1
    low += (high - low) % stride // 2
    nx, ny = normal_of(line)
    beyond, pixel = pixel_at(low, line, axes)
    rise, half = np.float32(line['slope'] * stride), np.float32(0.5 * stride * (n - 1))
    response = curvature = slant = slant_t = sd = std = every(0)
    for k in range(0, n, STEPS):
        there, s = steps(k, n)
        q = rise * floats(s) + beyond
        r = floor(q + HALF)
        before, at, behind = profile(
            gradient, s * (stride * axes.step_p) + integers(r) * axes.step_q + pixel, axes.step_q, nx, ny)
        t = floats(s * stride) - half
        d, first = where(there, r - q, ZERO), where(there, behind - before, ZERO)
        response = response + where(there, at, ZERO)
        curvature = curvature + where(there, behind + before - (at + at), ZERO)
        slant = slant + first
        slant_t = slant_t + t * first
        sd = sd + d
        std = std + t * d
    line['response'] = float(total(response)) / n
    second = 2.0 * total(curvature) / n
    if second < -2 * CURVED * line['response']:
        turn = (total(std) - total(slant_t) / second) / (stride * stride * n * (n * n - 1.0) / 12)
        nudge(line, (total(sd) - total(slant) / second) / n, turn, low + half, move)


@kernel
def align_to_peaks(line: Any, gradient: Any, axes: Axes, move: float) -> float:
    """Shift and turn a line to the peaks of the gradient across it that are no farther than FARTHEST_PEAK.

    Args:
        line: It is changed, and receives its mean response, and variance, size and moment of the peaks, if there are
            enough.
        gradient, axes, move: As for :func:`align`.

    Returns:
        How far its ends moved, q.
    """
    trim = min(TRIM, LARGEST_TRIM * (line['last'] - line['first']))
    low, high = within(line['slope'], line['intercept'], line['first'] + trim, line['last'] - trim, HALF, axes.size_p,
                       axes.size_q)
    size = high - low + 1
    if size < SHORTEST_GROWING:
        return 0.0
    nx, ny = normal_of(line)
    beyond, pixel = pixel_at(low, line, axes)
    rise, half = np.float32(line['slope']), np.float32(0.5 * (size - 1))
    response = peaks = sum_t = sum_tt = sum_d = sum_td = sum_dd = every(0)
    for k in range(0, size, STEPS):
        there, s = steps(k, size)
        q = rise * floats(s) + beyond
        r = floor(q + HALF)
        before, at, behind = profile(
            gradient, s * axes.step_p + integers(r) * axes.step_q + pixel, axes.step_q, nx, ny)
        response = response + where(there, at, ZERO)
        first, second = behind - before, behind + before - (at + at)
        second = second + second
        near = there & (abs(first) < second * -FARTHEST_PEAK)
        t, d = where(near, floats(s) - half, ZERO), where(near, r - q - first / where(near, second, ONE), ZERO)
        peaks = peaks + where(near, every(1), ZERO)
        sum_t = sum_t + t
        sum_tt = sum_tt + t * t
        sum_d = sum_d + d
        sum_td = sum_td + t * d
        sum_dd = sum_dd + d * d
    n = int(total(peaks))
    if n < SHORTEST_GROWING:
        return 0.0
    st, sd, std = float(total(sum_t)), float(total(sum_d)), float(total(sum_td))
    moment = total(sum_tt) - st * st / n
    turn = (std - st * sd / n) / moment
    shift = (sd - turn * st) / n
    line['response'] = float(total(response)) / size
    line['variance'] = max(total(sum_dd) - shift * sd - turn * std, 0.0) / max(n - 2, 1)
    line['size'], line['moment'] = n, moment
    return nudge(line, shift, turn, low + half, move)


@inlined
def nudge(line: Any, shift: float, turn: float, middle: float, move: float) -> float:
    """Shift a line by so much, and turn it by so much about a place, as far as its ends may move; how far they did."""
    half = 0.5 * (line['last'] - line['first'])
    shift = min(max(shift, -move), move)
    turn = min(max(turn, -move / half), move / half)
    line['slope'] += turn
    line['intercept'] += shift - turn * middle
    return abs(shift) + abs(turn) * half


# Growing

@inlined
def support(q: Any, gradient: Any, pixels: Any, step_q: int, nx: Any, ny: Any, tolerance: Any) -> Any:
    """The gradient across a line at places between two pixels each, as far as it supports the line.

    It does not where it points elsewhere, or is stronger one pixel beside the line; what noise may do is tolerated.

    Args:
        q: The places, from the pixels on.
        gradient, pixels: The gradient, and where it is looked at for q = 0.
        step_q: What a step along q adds to the number of a pixel.
        nx, ny: Normal of the line.
        tolerance: What noise may do.
    """
    r = floor(q)
    lower = q - r
    upper = ONE - lower
    at = pixels + integers(r) * step_q
    (x1, y1), (x2, y2) = pairs(gradient, at), pairs(gradient, at + step_q)
    first, second = nx * x1 + ny * y1, nx * x2 + ny * y2
    response = upper * first + lower * second
    before = upper * across(gradient, at - step_q, nx, ny) + lower * first
    behind = upper * second + lower * across(gradient, at + 2 * step_q, nx, ny)
    tangential = abs(ny * (upper * x1 + lower * x2) - nx * (upper * y1 + lower * y2))
    supports = (tangential <= TANGENT * response + tolerance) & (larger(before, behind) <= response + tolerance)
    return where(supports, response, smaller(response, ZERO))


@kernel
def extend(
    line: Any, gradient: Any, axes: Axes, noise: float, limit: float, at_first: bool, at_last: bool, values: Any,
) -> None:
    """Move the ends of a line to where the gradient across it ends; arguments as for :func:`align`.

    Args:
        line: It is changed.
        noise: Of a component of the gradient.
        limit: The farthest that an end moves outwards, in steps of p.
        at_first, at_last: Whether its first and its last end are looked for.
        values: Memory for what supports the line in each step.
    """
    # Of a response that is no number, as pixels near the largest float have it, the window is the largest.
    size = WINDOW + WINDOW_NOISE * (noise / max(line['response'], 1e-6))**2
    if not size < LARGEST_WINDOW:
        size = LARGEST_WINDOW
    half, tolerance = int(size) // 2, np.float32(TOLERANCE * noise)
    first, last = line['first'], line['last']
    if at_last:
        line['last'] = end_of(line, 1, last, first, half, gradient, axes, tolerance, limit, values)
    if at_first:
        line['first'] = -end_of(line, -1, -first, -last, half, gradient, axes, tolerance, limit, values)


@kernel
def end_of(
    line: Any, way: int, end: float, other: float, half: int, gradient: Any, axes: Axes, tolerance: Any, limit: float,
    values: Any,
) -> float:
    """Where a line ends on one side, in steps of p outwards; `way` is 1 where these are p itself, and -1 for -p.

    From a place inside it goes outwards step by step, until the mean over a window around the place is below END of the
    response: that of the line, and farther out that of about the last MEMORY steps. Between two steps the end is
    interpolated. Outside the picture nothing supports a line, and no line ends.
    """
    low, high = within(line['slope'], line['intercept'], 0.0, axes.size_p - 1.0, 0.0, axes.size_p, axes.size_q)
    nearest, farthest = (low, high) if way == 1 else (-high, -low)
    place = math.floor(end - min(half + INSIDE, 0.5 * (end - other)))
    start, base, size = place, place - half, 2 * half + 1
    # Sums over a window, in place of means.
    window, earlier, least, found = 0.0, 0.0, END * size * line['response'], float(place)
    step = seen = base
    while True:
        if step == seen:
            look_on(line, way, base, seen, nearest, farthest, gradient, axes, tolerance, values)
            seen += STEPS
        window += values[step - base]
        step += 1
        if step <= place + half:
            continue
        if window < least:
            found = place - 1 + (earlier - least) / (earlier - window) if place > start else float(place)
            break
        if place >= end + limit:
            found = end + limit
            break
        if place + 1 > farthest or place + 1 < nearest:
            found = float(place)
            break
        if place > end:
            least += (min(max(END * size * values[place - base], 0.0), 2 * least) - least) / MEMORY
        earlier = window
        window -= values[place - half - base]
        place += 1
    return found


@inlined
def look_on(
    line: Any, way: int, base: int, step: int, nearest: int, farthest: int, gradient: Any, axes: Axes, tolerance: Any,
    values: Any,
) -> None:
    """What supports a line in STEPS steps outwards, from one on, where that from the base on is kept.

    Args:
        line, way, gradient, axes, tolerance, values: As for :func:`end_of`.
        base, step: In steps of p outwards.
        nearest, farthest: Steps between which the line is in the picture.
    """
    seen = every(0)
    if nearest <= farthest:
        # A step in the picture that the others are counted from.
        known = min(max(base, nearest), farthest)
        nx, ny = normal_of(line)
        beyond, pixel = pixel_at(way * known, line, axes)
        numbers = ramp(step - known)
        s = larger(smaller(numbers, farthest - known), nearest - known)
        found = support(np.float32(way * line['slope']) * floats(s) + beyond, gradient,
                        s * (way * axes.step_p) + pixel, axes.step_q, nx, ny, tolerance)
        seen = where((numbers >= nearest - known) & (numbers <= farthest - known), found, ZERO)
    store(values, step - base, seen)


@kernel
def lay(
    lines: Any, gradient: Any, stride: int, pad: int, height: int, width: int, grown: Any, strengths: Any,
) -> None:
    """Turn first guesses into lines along their major axis, and tell how strong the gradient is along them."""
    for k in range(grown.size):
        guess, line = lines[k], grown[k]
        steep = abs(guess['sin']) > guess['cos']
        line['steep'] = steep
        if steep:
            line['slope'] = guess['cos'] / guess['sin']
            line['intercept'] = guess['x'] - line['slope'] * guess['y']
            line['first'], line['last'] = min(guess['y1'], guess['y2']), max(guess['y1'], guess['y2'])
        else:
            line['slope'] = guess['sin'] / guess['cos']
            line['intercept'] = guess['y'] - line['slope'] * guess['x']
            line['first'], line['last'] = min(guess['x1'], guess['x2']), max(guess['x1'], guess['x2'])
        line['sign'] = 1.0
        response = mean_response(line, gradient, axes_of(line, stride, pad, height, width))
        if response < 0:
            line['sign'], response = -1.0, -response
        line['response'], line['size'], line['alive'] = response, PENDING, False
        strengths[k] = response * math.sqrt(line['last'] - line['first'])


@kernel
def grow(
    order: Any, guesses: Any, rarities: Any, least: tuple[float, float], gradient: Any, stride: int, pad: int,
    height: int, width: int, noise: float, claims: Any, values: Any, grown: Any,
) -> None:
    """Let the first guesses that may become clear enough grow, in their order; those alive at the end are there once.

    How a guess grows does not depend on the others, but whether it need grow does. So what has grown before, by the
    claims of some lines only, is looked up when all lines are gone through, and need not grow again.

    Args:
        order: Places of the guesses, strongest first.
        guesses: They stay as they are; or they are what has grown itself, where nothing has grown before.
        grown: What becomes of them, at the same places: its size is PENDING of what has not grown yet, or need not
            by the claims so far, and 0 where nothing comes of it.
    """
    for k in range(claims.size):
        claims[k] = 0
    for place in range(order.size):
        if place + FAR_AHEAD < order.size:
            fetch(guesses, order[place + FAR_AHEAD])
        if place + AHEAD < order.size:
            later = order[place + AHEAD]
            if grown[later]['size'] == PENDING:
                fetch_along(guesses[later], gradient, axes_of(guesses[later], stride, pad, height, width), claims,
                            height, width)
        k = order[place]
        guess, line = guesses[k], grown[k]
        line['alive'] = False
        if line['size'] == PENDING and not is_clear(guess, rarities, HOPE * least[0], HOPE * least[1]):
            line['size'] = 0
        if line['size'] == 0 or claimed(guess, claims, height, width) > CLAIMED:
            continue
        if line['size'] == PENDING:
            grown[k] = guess
            grow_guess(line, rarities, GROWN * least[0], GROWN * least[1], gradient,
                       axes_of(line, stride, pad, height, width), noise, values)
        if line['size'] > 0 and leave(line, claims, height, width) <= REST_CLAIMED:
            line['alive'] = True
            claim(line, claims, height, width)


@inlined
def grow_guess(
    line: Any, rarities: Any, least_strength: float, least_evidence: float, gradient: Any, axes: Axes, noise: float,
    values: Any,
) -> None:
    """Let a first guess grow, and lay it along the peaks if it is as clear as that; its size is 0 if it is not."""
    grow_line(line, gradient, axes, noise, values)
    line['size'] = 0
    if line['last'] - line['first'] >= SHORTEST_GROWING and is_clear(line, rarities, least_strength, least_evidence):
        settle(line, gradient, axes, noise, values)


@kernel
def grow_line(line: Any, gradient: Any, axes: Axes, noise: float, values: Any) -> None:
    """Align a line and move its ends by turns; arguments as for :func:`extend`."""
    at_first = at_last = True
    for turn in range(ROUNDS):
        first, last = line['first'], line['last']
        align(line, gradient, axes, MOVE)
        limit = max(last - first, STEP) if turn < ROUNDS - 1 else UNBOUNDED
        extend(line, gradient, axes, noise, limit, at_first, at_last, values)
        # An end that stayed about where it was is one; the other is looked for anew, along a better line.
        at_first, at_last = first - line['first'] > STAYS, line['last'] - last > STAYS
        if not (at_first or at_last) or line['last'] - line['first'] < GROWS * (last - first):
            break


@kernel
def settle(line: Any, gradient: Any, axes: Axes, noise: float, values: Any) -> None:
    """Align a line to single peaks; arguments as for :func:`extend`."""
    moved = align_to_peaks(line, gradient, axes, LAST_MOVE)
    if moved > SETTLED:  # other peaks may be near enough now
        align_to_peaks(line, gradient, axes, LAST_MOVE)
        extend(line, gradient, axes, noise, 0.0, True, True, values)


# Claims

@inlined
def direction_of(line: Any) -> int:
    """The direction of the gradient across a line, in DIRECTIONS steps of the full circle.

    The slope is its tangent, or cotangent, and 1 at most but for what alignment turned: a parabola has the angle within
    a quarter of a degree.
    """
    slope = line['slope']
    angle = slope * (math.pi / 4 + ARC * (1 - abs(slope)))
    if line['steep']:
        angle = (0.0 if line['sign'] > 0 else math.pi) - angle
    else:
        angle += math.copysign(math.pi / 2, line['sign'])
    return math.floor(angle * DIRECTIONS / (2 * math.pi) + 0.5) & DIRECTIONS - 1


@kernel
def claimed(line: Any, claims: Any, height: int, width: int) -> float:
    """The share of a line whose cells others claim that run in the same direction."""
    own = direction_of(line)
    slope, intercept = line['slope'], line['intercept']
    step_p, step_q, size_p, size_q = cells(line['steep'], height, width)
    low, high = within(slope, intercept, line['first'], line['last'], HALF, size_p, size_q)
    hits, count = 0, 0
    for p in range(low, high + 1, CELL):
        hits += is_claimed(p, slope * p + intercept, own, claims, step_p, step_q, size_q)
        count += 1
    return hits / max(count, 1)


@kernel
def leave(line: Any, claims: Any, height: int, width: int) -> float:
    """Leave what others claim at the ends of a line to them; return which share of the rest they claim, too."""
    own = direction_of(line)
    slope, intercept = line['slope'], line['intercept']
    step_p, step_q, size_p, size_q = cells(line['steep'], height, width)
    low, high = within(slope, intercept, line['first'], line['last'], HALF, size_p, size_q)
    # Cells in all, of those the claimed ones, and of these such as follow the first end or precede the last.
    count, hits, at_first, at_last = 0, 0, 0, 0
    for p in range(low, high + 1, CELL):
        if is_claimed(p, slope * p + intercept, own, claims, step_p, step_q, size_q):
            hits += 1
            at_last += 1
            at_first += hits > count
        else:
            at_last = 0
        count += 1
    line['begin'], line['end'] = line['first'], line['last']
    if hits == count:
        return 1.0
    rest, rest_hits = count, hits
    if CELL * at_first >= LEFT:
        line['begin'] = low + CELL * at_first - CLAIM
        rest, rest_hits = rest - at_first, rest_hits - at_first
    if CELL * at_last >= LEFT:
        line['end'] = low + CELL * (count - at_last - 1) + CLAIM
        rest, rest_hits = rest - at_last, rest_hits - at_last
    return rest_hits / rest


@inlined
def is_claimed(
    p: int, q: float, direction: int, claims: Any, step_p: int, step_q: int, size_q: int,
) -> bool:
    """Whether a place is in a cell of a line of about the same direction."""
    r = min(max(math.floor(q + HALF), 0), size_q - 1)
    cell = np.uint64(p // CELL * step_p + r // CELL * step_q)
    return is_along(claims[cell], direction) | is_along(claims[cell + np.uint64(1)], direction)


@inlined
def is_along(mark: Any, direction: int) -> bool:
    """Whether a claim is there, of a line whose direction is about the same."""
    turned = (np.int64(mark) - direction + SAME_DIRECTION) & DIRECTIONS - 1
    return (mark >= IS_CLAIMED) & (turned <= 2 * SAME_DIRECTION)


@kernel
def claim(line: Any, claims: Any, height: int, width: int) -> None:
    """Claim the cells near a line that nobody claims in about its direction, where there is room for one more claim."""
    own = direction_of(line)
    mark = np.uint8(own | IS_CLAIMED)
    slope, intercept = line['slope'], line['intercept']
    step_p, step_q, size_p, size_q = cells(line['steep'], height, width)
    reach = CLAIM * math.sqrt(1 + slope * slope)
    low, high = within(slope, intercept, line['begin'], line['end'], reach, size_p, size_q)
    for cell in range(low // CELL, high // CELL + (high >= low)):
        q = slope * (CELL * cell + HALF) + intercept
        for r in range(max(math.ceil(q - reach), 0) // CELL, min(math.floor(q + reach), size_q - 1) // CELL + 1):
            index = np.uint64(cell * step_p + r * step_q)
            if not is_along(claims[index], own):
                index += np.uint64(claims[index] != 0)
                claims[index] = claims[index] or mark


@inlined
def cells(steep: bool, height: int, width: int) -> tuple[int, int, int, int]:
    """What a cell along p and along q adds to an index of the claims; steps of p and of q that the picture has.

    A cell has room for two claims: edges as near to each other as the sides of a thin line have opposite directions.
    """
    stride = 2 * ((width + CELL - 1) // CELL)
    if steep:
        return stride, 2, height, width
    return 2, stride, width, height


# Judging

@inlined
def length_of(line: Any) -> float:
    """Its length in pixels."""
    return (line['last'] - line['first']) * math.sqrt(1 + line['slope'] * line['slope'])


@kernel
def strongest_first(bits: Any, counts: Any, order: Any) -> None:
    """Put the places of numbers into order, the largest number first, by their first bits, which are counted.

    Args:
        bits: uint32, those of floats that are not negative.
        counts: Memory for KEYS whole numbers.
        order: Receives the places.
    """
    for key in range(KEYS):
        counts[key] = 0
    for place in range(bits.size):
        counts[key_of(bits[place])] += 1
    before = 0
    for key in range(KEYS):
        before, counts[key] = before + counts[key], before
    for place in range(bits.size):
        key = key_of(bits[place])
        order[counts[key]] = place
        counts[key] += 1


@inlined
def key_of(bits: Any) -> int:
    """The smaller the number, the larger: the exponent of a float, and the first bits behind it."""
    return KEYS - 1 - (int(bits) >> KEY_SHIFT & KEYS - 1)


@inlined
def norm_bin(norm: float) -> int:
    """The bin of a norm; that of what is too large for all, or no number, is the last."""
    return int(norm / NORM_BIN) if norm < NORM_BIN * (NORM_BINS - 1) else NORM_BINS - 1


@inlined
def rarity(response: float, rarities: Any) -> float:
    """-log10 of the share of the picture's pixels with a gradient as strong."""
    return float(rarities[norm_bin(response)])


@kernel
def rank_norms(gradient: Any, pad: int, height: int, width: int, counts: Any, rarities: Any) -> None:
    """How rare norms are, by their bins."""
    count_norms(gradient, pad, height, width, counts)
    count, rare = 0, -math.log10(RAREST)
    for k in range(counts.size - 1, -1, -1):
        if counts[k] != count:
            count = counts[k]
            rare = -math.log10(max(count / counts[0], RAREST))
        rarities[k] = rare


@kernel
def count_norms(gradient: Any, pad: int, height: int, width: int, counts: Any) -> None:
    """Count how many of the pixels that are looked at have a norm of each bin, or a larger one."""
    for k in range(counts.size):
        counts[k] = 0
    apart, turns = max(height // MOST_ROWS, COUNT_ROWS), max(width // MOST_COLUMNS, COUNT_COLUMNS)
    for k in range((height + apart - 1) // apart):
        # At another place each time: of a pattern that repeats all is to be seen.
        row = apart * k + int(apart * (SCATTER * k % 1))
        if row >= height:
            continue
        for column in range(k % turns, width, turns):
            # Unsigned indices spare the test whether to count from the end.
            down, right = np.uint64(row + pad), np.uint64(column + pad)
            x, y = gradient[down, right, 0], gradient[down, right, 1]
            counts[np.uint64(norm_bin(math.sqrt(np.float32(x) * x + np.float32(y) * y)))] += 1
    for k in range(counts.size - 2, -1, -1):
        counts[k] += counts[k + 1]


@inlined
def is_clear(line: Any, rarities: Any, least_strength: float, least_evidence: float) -> bool:
    """Whether neither noise nor chance makes a line as clear as this.

    Were the gradients of the picture spread over it without order, a line of length l along which they are as strong as
    a share H of them is would be there N H^l times by chance, N being the number of lines that can be drawn (Desolneux,
    Moisan and Morel, 2001, with the mean in place of the minimum).

    Args:
        line: The line.
        rarities: Of the norms.
        least_strength: What its response by root of length must be.
        least_evidence: What -l log10 H must be.
    """
    length = length_of(line)
    return (line['response'] * math.sqrt(length) >= least_strength
            and length * rarity(line['response'], rarities) >= least_evidence)


@kernel
def judge(
    least: tuple[float, float], sigma_theta: float, rarities: Any, correlation: float, order: Any, gradient: Any,
    stride: int, pad: int, height: int, width: int, grown: Any,
) -> int:
    """Drop the lines that are too short, not clear or not certain enough from the order; return how many are left.

    What a line left to others does not count: it is judged, and told of, by what there is along the rest.
    """
    left = 0
    for place in range(order.size):
        if place + FAR_AHEAD < order.size:
            fetch(grown, order[place + FAR_AHEAD])
        line = grown[order[place]]
        if not line['alive']:
            continue
        if line['begin'] > line['first'] or line['end'] < line['last']:
            line['first'], line['last'], line['size'] = line['begin'], line['end'], 0
            align_to_peaks(line, gradient, axes_of(line, stride, pad, height, width), 0.0)
        if (line['size'] > 0 and length_of(line) >= SHORTEST and is_clear(line, rarities, least[0], least[1])
                and deviations(line, correlation)[0] <= sigma_theta):
            order[left] = order[place]
            left += 1
    return left


@inlined
def deviations(line: Any, correlation: float) -> tuple[float, float]:
    """Standard deviations of the orientation of a line, radians, and of its position across it, pixels."""
    scale = 1 / math.sqrt(1 + line['slope'] * line['slope'])
    # Noise of neighbouring peaks is smoothed along the edge: so many of them count as one.
    as_one = max(INDEPENDENT * correlation * scale, 1.0)
    variance = as_one * max(line['variance'], LEAST_VARIANCE)
    return math.sqrt(variance / line['moment']) * scale * scale, math.sqrt(variance / line['size']) * scale


@kernel
def write(
    order: Any, grown: Any, step: float, correlation: float, tests: float, rarities: Any, segments: Any,
) -> None:
    """Fill in the records that users get."""
    for count in range(segments.size):
        line, segment = grown[order[count]], segments[count]
        slope, first, last = line['slope'], line['first'], line['last']
        scale = 1 / math.sqrt(1 + slope * slope)
        q1, q2 = slope * first + line['intercept'], slope * last + line['intercept']
        if line['steep']:
            x1, y1, x2, y2 = q1, first, q2, last
            cos, sin = slope * scale, scale
        else:
            x1, y1, x2, y2 = first, q1, last, q2
            cos, sin = scale, slope * scale
        turned = cos < 0 and not points_up(-cos, -sin)
        if turned:
            x1, y1, x2, y2, cos, sin = x2, y2, x1, y1, -cos, -sin
        x, y = 0.5 * (x1 + x2), 0.5 * (y1 + y2)
        segment['x'], segment['y'], segment['z'] = x, y, 0
        segment['x1'], segment['y1'], segment['x2'], segment['y2'] = x1, y1, x2, y2
        segment['length'] = length_of(line)
        theta = segment['theta'] = math.atan2(sin, cos)
        segment['intercept'] = y - sin / cos * x if cos >= VERTICAL else np.nan
        segment['rho'] = y * cos - x * sin
        # The code of the gradient's direction, a quarter of a turn on, by sections about multiples of 45 degrees.
        segment['code'] = math.floor(theta / (np.pi / 4) + 2.5) % 4 + 1
        segment['size'] = line['size']
        segment['sigma_theta'], segment['sigma_offset'] = deviations(line, correlation)
        segment['contrast'] = line['response'] / step
        segment['polarity'] = -line['sign'] if line['steep'] and not turned else line['sign']
        segment['log_nfa'] = tests - length_of(line) * rarity(line['response'], rarities)

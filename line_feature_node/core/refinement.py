"""Beyond the paper: lines are laid along the ridge of the gradient, grown as far as it goes, and judged.

The line of a line-blob is a first guess. Each is aligned with the gradient itself: it is shifted and turned to where
the gradient across it peaks. Then it grows at both ends while the gradient goes on, aligned anew as it gets longer, so
that it crosses the gaps that noise or a weak stretch made in its chain. The ends are where the gradient falls to half,
as the smoothed gradient does at the end of an edge. Lines are taken in the order of their strength, and each claims the
pixels along itself: a later one that runs mostly over claimed pixels in the same direction is the same edge found
twice. What is left must be stronger than noise makes it, and than the texture of the picture does by chance.

A line here is q = slope p + intercept, where p is the axis that it follows more closely, the major one: x for flat
lines, y for steep ones. All along it is looked at in whole steps of p.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.features import SEGMENT_DTYPE, VERTICAL
from line_feature_node.core.parameters import Parameters

#: A line while it grows.
RIDGE_DTYPE = np.dtype([
    ('steep', np.bool_),                                # whether p is y
    ('slope', np.float64), ('intercept', np.float64),
    ('first', np.float64), ('last', np.float64),        # its ends, p
    ('sign', np.float64),                               # 1 where the gradient points to larger q, else -1
    ('response', np.float64),                           # mean gradient across it
    ('variance', np.float64),                           # of the peaks of the gradient around it, q
    ('size', np.int64),                                 # how many peaks that are
    ('moment', np.float64),                             # sum of the squared distances, p, of the peaks from their mean
    ('alive', np.bool_),
])

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
FARTHEST_PEAK = 0.8
#: The line ends where the gradient, as the mean of a window, falls below this part of what it was before.
END = 0.5
#: Window in pixels: at least, by the square of noise over gradient, and at most.
WINDOW, WINDOW_NOISE, LARGEST_WINDOW = 3.0, 4.0, 24.0
#: Beyond the first guess the response is averaged over about so many steps.
MEMORY = 24
#: The search for an end begins so many steps and half a window inside.
INSIDE = 3
#: A pixel supports the line where the gradient along it is at most this part of that across it, ...
TANGENT = 0.8
#: ... and that across it does not grow beside it, both but for so many standard deviations of noise.
TOLERANCE = 2.5
#: Shorter lines are dropped, in pixels; while growing, in steps of p.
SHORTEST, SHORTEST_GROWING = 9.0, 4.0
#: A first guess grows when it has this part of what is asked of a line in the end.
HOPE = 0.4
#: A line claims the pixels within this distance; a line of which more than this part is claimed is dropped.
CLAIM, CLAIMED = 2.5, 0.6
#: Claims keep the direction of the gradient in so many steps of the full circle, with a bit that says that it is one.
DIRECTIONS, IS_CLAIMED = 128, 128
#: Claims count where the directions differ by at most so many steps, 25 degrees.
SAME_DIRECTION = 9
#: The part of the correlation length along an edge from which on peaks are independent, as measured.
INDEPENDENT = 0.8
#: Peaks are known to a fiftieth of a pixel at best, in whole grey levels.
LEAST_VARIANCE = 0.02**2
#: Norms are counted in every so many rows and columns, in bins of a part of a grey level a pixel.
COUNT_ROWS, COUNT_COLUMNS, NORM_BINS, NORM_RESOLUTION = 4, 2, 4096, 32
#: No gradient is rarer than this share of the pixels, as so many are looked at.
RAREST = 1e-4


class Ridges(NamedTuple):
    """What refinement reads, besides the lines.

    Attributes:
        gx, gy: Gradient, padded.
        pad: Its padding on each side.
        height, width: Of the picture.
        noise: Standard deviation of the noise of a component.
        step: The gradient of a step of one grey level.
        correlation: Pixels along an edge whose noise counts as one.
    """

    gx: NDArray[np.float32]
    gy: NDArray[np.float32]
    pad: int
    height: int
    width: int
    noise: float
    step: float
    correlation: float


def refine_lines(
    lines: NDArray[np.void], count: int, ridges: Ridges, parameters: Parameters, buffers: Buffers,
) -> NDArray[np.void]:
    """Align, grow, claim and judge.

    Args:
        lines: LINE_DTYPE, first guesses.
        count: How many there are.
        ridges: The gradient, and what is known of its noise.
        parameters: min_snr and false_alarms are used.
        buffers: Memory to work in.

    Returns:
        SEGMENT_DTYPE, strongest first guess first, a new array.
    """
    gx, gy, pad, height, width, noise, step, correlation = ridges
    flat_x, flat_y, stride = gx.reshape(-1), gy.reshape(-1), gx.shape[1]
    grown = buffers.array('ridges', count, RIDGE_DTYPE)[:count]
    strengths = buffers.array('strengths', count, np.float64)[:count]
    lay(lines, flat_x, flat_y, stride, pad, height, width, grown, strengths)
    order = np.argsort(-strengths, kind='stable').astype(np.int32)
    claims = buffers.array('claims', height * width, np.uint8)[:height * width]
    values = buffers.array('responses', 2 * (height + width) + 4 * MEMORY, np.float64)
    counts = buffers.array('norm counts', NORM_BINS, np.int64)[:NORM_BINS]
    count_norms(gx, gy, pad, height, width, counts)
    tests = 2 * math.log10(height * width)
    least = parameters.min_snr * noise, tests - math.log10(parameters.false_alarms)
    grow(order, counts, least, flat_x, flat_y, stride, pad, height, width, noise, claims, values, grown)
    kept = judge(least, counts, order, grown)
    segments = np.empty(kept, SEGMENT_DTYPE)
    write(order, grown, step, correlation, tests, counts, segments)
    return segments


# Looking at a line

@inlined
def axes(steep: bool, stride: int, height: int, width: int) -> tuple[int, int, int, int]:
    """Steps of a flat index along p and along q, and how many steps of each the picture has."""
    if steep:
        return stride, 1, height, width
    return 1, stride, width, height


@inlined
def across(gp: Any, gq: Any, index: int, np_: float, nq: float) -> float:
    """The gradient across the line, at a pixel: its part along the normal."""
    return np_ * gp[index] + nq * gq[index]


@inlined
def normal_of(slope: float, sign: float) -> tuple[float, float]:
    """The unit normal of a line that the gradient points along, its parts along p and q."""
    scale = sign / math.sqrt(1 + slope * slope)
    return -slope * scale, scale


@kernel
def mean_response(
    line: Any, gp: Any, gq: Any, origin: int, step_p: int, step_q: int, size_p: int, size_q: int,
) -> float:
    """The mean gradient across a line."""
    np_, nq = normal_of(line['slope'], line['sign'])
    total, count = 0.0, 0
    for p in range(max(math.ceil(line['first']), 0), min(math.floor(line['last']), size_p - 1) + 1):
        r = math.floor(line['slope'] * p + line['intercept'] + 0.5)
        if 0 <= r < size_q:
            total += across(gp, gq, origin + p * step_p + r * step_q, np_, nq)
            count += 1
    return total / max(count, 1)


@kernel
def align(
    line: Any, gp: Any, gq: Any, origin: int, step_p: int, step_q: int, size_p: int, size_q: int, move: float,
    single: bool,
) -> float:
    """Shift and turn a line to where the gradient across it peaks.

    In each step of p the peak is that of the parabola through the gradient at three pixels across. In the noise a
    single parabola may have none, so a first approach takes the mean curvature of all for each; then peaks that are no
    farther than FARTHEST_PEAK count, each by its own.

    Args:
        line: It is changed, and receives its mean response; with `single`, variance, size and moment of its peaks, too.
        gp, gq: The gradient along p and q, flat.
        origin: Index of the first pixel of the picture.
        step_p, step_q: What a step along p and q adds to an index.
        size_p, size_q: Pixels of the picture along p and q.
        move: The farthest that an end moves.
        single: Whether each peak is that of its own parabola.

    Returns:
        How far its ends moved, q.
    """
    slope, intercept = line['slope'], line['intercept']
    np_, nq = normal_of(slope, line['sign'])
    trim = min(TRIM, LARGEST_TRIM * (line['last'] - line['first']))
    middle = 0.5 * (line['first'] + line['last'])
    n, st, stt, sd, std, sdd = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    response, curvature, slant, slant_t = 0.0, 0.0, 0.0, 0.0
    looked_at = 0
    for p in range(max(math.ceil(line['first'] + trim), 0),
                   min(math.floor(line['last'] - trim), size_p - 1) + 1):
        q = slope * p + intercept
        r = math.floor(q + 0.5)
        if not 0 <= r < size_q:
            continue
        index = origin + p * step_p + r * step_q
        before, at, behind = (across(gp, gq, index - step_q, np_, nq), across(gp, gq, index, np_, nq),
                              across(gp, gq, index + step_q, np_, nq))
        second, first = behind - 2 * at + before, 0.5 * (behind - before)
        looked_at += 1
        response += at
        curvature += second
        t, d = p - middle, r - q
        if single:
            if not (second < 0 and abs(first) < -FARTHEST_PEAK * second):
                continue
            d -= first / second
        else:
            slant += first
            slant_t += t * first
        n += 1
        st += t
        stt += t * t
        sd += d
        std += t * d
        sdd += d * d
    if n < SHORTEST_GROWING:
        return 0.0
    line['response'] = response / looked_at
    if not single:
        curvature /= n
        if curvature >= -CURVED * line['response']:
            return 0.0
        sd -= slant / curvature
        std -= slant_t / curvature
    moment = stt - st * st / n
    if moment <= 0:
        return 0.0
    turn = (std - st * sd / n) / moment
    shift = (sd - turn * st) / n
    if single:
        line['variance'] = max(sdd - shift * sd - turn * std, 0.0) / max(n - 2, 1)
        line['size'], line['moment'] = n, moment
    half = 0.5 * (line['last'] - line['first'])
    shift = min(max(shift, -move), move)
    turn = min(max(turn, -move / half), move / half)
    line['slope'] += turn
    line['intercept'] += shift - turn * middle
    return abs(shift) + abs(turn) * half


@inlined
def support_at(
    p: int, slope: float, intercept: float, gp: Any, gq: Any, origin: int, step_p: int, step_q: int, size_p: int,
    size_q: int, np_: float, nq: float, tolerance: float,
) -> float:
    """The gradient across a line, as far as it supports the line; 0 outside the picture.

    It does not where it points elsewhere, or is stronger one pixel beside the line; what noise may do is tolerated.
    """
    q = slope * p + intercept
    if not (0 <= p < size_p and 0 <= q <= size_q - 1):
        return 0.0
    r = min(int(q), size_q - 2)
    part, index = q - r, origin + p * step_p + r * step_q
    upper, lower = 1 - part, part
    at_p = upper * gp[index] + lower * gp[index + step_q]
    at_q = upper * gq[index] + lower * gq[index + step_q]
    response = np_ * at_p + nq * at_q
    tangential = abs(nq * at_p - np_ * at_q)
    before = upper * across(gp, gq, index - step_q, np_, nq) + lower * across(gp, gq, index, np_, nq)
    behind = upper * across(gp, gq, index + step_q, np_, nq) + lower * across(gp, gq, index + 2 * step_q, np_, nq)
    if tangential > TANGENT * response + tolerance or max(before, behind) > response + tolerance:
        return min(response, 0.0)
    return response


# Growing

@kernel
def extend(
    line: Any, gp: Any, gq: Any, origin: int, step_p: int, step_q: int, size_p: int, size_q: int, noise: float,
    limit: float, at_first: bool, at_last: bool, values: Any,
) -> None:
    """Move the ends of a line to where the gradient across it ends; arguments as for :func:`align`.

    Args:
        line: It is changed.
        noise: Of a component of the gradient.
        limit: The farthest that an end moves outwards, in steps of p.
        at_first, at_last: Whether its first and its last end are looked for.
        values: Memory for what supports the line in each step.
    """
    response = max(line['response'], 1e-6)
    half = int(min(WINDOW + WINDOW_NOISE * (noise / response)**2, LARGEST_WINDOW)) // 2
    first, last = line['first'], line['last']
    if at_last:
        line['last'] = end_of(line, 1, last, first, half, gp, gq, origin, step_p, step_q, size_p, size_q,
                              TOLERANCE * noise, limit, values)
    if at_first:
        line['first'] = -end_of(line, -1, -first, -last, half, gp, gq, origin, step_p, step_q, size_p, size_q,
                                TOLERANCE * noise, limit, values)


@kernel
def end_of(
    line: Any, way: int, end: float, other: float, half: int, gp: Any, gq: Any, origin: int, step_p: int, step_q: int,
    size_p: int, size_q: int, tolerance: float, limit: float, values: Any,
) -> float:
    """Where a line ends on one side, in steps of p outwards; `way` is 1 where these are p itself, and -1 for -p.

    From a place inside it goes outwards step by step, until the mean over a window around the place is below END of the
    response: that of the line, and farther out that of about the last MEMORY steps. Between two steps the end is
    interpolated.
    """
    slope, intercept, before = line['slope'], line['intercept'], line['response']
    np_, nq = normal_of(slope, line['sign'])
    place = math.floor(end - min(half + INSIDE, 0.5 * (end - other)))
    base = place - half
    window = 0.0
    for step in range(base, place + half + 1):
        values[step - base] = support_at(way * step, slope, intercept, gp, gq, origin, step_p, step_q, size_p, size_q,
                                         np_, nq, tolerance)
        window += values[step - base]
    size = 2 * half + 1
    earlier = 2 * END * before
    start = place
    while True:
        mean = window / size
        if mean < END * before:
            if place == start:
                return float(place)
            return place - 1 + (earlier - END * before) / (earlier - mean)
        if place >= end + limit:
            return end + limit
        p = way * (place + 1)
        q = slope * p + intercept
        if not (0 <= p < size_p and 0 <= q <= size_q - 1):
            return float(place)
        if place > end:
            before += (min(max(values[place - base], 0.0), 2 * before) - before) / MEMORY
        earlier = mean
        window -= values[place - half - base]
        place += 1
        values[place + half - base] = support_at(
            way * (place + half), slope, intercept, gp, gq, origin, step_p, step_q, size_p, size_q, np_, nq, tolerance)
        window += values[place + half - base]


@kernel
def lay(
    lines: Any, gx: Any, gy: Any, stride: int, pad: int, height: int, width: int, grown: Any, strengths: Any,
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
        step_p, step_q, size_p, size_q = axes(steep, stride, height, width)
        gp, gq = (gy, gx) if steep else (gx, gy)
        response = mean_response(line, gp, gq, pad * (stride + 1), step_p, step_q, size_p, size_q)
        if response < 0:
            line['sign'], response = -1.0, -response
        line['response'] = response
        line['alive'] = False
        strengths[k] = response * math.sqrt(line['last'] - line['first'])


@kernel
def grow(
    order: Any, counts: Any, least: tuple[float, float], gx: Any, gy: Any, stride: int, pad: int, height: int,
    width: int, noise: float, claims: Any, values: Any, grown: Any,
) -> None:
    """Let the lines that may become clear enough grow, in their order; those alive at the end are there once."""
    origin = pad * (stride + 1)
    for k in range(claims.size):
        claims[k] = 0
    for k in order:
        line = grown[k]
        if not is_clear(line, counts, HOPE * least[0], HOPE * least[1]):
            continue
        if claimed(line, claims, height, width) > CLAIMED:
            continue
        step_p, step_q, size_p, size_q = axes(line['steep'], stride, height, width)
        gp, gq = (gy, gx) if line['steep'] else (gx, gy)
        at_first = at_last = True
        for turn in range(ROUNDS):
            first, last = line['first'], line['last']
            align(line, gp, gq, origin, step_p, step_q, size_p, size_q, MOVE, False)
            limit = max(last - first, STEP) if turn < ROUNDS - 1 else UNBOUNDED
            extend(line, gp, gq, origin, step_p, step_q, size_p, size_q, noise, limit, at_first, at_last, values)
            # An end that stayed about where it was is one; the other is looked for anew, along a better line.
            at_first, at_last = first - line['first'] > STAYS, line['last'] - last > STAYS
            if not (at_first or at_last) or line['last'] - line['first'] < GROWS * (last - first):
                break
        if line['last'] - line['first'] < SHORTEST_GROWING:
            continue
        line['size'] = 0
        # From where the first leaves the line, other peaks may be near enough.
        if align(line, gp, gq, origin, step_p, step_q, size_p, size_q, LAST_MOVE, True) > SETTLED:
            align(line, gp, gq, origin, step_p, step_q, size_p, size_q, LAST_MOVE, True)
            extend(line, gp, gq, origin, step_p, step_q, size_p, size_q, noise, 0.0, True, True, values)
        if line['size'] > 0 and claimed(line, claims, height, width) <= CLAIMED:
            line['alive'] = True
            claim(line, claims, height, width)


# Claims

@inlined
def direction_of(line: Any) -> int:
    """The direction of the gradient across a line, in DIRECTIONS steps of the full circle."""
    np_, nq = normal_of(line['slope'], line['sign'])
    angle = math.atan2(np_, nq) if line['steep'] else math.atan2(nq, np_)
    return math.floor(angle * DIRECTIONS / (2 * math.pi) + 0.5) & DIRECTIONS - 1


@kernel
def claimed(line: Any, claims: Any, height: int, width: int) -> float:
    """The share of a line whose pixels others claim that run in the same direction."""
    own = direction_of(line)
    step_p, step_q, size_p, size_q = axes(line['steep'], width, height, width)
    hits, count = 0, 0
    for p in range(max(math.ceil(line['first']), 0), min(math.floor(line['last']), size_p - 1) + 1):
        r = math.floor(line['slope'] * p + line['intercept'] + 0.5)
        if 0 <= r < size_q:
            count += 1
            found = claims[p * step_p + r * step_q]
            if found & IS_CLAIMED:
                turned = (np.int64(found) - own) & DIRECTIONS - 1
                hits += turned <= SAME_DIRECTION or turned >= DIRECTIONS - SAME_DIRECTION
    return hits / max(count, 1)


@kernel
def claim(line: Any, claims: Any, height: int, width: int) -> None:
    """Claim the pixels near a line that nobody has claimed."""
    mark = np.uint8(direction_of(line) | IS_CLAIMED)
    step_p, step_q, size_p, size_q = axes(line['steep'], width, height, width)
    reach = CLAIM * math.sqrt(1 + line['slope'] * line['slope'])
    for p in range(max(math.ceil(line['first']), 0), min(math.floor(line['last']), size_p - 1) + 1):
        q = line['slope'] * p + line['intercept']
        for r in range(max(math.ceil(q - reach), 0), min(math.floor(q + reach), size_q - 1) + 1):
            if claims[p * step_p + r * step_q] == 0:
                claims[p * step_p + r * step_q] = mark


# Judging

@inlined
def length_of(line: Any) -> float:
    """Its length in pixels."""
    return (line['last'] - line['first']) * math.sqrt(1 + line['slope'] * line['slope'])


@inlined
def norm_bin(norm: float) -> int:
    """The bin of a norm; that of what is too large for all, or no number, is the last."""
    return int(norm * NORM_RESOLUTION) if norm < (NORM_BINS - 1) / NORM_RESOLUTION else NORM_BINS - 1


@inlined
def rarity(response: float, counts: Any) -> float:
    """-log10 of the share of the picture's pixels with a gradient as strong; the counts are cumulative from the top."""
    share = counts[norm_bin(response)] / max(counts[0], 1)
    return -math.log10(max(share, RAREST))


@kernel
def count_norms(gx: Any, gy: Any, pad: int, height: int, width: int, counts: Any) -> None:
    """Count how many of the pixels that are looked at have a norm of each bin, or a larger one."""
    for k in range(counts.size):
        counts[k] = 0
    for row in range(pad, height + pad, COUNT_ROWS):
        for column in range(pad, width + pad, COUNT_COLUMNS):
            norm = math.sqrt(gx[row, column] * gx[row, column] + gy[row, column] * gy[row, column])
            counts[norm_bin(norm)] += 1
    for k in range(counts.size - 2, -1, -1):
        counts[k] += counts[k + 1]


@inlined
def is_clear(line: Any, counts: Any, least_strength: float, least_evidence: float) -> bool:
    """Whether neither noise nor chance makes a line as clear as this.

    Were the gradients of the picture spread over it without order, a line of length l along which they are as strong as
    a share H of them is would be there N H^l times by chance, N being the number of lines that can be drawn (Desolneux,
    Moisan and Morel, 2001, with the mean in place of the minimum).

    Args:
        line: The line.
        counts: Of the norms.
        least_strength: What its response by root of length must be.
        least_evidence: What -l log10 H must be.
    """
    length = length_of(line)
    return (line['response'] * math.sqrt(length) >= least_strength
            and length * rarity(line['response'], counts) >= least_evidence)


@kernel
def judge(least: tuple[float, float], counts: Any, order: Any, grown: Any) -> int:
    """Drop the lines that are too short or not clear enough; return how many are left."""
    left = 0
    for k in order:
        line = grown[k]
        line['alive'] &= length_of(line) >= SHORTEST and is_clear(line, counts, least[0], least[1])
        left += line['alive']
    return left


@kernel
def write(
    order: Any, grown: Any, step: float, correlation: float, tests: float, counts: Any, segments: Any,
) -> None:
    """Fill in the records that users get."""
    count = 0
    for k in order:
        line = grown[k]
        if not line['alive']:
            continue
        segment = segments[count]
        count += 1
        slope, first, last = line['slope'], line['first'], line['last']
        scale = 1 / math.sqrt(1 + slope * slope)
        q1, q2 = slope * first + line['intercept'], slope * last + line['intercept']
        turned = line['steep'] and slope < 0
        if line['steep']:
            x1, y1, x2, y2 = q1, first, q2, last
            cos, sin = slope * scale, scale
        else:
            x1, y1, x2, y2 = first, q1, last, q2
            cos, sin = scale, slope * scale
        if turned:
            x1, y1, x2, y2, cos, sin = x2, y2, x1, y1, -cos, -sin
        x, y = 0.5 * (x1 + x2), 0.5 * (y1 + y2)
        segment['x'], segment['y'], segment['z'] = x, y, 0
        segment['x1'], segment['y1'], segment['x2'], segment['y2'] = x1, y1, x2, y2
        segment['length'] = length_of(line)
        theta = np.float32(math.atan2(sin, cos))
        segment['theta'] = theta if theta > -np.float32(np.pi / 2) else np.float32(np.pi / 2)
        segment['intercept'] = y - sin / cos * x if cos >= VERTICAL else np.nan
        segment['rho'] = y * cos - x * sin
        # The code of the gradient's direction: its sections are centred on multiples of 45 degrees.
        section = math.floor(math.atan2(cos, -sin) / (np.pi / 4) + 0.5) % 4
        segment['code'] = section + 1
        segment['size'] = line['size']
        # Noise of neighbouring peaks is smoothed along the edge: so many of them count as one.
        together = max(INDEPENDENT * correlation * scale, 1.0)
        variance = max(line['variance'], LEAST_VARIANCE)
        segment['sigma_theta'] = math.sqrt(together * variance / line['moment']) * scale * scale
        segment['sigma_offset'] = math.sqrt(together * variance / line['size']) * scale
        segment['contrast'] = line['response'] / step
        segment['polarity'] = -line['sign'] if line['steep'] and not turned else line['sign']
        segment['log_nfa'] = tests - length_of(line) * rarity(line['response'], counts)

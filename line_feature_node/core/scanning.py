"""Step 2, edge scanning: hysteresis and chains of edge pixels by eight-directional chain coding (section 2.2.1).

Directions are those of the chain code: 0 is +x, then in steps of 45 degrees from +x towards +y, so that 2 is down.

Where a chain starts and how it is walked: the marks are read from the top, left to right, and the first strong pixel
that no chain has yet is a seed. The chain runs through it along the edge, in the direction that its code gives (down,
to the lower left, to the right and to the lower right for codes 1 to 4), and reaches as far as the edge goes both
ways. At each pixel it goes on to the unvisited neighbour that bends least, by a right angle at most; of two that bend
alike it takes the one that turns back, as a digital straight line does. What it leaves beside itself starts chains of
its own, so all that is connected to a strong pixel is visited: that is the hysteresis.
"""

from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.edges import CODE, OPEN, STRONG
from line_feature_node.core.indices import are_neighbours, position
from line_feature_node.core.parameters import Parameters

#: Column and row steps of the eight directions.
STEP_X = np.array([1, 1, 0, -1, -1, -1, 0, 1])
STEP_Y = np.array([0, 1, 1, 1, 0, -1, -1, -1])
#: A mark of a pixel that belongs to a chain already, or fills a gap.
TAKEN = 16
#: With TAKEN: the pixel fills a gap.
BRIDGED = 64
#: With TAKEN: a chain that may be linked ends here.
ENDING = 32
#: The strong bit of eight marks at once.
STRONG_WORD = np.uint64(STRONG * 0x0101010101010101)
#: In place of a state: the chain ends.
END = 255
#: How many states there are, and the bits of one or of END.
STATES, STATE_BITS = 16, 8
#: A chain turns by at most this many directions at once.
SHARPEST = 2
#: The direction of a chain at its end is measured over this many pixels.
REACH = 4


def _next_state() -> NDArray[np.uint8]:
    """Where a chain goes on, indexed by its state and the mask of its neighbours; END where it ends.

    A state is 2 (direction) + (whether the last turn was to the right). Bit d of the mask stands for an unvisited
    neighbour in direction d.
    """
    table = np.full((STATES, 256), END, np.uint8)
    for state in range(STATES):
        direction, right = divmod(state, 2)
        back = -1 if right else 1
        turns = [0, *(k * sign for k in range(1, SHARPEST + 1) for sign in (back, -back))]
        for mask in range(256):
            for turn in turns:
                if mask >> (direction + turn) % 8 & 1:
                    table[state, mask] = 2 * ((direction + turn) % 8) + (right if turn == 0 else turn > 0)
                    break
    return table


def _fan(longest: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pixels in which the other side of a gap is looked for: nearest first, then those that bend least.

    Returns:
        Column and row steps, 8×M each, for a chain that ends in each direction; offsets of the first step of each
        distance, gaps of 0 to `longest` pixels.
    """
    steps, counts = [], []
    for direction in range(8):
        tangent = np.array([STEP_X[direction], STEP_Y[direction]]) / np.hypot(STEP_X[direction], STEP_Y[direction])
        rings = []
        for distance in range(1, longest + 2):
            ring = [(x, y) for x in range(-distance, distance + 1) for y in range(-distance, distance + 1)
                    if max(abs(x), abs(y)) == distance]
            along = {(x, y): (x * tangent[0] + y * tangent[1]) / np.hypot(x, y) for x, y in ring}
            rings.append(sorted((step for step in ring if along[step] > np.cos(np.radians(46))),
                                key=lambda step: (-round(along[step], 9), step)))
        counts = [len(ring) for ring in rings]
        steps.append([step for ring in rings for step in ring])
    return np.array(steps), np.cumsum([0, *counts])


def _pointing() -> NDArray[np.uint8]:
    """The direction that a step of up to REACH rows and columns is nearest to, at those rows and columns plus REACH."""
    y, x = np.mgrid[-REACH:REACH + 1, -REACH:REACH + 1]
    return np.asarray(np.round(np.arctan2(y, x) / (np.pi / 4)) % 8, np.uint8)


NEXT_STATE = _next_state()
POINTING = _pointing()
#: The place of the lowest bit of a mask.
LOWEST = np.array([0, *((mask & -mask).bit_length() - 1 for mask in range(1, 256))], np.int64)


@lru_cache(maxsize=8)
def _moves(stride: int) -> NDArray[np.int64]:
    """Where a chain goes on, at 256 (state) + (mask), for marks with rows of a length.

    One number has both the next state, as in NEXT_STATE, and, STATE_BITS higher, what the step there adds to a flat
    index: to look up one by the other would take longer.
    """
    steps = np.append(np.repeat(STEP_X + stride * STEP_Y, 2), 0)
    return ((steps[np.minimum(NEXT_STATE, STATES)] << STATE_BITS) + NEXT_STATE).reshape(-1)


FAN, FAN_OFFSETS = _fan(8)


class Chains(NamedTuple):
    """Edge chains. The arrays are the extractor's own: a frame's chains end with the next frame.

    Attributes:
        pixels: int32, pixels of all chains one after the other, as flat indices into the marks.
        codes: uint8, gradient direction code of each pixel.
        bridged: bool, whether the pixel fills a gap.
        offsets: int32, where each chain starts in these; one more than there are chains.
        closed: bool, whether the end of each chain meets its start.
    """

    pixels: NDArray[np.int32]
    codes: NDArray[np.uint8]
    bridged: NDArray[np.bool_]
    offsets: NDArray[np.int32]
    closed: NDArray[np.bool_]


def scan_edges(marks: NDArray[np.uint8], parameters: Parameters, buffers: Buffers) -> Chains:
    """Follow the candidates in the marks from strong ones, and link them to chains.

    Args:
        marks: As edge extraction leaves them; pixels that were visited become TAKEN.
        parameters: max_gap, min_chain and refine are used: what is refined needs no chains over gaps, as its lines grow
            over them, nor any that are closed, and short ones give no line.
        buffers: Memory to work in.

    Returns:
        The chains of at least min_chain pixels; all as they were traced where lines are refined.
    """
    [raw] = trace_edges(marks, 1, buffers)
    if parameters.refine:
        return raw
    flat = marks.reshape(-1)
    stride = marks.shape[1]
    count, most = raw.closed.size, raw.pixels.size + parameters.max_gap * raw.closed.size
    links = buffers.array('links', 2 * count, np.int32)
    link_gaps(flat, stride, count, parameters.max_gap, FAN, FAN_OFFSETS, raw.pixels, raw.codes, raw.offsets,
              buffers.array('ends', flat.size, np.int32), buffers.array('end directions', 2 * count, np.uint8),
              buffers.array('facing', 2 * count, np.int32), links)
    pixels, codes = buffers.array('pixels', most, np.int32), buffers.array('codes', most, np.uint8)
    bridged = buffers.array('bridged', most, np.bool_)
    offsets, closed = buffers.array('offsets', count + 1, np.int32), buffers.array('closed', count, np.bool_)
    linked = assemble(stride, count, parameters.min_chain, raw.pixels, raw.codes, raw.offsets, links,
                      buffers.array('done', count, np.bool_), pixels, codes, bridged, offsets, closed)
    length = offsets[linked]
    return Chains(pixels[:length], codes[:length], bridged[:length], offsets[:linked + 1], closed[:linked])


def trace_edges(marks: NDArray[np.uint8], parts: int, buffers: Buffers) -> Iterator[Chains]:
    """Follow the candidates in the marks from strong ones, not over gaps.

    Args:
        marks: As edge extraction leaves them; pixels that were visited become TAKEN.
        parts: In so many goes, by the rows that edges are found in.
        buffers: Memory to work in.

    Yields:
        The chains that each go added: offsets are those of all chains, into the pixels of all.
    """
    flat, (height, stride) = marks.reshape(-1), marks.shape
    most = cv2.countNonZero(marks)
    pixels, codes = buffers.array('raw pixels', most, np.int32), buffers.array('raw codes', most, np.uint8)
    offsets, stack = buffers.array('raw offsets', most + 1, np.int32), buffers.array('stack', most + 1, np.int32)
    bridged = buffers.array('not bridged', most, np.bool_, zeros=True)
    closed = buffers.array('not closed', most, np.bool_, zeros=True)
    offsets[0] = count = 0
    for first, end in pairwise(k * height // parts * stride for k in range(parts + 1)):
        before = count
        count = trace(first, end, flat, flat.view(np.uint64), stride, _moves(stride), pixels, codes,
                      offsets, before, stack)
        length = offsets[count]
        yield Chains(pixels[:length], codes[:length], bridged[:length], offsets[before:count + 1],
                     closed[:count - before])


def joined(parts: list[Chains]) -> Chains:
    """The chains of all goes of :func:`trace_edges`."""
    offsets = [part.offsets[:-1] for part in parts]
    return parts[-1]._replace(offsets=np.concatenate([*offsets, parts[-1].offsets[-1:]]),
                              closed=np.concatenate([part.closed for part in parts]))


def chain_directions(chains: Chains, stride: int) -> NDArray[np.uint8]:
    """The chain code: the direction from each pixel to the next; END at the end of an open chain, or without chains."""
    directions = np.full(chains.pixels.size, END, np.uint8)
    write_directions(chains.pixels, chains.offsets, chains.closed, stride, directions)
    return directions


@kernel
def trace(
    first: int, end: int, marks: Any, words: Any, stride: int, moves: Any, pixels: Any, codes: Any, offsets: Any,
    chains: int, stack: Any,
) -> int:
    """Visit all candidates that are connected to a strong one between two marks; return how many chains there are then.

    Args:
        first, end: The marks, multiples of eight.
        chains: How many chains there are before.
    """
    length = np.int64(offsets[chains])
    for word in range(first // 8, end // 8):
        if words[word] & STRONG_WORD == 0:
            continue
        for seed in range(8 * word, 8 * word + 8):
            if marks[seed] & STRONG == 0:
                continue
            start, beside, direction, top = seed, seed, 8, 0
            while start != -1:
                length, top = trace_chain(start, marks, stride, moves, pixels, codes, length, stack, top)
                chains += 1
                offsets[chains] = length
                start, beside, direction, top = next_start(beside, direction, marks, stride, stack, top)
    return chains


@inlined
def next_start(
    beside: int, direction: int, marks: Any, stride: int, stack: Any, top: int,
) -> tuple[int, int, int, int]:
    """The next candidate beside a pixel, from a direction on, or beside those on the stack.

    Returns:
        It, -1 where there is none; what it is beside, and the direction after it; the number of entries on the stack.
    """
    while True:
        mask = open_neighbours(marks, beside, stride) >> direction if direction < 8 else 0
        if mask != 0:
            direction += LOWEST[mask]
            return beside + STEP_X[direction] + stride * STEP_Y[direction], beside, direction + 1, top
        if top == 0:
            return -1, beside, direction, top
        top -= 1
        beside, direction = int(stack[top]), 0


@inlined
def trace_chain(
    start: int, marks: Any, stride: int, moves: Any, pixels: Any, codes: Any, length: int, stack: Any, top: int,
) -> tuple[int, int]:
    """Append the chain through a pixel: first its arm against the edge's direction, turned round, then that along it.

    Returns:
        The number of pixels in all chains, and of entries on the stack.
    """
    first, code = length, marks[start] & CODE
    direction = (np.int64(code) + 1) % 4
    marks[start] = TAKEN
    mask = open_neighbours(marks, start, stride)
    alone = mask == 0
    if not alone:
        length, top = walk(start, (direction + 4) % 8, mask, marks, stride, moves, pixels, codes, length, stack, top)
        reverse(pixels, codes, first, length)
    pixels[length] = start
    codes[length] = code
    length += 1
    if not alone:
        mask = open_neighbours(marks, start, stride)
        length, top = walk(start, direction, mask, marks, stride, moves, pixels, codes, length, stack, top)
        stack[top] = start
        top += open_neighbours(marks, start, stride) != 0
    return length, top


@inlined
def walk(
    start: int, direction: int, mask: int, marks: Any, stride: int, moves: Any, pixels: Any, codes: Any, length: int,
    stack: Any, top: int,
) -> tuple[int, int]:
    """Append the pixels that follow the start in a direction, and put those beside which others stay on the stack.

    Every pixel is written on top of the stack, and most are not kept there: to ask before would be a branch that no
    processor can predict. One neighbour alone is where the chain goes on; if it lies back too sharply for that, it is
    a neighbour of the pixel before, too, which is on the stack then, or, if it is the start, is put there in the end.

    Args:
        mask: The neighbours of the start.
    """
    pixel = start
    following = moves[np.uint64(512 * direction + mask)]
    while following != END:
        pixel += following >> STATE_BITS
        state = following & END
        index, place = np.uint64(pixel), np.uint64(length)
        pixels[place] = pixel
        codes[place] = marks[index] & CODE
        marks[index] = TAKEN
        length += 1
        mask = open_neighbours(marks, pixel, stride)
        following = moves[np.uint64(256 * state + mask)]
        stack[np.uint64(top)] = pixel
        top += (mask & (mask - 1)) != 0
    return length, top


@inlined
def open_neighbours(marks: Any, pixel: int, stride: int) -> int:
    """The mask of a pixel: bit d is set where the neighbour in direction d is OPEN.

    Indices are unsigned, for which Numba leaves out the test whether to count from the end.
    """
    middle, row, one = np.uint64(pixel), np.uint64(stride), np.uint64(1)
    above, below = middle - row, middle + row
    return (opening(marks[middle + one], 0) | opening(marks[below + one], 1) | opening(marks[below], 2)
            | opening(marks[below - one], 3) | opening(marks[middle - one], 4) | opening(marks[above - one], 5)
            | opening(marks[above], 6) | opening(marks[above + one], 7))


@inlined
def opening(mark: int, direction: int) -> Any:
    """The bit of a direction where a mark is OPEN, else 0."""
    return np.int64(mark & OPEN) >> 7 - direction


@inlined
def reverse(pixels: Any, codes: Any, first: int, end: int) -> None:
    """Turn round the pixels from the first to the end, and their codes, in place."""
    last = end - 1
    while first < last:
        pixels[first], pixels[last] = pixels[last], pixels[first]
        codes[first], codes[last] = codes[last], codes[first]
        first += 1
        last -= 1


@kernel
def link_gaps(
    marks: Any, stride: int, chains: int, max_gap: int, fan: Any, fan_offsets: Any, pixels: Any, codes: Any,
    offsets: Any, ends: Any, directions: Any, facing: Any, links: Any,
) -> None:
    """Link the ends of chains over gaps of up to max_gap pixels, the shortest gaps first.

    End 2 c is the start of chain c, 2 c + 1 its end. Two ends are linked when the one lies in the fan of directions
    that the other points to, the two point at each other, within 45 degrees, their codes are equal or neighbours, and
    nothing lies between. A chain of one pixel points nowhere and is not linked.
    """
    inverse = 1 / stride
    pointing = 0
    for chain in range(chains):
        for end in range(2 * chain, 2 * chain + 2):
            links[end] = -1
            if offsets[chain + 1] - offsets[chain] > 1:
                facing[pointing] = end
                pointing += 1
                directions[end] = end_direction(pixels, offsets, end, stride, inverse)
                pixel = pixels[end_index(offsets, end)]
                ends[pixel] = end
                marks[pixel] = TAKEN | ENDING
    # Most of them face none at all.
    found = 0
    for place in range(pointing):
        end = facing[found] = facing[place]
        found += faces_ends(pixels[end_index(offsets, end)], fan[directions[end]], fan_offsets[max_gap + 1], marks,
                            stride)
    for gap in range(max_gap + 1):
        for place in range(found):
            end = facing[place]
            if links[end] == -1:
                other = facing_end(end, gap, marks, stride, fan, fan_offsets, pixels, codes, offsets, ends, directions,
                                   links)
                if other != -1:
                    links[end] = other
                    links[other] = end


@inlined
def faces_ends(pixel: int, steps: Any, count: int, marks: Any, stride: int) -> bool:
    """Whether there is an end of a chain at any of so many steps from a pixel."""
    seen = 0
    for k in range(count):
        # As an unsigned number what is before the marks is far behind them.
        target = np.uint64(np.int64(pixel) + steps[k, 0] + steps[k, 1] * stride)
        seen |= marks[target] if target < np.uint64(marks.size) else 0
    return seen & ENDING != 0


@inlined
def facing_end(
    end: int, gap: int, marks: Any, stride: int, fan: Any, fan_offsets: Any, pixels: Any, codes: Any, offsets: Any,
    ends: Any, directions: Any, links: Any,
) -> int:
    """The end that one can be linked with over a gap, -1 if there is none; the pixels between are then taken."""
    index = end_index(offsets, end)
    pixel = np.int64(pixels[index])
    direction = directions[end]
    for k in range(fan_offsets[gap], fan_offsets[gap + 1]):
        step = fan[direction, k, 0]
        target = pixel + step + fan[direction, k, 1] * stride
        if not (0 <= target < marks.size and marks[target] & ENDING):
            continue
        other = ends[target]
        # A step over the margin leads to the other side of the image.
        if other == end or links[other] != -1 or not 0 <= pixel % stride + step < stride:
            continue
        facing = (np.int64(directions[other]) - direction + 4 + 1) % 8 <= 2
        between = (np.int64(codes[index]) - codes[end_index(offsets, other)]) % 4
        if facing and between != 2 and take_gap(marks, pixel, target, gap, stride):
            return other
    return -1


@inlined
def end_index(offsets: Any, end: int) -> int:
    """Where the pixel of an end stands."""
    return offsets[end // 2] if end % 2 == 0 else offsets[end // 2 + 1] - 1


@inlined
def end_direction(pixels: Any, offsets: Any, end: int, stride: int, inverse: float) -> int:
    """The chain-code direction in which a chain of two pixels or more leaves over one of its ends."""
    chain = end // 2
    reach = min(REACH, offsets[chain + 1] - offsets[chain] - 1)
    index = end_index(offsets, end)
    inner = pixels[index + reach if end % 2 == 0 else index - reach]
    row, column = position(pixels[index], inverse, stride)
    inner_row, inner_column = position(inner, inverse, stride)
    return int(POINTING[row - inner_row + REACH, column - inner_column + REACH])


@inlined
def gap_pixel(pixel: int, target: int, k: int, gap: int, stride: int) -> int:
    """The k-th of the `gap` pixels on the digital straight line between two pixels; 0 is the pixel itself."""
    x, y = pixel % stride, pixel // stride
    span_x, span_y = target % stride - x, target // stride - y
    steps = gap + 1
    return (x + (2 * span_x * k + steps) // (2 * steps)) + (y + (2 * span_y * k + steps) // (2 * steps)) * stride


@inlined
def take_gap(marks: Any, pixel: int, target: int, gap: int, stride: int) -> bool:
    """Take the pixels between two ends; False if one of them is an edge, or taken already."""
    for k in range(1, gap + 1):
        if marks[gap_pixel(pixel, target, k, gap, stride)] != 0:
            return False
    for k in range(1, gap + 1):
        marks[gap_pixel(pixel, target, k, gap, stride)] = TAKEN | BRIDGED
    return True


@kernel
def assemble(
    stride: int, raw: int, min_chain: int, raw_pixels: Any, raw_codes: Any, raw_offsets: Any, links: Any, done: Any,
    pixels: Any, codes: Any, bridged: Any, offsets: Any, closed: Any,
) -> int:
    """Write out the linked chains with their gaps filled, without the short ones; return their number."""
    for chain in range(raw):
        done[chain] = False
    chains = 0
    length = 0
    offsets[0] = 0
    for chain in range(raw):
        alone = links[2 * chain] == -1 and links[2 * chain + 1] == -1
        if done[chain] or (alone and raw_offsets[chain + 1] - raw_offsets[chain] < min_chain):
            continue
        start = first_end(chain, links)
        first = length
        end = start
        while True:
            length = append(end, raw_pixels, raw_codes, raw_offsets, pixels, codes, bridged, length)
            done[end // 2] = True
            following = links[end ^ 1]
            if following == -1:
                break
            length = bridge(raw_pixels[end_index(raw_offsets, following)], stride, pixels, codes, bridged, length)
            if following == start:
                break
            end = following
        if length - first < min_chain:
            length = first
            continue
        closed[chains] = length - first >= 4 and are_neighbours(pixels[length - 1], pixels[first], stride)
        chains += 1
        offsets[chains] = length
    return chains


@kernel
def first_end(chain: int, links: Any) -> int:
    """The end at which the chain of linked chains begins; that of the chain itself where they form a ring."""
    end = 2 * chain
    while links[end] != -1:
        end = links[end] ^ 1
        if end == 2 * chain:
            break
    return end


@inlined
def append(
    end: int, raw_pixels: Any, raw_codes: Any, raw_offsets: Any, pixels: Any, codes: Any, bridged: Any, length: int,
) -> int:
    """Copy a raw chain, beginning with the given end of it."""
    first, last = raw_offsets[end // 2], raw_offsets[end // 2 + 1]
    total = length + last - first
    copy(raw_pixels[first:last], raw_codes[first:last], pixels[length:total], codes[length:total],
         bridged[length:total])
    if end % 2 == 1:
        reverse(pixels, codes, length, total)
    return total


@inlined
def copy(raw_pixels: Any, raw_codes: Any, pixels: Any, codes: Any, bridged: Any) -> None:
    """Copy pixels and codes, which fill no gap; slices spare the test whether to count from the end."""
    for k in range(pixels.size):
        bridged[k] = False
    for k in range(pixels.size):
        pixels[k] = raw_pixels[k]
    for k in range(pixels.size):
        codes[k] = raw_codes[k]


@inlined
def bridge(target: int, stride: int, pixels: Any, codes: Any, bridged: Any, length: int) -> int:
    """Fill the gap between the last pixel and the target with a digital straight line of the last pixel's code."""
    pixel, code = pixels[length - 1], codes[length - 1]
    gap = max(abs(target % stride - pixel % stride), abs(target // stride - pixel // stride)) - 1
    for k in range(1, gap + 1):
        pixels[length] = gap_pixel(pixel, target, k, gap, stride)
        codes[length] = code
        bridged[length] = True
        length += 1
    return length


@kernel
def write_directions(pixels: Any, offsets: Any, closed: Any, stride: int, directions: Any) -> None:
    """Write the direction from each pixel of every chain to the next."""
    for chain in range(closed.size):
        first, end = offsets[chain], offsets[chain + 1]
        for k in range(first, end - 1):
            directions[k] = chain_code(pixels[k + 1] - pixels[k], np.int32(stride))
        directions[end - 1] = (chain_code(pixels[first] - pixels[end - 1], np.int32(stride)) if closed[chain] else END)


@inlined
def chain_code(step: Any, stride: Any) -> Any:
    """The direction of a step between neighbours, given as a difference of flat indices."""
    down = np.int32(step > 1) - np.int32(step < -1)
    right = step - down * stride
    level = np.int32(0) if right == 1 else np.int32(4)
    upward = np.int32(6) + right
    return np.uint8((np.int32(2) - right if down == 1 else upward) if down != 0 else level)

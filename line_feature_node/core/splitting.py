"""Step 4 by straightness: chains are divided into straight stretches, whatever the codes of their pixels.

A chain is gone along in units of a few pixels. A stretch begins with the first units that lie along a line, and takes
in one unit after the other as long as that costs less than to leave the unit out; what does not belong to a line, where
a chain goes round a corner or wanders, is in no stretch. The cost of pixels is the sum of their squared distances from
their line, in units of the variance that whole pixels and noise give them. The line-blobs are the stretches.
"""

from typing import Any

import numpy as np

from line_feature_node.core.blobs import BLOB_DTYPE, MOMENTS, Blobs, put_down
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.indices import position
from line_feature_node.core.scanning import Chains

#: Pixels of a unit; units that a stretch begins with, and the most that it has: longer lines are found in parts.
UNIT, FIRST, LONGEST = 4, 3, 32
#: The largest cost of the units that a stretch begins with, and the cost of a unit that is left out.
STRAIGHT, LEFT_OUT = 10.0, 6.0
#: The scatter of two pixels beside each other: that of one pixel would be divided by nothing.
LEAST_TRACE = 0.5
#: Standard deviation, in pixels, of the distance of whole pixels from the line that they follow, and of the noise in
#: that where the gradient is as strong as the noise of its components.
DEVIATION, NOISE_DEVIATION = 0.5, 2.0


def deviation_variance(noise: float, least: float) -> float:
    """The variance of the distance of edge pixels from their line, in square pixels.

    Args:
        noise: Standard deviation of the noise of a component of the gradient.
        least: The least gradient that an edge has.
    """
    return DEVIATION**2 + (NOISE_DEVIATION * noise / max(least, 1e-9))**2


def split_chains(
    chains: Chains, variance: float, stride: int, margin: int, min_size: int, buffers: Buffers,
) -> Blobs:
    """Divide the chains into straight stretches.

    Args:
        chains: What edge scanning made.
        variance: Of the distance of a pixel from its line.
        stride, margin: Length of a row of the padded image that the chains' pixels are of, and its padding.
        min_size: Shorter stretches are left out.
        buffers: Memory to work in.

    Returns:
        A blob for each stretch, with the code that most of its pixels have.
    """
    size = int(chains.offsets[-1] - chains.offsets[0])
    most = size // min_size + 1
    attributes = buffers.array('stretches', most, BLOB_DTYPE)
    members = buffers.array('members', size, np.int32)
    offsets = buffers.array('blob offsets', most + 1, np.int32)
    moments = buffers.array('moments', MOMENTS * most, np.float64)[:MOMENTS * most].reshape(most, MOMENTS)
    units = size // UNIT + 2
    sums = buffers.array('sums', MOMENTS * units, np.float64)[:MOMENTS * units].reshape(units, MOMENTS)
    count = split(chains.offsets, chains.pixels, chains.codes, chains.bridged, 1 / variance, stride, margin, min_size,
                  sums, attributes, members, offsets, moments)
    return Blobs(attributes[:count], members[:offsets[count]], offsets[:count + 1], moments[:count])


@kernel
def split(
    chain_offsets: Any, pixels: Any, codes: Any, bridged: Any, weight: float, stride: int, margin: int, min_size: int,
    sums: Any, blobs: Any, members: Any, offsets: Any, moments: Any,
) -> int:
    """Divide every chain, and write out its stretches; return their number."""
    count, total = 0, 0
    offsets[0] = 0
    for chain in range(chain_offsets.size - 1):
        first, size = chain_offsets[chain], chain_offsets[chain + 1] - chain_offsets[chain]
        if size < max(min_size, UNIT * (FIRST - 1) + 1):
            continue
        sum_up(first, size, pixels, bridged, stride, margin, sums)
        units = (size + UNIT - 1) // UNIT
        unit = 0
        while unit + FIRST <= units:
            end = end_of_stretch(sums, unit, units, weight)
            if end == unit:
                unit += 1
                continue
            start, stop = first + unit * UNIT, first + min(end * UNIT, size)
            for k in range(MOMENTS):
                moments[count, k] = sums[end, k] - sums[unit, k]
            unit = end
            if stop - start < min_size:
                continue
            describe(pixels, codes, start, stop, stride, margin, blobs[count])
            for pixel in range(start, stop):
                members[total] = pixel
                total += 1
            count += 1
            offsets[count] = total
    return count


@inlined
def sum_up(first: int, size: int, pixels: Any, bridged: Any, stride: int, margin: int, sums: Any) -> None:
    """The moments of a chain up to each unit; filled gaps don't count."""
    inverse = 1 / stride
    n, sx, sy, sxx, sxy, syy = 0, 0, 0, 0, 0, 0
    for k in range(size):
        if k % UNIT == 0:
            put_down(sums, k // UNIT, n, sx, sy, sxx, sxy, syy)
        if bridged[first + k]:
            continue
        row, column = position(pixels[first + k], inverse, stride)
        x, y = column - margin, row - margin
        n, sx, sy, sxx, sxy, syy = n + 1, sx + x, sy + y, sxx + x * x, sxy + x * y, syy + y * y
    put_down(sums, (size + UNIT - 1) // UNIT, n, sx, sy, sxx, sxy, syy)


@inlined
def scatter(sums: Any, first: int, last: int) -> float:
    """Sum of squared distances of the pixels of some units from their line: the smaller eigenvalue of their scatter.

    It is taken as the determinant over the trace, which is that but for the share that it has of the larger one.
    """
    n = sums[last, 0] - sums[first, 0]
    per_pixel = 1 / max(n, 1.0)
    x, y = sums[last, 1] - sums[first, 1], sums[last, 2] - sums[first, 2]
    xx = sums[last, 3] - sums[first, 3] - x * x * per_pixel
    xy = sums[last, 4] - sums[first, 4] - x * y * per_pixel
    yy = sums[last, 5] - sums[first, 5] - y * y * per_pixel
    return max(xx * yy - xy * xy, 0.0) / max(xx + yy, LEAST_TRACE)


@kernel
def end_of_stretch(sums: Any, unit: int, units: int, weight: float) -> int:
    """The first unit behind the stretch that begins with a unit; that unit itself where none begins there."""
    end = unit + FIRST
    cost = weight * scatter(sums, unit, end)
    if cost > STRAIGHT:
        return unit
    while end < units and end - unit < LONGEST:
        longer = weight * scatter(sums, unit, end + 1)
        if longer > cost + LEFT_OUT:
            break
        cost = longer
        end += 1
    return end


@inlined
def describe(pixels: Any, codes: Any, start: int, stop: int, stride: int, margin: int, blob: Any) -> None:
    """Fill in the attributes of a stretch; of codes that are equally frequent the lower one counts."""
    inverse = 1 / stride
    top, left = position(pixels[start], inverse, stride)
    bottom, right = top, left
    counts: Any = np.int64(0)
    for k in range(start, stop):
        row, column = position(pixels[k], inverse, stride)
        top, bottom, left, right = min(top, row), max(bottom, row), min(left, column), max(right, column)
        counts += 1 << 15 * (np.int64(codes[k]) - 1)
    most: Any = -1
    for code in range(1, 5):
        if counts >> 15 * (code - 1) & 0x7FFF > most:
            most = counts >> 15 * (code - 1) & 0x7FFF
            blob['dir'] = code
    blob['select'], blob['size'] = True, stop - start
    blob['min_row'], blob['max_row'] = top - margin, bottom - margin
    blob['min_col'], blob['max_col'] = left - margin, right - margin

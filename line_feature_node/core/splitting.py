"""Step 4 by straightness: chains are divided into straight stretches, whatever the codes of their pixels.

A chain is gone along in units of a few pixels. A stretch begins with the first units that lie along a line, and takes
in one unit after the other as long as that costs less than to leave the unit out; what does not belong to a line, where
a chain goes round a corner or wanders, is in no stretch. The cost of pixels is the sum of their squared distances from
their line, in units of the variance that whole pixels and noise give them. The line-blobs are the stretches.
"""

from typing import Any

import numpy as np

from line_feature_node.core.blobs import BLOB_DTYPE, MOMENTS, Blobs, describe, moments_of, put_down
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.indices import place_pixels
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
    starts, ends = buffers.array('stretch starts', most, np.int32), buffers.array('stretch ends', most, np.int32)
    labels = buffers.array('labels', most, np.int32)
    moments = buffers.array('moments', MOMENTS * most, np.float64)[:MOMENTS * most].reshape(most, MOMENTS)
    units = size // UNIT + 2
    sums = buffers.array('sums', MOMENTS * units, np.float64)[:MOMENTS * units].reshape(units, MOMENTS)
    columns = buffers.array('pixel columns', size, np.int32)
    rows = buffers.array('pixel rows', size, np.int32)
    first, last = chains.offsets[0], chains.offsets[-1]
    place_pixels(chains.pixels[first:last], stride, margin, columns, rows)
    count = split(chains.offsets, columns, rows, chains.codes[first:last], chains.bridged[first:last], 1 / variance,
                  min_size, sums, attributes, moments, starts, ends, labels)
    return Blobs(attributes[:count], moments[:count], starts[:count], ends[:count], labels[:count])


@kernel
def split(
    chain_offsets: Any, columns: Any, rows: Any, codes: Any, bridged: Any, weight: float, min_size: int, sums: Any,
    blobs: Any, moments: Any, starts: Any, ends: Any, labels: Any,
) -> int:
    """Divide every chain, and write out its stretches; return their number.

    Columns, rows, codes and whether they fill a gap are those of the chains' pixels, from the first chain's on.
    """
    count, start_of_all = 0, chain_offsets[0]
    for chain in range(chain_offsets.size - 1):
        first, size = chain_offsets[chain] - start_of_all, chain_offsets[chain + 1] - chain_offsets[chain]
        if size < max(min_size, UNIT * (FIRST - 1) + 1):
            continue
        sum_up(columns[first:first + size], rows[first:first + size], bridged[first:first + size], sums)
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
            describe(columns[start:stop], rows[start:stop], most_frequent(codes[start:stop]), blobs[count])
            starts[count], ends[count], labels[count] = start_of_all + start, start_of_all + stop, count
            count += 1
    return count


@inlined
def sum_up(columns: Any, rows: Any, bridged: Any, sums: Any) -> None:
    """The moments of a chain up to each unit; filled gaps don't count."""
    size = columns.size
    for k in range(MOMENTS):
        sums[0, k] = 0
    for unit in range(size // UNIT):
        first, end = UNIT * unit, UNIT * unit + UNIT
        add_unit(columns[first:end], rows[first:end], bridged[first:end], sums, unit)
    if size % UNIT > 0:
        first = size // UNIT * UNIT
        add_unit(columns[first:], rows[first:], bridged[first:], sums, size // UNIT)


@inlined
def add_unit(columns: Any, rows: Any, bridged: Any, sums: Any, unit: int) -> None:
    """The moments up to the end of a unit, from those up to its beginning."""
    n, sx, sy, sxx, sxy, syy = moments_of(columns, rows, bridged)
    put_down(sums, unit + 1, n + sums[unit, 0], sx + sums[unit, 1], sy + sums[unit, 2], sxx + sums[unit, 3],
             sxy + sums[unit, 4], syy + sums[unit, 5])


@inlined
def scatter(sums: Any, first: int, last: int) -> float:
    """Sum of squared distances of the pixels of some units from their line: the smaller eigenvalue of their scatter.

    It is taken as the determinant over the trace, which is that but for the share that it has of the larger one. The
    central moments are multiplied by the number of pixels, which makes them whole numbers, and a division less.
    """
    n = sums[last, 0] - sums[first, 0]
    x, y = sums[last, 1] - sums[first, 1], sums[last, 2] - sums[first, 2]
    xx = n * (sums[last, 3] - sums[first, 3]) - x * x
    xy = n * (sums[last, 4] - sums[first, 4]) - x * y
    yy = n * (sums[last, 5] - sums[first, 5]) - y * y
    return max(xx * yy - xy * xy, 0.0) / (max(n, 1.0) * max(xx + yy, LEAST_TRACE * n, LEAST_TRACE))


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
def most_frequent(codes: Any) -> int:
    """The code that most of some pixels have; of those that are equally frequent the lower one."""
    counts: Any = np.int64(0)
    for k in range(codes.size):
        counts += 1 << 15 * (np.int64(codes[k]) - 1)
    found, most = 0, -1
    for code in range(1, 5):
        if counts >> 15 * (code - 1) & 0x7FFF > most:
            most = counts >> 15 * (code - 1) & 0x7FFF
            found = code
    return found

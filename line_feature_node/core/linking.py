"""Step 6, line linking: lines that are collinear, not overlapped and adjacent become one (section 2.3)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.features import fit
from line_feature_node.core.parameters import Parameters

#: Cells of the grid over the end points are at least this wide, in pixels.
SMALLEST_CELL = 8.0
#: Below this cosine of the angle between two lines the normal of one counts as parallel to the other.
PARALLEL = 1e-9


def link_lines(
    lines: NDArray[np.void], count: int, shape: tuple[int, int], parameters: Parameters, buffers: Buffers,
) -> NDArray[np.bool_]:
    """Link lines until no two can be linked any more.

    Pairs are taken by the distance of their nearest ends, and by the coordinates of the lines where that is equal, so
    that the result does not depend on the order of the lines.

    Args:
        lines: LINE_DTYPE, with room for twice as many as there are; merged lines are appended.
        count: How many there are.
        shape: Height and width of the image.
        parameters: tau1, tau2 and orientation are used.
        buffers: Memory to work in.

    Returns:
        For each line, the appended ones included, whether it is left: a merged one's parts are not.
    """
    height, width = shape
    cell = max(2 * parameters.tau2, SMALLEST_CELL)
    rows, columns = int(height / cell) + 1, int(width / cell) + 1
    alive = buffers.array('alive', 2 * count, np.bool_)
    entries = buffers.array('entries', 4 * count, np.int32)
    cells = buffers.array('cells', rows * columns, np.int32)[:rows * columns].reshape(rows, columns)
    room = max(count, 64)
    while True:
        pairs = buffers.array('pairs', 2 * room, np.int32)[:2 * room].reshape(room, 2)
        gaps, heap = buffers.array('gaps', room, np.float64), buffers.array('heap', room, np.int32)
        total = link(lines, count, float(height), float(width), parameters.tau1, parameters.tau2,
                     parameters.orientation == 'least_squares', cell, alive, entries, cells, pairs, gaps, heap)
        if total >= 0:
            return alive[:total]
        room *= 4


@inlined
def collinear(first: Any, second: Any, tau1: float) -> bool:
    """Definition 1: max(l1, l2) < tau1, with l1 and l2 from each mid-point to the other, infinite, line."""
    return max(distance(first, second), distance(second, first)) < tau1


@inlined
def distance(first: Any, second: Any) -> float:
    """Distance from the mid-point of one line to the infinite other."""
    return abs((first['y'] - second['y']) * second['cos'] - (first['x'] - second['x']) * second['sin'])


@inlined
def overlapped(first: Any, second: Any) -> bool:
    """Definition 2, either way round: the text does not say which of the two lines is L1."""
    return falls_on(first, second) or falls_on(second, first)


@inlined
def falls_on(first: Any, second: Any) -> bool:
    """Whether L3, orthogonal to the first line in its mid-point P1, meets the second in a point P3 of its rectangle.

    P3 lies on the second line, so only its coordinate along the dominant axis of that line is compared. Where L3 is
    parallel to the second line there is no P3.
    """
    cosine = first['cos'] * second['cos'] + first['sin'] * second['sin']
    if abs(cosine) < PARALLEL:
        return False
    along = ((first['x'] - second['x']) * first['cos'] + (first['y'] - second['y']) * first['sin']) / cosine
    if second['cos'] >= abs(second['sin']):
        x3 = second['x'] + along * second['cos']
        return min(second['x1'], second['x2']) <= x3 <= max(second['x1'], second['x2'])
    y3 = second['y'] + along * second['sin']
    return min(second['y1'], second['y2']) <= y3 <= max(second['y1'], second['y2'])


@inlined
def adjacent(first: Any, second: Any, tau2: float) -> bool:
    """Definition 3: the smallest distance between end points of the two lines is below tau2."""
    return nearest_ends(first, second)[0] < tau2


@inlined
def nearest_ends(first: Any, second: Any) -> tuple[float, int]:
    """The smallest distance between ends of two lines; and between which, as 2 (end of first) + (end of second)."""
    a = squared(first['x1'] - second['x1'], first['y1'] - second['y1'])
    b = squared(first['x1'] - second['x2'], first['y1'] - second['y2'])
    c = squared(first['x2'] - second['x1'], first['y2'] - second['y1'])
    d = squared(first['x2'] - second['x2'], first['y2'] - second['y2'])
    gap = min(a, b, c, d)
    return np.sqrt(gap), (0 if a == gap else (1 if b == gap else (2 if c == gap else 3)))


@inlined
def squared(x: float, y: float) -> float:
    """Square of a distance."""
    return x * x + y * y


@inlined
def merge(first: Any, second: Any, merged: Any, least_squares: bool, height: float, width: float) -> bool:
    """The line of the pixels of both: sums add, rectangles unite, the code is that of the larger part.

    Returns:
        Whether the union has a direction.
    """
    merged['n'] = first['n'] + second['n']
    merged['sx'], merged['sy'] = first['sx'] + second['sx'], first['sy'] + second['sy']
    merged['sxx'], merged['syy'] = first['sxx'] + second['sxx'], first['syy'] + second['syy']
    merged['sxy'] = first['sxy'] + second['sxy']
    merged['min_col'] = min(first['min_col'], second['min_col'])
    merged['max_col'] = max(first['max_col'], second['max_col'])
    merged['min_row'] = min(first['min_row'], second['min_row'])
    merged['max_row'] = max(first['max_row'], second['max_row'])
    if first['n'] == second['n']:
        merged['code'] = min(first['code'], second['code'])
    else:
        merged['code'] = first['code'] if first['n'] > second['n'] else second['code']
    return fit(merged, least_squares, height, width)


@inlined
def precedes(first: Any, second: Any) -> int:
    """-1, 0 or 1 as the coordinates of the first line come before, equal or come after those of the second."""
    for a, b in (
        (first['y'], second['y']), (first['x'], second['x']), (first['y1'], second['y1']), (first['x1'], second['x1']),
        (first['y2'], second['y2']), (first['x2'], second['x2']), (first['n'], second['n']),
    ):
        if a != b:
            return -1 if a < b else 1
    return 0


@inlined
def comes_first(a: int, b: int, lines: Any, pairs: Any, gaps: Any) -> bool:
    """Whether pair a is to be linked before pair b."""
    if gaps[a] != gaps[b]:
        return gaps[a] < gaps[b]
    order = precedes(lines[pairs[a, 0]], lines[pairs[b, 0]])
    if order == 0:
        order = precedes(lines[pairs[a, 1]], lines[pairs[b, 1]])
    return order < 0


@kernel
def push(heap: Any, size: int, pair: int, lines: Any, pairs: Any, gaps: Any) -> None:
    """Add a pair to a binary heap of `size` pairs."""
    k = size
    while k > 0 and comes_first(pair, heap[(k - 1) // 2], lines, pairs, gaps):
        heap[k] = heap[(k - 1) // 2]
        k = (k - 1) // 2
    heap[k] = pair


@kernel
def pop(heap: Any, size: int, lines: Any, pairs: Any, gaps: Any) -> int:
    """Take the first pair from a binary heap of `size` pairs."""
    first, moved = heap[0], heap[size - 1]
    k = 0
    while True:
        child = 2 * k + 1
        if child >= size - 1:
            break
        if child + 1 < size - 1 and comes_first(heap[child + 1], heap[child], lines, pairs, gaps):
            child += 1
        if not comes_first(heap[child], moved, lines, pairs, gaps):
            break
        heap[k] = heap[child]
        k = child
    heap[k] = moved
    return first


@inlined
def place_of(line: Any, end: int, cell: float) -> tuple[float, float]:
    """Where an end of a line lies in the grid, in cells downwards and to the right."""
    x, y = (line['x1'], line['y1']) if end == 0 else (line['x2'], line['y2'])
    return (y + 0.5) / cell, (x + 0.5) / cell


@inlined
def is_near(first: Any, end: int, second: Any, other_end: int, tau2: float) -> bool:
    """Whether an end of one line is not farther than tau2 from an end of another: what most in a cell are not."""
    x1, y1 = (first['x1'], first['y1']) if end == 0 else (first['x2'], first['y2'])
    x2, y2 = (second['x1'], second['y1']) if other_end == 0 else (second['x2'], second['y2'])
    return squared(x1 - x2, y1 - y2) <= tau2 * tau2


@inlined
def insert(k: int, lines: Any, cell: float, entries: Any, cells: Any) -> None:
    """Put both ends of a line into the grid."""
    for end in range(2):
        down, right = place_of(lines[k], end, cell)
        entries[2 * k + end] = cells[int(down), int(right)]
        cells[int(down), int(right)] = 2 * k + end


@inlined
def find_pairs(
    k: int, found: int, waiting: int, lines: Any, tau1: float, tau2: float, cell: float, alive: Any, entries: Any,
    cells: Any, pairs: Any, gaps: Any, heap: Any,
) -> tuple[int, int]:
    """Push every line of the grid that line k can be linked with.

    Returns:
        The number of pairs found so far, and of those that wait in the heap; -1 where there is no room for one more.
    """
    line = lines[k]
    for end in range(2):
        # A cell is twice tau2 wide or more: what is near lies in it or in those on the nearer sides.
        down, right = place_of(line, end, cell)
        for i in range(max(int(down + 0.5) - 1, 0), min(int(down + 0.5) + 1, cells.shape[0])):
            for j in range(max(int(right + 0.5) - 1, 0), min(int(right + 0.5) + 1, cells.shape[1])):
                entry = cells[i, j]
                while entry != -1:
                    other = entry // 2
                    # Most that meet are not collinear. Of the up to four ways to meet a pair here, its nearest ends are
                    # the one that counts.
                    if (alive[other] and is_near(line, end, lines[other], entry % 2, tau2)
                            and collinear(line, lines[other], tau1) and adjacent(line, lines[other], tau2)
                            and not overlapped(line, lines[other])
                            and nearest_ends(line, lines[other])[1] == 2 * end + entry % 2):
                        if found == pairs.shape[0]:
                            return -1, waiting
                        swapped = precedes(line, lines[other]) > 0
                        pairs[found, 0], pairs[found, 1] = (other, k) if swapped else (k, other)
                        gaps[found] = nearest_ends(line, lines[other])[0]
                        push(heap, waiting, found, lines, pairs, gaps)
                        found += 1
                        waiting += 1
                    entry = entries[entry]
    return found, waiting


@kernel
def link(
    lines: Any, count: int, height: float, width: float, tau1: float, tau2: float, least_squares: bool, cell: float,
    alive: Any, entries: Any, cells: Any, pairs: Any, gaps: Any, heap: Any,
) -> int:
    """Link the pairs in their order; merged lines come back into the grid. Return the number of lines made in all.

    -1 says that there was no room for all pairs; the lines given are then as they were.
    """
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            cells[row, column] = -1
    found, waiting = 0, 0
    for k in range(count):
        alive[k] = True
        found, waiting = find_pairs(
            k, found, waiting, lines, tau1, tau2, cell, alive, entries, cells, pairs, gaps, heap)
        if found < 0:
            return -1
        insert(k, lines, cell, entries, cells)
    total = count
    while waiting > 0:
        pair = pop(heap, waiting, lines, pairs, gaps)
        waiting -= 1
        first, second = pairs[pair, 0], pairs[pair, 1]
        if not (alive[first] and alive[second]):
            continue
        if not merge(lines[first], lines[second], lines[total], least_squares, height, width):
            continue
        alive[first], alive[second], alive[total] = False, False, True
        found, waiting = find_pairs(
            total, found, waiting, lines, tau1, tau2, cell, alive, entries, cells, pairs, gaps, heap)
        if found < 0:
            return -1
        insert(total, lines, cell, entries, cells)
        total += 1
    return total

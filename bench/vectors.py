"""Time the blocks of core/vectors.py beside plain loops that do the same, over the rows of a 640×480 picture.

    python bench/vectors.py
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from line_feature_node.core.compiling import kernel
from line_feature_node.core.edges import smooth_strip, turn, turn_back
from line_feature_node.core.vectors import LANES, TILE

WIDTH, STRIDE, STRIPS, REPS = 640, 656, 480 // LANES, 200


@kernel
def smooth_plain(strip: Any, width: int, q: Any) -> None:
    """Both passes of the recursion as loops over lanes."""
    gain, first, second = (1 - q) * (1 - q), 2 * q, -q * q
    columns = strip.reshape(-1, LANES)
    for column in range(2, width + 2):
        for i in range(LANES):
            columns[column, i] = first * columns[column - 1, i] + (
                second * columns[column - 2, i] + gain * columns[column, i])
    for column in range(width + 1, -1, -1):
        for i in range(LANES):
            columns[column, i] = first * columns[column + 1, i] + (
                second * columns[column + 2, i] + gain * columns[column, i])


@kernel
def turn_plain(plane: Any, first: int, strip: Any) -> None:
    """Rows to lanes as a loop over single values."""
    for lane in range(LANES):
        for column in range(plane.shape[1]):
            strip[column * LANES + lane] = plane[first + lane, column]


@kernel
def turn_back_plain(strip: Any, plane: Any, first: int) -> None:
    """Lanes to rows as a loop over single values."""
    for lane in range(LANES):
        for column in range(plane.shape[1]):
            plane[first + lane, column] = strip[column * LANES + lane]


def milliseconds(function: Callable[..., Any], *arguments: Any) -> float:
    """The best time for all strips of a picture."""
    function(*arguments)
    times = []
    for _ in range(REPS):
        start = time.perf_counter()
        for _ in range(STRIPS):
            function(*arguments)
        times.append(time.perf_counter() - start)
    return min(times) * 1e3


def main() -> None:
    assert STRIDE % TILE == 0
    plane, strip = np.ones((LANES, STRIDE), np.float32), np.ones(STRIDE * LANES, np.float32)
    q = np.float32(np.exp(-1))
    print('ms for 640×480        block   plain')
    for name, block, plain, arguments in (
        ('recursion', smooth_strip, smooth_plain, (strip, WIDTH, q)),
        ('rows to lanes', turn, turn_plain, (plane, 0, strip)),
        ('lanes to rows', turn_back, turn_back_plain, (strip, plane, 0)),
    ):
        print(f'{name:20}{milliseconds(block, *arguments):7.3f} {milliseconds(plain, *arguments):7.3f}')


if __name__ == '__main__':
    main()

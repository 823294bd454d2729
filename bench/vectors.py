"""Time what core/vectors.py is for beside plain loops that do the same: rows of 640×480, and steps along lines there.

    python bench/vectors.py
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from line_feature_node.core.compiling import kernel
from line_feature_node.core.edges import smooth_strip, turn, turn_back
from line_feature_node.core.refinement import RIDGE_DTYPE, align, axes_of
from line_feature_node.core.vectors import LANES, TILE

WIDTH, HEIGHT, STRIDE, STRIPS, REPS = 640, 480, 656, 480 // LANES, 200
LINES, LENGTH = 1000, 30


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


@kernel
def align_all(lines: Any, gradient: Any, stride: int) -> None:
    """Align lines, which may not move, so that they are the same ones every time."""
    for line in lines:
        align(line, gradient, axes_of(line, stride, 2, HEIGHT, WIDTH), 0.0)


@kernel
def align_all_plain(lines: Any, gradient: Any, stride: int) -> None:
    """What takes the time of that, pixel by pixel: the sums over the gradient at three pixels across."""
    for line in lines:
        slope, intercept = np.float32(line['slope']), np.float32(line['intercept'])
        response = curvature = slant = slant_t = sd = std = np.float32(0)
        first = int(line['first']) + 2
        for p in range(first, first + LENGTH - 4, 2):
            q = slope * np.float32(p) + intercept
            r = int(q + np.float32(0.5))
            x, y = (r, p) if line['steep'] else (p, r)
            step = 2 if line['steep'] else 2 * stride
            k = 2 * ((y + 2) * stride + x + 2)
            before = slope * gradient[k - step] + gradient[k - step + 1]
            at = slope * gradient[k] + gradient[k + 1]
            behind = slope * gradient[k + step] + gradient[k + step + 1]
            t, d, across = np.float32(p - first), np.float32(r) - q, behind - before
            response += at
            curvature += behind + before - (at + at)
            slant += across
            slant_t += t * across
            sd += d
            std += t * d
        line['response'] = response + curvature + slant + slant_t + sd + std


def lines_anywhere(seed: int = 0) -> tuple[Any, Any]:
    """Lines in a picture of noise, and its gradient."""
    rng = np.random.default_rng(seed)
    lines = np.zeros(LINES, RIDGE_DTYPE)
    lines['steep'], lines['slope'], lines['sign'] = rng.random(LINES) < 0.5, rng.uniform(-0.5, 0.5, LINES), 1
    lines['first'] = rng.uniform(50, 350, LINES)
    lines['last'] = lines['first'] + LENGTH
    lines['intercept'] = rng.uniform(50, 430, LINES) * 0.5 + 100 - lines['slope'] * lines['first']
    return lines, rng.integers(-9, 9, (HEIGHT + 4) * STRIDE * 2).astype(np.int16)


def milliseconds(function: Callable[..., Any], *arguments: Any, times: int = STRIPS) -> float:
    """The best time for so many calls: for all strips of a picture where nothing else is said."""
    function(*arguments)
    seconds = []
    for _ in range(REPS):
        start = time.perf_counter()
        for _ in range(times):
            function(*arguments)
        seconds.append(time.perf_counter() - start)
    return min(seconds) * 1e3


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
    lines, gradient = lines_anywhere()
    times = [milliseconds(function, lines, gradient, STRIDE, times=1) for function in (align_all, align_all_plain)]
    print(f'{LINES} lines aligned {times[0]:7.3f} {times[1]:7.3f}')


if __name__ == '__main__':
    main()

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
import pytest

from line_feature_node.core import extract, vectors
from line_feature_node.core.vectors import LANES, STEPS, TILE

Floats = npt.NDArray[np.float32]


def values(size: int, seed: int = 0) -> Floats:
    return np.random.default_rng(seed).normal(0, 100, size).astype(np.float32)


@numba.njit
def move(source: Any, start: int, target: Any, target_start: int) -> None:
    vectors.store(target, target_start, vectors.load(source, start))


@numba.njit
def combine(factor: float, source: Any, start: int, summand: Any, target: Any) -> None:
    vectors.store(target, 0, factor * vectors.load(source, start) + vectors.load(summand, 0))


@numba.njit
def turn(source: Any, start: int, step: int, target: Any, target_start: int, target_step: int) -> None:
    vectors.transpose(source, start, step, target, target_start, target_step)


@pytest.mark.parametrize('start', [0, 1, 7, 33])
def test_load(start: int) -> None:
    """Any index will do, aligned or not."""
    source, target = values(100), np.zeros(LANES, np.float32)
    move(source, start, target, 0)
    np.testing.assert_array_equal(target, vectors.load_plain(source, start))
    np.testing.assert_array_equal(target, source[start:start + LANES])


def test_plain_load_is_no_view() -> None:
    """A vector keeps its values when the array changes."""
    source = values(LANES)
    vector, before = vectors.load_plain(source, 0), source.copy()
    source[:] = 0
    np.testing.assert_array_equal(vector, before)


@pytest.mark.parametrize('start', [0, 1, 7, 33])
def test_store(start: int) -> None:
    """Only the lanes are written."""
    source, target, expected = values(LANES), values(100, seed=1), values(100, seed=1)
    move(source, 0, target, start)
    vectors.store_plain(expected, start, source)
    np.testing.assert_array_equal(target, expected)
    assert (target != values(100, seed=1)).sum() == LANES


@pytest.mark.parametrize('factor', [0.0, 1.0, -0.37, 1e-20, 3e20])
def test_product_and_sum_of_rows(factor: float) -> None:
    """Rounded once or twice: the two differ by a rounding of the product at most."""
    source, summand, target = values(2 * LANES), values(LANES, seed=1), np.zeros(LANES, np.float32)
    combine(np.float32(factor), source, 5, summand, target)
    vector = source[5:5 + LANES]
    plain = np.float32(factor) * vector + summand
    rounding = np.finfo(np.float32).eps * (abs(np.float64(np.float32(factor)) * vector) + abs(summand))
    assert (abs(target.astype(np.float64) - plain) <= rounding).all()


# Steps along a line. What is compiled and its plain twin are both given what a kernel has: arrays, and numbers.

@numba.njit
def arithmetic(a: Any, b: Any, number: float, results: Any) -> None:
    x, y = vectors.pairs(a, vectors.ramp(0))[0], vectors.pairs(b, vectors.ramp(0))[0]
    vectors.store(results, 0, x + y)
    vectors.store(results, 8, x - y)
    vectors.store(results, 16, x * y)
    vectors.store(results, 24, x / y)
    vectors.store(results, 32, abs(x))
    vectors.store(results, 40, number - x)
    vectors.store(results, 48, x * number)
    vectors.store(results, 56, vectors.floor(x))
    vectors.store(results, 64, vectors.floats(vectors.integers(x)))
    vectors.store(results, 72, vectors.smaller(x, y))
    vectors.store(results, 80, vectors.larger(x, y))
    vectors.store(results, 88, vectors.larger(x, number))
    vectors.store(results, 96, vectors.where(x < y, x, number))
    vectors.store(results, 104, vectors.where((x <= y) & (y >= number), vectors.every(1), 0))
    vectors.store(results, 112, vectors.every(vectors.total(x)))
    results[120] = vectors.total(y)


def plain_arithmetic(a: Floats, b: Floats, number: float) -> Floats:
    x, y = a[0:16:2], b[0:16:2]
    results = [x + y, x - y, x * y, x / y, abs(x), number - x, x * number, np.floor(x),
               vectors.floats_plain(vectors.integers_plain(x)), np.where(x < y, x, y), np.where(x >= y, x, y),
               np.where(x >= number, x, number), vectors.where_plain(x < y, x, number),
               vectors.where_plain((x <= y) & (y >= number), vectors.every_plain(1), 0),
               vectors.every_plain(vectors.total_plain(x)), vectors.total_plain(y)]
    return np.hstack(results).astype(np.float32)


@pytest.mark.parametrize('seed', range(5))
def test_arithmetic_along_a_line(seed: int) -> None:
    a, b, results = values(2 * STEPS, seed), values(2 * STEPS, seed + 100), np.zeros(15 * STEPS + 1, np.float32)
    a[:6:2], b[:6:2] = (3, -3, 0.5), (3, 2.5, 0.5)  # equal ones, and halves
    arithmetic(a, b, np.float32(0.25), results)
    np.testing.assert_allclose(results, plain_arithmetic(a, b, np.float32(0.25)), rtol=1e-6)


def test_arithmetic_of_what_is_no_number() -> None:
    """A comparison with it is false, so that the other one is chosen."""
    a, b, results = values(2 * STEPS), values(2 * STEPS, 1), np.zeros(15 * STEPS + 1, np.float32)
    a[0], a[2], b[4] = np.nan, np.inf, np.nan
    with np.errstate(invalid='ignore'):
        plain = plain_arithmetic(a, b, np.float32(0.25))
    arithmetic(a, b, np.float32(0.25), results)
    whole = slice(64, 72)  # there is no whole number for these
    results[whole], plain[whole] = 0, 0
    np.testing.assert_allclose(results, plain, rtol=1e-6)
    assert results[72] == b[0]
    assert results[80] == b[0]


@numba.njit
def whole_numbers(first: int, number: int, results: Any) -> None:
    s = vectors.ramp(first)
    vectors.store(results, 0, vectors.floats(s))
    vectors.store(results, 8, vectors.floats(s * number - 2))
    vectors.store(results, 16, vectors.floats(vectors.larger(vectors.smaller(s, number), 3)))
    vectors.store(results, 24, vectors.where((s < number) & (s >= 3), vectors.every(1), 0))


def test_whole_numbers() -> None:
    results = np.zeros(4 * STEPS, np.float32)
    whole_numbers(1, 5, results)
    s = vectors.ramp_plain(1)
    np.testing.assert_array_equal(s, [1, 2, 3, 4, 5, 6, 7, 8])
    np.testing.assert_array_equal(results, np.hstack([
        s, s * 5 - 2, np.clip(s, 3, 5),
        vectors.where_plain((s < 5) & (s >= 3), vectors.every_plain(1), 0)]))


def test_total_has_the_same_order_everywhere() -> None:
    """Of numbers that are lost beside others, which are lost depends on the order."""
    vector = np.array([1e8, 1, 2, 3, -1e8, 5, 6, 7], np.float32)
    a, results = np.repeat(vector, 2), np.zeros(15 * STEPS + 1, np.float32)
    arithmetic(a, a, np.float32(0), results)
    halves = vector[:4] + vector[4:]
    assert results[120] == vectors.total_plain(vector) == halves[:2].sum() + halves[2:].sum() == 24


@numba.njit
def gather(array: Any, first: int, results: Any) -> None:
    x, y = vectors.pairs(array, (vectors.ramp(0) * 3 + first))
    vectors.store(results, 0, x)
    vectors.store(results, 8, y)


@pytest.mark.parametrize('dtype', [np.int16, np.float32])
def test_pairs(dtype: Any) -> None:
    """Both numbers of each, with their signs."""
    array = np.random.default_rng(0).integers(-32768, 32768, 60).astype(dtype)
    array[[8, 9, 14, 15]] = -32768, 32767, 32767, -32768
    results = np.zeros(2 * STEPS, np.float32)
    gather(array, 4, results)
    index = np.arange(4, 4 + 3 * STEPS, 3)
    np.testing.assert_array_equal(results, np.hstack([array[2 * index], array[2 * index + 1]]).astype(np.float32))
    np.testing.assert_array_equal(results, np.hstack(vectors.pairs_plain(array, index.astype(np.int32))))


def test_plain_vectors_are_in_the_array() -> None:
    """As where bounds are checked."""
    for index in (-1, 1):
        with pytest.raises(IndexError):
            vectors.load_plain(values(LANES), index)


def test_plain_pairs_are_in_the_array() -> None:
    """What the compiler would read from elsewhere is an error."""
    for first in (-1, 8):
        with pytest.raises(IndexError):
            vectors.pairs_plain(np.zeros(16, np.int16), np.array([first] * STEPS, np.int32))


@numba.njit
def ask(array: Any, index: int) -> None:
    vectors.fetch(array, index)


@pytest.mark.parametrize('index', [0, 3, -1, 10**15])
@pytest.mark.parametrize('dtype', [np.uint8, np.dtype([('a', np.float64, 20), ('b', np.int8)])])
def test_anything_can_be_asked_for(dtype: Any, index: int) -> None:
    array = np.zeros(4, dtype)
    ask(array, index)
    vectors.fetch_plain(array, index)
    assert array.tobytes() == bytes(array.nbytes)


@pytest.mark.compiled
def test_what_is_asked_for_is_asked_for() -> None:
    """All cache lines that an item may be in; nothing else shows that, but time."""
    ask(np.zeros(4, np.uint8), 0)
    ask(np.zeros(4, np.dtype([('a', np.float64, 11), ('b', np.int16)])), 0)
    calls = [text.count('call void @llvm.prefetch') for text in ask.inspect_llvm().values()]
    assert min(calls) == 1
    assert max(calls) >= 3


BOUNDS = """
import sys
import numba, numpy as np
from line_feature_node.core import vectors
@numba.njit
def load(array, index, target): vectors.store(target, 0, vectors.load(array, index))
@numba.njit
def store(array, index, target): vectors.store(array, index, vectors.load(target, 0))
@numba.njit
def pairs(array, index, target): vectors.store(target, 0, vectors.pairs(array, vectors.ramp(index))[0])
@numba.njit
def turn(array, index, target): vectors.transpose(array, index, 16, target, 0, 16)
array, target = np.zeros(256 + 32, np.float32), np.zeros(256, np.float32)
for function, last in ((load, 256), (store, 256), (pairs, 136), (turn, 32)):
    for index in (0, last):
        function(array, index, target)
    for index in (-1, last + 1):
        try:
            function(array, index, target)
        except IndexError:
            continue
        sys.exit(f'{function.__name__} at {index}')
"""


def test_bounds_of_vectors_are_checked_where_those_of_arrays_are(tmp_path: Path) -> None:
    root = str(Path(__file__).parents[1])
    run = subprocess.run([sys.executable, '-c', BOUNDS], capture_output=True, text=True, check=False, env=os.environ | {
        'NUMBA_BOUNDSCHECK': '1', 'NUMBA_DISABLE_JIT': '0', 'NUMBA_CACHE_DIR': str(tmp_path),
        'PYTHONPATH': os.pathsep.join([root, os.environ.get('PYTHONPATH', '')])})
    assert run.returncode == 0, run.stderr[-2000:]


@pytest.mark.parametrize(('start', 'step', 'target_start', 'target_step'), [
    (0, TILE, 0, TILE), (3, 29, 5, 17), (40, 64, 1, LANES), (0, 16, 128, 40),
])
def test_transpose(start: int, step: int, target_start: int, target_step: int) -> None:
    """Value k of row r becomes value r of row k, and nothing else is touched."""
    source = values(start + TILE * step)
    target, plain = values(1200, seed=1), values(1200, seed=1)
    turn(source, start, step, target, target_start, target_step)
    vectors.transpose_plain(source, start, step, plain, target_start, target_step)
    np.testing.assert_array_equal(target, plain)
    columns = np.arange(TILE)
    for row in range(TILE):
        np.testing.assert_array_equal(target[target_start + row + columns * target_step],
                                      source[start + row * step + columns])
    assert (target != values(1200, seed=1)).sum() == TILE * TILE


def picture() -> npt.NDArray[np.uint8]:
    """A bright quadrilateral on a dark ground, with a little noise."""
    y, x = np.mgrid[:24, :32]
    inside = np.clip(x - 0.2 * y - 5.3, 0, 1) * np.clip(26.6 - x - 0.1 * y, 0, 1) * np.clip(y - 0.1 * x - 3.2, 0, 1)
    return (60 + 120 * inside + np.random.default_rng(0).normal(0, 2, (24, 32))).astype(np.uint8)


@pytest.mark.parametrize('operator', ['deriche', 'sobel'])
def test_plain_python_gives_the_same_segments(operator: str, tmp_path: Path) -> None:
    """Without the compiler the plain twins take the place of the vectors, and find what these do."""
    np.save(tmp_path / 'image.npy', picture())
    program = ('import json, sys; import numpy as np; from line_feature_node.core import extract, vectors;'
               'assert vectors.transpose is vectors.transpose_plain and vectors.load is vectors.load_plain;'
               'found = extract(np.load(sys.argv[1]), operator=sys.argv[2], min_chain=4, T1=10, T2=4);'
               'print(json.dumps([[float(value) for value in segment] for segment in found.tolist()]))')
    root = str(Path(__file__).parents[1])
    environment = os.environ | {
        'NUMBA_DISABLE_JIT': '1', 'PYTHONPATH': os.pathsep.join([root, os.environ.get('PYTHONPATH', '')])}
    run = subprocess.run([sys.executable, '-c', program, str(tmp_path / 'image.npy'), operator], env=environment,
                         capture_output=True, text=True, check=False, timeout=120)
    assert run.returncode == 0, run.stderr
    expected = extract(picture(), operator=operator, min_chain=4, T1=10, T2=4)
    assert len(expected) >= 3
    np.testing.assert_allclose(json.loads(run.stdout), [list(segment) for segment in expected.tolist()], atol=1e-3,
                               rtol=1e-5)

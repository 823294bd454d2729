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
from line_feature_node.core.vectors import LANES, TILE

Floats = npt.NDArray[np.float32]


def values(size: int, seed: int = 0) -> Floats:
    return np.random.default_rng(seed).normal(0, 100, size).astype(np.float32)


@numba.njit
def move(source: Any, start: int, target: Any, target_start: int) -> None:
    vectors.store(target, target_start, vectors.load(source, start))


@numba.njit
def scale(factor: float, source: Any, start: int, target: Any) -> None:
    vectors.store(target, 0, vectors.multiply(factor, vectors.load(source, start)))


@numba.njit
def scale_and_add(factor: float, source: Any, start: int, summand: Any, target: Any) -> None:
    vectors.store(target, 0, vectors.multiply_add(factor, vectors.load(source, start), vectors.load(summand, 0)))


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
def test_multiply(factor: float) -> None:
    source, target = values(2 * LANES), np.zeros(LANES, np.float32)
    scale(np.float32(factor), source, 5, target)
    np.testing.assert_array_equal(target, vectors.multiply_plain(np.float32(factor), source[5:5 + LANES]))


@pytest.mark.parametrize('factor', [0.0, 1.0, -0.37, 1e-20, 3e20])
def test_multiply_add(factor: float) -> None:
    """Rounded once or twice: the two differ by a rounding of the product at most."""
    source, summand, target = values(2 * LANES), values(LANES, seed=1), np.zeros(LANES, np.float32)
    scale_and_add(np.float32(factor), source, 5, summand, target)
    vector = source[5:5 + LANES]
    plain = vectors.multiply_add_plain(np.float32(factor), vector, summand)
    rounding = np.finfo(np.float32).eps * (abs(np.float64(np.float32(factor)) * vector) + abs(summand))
    assert (abs(target.astype(np.float64) - plain) <= rounding).all()


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

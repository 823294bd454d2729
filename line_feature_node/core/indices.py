"""Pixels as flat indices into a padded image, row by row: one number each, and steps between neighbours constant."""

from typing import Any

import numpy as np

from line_feature_node.core.compiling import inlined, kernel


@inlined
def are_neighbours(a: int, b: int, stride: int) -> bool:
    """Whether two different pixels touch, given as flat indices."""
    step = abs(a - b)
    return step == 1 or (stride - 1 <= step <= stride + 1)


@inlined
def position(pixel: int, inverse: float, stride: int) -> tuple[Any, Any]:
    """Row and column of a flat index.

    The product replaces a slow division; half a pixel keeps it off whole numbers, where rounding would matter.
    """
    row = np.int32((pixel + 0.5) * inverse)
    return row, pixel - row * stride


@kernel
def place_pixels(pixels: Any, stride: int, margin: int, columns: Any, rows: Any) -> None:
    """Columns and rows of pixels: by themselves, as the compiler makes vectors of that."""
    inverse = 1 / stride
    for k in range(pixels.size):
        row, column = position(pixels[k], inverse, stride)
        columns[k], rows[k] = column - margin, row - margin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from line_feature_node.core.indices import are_neighbours, place_pixels, position


@settings(max_examples=300, deadline=None)
@given(st.integers(1, 2**30), st.data())
def test_position(stride: int, data: st.DataObject) -> None:
    """Row and column are exact in an image of 2^30 pixels, at either end of a row too."""
    row = data.draw(st.integers(0, 2**30 // stride - 1))
    for column in (0, stride - 1, data.draw(st.integers(0, stride - 1))):
        assert position(row * stride + column, 1 / stride, stride) == (row, column)


@pytest.mark.parametrize(('stride', 'margin'), [(8, 1), (648, 2), (2**20, 3)])
def test_pixels_in_their_places(stride: int, margin: int) -> None:
    rng = np.random.default_rng(stride)
    x, y = rng.integers(0, stride - 2 * margin, 99), rng.integers(0, 1000, 99)
    pixels = ((y + margin) * stride + x + margin).astype(np.int32)
    columns, rows = np.zeros(99, np.int32), np.zeros(99, np.int32)
    place_pixels(pixels, stride, margin, columns, rows)
    np.testing.assert_array_equal(columns, x)
    np.testing.assert_array_equal(rows, y)


@pytest.mark.parametrize('stride', [8, 16, 648])
def test_a_pixel_touches_eight_others(stride):
    pixel = 3 * stride + 4
    touching = {other - pixel for other in range(6 * stride) if other != pixel and are_neighbours(pixel, other, stride)}
    assert touching == {dx + dy * stride for dx in (-1, 0, 1) for dy in (-1, 0, 1)} - {0}

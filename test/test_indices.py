import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from line_feature_node.core.indices import are_neighbours, position


@settings(max_examples=300, deadline=None)
@given(st.integers(1, 2**30), st.data())
def test_position(stride: int, data: st.DataObject) -> None:
    """Row and column are exact in an image of 2^30 pixels, at either end of a row too."""
    row = data.draw(st.integers(0, 2**30 // stride - 1))
    for column in (0, stride - 1, data.draw(st.integers(0, stride - 1))):
        assert position(row * stride + column, 1 / stride, stride) == (row, column)


@pytest.mark.parametrize('stride', [8, 16, 648])
def test_a_pixel_touches_eight_others(stride):
    pixel = 3 * stride + 4
    touching = {other - pixel for other in range(6 * stride) if other != pixel and are_neighbours(pixel, other, stride)}
    assert touching == {dx + dy * stride for dx in (-1, 0, 1) for dy in (-1, 0, 1)} - {0}

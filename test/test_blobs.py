from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from line_feature_node.core.blobs import BLOB_DTYPE, Blobs, extract_blobs, join, paint
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.edges import CODE, OPEN
from line_feature_node.core.scanning import BRIDGED, TAKEN

Pixels = NDArray[np.int64]
#: dir, min_row, max_row, min_col, max_col and the pixels as (row, column).
Blob = tuple[int, int, int, int, int, tuple[tuple[int, int], ...]]


def raster(image: NDArray[np.uint8]) -> Pixels:
    return np.argwhere(image)


def backwards(image: NDArray[np.uint8]) -> Pixels:
    return np.argwhere(image)[::-1]


def columns(image: NDArray[np.uint8]) -> Pixels:
    return np.argwhere(image.T)[:, ::-1]


def shuffled(image: NDArray[np.uint8]) -> Pixels:
    return np.random.default_rng(image.size).permutation(np.argwhere(image))


def chains(image: NDArray[np.uint8]) -> Pixels:
    """From neighbour to neighbour of any code as long as there is one, then elsewhere."""
    left = {(int(row), int(column)) for row, column in np.argwhere(image)}
    order = []
    while left:
        pixel = min(left)
        while pixel:
            order.append(pixel)
            left.discard(pixel)
            row, column = pixel
            beside = [(row + i, column + j) for i in (1, 0, -1) for j in (1, -1, 0) if (row + i, column + j) in left]
            pixel = beside[0] if beside else None
    return np.array(order, np.int64).reshape(-1, 2)


ORDERS = [raster, backwards, columns, shuffled, chains]


def extract(
    image: NDArray[np.uint8], order: Callable[[NDArray[np.uint8]], Pixels] = raster, margin: int = 1,
    buffers: Buffers | None = None, filled: NDArray[np.bool_] | None = None,
) -> tuple[Blobs, Pixels]:
    """The blobs of a quintuple image, given as a list of pixels in some order; and that list, rows and columns."""
    pixels = order(image)
    shape = image.shape[0] + 2 * margin, image.shape[1] + 2 * margin
    flat = (pixels[:, 0] + margin) * shape[1] + pixels[:, 1] + margin
    codes = image[pixels[:, 0], pixels[:, 1]]
    bridged = np.zeros(len(flat), np.bool_) if filled is None else filled
    # What is no edge may have a code, as candidates that scanning did not reach have.
    marks = np.random.default_rng(image.size).choice(np.array([0, 3, OPEN | 1], np.uint8), shape)
    marks.reshape(-1)[flat] = np.where(bridged, TAKEN | BRIDGED, TAKEN)
    blobs = extract_blobs(flat.astype(np.int32), codes, bridged, marks, margin, buffers or Buffers())
    np.testing.assert_array_equal(marks.reshape(-1)[flat] & CODE, codes)
    return blobs, pixels


def listed(blobs: Blobs, pixels: Pixels) -> list[Blob]:
    """The blobs in use, comparable."""
    found = []
    all_members, offsets = blobs.members()
    for k, blob in enumerate(blobs.attributes):
        if blob['select']:
            members = pixels[all_members[offsets[k]:offsets[k + 1]]].tolist()
            assert blob['size'] == len(members)
            found.append((*(int(blob[name]) for name in ('dir', 'min_row', 'max_row', 'min_col', 'max_col')),
                          tuple(sorted((row, column) for row, column in members))))
    return sorted(found)


def reference(image: NDArray[np.uint8]) -> list[Blob]:
    """The connected components of each code by itself."""
    found = []
    for code in range(1, 5):
        count, labels = cv2.connectedComponents((image == code).astype(np.uint8), connectivity=8)
        for label in range(1, count):
            pixels = np.argwhere(labels == label)
            (top, left), (bottom, right) = pixels.min(0).tolist(), pixels.max(0).tolist()
            found.append((code, top, bottom, left, right, tuple((row, column) for row, column in pixels.tolist())))
    return sorted(found)


@pytest.mark.parametrize('order', ORDERS)
@pytest.mark.parametrize('density', [0.05, 0.3, 0.6, 1.0])
@pytest.mark.parametrize('shape', [(40, 53), (1, 90), (90, 1)])
def test_random_images(
    order: Callable[[NDArray[np.uint8]], Pixels], density: float, shape: tuple[int, int],
) -> None:
    rng = np.random.default_rng(round(density * 100))
    image = np.where(rng.random(shape) < density, rng.integers(1, 5, shape), 0).astype(np.uint8)
    assert listed(*extract(image, order)) == reference(image)


@settings(max_examples=150, deadline=None)
@given(arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.sampled_from([0, 1, 1, 2, 4])),
       st.randoms(use_true_random=False), st.integers(1, 3))
def test_any_order_of_the_pixels(image: NDArray[np.uint8], random: object, margin: int) -> None:
    def order(image: NDArray[np.uint8]) -> Pixels:
        pixels = np.argwhere(image).tolist()
        random.shuffle(pixels)
        return np.array(pixels, np.int64).reshape(-1, 2)

    assert listed(*extract(image, order, margin)) == reference(image)


def drawing(text: str) -> NDArray[np.uint8]:
    return np.array([[int(cell) if cell.isdigit() else 0 for cell in line] for line in text.split()], np.uint8)


@pytest.mark.parametrize('order', ORDERS)
@pytest.mark.parametrize('text', [
    # Labels that merge in the last row, all into one.
    '1.1.1.1.1 1.1.1.1.1 111111111',
    # A spiral, a comb upside down, and a checkerboard of diagonal neighbours.
    '1111111 ......1 11111.1 1...1.1 1.111.1 1.....1 1111111',
    '111111111 1.1.1.1.1 1.1.1.1.1',
    '1.1.1.1 .1.1.1. 1.1.1.1',
    # Two codes that cross diagonally: both are connected.
    '12 21',
    '2..2 .22. .11. 1..1',
    '4444 3333 4444 3333',
])
def test_shapes(order: Callable[[NDArray[np.uint8]], Pixels], text: str) -> None:
    image = drawing(text)
    assert listed(*extract(image, order)) == reference(image)


def test_attributes() -> None:
    image = drawing("""
        ........
        .33...1.
        ...33.1.
        ......1.
        ....1...
        """)
    blobs, _ = extract(image)
    used = np.sort(blobs.attributes[blobs.attributes['select']], order=['dir', 'size'])
    assert [tuple(int(blob[name]) for name in BLOB_DTYPE.names[:-1]) for blob in used] == [
        (1, 1, 4, 4, 4, 4), (1, 3, 1, 3, 6, 6), (3, 4, 1, 2, 1, 4)]


@pytest.mark.parametrize('order', ORDERS)
def test_members_are_a_partition(order: Callable[[NDArray[np.uint8]], Pixels]) -> None:
    rng = np.random.default_rng(3)
    image = rng.choice(np.array([0, 1, 1, 1, 2], np.uint8), (50, 50))
    blobs, pixels = extract(image, order)
    members, offsets = blobs.members()
    assert sorted(members.tolist()) == list(range(len(pixels)))
    assert offsets.size == blobs.attributes.size + 1
    assert offsets[0] == 0
    assert offsets[-1] == len(pixels)
    np.testing.assert_array_equal(np.diff(offsets), blobs.attributes['size'])


@pytest.mark.parametrize('order', ORDERS)
@pytest.mark.parametrize('margin', [1, 3])
def test_moments(order: Callable[[NDArray[np.uint8]], Pixels], margin: int) -> None:
    """Pixels that fill a gap do not count."""
    rng = np.random.default_rng(5)
    image = rng.choice(np.array([0, 1, 1, 1, 2], np.uint8), (40, 60))
    filled = rng.random(int((image > 0).sum())) < 0.2
    blobs, pixels = extract(image, order, margin, filled=filled)
    all_members, offsets = blobs.members()
    for label, (first, last) in enumerate(pairwise(offsets)):
        members = all_members[first:last]
        y, x = pixels[members[~filled[members]]].T
        assert blobs.moments[label].tolist() == [len(x), x.sum(), y.sum(), (x * x).sum(), (x * y).sum(), (y * y).sum()]


def test_labels_that_merged_are_empty() -> None:
    blobs, _ = extract(drawing('1.1.1 1.1.1 11111'))
    used = blobs.attributes['select']
    assert used.size > 1
    assert blobs.attributes['size'][used].tolist() == [11]
    assert not blobs.attributes['size'][~used].any()


def test_more_labels_than_a_byte_can_count_without_the_compiler() -> None:
    """Codes and marks are bytes, and Python computes in them where they are not turned into larger numbers."""
    stride, width = 680, 2 * 300
    pixels = (stride + 1 + np.arange(0, width, 2)).astype(np.int32)
    marks = np.zeros(3 * stride, np.uint8)
    marks[pixels] = TAKEN
    starts, follows, labels = np.zeros(301, np.int32), np.zeros(301, np.bool_), np.zeros(300, np.int32)
    plain_paint, plain_join = (getattr(kernel, 'py_func', kernel) for kernel in (paint, join))
    assert plain_paint(pixels, np.full(300, 4, np.uint8), stride, marks, starts, follows) == 300
    plain_join(pixels, stride, marks, starts, follows, np.zeros(marks.size, np.int32), np.zeros(300, np.int32), labels)
    assert labels.tolist() == list(range(300))


def test_no_pixels() -> None:
    blobs, _ = extract(np.zeros((5, 5), np.uint8))
    members, offsets = blobs.members()
    assert blobs.attributes.size == members.size == 0
    assert offsets.tolist() == [0]


def test_frame_after_frame() -> None:
    """Nothing is left of an image when the next one comes, larger or smaller, with the same memory."""
    buffers = Buffers()
    rng = np.random.default_rng(8)
    for shape in [(30, 40), (30, 40), (60, 50), (7, 9), (40, 30), (1, 1), (60, 50)]:
        image = rng.integers(0, 5, shape).astype(np.uint8)
        assert listed(*extract(image, shuffled, buffers=buffers)) == reference(image)


def test_moments_of_large_pictures_are_exact() -> None:
    """Also as plain Python, where whole numbers of 32 bits would overflow."""
    stride = 1936
    pixels = (1071 * stride + np.arange(1, 1901)).astype(np.int32)
    codes, bridged = np.full(1900, 3, np.uint8), np.zeros(1900, np.bool_)
    blobs = extract_blobs(pixels, codes, bridged, np.full((1082, stride), TAKEN, np.uint8), 1, Buffers())
    x, y = np.arange(1900, dtype=object), np.full(1900, 1070, dtype=object)
    assert blobs.moments.tolist() == [[1900, x.sum(), y.sum(), (x * x).sum(), (x * y).sum(), (y * y).sum()]]

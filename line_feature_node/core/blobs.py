"""Step 4, line-blob extraction: colouring of the quintuple image (section 2.2.3, Fig. 13)."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.indices import are_neighbours, position

#: The attributes of a line-blob, named as in Fig. 13. `select` says whether the label is in use: labels merge while
#: colouring, and one that merged into another is not. Rows and columns are those of the image.
BLOB_DTYPE = np.dtype([
    ('dir', np.int32), ('size', np.int32), ('min_row', np.int32), ('max_row', np.int32), ('min_col', np.int32),
    ('max_col', np.int32), ('select', np.bool_),
])


#: Sums of 1, x, y, x^2, x y and y^2 over the pixels of a blob: all that its line is computed from, (A.1) and (A.3).
MOMENTS = 6


class Blobs(NamedTuple):
    """Line-blobs. The arrays are the extractor's own: a frame's blobs end with the next frame.

    Attributes:
        attributes: BLOB_DTYPE, one for each label; those with ``select`` are blobs, the rest are empty.
        members: int32, for each blob its pixels, as indices into the list of edge pixels, one blob after the other:
            the linked NODEs of Fig. 13 as one array.
        offsets: int32, where each blob's members start; one more than there are labels.
        moments: N×MOMENTS float64, whole numbers: of each blob, without pixels that fill a gap.
    """

    attributes: NDArray[np.void]
    members: NDArray[np.int32]
    offsets: NDArray[np.int32]
    moments: NDArray[np.float64]


def extract_blobs(
    pixels: NDArray[np.int32], codes: NDArray[np.uint8], bridged: NDArray[np.bool_], shape: tuple[int, int],
    margin: int, buffers: Buffers,
) -> Blobs:
    """Group 8-connected edge pixels of one code.

    Args:
        pixels: Flat index of each edge pixel in the padded image; no pixel twice.
        codes: Code of each, 1 to 4: the quintuple image as the list of what is not background.
        bridged: Whether each fills a gap.
        shape: Rows and columns of the padded image.
        margin: Its padding on each side, one pixel at least.
        buffers: Memory to work in.
    """
    most, stride = pixels.size, shape[1]
    labels = buffers.array('labels', most, np.int32)
    parents = buffers.array('parents', most, np.int32)
    colours = buffers.array('colours', shape[0] * stride, np.int32, zeros=True)
    used = colour(pixels, codes, stride, colours, labels, parents)
    attributes = buffers.array('blobs', used, BLOB_DTYPE)[:used]
    members = buffers.array('members', most, np.int32)[:most]
    offsets = buffers.array('blob offsets', used + 1, np.int32)[:used + 1]
    moments = buffers.array('moments', MOMENTS * used, np.float64)[:MOMENTS * used].reshape(used, MOMENTS)
    collect(pixels, codes, stride, margin, labels, parents, attributes, members, offsets)
    sum_up(pixels, bridged, stride, margin, members, offsets, moments)
    return Blobs(attributes, members, offsets, moments)


def joined_blobs(parts: list[Blobs]) -> Blobs:
    """The blobs of all parts of one list of edge pixels, one after the other, in arrays of their own."""
    ends = np.cumsum([0] + [part.members.size for part in parts])
    starts = [part.offsets[:-1] + end for part, end in zip(parts, ends[:-1], strict=True)]
    return Blobs(np.concatenate([part.attributes for part in parts]), np.concatenate([part.members for part in parts]),
                 np.concatenate([*starts, ends[-1:]]).astype(np.int32),
                 np.concatenate([part.moments for part in parts]))


@inlined
def root(parents: Any, label: int) -> int:
    """The label that a label merged into at last, halving the way there for later."""
    while parents[label] != label:
        parents[label] = parents[parents[label]]
        label = parents[label]
    return label


@kernel
def colour(pixels: Any, codes: Any, stride: int, colours: Any, labels: Any, parents: Any) -> int:
    """Give the pixels labels, and merge those that meet: neighbours of one code share what their labels merge into.

    Pixels that follow each other in the list and are neighbours, as those of a chain are, share one from the start.
    Every pair of neighbours is then seen from one of its sides: the right, or the three below.
    """
    used = 0
    for k in range(pixels.size):
        if k == 0 or codes[k] != codes[k - 1] or not are_neighbours(pixels[k], pixels[k - 1], stride):
            parents[used] = used
            used += 1
        labels[k] = used - 1
        # A colour is 8 (label + 1) + code; 0 is background.
        colours[pixels[k]] = used << 3 | np.int64(codes[k])
    # Unsigned indices spare the test whether to count from the end.
    one, row = np.uint64(1), np.uint64(stride)
    for k in range(pixels.size):
        pixel = np.uint64(pixels[k])
        own, below = colours[pixel], pixel + row
        for neighbour in (pixel + one, below - one, below, below + one):
            found = colours[neighbour]
            if found != own and found & 7 == own & 7:
                a, b = root(parents, (own >> 3) - 1), root(parents, (found >> 3) - 1)
                parents[max(a, b)] = min(a, b)
    for k in range(pixels.size):
        colours[pixels[k]] = 0
    return used


@kernel
def collect(
    pixels: Any, codes: Any, stride: int, margin: int, labels: Any, parents: Any, blobs: Any, members: Any,
    offsets: Any,
) -> None:
    """Bring each pixel to its final label, and fill in the attributes and members of the blobs."""
    inverse = 1 / stride
    for label in range(blobs.size):
        parents[label] = parents[parents[label]]
        clear(blobs[label])
        blobs[label]['select'] = parents[label] == label
    for k in range(pixels.size):
        label = labels[k] = parents[labels[k]]
        row, column = position(pixels[k], inverse, stride)
        include(blobs[label], codes[k], row - margin, column - margin)
    total = 0
    for label in range(blobs.size):
        offsets[label] = total
        total += blobs[label]['size']
    for k in range(pixels.size):
        members[offsets[labels[k]]] = k
        offsets[labels[k]] += 1
    # Each offset has moved to where the next blob starts.
    for label in range(blobs.size, 0, -1):
        offsets[label] = offsets[label - 1]
    offsets[0] = 0


@inlined
def clear(blob: Any) -> None:
    """Empty a blob."""
    blob['dir'] = 0
    blob['size'] = 0
    blob['min_row'] = 2147483647
    blob['min_col'] = 2147483647
    blob['max_row'] = -1
    blob['max_col'] = -1


@inlined
def include(blob: Any, code: int, row: int, column: int) -> None:
    """Add a pixel to a blob."""
    blob['dir'] = code
    blob['size'] += 1
    blob['min_row'] = min(blob['min_row'], row)
    blob['max_row'] = max(blob['max_row'], row)
    blob['min_col'] = min(blob['min_col'], column)
    blob['max_col'] = max(blob['max_col'], column)


@kernel
def sum_up(
    pixels: Any, bridged: Any, stride: int, margin: int, members: Any, offsets: Any, moments: Any,
) -> None:
    """The moments of each blob."""
    inverse = 1 / stride
    for label in range(moments.shape[0]):
        n, sx, sy, sxx, sxy, syy = 0, 0, 0, 0, 0, 0
        for place in range(offsets[label], offsets[label + 1]):
            k = members[place]
            if bridged[k]:
                continue
            row, column = position(pixels[k], inverse, stride)
            x, y = int(column - margin), int(row - margin)
            n, sx, sy, sxx, sxy, syy = n + 1, sx + x, sy + y, sxx + x * x, sxy + x * y, syy + y * y
        put_down(moments, label, n, sx, sy, sxx, sxy, syy)


@inlined
def put_down(moments: Any, place: int, n: int, sx: int, sy: int, sxx: int, sxy: int, syy: int) -> None:
    """Put sums in their place."""
    moments[place, 0], moments[place, 1], moments[place, 2] = n, sx, sy
    moments[place, 3], moments[place, 4], moments[place, 5] = sxx, sxy, syy

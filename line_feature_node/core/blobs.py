"""Step 4, line-blob extraction: colouring of the quintuple image (section 2.2.3, Fig. 13)."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.edges import CODE
from line_feature_node.core.indices import are_neighbours, place_pixels
from line_feature_node.core.scanning import TAKEN

#: The attributes of a line-blob, named as in Fig. 13. `select` says whether the label is in use: labels merge while
#: colouring, and one that merged into another is not. Rows and columns are those of the image.
BLOB_DTYPE = np.dtype([
    ('dir', np.int32), ('size', np.int32), ('min_row', np.int32), ('max_row', np.int32), ('min_col', np.int32),
    ('max_col', np.int32), ('select', np.bool_),
])


#: Sums of 1, x, y, x^2, x y and y^2 over the pixels of a blob: all that its line is computed from, (A.1) and (A.3).
MOMENTS = 6
#: The bits of a mark that those of one blob share.
SAME = TAKEN | CODE


class Blobs(NamedTuple):
    """Line-blobs. The arrays are the extractor's own: a frame's blobs end with the next frame.

    The pixels of a blob are runs of the list of edge pixels: one where chains are divided into stretches, several where
    colouring joined them.

    Attributes:
        attributes: BLOB_DTYPE, one for each label; those with ``select`` are blobs, the rest are empty.
        moments: N×MOMENTS float64, whole numbers: of each blob, without pixels that fill a gap.
        starts, ends: int32, the first pixel of each run, as an index into the list of edge pixels, and the one behind
            its last.
        labels: int32, the label of each run.
    """

    attributes: NDArray[np.void]
    moments: NDArray[np.float64]
    starts: NDArray[np.int32]
    ends: NDArray[np.int32]
    labels: NDArray[np.int32]

    def members(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The pixels of each blob: the linked NODEs of Fig. 13 as one array.

        Returns:
            int32, indices into the list of edge pixels, one blob after the other; and where each blob's start among
            them, one more than there are labels.
        """
        runs = [np.arange(start, end, dtype=np.int32) for start, end in zip(self.starts, self.ends, strict=True)]
        runs = [runs[k] for k in np.argsort(self.labels, kind='stable')]
        return (np.concatenate([np.empty(0, np.int32), *runs]),
                np.cumsum([0, *self.attributes['size'].tolist()], dtype=np.int32))


def extract_blobs(
    pixels: NDArray[np.int32], codes: NDArray[np.uint8], bridged: NDArray[np.bool_], marks: NDArray[np.uint8],
    margin: int, buffers: Buffers,
) -> Blobs:
    """Group 8-connected edge pixels of one code.

    Args:
        pixels: Flat index of each edge pixel in the padded image; no pixel twice.
        codes: Code of each, 1 to 4.
        bridged: Whether each fills a gap.
        marks: The padded image, as edge scanning leaves it: edge pixels are TAKEN, and those listed have no code. They
            receive theirs, which makes it the quintuple image.
        margin: Its padding on each side, one pixel at least.
        buffers: Memory to work in.
    """
    most, stride = pixels.size, marks.shape[1]
    starts, flat = buffers.array('run starts', most + 1, np.int32), marks.reshape(-1)
    follows = buffers.array('follows', most + 1, np.bool_)
    used = paint(pixels, codes, stride, flat, starts, follows)
    columns, rows = buffers.array('pixel columns', most, np.int32), buffers.array('pixel rows', most, np.int32)
    place_pixels(pixels, stride, margin, columns, rows)
    attributes = buffers.array('blobs', used, BLOB_DTYPE)[:used]
    moments = buffers.array('moments', MOMENTS * used, np.float64)[:MOMENTS * used].reshape(used, MOMENTS)
    labels = buffers.array('labels', used, np.int32)[:used]
    describe_runs(codes, bridged, columns, rows, starts, attributes, moments)
    join(pixels, stride, flat, starts, follows, buffers.array('run of pixel', flat.size, np.int32),
         buffers.array('touching', most, np.int32), labels)
    gather(labels, attributes, moments)
    return Blobs(attributes, moments, starts[:used], starts[1:used + 1], labels)


def joined_blobs(parts: list[Blobs]) -> Blobs:
    """The blobs of all parts of one list of edge pixels, one after the other, in arrays of their own."""
    before = np.cumsum([0] + [part.attributes.size for part in parts])
    labels = [part.labels + count for part, count in zip(parts, before[:-1], strict=True)]
    together = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
    return Blobs(*together)._replace(labels=np.concatenate(labels).astype(np.int32))


@kernel
def paint(pixels: Any, codes: Any, stride: int, marks: Any, starts: Any, follows: Any) -> int:
    """Bring the codes into the image, and find the runs: pixels that follow each other and are neighbours of one code.

    Returns:
        The number of runs; each is a label.
    """
    used: Any = np.int64(0)
    for k in range(pixels.size):
        starts[used] = k
        follows[k] = (k > 0) & (codes[k] == codes[k - 1]) & are_neighbours(pixels[k], pixels[k - 1], stride)
        used += not follows[k]
        marks[np.uint64(pixels[k])] |= codes[k]
    starts[used], follows[pixels.size] = pixels.size, False
    return used


@kernel
def describe_runs(
    codes: Any, bridged: Any, columns: Any, rows: Any, starts: Any, blobs: Any, moments: Any,
) -> None:
    """The attributes and moments of each run."""
    for run in range(blobs.size):
        first, end = starts[run], starts[run + 1]
        put_down(moments, run, *moments_of(columns[first:end], rows[first:end], bridged[first:end]))
        describe(columns[first:end], rows[first:end], codes[first], blobs[run])


@inlined
def moments_of(columns: Any, rows: Any, bridged: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
    """The moments of pixels; filled gaps don't count."""
    n, sx, sy, sxx, sxy, syy = 0, 0, 0, 0, 0, 0
    for k in range(columns.size):
        there = np.int64(1) - bridged[k]
        x, y = np.int64(columns[k]), np.int64(rows[k])
        n, sx, sy = n + there, sx + there * x, sy + there * y
        sxx, sxy, syy = sxx + there * x * x, sxy + there * x * y, syy + there * y * y
    return n, sx, sy, sxx, sxy, syy


@inlined
def put_down(moments: Any, place: int, n: Any, sx: Any, sy: Any, sxx: Any, sxy: Any, syy: Any) -> None:
    """Put sums in their place."""
    moments[place, 0], moments[place, 1], moments[place, 2] = n, sx, sy
    moments[place, 3], moments[place, 4], moments[place, 5] = sxx, sxy, syy


@inlined
def describe(columns: Any, rows: Any, code: int, blob: Any) -> None:
    """Fill in the attributes of pixels whose code is given."""
    left, right, top, bottom = columns[0], columns[0], rows[0], rows[0]
    for k in range(columns.size):
        left, right = min(left, columns[k]), max(right, columns[k])
        top, bottom = min(top, rows[k]), max(bottom, rows[k])
    blob['dir'], blob['select'], blob['size'] = code, True, columns.size
    blob['min_row'], blob['max_row'], blob['min_col'], blob['max_col'] = top, bottom, left, right


@kernel
def join(
    pixels: Any, stride: int, marks: Any, starts: Any, follows: Any, run_of: Any, touching: Any, labels: Any,
) -> None:
    """Join the labels of runs that touch: neighbours of one code share what their labels merge into.

    Most pixels have no neighbours of their code but those before and after them in their run, so first those are found
    that have more, and only these have their runs in an image. What touches them is among them.
    """
    for run in range(labels.size):
        labels[run] = run
    count = np.int64(0)
    for k in range(pixels.size):
        touching[count] = k
        count += neighbours_alike(marks, pixels[k], stride) != np.int64(follows[k]) + follows[k + 1]
    run = 0
    for place in range(count):
        while starts[run + 1] <= touching[place]:
            run += 1
        run_of[pixels[touching[place]]] = run
    for place in range(count):
        k = touching[place]
        before = pixels[k - 1] if follows[k] else -1
        after = pixels[k + 1] if follows[k + 1] else -1
        join_with_neighbours(pixels[k], before, after, marks, stride, run_of, labels)
    # A label merges into lower ones only.
    for run in range(labels.size):
        labels[run] = labels[labels[run]]


@inlined
def neighbours_alike(marks: Any, pixel: int, stride: int) -> int:
    """How many of the eight neighbours of a pixel are edges of its code."""
    middle, row, one = np.uint64(pixel), np.uint64(stride), np.uint64(1)
    above, below, own = middle - row, middle + row, marks[middle] & SAME
    return (is_alike(marks, above - one, own) + is_alike(marks, above, own) + is_alike(marks, above + one, own)
            + is_alike(marks, middle - one, own) + is_alike(marks, middle + one, own)
            + is_alike(marks, below - one, own) + is_alike(marks, below, own) + is_alike(marks, below + one, own))


@inlined
def is_alike(marks: Any, pixel: Any, own: int) -> Any:
    """1 where a pixel is an edge of a code, else 0."""
    return np.int64(marks[pixel] & SAME == own)


@inlined
def join_with_neighbours(
    pixel: int, before: int, after: int, marks: Any, stride: int, run_of: Any, labels: Any,
) -> None:
    """Join the run of a pixel with those of its neighbours, but for the pixels before and after it.

    Every pair of neighbours is seen from both, so that one of its sides will do: the right, and the three below.
    """
    own = marks[pixel] & SAME
    for neighbour in (pixel + 1, pixel + stride - 1, pixel + stride, pixel + stride + 1):
        if marks[neighbour] & SAME == own and neighbour != before and neighbour != after:
            a, b = root(labels, run_of[pixel]), root(labels, run_of[neighbour])
            labels[max(a, b)] = min(a, b)


@inlined
def root(labels: Any, label: int) -> int:
    """The label that a label merged into at last, halving the way there for later."""
    while labels[label] != label:
        labels[label] = labels[labels[label]]
        label = labels[label]
    return label


@kernel
def gather(labels: Any, blobs: Any, moments: Any) -> None:
    """Add each run to the one that its label merged into, and empty it."""
    for run in range(labels.size):
        label = labels[run]
        if label == run:
            continue
        add(blobs[run], blobs[label])
        clear(blobs[run])
        for k in range(MOMENTS):
            moments[label, k] += moments[run, k]
            moments[run, k] = 0


@inlined
def add(part: Any, blob: Any) -> None:
    """Add the attributes of a part to those of a blob."""
    blob['size'] += part['size']
    blob['min_row'] = min(blob['min_row'], part['min_row'])
    blob['max_row'] = max(blob['max_row'], part['max_row'])
    blob['min_col'] = min(blob['min_col'], part['min_col'])
    blob['max_col'] = max(blob['max_col'], part['max_col'])


@inlined
def clear(blob: Any) -> None:
    """Empty a blob."""
    blob['dir'], blob['size'], blob['select'] = 0, 0, False
    blob['min_row'], blob['min_col'] = 2147483647, 2147483647
    blob['max_row'], blob['max_col'] = -1, -1

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_features import blobs_of

from line_feature_node.core.blobs import BLOB_DTYPE
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.features import LINE_DTYPE, compute_lines, segments_of
from line_feature_node.core.linking import adjacent, collinear, link_lines, merge, nearest_ends, overlapped
from line_feature_node.core.parameters import Parameters

Pixel = tuple[int, int]
Piece = frozenset[Pixel]

SHAPE = (400, 600)


def piece(x1: int, y1: int, x2: int, y2: int) -> Piece:
    """The pixels of a digital straight line."""
    steps = max(abs(x2 - x1), abs(y2 - y1))
    return frozenset((x1 + math.floor((x2 - x1) * k / steps + 0.5), y1 + math.floor((y2 - y1) * k / steps + 0.5))
                     for k in range(steps + 1))


def lines_of(
    pieces: list[Piece], codes: list[int] | None = None, shape: tuple[int, int] = SHAPE, **parameters: Any,
) -> tuple[NDArray[np.void], int]:
    """The lines of line-blobs that are given as their pixels, with room for linking."""
    pixels = np.array([pixel for blob in pieces for pixel in sorted(blob)], np.int64).reshape(-1, 2)
    offsets = np.cumsum([0] + [len(blob) for blob in pieces]).astype(np.int32)
    attributes = np.zeros(len(pieces), BLOB_DTYPE)
    for k, blob in enumerate(pieces):
        x, y = zip(*blob, strict=True)
        attributes[k] = (codes[k] if codes else 3, len(blob), min(y), max(y), min(x), max(x), True)
    return computed(attributes, pixels, offsets, shape, **parameters)


def computed(
    attributes: NDArray[np.void], pixels: NDArray[np.int64], offsets: NDArray[np.int32], shape: tuple[int, int],
    **parameters: Any,
) -> tuple[NDArray[np.void], int]:
    return compute_lines(blobs_of(attributes, pixels, offsets, np.zeros(len(pixels), np.bool_)), shape,
                         Parameters(**{'min_size': 2, **parameters}), Buffers())


def line(*ends: int) -> Any:
    """The line of a digital straight line between two points."""
    lines, count = lines_of([piece(*ends)])
    assert count == 1
    return lines[0]


def link(
    pieces: list[Piece], codes: list[int] | None = None, shape: tuple[int, int] = SHAPE, **parameters: Any,
) -> NDArray[np.void]:
    """What is left of the lines of some pieces, with the codes that they begin with."""
    lines, count = lines_of(pieces, codes, shape, **parameters)
    alive = link_lines(lines, count, shape, Parameters(**{'min_size': 2, **parameters}), Buffers())
    return lines[:alive.size][alive]


def comparable(lines: Any) -> list[tuple[float, ...]]:
    return sorted(tuple(record) for record in lines.tolist())


def linkable(first: Any, second: Any, tau1: float, tau2: float) -> bool:
    return collinear(first, second, tau1) and not overlapped(first, second) and adjacent(first, second, tau2)


def coordinates(record: Any) -> tuple[float, ...]:
    return tuple(float(record[name]) for name in ('y', 'x', 'y1', 'x1', 'y2', 'x2', 'n'))


def reference(
    pieces: list[Piece], codes: list[int], tau1: float, tau2: float, shape: tuple[int, int] = SHAPE, **parameters: Any,
) -> list[tuple[float, ...]]:
    """Links, as long as there is one, the linkable pair whose ends are nearest, from the pixels of both."""
    def record(pixels: list[Pixel], code: int) -> Any:
        stack = np.array(pixels)
        (left, top), (right, bottom) = stack.min(0), stack.max(0)
        attributes = np.array([(code, len(pixels), top, bottom, left, right, True)], BLOB_DTYPE)
        lines, count = computed(attributes, stack, np.array([0, len(pixels)], np.int32), shape, **parameters)
        return lines[0] if count else None

    left: dict[int, tuple[list[Pixel], int, Any]] = {}
    pairs: list[tuple[Any, ...]] = []

    def add(name: int, pixels: list[Pixel], code: int, new: Any) -> None:
        for other, (_, _, old) in left.items():
            if linkable(new, old, tau1, tau2):
                pairs.append((nearest_ends(new, old)[0], *sorted([coordinates(new), coordinates(old)]), name, other))
        left[name] = pixels, code, new

    for name, (pixels, code) in enumerate(zip(pieces, codes, strict=True)):
        new = record(sorted(pixels), code)
        if new is not None:
            add(name, sorted(pixels), code, new)
    for name in itertools.count(len(pieces)):
        pairs = sorted(pair for pair in pairs if pair[-1] in left and pair[-2] in left)
        if not pairs:
            return sorted(tuple(old.tolist()) for _, _, old in left.values())
        first, second = pairs.pop(0)[-2:]
        (pixels1, code1, _), (pixels2, code2, _) = left[first], left[second]
        larger = max((len(pixels1), -code1), (len(pixels2), -code2))
        union = record(pixels1 + pixels2, -larger[1])
        if union is not None:
            del left[first], left[second]
            add(name, pixels1 + pixels2, -larger[1], union)
    raise AssertionError


def broken_lines(rng: np.random.Generator, count: int, size: int = 160) -> tuple[list[Piece], list[int]]:
    """Pieces of a few lines, not all quite on them, with gaps and overlaps between them."""
    pieces: list[Piece] = []
    while len(pieces) < count:
        angle, x, y = rng.uniform(0, math.pi), *rng.uniform(10, size - 10, 2)
        along = rng.uniform(-60, -10)
        while along < 60 and len(pieces) < count:
            length = rng.integers(3, 15)
            beside = rng.choice([0, 0, 0, 1, -1])
            cos, sin = math.cos(angle), math.sin(angle)
            ends = [(x + t * cos - beside * sin, y + t * sin + beside * cos) for t in (along, along + length)]
            whole = [round(value) for end in ends for value in end]
            if all(0 <= value < size for value in whole) and whole[:2] != whole[2:]:
                pieces.append(piece(*whole))
            along += length + rng.integers(-1, 8)
    pieces = list(dict.fromkeys(pieces))
    return pieces, rng.integers(1, 5, len(pieces)).tolist()


ENDS = st.tuples(*[st.integers(100, 140)] * 4).filter(lambda ends: ends[:2] != ends[2:])


def across(first: Any, second: Any) -> float:
    """Distance from the mid-point of the first line to the second, by its end points."""
    x1, y1, x2, y2 = (float(second[name]) for name in ('x1', 'y1', 'x2', 'y2'))
    x, y = float(first['x']), float(first['y'])
    return abs((x2 - x1) * (y1 - y) - (x1 - x) * (y2 - y1)) / math.hypot(x2 - x1, y2 - y1)


@settings(max_examples=300, deadline=None)
@given(ENDS, ENDS, st.floats(0.1, 20))
def test_definition_1(a: tuple[int, ...], b: tuple[int, ...], tau1: float) -> None:
    first, second = line(*a), line(*b)
    expected = max(across(first, second), across(second, first))
    assume(abs(expected - tau1) > 1e-9)
    assert collinear(first, second, tau1) == (expected < tau1)
    assert collinear(second, first, tau1) == (expected < tau1)


def test_collinear_is_strict() -> None:
    first, second = line(10, 10, 20, 10), line(30, 12, 40, 12)
    assert not collinear(first, second, 2.0)
    assert collinear(first, second, np.nextafter(2.0, 3))


def test_both_mid_points_must_be_near() -> None:
    """The mid-point of a short tilted line lies on the long one, whose mid-point is far from it."""
    long, short = line(10, 50, 110, 50), line(115, 48, 119, 52)
    assert across(short, long) == 0
    assert not collinear(long, short, 5.0)
    assert not collinear(short, long, 5.0)


def literal_p3(first: Any, second: Any) -> NDArray[np.float64] | None:
    """Where L3, orthogonal to the first line in its mid-point, meets the second line."""
    u, p1 = np.array([first['cos'], first['sin']]), np.array([first['x'], first['y']])
    start, end = np.array([second['x1'], second['y1']]), np.array([second['x2'], second['y2']])
    along = end - start
    if abs(u @ along) < 1e-9 * np.hypot(*along):
        return None
    return start + along * (u @ (p1 - start)) / (u @ along)


@settings(max_examples=500, deadline=None)
@given(ENDS, ENDS)
def test_definition_2(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    """P3 in the rectangle, up to rounding; either way round, as the text doesn't say which line is L1."""
    first, second = line(*a), line(*b)
    expected = False
    for one, other in ((first, second), (second, first)):
        p3 = literal_p3(one, other)
        if p3 is not None:
            corners = np.array([[other['x1'], other['y1']], [other['x2'], other['y2']]])
            inside = np.minimum(p3 - corners.min(0), corners.max(0) - p3)
            longer = int(np.ptp(corners, 0).argmax())
            assume(abs(inside[longer]) > 1e-6)
            expected |= bool((inside > -1e-6).all())
    assert overlapped(first, second) == expected
    assert overlapped(second, first) == expected


@pytest.mark.parametrize(('a', 'b', 'expected'), [
    # End to end, side by side, and one behind the other's end.
    ((10, 10, 20, 10), (22, 10, 40, 10), False),
    ((10, 10, 20, 10), (10, 12, 20, 12), True),
    ((10, 10, 20, 10), (18, 12, 28, 12), False),
    # The normal of the short one meets the long one, not the other way round.
    ((10, 10, 60, 10), (50, 12, 58, 12), True),
    # The rectangle's border belongs to it: the mid-point of the first is at column 15.
    ((10, 10, 20, 10), (15, 10, 40, 10), True),
    ((10, 10, 20, 10), (16, 10, 40, 10), False),
    ((10, 10, 10, 20), (12, 15, 12, 40), True),
    ((10, 10, 10, 20), (12, 16, 12, 40), False),
    ((10, 10, 20, 20), (30, 30, 40, 40), False),
    ((10, 10, 20, 20), (12, 10, 22, 20), True),
    # L3 is parallel to L2, on it or beside it.
    ((10, 10, 20, 10), (15, 0, 15, 30), False),
    ((10, 10, 20, 10), (15, 12, 15, 30), False),
    ((10, 10, 20, 10), (80, 12, 80, 30), False),
    ((10, 10, 20, 20), (20, 10, 10, 20), False),
])
def test_overlapped(a: tuple[int, ...], b: tuple[int, ...], expected: bool) -> None:
    assert overlapped(line(*a), line(*b)) == expected
    assert overlapped(line(*b), line(*a)) == expected


@settings(max_examples=200, deadline=None)
@given(ENDS, st.integers(100, 140), st.booleans())
def test_rectangle_without_width(ends: tuple[int, ...], where: int, transposed: bool) -> None:
    """P3 on a horizontal or vertical L2 is never lost by rounding: its rectangle is a line."""
    if transposed:
        first, second = line(ends[1], ends[0], ends[3], ends[2]), line(where, 0, where, 399)
    else:
        first, second = line(*ends), line(0, where, 399, where)
    p3 = literal_p3(first, second)
    if p3 is None:
        assert not overlapped(first, second)
    else:
        where_along = float(p3[1 if transposed else 0])
        assume(0.001 < where_along < 398.999)
        assert overlapped(first, second)


@settings(max_examples=300, deadline=None)
@given(ENDS, ENDS, st.floats(0, 40))
def test_definition_3(a: tuple[int, ...], b: tuple[int, ...], tau2: float) -> None:
    first, second = line(*a), line(*b)
    expected = min(math.dist(p, q) for p in ((first['x1'], first['y1']), (first['x2'], first['y2']))
                   for q in ((second['x1'], second['y1']), (second['x2'], second['y2'])))
    assume(abs(expected - tau2) > 1e-9)
    assert adjacent(first, second, tau2) == (expected < tau2)
    assert adjacent(second, first, tau2) == (expected < tau2)
    gap, ends = nearest_ends(first, second)
    assert gap == pytest.approx(expected, abs=1e-12)
    p, q = (first['x1'], first['y1']), (second['x1'], second['y1'])
    if ends // 2:
        p = first['x2'], first['y2']
    if ends % 2:
        q = second['x2'], second['y2']
    assert math.dist(p, q) == pytest.approx(gap, abs=1e-12)


@pytest.mark.parametrize(('a', 'b', 'gap'), [
    ((10, 10, 20, 10), (26, 10, 36, 10), 6.0),
    ((10, 10, 10, 20), (10, 26, 10, 36), 6.0),
    ((10, 10, 20, 10), (24, 13, 34, 13), 5.0),
])
def test_adjacent_is_strict(a: tuple[int, ...], b: tuple[int, ...], gap: float) -> None:
    assert not adjacent(line(*a), line(*b), gap)
    assert adjacent(line(*a), line(*b), np.nextafter(gap, 100))


@pytest.mark.parametrize('order', [1, -1])
@pytest.mark.parametrize(('a', 'b', 'tau1', 'tau2', 'count'), [
    ((10, 10, 20, 10), (24, 10, 34, 10), 1.0, 6.0, 1),
    ((10, 10, 20, 10), (24, 12, 34, 12), 1.0, 6.0, 2),      # not collinear
    ((10, 10, 20, 10), (24, 12, 34, 12), 2.1, 6.0, 1),
    ((10, 10, 20, 10), (24, 12, 34, 12), 2.0, 6.0, 2),      # tau1 is strict
    ((10, 10, 20, 10), (26, 10, 36, 10), 1.0, 6.0, 2),      # tau2 is strict
    ((10, 10, 20, 10), (26, 10, 36, 10), 1.0, 6.01, 1),
    ((10, 10, 20, 10), (50, 10, 60, 10), 1.0, 6.0, 2),      # not adjacent
    ((10, 10, 40, 10), (10, 11, 40, 11), 5.0, 6.0, 2),      # overlapped
    ((10, 10, 40, 10), (32, 11, 42, 11), 5.0, 6.0, 2),      # overlapped one way round
    ((10, 10, 20, 10), (22, 12, 22, 22), 4.0, 6.0, 2),      # a corner is not collinear
    ((10, 10, 20, 20), (22, 22, 30, 30), 1.0, 6.0, 1),
    ((10, 20, 20, 10), (22, 8, 30, 0), 1.0, 6.0, 1),
    ((10, 10, 10, 30), (10, 33, 10, 50), 1.0, 6.0, 1),
    ((10, 10, 30, 20), (33, 21, 55, 32), 1.0, 6.0, 1),
])
def test_pairs(a: tuple[int, ...], b: tuple[int, ...], tau1: float, tau2: float, count: int, order: int) -> None:
    assert link([piece(*a), piece(*b)][::order], tau1=tau1, tau2=tau2).size == count


@pytest.mark.parametrize(('tau1', 'tau2'), [(0.0, 100.0), (20.0, 0.0), (0.0, 0.0)])
def test_tau_of_0_links_nothing(tau1: float, tau2: float) -> None:
    pieces = [piece(x, 10, x + 8, 10) for x in range(0, 90, 9)] + [piece(9, 30, 20, 30), piece(20, 30, 40, 30)]
    assert link(pieces, tau1=tau1, tau2=tau2).size == len(pieces)


@pytest.mark.parametrize('orientation', ['principal_axis', 'least_squares'])
@pytest.mark.parametrize(('a', 'b'), [
    ((10, 10, 20, 10), (23, 11, 40, 11)),
    ((10, 10, 30, 20), (33, 21, 55, 32)),
    ((10, 10, 11, 40), (11, 43, 13, 80)),
    ((20, 90, 60, 50), (63, 46, 70, 39)),
])
def test_merged_line_is_that_of_the_pixels_of_both(a: tuple[int, ...], b: tuple[int, ...], orientation: str) -> None:
    one, other = piece(*a), piece(*b)
    [merged] = link([one, other], [1, 3], orientation=orientation, tau1=2.0, tau2=20.0)
    [union] = lines_of([one | other], [1 if len(one) > len(other) else 3], orientation=orientation)[0][:1]
    assert merged.tolist() == union.tolist()
    x, y = np.array(sorted(one | other), np.float64).T
    assert (merged['x'], merged['y']) == pytest.approx((x.mean(), y.mean()))
    assert merged['n'] == len(one) + len(other)


@pytest.mark.parametrize('order', [1, -1])
@pytest.mark.parametrize(('lengths', 'codes', 'expected'), [
    ((10, 20), (1, 3), 3), ((20, 10), (1, 3), 1), ((20, 10), (4, 2), 4), ((21, 20), (4, 2), 4),
])
def test_code_of_the_larger_part(
    lengths: tuple[int, int], codes: tuple[int, int], expected: int, order: int,
) -> None:
    pieces = [piece(10, 10, 10 + lengths[0] - 1, 10), piece(40, 10, 40 + lengths[1] - 1, 10)]
    [merged] = link(pieces[::order], list(codes)[::order], tau2=50.0)
    assert merged['code'] == expected


def test_merge_does_not_depend_on_the_order() -> None:
    lines, _ = lines_of([piece(10, 10, 20, 10), piece(22, 11, 32, 11)], [4, 2])
    merged = np.zeros(2, LINE_DTYPE)
    assert merge(lines[0], lines[1], merged[0], False, 400.0, 600.0)
    assert merge(lines[1], lines[0], merged[1], False, 400.0, 600.0)
    assert merged[0].tobytes() == merged[1].tobytes()


def test_union_without_direction_is_no_line() -> None:
    """Four pixels in the corners of a square, as two lines."""
    lines, _ = lines_of([piece(10, 10, 11, 10), piece(10, 11, 11, 11)])
    assert not merge(lines[0], lines[1], np.zeros(1, LINE_DTYPE)[0], False, 400.0, 600.0)


@pytest.mark.parametrize('order', list(itertools.permutations(range(3))))
def test_three_pieces_become_one_line(order: tuple[int, ...]) -> None:
    pieces = [piece(10, 20, 40, 30), piece(43, 31, 70, 40), piece(73, 41, 100, 50)]
    [merged] = link([pieces[k] for k in order])
    [union] = lines_of([frozenset().union(*pieces)])[0][:1]
    assert merged.tolist() == union.tolist()


@pytest.mark.parametrize('order', list(itertools.permutations(range(3))))
def test_merged_lines_come_back_into_the_queue(order: tuple[int, ...]) -> None:
    """The third piece can be linked with neither of the others, only with what becomes of them."""
    pieces = [
        frozenset((x, 10) for x in range(14, 20)),
        frozenset([(21, 10), (22, 10), (23, 11), (24, 11)]),
        frozenset((x, 10) for x in range(26, 34)),
    ]
    a, b, c = lines_of(pieces)[0][:3]
    assert linkable(a, b, 2.0, 6.0)
    assert not linkable(b, c, 2.0, 6.0)
    assert not linkable(a, c, 2.0, 6.0)
    assert link([pieces[k] for k in order], tau1=2.0, tau2=6.0).size == 1


@pytest.mark.parametrize('nearer', [9, 11])
@pytest.mark.parametrize('order', list(itertools.permutations(range(3))))
def test_nearer_pair_is_linked_first(nearer: int, order: tuple[int, ...]) -> None:
    """Two lines that overlap each other both continue a third: the nearer one does."""
    pieces = [piece(10, 10, 40, 10), piece(42, nearer, 60, nearer), piece(44, 20 - nearer, 60, 20 - nearer)]
    left = link([pieces[k] for k in order], tau1=1.5, tau2=6.0)
    assert sorted(left['n'].tolist()) == [17, 50]
    assert left[left['n'] == 17]['y'] == 20 - nearer


@pytest.mark.parametrize('beside', [9, 11])
def test_ties_do_not_depend_on_the_order(beside: int) -> None:
    """The middle one is as near to the left as to the right one, and linked with one it leaves the other's line.

    It is linked with the left one, whose coordinates come first.
    """
    pieces = [piece(10, beside, 20, beside), piece(23, 10, 33, 10), piece(36, beside, 46, beside)]
    left, middle, right = lines_of(pieces)[0][:3]
    assert nearest_ends(left, middle)[0] == nearest_ends(middle, right)[0]
    assert linkable(left, middle, 1.2, 6.0)
    assert linkable(middle, right, 1.2, 6.0)
    results = [comparable(link([pieces[k] for k in order], tau1=1.2, tau2=6.0))
               for order in itertools.permutations(range(3))]
    assert len(results[0]) == 2
    assert all(result == results[0] for result in results)
    assert link(pieces, tau1=1.2, tau2=6.0)['x'].max() == 41


@pytest.mark.parametrize('transposed', [False, True])
def test_lines_beside_the_border(transposed: bool) -> None:
    """Their ends are in the grid too, whether or not the image is a whole number of cells wide."""
    for height, width in [(16, 64), (17, 65), (15, 63), (1, 64)]:
        pieces = [piece(x, y, x + 5, y) for y in {0, height - 1} for x in range(0, width - 5, 8)]
        shape = height, width
        if transposed:
            pieces, shape = [frozenset((y, x) for x, y in blob) for blob in pieces], (width, height)
        assert link(pieces, shape=shape).size == len({0, height - 1})


def test_no_lines() -> None:
    assert link([]).size == 0
    assert link([piece(1, 1, 9, 1)]).size == 1


def test_dashes() -> None:
    """All gaps of a dashed line are equal; it becomes one line, of the pixels of all."""
    rng = np.random.default_rng(1)
    pieces = [piece(8 * k, 3, 8 * k + 4, 3) for k in range(2000)]
    [merged] = link([pieces[k] for k in rng.permutation(2000)], shape=(7, 16000))
    assert merged['n'] == 10000
    assert [float(merged[name]) for name in ('x1', 'y1', 'x2', 'y2')] == [0, 3, 8 * 1999 + 4, 3]


SETTINGS = [(1.0, 6.0), (2.0, 12.0), (0.5, 3.0), (4.0, 30.0), (20.0, 100.0)]


@pytest.mark.parametrize(('tau1', 'tau2'), SETTINGS)
@pytest.mark.parametrize('seed', range(6))
def test_as_brute_force(tau1: float, tau2: float, seed: int) -> None:
    """Of all linkable pairs the one with the nearest ends, again and again; ties by coordinates."""
    pieces, codes = broken_lines(np.random.default_rng(seed), 45)
    shape = (160, 160)
    parameters: dict[str, Any] = {'orientation': 'least_squares'} if seed == 5 else {}
    left = link(pieces, codes, shape, tau1=tau1, tau2=tau2, **parameters)
    assert comparable(left) == reference(pieces, codes, tau1, tau2, shape, **parameters)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*[st.integers(0, 12)] * 4).filter(lambda ends: ends[:2] != ends[2:]), max_size=9),
       st.sampled_from(SETTINGS))
def test_as_brute_force_in_a_small_image(ends: list[tuple[int, ...]], taus: tuple[float, float]) -> None:
    """Many ties, and lines that cross."""
    pieces = list(dict.fromkeys(piece(*quadruple) for quadruple in ends))
    codes = [1 + k % 4 for k in range(len(pieces))]
    left = link(pieces, codes, (13, 13), tau1=taus[0], tau2=taus[1])
    assert comparable(left) == reference(pieces, codes, *taus, (13, 13))


def test_more_pairs_than_lines() -> None:
    """Nearly every pair of lines that point anywhere can be linked when the thresholds let it."""
    rng = np.random.default_rng(4)
    pieces = list(dict.fromkeys(piece(x, y, x + dx, y + dy) for x, y, dx, dy in zip(
        *rng.integers(5, 150, (2, 90)), *rng.integers(1, 5, (2, 90)), strict=True)))
    lines, count = lines_of(pieces)
    pairs = sum(linkable(lines[i], lines[j], 20.0, 100.0) for i in range(count) for j in range(i))
    assert pairs > 4 * count
    left = link(pieces, tau1=20.0, tau2=100.0)
    assert comparable(left) == reference(pieces, [3] * len(pieces), 20.0, 100.0)


@pytest.mark.compiled
@pytest.mark.parametrize(('tau1', 'tau2'), SETTINGS)
@pytest.mark.parametrize('seed', range(5))
def test_order_of_the_lines_does_not_matter(tau1: float, tau2: float, seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    pieces, codes = broken_lines(rng, 200, 400)
    if seed == 0:
        # A pattern in which every gap is tied.
        pieces = [piece(x, y, x + 4, y) for x in range(3, 150, 8) for y in range(3, 60, 2)]
        codes = [1 + (x * y) % 4 for x in range(3, 150, 8) for y in range(3, 60, 2)]
    results = []
    for _ in range(4):
        order = rng.permutation(len(pieces))
        left = link([pieces[k] for k in order], [codes[k] for k in order], tau1=tau1, tau2=tau2)
        segments = segments_of(left, np.ones(left.size, np.bool_))
        results.append((comparable(left), sorted(segment.tobytes() for segment in segments)))
    assert all(result == results[0] for result in results)


@pytest.mark.compiled
@pytest.mark.parametrize(('tau1', 'tau2'), SETTINGS)
def test_nothing_is_left_to_link_and_no_pixel_is_lost(tau1: float, tau2: float) -> None:
    pieces, codes = broken_lines(np.random.default_rng(77), 250, 350)
    lines, count = lines_of(pieces, codes)
    left = link(pieces, codes, tau1=tau1, tau2=tau2)
    assert left.size < count
    for name in ('n', 'sx', 'sy', 'sxx', 'sxy', 'syy'):
        assert left[name].sum() == lines[:count][name].sum()
    for first, second in itertools.combinations(left, 2):
        if linkable(first, second, tau1, tau2):
            assert not merge(first, second, np.zeros(1, LINE_DTYPE)[0], False, 400.0, 600.0)


def test_memory_of_the_last_frame_does_not_matter() -> None:
    buffers = Buffers()
    for seed, count in [(1, 100), (2, 30), (3, 160)]:
        pieces, codes = broken_lines(np.random.default_rng(seed), count, 300)
        lines, found = lines_of(pieces, codes)
        alive = link_lines(lines, found, SHAPE, Parameters(), buffers)
        assert comparable(lines[:alive.size][alive]) == comparable(link(pieces, codes))


@pytest.mark.compiled
def test_many_scattered_lines() -> None:
    """20,000 dashes in rows: gaps of 13 pixels between them, which one threshold bridges and the other does not."""
    columns, rows, size = 200, 100, 8
    x = np.arange(columns) * 20 + 4
    y = np.arange(rows) * 40 + 4
    starts = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    pixels = (starts[:, None] + np.stack([np.arange(size), np.zeros(size, int)], -1)).reshape(-1, 2)
    attributes = np.zeros(len(starts), BLOB_DTYPE)
    attributes['dir'], attributes['size'], attributes['select'] = 3, size, True
    attributes['min_col'], attributes['max_col'] = starts[:, 0], starts[:, 0] + size - 1
    attributes['min_row'] = attributes['max_row'] = starts[:, 1]
    offsets = np.arange(0, len(pixels) + 1, size, dtype=np.int32)
    shape = (4100, 4100)
    for tau2, expected in ((12.0, len(starts)), (13.5, rows)):
        lines, count = computed(attributes, pixels, offsets, shape)
        assert count == 20000
        alive = link_lines(lines, count, shape, Parameters(tau2=tau2), Buffers())
        assert np.count_nonzero(alive) == expected
        assert lines[:alive.size][alive]['n'].sum() == size * count

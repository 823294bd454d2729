import itertools
import math
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.edges import MARGIN, OPEN, STRONG
from line_feature_node.core.parameters import Parameters
from line_feature_node.core.scanning import TAKEN, chain_directions, joined, scan_edges, trace_edges

Pixel = tuple[int, int]

#: Chain code 0 to 7: from +x towards +y in steps of 45 degrees.
STEPS = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]
NONE = 255
NEIGHBOURS = set(STEPS)


class Chain(NamedTuple):
    pixels: list[Pixel]
    codes: list[int]
    directions: list[int]
    bridged: list[bool]
    closed: bool


def picture(text: str) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Codes and strength of a drawing: 1 to 4 are strong pixels of that code, a to d weak ones, all else is empty."""
    lines = text.strip('\n').split('\n')
    width = max(len(line) for line in lines)
    cells = np.array([list(line.ljust(width, '.')) for line in lines])
    codes = np.zeros(cells.shape, np.uint8)
    for code in range(1, 5):
        codes[(cells == str(code)) | (cells == 'abcd'[code - 1])] = code
    return codes, np.isin(cells, list('1234'))


def marks_of(codes: NDArray[np.uint8], strong: Any = True) -> NDArray[np.uint8]:
    """Marks as edge extraction leaves them: padded, and rows a multiple of eight long."""
    height, width = codes.shape
    marks = np.zeros((height + 2 * MARGIN, -(-(width + 2 * MARGIN) // 8) * 8), np.uint8)
    marks[MARGIN:MARGIN + height, MARGIN:MARGIN + width] = codes + OPEN * (codes > 0) + STRONG * ((codes > 0) & strong)
    return marks


def scan(
    codes: NDArray[np.uint8], strong: Any = True, max_gap: int = 0, min_chain: int = 1, buffers: Buffers | None = None,
    refine: bool = False,
) -> list[Chain]:
    marks = marks_of(codes, strong)
    chains = scan_edges(
        marks, Parameters(max_gap=max_gap, min_chain=min_chain, refine=refine), buffers or Buffers())
    directions = chain_directions(chains, marks.shape[1])
    rows, columns = np.divmod(chains.pixels, marks.shape[1])
    assert chains.offsets.size == chains.closed.size + 1
    assert chains.offsets[0] == 0
    assert chains.offsets[-1] == chains.pixels.size
    found = []
    for k, closed in enumerate(chains.closed):
        part = slice(chains.offsets[k], chains.offsets[k + 1])
        pixels = list(zip((columns[part] - MARGIN).tolist(), (rows[part] - MARGIN).tolist(), strict=True))
        found.append(Chain(pixels, chains.codes[part].tolist(), directions[part].tolist(),
                           chains.bridged[part].tolist(), bool(closed)))
    return found


def scan_text(text: str, **options: Any) -> list[Chain]:
    return scan(*picture(text), **options)


def drawn(pixels: list[Pixel], codes: int | list[int], shape: tuple[int, int]) -> NDArray[np.uint8]:
    image = np.zeros(shape, np.uint8)
    for k, (x, y) in enumerate(pixels):
        image[y, x] = codes if isinstance(codes, int) else codes[k]
    return image


def hysteresis(codes: NDArray[np.uint8], strong: NDArray[np.bool_]) -> set[Pixel]:
    """Candidates that are 8-connected to a strong one through candidates."""
    _, labels = cv2.connectedComponents((codes > 0).astype(np.uint8), connectivity=8)
    rows, columns = np.nonzero((codes > 0) & np.isin(labels, labels[strong & (codes > 0)]))
    return set(zip(columns.tolist(), rows.tolist(), strict=True))


def touch(a: Pixel, b: Pixel) -> bool:
    return (b[0] - a[0], b[1] - a[1]) in NEIGHBOURS


def check(chains: list[Chain], codes: NDArray[np.uint8], strong: NDArray[np.bool_]) -> None:
    """What holds of the chains of any image, when none is dropped."""
    every = [pixel for chain in chains for pixel in chain.pixels]
    assert len(every) == len(set(every)), 'a pixel belongs to two chains'
    edges = {pixel for chain in chains
             for pixel, bridged in zip(chain.pixels, chain.bridged, strict=True) if not bridged}
    assert edges == hysteresis(codes, strong)
    for pixels, chain_codes, directions, bridged, closed in chains:
        following = [*pixels[1:], pixels[0]]
        for k, (a, b) in enumerate(zip(pixels, following, strict=True)):
            if k + 1 < len(pixels) or closed:
                assert (b[0] - a[0], b[1] - a[1]) == STEPS[directions[k]]
            else:
                assert directions[k] == NONE
        assert closed == (len(pixels) >= 4 and touch(pixels[-1], pixels[0]))
        for k, (x, y) in enumerate(pixels):
            assert 0 <= y < codes.shape[0]
            assert 0 <= x < codes.shape[1]
            if bridged[k]:
                assert codes[y, x] == 0
                assert k > 0
                assert chain_codes[k] == chain_codes[k - 1]
            else:
                assert chain_codes[k] == codes[y, x]


@pytest.mark.parametrize('density', [0.05, 0.15, 0.3, 0.5, 0.8])
@pytest.mark.parametrize('max_gap', [0, 2])
@pytest.mark.parametrize('shape', [(60, 83), (1, 200), (200, 1)])
def test_random_images(density: float, max_gap: int, shape: tuple[int, int]) -> None:
    """Tracing is hysteresis: a pixel is visited, once, when it hangs together with a strong one."""
    rng = np.random.default_rng(round(1000 * density) + shape[0])
    buffers = Buffers()
    for _ in range(5):
        codes = np.where(rng.random(shape) < density, rng.integers(1, 5, shape), 0).astype(np.uint8)
        strong = rng.random(shape) < 0.02
        check(scan(codes, strong, max_gap, buffers=buffers), codes, strong & (codes > 0))


@pytest.mark.parametrize('density', [0.05, 0.3, 0.8])
def test_chains_that_are_refined_are_those_that_were_traced(density: float) -> None:
    """All of their pixels and none linked, whatever max_gap and min_chain are; nor does any count as closed."""
    rng = np.random.default_rng(round(1000 * density))
    buffers = Buffers()
    for shape in ((60, 83), (9, 7), (60, 83), (1, 1), (40, 120)):
        codes = np.where(rng.random(shape) < density, rng.integers(1, 5, shape), 0).astype(np.uint8)
        strong = rng.random(shape) < 0.05
        linked = scan(codes, strong, max_gap=0, min_chain=1)
        found = scan(codes, strong, max_gap=4, min_chain=9, buffers=buffers, refine=True)
        assert len(found) >= len(linked)
        pixels, of_linked = (sorted(pixel for chain in some for pixel in zip(chain.pixels, chain.codes, strict=True))
                             for some in (found, linked))
        assert pixels == of_linked
        for chain in found:
            assert all(max(abs(x - u), abs(y - v)) == 1 for (x, y), (u, v) in itertools.pairwise(chain.pixels))
        assert not any(chain.closed or any(chain.bridged) for chain in found)
        scan(codes, strong, max_gap=4, min_chain=2, buffers=buffers)


SMALL = st.tuples(st.integers(1, 10), st.integers(1, 18))


@settings(max_examples=150, deadline=None)
@given(st.data(), st.integers(0, 8))
def test_small_images(data: st.DataObject, max_gap: int) -> None:
    shape = data.draw(SMALL)
    codes = data.draw(arrays(np.uint8, shape, elements=st.integers(0, 4)))
    strong = data.draw(arrays(np.bool_, shape))
    check(scan(codes, strong, max_gap), codes, strong)


@settings(max_examples=50, deadline=None)
@given(st.data(), st.integers(0, 4), st.integers(0, 9), st.integers(0, 9))
def test_chains_move_with_the_image(data: st.DataObject, max_gap: int, left: int, above: int) -> None:
    """Background around an image changes nothing but the coordinates."""
    shape = data.draw(SMALL)
    codes = data.draw(arrays(np.uint8, shape, elements=st.sampled_from([0, 0, 1, 2, 3, 4])))
    strong = data.draw(arrays(np.bool_, shape))
    around = (above, 3), (left, 5)
    moved = scan(np.pad(codes, around), np.pad(strong, around), max_gap)
    expected = [chain._replace(pixels=[(x + left, y + above) for x, y in chain.pixels])
                for chain in scan(codes, strong, max_gap)]
    assert moved == expected


def test_equal_marks_give_equal_chains() -> None:
    rng = np.random.default_rng(5)
    codes = np.where(rng.random((40, 70)) < 0.3, rng.integers(1, 5, (40, 70)), 0).astype(np.uint8)
    used = Buffers()
    scan(rng.integers(0, 5, (64, 64)).astype(np.uint8), max_gap=3, buffers=used)
    first = scan(codes, max_gap=2)
    assert scan(codes, max_gap=2) == first
    assert scan(codes, max_gap=2, buffers=used) == first


@pytest.mark.parametrize('code', [1, 2, 3, 4])
@pytest.mark.parametrize('shape', [(1, 1), (2, 2), (33, 47)])
def test_image_full_of_candidates(code: int, shape: tuple[int, int]) -> None:
    codes = np.full(shape, code, np.uint8)
    strong = np.zeros(shape, np.bool_)
    strong[-1, -1] = True
    check(scan(codes, strong, 2), codes, strong)
    check(scan(codes, max_gap=2), codes, codes > 0)
    assert scan(codes, ~codes.astype(bool), 2) == []


def test_visited_pixels_are_taken() -> None:
    """The marks tell afterwards which candidates the hysteresis kept."""
    codes, strong = picture("""
        cc3..1..
        .......b
        ...dd...
        """.replace(' ', ''))
    marks = marks_of(codes, strong)
    scan_edges(marks, Parameters.profile('paper', max_gap=0, min_chain=1), Buffers())
    taken = marks[MARGIN:-MARGIN, MARGIN:MARGIN + codes.shape[1]] & TAKEN > 0
    assert set(zip(*np.nonzero(taken.T), strict=True)) == {(0, 0), (1, 0), (2, 0), (5, 0)}


@pytest.mark.parametrize(('code', 'pixels'), [
    (1, [(4, 1), (4, 2), (4, 3), (4, 4), (4, 5)]),
    (2, [(5, 1), (4, 2), (3, 3), (2, 4), (1, 5)]),
    (3, [(2, 3), (3, 3), (4, 3), (5, 3), (6, 3)]),
    (4, [(1, 1), (2, 2), (3, 3), (4, 4), (5, 5)]),
])
@pytest.mark.parametrize('only', [None, 0, 2, 4])
def test_where_a_chain_starts(code: int, pixels: list[Pixel], only: int | None) -> None:
    """A line is walked down, to the lower left, right and lower right for codes 1 to 4, whichever pixel is strong."""
    codes = drawn(pixels, code, (8, 9))
    strong = codes > 0 if only is None else drawn([pixels[only]], 1, (8, 9)) > 0
    [chain] = scan(codes, strong)
    assert chain.pixels == pixels
    assert chain.codes == [code] * 5
    assert chain.directions == [(code + 1) % 4] * 4 + [NONE]
    assert not chain.closed


def test_chains_come_in_the_order_of_their_first_strong_pixel() -> None:
    chains = scan_text("""
a.1....1
1...3..a
a.3.....
""")
    assert [chain.pixels[0] for chain in chains] == [(2, 0), (7, 0), (0, 0), (4, 1), (2, 2)]


def ring(text: str) -> Chain:
    [chain] = scan_text(text)
    return chain


@pytest.mark.parametrize('text', [
    '.333.\n1...1\n1...1\n.333.',
    '..2..\n.2.4.\n2...4\n.4.2.\n..4..',
    '3333\n1..1\n1..1\n3333',
    '.3.\n1.1\n.3.',
])
def test_closed_chain(text: str) -> None:
    chain = ring(text)
    assert chain.closed
    assert len(chain.pixels) == np.count_nonzero(picture(text)[0])
    assert NONE not in chain.directions
    # Once round a ring, the turns add up to a full circle.
    turns = [(b - a + 4) % 8 - 4 for a, b in zip(chain.directions, chain.directions[1:] + chain.directions[:1],
                                                 strict=True)]
    assert abs(sum(turns)) == 8


@pytest.mark.parametrize('text', [
    '333333', '1\n1', '3', '.333.\n1...1\n1...1', '..2\n.2.\n2..', '.333.\n1....\n1...1\n.333.',
])
def test_open_chain(text: str) -> None:
    [chain] = scan_text(text)
    assert not chain.closed
    assert chain.directions.index(NONE) == len(chain.pixels) - 1


def test_ring_with_a_bridged_gap_is_closed() -> None:
    text = '\n'.join(['.333333333333.', *['1............1'] * 6, '.33333..33333.'])
    [chain] = scan_text(text, max_gap=2)
    assert chain.closed
    assert {pixel for pixel, bridged in zip(chain.pixels, chain.bridged, strict=True) if bridged} == {(6, 7), (7, 7)}
    [chain] = scan_text(text, max_gap=1)
    assert not chain.closed


def chain_with(chains: list[Chain], pixel: Pixel) -> Chain:
    [chain] = [chain for chain in chains if pixel in chain.pixels]
    return chain


@pytest.mark.parametrize(('text', 'ends'), [
    ('333333333\n....1....\n....1....\n....1....', [(0, 0), (8, 0)]),
    ('....1....\n....1....\n....1....\n....13333\n....1....\n....1....', [(4, 0), (4, 5)]),
    ('....1....\n....1....\n....1....\n333313333\n....1....\n....1....', [(4, 0), (4, 5)]),
    ('4.....2\n.4...2.\n..4.2..\n...4...\n..2.4..\n.2...4.\n2.....4', [(0, 0), (6, 6)]),
    ('...2..\n..2...\n.4....\n2.4...\n...4..\n....4.', [(0, 3), (3, 0)]),
    ('...1...\n...1...\n...1...\n...1...\n..21...\n.2.1...\n2..1...', [(3, 0), (3, 6)]),
    ('333333333\n...2.....\n..2......\n.2.......', [(0, 0), (8, 0)]),
], ids=['T', 'lying T', 'X of axes', 'X of diagonals', 'diagonal T', 'Y', 'Y of a horizontal'])
def test_straight_on_at_a_junction(text: str, ends: list[Pixel]) -> None:
    codes, strong = picture(text)
    chains = scan(codes, strong)
    check(chains, codes, strong)
    pixels = chain_with(chains, ends[0]).pixels
    assert sorted((pixels[0], pixels[-1])) == ends
    # A straight line between its ends.
    assert len(pixels) == max(abs(ends[1][0] - ends[0][0]), abs(ends[1][1] - ends[0][1])) + 1


@pytest.mark.parametrize('mirror', [False, True])
def test_of_two_equal_bends_the_one_that_turns_back(mirror: bool) -> None:
    fork = [(4, 0), (4, 1), (3, 2), (3, 3), (3, 4), (2, 2), (1, 2)]
    straight = fork[:5]
    if mirror:
        fork, straight = ([(8 - x, y) for x, y in pixels] for pixels in (fork, straight))
    chains = scan(drawn(fork, 1, (6, 9)))
    assert chain_with(chains, fork[0]).pixels == straight


def test_no_turn_is_sharper_than_a_right_angle() -> None:
    chains = scan_text('1.\n11\n1.')
    assert [chain.pixels for chain in chains] == [[(0, 0), (0, 1), (0, 2)], [(1, 1)]]
    [chain] = scan_text('1.\n1.\n11')
    assert chain.pixels == [(0, 0), (0, 1), (0, 2), (1, 2)]


def code_of(degrees: float) -> int:
    """Code of an edge that runs in a direction: of its gradient, across it."""
    return int(((degrees + 90) % 180 + 22.5) // 45) % 4 + 1


def digital_line(degrees: float, length: int, start: Pixel = (40, 40)) -> list[Pixel]:
    """Pixels along a direction, one for each step along the axis that it is nearer to."""
    x, y = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    scale = max(abs(x), abs(y))
    return [(start[0] + math.floor(k * x / scale + 0.5), start[1] + math.floor(k * y / scale + 0.5))
            for k in range(length)]


ANGLES = [0, 45, 90, 135, 8, 15, 20, 25, 33, 40, 52, 61, 68, 75, 82, 98, 107, 113, 120, 128, 143, 150, 157, 163, 172]


@pytest.mark.parametrize('degrees', ANGLES)
@pytest.mark.parametrize('gap', [1, 2])
@pytest.mark.parametrize('first', [8, 9, 11])
def test_gap_in_a_line_is_bridged(degrees: float, gap: int, first: int) -> None:
    line = digital_line(degrees, 21)
    codes = drawn(line[:first] + line[first + gap:], code_of(degrees), (81, 81))
    [chain] = scan(codes, max_gap=2)
    check([chain], codes, codes > 0)
    assert sum(chain.bridged) == gap
    assert len(chain.pixels) == 21
    start = chain.bridged.index(True)
    assert chain.bridged[start:start + gap] == [True] * gap
    # The gap is filled with the digital straight line between its sides.
    a, b = np.array(chain.pixels[start - 1]), np.array(chain.pixels[start + gap])
    for k in range(1, gap + 1):
        exact = a + (b - a) * k / (gap + 1)
        assert np.abs(exact - chain.pixels[start + k - 1]).max() <= 0.5
    assert chain.codes == [code_of(degrees)] * 21


@pytest.mark.parametrize('degrees', ANGLES)
@pytest.mark.parametrize(('gap', 'max_gap'), [(1, 0), (2, 0), (2, 1), (3, 2), (5, 4)])
def test_longer_gap_is_not_bridged(degrees: float, gap: int, max_gap: int) -> None:
    line = digital_line(degrees, 24)
    parts = [line[:10], line[10 + gap:]]
    chains = scan(drawn(parts[0] + parts[1], code_of(degrees), (81, 81)), max_gap=max_gap)
    assert sorted(sorted(chain.pixels) for chain in chains) == sorted(sorted(part) for part in parts)
    assert not any(any(chain.bridged) for chain in chains)


@pytest.mark.parametrize('gap', range(1, 9))
@pytest.mark.parametrize('degrees', [0, 45, 90, 135])
def test_gaps_up_to_the_largest_parameter(gap: int, degrees: float) -> None:
    line = digital_line(degrees, 30)
    [chain] = scan(drawn(line[:10] + line[10 + gap:], code_of(degrees), (81, 81)), max_gap=8)
    assert sorted(chain.pixels) == sorted(line)


@pytest.mark.parametrize('row', [0, 4])
@pytest.mark.parametrize('transposed', [False, True])
def test_gap_beside_the_border_is_bridged(row: int, transposed: bool) -> None:
    codes = np.zeros((5, 14), np.uint8)
    codes[row] = [1 if transposed else 3] * 6 + [0, 0] + [1 if transposed else 3] * 6
    [chain] = scan(codes.T.copy() if transposed else codes, max_gap=2)
    assert len(chain.pixels) == 14


@pytest.mark.parametrize('left', [1, 2, 3, 4])
@pytest.mark.parametrize('right', [1, 2, 3, 4])
def test_bridge_needs_equal_or_neighbouring_codes(left: int, right: int) -> None:
    """Sections of 45 degrees modulo 180: 4 and 1 are neighbours, 1 and 3 are perpendicular."""
    row = np.array([[left] * 8 + [0] + [right] * 8], np.uint8)
    chains = scan(row, max_gap=2)
    if (left - right) % 4 == 2:
        assert [len(chain.pixels) for chain in chains] == [8, 8]
    else:
        [chain] = chains
        assert chain.pixels[8] == (8, 0)
        assert chain.bridged[8]
        # The code of the end that is continued, in the order in which the chain is walked.
        assert chain.codes[8] == chain.codes[7] != 0


@pytest.mark.parametrize('text', [
    '33333333.....\n.............\n....33333333.',
    '33333333.....\n.............\n........1....\n........1....\n........1....\n........1....\n........1....',
    '1.......\n.......1\n1......1\n1......1\n1......1\n1..1....\n1..1....\n...1....\n...1....\n...1....',
    '3333333......\n.............\n.......2.....\n......2......\n.....2.......\n....2........\n...2.........',
], ids=['past each other', 'corner', 'upright, past each other', 'hairpin'])
def test_no_bridge_between_ends_that_do_not_face_each_other(text: str) -> None:
    codes, strong = picture(text)
    chains = scan(codes, strong, max_gap=2)
    check(chains, codes, strong)
    assert not any(any(chain.bridged) for chain in chains)


@pytest.mark.parametrize('code', [1, 2, 3, 4])
@pytest.mark.parametrize('turns', range(4))
@pytest.mark.parametrize('mirror', [False, True])
def test_no_bridge_around_a_corner(code: int, turns: int, mirror: bool) -> None:
    """Of equal codes too: the ends of the two sides of a right angle don't point at each other."""
    codes = np.zeros((9, 9), np.uint8)
    codes[0, :7] = codes[2:, 8] = code
    codes = np.rot90(codes[::-1] if mirror else codes, turns).copy()
    chains = scan(codes, max_gap=2)
    assert [len(chain.pixels) for chain in chains] == [7, 7]


@pytest.mark.parametrize('width', [6, 7, 13, 14, 30])
@pytest.mark.parametrize('flip', [False, True])
@pytest.mark.parametrize('mirror', [False, True])
def test_bridge_in_a_narrow_image(width: int, mirror: bool, flip: bool) -> None:
    """A sloping line and the vertical that continues it, however few pixels a row has."""
    codes = np.zeros((9, 6), np.uint8)
    codes[[8, 8, 7, 7, 6], range(5)] = 4 if mirror != flip else 2
    codes[:5, 5] = 1
    codes = np.pad(codes[::-1 if flip else 1, ::-1 if mirror else 1], ((0, 0), (0, width - 6)))
    [chain] = scan(codes, max_gap=1)
    assert len(chain.pixels) == 11


@pytest.mark.parametrize('stroke', ['1', '3'])
def test_no_bridge_over_an_occupied_pixel(stroke: str) -> None:
    beside = [f'........{stroke}........'] * 4
    text = '\n'.join([*beside, f'3333333.{stroke}.3333333', *beside])
    chains = scan_text(text, max_gap=3)
    assert len(chains) == 3
    assert not any(any(chain.bridged) for chain in chains)
    # The gap itself is one that is bridged.
    assert len(scan_text('3333333...3333333', max_gap=3)) == 1


def test_a_gap_is_filled_once() -> None:
    """Two broken lines cross in their gap: one of them is bridged, over the other's gap."""
    size = 15
    codes = np.zeros((size, size), np.uint8)
    codes[7], codes[:, 7] = 3, 1
    codes[6:9, 6:9] = 0
    chains = scan(codes, max_gap=3)
    check(chains, codes, codes > 0)
    assert len(chains) == 3
    assert sum(sum(chain.bridged) for chain in chains) == 3


@pytest.mark.parametrize('width', range(21, 31))
@pytest.mark.parametrize('row', range(5))
def test_no_bridge_around_the_border(width: int, row: int) -> None:
    """The pixel after the last of a row is far away, though not in memory."""
    codes = np.zeros((5, width), np.uint8)
    codes[row, -6:] = 3
    codes[2, :6] = 3
    chains = scan(codes, max_gap=8)
    assert [len(chain.pixels) for chain in chains] == [6, 6]


@pytest.mark.parametrize('width', [1, 2, 5, 6, 7, 13, 14, 15])
@pytest.mark.parametrize('gap', [9, 10, 11])
def test_no_bridge_around_the_border_of_a_narrow_image(width: int, gap: int) -> None:
    """Nor is the pixel before the first, where a row is not much longer than a gap."""
    for column in range(width):
        codes = np.zeros((12 + gap, width), np.uint8)
        codes[:6, 0] = 1
        codes[-6:, column] = 1
        chains = scan(codes, max_gap=8)
        assert [len(chain.pixels) for chain in chains] == [6, 6]


@pytest.mark.parametrize('first', ['left', 'right'])
def test_the_shortest_gap_is_bridged_first(first: str) -> None:
    """The middle of three pieces is as far as can be reached from both sides; nearer pieces go before farther."""
    text = '33333333.333333..33333333' if first == 'left' else '33333333..333333.33333333'
    [chain] = scan_text(text, max_gap=2)
    assert len(chain.pixels) == 25
    assert sum(chain.bridged) == 3
    # Two pieces that could both continue a third: the nearer one does.
    fork = '........3333333\n3333333........\n.........333333' if first == 'left' else \
        '.........333333\n3333333........\n........3333333'
    chains = scan_text(fork, max_gap=2)
    nearer = (14, 0) if first == 'left' else (14, 2)
    assert (0, 1) in chain_with(chains, nearer).pixels
    assert len(chains) == 2


def test_isolated_pixels_are_not_linked() -> None:
    """One pixel points nowhere."""
    chains = scan_text('3.3.3.3', max_gap=2)
    assert sorted(chain.pixels for chain in chains) == [[(x, 0)] for x in (0, 2, 4, 6)]


@pytest.mark.parametrize('min_chain', range(1, 8))
def test_short_chains_are_dropped(min_chain: int) -> None:
    text = '\n\n'.join('3' * length for length in range(1, 8))
    chains = scan_text(text, min_chain=min_chain)
    assert [len(chain.pixels) for chain in chains] == list(range(min_chain, 8))


@pytest.mark.parametrize(('max_gap', 'min_chain', 'expected'), [
    (0, 5, [5, 5]), (0, 6, []), (1, 5, [11]), (1, 11, [11]), (1, 12, []),
])
def test_linked_chains_count_as_one(max_gap: int, min_chain: int, expected: list[int]) -> None:
    """Two pieces of five pixels with one between them make eleven."""
    chains = scan_text('33333.33333', max_gap=max_gap, min_chain=min_chain)
    assert [len(chain.pixels) for chain in chains] == expected


@settings(max_examples=40, deadline=None)
@given(arrays(np.uint8, (14, 22), elements=st.sampled_from([0, 0, 0, 1, 2, 3, 4])), st.integers(0, 3),
       st.integers(1, 12))
def test_min_chain_drops_whole_chains_and_changes_no_other(
    codes: NDArray[np.uint8], max_gap: int, min_chain: int,
) -> None:
    kept = [chain for chain in scan(codes, max_gap=max_gap) if len(chain.pixels) >= min_chain]
    assert scan(codes, max_gap=max_gap, min_chain=min_chain) == kept


# In several goes

@pytest.mark.parametrize('parts', [2, 3, 8, 200])
@pytest.mark.parametrize(('filled', 'strong'), [(0.05, 0.5), (0.3, 0.02), (0.38, 0.002), (0, 0), (1, 0.001)])
def test_edges_traced_in_several_goes_are_those_of_one(parts: int, filled: float, strong: float) -> None:
    """Each chain comes once, as soon as the rows that its edge is found in are read."""
    rng = np.random.default_rng(parts)
    codes = np.where(rng.random((150, 90)) < filled, rng.integers(1, 5, (150, 90)), 0).astype(np.uint8)
    whole = marks_of(codes, rng.random(codes.shape) < strong)
    shared = whole.copy()
    [one] = trace_edges(whole, 1, Buffers())
    goes = list(trace_edges(shared, parts, Buffers()))
    assert len(goes) == parts
    np.testing.assert_array_equal(shared, whole)
    for found, expected in zip(joined(goes), one, strict=True):
        np.testing.assert_array_equal(found, expected)
    for before, after in pairwise(goes):
        assert before.offsets[-1] == after.offsets[0]
    assert sum(go.closed.size for go in goes) == one.closed.size

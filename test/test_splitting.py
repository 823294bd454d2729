"""Stretches are straight, in their chains, and as long as these are straight; what is no line is in none of them."""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from line_feature_node.core.buffers import Buffers
from line_feature_node.core.scanning import Chains
from line_feature_node.core.splitting import LONGEST, UNIT, deviation_variance, split_chains

Pixel = tuple[int, int]

#: Length of a row of the image that the chains are in, and its margin.
STRIDE, MARGIN = 2000, 1
#: Of the pixels of a clean picture.
VARIANCE = deviation_variance(0.0, 4.0)
#: Pixels of a line that is found as a whole, and what may be missing of a stretch at its ends.
WHOLE, SLACK = 120, 8


class Stretch(NamedTuple):
    """What is known of a stretch."""

    chain: int
    start: int
    size: int
    code: int
    box: tuple[int, int, int, int]
    pixels: list[Pixel]


def split(
    chains: list[list[Pixel]], codes: list[list[int]] | None = None, bridged: list[set[int]] | None = None,
    variance: float = VARIANCE, min_size: int = 5, buffers: Buffers | None = None,
) -> list[Stretch]:
    """The stretches of some chains, each given by its pixels (x, y)."""
    flat = np.array([pixel for chain in chains for pixel in chain], np.int64).reshape(-1, 2)
    offsets = np.cumsum([0, *(len(chain) for chain in chains)]).astype(np.int32)
    fills = np.array([bridged is not None and k in bridged[number]
                      for number, chain in enumerate(chains) for k in range(len(chain))], np.bool_)
    all_codes = np.array([code for some in codes for code in some] if codes else np.ones(len(flat)), np.uint8)
    found = split_chains(
        Chains(((flat[:, 1] + MARGIN) * STRIDE + flat[:, 0] + MARGIN).astype(np.int32), all_codes, fills, offsets,
               np.zeros(len(chains), np.bool_)), variance, STRIDE, MARGIN, min_size, buffers or Buffers())
    all_members, starts = found.members()
    assert starts[0] == 0
    assert len(starts) == len(found.attributes) + 1
    assert starts[-1] == len(all_members)
    stretches = []
    for k, blob in enumerate(found.attributes):
        members = all_members[starts[k]:starts[k + 1]]
        assert (np.diff(members) == 1).all()
        chain = int(np.searchsorted(offsets, members[0], 'right')) - 1
        assert members[-1] < offsets[chain + 1]
        assert blob['select']
        assert blob['size'] == len(members)
        stretches.append(Stretch(
            chain, int(members[0] - offsets[chain]), len(members), int(blob['dir']),
            (int(blob['min_col']), int(blob['max_col']), int(blob['min_row']), int(blob['max_row'])),
            [(int(x), int(y)) for x, y in flat[members]]))
    places = [(stretch.chain, stretch.start, stretch.size) for stretch in stretches]
    for (chain, start, size), (following, begin, _) in itertools.pairwise(places):
        assert following > chain or begin >= start + size
    return stretches


def line(length: int, degrees: float, x: float = 900.0, y: float = 900.0) -> list[Pixel]:
    """A digital straight line of so many pixels."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    step = 1 / max(abs(cos), abs(sin))
    return [(round(x + k * step * cos), round(y + k * step * sin)) for k in range(length)]


def curve(points: Any) -> list[Pixel]:
    """The pixels that a dense sequence of points goes through, each after the other, eight-connected."""
    pixels: list[Pixel] = []
    for x, y in points:
        pixel = round(x), round(y)
        if not pixels or pixel != pixels[-1]:
            pixels.append(pixel)
    thin = pixels[:1]
    for k in range(1, len(pixels)):
        following = pixels[k + 1] if k + 1 < len(pixels) else None
        if following is None or max(abs(following[0] - thin[-1][0]), abs(following[1] - thin[-1][1])) > 1:
            thin.append(pixels[k])
    return thin


def circle(radius: float, share: float = 1.0) -> list[Pixel]:
    angles = np.linspace(0, 2 * math.pi * share, int(50 * radius))
    return curve((900.3 + radius * math.cos(angle), 899.8 + radius * math.sin(angle)) for angle in angles)


def polygon(*corners: tuple[float, float]) -> list[Pixel]:
    points = [np.linspace(a, b, 4000) for a, b in itertools.pairwise(corners)]
    return curve(np.concatenate(points))


def distances(pixels: list[Pixel]) -> NDArray[np.float64]:
    """Of pixels from the line through them that fits best."""
    centred = np.array(pixels, np.float64) - np.mean(pixels, axis=0)
    return np.asarray(centred @ np.linalg.svd(centred, full_matrices=False)[2][1])


# Lines

@pytest.mark.parametrize('degrees', [0, 4, 17, 26.57, 45, 58, 85, 90, 101, 135, 150, 176, 200, 270, 315])
@pytest.mark.parametrize('length', [13, 20, 47, WHOLE])
def test_straight_chain_is_one_stretch(length: int, degrees: float) -> None:
    chain = line(length, degrees)
    [stretch] = split([chain])
    assert (stretch.start, stretch.size) == (0, length)
    assert stretch.pixels == chain


@pytest.mark.parametrize('degrees', [0.5, 1, 2, 89, 91, 178.5, 44, 46.5, 134])
def test_line_of_long_runs_is_at_worst_found_in_them(degrees: float) -> None:
    """A line at one degree goes along an axis for 57 pixels before it steps aside; hardly a pixel is left out."""
    chain = line(WHOLE, degrees)
    found = split([chain])
    assert sum(stretch.size for stretch in found) > WHOLE - 2 * SLACK
    away = (degrees + 22.5) % 45 - 22.5
    assert len(found) <= 2 + WHOLE * abs(math.sin(math.radians(away))) * math.sqrt(2)
    for stretch in found:
        assert abs(distances(stretch.pixels)).max() < 1


@pytest.mark.parametrize('degrees', [0, 17, 45, 71, 100, 160])
@pytest.mark.parametrize('length', [200, 517, 1000])
def test_long_line_is_found_in_parts(length: int, degrees: float) -> None:
    """They leave out nothing but a remainder that is too short."""
    turned = degrees > 90
    found = split([line(length, degrees, 1500.0 if turned else 100.0, 100.0)])
    assert sum(stretch.size for stretch in found) > length - 2 * SLACK
    assert len(found) <= length / WHOLE + 1
    assert max(stretch.size for stretch in found) == UNIT * LONGEST
    assert all(abs(distances(stretch.pixels)).max() < 1 for stretch in found)


@pytest.mark.parametrize('degrees', [0, 20, 45, 80])
@pytest.mark.parametrize('turn', [30, 45, 60, 90, 120, 135])
@pytest.mark.parametrize('length', [24, 61, 100])
def test_corner_divides(length: int, turn: float, degrees: float) -> None:
    """Into two stretches that are not far from it, each of one side of it but for a few pixels."""
    arm = line(length, degrees)
    chain = [*arm, *line(length, degrees + turn, *arm[-1])[1:]]
    found = split([chain])
    first, *rest = found
    assert first.start == 0
    assert abs(first.size - length) <= SLACK
    last = rest[-1]
    assert abs(last.start - length) <= 2 * SLACK
    assert last.start + last.size == len(chain)
    assert len(found) == 2


def test_square_has_four_sides() -> None:
    """A closed chain, wherever it begins on it."""
    chain = polygon((700, 700), (800, 700), (800, 800), (700, 800), (700, 700))[:-1]
    for begin in (0, 7, 50, 99):
        found = split([chain[begin:] + chain[:begin]])
        sides = [stretch for stretch in found if stretch.size > 2 * SLACK]
        assert 4 <= len(sides) <= 5
        assert sum(stretch.size for stretch in sides) > len(chain) - 8 * SLACK
        for stretch in sides:
            assert min(np.ptp(stretch.pixels, axis=0)) <= 2


@pytest.mark.parametrize('radius', [10, 15, 20, 30, 50, 100, 200, 300, 600])
def test_circle_is_divided_into_chords(radius: float) -> None:
    """Each within a pixel of its line, and longer where the circle is flatter."""
    found = split([circle(radius)])
    for stretch in found:
        assert abs(distances(stretch.pixels)).max() < 1.5
        assert distances(stretch.pixels).std() < 0.75
    if radius >= 30:
        assert sum(stretch.size for stretch in found) > 0.8 * len(circle(radius))
        # A chord that stays within h of its circle is sqrt(8 r h) long.
        sizes = [stretch.size for stretch in found]
        assert min(math.sqrt(8 * radius * 0.3), WHOLE) / 2 < np.median(sizes) < math.sqrt(8 * radius * 3) + SLACK


def test_tight_curls_have_no_stretch() -> None:
    for radius in (2, 3):
        assert split([circle(radius)]) == []
    zigzag = [(900 + k, 900 + 4 * (k // 4 % 2) + (k % 4) * (1 - 2 * (k // 4 % 2))) for k in range(80)]
    assert split([zigzag]) == []


@pytest.mark.parametrize('seed', range(5))
def test_what_a_chain_takes_in_at_a_bend_is_in_no_stretch(seed: int) -> None:
    """Two straight stretches with a wandering one between them: both are found, to some pixels."""
    rng = np.random.default_rng(seed)
    arm = line(60, 10)
    x, y = arm[-1]
    wild = []
    for _ in range(6):
        for dx, dy in ((1, 1), (1, 1), (0, 1), (-1, 1), (-1, 1), (-1, 0) if rng.random() < 0.5 else (0, 1)):
            x, y = x + dx, y + dy
            wild.append((x, y))
    chain = [*arm, *wild, *line(60, 100, *wild[-1])[1:]]
    found = split([chain])
    assert found[0].start == 0
    assert found[0].size >= 60 - SLACK
    assert found[-1].start + found[-1].size == len(chain)
    assert found[-1].size >= 60 - SLACK
    assert all(distances(stretch.pixels).std() < 0.8 for stretch in found)


# Noise

def test_variance_is_that_of_whole_pixels_and_grows_with_the_noise() -> None:
    assert 1 / 12 <= deviation_variance(0, 4) < 1
    found = [deviation_variance(noise, 4) for noise in (0, 0.1, 0.5, 1, 2)]
    assert found == sorted(set(found))
    assert deviation_variance(2, 8) == pytest.approx(deviation_variance(1, 4))
    assert math.isfinite(deviation_variance(1, 0))


@pytest.mark.parametrize('deviation', [0.8, 1.2])
def test_noisy_line_is_whole_where_the_variance_says_that_it_is_noisy(deviation: float) -> None:
    whole = torn = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        chain = curve((900 + k / 50, 900 + 0.3 * k / 50 + shift) for k, shift in enumerate(
            np.interp(np.arange(5000), np.arange(0, 5001, 100), rng.normal(0, deviation, 51))))
        whole += len(split([chain], variance=2 * deviation**2)) == 1
        torn += len(split([chain], variance=0.02)) != 1
    assert whole >= 18
    assert torn >= 18


# Bookkeeping

def test_no_chains() -> None:
    assert split([]) == []


@pytest.mark.parametrize('size', range(1, 30))
@pytest.mark.parametrize('min_size', [2, 5, 12, 13])
def test_short_chains(size: int, min_size: int) -> None:
    """One pixel, or too few to tell a line, is in no stretch; what is found is never shorter than min_size."""
    found = split([line(size, 30)], min_size=min_size)
    assert len(found) <= 1
    assert all(stretch.size >= min_size for stretch in found)
    if size < min_size:
        assert found == []
    if size >= max(min_size, 13):
        assert [stretch.size for stretch in found] == [size]


def test_many_chains_are_each_divided_by_themselves() -> None:
    """Also when they touch, and are of one pixel or none."""
    corner = [*line(40, 0), *line(40, 90, 939, 900)[1:]]
    chains = [line(30, 0), [(5, 5)], line(30, 0, 930.0), corner, circle(40), [(7, 7), (8, 8)], line(200, 45, 100, 100)]
    found = split(chains)
    expected = [stretch._replace(chain=k) for k, chain in enumerate(chains) for stretch in split([chain])]
    assert found == expected
    buffers = Buffers()
    for some in (chains, chains[:1], chains[::-1], [], chains):
        assert split(some, buffers=buffers) == split(some)


def test_min_size_leaves_out_the_shorter_ones_and_changes_no_other() -> None:
    chains = [circle(radius) for radius in (12, 20, 33, 50, 90)]
    everything = split(chains, min_size=2)
    assert len(everything) > 30
    for min_size in (5, 12, 16, 20, 30):
        assert split(chains, min_size=min_size) == [stretch for stretch in everything if stretch.size >= min_size]


def test_pixels_that_fill_gaps_do_not_count() -> None:
    """They belong to the stretch, wherever they are, but do not bend it."""
    chain = line(60, 20)
    gap = set(range(28, 31))
    aside = [(x, y - 3) if k in gap else (x, y) for k, (x, y) in enumerate(chain)]
    [stretch] = split([aside], bridged=[gap])
    assert (stretch.start, stretch.size) == (0, 60)
    assert stretch.pixels == aside
    only = split([chain], bridged=[set(range(60))])
    assert all(stretch.chain == 0 for stretch in only)


def test_code_is_that_of_most_pixels() -> None:
    """Of codes that are equally frequent it is the lowest."""
    chain = line(40, 0)
    for codes, expected in (([1] * 40, 1), ([4] * 40, 4), ([3] * 19 + [2] * 21, 2), ([3] * 20 + [2] * 20, 2),
                            ([4] * 14 + [1] * 13 + [2] * 13, 4), ([1, 2, 3, 4] * 10, 1), ([4, 3, 3, 4] * 10, 3)):
        [stretch] = split([chain], [codes])
        assert stretch.code == expected
    [stretch] = split([line(WHOLE, 0)], [[4] * WHOLE])
    assert stretch.code == 4


def test_box_is_that_of_the_pixels() -> None:
    for stretch in split([circle(60), line(50, 200)]):
        x, y = zip(*stretch.pixels, strict=True)
        assert stretch.box == (min(x), max(x), min(y), max(y))


# Symmetry

@st.composite
def wanderings(draw: Any) -> list[Pixel]:
    """A chain whose direction changes now and then."""
    x, y, direction = 900, 900, draw(st.integers(0, 7))
    chain = [(x, y)]
    steps = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]
    for run, turn in draw(st.lists(st.tuples(st.integers(1, 30), st.integers(-1, 1)), min_size=1, max_size=14)):
        direction = (direction + turn) % 8
        for _ in range(run):
            x, y = x + steps[direction][0], y + steps[direction][1]
            chain.append((x, y))
    return chain


@settings(max_examples=150, deadline=None, derandomize=True, database=None)
@given(wanderings(), st.sampled_from([0.1, VARIANCE, 1.0, 4.0]), st.integers(2, 20))
def test_any_chain(chain: list[Pixel], variance: float, min_size: int) -> None:
    """Stretches stay as straight as the variance asks for; moved, mirrored and transposed chains have the same ones."""
    found = split([chain], variance=variance, min_size=min_size)
    for stretch in found:
        assert stretch.size >= min_size
        assert stretch.pixels == chain[stretch.start:stretch.start + stretch.size]
        assert (distances(stretch.pixels)**2).mean() < 3 * variance
    places = [(stretch.start, stretch.size) for stretch in found]
    for move in (lambda x, y: (x + 57, y - 31), lambda x, y: (y, x), lambda x, y: (1900 - x, y),
                 lambda x, y: (x, 1900 - y)):
        moved = split([[move(x, y) for x, y in chain]], variance=variance, min_size=min_size)
        assert [(stretch.start, stretch.size) for stretch in moved] == places

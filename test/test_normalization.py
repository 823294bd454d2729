from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from line_feature_node.core.normalization import normalize_closed, normalize_codes, normalize_open
from line_feature_node.core.scanning import Chains

CODES = st.lists(st.integers(1, 4), min_size=1, max_size=40)
#: Runs as edges have them, and single deviating codes between.
RUNS = st.lists(st.tuples(st.integers(1, 4), st.integers(1, 12)), min_size=1, max_size=8).map(
    lambda runs: [code for code, length in runs for _ in range(length)])


def reference(codes: list[int], n: int, closed: bool = False) -> list[int]:
    """Equations (1) to (5), word for word; n of a closed chain is such that its window holds no pixel twice."""
    d = list(codes)
    size = len(d)
    if closed:
        n = min(n, (size - 2) // 2)
    if n < 1:
        return d
    for k in range(size if closed else size - 1):
        before, after = k % size, (k + 1) % size
        if d[before] == d[after]:
            continue
        window_1 = range(k - n, k + n + 2)
        window_2 = range(k + 1, k + n + 2)
        if closed:
            f_1, f_2 = [d[i % size] for i in window_1], [d[i % size] for i in window_2]
        else:
            f_1, f_2 = [d[i] for i in window_1 if 0 <= i < size], [d[i] for i in window_2 if i < size]
        p_1 = Fraction(f_1.count(d[before]), len(f_1))
        p_2 = Fraction(f_2.count(d[after]), len(f_2))
        if p_1 / p_2 > 1:
            d[after] = d[before]
    return d


def normalized(codes: list[int], n: int, closed: bool = False) -> list[int]:
    array = np.array(codes, np.uint8)
    size = array.size
    chains = Chains(np.arange(size, dtype=np.int32), array, np.zeros(size, np.bool_),
                    np.array([0, size], np.int32), np.array([closed]))
    normalize_codes(chains, n)
    return array.tolist()


def decode(text: str) -> list[int]:
    return [int(code) for code in text]


@settings(max_examples=400, deadline=None)
@given(CODES | RUNS, st.integers(0, 50), st.booleans())
def test_equations(codes: list[int], n: int, closed: bool) -> None:
    closed = closed and len(codes) >= 4
    assert normalized(codes, n, closed) == reference(codes, n, closed)


@settings(max_examples=200, deadline=None)
@given(CODES | RUNS, st.integers(1, 50))
def test_kernel_of_open_chains(codes: list[int], n: int) -> None:
    array = np.array(codes, np.uint8)
    normalize_open(array, n)
    assert array.tolist() == reference(codes, n)


@settings(max_examples=200, deadline=None)
@given(RUNS.filter(lambda codes: len(codes) >= 4), st.integers(1, 50))
def test_kernel_of_closed_chains(codes: list[int], n: int) -> None:
    array = np.array(codes, np.uint8)
    normalize_closed(array, min(n, (len(codes) - 2) // 2))
    assert array.tolist() == reference(codes, n, closed=True)


@pytest.mark.parametrize('n', [1, 2, 4, 7])
def test_every_short_sequence_of_two_codes(n: int) -> None:
    for size in range(1, 11):
        for bits in range(2**size):
            codes = [1 + (bits >> k & 1) * 2 for k in range(size)]
            assert normalized(codes, n) == reference(codes, n)
            if size >= 4:
                assert normalized(codes, n, closed=True) == reference(codes, n, closed=True)


@pytest.mark.parametrize(('before', 'after', 'n'), [
    # As in Fig. 3: 2 is dominant, A and B deviate to 1 and 3.
    ('222222122222232222222', '2' * 21, 4),
    ('222222122222232222222', '2' * 21, 1),
    # Two long runs are a corner, which stays.
    ('22222222233333333', '22222222233333333', 4),
    ('11111144444', '11111144444', 4),
    ('22221222233333133333', '22222222233333333333', 4),
    # Two deviating pixels are a perturbation in a window of nine, four are none in a window of four.
    ('22222113222222', '22222222222222', 4),
    ('22222111122222', '22222111122222', 1),
    # The last pixel deviates: the window is cut off behind it, m1 = 5/6, m2 = 1.
    ('22222223', '22222223', 4),
    # The one before the last: m1 = 6/7 of its window, m2 = 1/2.
    ('22222232', '22222222', 4),
    # The first pixel has nothing before it to take: m1 = 1/6, m2 = 1.
    ('32222222', '32222222', 4),
    # p(k) is the first, p(k+1) deviates: m1 = 5/6, m2 = 1/5.
    ('23222222', '22222222', 4),
    # A change is seen by the next pair: the second 3 has only changed pixels before it.
    ('2222332222', '2222222222', 4),
    ('2', '2', 4),
    ('23', '23', 4),
])
def test_examples(before: str, after: str, n: int) -> None:
    assert normalized(decode(before), n) == decode(after)


@pytest.mark.parametrize(('before', 'after'), [
    # n = 1, k the second pixel: m1 = 2/4 and m2 = 1/2, Lambda = 1 keeps.
    ('2234', '2234'),
    # One more 2 in the window and Lambda = 3/2.
    ('2232', '2222'),
    # The windows are cut off: m1 = 1/2 at both ends, m2 = 1.
    ('24', '24'),
])
def test_tie_keeps(before: str, after: str) -> None:
    assert normalized(decode(before), 1) == decode(after)


def test_window_of_a_closed_chain_wraps() -> None:
    """The deviating pixel stands first in memory; before it comes the last."""
    codes = decode('3222222222')
    assert normalized(codes, 4) == codes
    assert normalized(codes, 4, closed=True) == [2] * 10


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(1, 4), min_size=10, max_size=30), st.integers(1, 4))
def test_window_of_a_long_closed_chain_is_that_of_an_endless_one(codes: list[int], n: int) -> None:
    """The first change of code round a ring is decided as in an open chain that repeats it."""
    change = next((k for k in range(len(codes) - 1) if codes[k] != codes[k + 1]), None)
    if change is None:
        return
    endless = codes * 3
    start, size = change + len(codes), len(codes)
    window = endless[start - n:start + n + 2]
    local = list(window)
    m1 = Fraction(local.count(codes[change]), 2 * n + 2)
    m2 = Fraction(local[n + 1:].count(codes[change + 1]), n + 1)
    expected = codes[change] if m1 > m2 else codes[change + 1]
    got = normalized(codes, n, closed=True)
    # Later pairs don't touch p(k+1) any more, save the last pair of the ring, which is p(0).
    assert 0 < change + 1 < size
    assert got[change + 1] == expected


@pytest.mark.parametrize('size', range(4, 12))
@pytest.mark.parametrize('n', [4, 5, 100, 10000])
def test_window_of_a_short_closed_chain_holds_no_pixel_twice(size: int, n: int) -> None:
    """The window is shortened: more than the whole ring is no more than the ring."""
    largest = (size - 2) // 2
    rng = np.random.default_rng(size)
    for _ in range(50):
        codes = rng.integers(1, 5, size).tolist()
        assert normalized(codes, max(n, largest), closed=True) == normalized(codes, largest, closed=True)


@settings(max_examples=100, deadline=None)
@given(CODES, st.booleans())
def test_n_of_0_turns_the_step_off(codes: list[int], closed: bool) -> None:
    assert normalized(codes, 0, closed) == codes


@pytest.mark.parametrize('code', [1, 2, 3, 4])
@pytest.mark.parametrize('closed', [False, True])
def test_equal_codes_stay(code: int, closed: bool) -> None:
    assert normalized([code] * 30, 4, closed) == [code] * 30


def test_chains_are_normalized_each_by_itself() -> None:
    parts = [(decode('222322'), False), (decode('3222222222'), True), (decode('4'), False), (decode('114111'), False),
             (decode('3333'), True), (decode('23'), False)]
    codes = np.array([code for part, _ in parts for code in part], np.uint8)
    offsets = np.cumsum([0] + [len(part) for part, _ in parts]).astype(np.int32)
    size = codes.size
    chains = Chains(np.zeros(size, np.int32), codes, np.zeros(size, np.bool_), offsets,
                    np.array([closed for _, closed in parts]))
    normalize_codes(chains, 4)
    assert codes.tolist() == [code for part, closed in parts for code in reference(part, 4, closed)]


def test_no_chains() -> None:
    empty = np.empty(0, np.uint8)
    normalize_codes(Chains(np.empty(0, np.int32), empty, np.empty(0, np.bool_), np.zeros(1, np.int32),
                           np.empty(0, np.bool_)), 4)


@pytest.mark.parametrize('n', [5000, 10000])
@pytest.mark.parametrize('closed', [False, True])
@pytest.mark.parametrize('code', [1, 4])
def test_largest_windows(n: int, closed: bool, code: int) -> None:
    """Counts don't overflow, of any code: runs of thousands of pixels."""
    runs = [(code, 9000), (2, 100), (code, 6000), (3, 12000), (code, 3), (3, 4000), (5 - code, 7000)]
    codes = [value for value, length in runs for _ in range(length)]
    assert normalized(codes, n, closed) == reference_with_numpy(codes, n, closed)


def reference_with_numpy(codes: list[int], n: int, closed: bool) -> list[int]:
    """As the reference, for long chains."""
    d = np.array(codes)
    size = d.size
    if closed:
        n = min(n, (size - 2) // 2)
    for k in range(size if closed else size - 1):
        old, new = d[k], d[(k + 1) % size]
        if old == new:
            continue
        window = np.arange(k - n, k + n + 2)
        window = window % size if closed else window[(window >= 0) & (window < size)]
        start = n + 1 if closed else min(k, n) + 1
        m1, m2 = (d[window] == old).mean(), (d[window[start:]] == new).mean()
        if m1 > m2:
            d[(k + 1) % size] = old
    return d.tolist()

"""Step 3, edge normalisation: a maximum-likelihood decision on each change of code along a chain (section 2.2.2)."""

from typing import Any

import numpy as np

from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.scanning import Chains

#: Counts of the four codes are kept in one number, 16 bits each; windows are cut to what 15 bits can count.
COUNT_BITS, COUNT_MASK, LONGEST = 16, 0xFFFF, 16000


def normalize_codes(chains: Chains, n: int) -> None:
    """Let each code that deviates from its surroundings take the code before it; equations (1) to (5), in place.

    Args:
        chains: Their codes are changed. The window of a closed chain wraps; where the chain is shorter than 2 n + 2
            its window is shortened so that it holds no pixel twice.
        n: Pixels of the window on each side; 0 changes nothing.
    """
    if n > 0:
        normalize_chains(chains.codes, chains.offsets, chains.closed, min(n, LONGEST))


@kernel
def normalize_chains(codes: Any, offsets: Any, closed: Any, n: int) -> None:
    """Normalise each chain by itself."""
    for chain in range(closed.size):
        first, end = offsets[chain], offsets[chain + 1]
        if closed[chain]:
            normalize_closed(codes[first:end], min(n, (end - first - 2) // 2))
        else:
            normalize_open(codes[first:end], n)


@inlined
def one(code: int) -> Any:
    """The counts of a single pixel."""
    return 1 << COUNT_BITS * (np.int64(code) - 1)


@inlined
def count(counts: int, code: int) -> Any:
    """How many of the counted pixels have a code."""
    return counts >> COUNT_BITS * (np.int64(code) - 1) & COUNT_MASK


@inlined
def takes_code_before(before: int, after: int, size_before: int, size_after: int, old: int, new: int) -> bool:
    """Equation (5), whether Lambda > 1: the change from code old, d(k), to code new, d(k+1), is a perturbation.

    P(z|m1) is the share of d(k) among all pixels of the window, equation (1), and P(z|m2) that of d(k+1) among those
    after p(k), equation (2); both are multiplied out.
    """
    m1 = count(before, old) + count(after, old)
    m2 = count(after, new)
    return m1 * size_after > m2 * (size_before + size_after)


@kernel
def normalize_open(codes: Any, n: int) -> None:
    """Normalise an open chain. The windows p(k-n) .. p(k) and p(k+1) .. p(k+n+1) are cut off at its ends."""
    size = codes.size
    before, after = one(codes[0]), 0
    for i in range(1, min(n + 2, size)):
        after += one(codes[i])
    old = codes[0]
    for k in range(size - 1):
        new = kept = codes[k + 1]
        if old != new and takes_code_before(before, after, min(k, n) + 1, min(n + 1, size - k - 1), old, new):
            kept = codes[k + 1] = old
        after -= one(new)
        # Unsigned indices spare the test whether to count from the end.
        if k + n + 2 < size:
            after += one(codes[np.uint64(k + n + 2)])
        before += one(kept)
        if k >= n:
            before -= one(codes[np.uint64(k - n)])
        old = kept


@kernel
def normalize_closed(codes: Any, n: int) -> None:
    """Normalise a closed chain, whose last pair is its last and its first pixel."""
    size = codes.size
    if n < 1:
        return
    before, after = 0, 0
    for i in range(n + 1):
        before += one(codes[(size - i) % size])
        after += one(codes[1 + i])
    for k in range(size):
        following = (k + 1) % size
        old, new = codes[k], codes[following]
        if old != new and takes_code_before(before, after, n + 1, n + 1, old, new):
            codes[following] = old
        after += one(codes[(k + n + 2) % size]) - one(new)
        before += one(codes[following]) - one(codes[(k - n + size) % size])

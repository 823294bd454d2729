"""Bytes with something wrong with them."""

from collections.abc import Callable
from random import Random

#: Numbers at the ends of the types that formats have.
EDGES = (0, 1, 2, 3, 7, 8, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**24, 2**28, 2**31 - 1, 2**31, 2**32 - 1)


def edge(draw: Random) -> int:
    """A number that formats go wrong with."""
    return max(0, draw.choice(EDGES) + draw.randint(-1, 1))


def mutated(data: bytes, draw: Random, most: int = 4) -> bytes:
    """The data after one to so many changes."""
    for _ in range(draw.randint(1, most)):
        data = draw.choice(CHANGES)(data, draw)
    return data


def place_in(data: bytes, draw: Random) -> int:
    """A place, more often near the beginning or the end, where headers and indices are."""
    size = max(1, len(data))
    near = min(size, draw.choice((16, 64, 512, size, size)))
    place = draw.randrange(near)
    return size - 1 - place if draw.random() < 0.3 else place


def _flip(data: bytes, draw: Random) -> bytes:
    place = place_in(data, draw)
    changed = bytearray(data or b'\0')
    changed[place] ^= 1 << draw.randrange(8)
    return bytes(changed)


def _overwrite(data: bytes, draw: Random) -> bytes:
    place = place_in(data, draw)
    piece = draw.randbytes(draw.randint(1, 8))
    return data[:place] + piece + data[place + len(piece):]


def _number(data: bytes, draw: Random) -> bytes:
    """A number of one of the widths that formats have, at an end of its range."""
    place, width = place_in(data, draw), draw.choice((1, 2, 4, 8))
    number = edge(draw) % 2**(8 * width)
    return data[:place] + number.to_bytes(width, draw.choice(('little', 'big'))) + data[place + width:]


def _cut(data: bytes, draw: Random) -> bytes:
    return data[:place_in(data, draw)]


def _without(data: bytes, draw: Random) -> bytes:
    place = place_in(data, draw)
    return data[:place] + data[place + draw.choice((1, 4, 64, 4096)):]


def _twice(data: bytes, draw: Random) -> bytes:
    place, size = place_in(data, draw), draw.choice((1, 4, 64, 4096))
    return data[:place + size] + data[place:]


def _inserted(data: bytes, draw: Random) -> bytes:
    place = place_in(data, draw)
    return data[:place] + draw.randbytes(draw.choice((1, 2, 3, 4, 16))) + data[place:]


def _swapped(data: bytes, draw: Random) -> bytes:
    """Two pieces in each other's place."""
    size = draw.choice((1, 4, 64, 1024))
    first, second = sorted((place_in(data, draw), place_in(data, draw)))
    second = max(first + size, second)
    return (data[:first] + data[second:second + size] + data[first + size:second] + data[first:first + size]
            + data[second + size:])


def _zeroed(data: bytes, draw: Random) -> bytes:
    place, size = place_in(data, draw), draw.choice((4, 64, 1024))
    piece = draw.choice((b'\0', b'\xff')) * min(size, len(data) - place)
    return data[:place] + piece + data[place + len(piece):]


CHANGES: tuple[Callable[[bytes, Random], bytes], ...] = (
    _flip, _flip, _overwrite, _number, _number, _cut, _without, _twice, _inserted, _swapped, _zeroed)

import math
from collections import Counter

import pytest

from line_feature_node.frames import ROW, Frames
from line_feature_node.slices import BANDS, Frame

SOME = [
    Frame('/left', 0, 1_700_000_000_123_456_789, segments=7, seconds=0.5, orientations=[k / 4 for k in range(BANDS)],
          header_stamp=-5),
    Frame('/right', 0, 5, 'of no use'),
    Frame('/left', 4_000_000_000, 6, agreement=[0.5, 0.25, 0.0, 1.0], orientations=[0.0] * BANDS),
    Frame('/right', 1, 7, 'its overlay cannot be', segments=3, orientations=[1.0] * BANDS),
    Frame('/right', 2, 8, 'of no use'),
]


@pytest.fixture
def frames():
    return Frames(SOME)


def test_frames_come_out_as_they_were(frames):
    assert list(frames) == SOME
    assert frames[-1] == SOME[-1]
    assert frames[1:3] == SOME[1:3]
    assert len(frames) == 5
    with pytest.raises(IndexError):
        frames[5]


def test_there_may_be_none():
    assert list(Frames()) == []
    assert Frames().failed == Counter()
    assert len(Frames().good) == 0


def test_an_agreement_of_nothing_is_an_agreement():
    frames = Frames()
    frames.append(Frame('/a', 0, 0, agreement=[math.nan] * 4))
    assert len(frames[0].agreement) == 4
    assert all(map(math.isnan, frames[0].agreement))


def test_reasons_are_counted(frames):
    assert frames.failed == {'of no use': 2, 'its overlay cannot be': 1}
    assert frames.good['stamp'].tolist() == [SOME[0].stamp, 6]


def test_many_frames_take_little_memory():
    frames = Frames()
    for number in range(10_000):
        frames.append(Frame(f'/camera{number % 3}', number, number, f'reason {number % 5}'))
    assert [frame.number for frame in frames] == list(range(10_000))
    assert frames[9_999] == Frame('/camera0', 9_999, 9_999, 'reason 4')
    assert frames.table.base.nbytes <= 2 * 10_000 * ROW.itemsize
    assert ROW.itemsize < 130

"""What became of all frames of a recording, in little memory however many they are."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

from line_feature_node.slices import BANDS, Frame

#: A frame, its topic and its error as numbers of those that there are; orientations and agreement may not be known.
ROW = np.dtype([
    ('topic', 'u2'), ('number', 'u4'), ('stamp', 'u8'), ('error', 'u4'), ('segments', 'u4'), ('seconds', 'f4'),
    ('extracted', '?'), ('orientations', 'f4', BANDS), ('compared', '?'), ('agreement', 'f4', 4),
    ('header_stamp', 'i8')])


class Frames(Sequence[Frame]):
    """Frames without their messages; of their seconds, orientations and agreement seven digits."""

    def __init__(self, frames: Iterable[Frame] = ()) -> None:
        self._rows = np.zeros(64, ROW)
        self._count = 0
        self._topics = _Words()
        self._errors = _Words()
        self._errors.number('')  # 0
        for frame in frames:
            self.append(frame)

    def append(self, frame: Frame) -> None:
        """Add a frame at the end."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count] = (
            self._topics.number(frame.topic), frame.number, frame.stamp, self._errors.number(frame.error),
            frame.segments, frame.seconds, bool(frame.orientations), frame.orientations or 0.0,
            bool(frame.agreement), frame.agreement or 0.0, frame.header_stamp)
        self._count += 1

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, place: int) -> Frame: ...

    @overload
    def __getitem__(self, place: slice) -> list[Frame]: ...

    def __getitem__(self, place: int | slice) -> Frame | list[Frame]:
        if isinstance(place, slice):
            return [self[k] for k in range(*place.indices(self._count))]
        row = self.table[place]
        return Frame(
            self._topics.words[row['topic']], int(row['number']), int(row['stamp']), self._errors.words[row['error']],
            int(row['segments']), float(row['seconds']), row['orientations'].tolist() if row['extracted'] else [],
            row['agreement'].tolist() if row['compared'] else [], int(row['header_stamp']))

    @property
    def table(self) -> NDArray[np.void]:
        """ROW of each; a view of those that there are now."""
        table: NDArray[np.void] = self._rows[:self._count]
        return table

    @property
    def good(self) -> NDArray[np.void]:
        """ROW of those that did not fail."""
        good: NDArray[np.void] = self.table[self.table['error'] == 0]
        return good

    @property
    def failed(self) -> Counter[str]:
        """How many failed, by reason."""
        counts = np.bincount(self.table['error'], minlength=len(self._errors.words)).tolist()
        return Counter({error: count for error, count in zip(self._errors.words, counts, strict=True) if error})


class _Words:
    """Words in the order of their numbers."""

    def __init__(self) -> None:
        self.words: list[str] = []
        self._numbers: dict[str, int] = {}

    def number(self, word: str) -> int:
        """The number of a word, which is new where it is."""
        if word not in self._numbers:
            self._numbers[word] = len(self.words)
            self.words.append(word)
        return self._numbers[word]

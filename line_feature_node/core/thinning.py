"""Edges that are not thinned by suppression: hysteresis alone, and what morphology makes of it (section 3, Fig. 5)."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.edges import CODE, STRONG
from line_feature_node.core.scanning import TAKEN, Chains

#: The two structuring elements of Golay's L, each turned three times by a right angle: 1 is edge, -1 background.
GOLAY = [np.rot90(element, turn) for element in (
    np.array([[-1, -1, -1], [0, 1, 0], [1, 1, 1]]),
    np.array([[0, -1, -1], [1, 1, -1], [0, 1, 0]]),
) for turn in range(4)]


def thin(marks: NDArray[np.uint8]) -> None:
    """Reduce the marks, in place, to the edges after hysteresis, thinned to lines without regard to their norm.

    Pixels on the border of a region that no line needs are taken away, from eight sides in turn, until none is left.
    All that stays is strong: the hysteresis has been.
    """
    edges = connected(marks)
    while True:
        before = np.count_nonzero(edges)
        for element in GOLAY:
            hits = cv2.morphologyEx(edges, cv2.MORPH_HITMISS, element, borderType=cv2.BORDER_CONSTANT, borderValue=0)
            edges[hits != 0] = 0
        if np.count_nonzero(edges) == before:
            break
    marks[:] = np.where(edges != 0, marks | STRONG, 0)


def unscanned(marks: NDArray[np.uint8]) -> Chains:
    """All pixels of thick edges after hysteresis; no chains are there to be scanned.

    Args:
        marks: As edge extraction leaves them; edge pixels become TAKEN.

    Returns:
        Pixels and codes of the edges, and no chains.
    """
    edges = connected(marks)
    pixels = np.flatnonzero(edges).astype(np.int32)
    flat = marks.reshape(-1)
    codes = flat[pixels] & np.uint8(CODE)
    flat[pixels] = TAKEN
    return Chains(pixels, codes, np.zeros(pixels.size, np.bool_), np.zeros(1, np.int32), np.zeros(0, np.bool_))


def connected(marks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """1 where a candidate is 8-connected to a strong one through candidates, 0 elsewhere."""
    _, labels = cv2.connectedComponents((marks != 0).astype(np.uint8), connectivity=8)
    kept: NDArray[Any] = np.zeros(labels.max() + 1, np.uint8)
    kept[labels[marks & STRONG != 0]] = 1
    kept[0] = 0
    return np.asarray(kept[labels])

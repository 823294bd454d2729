"""What each step made of an image, as pictures like the paper's figures."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core import Stages
from line_feature_node.overlay import COLOURS, draw_overlay

Picture = NDArray[np.uint8]

#: Colours by direction code, black for background, as a table to be indexed by code.
CODE_COLOURS = np.array([(0, 0, 0), *COLOURS.values()], np.uint8)
#: Pictures are enlarged to at least this many columns, so that single pixels can be seen.
WIDTH = 960
#: Height of the line above a picture, with its caption.
CAPTION = 26


def stage_pictures(image: Picture, stages: Stages, scale: int | None = None) -> dict[str, Picture]:
    """What each step made, by name and in order; BGR, enlarged by a whole number of times.

    `edges` has all edge pixels in white, those that only hysteresis keeps in grey; `chains` a colour for each chain,
    white where a gap was filled; `codes-before` and `codes-after` normalisation and the segments the colours of their
    direction codes; `blobs` a colour for each line-blob.

    Args:
        image: H×W or H×W×3 uint8, for display.
        stages: What the steps made of it.
        scale: How many times the pictures are enlarged; None for what makes single pixels visible.
    """
    shape = stages.grey.shape
    chains = np.repeat(np.arange(len(stages.chain_offsets) - 1), np.diff(stages.chain_offsets))
    blobs = np.repeat(np.arange(len(stages.blobs)), np.diff(stages.blob_offsets))
    chain_colours = hues(chains)
    chain_colours[stages.bridged[:len(chains)]] = 255
    edges = np.where(stages.strong, 255, 140) * (stages.edges != 0)
    blank = np.zeros(shape, np.uint8)
    scale = scale or enlargement(shape[1])
    return {
        'image': draw_overlay(enlarged(image, scale), np.empty(0, stages.segments.dtype)),
        'edges': enlarged(cv2.cvtColor(edges.astype(np.uint8), cv2.COLOR_GRAY2BGR), scale),
        'chains': enlarged(painted(shape, stages.chain_pixels[:len(chains)], chain_colours), scale),
        'codes-before': enlarged(painted(shape, stages.chain_pixels, CODE_COLOURS[stages.codes_before]), scale),
        'codes-after': enlarged(painted(shape, stages.chain_pixels, CODE_COLOURS[stages.codes_after]), scale),
        'blobs': enlarged(painted(shape, stages.blob_pixels, hues(blobs)), scale),
        'segments-unlinked': draw_overlay(enlarged(blank, scale), scaled(stages.unlinked, scale)),
        'segments': draw_overlay(enlarged(blank, scale), scaled(stages.linked, scale)),
    }


def sheet(pictures: dict[str, Picture], columns: int) -> Picture:
    """Pictures of one size side by side, each under its name."""
    cells = []
    for name, picture in pictures.items():
        head = np.full((CAPTION, picture.shape[1], 3), 40, np.uint8)
        cv2.putText(head, name, (8, CAPTION - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
        cells.append(cv2.copyMakeBorder(np.vstack([head, picture]), 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=[40] * 3))
    cells += [np.zeros_like(cells[0])] * (-len(cells) % columns)
    return np.vstack([np.hstack(cells[k:k + columns]) for k in range(0, len(cells), columns)])


def painted(shape: tuple[int, ...], pixels: NDArray[np.int32], colours: Picture) -> Picture:
    """A black picture with pixels (N×2, column and row) in their colours (N×3)."""
    picture = np.zeros((*shape, 3), np.uint8)
    picture[pixels[:, 1], pixels[:, 0]] = colours
    return picture


def hues(numbers: NDArray[Any]) -> Picture:
    """A colour (N×3) for each number, as different as can be for numbers near each other: the golden ratio's hues."""
    hue = (numbers * 0.618034 % 1 * 180).astype(np.uint8)
    colour = np.stack([hue, np.full_like(hue, 190), np.full_like(hue, 255)], -1)[None]
    return np.asarray(cv2.cvtColor(colour, cv2.COLOR_HSV2BGR)[0] if len(numbers) else colour[0], np.uint8)


def enlargement(width: int) -> int:
    """How many times a picture is to be enlarged."""
    return max(1, -(-WIDTH // width))


def enlarged(picture: Picture, scale: int) -> Picture:
    """A picture with each pixel as a square of scale×scale."""
    return np.repeat(np.repeat(picture, scale, 0), scale, 1)


def scaled(segments: NDArray[np.void], scale: int) -> NDArray[np.void]:
    """Segments in the coordinates of the enlarged picture."""
    result = segments.copy()
    for name in ('x', 'y', 'x1', 'y1', 'x2', 'y2'):
        result[name] = (segments[name] + 0.5) * scale - 0.5
    return result

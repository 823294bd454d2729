"""Segments drawn over the image in which they were found."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core import end_points

#: Colours (BGR) of the direction codes 1 to 4, told apart by colour-blind eyes too (after Okabe and Ito).
COLOURS = {1: (0, 94, 213), 2: (115, 158, 0), 3: (233, 180, 86), 4: (66, 228, 240)}
#: The edges that a direction code stands for: its section of the gradient, and what lies across it.
SECTIONS = {1: 'vertical', 2: 'rising', 3: 'horizontal', 4: 'falling'}
#: Brightness that is left of the picture, so that the segments stand out.
BACKGROUND = 0.7
#: The longest side that libjpeg accepts.
JPEG_SIDE = 65500
#: Bits behind the binary point of the coordinates that OpenCV draws.
SHIFT = 4


def draw_overlay(image: NDArray[Any], segments: NDArray[np.void], caption: str = '') -> NDArray[np.uint8]:
    """Draw segments, coloured by direction code and with their end points, over a darkened grey picture.

    Args:
        image: H×W, H×W×3 (BGR) or H×W×4 (BGRA), uint8.
        segments: SEGMENT_DTYPE.
        caption: A line of text for the top left corner.

    Returns:
        H×W×3 uint8, BGR; a new array.
    """
    canvas = _darkened(image)
    ends = end_points(segments)
    thickness = max(1, round(max(canvas.shape[:2]) / 900))
    points = np.round(ends * 2**SHIFT).astype(int)
    for (x1, y1, x2, y2), code in zip(points.tolist(), segments['code'].tolist(), strict=True):
        cv2.line(canvas, (x1, y1), (x2, y2), COLOURS[code], thickness, cv2.LINE_AA, SHIFT)
    for x1, y1, x2, y2 in points.tolist():
        for end in ((x1, y1), (x2, y2)):
            cv2.circle(canvas, end, round(thickness * 1.2 * 2**SHIFT), (255, 255, 255), -1, cv2.LINE_AA, SHIFT)
    if caption:
        _write(canvas, caption)
    return canvas


def encode_jpeg(picture: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """The bytes of a JPEG.

    Raises:
        ValueError: The picture is wider or higher than a JPEG can be.
    """
    if max(picture.shape[:2]) > JPEG_SIDE:
        height, width = picture.shape[:2]
        raise ValueError(f'{width}×{height} pixels are more than a JPEG can have, {JPEG_SIDE} a side')
    return np.asarray(cv2.imencode('.jpg', picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], np.uint8)


def _darkened(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Grey as BGR; made darker before, while it is a third of that."""
    if image.ndim == 3 and image.shape[2] > 1:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
    return np.asarray(cv2.cvtColor(cv2.convertScaleAbs(image, alpha=BACKGROUND), cv2.COLOR_GRAY2BGR), np.uint8)


def _write(canvas: NDArray[np.uint8], caption: str) -> None:
    """A caption in white on black, so that it can be read on any picture."""
    scale = max(0.4, max(canvas.shape[:2]) / 1400)
    (width, height), base = cv2.getTextSize(caption, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    cv2.rectangle(canvas, (0, 0), (width + 8, height + base + 6), (0, 0, 0), -1)
    cv2.putText(canvas, caption, (4, height + 4), cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)

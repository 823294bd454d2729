"""What is looked at and what is kept: region of interest, mask and scale before the six steps, selection after them."""

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.features import VERTICAL
from line_feature_node.core.parameters import RIGHT_ANGLE, Parameters

#: Pixels around an unknown one whose gradient its stand-in would tell on.
REACH = 4


@lru_cache(maxsize=64)
def region(roi: tuple[float, float, float, float], width: int, height: int) -> tuple[int, int, int, int]:
    """The part of a picture that a region of interest covers: x, y, width and height in pixels.

    Shares are rounded to whole pixels; what lies beyond the picture is left out.

    Raises:
        ValueError: Nothing of the region lies in the picture.
    """
    x, y, w, h = roi
    x_unit, y_unit = (1, 1) if max(roi) > 1 else (width, height)  # pixels
    left, right = (min(round(value * x_unit), width) for value in (x, x + w))
    top, bottom = (min(round(value * y_unit), height) for value in (y, y + h))
    if left >= right or top >= bottom:
        raise ValueError(f'roi {list(roi)} leaves nothing of an image of {width}×{height} pixels')
    return left, top, right - left, bottom - top


def check_mask(mask: Any, shape: tuple[int, ...]) -> None:
    """Raise what is wrong with a mask for an image of a shape."""
    if not isinstance(mask, np.ndarray):
        raise TypeError(f'mask must be a numpy array, got {type(mask).__name__}')
    if mask.dtype not in (np.uint8, np.bool_):
        raise TypeError(f'mask must be bool or uint8, got {mask.dtype}')
    if mask.shape != shape[:2]:
        raise ValueError(f'mask must have the shape of the image, {shape[:2]}, got {mask.shape}')


def filled(grey: NDArray[Any], mask: NDArray[np.uint8]) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Give pixels that are NaN or infinite the value of the nearest that is not, where they are masked.

    Args:
        grey: H×W float32.
        mask: H×W uint8, 0 where pixels do not count, else 255.

    Returns:
        The image, finite, and the mask, in which pixels near those that were filled do not count either.

    Raises:
        ValueError: A pixel that counts is not finite, or none is finite.
    """
    unknown = (~np.isfinite(grey)).astype(np.uint8)
    if not unknown.any():
        return grey, mask
    if (unknown & (mask != 0)).any():
        raise ValueError('image must be finite where it is not masked, got pixels that are NaN or infinite')
    if unknown.all():
        raise ValueError('image must have finite pixels, got none')
    _, labels = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    values = np.empty(int(labels.max()) + 1, grey.dtype)
    known = unknown == 0
    values[labels[known]] = grey[known]
    around = cv2.dilate(unknown, np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8))
    return values[labels], np.where(around != 0, 0, mask).astype(np.uint8)


def smaller(image: NDArray[Any], mask: NDArray[np.uint8] | None, scale: float) -> tuple[NDArray[Any], Any]:
    """The image made smaller, each pixel the mean of what it covers, and its mask: where all of that counts."""
    height, width = (max(1, round(size * scale)) for size in image.shape)
    if mask is not None:
        masked = cv2.resize((mask == 0).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        mask = np.where(masked > 0, np.uint8(0), np.uint8(255))
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)), mask


def enlarged(image: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """The image in a larger size, each pixel that which covers its centre or begins there."""
    rows, columns = (np.arange(large) * small // large
                     for large, small in zip((height, width), image.shape, strict=True))
    return np.asarray(image[rows[:, None], columns])


def placed(segments: NDArray[np.void], x: float, y: float, across: float, down: float) -> NDArray[np.void]:
    """Segments, in place, in pixels of the full picture.

    Args:
        segments: SEGMENT_DTYPE, in pixels of a part of the picture.
        x: Column of the part's left edge.
        y: Row of its top edge.
        across: Columns of the full picture for each of the part.
        down: Rows for each of the part.
    """
    for names, factor, start in ((('x', 'x1', 'x2'), across, x), (('y', 'y1', 'y2'), down, y)):
        for name in names:
            segments[name] = (segments[name] + 0.5) * factor - 0.5 + start
    theta = segments['theta'].astype(float)
    cos, sin = np.cos(theta), np.sin(theta)
    if across != down:  # sizes are rounded to pixels
        norm = np.hypot(cos * across, sin * down)
        cos, sin = cos * across / norm, sin * down / norm
        segments['theta'] = np.arctan2(sin, cos)
    segments['length'] = np.hypot(segments['x2'] - segments['x1'], segments['y2'] - segments['y1'])
    with np.errstate(divide='ignore', over='ignore'):
        slope = np.where(cos >= VERTICAL, sin / cos, np.nan)
    segments['intercept'] = segments['y'] - slope * segments['x']
    segments['rho'] = segments['y'] * cos - segments['x'] * sin
    segments['sigma_offset'] *= np.sqrt(across * down)
    return segments


def selected(segments: NDArray[np.void], parameters: Parameters) -> NDArray[np.void]:
    """The segments that are long enough, in the band of orientations, and among the longest; in their order."""
    p = parameters
    if p.min_length > 0:
        segments = segments[segments['length'] >= p.min_length]
    if (p.theta_min, p.theta_max) != (-RIGHT_ANGLE, RIGHT_ANGLE):
        above, below = segments['theta'] >= p.theta_min, segments['theta'] <= p.theta_max
        segments = segments[above & below if p.theta_min <= p.theta_max else above | below]
    if 0 < p.max_segments < len(segments):
        longest = np.argsort(-segments['length'], kind='stable')[:p.max_segments]
        segments = segments[np.sort(longest)]
    return segments

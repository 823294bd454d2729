"""How well segments agree with ground truth."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core import SEGMENT_DTYPE
from line_feature_node.core.features import UNREFINED, VERTICAL

#: A segment matches a true one when both its ends are this near to the true line (pixels), ...
DISTANCE = 2.0
#: ... the two differ by less than this in orientation (radians), ...
ANGLE = np.radians(3)
#: ... and they share more than this part of the shorter one.
OVERLAP = 0.5


@dataclass(frozen=True)
class Agreement:
    """What became of the segments and of the ground truth.

    Attributes:
        precision: Share of the length of the segments that lies on true ones; NaN without segments.
        recall: Share of the true length that is covered; NaN without ground truth.
        angle: Median difference in orientation of the segments that match, radians; NaN where none does.
        offset: Median distance between their mid-points and the true line, pixels.
    """

    precision: float
    recall: float
    angle: float
    offset: float


def compare(
    segments: NDArray[np.floating], truth: NDArray[np.floating], weak: NDArray[np.floating] | None = None,
) -> Agreement:
    """Compare segments with the true ones.

    Args:
        segments: N×4, end points x1, y1, x2, y2 in pixels.
        truth: M×4, true segments.
        weak: K×4, true segments too faint or too short to ask for: what matches only these is not counted.
    """
    matched, low, high, offset, angle = match(segments, truth)
    counted = matched.any(1) | (True if weak is None else ~match(segments, weak)[0].any(1))
    shared = np.where(matched, high - low, 0.0)
    length, true_length = _lengths(segments), _lengths(truth)
    covered = sum(_union(low[matched[:, j], j], high[matched[:, j], j]) for j in range(len(truth)))
    best = shared.argmax(1) if len(truth) else np.zeros(len(segments), int)
    hits = np.flatnonzero(matched.any(1))
    on_truth = np.minimum(shared.max(1, initial=0.0), length)[counted].sum()
    return Agreement(
        precision=float(on_truth / length[counted].sum()) if counted.any() else float('nan'),
        recall=float(covered / true_length.sum()) if len(truth) else float('nan'),
        angle=float(np.median(angle[hits, best[hits]])) if len(hits) else float('nan'),
        offset=float(np.median(offset[hits, best[hits]])) if len(hits) else float('nan'),
    )


def _lengths(segments: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])


def match(
    segments: NDArray[np.floating], truth: NDArray[np.floating],
) -> tuple[NDArray[np.bool_], NDArray[np.floating], NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """For all pairs, N×M: match or not, the interval shared along the true one, offset of the middle, angle."""
    length, true_length = _lengths(segments), _lengths(truth)
    along = (truth[:, 2:] - truth[:, :2]) / np.maximum(true_length, 1e-9)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], -1)
    ends = [segments[:, None, k:k + 2] - truth[None, :, :2] for k in (0, 2)]
    distances = [(end * normal).sum(-1) for end in ends]
    places = [(end * along).sum(-1) for end in ends]
    low = np.clip(np.minimum(*places), 0, true_length)
    high = np.clip(np.maximum(*places), 0, true_length)
    sine = (distances[1] - distances[0]) / np.maximum(length, 1e-9)[:, None]
    angle = np.arcsin(np.clip(np.abs(sine), 0, 1))
    matched = ((np.maximum(*np.abs(distances)) <= DISTANCE) & (angle < ANGLE)
               & (high - low > OVERLAP * np.minimum(length[:, None], true_length)))
    return matched, low, high, np.abs(distances[0] + distances[1]) / 2, angle


def _union(low: NDArray[np.floating], high: NDArray[np.floating]) -> float:
    """Length of the union of intervals."""
    total, reach = 0.0, -np.inf
    for k in np.argsort(low):
        total += max(0.0, high[k] - max(low[k], reach))
        reach = max(reach, high[k])
    return total


def segments_of_truth(truth: NDArray[np.floating], weak: NDArray[np.floating]) -> NDArray[np.void]:
    """True segments in the layout of those that are found.

    Args:
        truth: N×4, end points x1, y1, x2, y2 in pixels.
        weak: M×4, those that are too weak to be asked for.

    Returns:
        SEGMENT_DTYPE; `size` is the length in whole pixels, but 0 marks the weak ones.
    """
    ends = np.concatenate([truth, weak])
    segments = np.zeros(len(ends), SEGMENT_DTYPE)
    for name, value in UNREFINED.items():
        segments[name] = value
    for name, column in zip(('x1', 'y1', 'x2', 'y2'), ends.T, strict=True):
        segments[name] = column
    segments['x'], segments['y'] = (ends[:, 0] + ends[:, 2]) / 2, (ends[:, 1] + ends[:, 3]) / 2
    length = _lengths(ends)
    cos, sin = (ends[:, 2] - ends[:, 0]) / length, (ends[:, 3] - ends[:, 1]) / length
    turned = np.where((cos < 0) | ((cos == 0) & (sin < 0)), -1, 1)
    cos, sin = cos * turned, sin * turned
    theta = np.arctan2(sin, cos)
    segments['length'], segments['theta'] = length, theta
    slope = np.where(cos >= VERTICAL, sin / np.maximum(cos, VERTICAL), np.nan)
    segments['intercept'] = segments['y'] - slope * segments['x']
    segments['rho'] = segments['y'] * cos - segments['x'] * sin
    # The gradient is at right angles to the edge: of an upright one it is horizontal, code 1.
    segments['code'] = 1 + np.round((theta + np.pi / 2) / (np.pi / 4)).astype(int) % 4
    segments['size'][:len(truth)] = np.round(length[:len(truth)])
    return segments

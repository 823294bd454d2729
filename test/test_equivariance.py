"""A turned or mirrored image has the turned or mirrored edges, and segments on the same lines; any size will do."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from line_feature_node.core import LineFeatureExtractor, Parameters, end_points
from line_feature_node.scenes import Camera, corridor

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'
PHOTOS = [*sorted((DATA / 'york' / 'images').glob('*.jpg'))[:6], *sorted((DATA / 'scenes' / 'corridor').glob('*.jpg'))]
BOTH = pytest.mark.parametrize('profile', ['default', 'paper'])
#: The moved image, and where a point (x, y) comes to lie when the last column is `right` and the last row `bottom`.
MOVES: dict[str, tuple[Callable[[Any], Any], Callable[..., Any]]] = {
    'mirrored': (np.fliplr, lambda x, y, right, _: (right - x, y)),
    'upside down': (np.flipud, lambda x, y, _, bottom: (x, bottom - y)),
    'turned left': (np.rot90, lambda x, y, right, _: (y, right - x)),
    'turned half': (lambda image: image[::-1, ::-1], lambda x, y, right, bottom: (right - x, bottom - y)),
    'transposed': (np.transpose, lambda x, y, *_: (y, x)),
}


def covered(segments: Any, others: Any) -> float:
    """Length of segments (N×4) of which each point has another within 2 px and 10 degrees."""
    along = others[:, 2:] - others[:, :2]
    lengths = np.hypot(along[:, 0], along[:, 1])
    along = along / lengths[:, None]
    total = 0.0
    for segment in segments:
        step = segment[2:] - segment[:2]
        length = np.hypot(*step)
        near = np.abs(step[0] * along[:, 1] - step[1] * along[:, 0]) < np.sin(np.radians(10)) * length
        points = segment[:2] + (np.arange(0.5, length, 1)[:, None] / length) * step
        relative = points[:, None] - others[near, :2]
        place = (relative * along[near]).sum(-1)
        offset = np.abs(relative[..., 1] * along[near, 0] - relative[..., 0] * along[near, 1])
        hit = ((place > -1) & (place < lengths[near] + 1) & (offset < 2)).any(1)
        total += length * hit.mean() if len(hit) else 0.0
    return total


def check(images: list[Any], move: str, profile: str) -> None:
    turned, moved = MOVES[move]
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    pixels = changed = length = shared = 0.0
    for image in images:
        bottom, right = np.array(image.shape) - 1
        before, after = extractor.stages(image), extractor.stages(np.ascontiguousarray(turned(image)))
        pixels += image.size
        changed += np.count_nonzero((turned(before.edges) != 0) != (after.edges != 0))
        ends = end_points(before.segments)
        expected = np.column_stack([*moved(ends[:, 0], ends[:, 1], right, bottom),
                                    *moved(ends[:, 2], ends[:, 3], right, bottom)])
        for first, second in ((expected, end_points(after.segments)), (end_points(after.segments), expected)):
            length += np.hypot(first[:, 2] - first[:, 0], first[:, 3] - first[:, 1]).sum()
            shared += covered(first, second)
    # The noise is measured in some rows, so a picture on its side has another alpha and other thresholds, by a little.
    assert changed <= pixels / (1000 if extractor.parameters.adaptive else 10000)
    assert shared >= 0.95 * length


@BOTH
@pytest.mark.parametrize('move', MOVES)
def test_rendered_corridors(profile: str, move: str) -> None:
    check([cv2.cvtColor(corridor(Camera(x=2.0 + 4 * k), seed=k, layout=k).image, cv2.COLOR_BGR2GRAY)
           for k in range(3)], move, profile)


@pytest.mark.skipif(not PHOTOS, reason='the photographs are not part of the project')
@BOTH
@pytest.mark.parametrize('move', MOVES)
def test_photographs(profile: str, move: str) -> None:
    check([cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in PHOTOS], move, profile)


@BOTH
@pytest.mark.parametrize('shape', [(1, 1), (4320, 1), (1, 7680), (3, 7680), (4320, 7680)])
def test_extreme_sizes(profile: str, shape: tuple[int, int]) -> None:
    """One-pixel-wide images and 8K ones: a cross is found wherever there is room for one."""
    image = np.full(shape, 60, np.uint8)
    middle = shape[0] // 2, shape[1] // 2
    image[middle[0]:, middle[1]:] = 200
    segments = LineFeatureExtractor(Parameters.profile(profile)).extract(image)
    if min(shape) > 100:
        assert len(segments) == 2
        assert sorted(segments['length']) == pytest.approx([shape[0] / 2, shape[1] / 2], abs=12)
    assert np.all(np.abs(end_points(segments)[:, ::2] - (shape[1] - 1) / 2) <= shape[1] / 2)

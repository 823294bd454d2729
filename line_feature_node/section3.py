"""Section 3 of the paper: what thinning, and the way of fitting, do to the lines (Fig. 5)."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from line_feature_node.core import LineFeatureExtractor, Parameters, Stages, end_points
from line_feature_node.figures import CODE_COLOURS, Picture, enlarged, enlargement, scaled
from line_feature_node.overlay import draw_overlay
from line_feature_node.scenes import Camera, corridor
from line_feature_node.truth import compare

#: Part of the width and of the height that the enlarged region of Fig. 5c shows.
REGION = 0.15
#: Where the camera stands in the corridors that errors are measured in, metres; each has another layout.
PLACES = (1.0, 2.5, 4.0, 5.5, 7.0, 8.5, 10.0, 11.5)


@dataclass(frozen=True)
class Errors:
    """How one combination does on rendered scenes: means over them.

    Attributes:
        thinning, orientation: The combination.
        precision, recall: As :class:`line_feature_node.truth.Agreement` has them.
        angle: Radians.
        offset: Pixels.
    """

    thinning: str
    orientation: str
    precision: float
    recall: float
    angle: float
    offset: float


def measure_errors(parameters: Parameters, noise: float = 4.0) -> list[Errors]:
    """Hold every combination of thinning and orientation against the truth of rendered corridors.

    Args:
        parameters: All others.
        noise: Standard deviation in grey levels.
    """
    scenes = [corridor(Camera(x=x), noise=noise, seed=k, layout=k) for k, x in enumerate(PLACES)]
    rows = []
    for thinning in Parameters.specs()['thinning'].choices:
        for orientation in Parameters.specs()['orientation'].choices:
            extractor = LineFeatureExtractor(replace(
                parameters, thinning=thinning, orientation=orientation, grouping='codes', refine=False))
            figures = []
            for scene in scenes:
                agreement = compare(end_points(extractor.extract(scene.image)), scene.truth, scene.weak)
                figures.append((agreement.precision, agreement.recall, agreement.angle, agreement.offset))
            rows.append(Errors(thinning, orientation, *map(float, np.mean(figures, 0))))
    return rows


def compare_pictures(image: Picture, parameters: Parameters) -> dict[str, Picture]:
    """The six panels of Fig. 5 by caption, for an image of bytes; and which region (c) shows is framed in (b)."""
    ways = {way: LineFeatureExtractor(replace(parameters, thinning=way)).stages(image)
            for way in ('none', 'morphological', 'suppression')}
    thick = ways['none']
    bent = LineFeatureExtractor(replace(parameters, thinning='none', orientation='least_squares')).stages(image)
    region = telling_region(thick, bent)
    scale = enlargement(image.shape[1])
    framed = edge_picture(thick, scale)
    x, y, width, height = region
    cv2.rectangle(framed, (x * scale, y * scale), ((x + width) * scale, (y + height) * scale), (255, 255, 255), 2)
    plain = np.empty(0, thick.segments.dtype)
    return {
        '(a) image': draw_overlay(enlarged(image, scale), plain),
        '(b) hysteresis alone': framed,
        '(c) frame of (b): white principal axis, red least squares': region_picture(thick, bent, region, framed.shape),
        '(d) thinned without regard to the norm': edge_picture(ways['morphological'], scale),
        '(e) non-maximum suppression': edge_picture(ways['suppression'], scale),
        '(f) segments from (e)': draw_overlay(enlarged(image, scale), scaled(ways['suppression'].segments, scale)),
    }


def edge_picture(stages: Stages, scale: int) -> Picture:
    """The quintuple image in the colours of its codes."""
    return enlarged(CODE_COLOURS[stages.edges], scale)


def telling_region(thick: Stages, bent: Stages) -> tuple[int, int, int, int]:
    """Where principal axis and least squares differ most among the larger line-blobs: x, y, width and height."""
    height, width = thick.grey.shape
    region_width, region_height = max(1, round(width * REGION)), max(1, round(height * REGION))
    lines, others = thick.unlinked, bent.unlinked
    if not len(lines) or len(lines) != len(others):
        return 0, 0, region_width, region_height
    turned = np.abs(np.sin(lines['theta'].astype(float) - others['theta']))
    large = lines['length'] >= np.sort(lines['length'])[-min(30, len(lines))]
    telling = lines[np.where(large, turned * lines['length'], -1).argmax()]
    x = np.clip(telling['x'] - region_width / 2, 0, width - region_width)
    y = np.clip(telling['y'] - region_height / 2, 0, height - region_height)
    return int(x), int(y), region_width, region_height


def region_picture(
    thick: Stages, bent: Stages, region: tuple[int, int, int, int], shape: tuple[int, ...],
) -> Picture:
    """A region of thick edges, enlarged to a size, with the lines that both ways of fitting find in it."""
    x, y, width, height = region
    picture = cv2.resize(CODE_COLOURS[thick.edges[y:y + height, x:x + width]] // 2, (shape[1], shape[0]),
                         interpolation=cv2.INTER_NEAREST)
    factors = np.tile([shape[1] / width, shape[0] / height], 2)
    for segments, colour in ((bent.unlinked, (60, 60, 255)), (thick.unlinked, (255, 255, 255))):
        corners = (end_points(segments) - [x, y, x, y] + 0.5) * factors
        for x1, y1, x2, y2 in np.round(corners * 16).astype(int).tolist():
            cv2.line(picture, (x1, y1), (x2, y2), colour, 2, cv2.LINE_AA, 4)
    return np.asarray(picture, np.uint8)

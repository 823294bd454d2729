"""Step 5, line features: mid-point, orientation, intercept, end points and length of line-blobs (Appendix A)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.blobs import Blobs
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.compiling import inlined, kernel
from line_feature_node.core.parameters import Parameters

#: One segment, as users get it and as the PointCloud2 message lays it out. Pixels and radians; the centre of the
#: top-left pixel is (0, 0).
SEGMENT_DTYPE = np.dtype([
    ('x', np.float32), ('y', np.float32), ('z', np.float32),    # mid-point (A.1); z is 0
    ('x1', np.float32), ('y1', np.float32),                     # first end point (A.5, A.6)
    ('x2', np.float32), ('y2', np.float32),                     # second end point
    ('length', np.float32),                                     # between the end points
    ('theta', np.float32),                                      # orientation (A.2), in (-pi/2, pi/2]
    ('intercept', np.float32),                                  # of the y axis (A.4); NaN for a vertical line
    ('rho', np.float32),                                        # -x sin(theta) + y cos(theta): distance from the origin
    ('code', np.uint32),                                        # gradient direction code, 1 to 4
    ('size', np.uint32),                                        # edge pixels
    # The rest is known of refined segments only: NaN, and polarity 0, of others.
    ('sigma_theta', np.float32),                                # standard deviation of theta
    ('sigma_offset', np.float32),                               # and of the mid-point's position across the segment
    ('contrast', np.float32),                                   # grey levels of the step across it
    ('polarity', np.int32),                                     # 1: brighter on the side of (-sin, cos); -1: darker
    ('log_nfa', np.float32),                                    # log10 of the number of false alarms as clear as this
])

#: What the fields have that are known of refined segments only, in others.
UNREFINED = {'sigma_theta': np.nan, 'sigma_offset': np.nan, 'contrast': np.nan, 'polarity': 0, 'log_nfa': np.nan}

#: A line while it is computed: sums over its pixels, its minimum rectangle, and what follows from them.
LINE_DTYPE = np.dtype([
    ('n', np.float64), ('sx', np.float64), ('sy', np.float64),
    ('sxx', np.float64), ('sxy', np.float64), ('syy', np.float64),
    ('min_col', np.float64), ('min_row', np.float64), ('max_col', np.float64), ('max_row', np.float64),
    ('code', np.int64),
    ('x', np.float64), ('y', np.float64),               # mid-point
    ('cos', np.float64), ('sin', np.float64),           # direction, cos >= 0
    ('x1', np.float64), ('y1', np.float64), ('x2', np.float64), ('y2', np.float64),
])

#: Below this |cos(theta)| a line has no intercept.
VERTICAL = 1e-6


def compute_lines(
    blobs: Blobs, shape: tuple[int, int], parameters: Parameters, buffers: Buffers,
) -> tuple[NDArray[np.void], int]:
    """Compute the line of each blob that has an orientation and min_size pixels; pixels that fill a gap don't count.

    Args:
        blobs: The line-blobs.
        shape: Height and width of the image, to which end points are clipped.
        parameters: min_size and orientation are used.
        buffers: Memory to work in.

    Returns:
        LINE_DTYPE, with room for twice as many as there are; and how many there are.
    """
    lines = buffers.array('lines', 2 * blobs.attributes.size, LINE_DTYPE)
    height, width = shape
    count = fit_blobs(blobs.attributes, blobs.moments, parameters.min_size, parameters.orientation == 'least_squares',
                      float(height), float(width), lines)
    return lines, int(count)


@kernel
def fit_blobs(
    blobs: Any, moments: Any, min_size: int, least_squares: bool, height: float, width: float, lines: Any,
) -> int:
    """Fit the line of each blob."""
    count = 0
    for label in range(blobs.size):
        blob = blobs[label]
        if not blob['select'] or moments[label, 0] < min_size:
            continue
        line = lines[count]
        line['n'], line['sx'], line['sy'] = moments[label, 0], moments[label, 1], moments[label, 2]
        line['sxx'], line['sxy'], line['syy'] = moments[label, 3], moments[label, 4], moments[label, 5]
        line['min_col'], line['max_col'] = blob['min_col'], blob['max_col']
        line['min_row'], line['max_row'] = blob['min_row'], blob['max_row']
        line['code'] = blob['dir']
        if fit(line, least_squares, height, width):
            count += 1
    return count


@inlined
def fit(line: Any, least_squares: bool, height: float, width: float) -> bool:
    """Compute mid-point, direction and end points of a line from its sums; False when it has no direction."""
    n = line['n']
    line['x'], line['y'] = line['sx'] / n, line['sy'] / n
    # Central moments (A.3) multiplied by n: whole numbers again, so that a straight line's vanish exactly.
    mu20 = n * line['sxx'] - line['sx'] * line['sx']
    mu11 = n * line['sxy'] - line['sx'] * line['sy']
    mu02 = n * line['syy'] - line['sy'] * line['sy']
    cos, sin = regression(mu20, mu11, mu02) if least_squares else principal_axis(mu20, mu11, mu02)
    if cos == 0 and sin == 0:
        return False
    line['cos'], line['sin'] = cos, sin
    set_end_points(line, height, width)
    return True


@inlined
def principal_axis(mu20: float, mu11: float, mu02: float) -> tuple[float, float]:
    """Cosine and sine of theta = atan(2 mu11 / (mu20 - mu02)) / 2, equation (A.2); both 0 where all axes are equal.

    With r the hypotenuse of 2 mu11 and mu20 - mu02, cos(2 theta) = (mu20 - mu02) / r and sin(2 theta) = 2 mu11 / r.
    The larger one of cos(theta) and sin(theta) is taken from the first, the other from the second, so that nothing
    cancels and horizontal and vertical lines are exact.
    """
    difference = mu20 - mu02
    r = np.sqrt(4 * mu11 * mu11 + difference * difference)
    if r == 0:
        return 0.0, 0.0
    if difference >= 0:
        cos = np.sqrt((r + difference) / (2 * r))
        return cos, mu11 / (r * cos)
    sin = np.sqrt((r - difference) / (2 * r))
    return rightward(mu11 / (r * sin), sin)


@inlined
def regression(mu20: float, mu11: float, mu02: float) -> tuple[float, float]:
    """Cosine and sine of the least-squares line: y on x, or x on y where that is steep; both 0 for equal axes."""
    if mu11 == 0 and mu20 == mu02:
        return 0.0, 0.0
    x, y = (mu20, mu11) if mu20 >= mu02 else (mu11, mu02)
    r = np.hypot(x, y)
    return rightward(x / r, y / r)


@inlined
def rightward(cos: float, sin: float) -> tuple[float, float]:
    """The one of two opposite directions that points to the right; down where both are vertical."""
    if cos < 0:
        return -cos, -sin
    if cos == 0:
        return 0.0, 1.0
    return cos, sin


@inlined
def set_end_points(line: Any, height: float, width: float) -> None:
    """End points on the minimum rectangle, (A.5) and (A.6), clipped to the image along the line.

    The text compares |tan(theta)| with the arc tangent of the rectangle's slope, a misprint for the slope. Both
    sides are multiplied by |cos(theta)| (x1 - x0) here, so that a vertical line needs no special case, save that a
    rectangle one pixel wide has no slope.
    """
    width_of, height_of = line['max_col'] - line['min_col'], line['max_row'] - line['min_row']
    x, y, cos, sin = line['x'], line['y'], line['cos'], line['sin']
    if abs(sin) * width_of > abs(cos) * height_of or cos == 0:
        first, last = (line['min_row'] - y) / sin, (line['max_row'] - y) / sin
    else:
        first, last = (line['min_col'] - x) / cos, (line['max_col'] - x) / cos
    first, last = clip(first, last, x, cos, width)
    first, last = clip(first, last, y, sin, height)
    line['x1'], line['y1'] = x + first * cos, y + first * sin
    line['x2'], line['y2'] = x + last * cos, y + last * sin


@inlined
def clip(first: float, last: float, start: float, step: float, size: float) -> tuple[float, float]:
    """Shorten an interval of t so that start + t step stays within [-1/2, size - 1/2]."""
    if step == 0:
        return first, last
    a, b = (-0.5 - start) / step, (size - 0.5 - start) / step
    low, high = min(a, b), max(a, b)
    return min(max(first, low), high), min(max(last, low), high)


def end_points(segments: NDArray[np.void]) -> NDArray[np.float64]:
    """End points of SEGMENT_DTYPE records: N×4, x1, y1, x2, y2."""
    return np.stack([segments[name] for name in ('x1', 'y1', 'x2', 'y2')], -1).astype(float)


def segments_of(lines: NDArray[np.void], alive: NDArray[np.bool_]) -> NDArray[np.void]:
    """The lines that are left as a new SEGMENT_DTYPE array."""
    segments = np.empty(np.count_nonzero(alive), SEGMENT_DTYPE)
    write_segments(lines[:alive.size], alive, segments)
    return segments


@inlined
def points_up(cos: float, sin: float) -> bool:
    """Whether a direction is that of -pi/2, to the digits that theta has: the other way round it is in the range."""
    return bool(sin < 0 and np.float32(np.arctan2(sin, cos)) <= -np.float32(np.pi / 2))


@kernel
def write_segments(lines: Any, alive: Any, segments: Any) -> None:
    """Fill in the records that users get."""
    count = 0
    for k in range(lines.size):
        if not alive[k]:
            continue
        line = lines[k]
        segment = segments[count]
        cos, sin = line['cos'], line['sin']
        x1, y1, x2, y2 = line['x1'], line['y1'], line['x2'], line['y2']
        if points_up(cos, sin):
            cos, sin, x1, y1, x2, y2 = -cos, -sin, x2, y2, x1, y1
        segment['x'], segment['y'], segment['z'] = line['x'], line['y'], 0
        segment['x1'], segment['y1'], segment['x2'], segment['y2'] = x1, y1, x2, y2
        segment['length'] = np.sqrt((x2 - x1) * (x2 - x1) + (y2 - y1) * (y2 - y1))
        segment['theta'] = np.arctan2(sin, cos)
        segment['intercept'] = line['y'] - sin / cos * line['x'] if cos >= VERTICAL else np.nan
        segment['rho'] = line['y'] * cos - line['x'] * sin
        segment['code'] = line['code']
        segment['size'] = line['n']
        segment['sigma_theta'], segment['sigma_offset'] = np.nan, np.nan
        segment['contrast'], segment['polarity'], segment['log_nfa'] = np.nan, 0, np.nan
        count += 1

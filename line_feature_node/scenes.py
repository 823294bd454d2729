"""Rendered scenes with ground truth: a corridor as the camera of a mobile robot sees it.

The corridor is a box along x, its faces painted with axis-aligned rectangles: doors, skirting, notice boards, lamps.
All paint lies on a grid of `CELL` metres, so looking up the cell that a ray hits gives outlines exactly where their
projection says: the picture and its ground truth come from one source.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int8]
Colour = tuple[int, int, int]

LOW = np.array([0.0, -1.2, 0.0])  # metres: x along the corridor, y to its left, z up
HIGH = np.array([24.0, 1.2, 2.6])
CELL = 0.02  # metres
PAD = 2  # cells around the map of each face, so that interpolation never mixes two faces
CLEARANCE = 0.05  # metres between the camera and any face; also its near plane
LAMPS = np.arange(1.8, HIGH[0], 2.4)  # metres: the x of their centres

SAMPLES, LATTICE = 13, 8  # rays a pixel, on a Fibonacci lattice: no two in line, so upright edges are smooth too
BLUR = 0.6  # pixels
VIGNETTE = 0.12  # loss of light in the corners of the picture
WHITE = 252.0  # grey levels at which the sensor saturates
GREY = np.array([0.114, 0.587, 0.299], np.float32)  # as cv2.COLOR_BGR2GRAY weighs the channels

TRUTH_CONTRAST = 12.0  # grey levels across an edge that a detector should find
WEAK_CONTRAST = 2.0  # grey levels below which there is no edge
SHORTEST = 20.0  # pixels
SPECK = 2.0  # pixels, below which even a weak edge is left out
CROWDED = 4.0  # pixels between two parallel edges that cannot be told apart
PARALLEL = np.cos(np.radians(15))
NEAR, WIDE = 0.1, 1.2  # pixels to either side of an edge: its own contrast, and what a lens leaves of it among others
STEP = 2.0  # pixels, at most, between two such measurements


@dataclass(frozen=True, eq=False)
class Scene:
    """A picture and the edges in it.

    Attributes:
        image: uint8, H x W x 3, BGR.
        truth: float64, N x 4: x1, y1, x2, y2 in pixels, (0, 0) being the centre of the top-left pixel. Edges that a
            detector should find: a contrast of 12 grey levels or more over 20 pixels or more, and no such edge
            parallel within 4 pixels.
        weak: float64, M x 4. Edges that are there (2 grey levels or more), but too faint, too short or too near to a
            parallel one to count for or against a detector.
    """

    image: npt.NDArray[np.uint8]
    truth: Float64
    weak: Float64


@dataclass(frozen=True)
class Camera:
    """A pin-hole camera, by default in the corridor: 24 m long, 2.4 m wide and 2.6 m high; 5 cm or more from its faces.

    Attributes:
        x: Metres from the end wall behind the camera, 0 to 24; unturned, the camera looks along x.
        y: Metres to the left of the corridor's axis, -1.2 to 1.2.
        z: Metres above the floor, 0 to 2.6.
        yaw: Radians, positive to the left.
        pitch: Radians, positive downwards.
        roll: Radians, positive with the camera's right side down.
        focal: Focal length in pixels; None stands for 0.8 of the picture's width.
    """

    x: float = 2.0
    y: float = 0.2
    z: float = 1.0
    yaw: float = 0.06
    pitch: float = 0.02
    roll: float = 0.01
    focal: float | None = None


def corridor(
    camera: Camera = Camera(),
    *,
    width: int = 640,
    height: int = 480,
    noise: float = 4.0,
    seed: int = 0,
    layout: int = 0,
) -> Scene:
    """Render the corridor as the camera sees it. The same arguments give the same bytes.

    Args:
        camera: Where the camera is and where it looks.
        width: Width of the picture in pixels.
        height: Height of the picture in pixels.
        noise: Standard deviation of the sensor noise in grey levels, the same noise in all three channels.
        seed: Seed of the noise, and of nothing else.
        layout: Which corridor: its doors and boards, and the texture of its surfaces.

    Returns:
        The picture with the edges that are visible in it.

    Raises:
        ValueError: If the picture has no area, a number is negative or not finite, or the camera is not inside.
    """
    check(camera, width, height, LOW + CLEARANCE, HIGH - CLEARANCE, noise=noise, seed=seed, layout=layout)
    view, building = View(camera, width, height), _building(layout)
    picture = _exposure(view, building) + _texture(view, building)[..., None]
    return Scene(sensed(picture, noise, seed), *_visible_edges(view, building))


def sensed(picture: Float32, noise: float, seed: int) -> npt.NDArray[np.uint8]:
    """What the sensor makes of a picture (H x W x 3, grey levels): noise in whole grey levels, saturated."""
    grain = np.random.default_rng(seed).standard_normal((*picture.shape[:2], 1), np.float32)
    return np.asarray(np.clip(np.rint(picture + np.float32(noise) * grain), 0, 255), np.uint8)


def check(camera: Camera, width: int, height: int, low: Float64, high: Float64, **numbers: float) -> None:
    """Raise a ValueError for what no picture is made of: a camera outside of a box (metres), a number below 0."""
    if width < 2 or height < 2:
        raise ValueError(f'width and height must be 2 pixels or more, not {width} x {height}')
    for name, value in numbers.items():
        if not 0 <= value < np.inf:
            raise ValueError(f'{name} must be 0 or more, not {value}')
    for name, value, least, most in zip('xyz', (camera.x, camera.y, camera.z), low, high, strict=True):
        if not least <= value <= most:
            raise ValueError(f'{name} must be {least:g} to {most:g} metres, not {value}')
    for name, value in (('yaw', camera.yaw), ('pitch', camera.pitch), ('roll', camera.roll)):
        if not np.isfinite(value):
            raise ValueError(f'{name} must be an angle in radians, not {value}')
    if camera.focal is not None and not 0 < camera.focal < np.inf:
        raise ValueError(f'focal must be more than 0 pixels, not {camera.focal}')


class View:
    """The geometry of one picture: from pixels to rays and from points to pixels."""

    def __init__(self, camera: Camera, width: int, height: int) -> None:
        self.size = np.array([width, height])
        self.centre = (self.size - 1) / 2
        self.focal = 0.8 * width if camera.focal is None else camera.focal
        self.origin = np.array([camera.x, camera.y, camera.z])
        self.axes = _rotation(camera.yaw, camera.pitch, camera.roll)  # columns: forward, left, up
        self.px = np.arange(width, dtype=np.float32)[None]
        self.py = np.arange(height, dtype=np.float32)[:, None]

    def rays(self, px: Float32, py: Float32) -> list[Float32]:
        """The x, y and z of the directions in which pixels look."""
        cx, cy = self.centre.astype(np.float32)
        left, up = (cx - px) / np.float32(self.focal), (cy - py) / np.float32(self.focal)
        return [axes[0] + axes[1] * left + axes[2] * up for axes in self.axes.astype(np.float32)]

    def vignette(self, px: Float32, py: Float32) -> Float32:
        """The share of the light that reaches pixels through the lens."""
        cx, cy = self.centre.astype(np.float32)
        return np.asarray(1 - VIGNETTE * ((px - cx) ** 2 + (py - cy) ** 2) / (cx**2 + cy**2), np.float32)

    def project(self, lines: Float64) -> Float64:
        """The visible parts (M x 2 x 2, pixels) of lines (N x 2 x 3, metres)."""
        local = (lines - self.origin) @ self.axes
        local = clipped(local, local[..., 0] - CLEARANCE)
        pixels = self.centre - self.focal * local[..., 1:] / local[..., :1]
        for axis in range(2):
            pixels = clipped(pixels, pixels[..., axis])
            pixels = clipped(pixels, self.size[axis] - 1 - pixels[..., axis])
        return pixels


def _rotation(yaw: float, pitch: float, roll: float) -> Float64:
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return np.asarray(about_z @ about_y @ about_x)


def clipped(lines: Float64, inside: Float64) -> Float64:
    """The parts of lines (N x 2 x D) where a linear function, given at their ends (N x 2), is not negative."""
    keep = inside.max(axis=1) > 0
    lines, inside = lines[keep], inside[keep]
    share = np.divide(inside, inside - inside[:, ::-1], out=np.zeros_like(inside), where=inside < 0)
    return np.asarray(lines + share[..., None] * (lines[:, ::-1] - lines))


class _Face(NamedTuple):
    """A side of the box: its normal axis, at the low or high end of it, and the grey levels of its texture (sigma)."""

    axis: int
    high: bool
    speckle: float

    @property
    def plane(self) -> float:
        return float((HIGH if self.high else LOW)[self.axis])

    @property
    def plane_axes(self) -> tuple[int, int]:
        """The axes of its rows and of its columns."""
        return ((2, 1), (2, 0), (1, 0))[self.axis]

    @property
    def shape(self) -> tuple[int, int]:
        """The rows and columns of its map."""
        rows, columns = np.rint((HIGH - LOW) / CELL).astype(int)[list(self.plane_axes)]
        return int(rows), int(columns)


ENDS = _Face(0, False, 1.5), _Face(0, True, 1.5)
WALLS = _Face(1, False, 1.5), _Face(1, True, 1.5)
FLOOR, CEILING = _Face(2, False, 3.5), _Face(2, True, 1.0)
FACES = [*ENDS, *WALLS, FLOOR, CEILING]
FIRST_ROWS = np.cumsum([PAD] + [face.shape[0] + 2 * PAD for face in FACES[:-1]]).astype(np.float32)


@dataclass(frozen=True)
class _Building:
    """A corridor ready to render: its lines, and the maps of its faces, one above the other in an atlas."""

    paint: Float32  # rows x columns x 3, grey levels
    light: Float32  # rows x columns, the share of the paint's grey levels that is seen
    textures: dict[int, Float32]  # cells a grain: rows x columns, grey levels
    lines: Float64  # N x 2 x 3, metres


@lru_cache(maxsize=4)
def _building(layout: int) -> _Building:
    rng = np.random.default_rng(layout)
    paints = [_end(rng), _end(rng), _wall(rng), _wall(rng), _floor(rng), _ceiling()]
    powers = rng.uniform(0.75, 1.1, len(LAMPS))
    textures = {grain: _atlas([_value_noise(rng, face, grain) for face in FACES]) for grain in (1, 12)}
    lines = [_box(), *(_outlines(face, paint) for face, paint in zip(FACES, paints, strict=True))]
    return _Building(_atlas(paints), _atlas([_light(face, powers) for face in FACES]), textures, np.concatenate(lines))


def _atlas(maps: list[Float32]) -> Float32:
    columns = max(field.shape[1] for field in maps)
    spare = [(0, 0)] * (maps[0].ndim - 2)
    return np.concatenate(
        [np.pad(field, [(PAD, PAD), (PAD, PAD + columns - field.shape[1]), *spare], mode='edge') for field in maps]
    )


METAL, PAPER, GLASS, RED, GREEN = (176, 174, 172), (238, 240, 240), (74, 62, 54), (44, 40, 178), (80, 140, 30)
SKIRTING = (70, 72, 78)
DOORS: list[tuple[Colour, Colour]] = [  # leaf, frame
    ((92, 134, 176), (86, 124, 164)),  # beech
    ((140, 104, 66), (178, 176, 172)),  # blue in a pale frame
    ((150, 152, 150), (88, 90, 94)),  # grey in a dark frame
    ((88, 112, 86), (84, 104, 82)),  # green
]


def _blank(face: _Face, colour: Colour) -> Float32:
    return np.full((*face.shape, 3), colour, np.float32)


def _rectangle(paint: Float32, u: float, v: float, width: float, height: float, colour: Colour) -> None:
    """Paint a rectangle, given in metres along the columns (u) and the rows (v) of a face."""
    left, low, right, high = (round(place / CELL) for place in (u, v, u + width, v + height))
    paint[low:high, left:right] = colour


def _end(rng: np.random.Generator) -> Float32:
    end = _blank(ENDS[0], (170, 184, 190))
    _rectangle(end, 0, 0, 2.4, 0.12, SKIRTING)
    leaf, frame = DOORS[rng.integers(len(DOORS))]
    _rectangle(end, 0.36, 0, 1.68, 2.14, frame)
    for u in (0.44, 1.22):
        _rectangle(end, u, 0, 0.74, 2.06, leaf)
        _rectangle(end, u + 0.18, 1.1, 0.38, 0.8, (226, 222, 214))
    _rectangle(end, 1.0, 2.24, 0.4, 0.2, GREEN)
    return end


def _wall(rng: np.random.Generator) -> Float32:
    wall = _blank(WALLS[0], (196, 208, 212))
    _rectangle(wall, 0, 0, 24, 0.92, (158, 172, 170))
    _rectangle(wall, 0, 0.92, 24, 0.12, (84, 116, 150))
    _rectangle(wall, 0, 0, 24, 0.12, SKIRTING)
    place = rng.uniform(0.4, 1.4)
    while place < 20.8:
        _paint_door(wall, place, rng)
        if rng.random() < 0.7:
            _paint_board(wall, place + 1.7, rng)
        place += rng.uniform(3.0, 4.4)
    return wall


def _paint_door(wall: Float32, u: float, rng: np.random.Generator) -> None:
    leaf, frame = DOORS[rng.integers(len(DOORS))]
    _rectangle(wall, u, 0, 1.2, 2.16, frame)
    _rectangle(wall, u + 0.12, 0, 0.96, 2.04, leaf)
    _rectangle(wall, u + 0.94, 1.0, 0.1, 0.06, METAL)
    if rng.random() < 0.5:
        _rectangle(wall, u + 0.32, 1.2, 0.44, 0.6, GLASS)
    if rng.random() < 0.5:
        _rectangle(wall, u + 0.12, 0, 0.96, 0.24, METAL)
    _rectangle(wall, u + 1.34, 1.5, 0.18, 0.14, PAPER)


def _paint_board(wall: Float32, u: float, rng: np.random.Generator) -> None:
    if rng.random() < 0.3:
        _rectangle(wall, u, 1.16, 0.32, 0.64, RED)
        return
    _rectangle(wall, u, 1.2, 1.12, 0.86, METAL)
    _rectangle(wall, u + 0.04, 1.24, 1.04, 0.78, (92, 138, 178))
    for left in (0.1, 0.44, 0.78):
        _rectangle(wall, u + left, 1.3 + rng.uniform(0, 0.3), 0.22, 0.3, PAPER)


def _floor(rng: np.random.Generator) -> Float32:
    floor = _blank(FLOOR, (128, 126, 122))
    for v in (0.24, 2.04):
        _rectangle(floor, 0, v, 24, 0.12, (78, 70, 64))
    for u in np.arange(rng.uniform(1, 4), 24, 4.8):
        _rectangle(floor, u, 0.36, 0.36, 1.68, (160, 157, 150))
    return floor


def _ceiling() -> Float32:
    ceiling = _blank(CEILING, (242, 246, 246))
    ceiling[14::30] = ceiling[:, 29::120] = (234, 238, 238)
    for x in LAMPS:
        _rectangle(ceiling, x - 0.6, 0.96, 1.2, 0.48, (900, 900, 900))
    return ceiling


def _light(face: _Face, powers: Float64) -> Float32:
    """The light on a face: what the walls scatter, less of it in the corners, and what falls from the lamps."""
    place = [np.full((1, 1), face.plane)] * 3
    corners = np.ones((1, 1))
    for axis, count, turn in zip(face.plane_axes, face.shape, ((-1, 1), (1, -1)), strict=True):
        place[axis] = (LOW[axis] + CELL * (np.arange(count) + 0.5)).reshape(turn)
        gap = np.minimum(place[axis] - LOW[axis], HIGH[axis] - place[axis])
        corners = corners * (1 - 0.22 * np.exp(-gap / 0.2))
    direct = np.zeros(face.shape)
    for x, power in zip(LAMPS, powers, strict=True):
        to_lamp = [x - place[0], -place[1], HIGH[2] - place[2]]
        facing = np.maximum(-to_lamp[face.axis] if face.high else to_lamp[face.axis], 0)
        direct += power * facing * to_lamp[2] / (sum(part * part for part in to_lamp) + 0.3) ** 2
    return np.asarray((0.72 + 0.62 * direct) * corners, np.float32)


def _value_noise(rng: np.random.Generator, face: _Face, grain: int) -> Float32:
    rows, columns = face.shape
    knots = rng.standard_normal((max(2, rows // grain), max(2, columns // grain)), np.float32)
    field = cv2.resize(knots, (columns, rows), interpolation=cv2.INTER_CUBIC)
    return np.asarray(face.speckle * field / field.std(), np.float32)


def _box() -> Float64:
    """The edges of the corridor itself, 12 x 2 x 3 in metres."""
    corners = np.array([[(LOW, HIGH)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
    return np.array([corners[[k, k + bit]] for bit in (1, 2, 4) for k in range(8) if not k & bit])


def _outlines(face: _Face, paint: Float32) -> Float64:
    """The lines of a face, N x 2 x 3 in metres, along which its paint changes."""
    groups = []
    for strips, (across, along) in ((paint, face.plane_axes), (paint.swapaxes(0, 1), face.plane_axes[::-1])):
        row, start, stop = _runs((strips[1:] != strips[:-1]).any(axis=2))
        lines = np.full((len(row), 2, 3), face.plane)
        lines[..., across] = LOW[across] + CELL * (row[:, None] + 1)
        lines[..., along] = LOW[along] + CELL * np.stack([start, stop], axis=1)
        groups.append(lines)
    return np.concatenate(groups)


def _runs(labels: npt.NDArray[np.bool_] | Labels) -> tuple[npt.NDArray[np.intp], ...]:
    """The runs of one label other than 0 in rows: their row, first column and the column after their last."""
    padded = np.pad(labels, ((0, 0), (1, 1)))
    before, after = padded[:, :-1], padded[:, 1:]
    row, start = np.nonzero((before != after) & (after != 0))
    return row, start, np.nonzero((before != after) & (before != 0))[1]


def _hits(view: View, px: Float32, py: Float32) -> tuple[Float32, Float32]:
    """The column and row of the atlas, in cells from its corner, at which the rays through pixels end."""
    rays = view.rays(px, py)
    origin, low, high = (values.astype(np.float32) for values in (view.origin, LOW, HIGH))
    with np.errstate(divide='ignore'):  # a ray along a face meets it at infinity
        reach = [np.where(ray > 0, high[k] - origin[k], origin[k] - low[k]) / np.abs(ray) for k, ray in enumerate(rays)]
    distance = np.minimum(np.minimum(reach[0], reach[1]), reach[2])
    x, y, z = ((origin[k] - low[k] + distance * ray) / np.float32(CELL) for k, ray in enumerate(rays))
    on_end, on_level = distance == reach[0], distance == reach[2]
    on_level &= ~on_end
    first = [np.where(ray > 0, FIRST_ROWS[2 * k + 1], FIRST_ROWS[2 * k]) for k, ray in enumerate(rays)]
    column = np.where(on_end, y, x) + np.float32(PAD)
    row = np.where(on_level, y, z) + np.where(on_end, first[0], np.where(on_level, first[2], first[1]))
    return column, row


def _interpolated(field: Float32, column: Float32, row: Float32, method: int) -> Float32:
    half = np.float32(0.5)
    return np.asarray(cv2.remap(field, column - half, row - half, method, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _radiance(view: View, building: _Building, px: Float32, py: Float32) -> Float32:
    """The colour at places of the picture in grey levels, before lens, texture and noise."""
    column, row = _hits(view, px, py)
    cell = row.astype(np.int32) * np.int32(building.paint.shape[1]) + column.astype(np.int32)
    colour = building.paint.reshape(-1, 3).take(cell, axis=0)
    colour *= _interpolated(building.light, column, row, cv2.INTER_LINEAR)[..., None]
    # Saturated here rather than in the sensor, a lamp keeps its outline.
    return np.minimum(colour, np.float32(WHITE), out=colour)


def _exposure(view: View, building: _Building) -> Float32:
    """The picture without texture and noise, H x W x 3 in grey levels."""
    picture = np.zeros((*view.size[::-1], 3), np.float32)
    for k in range(SAMPLES):
        dx, dy = (k + 0.5) / SAMPLES - 0.5, (k * LATTICE % SAMPLES + 0.5) / SAMPLES - 0.5
        picture += _radiance(view, building, view.px + np.float32(dx), view.py + np.float32(dy))
    picture *= view.vignette(view.px, view.py)[..., None] / np.float32(SAMPLES)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), BLUR), np.float32)


def _texture(view: View, building: _Building) -> Float32:
    """The texture of the surfaces, H x W in grey levels, faded out where its grain is finer than the pixels."""
    column, row = _hits(view, view.px, view.py)
    cells = np.max([np.abs(slope) for field in (column, row) for slope in np.gradient(field)], axis=0)
    layers = [
        _interpolated(field, column, row, cv2.INTER_CUBIC) / (1 + (cells / grain) ** 2)
        for grain, field in building.textures.items()
    ]
    return np.asarray(sum(layers), np.float32)


def _visible_edges(view: View, building: _Building) -> tuple[Float64, Float64]:
    """The edges in the picture, truth and weak, each N x 4."""
    edges = view.project(building.lines)
    if not len(edges):
        return np.empty((0, 4)), np.empty((0, 4))
    return graded(edges, *(_contrast(view, building, edges, reach) for reach in (NEAR, WIDE)))


def graded(edges: Float64, near: Float32, wide: Float32) -> tuple[Float64, Float64]:
    """Truth and weak, each N x 4, of edges (N x 2 x 2), given their contrast at evenly spaced places, N x S."""
    sign = np.sign(near).astype(np.int8)  # where it changes, an edge ends and another begins
    there, strong = np.abs(near) >= WEAK_CONTRAST, np.abs(near) >= TRUTH_CONTRAST
    strong &= ~_crowded(edges, sign * strong) & (sign * wide >= TRUTH_CONTRAST)
    parts = _parts(edges, sign * strong)
    long = lengths_of(parts) >= SHORTEST
    weak = np.concatenate([parts[~long], _parts(edges, sign * (there & ~strong))])
    return parts[long].reshape(-1, 4), weak[lengths_of(weak) >= SPECK].reshape(-1, 4)


def lengths_of(edges: Float64) -> Float64:
    """The lengths of edges (N x 2 x 2)."""
    return np.hypot(edges[:, 1, 0] - edges[:, 0, 0], edges[:, 1, 1] - edges[:, 0, 1])


def _contrast(view: View, building: _Building, edges: Float64, reach: float) -> Float32:
    """The step in grey levels across edges (N x 2 x 2) at evenly spaced places along them, N x S."""
    count = int(np.ceil(np.hypot(*view.size) / STEP))
    along = edges[:, 1:] - edges[:, :1]
    middle = edges[:, :1] + along * ((np.arange(count) + 0.5) / count)[:, None]
    normal = along[..., ::-1] * (-1, 1) / np.maximum(lengths_of(edges), 1e-9)[:, None, None]
    sides = []
    for side in (-reach, reach):
        px, py = np.moveaxis((middle + side * normal).astype(np.float32), -1, 0)
        sides.append(_radiance(view, building, px, py) @ GREY * view.vignette(px, py))
    return np.asarray(sides[1] - sides[0], np.float32)


def _parts(edges: Float64, labels: Labels) -> Float64:
    """The parts (M x 2 x 2) of edges (N x 2 x 2) that bear one label other than 0, given at places, N x S."""
    row, start, stop = _runs(labels)
    shares = np.stack([start, stop], axis=1)[..., None] / labels.shape[1]
    return np.asarray(edges[row, :1] + shares * (edges[row, 1:] - edges[row, :1]))


def _crowded(edges: Float64, labels: Labels) -> npt.NDArray[np.bool_]:
    """Whether labelled places (N x S) along edges have a labelled part of a parallel edge too near beside them."""
    parts = _parts(edges, labels)
    lengths = np.maximum(lengths_of(parts), 1e-9)
    units = (parts[:, 1] - parts[:, 0]) / lengths[:, None]
    low, high = parts.min(axis=1) - CROWDED, parts.max(axis=1)
    crowded = np.zeros(labels.shape, bool)
    for part, (row, start, stop) in enumerate(zip(*_runs(labels), strict=True)):
        beside = (low <= high[part]).all(axis=1) & (low[part] <= high).all(axis=1)
        beside &= np.abs(units @ units[part]) > PARALLEL
        beside[part] = False
        shares = (np.arange(start, stop) + 0.5) / labels.shape[1]
        away = (edges[row, 0] + shares[:, None] * (edges[row, 1] - edges[row, 0]))[:, None] - parts[beside, 0]
        along = (away * units[beside]).sum(axis=2)
        across = np.abs(away[..., 0] * units[beside, 1] - away[..., 1] * units[beside, 0])
        crowded[row, start:stop] = ((across < CROWDED) & (along > 0) & (along < lengths[beside])).any(axis=1)
    return crowded

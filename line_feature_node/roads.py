"""A rendered road with ground truth: what the camera of a car sees on a straight two-lane road by day.

Everything with an outline is a sheet, a flat quadrilateral in space: asphalt, paint, shadows, kerb, guard rail, posts,
cars. Sheets are painted over each other from far to near with the exact share of each pixel that they cover, and their
outlines are the ground truth, as far as they are seen. Texture, hills and trees have no straight outlines and none in
the ground truth: they are what a detector should not take for lines.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from line_feature_node.scenes import (
    BLUR,
    CLEARANCE,
    GREY,
    NEAR,
    SPECK,
    STEP,
    WIDE,
    Camera,
    Colour,
    Float32,
    Float64,
    Scene,
    View,
    check,
    clipped,
    graded,
    lengths_of,
    sensed,
)

Look = tuple[float, float, float, float, float, float]  # blue, green, red; shares of asphalt, grass and paint in it

LENGTH = 2000.0  # metres of road on which a camera may be; the painted strips go on
LOW, HIGH = np.array([0.0, -3.0, 0.3]), np.array([LENGTH, 3.0, 4.0])  # metres: where cameras may be
ENDLESS = 20000.0  # metres
SIGHT = 400.0  # metres, beyond which only endless strips are drawn
TINY = 0.05  # pixels of area, below which a sheet is left out

KERB = 0.12  # metres: its height, and that of the ground behind it
BESIDE = 4.0  # metres from the axis of the road to the end of the asphalt
RAIL = 4.6  # metres from the axis of the road to the guard rail
MARK = 0.12  # metres, the width of painted lines

GROUND, PAINT, SHADE, ROADSIDE, POSTS, BEAM, TRAFFIC = range(7)  # the order in which sheets are painted
TILE = 512  # cells of the texture that is laid out again and again
AZIMUTHS = 4096  # directions for which the heights of hills and trees are given
ROW = 1024  # places looked up in one row of a map, whose size has limits
STRETCH, ACROSS = 0.5, 0.05  # metres: cells of the map of the road along x and y
MAP_WIDTH = 8.0  # metres to either side of the axis which the map of the road shows

DEFAULT_CAMERA = Camera(x=20.0, y=-1.7, z=1.3, yaw=0.0, pitch=0.03, roll=0.0)

SKY_TOP, SKY_LOW = (224, 178, 128), (236, 228, 218)
HILLS, TREES = (188, 178, 166), (46, 62, 54)
MARKS, RUBBER, STEEL, DARK = (222, 226, 228), (36, 36, 38), (186, 184, 180), (58, 54, 52)
GLASS, RED, BLUE, PLATE = (74, 62, 50), (40, 36, 186), (150, 84, 26), (206, 226, 228)
CARS: list[Colour] = [(206, 208, 210), (52, 44, 40), (128, 64, 40), (46, 40, 150), (150, 148, 146)]


def road(
    camera: Camera = DEFAULT_CAMERA,
    *,
    width: int = 640,
    height: int = 480,
    noise: float = 4.0,
    seed: int = 0,
    layout: int = 0,
) -> Scene:
    """Render the road as the camera of a car sees it. The same arguments give the same bytes.

    A car ahead keeps its distance from the camera and others come towards it just as fast, wherever it is: cameras at
    increasing x are a drive.

    Args:
        camera: Where the camera is and where it looks: x along the road, 0 to 2000 metres; y to the left of its axis,
            -3 to 3; z above it, 0.3 to 4. Traffic keeps to the right, where y is negative.
        width: Width of the picture in pixels.
        height: Height of the picture in pixels.
        noise: Standard deviation of the sensor noise in grey levels, the same noise in all three channels.
        seed: Seed of the noise, and of nothing else.
        layout: Which road: its lanes, marks, posts and traffic, the side of the kerb, and the texture of its surfaces.

    Returns:
        The picture with the edges that are visible in it.

    Raises:
        ValueError: If the picture has no area, a number is negative or not finite, or the camera is not on the road.
    """
    check(camera, width, height, LOW, HIGH, noise=noise, seed=seed, layout=layout)
    view, land = View(camera, width, height), _land(layout)
    sight = _Sight(view, _surroundings(land, camera.x))
    return Scene(sensed(_exposure(view, land, sight), noise, seed), *_visible_edges(view, land, sight))


@dataclass(frozen=True)
class _Sheets:
    """Flat quadrilaterals, and the lines that are edges if they are seen.

    Attributes:
        corners: M x 4 x 3, metres, counter-clockwise for who looks at their front; their backs are never seen.
        gain: M, the share of what is behind a sheet that is seen through it.
        look: M x 6, what a sheet adds to that, as in Look.
        stage: M, when it is painted.
        place: M, the x at which it is, metres: within a stage, what is far from the camera is painted first.
        group: M, the same number for sheets that may touch, but do not hide each other.
        lines: N x 2 x 3, metres.
    """

    corners: Float64
    gain: Float32
    look: Float32
    stage: npt.NDArray[np.int64]
    place: Float64
    group: npt.NDArray[np.int64]
    lines: Float64

    def near(self, x: float) -> '_Sheets':
        """Those within sight of x: what has an end starts there."""
        keep, lines = (
            (np.abs(start - x) < SIGHT) | (np.abs(start) >= ENDLESS)
            for start in (self.corners[:, 0, 0], self.lines[:, 0, 0])
        )
        return self.only(np.flatnonzero(keep), self.lines[lines])

    def only(self, keep: npt.NDArray[np.intp], lines: Float64) -> '_Sheets':
        """Some of the sheets, with other lines."""
        return _Sheets(
            self.corners[keep], self.gain[keep], self.look[keep], self.stage[keep], self.place[keep], self.group[keep],
            lines,
        )

    def moved(self, x: float, y: float) -> '_Sheets':
        """The same elsewhere."""
        corners, lines = (ends + np.array([x, y, 0]) for ends in (self.corners, self.lines))
        return _Sheets(corners, self.gain, self.look, self.stage, self.place + x, self.group, lines)


def _joined(parts: Sequence[_Sheets]) -> _Sheets:
    groups = np.cumsum([0] + [part.group.max(initial=0) + 1 for part in parts])
    fields = zip(*((part.corners, part.gain, part.look, part.stage, part.place) for part in parts), strict=True)
    corners, gain, look, stage, place = (np.concatenate(field) for field in fields)
    group = np.concatenate([part.group + first for part, first in zip(parts, groups[:-1], strict=True)])
    return _Sheets(corners, gain, look, stage, place, group, np.concatenate([part.lines for part in parts]))


def _plain(colour: Sequence[float], share: float = 1.0) -> Look:
    """A surface without texture, of a share of the brightness of a colour."""
    blue, green, red = (share * value for value in colour)
    return blue, green, red, 0, 0, 0


def _ground(x1: float, x2: float, y1: float, y2: float, z: float = 0.0) -> Float64:
    """The corners of a rectangle on the ground, metres."""
    (x1, x2), (y1, y2) = sorted((x1, x2)), sorted((y1, y2))
    return np.array([[x1, y1, z], [x2, y1, z], [x2, y2, z], [x1, y2, z]])


def _beside(x1: float, x2: float, y: float, z1: float, z2: float) -> Float64:
    """The corners of an upright rectangle along the road that faces its axis, metres."""
    if y < 0:
        x1, x2 = x2, x1
    return np.array([[x1, y, z1], [x2, y, z1], [x2, y, z2], [x1, y, z2]])


def _patch(face: Float64, u1: float, u2: float, v1: float, v2: float) -> Float64:
    """Part of a face: shares of its width, along its first side, and of its height."""
    u, v = np.array([[u1], [u2], [u2], [u1]]), np.array([[v1], [v1], [v2], [v2]])
    return np.asarray((face[0] * (1 - u) + face[1] * u) * (1 - v) + (face[3] * (1 - u) + face[2] * u) * v)


def _raised(corners: Float64, height: float) -> Float64:
    return np.asarray(corners + np.array([0, 0, height]))


class _Draft:
    """Sheets in the making."""

    def __init__(self) -> None:
        self.corners: list[Float64] = []
        self.gains: list[float] = []
        self.looks: list[Look] = []
        self.keys: list[tuple[int, float, int]] = []
        self.lines: list[Float64] = []

    def add(self, *faces: tuple[Float64, Look], stage: int, place: float = 0.0, gain: float = 0.0) -> None:
        """Add sheets that may touch, but do not hide each other, without their lines."""
        group = self.keys[-1][2] + 1 if self.keys else 0
        for corners, look in faces:
            self.corners.append(corners)
            self.looks.append(look)
            self.gains.append(gain)
            self.keys.append((stage, place, group))

    def outline(self, *faces: Float64) -> None:
        """Add the four sides of each of some faces as lines."""
        self.lines.extend(np.stack([face, np.roll(face, -1, axis=0)], axis=1) for face in faces)

    def along(self, *places: tuple[float, float]) -> None:
        """Add endless lines along x, at y and z."""
        self.lines.extend(np.array([[[x, y, z] for x in (-ENDLESS, ENDLESS)]]) for y, z in places)

    def panel(self, face: Float64, look: Look, *, stage: int, place: float = 0.0) -> None:
        """Add a sheet with its outline."""
        self.add((face, look), stage=stage, place=place)
        self.outline(face)

    def shadow(self, face: Float64, gain: float, *, place: float = 0.0) -> None:
        """Darken what a face on the ground covers."""
        self.add((face, (0, 0, 0, 0, 0, 0)), stage=SHADE, place=place, gain=gain)
        self.outline(face)

    def block(
        self, low: Float64, high: Float64, colour: Colour, *, stage: int, place: float, light: tuple[float, ...]
    ) -> list[Float64]:
        """Add a body between two rectangles (corners counter-clockwise from above); returns its four sides.

        They look to -y, +x, +y and -x; light is the share of their colour that is seen, and that of the lid.
        """
        sides = [np.array([low[k], low[k - 3], high[k - 3], high[k]]) for k in range(4)]
        faces = [*sides, high]
        shades = zip(faces, light, strict=True)
        self.add(*((face, _plain(colour, share)) for face, share in shades), stage=stage, place=place)
        self.outline(low, high)
        self.lines.append(np.stack([low, high], axis=1))
        return sides

    def done(self) -> _Sheets:
        """All that was added."""
        stage, place, group = (np.array(key) for key in zip(*self.keys, strict=True))
        corners, looks = np.stack(self.corners), np.array(self.looks, np.float32)
        gains = np.array(self.gains, np.float32)
        return _Sheets(corners, gains, looks, stage, place.astype(np.float64), group, np.concatenate(self.lines))


@dataclass(frozen=True)
class _Plan:
    """What differs between roads: lengths in metres (lane: the width of one with its line), sides as the sign of y."""

    lane: float
    dash: float
    period: float
    kerb_side: int
    asphalt: float  # grey levels
    sun: Float64  # where the shadow of what is 1 m high falls, x and y

    @property
    def light(self) -> tuple[float, ...]:
        """The light on faces to -y, +x, +y, -x, and on lids."""
        bright, dull = 1.0, 0.72
        right, left = (bright, dull) if self.sun[1] > 0 else (dull, bright)
        return right, 0.74, left, 0.92, 1.08


@dataclass(frozen=True)
class _Land:
    """A road ready to render.

    Attributes:
        sheets: All that stays where it is.
        ahead: The car ahead, its tail at x = 0 and its middle at y = 0.
        oncoming: The car that comes towards the camera, its front at x = 0.
        plan: What the road is like.
        gap: Metres from the camera to the car ahead.
        grain: TILE x TILE, texture of sigma 1.
        wear: The road from above, rows along y, columns along x: stains and wheel tracks, grey levels.
        shade: Likewise: the shade of trees, 0 to 1.
        heights: 3 x AZIMUTHS, elevation (tangent) of the hills and of the tree tops, and brightness of the trees.
    """

    sheets: _Sheets
    ahead: _Sheets
    oncoming: _Sheets
    plan: _Plan
    gap: float
    grain: Float32
    wear: Float32
    shade: Float32
    heights: Float32


@lru_cache(maxsize=4)
def _land(layout: int) -> _Land:
    rng = np.random.default_rng(layout)
    dash, period = ((4.0, 12.0), (3.0, 9.0), (6.0, 12.0))[rng.integers(3)]
    side, sunny = rng.choice([-1, 1], 2)
    sun = np.array([rng.uniform(0.2, 0.6), sunny * rng.uniform(0.6, 0.9)])
    plan = _Plan(rng.uniform(3.3, 3.6), dash, period, int(side), rng.uniform(96, 122), sun)
    draft = _Draft()
    _add_strips(draft, plan)
    _add_marks(draft, plan)
    _add_repairs(draft, plan, rng)
    _add_kerb(draft, plan)
    _add_rail(draft, plan)
    _add_roadside(draft, plan, rng)
    colours = rng.permutation(len(CARS))
    cars = _van(plan, CARS[colours[0]]) if rng.random() < 0.4 else _car(plan, CARS[colours[0]])
    grain = _noise(rng, (TILE, TILE), (1, 1))
    return _Land(
        draft.done(), cars, _car(plan, CARS[colours[1]], oncoming=True), plan, rng.uniform(16, 28), grain,
        _wear(rng, plan), _shade(rng), _heights(rng),
    )


def _noise(rng: np.random.Generator, shape: tuple[int, int], grain: tuple[float, float]) -> Float32:
    """Smooth noise of sigma 1, its grain in cells along rows and columns; what leaves on one side enters opposite."""
    high, wide = (int(4 * size) + 1 for size in grain)
    field = np.pad(rng.standard_normal(shape, np.float32), [(high, high), (wide, wide)], mode='wrap')
    smooth = cv2.GaussianBlur(field, (0, 0), sigmaX=0.6 * grain[1], sigmaY=0.6 * grain[0])[high:-high, wide:-wide]
    return np.asarray(smooth / smooth.std(), np.float32)


def _away(rows: int) -> Float64:
    """Metres from the axis of the road for rows of its map."""
    return np.asarray(np.abs(ACROSS * (np.arange(rows) + 0.5) - MAP_WIDTH))


def _wear(rng: np.random.Generator, plan: _Plan) -> Float32:
    shape = round(2 * MAP_WIDTH / ACROSS), TILE
    y = _away(shape[0])
    tracks = sum(np.exp(-(((y - plan.lane / 2 - side) / 0.3) ** 2)) for side in (-0.8, 0.8))
    oil = np.exp(-(((y - plan.lane / 2) / 0.35) ** 2))
    wander = 1 + 0.3 * _noise(rng, (1, TILE), (1, 40))
    streaks = 2.2 * _noise(rng, shape, (3, 30)) + 1.8 * _noise(rng, shape, (8, 4))
    return np.asarray(streaks - (7 * tracks + 5 * oil)[:, None] * wander, np.float32)


def _shade(rng: np.random.Generator) -> Float32:
    shape = round(2 * MAP_WIDTH / ACROSS), TILE
    leaves = _noise(rng, shape, (24, 5)) + 0.5 * _noise(rng, shape, (8, 2))
    trees = 1.6 * _noise(rng, (1, TILE), (1, 60)) - 1.6
    edge = np.clip((MAP_WIDTH - 0.5 - _away(shape[0])) / 2, 0, 1)[:, None]
    return np.asarray(edge * np.clip(0.5 + 0.5 * (leaves + trees), 0, 1), np.float32)


def _heights(rng: np.random.Generator) -> Float32:
    shape = 1, AZIMUTHS
    hills = 0.05 + 0.014 * _noise(rng, shape, (1, 400)) + 0.003 * _noise(rng, shape, (1, 90))
    crowns = 0.02 + 0.006 * _noise(rng, shape, (1, 60)) + 0.004 * _noise(rng, shape, (1, 9))
    crowns += 0.0016 * _noise(rng, shape, (1, 2))
    light = 1 + 0.1 * _noise(rng, shape, (1, 12))
    return np.concatenate([hills, np.maximum(crowns, 0.008), light])


def _add_strips(draft: _Draft, plan: _Plan) -> None:
    """The ground, the gravel on one side, the asphalt."""
    grey, side = plan.asphalt, -plan.kerb_side
    draft.panel(_ground(-ENDLESS, ENDLESS, -ENDLESS, ENDLESS), (52, 108, 92, 0, 1, 0), stage=GROUND)
    gravel, asphalt = (grey + 16, grey + 24, grey + 30, 1, 0, 0), (grey + 3, grey, grey - 2, 1, 0, 0)
    draft.add((_ground(-ENDLESS, ENDLESS, side * BESIDE, side * (RAIL + 0.7)), gravel), stage=GROUND)
    draft.add((_ground(-ENDLESS, ENDLESS, -BESIDE, BESIDE), asphalt), stage=GROUND)
    draft.along((side * (RAIL + 0.7), 0), (side * BESIDE, 0))


def _add_marks(draft: _Draft, plan: _Plan) -> None:
    """Solid lines at the edges of the lanes, dashes between them."""
    paint: Look = (*MARKS, 0.3, 0, 0.7)
    for side in (-1, 1):
        outer = side * plan.lane
        inner = outer - side * MARK
        draft.add((_ground(-ENDLESS, ENDLESS, inner, outer), paint), stage=PAINT)
        draft.along((inner, 0), (outer, 0))
    for x in np.arange(-SIGHT, LENGTH + SIGHT, plan.period):
        draft.panel(_ground(x, x + plan.dash, -MARK / 2, MARK / 2), paint, stage=PAINT)


def _add_repairs(draft: _Draft, plan: _Plan, rng: np.random.Generator) -> None:
    """Patches of other asphalt, seams sealed with tar, manhole covers."""
    for x in np.arange(-SIGHT, LENGTH + SIGHT, 40.0) + rng.uniform(0, 20):
        lane = rng.choice([-1, 1]) * plan.lane / 2
        grey = plan.asphalt + rng.choice([-26, -16, 18]) + rng.uniform(-3, 3)
        reach, half, start = rng.uniform(1.5, 9), rng.uniform(0.4, 1.2), x + rng.uniform(0, 20)
        middle = lane + rng.uniform(-0.3, 0.3)
        draft.panel(_ground(start, start + reach, middle - half, middle + half), (grey, grey, grey, 1, 0, 0),
                    stage=GROUND)
        start, y, slant = x + rng.uniform(0, 20), rng.choice([-1, 1]) * rng.uniform(0.5, 3.0), rng.uniform(-0.5, 0.5)
        seam = np.array([[start, y, 0], [start + 14, y + slant, 0], [start + 14, y + slant + 0.05, 0],
                         [start, y + 0.05, 0]])
        draft.panel(seam, (50, 48, 46, 0.5, 0, 0), stage=PAINT)
        if rng.random() < 0.4:
            cover = _ground(x, x + 0.7, -lane - 0.35, -lane + 0.35)
            draft.panel(cover, (70, 72, 76, 0.5, 0, 0), stage=PAINT)


def _add_kerb(draft: _Draft, plan: _Plan) -> None:
    """The kerb, the pavement behind it and the ground behind that, all higher than the road."""
    side = plan.kerb_side
    face, top, back = side * BESIDE, side * (BESIDE + 0.15), side * (BESIDE + 1.6)
    light = 150 if plan.sun[1] * side > 0 else 104
    draft.add(
        (_beside(-ENDLESS, ENDLESS, face, 0, KERB), (light, light, light, 0.5, 0, 0)),
        (_ground(-ENDLESS, ENDLESS, face, top, KERB), (184, 188, 190, 0.4, 0, 0)),
        (_ground(-ENDLESS, ENDLESS, top, back, KERB), (146, 152, 156, 0.6, 0, 0.4)),
        (_ground(-ENDLESS, ENDLESS, back, side * ENDLESS, KERB), (52, 108, 92, 0, 1, 0)),
        stage=GROUND,
    )
    draft.along((face, 0), (face, KERB), (top, KERB), (back, KERB))
    for x in np.arange(-50.0, LENGTH + SIGHT, 2.0):
        draft.panel(_ground(x, x + 0.02, face, top, KERB), (110, 112, 114, 0, 0, 0), stage=PAINT)


def _add_rail(draft: _Draft, plan: _Plan) -> None:
    """The guard rail on its posts, and the shadow of it."""
    side = -plan.kerb_side
    bounds, shares = (0.45, 0.53, 0.62, 0.7, 0.76), (0.72, 1.02, 0.66, 1.06)
    y = side * RAIL
    bands = zip(bounds[:-1], bounds[1:], shares, strict=True)
    draft.add(
        *((_beside(-ENDLESS, ENDLESS, y, low, high), _plain(STEEL, share)) for low, high, share in bands), stage=BEAM
    )
    draft.along(*((y, z) for z in bounds))
    shade = [y + plan.sun[1] * z for z in (bounds[0], bounds[-1])]
    draft.add((_ground(-ENDLESS, ENDLESS, *shade), (0, 0, 0, 0, 0, 0)), stage=SHADE, gain=0.55)
    draft.along(*((shift, 0) for shift in shade))
    for x in np.arange(-SIGHT, LENGTH + SIGHT, 4.0):
        _add_post(draft, plan, x, side * (RAIL + 0.1), 0.7, 0.1, (132, 132, 130), stage=POSTS)


def _add_post(
    draft: _Draft, plan: _Plan, x: float, y: float, height: float, size: float, colour: Colour, *, stage: int
) -> list[Float64]:
    low = _ground(x - size / 2, x + size / 2, y - size / 2, y + size / 2, KERB if y * plan.kerb_side > BESIDE else 0.0)
    return draft.block(low, _raised(low, height), colour, stage=stage, place=x, light=plan.light)


def _add_roadside(draft: _Draft, plan: _Plan, rng: np.random.Generator) -> None:
    """Reflector posts, lamp posts, signs and gantries, and the shadows of all that is tall."""
    for x in np.arange(-350.0, LENGTH + SIGHT, 25.0):
        for side in (-1, 1):
            _add_reflector(draft, plan, x + 3, side * (RAIL + 1.6))
    for x in np.arange(-360.0, LENGTH + SIGHT, 50.0) + rng.uniform(0, 25):
        y = plan.kerb_side * (BESIDE + 2.2)
        _add_post(draft, plan, x, y, 9.0, 0.18, (120, 124, 122), stage=ROADSIDE)
        _add_shadow_across(draft, plan, x, y, 9.0, 0.2)
        if rng.random() < 0.5:
            _add_sign(draft, plan, x + rng.uniform(10, 30), rng.choice([-1, 1]) * (RAIL + 2.4), rng)
    for x in np.arange(-200.0, LENGTH + SIGHT, 240.0) + rng.uniform(0, 200):
        _add_gantry(draft, plan, x, rng)


def _add_reflector(draft: _Draft, plan: _Plan, x: float, y: float) -> None:
    """A white post with a black band."""
    base = KERB if y * plan.kerb_side > BESIDE else 0.0
    low = _ground(x - 0.05, x + 0.05, y - 0.06, y + 0.06, base)
    bounds = 0.0, 0.62, 0.84, 1.0
    for bottom, top, colour in zip(bounds[:-1], bounds[1:], (MARKS, RUBBER, MARKS), strict=True):
        rings = _raised(low, bottom), _raised(low, top)
        sides = [np.array([rings[0][k], rings[0][k - 3], rings[1][k - 3], rings[1][k]]) for k in range(4)]
        draft.add(*((face, _plain(colour, share)) for face, share in zip(sides, plan.light[:4], strict=True)),
                  stage=ROADSIDE, place=x)
        draft.outline(rings[1])
    draft.outline(low)
    draft.lines.append(np.stack([low, _raised(low, 1.0)], axis=1))


def _add_shadow_across(draft: _Draft, plan: _Plan, x: float, y: float, height: float, size: float) -> None:
    """The shadow of a post as far as it falls on the road."""
    reach = plan.sun * height
    first, last = sorted(np.clip(((-BESIDE - y) / reach[1], (BESIDE - y) / reach[1]), 0, 1))
    if first == last:
        return
    starts = np.array([[x - size / 2, y, 0], [x + size / 2, y, 0]])
    ends = starts + np.array([*reach, 0])
    near, far = starts + first * (ends - starts), starts + last * (ends - starts)
    corners = np.array([near[0], near[1], far[1], far[0]])
    draft.shadow(corners if reach[1] > 0 else corners[::-1], 0.62, place=x)


def _add_sign(draft: _Draft, plan: _Plan, x: float, y: float, rng: np.random.Generator) -> None:
    _add_post(draft, plan, x + 0.1, y, 2.8, 0.08, (140, 142, 142), stage=ROADSIDE)
    half, low, high = rng.uniform(0.35, 0.7), rng.uniform(1.5, 1.8), rng.uniform(2.4, 3.0)
    board = np.array([[x, y + half, low], [x, y - half, low], [x, y - half, high], [x, y + half, high]])
    draft.panel(board, _plain(MARKS, 0.95), stage=ROADSIDE, place=x)
    field = _patch(board, 0.08, 0.92, 0.08, 0.92)
    draft.panel(field, _plain(BLUE if rng.random() < 0.5 else (30, 170, 226)), stage=ROADSIDE, place=x)
    draft.panel(_patch(field, 0.2, 0.8, 0.55, 0.75), _plain(MARKS), stage=ROADSIDE, place=x)


def _add_gantry(draft: _Draft, plan: _Plan, x: float, rng: np.random.Generator) -> None:
    """A beam across the road with boards on it; its shadow falls on the road."""
    for side in (-1, 1):
        _add_post(draft, plan, x, side * (RAIL + 2.0), 6.1, 0.35, (150, 152, 150), stage=ROADSIDE)
    low = _ground(x - 0.2, x + 0.2, -RAIL - 2, RAIL + 2, 5.6)
    soffit = low[::-1]
    draft.add((soffit, _plain((150, 152, 150), 0.5)), stage=ROADSIDE, place=x)
    draft.block(low, _raised(low, 0.5), (150, 152, 150), stage=ROADSIDE, place=x, light=plan.light)
    for y in rng.choice([-2.6, -1.6, 1.8], 2, replace=False):
        board = np.array([[x - 0.25, y + 1.4, 5.2], [x - 0.25, y - 1.4, 5.2], [x - 0.25, y - 1.4, 6.8],
                          [x - 0.25, y + 1.4, 6.8]])
        draft.panel(board, _plain(BLUE), stage=ROADSIDE, place=x)
        for u, v in ((0.1, 0.6), (0.1, 0.2)):
            draft.panel(_patch(board, u, u + rng.uniform(0.4, 0.75), v, v + 0.18), _plain(MARKS),
                        stage=ROADSIDE, place=x)
    start = x + plan.sun[0] * 5.8
    draft.shadow(_ground(start - 0.35, start + 0.35, -BESIDE, BESIDE), 0.6, place=x)


def _around(x1: float, x2: float, half: float, z: float) -> Float64:
    """The corners of a level rectangle across the middle of a car."""
    return _ground(x1, x2, -half, half, z)


def _car(plan: _Plan, colour: Colour, *, oncoming: bool = False) -> _Sheets:
    """A car of boxes: its tail at x = 0 or, oncoming, its front."""
    draft, back = _Draft(), 3  # the side that the camera sees: the one at low x
    light = plan.light
    _add_under(draft, plan, 4.2, 0.86)
    draft.block(_around(0, 4.2, 0.88, 0.25), _around(0, 4.2, 0.88, 0.5), DARK, stage=TRAFFIC, place=0.0, light=light)
    sides = draft.block(_around(0.05, 4.1, 0.86, 0.5), _around(0.05, 4.1, 0.84, 0.94), colour, stage=TRAFFIC,
                        place=0.0, light=light)
    lamp, plate = ((232, 240, 240) if oncoming else RED), (_patch(sides[back], 0.36, 0.64, 0.15, 0.42))
    for u in (0.04, 0.78):
        draft.panel(_patch(sides[back], u, u + 0.18, 0.5, 0.82), _plain(lamp), stage=TRAFFIC)
    draft.panel(plate, _plain(PLATE), stage=TRAFFIC)
    start, top = (1.2, 1.9) if oncoming else (0.35, 0.8)
    cabin = draft.block(_around(start, 3.5, 0.8, 0.94), _around(top, 2.9, 0.62, 1.44), colour, stage=TRAFFIC,
                        place=0.0, light=light)
    for face in cabin:
        draft.panel(_patch(face, 0.08, 0.92, 0.1, 0.86), _plain(GLASS), stage=TRAFFIC)
    return draft.done()


def _van(plan: _Plan, colour: Colour) -> _Sheets:
    """A delivery van from behind, its tail at x = 0."""
    draft, light = _Draft(), plan.light
    _add_under(draft, plan, 5.5, 0.95)
    draft.block(_around(0, 5.5, 0.98, 0.3), _around(0, 5.5, 0.98, 0.55), DARK, stage=TRAFFIC, place=0.0, light=light)
    tail = draft.block(_around(0.1, 5.4, 0.98, 0.55), _around(0.1, 5.4, 0.94, 2.4), colour, stage=TRAFFIC,
                       place=0.0, light=light)[3]
    for u in (0.08, 0.53):
        draft.panel(_patch(tail, u, u + 0.39, 0.55, 0.9), _plain(GLASS), stage=TRAFFIC)
    for u in (0.02, 0.92):
        draft.panel(_patch(tail, u, u + 0.06, 0.15, 0.4), _plain(RED), stage=TRAFFIC)
    draft.panel(_patch(tail, 0.495, 0.505, 0.02, 0.97), _plain(DARK), stage=TRAFFIC)
    draft.panel(_patch(tail, 0.36, 0.62, 0.05, 0.12), _plain(PLATE), stage=TRAFFIC)
    return draft.done()


def _add_under(draft: _Draft, plan: _Plan, length: float, half: float) -> None:
    """The shadow of a car and its wheels."""
    aside = 1.2 * plan.sun[1]
    draft.shadow(_ground(-0.1, length + 0.1, min(-half, aside - half), max(half, aside + half)), 0.5)
    draft.shadow(_ground(0.1, length - 0.1, -half, half), 0.4)
    for x in (0.5, length - 1.1):
        for y in (-half, half - 0.22):
            low = _ground(x, x + 0.6, y, y + 0.22)
            draft.block(low, _raised(low, 0.4), RUBBER, stage=TRAFFIC, place=0.0, light=(1, 1, 1, 1, 1))


def _surroundings(land: _Land, x: float) -> _Sheets:
    """All that can be seen from x, metres along the road: what stays where it is, and the traffic."""
    lane = land.plan.lane / 2
    ahead = x + land.gap + 3 * np.sin(x / 60)
    parts = [land.sheets.near(x), land.ahead.moved(ahead, -lane + 0.1 * np.sin(x / 35))]
    meetings = 130.0 * np.arange(np.floor(2 * x / 130), np.ceil((2 * x + SIGHT) / 130) + 1)
    # The camera meets oncoming cars, as fast as itself, where these places of theirs have halved.
    parts += [land.oncoming.moved(meeting - x, lane) for meeting in meetings]
    return _joined(parts)


class _Sight:
    """Sheets as a camera sees them.

    Attributes:
        sheets: Those that are in the picture, in the order in which they are painted.
        sides: M x 4 x 3: a point (x, y) in pixels is a x + b y + c pixels inside of each side.
        boxes: M x 4: the least x, y and most x, y of pixels that they touch.
    """

    def __init__(self, view: View, sheets: _Sheets) -> None:
        corners = sheets.corners - view.origin
        edges = np.roll(corners, -1, axis=1) - corners
        normals = np.cross(edges[:, 0], edges[:, 1])
        bounds, area = _bounds(view, sheets.corners)
        last = view.size - 1
        keep = ((normals * corners[:, 0]).sum(axis=1) < 0) & (area >= TINY)
        keep &= (bounds[:, :2] <= last).all(axis=1) & (bounds[:, 2:] >= 0).all(axis=1)
        away = np.abs(sheets.place - view.origin[0])
        order = np.lexsort((np.arange(len(away)), sheets.group, -away, sheets.stage))
        order = order[keep[order]]
        self.sheets = sheets.only(order, sheets.lines)
        self.boxes = np.clip(bounds[order], 0, np.tile(last, 2)).astype(int)
        self.sides = _sides(view, corners[order])


def _bounds(view: View, corners: Float64) -> tuple[Float64, Float64]:
    """The boxes around quadrilaterals (M x 4 x 3, metres) in whole pixels, M x 4, and their areas."""
    local = (corners - view.origin) @ view.axes
    lines = np.stack([local, np.roll(local, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    ahead = lines[..., 0] - CLEARANCE
    seen = np.repeat(ahead.max(axis=1) > 0, 2).reshape(len(corners), 8)
    pixels = np.full((len(corners), 8, 2), np.nan)
    part = clipped(lines, ahead)
    pixels[seen] = (view.centre - view.focal * part[..., 1:] / part[..., :1]).reshape(-1, 2)
    low = np.where(seen[..., None], pixels, np.inf).min(axis=1)
    high = np.where(seen[..., None], pixels, -np.inf).max(axis=1)
    area = np.where(seen.any(axis=1), np.prod(np.minimum(high - low, 1e6), axis=1), 0)
    return np.hstack([np.floor(np.clip(low - 0.5, -9, 1e6)), np.ceil(np.clip(high + 0.5, -9, 1e6))]), area


def _sides(view: View, corners: Float64) -> Float32:
    """The sides of quadrilaterals (M x 4 x 3, metres from the camera) as lines in the picture, M x 4 x 3."""
    normals = np.cross(np.roll(corners, -1, axis=1), corners)
    slopes = -normals @ view.axes[:, 1:] / view.focal
    level = normals @ view.axes[:, 0] - slopes @ view.centre
    sides = np.concatenate([slopes, level[..., None]], axis=2)
    return np.asarray(sides / np.maximum(np.hypot(*slopes.T).T, 1e-12)[..., None], np.float32)


def _coverage(sides: Float32, x: Float32, y: Float32) -> Float32:
    """The share of pixels at x (columns) and y (rows) that a quadrilateral covers, rows x columns."""
    share = np.ones((len(y), len(x)), np.float32)
    for pair in (sides[::2], sides[1::2]):
        strip = np.float32(1)
        for a, b, c in pair:
            if min(a * x[0], a * x[-1]) + min(b * y[0], b * y[-1]) + c < 0.5:
                strip = strip + np.clip(a * x + (b * y + (c + np.float32(0.5)))[:, None], 0, 1) - np.float32(1)
        if np.ndim(strip):
            share *= np.maximum(strip, 0)
    return share


def _exposure(view: View, land: _Land, sight: _Sight) -> Float32:
    """The picture without noise, H x W x 3 in grey levels."""
    width, height = view.size
    layers = np.zeros((6, height, width), np.float32)
    _paint_backdrop(layers, view, land)
    _paint_sheets(layers, sight)
    _paint_ground(layers, view, land)
    picture = np.ascontiguousarray(np.moveaxis(layers[:3] * view.vignette(view.px, view.py), 0, 2))
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), BLUR), np.float32)


def _paint_sheets(layers: Float32, sight: _Sight) -> None:
    sheets = sight.sheets
    first = 0
    while first < len(sheets.gain):
        stop = first + 1
        while stop < len(sheets.gain) and sheets.group[stop] == sheets.group[first]:
            stop += 1
        left, top = sight.boxes[first:stop, :2].min(axis=0)
        right, bottom = sight.boxes[first:stop, 2:].max(axis=0) + 1
        # Sheets of a group share the pixels at their seams without seeing each other there.
        behind = layers[:, top:bottom, left:right].copy()
        for k in range(first, stop):
            x1, y1, x2, y2 = sight.boxes[k] + (0, 0, 1, 1)
            x, y = np.arange(x1, x2, dtype=np.float32), np.arange(y1, y2, dtype=np.float32)
            old = behind[:, y1 - top:y2 - top, x1 - left:x2 - left]
            change = sheets.look[k][:, None, None] + (sheets.gain[k] - 1) * old
            layers[:, y1:y2, x1:x2] += change * _coverage(sight.sides[k], x, y)
        first = stop


def _paint_backdrop(layers: Float32, view: View, land: _Land) -> None:
    """Sky, hills and trees above the horizon, with the texture of the trees."""
    above = np.flatnonzero((view.rays(view.px, view.py)[2] > -0.01).any(axis=1))
    if not len(above):
        return
    rows = slice(above[0], above[-1] + 1)
    azimuth, elevation = _direction(view, view.px, view.py[rows])
    leaves = _tiled(land.grain, azimuth * 400, elevation * 400) + _tiled(land.grain, azimuth * 90, elevation * 120)
    layers[:3, rows], woods = _backdrop(land, azimuth, elevation, leaves)
    layers[:3, rows] += 7 * woods * leaves


def _direction(view: View, px: Float32, py: Float32) -> tuple[Float32, Float32]:
    """The azimuth (radians) and the elevation (its tangent) in which pixels look."""
    x, y, z = view.rays(px, py)
    return np.arctan2(y, x), np.asarray(z / np.maximum(np.hypot(x, y), np.float32(1e-6)), np.float32)


def _backdrop(
    land: _Land, azimuth: Float32, elevation: Float32, leaves: Float32 | None = None
) -> tuple[Float32, Float32]:
    """The colour of sky, hills and trees in directions (3 x their shape), and the share of trees in it.

    Leaves, texture of sigma 1.4, make the tree tops ragged.
    """
    place = azimuth * np.float32(AZIMUTHS / (2 * np.pi))
    whole = np.floor(place)
    share, cell = place - whole, whole.astype(np.int32) % AZIMUTHS
    beside = (cell + 1) % AZIMUTHS
    hills, crowns, light = (
        np.asarray(row[cell] * (1 - share) + row[beside] * share, np.float32) for row in land.heights
    )
    crowns = crowns if leaves is None else crowns * (1 + np.float32(0.12) * leaves)
    high = np.sqrt(np.clip(elevation * np.float32(1.6), 0, 1))
    haze = np.clip((hills - elevation) / np.float32(0.04) + np.float32(0.5), 0, 1)
    woods = np.clip((crowns - elevation) / np.float32(0.007) + np.float32(0.5), 0, 1)
    haze = haze * haze * (3 - 2 * haze)
    light = light * (1 + np.float32(1.1) * np.clip(elevation / crowns, 0, 1))  # the sun is on their tops
    colours = []
    for top, low, hill, tree in zip(SKY_TOP, SKY_LOW, HILLS, TREES, strict=True):
        colour = low + (top - low) * high
        colour += (hill - colour) * haze
        colours.append(colour + (tree * light - colour) * woods)
    return np.asarray(colours, np.float32), np.asarray(woods, np.float32)


def _tiled(field: Float32, column: Float32, row: Float32) -> Float32:
    """A field at places in cells, repeated without end."""
    column, row = (
        place - np.floor(place / np.float32(size)) * np.float32(size)
        for place, size in zip((column, row), field.shape[::-1], strict=True)
    )
    return np.asarray(cv2.remap(field, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32)


def _paint_ground(layers: Float32, view: View, land: _Land) -> None:
    """Texture and the shade of trees on all that is ground."""
    below = np.flatnonzero((view.rays(view.px, view.py)[2] < -1e-3).any(axis=1))
    if not len(below):
        return
    rows = slice(below[0], below[-1] + 1)
    rough, lush, worn = layers[3:, rows]
    x, y, wide, long = _footprints(view, land, view.px, view.py[rows])
    texture = rough * (
        8 * _grained(land, x, y, 0.012, wide, long)
        + 4 * _grained(land, x, y, 0.05, wide, long)
        + _on_map(land.wear, x, y, wide)
    )
    texture += lush * (
        15 * _grained(land, x, y, 0.03, wide, long)
        + 10 * _grained(land, x, y, 0.25, wide, long)
        + 5 * _grained(land, x, y, 2.2, wide, long)
    )
    texture -= worn * np.maximum(0, 14 + 22 * _grained(land, x, y, 0.06, wide, long))
    layers[:3, rows] += texture
    layers[:3, rows] *= 1 - (rough + lush + worn) * _shading(land, x, y, wide, long)


def _shading(land: _Land, x: Float32, y: Float32, wide: Float32, long: Float32) -> Float32:
    """The share of light that trees take from the ground."""
    return np.asarray(np.float32(0.3) * _on_map(land.shade, x, y, wide) / (1 + (long / 2) ** 2), np.float32)


def _footprints(view: View, land: _Land, px: Float32, py: Float32) -> tuple[Float32, ...]:
    """Where on the ground pixels look, x and y, and how wide and long they are there; metres."""
    ahead, left, up = view.rays(px, py)
    origin = view.origin.astype(np.float32)
    away = np.minimum(origin[2] / np.maximum(-up, np.float32(1e-3)), np.float32(SIGHT))
    side = np.float32(land.plan.kerb_side)
    raised = away * (1 - np.float32(KERB) / origin[2])
    away = np.where(side * (origin[1] + raised * left) > BESIDE, raised, away)
    wide = away / np.float32(view.focal)
    long = wide * np.maximum(1, away / origin[2])
    return origin[0] + away * ahead, origin[1] + away * left, wide, np.asarray(long, np.float32)


def _grained(land: _Land, x: Float32, y: Float32, cell: float, wide: Float32, long: Float32) -> Float32:
    """Texture with cells of so many metres, faded out where it is finer than the pixels."""
    inverse = np.float32(1 / cell)
    field = _tiled(land.grain, x * inverse, y * inverse + np.float32(1000 * cell))
    faded = field / ((1 + (wide * inverse) ** 2) * (1 + np.float32(0.6) * long * inverse))
    return np.asarray(faded, np.float32)


def _on_map(field: Float32, x: Float32, y: Float32, wide: Float32) -> Float32:
    """A map of the road, rows along y and columns along x, as it is seen at places; metres."""
    column = x / np.float32(STRETCH)
    column -= np.floor(column / np.float32(TILE)) * np.float32(TILE)
    row = np.clip((y + np.float32(MAP_WIDTH)) / np.float32(ACROSS) - np.float32(0.5), 0, field.shape[0] - 1)
    found = cv2.remap(field, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(found / (1 + (wide / np.float32(4 * ACROSS)) ** 2), np.float32)


def _visible_edges(view: View, land: _Land, sight: _Sight) -> tuple[Float64, Float64]:
    """The edges in the picture, truth and weak, each N x 4."""
    edges = view.project(sight.sheets.lines)
    edges = edges[lengths_of(edges) >= SPECK]
    if not len(edges):
        return np.empty((0, 4)), np.empty((0, 4))
    return graded(edges, *_contrasts(view, land, sight, edges))


def _contrasts(view: View, land: _Land, sight: _Sight, edges: Float64) -> list[Float32]:
    """The steps in grey levels across edges (N x 2 x 2) at places along them, N x S, measured near and wide.

    A short edge is measured at fewer places than a long one, and each of them stands for some of the S.
    """
    lengths = lengths_of(edges)
    counts = np.ceil(lengths / STEP).astype(int)
    first = np.cumsum(counts) - counts
    edge = np.repeat(np.arange(len(edges)), counts)
    shares = (np.arange(len(edge)) - first[edge] + 0.5) / counts[edge]
    along = edges[:, 1] - edges[:, 0]
    middle = edges[edge, 0] + along[edge] * shares[:, None]
    normal = (along[:, ::-1] * (-1, 1) / lengths[:, None])[edge]
    places = np.stack([middle + reach * normal for reach in (-NEAR, NEAR, -WIDE, WIDE)])
    levels = _radiance(view, land, sight, *places.reshape(-1, 2).T.astype(np.float32)).reshape(4, -1)
    most = counts.max()
    spread = first[:, None] + ((np.arange(most) + 0.5) / most * counts[:, None]).astype(int)
    return [(levels[k + 1] - levels[k])[spread] for k in (0, 2)]


def _radiance(view: View, land: _Land, sight: _Sight, px: Float32, py: Float32) -> Float32:
    """The grey levels at points of the picture, P, without texture and noise."""
    layers = np.zeros((6, len(px)), np.float32)
    layers[:3] = _backdrop(land, *_direction(view, px, py))[0]
    for sides, (x1, y1, x2, y2), gain, look in zip(
        sight.sides, sight.boxes, sight.sheets.gain, sight.sheets.look, strict=True
    ):
        hit = np.flatnonzero((px >= x1 - 2) & (px <= x2 + 2) & (py >= y1 - 2) & (py <= y2 + 2))
        x, y = px[hit], py[hit]
        hit = hit[np.logical_and.reduce([a * x + b * y + c >= 0 for a, b, c in sides])]
        layers[:, hit] = look[:, None] + gain * layers[:, hit]
    rows = [np.resize(values, (len(px) // ROW + 1, ROW)) for values in _footprints(view, land, px, py)]
    layers[:3] *= 1 - layers[3:].sum(axis=0) * _shading(land, *rows).ravel()[:len(px)]
    return np.asarray(GREY @ layers[:3] * view.vignette(px, py), np.float32)

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from line_feature_node.scenes import Camera, Scene, corridor

LEVEL = Camera(x=3.0, y=0.1, yaw=0.0, pitch=0.0, roll=0.0)
POSES = [
    Camera(),
    LEVEL,
    Camera(x=8.0, y=-0.5, z=0.6, yaw=0.4, pitch=0.15, roll=-0.1),
    Camera(x=12.0, yaw=3.0),
]
FOCAL = 512.0  # pixels: 0.8 of 640
SMALL: Any = {'width': 320, 'height': 240}
COS, SIN = np.cos(0.1), np.sin(0.1)


@pytest.fixture(scope='module', params=POSES, ids=range(len(POSES)))
def clean(request: pytest.FixtureRequest) -> Scene:
    return corridor(request.param, noise=0)


def grey(scene: Scene) -> npt.NDArray[np.float32]:
    return cv2.cvtColor(scene.image, cv2.COLOR_BGR2GRAY).astype(np.float32)


def lengths(segments: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])


def steepest(picture: npt.NDArray[np.float32], segment: npt.NDArray[np.float64]) -> float:
    """How far beside a segment, in pixels, the mean profile across it is steepest: the centroid of its slope."""
    start, along = segment[:2], segment[2:] - segment[:2]
    length = np.hypot(*along)
    normal = np.array([-along[1], along[0]]) / length
    offsets = np.arange(-2.5, 2.55, 0.1)
    shares = np.arange(3, length - 3) / length
    places = start + shares[:, None, None] * along + offsets[:, None] * normal
    x, y = np.moveaxis(places.astype(np.float32), -1, 0)
    profiles = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    slope = np.abs(np.gradient(profiles.mean(axis=0)))
    near = np.abs(offsets - offsets[slope.argmax()]) < 0.85
    weight = np.maximum(slope - slope.max() / 2, 0) * near
    return float((weight * offsets).sum() / weight.sum())


def test_same_arguments_give_same_bytes() -> None:
    once, again = corridor(seed=3, **SMALL), corridor(seed=3, **SMALL)
    assert once.image.tobytes() == again.image.tobytes()
    assert once.truth.tobytes() == again.truth.tobytes()
    assert once.weak.tobytes() == again.weak.tobytes()


def test_seed_changes_the_noise_alone() -> None:
    one, other = corridor(seed=1, **SMALL), corridor(seed=2, **SMALL)
    assert (one.image != other.image).mean() > 0.5
    np.testing.assert_array_equal(one.truth, other.truth)
    np.testing.assert_array_equal(one.weak, other.weak)
    still = [corridor(noise=0, seed=seed, **SMALL).image for seed in (1, 2)]
    np.testing.assert_array_equal(still[0], still[1])


def test_layout_changes_the_corridor() -> None:
    one, other = corridor(layout=0, noise=0, **SMALL), corridor(layout=1, noise=0, **SMALL)
    assert one.truth.shape != other.truth.shape or not np.array_equal(one.truth, other.truth)
    assert (one.image != other.image).mean() > 0.3


@pytest.mark.parametrize(('width', 'height'), [(320, 200), (97, 131)])
def test_shapes_and_types(width: int, height: int) -> None:
    scene = corridor(width=width, height=height)
    assert scene.image.shape == (height, width, 3)
    assert scene.image.dtype == np.uint8
    for edges in (scene.truth, scene.weak):
        assert edges.dtype == np.float64
        assert edges.shape == (len(edges), 4)
        assert len(edges) > 0
        assert edges.min() >= -1e-9
        assert edges[:, 0::2].max() <= width - 1 + 1e-9
        assert edges[:, 1::2].max() <= height - 1 + 1e-9


@pytest.mark.filterwarnings('error')
def test_rays_along_the_walls_are_rendered_as_their_neighbours() -> None:
    odd: Any = {'width': 321, 'height': 241, 'noise': 0}  # the middle column and row look exactly along x
    along, beside = (grey(corridor(camera, **odd)) for camera in (LEVEL, replace(LEVEL, yaw=1e-6, pitch=1e-6)))
    one_ray_of_a_pixel = 252 / 13  # may fall to the other side of an edge
    assert np.abs(along - beside).max() <= one_ray_of_a_pixel + 1


def test_truth_is_long_and_plenty(clean: Scene) -> None:
    assert len(clean.truth) >= 30
    assert lengths(clean.truth).min() >= 20


def test_truth_is_where_the_picture_is_steepest(clean: Scene) -> None:
    picture = grey(clean)
    inside = [
        segment
        for segment in clean.truth
        if (segment > 1).all() and (segment[0::2] < 638).all() and (segment[1::2] < 478).all()
    ]
    offsets = np.abs([steepest(picture, segment) for segment in inside])
    assert len(offsets) >= 20
    assert np.median(offsets) < 0.05
    assert np.quantile(offsets, 0.9) < 0.25


def test_no_two_truths_are_too_near_to_tell_apart(clean: Scene) -> None:
    start, along = clean.truth[:, :2], clean.truth[:, 2:] - clean.truth[:, :2]
    unit = along / lengths(clean.truth)[:, None]
    away = (start + along / 2)[:, None] - start
    beside = np.abs(away[..., 0] * unit[:, 1] - away[..., 1] * unit[:, 0]) < 3.9
    beside &= ((away * unit).sum(axis=2) > 0) & ((away * unit).sum(axis=2) < lengths(clean.truth))
    beside &= np.abs(unit @ unit.T) > np.cos(np.radians(14))
    np.testing.assert_array_equal(beside, np.eye(len(beside), dtype=bool))


def test_every_strong_step_of_the_picture_is_told(clean: Scene) -> None:
    steps = np.hypot(*np.gradient(grey(clean)))
    told = np.zeros(steps.shape, np.uint8)
    for edges in (clean.truth, clean.weak):
        for x1, y1, x2, y2 in np.rint(edges).astype(int).tolist():
            cv2.line(told, (x1, y1), (x2, y2), 1, 7)
    strong = steps > 10
    assert strong.sum() > 1000
    assert told[strong].mean() > 0.999


@pytest.mark.parametrize('noise', [2.0, 6.0])
def test_noise_has_the_sigma_asked_for(noise: float) -> None:
    clean = corridor(noise=0, **SMALL).image.astype(float)
    grain = corridor(noise=noise, seed=5, **SMALL).image - clean
    unclipped = grain[(clean > 40) & (clean < 215)]
    assert unclipped.std() == pytest.approx(noise, rel=0.03)
    assert unclipped.mean() == pytest.approx(0, abs=0.05)


def test_forward_motion_moves_truth_as_projection_says() -> None:
    forward = 0.5
    before, after = corridor(LEVEL, noise=0).truth, corridor(replace(LEVEL, x=LEVEL.x + forward), noise=0).truth
    upright = [truth[np.abs(truth[:, 0] - truth[:, 2]) < 1e-6, 0] - 319.5 for truth in (before, after)]
    beside = np.where(upright[0] < 0, 1.2 - LEVEL.y, -1.2 - LEVEL.y)  # metres from the camera to the left or right wall
    depth = -FOCAL * beside / upright[0]
    expected = -FOCAL * beside / (depth - forward)
    expected = expected[(depth < 12) & (np.abs(expected) < 319)]
    nearest = np.abs(expected[:, None] - upright[1]).min(axis=1)
    assert len(expected) >= 6
    assert nearest.max() < 0.001


@pytest.mark.parametrize(
    ('turn', 'ahead', 'left', 'up'),
    [
        ({}, 6.0, 1.1, 1.6),
        ({'yaw': 0.1}, 6.0 * COS + 1.1 * SIN, 1.1 * COS - 6.0 * SIN, 1.6),
        ({'pitch': 0.1}, 6.0 * COS - 1.6 * SIN, 1.1, 1.6 * COS + 6.0 * SIN),
        ({'roll': 0.1}, 6.0, 1.1 * COS + 1.6 * SIN, 1.6 * COS - 1.1 * SIN),
    ],
    ids=['level', 'yaw to the left', 'pitch downwards', 'roll to the right'],
)
def test_corner_of_the_end_wall_is_where_projection_says(
    turn: dict[str, float], ahead: float, left: float, up: float
) -> None:
    scene = corridor(replace(LEVEL, x=18.0, y=0.1, z=1.0, focal=200.0, **turn), **SMALL)
    ends = np.concatenate([scene.truth, scene.weak]).reshape(-1, 2)
    corner = 159.5 - 200 * left / ahead, 119.5 - 200 * up / ahead
    assert np.hypot(*(ends - corner).T).min() < 1e-6


def test_looking_at_a_blank_ceiling_gives_no_truth() -> None:
    scene = corridor(Camera(x=6.7, y=0.0, z=2.5, pitch=-np.pi / 2, roll=0.0, yaw=0.0), width=64, height=48)
    assert scene.truth.shape == scene.weak.shape == (0, 4)


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ({'noise': -1.0}, 'noise must be 0 or more, not -1.0'),
        ({'noise': np.nan}, 'noise must be 0 or more, not nan'),
        ({'width': 0}, 'width and height must be 2 pixels or more, not 0 x 480'),
        ({'height': -3}, 'width and height must be 2 pixels or more, not 640 x -3'),
        ({'seed': -1}, 'seed must be 0 or more, not -1'),
        ({'layout': -2}, 'layout must be 0 or more, not -2'),
        ({'camera': Camera(y=1.3)}, r'y must be -1.15 to 1.15 metres, not 1.3'),
        ({'camera': Camera(x=24.0)}, r'x must be 0.05 to 23.95 metres, not 24.0'),
        ({'camera': Camera(yaw=np.inf)}, 'yaw must be an angle in radians, not inf'),
        ({'camera': Camera(focal=0.0)}, 'focal must be more than 0 pixels, not 0.0'),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        corridor(**arguments)

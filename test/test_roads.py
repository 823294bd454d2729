from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from line_feature_node.core import end_points, extract
from line_feature_node.roads import DEFAULT_CAMERA, road
from line_feature_node.scenes import Camera, Scene
from line_feature_node.truth import compare

SMALL: Any = {'width': 320, 'height': 240}
LEVEL = replace(DEFAULT_CAMERA, pitch=0.0)
POSES = [
    (DEFAULT_CAMERA, 0),
    (Camera(x=300.0, y=-1.3, z=1.3, yaw=0.06, pitch=0.05, roll=0.03), 1),
    (Camera(x=222.0, y=-1.7, z=2.4, yaw=0.0, pitch=0.12, roll=0.0), 0),
    (Camera(x=77.7, y=0.0, z=1.3, yaw=3.1, pitch=0.03, roll=0.0), 8),
]
STEP = 20 / 30  # metres from frame to frame at 20 m/s and 30 Hz


@pytest.fixture(scope='module', params=POSES, ids=range(len(POSES)))
def clean(request: pytest.FixtureRequest) -> Scene:
    camera, layout = request.param
    return road(camera, layout=layout, noise=0)


def grey(scene: Scene) -> npt.NDArray[np.float32]:
    return cv2.cvtColor(scene.image, cv2.COLOR_BGR2GRAY).astype(np.float32)


def lengths(segments: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])


def profile(
    picture: npt.NDArray[np.float32], segment: npt.NDArray[np.float64], offsets: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """The mean grey levels at offsets (pixels) beside a segment."""
    start, along = segment[:2], segment[2:] - segment[:2]
    length = np.hypot(*along)
    normal = np.array([-along[1], along[0]]) / length
    shares = np.arange(3, length - 3) / length
    places = start + shares[:, None, None] * along + offsets[:, None] * normal
    x, y = np.moveaxis(places.astype(np.float32), -1, 0)
    return cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).mean(axis=0).astype(float)


def step_offset(picture: npt.NDArray[np.float32], segment: npt.NDArray[np.float64]) -> float:
    """How far beside a segment, in pixels, the profile across it crosses the middle between its two levels."""
    offsets = np.arange(-1.5, 1.55, 0.05)
    levels = profile(picture, segment, offsets)
    rising = (levels - (levels[0] + levels[-1]) / 2) * np.sign(levels[-1] - levels[0])
    return float(offsets[np.abs(rising).argmin()])


def test_same_arguments_give_same_bytes() -> None:
    once, again = road(seed=3, **SMALL), road(seed=3, **SMALL)
    assert once.image.tobytes() == again.image.tobytes()
    assert once.truth.tobytes() == again.truth.tobytes()
    assert once.weak.tobytes() == again.weak.tobytes()


def test_seed_changes_the_noise_alone() -> None:
    one, other = road(seed=1, **SMALL), road(seed=2, **SMALL)
    assert (one.image != other.image).mean() > 0.5
    np.testing.assert_array_equal(one.truth, other.truth)
    np.testing.assert_array_equal(one.weak, other.weak)
    still = [road(noise=0, seed=seed, **SMALL).image for seed in (1, 2)]
    np.testing.assert_array_equal(still[0], still[1])


def test_noise_has_the_sigma_asked_for() -> None:
    clean = road(noise=0, **SMALL).image.astype(float)
    grain = road(noise=5.0, seed=5, **SMALL).image - clean
    unclipped = grain[(clean > 30) & (clean < 225)]
    assert unclipped.std() == pytest.approx(5.0, rel=0.03)
    assert unclipped.mean() == pytest.approx(0, abs=0.1)


def test_layout_changes_the_road() -> None:
    one, other = road(layout=0, noise=0, **SMALL), road(layout=1, noise=0, **SMALL)
    assert one.truth.shape != other.truth.shape or not np.array_equal(one.truth, other.truth)
    assert (one.image != other.image).mean() > 0.3


@pytest.mark.parametrize(('width', 'height'), [(320, 200), (97, 131)])
def test_shapes_and_types(width: int, height: int) -> None:
    scene = road(width=width, height=height)
    assert scene.image.shape == (height, width, 3)
    assert scene.image.dtype == np.uint8
    for edges in (scene.truth, scene.weak):
        assert edges.dtype == np.float64
        assert edges.shape == (len(edges), 4)
        assert (edges >= -1e-9).all()
        assert (edges[:, 0::2] <= width - 1 + 1e-9).all()
        assert (edges[:, 1::2] <= height - 1 + 1e-9).all()
    assert len(scene.weak) > 0


def test_truth_is_long_and_plenty(clean: Scene) -> None:
    assert len(clean.truth) >= 15
    assert lengths(clean.truth).min() >= 20


def test_truth_lies_on_visible_edges(clean: Scene) -> None:
    picture = grey(clean)
    levels = np.array([profile(picture, segment, np.array([-1.5, 1.5])) for segment in clean.truth])
    contrast = np.abs(levels[:, 1] - levels[:, 0])
    assert contrast.mean() > 30
    assert (contrast > 8).all()


def test_truth_is_where_the_picture_steps(clean: Scene) -> None:
    picture = grey(clean)
    offsets = np.abs([step_offset(picture, segment) for segment in clean.truth])
    assert np.median(offsets) < 0.1
    assert np.quantile(offsets, 0.9) < 0.5


def test_every_strong_step_below_the_horizon_is_told(clean: Scene) -> None:
    steps = np.hypot(*np.gradient(grey(clean)))
    told = np.zeros(steps.shape, np.uint8)
    for edges in (clean.truth, clean.weak):
        for x1, y1, x2, y2 in np.rint(edges).astype(int).tolist():
            cv2.line(told, (x1, y1), (x2, y2), 1, 7)
    strong = steps > 14
    strong[:300] = False
    assert strong.sum() > 500
    assert told[strong].mean() > 0.995


@pytest.mark.parametrize('noise', [0.0, 4.0])
def test_a_detector_finds_the_truth_among_clutter(noise: float) -> None:
    scene = road(noise=noise)
    agreement = compare(end_points(extract(scene.image)), scene.truth, scene.weak)
    assert agreement.recall > 0.7
    assert agreement.precision > 0.55


def dash_ends(camera: Camera) -> npt.NDArray[np.float64]:
    """The distances ahead, in metres, at which the dashes end: across the middle, as the level picture tells."""
    scene = road(camera, noise=0, layout=8)
    edges = np.concatenate([scene.truth, scene.weak])
    left, up = (319.5 - edges[:, 0::2]) / 512, (239.5 - edges[:, 1::2]) / 512
    ahead = camera.z / np.maximum(-up, 1e-6)
    y = camera.y + ahead * left
    across = (np.ptp(ahead, axis=1) < 1e-6) & (np.abs(y) < 0.06 + 1e-6).all(axis=1)
    return np.sort(ahead[across, 0])


def test_dashes_come_nearer_as_the_camera_drives() -> None:
    frames = [dash_ends(replace(LEVEL, x=640.0 + k * STEP)) for k in (0, 1, 3)]
    for k, ends in zip((0, 1, 3), frames, strict=True):
        assert len(ends) >= 2
        expected = frames[0] - k * STEP
        seen = expected[(expected > 4) & (expected < 10)]
        assert len(seen) > 0
        assert np.abs(seen[:, None] - ends).min(axis=1).max() < 1e-6


def test_endless_lines_stay_as_the_camera_drives() -> None:
    before, after = (road(replace(LEVEL, x=x), noise=0).truth for x in (20.0, 20.0 + STEP))
    longest = before[lengths(before).argsort()[-4:]]
    for segment in longest:
        along = segment[2:] - segment[:2]
        normal = np.array([-along[1], along[0]]) / np.hypot(*along)
        assert np.abs((after.reshape(-1, 2, 2) - segment[:2]) @ normal).max(axis=1).min() < 1e-6


def test_lines_along_the_road_meet_on_the_horizon() -> None:
    truth = road(replace(LEVEL, yaw=0.1), noise=0).truth
    point = np.array([319.5 + 512 * np.tan(0.1), 239.5])
    along = truth[:, 2:] - truth[:, :2]
    beside = np.abs(along[:, 0] * (truth[:, 1] - point[1]) - along[:, 1] * (truth[:, 0] - point[0])) / lengths(truth)
    assert ((beside < 0.1) & (lengths(truth) > 60)).sum() >= 4


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('pitch', [-np.pi / 2, np.pi / 2, 0.0], ids=['up', 'down', 'aside'])
def test_it_may_look_anywhere(pitch: float) -> None:
    scene = road(Camera(x=0.0, y=3.0, z=0.3, yaw=np.pi / 2, pitch=pitch, roll=0.0), width=64, height=48)
    assert scene.image.shape == (48, 64, 3)
    if pitch < 0:
        assert len(scene.truth) == 0


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ({'noise': -1.0}, 'noise must be 0 or more, not -1.0'),
        ({'noise': np.nan}, 'noise must be 0 or more, not nan'),
        ({'width': 0}, 'width and height must be 2 pixels or more, not 0 x 480'),
        ({'seed': -1}, 'seed must be 0 or more, not -1'),
        ({'layout': -2}, 'layout must be 0 or more, not -2'),
        ({'camera': Camera(y=3.1)}, r'y must be -3 to 3 metres, not 3.1'),
        ({'camera': Camera(x=2001.0)}, r'x must be 0 to 2000 metres, not 2001.0'),
        ({'camera': Camera(x=np.nan)}, r'x must be 0 to 2000 metres, not nan'),
        ({'camera': Camera(z=0.1)}, r'z must be 0.3 to 4 metres, not 0.1'),
        ({'camera': Camera(yaw=np.inf)}, 'yaw must be an angle in radians, not inf'),
        ({'camera': Camera(focal=0.0)}, 'focal must be more than 0 pixels, not 0.0'),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        road(**arguments)

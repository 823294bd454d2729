import dataclasses
import math
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from line_feature_node.core import (
    SEGMENT_DTYPE,
    STEPS,
    LineFeatureExtractor,
    Parameters,
    Stages,
    edges,
    extract,
    pipeline,
)
from line_feature_node.scenes import Camera, corridor

Image = npt.NDArray[Any]
TYPES = [np.uint8, np.uint16, np.float32]
BOTH = pytest.mark.parametrize('profile', ['default', 'paper'])
#: Column and row steps of the chain code: 0 is +x, then in steps of 45 degrees towards +y.
STEPS_OF_CODE = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)])
#: Known of refined segments only.
OF_REFINED = ('sigma_theta', 'sigma_offset', 'contrast', 'polarity', 'log_nfa')
FRAMES = ['grey', 'candidates', 'strong', 'edges', 'chain_pixels', 'chain_offsets', 'chain_directions', 'closed',
          'bridged', 'codes_before', 'codes_after', 'blobs', 'blob_pixels', 'blob_offsets', 'unlinked', 'linked',
          'segments']


def half_plane(height: int, width: int, degrees: float, x: float, y: float) -> npt.NDArray[np.float64]:
    """Share of each pixel's area, exactly, that lies to the right of a line through (x, y), looking along it."""
    rows, columns = np.mgrid[:height, :width]
    radians = math.radians(degrees)
    distance = (rows - y) * math.cos(radians) - (columns - x) * math.sin(radians)
    small, large = sorted((abs(math.cos(radians)), abs(math.sin(radians))))
    if small < 1e-9:
        return np.clip(distance + 0.5, 0, 1)

    def second_integral(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.maximum(t, 0)**2 / 2

    a, b = (large + small) / 2, (large - small) / 2
    return (second_integral(distance + a) - second_integral(distance + b) - second_integral(distance - b)
            + second_integral(distance - a)) / (small * large)


def scene(height: int = 90, width: int = 120, dtype: Any = np.uint8, seed: int = 0, sigma: float = 4) -> Image:
    """A few bright triangles and bars with a little noise."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 60.0)
    for _ in range(4):
        x, y, turn = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, 360)
        inside = np.ones((height, width))
        for k in range(3):
            angle = turn + 120 * k
            inside *= half_plane(height, width, angle, x + 25 * math.sin(math.radians(angle)),
                                 y - 25 * math.cos(math.radians(angle)))
        image += inside * (rng.uniform(40, 180) - image)
    image = np.clip(image + rng.normal(0, sigma, image.shape), 0, 255)
    return (image * 257 if dtype == np.uint16 else image).astype(dtype)


def coloured(dtype: Any = np.uint8, channels: int = 3) -> Image:
    return np.stack([scene(dtype=dtype, seed=seed) for seed in range(channels)], -1)


def same(first: npt.NDArray[np.void], second: npt.NDArray[np.void]) -> bool:
    """Byte for byte."""
    return first.dtype == second.dtype and first.tobytes() == second.tobytes()


# Straight edges.

ANGLES = [0, 1, 5, 10, 17, 22.5, 24, 31, 38, 45, 46, 52, 60, 67.5, 71, 80, 88, 90, 93, 112.5, 120, 135, 143, 157.5, 174]


@BOTH
@pytest.mark.parametrize('dark', [False, True], ids=['bright', 'dark'])
@pytest.mark.parametrize('degrees', ANGLES)
def test_straight_edge(profile: str, degrees: float, dark: bool) -> None:
    """It is one segment, with its position, its angle and nine tenths of its length.

    By codes: where the code changes, at 22.5 degrees and so on, the border of the image may turn the gradient enough
    to cut off a few pixels at an end. And the end points of (A.5) and (A.6) come from the minimum rectangle: of a line
    at one degree, which is three pixels high, they cut off up to a pixel's worth of rise.
    """
    size, centre = 151, 75
    side = half_plane(size, size, degrees, centre, centre)
    image = np.round(60 + 120 * (1 - side if dark else side)).astype(np.uint8)
    found = extract(image, profile=profile)
    segment = found[found['length'].argmax()]
    assert found['length'].sum() - segment['length'] <= (15 if degrees % 45 == 22.5 else 0)
    radians = math.radians(degrees)
    cos, sin = math.cos(radians), math.sin(radians)
    whole = (size - 1) / max(abs(cos), abs(sin))
    turned = (float(segment['theta']) - radians + math.pi / 2) % math.pi - math.pi / 2
    assert abs(math.degrees(turned)) < 0.2
    for x, y in (('x', 'y'), ('x1', 'y1'), ('x2', 'y2')):
        assert abs((segment[y] - centre) * cos - (segment[x] - centre) * sin) < (0.1 if x == 'x' else 0.5)
    short = 1 / max(min(abs(cos), abs(sin)), 1 / whole)
    assert min(0.9 * whole, whole - short) <= segment['length'] <= 1.02 * whole + 1
    assert segment['size'] >= 0.9 * whole * max(abs(cos), abs(sin))
    gradient = (degrees + 90 + 22.5) % 180 / 45
    if abs(gradient - round(gradient)) > 0.1:
        assert segment['code'] == math.floor(gradient) % 4 + 1


@BOTH
@pytest.mark.parametrize('degrees', ANGLES)
@pytest.mark.parametrize('shift', [0.3, 0.7])
def test_straight_edge_between_pixels(profile: str, degrees: float, shift: float) -> None:
    """Wherever it lies, it is one segment and no point of it is more than a pixel off."""
    radians = math.radians(degrees)
    cos, sin = math.cos(radians), math.sin(radians)
    x, y = 75 - shift * sin, 75 + shift * cos
    found = extract((60 + 120 * half_plane(151, 151, degrees, x, y)).astype(np.float32), profile=profile)
    assert len(found) == 1 or degrees % 45 == 22.5
    for segment in found:
        for end_x, end_y in (('x', 'y'), ('x1', 'y1'), ('x2', 'y2')):
            assert abs((segment[end_y] - y) * cos - (segment[end_x] - x) * sin) < 1


@BOTH
@pytest.mark.parametrize('operator', Parameters.specs()['operator'].choices)
@pytest.mark.parametrize('degrees', [*ANGLES, *(math.degrees(math.atan2(*slope)) for slope in (
    (1, 2), (2, 1), (1, 3), (3, 1), (2, 3), (3, 2), (1, -2), (2, -1), (1, -3), (3, -1), (2, -3)))])
def test_straight_edge_is_thin_and_has_no_gap(profile: str, degrees: float, operator: str) -> None:
    """Ties of norms neither tear it nor leave it thick, wherever it lies: from border to border it hangs together."""
    radians = math.radians(degrees)
    steep = abs(math.sin(radians)) > abs(math.cos(radians))
    extractor = LineFeatureExtractor(Parameters.profile(profile, operator=operator, max_gap=0, min_chain=1, T1=4, T2=2))
    for shift in (0, 0.25, 0.5, 0.8):
        side = half_plane(61, 61, degrees, 30 + shift * steep, 30 + shift * (not steep))
        for image in (np.round(60 + 120 * side).astype(np.uint8), (180 - 120 * side).astype(np.float32)):
            edges = (extractor.stages(image).edges != 0)[6:-6, 6:-6]
            assert cv2.connectedComponents(edges.astype(np.uint8), connectivity=8)[0] == 2
            across = edges.sum(axis=1 if steep else 0)
            assert across.max() <= 2
            assert across.mean() > 0.5


@BOTH
@pytest.mark.parametrize('operator', ['deriche', 'sobel'])
def test_turned_image_has_turned_segments(profile: str, operator: str) -> None:
    """Its mirror image has the same edges; the ends are named anew."""
    image = np.round(60 + 120 * half_plane(100, 140, 20, 70, 50)).astype(np.uint8)
    straight, mirrored = (extract(turned, operator=operator, profile=profile) for turned in (image, image[:, ::-1]))
    assert len(straight) == len(mirrored) == 1
    assert straight['theta'][0] == pytest.approx(-mirrored['theta'][0], abs=5e-3)
    assert straight['length'][0] == pytest.approx(mirrored['length'][0], abs=2)


@BOTH
@pytest.mark.parametrize('image', [
    np.zeros((60, 80), np.uint8), np.full((60, 80), 255, np.uint8), np.full((60, 80, 3), 7, np.uint8),
    np.full((60, 80), 65535, np.uint16), np.full((60, 80, 4), 0.5, np.float32),
], ids=lambda image: f'{image.dtype} {image.ndim}')
def test_blank_image_has_no_segment(profile: str, image: Image) -> None:
    found = extract(image, profile=profile)
    assert found.shape == (0,)
    assert found.dtype == SEGMENT_DTYPE


# What an image may be.

def test_layout_of_the_result() -> None:
    """Fields of four bytes, the paper's first, without holes: the layout of the message."""
    names = ['x', 'y', 'z', 'x1', 'y1', 'x2', 'y2', 'length', 'theta', 'intercept', 'rho', 'code', 'size']
    assert SEGMENT_DTYPE.names is not None
    assert list(SEGMENT_DTYPE.names[:13]) == names
    for k, name in enumerate(SEGMENT_DTYPE.names):
        assert SEGMENT_DTYPE.fields is not None
        assert SEGMENT_DTYPE.fields[name][1] == 4 * k
        if name in names:
            assert SEGMENT_DTYPE[name] == (np.uint32 if name in ('code', 'size') else np.float32)
    assert SEGMENT_DTYPE.itemsize == 4 * len(SEGMENT_DTYPE.names)


def padded_rows(image: Image) -> Image:
    wide = np.full((image.shape[0], image.shape[1] + 5, *image.shape[2:]), 99, image.dtype)
    wide[:, :image.shape[1]] = image
    return wide[:, :image.shape[1]]


def every_other(image: Image) -> Image:
    large = np.full((2 * image.shape[0], 3 * image.shape[1], *image.shape[2:]), 99, image.dtype)
    large[::2, ::3] = image
    return large[::2, ::3]


def unaligned(image: Image) -> Image:
    raw = np.zeros(image.nbytes + 1, np.uint8)
    view = raw[1:].view(image.dtype).reshape(image.shape)
    view[...] = image
    return view


def read_only(image: Image) -> Image:
    copied = image.copy()
    copied.flags.writeable = False
    return copied


@BOTH
@pytest.mark.parametrize('layout', [
    padded_rows, every_other, unaligned, read_only, np.asfortranarray,
    lambda image: image[::-1].copy()[::-1], lambda image: image[:, ::-1].copy()[:, ::-1],
    lambda image: image.astype(image.dtype.newbyteorder('>')),
    lambda image: image.astype(image.dtype.newbyteorder('<')),
    lambda image: read_only(every_other(image.astype(image.dtype.newbyteorder('>')))),
], ids=['padded', 'every other', 'unaligned', 'read-only', 'fortran', 'upside down', 'mirrored', 'big endian',
        'little endian', 'all of it'])
@pytest.mark.parametrize('dtype', TYPES)
@pytest.mark.parametrize('channels', [1, 3, 4])
def test_layout_in_memory_does_not_matter(profile: str, layout: Any, dtype: Any, channels: int) -> None:
    image = scene(dtype=dtype) if channels == 1 else coloured(dtype, channels)
    expected = extract(image, profile=profile)
    before = layout(image)
    kept = before.copy()
    assert len(expected) > 0
    assert same(extract(before, profile=profile), expected)
    np.testing.assert_array_equal(before, kept)


@BOTH
@pytest.mark.parametrize('dtype', TYPES)
def test_one_channel_is_grey(profile: str, dtype: Any) -> None:
    image = scene(dtype=dtype)
    assert same(extract(image[:, :, None], profile=profile), extract(image, profile=profile))
    assert same(extract(np.moveaxis(image[None], 0, -1), profile=profile), extract(image, profile=profile))


@BOTH
@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
@pytest.mark.parametrize('channels', [3, 4])
def test_equal_channels_are_grey(profile: str, dtype: Any, channels: int) -> None:
    image = scene(dtype=dtype)
    assert same(extract(np.repeat(image[:, :, None], channels, 2), profile=profile), extract(image, profile=profile))


def test_equal_channels_are_grey_floats() -> None:
    """Weights of the channels round."""
    image = np.round(scene(dtype=np.float32, sigma=0))
    grey = LineFeatureExtractor().stages(np.repeat(image[:, :, None], 3, 2)).grey
    np.testing.assert_allclose(grey, image, rtol=1e-6)


@BOTH
@pytest.mark.parametrize('dtype', TYPES)
def test_alpha_channel_is_ignored(profile: str, dtype: Any) -> None:
    image = coloured(dtype, 4)
    expected = extract(image[:, :, :3], profile=profile)
    assert same(extract(image, profile=profile), expected)
    image[:, :, 3] = 0
    assert same(extract(image, profile=profile), expected)


@pytest.mark.parametrize('dtype', TYPES)
def test_colours_are_blue_green_red(dtype: Any) -> None:
    """Weights .114, .587 and .299."""
    image = coloured(dtype)
    grey = LineFeatureExtractor().stages(image).grey
    assert grey.dtype == dtype
    expected = image.astype(np.float64) @ [0.114, 0.587, 0.299]
    np.testing.assert_allclose(grey, expected, atol=1e-3 if dtype == np.float32 else 1.01)


@BOTH
@pytest.mark.parametrize('operator', ['deriche', 'sobel'])
def test_every_size(profile: str, operator: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(
        profile, operator=operator, min_chain=1, min_size=2, T1=4, T2=2))
    rng = np.random.default_rng(0)
    shapes = [*((1, n) for n in range(1, 71)), *((n, 1) for n in range(1, 71)), *((20, n) for n in range(1, 71)),
              *((n, 21) for n in range(1, 71)), (2, 2), (1, 5000), (5000, 1), (2, 3000), (3000, 2)]
    for height, width in shapes:
        found = extractor.extract(rng.integers(0, 256, (height, width), np.uint8))
        for name, size in (('x1', width), ('x2', width), ('y1', height), ('y2', height)):
            assert (found[name] >= -0.5).all()
            assert (found[name] <= size - 0.5).all()


@BOTH
@pytest.mark.parametrize('shape', [(1, 1, 1), (1, 1, 3), (1, 1, 4), (1, 7, 3), (7, 1, 4), (2, 2, 1)], ids=str)
@pytest.mark.parametrize('dtype', TYPES)
def test_small_colour_images(profile: str, shape: tuple[int, ...], dtype: Any) -> None:
    assert extract(np.zeros(shape, dtype), profile=profile).shape == (0,)


@pytest.mark.parametrize('shape', [
    (), (5,), (0, 0), (0, 5), (5, 0), (0, 5, 3), (5, 5, 0), (5, 5, 2), (5, 5, 5), (3, 5, 5), (1, 5, 5, 3),
    (1, 1, 1, 1, 1),
], ids=str)
def test_wrong_shape(shape: tuple[int, ...]) -> None:
    """The message names what came and what is expected."""
    with pytest.raises(ValueError, match='^image must ') as caught:
        extract(np.zeros(shape, np.uint8))
    assert str(shape) in str(caught.value)
    assert 'pixels' in str(caught.value) if 0 in shape[:2] else 'H×W' in str(caught.value)


@pytest.mark.parametrize('dtype', [
    object, np.float64, np.float16, complex, bool, np.int8, np.int16, np.int32, np.int64, np.uint32, 'U3', 'S1',
    'M8[s]', [('r', np.uint8), ('g', np.uint8)],
])
def test_wrong_type_of_pixel(dtype: Any) -> None:
    image = np.zeros((5, 5), dtype)
    with pytest.raises(TypeError, match='^image must be uint8, uint16 or float32') as caught:
        extract(image)
    assert str(image.dtype) in str(caught.value)


@pytest.mark.parametrize('image', [None, [[1, 2], [3, 4]], 'image.png', b'\0', 5, 5.0, memoryview(b'abcd')],
                         ids=lambda image: type(image).__name__)
def test_no_array(image: Any) -> None:
    with pytest.raises(TypeError, match='^image must be a numpy array') as caught:
        extract(image)
    assert type(image).__name__ in str(caught.value)


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('shape', [(1, 1), (40, 50), (40, 50, 3), (40, 50, 4)], ids=str)
@pytest.mark.parametrize('last', [False, True], ids=['first', 'last'])
def test_pixels_that_are_not_finite(value: float, shape: tuple[int, ...], last: bool) -> None:
    """In any channel that counts."""
    image = np.zeros(shape, np.float32)
    image[(-1, -1, 2)[:len(shape)] if last else (0,) * len(shape)] = value
    with pytest.raises(ValueError, match='^image must be finite'):
        extract(image)


@BOTH
def test_extractor_survives_a_wrong_image(profile: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    expected = extractor.extract(scene())
    wrong = scene(dtype=np.float32)
    wrong[3, 3] = np.nan
    for image in (wrong, np.zeros((0, 3), np.uint8), None):
        with pytest.raises((TypeError, ValueError)):
            extractor.extract(image)
    assert same(extractor.extract(scene()), expected)


@pytest.mark.parametrize('wrong', [{}, {'T1': 9}, 'paper', 3, Parameters], ids=str)
def test_wrong_parameters(wrong: Any) -> None:
    with pytest.raises(TypeError, match='^parameters must be Parameters, got'):
        LineFeatureExtractor(wrong)


def test_wrong_parameters_of_the_function() -> None:
    with pytest.raises(TypeError, match="'T3'"):
        extract(scene(), T3=1)
    with pytest.raises(ValueError, match='^T2 must be less'):
        extract(scene(), T1=1, T2=2)
    with pytest.raises(ValueError, match='^profile must be one of'):
        extract(scene(), profile='none')


@pytest.mark.parametrize(('dtype', 'given'), [
    (np.uint8, {'intensity_min': 255}), (np.uint8, {'intensity_min': 300}), (np.uint16, {'intensity_min': 65535}),
    (np.uint8, {'intensity_max': 0}), (np.float32, {'intensity_max': -5}), (np.float32, {'intensity_min': 255}),
])
def test_range_that_contradicts_the_type(dtype: Any, given: dict[str, float]) -> None:
    """The end that is unset is the type's own; the range must not be empty or turned round."""
    with pytest.raises(ValueError, match='intensity_min'):
        extract(np.ones((5, 5), dtype), **given)


# One extractor, many frames.

def frames() -> list[Image]:
    return [scene(), coloured(), scene(61, 150, np.uint16, 1), scene(dtype=np.float32), scene(33, 20, seed=2),
            np.zeros((5, 5), np.uint8), scene(seed=4), np.full((1, 1), 9, np.uint8), scene(200, 230, seed=5)]


@pytest.mark.parametrize('parameters', [
    Parameters(), Parameters.paper(), Parameters(operator='sobel', orientation='least_squares', max_gap=0),
    Parameters.profile('paper', operator='sobel', orientation='least_squares', n=0, max_gap=0),
    Parameters(refine=False), Parameters(grouping='codes'),
], ids=['default', 'paper', 'other', 'paper other', 'linked', 'codes'])
def test_frames_do_not_depend_on_those_before(parameters: Parameters) -> None:
    extractor = LineFeatureExtractor(parameters)
    expected = [LineFeatureExtractor(parameters).extract(image) for image in frames()]
    assert sum(len(segments) for segments in expected) > 30
    order = [*range(len(expected)), *reversed(range(len(expected))), 0, 0, 3, 0]
    for k in order:
        assert same(extractor.extract(frames()[k]), expected[k]), k


@BOTH
@pytest.mark.parametrize('thinning', Parameters.specs()['thinning'].choices)
def test_images_of_one_padded_width_do_not_mix(profile: str, thinning: str) -> None:
    """Rows are padded to whole words: what a wider image left in the padding must not be seen."""
    extractor = LineFeatureExtractor(Parameters.profile(profile, thinning=thinning, min_chain=2))
    noise = np.random.default_rng(0).integers(0, 256, (30, 46), np.uint8)
    for width in range(46, 30, -1):
        extractor.extract(noise)
        image = np.ascontiguousarray(noise[:, :width])
        fresh = LineFeatureExtractor(extractor.parameters).extract(image)
        assert same(extractor.extract(image), fresh)


@BOTH
def test_one_extractor_in_two_threads_is_refused(profile: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would write into the memory of the other; afterwards it goes on."""
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    expected = extractor.extract(scene())
    refused = []

    def second(*_: Any) -> None:
        try:
            extractor.extract(scene())
        except RuntimeError as error:
            refused.append(str(error))

    monkeypatch.setattr(extractor, '_steps', lambda *_: second())
    extractor.extract(scene())
    monkeypatch.undo()
    assert refused == ['the extractor is at work in another thread: each thread needs an extractor of its own']
    assert same(extractor.extract(scene()), expected)


def test_warm_up_leaves_out_types_that_the_range_contradicts() -> None:
    extractor = LineFeatureExtractor(Parameters(intensity_min=300))
    extractor.warm_up()
    with pytest.raises(ValueError, match='intensity_min must be less than intensity_max'):
        extractor.warm_up(np.uint8)


@BOTH
def test_results_are_not_overwritten(profile: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    first = extractor.extract(scene())
    kept = first.copy()
    second = extractor.extract(scene(seed=1))
    assert not np.shares_memory(first, second)
    assert same(first, kept)
    first['x'] = -1
    assert same(extractor.extract(scene()), kept)


@BOTH
def test_stages_are_not_overwritten(profile: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    image = scene()
    first = extractor.stages(image)
    kept = {name: getattr(first, name).copy() for name in FRAMES}
    image[:] = 0
    extractor.stages(scene(seed=1))
    extractor.extract(scene(seed=2))
    for name in FRAMES:
        assert getattr(first, name).tobytes() == kept[name].tobytes(), name


@BOTH
def test_image_is_left_alone(profile: str) -> None:
    for image in frames():
        kept = image.copy()
        extract(image, profile=profile)
        LineFeatureExtractor(Parameters.profile(profile)).stages(image)
        np.testing.assert_array_equal(image, kept)


def together(count: int, work: Any) -> list[Any]:
    """Run it in threads that start at once."""
    barrier = threading.Barrier(count)

    def wait_and_work(k: int) -> Any:
        barrier.wait()
        return work(k)

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(wait_and_work, range(count)))


@BOTH
def test_function_in_threads(profile: str) -> None:
    pictures = frames()
    expected = [extract(image, profile=profile) for image in pictures]

    def work(k: int) -> bool:
        order = np.random.default_rng(k).permutation(len(pictures))
        return all(same(extract(pictures[i], profile=profile), expected[i]) for _ in range(3) for i in order)

    assert all(together(8, work))


def test_extractors_in_threads() -> None:
    pictures = frames()
    parameters = [Parameters(), Parameters(operator='sobel'), Parameters.paper(),
                  Parameters.profile('paper', alpha=1.8, n=9), Parameters(max_gap=0, T1=20), Parameters(refine=False)]
    expected = [[LineFeatureExtractor(p).extract(image) for image in pictures] for p in parameters]

    def work(k: int) -> bool:
        extractor = LineFeatureExtractor(parameters[k % 6])
        return all(same(extractor.extract(image), segments)
                   for _ in range(3) for image, segments in zip(pictures, expected[k % 6], strict=True))

    assert all(together(8, work))


# Threads on one frame

def wide(height: int, width: int, sigma: float, kind: type = np.uint8) -> Any:
    """A corridor of any size, in noise."""
    image = cv2.cvtColor(corridor(Camera(), width=max(width, 64), height=max(height, 48)).image, cv2.COLOR_BGR2GRAY)
    noisy = image[:height, :width] + np.random.default_rng(height).normal(0, sigma, (height, width))
    scale = 257 if kind == np.uint16 else 1
    return np.clip(np.rint(noisy) * scale, 0, 255 * scale).astype(kind)


@pytest.mark.parametrize('parameters', [
    {}, {'grouping': 'codes'}, {'refine': False}, {'operator': 'dog'}, {'alpha': 0.3}, {'profile': 'paper'},
    {'thinning': 'morphological'}, {'thinning': 'none'}, {'scale': 0.7}, {'max_segments': 40},
], ids=str)
@pytest.mark.parametrize(('height', 'width', 'sigma'), [(1, 1, 0), (7, 300, 9), (300, 7, 9), (480, 640, 3), (
    600, 337, 12), (1080, 1920, 5)])
def test_threads_make_no_difference(
    parameters: dict[str, Any], height: int, width: int, sigma: float, monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The same bytes, and the same edges, however many work on a frame, and however small it is."""
    monkeypatch.setattr(pipeline, 'LEAST_SHARED', 0)
    image = wide(height, width, sigma)
    chosen = Parameters.profile(parameters.get('profile', 'default'),
                                **{name: value for name, value in parameters.items() if name != 'profile'})
    alone = LineFeatureExtractor(chosen)
    expected = alone.extract(image)
    for threads in (2, 3, 7):
        shared = LineFeatureExtractor(dataclasses.replace(chosen, threads=threads))
        for _ in range(2):
            assert same(shared.extract(image), expected)
        np.testing.assert_array_equal(shared.edges(), alone.edges())


@pytest.mark.parametrize('kind', TYPES)
@pytest.mark.parametrize('roi', [(0.0, 0.0, 1.0, 1.0), (0.0, 0.1, 0.95, 0.85)])
def test_threads_make_no_difference_to_masks_and_regions(kind: type, roi: Any) -> None:
    image = wide(800, 1280, 4, kind)
    mask = np.ones(image.shape, np.uint8)
    mask[200:300, 400:900] = 0
    expected = LineFeatureExtractor(Parameters(roi=roi)).extract(image, mask)
    assert len(expected) > 20
    assert same(LineFeatureExtractor(Parameters(roi=roi, threads=2)).extract(image, mask), expected)


def test_warm_up_is_for_all_threads() -> None:
    """No kernel is compiled, or loaded, at the first frame that is large enough for several."""
    before = signatures()
    extractor = LineFeatureExtractor(Parameters(threads=2, operator='deriche'))
    extractor.warm_up(np.uint16)
    warm = signatures()
    assert warm['smooth_down'] >= max(before['smooth_down'], 1)
    extractor.extract(wide(720, 1280, 4, np.uint16))
    assert signatures() == warm


CHANGING = """
import importlib, itertools, pkgutil
import numpy as np
from line_feature_node import core

names = [found.name for found in pkgutil.iter_modules(core.__path__)]
modules = [importlib.import_module(f'line_feature_node.core.{name}') for name in names]
kernels = [value for module in modules for value in vars(module).values() if hasattr(value, 'signatures')]
assert len(kernels) > 50
core.warm_up_all()
before = [len(kernel.signatures) for kernel in kernels]
names = ('operator', 'thinning', 'grouping', 'refine', 'orientation', 'n', 'threads')
values = (('deriche', 'sobel', 'dog'), ('suppression', 'morphological', 'none'), ('codes', 'straightness'),
          (True, False), ('principal_axis', 'least_squares'), (0, 4), (1, 2))
picture = np.zeros((736, 736), np.uint8)
picture[90:400, 90:400] = 200
for some in itertools.product(*values):
    parameters = core.Parameters(**dict(zip(names, some)))
    if parameters.threads > 1 and (parameters.orientation, parameters.n) != ('principal_axis', 4):
        continue  # large pictures take long
    seen = picture if parameters.threads > 1 else picture[60:140, 60:160]
    for kind in (np.uint8, np.uint16, np.float32):
        core.LineFeatureExtractor(parameters).extract(seen.astype(kind), np.ones(seen.shape, bool))
print([kernel for kernel, count in zip(kernels, before) if len(kernel.signatures) > count])
"""


@pytest.mark.compiled
def test_no_parameters_need_kernels_that_warm_up_all_has_not() -> None:
    """In a process of its own, where no other test had any compiled."""
    done = subprocess.run([sys.executable, '-c', CHANGING], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ('[]\n', '')


def signatures() -> dict[str, int]:
    """How many types of arguments each kernel of the edge extraction is compiled for."""
    return {name: len(value.signatures) for name, value in vars(edges).items() if hasattr(value, 'signatures')}


def test_edges_stay_those_of_the_last_frame_that_was_extracted() -> None:
    """Another is refused, whose size is another: its memory is the same."""
    extractor = LineFeatureExtractor(Parameters.profile('paper', intensity_min=300.0))
    extractor.extract(wide(40, 48, 4, np.uint16))
    before = extractor.edges()
    assert before.any()
    with pytest.raises(ValueError, match='intensity_min must be less'):
        extractor.extract(np.zeros((24, 32), np.uint8))
    np.testing.assert_array_equal(extractor.edges(), before)


def test_small_pictures_have_one_thread() -> None:
    before = set(threading.enumerate())
    extractor = LineFeatureExtractor(Parameters(threads=4))
    extractor.extract(wide(480, 640, 4))
    assert not set(threading.enumerate()) - before
    extractor.extract(wide(720, 1280, 4))
    assert set(threading.enumerate()) - before


def test_threads_may_change_between_frames() -> None:
    image = wide(720, 1280, 4)
    extractor = LineFeatureExtractor()
    expected = extractor.extract(image)
    for threads in (3, 1, 2, 2, 1):
        extractor.parameters = Parameters(threads=threads)
        assert same(extractor.extract(image), expected)


def test_stages_of_several_threads() -> None:
    """They are those of one, and fit together."""
    image = wide(1080, 640, 2)
    stages, alone = (LineFeatureExtractor(Parameters(threads=threads)).stages(image) for threads in (2, 1))
    for name in FRAMES:
        assert getattr(stages, name).tobytes() == getattr(alone, name).tobytes(), name
    assert stages.chain_offsets[-1] == len(stages.chain_pixels) == np.count_nonzero(stages.edges)
    assert (np.diff(stages.chain_offsets) > 0).all()
    inside = np.ones(len(stages.chain_pixels) - 1, bool)
    inside[stages.chain_offsets[1:-1] - 1] = False
    assert (np.abs(np.diff(stages.chain_pixels, axis=0)).max(1)[inside] == 1).all()
    assert stages.blob_offsets[-1] == len(stages.blob_pixels)
    for k, blob in enumerate(stages.blobs):
        pixels = stages.blob_pixels[stages.blob_offsets[k]:stages.blob_offsets[k + 1]]
        assert len(pixels) == blob['size']
        assert (*pixels.min(0), *pixels.max(0)) == tuple(
            blob[name] for name in ('min_col', 'min_row', 'max_col', 'max_row'))


# What the extractor tells beside the segments.

def test_function_is_the_extractor() -> None:
    for chosen in ({}, {'T1': 12}, {'alpha': 0.7, 'max_gap': 0}, {'operator': 'sobel'}, {'refine': False}):
        assert same(extract(scene(), **chosen), LineFeatureExtractor(Parameters(**chosen)).extract(scene()))
    expected = LineFeatureExtractor(Parameters.profile('paper', T1=12)).extract(scene())
    assert same(extract(scene(), profile='paper', T1=12), expected)
    assert same(extract(scene(), profile='default'), extract(scene()))


@BOTH
def test_times(profile: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    assert list(extractor.times) == list(STEPS)
    extractor.extract(scene())
    assert list(extractor.times) == list(STEPS)
    assert all(0 <= seconds < 60 for seconds in extractor.times.values())
    assert sum(extractor.times.values()) > 0


@BOTH
def test_unlinked_counts_segments_before_linking(profile: str) -> None:
    extractor = LineFeatureExtractor(Parameters.profile(profile, min_length=0))
    for image in (scene(), np.zeros((9, 9), np.uint8), scene(seed=3)):
        segments = extractor.extract(image)
        assert extractor.unlinked >= len(segments)
        assert extractor.unlinked == len(extractor.stages(image).unlinked)
    assert LineFeatureExtractor(Parameters.profile(profile)).unlinked == 0


def test_linking_only_joins() -> None:
    """No edge pixel is lost or counted twice by it."""
    for seed in range(4):
        stages = LineFeatureExtractor(Parameters.profile('paper', max_segments=2)).stages(scene(seed=seed))
        assert stages.unlinked['size'].sum() == stages.linked['size'].sum()
        assert len(stages.linked) <= len(stages.unlinked)
        assert len(stages.segments) < len(stages.linked)


@BOTH
def test_linked_are_all_segments_whatever_is_selected(profile: str) -> None:
    """In the order of the result, which leaves some out."""
    plain = LineFeatureExtractor(Parameters.profile(profile, min_length=0)).stages(scene(seed=1))
    assert same(plain.linked, plain.segments)
    for chosen in ({'min_length': 20}, {'max_segments': 3}, {'theta_min': 0, 'theta_max': 1}, {'min_length': 1e5}):
        stages = LineFeatureExtractor(Parameters.profile(profile, **chosen)).stages(scene(seed=1))
        assert same(stages.linked, plain.linked)
        chosen_bytes = {segment.tobytes() for segment in stages.segments}
        left = [k for k, segment in enumerate(plain.linked) if segment.tobytes() in chosen_bytes]
        assert len(left) < len(plain.linked)
        assert same(stages.segments, plain.linked[left])


@BOTH
def test_linked_and_segments_are_arrays_of_their_own(profile: str) -> None:
    stages = LineFeatureExtractor(Parameters.profile(profile, min_length=0)).stages(scene())
    linked = stages.linked.copy()
    stages.segments['x'] = -1
    assert same(stages.linked, linked)


# Truths that hold for every image.

def hysteresis(candidates: Image, strong: Image) -> npt.NDArray[np.bool_]:
    """Candidates that are 8-connected to a strong one through candidates."""
    _, labels = cv2.connectedComponents((candidates != 0).astype(np.uint8), connectivity=8)
    good = np.unique(labels[strong])
    return np.isin(labels, good[good != 0])


def check_edges(stages: Stages) -> None:
    assert set(np.unique(stages.candidates)) <= {0, 1, 2, 3, 4}
    assert (stages.candidates[stages.strong] != 0).all()
    expected = np.where(hysteresis(stages.candidates, stages.strong), stages.candidates, 0)
    np.testing.assert_array_equal(stages.edges, expected)


def check_chains(stages: Stages, parameters: Parameters) -> None:
    height, width = stages.grey.shape
    pixels, offsets = stages.chain_pixels.astype(np.int64), stages.chain_offsets
    assert len(np.unique(pixels, axis=0)) == len(pixels)
    assert (pixels >= 0).all()
    assert (pixels < [width, height]).all()
    at_pixels = stages.edges[pixels[:, 1], pixels[:, 0]]
    np.testing.assert_array_equal(at_pixels != 0, ~stages.bridged)
    np.testing.assert_array_equal(stages.codes_before[~stages.bridged], at_pixels[~stages.bridged])
    assert np.isin(stages.codes_before, [1, 2, 3, 4]).all()
    assert np.isin(stages.codes_after, [1, 2, 3, 4]).all()
    assert offsets[0] == 0
    assert len(pixels) == len(stages.chain_directions)
    if parameters.thinning == 'none':
        assert len(offsets) == 1
        assert len(pixels) == (stages.edges != 0).sum()
    else:
        assert offsets[-1] == len(pixels)
    assert len(stages.closed) == len(offsets) - 1
    if parameters.refine and parameters.thinning != 'none':
        # Chains as they were traced: every edge pixel is in one, and lines grow over gaps by themselves.
        assert len(pixels) == (stages.edges != 0).sum()
        assert not stages.closed.any()
    else:
        assert (np.diff(offsets) >= parameters.min_chain).all()
    if parameters.n == 0:
        np.testing.assert_array_equal(stages.codes_before, stages.codes_after)
    if parameters.max_gap == 0 or parameters.refine:
        assert not stages.bridged.any()
    for first, end, closed in zip(offsets[:-1], offsets[1:], stages.closed, strict=True):
        chain, directions = pixels[first:end], stages.chain_directions[first:end]
        following = np.roll(chain, -1, 0) if closed else chain[1:]
        if not closed:
            assert directions[-1] == 255
            directions = directions[:-1]
        assert (directions < 8).all()
        np.testing.assert_array_equal(chain[:len(following)] + STEPS_OF_CODE[directions], following)
        bridged = stages.bridged[first:end]
        assert not bridged[0] or closed
        assert not bridged[-1] or closed
        # Filled pixels take the code of the end that they continue.
        for k in np.flatnonzero(bridged[1:]) + 1:
            assert stages.codes_before[first + k] == stages.codes_before[first + k - 1]
        runs = ''.join('b' if flag else ' ' for flag in bridged).split()
        assert max((len(run) for run in runs), default=0) <= parameters.max_gap


def check_stretches(stages: Stages, parameters: Parameters) -> None:
    """Blobs are stretches of chains, none of them twice, with the code that most of their pixels have."""
    pixels, width = stages.chain_pixels.astype(np.int64), stages.grey.shape[1]
    places = {place: k for k, place in enumerate((pixels[:, 1] * width + pixels[:, 0]).tolist())}
    chain_of = np.searchsorted(stages.chain_offsets, np.arange(len(pixels)), 'right')
    last = -1
    assert len(stages.blob_pixels) == stages.blob_offsets[-1]
    assert len(stages.blob_offsets) == len(stages.blobs) + 1
    for k, blob in enumerate(stages.blobs):
        columns, rows = stages.blob_pixels[stages.blob_offsets[k]:stages.blob_offsets[k + 1]].astype(np.int64).T
        members = np.array([places[place] for place in (rows * width + columns).tolist()])
        assert blob['select']
        assert len(members) == blob['size'] >= parameters.min_size
        assert members[0] > last
        assert (np.diff(members) == 1).all()
        assert len(set(chain_of[members].tolist())) == 1
        assert blob['dir'] == 1 + np.bincount(stages.codes_before[members], minlength=5)[1:].argmax()
        assert (blob['min_row'], blob['max_row']) == (rows.min(), rows.max())
        assert (blob['min_col'], blob['max_col']) == (columns.min(), columns.max())
        last = members[-1]


def check_blobs(stages: Stages) -> None:
    """Blobs are the 8-connected components of the pixels of each code after normalisation."""
    height, width = stages.grey.shape
    pixels = stages.chain_pixels
    image = np.zeros((height, width), np.uint8)
    image[pixels[:, 1], pixels[:, 0]] = stages.codes_after
    labels = np.full((height, width), -1)
    assert len(stages.blob_pixels) == len(pixels) == stages.blob_offsets[-1]
    for k, blob in enumerate(stages.blobs):
        columns, rows = stages.blob_pixels[stages.blob_offsets[k]:stages.blob_offsets[k + 1]].T
        assert len(columns) == blob['size']
        assert blob['select'] == (len(columns) > 0)
        if blob['select']:
            assert (labels[rows, columns] == -1).all()
            labels[rows, columns] = k
            assert (image[rows, columns] == blob['dir']).all()
            assert (blob['min_row'], blob['max_row']) == (rows.min(), rows.max())
            assert (blob['min_col'], blob['max_col']) == (columns.min(), columns.max())
    np.testing.assert_array_equal(labels >= 0, image != 0)
    for code in range(1, 5):
        of_code = image == code
        parts, expected = cv2.connectedComponents(of_code.astype(np.uint8), connectivity=8)
        pairs = np.unique(np.stack([expected[of_code], labels[of_code]]), axis=1)
        assert pairs.shape[1] == parts - 1 == len(np.unique(pairs[1]))


def check_moments(stages: Stages, parameters: Parameters) -> None:
    """Mid-point and orientation of each blob, from its pixels but those that fill gaps."""
    filled = {tuple(pixel) for pixel in stages.chain_pixels[stages.bridged]}
    expected = []
    for k in np.flatnonzero(stages.blobs['select']):
        points = np.array([pixel for pixel in stages.blob_pixels[stages.blob_offsets[k]:stages.blob_offsets[k + 1]]
                           if tuple(pixel) not in filled], np.int64).reshape(-1, 2)
        n = len(points)
        (xx, xy), (_, yy) = (n * points.T @ points - np.outer(points.sum(0), points.sum(0))).tolist()
        if n >= parameters.min_size and (xx != yy or xy != 0):
            if parameters.orientation == 'principal_axis':
                theta = math.atan2(2 * xy, xx - yy) / 2
            else:
                theta = math.atan2(xy, xx) if xx >= yy else math.atan2(yy, xy)
            expected.append((n, *points.mean(0), theta, stages.blobs['dir'][k]))
    assert len(expected) == len(stages.unlinked)
    for segment, (n, x, y, theta, code) in zip(stages.unlinked, expected, strict=True):
        assert (segment['size'], segment['code']) == (n, code)
        assert segment['x'] == pytest.approx(x, abs=1e-3)
        assert segment['y'] == pytest.approx(y, abs=1e-3)
        turned = (segment['theta'] - theta + math.pi / 2) % math.pi - math.pi / 2
        assert abs(turned) < 1e-5


def check_segments(segments: npt.NDArray[np.void], height: int, width: int, parameters: Parameters) -> None:
    assert segments.dtype == SEGMENT_DTYPE
    for name in set(SEGMENT_DTYPE.names or ()) - {'intercept', *OF_REFINED}:
        assert np.isfinite(segments[name]).all(), name
    if parameters.refine:
        for name in OF_REFINED:
            assert np.isfinite(segments[name]).all(), name
        for name in ('sigma_theta', 'sigma_offset', 'contrast'):
            assert (segments[name] >= 0).all(), name
        assert np.isin(segments['polarity'], [-1, 1]).all()
        assert (segments['log_nfa'] <= math.log10(parameters.false_alarms) + 1e-4).all()
        assert (segments['sigma_theta'] <= np.float32(parameters.max_sigma_theta)).all()
        assert (segments['size'] > 0).all()
    else:
        for name in OF_REFINED:
            assert name == 'polarity' or np.isnan(segments[name]).all(), name
        assert (segments['polarity'] == 0).all()
        assert (segments['size'] >= parameters.min_size).all()
    assert np.isin(segments['code'], [1, 2, 3, 4]).all()
    assert (segments['length'] >= parameters.min_length * (1 - 1e-6)).all()
    assert (segments['z'] == 0).all()
    assert (abs(segments['theta']) <= np.float32(math.pi / 2)).all()
    assert (segments['theta'] > -np.float32(math.pi / 2)).all()
    for end, size in (('x1', width), ('x2', width), ('y1', height), ('y2', height)):
        assert (segments[end] >= -0.5).all()
        assert (segments[end] <= size - 0.5).all()
    x, y, x1, y1, x2, y2, length, theta, intercept, rho = (
        segments[name].astype(np.float64)
        for name in ('x', 'y', 'x1', 'y1', 'x2', 'y2', 'length', 'theta', 'intercept', 'rho'))
    cos, sin = np.cos(theta), np.sin(theta)
    for end_x, end_y in ((x1, y1), (x2, y2)):
        assert (abs((end_y - y) * cos - (end_x - x) * sin) < 1e-2).all()
    np.testing.assert_allclose(length, np.hypot(x2 - x1, y2 - y1), atol=1e-3)
    np.testing.assert_allclose(rho, y * cos - x * sin, atol=1e-3)
    assert np.isnan(intercept[cos < 5e-7]).all()
    sloped = cos > 1e-5  # of a steeper line, the 24 bits of theta give the cosine to no better than a hundredth
    assert np.isfinite(intercept[sloped]).all()
    # The line meets the y axis there; a steep one far away.
    np.testing.assert_allclose((intercept * cos)[sloped], rho[sloped], atol=1e-2, rtol=1e-2)


def check_everything(image: Image, parameters: Parameters) -> Stages:
    extractor = LineFeatureExtractor(parameters)
    stages = extractor.stages(image)
    height, width = image.shape[:2]
    assert stages.grey.shape == stages.candidates.shape == stages.strong.shape == stages.edges.shape == (height, width)
    assert same(stages.segments, extractor.extract(image))
    check_edges(stages)
    check_chains(stages, parameters)
    if parameters.grouping == 'codes' or parameters.thinning == 'none':
        check_blobs(stages)
    else:
        check_stretches(stages, parameters)
        np.testing.assert_array_equal(stages.codes_before, stages.codes_after)
    check_moments(stages, parameters)
    check_segments(stages.unlinked, height, width, dataclasses.replace(parameters, min_length=0, refine=False))
    check_segments(stages.linked, height, width, dataclasses.replace(parameters, min_length=0))
    check_segments(stages.segments, height, width, parameters)
    assert same(stages.segments, stages.linked[stages.linked['length'] >= np.float32(parameters.min_length)])
    return stages


@BOTH
@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('sigma', [0, 4, 30])
def test_rendered_images(profile: str, seed: int, sigma: float) -> None:
    stages = check_everything(scene(seed=seed, sigma=sigma), Parameters.profile(profile, min_chain=4))
    assert len(stages.segments) > 2


@pytest.mark.parametrize('operator', ['deriche', 'sobel'])
def test_hysteresis_of_noise(operator: str) -> None:
    """Weak edges stay where, and only where, they hang together with strong ones."""
    some = 0
    for seed in range(10):
        image = np.random.default_rng(seed).integers(0, 256, (60, 70), np.uint8)
        for T1 in (15, 20, 40):
            stages = LineFeatureExtractor(Parameters.profile('paper', operator=operator, T1=T1, T2=12)).stages(image)
            check_edges(stages)
            some += 0 < (stages.edges != 0).sum() < (stages.candidates != 0).sum()
    assert some > 5


@pytest.mark.parametrize('parameters', [Parameters.paper(), Parameters(refine=False)], ids=['codes', 'straightness'])
def test_rings_are_closed(parameters: Parameters) -> None:
    """The outline of a disc is one closed chain."""
    y, x = np.mgrid[:80, :80]
    image = (60 + 120 * np.clip(25.5 - np.hypot(x - 40.2, y - 39.6), 0, 1)).astype(np.uint8)
    stages = check_everything(image, parameters)
    assert stages.closed.tolist() == [True]
    assert set(stages.codes_after) == {1, 2, 3, 4}


def picture_of(kind: str, height: int, width: int, dtype: Any, seed: int, channels: int) -> Image:
    rng = np.random.default_rng(seed)
    top = {np.uint8: 255, np.uint16: 65535, np.float32: 255}[dtype]
    y, x = np.mgrid[:height, :width]
    low, high = np.sort(rng.integers(0, top, 2, endpoint=True))
    period = rng.integers(1, 9)
    image: Any
    if kind == 'noise':
        image = rng.uniform(0, top, (height, width))
    elif kind == 'two levels':
        image = np.where(rng.random((height, width)) < rng.random(), 0, top)
    elif kind == 'checkerboard':
        image = np.where((x // period + y // period) % 2, low, high)
    elif kind == 'stripes':
        image = np.where((x * rng.integers(-2, 3) + y * rng.integers(-2, 3)) // period % 2, low, high)
    elif kind == 'edges':
        image = low + (high - low) * half_plane(height, width, rng.uniform(0, 360), *(rng.uniform(0, (width, height))))
        image *= half_plane(height, width, rng.uniform(0, 360), *(rng.uniform(0, (width, height))))
    elif kind == 'rings':
        image = np.where(np.hypot(x - width / 2, y - height / 2) // period % 2, low, high)
    elif kind == 'extreme':
        image = rng.choice([0, 1e-40, 1e-20, 1, top, *((1e20, -1e20, 3e38, -3e38) if dtype == np.float32 else ())],
                           (height, width), p=None)
    else:
        image = np.full((height, width), low)
    image = np.asarray(image).astype(dtype)
    return image if channels == 1 else np.repeat(image[:, :, None], channels, 2)


images = st.builds(
    picture_of,
    st.sampled_from(['noise', 'two levels', 'checkerboard', 'stripes', 'edges', 'rings', 'extreme', 'constant']),
    st.integers(1, 64), st.integers(1, 64), st.sampled_from(TYPES), st.integers(0, 10**6),
    st.sampled_from([1, 1, 3, 4]))
profiles = st.sampled_from(['default', 'paper'])
thresholds = st.lists(st.floats(0, 60) | st.floats(0, 1000), min_size=2, max_size=2, unique=True).map(sorted)
parameter_sets = st.builds(
    lambda profile, levels, **others: Parameters.profile(profile, T2=levels[0], T1=levels[1], **others),
    profiles, thresholds,
    operator=st.sampled_from(Parameters.specs()['operator'].choices),
    alpha=st.floats(0.2, 5), sigma=st.floats(0.3, 10),
    thinning=st.sampled_from(['suppression', *Parameters.specs()['thinning'].choices]), max_gap=st.integers(0, 8),
    min_chain=st.integers(1, 12), n=st.integers(0, 12) | st.integers(0, 10000), min_size=st.integers(2, 12),
    orientation=st.sampled_from(['principal_axis', 'least_squares']), tau1=st.floats(0, 5) | st.floats(0, 20),
    tau2=st.floats(0, 20) | st.floats(0, 100), min_length=st.just(0.0) | st.floats(0, 30),
    intensity_min=st.just(math.nan) | st.floats(-100, 100), intensity_max=st.just(math.nan) | st.floats(101, 255))


@settings(max_examples=250, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(images, parameter_sets)
def test_any_image_and_parameters(image: Image, parameters: Parameters) -> None:
    check_everything(image, parameters)


beyond_the_paper = st.fixed_dictionaries({}, optional={
    'alpha': st.just(math.nan), 'noise_T1': st.floats(0, 100), 'noise_T2': st.floats(0, 100),
    'clutter': st.floats(1, 100),
    'grouping': st.sampled_from(['codes', 'straightness']), 'refine': st.booleans(), 'min_snr': st.floats(0, 100),
    'false_alarms': st.sampled_from([1e-30, 1e-3, 1.0, 1e30]), 'max_sigma_theta': st.sampled_from([0.0, 0.01, 10.0]),
    'operator': st.just('sobel'),
    'thinning': st.sampled_from(['morphological', 'none']), 'min_chain': st.integers(1, 12),
    'min_size': st.integers(2, 12), 'max_gap': st.integers(0, 8)})


@settings(max_examples=250, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(profiles, images, thresholds, beyond_the_paper)
def test_any_image_beyond_the_paper(
    profile: str, image: Image, levels: list[float], chosen: dict[str, Any],
) -> None:
    """Each step that the paper does not have, with and without the others."""
    check_everything(image, Parameters.profile(profile, T2=levels[0], T1=levels[1], **chosen))


@settings(max_examples=150, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(profiles, images, st.sampled_from([0.5, 2.0, 10.0]), st.integers(0, 8))
def test_any_image_with_low_thresholds(profile: str, image: Image, T1: float, max_gap: int) -> None:
    """Where almost everything is an edge."""
    check_everything(image, Parameters.profile(
        profile, T1=T1, T2=T1 / 8, max_gap=max_gap, min_chain=2, min_size=2, tau1=2, tau2=10))


@settings(max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(profiles, images, images)
def test_any_two_images(profile: str, first: Image, second: Image) -> None:
    """What an extractor saw before does not matter."""
    extractor = LineFeatureExtractor(Parameters.profile(profile))
    expected = [LineFeatureExtractor(Parameters.profile(profile)).extract(image) for image in (first, second)]
    assert [same(extractor.extract(image), segments) for image, segments in
            zip((first, second, first), (*expected, expected[0]), strict=True)] == [True] * 3

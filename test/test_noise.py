"""The noise that is measured is that which was added; what the operators make of it is what they do make of it."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from line_feature_node.core import LineFeatureExtractor, Parameters
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.edges import PAD, extract_edges, kept_gradient
from line_feature_node.core.noise import (
    ROUNDING,
    STEP,
    STRONG_SHARE,
    WEAK_SHARE,
    Quality,
    adapted,
    correlation_length,
    gradient_noise,
    measure,
    step_response,
)

Image = npt.NDArray[Any]
OPERATORS: list[dict[str, Any]] = [
    *({'operator': 'deriche', 'alpha': alpha} for alpha in (0.5, 0.7, 1.0, 2.2, 4.0)),
    *({'operator': operator} for operator in ('sobel', 'prewitt', 'scharr')),
    *({'operator': 'dog', 'sigma': sigma} for sigma in (0.5, 1.0, 2.0)),
]


def named(parameters: dict[str, Any]) -> str:
    return ' '.join(str(value) for value in parameters.values())


def noisy(sigma: float, level: Any = 128.0, shape: tuple[int, int] = (240, 320), seed: int = 0) -> Image:
    return level + np.random.default_rng(seed).normal(0, sigma, shape)


def measured(image: Image, **parameters: Any) -> float:
    return measure(np.ascontiguousarray(image), Parameters(**parameters), Buffers()).noise


def kept(image: Image, parameters: Parameters) -> tuple[Image, Image]:
    """gx and gy without the padding, as double precision numbers."""
    buffers = Buffers()
    extract_edges(np.ascontiguousarray(image), parameters, buffers)
    inside = slice(PAD, PAD + image.shape[0]), slice(PAD, PAD + image.shape[1])
    values, unit = kept_gradient(buffers)
    gx, gy = np.moveaxis(values[inside] * unit, 2, 0)
    return gx, gy


# What is measured

@pytest.mark.parametrize('sigma', [0.5, 1, 2, 5, 10, 20, 30, 60])
def test_noise_of_floats(sigma: float) -> None:
    assert measured(noisy(sigma).astype(np.float32)) == pytest.approx(sigma, rel=0.06, abs=0.05)


@pytest.mark.parametrize('sigma', [1, 2, 5, 10, 20, 30])
def test_noise_of_whole_grey_levels(sigma: float) -> None:
    """With that of rounding."""
    image = np.clip(np.round(noisy(sigma)), 0, 255).astype(np.uint8)
    assert measured(image) == pytest.approx(math.hypot(sigma, ROUNDING), rel=0.06)


@pytest.mark.parametrize(('dtype', 'factor', 'shift', 'given'), [
    (np.uint16, 257, 0, {}), (np.uint16, 16, 0, {'intensity_max': 16 * 255.0}),
    (np.uint16, 8, 1000, {'intensity_min': 1000.0, 'intensity_max': 1000 + 8 * 255.0}),
    (np.float32, 1 / 255, 0, {'intensity_max': 1.0}),
    (np.float32, 1 / 255, -0.5, {'intensity_min': -0.5, 'intensity_max': 0.5}),
    (np.float32, 1e6, 0, {'intensity_max': 255e6})])
@pytest.mark.parametrize('sigma', [1, 5, 20])
def test_noise_is_in_grey_levels_whatever_the_type_and_range(
    sigma: float, dtype: Any, factor: float, shift: float, given: dict[str, float],
) -> None:
    image = (noisy(sigma) * factor + shift).astype(dtype)
    assert measured(image, **given) == pytest.approx(sigma, rel=0.06)


@pytest.mark.parametrize('image', [
    np.zeros((60, 80), np.uint8), np.full((60, 80), 255, np.uint8), np.full((60, 80), 1e9, np.float32),
    np.tile(np.arange(200, dtype=np.uint8), (90, 1)), noisy(0.05).astype(np.float32),
], ids=['black', 'white', 'bright', 'ramp', 'faint'])
def test_rounding_is_the_least_noise(image: Image) -> None:
    assert measured(image) == pytest.approx(ROUNDING)


@pytest.mark.parametrize('sigma', [1, 5, 20])
def test_edges_along_the_axes_and_slopes_are_no_noise(sigma: float) -> None:
    y, x = np.mgrid[:240, :320]
    level = 30 + 0.2 * x + 0.1 * y + 60 * ((x // 8 + y // 8) % 2)
    assert measured(noisy(sigma, level).astype(np.float32)) == pytest.approx(sigma, rel=0.08)


@pytest.mark.parametrize('sigma', [1, 5, 20])
def test_sparse_edges_of_any_direction_are_no_noise(sigma: float) -> None:
    """As a photograph has them, one in ten pixels."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:240, :320]
    level = np.full((240, 320), 60.0)
    for _ in range(6):
        angle = rng.uniform(0, 2 * math.pi)
        level[(x - rng.uniform(0, 320)) * math.cos(angle) + (y - rng.uniform(0, 240)) * math.sin(angle) > 0] += 25
    assert sigma * 0.95 < measured(noisy(sigma, level).astype(np.float32)) < sigma * 1.15


def test_fine_texture_counts_as_noise() -> None:
    """What changes from pixel to pixel cannot be told from it, and is measured with it."""
    texture = noisy(12, seed=1)
    assert measured(noisy(5, texture).astype(np.float32)) == pytest.approx(13, rel=0.06)


@pytest.mark.parametrize('shape', [(1, 1), (2, 9), (9, 2), (2, 2), (1, 500), (500, 1), (2, 500)], ids=str)
def test_small_images_have_the_noise_of_rounding(shape: tuple[int, int]) -> None:
    """There are no rows to measure in, or no columns."""
    assert measured(noisy(50, shape=shape).astype(np.float32)) == pytest.approx(ROUNDING)


@pytest.mark.parametrize('shape', [(3, 400), (900, 3), (30, 60), (64, 30)], ids=str)
def test_noise_of_small_images(shape: tuple[int, int]) -> None:
    """Roughly right each time, and on average right."""
    found = [measured(noisy(10, shape=shape, seed=seed).astype(np.float32)) for seed in range(30)]
    assert np.mean(found) == pytest.approx(10, rel=0.1)
    assert np.std(found) < 2


@pytest.mark.parametrize('value', [1e10, 1e20, 1e30, 3e38])
def test_huge_values_give_a_finite_noise(value: float) -> None:
    """The largest that is told apart, whatever overflows on the way."""
    for image in (noisy(0.3, 0) * value, np.where(noisy(1, 0) > 0, value, -value), np.full((60, 80), -value)):
        with np.errstate(over='ignore'):
            found = measured(np.clip(image, -3.4e38, 3.4e38).astype(np.float32))
        assert ROUNDING <= found < 1e4


def test_noise_does_not_depend_on_the_frame_before() -> None:
    buffers = Buffers()
    for seed, sigma in enumerate((30, 1, 10, 1)):
        image = noisy(sigma, seed=seed).astype(np.float32)
        assert measure(image, Parameters(), buffers) == measure(image, Parameters(), Buffers())


# Clutter

@pytest.mark.parametrize('sigma', [0, 2, 5])
def test_gradient_that_a_share_exceeds(sigma: float) -> None:
    """Of waves that are the same everywhere, without what the noise adds."""
    y, x = np.mgrid[:320, :400]
    wave = 60 * np.sin(x * math.cos(0.4) / 5 + y * math.sin(0.4) / 5)
    clean = np.hypot(*np.gradient(wave))[5:-5, 5:-5]
    found = measure(noisy(sigma, 128 + wave, wave.shape).astype(np.float32), Parameters(), Buffers())
    assert found.strong == pytest.approx(np.quantile(clean, 1 - STRONG_SHARE), rel=0.1)
    assert found.weak == pytest.approx(np.quantile(clean, 1 - WEAK_SHARE), rel=0.1)


@pytest.mark.parametrize('sigma', [0, 1, 5, 20, 60])
def test_noise_and_few_edges_are_no_clutter(sigma: float) -> None:
    level = 60 + 120 * (np.mgrid[:240, :320][1] > 150)
    found = measure(noisy(sigma, level).astype(np.float32), Parameters(), Buffers())
    for gradient in (found.strong, found.weak):
        assert 0 <= gradient < 0.15 * sigma + 0.1


def test_clutter_raises_the_thresholds() -> None:
    """By the factor that is asked for, whatever they depend on besides."""
    quality = Quality(1.0, 7.0, 3.5)
    found = adapted(Parameters(), quality)
    raised = found.T1, found.T2
    assert raised == pytest.approx((7, 3.5), abs=STEP)
    found = adapted(Parameters(noise_T1=0.0, noise_T2=0.0), quality)
    assert raised == (found.T1, found.T2)
    found = adapted(Parameters(clutter=1.5), quality)
    assert (found.T1, found.T2) == (6, 3)
    found = adapted(Parameters(clutter=1.0, noise_T1=0.0, noise_T2=0.0), quality)
    assert (found.T1, found.T2) == (Parameters().T1, Parameters().T2)
    assert adapted(Parameters.paper(), quality) == Parameters.paper()
    found = adapted(Parameters(), Quality(1.0, 20.0, 20.0))
    assert found.T2 < found.T1


# What the operators make of it

@pytest.mark.compiled
@pytest.mark.parametrize('chosen', OPERATORS, ids=named)
def test_noise_of_the_gradient(chosen: dict[str, Any]) -> None:
    parameters = Parameters(**chosen)
    for component in kept(noisy(10, shape=(500, 500)).astype(np.float32), parameters):
        assert component[50:-50, 50:-50].std() == pytest.approx(10 * gradient_noise(parameters), rel=0.03)


@pytest.mark.parametrize('chosen', OPERATORS, ids=named)
def test_gradient_of_a_step(chosen: dict[str, Any]) -> None:
    parameters = Parameters(**chosen)
    image = np.full((120, 120), 100, np.float32)
    image[:, 60:] += 20
    gx, gy = kept(image, parameters)
    assert abs(gx[60]).max() == pytest.approx(20 * step_response(parameters), rel=2e-3)
    gx, gy = kept(image.T, parameters)
    assert abs(gy[:, 60]).max() == pytest.approx(20 * step_response(parameters), rel=2e-3)


@pytest.mark.compiled
@pytest.mark.parametrize('chosen', OPERATORS, ids=named)
def test_noise_is_correlated_along_an_edge(chosen: dict[str, Any]) -> None:
    """The mean of n gradients along an edge varies as that of n / length independent ones."""
    parameters = Parameters(**chosen)
    gx, _ = kept(noisy(10, shape=(800, 700)).astype(np.float32), parameters)
    n = 100
    means = gx[50:50 + 7 * n, 50:650].reshape(7, n, 600).mean(1)
    assert n * means.var() / gx[50:-50, 50:-50].var() == pytest.approx(correlation_length(parameters), rel=0.15)


def test_more_smoothing_leaves_less_noise_of_a_step() -> None:
    narrow, wide = Parameters(alpha=2.2), Parameters(alpha=0.7)
    assert gradient_noise(wide) / step_response(wide) < gradient_noise(narrow) / step_response(narrow)
    assert correlation_length(wide) > correlation_length(narrow) > 1


# What follows for the parameters

NOISES = [0.29, 1, 2, 5, 8, 12, 24, 40, 100, 500]


def test_alpha_falls_with_the_noise_where_it_is_unset() -> None:
    alphas = [adapted(Parameters(), Quality(noise)).alpha for noise in NOISES]
    assert alphas == sorted(alphas, reverse=True)
    assert alphas[0] > 2 * alphas[-1]
    assert all(0.2 <= alpha <= 5 for alpha in alphas)
    assert [adapted(Parameters(alpha=1.5), Quality(noise)).alpha for noise in NOISES] == [1.5] * len(NOISES)


@pytest.mark.parametrize('operator', Parameters.specs()['operator'].choices)
@pytest.mark.parametrize('noise', NOISES)
def test_thresholds_are_raised_to_the_noise(operator: str, noise: float) -> None:
    """To so many standard deviations of it, but not below their own values, and in order."""
    given = Parameters(operator=operator, T1=6, T2=2, noise_T1=5, noise_T2=2.5)
    found = adapted(given, Quality(noise))
    of_gradient = noise * gradient_noise(found)
    slack = STEP * gradient_noise(found) * 5
    expected = {'T1': min(max(6, 5 * of_gradient), 1000), 'T2': max(2, 2.5 * of_gradient)}
    assert {name: getattr(found, name) for name in expected} == pytest.approx(expected, abs=slack)
    assert found.T1 >= given.T1
    assert found.T2 >= given.T2


@pytest.mark.parametrize('given', [
    {'noise_T1': 100.0}, {'noise_T2': 100.0}, {'noise_T1': 0.0}, {'noise_T1': 1.0, 'noise_T2': 4.0},
    {'T1': 1000.0, 'T2': 999.5}, {'noise_T1': 100.0, 'noise_T2': 100.0, 'operator': 'sobel'}], ids=str)
def test_thresholds_stay_in_range_and_in_order(given: dict[str, Any]) -> None:
    for noise in (*NOISES, 1e4):
        found = adapted(Parameters(**given), Quality(noise))
        assert 0 <= found.T2 < found.T1 <= 1000


def test_nothing_else_is_changed() -> None:
    given = Parameters(T1=9, n=7, max_gap=1, roi=(0, 0, 0.5, 0.5), min_snr=30, noise_T1=0, noise_T2=0)
    found = adapted(given, Quality(20))
    assert (found.T1, found.T2) == (9, given.T2)
    changed = {name for name in Parameters.specs() if repr(getattr(found, name)) != repr(getattr(given, name))}
    assert changed == {'alpha'}
    assert adapted(Parameters.paper(), Quality(20)) == Parameters.paper()


def test_equal_noise_makes_equal_parameters() -> None:
    """Up to a step, so that the frames of a video share them."""
    assert adapted(Parameters(), Quality(5.001)) is adapted(Parameters(), Quality(4.999))
    assert adapted(Parameters(), Quality(5)) != adapted(Parameters(), Quality(5 + 2 * STEP))


@pytest.mark.compiled
@pytest.mark.parametrize('operator', ['deriche', 'sobel'])
def test_noise_has_few_edges(operator: str) -> None:
    """Less than one in fifty pixels, however strong it is."""
    for sigma in (3, 10, 30, 60):
        stages = LineFeatureExtractor(Parameters(operator=operator)).stages(noisy(sigma).astype(np.float32))
        assert (stages.edges != 0).mean() < 0.02


@pytest.mark.parametrize('share', [0.3, 0.6])
def test_masked_pixels_do_not_tell_what_the_noise_is(share: float) -> None:
    """A black border, a lens that does not fill the picture, or the robot itself."""
    image = np.clip(np.round(noisy(20)), 0, 255).astype(np.uint8)
    mask = np.mgrid[:240, :320][0] >= share * 240
    expected = LineFeatureExtractor().stages(image, mask)
    image[~mask] = 0
    found = LineFeatureExtractor().stages(image, mask)
    first = math.ceil(share * 240) + 12
    inner = np.s_[first:]
    assert len(expected.segments) == 0
    assert (found.segments['y'] < first).all()
    assert (found.edges[inner] != 0).mean() < 2 * (expected.edges[inner] != 0).mean() + 0.002


@pytest.mark.parametrize('left_out', [None, (0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_pixel_counts_where_the_four_beside_it_do(left_out: tuple[int, int] | None) -> None:
    image = np.random.default_rng(1).integers(0, 255, (20, 30), np.uint8)
    keep = np.zeros(image.shape, np.uint8)
    keep[9, 11:14] = keep[8:11, 12] = 255  # in one of the rows that are looked at
    if left_out:
        keep[9 + left_out[0], 12 + left_out[1]] = 0
    quality = measure(image, Parameters(), Buffers(), keep)
    assert (quality == Quality(ROUNDING)) == bool(left_out)


def test_clutter_raises_the_thresholds_by_so_much_at_most() -> None:
    """A fence fills the picture with edges that are all as strong."""
    found = adapted(Parameters(T1=5.0, T2=3.0), Quality(1.0, 100.0, 90.0))
    assert (found.T1, found.T2) == (10, 6)


@pytest.mark.parametrize('width', [4, 8, 16])
def test_stripes_that_fill_the_picture_are_found(width: int) -> None:
    image = np.tile(np.where(np.arange(320) // width % 2, 200, 40).astype(np.uint8), (240, 1))
    segments = LineFeatureExtractor().extract(image)
    assert len(segments) == pytest.approx(320 / width - 1, abs=2)
    np.testing.assert_allclose(abs(segments['theta']), np.pi / 2, atol=1e-3)

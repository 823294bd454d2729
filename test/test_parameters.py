import copy
import dataclasses
import math
import pickle
from typing import Any

import numpy as np
import pytest

from line_feature_node.core.parameters import PROFILES, Parameters

SPECS = Parameters.specs()
DEFAULTS = dataclasses.asdict(Parameters())
NUMBERS = [name for name, spec in SPECS.items() if not spec.choices]
WHOLE = [name for name in NUMBERS if isinstance(DEFAULTS[name], int)]
REAL = [name for name in NUMBERS if isinstance(DEFAULTS[name], float)]
CHOICES = [name for name, spec in SPECS.items() if spec.choices]
UNSET = [name for name, spec in SPECS.items() if spec.unset]


def test_names_of_the_paper() -> None:
    assert {'alpha', 'T1', 'T2', 'n', 'tau1', 'tau2'} <= set(SPECS)


def test_defaults_are_valid() -> None:
    assert dataclasses.asdict(Parameters(**DEFAULTS)).keys() == DEFAULTS.keys()
    assert Parameters().T2 < Parameters().T1
    assert Parameters().min_size >= 2
    for name in NUMBERS:
        value = DEFAULTS[name]
        assert SPECS[name].low <= value <= SPECS[name].high or (name in UNSET and math.isnan(value))


def test_every_parameter_is_described() -> None:
    for name, spec in SPECS.items():
        assert spec.description.endswith('.'), name
        assert spec.choices or (math.isfinite(spec.low) and math.isfinite(spec.high)), name


@pytest.mark.parametrize(('name', 'end'), [
    (name, end) for name in NUMBERS for end in ('low', 'high') if (name, end) not in {('T1', 'low'), ('T2', 'high')}])
def test_ends_of_a_range_are_allowed(name: str, end: str) -> None:
    """But T1 at its low end or T2 at its high end, which contradict every value of the other."""
    value = getattr(SPECS[name], end)
    value = int(value) if name in WHOLE else value
    assert getattr(Parameters(**{name: value}), name) == value


@pytest.mark.parametrize('name', NUMBERS)
@pytest.mark.parametrize('sign', [-1, 1])
def test_beyond_a_range_is_refused(name: str, sign: int) -> None:
    """The message has the name, the range and what came."""
    spec = SPECS[name]
    end = spec.low if sign < 0 else spec.high
    value = int(end) + sign if name in WHOLE else math.nextafter(end, sign * math.inf)
    with pytest.raises(ValueError, match=rf'^{name} must be ') as caught:
        Parameters(**{name: value})
    assert f'{spec.low:g} to {spec.high:g}' in str(caught.value)
    assert spec.unit in str(caught.value)
    assert repr(value) in str(caught.value)


@pytest.mark.parametrize('name', REAL)
@pytest.mark.parametrize('value', [math.inf, -math.inf, np.float32(np.inf)])
def test_infinite_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        Parameters(**{name: value})


@pytest.mark.parametrize('name', REAL)
def test_nan_only_where_it_means_unset(name: str) -> None:
    if name in UNSET:
        assert math.isnan(getattr(Parameters(**{name: math.nan}), name))
        assert 'nan' in SPECS[name].range
    else:
        with pytest.raises(ValueError, match=f'{name} must be .* got nan'):
            Parameters(**{name: math.nan})


def test_unset_are_the_intensities() -> None:
    assert set(UNSET) == {'intensity_min', 'intensity_max'}


@pytest.mark.parametrize('name', NUMBERS)
@pytest.mark.parametrize('value', [True, False, np.True_, '1', 'nan', None, [1], (1,), 1j, np.array([1.0]), b'1'],
                         ids=repr)
def test_what_is_no_number_is_refused(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=rf'^{name} must be a (whole )?number of ') as caught:
        Parameters(**{name: value})
    assert repr(value) in str(caught.value)


@pytest.mark.parametrize('name', WHOLE)
@pytest.mark.parametrize('value', [5.0, 5.5, np.float32(5), math.nan])
def test_float_for_a_whole_number_is_refused(name: str, value: float) -> None:
    with pytest.raises(TypeError, match=rf'^{name} must be a whole number'):
        Parameters(**{name: value})


@pytest.mark.parametrize('name', REAL)
@pytest.mark.parametrize('kind', [int, float, np.float32, np.float64, np.int32, np.uint8])
def test_numbers_of_any_type(name: str, kind: type) -> None:
    """Whole numbers and numpy's scalars will do for a number, which is kept as a float."""
    value = {'alpha': 2, 'sigma': 2, 'T2': 4, 'intensity_max': 100, 'tau1': 9}.get(name, 50)
    given = kind(value)
    kept = getattr(Parameters(**{name: given}), name)
    assert kept == value
    assert type(kept) is float


@pytest.mark.parametrize('name', WHOLE)
@pytest.mark.parametrize('kind', [int, np.int64, np.uint8, np.int16])
def test_whole_numbers_of_any_type(name: str, kind: type) -> None:
    kept = getattr(Parameters(**{name: kind(6)}), name)
    assert kept == 6
    assert type(kept) is int


@pytest.mark.parametrize('name', CHOICES)
def test_choices(name: str) -> None:
    for choice in SPECS[name].choices:
        assert getattr(Parameters(**{name: choice}), name) == choice
    for wrong, error in (('canny', ValueError), ('', ValueError), (3, TypeError), (None, TypeError)):
        with pytest.raises(error, match=f'^{name} must be one of') as caught:
            Parameters(**{name: wrong})
        assert all(choice in str(caught.value) for choice in SPECS[name].choices)
        assert repr(wrong) in str(caught.value)


@pytest.mark.parametrize(('T1', 'T2'), [(5, 5), (5, 6), (0, 0), (1000, 1000), (2.0, 3.0)])
def test_lower_threshold_is_lower(T1: float, T2: float) -> None:
    with pytest.raises(ValueError, match=f'T2 = {T2:g} and T1 = {T1:g}'):
        Parameters(T1=T1, T2=T2)


@pytest.mark.parametrize(('low', 'high'), [(5, 5), (6, 5), (0, 0), (-1, -2)])
def test_intensities_are_in_order(low: float, high: float) -> None:
    with pytest.raises(ValueError, match=f'intensity_min .* intensity_max.* {low:g} and {high:g}'):
        Parameters(intensity_min=low, intensity_max=high)


@pytest.mark.parametrize('name', ['t1', 'beta', 'Alpha', 'alpha ', ''])
@pytest.mark.parametrize('make', [
    lambda values: Parameters(**values), Parameters.of, lambda values: Parameters.profile('paper', **values),
], ids=['Parameters', 'of', 'profile'])
def test_unknown_name(make: Any, name: str) -> None:
    with pytest.raises(TypeError) as caught:
        make({name: 1})
    assert f"'{name}'" in str(caught.value)


def test_of_lists_the_names_there_are() -> None:
    with pytest.raises(TypeError) as caught:
        Parameters.of({'T3': 1})
    assert all(name in str(caught.value) for name in SPECS)


def test_by_name_only() -> None:
    with pytest.raises(TypeError):
        Parameters('sobel')


@pytest.mark.parametrize('name', PROFILES)
def test_profiles(name: str) -> None:
    expected = {**DEFAULTS, **PROFILES[name]}
    found = Parameters.profile(name)
    for key, value in expected.items():
        np.testing.assert_equal(getattr(found, key), value)
    assert Parameters.profile(name, max_gap=3, tau2=9.5).max_gap == 3
    assert Parameters.profile(name, max_gap=3, tau2=9.5).tau2 == 9.5


def test_profile_names() -> None:
    assert {'default', 'paper'} <= set(PROFILES)
    assert Parameters.profile('default') == Parameters()
    assert Parameters.profile('paper') == Parameters.paper()
    assert Parameters.paper().min_length == 0
    for wrong in ('Paper', 'none', ''):
        with pytest.raises(ValueError, match='^profile must be one of') as caught:
            Parameters.profile(wrong)
        assert repr(wrong) in str(caught.value)
        assert all(name in str(caught.value) for name in PROFILES)


def test_profile_of_the_wrong_type() -> None:
    for wrong in (None, 3):
        with pytest.raises((TypeError, ValueError), match='^profile must be'):
            Parameters.profile(wrong)


def test_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Parameters().alpha = 2.0


def test_equal_and_hashable() -> None:
    assert Parameters() == Parameters()
    assert hash(Parameters()) == hash(Parameters())
    assert Parameters(T1=9) == Parameters(T1=9.0) == Parameters(T1=np.float32(9))
    assert len({Parameters(), Parameters(T1=8.5), Parameters(T1=8.5), Parameters(operator='sobel')}) == 3
    assert Parameters(alpha=1.1) != Parameters()


@pytest.mark.parametrize('unset', [float('nan'), np.float32('nan'), -math.nan], ids=['float', 'numpy', 'negative'])
def test_unset_is_unset_whichever_nan(unset: float) -> None:
    """Parameters from a file, a message or another process are equal to those made here."""
    assert Parameters(intensity_min=unset, intensity_max=unset) == Parameters()
    assert hash(Parameters(intensity_min=unset, intensity_max=unset)) == hash(Parameters())


def test_copies_are_equal() -> None:
    """Through a process pool too."""
    for parameters in (Parameters(), Parameters(intensity_min=1, intensity_max=2, n=7)):
        assert copy.deepcopy(parameters) == parameters
        assert pickle.loads(pickle.dumps(parameters)) == parameters
        assert dataclasses.replace(parameters) == parameters
        assert Parameters.of(dataclasses.asdict(parameters)) == parameters
    assert dataclasses.replace(Parameters(), n=9).n == 9
    with pytest.raises(ValueError, match='T2'):
        dataclasses.replace(Parameters(), T2=20)


def test_range_in_words() -> None:
    assert SPECS['alpha'].range == f'{SPECS["alpha"].low:g} to {SPECS["alpha"].high:g}'
    assert SPECS['operator'].range == ', '.join(SPECS['operator'].choices)

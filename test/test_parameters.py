import array
import copy
import dataclasses
import math
import pickle
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from line_feature_node.core.parameters import PROFILES, Parameters, ParameterSet, Spec, parameter

SPECS = Parameters.specs()
DEFAULTS = dataclasses.asdict(Parameters())
SWITCHES = [name for name in SPECS if isinstance(DEFAULTS[name], bool)]
NUMBERS = [name for name in SPECS if isinstance(DEFAULTS[name], int | float) and name not in SWITCHES]
WHOLE = [name for name in NUMBERS if isinstance(DEFAULTS[name], int)]
REAL = [name for name in NUMBERS if isinstance(DEFAULTS[name], float)]
CHOICES = [name for name, spec in SPECS.items() if spec.choices]
LISTS = [name for name in SPECS if isinstance(DEFAULTS[name], tuple)]
UNSET = [name for name, spec in SPECS.items() if spec.unset]


@dataclass(frozen=True, kw_only=True, eq=False)
class Mixed(ParameterSet):
    """One parameter of every kind that a table may have."""

    flag: bool = parameter(False, 'Whether.')
    text: str = parameter('some', 'Any text.')
    choice: str = parameter('a', 'One of two.', choices=('a', 'b'))
    whole: int = parameter(2, 'A whole number.', low=1, high=3)
    real: float = parameter(0.5, 'A number.', low=0, high=1, unit='pixels')
    perhaps: float = parameter(math.nan, 'A number or none.', low=0, high=1, unset=True, constant=True)
    pair: tuple[float, float] = parameter((1.0, 2.0), 'Two numbers.', low=0, high=9)


def test_every_parameter_is_of_one_kind() -> None:
    assert sorted([*SWITCHES, *WHOLE, *REAL, *CHOICES, *LISTS]) == sorted(SPECS)
    assert sorted([*WHOLE, *REAL]) == sorted(NUMBERS)
    assert 'roi' in LISTS


def test_names_of_the_paper() -> None:
    assert {'alpha', 'T1', 'T2', 'n', 'tau1', 'tau2'} <= set(SPECS)


def test_defaults_are_valid() -> None:
    assert dataclasses.asdict(Parameters(**DEFAULTS)).keys() == DEFAULTS.keys()
    assert Parameters().T2 < Parameters().T1
    assert Parameters().min_size >= 2
    for name in NUMBERS:
        value = DEFAULTS[name]
        assert SPECS[name].low <= value <= SPECS[name].high or (name in UNSET and math.isnan(value))
    for name in LISTS:
        assert all(SPECS[name].low <= value <= SPECS[name].high for value in DEFAULTS[name])


def test_every_parameter_is_described() -> None:
    for name, spec in SPECS.items():
        assert spec.description.endswith('.'), name
        bounded = math.isfinite(spec.low) and math.isfinite(spec.high)
        assert spec.choices or bounded or name in SWITCHES, name


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


def test_unset_are_the_intensities_and_alpha() -> None:
    assert set(UNSET) == {'alpha', 'intensity_min', 'intensity_max'}


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
    value = {'alpha': 2, 'sigma': 2, 'T2': 3, 'intensity_max': 100, 'tau1': 9, 'theta_min': 1, 'theta_max': 1,
             'scale': 1, 'max_sigma_theta': 1}.get(name, 50)
    given = kind(value)
    kept = getattr(Parameters(**{name: given}), name)
    assert kept == value
    assert type(kept) is float


@pytest.mark.parametrize('kind', [float, np.float32, np.float64, np.float16])
@pytest.mark.parametrize(('name', 'value'), [('scale', 0.25), ('theta_min', -1.25), ('theta_max', 0.5), ('alpha', 0.5)])
def test_fractions_of_any_type(name: str, value: float, kind: type) -> None:
    kept = getattr(Parameters(**{name: kind(value)}), name)
    assert kept == value
    assert type(kept) is float


@pytest.mark.parametrize('name', WHOLE)
@pytest.mark.parametrize('kind', [int, np.int64, np.uint8, np.int16])
def test_whole_numbers_of_any_type(name: str, kind: type) -> None:
    kept = getattr(Parameters(**{name: kind(6)}), name)
    assert kept == 6
    assert type(kept) is int


@pytest.mark.parametrize('name', SWITCHES)
def test_switches(name: str) -> None:
    for value in (True, False, np.True_, np.False_):
        kept = getattr(Parameters(**{name: value}), name)
        assert kept == value
        assert type(kept) is bool
    for wrong in (0, 1, 1.0, 'true', None, np.uint8(1), [True]):
        with pytest.raises(TypeError, match=rf'^{name} must be true or false, got') as caught:
            Parameters(**{name: wrong})
        assert repr(wrong) in str(caught.value)


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


@pytest.mark.parametrize('angle', [math.pi / 2, np.float32(math.pi / 2), 1.5708, 1.5707963])
@pytest.mark.parametrize('name', ['theta_min', 'theta_max'])
def test_right_angles_are_in_the_range(name: str, angle: float) -> None:
    """However they are rounded, and on both sides."""
    for value in (angle, -angle):
        assert getattr(Parameters(**{name: value}), name) == float(value)
    with pytest.raises(ValueError, match=f'^{name} must be .* radians, got'):
        Parameters(**{name: 1.571})


@pytest.mark.parametrize(('theta_min', 'theta_max'), [(0.5, -0.5), (1.5708, -1.5708), (0.3, 0.3), (-0.5, 0.5)])
def test_band_of_orientations_may_go_either_way(theta_min: float, theta_max: float) -> None:
    band = Parameters(theta_min=theta_min, theta_max=theta_max)
    assert (band.theta_min, band.theta_max) == (theta_min, theta_max)


def test_default_band_is_every_orientation() -> None:
    assert Parameters().theta_min <= -math.pi / 2
    assert Parameters().theta_max >= math.pi / 2


# Lists of numbers.

SHARES = (0.25, 0.5, 0.125, 1.0)
PIXELS = (3.0, 0.0, 20.0, 10.0)


@pytest.mark.parametrize('values', [SHARES, PIXELS], ids=['shares', 'pixels'])
@pytest.mark.parametrize('make', [
    list, tuple, np.array, lambda values: np.array(values, np.float32), lambda values: [np.float64(v) for v in values],
    lambda values: np.array(values)[::-1].copy()[::-1], lambda values: array.array('d', values),
], ids=['list', 'tuple', 'numpy', 'float32', 'scalars', 'strided', 'array'])
def test_list_of_any_type(values: tuple[float, ...], make: Any) -> None:
    """It is kept as a tuple of floats, whatever it was."""
    kept = Parameters(roi=make(values)).roi
    assert kept == values
    assert type(kept) is tuple
    assert [type(value) for value in kept] == [float] * 4


@pytest.mark.parametrize('values', [
    [0, 5, 20, 10], np.array([0, 5, 20, 10]), np.array([0, 5, 20, 10], np.uint8), [np.int16(0), 5, np.uint8(20), 10.0],
    range(0, 20, 5)], ids=['int', 'int64', 'uint8', 'mixed', 'range'])
def test_list_of_whole_numbers(values: Any) -> None:
    kept = Parameters(roi=values).roi
    assert kept == tuple(values)
    assert [type(value) for value in kept] == [float] * 4


def test_list_does_not_follow_the_one_given() -> None:
    given = [0.0, 0.0, 0.5, 0.5]
    parameters = Parameters(roi=given)
    given[0] = 0.25
    assert parameters.roi == (0, 0, 0.5, 0.5)
    source = np.array([0.0, 0.0, 0.5, 0.5])
    parameters = Parameters(roi=source)
    source[:] = 1
    assert parameters.roi == (0, 0, 0.5, 0.5)


@pytest.mark.parametrize('values', [[], [0.5], [0, 0, 1], [0, 0, 1, 1, 1], (), np.zeros(3), np.ones(5), [[0, 0, 1, 1]],
                                    np.ones((1, 4)), np.ones((2, 2)), [0] * 100], ids=str)
@pytest.mark.parametrize('name', LISTS)
def test_list_of_the_wrong_length(name: str, values: Any) -> None:
    with pytest.raises(ValueError, match=f'^{name} must be a list of 4 numbers, got {len(values)}'):
        Parameters(**{name: values})


@pytest.mark.parametrize('value', [
    None, True, 1, 0.5, 1j, np.float64(1), 'abcd', '', '0 0 1 1', np.str_('abcd'), {0, 1, 2, 3},
    {'x': 0, 'y': 0, 'width': 1, 'height': 1}, iter([0, 0, 1, 1]), object],
    ids=lambda value: type(value).__name__ + ' ' + str(value)[:9])
@pytest.mark.parametrize('name', LISTS)
def test_what_is_no_list_is_refused(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=f'^{name} must be a list of 4 numbers, got ') as caught:
        Parameters(**{name: value})
    assert repr(value) in str(caught.value)


@pytest.mark.parametrize('value', [b'\0\0\1\1', bytearray(b'\0\0\1\1'), memoryview(b'\0\0\1\1')],
                         ids=lambda value: type(value).__name__)
@pytest.mark.parametrize('name', LISTS)
def test_bytes_are_no_list_of_numbers(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=f'^{name} must be a list of 4 numbers, got '):
        Parameters(**{name: value})


@pytest.mark.parametrize('value', [np.array(1.0), np.array(4)], ids=repr)
@pytest.mark.parametrize('name', LISTS)
def test_array_without_dimensions_is_no_list(name: str, value: Any) -> None:
    with pytest.raises((TypeError, ValueError), match=f'^{name} must be a list of 4 numbers, got '):
        Parameters(**{name: value})


@pytest.mark.parametrize('wrong', [True, np.True_, '1', None, [1], (1, 1), 1j, np.array([1.0]), b'1'], ids=repr)
@pytest.mark.parametrize('place', [0, 3])
@pytest.mark.parametrize('name', LISTS)
def test_what_is_no_number_in_a_list_is_refused(name: str, place: int, wrong: Any) -> None:
    values: list[Any] = [0, 0, 1, 1]
    values[place] = wrong
    with pytest.raises(TypeError, match=f'^each number of {name} must be a number of ') as caught:
        Parameters(**{name: values})
    assert repr(wrong) in str(caught.value)


@pytest.mark.parametrize('values', [np.ones(4, bool), np.ones((4, 4)), np.array(['0', '0', '1', '1']),
                                    np.array([0, 0, 1, None])], ids=['bool', 'nested', 'text', 'object'])
@pytest.mark.parametrize('name', LISTS)
def test_array_of_what_is_no_number_is_refused(name: str, values: Any) -> None:
    with pytest.raises(TypeError, match=f'^each number of {name} must be a number of '):
        Parameters(**{name: values})


@pytest.mark.parametrize('place', range(4))
@pytest.mark.parametrize('name', LISTS)
def test_number_beyond_the_range_in_a_list_is_refused(name: str, place: int) -> None:
    """Also NaN and infinity."""
    spec = SPECS[name]
    for wrong in (math.nextafter(spec.low, -math.inf), math.nextafter(spec.high, math.inf), -1.0, math.nan, math.inf,
                  -math.inf, np.float32(math.nan)):
        values: list[Any] = [1.0, 1.0, 1.0, 1.0]
        values[place] = wrong
        for given in (values, np.array(values)):
            with pytest.raises(ValueError, match=f'^each number of {name} must be ') as caught:
                Parameters(**{name: given})
            assert spec.range in str(caught.value)
            assert str(given[place]) in str(caught.value)


# The region of interest.

@pytest.mark.parametrize('values', [
    (0, 0, 1, 1), (0.5, 0.5, 0.5, 0.5), (1, 1, 1, 1), (0.9, 0.9, 1e-6, 1), (0, 0, 2, 1), (0, 0, 1, 2), (5, 0, 1, 1),
    (1e6, 1e6, 1e6, 1e6), (0, 0, 640, 480)], ids=str)
def test_regions(values: tuple[float, ...]) -> None:
    assert Parameters(roi=values).roi == values


@pytest.mark.parametrize('values', [
    (0, 0, 0, 1), (0, 0, 1, 0), (0, 0, 0, 0), (0.5, 0.5, 0.5, 0), (10, 10, 0, 5), (10, 10, 5, 0), (0, 0, -0.0, 1)],
    ids=str)
def test_region_without_a_size(values: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match='^roi must have a width and a height above 0, got ') as caught:
        Parameters(roi=values)
    assert str([float(value) for value in values]) in str(caught.value)


@pytest.mark.parametrize('values', [
    (0.5, 0, 20, 10), (0, 0.25, 20, 10), (0, 0, 20.5, 10), (0, 0, 20, 0.5), (0, 0, 1.5, 1), (0.1, 0.1, 0.9, 1.000001)],
    ids=str)
def test_region_of_shares_and_pixels(values: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match='^roi must be shares of 0 to 1 or whole pixels, got ') as caught:
        Parameters(roi=values)
    assert str([float(value) for value in values]) in str(caught.value)


def test_region_is_checked_when_replaced() -> None:
    with pytest.raises(ValueError, match='^roi must have a width'):
        dataclasses.replace(Parameters(), roi=(0, 0, 0, 0))
    with pytest.raises(ValueError, match='^roi must be a list of 4 numbers'):
        Parameters.profile('paper', roi=[1])


# Names.

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
    expected = {**DEFAULTS, **PROFILES[name].values}
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
    assert Parameters() != dataclasses.asdict(Parameters())


@pytest.mark.parametrize('make', [list, tuple, np.array, lambda values: np.array(values, np.float32)],
                         ids=['list', 'tuple', 'numpy', 'float32'])
def test_equal_and_hashable_with_a_list(make: Any) -> None:
    plain = Parameters(roi=(0.0, 0.25, 0.5, 0.75))
    given = Parameters(roi=make([0.0, 0.25, 0.5, 0.75]))
    assert given == plain
    assert hash(given) == hash(plain)
    assert given != Parameters()
    assert given != Parameters(roi=(0.25, 0.0, 0.5, 0.75))
    assert Parameters(roi=make([0, 0, 1, 1])) == Parameters()
    assert {given: 1}[plain] == 1


@pytest.mark.parametrize('unset', [float('nan'), np.float32('nan'), -math.nan], ids=['float', 'numpy', 'negative'])
def test_unset_is_unset_whichever_nan(unset: float) -> None:
    """Parameters from a file, a message or another process are equal to those made here."""
    assert Parameters(intensity_min=unset, intensity_max=unset) == Parameters()
    assert hash(Parameters(intensity_min=unset, intensity_max=unset)) == hash(Parameters())


def test_copies_are_equal() -> None:
    """Through a process pool too."""
    for parameters in (Parameters(), Parameters(intensity_min=1, intensity_max=2, n=7),
                       Parameters(roi=[1, 2, 30, 40], scale=0.5, theta_min=1, theta_max=-1, max_segments=9)):
        assert copy.deepcopy(parameters) == parameters
        assert pickle.loads(pickle.dumps(parameters)) == parameters
        assert dataclasses.replace(parameters) == parameters
        assert Parameters.of(dataclasses.asdict(parameters)) == parameters
    assert dataclasses.replace(Parameters(), n=9).n == 9
    with pytest.raises(ValueError, match='T2'):
        dataclasses.replace(Parameters(), T2=20)


def test_range_in_words() -> None:
    assert SPECS['sigma'].range == f'{SPECS["sigma"].low:g} to {SPECS["sigma"].high:g}'
    assert SPECS['refine'].range == ''
    assert SPECS['operator'].range == ', '.join(SPECS['operator'].choices)
    assert SPECS['intensity_min'].range.endswith(', or nan for unset')
    assert Spec('Anything.').range == ''


# Tables of another kind.

def test_table_of_every_kind() -> None:
    assert Mixed() == Mixed(flag=False, text='some', choice='a', whole=2, real=0.5, perhaps=math.nan, pair=(1, 2))
    changed = Mixed(flag=np.True_, text='', choice='b', whole=np.int8(3), real=1, perhaps=0, pair=np.array([0, 9]))
    assert dataclasses.asdict(changed) == {
        'flag': True, 'text': '', 'choice': 'b', 'whole': 3, 'real': 1.0, 'perhaps': 0.0, 'pair': (0.0, 9.0)}
    assert [type(value) for value in vars(changed).values()] == [bool, str, str, int, float, float, tuple]
    assert Mixed.of({'flag': True}).flag is True


@pytest.mark.parametrize(('name', 'value', 'error', 'message'), [
    ('flag', 1, TypeError, 'flag must be true or false, got 1'),
    ('flag', 'true', TypeError, "flag must be true or false, got 'true'"),
    ('flag', None, TypeError, 'flag must be true or false, got None'),
    ('text', 3, TypeError, 'text must be a text, got 3'),
    ('text', b'some', TypeError, "text must be a text, got b'some'"),
    ('choice', 'c', ValueError, "choice must be one of a, b, got 'c'"),
    ('whole', 2.0, TypeError, 'whole must be a whole number of 1 to 3, got 2.0'),
    ('whole', True, TypeError, 'whole must be a whole number of 1 to 3, got True'),
    ('whole', 4, ValueError, 'whole must be 1 to 3, got 4'),
    ('real', math.nan, ValueError, 'real must be 0 to 1 pixels, got nan'),
    ('perhaps', 2, ValueError, 'perhaps must be 0 to 1, or nan for unset, got 2'),
    ('pair', [1], ValueError, 'pair must be a list of 2 numbers, got 1: [1]'),
    ('pair', 'ab', TypeError, "pair must be a list of 2 numbers, got 'ab'"),
    ('pair', [1, 10], ValueError, 'each number of pair must be 0 to 9, got 10'),
    ('pair', [1, True], TypeError, 'each number of pair must be a number of 0 to 9, got True'),
])
def test_wrong_value_in_a_table(name: str, value: Any, error: Any, message: str) -> None:
    with pytest.raises(error) as caught:
        Mixed(**{name: value})
    assert str(caught.value) == message


def test_tables_list_their_own_parameters() -> None:
    assert list(Mixed.specs()) == ['flag', 'text', 'choice', 'whole', 'real', 'perhaps', 'pair']
    assert Mixed.specs()['perhaps'].constant
    assert not Mixed.specs()['real'].constant
    with pytest.raises(TypeError, match="^unknown parameter 'alpha': the parameters are flag, text, choice, whole"):
        Mixed.of({'alpha': 1})


def test_tables_are_equal_where_all_values_are() -> None:
    assert Mixed(perhaps=np.float32('nan')) == Mixed()
    assert hash(Mixed(perhaps=-math.nan, pair=[1, 2])) == hash(Mixed())
    for change in ({'flag': True}, {'text': 'other'}, {'perhaps': 0.5}, {'pair': (2, 1)}):
        assert Mixed(**change) != Mixed()
    assert Mixed() != Parameters()
    assert Parameters() != Mixed()
    with pytest.raises(dataclasses.FrozenInstanceError):
        Mixed().flag = True


# What the steps are to do.

def test_paper_does_not_depend_on_noise() -> None:
    assert not Parameters.paper().adaptive
    assert Parameters().adaptive


@pytest.mark.parametrize(('given', 'expected'), [
    ({'alpha': math.nan}, True), ({'noise_T1': 0.1}, True), ({'noise_T2': 0.1}, True), ({'clutter': 1.1}, True),
    ({'alpha': 2.0}, False),
    ({'refine': True, 'grouping': 'straightness'}, False)], ids=str)
def test_adaptive_is_what_depends_on_the_noise(given: dict[str, Any], expected: bool) -> None:
    assert Parameters.profile('paper', **given).adaptive is expected


@pytest.mark.parametrize('value', [10**400, -10**400, 16**5000], ids=['large', 'small', 'unwritable'])
@pytest.mark.parametrize('name', ['alpha', 'T1', 'n', 'intensity_max'])
def test_number_beyond_every_float_is_refused(name: str, value: int) -> None:
    with pytest.raises(ValueError, match=f'^{name} must be .*, got ') as caught:
        Parameters(**{name: value})
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(('name', 'value'), [('operator', 'x' * 10**6), ('roi', [1.0] * 10**5), ('refine', 'y' * 999)],
                         ids=['text', 'list', 'flag'])
def test_value_of_any_size_is_named_in_part(name: str, value: Any) -> None:
    expected = rf'^{name} must be .*, got .*\.\.\. \(\d+ characters\)$'
    with pytest.raises((TypeError, ValueError), match=expected) as caught:
        Parameters(**{name: value})
    assert len(str(caught.value)) < 500


def test_number_of_few_bits_is_compared_as_it_is() -> None:
    """In the half precision of the value the range of the parameter would be infinite, with a warning."""
    assert Parameters(intensity_max=np.float16(0.5)).intensity_max == 0.5
    with pytest.raises(ValueError, match='^T1 must be 0 to 1000'):
        Parameters(T1=np.float16(2000))

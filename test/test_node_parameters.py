"""The parameters of the node, as its start and its services have them."""

import math
import re

import pytest
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter, parameter_value_to_python
from test_node import NAME

from line_feature_node.core import PROFILES, Parameters
from line_feature_node.core.parameters import Spec
from line_feature_node.core.profiles import Profile
from line_feature_node.node import ConfigurationError
from line_feature_node.options import Options

TABLES = {**Parameters.specs(), **Options.specs()}
DEFAULTS = {name: getattr(table, name) for table in (Parameters(), Options()) for name in table.specs()}
TYPES = {
    bool: ParameterType.PARAMETER_BOOL, int: ParameterType.PARAMETER_INTEGER, float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING, tuple: ParameterType.PARAMETER_DOUBLE_ARRAY,
}
#: A value of each parameter that is neither its default nor refused.
OTHERS = {
    'operator': 'sobel', 'alpha': 2.5, 'sigma': 2.0, 'T1': 9.5, 'T2': 2.5, 'noise_T1': 3.0, 'noise_T2': 1.5,
    'clutter': 1.5, 'intensity_min': -5.0, 'intensity_max': 9.0, 'thinning': 'none', 'max_gap': 1, 'min_chain': 9,
    'n': 7, 'grouping': 'codes', 'min_size': 6, 'orientation': 'least_squares', 'tau1': 1.5, 'tau2': 7.5,
    'refine': False, 'min_snr': 9.0, 'false_alarms': 0.5, 'max_sigma_theta': 0.1, 'min_length': 3.5,
    'max_segments': 11, 'theta_min': -0.5, 'theta_max': 0.5, 'roi': [0.0, 0.5, 1.0, 0.5], 'scale': 0.5, 'threads': 3,
    'profile': 'paper', 'lazy': False, 'jpeg_quality': 55, 'image_timeout': 3.5, 'max_latency': 0.5,
    'max_dropped': 0.5,
}
RUNNING = [name for name, spec in TABLES.items() if not spec.constant]


@pytest.fixture
def profile(monkeypatch):
    """A named set that differs from the defaults."""
    values = {'T1': (20.0, 'Reason.'), 'T2': (10.0, 'Reason.'), 'n': (9, 'Reason.')}
    monkeypatch.setitem(PROFILES, 'odd', Profile('For tests.', values))
    choices = Spec(**{**vars(Options.specs()['profile']), 'choices': tuple(PROFILES)})
    field = Options.__dataclass_fields__['profile']
    monkeypatch.setattr(field, 'metadata', {'spec': choices})
    return 'odd'


def values(bench, client, *names):
    answer = bench.wait(client.get_parameters(list(names)))
    found = [parameter_value_to_python(value) for value in answer.values]
    return found if len(names) > 1 else found[0]


def same(first, second):
    if isinstance(first, float) and math.isnan(first):
        return isinstance(second, float) and math.isnan(second)
    return list(first) == list(second) if isinstance(first, tuple) else first == second


# Declared

def test_every_parameter_has_the_name_and_the_default_of_its_table(bench):
    bench.node()
    client = bench.parameters()
    names = bench.wait(client.list_parameters()).result.names
    assert set(TABLES) <= set(names)
    for name, value in zip(TABLES, values(bench, client, *TABLES), strict=True):
        assert same(DEFAULTS[name], value), name


def test_every_parameter_has_its_type(bench):
    bench.node()
    types = bench.wait(bench.parameters().get_parameter_types(list(TABLES))).types
    assert list(types) == [TYPES[type(DEFAULTS[name])] for name in TABLES]


def test_every_parameter_is_described_with_its_range(bench):
    """So that rqt_reconfigure shows sliders."""
    bench.node()
    descriptors = bench.wait(bench.parameters().describe_parameters(list(TABLES))).descriptors
    for descriptor, (name, spec) in zip(descriptors, TABLES.items(), strict=True):
        assert descriptor.name == name
        assert descriptor.description == spec.description
        assert spec.range in descriptor.additional_constraints
        assert spec.unit in descriptor.additional_constraints
        assert descriptor.read_only == spec.constant
        assert not descriptor.dynamic_typing
        kind = type(DEFAULTS[name])
        whole = [(limits.from_value, limits.to_value, limits.step) for limits in descriptor.integer_range]
        real = [(limits.from_value, limits.to_value, limits.step) for limits in descriptor.floating_point_range]
        assert whole == ([(spec.low, spec.high, 1)] if kind is int else [])
        assert real == ([(spec.low, spec.high, 0.0)] if kind is float and not spec.unset else []), name


def test_read_only_is_what_is_read_once(bench):
    bench.node()
    descriptors = bench.wait(bench.parameters().describe_parameters(list(TABLES))).descriptors
    assert {descriptor.name for descriptor in descriptors if descriptor.read_only} == {
        'image_transport', 'mask_file', 'autostart'}


# At the start

def test_every_running_parameter_has_another_value_to_try():
    assert set(OTHERS) == set(RUNNING)


@pytest.mark.parametrize('name', RUNNING)
def test_override_is_taken(bench, name):
    node = bench.node(**{name: OTHERS[name]})
    assert list(bench.warnings()) == []
    found = node.get_parameter(name).value
    assert found == OTHERS[name] if name != 'roi' else list(found) == OTHERS[name]
    table = node._settings.parameters if name in Parameters.specs() else node._settings.options
    assert same(getattr(table, name), OTHERS[name]) or list(getattr(table, name)) == OTHERS[name]


@pytest.mark.parametrize(('name', 'given', 'taken'), [
    ('T1', 12, 12.0), ('tau2', 0, 0.0), ('intensity_max', 4095, 4095.0), ('image_timeout', 5, 5.0),
    ('n', 6.0, 6), ('jpeg_quality', 90.0, 90), ('roi', [0, 100, 640, 380], [0.0, 100.0, 640.0, 380.0])])
def test_numbers_of_the_other_kind_are_taken_at_the_start(bench, name, given, taken):
    node = bench.node(**{name: given})
    found = node.get_parameter(name).value
    assert list(found) == taken if isinstance(taken, list) else (found, type(found)) == (taken, type(taken))


@pytest.mark.parametrize('argument', ['T1:=12', 'n:=6.0', 'intensity_max:=4095', 'roi:=[0,100,640,380]', 'lazy:=false'])
def test_numbers_of_the_other_kind_are_taken_from_the_command_line(bench, argument):
    node = bench.node('-p', argument)
    name = argument.split(':')[0]
    assert not same(DEFAULTS[name], node.get_parameter(name).value)


@pytest.mark.parametrize(('overrides', 'reason'), [
    ({'T1': 1e6}, 'T1 must be 0 to 1000 grey levels/pixel, got 1000000.0'),
    ({'T1': 'high'}, "T1 must be a number of 0 to 1000 grey levels/pixel, got 'high'"),
    ({'T1': True}, 'T1 must be a number of 0 to 1000 grey levels/pixel, got True'),
    ({'T1': float('nan')}, 'T1 must be 0 to 1000 grey levels/pixel, got nan'),
    ({'T1': 2.0}, 'T2 must be less than T1, got T2 = 2 and T1 = 2'),
    ({'n': 4.5}, 'n must be a whole number of 0 to 10000 pixels, got 4.5'),
    ({'n': -1}, 'n must be 0 to 10000 pixels, got -1'),
    ({'operator': 'canny'}, "operator must be one of deriche, .*, got 'canny'"),
    ({'roi': [0.0, 1.0]}, 'roi must be a list of 4 numbers, got 2'),
    ({'roi': [0.0, 0.0, 0.0, 0.0]}, 'roi must have a width and a height above 0'),
    ({'roi': [0.5, 0.0, 640.0, 480.0]}, 'roi must be shares of 0 to 1 or whole pixels'),
    ({'roi': '0 0 1 1'}, "roi must be a list of 4 numbers, got '0 0 1 1'"),
    ({'roi': ['0', '0', '1', '1']}, 'each number of roi must be a number'),
    ({'lazy': 'yes'}, "lazy must be true or false, got 'yes'"),
    ({'lazy': 1}, 'lazy must be true or false, got 1'),
    ({'profile': 'none'}, "profile must be one of default, .*, got 'none'"),
    ({'profile': 5}, 'profile must be one of default'),
    ({'image_transport': 'theora'}, "image_transport must be one of raw, compressed, got 'theora'"),
    ({'intensity_min': 10.0, 'intensity_max': 5.0}, 'intensity_min must be less than intensity_max, got 10 and 5'),
])
def test_wrong_override_keeps_the_node_from_starting_and_is_named(bench, overrides, reason):
    with pytest.raises(ConfigurationError, match=reason):
        bench.node(**overrides)


@pytest.mark.parametrize(('wrong', 'right'), [
    ('min_lenght', 'min_length'), ('Max_gap', 'max_gap'), ('max_segment', 'max_segments'), ('tau_1', 'tau1'),
    ('image_trasport', 'image_transport'), ('maskfile', 'mask_file')])
def test_misspelt_override_is_warned_of_with_what_was_meant(bench, wrong, right):
    node = bench.node(**{wrong: 5.0})
    [line] = bench.warnings()
    assert f'there is no parameter {wrong!r}, what it is set to has no effect: did you mean {right!r}?' in line
    assert not node.has_parameter(wrong)


@pytest.mark.parametrize(('wrong', 'right'), [('t1', 'T1'), ('t2', 'T2'), ('N', 'n'), ('ROI', 'roi'), ('Tl', 'T1')])
def test_override_that_looks_alike_is_warned_of_with_what_was_meant(bench, wrong, right):
    bench.node(**{wrong: 5.0})
    assert f'did you mean {right!r}?' in bench.warnings()[0]


@pytest.mark.parametrize('name', ['roi', 'nonsense'])
def test_empty_list_at_the_start_is_refused_by_its_name(bench, tmp_path, name):
    path = tmp_path / 'some.yaml'
    path.write_text(f'/**: {{ros__parameters: {{T1: 9.0, {name}: []}}}}')
    with pytest.raises(ConfigurationError, match=f'^{name} must have a value'):
        bench.node('--params-file', str(path))


@pytest.mark.parametrize(('section', 'warned'), [('lines', True), ('line_feature_node', False)])
def test_parameter_file_is_warned_of_where_the_node_is_in_the_same_process(bench, tmp_path, section, warned):
    path = tmp_path / 'some.yaml'
    path.write_text(f'{section}: {{ros__parameters: {{T1: 9.0}}}}')
    bench.node('--params-file', str(path))
    assert bench.warnings() == [] if not warned else f'nothing in {path} is for /line' in bench.warnings()[0]


def test_override_like_no_parameter_is_warned_of_by_its_name(bench):
    bench.node(xyzzy_plugh=5.0)
    [line] = bench.warnings()
    assert "there is no parameter 'xyzzy_plugh'" in line
    assert 'did you mean' not in line


@pytest.mark.parametrize(('wrong', 'right'), [
    ('qos_overrides./imgae.subscription.reliability', 'qos_overrides./image.subscription.reliability'),
    ('qos_overrides./image.subscriber.depth', 'qos_overrides./image.subscription.depth'),
    ('qos_overrides.image.subscription.depth', 'qos_overrides./image.subscription.depth'),
    ('qos_overrides./line_feature_node/segment.publisher.depth',
     'qos_overrides./line_feature_node/segments.publisher.depth'),
    ('qos_overrides./image.publisher.depth', 'qos_overrides./image.subscription.depth')])
def test_misspelt_override_of_quality_of_service_is_warned_of_with_what_was_meant(bench, wrong, right):
    bench.node(**{wrong: 5})
    [line] = bench.warnings()
    assert repr(wrong) in line
    assert f'did you mean {right!r}?' in line


def test_what_rclpy_itself_declares_is_not_warned_of(bench):
    bench.node(use_sim_time=True, start_type_description_service=False)
    assert not bench.warnings()


def test_override_of_quality_of_service_of_a_topic_that_is_remapped_by_itself_is_not_warned_of(bench):
    node = bench.node('-r', '/image/compressed:=/front/jpeg', image_transport='compressed', lazy=False, **{
        'qos_overrides./front/jpeg.subscription.depth': 7})
    assert node._subscription.topic_name == '/front/jpeg'
    assert node._subscription.qos_profile.depth == 7
    assert not bench.warnings()


def test_profile_at_the_start_is_the_base_and_overrides_win(bench, profile):
    node = bench.node(profile=profile, T1=30)
    assert node._settings.parameters == Parameters(T1=30.0, T2=10.0, n=9)
    assert [node.get_parameter(name).value for name in ('profile', 'T1', 'T2', 'n')] == ['odd', 30.0, 10.0, 9]
    assert not bench.warnings()


@pytest.mark.parametrize('name', PROFILES)
def test_every_profile_can_be_started_with(bench, name):
    assert bench.node(profile=name)._settings.parameters == Parameters.profile(name)


# While running

@pytest.mark.parametrize('name', RUNNING)
def test_parameter_can_be_set_while_running(bench, name):
    node = bench.node()
    client = bench.parameters()
    assert bench.set(client, **{name: OTHERS[name]}) == ''
    found = values(bench, client, name)
    assert (list(found) if name == 'roi' else found) == OTHERS[name]
    table = node._settings.parameters if name in Parameters.specs() else node._settings.options
    now = getattr(table, name)
    assert (list(now) if name == 'roi' else now) == OTHERS[name]


def test_thresholds_can_be_set_together(bench):
    """T1 alone would be less than T2."""
    node = bench.node()
    client = bench.parameters()
    assert bench.set(client, T1=2.0) == 'T2 must be less than T1, got T2 = 2 and T1 = 2'
    assert bench.set(client, T1=2.0, T2=1.0) == ''
    assert (node._settings.parameters.T1, node._settings.parameters.T2) == (2.0, 1.0)
    assert values(bench, client, 'T1', 'T2') == [2.0, 1.0]


def test_bad_combination_is_refused_with_a_reason_and_nothing_is_changed(bench):
    node = bench.node()
    client, before = bench.parameters(), (node._settings.parameters, node._settings.options)
    reason = bench.set(client, n=7, lazy=False, T1=1.0, T2=5.0)
    assert reason == 'T2 must be less than T1, got T2 = 5 and T1 = 1'
    assert (node._settings.parameters, node._settings.options) == before
    assert values(bench, client, 'n', 'lazy', 'T1', 'T2') == [4, True, 4.0, 2.0]


def test_each_parameter_that_is_set_by_itself_has_its_own_result(bench):
    """As `ros2 param load` does it."""
    node = bench.node()
    client = bench.parameters()
    changes = [Parameter('T2', value=9.0), Parameter('T1', value=20.0), Parameter('T2', value=9.0)]
    results = bench.wait(client.set_parameters(changes)).results
    assert [result.successful for result in results] == [False, True, True]
    assert results[0].reason == 'T2 must be less than T1, got T2 = 9 and T1 = 4'
    assert (node._settings.parameters.T1, node._settings.parameters.T2) == (20.0, 9.0)


@pytest.mark.parametrize(('name', 'given', 'taken'), [
    ('T1', 12, 12.0), ('tau2', 0, 0.0), ('intensity_max', 4095, 4095.0), ('n', 6.0, 6), ('jpeg_quality', 90.0, 90)])
def test_numbers_of_the_other_kind_are_taken_while_running(bench, name, given, taken):
    bench.node()
    client = bench.parameters()
    assert bench.set(client, **{name: given}) == ''
    found = values(bench, client, name)
    assert (found, type(found)) == (taken, type(taken))


def test_whole_numbers_are_taken_for_a_list_while_running(bench):
    node = bench.node()
    client = bench.parameters()
    assert bench.set(client, roi=[0, 100, 640, 380]) == ''
    assert node._settings.parameters.roi == (0, 100, 640, 380)
    assert list(values(bench, client, 'roi')) == [0, 100, 640, 380]


WRONG_TYPE = r"Wrong parameter type, expected 'Type\.\w+' got 'Type\.\w+'"


@pytest.mark.parametrize(('changes', 'reason'), [
    ({'T1': 1e6}, 'T1 must be|Parameter T1'), ({'T1': float('nan')}, 'T1'), ({'T1': float('inf')}, 'T1'),
    ({'n': -1}, 'n must be|Parameter n'), ({'operator': 'canny'}, 'operator must be one of deriche, sobel'),
    ({'roi': [0.0, 1.0]}, 'roi must be a list of 4 numbers, got 2'),
    ({'roi': [0.0, 0.0, 0.0, 0.0]}, 'roi must have a width and a height above 0'),
    ({'profile': 'none'}, 'profile must be one of default'), ({'min_lenght': 5.0}, 'undeclared parameter'),
    ({'image_transport': 'compressed'}, 'read-only'), ({'mask_file': 'x'}, 'read-only'),
    ({'qos_overrides./line_feature_node/segments.publisher.depth': 3}, 'read-only'),
    ({'T1': 'high'}, WRONG_TYPE), ({'T1': True}, WRONG_TYPE), ({'n': 4.5}, WRONG_TYPE), ({'operator': 1}, WRONG_TYPE),
    ({'roi': 'all'}, WRONG_TYPE), ({'roi': 1.0}, WRONG_TYPE), ({'roi': [True] * 4}, WRONG_TYPE),
    ({'lazy': 1}, WRONG_TYPE), ({'profile': 5}, WRONG_TYPE)])
def test_wrong_value_is_refused_with_a_reason_while_running(bench, changes, reason):
    node = bench.node()
    client, before = bench.parameters(), (node._settings.parameters, node._settings.options)
    assert re.search(reason, bench.set(client, **changes))
    assert (node._settings.parameters, node._settings.options) == before
    assert bench.set(client, T1=9.0) == ''


@pytest.mark.parametrize('kind', [
    Parameter.Type.NOT_SET, Parameter.Type.BYTE_ARRAY, Parameter.Type.STRING_ARRAY, Parameter.Type.DOUBLE_ARRAY,
    Parameter.Type.INTEGER_ARRAY])
@pytest.mark.parametrize('name', ['T1', 'n', 'roi', 'lazy', 'operator', 'profile'])
def test_empty_value_is_refused_while_running(bench, name, kind):
    """As a tool sends that deletes a parameter, or an empty list."""
    node = bench.node()
    client, before = bench.parameters(), (node._settings.parameters, node._settings.options)
    change = Parameter(name, kind, None if kind == Parameter.Type.NOT_SET else [])
    answer = bench.wait(client.set_parameters_atomically([change])).result
    assert not answer.successful
    assert answer.reason != ''
    assert (node._settings.parameters, node._settings.options) == before


def test_intensity_range_can_be_set_and_unset_again(bench):
    """NaN is outside of any range that a descriptor can name."""
    node = bench.node()
    client = bench.parameters()
    assert bench.set(client, intensity_max=4095.0) == ''
    assert node._settings.parameters.intensity_max == 4095
    assert bench.set(client, intensity_max=float('nan')) == ''
    assert math.isnan(node._settings.parameters.intensity_max)
    assert math.isnan(values(bench, client, 'intensity_max'))


def test_intensity_beyond_all_measure_is_refused(bench):
    bench.node()
    assert 'intensity_max must be -1e+09 to 1e+09' in bench.set(bench.parameters(), intensity_max=1e10)


def test_profile_while_running_sets_all_that_it_does_and_resets_the_others(bench, profile):
    node = bench.node(T1=50.0, tau1=2.0)
    client = bench.parameters()
    assert bench.set(client, profile=profile) == ''
    assert node._settings.parameters == Parameters.profile(profile) == Parameters(T1=20.0, T2=10.0, n=9)
    assert values(bench, client, 'profile', 'T1', 'T2', 'n', 'tau1') == ['odd', 20.0, 10.0, 9, 1.0]
    assert bench.set(client, profile='default') == ''
    assert node._settings.parameters == Parameters()
    assert values(bench, client, 'profile', 'T1', 'T2', 'n') == ['default', 4.0, 2.0, 4]


def test_values_set_together_with_a_profile_win(bench, profile):
    node = bench.node()
    client = bench.parameters()
    assert bench.set(client, n=5, profile=profile, T1=40) == ''
    assert node._settings.parameters == Parameters(T1=40.0, T2=10.0, n=5)
    assert values(bench, client, 'T1', 'T2', 'n') == [40.0, 10.0, 5]


def test_profile_that_contradicts_what_is_set_with_it_is_refused_whole(bench, profile):
    node = bench.node()
    client = bench.parameters()
    assert bench.set(client, profile=profile, T1=5.0) == 'T2 must be less than T1, got T2 = 10 and T1 = 5'
    assert node._settings.parameters == Parameters()
    assert values(bench, client, 'profile', 'T1', 'T2', 'n') == ['default', 4.0, 2.0, 4]


def test_parameters_of_the_extractor_are_swapped_as_one(bench):
    node = bench.node()
    before = node._extractor.parameters
    assert bench.set(bench.parameters(), T1=20.0, T2=10.0) == ''
    assert node._extractor.parameters is node._settings.parameters is not before
    assert before == Parameters()


def test_option_leaves_the_extractor_as_it_is(bench):
    node = bench.node()
    before = node._extractor.parameters
    assert bench.set(bench.parameters(), jpeg_quality=50) == ''
    assert node._extractor.parameters is before
    assert node._settings.options.jpeg_quality == 50


def test_parameters_of_two_nodes_are_their_own(bench):
    left, right = bench.node('-r', '__ns:=/left'), bench.node('-r', '__ns:=/right')
    assert bench.set(bench.parameters(f'/left{NAME}'), T1=20.0) == ''
    assert (left._settings.parameters.T1, right._settings.parameters.T1) == (20.0, 4.0)

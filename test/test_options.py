import pytest

from line_feature_node.core import PROFILES, Parameters
from line_feature_node.options import Options


def test_defaults_are_those_of_a_camera_that_just_works():
    options = Options()
    assert (options.profile, options.image_transport, options.mask_file) == ('default', 'raw', '')
    assert options.lazy
    assert options.autostart


@pytest.mark.parametrize('name', Options.specs())
def test_every_option_is_described(name):
    spec = Options.specs()[name]
    assert spec.description[0].isupper()
    assert spec.description.endswith('.')


def test_no_option_has_the_name_of_a_parameter_of_the_extraction():
    """All are parameters of one node."""
    assert not set(Options.specs()) & set(Parameters.specs())


def test_every_profile_may_be_chosen():
    assert Options.specs()['profile'].choices == tuple(PROFILES)
    for name in PROFILES:
        assert Options(profile=name).profile == name


def test_what_is_read_once_is_constant():
    constant = {name for name, spec in Options.specs().items() if spec.constant}
    assert constant == {'image_transport', 'mask_file', 'autostart'}


def test_no_text_that_may_name_a_file_can_be_set_while_the_node_runs():
    """Anybody may set what is not constant."""
    for table in (Parameters(), Options()):
        free = {name for name, spec in table.specs().items() if isinstance(getattr(table, name), str)
                and not spec.choices}
        assert free <= {'mask_file'}
        assert all(table.specs()[name].constant for name in free)


@pytest.mark.parametrize(('values', 'reason'), [
    ({'profile': 'none'}, 'profile must be one of default, '),
    ({'image_transport': 'theora'}, "image_transport must be one of raw, compressed, got 'theora'"),
    ({'jpeg_quality': 0}, 'jpeg_quality must be 1 to 100, got 0'),
    ({'jpeg_quality': 101}, 'jpeg_quality must be 1 to 100, got 101'),
    ({'image_timeout': 0.0}, 'image_timeout must be 0.1 to 3600 seconds'),
    ({'image_timeout': float('nan')}, 'image_timeout must be 0.1 to 3600 seconds, got nan'),
    ({'max_latency': -0.1}, 'max_latency must be 0 to 60 seconds'),
    ({'max_dropped': 1.1}, 'max_dropped must be 0 to 1, got 1.1'),
])
def test_value_out_of_range_is_refused(values, reason):
    with pytest.raises(ValueError, match=reason):
        Options(**values)


@pytest.mark.parametrize(('values', 'reason'), [
    ({'lazy': 1}, 'lazy must be true or false, got 1'),
    ({'autostart': 'no'}, "autostart must be true or false, got 'no'"),
    ({'mask_file': 5}, 'mask_file must be a text, got 5'),
    ({'jpeg_quality': 80.5}, 'jpeg_quality must be a whole number of 1 to 100, got 80.5'),
    ({'jpeg_quality': True}, 'jpeg_quality must be a whole number of 1 to 100, got True'),
    ({'max_latency': '0.1'}, "max_latency must be a number of 0 to 60 seconds, got '0.1'"),
])
def test_value_of_another_type_is_refused(values, reason):
    with pytest.raises(TypeError, match=reason):
        Options(**values)


def test_unknown_name_is_refused_with_those_that_there_are():
    with pytest.raises(TypeError, match=r"unknown parameter 'lasy': the parameters are profile, .*lazy"):
        Options.of({'lasy': True})

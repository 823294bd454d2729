import dataclasses
from typing import Any

import numpy as np
import pytest

from line_feature_node.core import PROFILES as EXPORTED
from line_feature_node.core import Parameters
from line_feature_node.core.profiles import PROFILES, Profile

SETTINGS = [(profile, name) for profile in PROFILES for name in PROFILES[profile].settings]


def is_sentence(text: Any) -> bool:
    """It starts with a capital or a name of a parameter, ends in a full stop, and is all on one line."""
    known = text[:1].isupper() or text.split()[0].strip(',') in Parameters.specs()
    return known and text.endswith('.') and text == ' '.join(text.split()) and len(text.split()) > 2


def test_names() -> None:
    assert EXPORTED is PROFILES
    assert next(iter(PROFILES)) == 'default'
    assert 'paper' in PROFILES
    for name in PROFILES:
        assert name.isidentifier()
        assert name.islower()


@pytest.mark.parametrize('name', PROFILES)
def test_profile_makes_parameters(name: str) -> None:
    values = PROFILES[name].values
    assert set(values) <= set(Parameters.specs())
    found = Parameters.profile(name)
    assert found == Parameters(**values) == Parameters.of(values)
    for key, value in dataclasses.asdict(found).items():
        np.testing.assert_equal(value, values.get(key, dataclasses.asdict(Parameters())[key]))


@pytest.mark.parametrize('name', PROFILES)
def test_description_is_a_sentence(name: str) -> None:
    assert is_sentence(PROFILES[name].description)


@pytest.mark.parametrize('name', PROFILES)
def test_every_setting_has_a_reason(name: str) -> None:
    for key, setting in PROFILES[name].settings.items():
        assert isinstance(setting, tuple), key
        assert len(setting) == 2, key
        assert is_sentence(setting[1]), (key, setting)


@pytest.mark.parametrize('name', PROFILES)
def test_every_setting_differs_from_the_default(name: str) -> None:
    """As Parameters has it, so that 8 is no other than 8.0."""
    defaults, chosen = Parameters(), Parameters.profile(name)
    for key in PROFILES[name].values:
        assert getattr(chosen, key) != getattr(defaults, key), key


def test_default_changes_nothing() -> None:
    assert PROFILES['default'].values == {}
    assert Parameters.profile('default') == Parameters()


def test_profiles_are_told_apart() -> None:
    descriptions = [profile.description for profile in PROFILES.values()]
    assert len(set(descriptions)) == len(descriptions)


def test_values_are_the_settings_without_their_reasons() -> None:
    profile = Profile('For a test.', {'n': (0, 'It is off.'), 'T1': (9.0, 'It is strong.')})
    assert profile.values == {'n': 0, 'T1': 9.0}
    profile.values['n'] = 3
    assert profile.values['n'] == 0
    assert Profile('For nothing at all.').settings == {}
    with pytest.raises(dataclasses.FrozenInstanceError):
        profile.description = 'Another.'

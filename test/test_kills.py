"""A short form of bench/kills.py: runs over a recording that are killed or lack something, and resumed."""

import importlib.util
import sys
from pathlib import Path

import pytest

PATH = Path(__file__).resolve().parents[1] / 'bench' / 'kills.py'


def module():
    spec = importlib.util.spec_from_file_location('kills', PATH)
    loaded = importlib.util.module_from_spec(spec)
    sys.modules['kills'] = loaded  # its classes look themselves up there
    spec.loader.exec_module(loaded)
    return loaded


kills = module()


@pytest.fixture(scope='module')
def campaign(tmp_path_factory):
    return kills.Campaign(tmp_path_factory.mktemp('kills'), 96, seed=3, setups=kills.SETUPS[:1])


@pytest.fixture
def setup(campaign):
    campaign.findings = kills.Findings()
    [setup] = campaign.sources
    return setup


def test_the_undisturbed_run_is_a_run(campaign, setup):
    messages, table = campaign.expected[setup].content
    assert [topic for topic, _, _ in messages] == ['/camera/segments'] * 96
    assert (table, campaign.expected[setup].steps > 20) == (b'', True)


def test_a_run_that_is_killed_and_gone_on_with_gives_the_same(campaign, setup):
    campaign.kill()
    assert campaign.findings.wrong == []
    assert sum(campaign.findings.counts.values()) >= 2


def test_a_recording_that_is_cut_meanwhile_is_a_sentence_and_nothing_broken(campaign, setup):
    campaign.cut_input(setup)
    assert campaign.findings.wrong == []


def test_what_is_not_as_it_must_be_is_found(campaign, setup, tmp_path, capsys):
    """A campaign that finds nothing is worth what it would find."""
    other = kills.record(tmp_path / 'out', 'mcap', 5)
    assert campaign._is_whole(setup, other, None, 'of a test')
    [file] = other.glob('*.mcap')
    file.write_bytes(file.read_bytes()[:-100])
    assert campaign._is_whole(setup, other, None, 'of a test')
    assert not campaign._is_whole(setup, tmp_path / 'none', campaign.expected[setup].content, 'of a test')
    wrong, broken, lost = campaign.findings.wrong
    assert 'a wrong target' in wrong
    assert 'a broken target' in broken
    assert 'the old bag is lost' in lost
    assert capsys.readouterr().err.count('NOT AS IT MUST BE') == 3

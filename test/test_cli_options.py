import inspect

import pytest
import typer
from typer.testing import CliRunner

from line_feature_node.cli_options import with_parameters
from line_feature_node.core import Parameters


@pytest.fixture
def run(tmp_path):
    """Run a command that keeps its parameters."""
    kept = []

    def command(name: str, parameters: Parameters) -> None:
        kept.append((name, parameters))

    app = typer.Typer()
    app.command()(with_parameters(command))

    def run(*arguments):
        result = CliRunner().invoke(app, ['some', *map(str, arguments)])
        return result, kept[-1][1] if kept else None

    return run


def test_every_parameter_is_an_option():
    def command(parameters: Parameters) -> None:
        raise AssertionError(parameters)

    names = set(inspect.signature(with_parameters(command)).parameters)
    assert names == {'params_file', 'profile', *Parameters.specs()}


def test_without_options_there_are_the_defaults(run):
    assert run()[1] == Parameters()


def test_options_win_over_the_file_and_that_over_the_profile(run, tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text('/**: {ros__parameters: {profile: corridor, T1: 30, T2: 7.0, nonsense: 1}}')
    result, parameters = run('--params-file', path, '--T2', 6)
    assert parameters == Parameters.profile('corridor', T1=30.0, T2=6.0)
    assert "no parameter 'nonsense'" in result.stderr


@pytest.mark.parametrize(('arguments', 'name'), [
    ([], 'default'), (['--params-file', 'some.yaml'], 'corridor'),
    (['--params-file', 'some.yaml', '--profile', 'paper'], 'paper')])
def test_a_command_may_ask_for_the_name_of_the_profile(tmp_path, monkeypatch, arguments, name):
    kept = []

    def command(parameters: Parameters, profile: str) -> None:
        kept.append((parameters, profile))

    monkeypatch.chdir(tmp_path)
    (tmp_path / 'some.yaml').write_text('/**: {ros__parameters: {profile: corridor}}')
    app = typer.Typer()
    app.command()(with_parameters(command))
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert kept == [(Parameters.profile(name), name)]


def test_a_list_takes_its_numbers_one_by_one(run):
    assert run('--roi', 0, 0.5, 1, 0.5)[1].roi == (0.0, 0.5, 1.0, 0.5)


@pytest.mark.parametrize('arguments', [('--T1', 2), ('--profile', 'none'), ('--params-file', 'missing.yaml')])
def test_what_cannot_be_is_a_sentence_and_status_2(run, arguments):
    result, parameters = run(*arguments)
    assert result.exit_code == 2
    assert parameters is None
    assert 'Traceback' not in result.output


def test_whole_numbers_of_a_file_are_taken_for_doubles(run, tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text('/**: {ros__parameters: {T1: 30, min_length: 12, roi: [0, 0, 1, 1], n: 6}}')
    parameters = run('--params-file', path)[1]
    assert (parameters.T1, parameters.min_length, parameters.roi, parameters.n) == (30.0, 12.0, (0.0, 0.0, 1.0, 1.0), 6)
    assert isinstance(parameters.T1, float)


def test_the_profile_of_the_command_wins_over_that_of_the_file_which_still_sets_what_it_names(run, tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text('/**: {ros__parameters: {profile: corridor, T1: 30.0}}')
    assert run('--params-file', path, '--profile', 'paper')[1] == Parameters.profile('paper', T1=30.0)


@pytest.mark.parametrize(('name', 'value'), [('profile', 'none'), ('T1', 'many'), ('T1', -5), ('profile', '[1]'),
                                             ('roi', '[1, 2]'), ('operator', 3)])
def test_values_of_a_file_that_cannot_be_are_a_sentence_with_their_name(run, tmp_path, name, value):
    path = tmp_path / 'some.yaml'
    path.write_text(f'/**: {{ros__parameters: {{{name}: {value}}}}}')
    result, parameters = run('--params-file', path)
    assert result.exit_code == 2
    assert parameters is None
    assert name in result.stderr
    assert 'Traceback' not in result.output


def test_each_warning_is_one_line(run, tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text('/**: {ros__parameters: {one: 1, two: 2, T1: 9.0}}')
    result, parameters = run('--params-file', path)
    assert result.exit_code == 0
    assert len(result.stderr.splitlines()) == 2
    assert parameters.T1 == 9

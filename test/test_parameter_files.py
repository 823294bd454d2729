from pathlib import Path

import pytest
import yaml

from line_feature_node.core import Parameters
from line_feature_node.options import Options
from line_feature_node.parameter_files import read_parameter_file

CONFIG = Path(__file__).resolve().parents[1] / 'config'


@pytest.mark.parametrize('name', ['default', 'corridor', 'lane_tracking', 'paper'])
def test_files_of_the_node_are_accepted_as_they_are(name):
    values, unknown = read_parameter_file(CONFIG / f'{name}.yaml')
    assert values['profile'] == name
    assert unknown == []
    own = {key: value for key, value in values.items() if key in Parameters.specs()}
    assert Parameters.of(own) == Parameters.profile(name)


def test_sections_of_nodes_and_namespaces_are_found_and_unknown_names_told(tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text('/front:\n  some_node:\n    ros__parameters: {T1: 50, use_sim_time: true}\n')
    assert read_parameter_file(path) == ({'T1': 50}, ['use_sim_time'])


def test_quality_of_service_is_not_told_as_unknown(tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text('/**: {ros__parameters: {qos_overrides: {/image: {subscription: {depth: 9}}}, T1: 50}}\n'
                    'node: {ros__parameters: {qos_overrides./image.subscription.reliability: reliable, qos: 1}}')
    assert read_parameter_file(path) == ({'T1': 50}, ['qos'])


def test_nested_names_are_joined_by_points(tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text('/**: {ros__parameters: {camera: {fps: 30, size: {width: 640}}, T1: 9.0}}')
    assert read_parameter_file(path) == ({'T1': 9.0}, ['camera.fps', 'camera.size.width'])


@pytest.mark.parametrize(('text', 'reason'), [
    ('a: &a {ros__parameters: {}, b: *a}\nc: &c {d: *c}', 'alias'),
    ('a: {ros__parameters: {day: 2024-13-45}}', 'not YAML'), ('T1: 5', 'no ros__parameters'),
    ('', 'no ros__parameters'), ('[1, 2]', 'no ros__parameters'),
    ('a: {ros__parameters: 5}', 'must be names with values, got 5'), ('a: [', 'not YAML'), ('\xff\x00', 'not YAML')])
def test_what_is_no_parameter_file_is_a_sentence(tmp_path, text, reason):
    path = tmp_path / 'some.yaml'
    path.write_bytes(text.encode('latin-1'))
    with pytest.raises(ValueError, match=reason) as caught:
        read_parameter_file(path)
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


def test_a_missing_file_is_a_sentence(tmp_path):
    with pytest.raises(ValueError, match='none.yaml: No such file'):
        read_parameter_file(tmp_path / 'none.yaml')


def test_sections_are_put_together_and_the_last_wins(tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text('/**: {ros__parameters: {T1: 5, n: 3}}\nfront: {node: {ros__parameters: {T1: 7.5, lazy: true}}}\n')
    assert read_parameter_file(path) == ({'T1': 7.5, 'n': 3, 'lazy': True}, [])


def test_parameters_and_options_of_every_name_are_known(tmp_path):
    path = tmp_path / 'some.yaml'
    names = [*Parameters.specs(), *Options.specs()]
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': dict.fromkeys([*names, 'other', 5], 1)}}))
    values, unknown = read_parameter_file(path)
    assert set(values) == set(names)
    assert sorted(unknown) == ['5', 'other']


def test_a_folder_is_a_sentence(tmp_path):
    with pytest.raises(ValueError, match='Is a directory'):
        read_parameter_file(tmp_path)


@pytest.mark.parametrize(('content', 'reason'), [
    ('a: &a\n  b: *a\n', 'is an alias'), ('a: {ros__parameters: &a {b: *a}}', 'is an alias'),
    ('[' * 5000 + ']' * 5000, 'nested too deep'), ('a: ' + '{b: ' * 5000 + '}' * 5000, 'nested too deep')])
def test_what_contains_itself_or_is_nested_without_end_is_a_sentence(tmp_path, content, reason):
    path = tmp_path / 'some.yaml'
    path.write_text(content)
    with pytest.raises(ValueError, match=reason):
        read_parameter_file(path)


def test_what_would_be_gigabytes_is_refused_before_it_is(tmp_path):
    path = tmp_path / 'some.yaml'
    lines = ['a0: &a0 {ros__parameters: {alpha: 1.0}}', *(
        f'a{level}: &a{level} {{x: *a{level - 1}, y: *a{level - 1}}}' for level in range(1, 60))]
    path.write_text('\n'.join(lines))
    with pytest.raises(ValueError, match='a0 is an alias'):
        read_parameter_file(path)


def test_a_section_that_is_a_long_text_is_named_in_part(tmp_path):
    path = tmp_path / 'some.yaml'
    path.write_text(f'a: {{ros__parameters: {"x" * 10_000}}}')
    with pytest.raises(ValueError, match=r"got 'xxx.*\.\.\. \(10002 characters\)") as caught:
        read_parameter_file(path)
    assert len(str(caught.value)) < 500

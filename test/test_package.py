"""What the project says of itself in several places is the same in all."""

import ast
import importlib.metadata
import re
import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from line_feature_node.core import SEGMENT_DTYPE, Parameters
from line_feature_node.files import FOLDERS
from line_feature_node.images import MOST_PIXELS
from line_feature_node.options import Options

ROOT = Path(__file__).resolve().parents[1]
GENERATE = runpy.run_path(str(ROOT / 'docs' / 'generate.py'))
CONFIG = GENERATE['config_files']()


def test_package_xml_is_valid():
    package = pytest.importorskip('catkin_pkg.package').parse_package(ROOT / 'package.xml')
    package.validate()
    assert package.name == 'line_feature_node'
    assert package.package_format == 3
    assert package.get_build_type() == 'ament_python'
    assert package.licenses == ['Apache-2.0']
    assert (ROOT / 'resource' / package.name).exists()


def test_pip_and_package_xml_agree():
    package = pytest.importorskip('catkin_pkg.package').parse_package(ROOT / 'package.xml')
    assert importlib.metadata.version('line_feature_node') == package.version
    required = importlib.metadata.requires('line_feature_node')
    names = {line.split('>')[0].split('[')[0] for line in required if 'extra ==' not in line}
    keys = {dependency.name for dependency in package.exec_depends if dependency.name.startswith('python3-')}
    names -= {'lz4', 'mcap', 'zstandard'}  # there are no keys for them, and only --salvage needs them
    unlike = {'opencv-python-headless': 'python3-opencv', 'rosbags': 'python3-rosbags-pip', 'PyYAML': 'python3-yaml'}
    assert keys == {unlike.get(name, f'python3-{name}') for name in names}
    assert not any(name.startswith('ros-') for name in names)


def test_package_xml_names_the_ros_packages_that_are_imported():
    package = pytest.importorskip('catkin_pkg.package').parse_package(ROOT / 'package.xml')
    declared = {dependency.name for dependency in package.exec_depends if not dependency.name.startswith('python3-')}
    known = {'cv2', 'distributed', 'line_feature_node', 'llvmlite', 'lz4', 'mcap', 'numba', 'numpy', 'rich', 'rosbags'}
    known |= {'typer', 'yaml', 'zstandard', *sys.stdlib_module_names}
    modules = [*(ROOT / 'line_feature_node').glob('*.py')]
    imported = {name.split('.')[0] for path in modules for name in imports(path)} - known
    # By name, when a message is made.
    named = {name.split('/')[0] for name in re.findall(r"'(\w+/msg/\w+)'", (
        ROOT / 'line_feature_node' / 'messages.py').read_text(encoding='utf-8'))}
    assert declared == imported | named


@pytest.mark.parametrize('name', sorted(CONFIG))
def test_config_files_are_those_of_the_table(name):
    assert (ROOT / 'config' / name).read_text(encoding='utf-8') == CONFIG[name]
    assert {path.name for path in (ROOT / 'config').glob('*.yaml')} == set(CONFIG)


@pytest.mark.parametrize('name', sorted(CONFIG))
def test_config_files_set_what_their_profile_has(name):
    [(nodes, content)] = yaml.safe_load(CONFIG[name]).items()
    values = content['ros__parameters']
    assert nodes == '/**'
    assert set(values) <= {*Parameters.specs(), *Options.specs()}
    assert Options.of({key: value for key, value in values.items() if key in Options.specs()})
    own = {key: value for key, value in values.items() if key in Parameters.specs()}
    profile = name.removesuffix('.yaml')
    assert values['profile'] == profile
    assert Parameters.of(own) == Parameters.profile(profile) == Parameters.profile(profile, **own)
    if name == 'default.yaml':
        assert set(values) == {*Parameters.specs(), *Options.specs()}


def test_doubles_are_written_as_doubles():
    """An int where ROS 2 expects a double is not for everybody's nodes."""
    for text in CONFIG.values():
        for key, value in next(iter(yaml.safe_load(text).values()))['ros__parameters'].items():
            default = getattr(Parameters() if key in Parameters.specs() else Options(), key)
            assert type(value) is (list if isinstance(default, tuple) else type(default)), key


def test_launch_file_starts_the_node_with_its_arguments():
    [launch] = [yaml.safe_load(path.read_text(encoding='utf-8')) for path in (ROOT / 'launch').iterdir()]
    arguments = {entry['arg']['name']: entry['arg']['default'] for entry in launch['launch'] if 'arg' in entry}
    [node] = [entry['node'] for entry in launch['launch'] if 'node' in entry]
    assert arguments == {'preset': 'default', 'image': 'image', 'image_transport': 'raw', 'namespace': ''}
    assert node['pkg'] == 'line_feature_node'
    scripts = importlib.metadata.entry_points(group='console_scripts')
    assert scripts[node['exec']].value == 'line_feature_node.__main__:main'
    assert node['remap'] == [{'from': 'image', 'to': '$(var image)'}]
    assert node['param'][0]['from'].endswith('/config/$(var preset).yaml')
    used = set(re.findall(r'\$\(var (\w+)\)', yaml.safe_dump(node)))
    assert used == set(arguments)
    assert node['param'][1]['name'] in Options.specs()


def test_readme_table_is_that_of_the_parameters():
    readme = (ROOT / 'README.md').read_text(encoding='utf-8')
    assert GENERATE['with_tables'](readme) == readme
    for name in {**Parameters.specs(), **Options.specs()}:
        assert f'| `{name}` |' in readme


def examples(readme):
    return [part.split('```')[0] for part in readme.split('```python\n')[1:]]


def test_readme_subscriber_runs(monkeypatch, capsys):
    rclpy = pytest.importorskip('rclpy')
    readme = (ROOT / 'README.md').read_text(encoding='utf-8')
    [example] = [code for code in examples(readme) if 'rclpy' in code]
    assert len(example.strip().splitlines()) <= 10
    nodes = []
    monkeypatch.setattr(rclpy, 'spin', nodes.append)
    try:
        exec(compile(example, 'README.md', 'exec'), {})
        [subscription] = [entry for entry in nodes[0].subscriptions if 'segments' in entry.topic_name]
        assert subscription.topic_name == '/line_feature_node/segments'
        node = pytest.importorskip('line_feature_node.node')
        message = node.MESSAGES.segments(np.ones(1, SEGMENT_DTYPE), None)
        subscription.callback(message)
        assert capsys.readouterr().out == '[(1., 1., 1., 1.)]\n'
    finally:
        nodes[0].destroy_node()
        rclpy.shutdown()


def test_readme_example_runs(monkeypatch):
    readme = (ROOT / 'README.md').read_text(encoding='utf-8')
    [example] = [code for code in examples(readme) if 'extract(' in code]
    assert len(example.strip().splitlines()) <= 5
    picture = np.zeros((60, 80, 3), np.uint8)
    picture[:, 40:] = 200
    monkeypatch.setattr(cv2, 'imread', lambda _: picture)
    scope = {}
    exec(compile(example, 'README.md', 'exec'), scope)
    assert len(scope['segments']) == 1


def imports(path):
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module


#: What runs whatever code is in the data that it reads.
RUNS_DATA = {'pickle', 'cPickle', 'dill', 'cloudpickle', 'joblib', 'marshal', 'shelve', 'jsonpickle'}
RUNS_TEXT = {'eval', 'exec', 'compile', '__import__', 'system', 'popen'}


def faults(source):
    """What in a module could run code that somebody else sent or wrote."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            yield from (name for name in names if name and name.split('.')[0] in RUNS_DATA)
        elif isinstance(node, ast.Call):
            owner = node.func.value if isinstance(node.func, ast.Attribute) else None
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, 'id', '')
            of = owner.id if isinstance(owner, ast.Name) else ''
            if name in RUNS_TEXT and of not in {'re', 'sre'}:
                yield name
            if of == 'yaml' and name not in {'safe_load', 'safe_dump', 'parse'}:  # which makes no values
                yield f'yaml.{name}'
            yield from (keyword.arg for keyword in node.keywords if keyword.arg in {'allow_pickle', 'shell'}
                        and not (isinstance(keyword.value, ast.Constant) and keyword.value.value is False))


MODULES = sorted((ROOT / 'line_feature_node').rglob('*.py'))


@pytest.mark.parametrize('path', MODULES, ids=[path.stem for path in MODULES])
def test_nothing_runs_what_it_reads(path):
    assert list(faults(path.read_text(encoding='utf-8'))) == []


@pytest.mark.parametrize('source', [
    'import pickle', 'from pickle import load', 'import cloudpickle.x', 'eval(text)', 'exec(text)', 'os.system(text)',
    'yaml.load(text)', 'yaml.load_all(text, yaml.Loader)', 'yaml.unsafe_load(text)', 'np.load(path, allow_pickle=True)',
    'run(text, shell=yes)', 'builtins.eval(text)'])
def test_what_runs_what_it_reads_would_be_found(source):
    assert len(list(faults(source))) == 1


def test_security_md_names_what_the_node_has():
    said = (ROOT / 'SECURITY.md').read_text(encoding='utf-8')
    constant = [name for name, spec in Options.specs().items() if spec.constant]
    row = next(line for line in said.splitlines() if line.startswith('| parameters |'))
    assert {name for name in re.findall(r'`(\w+)`', row) if name in Options.specs()} == set(constant)
    assert f'`{FOLDERS}=' in said
    assert MOST_PIXELS == 2**28
    assert '2^28 pixels' in said


def test_every_requirement_says_from_which_version_on():
    for line in importlib.metadata.requires('line_feature_node'):
        assert re.match(r'[\w-]+(\[\w+\])?>=\d', line), line


@pytest.mark.parametrize('path', sorted((ROOT / 'line_feature_node' / 'core').glob('*.py')), ids=lambda path: path.name)
def test_core_knows_nothing_of_the_world(path):
    allowed = {'cv2', 'numpy', 'numba', 'llvmlite', *sys.stdlib_module_names}
    for name in imports(path):
        assert name.startswith('line_feature_node.core') or name.split('.')[0] in allowed, name
        assert name.split('.')[0] not in {'argparse', 'os', 'io', 'logging'}, name
        # The cache of compiled kernels goes by what the modules of the core are.
        assert name != 'pathlib' or path.name == 'compiling.py'


def test_modules_and_tests_have_the_same_names():
    modules = {path.stem for path in (ROOT / 'line_feature_node').rglob('*.py')} - {'__init__', '__main__'}
    tests = {path.stem.removeprefix('test_') for path in (ROOT / 'test').glob('test_*.py')}
    assert modules <= tests

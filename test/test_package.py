"""What the project says of itself in several places is the same in all."""

import ast
import importlib.metadata
import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from line_feature_node.core import Parameters

ROOT = Path(__file__).resolve().parents[1]
GENERATE = runpy.run_path(str(ROOT / 'docs' / 'generate.py'))


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
    keys = {dependency.name for dependency in package.exec_depends}
    assert keys == {'python3-opencv' if name.startswith('opencv') else f'python3-{name}' for name in names}
    assert not any(name.startswith('ros-') for name in names)


def test_readme_table_is_that_of_the_parameters():
    readme = (ROOT / 'README.md').read_text(encoding='utf-8')
    assert GENERATE['with_table'](readme) == readme
    for name in Parameters.specs():
        assert f'| `{name}` |' in readme


def test_readme_example_runs(monkeypatch):
    readme = (ROOT / 'README.md').read_text(encoding='utf-8')
    example = readme.split('```python\n')[1].split('```')[0]
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


@pytest.mark.parametrize('path', sorted((ROOT / 'line_feature_node' / 'core').glob('*.py')), ids=lambda path: path.name)
def test_core_knows_nothing_of_the_world(path):
    allowed = {'cv2', 'numpy', 'numba', 'llvmlite', *sys.stdlib_module_names}
    for name in imports(path):
        assert name.startswith('line_feature_node.core') or name.split('.')[0] in allowed, name
        assert name.split('.')[0] not in {'argparse', 'os', 'io', 'logging'}, name
        # The cache of compiled kernels goes by what the modules of the core are.
        assert name != 'pathlib' or path.name == 'compiling.py'


def test_modules_and_tests_have_the_same_names():
    modules = {path.stem for path in (ROOT / 'line_feature_node').rglob('*.py')} - {'__init__', 'compiling'}
    tests = {path.stem.removeprefix('test_') for path in (ROOT / 'test').glob('test_*.py')}
    assert modules <= tests

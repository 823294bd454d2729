import os
import shutil
import subprocess
import sys
from pathlib import Path

import line_feature_node

PACKAGE = Path(line_feature_node.__file__).parent
PROGRAM = """
import numpy as np
from line_feature_node.core.compiling import kernel
from line_feature_node.core.normalization import normalize_open
codes = np.array([1, 1, 1, 1, 3, 1, 1, 1, 1], np.uint8)
normalize_open(codes, 4)
print(codes.tolist(), sum(normalize_open.stats.cache_hits.values()))
"""


def run(folder: Path, **environment: str) -> str:
    done = subprocess.run([sys.executable, '-c', PROGRAM], cwd=folder, capture_output=True, text=True, check=False,
                          env={**os.environ, 'PYTHONPATH': str(folder), **environment})
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_cache_is_used_until_any_module_of_the_core_changes(tmp_path):
    """Kernels have functions and constants of other modules compiled into them."""
    shutil.copytree(PACKAGE, tmp_path / 'line_feature_node', ignore=shutil.ignore_patterns('__pycache__'))
    assert run(tmp_path) == '[1, 1, 1, 1, 1, 1, 1, 1, 1] 0'
    assert run(tmp_path) == '[1, 1, 1, 1, 1, 1, 1, 1, 1] 1'
    indices = tmp_path / 'line_feature_node' / 'core' / 'indices.py'
    indices.write_text(indices.read_text() + '# changed\n')
    assert run(tmp_path) == '[1, 1, 1, 1, 1, 1, 1, 1, 1] 0'


def test_without_a_home_or_a_writable_cache(tmp_path):
    """A read-only installation works, and compiles in every process."""
    shutil.copytree(PACKAGE, tmp_path / 'line_feature_node', ignore=shutil.ignore_patterns('__pycache__'))
    (tmp_path / 'line_feature_node' / 'core' / '__pycache__').write_text('in the way of the folder')
    for _ in range(2):
        output = run(tmp_path, NUMBA_CACHE_DIR='/proc/none', HOME='/proc/none', XDG_CACHE_HOME='/proc/none')
        assert output == '[1, 1, 1, 1, 1, 1, 1, 1, 1] 0'

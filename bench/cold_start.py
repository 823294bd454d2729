"""Time a process from its start to its first segments: without compiled kernels, with them, and with no cache at all.

    python bench/cold_start.py [--runs 5]
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time

PROGRAM = """
import time
start = time.perf_counter()
import numpy as np
import cv2
libraries = time.perf_counter()
from line_feature_node.core import extract
imported = time.perf_counter()
extract(np.zeros((480, 640), np.uint8))
first = time.perf_counter()
extract(np.zeros((480, 640), np.uint8))
print(libraries - start, imported - libraries, first - imported, time.perf_counter() - first)
"""
COLUMNS = ('process', 'numpy, cv2', 'import', 'first frame', 'second frame')


def run(cache: str) -> list[float]:
    """Seconds of the whole process, and of its parts."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, '-c', PROGRAM], env={**os.environ, 'NUMBA_CACHE_DIR': cache},
                          capture_output=True, text=True, check=True)
    return [time.perf_counter() - start, *map(float, done.stdout.split())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=5)
    runs = parser.parse_args().runs
    rows: dict[str, list[list[float]]] = {'no cache yet': [], 'cached': []}
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as cache:
            rows['no cache yet'].append(run(cache))
            rows['cached'].append(run(cache))
    print(f'seconds, medians of {runs} runs')
    print(f'{"":14}' + ''.join(f'{name:>14}' for name in COLUMNS))
    for name, values in rows.items():
        print(f'{name:14}' + ''.join(f'{statistics.median(column):14.3f}' for column in zip(*values, strict=True)))


if __name__ == '__main__':
    main()

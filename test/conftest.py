"""Under colcon the tests are of the package that it installed, not of the sources they are started in.

Tests of the node keep apart from each other, and from every other ROS 2 on the machine and in the network: each process
that runs tests has a domain of its own.
"""

import os
import sys
import tempfile
import zlib
from pathlib import Path

if 'COLCON' in os.environ:
    ROOT = Path(__file__).resolve().parents[1]
    sys.path[:] = [entry for entry in sys.path if Path(entry).resolve() != ROOT]


def _domain() -> int:
    """From 1 to 101, the same for no two workers of one run; runs at the same time hardly ever meet."""
    run = os.environ.get('PYTEST_XDIST_TESTRUNUID') or str(os.getpid())
    worker = os.environ.get('PYTEST_XDIST_WORKER', 'gw0')
    return 1 + (zlib.crc32(run.encode()) + int(worker.removeprefix('gw'))) % 101


# Before rclpy is imported.
os.environ.update(
    ROS_DOMAIN_ID=str(_domain()), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
    ROS_LOG_DIR=str(Path(tempfile.gettempdir()) / f'line_feature_node-test-{os.getuid()}'),
    RCUTILS_CONSOLE_OUTPUT_FORMAT='[{severity}] [{name}]: {message}')

"""Under colcon the tests are of the package that it installed, not of the sources they are started in.

Tests of the node keep apart from each other, and from every other ROS 2 on the machine and in the network: each process
that runs tests has a domain of its own.
"""

import fcntl
import os
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

if 'COLCON' in os.environ:
    ROOT = Path(__file__).resolve().parents[1]
    sys.path[:] = [entry for entry in sys.path if Path(entry).resolve() != ROOT]

FOLDER = Path(tempfile.gettempdir()) / f'line_feature_node-test-{os.getuid()}'
FOLDER.mkdir(exist_ok=True)


def _domain():
    """A number from 1 to 101, and a lock that keeps it from other processes while this one lives."""
    for offset in range(101):
        domain = 1 + (os.getpid() + offset) % 101
        lock = os.open(FOLDER / f'domain-{domain}', os.O_CREAT | os.O_RDWR)
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return domain
        os.close(lock)
    raise RuntimeError('no domain of ROS 2 is free for the tests')


# Before rclpy is imported.
os.environ.update(
    ROS_DOMAIN_ID=str(_domain()), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST', ROS_LOG_DIR=str(FOLDER / 'log'),
    RCUTILS_CONSOLE_OUTPUT_FORMAT='[{severity}] [{name}]: {message}')

"""Under colcon the tests are of the package that it installed, not of the sources they are started in.

Tests of the node keep apart from each other, and from every other ROS 2 on the machine and in the network: each process
that runs tests has a domain of its own.
"""

import fcntl
import os
import sys
import tempfile
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

if 'COLCON' in os.environ:
    ROOT = Path(__file__).resolve().parents[1]
    sys.path[:] = [entry for entry in sys.path if Path(entry).resolve() != ROOT]

#: They need ROS 2.
ROS_TESTS = [
    'test_demo.py', 'test_faults.py', 'test_node.py', 'test_node_parameters.py', 'test_node_process.py', 'test_soak.py',
]
collect_ignore = [] if find_spec('rclpy') else ROS_TESTS


def pytest_report_header():
    return f'ROS 2 is not there: {", ".join(collect_ignore)} are left out' if collect_ignore else ''


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


@pytest.fixture
def bench(capfd):
    """A context of ROS 2 of the test's own, with nodes to talk to the one under test."""
    from test_node import Bench

    bench = Bench(capfd)
    yield bench
    bench.close()


@pytest.fixture
def start(bench, tmp_path):
    """Starts a node as a process and waits until it says that it is ready."""
    from test_node_process import START, Process

    processes = []

    def start(*arguments, word='ready; waits', **options):
        process = Process(tmp_path, *arguments, **options)
        processes.append(process)
        bench.until(lambda: word in process.log or process.process.poll() is not None, f'{word!r}', START)
        assert word in process.log, process.log
        return process

    yield start
    for process in processes:
        process.process.kill()
        process.process.wait()


@pytest.fixture
def distributed(monkeypatch):
    """The library Dask; its clients do not wait as long for a scheduler that is not there, and end with the test."""
    distributed = pytest.importorskip('distributed')
    clients = []

    def client(address, timeout):
        clients.append(make(address, timeout='1s' if address.endswith(':9') else '3s'))
        return clients[-1]

    make = distributed.Client
    monkeypatch.setattr(distributed, 'Client', client)
    yield distributed
    for client in clients:
        client.close(timeout=1)


@pytest.fixture
def fleet(distributed, tmp_path_factory):
    """Makes Dask clusters of so many worker processes."""
    from test_workers import Fleet

    fleets = []

    def fleet(count, **environment):
        fleets.append(Fleet(distributed.Client, tmp_path_factory.mktemp('fleet'), count, **environment))
        return fleets[-1]

    yield fleet
    for one in fleets:
        one.close()

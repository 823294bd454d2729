import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from line_feature_node import __main__


@pytest.fixture(autouse=True)
def handlers():
    """Those of this process are put back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def started(monkeypatch, run, *arguments):
    """What main ends with, where the node is replaced."""
    monkeypatch.setattr(sys, 'argv', ['line_feature_node', *arguments])
    monkeypatch.setitem(sys.modules, 'line_feature_node.node', SimpleNamespace(run=run))
    with pytest.raises(SystemExit) as end:
        __main__.main()
    return end.value.code


@pytest.mark.parametrize('status', [0, 2])
def test_status_is_that_of_the_node(monkeypatch, status):
    assert started(monkeypatch, lambda *_: status) == status


def test_node_gets_the_command_line_with_its_name(monkeypatch):
    calls = []
    started(monkeypatch, lambda arguments, _: calls.append(arguments) or 0, '--ros-args', '-p', 'n:=9')
    assert calls == [['line_feature_node', '--ros-args', '-p', 'n:=9']]


@pytest.mark.parametrize('argument', ['-h', '--help'])
def test_usage_needs_no_ros(monkeypatch, capsys, argument):
    monkeypatch.setattr(sys, 'argv', ['line_feature_node', argument])
    monkeypatch.setitem(sys.modules, 'line_feature_node.node', None)
    __main__.main()
    assert capsys.readouterr().out.startswith('usage: line_feature_node [--ros-args')


def test_where_there_is_no_ros_it_is_said_so_in_one_line():
    """In a process where nothing of ROS can be imported."""
    code = "import sys; sys.modules['rclpy'] = None; from line_feature_node.__main__ import main; main()"
    done = subprocess.run([sys.executable, '-c', code], check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    [line] = done.stderr.splitlines()
    assert line.startswith('the node needs ROS 2, which is not there (')
    assert 'source its setup.bash' in line


IGNORING = """
import signal, sys, types
def run(arguments, ready):
    if {ready}:
        ready()
    try:
        signal.raise_signal({number})
    except BaseException:
        pass
    return 7
sys.modules['line_feature_node.node'] = types.SimpleNamespace(run=run)
from line_feature_node.__main__ import main
main()
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(('ready', 'status'), [(False, 0), (True, 7)])
def test_signal_ends_the_process_until_the_node_is_ready_whatever_is_ignored(number, ready, status):
    """As a library does that calls Python back."""
    code = IGNORING.format(ready=ready, number=int(number))
    assert subprocess.run([sys.executable, '-c', code], check=False, timeout=60).returncode == status

"""Start the node as a process: `ros2 run`, `line_feature_node` and `python -m line_feature_node`."""

import os
import signal
import sys
from typing import Any

USAGE = """usage: line_feature_node [--ros-args [-r image:=TOPIC] [-p NAME:=VALUE] [--params-file FILE]]

Extracts line segments from the images of a ROS 2 topic, by default `image`. The README lists the parameters; while the
node runs, `ros2 param describe` shows each with its range."""


def main() -> None:
    """Run the node, and end with its status: 0 after a signal, however early it comes."""
    stop = _Stop()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    if {'-h', '--help'} & set(sys.argv[1:]):
        print(USAGE)
        return
    try:
        from line_feature_node.node import run
    except ImportError as error:
        sys.exit(f'the node needs ROS 2, which is not there ({error}): source its setup.bash, or install the packages '
                 f"of the extra 'ros' with pip")
    sys.exit(run(sys.argv, stop.release))


class _Stop:
    """Ends the process at a signal until the node can end by itself; importing and compiling take long.

    An exception would be lost in a callback of the compiler, which then fails in its own way, or goes on.
    """

    def __init__(self) -> None:
        self._wanted = True

    def __call__(self, _number: int, _frame: Any) -> None:
        if self._wanted:
            os._exit(0)

    def release(self) -> None:
        """Leave signals to the node from now on."""
        self._wanted = False


if __name__ == '__main__':
    main()

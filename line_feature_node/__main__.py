"""Start the node as a process: `ros2 run`, `line_feature_node` and `python -m line_feature_node`."""

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
    sys.exit(run(sys.argv, stop))


class _Stop:
    """Ends the process at a signal, as importing and compiling take long; is true once there was one.

    That is for the case that what ends it is lost in some library that ignores all exceptions.
    """

    def __init__(self) -> None:
        self._asked = False

    def __bool__(self) -> bool:
        return self._asked

    def __call__(self, _number: int, _frame: Any) -> None:
        self._asked = True
        raise SystemExit(0)


if __name__ == '__main__':
    main()

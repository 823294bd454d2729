"""Start the command `line_features` as a process."""

import importlib
import os
import signal
from typing import Any

from line_feature_node import MOST_PIXELS

#: Status of a process that SIGINT ended, as shells have it.
INTERRUPTED = 130


def main() -> None:
    """Run the command; an interrupt while it is imported, which takes long, ends the process without a word."""
    # OpenCV reads its limit on pictures of any format when it is loaded.
    os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(MOST_PIXELS))
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # else interrupts are ignored, as in the background
        signal.signal(signal.SIGINT, _end)
    cli = importlib.import_module('line_feature_node.cli')
    signal.signal(signal.SIGINT, before)
    cli.app()


def _end(_number: int, _frame: Any) -> None:
    os._exit(INTERRUPTED)

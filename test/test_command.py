import importlib.metadata
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest

from line_feature_node import command

INTERRUPTING = """
import signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == 'numba':
            print('interrupted', flush=True)
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder())
{before}
from line_feature_node.command import main
main()
"""


def interrupted(before):
    """The command as a process that is interrupted while it imports."""
    return subprocess.run([sys.executable, '-c', INTERRUPTING.format(before=before), '--version'], check=False,
                          capture_output=True, text=True, timeout=60)


def test_an_interrupt_during_the_imports_ends_without_a_word():
    # Whoever started the tests in the background had interrupts ignored.
    done = interrupted('signal.signal(signal.SIGINT, signal.default_int_handler)')
    assert (done.returncode, done.stdout, done.stderr) == (130, 'interrupted\n', '')


def test_interrupts_that_are_ignored_stay_so():
    done = interrupted('signal.signal(signal.SIGINT, signal.SIG_IGN)')
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.splitlines() == ['interrupted', importlib.metadata.version('line_feature_node')]


def test_the_command_has_interrupts_as_they_were(monkeypatch, capsys):
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(sys, 'argv', ['line_features', '--version'])
    with pytest.raises(SystemExit) as end:
        command.main()
    assert end.value.code == 0
    assert capsys.readouterr().out.strip() == importlib.metadata.version('line_feature_node')
    assert signal.getsignal(signal.SIGINT) is before


def test_a_picture_of_any_format_has_bounds(tmp_path):
    """A BMP of 1 kB that says it has more pixels than any that is decoded."""
    data = bytearray(cv2.imencode('.bmp', np.zeros((4, 4), np.uint8))[1].tobytes())
    data[18:26] = (30_000).to_bytes(4, 'little') * 2
    (tmp_path / 'large.bmp').write_bytes(data)
    program = 'from line_feature_node.command import main; main()'
    done = subprocess.run([sys.executable, '-c', program, 'image', str(tmp_path / 'large.bmp')], check=False,
                          capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert 'OpenCV cannot decode the image: pixels <= CV_IO_MAX_IMAGE_PIXELS' in done.stderr
    assert len(done.stderr.splitlines()) == 1

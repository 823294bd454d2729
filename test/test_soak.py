"""A minute of bench/soak.py, whose campaign is longer."""

import subprocess
import sys
from pathlib import Path

SOAK = Path(__file__).resolve().parents[1] / 'bench' / 'soak.py'
#: Half of the rate, for machines that are busy. Half a minute is short for all that is loaded once to have been.
SHORT = ['--minutes', '1', '--rate', '30', '--untimed', '--memory', '16']
CHECKED = [
    'own memory, MiB', 'threads', 'descriptors', 'frames by the node', 'answers that came', 'failed',
    'neither received nor dropped', 'parameters', 'status and tracebacks']


def test_a_minute_among_others_that_come_go_and_break():
    """Memory, threads and descriptors do not grow, and every frame is accounted for."""
    done = subprocess.run([sys.executable, str(SOAK), *SHORT], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = {cells[0]: cells for cells in (line.strip('| ').split(' | ') for line in done.stdout.splitlines())}
    assert [rows[name][-1] for name in CHECKED] == ['met'] * len(CHECKED)
    assert all(rows[name][2] for name in CHECKED)

"""Under colcon the tests are of the package that it installed, not of the sources they are started in."""

import os
import sys
from pathlib import Path

if 'COLCON' in os.environ:
    ROOT = Path(__file__).resolve().parents[1]
    sys.path[:] = [entry for entry in sys.path if Path(entry).resolve() != ROOT]

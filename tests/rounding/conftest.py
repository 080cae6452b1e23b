"""The oracles are plain modules beside the tests; make them importable whatever directory pytest was started in."""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

"""The oracles are plain modules beside the tests; make them importable whatever directory pytest was started in."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "oracles"))

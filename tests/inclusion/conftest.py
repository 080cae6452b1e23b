"""The oracles are plain modules beside the tests; make them importable whatever directory pytest was started in."""

import sys
from pathlib import Path

import pytest

from gsisio_jax.interval import rounding

sys.path.append(str(Path(__file__).parents[1] / "oracles"))


@pytest.fixture(autouse=True)
def nearest():
    """What is tested here is that the rules are exact, so rounding is to nearest; tests/rounding is about the other."""
    with rounding.using("nearest"):
        yield

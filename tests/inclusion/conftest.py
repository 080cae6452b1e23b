"""The oracles are plain modules beside the tests; make them importable whatever directory pytest was started in."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from oracles.uncompiled import is_about_xla
from oracles.uncompiled_bounds import bounds_in_numpy

from gsisio_jax.interval import rounding

sys.path.append(str(Path(__file__).parents[1] / "oracles"))


@pytest.fixture(autouse=True)
def nearest():
    """What is tested here is that the rules are exact, so rounding is to nearest; tests/rounding is about the other."""
    with rounding.using("nearest"):
        yield


@pytest.fixture(scope="module", autouse=True)
def in_numpy(request: pytest.FixtureRequest) -> Iterator[None]:
    """Bounds of boxes of numbers without XLA, but in modules that are about what XLA makes of them (`COMPILED`)."""
    if is_about_xla(request):
        yield
    else:
        with bounds_in_numpy():
            yield

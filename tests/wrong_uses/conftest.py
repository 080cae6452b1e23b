"""One small observer, which all tables share; and their common module beside them, whatever the directory."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import gsisio_jax as gx
from gsisio_jax import System
from gsisio_jax.tuning import Records

sys.path.append(str(Path(__file__).parent))

from uses import BOX, NOISE, G, H, Y, f, f_of_u, g


@pytest.fixture(scope="session")
def observer():
    return gx.design_observer(System(f, g, G=G, H=H), NOISE, BOX, missing=False, sweeps=1)


@pytest.fixture(scope="session")
def objects(observer):
    return SimpleNamespace(
        delayed=gx.design_observer(observer.system, NOISE, BOX, missing=False, sweeps=1, delay=1),
        observer=observer,
        system=observer.system,
        with_u=System(f_of_u, g, G=G, H=H, m=1),
        records=Records(BOX, Y),
        carry=gx.start(observer, BOX, Y[0])[0],
        boxes=gx.estimate(observer, BOX, Y),
    )

"""How the unknown input moves, as keys of a configuration."""

import numpy as np
import pytest

from gsisio_jax.cli.config import Config
from gsisio_jax.cli.errors import UserError
from gsisio_jax.cli.problem import build_problem, importable

PLANT = """\
import gsisio_jax as gx

plant = gx.System(f=lambda x: 0.5 * x, g=lambda x: x, G=[[1.0, 0.0], [0.0, 1.0]], H=[[0.0, 0.0], [0.0, 0.0]])
"""


@pytest.fixture
def built(tmp_path):
    (tmp_path / "pushed_plant.py").write_text(PLANT)
    two = {"radius": [0.1, 0.1]}

    def build(**more):
        config = {
            "system": {"use": "pushed_plant:plant", **more},
            "signals": {"input": [{"name": "wind"}, {"name": "slope"}]},
            "noise": {"w": two, "v": two},
            "region": {"lower": [-1.0, -1.0], "upper": [1.0, 1.0]},
            "initial": {"lower": [-1.0, -1.0], "upper": [1.0, 1.0]},
        }
        with importable(tmp_path):
            return build_problem(Config.model_validate(config), "cart.toml").system

    return build


def test_rates_by_name_and_blocks(built):
    system = built(input_rate={"slope": 0.2}, input_constant=5)
    assert np.array_equal(system.input_rate.upper, [np.inf, 0.2])
    assert system.input_constant == 5
    assert built().input_rate is None


def test_what_cannot_be_is_named(built):
    with pytest.raises(UserError, match=r"cart.toml: system.input_rate: there is no input gust; they are: wind, slope"):
        built(input_rate={"gust": 0.2})
    with pytest.raises(UserError, match=r"cart.toml: system: System: `input_rate` must not be negative"):
        built(input_rate={"wind": -0.2})

"""Programs that run once are compiled with options that suit what XLA_FLAGS make of loops."""

import jax
import jax.numpy as jnp

from gsisio_jax.scalar.options import extended
from gsisio_jax.tuning import compiled


def test_no_option_makes_a_loop_explode_that_is_one_function(monkeypatch):
    """Without its emitters XLA needs more than 14 GB for the step of the flight there."""
    asked = []

    def jit(function, compiler_options, **options):
        asked.append(compiler_options)
        return function

    monkeypatch.setattr(jax, "jit", jit)
    for flags in ("", extended("")):
        monkeypatch.setenv("XLA_FLAGS", flags)
        assert compiled.quickly(lambda x: 2 * x)(jnp.float64(2.0)) == 4
    assert asked == [compiled.TASKS, compiled.FUNCTION]
    assert "xla_cpu_use_fusion_emitters" not in compiled.FUNCTION

"""Runs over four devices of one machine, against the same on one: started by `test_devices.py`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

import gsisio_jax as gx
from gsisio_jax.tuning import fold

COUNT = 8


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    system = gx.System(lambda x: 0.9 * x + 0.02 * jnp.sin(x), lambda x: x, G=np.zeros((1, 0)), H=np.zeros((1, 0)))
    bounds = gx.Noise(gx.Interval.symmetric([0.01]), gx.Interval.symmetric([0.1]))
    observer = gx.design_observer(system, bounds, gx.Interval.symmetric([3.0]), bounds=["affine"])
    boxes = gx.Interval(-np.ones((COUNT, 1)), np.linspace(1, 2, COUNT)[:, None])
    y, radius = jnp.full((3, 1), 0.5), jnp.array([0.1])
    mesh = Mesh(np.array(jax.devices()), ("cases",))
    assert mesh.size == 4

    def noise(radius: Any) -> gx.Noise:
        return gx.Noise(bounds.w, gx.Interval(-radius, radius))

    def estimate(radius: Any, box: gx.Interval) -> Any:
        return gx.estimate(observer, box, y, noise=noise(radius)).state.width

    def steps(radius: Any, box: gx.Interval) -> Any:
        carry, _ = gx.start(observer, box, y[0], noise=noise(radius))
        return gx.step(observer, carry, y[1], noise=noise(radius))[1].state.width

    def folded(radius: Any, box: gx.Interval) -> Any:
        return fold(observer, box, y, lambda s, out, k: s + out.state.width, jnp.zeros(1), noise=noise(radius))

    def cases(run: Callable[..., Any]) -> Callable[..., Any]:
        return jax.vmap(run, (None, 0))

    def shared(function: Callable[..., Any], out: Any, **options: Any) -> Callable[..., Any]:
        return jax.shard_map(function, mesh=mesh, in_specs=(P(), P("cases")), out_specs=out, **options)

    expected_of = {run: np.asarray(jax.jit(cases(run))(radius, boxes)) for run in (estimate, steps, folded)}
    for run, expected in expected_of.items():
        found = jax.jit(shared(cases(run), P("cases")))(radius, boxes)
        assert len(found.addressable_shards) == 4
        np.testing.assert_allclose(found, expected, rtol=1e-12, err_msg=run.__name__)

    def slope(through: Callable[..., Any]) -> Any:
        return jax.jit(jax.grad(lambda radius: through(radius, boxes)[:, -1].sum()))(radius)

    expected = slope(cases(estimate))
    assert expected > 1
    np.testing.assert_allclose(slope(shared(cases(estimate), P("cases"))), expected, rtol=1e-12)

    def inside(radius: Any, boxes: gx.Interval) -> Any:
        """The noise is one for all devices, so its gradient is summed over them."""
        return jax.grad(lambda radius: cases(estimate)(radius, boxes)[:, -1].sum())(radius)

    np.testing.assert_allclose(jax.jit(shared(inside, P()))(radius, boxes), expected, rtol=1e-12)

    explicit = jax.make_mesh((4,), ("cases",), axis_types=(AxisType.Explicit,))
    with jax.set_mesh(explicit):
        spread = jax.device_put(boxes, NamedSharding(explicit, P("cases")))
        for run in (estimate, steps):
            found = jax.jit(cases(run))(radius, spread)
            assert len({str(shard.index) for shard in found.addressable_shards}) == 4
            np.testing.assert_allclose(found, expected_of[run], rtol=1e-12, err_msg=run.__name__)
        found = jax.jit(jax.grad(lambda radius: cases(estimate)(radius, spread)[:, -1].sum()))(radius)
        np.testing.assert_allclose(found, expected, rtol=1e-12)


if __name__ == "__main__":
    main()

"""Functions that JAX cannot follow, or that are none."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from uses import BOX, KEY, ROWS, G, Gain, H, assigns, check_refused, g, plant, table

import gsisio_jax as gx
from gsisio_jax import Interval, System, inclusion

MAPS = {
    "if": (plant(lambda x: x if x[0] > 0 else -x), "System: calling f", "jnp.where"),
    "max": (plant(lambda x: [max(x[0], 0), x[1]]), "System: calling f", "jnp.minimum"),
    "np.sin": (plant(lambda x: np.sin(x)), "System: calling f", "jnp.sin, not np.sin"),
    "np in g": (plant(g=lambda x: np.cos(x[:1])), "System: calling g", "jnp.sin, not np.sin"),
    "math": (plant(lambda x: [math.sin(x[0]), x[1]]), "System: calling f", "jnp.sin, not math.sin"),
    "range": (
        plant(lambda x: [sum(x[1] for _ in range(x[0])), x[1]]),
        "System: calling f",
        "number of turns",
        "jnp.where",
    ),
    "text of x": (plant(lambda x: [float(f"{x[0]:.2f}"), x[1]]), "System: calling f", "jax.debug.print"),
    "float": (plant(lambda x: [float(x[0]), x[1]]), "System: calling f", "float(x)"),
    "item": (plant(lambda x: x * x[0].item()), "System: calling f", "x.item()"),
    "index of x": (plant(lambda x: [(1.0, 2.0)[x[0].astype(int)], x[1]]), "System: calling f", "jnp.take"),
    "boolean index": (plant(lambda x: x[x > 0]), "System: calling f", "jnp.where"),
    "assignment": (plant(assigns), "System: calling f", "x.at[0].set(value)"),
    "matrix too large": (plant(lambda x: jnp.eye(3) @ x), "System: calling f", "one entry per row of G"),
    "unpacked": (plant(lambda x: [a for a, b, c in [x]]), "System: calling f", "one entry per row of G"),
    "index beyond": (plant(lambda x: jnp.stack([x[0], x[2]])), "System: f reads index 2", "(2,)", "row of G"),
    "index before": (plant(lambda x: jnp.stack([x[0], x[-3]])), "System: f reads index -3", "(2,)"),
    "index in jit": (plant(jax.jit(lambda x: jnp.stack([x[0], x[5]]))), "System: f reads index 5", "(2,)"),
    "indices beyond": (plant(lambda x: x[np.array([0, 7])]), "System: f reads index 7", "(2,)", "row of G"),
    "indices before": (plant(lambda x: x[jnp.array([-3, 1])]), "System: f reads index -3", "(2,)"),
    "indices in jit": (plant(jax.jit(lambda x: x[np.array([0, 7])])), "System: f reads index 7", "(2,)"),
    "indices in vmap": (
        plant(lambda x: jax.vmap(lambda i: x[i])(jnp.array([0, 5]))),
        "System: f reads index 5",
        "(2,)",
    ),
    "taken beyond": (plant(lambda x: x * jnp.take(x, 7)), "System: f reads index 7", "(2,)"),
    "of a table": (plant(lambda x: x * jnp.arange(5.0)[jnp.array([9, 1])]), "System: f reads index 9", "(5,)"),
    "of a matrix": (
        plant(lambda x: jnp.outer(x, x)[np.array([0, 1]), np.array([0, 2])]),
        "System: f reads index 2",
        "(2, 2)",
    ),
    "along an axis": (plant(lambda x: jnp.take_along_axis(x, np.array([0, 3]), 0)), "System: f reads index 3", "(2,)"),
    "by a call": (plant(lambda x: x * jax.lax.dynamic_index_in_dim(x, 4, 0, False)), "System: f reads index 4", "(2,)"),
    "set beyond": (plant(lambda x: x.at[7].set(1.0)), "System: f reads index 7", "(2,)"),
    "added beyond": (plant(lambda x: x.at[np.array([0, 7])].add(1.0)), "System: f reads index 7", "(2,)"),
    "u beyond": (plant(lambda x, u: x + u[1], m=1), "System: f reads index 1", "(1,)", "per known input"),
    "g beyond": (plant(g=lambda x: x[2]), "System: g reads index 2", "(2,)"),
    "key around": (
        plant(lambda x: x + jax.random.normal(KEY, (2,))),
        "System: f draws random numbers",
        "Noise",
        "simulate",
    ),
    "key inside": (plant(lambda x: x + jax.random.uniform(jax.random.key(1))), "System: f draws random numbers"),
    "old key": (plant(lambda x: x + jax.random.uniform(jax.random.PRNGKey(1))), "System: f draws random numbers"),
    "np.random": (plant(lambda x: x + np.random.normal(size=2)), "System: f is another function every time", "w and v"),
    "random number": (plant(lambda x: x * float(np.random.normal())), "System: f is another function every time"),
    "nothing": (plant(lambda x: None), "System: f must return", "(2,)", "nothing (None)"),
    "a class": (plant(Gain), "System: f must return", "(2,)", "Gain"),
    "a dictionary": (plant(lambda x: {"x": x}), "System: f must return", "(2,)", "dict"),
    "complex": (plant(lambda x: x * 1j), "System: f must return real numbers", "complex"),
    "bounds of if": (lambda o: inclusion.affine(lambda x: x if x[0] > 0 else -x)(BOX), "inclusion", "jnp.where"),
    "bounds of np": (lambda o: inclusion.natural(np.sin)(BOX), "inclusion", "jnp.sin, not np.sin"),
    **{
        f"bounds beyond, {method.__name__}": (
            lambda o, method=method: method(lambda x: jnp.stack([x[0], x[5]]))(BOX),
            "inclusion: the function reads index 5",
            "the box has shape (2,)",
        )
        for method in (inclusion.natural, inclusion.affine, inclusion.jacobian, inclusion.mean_value)
    },
    "bounds of a batch beyond": (
        lambda o: inclusion.batched(inclusion.natural(lambda x: x[np.array([0, 2])]))(Interval(ROWS, ROWS)),
        "inclusion: the function reads index 2",
        "(2,)",
    ),
    "bounds of a key": (
        lambda o: inclusion.natural(lambda x: x + jax.random.normal(KEY, (2,)))(BOX),
        "inclusion: the function draws random numbers",
        "a further argument, a box",
    ),
    "bounds of nothing": (lambda o: inclusion.affine(lambda x: None)(BOX), "inclusion", "nothing (None)", "an array"),
    "bounds of complex": (lambda o: inclusion.natural(lambda x: 1j * x)(BOX), "inclusion", "real", "complex", "imag"),
    "discretized beyond": (
        lambda o: gx.discretize(lambda x: jnp.stack([x[0], x[4]]), 0.1, region=BOX),
        "discretize: f reads index 4",
    ),
    "discretized key": (
        lambda o: gx.discretize(lambda x: x + jax.random.normal(KEY, (2,)), 0.1, region=BOX),
        "discretize: f draws random numbers",
    ),
    "discretized part": (lambda o: gx.discretize(lambda x: x[:1], 0.1, region=BOX), "discretize: f", "(2,)", "(1,)"),
}


@table(MAPS)
def test_a_map_that_is_none(objects, use, words):
    check_refused(use, objects, words)


def test_an_equinox_module_is_a_map(observer):
    """Its arrays are watched as every number that a map reads, and nothing warns of them."""
    system = System(Gain(jnp.array([0.5, 0.5])), g, G=G, H=H)
    assert hash(system.f) == hash(System(system.f.__wrapped__, g, G=G, H=H).f)
    assert inclusion.affine(system.dynamics)(BOX, np.zeros(0)).slope.tolist() == [[0.5, 0.0], [0.0, 0.5]]
    partial = System(jax.tree_util.Partial(lambda a, x: a * x, jnp.ones(2)), g, G=G, H=H)
    assert hash(partial.f)


def test_indices_inside_are_taken():
    """Slices may end beyond, negative indices count from the end, and computed ones are the user's own affair."""
    assert plant(lambda x: jnp.stack([x[-2], x[-1]]))(None).n == 2
    assert plant(lambda x: x[0:7])(None).n == 2
    assert plant(lambda x: jnp.roll(x, 1))(None).n == 2
    assert plant(lambda x: x[jnp.array([1, 0])])(None).n == 2
    assert plant(lambda x: x[np.array([1, -1])])(None).n == 2
    assert plant(lambda x: x.at[np.array([1, -2])].add(1.0))(None).n == 2
    for asked in ("clip", "wrap"):
        assert plant(lambda x, mode=asked: jnp.take(x, np.array([0, 7]), mode=mode))(None).n == 2
    assert plant(lambda x: jnp.take(x, np.array([0, 7]), mode="fill", fill_value=0.0))(None).n == 2

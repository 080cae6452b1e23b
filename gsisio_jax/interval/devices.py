"""What a type says besides shape and dtype where arrays lie on several devices; on one it says nothing.

Inside `jax.shard_map` an array varies along axes of the mesh, or is the same on all devices along them: operands of one
operation must agree. On a mesh with explicit axes (`jax.set_mesh`) it says along which of them every dimension lies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.sharding import AxisType, NamedSharding, PartitionSpec


def is_meshed(aval: Any) -> bool:
    """The type says something about a mesh."""
    sharding = getattr(aval, "sharding", None)
    return sharding is not None and not sharding.mesh.empty


def varying(aval: Any) -> frozenset[Any]:
    """Axes of the mesh along which the value may differ from device to device."""
    kind = getattr(aval, "manual_axis_type", None)  # before JAX 0.10 it was `vma`
    return getattr(aval, "vma", frozenset()) if kind is None else kind.varying


def agreeing(values: Sequence[Any]) -> Sequence[Any]:
    """The values, all varying along the axes along which one of them does; what is known on each device is the same.

    On a mesh with explicit axes all say that they lie on it: the carry of a `jax.lax.scan` that JAX maps has to. The
    derivative of that is a sum over the devices, so it belongs in front of a loop, not into it.
    """
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty:
        return values
    if AxisType.Explicit in mesh.axis_types:
        values = [value if is_meshed(jax.typeof(value)) else _placed(value) for value in values]
    return cast(values, union(values))


def union(values: Sequence[Any]) -> frozenset[Any]:
    """Axes along which any of the values varies."""
    return frozenset().union(*(varying(jax.typeof(value)) for value in values))


def cast(values: Sequence[Any], axes: frozenset[Any]) -> list[Any]:
    """The values, varying along these axes, too."""
    return [_varied(value, axes - varying(jax.typeof(value))) for value in values]


def stack(values: Sequence[Any], axis: int = 0) -> Any:
    """`jnp.stack`, which JAX 0.10 cannot map over an explicit axis of a mesh where only some of the values have it."""
    if jax.sharding.get_abstract_mesh().empty:
        return jnp.stack(values, axis)
    return jnp.concatenate([jnp.expand_dims(value, axis) for value in values], axis)


def spread(value: Any, size: int, aval: Any, axis: int) -> Any:
    """The value repeated along a new first axis, which lies on the mesh as an axis of a value of that type does."""
    own = jax.typeof(value)
    spec = own.sharding.spec if is_meshed(own) else (None,) * own.ndim
    sharding = NamedSharding(aval.sharding.mesh, PartitionSpec(aval.sharding.spec[axis], *spec))
    return jax.lax.broadcast_in_dim(value, (size, *own.shape), range(1, 1 + own.ndim), out_sharding=sharding)


def _placed(value: Any) -> Any:
    return jax.sharding.reshard(value, PartitionSpec())


def _varied(value: Any, axes: frozenset[Any]) -> Any:
    if not axes:
        return value
    names = tuple(sorted(axes, key=str))
    if hasattr(jax.lax, "pcast"):
        return jax.lax.pcast(value, names, to="varying")
    return getattr(jax.lax, "pvary")(value, names)  # noqa: B009 - its name in JAX 0.8


def scan(body: Callable[..., Any], carry: Any, xs: Any, length: int | None = None) -> tuple[Any, Any]:
    """`jax.lax.scan`, whose carry may vary along more axes of the mesh behind a turn than before the first."""
    length = given(length)
    if jax.sharding.get_abstract_mesh().empty:
        return jax.lax.scan(body, carry, xs, length=length)
    leaves, structure = jax.tree.flatten(carry)
    leaves = agreeing(leaves)
    row = jax.tree.map(lambda x: jax.lax.index_in_dim(x, 0, keepdims=False), xs)
    after = jax.make_jaxpr(lambda *args: jax.tree.leaves(body(*args)[0]))(
        jax.tree.unflatten(structure, leaves), row
    ).out_avals
    axes = union(leaves).union(*map(varying, after))

    def turn(carry: Any, row: Any) -> tuple[Any, Any]:
        carry, out = body(carry, row)
        return jax.tree.unflatten(structure, cast(jax.tree.leaves(carry), axes)), out

    return jax.lax.scan(turn, jax.tree.unflatten(structure, cast(leaves, axes)), xs, length=length)


def given(length: Any) -> int | None:
    """A number of turns for `jax.lax.scan`, which finds it in the rows where it is a symbol (`jax.export`)."""
    return length if isinstance(length, int) else None


def merged(avals: Sequence[Any], shape: tuple[int, ...], dtype: Any, places: Sequence[Sequence[int | None]]) -> Any:
    """The type of a result of operands with such types.

    Args:
        avals: of the operands.
        shape: of the result.
        dtype: of the result.
        places: for every operand, which of its dimensions each dimension of the result is; None where none.
    """
    meshed = [(aval, place) for aval, place in zip(avals, places, strict=True) if is_meshed(aval)]
    if not meshed:
        return ShapedArray(shape, dtype)
    spec = []
    for dimension in range(len(shape)):
        found = (aval.sharding.spec[place[dimension]] for aval, place in meshed if place[dimension] is not None)
        spec.append(next((name for name in found if name is not None), None))
    like = max((aval for aval, _ in meshed), key=lambda aval: len(varying(aval)))
    sharding = NamedSharding(like.sharding.mesh, PartitionSpec(*spec))
    return like.update(shape=shape, dtype=dtype, weak_type=False, sharding=sharding)

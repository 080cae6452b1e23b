"""What an equation was made from: the graph of a jaxpr, looked at from its results."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.extend.core as jex
import numpy as np

from gsisio_jax.inclusion.node import Node

_KEEPS = ("stop_gradient", "copy", "optimization_barrier")
MOST_TERMS = 64  # of a sum that is known as a whole
_JAX = os.path.join(os.path.dirname(jax.__file__), "")  # with a separator: other packages may begin with its name


def library_function(jaxpr: Any) -> str:
    """The name of the function of JAX's own libraries whose body this is, or nothing."""
    name, _, source = (getattr(jaxpr.debug_info, "func_src_info", None) or "").partition(" at ")
    return name if source.startswith(_JAX) else ""


@dataclass
class Match:
    """An equation that stands for a known function of other variables."""

    rule: Callable[..., Node | None]
    operands: Sequence[Any]


class Makers:
    """Which equation made a variable."""

    def __init__(self, jaxpr: Any):
        self.maker = {id(out): eqn for eqn in jaxpr.eqns for out in eqn.outvars}

    def made(self, atom: Any, *names: str) -> Any:
        """The equation that made it, if it is one of these."""
        eqn = None if isinstance(atom, jex.Literal) else self.maker.get(id(atom))
        return eqn if eqn is not None and eqn.primitive.name in names else None

    def plain(self, atom: Any) -> Any:
        """The variable behind operations that change no number."""
        while (eqn := self.made(atom, *_KEEPS)) is not None and len(eqn.outvars) == 1:
            atom = eqn.invars[0]
        return atom

    def resized(self, atom: Any) -> Any:
        """The variable behind operations that change neither numbers nor how many there are."""
        while (eqn := self.made(atom, "broadcast_in_dim", "reshape", "squeeze", "expand_dims", *_KEEPS)) is not None:
            if len(eqn.outvars) != 1 or math.prod(eqn.invars[0].aval.shape) != math.prod(atom.aval.shape):
                break
            atom = eqn.invars[0]
        return atom

    def common(self, atom: Any, axes: Sequence[int], shape: tuple[int, ...]) -> Any:
        """The variable behind a broadcast along these axes, without them; None where it is none.

        A scalar operand counts as broadcast along all axes.
        """
        atom = self.plain(atom)
        rest = tuple(n for axis, n in enumerate(shape) if axis not in axes)
        kept = tuple(1 if axis in axes else n for axis, n in enumerate(shape))
        if atom.aval.shape == () and rest == ():
            return atom
        chain: list[Any] = []
        while (eqn := self.made(atom, "broadcast_in_dim", "reshape", "squeeze", "expand_dims", *_KEEPS)) is not None:
            chain.append(eqn)
            atom = eqn.invars[0]
            if atom.aval.shape == rest and _places(chain, rest, kept, shape):
                return self.plain(atom)
        return self.plain(atom) if atom.aval.shape == kept and _places(chain, rest, kept, shape) else None

    def same(self, a: Any, b: Any, depth: int = 4) -> bool:
        """Do they hold the same numbers: one variable, or two that were made alike (``x[0]`` twice)?"""
        if isinstance(a, jex.Literal) or isinstance(b, jex.Literal):
            return isinstance(a, jex.Literal) and isinstance(b, jex.Literal) and bool(np.array_equal(a.val, b.val))
        a, b = self.plain(a), self.plain(b)
        if a is b:
            return True
        first, second = self.maker.get(id(a)), self.maker.get(id(b))
        if depth == 0 or first is None or second is None or first.primitive is not second.primitive:
            return False
        if len(first.outvars) != 1 or len(first.invars) != len(second.invars) or "jaxpr" in first.params:
            return False
        alike = str(first.params) == str(second.params)
        return alike and all(self.same(p, q, depth - 1) for p, q in zip(first.invars, second.invars, strict=True))


def _places(chain: Sequence[Any], rest: tuple[int, ...], kept: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Does this chain, from the last equation to the first, bring the entries of an array of shape `rest` (or `kept`)
    to their places along the other axes? Of a square matrix sums of rows and of columns have the same shape."""
    first: Any = chain[-1].invars[0].aval if chain else None
    places = np.arange(math.prod(rest)).reshape(kept)
    moved = places if first is None else places.reshape(first.shape)
    for eqn in reversed(chain):
        out = eqn.outvars[0].aval.shape
        if eqn.primitive.name == "broadcast_in_dim":
            spread = np.ones(len(out), int)
            spread[list(eqn.params["broadcast_dimensions"])] = moved.shape
            moved = np.broadcast_to(moved.reshape(spread), out)
        else:
            moved = moved.reshape(out)
    if moved.ndim != len(shape):
        return False
    return bool((np.broadcast_to(moved, shape) == np.broadcast_to(places, shape)).all())

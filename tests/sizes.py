"""How large one step of a test system is: equations and operations of its scalar program, stage by stage.

Nothing is compiled. A stage is the outermost `jax.named_scope` of `gsisio_jax.observer.step.advance`.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import systems

from gsisio_jax.observer.fixed import Fixed
from gsisio_jax.observer.step import advance, blank
from gsisio_jax.scalar import ScalarProgram, scalar_program
from gsisio_jax.scalar.derivative import cotangent_program, reached

SYSTEMS = ("s1", "s5", "s7")
VARIANTS = ("outward", "nearest", "with gradient")
BUDGET = Path(__file__).resolve().parent / "budget.json"
Budget = dict[str, dict[str, int]]
# Of these nothing is left in the compiled program; and how many fences there are depends on the options of XLA.
_NOT_COUNTED = ("wave", "falling_wave", "stop_gradient", "fusion_barrier")


class Step:
    """One step of a test system, its gain a constant: default sweeps, no variants for missing rows."""

    def __init__(self, name: str):
        case = replace(getattr(systems, name)(), sweeps=3)
        self._observer = case.design(missing=False)
        self._args = first_arguments(self._observer, case)

    def program(self, variant: str) -> ScalarProgram:
        """The step over single numbers; "with gradient" is "outward"."""
        return step_program(self._observer.with_rounding("nearest" if variant == "nearest" else "outward"), self._args)

    def operations(self, variant: str) -> Counter[str]:
        """Scalar operations of every stage."""
        return self.program(variant).count(stages=True)

    def equations(self, variant: str) -> Counter[str]:
        """Equations of every stage in the jaxpr of the step, or in that of its gradient: of the widths of its box by
        the noise bounds, old and new ones. A gradient computes again what it needs of the step; in a scan the step
        comes on top."""
        program = self.program(variant)
        if variant == "with gradient":
            carry, _, _, _ = self._args
            none = jax.tree.map(lambda leaf: jnp.zeros_like(leaf, bool), self._args)
            every = jax.tree.map(lambda leaf: jnp.ones_like(leaf, bool), carry.noise)
            moving = tuple(map(bool, _entries((replace(none[0], noise=every), *none[1:3], every))))
            box = 2 * carry.state.lower.size
            wanted = tuple(r and i < box for i, r in enumerate(reached(program, moving)))
            back = cotangent_program(program, moving, wanted)
            return _equations(jax.make_jaxpr(back)([jnp.zeros((), v.dtype) for v in back.inputs]).jaxpr, "")
        return _equations(jax.make_jaxpr(program)(_entries(self._args)).jaxpr, "")


def first_arguments(observer: Any, case: systems.Case) -> tuple[Any, Any, Any, Any]:
    """What a first step of a test system takes: carry, y, u, noise."""
    box, noise = (jax.tree.map(jnp.asarray, x) for x in (case.initial, case.noise))
    return blank(observer, box), jnp.zeros(case.system.l), jnp.asarray(case.u(1)[0]), noise


def step_program(observer: Any, args: Any) -> ScalarProgram:
    """One step over single numbers, its gain a constant."""
    fixed = Fixed(observer).value
    return scalar_program(jax.make_jaxpr(lambda *args: advance(fixed, *args))(*args))


def counts() -> Budget:
    """Equations of all programs, by program and stage."""
    steps = {name: Step(name) for name in SYSTEMS}
    return {
        key(name, variant): dict(sorted(step.equations(variant).items()))
        for name, step in steps.items()
        for variant in VARIANTS
    }


def key(name: str, variant: str) -> str:
    return f"{name} {variant}"


def recorded() -> Budget:
    return json.loads(BUDGET.read_text())


def _entries(args: Any) -> list[Any]:
    return [entry for leaf in jax.tree.leaves(args) for entry in leaf.ravel()]


def _equations(jaxpr: Any, outer: str) -> Counter[str]:
    """Equations by stage, those of functions that are called included."""
    found: Counter[str] = Counter()
    for eqn in jaxpr.eqns:
        scope = f"{outer}/{eqn.source_info.name_stack}"
        inner = [v for v in eqn.params.values() if hasattr(v, "jaxpr") or hasattr(v, "eqns")]
        for part in inner:
            found += _equations(getattr(part, "jaxpr", part), scope)
        if not inner and eqn.primitive.name not in _NOT_COUNTED:
            named = re.search(r"\b(known|predict|initial|sweeps|certified|inputs|restart|finish)\b", scope)
            found[named.group() if named else "other"] += 1
    return found

"""Rows of a Monte Carlo run: the plant itself, simulated in the same compiled scan that estimates it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.files.program import lines
from gsisio_jax.interval.box import Interval
from gsisio_jax.observer import scan
from gsisio_jax.observer.tolerant import TolerantObserver
from gsisio_jax.study import certain, containment
from gsisio_jax.study.containment import BROKEN
from gsisio_jax.study.reduction_base import Variable
from gsisio_jax.study.row_source import Row, Rows


@dataclass(frozen=True)
class Simulated(Rows):
    """Simulated runs.

    Attributes:
        length: T.
        impl: of the key.
        d: ``d(key, k, x)`` -> (p,), or None: no input, or the array ``d`` of the case.
        draw: "uniform", "vertices", or ``draw(key, k, x, noise)`` -> (w, v).
        x0: ``x0(key)`` -> (n,), or None: the array or box ``x0`` of the case.
        on_miss: "raise" or "record".
        strict: noise is to lie in its bounds for certain (`study.certain`), wherever these leave room for rounding.
    """

    length: int
    impl: str
    d: Callable[..., Any] | None
    draw: str | Callable[..., Any]
    x0: Callable[..., Any] | None
    on_miss: str = field(compare=False)  # the program is the same
    strict: bool = False

    def steps(self, case: Any) -> int:
        return self.length

    def first(self, observer: Any, case: Any) -> tuple[Row, Any]:
        system, dtype = observer.system, case["steady"].dtype
        key = jax.random.fold_in(jax.random.wrap_key_data(case["key"], impl=self.impl), case["run"])
        key, key_x = jax.random.split(key)
        if self.x0 is not None:
            x = jnp.asarray(self.x0(key_x), dtype)
        elif isinstance(case["x0"], Interval):
            x = _inside(key_x, case["x0"], self.draw == "vertices")
        else:
            x = case["x0"]
        start = jnp.where(case["initial"].contains(x).all(), 0, 1)
        zero = jnp.zeros(system.p, dtype)
        row, plant, outside = self._measure(observer, case, key, jnp.int32(0), x, zero, _row(case, 0), self.strict)
        return row, (key, plant, _first_break(jnp.full(2, -1, jnp.int32), 0, start | outside, row), row.exact)

    def given(self, case: Any) -> Any:
        noise = jax.tree.map(lambda a: a[1:], scan.noise_rows(case["noise"]))
        d = None if case["d"] is None else case["d"][1:]
        return case["u"][1:], noise, d

    def following(self, observer: Any, case: Any, carried: Any, k: Any, given: Any) -> tuple[Row, Any]:
        key, (x, d, u, w, w_bounds), broken, exact = carried
        system = observer.system
        x, within = certain.next_state(system, x, d, u, w, w_bounds, self.strict)
        left = jnp.where(system.state_bounds.contains(x).all(), 0, 2)
        row, plant, outside = self._measure(observer, case, key, k, x, d, given, exact & within)
        return row, (key, plant, _first_break(broken, k, outside | left, row), row.exact)

    def results(self, carried: Any) -> dict[str, Any]:
        _, (x, *_), (at, what), _ = carried
        return {"broken_at": jnp.where(at < 0, jnp.nan, at).astype(x.dtype), "broken": jnp.maximum(what, 0)}

    def describe(self) -> dict[str, Variable]:
        return {
            "broken_at": Variable((), "first step at which the simulation left the bounds that the boxes rely on"),
            "broken": Variable((), "what it left there, a bit mask: " + "; ".join(BROKEN)),
        }

    def check(self, job: Any, cases: np.ndarray, results: dict[str, np.ndarray]) -> None:
        if self.on_miss == "raise":
            containment.check(job, cases, results)

    def identity(self, observer: Any) -> tuple[str, list[Any]]:
        key, k, x = jax.random.key(0, impl=self.impl), jnp.int32(0), jnp.zeros(observer.system.n)
        given = (self.x0, (key,)), (self.d, (key, k, x)), (self.draw, (key, k, x, observer.noise))
        text = [f"Simulated {self.length} {self.impl} {self.strict}"]
        for function, arguments in given:
            if callable(function):
                text += lines(jax.make_jaxpr(function)(*arguments))
            else:
                text.append(str(function))
        return "\n".join(text), []

    def _measure(self, observer: Any, case: Any, key: Any, k: Any, x: Any, before: Any, given: Any, exact: Any) -> Any:
        """Row k; what moves the plant on to x[k+1]: x, d, u, w and its bounds; and what is outside of its bounds.
        `exact`: all noise before was within them for certain."""
        system, (u, now, d) = observer.system, given
        noise = scan.noise_of_row(case["noise"], now)
        key_d, key_noise = jax.random.split(jax.random.fold_in(key, k))
        if self.d is not None:
            d = jnp.asarray(self.d(key_d, k, x), x.dtype)
        elif d is None:
            d = jnp.zeros(system.p, x.dtype)
        if callable(self.draw):
            w, v = (jnp.asarray(part, x.dtype) for part in self.draw(key_noise, k, x, noise))
            legal = noise.w.contains(w).all() & ((~noise.v.contains(v)).sum() <= tolerated(observer))
        else:
            key_w, key_v = jax.random.split(key_noise)
            w, v = (_inside(key, box, self.draw == "vertices") for key, box in ((key_w, noise.w), (key_v, noise.v)))
            legal = True
        outside = jnp.where(system.input_bounds.contains(d).all(), 0, 4) | jnp.where(legal, 0, 8)
        y, within = certain.measurement(system, x, d, u, v, noise.v, self.strict)
        return Row(y, u, noise, x, before, jnp.asarray(exact & within)), (x, d, u, w, noise.w), outside


def tolerated(observer: Any) -> int:
    """Outputs of a step that may be wrong."""
    return observer.tolerate if isinstance(observer, TolerantObserver) else 0


def _row(case: Any, k: int) -> Any:
    noise = jax.tree.map(lambda a: a[k], scan.noise_rows(case["noise"]))
    return case["u"][k], noise, None if case["d"] is None else case["d"][k]


def _inside(key: Any, box: Interval, vertices: bool) -> Any:
    """A random vertex, or a point drawn uniformly."""
    if vertices:
        return jnp.where(jax.random.bernoulli(key, shape=box.shape), box.upper, box.lower)
    share = jax.random.uniform(key, box.shape, box.lower.dtype)
    return jnp.clip(box.lower + share * (box.upper - box.lower), box.lower, box.upper)


def _first_break(broken: Any, k: Any, now: Any, row: Row) -> Any:
    """Step and kind of the first thing that went out of its bounds, (2,); -1 as long as there is none."""
    now = now | jnp.where(jnp.isfinite(row.y).all() & jnp.isfinite(row.x).all(), 0, 16)
    return jnp.where((broken[0] < 0) & (now != 0), jnp.stack([jnp.int32(k), now.astype(jnp.int32)]), broken)

"""Compiled scores of noise bounds on a set of records: how much is contradicted, and its derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.interval.box import Interval
from gsisio_jax.observer import scan
from gsisio_jax.observer.fixed import Fixed, chosen, fixed, jitted
from gsisio_jax.observer.types import Observer, cast
from gsisio_jax.plant.periodic import nearest
from gsisio_jax.tuning.compiled import quickly
from gsisio_jax.tuning.fold import fold_rows
from gsisio_jax.tuning.records import Records
from gsisio_jax.tuning.shape import Shape

POINTS = 4  # noise bounds evaluated at once; fewer are filled up, so that every search runs the same program


class Score(NamedTuple):
    """What a record says about noise bounds.

    Attributes:
        penalty: sum over the steps of what is violated: emptiness of the tightest intersection, and how far the logged
            truth is outside its box.
        first: the first violation (negative), else the smallest slack of all steps.
        conflicts: steps with an empty intersection.
        when: the first step that violates anything, -1 if none.
        outside: steps whose logged truth is not in its box (with the margin asked for).
        logged: steps with a logged truth.
    """

    penalty: Any
    first: Any
    conflicts: Any
    when: Any
    outside: Any
    logged: Any


def score_record(observer: Observer, noise: Any, record: dict[str, Any], room: Any) -> Score:
    """The score of one record; differentiable in `noise`.

    Args:
        observer: in the type of the data.
        noise: bounds of w and v.
        record: one case of `Records.arrays`.
        room: (n,) how far inside its box the logged state must lie.
    """

    def update(score: Score, out: Any, k: Any, truth: Any) -> Score:
        x, d = truth
        inside = jnp.minimum(_slack(out.state, nearest(observer, x, out.state), room), _slack(out.input, d, 0.0))
        violated, conflict = inside < 0, out.margin < 0
        slack = jnp.minimum(out.margin, inside)
        now = jnp.where(conflict, -out.margin, 0) + jnp.where(violated, -inside, 0)
        return Score(
            penalty=score.penalty + now,
            first=jnp.where(score.when >= 0, score.first, jnp.where(slack < 0, slack, jnp.minimum(score.first, slack))),
            conflicts=score.conflicts + conflict,
            when=jnp.where((score.when < 0) & (slack < 0), k, score.when),
            outside=score.outside + violated,
            logged=score.logged + (jnp.isfinite(x).any() | jnp.isfinite(d).any()),
        )

    dtype = record["y"].dtype
    zero, none = jnp.zeros((), dtype), jnp.int32(0)
    start = Score(zero, zero + jnp.inf, none, jnp.int32(-1), none, none)
    y, d = scan.cut(record["y"], record["length"]), record["d"]
    before = jnp.concatenate([jnp.full_like(d[:1], jnp.nan), d[:-1]])  # the step from k-1 to k bounds d[k-1]
    return fold_rows(
        observer, record["initial"], y, record["u"], noise, update, start,
        length=record["length"], rows=(record["x"], before),
    )  # fmt: skip


def _slack(box: Interval, value: Any, room: Any) -> Any:
    """How far inside the box the logged entries are."""
    slack = jnp.minimum(box.upper - value, value - box.lower) - room
    return jnp.where(jnp.isfinite(slack), slack, jnp.inf).min(initial=jnp.inf)


def _values(static: Fixed | None, traced: Any, noise: Any, records: Any, room: Any) -> Score:
    observer = chosen(static, traced)

    def one(noise: Any) -> Score:
        return jax.vmap(lambda record: score_record(observer, noise, record, room))(records)

    return jax.vmap(one)(noise)


def _gradient(observer: Observer, noise: Any, record: Any, room: Any, mix: Any) -> Any:
    """Value and gradient of the penalty (mix 1) or of the first violation (mix 0) of one record, with its score."""

    def one(noise: Any) -> Any:
        score = score_record(observer, noise, record, room)
        return jnp.where(mix, score.penalty, jnp.where(jnp.isfinite(score.first), score.first, 0)), score

    return jax.value_and_grad(one, has_aux=True)(noise)


def _gradients(static: Fixed | None, traced: Any, noise: Any, records: Any, room: Any, mix: Any) -> Any:
    """Record by record."""
    observer = chosen(static, traced)
    return jax.vmap(lambda record: _gradient(observer, noise, record, room, mix))(records)


# Up to these, rows of all records together and of one, compiling costs more than running: unoptimised loops are slow
# for each step that they make (the flight: 4 ms instead of .2), whatever a step does.
SMALL, SHORT = 5000, 400


def _program(gradients: bool, small: bool) -> Callable[..., Any]:
    function = _gradients if gradients else _values
    # The observer's numbers are constants: the program is less than half as long.
    return lambda static, traced, *rest: jitted(function, static, traced, jit=quickly if small else jax.jit)(*rest)


class Scores:
    """The records, ready to be scored for any factors of a `Shape`.

    Args:
        observer: a current-form observer.
        shape: what is fitted.
        records: all records, fitted and held out.
        fitted: mask of those to fit.
        room: as in `score_record`.
    """

    def __init__(self, observer: Observer, shape: Shape, records: Records, fitted: np.ndarray, room: np.ndarray):
        dtype = jax.dtypes.canonicalize_dtype(np.float64)
        self.shape, self.fitted, self.calls = shape, fitted, 0
        self._observer = observer if dtype == np.float64 else observer.astype(dtype)
        arrays = records.arrays(observer.system)
        length = arrays.pop("length")
        self._records = {**cast(arrays, dtype), "length": jnp.asarray(length)}
        index = np.flatnonzero(fitted)
        self._chosen = jax.tree.map(lambda a: a[index], self._records)
        self._room = jnp.asarray(room, dtype)
        self._dtype = dtype
        rows = records.y.shape[1]
        self._small = len(records) * rows <= SMALL and rows <= SHORT

    def values(self, factors: np.ndarray) -> Score:
        """Scores of several factors (points, k), at most `POINTS`: arrays (points, R) over all records."""
        points = len(factors)
        full = np.concatenate([factors, np.repeat(factors[-1:], POINTS - points, axis=0)])
        # The compiled programs know bounds, not factors: another parametrisation compiles nothing.
        program = _program(False, self._small)
        score = program(*fixed(self._observer), self.shape.noise(full).astype(self._dtype), self._records, self._room)
        self.calls += points
        return Score(*(np.asarray(a)[:points] for a in score))

    def feasible(self, factors: np.ndarray) -> np.ndarray:
        """Nothing in the fitted records contradicts these factors (points, k); (points,)."""
        return (self.values(factors).when[:, self.fitted] < 0).all(axis=1)

    def gradient(self, factors: np.ndarray, penalty: bool) -> tuple[np.ndarray, np.ndarray, Score]:
        """Of the penalties, or of the first violations, of the fitted records: (R,), (R, k), and the scores."""
        noise = self.shape.noise(factors).astype(self._dtype)
        program = _program(True, self._small)
        (value, score), slope = program(*fixed(self._observer), noise, self._chosen, self._room, jnp.asarray(penalty))
        self.calls += 1
        return np.asarray(value), self.shape.pull(slope), Score(*map(np.asarray, score))

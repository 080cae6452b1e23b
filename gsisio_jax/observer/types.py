"""The observer: what a design leaves for the online recursion, and what a step takes and returns.

The recursion itself stands in `step`.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax._memo import Remembers, memory, once
from gsisio_jax.inclusion import AffineForm
from gsisio_jax.inclusion.planes import Abstraction
from gsisio_jax.interval.box import Interval, is_concrete
from gsisio_jax.interval.cast import as_array
from gsisio_jax.interval.rounding import Rounding, check_rounding
from gsisio_jax.observer.bank import CancellationResidual, LinearBounds
from gsisio_jax.observer.certificate import Certificate
from gsisio_jax.plant.system import Noise, System


class InitialContraction(eqx.Module):
    """How a step begins: with what is known offline of the outputs on the state bounds.

    Attributes:
        form: affine bounds of T2 g there, or None where g takes u; its offset is that of a slope within `slack`.
        slack: (q, n), what the slope of the form may be off by.
        inverses: V >= ``(I - |N_z| R - Q)^{-1}`` there, for the gains named in `gains`.
        cancellation_residual: Q (K, n, n), what every gain leaves of x[k] by rounding, directly or through d[k-1].
        maps: K = ``(I + N_z (S - C))^{-1}`` for the slope S of the form, for the gains named in `linear`.
        left: what these leave of x[k]; ``|x| <= |K (...)| + left |x|``.
        bounds: V >= ``(I - left)^{-1}``.
        gains: indices of the gains for which ``|N_z| R`` contracts there.
        linear: indices of the gains that `maps` belong to.
        affine_output: T2 g is affine on the state bounds.

    Source: theory 5.3 and 10.
    """

    form: AffineForm | None
    slack: Any
    inverses: Any
    cancellation_residual: Any
    maps: Any
    left: Any
    bounds: Any
    gains: tuple[int, ...] = eqx.field(static=True)
    linear: tuple[int, ...] = eqx.field(static=True)
    affine_output: bool = eqx.field(static=True)


class RoundingConstants(eqx.Module):
    """What rounding leaves of the identities of a design, as upper bounds; see `gsisio_jax.observer.residuals`.

    Attributes:
        gains, inverses: of the two banks.
        rows, circuits: of `ExactInputs`: (K, p, p) and (c, p), what they leave of d[k-1].
        input_inverses: (m, p, p), V with ``|d| <= V |d without x[k]| + input_state |x[k]|`` for the inverses `direct`.
        input_state: (p, n).
        growth, input_growth: slope of the certified gain and of the first left inverse around the middle of a box in
            the region, (n, n) and (p, n), rounded up.
        feedthrough: (l, p), how far the H of the promise may be from the one that is written.
        slices: the slopes of the certified gain on parts of the region (`Slices`) in that type, or None.
        implicit: ``|N_z| R`` of the certified gain on the region, (n, n), rounded up.
        rounds: how often the certified bound is applied about the middle of what is left; 0 where psi is 0.
        direct: indices of left inverses of [G; H] itself.

    Source: theory 10.
    """

    gains: CancellationResidual
    inverses: CancellationResidual
    rows: Any
    circuits: Any
    input_inverses: Any
    input_state: Any
    growth: Any
    input_growth: Any
    feedthrough: Any
    direct: tuple[int, ...] = eqx.field(static=True)
    slices: Any = None
    implicit: Any = None
    rounds: int = eqx.field(static=True, default=0)


class ExactInputs(eqx.Module):
    """What makes input boxes exact, given the box of ``[G; H] d``.

    Attributes:
        rows: (K, p, n + l), left inverses of [G; H] in the columns of free inputs, input by input.
        known: (K, p, b), what they leave of the inputs with known bounds.
        circuits: (c, n + l), rows that are free of d.
        circuits_known: (c, b), what they leave of the inputs with known bounds.
        complete: no basic row is missing (there may be too many), so the boxes are exact.

    Source: theory 7.
    """

    rows: Any
    known: Any
    circuits: Any
    circuits_known: Any
    complete: bool = eqx.field(static=True)


class Observer(Remembers, eqx.Module):
    """A designed observer; a pytree whose structure holds f and g. Made by `design_observer`.

    Attributes:
        system: the plant.
        noise: the bounds it was designed for (any others are legal at run time).
        certificate: what the design promises; print it.
        gains: K bounds of x[k]; the first is the certified one.
        inverses: bounds of d[k-1]; the first is the certified one.
        exact: more bounds of d[k-1], exact for a box of [G; H] d.
        T2, C: unknown-input-free outputs (q, l) and the slopes chosen for them (q, n).
        bounded_states: (s, n) rows of the identity; bounded_inputs: (b, p).
        region_inverse: ``(I - |N_z| R)^{-1}`` of the first gain on the region (n, n).
        u_region: box (m,) of known inputs for which the enclosures hold; all of R^m where f and g do not take u.
        first: how every step begins.
        current: (p_H, l), ``V1' d = current @ (y - g - D u - v)``.
        current_input_directions: V1 (p, p_H).
        abstraction, output_abstraction: affine planes of [f; g] and of T2 g, where the bounds use them.
        output_rows: for every row of T2 the outputs that enter it.
        bounds: the methods of Corollary 1 that bound f and g.
        sweeps: how often the box is contracted in a step.
        rounding_constants: what the gains leave by rounding.
        window: rows over several steps (`observer.window.Window`), or None.
        recovery: rows that need no box to begin with (`observer.recovery.Recovery`), those of one length together.
        input_rows: rows for the unknown input over several steps (`observer.input_memory.InputRows`), or None.
        corrections: Newton steps to the point that the certified bound is around (theory 5.6).
        cells: into how many parts the box of x[k] is cut along every state (`observer.cells`); () for none.
        past_cells: the same of x[k-1].
        rounding: "outward": boxes hold on the machine. "nearest": up to rounding errors, for comparisons of speed.
    """

    system: System
    noise: Noise
    certificate: Certificate
    gains: LinearBounds
    inverses: LinearBounds
    exact: ExactInputs
    T2: Any
    C: Any
    bounded_states: Any
    bounded_inputs: Any
    region_inverse: Any
    u_region: Interval
    first: InitialContraction
    current: Any
    current_input_directions: Any
    abstraction: Abstraction | None
    output_abstraction: Abstraction | None
    rounding_constants: Any  # RoundingConstants
    output_rows: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    bounds: tuple[str, ...] = eqx.field(static=True)
    sweeps: int = eqx.field(static=True)
    window: Any = None
    recovery: Any = ()
    input_rows: Any = None
    corrections: int = eqx.field(static=True, default=0)
    cells: tuple[int, ...] = eqx.field(static=True, default=())
    past_cells: tuple[int, ...] = eqx.field(static=True, default=())
    rounding: Rounding = eqx.field(static=True, default="outward")

    @property
    def delay(self) -> int:
        """0: boxes of x[k] come with y[k]; a `DelayedObserver` has another."""
        return 0

    @property
    def guaranteed(self) -> bool:
        """The boxes hold on the machine."""
        return self.rounding == "outward"

    def with_rounding(self, rounding: Rounding) -> Observer:
        """The same observer with another rounding."""
        check_rounding("Observer.with_rounding", rounding)
        return once(self, ("rounding", rounding), lambda: self._with_rounding(rounding))

    def _with_rounding(self, rounding: Rounding) -> Observer:
        found = replace(self, rounding=rounding)
        if in_type in memory(self) and rounding == "outward":
            memory(found)[in_type] = memory(self)[in_type]
        return found

    def astype(self, dtype: Any) -> Observer:
        """The same observer in another floating type; boxes are rounded outward.

        Gains of that type are other numbers, so what they leave is computed anew: once per observer, in seconds.

        Raises:
            ValueError: the type is not float64 or float32, or the observer is traced.
        """
        return in_type(self, dtype)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write every number of the design into a file; `gsisio_jax.load_observer` reads it, given the system.

        f and g may be anything, also lambdas: the file holds what tells them from others, and not their code.

        Args:
            path: of the file; one that is there is replaced, by the whole new one or not at all.

        Raises:
            OSError: it cannot be written there.
            ValueError: the observer is traced.
        """
        from gsisio_jax.files import save_observer

        save_observer(path, self)


def in_type(observer: Observer, dtype: Any) -> Observer:
    """`Observer.astype`; remembers what it found for that observer."""
    dtype = np.dtype(jax.dtypes.canonicalize_dtype(dtype))
    if dtype not in (np.float64, np.float32):
        raise ValueError(
            f"Observer.astype: the floating type must be float64 or float32, got {dtype}; convert the data"
        )
    leaves = jax.tree.leaves(observer)
    same = all(leaf.dtype == dtype for leaf in leaves if hasattr(leaf, "dtype"))
    if same or observer.rounding == "nearest" or dtype == np.float64:
        return cast_once(observer, dtype)
    if not all(map(is_concrete, leaves)):
        raise ValueError(
            "Observer.astype: the observer is traced, but its gains in another type need numbers; call "
            "observer.astype(jnp.float32) outside of jit"
        )
    return once(observer, in_type, lambda: _single(observer))


def _single(observer: Observer) -> Observer:
    from gsisio_jax.observer.rounding_constants import single_precision

    with jax.ensure_compile_time_eval():  # the observer's numbers are known, also while something else is traced
        return single_precision(observer)


def cast_once(observer: Any, dtype: Any) -> Any:
    """`cast`, the same object for every call, so that a step need not hash it again."""
    if not all(map(is_concrete, jax.tree.leaves(observer))):
        return cast(observer, dtype)

    def made() -> Any:
        with jax.ensure_compile_time_eval():  # what is remembered must not belong to the program that is traced
            return cast(observer, dtype)

    return once(observer, ("type", np.dtype(dtype)), made)


def cast(tree: Any, dtype: Any) -> Any:
    """A pytree of boxes, planes and arrays in another floating type; boxes and planes are rounded outward."""
    bounds = Interval | Abstraction

    def converted(leaf: Any) -> Any:
        if isinstance(leaf, bounds):
            return leaf.astype(dtype)
        kind = None if jnp.issubdtype(jnp.result_type(leaf), jnp.bool_) else dtype
        if not is_concrete(leaf):
            return jnp.asarray(leaf, kind)
        unchanged = isinstance(leaf, jax.Array) and (kind is None or leaf.dtype == kind) and not leaf.weak_type
        return leaf if unchanged else as_array(np.asarray(leaf), kind)  # JAX would compile a cast for every shape

    return jax.tree.map(
        converted,
        tree,
        is_leaf=lambda leaf: isinstance(leaf, bounds),
    )


class Carry(eqx.Module):
    """What one step hands to the next; a pytree of arrays (`gsisio_jax.save_carry` writes it into a file).

    Attributes:
        state: box of x[k], (n,); before the first step, the initial box.
        h: bounds of f and g on that box (prediction form: affine forms of [f; g]).
        y: (l,) measurement k, NaN where missing.
        u: (m,) known input k.
        noise: bounds of w[k] and v[k].
        starts: nothing has been measured yet.
        believed: no conflict has taken y[k] out of what is believed.
        older: the steps before, as far as rows look back (`observer.past.Past`).
        memory: earlier boxes of the input, where it is known how it moves (`observer.input_memory.InputMemory`).
    """

    state: Interval
    h: Any  # AtomBounds, or AffineForm in the prediction form
    y: Any
    u: Any
    noise: Noise
    starts: Any
    believed: Any
    older: Any = ()
    memory: Any = None


class StepOutput(eqx.Module):
    """Result of one step k.

    Attributes:
        state: box of x[k] from y[0..k], (n,).
        input: box of d[k-1] from y[0..k], (p,); at k = 0 the input bounds.
        current_input: box of V1' d[k] from y[0..k], (p_H,).
        status: `Status` bit mask.
        margin: signed slack of the tightest intersection.
        source: which one it was (`Source`).
        kept: (l,) outputs that are in every largest set of outputs that agree; None unless wrong ones are tolerated.
    """

    state: Interval
    input: Interval
    current_input: Interval
    status: Any
    margin: Any
    source: Any
    kept: Any = None

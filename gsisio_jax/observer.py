"""The observer: what a design leaves for the online recursion, and what a step takes and returns.

The recursion itself stands in `recursion`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from gsisio_jax.certificate import Certificate
from gsisio_jax.contraction import Bank
from gsisio_jax.inclusion import AffineForm
from gsisio_jax.inclusion.abstraction import Abstraction
from gsisio_jax.interval import Interval
from gsisio_jax.system import Noise, System


class FirstSweep(eqx.Module):
    """How a step begins: with what is known offline of the outputs on the state bounds.

    Attributes:
        form: affine bounds of T2 g there, or None where g takes u.
        inverses: ``(I - |N_z| R)^{-1}`` there, for the gains named in `gains`.
        gains: indices of the gains for which ``|N_z| R`` contracts there.
        affine_output: T2 g is linear on the state bounds, without a constant, so psi is zero.

    Source: design 4.3, step 3.
    """

    form: AffineForm | None
    inverses: Any
    gains: tuple[int, ...] = eqx.field(static=True)
    affine_output: bool = eqx.field(static=True)


class ExactInputs(eqx.Module):
    """What makes input boxes exact, given the box of ``[G; H] d``.

    Attributes:
        rows: (K, p, n + l), left inverses of [G; H] in the columns of free inputs, input by input.
        known: (K, p, b), what they leave of the inputs with known bounds.
        circuits: (c, n + l), rows that are free of d.
        circuits_known: (c, b), what they leave of the inputs with known bounds.
        complete: no basic row is missing (there may be too many), so the boxes are exact.

    Source: design 4.5.
    """

    rows: Any
    known: Any
    circuits: Any
    circuits_known: Any
    complete: bool = eqx.field(static=True)


class Observer(eqx.Module):
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
    """

    system: System
    noise: Noise
    certificate: Certificate
    gains: Bank
    inverses: Bank
    exact: ExactInputs
    T2: Any
    C: Any
    bounded_states: Any
    bounded_inputs: Any
    region_inverse: Any
    u_region: Interval
    first: FirstSweep
    current: Any
    current_input_directions: Any
    abstraction: Abstraction | None
    output_abstraction: Abstraction | None
    output_rows: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    bounds: tuple[str, ...] = eqx.field(static=True)
    sweeps: int = eqx.field(static=True)

    def astype(self, dtype: Any) -> Observer:
        """The same observer in another floating type; boxes are rounded outward."""
        return cast(self, dtype)


def cast(tree: Any, dtype: Any) -> Any:
    """A pytree of boxes and arrays in another floating type; boxes are rounded outward."""
    return jax.tree.map(
        lambda leaf: leaf.astype(dtype) if isinstance(leaf, Interval) else jnp.asarray(leaf, dtype),
        tree,
        is_leaf=lambda leaf: isinstance(leaf, Interval),
    )


class Carry(eqx.Module):
    """What one step hands to the next; a pytree of arrays that can be saved and resumed.

    Attributes:
        state: box of x[k], (n,).
        h: affine bounds of [f; g] on that box, (n + l,).
        y: (l,) measurement k, NaN where missing or not believed.
        u: (m,) known input k.
        noise: bounds of w[k] and v[k].
    """

    state: Interval
    h: AffineForm
    y: Any
    u: Any
    noise: Noise


class StepOutput(eqx.Module):
    """Result of one step k.

    Attributes:
        state: box of x[k] from y[0..k], (n,).
        input: box of d[k-1] from y[0..k], (p,); at k = 0 the input bounds.
        current_input: box of V1' d[k] from y[0..k], (p_H,).
        status: `Status` bit mask.
        margin: signed slack of the tightest intersection.
        source: which one it was (`Source`).
    """

    state: Interval
    input: Interval
    current_input: Interval
    status: Any
    margin: Any
    source: Any

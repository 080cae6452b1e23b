"""Bounds of atoms on a box: a slope and an offset for every one, and a range.

Rounding: see `atoms`.

**Atoms of atoms.** An argument t is such a row, too: ``t = s_t x + c_t +- r_t`` with the magnitude
``T = sum |w_i| m_i + sum |w_j| q_j + |c|``, and its bounds are off by ``kappa T`` at most. A curve with the line
``|phi(t) - s t - middle| <= half`` on the range of t (`lines.Line`), ``|phi| <= size``, has the slope
``s s_t``, the center ``s c_t + middle`` and the radius ``|s| r_t + half``, and its q is below ``3 |s| T + size``: one
``kappa |s| T`` for the argument and one kappa q for the rows. So radii are widened by ``(ulps + 4 kappa) (size + |s|
T)``, with ulps for the line. What is flushed to zero in t counts |s| times: T is made ``tiny / eps`` larger, which is
more. A product has ``cy s_x + cx s_y``, ``|cx| <= T_x`` and so on: its q is below ``4 T_x T_y``, and it is widened by
``(ulps + 8 kappa) T_x T_y``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atom_forms import (
    Argument,
    BoundedAtom,
    chosen,
    flushed,
    from_node,
    is_zero,
    met_with_form,
    padding,
)
from gsisio_jax.inclusion.atom_values import argument_range, is_plain, number, rule, value_and_magnitude
from gsisio_jax.inclusion.atoms import States, wider
from gsisio_jax.inclusion.linear_parts import Atom, Linear
from gsisio_jax.inclusion.node import InputBox
from gsisio_jax.inclusion.rules.bilinear import bilinear_line
from gsisio_jax.inclusion.rules.functions import CURVES, RECIPROCAL, SQUARE, power
from gsisio_jax.inclusion.rules.lines import LINES, UNBOUNDED, Line, line_of
from gsisio_jax.inclusion.rules.sincos import LIMIT
from gsisio_jax.inclusion.rules.trig import Wave, wave_atom
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, nan_to_unbounded
from gsisio_jax.interval.direct import where
from gsisio_jax.interval.primitives import scale


@dataclass
class BoxOfAtoms:
    """Bounds of atoms on a box, in an order in which each depends on earlier ones only.

    Attributes:
        states: the box of x (n,).
        u: the known input.
        terms: number of terms that a row can have.
        found: the atoms so far.
        arguments: their arguments, by `id`: some are shared.
    """

    states: States
    u: Any
    terms: int
    found: list[BoundedAtom] = field(default_factory=list)
    arguments: dict[int, Argument] = field(default_factory=dict)

    @property
    def n(self) -> int:
        return len(self.states.center)

    @cached_property
    def domain(self) -> InputBox:
        """The box, for the rules of the engine over arrays."""
        return InputBox(self.states.wide.lower, self.states.wide.upper, self.states.magnitude)

    def add(self, atom: Atom, used: bool) -> None:
        """The next atom; one that is not used may be anything."""
        self.found.append(self._bounded(atom) if used else self._nothing())

    def _nothing(self) -> BoundedAtom:
        zero = np.zeros((), self.states.center.dtype)
        return BoundedAtom([zero] * self.n, zero, zero, Interval.unchecked(zero, zero))

    def _bounded(self, atom: Atom) -> BoundedAtom:
        u, states, memo = self.u, self.states, self.arguments
        if atom.source is not None:
            point = Interval.unchecked(u[atom.source], u[atom.source])
            error = wider(abs(u[atom.source]), self.terms)
            zero = [np.zeros((), states.center.dtype)] * self.n
            return BoundedAtom(zero, point.lower, error, Interval.unchecked(point.lower - error, point.upper + error))
        curve, moving = _curve(atom), [t for t in atom.arguments if t.coefficients]
        if isinstance(curve, Wave) and is_plain(atom, self.n):
            return self._wave(curve, atom.arguments[0])
        for t in moving:
            if id(t) not in memo:
                memo[id(t)] = self.argument(t)
        if curve is not None and moving:
            return self._bent(curve, memo[id(moving[0])])
        if atom.name == "mul" and len(moving) == 2:
            return self._product(memo[id(moving[0])], memo[id(moving[1])])
        nodes = [
            memo[id(t)].node(self.domain) if t.coefficients else number(t, states.center.dtype) for t in atom.arguments
        ]
        return from_node(rule(atom, nodes), states, self.terms)

    def _bent(self, curve: Any, t: Argument) -> BoundedAtom:
        """A function of one variable, from its line on the range of t."""
        kappa = 2.0 * self.terms + 16
        line = _wave_line(curve, t, self.terms) if isinstance(curve, Wave) else None
        if line is None:
            a, b = t.range.lower, t.range.upper
            line = LINES[curve](a, b, kappa) if curve in LINES else line_of(curve, a, b, kappa)
        steep = abs(line.slope)
        lost = where(line.usable, jax.lax.stop_gradient(t.size), 0) + flushed(t.size)
        lost = line.size + steep * lost
        pad = padding(lost, line.ulps + 4 * kappa, line.floor)
        half = line.half if rounding.outward() else jnp.maximum(line.half, 0)
        radius = half if t.plain else half + scale(steep, t.radius)
        flat = not (t.plain and curve in LINES and curve in UNBOUNDED)
        best = not (t.plain and curve in LINES)
        usable, center, radius, size = chosen(
            line.usable, line.slope * t.center + line.middle, radius, pad, lost, line.range, kappa, flat, best
        )
        s = where(usable, line.slope, 0)
        slope = [v if is_zero(v) else s * v for v in t.slope]
        return BoundedAtom(slope, center, radius, line.range, size=size)

    def _product(self, x: Argument, y: Argument) -> BoundedAtom:
        """``x y`` around both centers."""
        kappa = 2.0 * self.terms + 16
        usable, cx, cy, spread, natural = bilinear_line(x.range, y.range, kappa)
        size_x, size_y = (where(usable, jax.lax.stop_gradient(t.size), 0) + flushed(t.size) for t in (x, y))
        size = size_x * size_y
        pad = padding(size, 32.0 + 8 * kappa, rounding.FLUSHED)
        center, radius = cy * x.center + cx * y.center - cx * cy, spread
        for c, t in ((cy, x), (cx, y)):
            radius = radius if t.plain else radius + scale(abs(c), t.radius)
        plain = x.plain and y.plain
        usable, center, radius, size = chosen(usable, center, radius, pad, size, natural, kappa, not plain, not plain)
        cx, cy = where(usable, cx, 0), where(usable, cy, 0)
        slope = []
        for v, w in zip(x.slope, y.slope, strict=True):
            terms = [c * part for c, part in ((cy, v), (cx, w)) if not is_zero(part)]
            slope.append(sum(terms[1:], terms[0]) if terms else np.zeros((), self.states.center.dtype))
        if any(not (is_zero(v) or is_zero(w)) for v, w in zip(x.slope, y.slope, strict=True)):
            # Both depend on the same entry of x: their product is then better known than that of their ranges.
            natural = met_with_form(natural, slope, center, radius, self.states)
        return BoundedAtom(slope, center, radius, natural, size=size)

    def _wave(self, curve: Wave, t: Linear) -> BoundedAtom:
        """Sine or cosine of a linear function of the states."""
        states = self.states
        dtype = states.center.dtype
        kind = np.dtype(dtype).type
        m, size = value_and_magnitude(t, states.center, states.magnitude)
        r: Any = kind(0)
        for k, weight in t.coefficients.items():
            r = r + kind(abs(float(weight))) * states.radius[k]
        steepness, center, radius, natural, middle = wave_atom(curve.cosine, m, r, size, self.terms)
        slope: list[Any] = [np.zeros((), dtype)] * self.n
        for k, weight in t.coefficients.items():
            slope[k] = steepness * kind(weight)
        return BoundedAtom(slope, center, radius, natural, middle, _wave_size(curve, size))

    def argument(self, t: Linear) -> Argument:
        """A linear argument: a range met with what slopes say, its form, and the magnitude of its terms."""
        states, found = self.states, self.found
        dtype = states.center.dtype
        kind = np.dtype(dtype).type
        natural = argument_range(t, self.n, states.wide, [bounded.range for bounded in found])
        inner = {k - self.n: v for k, v in t.coefficients.items() if k >= self.n}
        slope: list[Any] = [np.zeros((), dtype)] * self.n
        error: Any = kind(0)
        size: Any = kind(abs(float(t.constant)))
        for k, value in t.coefficients.items():
            weight = kind(abs(float(value)))
            size = size + weight * (states.magnitude[k] if k < self.n else found[k - self.n].magnitude(states))
            if k < self.n:
                slope[k] = np.asarray(value, dtype)
                inexact = value != Fraction(float(slope[k])) or len(t.coefficients) > 1 or inner
                error = error + weight * states.error[k] if inexact and rounding.outward() else error
        center: Any = kind(t.constant)
        radius: Any = error + abs(center) * kind(16 * float(jnp.finfo(dtype).eps) * rounding.outward())
        for j, value in inner.items():
            weight = kind(value)
            for k, part in enumerate(found[j].slope):
                if not is_zero(part):
                    slope[k] = weight * part if is_zero(slope[k]) else slope[k] + weight * part
            center, radius = center + weight * found[j].center, radius + abs(weight) * found[j].radius
        if len(t.coefficients) > 1 and inner:
            natural = met_with_form(natural, slope, center, radius, states)
        elif len(t.coefficients) > 1 or t.coefficients.get(next(iter(t.coefficients))) != 1 or t.constant:
            natural = nan_to_unbounded(natural)
        return Argument(natural, slope, center, radius, jnp.asarray(size), not inner)


def _curve(atom: Atom) -> Any:
    """The function of one variable that an atom is, None for others."""
    if atom.name == "reciprocal":
        return RECIPROCAL
    if atom.name == "table":
        return atom.equation
    if atom.name == "mul":
        return SQUARE if atom.arguments[0] is atom.arguments[1] else None
    if atom.name == "integer_pow" and atom.equation.params["y"] not in (0, 1):
        return power(float(atom.equation.params["y"]))
    if atom.name == "pow" and not atom.arguments[1].coefficients and atom.arguments[0].coefficients:
        exponent = float(atom.arguments[1].constant)
        return power(exponent) if exponent not in (0.0, 1.0) else None
    return CURVES.get(atom.name)


def _wave_size(curve: Wave, size: Any) -> Any:
    """The q of a sine or cosine (`wave_atom`), of which nothing but its range is used beyond `LIMIT`."""
    size = jax.lax.stop_gradient(size)
    return 3 * jnp.minimum(size + np.dtype(size.dtype).type(curve.cosine), LIMIT[size.dtype.name])


def _wave_line(curve: Wave, t: Argument, terms: int) -> Line:
    """A sine or cosine as a `Line` of an argument that is not linear in the states."""
    a, b = t.range.lower, t.range.upper
    m, r = 0.5 * a + 0.5 * b, 0.5 * b - 0.5 * a
    size = where(jnp.isfinite(t.size), t.size, jnp.inf)
    slope, center, radius, natural, _ = wave_atom(curve.cosine, m, r, size, terms)
    usable = size < LIMIT[m.dtype.name]
    return Line(usable, slope, center, radius, _wave_size(curve, size), natural)

"""A function as a linear map of the state and of a few atoms: ``f(x) = L x + A a(x) + c``.

An atom is the result of an operation that is not linear (a sine, a product), or an entry of the known input. Sums and
multiples between them are collected while tracing, in fractions, so a linear combination of outputs, ``R f(x)``, has
the constant weights ``R L`` and ``R A``: what cancels cancels exactly, and costs nothing at run time.

On a box every atom has a slope and an offset, ``a - s . x in offset``, and a range. Bounds of a combination are the
linear part plus those of the atoms, slopes combined before the box is applied (`joint`), or ranges alone (`natural`).

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

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.atoms import AtomBounds, Rows, States, widened_atoms, wider
from gsisio_jax.inclusion.linear_parts import Atom, Linear
from gsisio_jax.inclusion.node import POINT_MODE, Form, InputBox, Node
from gsisio_jax.inclusion.rules.bilinear import bilinear_line, multiply
from gsisio_jax.inclusion.rules.functions import CURVES, RECIPROCAL, SQUARE, power
from gsisio_jax.inclusion.rules.lines import LINES, UNBOUNDED, Line, line_of
from gsisio_jax.inclusion.rules.registry import ELEMENTWISE
from gsisio_jax.inclusion.rules.sincos import LIMIT
from gsisio_jax.inclusion.rules.trig import Wave, wave_atom, wave_point
from gsisio_jax.inclusion.rules.univariate import apply
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, center_and_radius, choose, faint, is_concrete, nan_to_unbounded
from gsisio_jax.interval.minmax import cut, raised
from gsisio_jax.interval.primitives import matmul, scale


@dataclass
class Expansion:
    """``function(x, u) = L x + A a(x, u) + c``, found while tracing.

    Attributes:
        n: number of states.
        atoms: in an order in which each depends on earlier ones only.
        outputs: one `Linear` for every component of the function.
    """

    n: int
    atoms: list[Atom]
    outputs: list[Linear]

    @property
    def terms(self) -> int:
        """Number of terms that a row can have."""
        return self.n + len(self.atoms) + 1

    def rows(self, weights: Any, dtype: Any, minus: Any = None) -> Rows:
        """``weights @ function - minus @ x``, weights (r, outputs); in fractions until the end if they are known."""
        if not (is_concrete(weights) and is_concrete(minus)):
            return self._traced_rows(jnp.asarray(weights, dtype), dtype, minus)
        weights = np.asarray(weights, np.float64)
        minus = np.zeros((len(weights), self.n)) if minus is None else np.asarray(minus, np.float64)
        states = np.zeros((len(weights), self.n), dtype)
        atoms = np.zeros((len(weights), len(self.atoms)), dtype)
        constant = np.zeros(len(weights), dtype)
        for r, row in enumerate(weights):
            total = Linear({i: -Fraction(float(v)) for i, v in enumerate(minus[r]) if v})
            for weight, output in zip(row, self.outputs, strict=True):
                if weight:
                    total = total.plus(output.times(Fraction(float(weight))))
            for k, value in total.coefficients.items():
                (states if k < self.n else atoms)[r, k - (0 if k < self.n else self.n)] = float(value)
            constant[r] = float(total.constant)
        return Rows(states, atoms, constant)

    def _traced_rows(self, weights: Any, dtype: Any, minus: Any) -> Rows:
        each = self.rows(np.eye(len(self.outputs)), dtype)
        states, size = matmul(weights, each.states), matmul(abs(weights), abs(each.states))
        if minus is not None:
            states, size = states - minus, size + abs(minus)
        lost = size, matmul(abs(weights), abs(each.atoms))
        # A constant is rounded at the size of its parts: it becomes part of an error that is there anyway.
        constant = matmul(weights, each.constant)
        lost = lost[0], lost[1]
        return Rows(states, matmul(weights, each.atoms), constant, lost)

    def bounds(
        self, states: States, u: Any, wanted: Sequence[bool] | None = None, with_values: bool = False
    ) -> AtomBounds:
        """Bounds of the atoms on a box, and on request their values at its center; those that are not `wanted`, by
        themselves or by others, may be anything."""
        found: list[_Bounded] = []
        domain = InputBox(states.wide.lower, states.wide.upper, states.magnitude)
        memo: dict[int, _Argument] = {}
        at: list[Any] = []
        thin = _thin(states.center, self.terms)
        for atom, used in zip(self.atoms, self._needed(wanted), strict=True):
            bounded = self._bounded(atom, states, u, found, domain, memo) if used else _nothing(self.n, states)
            found.append(bounded)
            if with_values:
                known = bounded.value
                at.append(self._value(atom, states.center, thin, u, at) if known is None else known)
        return _stacked(found, at, states)

    def values(self, x: Any, u: Any, wanted: Sequence[bool] | None = None) -> tuple[Any, Any]:
        """The atoms at a point x, and what rounding leaves of them, (J,) each."""
        found: list[Any] = []
        thin, zero = _thin(x, self.terms), jnp.zeros_like(x[0])
        for atom, used in zip(self.atoms, self._needed(wanted), strict=True):
            found.append(self._value(atom, x, thin, u, found) if used else Interval.unchecked(zero, zero))
        return _values(found, x.dtype)

    def _value(self, atom: Atom, x: Any, thin: Interval, u: Any, found: Sequence[Any]) -> Any:
        """An atom at a point, as (value, radius), or on a thin box around it, as a box; widened for rows."""
        curve = CURVES.get(atom.name)
        if isinstance(curve, Wave) and self._plain(atom):
            return wave_point(curve.cosine, *self._at(atom.arguments[0], x, abs(x)), self.terms)
        found = [v if isinstance(v, Interval) else Interval.unchecked(v[0] - v[1], v[0] + v[1]) for v in found]
        if atom.source is not None:
            value = Interval.unchecked(u[atom.source], u[atom.source])
        else:
            token = POINT_MODE.set(True)
            try:
                nodes = [
                    Node(self._argument_range(t, thin, found)) if t.coefficients else _number(t, thin.lower.dtype)
                    for t in atom.arguments
                ]
                value = nan_to_unbounded(_rule(atom, nodes).range)
            finally:
                POINT_MODE.reset(token)
        extra = wider(jnp.maximum(abs(value.lower), abs(value.upper)), self.terms)
        return Interval.unchecked(value.lower - extra, value.upper + extra)

    def _plain(self, atom: Atom) -> bool:
        """Its argument is a linear function of the states."""
        return all(k < self.n for k in atom.arguments[0].coefficients)

    def used_by(self, *rows: Rows) -> list[bool]:
        """Which atoms have a weight in some row."""
        return [
            any(not is_concrete(row.atoms) or bool(np.any(row.atoms[:, j])) for row in rows)
            for j in range(len(self.atoms))
        ]

    def _needed(self, wanted: Sequence[bool] | None) -> list[bool]:
        needed = [True] * len(self.atoms) if wanted is None else list(wanted)
        for j in range(len(self.atoms))[::-1]:
            if needed[j]:
                for argument in self.atoms[j].arguments:
                    for k in argument.coefficients:
                        if k >= self.n:
                            needed[k - self.n] = True
        return needed

    def _argument_range(self, t: Linear, wide: Interval, found: Sequence[Any]) -> Interval:
        """Range of an argument from ranges that were widened before."""
        dtype = wide.lower.dtype
        kind = np.dtype(dtype).type
        constant, error = kind(t.constant), abs(kind(t.constant)) * kind(16 * float(jnp.finfo(dtype).eps))
        error = error if rounding.outward() else kind(0)
        lower, upper = constant - error, constant + error
        for k, value in t.coefficients.items():
            weight = kind(value)
            side = wide[k] if k < self.n else found[k - self.n]
            first, last = (side.lower, side.upper) if value > 0 else (side.upper, side.lower)
            lower, upper = lower + weight * first, upper + weight * last
        floor = faint(np.array([kind(value) for value in t.coefficients.values()], dtype))
        lower, upper = lower - floor, upper + floor
        return Interval.unchecked(*(jnp.asarray(side, dtype) for side in (lower, upper)))

    def _bounded(
        self, atom: Atom, states: States, u: Any, found: list[_Bounded], domain: InputBox, memo: dict[int, _Argument]
    ) -> _Bounded:
        if atom.source is not None:
            point = Interval.unchecked(u[atom.source], u[atom.source])
            error = wider(abs(u[atom.source]), self.terms)
            zero = [np.zeros((), states.center.dtype)] * self.n
            return _Bounded(zero, point.lower, error, Interval.unchecked(point.lower - error, point.upper + error))
        curve, moving = _curve(atom), [t for t in atom.arguments if t.coefficients]
        if isinstance(curve, Wave) and self._plain(atom):
            return self._wave(curve, atom.arguments[0], states)
        for t in moving:
            if id(t) not in memo:
                memo[id(t)] = self._argument(t, states, found)
        if curve is not None and moving:
            return self._bent(curve, memo[id(moving[0])], states)
        if atom.name == "mul" and len(moving) == 2:
            return self._product(memo[id(moving[0])], memo[id(moving[1])], states)
        nodes = [
            memo[id(t)].node(domain) if t.coefficients else _number(t, states.center.dtype) for t in atom.arguments
        ]
        return _from_node(_rule(atom, nodes), states, self.terms)

    def _bent(self, curve: Any, t: _Argument, states: States) -> _Bounded:
        """A function of one variable, from its line on the range of t."""
        kappa = 2.0 * self.terms + 16
        line = _wave_line(curve, t, self.terms) if isinstance(curve, Wave) else None
        if line is None:
            a, b = t.range.lower, t.range.upper
            line = LINES[curve](a, b, kappa) if _is_line(curve) else line_of(curve, a, b, kappa)
        steep = abs(line.slope)
        lost = jnp.where(line.usable, jax.lax.stop_gradient(t.size), 0) + _crumb(t.size)
        lost = line.size + steep * lost
        pad = _padding(lost, line.ulps + 4 * kappa, line.floor)
        half = line.half if rounding.outward() else jnp.maximum(line.half, 0)
        radius = half if t.plain else half + scale(steep, t.radius)
        flat = not (t.plain and _is_line(curve) and curve in UNBOUNDED)
        best = not (t.plain and _is_line(curve))
        usable, center, radius, size = _chosen(
            line.usable, line.slope * t.center + line.middle, radius, pad, lost, line.range, kappa, flat, best
        )
        s = jnp.where(usable, line.slope, 0)
        slope = [v if _is_zero(v) else s * v for v in t.slope]
        return _Bounded(slope, center, radius, line.range, size=size)

    def _product(self, x: _Argument, y: _Argument, states: States) -> _Bounded:
        """``x y`` around both centers."""
        kappa = 2.0 * self.terms + 16
        usable, cx, cy, spread, natural = bilinear_line(x.range, y.range, kappa)
        size_x, size_y = (jnp.where(usable, jax.lax.stop_gradient(t.size), 0) + _crumb(t.size) for t in (x, y))
        size = size_x * size_y
        pad = _padding(size, 32.0 + 8 * kappa, rounding.FLUSHED)
        center, radius = cy * x.center + cx * y.center - cx * cy, spread
        for c, t in ((cy, x), (cx, y)):
            radius = radius if t.plain else radius + scale(abs(c), t.radius)
        plain = x.plain and y.plain
        usable, center, radius, size = _chosen(usable, center, radius, pad, size, natural, kappa, not plain, not plain)
        cx, cy = jnp.where(usable, cx, 0), jnp.where(usable, cy, 0)
        slope = []
        for v, w in zip(x.slope, y.slope, strict=True):
            terms = [c * part for c, part in ((cy, v), (cx, w)) if not _is_zero(part)]
            slope.append(sum(terms[1:], terms[0]) if terms else np.zeros((), states.center.dtype))
        if any(not (_is_zero(v) or _is_zero(w)) for v, w in zip(x.slope, y.slope, strict=True)):
            # Both depend on the same entry of x: their product is then better known than that of their ranges.
            natural = _met(natural, slope, center, radius, states)
        return _Bounded(slope, center, radius, natural, size=size)

    def _wave(self, curve: Wave, t: Linear, states: States) -> _Bounded:
        """Sine or cosine of a linear function of the states."""
        dtype = states.center.dtype
        kind = np.dtype(dtype).type
        m, size = self._at(t, states.center, states.magnitude)
        r: Any = kind(0)
        for k, weight in t.coefficients.items():
            r = r + kind(abs(float(weight))) * states.radius[k]
        steepness, center, radius, natural, middle = wave_atom(curve.cosine, m, r, size, self.terms)
        slope: list[Any] = [np.zeros((), dtype)] * self.n
        for k, weight in t.coefficients.items():
            slope[k] = steepness * kind(weight)
        return _Bounded(slope, center, radius, natural, middle, _wave_size(curve, size))

    def _at(self, t: Linear, x: Any, magnitude: Any) -> tuple[Any, Any]:
        """A linear function of the states at a point, and the magnitude of its terms."""
        kind = np.dtype(x.dtype).type
        value: Any = kind(float(t.constant))
        size: Any = kind(abs(float(t.constant)))
        for k, weight in t.coefficients.items():
            value = value + kind(float(weight)) * x[k]
            size = size + kind(abs(float(weight))) * magnitude[k]
        return jnp.asarray(value), jnp.asarray(size)

    def _argument(self, t: Linear, states: States, found: list[_Bounded]) -> _Argument:
        """A linear argument: a range met with what slopes say, its form, and the magnitude of its terms."""
        dtype = states.center.dtype
        kind = np.dtype(dtype).type
        natural = self._argument_range(t, states.wide, [bounded.range for bounded in found])
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
                if not _is_zero(part):
                    slope[k] = weight * part if _is_zero(slope[k]) else slope[k] + weight * part
            center, radius = center + weight * found[j].center, radius + abs(weight) * found[j].radius
        if len(t.coefficients) > 1 and inner:
            natural = _met(natural, slope, center, radius, states)
        elif len(t.coefficients) > 1 or t.coefficients.get(next(iter(t.coefficients))) != 1 or t.constant:
            natural = nan_to_unbounded(natural)
        return _Argument(natural, slope, center, radius, jnp.asarray(size), not inner)


@dataclass
class _Argument:
    """A linear argument t: its range, ``|t - slope x - center| <= radius``, and ``sum |slope_i| m_i + |center| +
    radius <= size``.

    Range and form are valid each by itself. Of the states alone (`plain`), the weights are known, and what the radius
    stands for is rounding that a share of the size takes in.
    """

    range: Interval
    slope: list[Any]
    center: Any
    radius: Any
    size: Any
    plain: bool

    def node(self, domain: InputBox) -> Node:
        """For the rules of the engine over arrays."""
        center, radius = self.center, self.radius
        offset = Interval.unchecked(jnp.asarray(center - radius), jnp.asarray(center + radius))
        slope: Any = np.asarray(self.slope) if self.plain else _joined(self.slope, domain.lower.dtype)
        return Node(self.range, Form(slope, offset if self.plain else nan_to_unbounded(offset), domain))


def _is_zero(value: Any) -> bool:
    """Known to be 0 while tracing."""
    return isinstance(value, np.ndarray | np.generic) and not value.any()


def _is_line(curve: Any) -> bool:
    return curve in LINES


def _crumb(size: Any) -> Any:
    """For what is flushed to zero, see the module docstring."""
    info = jnp.finfo(size.dtype)
    return np.dtype(size.dtype).type(float(info.tiny) / float(info.eps))


def _padding(size: Any, ulps: Any, floor: float) -> Any:
    if not rounding.outward():
        return np.zeros((), size.dtype)
    return rounding.error(size, ulps, floor)


def _chosen(
    usable: Any, center: Any, radius: Any, pad: Any, size: Any, natural: Interval, kappa: float, flat: bool, best: bool
) -> tuple[Any, Any, Any, Any]:
    """Is a form used, its center and radius and 4 times its `size`; else those of the range, as a form of slope 0.

    Args:
        flat: the range may be finite where no form is usable.
        best: it may be narrower than the form; where it is not by more than rounding, the slope is kept.
    """
    usable = usable & (size < float(jnp.finfo(size.dtype).max) / 64)
    lower, upper = natural.lower, natural.upper
    far = jnp.maximum(abs(lower), abs(upper))
    middle, half = np.zeros((), size.dtype), np.asarray(np.inf, size.dtype)
    if flat:
        half = 0.5 * upper - 0.5 * lower
        middle = jnp.where(half < jnp.inf, 0.5 * lower + 0.5 * upper, 0)
        # Its own rounding, and rows of it.
        half = half + _padding(far, 2 * kappa + 8, rounding.FLUSHED)
        if best:
            usable = usable & (radius <= half + pad)
    center, radius = jnp.where(usable, center, middle), jnp.where(usable, radius + pad, half)
    return usable, center, radius, jnp.where(usable, 4 * size, 2 * far)


def _met(natural: Interval, slope: list[Any], center: Any, radius: Any, states: States) -> Interval:
    """A range met with the image of a form; the range itself where rounding makes the two miss each other."""
    middle, spread = center, radius
    for k, part in enumerate(slope):
        if not _is_zero(part):
            middle, spread = middle + part * states.center[k], spread + scale(abs(part), states.radius[k])
    met = Interval.unchecked(raised(natural.lower, middle - spread), cut(natural.upper, middle + spread))
    return nan_to_unbounded(choose(met.lower <= met.upper, met, natural))


def _wave_size(curve: Wave, size: Any) -> Any:
    """The q of a sine or cosine (`wave_atom`), of which nothing but its range is used beyond `LIMIT`."""
    size = jax.lax.stop_gradient(size)
    return 3 * jnp.minimum(size + np.dtype(size.dtype).type(curve.cosine), LIMIT[size.dtype.name])


def _wave_line(curve: Wave, t: _Argument, terms: int) -> Line:
    """A sine or cosine as a `Line` of an argument that is not linear in the states."""
    a, b = t.range.lower, t.range.upper
    m, r = 0.5 * a + 0.5 * b, 0.5 * b - 0.5 * a
    size = jnp.where(jnp.isfinite(t.size), t.size, jnp.inf)
    slope, center, radius, natural, _ = wave_atom(curve.cosine, m, r, size, terms)
    usable = size < LIMIT[m.dtype.name]
    return Line(usable, slope, center, radius, _wave_size(curve, size), natural)


def _curve(atom: Atom) -> Any:
    """The function of one variable that an atom is, None for others."""
    if atom.name == "reciprocal":
        return RECIPROCAL
    if atom.name == "mul":
        return SQUARE if atom.arguments[0] is atom.arguments[1] else None
    if atom.name == "integer_pow" and atom.equation.params["y"] not in (0, 1):
        return power(float(atom.equation.params["y"]))
    if atom.name == "pow" and not atom.arguments[1].coefficients and atom.arguments[0].coefficients:
        exponent = float(atom.arguments[1].constant)
        return power(exponent) if exponent not in (0.0, 1.0) else None
    return CURVES.get(atom.name)


@dataclass
class _Bounded:
    slope: Any
    center: Any
    radius: Any
    range: Interval
    value: Any = None
    size: Any = None

    def magnitude(self, states: States) -> Any:
        """The q of an atom, at least its range: ``sum |slope_i| m_i + |center| + radius``."""
        if self.size is None:
            size = jnp.maximum(abs(self.range.lower), abs(self.range.upper))
            form = abs(self.center) + self.radius
            for k, part in enumerate(self.slope):
                form = form if _is_zero(part) else form + scale(abs(part), states.magnitude[k])
            self.size = jnp.maximum(size, form)
        return jax.lax.stop_gradient(self.size)


def _thin(x: Any, terms: int) -> Interval:
    """A point, widened for rows."""
    error = wider(abs(x), terms)
    return Interval.unchecked(x - error, x + error)


def _values(found: list[Any], dtype: Any) -> tuple[Any, Any]:
    """Middles and half-widths, of thin boxes or as they are; where one is infinite, its middle is 0."""
    if not found:
        return jnp.zeros(0, dtype), jnp.zeros(0, dtype)
    pairs = []
    for v in found:
        if isinstance(v, Interval):
            v = center_and_radius(v)
        pairs.append(v)
    value, error = (jnp.stack([jnp.asarray(pair[i], dtype) for pair in pairs]) for i in (0, 1))
    return value, error


def _nothing(n: int, states: States) -> _Bounded:
    zero = np.zeros((), states.center.dtype)
    return _Bounded([zero] * n, zero, zero, Interval.unchecked(zero, zero))


def _stacked(found: list[_Bounded], at: list[Any], states: States) -> AtomBounds:
    n, dtype = len(states.center), states.center.dtype
    value, error = _values(at, dtype) if len(at) == len(found) else (None, None)
    if not found:
        none = jnp.zeros(0, dtype)
        return AtomBounds(jnp.zeros((0, n), dtype), none, none, Interval.unchecked(none, none), value, error)

    def joined(parts: list[Any]) -> Any:
        return _joined(parts, dtype)

    natural = Interval.unchecked(joined([b.range.lower for b in found]), joined([b.range.upper for b in found]))
    slope, center, radius = ([getattr(b, name) for b in found] for name in ("slope", "center", "radius"))
    return AtomBounds(joined([joined(part) for part in slope]), joined(center), joined(radius), natural, value, error)


def _joined(parts: list[Any], dtype: Any) -> Any:
    return jnp.stack([jnp.asarray(part, dtype) for part in parts])


def _from_node(node: Node, states: States, terms: int) -> _Bounded:
    natural = nan_to_unbounded(node.range)
    n, dtype = len(states.center), states.center.dtype
    if node.form is None:
        slope: Any = np.zeros(n, dtype)
        offset = natural
    else:
        slope, offset = node.form.slope, nan_to_unbounded(node.form.folded())
    found = widened_atoms(slope, offset, natural, states, terms)
    parts = [np.asarray(slope[k]) if isinstance(slope, np.ndarray) else slope[k] for k in range(n)]
    return _Bounded(parts, found.center, found.radius, found.range)


def _number(t: Linear, dtype: Any) -> Any:
    return np.asarray(float(t.constant), dtype)


def _rule(atom: Atom, nodes: list[Any]) -> Node:
    if atom.name == "reciprocal":
        return apply(RECIPROCAL, nodes[0])
    if atom.name == "mul":
        return apply(SQUARE, nodes[0]) if atom.arguments[0] is atom.arguments[1] else multiply(*nodes)
    return ELEMENTWISE[atom.name](atom.equation, *nodes)

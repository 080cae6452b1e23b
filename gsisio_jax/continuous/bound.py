"""A guaranteed bound of what a discrete step leaves out: theory 15, and in short here.

Let ``z = (x, u, d)``, u and d constant over the step, ``F(z) = f(x, u) + c + G d`` with c the centre of the disturbance
box, and ``F_1 = F, F_{k+1} = (dF_k/dx) F``, the time derivatives of a solution. For a box X of states at the start of a
step of length h:

1. *Where the plant is.* A box E with ``X + [0, h] (F(E) + W - c)`` inside E holds every solution over the step (Picard
   and Schauder; F is Lipschitz on E, which is checked). Of a plant that never leaves B, met with B on both sides.
2. *Without disturbance*: ``x(h) = x + sum_{k<=q} h^k/k! F_k(x) + h^{q+1}/(q+1)! r``, and r lies in the range of F_{q+1}
   on E, and in ``J F(E)`` where J encloses the difference quotients of F_q. All F_k up to q must be Lipschitz on E
   (finite J), kinks allowed.
3. *Unknown input*: the terms of the sum that contain d vanish for d = 0, so they are ``D d`` with D in an enclosure of
   their derivatives by d; the discrete G is subtracted from that.
4. *Runge-Kutta*: up to order 4 its terms are those of the sum, the rest is ``h^5/120`` times a fifth derivative by the
   step length.
5. *Disturbance*: two solutions that differ in w(t) - c alone, ``|w - c| <= r``, differ by e with ``e' = A(t) e + w -
   c`` and A(t) in the enclosure of dF/dx on E. With M the larger of both sides on the diagonal and the magnitude off
   it, ``|e(h)| <= integral of exp(M s) r ds`` over [0, h] (comparison; exp(M s) is nonnegative).
6. *Rounding* of the coefficients of the method in the floating type of the run.

Every number here is rounded outward.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import factorial
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.continuous import maps, sides
from gsisio_jax.continuous.enclosure import Around, box_text
from gsisio_jax.continuous.exponential import integral_upper
from gsisio_jax.continuous.field import Field
from gsisio_jax.continuous.sides import Sides
from gsisio_jax.scalar.numpy_program import numpy_function

_LESS = 0.8  # of what the order at hand leaves out: then a lower one is named
_WIDE = 0.01  # of the region


@dataclass
class StepError:
    """Bounds of one method on boxes of states.

    Attributes:
        order: q, the order up to which the method has the terms of the solution.
        G: the discrete matrix of the unknown input, (n, p).
        spread: radius of the disturbance, (n,).
        eps: of the floating type of the run.
        never: box that the plant never leaves, (n,); infinite sides where nothing is known.
    """

    field: Field
    h: float
    order: int
    runge_kutta: bool
    G: np.ndarray
    u: Sides
    d: Sides
    spread: np.ndarray
    eps: float
    never: Sides

    def on(self, x: Sides) -> Sides:
        """What to add to w for starts in the box x."""
        around = self.around.of(x)
        rate = self.around.rate(around)
        parts = [self._remainder(around, rate), self._rounding(x)]
        if self.field.p:
            parts.append(self._mismatch(x))
        if self.runge_kutta:
            parts.append(self._of_method(x))
        if self.spread.any():
            parts.append(sides.symmetric(self._spreading(around)))
        return sides.add(*parts)

    @cached_property
    def left_by(self) -> dict[int, np.ndarray]:
        """Width of what orders 1, 2, ... (keys 0, 1, ...) leave out without the unknown input, the largest of all boxes
        so far: known besides."""
        return {}

    def notes(self, error: Sides, region: Sides, cut: bool) -> tuple[str, ...]:
        """What would make the bound smaller, where that is seen."""
        width, found = error[1] - error[0], []
        with np.errstate(all="ignore"):
            ratios = {
                k + 1: np.nanmax(left / self.left_by[self.order - 1], initial=0) for k, left in self.left_by.items()
            }
            best = min(ratios, key=lambda order: ratios[order])
            if best < self.order and ratios[best] < _LESS and not self.runge_kutta:
                found.append(
                    f"order={best} leaves out less than order={self.order} (at most {ratios[best]:.2g} times as much): "
                    "bounds of high derivatives on this region are wider than the powers of dt make up for"
                )
            rows = np.flatnonzero(width > _WIDE * (region[1] - region[0]))
        if len(rows):
            states = ", ".join(str(row + 1) for row in rows)
            found.append(
                f"the error of one step is wider than a hundredth of the region in state {states}: a shorter dt, "
                f"another order or a smaller region{'' if cut else ', or cells=4 or more,'} would make it smaller"
            )
        elif self.around.parts_pay and not cut:
            found.append(
                "f is bounded much better on parts of the region: cells=4 or more would make the error smaller"
            )
        return tuple(found)

    @cached_property
    def around(self) -> Around:
        """Where the plant is within a step, and how fast it moves there."""
        return Around(self._rate, self.h, self.spread, self.never)

    def _rate(self, around: Sides) -> Sides:
        return self._range("rate", self.field.of_z, sides.joined(around, self.u, self.d))

    def _range(self, name: str, function: Callable[[Any], Any], around: Sides) -> Sides:
        return sides.sides(self._bounds(name, inclusion.affine, function, around).range)

    def _bounds(self, name: str, transform: Callable[..., Any], function: Callable[..., Any], *around: Sides) -> Any:
        """Of the function of that name on boxes, in NumPy: the few times that it is asked for are not worth compiling
        hundreds of operations. Of high derivatives there are thousands, and tracing takes longer than that."""
        boxes, programs = [sides.box(pair) for pair in around], self._programs
        if self.order > 3 and name != "rate":
            return transform(function)(*boxes)
        if name not in programs:
            programs[name] = numpy_function(transform(function), *boxes)
        return programs[name](*boxes)

    @cached_property
    def _programs(self) -> dict[str, Callable[..., Any]]:
        return {}

    @cached_property
    def _solution(self) -> Callable[..., Any]:
        """``(x, u, d)`` to the derivatives of the solution, one more than the order."""
        return self.field.derivatives(self.order + 1)

    def _of_z(self, function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda z: function(*self.field.split(z))

    def _lipschitz(self, around: Sides) -> Sides:
        """Enclosure of the derivatives by x of all F_k up to the order, (q, n, n)."""
        function, q = self.field.rate, self.order
        if q > 1:
            function = _first(self._solution, q)
        found = sides.sides(self._bounds("slopes", inclusion.jacobian, function, around, self.u, self.d))
        found = tuple(side.reshape(q, self.field.n, self.field.n) for side in found)
        if not np.isfinite(found).all():
            k = int(np.argwhere(~np.isfinite(found).all((0, 2, 3)))[0, 0])
            raise ValueError(_rough(k, q, around))
        return found[0], found[1]

    def _remainder(self, around: Sides, rate: Sides) -> Sides:
        q = self.order
        slopes = self._lipschitz(around)
        for k in range(q):
            left = sides.times(_share(self.h, k + 2), sides.apply((slopes[0][k], slopes[1][k]), rate))
            self.left_by[k] = np.maximum(self.left_by.get(k, 0), left[1] - left[0])
        found = sides.apply((slopes[0][-1], slopes[1][-1]), rate)
        if not self.field.own_derivative:
            everything = sides.joined(around, self.u, self.d)
            try:
                last = self._range("last", self._of_z(lambda *a: self._solution(*a)[q]), everything)
            except (inclusion.UnknownPrimitiveError, NotImplementedError):  # no derivative of f to be had
                if q > 1:
                    raise
            else:
                found = sides.meet(found, last)
        return sides.times(_share(self.h, q + 1), found)

    def _mismatch(self, x: Sides) -> Sides:
        """The terms with d of the solution up to the order, without ``G d``."""
        powers = [maps.coefficient(self.h, k) for k in range(1, self.order + 1)]
        solution = _first(self._solution, self.order) if self.order > 1 else lambda *a: self.field.rate(*a)[None]

        def terms(d: Any, x: Any, u: Any) -> Any:
            found = solution(x, u, d)
            return sum(c * found[k] for k, c in enumerate(powers)) - jnp.asarray(self.G) @ d

        from_zero = np.minimum(self.d[0], 0), np.maximum(self.d[1], 0)
        slopes = self._bounds("terms of d", inclusion.jacobian, terms, from_zero, x, self.u)
        found = sides.apply(sides.sides(slopes), self.d)
        # The powers of h are rounded, in two terms of every order.
        sizes = self._range("solution", self._of_z(solution), sides.joined(x, self.u, from_zero))
        radius = np.finfo(np.float64).eps * (np.array(powers) @ sides.magnitude(sizes))
        return sides.add(found, sides.symmetric(radius * (1 + 1e-9) + 1e-300))

    @cached_property
    def _method(self) -> Callable[..., Any]:
        return self.field.method_derivatives(maps.rk4, self.order + 1)

    def _length(self) -> Sides:
        return np.zeros(1), np.array([np.nextafter(self.h * (1 + self.eps), np.inf)])

    def _of_method(self, x: Sides) -> Sides:
        q, n = self.order, self.field.n
        terms = _first(lambda s, x, u: self._method(s[0], x, u), q)
        slopes = self._bounds("slopes of method", inclusion.jacobian, terms, self._length(), x, self.u)
        if not np.isfinite(np.array(sides.sides(slopes))).all():
            raise ValueError(_rough(q - 1, q, x))
        everything = sides.joined(self._length(), x, self.u)
        last = self._range("last of method", lambda z: self._method(z[0], z[1 : n + 1], z[n + 1 :])[q], everything)
        return sides.negative(sides.times(_share(self.h, q + 1), last))

    def _spreading(self, around: Sides) -> np.ndarray:
        low, high = sides.sides(self._bounds("spread", inclusion.jacobian, self.field.rate, around, self.u, self.d))
        larger = sides.magnitude((low, high))
        np.fill_diagonal(larger, np.diagonal(high))
        return integral_upper(larger, self.spread, self.h)

    def _rounding(self, x: Sides) -> Sides:
        """Coefficients are off by eps of themselves, those of Runge-Kutta by twice that (the step, and its sixth)."""
        none = np.zeros(self.field.p), np.zeros(self.field.p)
        everything = sides.joined(x, self.u, none)
        if self.runge_kutta:
            n = self.field.n
            start = sides.joined(self._length(), x, self.u)
            stages = self._range("stages", lambda z: _stages(self.field, z[0], z[1 : n + 1], z[n + 1 :]), start)
            first = sides.magnitude(stages).max(0)
            slopes = sides.magnitude(
                self._range("first of method", lambda z: self._method(z[0], z[1 : n + 1], z[n + 1 :])[0], start)
            )
            radius = 2 * self.eps * self.h * (first + slopes)
        elif self.order == 1:
            radius = self.eps * self.h * sides.magnitude(self._range("rate", self.field.of_z, everything))
        else:
            terms = self._range("terms", self._of_z(_first(self._solution, self.order)), everything)
            weights = [maps.coefficient(self.h, k) for k in range(1, self.order + 1)]
            radius = self.eps * (np.array(weights) @ sides.magnitude(terms))
        if self.field.p:
            radius = radius + self.eps * (abs(self.G) @ sides.magnitude(self.d))
        return sides.symmetric(radius * (1 + 1e-9) + 1e-300)


def _first(function: Callable[..., Any], count: int) -> Callable[..., Any]:
    return lambda *args: function(*args)[:count]


def _stages(field: Field, s: Any, x: Any, u: Any) -> Any:
    found: list[Any] = []

    def watched(x: Any) -> Any:
        found.append(field.known(x, u))
        return found[-1]

    maps.rk4(watched, s, x)
    return jnp.stack(found)


def _share(h: float, k: int) -> Sides:
    """``h^k / k!`` between two floating numbers."""
    value = float(Fraction(h) ** k / factorial(k))
    return np.asarray(np.nextafter(value, -np.inf)), np.asarray(np.nextafter(value, np.inf))


def _rough(k: int, q: int, where: Sides) -> str:
    what = "f" if k == 0 else f"derivative {k} of f along the solution"
    remedy = (
        "give a region without the jump, or the infinite slope"
        if k == 0
        else 'use method="euler", which needs no derivative of f, or a region without the kink'
    )
    order = f"a method of order {q} needs it; " if k else "no step has a bound then; "
    return f"discretize: {what} is not Lipschitz on {box_text(where)}: {order}{remedy}"

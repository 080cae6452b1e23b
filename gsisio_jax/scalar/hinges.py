"""Piecewise-linear functions of single numbers, in fractions: sums of clips, maxima, ramps of one variable as what
they are together.

A number of a program that is made by sums, multiples, ``max``, ``min``, ``abs`` and ``clamp`` is

    constant + sum_b linear_b b + sum_t sum_k jump_tk max(t - k, 0),

b the numbers that are not made so (inputs, products, sines), t linear functions of these: its directions. Knots k and
jumps of slope are fractions, so what sums to one function of t is one, with the slopes that it has: of
``sum_i clip(t, i, i + 1)`` every difference quotient lies in [0, 1], where the sum of the parts says [0, K].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from typing import Any

import jax.numpy as jnp

from gsisio_jax.scalar.graph import Number, is_constant

BENT = {"max", "min", "abs", "clamp"}
_SUMS = {"add", "sub", "neg", "mul", "div", "copy", "stop_gradient", "convert_element_type"}
_FEW = 2  # bends of one direction that are left to the rules for single operations: those of a clip
_MOST_KNOTS = 1000
Direction = tuple[tuple[int, Fraction], ...]


@dataclass
class Bent:
    """A number in the form above.

    Attributes:
        linear: by `Number.order`, without zeros.
        constant: the constant.
        hinges: direction: {knot: jump}, without zeros.
        bends: direction: how many operations bend along it.
        joint: several summands, or more than `_FEW` operations, bend along one direction.
    """

    linear: dict[int, Fraction] = field(default_factory=dict)
    constant: Fraction = Fraction(0)
    hinges: dict[Direction, dict[Fraction, Fraction]] = field(default_factory=dict)
    bends: dict[Direction, int] = field(default_factory=dict)
    joint: bool = False

    def plus(self, other: Bent, sign: int = 1) -> Bent:
        both = [t for t in self.bends if t in other.bends]
        hinges = dict(self.hinges)
        for t, jumps in other.hinges.items():
            hinges[t] = _merged(hinges.get(t, {}), jumps, sign)
        bends = self.bends | other.bends | {t: self.bends[t] + other.bends[t] for t in both}
        return Bent(
            _merged(self.linear, other.linear, sign),
            self.constant + sign * other.constant,
            {t: jumps for t, jumps in hinges.items() if jumps},
            bends,
            self.joint or other.joint or bool(both),
        )

    def times(self, factor: Fraction) -> Bent:
        if not factor:
            return Bent()
        linear, hinges = _times(self.linear, factor), {t: _times(jumps, factor) for t, jumps in self.hinges.items()}
        return Bent(linear, factor * self.constant, hinges, self.bends, self.joint)

    @property
    def is_constant(self) -> bool:
        return not self.linear and not self.hinges

    def bases(self) -> list[int]:
        """All numbers that it depends on."""
        return sorted({*self.linear, *(b for t in self.hinges for b, _ in t)})

    def tables(self) -> tuple[Bent, list[tuple[Direction, Fraction, Fraction, dict[Fraction, Fraction]]]]:
        """What is linear, and for every direction t the slope and the constant at t = 0 beside the hinges.

        A table takes what is linear along its direction, and the first one the constant: together these are better
        known.
        """
        rest, constant, found = dict(self.linear), self.constant, []
        for t, jumps in self.hinges.items():
            slope = rest.get(t[0][0], Fraction(0)) / t[0][1]
            if any(rest.get(b, Fraction(0)) != slope * weight for b, weight in t):
                slope = Fraction(0)
            for b, _ in t if slope else ():
                del rest[b]
            found.append((t, slope, constant, jumps))
            constant = Fraction(0)
        return Bent(rest, constant), found


def _merged(a: dict[Any, Fraction], b: dict[Any, Fraction], sign: int) -> dict[Any, Fraction]:
    merged = dict(a)
    for key, value in b.items():
        merged[key] = merged.get(key, Fraction(0)) + sign * value
    return {key: value for key, value in merged.items() if value}


def _times(a: dict[Any, Fraction], factor: Fraction) -> dict[Any, Fraction]:
    return {key: factor * value for key, value in a.items()}


def _along(linear: dict[int, Fraction]) -> tuple[Direction, Fraction]:
    """A linear function as a multiple of its direction, of which the first weight is in [1, 2): times a power of two,
    weights that are floating numbers stay some."""
    ordered = sorted(linear.items())
    first = ordered[0][1]
    size = abs(first)
    scale = Fraction(2) ** (size.numerator.bit_length() - size.denominator.bit_length())
    scale = scale / 2 if scale > size else scale
    scale = scale if first > 0 else -scale
    return tuple((b, weight / scale) for b, weight in ordered), scale


def positive_part(w: Bent) -> Bent | None:
    """``max(w, 0)``; None where w is no function of one direction."""
    if w.is_constant:
        return Bent(constant=max(w.constant, Fraction(0)))
    if len(w.hinges) > 1:
        return None
    if w.hinges:
        ((t, jumps),) = w.hinges.items()
        own, slope = _along(w.linear) if w.linear else (t, Fraction(0))
        if own != t:
            return None
    else:
        (t, slope), jumps = _along(w.linear), {}
    if len(jumps) > _MOST_KNOTS:
        return None
    cuts, slopes = _signed_segments(slope, w.constant, jumps)
    new = {k: b - a for k, (a, b) in zip(cuts, pairwise(slopes), strict=True) if a != b}
    first = cuts[0] if cuts else Fraction(0)
    at = max(value_at(slope, w.constant, jumps, first), Fraction(0))
    linear = {b: slopes[0] * weight for b, weight in t} if slopes[0] else {}
    bends = w.bends.get(t, 0) + 1
    return Bent(linear, at - slopes[0] * first, {t: new} if new else {}, {t: bends}, w.joint or bends > _FEW)


def value_at(slope: Fraction, constant: Fraction, jumps: dict[Fraction, Fraction], t: Fraction) -> Fraction:
    """``constant + slope t + sum jump max(t - k, 0)``."""
    return constant + slope * t + sum((jump * (t - k) for k, jump in jumps.items() if k < t), Fraction(0))


def _signed_segments(
    slope: Fraction, constant: Fraction, jumps: dict[Fraction, Fraction]
) -> tuple[list[Fraction], list[Fraction]]:
    """Knots and roots of a function in order, and the slopes of its positive part on the segments between them."""
    knots = sorted(jumps)
    slopes = [slope]
    for k in knots:
        slopes.append(slopes[-1] + jumps[k])
    values = [value_at(slope, constant, jumps, k) for k in knots]
    cuts: list[Fraction] = []
    for i, s in enumerate(slopes):
        # The segment that ends at knot i: the line through one of its ends.
        at, value = (knots[max(i - 1, 0)], values[max(i - 1, 0)]) if knots else (Fraction(0), constant)
        if s:
            root = at - value / s
            if (i == 0 or root > knots[i - 1]) and (i == len(knots) or root < knots[i]):
                cuts.append(root)
        if i < len(knots):
            cuts.append(knots[i])
    inner = [(a + b) / 2 for a, b in pairwise(cuts)]
    points = [cuts[0] - 1, *inner, cuts[-1] + 1] if cuts else [Fraction(0)]
    found = []
    for point in points:
        own = slopes[sum(k < point for k in knots)]
        found.append(own if value_at(slope, constant, jumps, point) > 0 else Fraction(0))
    return cuts, found


class Bends:
    """Reads numbers as `Bent`; `numbers` has those that the result speaks of, by `Number.order`."""

    def __init__(self) -> None:
        self.numbers: dict[int, Number] = {}
        self._read: dict[int, Bent] = {}

    def of(self, value: Any) -> Bent | None:
        """A number or constant; None for a constant that is not finite."""
        if is_constant(value):
            number = float(value)
            return Bent(constant=Fraction(number)) if math.isfinite(number) else None
        stack = [value]
        while stack:
            number = stack[-1]
            if number.order in self._read:
                stack.pop()
                continue
            looks = number.name in _SUMS | BENT and _is_real(number)
            waiting = [v for v in number.operands if isinstance(v, Number) and v.order not in self._read]
            if looks and waiting:
                stack += waiting
                continue
            found = self._one(number) if looks else None
            if found is None:
                self.numbers[number.order] = number
                found = Bent({number.order: Fraction(1)})
            self._read[number.order] = found
        return self._read[value.order]

    def _one(self, number: Number) -> Bent | None:
        name = number.name
        operands: list[Bent] = []
        for v in number.operands:
            found = self._read[v.order] if isinstance(v, Number) else self.of(v)
            if found is None or not _is_real(v):
                return None
            operands.append(found)
        first, last = operands[0], operands[-1]
        if name in ("add", "sub"):
            return first.plus(last, 1 if name == "add" else -1)
        if name == "neg":
            return first.times(Fraction(-1))
        if name == "mul":
            for a, b in ((first, last), (last, first)):
                if a.is_constant:
                    return b.times(a.constant)
            return None
        if name == "div":
            return first.times(1 / last.constant) if last.is_constant and last.constant else None
        if name in ("max", "min"):
            return _larger(first, last) if name == "max" else _smaller(first, last)
        if name == "abs":
            return _larger(first, first.times(Fraction(-1)))
        if name == "clamp":
            raised = _larger(operands[0], operands[1])
            return None if raised is None else _smaller(raised, operands[2])
        return first


def _is_real(value: Any) -> bool:
    return jnp.issubdtype(value.dtype, jnp.floating) and jnp.finfo(value.dtype).bits >= 32


def _larger(a: Bent, b: Bent) -> Bent | None:
    """``max(a, b) = b + max(a - b, 0)``."""
    part = positive_part(a.plus(b, -1))
    return None if part is None else _with_part(a, b, b.plus(part), part)


def _smaller(a: Bent, b: Bent) -> Bent | None:
    """``min(a, b) = a - max(a - b, 0)``."""
    part = positive_part(a.plus(b, -1))
    return None if part is None else _with_part(a, b, a.plus(part, -1), part)


def _with_part(a: Bent, b: Bent, total: Bent, part: Bent) -> Bent:
    """What the bookkeeping of a sum says twice: the positive part counts the bends of both already."""
    bends = a.bends | b.bends | part.bends
    joint = a.joint or b.joint or part.joint or any(t in b.bends for t in a.bends)
    return Bent(total.linear, total.constant, total.hinges, bends, joint)

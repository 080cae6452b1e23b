"""A step of the paper's example (S1) written by hand over single numbers, gains (handwritten_design.json) constants.

Contractors are those of `estimate` with its default design, rounded outward in float64. Without missing rows, state
bounds or a proof of its error bounds: it is there to be compared with.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.handwritten_parts import (
    EPS,
    Box,
    Boxes,
    add,
    combined,
    least,
    linear,
    magnitude,
    meet,
    middle,
    most,
    negative,
    row_times,
    sin_cos,
    wave,
    where,
)  # fmt: skip

NOISE, SWEEPS = 0.2, 2
_G = ((0, -0.1), (0.2, -0.2))
_READ = json.loads(Path(__file__).with_name("handwritten_design.json").read_text())
D: dict[str, Any] = {
    key: {k: None if v is None else np.asarray(v) for k, v in value.items()}
    if isinstance(value, dict)
    else np.asarray(value)
    for key, value in _READ.items()
}
_GAINS, _INVERSES, _T2, _C = D["gains"], D["inverses"], D["T2"][0], D["C"][0]
_N = _GAINS["remainder"][0][:, 0]
_PLANES = tuple[list[Any], list[Any], list[Any]]


def run(lower: Any, upper: Any, y: Any, final: bool) -> Any:
    """Boxes (2, B) and a record (T, 2): the last widths (B, 2), or boxes of x and d and the status of all steps.

    The first measurement is only read by the second step, which is the first one here.
    """
    x = [(lower[i], upper[i]) for i in range(2)]

    def wide(tree: Any) -> Any:
        return jax.tree.map(lambda q: jnp.broadcast_to(jnp.asarray(q, float), lower.shape[1:]), tree)

    def body(carry: Any, row: Any) -> Any:
        carry, out = step(carry, [row[0], row[1]])
        return wide(carry), None if final else out

    carry = {"x": x, "h": _on_box(x), "y": [y[0, 0], y[0, 1]]}
    last, kept = jax.lax.scan(body, wide(carry), y[1:])
    return jnp.stack([high - low for low, high in last["x"]], 1) if final else kept


def step(carry: Any, y: list[Any]) -> Any:
    """The next carry; boxes of x[k] and d[k-1], and the status."""
    x, (slopes, offsets, ranges), before = carry["x"], carry["h"], carry["y"]
    w = [(-NOISE, NOISE)] * 2
    shift = [*w, *((-(q + NOISE), -(q - NOISE)) for q in before)]
    output = [(q - NOISE, q + NOISE) for q in y]
    known = shift + output
    sizes = [magnitude(box) for box in known]
    centred = middle(x, 4 * EPS)

    def linear_part(bank: Any, k: int, i: int) -> Box:
        return linear([*bank["residual"][k, i], *bank["output"][k, i]], known, sizes)

    range_sizes = [magnitude(box) for box in ranges]

    def predicted(bank: Any, k: int, i: int) -> Box:
        row = bank["residual"][k, i]
        along = [combined(row, [slope[j] for slope in slopes]) for j in range(2)]
        joint = add(row_times(along, centred), linear(row, offsets))
        return add(meet(joint, linear(row, ranges, range_sizes)), linear_part(bank, k, i))

    right = [predicted(_GAINS, 0, i) for i in range(2)]
    fixed = [[predicted(_INVERSES, k, i) for i in range(2)] for k in range(4)]
    new, plane, slacks = _sweeps(right, linear(_T2, output, sizes[4:]))
    d = _inputs(new, fixed, plane)
    new = [meet(new[i], add(ranges[i], w[i], linear(_G[i], d))) for i in range(2)]

    applies = _inside(x) & _inside(new)
    center = [jnp.where(applies, q, 0.0) for q in centred[0]]
    far = [jnp.where(applies, q, 0.0) for q in centred[1]]
    values = _at_point(center)

    def around(bank: Any, i: int, growth: Any) -> Box:
        row = bank["residual"][0, i]
        value = combined(row, values)
        radius = float(growth[0]) * far[0] + float(growth[1]) * far[1]
        size = sum(abs(float(a)) * abs(v) for a, v in zip(row, values, strict=True))
        radius = radius + size * (8 * EPS) + 64 * EPS
        return add((value - radius, value + radius), linear_part(bank, 0, i))

    joint = [meet(right[i], around(_GAINS, i, D["growth"][i])) for i in range(2)]
    new = _certified(new, joint, center, applies)
    d = _inputs(new, fixed, plane)
    for i in range(2):
        bound = add(linear(_INVERSES["state"][0][i], new), around(_INVERSES, i, D["input_growth"][i]))
        d[i] = meet(d[i], where(applies, bound))
    exact = [negative(add(box, s)) for box, s in zip(ranges, shift, strict=True)]
    exact[:2] = [add(new[i], exact[i]) for i in range(2)]
    exact_sizes = [magnitude(box) for box in exact]
    for rows in D["rows"]:
        d = [meet(d[i], linear(rows[i], exact, exact_sizes)) for i in range(2)]
    balances = [linear(row, exact, exact_sizes) for row in D["circuits"]]
    slacks += [least(high, -low) for low, high in balances] + [high - low for low, high in d]
    margin = slacks[0]
    for slack in slacks[1:]:
        margin = least(margin, slack)
    conflict = margin < 0
    new = [where(~conflict, box) for box in new]
    status = conflict.astype(jnp.int32) | (~applies).astype(jnp.int32) * 8
    return {"x": new, "h": _on_box(new), "y": y}, (new, d, status)


def _outputs(x: Boxes) -> tuple[Any, Any]:
    sizes = [magnitude(box) for box in x]
    return wave(linear((0.3, 0.2), x, sizes)), wave(x[0])


def _on_box(x: Boxes) -> _PLANES:
    """Slopes, boxes of what is left, and ranges of [f1 f2 g1 g2]."""
    sizes = [magnitude(box) for box in x]
    first, (second, third) = wave(linear((-0.2, 0.3), x, sizes)), _outputs(x)
    slopes = [
        (0.6 - 0.22 * first[0], -0.12 + 0.33 * first[0]),
        (-0.2, -0.14),
        (0.2 + 0.24 * second[0], 0.65 + 0.16 * second[0]),
        (third[0], 0.0),
    ]
    offsets = [tuple(1.1 * e for e in first[1]), (0.0, 0.0), tuple(0.8 * e for e in second[1]), third[1]]
    ranges = [
        linear((0.6, -0.12, 1.1), [*x, first[2]]),
        linear((-0.2, -0.14), x, sizes),
        linear((0.2, 0.65, 0.8), [*x, second[2]]),
        third[2],
    ]
    return slopes, offsets, ranges


def _at_point(x: list[Any]) -> list[Any]:
    first, _ = sin_cos(-0.2 * x[0] + 0.3 * x[1])
    second, _ = sin_cos(0.3 * x[0] + 0.2 * x[1])
    f = 0.6 * x[0] - 0.12 * x[1] + 1.1 * first, -0.2 * x[0] - 0.14 * x[1]
    return [*f, 0.2 * x[0] + 0.65 * x[1] + 0.8 * second, sin_cos(x[0])[0]]


def _free(x: Boxes) -> tuple[tuple[Any, Any], Box]:
    """Slopes and box of what is left of T2 g."""
    (second, third), (a, b) = _outputs(x), map(float, _T2)
    slope = a * (0.2 + 0.24 * second[0]) + b * third[0], a * (0.65 + 0.16 * second[0])
    return slope, linear((0.8 * a, b), [second[1], third[1]])


def _sweeps(right: list[Box], z: Box) -> tuple[list[Box], Any, list[Any]]:
    """The box of x[k] from y[k] and the dynamics, the plane of T2 g that was used last, and slacks."""
    low, high = D["first_off"]
    first = (low[0] + 0 * right[0][0], high[0] + 0 * right[0][0])
    shifted = [linear((1, -_N[i]), [right[i], first]) for i in range(2)]
    x = [linear(D["first_maps"][0][i], shifted) for i in range(2)]
    slacks: list[Any] = []
    slope, offset = (None, None), (None, None)
    for _ in range(SWEEPS):
        sizes = [magnitude(box) for box in x]
        slope, offset = _free(x)
        free = add(z, negative(offset))
        total = row_times(slope, middle(x))
        slacks.append(least(total[1] - free[0], free[1] - total[0]))
        met = [meet(x[i], _strip(slope, x, free, i)) for i in range(2)]
        # x + N psi(x) in the right side: the inverse of a matrix that differs from I by one of rank 1.
        d = slope[0] - _C[0], slope[1] - _C[1]
        den = 1 + d[0] * _N[0] + d[1] * _N[1]
        ok = abs(den) > 1e-6
        inverse = jnp.where(ok, 1 / jnp.where(ok, den, 1.0), 0.0)
        centred = middle([linear((1, -_N[i]), [right[i], offset]) for i in range(2)])
        error = (sizes[0] + sizes[1]) * (64 * EPS) * (1 + abs(inverse))
        for i in range(2):
            row = [float(i == j) - _N[i] * inverse * d[j] for j in range(2)]
            a, b = row_times(row, centred)
            met[i] = meet(met[i], where(ok, (a - error, b + error)))
        slacks += [b - a for a, b in met]
        x = met
    return x, (slope, offset), slacks


def _strip(slope: Any, x: Boxes, free: Box, i: int) -> Box:
    """The bound of x[i] that ``slope x in free`` leaves."""
    p, q = slope[1 - i] * x[1 - i][0], slope[1 - i] * x[1 - i][1]
    own = add(free, negative((least(p, q), most(p, q))))
    usable = abs(slope[i]) > 1e-9
    inverse = 1 / jnp.where(usable, slope[i], 1.0)
    a, b = inverse * own[0], inverse * own[1]
    error = (abs(a) + abs(b)) * (4 * EPS)
    return where(usable, (least(a, b) - error, most(a, b) + error))


def _inputs(x: Boxes, fixed: list[list[Box]], plane: Any) -> list[Box]:
    """The box of d[k-1] from every left inverse."""
    slope, offset = plane
    sizes, centred = [magnitude(box) for box in x], middle(x)
    found = []
    for i in range(2):
        bounds = []
        for k in range(4):
            state, remainder = _INVERSES["state"][k, i], float(_INVERSES["remainder"][k, i, 0])
            if remainder:
                row = [float(state[j]) - remainder * (slope[j] - _C[j]) for j in range(2)]
                bounds.append(add(row_times(row, centred), linear((-remainder,), [offset]), fixed[k][i]))
            else:
                bounds.append(add(linear(state, x, sizes), fixed[k][i]) if state.any() else fixed[k][i])
        found.append(meet(*bounds))
    return found


def _inside(x: Boxes) -> Any:
    low, high = D["region"]
    return (x[0][0] >= low[0]) & (x[0][1] <= high[0]) & (x[1][0] >= low[1]) & (x[1][1] <= high[1])


def _certified(x: list[Box], joint: list[Box], center: list[Any], applies: Any) -> list[Box]:
    """The centred form of the certificate, where it applies."""
    joint = [(jnp.where(applies, a, -1.0), jnp.where(applies, b, 1.0)) for a, b in joint]
    mid = [0.5 * (a + b) for a, b in joint]

    def kept(value: Any, i: int) -> Any:
        low, high = (jnp.where(applies, side, center[i]) for side in x[i])
        return least(most(value, low), high)

    def psi(c: list[Any]) -> Any:
        g = _at_point(c)[2:]
        return float(_T2[0]) * g[0] + float(_T2[1]) * g[1] - float(_C[0]) * c[0] - float(_C[1]) * c[1]

    c = [kept(mid[i], i) for i in range(2)]
    for _ in range(3):
        value = psi(c)
        c = [kept(mid[i] - _N[i] * value, i) for i in range(2)]
    value = psi(c)
    radius = []
    for i in range(2):
        moved = abs(kept(mid[i] - _N[i] * value, i) - c[i]) + (abs(value) * abs(_N[i]) + 1.0) * (16 * EPS)
        radius.append(most(joint[i][1] - mid[i], mid[i] - joint[i][0]) + moved)
    away = [(float(a) * radius[0] + float(b) * radius[1]) * (1 + 8 * EPS) for a, b in D["region_inverse"]]
    return [meet(x[i], where(applies, (c[i] - away[i], c[i] + away[i]))) for i in range(2)]

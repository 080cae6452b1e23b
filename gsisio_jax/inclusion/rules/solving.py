"""Linear systems of small matrices whose entries depend on the box.

With C near the inverse of A at its center and any vector x~, the solution of ``A x = b`` is

    x = x~ + y,    y = C r + E y,    r = b - A x~,    E = I - C A.

r is linear in A and b, so C r keeps slopes, while ``E y`` is of second order in the widths and goes to the offset. A
vector u > 0 with ``|E| u + |C r| <= u`` and, strictly, ``|E| u < u`` proves that every A of the enclosure is regular
(the spectral radius of E is below 1) and that ``|y| <= u``; one is computed to nearest and then checked, rounded
outward. Without one nothing is known of x: the bounds are infinite. Derivatives are ``A^-1 (db - dA x)``, with an
inverse that is the solution for the unit vectors, and with what `tangents` knows of dA and db. C and x~ are numbers
like any others: how well they are known makes no difference to what is proved. A matrix that does not depend on the box
is inverted in fractions.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax.inclusion.form_arithmetic import box_sum, is_known, product
from gsisio_jax.inclusion.node import Node, as_node, is_node, jac_of, meet, normalised, parts
from gsisio_jax.inclusion.rules.bilinear import multiply
from gsisio_jax.inclusion.rules.linear import add, move, multiple, structural, subtract, total
from gsisio_jax.inclusion.rules.possible import formless, unknown
from gsisio_jax.inclusion.rules.tangents import Tangents
from gsisio_jax.interval import rounding
from gsisio_jax.interval.box import Interval, choose, entire_like, magnitude

MOST_ROWS = 12


def solve(a: Any, b: Any) -> Any:
    """Solution of ``a x = b``; a (n, n), b (n,) or (n, m), nodes or constants, one of them a node."""
    if not is_node(a):
        if is_known(a):
            return _solve_known(a, b)
        a = as_node(a, np.shape(a), b.dtype)
    columns = len(_shape(b)) == 2
    b = b if is_node(b) else as_node(b, np.shape(b), a.dtype)
    right = b if columns else move(lambda v: v[:, None], b)
    x = _solve_columns(normalised(a), normalised(right), (a, b))
    return x if columns else move(lambda v: v[:, 0], x)


def _shape(value: Any) -> tuple[int, ...]:
    return value.shape if is_node(value) else np.shape(value)


def _times(a: Any, b: Any) -> Any:
    """Matrix product (n, k) (k, m) of nodes and constants."""
    n, k, m = *_shape(a), _shape(b)[1]
    wide_a = move(lambda v: jnp.broadcast_to(v[:, :, None], (n, k, m)), a)
    wide_b = move(lambda v: jnp.broadcast_to(v[None], (n, k, m)), b)
    return total(multiply(wide_a, wide_b), [1])


def _image(a: Interval, b: Interval) -> Interval:
    """Product of two boxes of matrices, (..., n, k) and (..., k, m)."""
    terms = product(
        Interval.unchecked(a.lower[..., :, :, None], a.upper[..., :, :, None]),
        Interval.unchecked(b.lower[..., None, :, :], b.upper[..., None, :, :]),
    )
    return Interval.unchecked(rounding.sum_down(terms.lower, -2), rounding.sum_up(terms.upper, -2))


def _solve_columns(a: Node, b: Node, sources: tuple[Node, Node]) -> Node:
    """`sources` are a and b as they came, with their origins."""
    c = _inverse(a.range.center)
    _, jac = parts([a, b])
    # E = I - C A; the bounds of its entries are all that is used of it.
    error = normalised(subtract(np.eye(a.shape[0], dtype=a.dtype), _times(c, formless(a)))).range
    if jac is None:
        return _enclosed(a, b, c, error)
    # The inverse is the solution for the unit vectors.
    m, eye = b.shape[1], as_node(np.eye(a.shape[0]), a.shape, a.dtype)
    right = structural(lambda *v: jnp.concatenate(v, 1), [formless(b), eye])[0]
    every = _enclosed(formless(a), right, c, error)
    x, inverse = (move(lambda v, part=part: v[:, part], every) for part in (slice(None, m), slice(m, None)))
    return Node(x.range, x.form, _derivative(*sources, normalised(x), normalised(inverse)))


def _enclosed(a: Node, b: Node, c: Any, error: Interval) -> Node:
    """The solution with its form, without a Jacobian; see the module docstring."""
    x = _clean(c @ _clean(b.range.center))
    start = normalised(_times(c, formless(subtract(b, _times(a, x)))))
    u, proved = _fixed_radius(magnitude(error), magnitude(start.range))
    y = box_sum(start.range, _image(error, Interval.unchecked(-u, u)))
    y = Interval.unchecked(jnp.maximum(y.lower, -u), jnp.minimum(y.upper, u))
    moved = normalised(add(add(start, Node(_image(error, y))), as_node(x, x.shape, a.dtype)))
    natural, form = choose(proved, moved.range, entire_like(y)), moved.form
    if form is not None:
        form = type(form)(
            jnp.where(proved, form.slope, 0),
            choose(proved, form.offset, entire_like(form.offset)),
            form.box,
            None if form.slack is None else jnp.where(proved, form.slack, 0),
        )
    return meet(Node(natural, form))


def _derivative(a: Node, b: Node, x: Node, inverse: Node) -> Interval:
    """``A^-1 (db - dA x)`` for every entry of the box: (size, n, m), from products of forms: what x and the inverse
    have in common is not lost."""
    size = next(v.jac.lower.shape[0] for v in (a, b) if v.jac is not None)
    ja, jb = jac_of(a, size), jac_of(b, size)
    tangent = Tangents(size)
    moved = move(lambda v: v.reshape(size, *x.shape), tangent(b))
    right = subtract(moved, _products(normalised(tangent(a)), x))
    found = normalised(_products(inverse, normalised(right))).range
    # An entry of the box on which neither side depends.
    flat = [((side.lower == 0) & (side.upper == 0)).reshape(size, -1).all(1) for side in (ja, jb)]
    still = (flat[0] & flat[1])[:, None, None]
    return choose(still & jnp.isfinite(inverse.range.lower).all(), Interval.unchecked(0.0, 0.0), found)


def _products(a: Node, b: Node) -> Node:
    """Matrix products (..., n, k) (..., k, m), of which one has an axis before."""
    (n, k), m = a.shape[-2:], b.shape[-1]
    shape = (*(a.shape[:-2] or b.shape[:-2]), n, k, m)
    wide_a = move(lambda v: jnp.broadcast_to(v[..., None], shape), a)
    wide_b = move(lambda v: jnp.broadcast_to(v[..., None, :, :], shape), b)
    return total(multiply(wide_a, wide_b), [len(shape) - 2])


def _fixed_radius(small: Any, reached: Any) -> tuple[Any, Any]:
    """u (..., n, m) with ``small u + reached <= u``, and whether that was proved; see the module docstring."""
    small, reached = jax.lax.stop_gradient((small, reached))
    n = small.shape[-1]
    finite = jnp.isfinite(small).all() & (small.sum(-1).max() < 1e6)
    safe = jnp.where(finite, small, 0)
    least = jnp.maximum(reached.max((-2, -1), keepdims=True), 1e-30) * 2.0**-40
    right = jnp.where(jnp.isfinite(reached), reached, 0) + least
    # The Neumann series, by doubling; where it diverges the check below fails.
    inverse, power = jnp.eye(n, dtype=small.dtype) + safe, safe
    for _ in range(6):
        power = jnp.minimum(power @ power, 1e6)
        inverse = jnp.minimum(inverse + power @ inverse, 1e12)
    share = float(2.0**-20 if small.dtype == jnp.float64 else 2.0**-10)
    u = (inverse @ right) * (1 + share) + float(jnp.finfo(small.dtype).tiny) * 2.0**20
    moved = rounding.sum_up(small[..., :, None, :] * jnp.swapaxes(u, -1, -2)[..., None, :, :], -1)
    needed = rounding.up(moved + reached, 4.0)
    proved = finite & (needed <= u) & (moved < u) & jnp.isfinite(u)
    return u, proved.all((-2, -1), keepdims=True)


def _clean(x: Any) -> Any:
    return jnp.where(jnp.isfinite(x), x, 0)


def _inverse(a: Any) -> Any:
    """Near the inverse, or any numbers where there is none."""
    n = a.shape[0]
    if n == 1:
        return _clean(1 / jnp.where(a == 0, 1, a))
    if n > 3:
        good = jnp.linalg.det(_clean(a)) != 0
        return _clean(jnp.linalg.inv(jnp.where(good, _clean(a), jnp.eye(n, dtype=a.dtype))))
    a = _clean(a)
    if n == 2:
        adjugate = jnp.array([[a[1, 1], -a[0, 1]], [-a[1, 0], a[0, 0]]])
    else:
        p, q, r = a[:, 0], a[:, 1], a[:, 2]
        adjugate = jnp.stack([_cross(q, r), _cross(r, p), _cross(p, q)])
    determinant = (adjugate[0] * a[:, 0]).sum()
    return _clean(adjugate / jnp.where(determinant == 0, 1, determinant))


def _cross(p: Any, q: Any) -> Any:
    return jnp.stack([p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]])


def _solve_known(a: Any, b: Node) -> Node:
    """A known matrix: its inverse in fractions, each entry rounded once."""
    inverse = _exact_inverse(np.asarray(a))
    if inverse is None:
        return unknown(b.shape, b.dtype, [b])
    columns = len(b.shape) == 2
    rows = move(lambda v: v if columns else v[:, None], b)
    n, m = rows.shape
    wide = move(lambda v: jnp.broadcast_to(v[None], (n, n, m)), rows)
    factor = np.broadcast_to(inverse.astype(b.dtype)[:, :, None], (n, n, m))
    x = total(multiple(factor, wide, rounded=True), [1])
    return x if columns else move(lambda v: v[:, 0], x)


def _exact_inverse(a: np.ndarray) -> np.ndarray | None:
    n = len(a)
    rows = [[Fraction(float(v)) for v in row] + [Fraction(int(i == j)) for j in range(n)] for i, row in enumerate(a)]
    for k in range(n):
        pivot = next((i for i in range(k, n) if rows[i][k]), None)
        if pivot is None:
            return None
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [v / rows[k][k] for v in rows[k]]
        for i in range(n):
            if i != k and rows[i][k]:
                factor = rows[i][k]
                rows[i] = [v - factor * w for v, w in zip(rows[i], rows[k], strict=True)]
    return np.array([[float(v) for v in row[n:]] for row in rows])


def triangular_solve(eqn: Any, a: Any, b: Any) -> Any:
    """As any other system: the other triangle is 0, and the diagonal 1 where that is asked for."""
    left, lower, transposed, unit = (eqn.params[key] for key in ("left_side", "lower", "transpose_a", "unit_diagonal"))
    if len(_shape(a)) != 2:
        raise NotImplementedError("of several matrices at once; take them one by one")
    n = _shape(a)[-1]
    mask = np.tril(np.ones((n, n), bool)) if lower else np.triu(np.ones((n, n), bool))

    # With the matrix on the right, x a = b, the transposed system is solved.
    turned = bool(transposed) == bool(left)
    a = move(lambda v: jnp.where(mask, v, 0).T if turned else jnp.where(mask, v, 0), a)
    if unit:
        diagonal = np.eye(n, dtype=bool)
        one = np.eye(n)
        a = move(lambda v: jnp.where(diagonal, 0, v), a)
        a = add(a, one) if is_node(a) else a + one
    if left:
        return solve(a, b)
    return move(lambda v: v.T, solve(a, move(lambda v: v.T, b)))

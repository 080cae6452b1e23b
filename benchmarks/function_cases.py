"""The functions of `benchmarks.functions`: what model code is made of, on boxes that make sense for each of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

USUAL = ([0.1, 0.1], [0.9, 0.9])
WIDE = ([-1.0, -1.0], [1.0, 1.0])
THREE = ([0.1, -0.5, 0.3], [0.9, 0.4, 0.8])
KNOTS = np.linspace(0.0, 1.0, 50)
TABLE = np.sin(5 * KNOTS) + 0.1 * np.cos(40 * KNOTS)
FEW, VALUES = np.array([0.0, 0.3, 0.6, 1.0]), np.array([0.0, 1.0, 0.5, 2.0])
STEPS = np.array([0.0, 0.25, 0.25, 1.0])

Case = tuple[Callable[[Any], Any], tuple[list[float], list[float]]]


def _elementwise() -> dict[str, Case]:
    """Functions of `jax.numpy` and `jax.nn` of one argument, on both boxes where they are defined."""
    positive = "log log2 log10 sqrt reciprocal log1p"
    unit = "arcsin arccos arctanh"
    rest = (
        "abs absolute fabs negative positive sign square exp exp2 expm1 cbrt sin cos tan arctan sinh cosh tanh "
        "arcsinh floor ceil trunc rint round sinc deg2rad rad2deg degrees radians angle real conj i0 nan_to_num "
        "signbit isfinite isnan unwrap cumsum cumprod diff ediff1d gradient sort flip ravel mean sum prod std var "
        "median max min ptp any all"
    )
    found: dict[str, Case] = {}
    for name in positive.split():
        found[f"jnp.{name}"] = (getattr(jnp, name), USUAL)
    for name in unit.split():
        found[f"jnp.{name}"] = (getattr(jnp, name), USUAL)
    for name in dict.fromkeys(rest.split()):
        found[f"jnp.{name}"] = (getattr(jnp, name), WIDE)
    found["jnp.arccosh"] = (jnp.arccosh, ([1.1, 1.2], [2.0, 3.0]))
    activations = (
        "relu relu6 sigmoid softplus silu swish log_sigmoid gelu elu selu celu leaky_relu hard_tanh hard_sigmoid "
        "hard_silu soft_sign squareplus mish softmax log_softmax logsumexp squareplus standardize sparse_plus"
    )
    for name in dict.fromkeys(activations.split()):
        found[f"nn.{name}"] = (getattr(jax.nn, name), WIDE)
    for name in ("erf", "erfc", "erfinv", "gammaln", "digamma", "ndtr", "logit", "expit", "entr", "xlogy", "xlog1py"):
        fn = getattr(jax.scipy.special, name)
        found[f"special.{name}"] = ((lambda x, fn=fn: fn(x[0], x[1])) if name[:4] == "xlog" else fn, USUAL)
    found["nn.gelu exact"] = (lambda x: jax.nn.gelu(x, approximate=False), WIDE)
    return found


def _pairs() -> dict[str, Case]:
    names = (
        "add subtract multiply maximum minimum fmax fmin hypot arctan2 copysign heaviside logaddexp logaddexp2 greater "
        "less equal logical_and dot inner outer vdot kron convolve correlate cross"
    )
    found: dict[str, Case] = {}
    for name in names.split():
        fn = getattr(jnp, name)
        if name in ("dot", "inner", "outer", "vdot", "kron", "convolve", "correlate"):
            found[f"jnp.{name}"] = (lambda x, fn=fn: fn(x, jnp.array([1.0, 2.0]) + x), WIDE)
        elif name == "cross":
            found["jnp.cross"] = (lambda x: jnp.cross(x, x**2), THREE)
        else:
            found[f"jnp.{name}"] = (lambda x, fn=fn: fn(x[0], x[1]), WIDE)
    for name in ("divide", "power", "float_power", "mod", "remainder", "fmod", "floor_divide"):
        fn = getattr(jnp, name)
        found[f"jnp.{name}"] = (lambda x, fn=fn: fn(x[0], x[1]), USUAL)
    return found


def _tables() -> dict[str, Case]:
    return {
        "sum of 49 clips": (
            lambda x: jnp.sum(jnp.clip(x[:, None], KNOTS[:-1], KNOTS[1:]) * jnp.diff(TABLE), -1),
            ([0.42, 0.1], [0.44, 0.9]),
        ),
        "interp, 50 knots": (lambda x: jnp.interp(x, KNOTS, TABLE), ([0.42, 0.1], [0.44, 0.9])),
        "interp, 4 knots": (lambda x: jnp.interp(x, FEW, VALUES), ([-0.5, 0.35], [1.5, 0.55])),
        "interp, left and right": (lambda x: jnp.interp(x[0], FEW, VALUES, left=-1.0, right=3.0), ([-0.5], [1.5])),
        "interp, steps": (lambda x: jnp.interp(x, STEPS, VALUES), ([0.1, 0.25], [0.4, 0.45])),
        "interp, period": (lambda x: jnp.interp(x, FEW[:-1], VALUES[:-1], period=1.0), ([0.8, -7.3], [1.1, -6.8])),
        "interp of sin": (lambda x: jnp.interp(jnp.sin(x[0] + x[1]), FEW, VALUES), USUAL),
        "interp, values of x": (lambda x: jnp.interp(0.4, FEW, VALUES * x[0]) + x[1], USUAL),
        "take": (lambda x: jnp.take(VALUES, (4 * x[0]).astype(int)), USUAL),
        "index, then x": (lambda x: jnp.asarray(VALUES)[(4 * x[0]).astype(int)] * x[1], USUAL),
        "dynamic_slice": (lambda x: lax.dynamic_slice(jnp.asarray(VALUES), ((3 * x[0]).astype(int),), (2,)), USUAL),
        "row of a table": (lambda x: jnp.asarray(TABLE[:48].reshape(12, 4))[(9 * x[0]).astype(int)], USUAL),
        "entries of x by index": (lambda x: x[(2 * x[0]).astype(int)], USUAL),
        "searchsorted": (lambda x: jnp.searchsorted(FEW, x) * 1.0, USUAL),
        "digitize": (lambda x: jnp.digitize(x, FEW) * 1.0, USUAL),
        "dynamic_index": (lambda x: lax.dynamic_index_in_dim(x, (2 * x[1]).astype(int), keepdims=False), USUAL),
        "index out of bounds": (lambda x: jnp.asarray(VALUES)[(9 * x[0]).astype(int)], USUAL),
    }


def _matrix(x: Any) -> Any:
    return jnp.array([[2.0 + x[0], x[1]], [x[0] * x[1], 3.0]])


def _matrix3(x: Any) -> Any:
    return jnp.array([[3.0 + x[0], x[1], 0.5], [x[0] * x[1], 4.0, x[1]], [0.2, x[0], 5.0]])


def _symmetric(x: Any) -> Any:
    return jnp.array([[2.0 + x[0], 0.5 * x[1]], [0.5 * x[1], 3.0]])


def _linalg() -> dict[str, Case]:
    linalg, right = jnp.linalg, jnp.array([1.0, 2.0])
    return {
        "solve 2x2": (lambda x: linalg.solve(_matrix(x), right), USUAL),
        "solve 2x2, right side of x": (lambda x: linalg.solve(_matrix(x), jnp.sin(x)), USUAL),
        "solve 3x3": (lambda x: linalg.solve(_matrix3(x), jnp.arange(3.0)), USUAL),
        "solve 4x4": (lambda x: linalg.solve(4 * jnp.eye(4) + x[0] * jnp.ones((4, 4)), jnp.arange(4.0)), USUAL),
        "solve, constant matrix": (lambda x: linalg.solve(jnp.array([[2.0, 1.0], [1.0, 3.0]]), x), USUAL),
        "inv 2x2": (lambda x: linalg.inv(_matrix(x)), USUAL),
        "inv 3x3": (lambda x: linalg.inv(_matrix3(x)) @ jnp.arange(3.0), USUAL),
        "det 2x2": (lambda x: linalg.det(_matrix(x)), USUAL),
        "det 3x3": (lambda x: linalg.det(_matrix3(x)), USUAL),
        "det 4x4": (lambda x: linalg.det(4 * jnp.eye(4) + x[0] * jnp.ones((4, 4))), USUAL),
        "slogdet 2x2": (lambda x: linalg.slogdet(_matrix(x))[1], USUAL),
        "cholesky 2x2": (lambda x: linalg.cholesky(_symmetric(x)), USUAL),
        "cho_solve": (lambda x: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(_symmetric(x)), right), USUAL),
        "lu_solve": (lambda x: jax.scipy.linalg.lu_solve(jax.scipy.linalg.lu_factor(_matrix(x)), right), USUAL),
        "solve, assume pos": (lambda x: jax.scipy.linalg.solve(_symmetric(x), right, assume_a="pos"), USUAL),
        "solve_triangular": (
            lambda x: jax.scipy.linalg.solve_triangular(_matrix(x), right, lower=True),
            USUAL,
        ),
        "norm": (linalg.norm, WIDE),
        "norm, away from 0": (linalg.norm, THREE),
        "norm 1": (lambda x: linalg.norm(x, 1), WIDE),
        "norm inf": (lambda x: linalg.norm(x, jnp.inf), WIDE),
        "norm, Frobenius": (lambda x: linalg.norm(_matrix(x)), USUAL),
        "norms of rows": (lambda x: linalg.norm(_matrix(x), axis=1), USUAL),
        "sqrt of squares": (lambda x: jnp.sqrt(x[0] ** 2 + x[1] ** 2), WIDE),
        "matrix_power": (lambda x: linalg.matrix_power(_matrix(x), 3), USUAL),
        "expm": (lambda x: jax.scipy.linalg.expm(0.1 * _matrix(x)), USUAL),
        "trace": (lambda x: jnp.trace(_matrix(x)), USUAL),
        "multi_dot": (lambda x: linalg.multi_dot([_matrix(x), _matrix(x), x]), USUAL),
        "lstsq": (lambda x: linalg.lstsq(_matrix(x), right)[0], USUAL),
    }


def _loops() -> dict[str, Case]:
    def rk4(x: Any, h: float = 0.05) -> Any:
        def f(x: Any) -> Any:
            return jnp.stack([x[1], -jnp.sin(x[0]) - 0.1 * x[1]])

        k1 = f(x)
        k2 = f(x + h / 2 * k1)
        k3 = f(x + h / 2 * k2)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + h * k3))

    def tableau(x: Any) -> Any:
        a = np.array([[0, 0, 0], [0.5, 0, 0], [-1.0, 2.0, 0]])
        b = np.array([1 / 6, 2 / 3, 1 / 6])
        ks = jnp.zeros((3, 2))
        for i in range(3):
            y = x + 0.05 * jnp.tensordot(a[i], ks, axes=1)
            ks = ks.at[i].set(jnp.stack([y[1], -jnp.sin(y[0])]))
        return x + 0.05 * jnp.tensordot(b, ks, axes=1)

    def counted(x: Any) -> Any:
        return lax.while_loop(lambda s: s[0] < 4, lambda s: (s[0] + 1, s[1] + 0.1 * jnp.sin(s[1])), (0, x))[1]

    def countdown(x: Any) -> Any:
        t, y = lax.while_loop(lambda s: s[0] < 0.35, lambda s: (s[0] + 0.1, rk4(s[1], 0.1)), (0.0, x))
        return y + t

    return {
        "fori_loop": (lambda x: lax.fori_loop(0, 4, lambda i, v: v + 0.1 * jnp.sin(v) * i, x), USUAL),
        "fori_loop, long": (lambda x: lax.fori_loop(0, 100, lambda i, v: v - 0.01 * v, x), USUAL),
        "while_loop, counted": (counted, USUAL),
        "while_loop, until a time": (countdown, USUAL),
        "scan": (lambda x: lax.scan(lambda c, t: (c + 0.1 * t * jnp.cos(c), c), x, jnp.arange(4.0))[0], USUAL),
        "RK4 step": (rk4, USUAL),
        "RK3 by its tableau": (tableau, USUAL),
        "map": (lambda x: lax.map(jnp.sin, x), USUAL),
        "vmap": (jax.vmap(lambda t: t * jnp.sin(t)), USUAL),
        "associative_scan": (lambda x: lax.associative_scan(jnp.add, x), USUAL),
        "grad": (jax.grad(lambda x: jnp.sin(x[0]) * x[1] ** 2), USUAL),
        "cond, undecided": (lambda x: lax.cond(x[0] > 0.5, jnp.sin, lambda v: v + 1, x), USUAL),
        "switch, three branches": (
            lambda x: lax.switch((3 * x[0]).astype(int), [jnp.sin, jnp.cos, lambda v: 2 * v], x),
            USUAL,
        ),
        "select": (lambda x: jnp.select([x[0] > 0.7, x[0] > 0.3], [x[1], x[1] ** 2], 0.0), USUAL),
        "piecewise": (lambda x: jnp.piecewise(x, [x < 0.3, x > 0.7], [lambda t: t + 1, lambda t: t * t, 0.5]), USUAL),
        "where": (lambda x: jnp.where(x > 0.5, x, x**2), USUAL),
        "argmax": (lambda x: jnp.argmax(x) * 1.0, USUAL),
        "argmin": (lambda x: jnp.argmin(x) * 1.0, ([0.1, 0.5], [0.4, 0.9])),
        "entry of argmax": (lambda x: x[jnp.argmax(x)], USUAL),
        "argsort": (lambda x: jnp.argsort(x) * 1.0, USUAL),
        "top_k": (lambda x: lax.top_k(x, 2)[0], THREE),
        "sort of three": (jnp.sort, THREE),
        "median of three": (jnp.median, THREE),
        "quantile": (lambda x: jnp.quantile(x, 0.3), THREE),
    }


def _arrays() -> dict[str, Case]:
    return {
        "vander": (lambda x: jnp.vander(x, 4), WIDE),
        "x**arange": (lambda x: x[0] ** jnp.arange(4), WIDE),
        "polyval": (lambda x: jnp.polyval(jnp.array([1.0, -2.0, 0.5]), x), WIDE),
        "einsum": (lambda x: jnp.einsum("i,ij,j->", x, jnp.array([[2.0, 1.0], [1.0, 3.0]]), x), WIDE),
        "matmul": (lambda x: _matrix(x) @ x, USUAL),
        "tensordot": (lambda x: jnp.tensordot(_matrix(x), x, axes=1), USUAL),
        "convolve, constant kernel": (lambda x: jnp.convolve(x, jnp.array([0.2, 0.5, 0.3])), WIDE),
        "conv_general_dilated": (
            lambda x: lax.conv_general_dilated(
                x.reshape(1, 1, -1), jnp.array([[[0.2, 0.5]], [[-1.0, 2.0]]]), (1,), "SAME"
            ),
            THREE,
        ),
        "segment_sum": (lambda x: jax.ops.segment_sum(jnp.concatenate([x, x**2]), jnp.array([0, 1, 1, 2]), 3), WIDE),
        "segment_max": (lambda x: jax.ops.segment_max(jnp.concatenate([x, x**2]), jnp.array([0, 1, 1, 2]), 3), WIDE),
        "at.set": (lambda x: jnp.zeros(3).at[1].set(x[0]).at[0].add(x[1]), WIDE),
        "at.multiply": (lambda x: x.at[0].multiply(x[1]), WIDE),
        "at.max": (lambda x: x.at[0].max(0.3), WIDE),
        "clip": (lambda x: jnp.clip(x, -0.5, 0.5), WIDE),
        "stack and concatenate": (lambda x: jnp.concatenate([jnp.stack([x, x]).ravel(), x]), WIDE),
        "pad": (lambda x: jnp.pad(x, 1), WIDE),
        "tile and repeat": (lambda x: jnp.repeat(jnp.tile(x, 2), 2), WIDE),
        "triu": (lambda x: jnp.triu(_matrix(x)), WIDE),
        "diag": (lambda x: jnp.diag(x) @ x, WIDE),
        "trapezoid": (lambda x: jnp.trapezoid(x), WIDE),
        "average": (lambda x: jnp.average(x, weights=jnp.array([1.0, 2.0])), WIDE),
        "nan_to_num of a quotient": (lambda x: jnp.nan_to_num(x[0] / (x[1] + 2)), WIDE),
        "linspace": (lambda x: jnp.linspace(x[0], x[1], 4), WIDE),
        "meshgrid": (lambda x: jnp.meshgrid(x, x)[0], WIDE),
        "logsumexp of three": (jax.nn.logsumexp, THREE),
        "softmax of three": (jax.nn.softmax, THREE),
        "softmax, large": (lambda x: jax.nn.softmax(8 * x), WIDE),
        "wrap by arctan2": (lambda x: jnp.arctan2(jnp.sin(x), jnp.cos(x)), WIDE),
        "wrap by mod": (lambda x: jnp.mod(x + jnp.pi, 2 * jnp.pi) - jnp.pi, WIDE),
        "wrap by mod, across": (lambda x: jnp.mod(x + jnp.pi, 2 * jnp.pi) - jnp.pi, ([3.0, 0.0], [3.4, 1.0])),
        "fft": (lambda x: jnp.abs(jnp.fft.fft(x)), WIDE),
    }


def _plumbing() -> dict[str, Case]:
    return {
        "device_put": (lambda x: jax.device_put(x) * 2, WIDE),
        "checkpoint": (jax.checkpoint(jnp.sin), WIDE),
        "named_call": (jax.named_call(jnp.sin, name="call"), WIDE),
        "jit": (jax.jit(jnp.sin), WIDE),
        "custom_jvp": (jax.nn.relu, WIDE),
        "jvp": (lambda x: jax.jvp(jnp.sin, (x,), (jnp.ones(2),))[1], WIDE),
        "jacfwd": (jax.jacfwd(jnp.sin), WIDE),
        "optimization_barrier": (lambda x: lax.optimization_barrier(x) * 2, WIDE),
    }


def _networks() -> dict[str, Case]:
    activations: dict[str, Any] = {
        "relu": jax.nn.relu, "tanh": jnp.tanh, "gelu": jax.nn.gelu, "elu": jax.nn.elu, "silu": jax.nn.silu,
        "softplus": jax.nn.softplus, "swish": jax.nn.swish,
    }  # fmt: skip
    return {
        f"MLP, {name}": (eqx.nn.MLP(2, 2, 4, 1, activation=fn, key=jax.random.key(0)), USUAL)
        for name, fn in activations.items()
    }


GROUPS: dict[str, Callable[[], dict[str, Case]]] = {
    "One argument": _elementwise,
    "Two arguments": _pairs,
    "Tables": _tables,
    "Linear algebra": _linalg,
    "Loops, branches, selections": _loops,
    "Arrays": _arrays,
    "Calls": _plumbing,
    "Networks": _networks,
}

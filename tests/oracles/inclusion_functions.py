"""Functions of one variable and their derivatives, from NumPy and SciPy: the truth that bounds are held against."""

from __future__ import annotations

import numpy as np
from scipy import special


def _power(p):
    return lambda t: t**p, lambda t: p * t ** (p - 1)


def _sigmoid_slope(t):
    return special.expit(t) * special.expit(-t)


# Name: (function, derivative).
TRUTH = {
    "sin": (np.sin, np.cos),
    "cos": (np.cos, lambda t: -np.sin(t)),
    "tan": (np.tan, lambda t: 1 / np.cos(t) ** 2),
    "exp": (np.exp, np.exp),
    "exp2": (np.exp2, lambda t: np.log(2) * np.exp2(t)),
    "expm1": (np.expm1, np.exp),
    "log": (np.log, lambda t: 1 / t),
    "log1p": (np.log1p, lambda t: 1 / (1 + t)),
    "sqrt": (np.sqrt, lambda t: 0.5 / np.sqrt(t)),
    "rsqrt": (lambda t: 1 / np.sqrt(t), lambda t: -0.5 / t**1.5),
    "cbrt": (np.cbrt, lambda t: 1 / (3 * np.cbrt(t) ** 2)),
    "square": (np.square, lambda t: 2 * t),
    "sinh": (np.sinh, np.cosh),
    "cosh": (np.cosh, np.sinh),
    "tanh": (np.tanh, lambda t: 1 / np.cosh(t) ** 2),
    "logistic": (special.expit, _sigmoid_slope),
    "erf": (special.erf, lambda t: 2 / np.sqrt(np.pi) * np.exp(-t * t)),
    "erfc": (special.erfc, lambda t: -2 / np.sqrt(np.pi) * np.exp(-t * t)),
    "atan": (np.arctan, lambda t: 1 / (1 + t * t)),
    "asin": (np.arcsin, lambda t: 1 / np.sqrt((1 - t) * (1 + t))),
    "acos": (np.arccos, lambda t: -1 / np.sqrt((1 - t) * (1 + t))),
    "asinh": (np.arcsinh, lambda t: 1 / np.hypot(1, t)),
    "acosh": (np.arccosh, lambda t: 1 / np.sqrt((t - 1) * (t + 1))),
    "atanh": (np.arctanh, lambda t: 1 / ((1 - t) * (1 + t))),
    "abs": (np.abs, np.sign),
    "relu": (lambda t: np.maximum(t, 0), lambda t: np.heaviside(t, 0.5)),
    "softplus": (lambda t: np.logaddexp(t, 0), special.expit),
    "cube": _power(3),
    "fourth": _power(4),
    "fifth": _power(5),
    "power 2.5": _power(2.5),
    "power 0.3": _power(0.3),
    "power -1.5": _power(-1.5),
    "two to the": (lambda t: 2.0**t, lambda t: np.log(2) * 2.0**t),
    "reciprocal": _power(-1),
    "minus second": _power(-2),
    "minus third": _power(-3),
}


def values(name: str, t) -> np.ndarray:
    """Values at t; NaN outside the domain, infinite at a pole, no warning."""
    with np.errstate(all="ignore"):
        return TRUTH[name][0](np.asarray(t, float))


def slopes(name: str, t) -> np.ndarray:
    """Derivatives at t."""
    with np.errstate(all="ignore"):
        return TRUTH[name][1](np.asarray(t, float))

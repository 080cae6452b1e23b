"""`python -m benchmarks.functions`: which functions can be bounded, how tightly, as a table in docs/functions.md.

Every function of `function_cases` is bounded on its box and compared with what it takes at corners, on faces and at
random points: the ratio of the widths is what a bound is too wide by (points miss extremes by a little)."""

from __future__ import annotations

import argparse
import itertools
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "functions.md"
# Compiled without optimization: every program runs once.
QUICK: dict[str, bool | int | str] = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_use_fusion_emitters": False,
}
EXACT, TIGHT, LARGEST = 1.02, 1.5, 1e150
HEAD = """# Functions that can be bounded

A table of `python -m benchmarks.functions`: for every function the bounds of `inclusion.natural`, `inclusion.affine`
(its range) and `inclusion.jacobian` on one box, against {points} points of that box. **exact**: wider than what the
points take by 2 % at most; **tight**: by half at most; **loose (r)**: r times as wide; **infinite**: some entry has no
finite bound although the values (or derivatives) are bounded; **jump**: the function may jump inside the box, so the
derivative has no bound; **refused**: `UnknownPrimitiveError`.

Integers wrap around and saturate: where bounds leave the type, all of that type is possible. Bits of integers
(`&`, `|`, `^`, `~`), complex numbers and those of 16 bits are refused, but where they do not depend on the box. Where a
function may have no value (`sqrt` of negative numbers, 0 / 0), what looks at that (`isnan`, comparisons, `fmax`, casts)
is open; NaN that come of overflow (`inf - inf`) are not followed.

jax {jax}, float64, rounded outward.
"""


def points(lower: np.ndarray, upper: np.ndarray, count: int) -> np.ndarray:
    """Corners, a grid that contains the edges, and random points."""
    rng, n = np.random.default_rng(0), len(lower)
    steps = max(3, int(count ** (1 / n) / 1.5))
    grid = np.array(list(itertools.product(*(np.linspace(a, b, steps) for a, b in zip(lower, upper, strict=True)))))
    return np.concatenate([grid, rng.uniform(lower, upper, (count // 2, n))])


def ratio(low: Any, high: Any, seen: np.ndarray) -> tuple[float, bool]:
    """How often the bounds are as wide as the points, in the worst entry; do they contain them?"""
    low, high = np.asarray(low, float), np.asarray(high, float)
    least, most = seen.min(0), seen.max(0)
    size = 1e-9 * (1 + np.maximum(abs(least), abs(most)))  # rounding of the points
    inside = bool((low <= least + 1e-3 * size).all() and (high >= most - 1e-3 * size).all())
    with np.errstate(all="ignore"):
        wide = (high - low) / np.maximum(most - least, 1e-9)
    wide = np.where(high - low <= most - least + size, 1.0, wide)
    return float(np.max(wide, initial=1.0)), inside


def verdict(low: Any, high: Any, seen: np.ndarray, jumps: bool = False) -> str:
    seen = seen[(np.abs(seen) < LARGEST).reshape(len(seen), -1).all(1)]
    if not len(seen):
        return "no value"
    wide, inside = ratio(low, high, seen)
    if not inside:
        return "WRONG"
    if not np.isfinite(wide):
        return "jump" if jumps else "infinite"
    return "exact" if wide <= EXACT else "tight" if wide <= TIGHT else f"loose ({wide:.3g})"


def survey(fn: Any, box: tuple[list[float], list[float]], count: int) -> dict[str, Any]:
    """The verdicts on one function."""
    from gsisio_jax import Interval, inclusion

    lower, upper = (np.array(side) for side in box)
    at = points(lower, upper, count)

    def plain(x: Any) -> Any:
        return jnp.asarray(fn(x), float)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            values = np.asarray(jax.jit(jax.vmap(plain))(at))
        except NotImplementedError:
            values = np.asarray([plain(x) for x in at[:: len(at) // 100]])
            at = at[:: len(at) // 100]
        try:
            slopes = np.asarray(jax.jit(jax.vmap(jax.jacfwd(plain)))(at))
        except Exception:
            slopes = np.zeros((1, *values.shape[1:], len(lower)))
    jumps = _jumps(plain, lower, upper)
    found: dict[str, Any] = {}
    started = time.process_time()
    try:
        every = jax.jit(lambda b: [way(plain)(b) for way in (inclusion.natural, inclusion.affine, inclusion.jacobian)])
        natural, form, jac = every.lower(Interval(lower, upper)).compile(QUICK)(Interval(lower, upper))
        found["natural"] = verdict(natural.lower, natural.upper, values)
        found["affine"] = verdict(form.range.lower, form.range.upper, values)
        rest = values - np.einsum("...j,kj->k...", np.asarray(form.slope), at)
        if not ratio(form.offset.lower, form.offset.upper, rest)[1]:
            found["affine"] = "WRONG (offset)"
        found["jacobian"] = verdict(jac.lower, jac.upper, slopes, jumps)
        if "WRONG" not in found["jacobian"] and not _quotients_inside(jac, at, values):
            found["jacobian"] = "WRONG (quotient)"
    except inclusion.UnknownPrimitiveError as error:
        found |= {"error": f"{error.operation} {error.detail}".strip()}
    except Exception as error:
        found |= {"error": f"{type(error).__name__}: {error}".splitlines()[0][:150]}
    found["seconds"] = time.process_time() - started
    return found


def _jumps(plain: Any, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Does it change by much over a very small distance, on lines through the box?"""
    share, middle = np.linspace(-0.5, 0.5, 2001)[:, None], 0.5 * (lower + upper)
    rng = np.random.default_rng(2)
    for direction in (np.ones(len(lower)), *rng.uniform(-1, 1, (3, len(lower)))):
        line = middle + share * direction * (upper - lower)
        try:
            values = np.asarray(jax.jit(jax.vmap(plain))(line)).reshape(len(line), -1)
        except NotImplementedError:
            return False
        change = np.abs(np.diff(values, axis=0))
        if (change.max(0) > 20 * (np.median(change, 0) + 1e-3)).any():
            return True
    return False


def _quotients_inside(jac: Any, at: np.ndarray, values: np.ndarray) -> bool:
    """``f(a) - f(b)`` in ``J (a - b)`` for random pairs of points."""
    order = np.random.default_rng(1).permutation(len(at))
    step, change = at - at[order], values - values[order]
    low, high = np.asarray(jac.lower), np.asarray(jac.upper)
    shape = (len(at),) + (1,) * (low.ndim - 1) + (-1,)
    step = step.reshape(shape)
    with np.errstate(invalid="ignore"):
        p, q = np.nan_to_num(low * step, nan=0.0), np.nan_to_num(high * step, nan=0.0)
    low, high = np.minimum(p, q).sum(-1), np.maximum(p, q).sum(-1)
    return bool((low - 1e-9 <= change).all() and (change <= high + 1e-9).all())


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.functions", description=__doc__)
    parser.add_argument("--only", default="", help="functions whose group or name contains this text")
    parser.add_argument("--points", type=int, default=4000, help="points of every box, about")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    from benchmarks.function_cases import GROUPS

    text, wrong = HEAD.format(points=options.points, jax=jax.__version__), 0
    for group, cases in GROUPS.items():
        lines = []
        for name, (fn, box) in cases().items():
            if options.only not in f"{group} {name}":
                continue
            try:
                found = survey(fn, box, options.points)
            except Exception as error:
                found = {"error": f"no case: {error}".splitlines()[0], "seconds": 0.0}
            jax.clear_caches()
            cells = [found.get(key, f"refused: {found.get('error')}") for key in ("natural", "affine", "jacobian")]
            wrong += any("WRONG" in cell for cell in cells)
            cells = cells if "error" not in found else [f"refused: `{found['error']}`", "", ""]
            lines.append(f"| `{name}` | {' | '.join(cells)} |")
            print(f"{name:28} {' | '.join(cells)}  ({found['seconds']:.1f} s)", file=sys.stderr, flush=True)
        text += f"\n## {group}\n\n| Function | natural | affine | jacobian |\n| --- | --- | --- | --- |\n"
        text += "\n".join(lines) + "\n"
    if not options.only:
        DOCUMENT.write_text(text)
        print(f"written to {DOCUMENT}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

"""The built-in examples, one case each: what a newcomer waits for, how wide boxes get, and what was promised.

``python -m benchmarks --only plants --name plants`` runs them; `benchmarks.tables` makes the table of its results.
"""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.throughput import peak

NAMES = gx.examples.names()
SETTLING = 20  # steps that the promise must have applied before widths count as settled


def plant(name: str, repeat: int, steps: int) -> dict[str, Any]:
    """Design, first call, rate of one box (steps a CPU second), widths against ranges, certificate against measured.

    Ranges are those of the true states and inputs, and of the middles of the boxes where nobody knows the truth.
    Widths are medians over the second half of the record, against the range in percent; the certificate against the
    largest width there, over steps at which it has applied for a while. Design and first call are CPU seconds.

    Args:
        name: of the example.
        repeat: runs that the rate is measured with.
        steps: most steps of the record.
    """
    example = gx.examples.load(name)
    record = example.record()
    y, u = record.y[:steps], None if record.u is None else record.u[:steps]
    began = time.process_time()
    observer = example.observer()
    design = time.process_time() - began
    began = time.process_time()
    est = jax.block_until_ready(gx.estimate(observer, example.initial, y, u))
    first = time.process_time() - began

    began = time.process_time()
    for _ in range(repeat):
        jax.block_until_ready(gx.estimate(observer, example.initial, y, u))
    cpu = (time.process_time() - began) / repeat

    certificate = observer.certificate
    applies = (np.asarray(est.status) & ~int(gx.Status.AMBIGUOUS)) == 0
    applies = np.array([applies[max(k - SETTLING, 0) : k + 1].all() for k in range(len(applies))])
    states = _widths(est.state, record.x, applies, np.asarray(certificate.steady_width), gx.nearest, example.system)
    inputs = _widths(est.input, record.d, applies[1:], np.asarray(certificate.input_width))
    missed = 0
    if record.x is not None:
        x = gx.nearest(example.system, record.x[: len(y)], est.state)
        missed += int(np.count_nonzero(~np.asarray(est.state.contains(x))))
    return {
        "batch": 1,
        "steps": len(y),
        "design_seconds": design,
        "first_call_seconds": first,
        "cpu_seconds": cpu,
        "rate": len(y) / cpu,
        "peak_mebibytes": peak() / 2**20,
        "ok": missed == 0,
        "states": dict(zip([n for n, _ in example.states], states, strict=True)),
        "inputs": dict(zip([n for n, _ in example.inputs], inputs, strict=True)),
        "certificate": "full" if certificate.self_consistent else "empty" if certificate.certified else "none",
        "outside": float(np.mean((np.asarray(est.status) & int(gx.Status.OUTSIDE_REGION)) != 0)),
    }


def _widths(
    box: Any, truth: Any, applies: np.ndarray, promised: np.ndarray, nearest: Any = None, system: Any = None
) -> list[dict[str, Any]]:
    """Of every signal: width, range, promised width, and the largest width where it is promised."""
    lower, upper = np.asarray(box.lower), np.asarray(box.upper)
    half = slice(len(lower) // 2, None)
    width = (upper - lower)[half]
    if truth is None:
        with np.errstate(invalid="ignore"):
            middle = (lower + upper) / 2
        spread = np.ptp(np.where(np.isfinite(middle), middle, np.nanmedian(middle, 0)), axis=0)
    else:
        truth = truth[: len(lower)]
        spread = np.ptp(truth if nearest is None else nearest(system, truth, box), axis=0)
    inside = np.where(applies[half, None], width, -np.inf).max(0)
    columns = zip(np.median(width, 0), spread, promised, inside, strict=True)
    names = ("width", "range", "promised", "largest")
    return [{name: float(value) for name, value in zip(names, row, strict=True)} for row in columns]


def table(results: dict[str, dict[str, Any]]) -> str:
    """The results as rows of Markdown."""
    lines = [
        "| Plant | design s | first call s | rate | x: width (% of range) | d: width | largest / promised: x | d |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, r in results.items():
        if "states" not in r:
            lines.append(f"| {name.removeprefix('plants ')} | {r.get('error', '')} |" + " |" * 6)
            continue
        states, inputs = list(r["states"].values()), list(r["inputs"].values())
        cells = [
            name.removeprefix("plants "), f"{r['design_seconds']:.1f}", f"{r['first_call_seconds']:.1f}",
            f"{_digits(r['rate']):,.0f}", *(", ".join(map(_share, group)) for group in (states, inputs)),
            *(", ".join(map(_kept, group)) for group in (states, inputs)),
        ]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _share(one: dict[str, Any]) -> str:
    width, spread = one["width"], one["range"]
    if not np.isfinite(width):
        return "inf"
    return f"{width:.2g} ({100 * width / spread:.2g})" if spread > 0 else f"{width:.2g}"


def _kept(one: dict[str, Any]) -> str:
    if not np.isfinite(one["promised"]) or not np.isfinite(one["largest"]):
        return "-"
    return f"{one['largest'] / one['promised']:.2f}"


def _digits(value: float) -> float:
    return float(f"{value:.2g}")

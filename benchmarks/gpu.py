"""`python -m benchmarks.gpu`: the same boxes on an accelerator as on the CPU, and how many a second, in five minutes.

For S1 (two states, nonlinear, one record for all boxes) and six tanks (S5, a record each), in float64 and float32:

- every box holds the truth, on both (in float32 for noise bounds that grow by 16 eps of states and outputs, because
  the plant's constants, inputs and measurements are rounded);
- both are rounded outward, so they are not the same numbers: the largest difference of a bound, over the largest width,
  must stay below 1e-9 (float64) and 2e-2 (float32: the levels of the tanks are 20, their noise 1e-3);
- box-steps a second at 10^4 to 10^7 boxes (S1, the widths of the last step are kept), the median of three runs.

    python -m benchmarks.gpu             # on the first GPU or TPU that JAX finds
    python -m benchmarks.gpu --small     # few boxes, also without an accelerator: CPU against CPU
    python -m benchmarks.gpu --seconds 240 --name h100

Sizes that would not fit the time or the memory are left out, and listed. Results: benchmarks/results/gpu.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import gsisio_jax as gx
from benchmarks.__main__ import RESULTS, setting
from benchmarks.plants import case, records

TOLERANCE = {"float64": 1e-9, "float32": 2e-2}
REPEATS = 3
SIZES = (10_000, 100_000, 1_000_000, 10_000_000)
RESERVE = 30.0  # seconds kept for what comes after a size: writing, and a run that takes longer than foreseen


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="few boxes; on the CPU, too")
    parser.add_argument("--seconds", type=float, default=270.0, help="stop measuring after so many (default: 270)")
    parser.add_argument("--name", default="gpu", help="name of the result file (default: gpu)")
    options = parser.parse_args()
    began, device = time.perf_counter(), jax.devices()[0]
    if device.platform == "cpu" and not options.small:
        parser.error("JAX finds no accelerator (pip install 'jax[cuda12]'); --small compares the CPU with itself")

    def left() -> float:
        return options.seconds - (time.perf_counter() - began)

    boxes, steps = (200, 20) if options.small else (2_000, 60)
    sizes = (1_000, 4_000) if options.small else SIZES
    result: dict[str, Any] = {"setting": setting() | {"device": f"{device.platform}: {device.device_kind}"}}
    # What is not measured, the design above all, is many small operations: those belong on the CPU.
    with jax.default_device(jax.devices("cpu")[0]):
        for dtype in TOLERANCE:
            result[f"s1 {dtype}"] = compared("s1", dtype, boxes, steps, device)
            say(f"s1 {dtype}", result[f"s1 {dtype}"])
        for dtype in TOLERANCE:
            rates, skipped = throughput(dtype, sizes, steps, device, left)
            result[f"rate {dtype}"] = {"boxes": rates, "left_out": skipped}
            say(f"rate {dtype}", {**{f"{n:,} boxes": f"{r / 1e6:.2f} M/s" for n, r in rates.items()}, **skipped})
        for dtype in TOLERANCE:
            enough = options.small or left() > 2 * RESERVE
            result[f"s5 {dtype}"] = compared("s5", dtype, boxes, steps, device) if enough else {"left_out": "no time"}
            say(f"s5 {dtype}", result[f"s5 {dtype}"])
    result["seconds"] = time.perf_counter() - began
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{options.name}.json"
    path.write_text(json.dumps(result, indent=1) + "\n")
    good = all(part["ok"] for part in result.values() if isinstance(part, dict) and "ok" in part)
    print(f"{'all checks passed' if good else 'FAILED'}; {result['seconds']:.0f} s; written to {path}")
    return 0 if good else 1


def compared(plant: str, dtype: str, batch: int, steps: int, device: Any) -> dict[str, Any]:
    """Boxes of states and inputs on both devices: misses, and the largest difference over the largest width."""
    setup = case(plant, steps)
    observer = setup.design(missing=False)
    initial, y, x = records(setup, batch)
    y = y.astype(dtype)
    noise = widened(setup.noise, x, y, dtype)
    initial = initial.astype(dtype)
    run = jax.jit(
        jax.vmap(lambda box, rows: _kept(gx.estimate(observer, box, rows, setup.u(steps).astype(dtype), noise)))
    )
    found = {}
    for name, place in (("cpu", jax.devices("cpu")[0]), ("device", device)):
        args = jax.device_put((initial, y), place)
        found[name] = [np.asarray(side, np.float64) for side in jax.tree.leaves(jax.block_until_ready(run(*args)))]
    missed = {
        name: int(((x < sides[0] - 1e-12) | (x > sides[1] + 1e-12)).sum()) for name, sides in found.items()
    }  # fmt: skip
    gap = 0.0
    for lower, upper, a, b in zip(found["cpu"][::2], found["cpu"][1::2], found["device"][::2], found["device"][1::2],
                                  strict=True):  # fmt: skip
        same = np.isfinite(lower) == np.isfinite(a), np.isfinite(upper) == np.isfinite(b)
        finite = np.isfinite(lower) & np.isfinite(upper) & same[0] & same[1]
        far = max(np.abs(np.where(finite, p - q, 0)).max() for p, q in ((lower, a), (upper, b)))
        wide = np.where(finite, upper - lower, 0).max()
        gap = np.inf if not all(part.all() for part in same) else max(gap, float(far / wide))
    return {
        "batch": batch, "steps": steps, "missed": missed, "gap": gap, "tolerance": TOLERANCE[dtype],
        "ok": not any(missed.values()) and gap <= TOLERANCE[dtype],
    }  # fmt: skip


def widened(noise: gx.Noise, x: np.ndarray, y: np.ndarray, dtype: str) -> gx.Noise:
    """Bounds that hold for the plant whose constants, inputs and measurements are known in that type only."""
    if dtype == "float64":
        return noise
    share = 16 * float(np.finfo(dtype).eps)
    more = [share * np.abs(values).max((0, 1)) for values in (x, y)]
    boxes = [
        gx.Interval(np.asarray(box.lower) - radius, np.asarray(box.upper) + radius)
        for box, radius in zip((noise.w, noise.v), more, strict=True)
    ]
    return gx.Noise(*boxes).astype(dtype)


def _kept(estimate: gx.Estimate) -> Any:
    """Lower and upper sides of states, then of inputs."""
    return estimate.state.lower, estimate.state.upper, estimate.input.lower, estimate.input.upper


def throughput(
    dtype: str, sizes: tuple[int, ...], steps: int, device: Any, left: Callable[[], float]
) -> tuple[dict[int, float], dict[str, str]]:
    """Box-steps a second of S1 by the number of boxes, and which sizes were left out and why."""
    setup = case("s1", steps)
    observer = setup.design(missing=False)
    run, _ = setup.simulate(jax.random.key(0))
    y, x = np.asarray(run.y, dtype), np.asarray(run.x[0])
    rates: dict[int, float] = {}
    skipped: dict[str, str] = {}
    noise = setup.noise.astype(dtype)
    program = jax.jit(
        jax.vmap(lambda box, rows: gx.estimate(observer, box, rows, noise=noise).state.width[-1], in_axes=(0, None))
    )
    foreseen = 0.0  # of the next size: compiled anew, and ten times as many boxes
    for boxes in sizes:
        if foreseen > left() - RESERVE:
            skipped[f"{boxes:,}"] = f"would take {foreseen:.0f} s, {max(left(), 0):.0f} s are left"
            continue
        began, spent = time.perf_counter(), 0.0
        try:
            rng = np.random.default_rng(0)
            parts = [(rng.uniform(0.05, 1, (boxes, 2)) * setup.initial.width).astype(dtype) for _ in range(2)]
            initial = jax.device_put(gx.Interval((x - parts[0]).astype(dtype), (x + parts[1]).astype(dtype)), device)
            rows = jax.device_put(y, device)
            jax.block_until_ready(program(initial, rows))
            seconds: list[float] = []
            for _ in range(REPEATS):
                started = time.perf_counter()
                widths = jax.block_until_ready(program(initial, rows))
                seconds.append(time.perf_counter() - started)
            spent = (REPEATS + 1) * max(seconds)
            if not np.isfinite(np.asarray(widths)).all():
                skipped[f"{boxes:,}"] = "some widths are not finite"
                continue
            rates[boxes] = boxes * steps / float(np.median(seconds))
        except jax.errors.JaxRuntimeError as error:  # out of memory
            skipped[f"{boxes:,}"] = str(error).splitlines()[0][:100]
        foreseen = time.perf_counter() - began + 9 * spent
    return rates, skipped


def say(name: str, found: dict[str, Any]) -> None:
    """One line."""
    print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in found.items()), flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main())

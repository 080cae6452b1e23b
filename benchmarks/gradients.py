"""`python -m benchmarks.gradients`: gradients against central differences, and the memory of a long one.

Not part of `python -m benchmarks`, because it measures correctness, not speed. Every line runs in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.record import keep

HERE = Path(__file__).resolve().parent
SYSTEMS = {"s1": "S1, two states, sines", "s5": "S5, six tanks", "s7": "S7, quadruple tank"}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gradients", description=__doc__)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=10_000, help="of the long gradient")
    parser.add_argument("--batch", type=int, default=1000, help="of the long gradient")
    parser.add_argument("--only", default="", help="s1, s5, s7 or memory")
    parser.add_argument("--case", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        here = (
            memory(options.steps, options.batch) if options.case == "memory" else points(options.case, options.points)
        )
        print(json.dumps(here))
        return 0
    results = {}
    for case in [c for c in (*SYSTEMS, "memory") if options.only in ("", c)]:
        sizes = [f"--{name}={getattr(options, name)}" for name in ("points", "steps", "batch")]
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.gradients", "--case", case, *sizes], capture_output=True, text=True,
            cwd=HERE.parent, env={**os.environ, "JAX_ENABLE_X64": "1"},
        )  # fmt: skip
        if done.returncode:
            print(done.stderr, file=sys.stderr)
            return 1
        results[case] = json.loads(done.stdout.strip().splitlines()[-1])
        print(line(case, results[case]), flush=True)
    checked = {case: result for case, result in results.items() if case != "memory"}
    if set(checked) == set(SYSTEMS):
        rows = [
            [SYSTEMS[case], *(f"{e:.1e}".replace("e-0", "e-") for e in one["worst"].values())]
            for case, one in checked.items()
        ]
        keep("gradients", ["system", *next(iter(checked.values()))["worst"]], rows, results=results)
    return 0 if all(result["ok"] for result in results.values()) else 1


def points(name: str, count: int) -> dict[str, Any]:
    """Worst relative error at `count` random points, by kind of argument."""
    from benchmarks.plants import from_tests

    checks, systems = from_tests("gradient_points"), from_tests("systems")
    checker = checks.Checker(getattr(systems, name)(), count, checks.folded, sweeps=3)
    report, not_finite = checker.check(checker.draw()), checker.not_finite()
    return {
        "points": count,
        "worst": {kind: float(report.error[:, i].max()) for i, kind in enumerate(checks.KINDS)},
        "kinks": int(report.kink.sum()),
        "subgradients": int(report.between[report.kink].sum()),
        "not_finite": not_finite,
        "ok": bool((report.error < 1e-4).all()) and not not_finite,
    }


def memory(steps: int, batch: int) -> dict[str, Any]:
    """Memory of a gradient of mean widths by noise bounds, S1: of the compiled program (arguments, results and all
    between), and of the whole process, where XLA's compiler takes the most."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from benchmarks.plants import from_tests
    from gsisio_jax import Noise
    from gsisio_jax.tuning import fold

    case = from_tests("systems").s1()
    observer = case.design(missing=False, sweeps=3)
    before = peak()
    y = jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, (batch, steps, 2)))

    def mean_width(noise: Noise, record: Any) -> Any:
        total = fold(
            observer, case.initial, record, lambda s, out, k: s + out.state.width.sum(), jnp.zeros(()), noise=noise
        )
        return total / steps

    run = jax.jit(jax.grad(lambda noise: jax.vmap(lambda record: mean_width(noise, record))(y).mean()))
    start = time.perf_counter()
    compiled = run.lower(case.noise).compile()
    build = time.perf_counter() - start
    sizes, after_compile = compiled.memory_analysis(), peak()
    program = (sizes.temp_size_in_bytes + sizes.argument_size_in_bytes + y.nbytes) / 2**20
    start = time.perf_counter()
    slope = jax.block_until_ready(compiled(case.noise))
    seconds = time.perf_counter() - start
    finite = all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(slope))
    return {
        "steps": steps, "batch": batch, "compile_seconds": build, "seconds": seconds, "before_mebibytes": before,
        "program_mebibytes": program, "compile_mebibytes": after_compile, "peak_mebibytes": peak(),
        "ok": finite and program < 2048,
    }  # fmt: skip


def peak() -> float:
    """Largest resident size of this process so far, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def line(case: str, result: dict[str, Any]) -> str:
    state = "passed" if result["ok"] else "FAILED"
    if case == "memory":
        sizes = [f"{result[f'{name}_mebibytes']:,.0f}" for name in ("program", "before", "compile", "peak")]
        return (
            f"gradient over {result['steps']:,} steps, batch {result['batch']:,}: {sizes[0]} MiB (process: {sizes[1]} "
            f"before, {sizes[2]} after compiling, {sizes[3]} in the end), {result['seconds']:.1f} s (compile "
            f"{result['compile_seconds']:.1f} s)  {state}"
        )
    worst = ", ".join(f"{kind} {error:.1e}" for kind, error in result["worst"].items())
    return (
        f"{case}: {result['points']} points, worst relative error: {worst}; {result['kinks']} kinks, derivative "
        f"between both sides at {result['subgradients']}; not finite: {', '.join(result['not_finite']) or 'nowhere'}  "
        f"{state}"
    )


if __name__ == "__main__":
    sys.exit(main())

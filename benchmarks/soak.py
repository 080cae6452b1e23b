"""`python -m benchmarks.soak`: the adversarial suite of tests/rounding at full size, recorded.

Every part runs in a fresh process, one after the other, and is written to benchmarks/results/<name>.json as soon as it
is done; parts that are there are not repeated (`--again` repeats them). `default` are XLA's own settings, `quick` those
without fusion and optimization: bounds must hold under both."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from importlib.metadata import version
from typing import Any

from benchmarks.__main__ import RESULTS, setting
from benchmarks.plants import TESTS

FLAGS = {
    "default": "",
    "quick": "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 "
    "--xla_llvm_disable_expensive_passes=true",
}
SEED = 100


def parts(points: float, steps: float) -> dict[str, tuple[str, str, str, float, str]]:
    """Name of every part: what, precision, rounding, size, setting of XLA."""
    found: dict[str, tuple[str, str, str, float, str]] = {}
    for flags, share in (("default", 1.0), ("quick", 0.1)):
        for dtype in ("float64", "float32"):
            found[f"primitives {dtype} {flags}"] = ("primitives", dtype, "outward", points * share, flags)
        for dtype in ("float64", "float32"):
            found[f"observers {dtype} {flags}"] = ("observers", dtype, "outward", steps * share, flags)
            found[f"sums {dtype} {flags}"] = ("sums", dtype, "outward", points / 500 * share, flags)
        if flags == "quick":
            for dtype in ("float64", "float32"):
                found[f"forms {dtype} {flags}"] = ("forms", dtype, "outward", points / 20, flags)
    for dtype in ("float64", "float32"):
        for what, size in (("primitives", points / 100), ("observers", steps / 100), ("sums", points / 1e4)):
            found[f"{what} {dtype} nearest"] = (what, dtype, "nearest", size, "quick")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.add_argument("--points", type=float, default=1e8, help="(function, box, point) per precision")
    parser.add_argument("--steps", type=float, default=1e7, help="observer steps per precision")
    parser.add_argument("--only", default="", help="parts whose name contains this text")
    parser.add_argument("--name", default="soak", help="name of the result file")
    parser.add_argument("--again", action="store_true", help="repeat parts that the result file has")
    parser.add_argument("--part", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        print(json.dumps(run_here(*options.part)))
        return 0
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{options.name}.json"
    record: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"parts": {}}
    wanted = parts(options.points, options.steps)
    for name, (what, dtype, rounding, size, flags) in wanted.items():
        if options.only not in name or (name in record["parts"] and not options.again):
            continue
        print(f"{name}, {size:.0e} ...", file=sys.stderr, flush=True)
        found = run_apart(what, dtype, rounding, size, flags)
        record["parts"][name] = found
        record["parts"] = {key: record["parts"][key] for key in wanted if key in record["parts"]}
        record["setting"] = setting() | {p: version(p) for p in ("crival", "python-flint")} | {"seed": SEED}
        path.write_text(json.dumps(record, indent=1) + "\n")
        print(f"  {summary(found)}", file=sys.stderr, flush=True)
    print(table(record))
    wrong = [name for name, found in record["parts"].items() if not as_expected(name, found)]
    print(f"\nwritten to {path}" + (f"; NOT as they should be: {', '.join(wrong)}" if wrong else ""))
    return 1 if wrong else 0


def as_expected(name: str, found: dict[str, Any]) -> bool:
    """No miss rounded outward, many rounded to nearest."""
    misses = found.get("misses", -1)
    return misses > 0 if name.endswith("nearest") else misses == 0 and found.get("conflicts", 0) == 0


def run_here(what: str, dtype: str, rounding: str, size: str) -> dict[str, Any]:
    """One part in this process."""
    import jax
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    sys.path[:0] = [str(TESTS), str(TESTS / "rounding")]
    soak = __import__("soak")
    return getattr(soak, what)(np.dtype(dtype).type, float(size), SEED, rounding)


def run_apart(what: str, dtype: str, rounding: str, size: float, flags: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.soak", "--part", what, dtype, rounding, str(size)]
    env = {**os.environ, "XLA_FLAGS": FLAGS[flags]}
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=RESULTS.parent)
    given = {"flags": flags, "size": size, "commit": commit.stdout.strip(), "date": time.strftime("%Y-%m-%d %H:%M")}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, cwd=RESULTS.parent.parent, env=env)
    if done.returncode:
        return given | {"error": f"ended with status {done.returncode}"}
    return given | json.loads(done.stdout.strip().splitlines()[-1])


def summary(found: dict[str, Any]) -> str:
    if "error" in found:
        return f"FAILED: {found['error']}"
    return f"{looked_at(found)}, {found['misses']:,} misses, {found['seconds']} s"


def looked_at(found: dict[str, Any]) -> str:
    if found["what"] in ("primitives", "forms"):
        return f"{found['points']:,} points, {found['checks']:,} comparisons"
    if found["what"] == "observers":
        return f"{found['steps']:,} steps, {found['checks']:,} comparisons"
    return f"{found['sums']:,} sums"


def table(record: dict[str, Any]) -> str:
    """The record as a Markdown table."""
    lines = ["| Part | Looked at | Misses | Nearest to a bound |", "| --- | --- | --- | --- |"]
    for name, found in record["parts"].items():
        if "error" in found:
            lines.append(f"| {name} | {summary(found)} | | |")
            continue
        nearest = name.endswith("nearest")
        lines.append(f"| {name} | {looked_at(found)} | {found['misses']:,} | {'' if nearest else _closest(found)} |")
    return "\n".join(lines)


def _closest(found: dict[str, Any]) -> str:
    """What came nearest to a bound, in eps of its value."""
    if found["what"] == "primitives":
        return found["closest"][0].replace(" of the value", "") if found["closest"] else ""
    if found["what"] == "observers":
        room, name = min((plant["closest_eps"], name) for name, plant in found["plants"].items())
        return f"{name}: {room} eps"
    return ""


if __name__ == "__main__":
    sys.exit(main())

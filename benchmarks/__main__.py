"""`python -m benchmarks`: run every case in a fresh process, print a table, write the results as JSON."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
SIZES = {  # full, quick
    "compiled": ({"batch": 100_000, "steps": 100}, {"batch": 5_000, "steps": 50}),
    "limit": ({"batch": 102_400, "steps": 100}, {"batch": 4_096, "steps": 50}),
    "limit stored": ({"batch": 20_480, "steps": 100}, {"batch": 4_096, "steps": 50}),
    "numpy": ({"batch": 2_000, "steps": 100}, {"batch": 1_000, "steps": 20}),
    "tanks": ({"steps": 100}, {"steps": 50}),
    "peers bounds": ({"boxes": 400_000}, {"boxes": 4_000}),
    "peers step": ({"batch": 20_000, "steps": 60, "alone": 40}, {"batch": 2_000, "steps": 20, "alone": 5}),
    "peers numpy": ({"batch": 20_000, "steps": 60, "few": 2_000}, {"batch": 2_000, "steps": 20, "few": 200}),
    "peers horizon": ({"batch": 2_000, "steps": 30, "solved": 5}, {"batch": 200, "steps": 20, "solved": 2}),
    "study": ({"boxes": 1000, "levels": 1000, "steps": 100}, {"boxes": 100, "levels": 100, "steps": 50}),
    "rounding": ({"batch": 20_000, "steps": 100}, {"batch": 2_000, "steps": 50}),
    "plants": ({"repeat": 20, "steps": 200}, {"repeat": 3, "steps": 50}),
}
PLANTS = (
    "flight", "paper", "double_integrator", "quadruple_tank", "six_tanks", "unicycle", "heading", "battery", "building",
    "sir", "tclab",
)  # fmt: skip  # gx.examples.names(), without the import


def cases(
    quick: bool, against: str | None = None, peers: str | None = None
) -> dict[str, tuple[str, str, dict[str, Any]]]:
    """Name of every case: its module, its function and its arguments."""
    size = {name: both[quick] for name, both in SIZES.items()}
    return {
        "throughput final widths": ("throughput", "final_widths", size["compiled"]),
        "throughput all boxes": ("throughput", "all_boxes", size["compiled"]),
        "throughput NumPy": ("throughput", "numpy", size["numpy"]),
        "limit final widths": ("limit", "final_widths", {**size["limit"], "against": against}),
        "limit all boxes": ("limit", "all_boxes", {**size["limit stored"], "against": against}),
        "peers bounds": ("peers", "bounds", {**size["peers bounds"], "peers": peers}),
        "peers step": ("peers", "step", {**size["peers step"], "peers": peers}),
        "peers NumPy": ("peers", "numpy", size["peers numpy"]),
        "peers horizon": ("peers", "horizon", size["peers horizon"]),
        "study sweep": ("studies", "sweep", size["study"]),
        **{
            f"rounding {plant} {dtype}": ("rounding", "compare", {"plant": plant, "dtype": dtype, **size["rounding"]})
            for plant in ("s1", "s5")
            for dtype in ("float64", "float32")
        },
        **{f"piecewise {kind}": ("piecewise", "case", {"kind": kind}) for kind in ("clips", "interp", "battery")},
        **{f"plants {name}": ("gallery", "plant", {"name": name, **size["plants"]}) for name in PLANTS},
        "startup import": ("startup", "importing", {}),
        "startup six tanks": ("startup", "tanks", size["tanks"]),
    }


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--only", default="", help="cases whose name contains this text")
    parser.add_argument("--name", help="name of the result file (default: quick or full)")
    parser.add_argument("--against", metavar="PYTHON", help="of an environment with an older version (limit)")
    parser.add_argument("--peers", metavar="PYTHON", help="of an environment with immrax and codac (peers)")
    parser.add_argument("--case", help=argparse.SUPPRESS)
    options = parser.parse_args()
    every = cases(options.quick, options.against, options.peers)
    chosen = {name: spec for name, spec in every.items() if options.only in name}
    if options.case:
        print(json.dumps(run_here(*chosen[options.case])))
        return 0
    if not chosen:
        parser.error(f"no case contains {options.only!r}; there are: {', '.join(every)}")
    results = {name: run_apart(name, options.quick, options.against, options.peers) for name in chosen}
    print(table(results))
    name = options.name or ("quick" if options.quick else "full")
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"setting": setting(), "results": results}, indent=2) + "\n")
    print(f"\nwritten to {path}")
    return 0 if all(result["ok"] for result in results.values()) else 1


def run_here(module: str, function: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Run one case in this process."""
    import importlib

    measure: Callable[..., dict[str, Any]] = getattr(importlib.import_module(f"benchmarks.{module}"), function)
    return measure(**arguments)


def run_apart(name: str, quick: bool, against: str | None = None, peers: str | None = None) -> dict[str, Any]:
    """Run one case in a process of its own."""
    print(f"{name} ...", file=sys.stderr, flush=True)
    command = [sys.executable, "-m", "benchmarks", "--case", name, *(["--quick"] if quick else [])]
    command += ["--against", against] if against else []
    command += ["--peers", peers] if peers else []
    from gsisio_jax.scalar import options  # here: a case may measure what importing takes

    # As the command line of the library sets them, unless the user has; before JAX starts.
    flags = os.environ.get("XLA_FLAGS", options.extended(""))
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_ENABLE_X64": "1"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
    if done.returncode:
        print(done.stderr, file=sys.stderr)
        return {"ok": False, "error": _last_error(done.stderr)}
    return json.loads(done.stdout.strip().splitlines()[-1])


def _last_error(text: str) -> str:
    """The line of a traceback that names the error."""
    lines = [line for line in text.splitlines() if "Error" in line and not line.startswith(" ")]
    return lines[-1] if lines else "no message"


def setting() -> dict[str, Any]:
    """What the figures depend on."""
    model = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    packages = ("jax", "numpy", "equinox", "gsisio_jax")
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    return {
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "commit": commit.stdout.strip(),
        "processor": model,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{package: version(package) for package in packages},
    }


def table(results: dict[str, dict[str, Any]]) -> str:
    """The results as text; ratios are against NumPy."""
    slow = results.get("throughput NumPy", {}).get("rate")
    titles = f"{'case':<26}{'boxes x steps':>16}{'run':>10}{'cpu':>10}{'compile':>10}{'rate':>14}"
    head = f"{titles}{'/ NumPy':>9}{'peak':>11}  check"
    lines = [head, "-" * len(head)]
    for name, r in results.items():
        size = f"{r['batch']:,} x {r['steps']}" if "batch" in r else ""
        keys = ("seconds", "cpu_seconds", "compile_seconds")
        run, cpu, build = (f"{r[key]:.3g} s" if key in r else "" for key in keys)
        rate = f"{r['rate'] / 1e6:.3f} M/s" if "rate" in r else ""
        ratio = f"{r['rate'] / slow:.1f}" if "rate" in r and slow else ""
        peak = f"{r['peak_mebibytes']:,.0f} MiB" if "peak_mebibytes" in r else ""
        notes = [r.get("error") or ("passed" if r["ok"] else "FAILED")]
        notes += [f"agrees to {r['gap']:.0e}"] if "gap" in r else []
        notes += [f"{r['to_bare']:.2f} of the rate of the bare kernel"] if "to_bare" in r else []
        notes += [f"outward / nearest {r['cost']:.2f}, wider by {r['inflation']:.1e}"] if "cost" in r else []
        notes += [f"first call {r['first_call_seconds']:.1f} s"] if "first_call_seconds" in r else []
        notes += [f"design {r['design_seconds']:.1f} s"] if "design_seconds" in r else []
        notes += [f"ours / {other} {ratio:.2f}" for other, ratio in r.get("ratios", {}).items()]
        notes += [f"{other} left out: {reason}" for other, reason in r.get("left_out", {}).items()]
        left = f"{name:<26}{size:>16}{run:>10}{cpu:>10}{build:>10}{rate:>14}"
        lines.append(f"{left}{ratio:>9}{peak:>11}  {', '.join(notes)}")
    return "\n".join([*lines, "", "rate in million boxes x steps per second; NumPy's is that of the smaller batch."])


if __name__ == "__main__":
    sys.exit(main())

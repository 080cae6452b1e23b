"""`python -m benchmarks.size`: equations and scalar operations of one step, stage by stage; `--write` records them."""

from __future__ import annotations

import argparse
import json
from typing import Any

import jax

from benchmarks.plants import from_tests
from benchmarks.record import keep

STAGES = ("known", "predict", "initial", "sweeps", "certified", "inputs", "restart", "finish", "other")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.size", description=__doc__)
    parser.add_argument("--write", action="store_true", help="record today's equations as the budget of the tests")
    write = parser.parse_args().write
    jax.config.update("jax_enable_x64", True)
    sizes = from_tests("sizes")
    budget = sizes.recorded() if sizes.BUDGET.exists() else {}
    found, operations = {}, {}
    for name in sizes.SYSTEMS:
        step = sizes.Step(name)
        for variant in sizes.VARIANTS:
            found[sizes.key(name, variant)] = dict(step.equations(variant))
        operations[name] = {v: dict(step.operations(v)) for v in sizes.VARIANTS if v != "with gradient"}
    print(
        table(found, {sizes.key(name, v): row for name, rows in operations.items() for v, row in rows.items()}, budget)
    )
    rows = [
        [program, *(f"{row.get(stage, 0):,}" for stage in STAGES), f"{sum(row.values()):,}"]
        for program, row in found.items()
    ]
    keep("size", ["equations of", *STAGES, "all"], rows)
    if write:
        sizes.BUDGET.write_text(json.dumps(found, indent=2, sort_keys=True) + "\n")
        print(f"\nwritten to {sizes.BUDGET}")


def table(equations: dict[str, Any], operations: dict[str, Any], budget: dict[str, Any]) -> str:
    """Counts as text: equations, and below them operations where these are others; the budget's total behind."""
    head = f"{'program':<20}{'of':<12}" + "".join(f"{stage:>11}" for stage in (*STAGES, "all", "budget"))
    lines = [head, "-" * len(head)]
    for program, row in equations.items():
        most = f"{sum(budget[program].values()):,}" if program in budget else ""
        lines.append(_line(program, "equations", row) + f"{most:>11}")
        if operations.get(program, row) != row:
            lines.append(_line("", "operations", operations[program]))
    return "\n".join(
        [*lines, "", "A gradient's equations are those of its way back, with what that computes again of the step."]
    )


def _line(program: str, of: str, row: dict[str, int]) -> str:
    numbers = [*(row.get(stage, 0) for stage in STAGES), sum(row.values())]
    return f"{program:<20}{of:<12}" + "".join(f"{number:>11,}" for number in numbers)


if __name__ == "__main__":
    main()

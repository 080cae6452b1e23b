"""`python -m benchmarks.tables`: write the tables of benchmarks/README.md anew from benchmarks/results.

A table stands between ``<!-- table NAME -->`` and ``<!-- table end -->``; tests/test_tables.py sees that each is what
its file of results says.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import soak
from benchmarks.__main__ import RESULTS

PAGE = Path(__file__).with_name("README.md")
_MARKED = re.compile(r"(<!-- table (\w+) -->\n).*?(<!-- table end -->)", re.DOTALL)
_IMMRAX = {"natif": "ranges", "jacif": "Jacobians", "mjacif": "mixed Jacobians"}


def peers(found: dict[str, Any]) -> str:
    """Other programs beside this library."""
    results = found["results"]
    lines = [
        "| Peer and task | ours, a second | the peer's | ratio | mean widths, ours | the peer's |",
        "| --- | --- | --- | --- | --- | --- |",
    ]

    def row(task: str, case: dict[str, Any], ours: str, peer: str) -> None:
        rates, widths = case["rates"], case["mean_width"]
        cells = task, _rate(rates[ours]), _rate(rates[peer]), _two(rates[ours] / rates[peer])
        lines.append(f"| {' | '.join((*cells, _widths(widths[ours]), _widths(widths[peer])))} |")

    bounds = results["peers bounds"]
    for peer, form in _IMMRAX.items():
        outward = "natural" if peer == "natif" else "affine"
        for ours in (outward, f"{outward}, nearest"):
            row(f"immrax `{peer}` ({form}), ours {ours}", bounds, ours, peer)
    row("codac, a step without unknown inputs, four gains", results["peers step"], "ours", "codac")
    row("NumPy, a step, one record", results["peers NumPy"], "ours", "NumPy")
    for ours in ("ours", "ours, window 5"):
        row(f"HiGHS, a step of three masses ({ours})", results["peers horizon"], ours, "HiGHS")
    s = found["setting"]
    versions = ", ".join(f"{name} {s[name]}" for name in ("python", "jax", "numpy"))
    said = f"{s['date']}, commit {s['commit']}, {s['processor']}, {s['cores']} cores, {versions}"
    return "\n".join([*lines, "", f"{bounds['batch']:,} boxes for immrax. {said}."])


TABLES: dict[str, Callable[[dict[str, Any]], str]] = {"peers": peers, "soak": soak.table}
"""By name of the file of results."""


def written(page: str) -> str:
    """The page with every table as its results say."""

    def table(match: re.Match[str]) -> str:
        found = json.loads((RESULTS / f"{match[2]}.json").read_text())
        return f"{match[1]}\n{TABLES[match[2]](found)}\n\n{match[3]}"

    return _MARKED.sub(table, page)


def _rate(value: float) -> str:
    return f"{_two(value / 1e6)} M" if value >= 1e6 else _two(value)


def _two(value: float) -> str:
    """Two digits that count."""
    rounded = float(f"{value:.2g}")
    return f"{rounded:,.0f}" if rounded >= 10 else f"{rounded:g}"


def _widths(values: list[float]) -> str:
    return ", ".join(f"{v:.3g}" for v in (values if len(values) < 5 else [min(values), max(values)]))


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")

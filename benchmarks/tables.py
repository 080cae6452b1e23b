"""`python -m benchmarks.tables`: write the tables of benchmarks/README.md (and of docs) anew from benchmarks/results.

A table stands between ``<!-- table NAME -->`` and ``<!-- table end -->``; tests/test_tables.py sees that each is what
its file of results says.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import gallery, soak
from benchmarks.__main__ import RESULTS, ROOT
from benchmarks.record import line, title

PAGE = Path(__file__).with_name("README.md")
PAGES = PAGE, ROOT / "docs" / "how-to" / "tuning.md"
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
    return "\n".join([*lines, "", f"{bounds['batch']:,} boxes for immrax. {_measured(found)}"])


def rounding(found: dict[str, Any]) -> str:
    """What rounding outward costs and widens, by plant and precision."""
    lines = [title(["", "outward, M box-steps/s of CPU time", "outward / nearest", "widest relative inflation"])]
    for name, case in found["results"].items():
        plant, dtype = name.split()[1:]
        cells = f"{case['rate'] / 1e6:.2g}", f"{case['cost']:.2f}", f"{case['inflation']:.1e}"
        lines.append(line([f"{plant.upper()} {dtype}", *cells]))
    return "\n".join([*lines, "", _measured(found)])


def limit(found: dict[str, Any]) -> str:
    """This library beside the same step by hand, in C, and an older version."""
    cases = found["results"]
    others = list(dict.fromkeys(other for case in cases.values() for other in case["ratios"]))
    lines = [title(["boxes x steps", "M box-steps/s", *(f"ours / {_OTHERS[other]}" for other in others)])]
    for name, case in cases.items():
        size = f"{name.removeprefix('limit ')}, {case['batch']:,} x {case['steps']}"
        ratios = [f"{case['ratios'][other]:.3g}" if other in case["ratios"] else "-" for other in others]
        lines.append(line([size, f"{case['rate'] / 1e6:.3g}", *ratios]))
    return "\n".join([*lines, "", _measured(found)])


def plants(found: dict[str, Any]) -> str:
    """The built-in examples."""
    return f"{gallery.table(found['results'])}\n\n{_measured(found)}"


def cells(found: dict[str, Any]) -> str:
    """A table as an experiment has kept it (`benchmarks.record`)."""
    return "\n".join([title(found["head"]), *map(line, found["rows"]), "", _measured(found)])


def _measured(found: dict[str, Any]) -> str:
    """When, on what and with what."""
    s = found["setting"]
    parts = [s["date"], f"commit {s['commit']}"]
    parts += [f"{s['processor']}, {s['cores']} cores"] if "processor" in s else []
    parts += [f"{name} {s[name]}" for name in ("python", "jax", "numpy") if name in s]
    return ", ".join(parts) + (f"; {s['note']}." if "note" in s else ".")


_OTHERS = {"handwritten": "by hand", "C": "C", "older": "older version"}
_KEPT = (
    "ablation", "delay", "dials", "directions", "gradients", "models", "recovery", "size", "tightness",
    "tightness_default",
)  # fmt: skip
TABLES: dict[str, Callable[[dict[str, Any]], str]] = {
    "limit": limit, "rounding": rounding, "peers": peers, "plants": plants, "soak": soak.table,
    **dict.fromkeys(_KEPT, cells),
}  # fmt: skip
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
    for page in PAGES:
        page.write_text(written(page.read_text(encoding="utf-8")), encoding="utf-8")

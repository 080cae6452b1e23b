"""What an experiment prints as a table, kept as a small file in benchmarks/results for `benchmarks.tables`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from benchmarks.__main__ import RESULTS, setting


def keep(name: str, head: Sequence[str], rows: Sequence[Sequence[str]], **more: Any) -> None:
    """Write results/NAME.json: the cells of the table, when and where they were measured, and `more`.

    Args:
        name: that of the file and of the mark in README.md.
        head: titles of the columns.
        rows: cells, as they are shown.
        more: what else belongs to it, JSON.
    """
    RESULTS.mkdir(exist_ok=True)
    found = {"setting": setting(), "head": list(head), "rows": [list(row) for row in rows], **more}
    (RESULTS / f"{name}.json").write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def keep_rows(name: str, head: Sequence[str], rows: Sequence[Sequence[str]], order: Sequence[str]) -> None:
    """`keep` of a part of a table: rows of other names, the first cell, stay as they are; a note says from when.

    Args:
        name, head, rows: as in `keep`.
        order: of the names.
    """
    file, new = RESULTS / f"{name}.json", {row[0] for row in rows}
    before: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"rows": []}
    stay = [row for row in before["rows"] if row[0] not in new and row[0] in order]
    when = {row[0]: before.get("when", {}).get(row[0], _when(before["setting"])) for row in stay}
    keep(name, head, sorted([*map(list, rows), *stay], key=lambda row: order.index(row[0])), when=when)
    if when:
        found = json.loads(file.read_text())
        of = {one: ", ".join(other for other, at in when.items() if at == one) for one in dict.fromkeys(when.values())}
        found["setting"]["note"] = "; ".join(f"{names}: {one}" for one, names in of.items())
        file.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _when(setting: dict[str, Any]) -> str:
    return f"commit {setting['commit']}, {setting['date']}"


def line(cells: Sequence[str]) -> str:
    """A row of Markdown."""
    return f"| {' | '.join(cells)} |"


def title(head: Sequence[str]) -> str:
    """The first two lines of a table."""
    return f"{line(head)}\n{line(['---'] * len(head))}"

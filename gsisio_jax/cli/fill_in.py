"""What `gsisio init` leaves open, and the one error that lists all of it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .errors import UserError

MARK = "FILL_IN"


def check_filled_in(raw: dict[str, Any], path: Path) -> None:
    """Complain about every key of a configuration, and every line of the plant beside it, that still says ``FILL_IN``.

    Args:
        raw: the TOML file as it was read.
        path: its place.

    Raises:
        UserError: something is left to fill in; one line that lists all of it.
    """
    keys = list(_marked(raw, ""))
    use = raw.get("system", {}).get("use") if isinstance(raw.get("system"), dict) else None
    plant = path.parent / f"{use.partition(':')[0]}.py" if isinstance(use, str) else None
    lines = _unfinished(plant) if plant is not None and plant.is_file() else []
    parts = [", ".join(keys)] if keys else []
    if lines and plant is not None:
        parts.append(f"in {plant.name} " + ", ".join(f"{what} (line {line})" for what, line in lines))
    if parts:
        raise UserError(f"{path.name}: fill in what says {MARK}: {'; '.join(parts)}")


def _marked(value: Any, key: str) -> Iterator[str]:
    """Keys below `key` whose value is the mark."""
    if isinstance(value, dict):
        for name, one in value.items():
            yield from _marked(one, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for index, one in enumerate(value):
            yield from _marked(one, f"{key}[{index}]")
    elif value == MARK:
        yield key


def _unfinished(path: Path) -> list[tuple[str, int]]:
    """Functions and names of a module that are given by the mark, with their lines."""
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError):
        return []  # importing it tells what is wrong
    found = []
    for statement in tree.body:
        for node in ast.walk(statement):
            if isinstance(node, ast.Name) and node.id == MARK:
                target = getattr(statement, "name", None) or ast.unparse(getattr(statement, "targets", [statement])[0])
                found.append((target, node.lineno))
    return found

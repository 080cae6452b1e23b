"""Names and signatures that users rely on, against the record in `public_api.txt`.

A change shows as a difference. If it is meant: ``python tests/test_public_api.py --write``, look at the difference in
git, and follow the deprecation policy of CONTRIBUTING.md for what goes or changes.
"""

from __future__ import annotations

import difflib
import enum
import inspect
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import gsisio_jax as gx

RECORD = Path(__file__).with_name("public_api.txt")
# Of these only the names below are public: they have no `__all__`, as they hold other things that serve the library.
PARTS = {
    "gx.estimation": ("estimate", "start", "step", "resume", "collect"),
    "gx.dataset": ("to_dataset", "alarm_records"),
    "gx.examples": ("names", "config_path"),
}


def signature(value: Any) -> str:
    """Parameters and defaults; annotations may get more precise without breaking anybody."""
    try:
        found = inspect.signature(value)
    except ValueError:
        return "(...)"
    parameters = [p.replace(annotation=inspect.Parameter.empty) for p in found.parameters.values()]
    return str(found.replace(parameters=parameters, return_annotation=inspect.Signature.empty))


def of_class(name: str, value: type) -> list[str]:
    if issubclass(value, enum.Enum):
        return [f"{name}.{member.name} = {member.value}" for member in value]
    made = "" if issubclass(value, BaseException) else signature(value)
    lines = [f"class {name}{made}"]
    ours = [kind for kind in value.__mro__ if kind.__module__.partition(".")[0] == gx.__name__]
    for attribute in sorted({name for kind in ours for name in (*vars(kind), *vars(kind).get("__annotations__", {}))}):
        if attribute.startswith("_"):
            continue
        found = inspect.getattr_static(value, attribute, None)
        found = found.__func__ if isinstance(found, (classmethod, staticmethod)) else found
        lines.append(f"{name}.{attribute}{signature(found) if inspect.isfunction(found) else ''}")
    return lines


def described(name: str, value: Any) -> list[str]:
    if isinstance(value, ModuleType):
        names = PARTS.get(name) or getattr(value, "__all__", ())
        return [line for each in sorted(names) for line in described(f"{name}.{each}", getattr(value, each))]
    if isinstance(value, type):
        return of_class(name, value)
    return [f"{name}{signature(value)}" if callable(value) else name]


def public_api() -> str:
    return "".join(f"{line}\n" for name in gx.__all__ for line in described(f"gx.{name}", getattr(gx, name)))


def test_names_and_signatures_are_those_of_the_record():
    before, now = RECORD.read_text().splitlines(), public_api().splitlines()
    changes = [line for line in difflib.unified_diff(before, now, "recorded", "now", lineterm="", n=0)]
    assert not changes, "\n".join([*changes, "", __doc__ or ""])


def test_a_changed_default_shows():
    def one(x, y=1, *, z=None): ...

    assert signature(one) == "(x, y=1, *, z=None)"
    assert described("gx.Status", gx.Status)[0] == "gx.Status.CONFLICT = 1"
    assert described("gx.step", gx.step) == [
        "gx.step(observer, carry, y_k, u_k=None, noise=None, on_conflict='restart', rounding=None)"
    ]


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        sys.exit("usage: python tests/test_public_api.py --write")
    RECORD.write_text(public_api())

"""Docstrings as Markdown: sessions of the interpreter become code blocks, attributes that share a line share a type."""

from __future__ import annotations

import re
from typing import Any

import griffe

SESSION = re.compile(r"^(?P<indent> *)>>> .*\n(?:(?P=indent).*\S.*\n?)*", re.MULTILINE)
# "K, L: text": the parser would take the second name for the type of the first.
NAMES = re.compile(r"^( +(?:\w+, )+\w+)(?=: )", re.MULTILINE)


def fenced(text: str) -> str:
    """The same text with a fence around each ``>>>`` session, which ends with a blank line."""

    def fence(match: re.Match[str]) -> str:
        indent, session = match["indent"], match.group().rstrip("\n")
        return f"{indent}```pycon\n{session}\n{indent}```\n"

    return SESSION.sub(fence, text + "\n").rstrip("\n")


def joined(text: str, obj: griffe.Object) -> str:
    """The same text where names before one colon are one name, with the types that they have."""
    typed = {part.name: part for part in obj.parameters} if isinstance(obj, griffe.Function) else obj.members

    def one(match: re.Match[str]) -> str:
        names = match[1].split(", ")
        found = dict.fromkeys(str(getattr(typed.get(name.strip()), "annotation", None)) for name in names)
        types = "" if "None" in found else f" ({', '.join(found)})"
        return ",\N{NO-BREAK SPACE}".join(names) + types

    return NAMES.sub(one, text)


class Sessions(griffe.Extension):
    """Changes docstrings when an object has been read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None and (obj.is_class or obj.is_function):
            obj.docstring.value = joined(obj.docstring.value, obj)
        if obj.docstring is not None and ">>>" in obj.docstring.value:
            obj.docstring.value = fenced(obj.docstring.value)

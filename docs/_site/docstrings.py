"""Docstrings as Markdown: sessions of the interpreter become code blocks."""

from __future__ import annotations

import re
from typing import Any

import griffe

SESSION = re.compile(r"^(?P<indent> *)>>> .*\n(?:(?P=indent)\S.*\n?)*", re.MULTILINE)


def fenced(text: str) -> str:
    """The same text with a fence around each ``>>>`` session, which ends with a blank line."""

    def fence(match: re.Match[str]) -> str:
        indent, session = match["indent"], match.group().rstrip("\n")
        return f"{indent}```pycon\n{session}\n{indent}```\n"

    return SESSION.sub(fence, text + "\n").rstrip("\n")


class Sessions(griffe.Extension):
    """Changes docstrings when an object has been read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None and ">>>" in obj.docstring.value:
            obj.docstring.value = fenced(obj.docstring.value)

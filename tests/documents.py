"""The blocks of a Markdown page, and how they are run: one namespace and one folder for each page.

A fence in Python is code; ``gsisio`` lines of a fence in ``sh`` are commands. A fence with ``title="name"`` is a file
of that name. ``<!-- output -->`` before a ``text`` fence: every line of it must occur in what the blocks before it have
said since the last such fence, whole, in this order, numbers to a thousandth;
``...`` stands for anything. ``<!-- not run: why -->`` before a fence leaves it out.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from gsisio_jax.cli import main

ROOT = Path(__file__).parents[1]
FENCE = re.compile(
    r"(?:<!-- (?P<mark>[^\n]*?) -->\n)?^```(?P<info>[^\n]*)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE
)
# Not part of a name (x1), a date or a longer number.
NUMBER = r"(?<![\w.])[-+]?(?:\d[\d,]*(?:\.(?!\.)\d*)?|\.\d+)(?:[eE][-+]?\d+)?(?![\w]|[.,]\d)"
CLOSE = 1e-3
PYTHON, SHELL = ("python", "py"), ("sh", "bash", "shell", "console")


@dataclass(frozen=True)
class Block:
    """A fence: its language, the file that it is, the mark before it, its text and the line where that begins."""

    language: str
    title: str | None
    mark: str
    text: str
    line: int

    @property
    def left_out(self) -> bool:
        return self.mark.startswith("not run")

    @property
    def runs(self) -> bool:
        return not self.left_out and (self.title is not None or self.language in PYTHON or bool(self.commands))

    @property
    def commands(self) -> list[list[str]]:
        """The ``gsisio`` commands of a shell block."""
        if self.language not in SHELL:
            return []
        return [shlex.split(line, comments=True)[1:] for line in self.text.splitlines() if line.startswith("gsisio ")]


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        language, _, rest = match["info"].partition(" ")
        title = re.search(r'title="([^"]+)"', rest)
        line = text.count("\n", 0, match.start("text"))
        found.append(Block(language, title and title[1], match["mark"] or "", match["text"], line))
    return found


def absent(expected: str, said: str) -> list[str]:
    """Lines of a fence that were not said, in this order, as whole lines.

    Blanks count as one; ``...`` stands for anything within a line. Text must be equal, whole numbers too, others to
    ``CLOSE`` of their size.
    """
    lines, place, missed = [" ".join(line.split()) for line in said.splitlines()], 0, []
    for line in (" ".join(line.split()) for line in expected.splitlines()):
        # From the line found last: a long line of the program may be several of the page.
        found = next((i for i in range(place, len(lines)) if _agrees(line, lines[i])), None)
        if found is None:
            missed.append(line)
        else:
            place = found
    return missed


def _agrees(expected: str, said: str) -> bool:
    parts = re.split(rf"({NUMBER}|\.\.\.)", expected)
    texts, marks = parts[::2], parts[1::2]
    pattern = re.escape(texts[0])
    for mark, text in zip(marks, texts[1:], strict=True):
        pattern += (".*" if mark == "..." else f"({NUMBER})") + re.escape(text)
    match = re.fullmatch(pattern, said)
    numbers = [mark for mark in marks if mark != "..."]
    return match is not None and all(map(_close, numbers, match.groups()))


def _close(expected: str, said: str) -> bool:
    a, b = (float(number.replace(",", "")) for number in (expected, said))
    whole = all(re.fullmatch(r"[-+]?[\d,]+", number) for number in (expected, said))
    return a == b if whole else abs(a - b) <= CLOSE * abs(a) + 1e-12


@contextlib.contextmanager
def modules_of(folder: Path) -> Iterator[None]:
    """Modules of a page's folder can be imported, and are forgotten afterwards: the next page has others so named."""
    before = sys.path[:]
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path[:] = before
        for name, module in list(sys.modules.items()):
            if str(getattr(module, "__file__", None) or "").startswith(str(folder)):
                del sys.modules[name]


@dataclass
class Session:
    """What the blocks of one page share."""

    page: Path
    folder: Path
    names: dict = field(default_factory=lambda: {"__name__": "page"}, repr=False)
    said: io.StringIO = field(default_factory=io.StringIO, repr=False)

    def run(self, block: Block) -> None:
        where = f"{self.page.relative_to(ROOT)}, line {block.line}"
        if block.title is not None:
            (self.folder / block.title).write_text(block.text, encoding="utf-8")
            return
        with contextlib.redirect_stdout(self.said), contextlib.redirect_stderr(self.said):
            if block.language in PYTHON:
                # The line of a failure is that of the page.
                exec(compile("\n" * block.line + block.text, str(self.page), "exec"), self.names)
            for command in block.commands:
                try:
                    code = main(command)
                except SystemExit as stop:  # --version, --help
                    code = stop.code
                assert code == 0, f"{where}: gsisio {' '.join(command)} ended with {code}: {self.said.getvalue()}"

    def expect(self, block: Block) -> None:
        said = self.said.getvalue()
        missed = absent(block.text, said)
        assert not missed, f"{self.page.relative_to(ROOT)}, line {block.line}: not said: {missed}\n{said}"
        self.said.truncate(self.said.seek(0))

"""Every code block of README and docs is run, page by page, and says what the page says that it says."""

from __future__ import annotations

import os
import re

import documents
import jax
import pytest

PAGES = documents.pages()
# Blocks that are not run, and why. A new one is a decision: it belongs here, and into a mark above its fence.
LEFT_OUT = {
    "docs/how-to/cluster.md": 3,  # clusters of other people
    "docs/paper.md": 1,  # has a test of its own
}


def name(page):
    return page.relative_to(documents.ROOT).as_posix()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    # Programs run once or twice each: compiled without optimization they are done in half of the time.
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_disable_most_optimizations", True)
    monkeypatch.chdir(tmp_path)
    with documents.modules_of(tmp_path):
        yield tmp_path
    jax.config.update("jax_disable_most_optimizations", False)
    jax.config.update("jax_enable_x64", before)


@pytest.mark.parametrize("page", [page for page in PAGES if any(b.runs for b in documents.blocks(page))], ids=name)
def test_the_blocks_of_a_page_run(page, folder):
    session = documents.Session(page, folder)
    for block in documents.blocks(page):
        if block.runs:
            session.run(block)
        elif block.mark == "output":
            session.expect(block)


def test_blocks_that_are_not_run_are_few():
    found = {name(page): sum(block.left_out for block in documents.blocks(page)) for page in PAGES}
    assert {page: count for page, count in found.items() if count} == LEFT_OUT


def test_marks_are_known():
    """A mark with a slip of the pen would switch nothing off and check nothing."""
    marks = {block.mark for page in PAGES for block in documents.blocks(page) if block.mark}
    assert {mark for mark in marks if mark != "output" and not mark.startswith("not run: ")} <= {"test command"}
    # An indented fence would not be seen.
    assert [name(page) for page in PAGES if re.search(r"^[ >]+```(py|sh)", page.read_text(), re.MULTILINE)] == []


@pytest.mark.parametrize(
    ("expected", "said", "missing"),
    [
        ("rate 0.5 per step", "a\n  rate   0.5 per step\n", 0),
        ("rate 0.5", "rate 0.4", 1),
        ("width 0.005", "width 0.00500001", 0),
        ("width 0.005", "width 0.00502", 1),
        ("state 2  1", "state 2 1.2", 1),
        ("state 2  1.2", "state 1 1.2", 1),
        ("8,734 rows", "8,735 rows", 1),
        ("[1. -2.5e-3]", "[ 1. -0.0025]", 1),
        ("[1. -2.5e-3]", "[1.   -0.0025001]", 0),
        ("1.9477... in the file", "gives 1.9477216 in the file", 1),
        ("... 1.9477... in the file", "gives 1.9477216 in the file", 0),
        ("rate 0.5", "rate 0.5 per step", 1),
        ("residual 0.0e+00", "residual 2.2e-17", 0),
        ("at 2026-11-29", "at 2026-11-28", 1),
        ("a ...\n... d", "a b c d", 0),
        ("a ... c\nd", "a b c", 1),
        ("c ... a", "a b c", 1),
    ],
)
def test_what_was_not_said_is_found(expected, said, missing):
    assert len(documents.absent(expected, said)) == missing


def test_a_block_that_fails_fails(tmp_path):
    page = documents.ROOT / "README.md"
    session = documents.Session(page, tmp_path)
    with pytest.raises(ZeroDivisionError):
        session.run(documents.Block("python", None, "", "1 / 0", 0))
    session.run(documents.Block("python", None, "", "print(6 * 7)", 0))
    with pytest.raises(AssertionError, match="not said: \\['43'\\]"):
        session.expect(documents.Block("text", None, "output", "43\n", 0))
    os.chdir(tmp_path)
    with pytest.raises(AssertionError, match="ended with 2"):
        session.run(documents.Block("sh", None, "", "gsisio estimate nothing.toml", 0))

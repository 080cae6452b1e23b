"""The tables of the benchmarks are those of their results, and not typed."""

import json
import re

import pytest

from benchmarks import tables

MARK = re.compile(r"^<!-- table (?!end)(\w+) -->$", re.MULTILINE)
NAMES = {page: MARK.findall(page.read_text(encoding="utf-8")) for page in tables.PAGES}


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.parent.name)
def test_tables_are_those_of_the_results(page):
    text = page.read_text(encoding="utf-8")
    assert tables.written(text) == text, "python -m benchmarks.tables"


def test_every_table_has_a_place_and_says_when_it_was_measured():
    assert sorted(name for names in NAMES.values() for name in names) == sorted(tables.TABLES)
    for name in set(tables.TABLES) - {"soak"}:  # which says so part by part
        found = json.loads((tables.RESULTS / f"{name}.json").read_text(encoding="utf-8"))
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", found["setting"]["date"])
        assert re.fullmatch(r"[0-9a-f]{7,}", found["setting"]["commit"])


@pytest.mark.parametrize(("name", "old", "new"), [("peers", '"natif": 7', '"natif": 3'), ("delay", "1.53", "1.54")])
def test_another_figure_is_seen(monkeypatch, tmp_path, name, old, new):
    for each in tables.TABLES:
        text = (tables.RESULTS / f"{each}.json").read_text(encoding="utf-8")
        (tmp_path / f"{each}.json").write_text(text.replace(old, new) if each == name else text, encoding="utf-8")
    monkeypatch.setattr(tables, "RESULTS", tmp_path)
    page = tables.PAGE.read_text(encoding="utf-8")
    assert tables.written(page) != page

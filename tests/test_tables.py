"""The tables of the benchmarks are those of their results, and not typed."""

from benchmarks import tables


def test_tables_are_those_of_the_results():
    page = tables.PAGE.read_text(encoding="utf-8")
    assert tables.written(page) == page, "python -m benchmarks.tables"
    assert {name for name in tables.TABLES if f"<!-- table {name} -->" in page} == set(tables.TABLES)


def test_another_figure_is_seen(monkeypatch, tmp_path):
    text = (tables.RESULTS / "peers.json").read_text()
    for name in tables.TABLES:
        (tmp_path / f"{name}.json").write_text((tables.RESULTS / f"{name}.json").read_text())
    (tmp_path / "peers.json").write_text(text.replace('"natif": 8', '"natif": 3'))
    monkeypatch.setattr(tables, "RESULTS", tmp_path)
    page = tables.PAGE.read_text(encoding="utf-8")
    assert tables.written(page) != page

"""The HTML report and the summary as JSON: whole, offline, and the numbers of the files."""

from __future__ import annotations

import base64
import csv
import json
import re
from html.parser import HTMLParser

import netCDF4
import numpy as np
import pytest

from gsisio_jax.cli.figures import strict
from gsisio_jax.cli.page import write_page
from gsisio_jax.cli.report import Summary
from gsisio_jax.cli.totals import Totals

VOID = {"meta", "img", "br", "link"}


class Page(HTMLParser):
    """Text by section, rows of the tables, addresses; every tag is closed in its turn."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.addresses, self.sections, self.rows = [], [], {}, []
        self._section = ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href", "srcset", "action", "data")]
        if tag == "tr":
            self.rows.append([])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self._section = data
            self.sections[data] = ""
        elif self._section:
            self.sections[self._section] += data
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1].append(data)


def test_report_and_json(project):
    project.edit('title = "Cart"', 'title = "Cart <i>&amp;</i> \\"cable\\""')
    project.edit('picture = "cart.png"', 'picture = "cart.png"\nreport = "told.html"')
    code, out, err = project.run("--format", "json")
    assert (code, err) == (0, "")
    found = json.loads(out, parse_constant=pytest.fail)
    with open(project.out / "boxes.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))

    def widths(name):
        sides = (np.array([float(row[f"{name}_{side}"] or "nan") for row in rows]) for side in ("lower", "upper"))
        lower, upper = sides
        return (upper - lower)[~np.isnan(lower)]

    assert found["steps"] == len(rows) == 40
    assert found["time"] == {"first": float(rows[0]["time"]), "last": float(rows[-1]["time"])}
    assert found["missing"] == {"rows": 2, "partly": 1}
    for bit, name in ((1, "CONFLICT"), (2, "MISSING"), (4, "UNBOUNDED")):
        assert found["statuses"][name] == sum(bool(int(row["status"]) & bit) for row in rows)
    assert [one["name"] for one in found["signals"]] == ["position", "velocity", "force"]
    for signal in found["signals"]:
        width = widths(signal["name"])
        finite = width[np.isfinite(width)]
        assert signal["mean_width"] == pytest.approx(finite.mean(), rel=1e-12)
        assert signal["last_width"] == width[-1]
        assert signal["unbounded_steps"] == np.isinf(width).sum()
    # The region is the whole plane: there is no number for the room in it.
    assert [one["room_in_region"] for one in found["signals"]] == [None] * 3
    assert [alarm["step"] for alarm in found["alarms"]] == [project.jump]
    assert found["alarm_count"] == 1
    assert set(found["files"]) == {"netcdf", "csv", "picture", "report"}
    assert set(found["seconds"]) == {"design", "compile", "run"}

    code, out, _ = project.run("--format", "json", command="design")
    design = json.loads(out, parse_constant=pytest.fail)
    assert code == 0
    assert design["certificate"] == found["certificate"]
    certificate = design["certificate"]
    assert [one["name"] for one in certificate["states"]] == ["position", "velocity"]
    assert certificate["states"][1]["steady_width"] == pytest.approx(0.2)
    assert certificate["states"][1]["region_width"] is None
    assert certificate["certified"] is True
    assert certificate["rate"] < 1

    text = (project.out / "told.html").read_text()
    page = Page(text)
    # Nothing is fetched from anywhere.
    assert [address[:22] for address in page.addresses] == ["data:image/png;base64,"]
    assert not re.search(r"url\(|@import|<script|<link", text)
    assert base64.b64decode(page.addresses[0][22:]) == (project.out / "cart.png").read_bytes()
    assert list(page.sections) == ["Picture", "Summary", "Alarms", "Certificate", "Configuration", "Files"]
    assert project.config in page.sections["Configuration"]
    # Rows are missing and contradicted in this run.
    assert re.search(r"applies at \d+ of \d+ steps", page.sections["Certificate"])
    assert "where it applies: while no measurement is missing" in page.sections["Certificate"]
    assert "rate" in page.sections["Certificate"]
    alarm = next(row for row in page.rows if row[0] == "2.5")
    assert alarm[1] == str(project.jump)
    assert float(alarm[3]) == pytest.approx(-found["alarms"][0]["gap"], rel=1e-3)
    assert alarm[4] == found["alarms"][0]["text"]
    assert "Cart &lt;i&gt;&amp;amp;&lt;/i&gt; &quot;cable&quot;" in text
    assert "<i>" not in text
    assert "1 certified alarm<" in text


def test_a_log_with_dates_is_told_in_dates(project):
    """In the zone of the log; numbers in the files stay seconds, and say what they count from."""
    lines = (project.folder / "cart.csv").read_text().splitlines()
    dated = [f"2024-03-31 01:59:{57 + float(line.partition(',')[0]):.1f}" for line in lines[1:]]
    dated = [f"{date[:11]}03:00:0{float(date[17:]) - 60:.1f}" if float(date[17:]) >= 60 else date for date in dated]
    rows = [f"{date},{line.partition(',')[2]}" for date, line in zip(dated, lines[1:], strict=True)]
    project.write_table([lines[0], *rows])
    project.edit('time = "t"', 'time = {column = "t", zone = "Europe/Berlin"}')
    project.edit('picture = "cart.png"', 'picture = "cart.png"\nreport = "told.html"\ndraw = "dated_picture:draw"')
    (project.folder / "dated_picture.py").write_text(DRAW)
    code, out, err = project.run()
    assert (code, err) == (0, "")
    assert "steps         40, from 2024-03-31 01:59:57 to 2024-03-31 03:00:00.9 (Europe/Berlin)" in out
    assert "conflicts     1, at 2024-03-31 01:59:59.5\n" in out
    assert "    2024-03-31 01:59:59.5: velocity" in out
    page = Page((project.out / "told.html").read_text())
    assert next(row for row in page.rows if row[1:2] == [str(project.jump)])[0] == "2024-03-31 01:59:59.5"
    assert "2024-03-31 01:59:57 to 2024-03-31 03:00:00.9 (Europe/Berlin)" in (project.out / "told.html").read_text()
    with netCDF4.Dataset(project.out / "cart.nc") as file:
        time = file["time"]
        assert float(time[0]) == 1711846797.0
        assert (time.units, time.epoch, time.zone) == ("s", "1970-01-01T00:00:00Z", "Europe/Berlin")
        assert time.long_name == "time since 1970-01-01 00:00 UTC"
    assert (project.out / "cart.png").read_text() == "time (Europe/Berlin)"


DRAW = """
import gsisio_jax as gx


def draw(dataset, path):
    path.write_text(gx.plot.framers(dataset)[-1].get_xlabel())
"""


def test_many_alarms_and_a_picture_that_browsers_do_not_show(tmp_path):
    (tmp_path / "cart.pdf").write_bytes(b"%PDF")
    alarm = {"time": 1.0, "step": 1, "kind": "state", "index": 0, "gap": 2.0, "text": "x: apart"}
    totals = Totals([], steps=9, first=0.0, last=8.0, alarms=[alarm] * 600, alarm_times=np.arange(9000.0))
    summary = Summary("t", [("steps", "9")], ("signal", "width"), [("x", "1")], [], ["none"], [])
    write_page(tmp_path / "a.html", summary, totals, picture=tmp_path / "cart.pdf", certificate="c", configuration="<")
    page = Page((tmp_path / "a.html").read_text())
    assert page.addresses == []
    assert "The picture is in the file cart.pdf." in page.sections["Picture"]
    assert "8,500 more" in page.sections["Alarms"]
    assert len([row for row in page.rows if row[0] == "1"]) == 500


def test_json_has_no_infinity():
    assert strict({"a": [1.0, float("inf"), (float("nan"), {"b": -float("inf")})], "c": "inf", "d": True}) == {
        "a": [1.0, None, [None, {"b": None}]],
        "c": "inf",
        "d": True,
    }

"""The report: one HTML file that opens anywhere, without a network, on a phone, in the dark and on paper."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from .._version import __version__
from .report import Summary, short, span
from .totals import Totals

SHOWN_ALARMS = 500
LARGEST_PICTURE = 20_000_000  # bytes; a browser would choke on more
_MEDIA = {
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".webp": "image/webp",
}
_SOURCES = {
    "initial": "initial box",
    "output": "measurement",
    "state": "past and present",
    "dynamics": "dynamics",
    "input": "bounds of the input",
    "certificate": "certified bound",
    "balance": "balance of inputs",
    "periodic": "angle",
}
_STYLE = """
:root { color-scheme: light dark; --text: #1b1f24; --dim: #5b6470; --page: #f5f6f8; --card: #fff; --line: #dfe3e8;
  --blue: #2a5db0; --red: #b3202c; --pale-red: #fbe9ea; --green: #1d6f42; }
@media (prefers-color-scheme: dark) { :root { --text: #e6e9ee; --dim: #9aa4b2; --page: #14171b; --card: #1d2126;
  --line: #343a43; --blue: #8ab4f8; --red: #ff8a8f; --pale-red: #3a1f22; --green: #7fd6a4; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--text); font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 70rem; margin: 0 auto; padding: 1.5rem 1rem 3rem; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .25rem; overflow-wrap: anywhere; }
h2 { font-size: 1.1rem; margin: 0 0 .75rem; }
p { margin: .25rem 0; }
.dim { color: var(--dim); }
section { background: var(--card); border: 1px solid var(--line); border-radius: .6rem; padding: 1rem 1.1rem;
  margin-top: 1rem; }
.verdict { display: inline-block; margin-top: .6rem; padding: .15rem .7rem; border-radius: 1rem; font-weight: 600;
  border: 1px solid currentColor; color: var(--green); }
.verdict.bad { color: var(--red); background: var(--pale-red); }
figure { margin: 0; background: #fff; border-radius: .4rem; overflow-x: auto; }
figure img { display: block; width: 100%; height: auto; }
dl { display: grid; grid-template-columns: minmax(7rem, max-content) 1fr; gap: .15rem 1.2rem; margin: 0 0 1rem; }
dt { color: var(--dim); }
dd { margin: 0; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: .3rem .6rem; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { color: var(--dim); font-weight: 500; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
td.words, th.words { text-align: left; white-space: normal; min-width: 16rem; }
pre { margin: .5rem 0 0; padding: .75rem; overflow-x: auto; font: 13px/1.45 ui-monospace, monospace;
  background: var(--page); border: 1px solid var(--line); border-radius: .4rem; }
summary { cursor: pointer; color: var(--blue); }
ul { margin: 0; padding-left: 1.2rem; }
li { overflow-wrap: anywhere; }
@media (max-width: 40rem) { main { padding: 1rem .6rem 2rem; } section { padding: .8rem; } h1 { font-size: 1.3rem; }
  dl { grid-template-columns: 1fr; gap: 0; } dd { margin-bottom: .45rem; } figure img { width: 44rem; }
  thead { display: none; } tr { display: block; padding: .45rem 0; border-bottom: 1px solid var(--line); }
  td, td:first-child { display: flex; justify-content: space-between; gap: 1rem; border: 0; padding: .05rem 0; }
  td::before { content: attr(data-label); color: var(--dim); } td:empty, td.words::before { display: none; }
  td:first-child { font-weight: 600; } td.words { display: block; min-width: 0; } }
@media print { body { background: none; } section { break-inside: avoid; } }
"""


def write_page(
    path: Path, summary: Summary, totals: Totals, *, picture: Path, certificate: str, configuration: str
) -> None:
    """Write the report of a run.

    Args:
        path: file to write.
        summary: facts, signals, certificate in short, files.
        totals: the alarms.
        picture: file that is shown; one that a browser does not show (a PDF), or a huge one, is named instead.
        certificate: the whole text.
        configuration: text of the TOML file.
    """
    parts = [
        _section("Picture", [_picture(picture, summary.title)]),
        _section("Summary", [_facts(summary.facts), _table(summary.header, summary.signals)]),
        _section("Alarms", _alarms(totals)),
        _section(
            "Certificate",
            [_list(summary.certificate), f"<details><summary>All of it</summary>{_text(certificate)}</details>"],
        ),
        _section("Configuration", [f"<details><summary>The TOML file</summary>{_text(configuration)}</details>"]),
        _section("Files", [_list(summary.files)]),
    ]
    count = totals.alarm_count
    verdict = "No alarm" if count == 0 else f"{count:,} certified alarm{'s' if count > 1 else ''}"
    head = (
        f"<h1>{escape(summary.title)}</h1>"
        f'<p class="dim">{totals.steps:,} steps, {span(totals)} · '
        f"gsisio_jax {__version__}</p>"
        f'<p class="verdict{" bad" if count else ""}">{verdict}</p>'
    )
    path.write_text(
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(summary.title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n{head}\n"
        + "\n".join(parts)
        + "\n</main>\n</body>\n</html>\n",
        encoding="utf-8",
    )


def _section(heading: str, parts: Iterable[str]) -> str:
    return f"<section>\n<h2>{heading}</h2>\n" + "\n".join(parts) + "\n</section>"


def _picture(path: Path, title: str) -> str:
    media = _MEDIA.get(path.suffix.lower())
    if media is None or path.stat().st_size > LARGEST_PICTURE:
        return f'<p class="dim">The picture is in the file {escape(path.name)}.</p>'
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f'<figure><img alt="Boxes over time: {escape(title)}" src="data:{media};base64,{data}"></figure>'


def _facts(facts: Iterable[Sequence[str]]) -> str:
    return "<dl>" + "".join(f"<dt>{escape(label)}</dt><dd>{escape(value)}</dd>" for label, value in facts) + "</dl>"


def _alarms(totals: Totals) -> list[str]:
    if not totals.alarms:
        return ["<p>None: the data agree with the stated bounds at every step.</p>"]
    shown = totals.alarms[:SHOWN_ALARMS]
    rows = [
        (
            totals.when(alarm["time"], unit=""),
            str(alarm["step"]),
            _SOURCES.get(alarm["kind"]) or str(alarm["kind"]),
            short(-alarm["gap"]),
            alarm["text"],
        )
        for alarm in shown
    ]
    time = "time [s]" if totals.zone is None else "time"
    left = totals.alarm_count - len(shown)
    more = [f'<p class="dim">{left:,} more: every step with status 1 in the files is one.</p>'] if left else []
    return [
        '<p class="dim">Steps whose data contradict the stated bounds, whatever the unknown input was.</p>',
        _table((time, "step", "source", "margin", "what contradicts what"), rows, words=True),
        *more,
    ]


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], words: bool = False) -> str:
    """A table whose last column holds sentences if `words`."""

    def row(cells: Sequence[Any], tag: str) -> str:
        last = len(cells) - 1
        return "".join(
            f"<{tag}{' class=words' if words and index == last else ''} data-label={quoteattr(header[index])}>"
            f"{escape(cell)}</{tag}>"
            for index, cell in enumerate(cells)
        )

    body = "".join(f"<tr>{row(cells, 'td')}</tr>\n" for cells in rows)
    return f'<div class="wide"><table><thead><tr>{row(header, "th")}</tr></thead>\n<tbody>{body}</tbody></table></div>'


def _list(items: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"


def _text(text: str) -> str:
    return f"<pre>{escape(text)}</pre>"

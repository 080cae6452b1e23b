"""Every small log in ``files`` against what it must give: its reading, or its one line of error."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from gsisio_jax.cli.errors import UserError
from gsisio_jax.cli.logs import TablePart, read_table

FOLDER = Path(__file__).parent / "files"
NAN = np.nan
RECORD = ([0, 1, 2], [[1.5, -2], [2.25, NAN], [1000.5, 4]])
MAY = 1714557600  # 2024-05-01 10:00:00 UTC


def clock(*time, **options):
    """What a log of `make_files.clock` gives: its times, and for every one the row it comes from (None: absent)."""
    rows = options.pop("rows", range(len(time)))
    return {"y": ["a"]} | options, (list(time), [[NAN if row is None else row] for row in rows])


def refused(message, **options):
    return options, message


def clock_refused(message, **options):
    return {"y": ["a"]} | options, message


def record(found=None, **options):
    """The common record; `found` is what the command says of the dialect."""
    return options, RECORD, found


MS = {"column": "t", "unit": "ms"}
BERLIN = {"column": "t", "zone": "Europe/Berlin"}
FORMAT = {"column": "t", "format": "%d.%m.%Y %H:%M:%S", "zone": "Europe/Berlin"}
MISSING = 'where it means missing: set missing = ["{}"]'

# Several readings of one file: what follows a blank in the name is left out of the file name.
CASES = {
    "plain.csv": record(),
    "plain.csv with all keys": record(
        None,
        dialect={"separator": ",", "decimal": ".", "comment": "#", "skip": 0, "header": True, "encoding": "utf-8"},
    ),
    "semicolons.csv": record("semicolons between cells, decimal comma"),
    "tabs.tsv": record("tabs between cells"),
    "bars.txt": record("bars between cells"),
    "spaces.txt": record("spaces between cells"),
    "spaces_and_tabs.txt": record("spaces between cells"),
    "decimal_comma_in_quotes.csv": record("decimal comma"),
    "decimal_comma_one_column.csv": ({"time": None, "y": ["a"]}, ([0, 1, 2], [[1.5], [2.25], [1000.5]])),
    "thousands_points.csv": record("semicolons between cells, decimal comma, thousands as in 1.000"),
    "thousands_commas.csv": record("thousands as in 1,000"),
    "thousands_spaces.csv": record("semicolons between cells, decimal comma, thousands as in 1 000"),
    "thousands_apostrophes.csv": record("thousands as in 1'000"),
    "thousands_wrong.csv": refused("row 3, column 'a': '2.25' is not a number"),
    "comma_ambiguous.csv": refused("'1,500' may mean 1.500 or 1500, and no cell says which; set decimal or"),
    "comma_ambiguous.csv decimal": ({"dialect": {"decimal": ","}}, ([0, 1], [[1.5, -2], [2.25, NAN]])),
    "comma_ambiguous.csv thousands": ({"dialect": {"thousands": ","}}, ([0, 1], [[1500, -2], [2250, NAN]])),
    "signs_and_exponents.csv": record(),
    "comments.csv": record("comments after #, header in line 2"),
    "header_in_comment.csv": record("comments after #"),
    "percent_comments.txt": record("tabs between cells, comments after %, header in line 2"),
    "preamble.csv": record("header in line 5"),
    "preamble.csv skip": record("header in line 5", dialect={"skip": 4}),
    "preamble.csv skip too few": refused("no column 't'; the columns are: Start, 2024-05-01", dialect={"skip": 3}),
    "units_row.csv": record("1 line of units"),
    "units_row.csv kept": refused(
        "row 2, column 't': '.s.' is not a number; .*; where this row is one of units: set table.dialect.skip_aft",
        dialect={"skip_after": 0},
    ),
    "units_row_without_first.csv": record("semicolons between cells, decimal comma, 1 line of units"),
    "units_row_without_first.csv as missing": refused(
        "row 2, column 't': the time is missing; .*; where this row is one of units: set table.dialect.skip_after = 1",
        missing=["m", "deg"],
    ),
    "units_row_without_first.csv skipped": record(
        "semicolons between cells, decimal comma, 1 line of units", dialect={"skip_after": 1}, missing=["m", "deg"]
    ),
    "off_in_first_row.csv": refused("row 2, column 'b': 'off' is not a number; where it means missing: set"),
    "units_and_types_rows.csv": record("semicolons between cells, decimal comma, 2 lines of units"),
    "text_after_header.csv": refused("row 2 has 1 cell, the header has 3"),
    "no_header.csv": ({"time": "c1", "y": ["c2", "c3"]}, RECORD, "no header: columns c1, c2, ..."),
    "no_header.csv names": refused("there is no column 't'; the columns are: c1, c2, c3"),
    "blank_lines.csv": record(),
    "quotes.csv": ({"y": ["a, raw", "b"]}, RECORD),
    "apostrophe_quotes.csv": record(dialect={"quote": "'"}),
    "apostrophe_quotes.csv unasked": refused("row 2 has 5 cells, the header has 4"),
    "trailing_commas.csv": record(),
    "trailing_commas_in_rows.csv": record(),
    "short_row.csv": refused("row 5 has 2 cells, the header has 3"),
    "long_row.csv": refused("row 3 has 4 cells, the header has 3"),
    "cut_off.csv": refused("row 4 has 2 cells, the header has 3"),
    "header_only.csv": refused("the file has a header but no rows"),
    "empty.csv": refused("the file is empty"),
    "column_twice.csv": refused("the column 'a' is there 2 times"),
    "column_absent.csv": refused("there is no column 't'; the columns are: time, a, b"),
    "missing_words.csv": ({}, (range(6), [*RECORD[1], [NAN, NAN], [NAN, NAN], [NAN, NAN]])),
    "missing_dashes.csv": refused(f"row 3, column 'b': '---' is not a number; {MISSING.format('---')}"),
    "missing_dashes.csv accepted": record(missing=["---"]),
    "missing_number.csv": record(missing=[-9999]),
    "a_word.csv": refused(f"row 3, column 'a': 'off' is not a number; {MISSING.format('off')}"),
    "infinite.csv": refused("row 3, column 'a': -inf is not finite; leave a missing value empty, or"),
    "mixed_decimals.csv": refused('\'1,5\' is not a number; where commas are decimal: set table.dialect.decimal = ","'),
    "latin.csv": ({"y": ["a", "Drehwinkel [°]"]}, RECORD, "cp1252"),
    "latin.csv as UTF-8": refused("not utf-8 text; set table.dialect.encoding", dialect={"encoding": "utf-8"}),
    "utf16.csv": record("utf-16"),
    "utf16_without_mark.csv": record("utf-16-le"),
    "byte_order_mark.csv": record(),
    "windows_lines.csv": record(),
    "old_mac_lines.csv": record(),
    "zero_bytes.csv": refused("not a table of text: it has zero bytes"),
    "packed.csv.gz": record("gz"),
    "packed_but_named.csv": record("gz"),
    "packed_cut_off.csv.gz": refused("the compressed file is damaged or ends too early"),
    "packed.csv.bz2": record("bz2"),
    "packed.csv.xz": record("xz"),
    "packed.csv.zst": record("zst"),
    "packed.zip": record("zip"),
    "two_in_one.zip": refused("the archive must hold one file, it holds 2 (log.csv, more.csv); unpack it"),
    "range_index.parquet": record(time=None),
    "named_range_index.parquet": record(),
    "named_index.parquet": record(),
    "date_index.parquet": ({"time": "index"}, ([MAY, MAY + 1, MAY + 2], RECORD[1])),
    "numbers_as_text.parquet": record(),
    "nanoseconds.parquet": (
        {"time": {"column": "t", "unit": "ns", "tolerance": 2e-8}},
        ([1e9, 1e9 + 1, 1e9 + 2], RECORD[1]),
    ),
    "nanoseconds.parquet exactly": refused(
        "row 2, column 't': the time 1000000001000000030 is not on the grid",
        time={"column": "t", "unit": "ns", "tolerance": 1e-8},
    ),
    "milliseconds.csv": clock(0, 1, 2, time=MS),
    "milliseconds.csv coarse": clock(0, 0.5, 1, 1.5, 2, time=MS, sample_time=0.5, rows=[0, None, 1, None, 2]),
    "milliseconds.csv unit": clock_refused('differ by 1000 s a row, .* milliseconds\\? Set time.unit = "ms"'),
    "milliseconds.csv meant": clock(*range(2001), rows=[0, *[None] * 999, 1, *[None] * 999, 2], sparse=True),
    "milliseconds.csv micro": clock_refused('milliseconds\\? Set time.unit = "ms"', time={"column": "t", "unit": "us"}),
    "two_rows_in_milliseconds.csv": clock_refused("would leave 99.9% of the steps without a row: milliseconds?"),
    "epoch_milliseconds.csv": clock(
        MAY, MAY + 0.5, MAY + 1, MAY + 1.5, time={"column": "t", "unit": "epoch"}, sample_time=0.5, rows=[0, 1, None, 2]
    ),
    "epoch_falls.csv": clock_refused(
        "row 4, column 't': the time 1395837505139 comes after 1395837505140", time=MS, sample_time=0.02
    ),
    "epoch_of_nothing.csv": clock_refused("1714557 is no time since 1970", time={"column": "t", "unit": "epoch"}),
    "thirty_hertz_us.csv": clock(
        1395837505.0, 1395837505.033333, 1395837505.066667, 1395837505.1, 1395837505.133333, 1395837505.166667,
        time={"column": "t", "unit": "us"}, sample_time=1 / 30, rows=[0, 1, 2, None, None, 3],
    ),
    "iso_utc.csv": clock(*range(MAY, MAY + 4), rows=[0, 1, None, 2]),
    "iso_utc.csv said": clock(*range(MAY, MAY + 4), time={"column": "t", "unit": "iso8601"}, rows=[0, 1, None, 2]),
    "iso_offset.csv": clock(*range(MAY, MAY + 4), rows=[0, 1, None, 2]),
    "iso_local.csv": clock(*range(MAY + 7200, MAY + 7204), rows=[0, 1, None, 2]),
    "iso_local.csv in Berlin": clock(*range(MAY, MAY + 4), time=BERLIN, rows=[0, 1, None, 2]),
    "iso_mixed.csv": clock_refused("row 3, column 't': the date '2024-05-01T10:00:01' has no zone, the rows"),
    "iso_wrong.csv": clock_refused("row 3, column 't': '2024-05-32T10:00:01' is not a date of ISO 8601; give"),
    "iso_slow.csv": clock_refused("1,998 of the 2,001 steps of sample_time = 1 s .* Set sample_time = 1000, or sparse"),
    "clocks_go_forward.csv": clock(1711846799, 1711846800, 1711846801, time=BERLIN),
    "clocks_go_back.csv": clock_refused("row 3, .* is there twice or not at all in Europe/Berlin", time=BERLIN),
    "german_date.csv": clock(*range(MAY, MAY + 4), time=FORMAT, rows=[0, 1, None, 2]),
    "german_date.csv without": clock_refused("'01.05.2024 12:00:00' is not a number; a date .* needs time.format"),
    "german_date.csv wrong": clock_refused(
        "row 2, .* is not a date of the form \"%Y\"", time={"column": "t", "format": "%Y"}
    ),
    "date_and_time.csv": clock_refused(
        "row 4, column 'Date', 'Time': the time is missing", time={"column": ["Date", "Time"]}
    ),
    "date_and_time.csv drop": clock(
        *range(MAY, MAY + 4), time={"column": ["Date", "Time"]}, rows=[0, 1, None, 3], on_blank_time="drop"
    ),
    "german_date_and_time.csv": clock(
        MAY - 36000.5, MAY - 35999.5, time={"column": ["Datum", "Zeit"], "format": "%d.%m.%Y %H:%M:%S,%f"}
    ),
    "stray_quote.csv": record(),
    "iso_utc.csv as numbers": clock_refused("'2024-05-01T10:00:00Z' is not a number", time=MS),
    "time_of_day.csv": clock(-2208902402, -2208902401, time={"column": "t", "format": "%H:%M:%S"}),
    "blank_time.csv": clock_refused('row 3, .* the time is missing; .*, or set on_blank_time = "drop"'),
    "blank_time.csv drop": clock(0, 1, 2, rows=[0, 2, 3], on_blank_time="drop"),
    "blank_date.csv": clock_refused("row 3, column 't': the time is missing"),
    "blank_date.csv drop": clock(MAY, MAY + 1, rows=[0, 2], on_blank_time="drop"),
    "unsorted.csv": clock_refused('row 4, column \'t\': the time 1 comes after 2; .* or set on_unsorted = "sort"'),
    "unsorted.csv sort": clock(0, 1, 2, 3, rows=[0, 2, 1, 3], on_unsorted="sort"),
    "twice.csv": clock_refused('row 4, column \'t\': the time 1 is there twice; set on_duplicate = "first", "last"'),
    "twice.csv first": clock(0, 1, 2, rows=[0, 1, 3], on_duplicate="first"),
    "twice.csv last": clock(0, 1, 2, rows=[0, 2, 3], on_duplicate="last"),
    "twice.csv mean": clock(0, 1, 2, rows=[0, 1.5, 3], on_duplicate="mean"),
    "nearly_twice.csv": clock_refused("row 4, column 't': the times 0.99 and 1.02 fall on the same step"),
    "nearly_twice.csv mean": clock(0, 0.99, 2, rows=[0, 1.5, 3], on_duplicate="mean"),
    "jitter.csv": clock(0, 1.08, 1.95, 3.1, 4.05, 5, rows=[0, 1, 2, 3, None, 4]),
    "jitter.csv strict": clock_refused(
        "the time 1.08 is not on the grid .*: it comes 1.08 s .* after 0, and each may be off by 0.01 s",
        time={"column": "t", "tolerance": 0.01},
    ),
    "off_the_grid.csv": clock_refused("row 4, column 't': the time 2.5 is not on the grid .* need dt = \"as_input\""),
    "uneven.csv auto": clock_refused("only 67% of the rows lie on such a grid", sample_time="auto"),
    "slow_clock.csv": clock_refused('rows are 0.103 s apart .*; set sample_time = 0.103, or "auto"', sample_time=0.1),
    "slow_clock.csv auto": clock(*(0.103 * k for k in range(40)), sample_time="auto"),
    "rare_rows.csv": clock_refused("17 of the 21 steps of sample_time = 1 s .* Set sample_time = 5, or sparse = true"),
    "rare_rows.csv auto": clock(0, 5, 10, 15, 20, rows=[0, 1, 2, None, 3], sample_time="auto"),
    "rare_rows.csv meant": clock(
        *range(21), rows=[{0: 0, 5: 1, 10: 2, 20: 3}.get(point) for point in range(21)], sparse=True
    ),
    "one_long_gap.csv": clock(*range(52), rows=[0, 1, 2, *[None] * 47, 3, 4]),
    "no_clock.csv": ({"time": None, "y": ["a"], "sample_time": 0.5}, ([0, 0.5, 1, 1.5], [[1], [2], [NAN], [4]])),
    "no_clock_comments.csv": ({"time": None, "y": ["a"]}, ([0, 1, 2, 3], [[1], [2], [NAN], [4]])),
    "no_clock_quotes.csv": ({"time": None, "y": ["a"]}, ([0, 1, 2, 3], [[1], [2], [NAN], [4]])),
    "trailing_comma_in_header.csv": record(),
    "trailing_blanks.csv": record(),
    "control_z.csv": record(),
    "raw_counts.csv": (
        {
            "y": ["p", "angle", "speed", "temp"],
            "columns": {
                "p": {"scale": 0.5, "offset": 1.0, "unit": "mbar"},
                "angle": {"unit": "deg"},
                "speed": {"unit": "km/h", "to": "m/s"},
                "temp": {"unit": "degC", "to": "degF"},
            },
        },
        ([0, 1], [[5100, np.pi, 10, 68], [10100, -np.pi / 2, 20, -40]]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_log_gives_its_reading_or_its_error(case):
    options, expected, *found = CASES[case]
    part = TablePart(**{"file": "log", "time": "t", "sample_time": 1.0, "y": ["a", "b"]} | options)
    path = FOLDER / case.partition(" ")[0]
    if isinstance(expected, str):
        with pytest.raises(UserError) as caught:
            read_table(path, part)
        message = str(caught.value)
        assert "\n" not in message
        assert message.startswith(path.name)
        assert expected in message or re.search(expected, message), message
        return
    table = read_table(path, part)
    np.testing.assert_allclose(table.time, expected[0], rtol=0, atol=1e-6)
    # Cells are read exactly; only units are computed.
    np.testing.assert_allclose(
        table.y, expected[1], rtol=1e-15 if part.columns else 0, atol=1e-13 if part.columns else 0
    )
    if found:
        assert dict(table.notes).get("table") == found[0]


def test_every_file_has_a_case():
    assert {case.partition(" ")[0] for case in CASES} == {path.name for path in FOLDER.iterdir()}

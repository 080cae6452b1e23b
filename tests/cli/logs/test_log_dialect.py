"""Any table written in any dialect reads back exactly, found by looking, in blocks of any size."""

from __future__ import annotations

import bz2
import gzip
import lzma
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gsisio_jax.cli.errors import UserError
from gsisio_jax.cli.logs.config import DialectPart
from gsisio_jax.cli.logs.dialect import sniff, sniff_file
from gsisio_jax.cli.logs.numerals import is_number
from gsisio_jax.cli.logs.parser import text_blocks
from gsisio_jax.cli.logs.text import blocks_of_lines, end_of_lines, find_encoding

COMPRESS = {"none": bytes, "gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress}
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
WORDS = st.sampled_from(["", "ok", "x,y;z", 'say "no"', "# 5", "two\nlines", "°C"])


@st.composite
def logs(draw):
    """Values (R, 2) with NaN, notes, and how they are written."""
    rows = draw(st.integers(1, 25))
    cell = st.one_of(NUMBERS, st.just(np.nan))
    values = np.array(draw(st.lists(st.tuples(cell, cell), min_size=rows, max_size=rows)))
    # A number at least, and one with a decimal mark that can be told from a thousand.
    values[0] = draw(st.sampled_from([(0.5, 1.25), (-1e-7, 12.5)]))
    notes = draw(st.lists(WORDS, min_size=rows, max_size=rows))
    separator = draw(st.sampled_from([",", ";", "\t", "|"]))
    return {
        "values": values,
        "notes": notes,
        "separator": separator,
        "decimal": draw(st.sampled_from(".,")),
        "missing": draw(st.sampled_from(["", "NaN", "nan", "NULL", " N/A"])),
        "quoted": draw(st.booleans()) or separator == ",",
        "preamble": draw(st.lists(st.sampled_from(["Logger 7", "", "a,b", "Start;now", "12"]), max_size=4)),
        "end": draw(st.sampled_from(["\n", "\r\n"])),
        "encoding": draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"])),
        "compression": draw(st.sampled_from(list(COMPRESS))),
        "blank": draw(st.booleans()),
    }


def written(log):
    """The bytes of a file."""

    def number(value):
        if np.isnan(value):
            return log["missing"]
        text = repr(float(value)).replace(".", log["decimal"])
        return f'"{text}"' if log["quoted"] else text

    def note(word):
        return '"' + word.replace('"', '""') + '"'

    header = log["separator"].join(["pos [m]", '"note"', "vel"])
    rows = [
        log["separator"].join([number(first), note(word), number(second)])
        for (first, second), word in zip(log["values"], log["notes"], strict=True)
    ]
    gap = "\n\n" if log["blank"] else "\n"
    text = "".join(line + "\n" for line in [*log["preamble"], header]) + "".join(row + gap for row in rows)
    return COMPRESS[log["compression"]](text.replace("\n", log["end"]).encode(log["encoding"]))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(logs(), st.sampled_from([1, 7, 64, 1 << 20]))
def test_a_log_reads_back_exactly(tmp_path, log, size):
    path = tmp_path / "log"
    path.write_bytes(written(log))
    wanted = ["pos [m]", "vel"]
    dialect = sniff_file(path, DialectPart(), wanted)
    assert (dialect.separator, dialect.decimal) == (log["separator"], log["decimal"])
    assert dialect.compression == log["compression"]
    blocks = list(text_blocks(path, dialect, wanted, (), size=size))
    found = np.concatenate([np.stack([block.columns[name] for name in wanted], axis=1) for block in blocks])
    np.testing.assert_array_equal(found, log["values"])
    # Every row is named by its (last) line.
    lines = written(replace_compression(log)).decode(log["encoding"]).replace("\r\n", "\n").split("\n")
    rows = np.concatenate([block.rows for block in blocks])
    assert (np.diff(rows) > 0).all()
    for row, word in zip(rows, log["notes"], strict=True):
        tail = word.replace('"', '""').rpartition("\n")[2]
        assert tail + '"' in lines[row - 1]


def replace_compression(log):
    return log | {"compression": "none"}


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.lists(st.one_of(st.integers(0, 9), st.none()), max_size=12), st.integers(0, 3), st.integers(1, 9))
def test_empty_lines_of_one_column_are_cells_but_not_at_the_end(tmp_path, cells, spare, size):
    path = tmp_path / "log.csv"
    cells = [*cells, 7]
    path.write_text("a\n" + "".join(f"{'' if cell is None else cell}\n" for cell in cells) + "\n" * spare)
    blocks = list(text_blocks(path, sniff_file(path, DialectPart(), ["a"]), ["a"], (), size=size))
    found = np.concatenate([block.columns["a"] for block in blocks])
    np.testing.assert_array_equal(found, [np.nan if cell is None else cell for cell in cells])
    np.testing.assert_array_equal(np.concatenate([block.rows for block in blocks]), 2 + np.arange(len(cells)))


@settings(deadline=None)
@given(st.text(alphabet='1,"\n', max_size=60))
def test_blocks_cut_no_cell(text):
    cut = end_of_lines(text, '"')
    assert cut == 0 or text[cut - 1] == "\n"
    assert text[:cut].count('"') % 2 == 0
    assert cut == max((k + 1 for k, c in enumerate(text) if c == "\n" and text[: k + 1].count('"') % 2 == 0), default=0)


def test_a_quote_that_is_never_closed_costs_neither_time_nor_memory():
    lines = ['0,5" pipe'] + [f"{k},1" for k in range(5000)]
    text = "\n".join(lines) + "\n"
    assert end_of_lines(text, '"') == len(text)
    import io

    blocks = list(blocks_of_lines(io.BytesIO(text.encode()), "utf-8", '"', "log.csv", size=1000))
    assert "".join(part for _, part in blocks) == text
    assert max(len(part) for _, part in blocks) < 20_000
    assert [line for line, _ in blocks] == [1 + text[: text.index(part)].count("\n") for _, part in blocks]


def test_each_key_overrides_what_is_found():
    head = b"t;a\n0;1,500\n1;2,500\n"
    with pytest.raises(UserError, match=r"may mean 1\.500 or 1500"):
        sniff(head, "log.csv", DialectPart(), ["a"])
    plain = sniff(head, "log.csv", DialectPart(decimal=","), ["a"])
    for part, changes in (
        (DialectPart(decimal=",", separator="|"), {"separator": "|", "columns": ("t;a",)}),
        (DialectPart(thousands=","), {"decimal": ".", "thousands": ","}),
        (DialectPart(decimal=",", comment="//"), {"comment": "//"}),
        (DialectPart(decimal=",", quote="'"), {"quote": "'"}),
        (DialectPart(decimal=",", skip=1), {"columns": ("c1", "c2"), "first_line": 2, "sample": plain.sample}),
        (DialectPart(decimal=",", skip_after=1), {"first_line": 3, "sample": plain.sample[1:]}),
        (DialectPart(decimal=",", encoding="latin-1"), {"encoding": "latin-1"}),
    ):
        found = sniff(head, "log.csv", part, ["a"])
        expected = replace(plain, **changes)
        ours = {name for name in ("separator", "decimal", "thousands", "comment", "quote", "columns", "encoding")}
        assert {n: getattr(found, n) for n in ours} == {n: getattr(expected, n) for n in ours}
        if "first_line" in changes:
            assert found.first_line == changes["first_line"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_encodings_are_told_apart(encoding):
    text = "t,Winkel [°]\n" + "0,1\n" * 40
    assert text.encode(encoding).decode(find_encoding(text.encode(encoding))).lstrip("\ufeff") == text


@settings(deadline=None)
@given(NUMBERS)
def test_any_number_of_python_is_a_number(value):
    assert is_number(repr(value))
    assert is_number(repr(value).replace(".", ","))

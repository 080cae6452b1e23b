"""The table: what is read, and one line with row and column for what cannot be."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pandas as pd
import pytest

from gsisio_jax.cli.errors import UserError
from gsisio_jax.cli.logs import TablePart, TableReader, read_table
from gsisio_jax.cli.logs.cells import Block
from gsisio_jax.cli.logs.read import filled
from gsisio_jax.cli.logs.stream import on_grid

GOOD = ["t,a,b,word", "0,1,2,x", "1,1.5,,y", "3,-9999, 4e0 ,z"]


def read(tmp_path, lines=None, name="log.csv", **changes):
    path = tmp_path / name
    if lines is not None:
        path.write_text("\n".join(lines) + "\n")
    transform = changes.pop("transform", None)
    options = {"time": "t", "sample_time": 1.0, "y": ["b", "a"], "missing": [-9999.0, "n/a"]} | changes
    return read_table(path, TablePart(file=name, **options), transform)


def test_rows_are_put_on_the_grid(tmp_path):
    table = read(tmp_path, GOOD)
    np.testing.assert_array_equal(table.time, [0, 1, 2, 3])
    np.testing.assert_array_equal(table.y, [[2, 1], [np.nan, 1.5], [np.nan, np.nan], [4, np.nan]])
    assert table.u is None


def test_decimals_are_read_exactly(tmp_path):
    text = "0.1000000000000000055511151231257827"
    table = read(tmp_path, ["t,a,b", f"0.1,{text},1.7976931348623157e308"])
    assert table.y.tolist() == [[1.7976931348623157e308, 0.1]]
    assert table.time.tolist() == [0.1]


@pytest.mark.parametrize("word", ["", "  ", "nan", "NaN", "n/a", "-9999", "-9999.0", "-9.999e3", '""'])
def test_missing_cells(tmp_path, word):
    assert math.isnan(read(tmp_path, ["t,a,b", f"0,{word},1"]).y[0, 1])


@pytest.mark.parametrize("word", ["abc", "1_000", "1,5;", "0x10", "1 2", "12:30", "True", "-"])
def test_other_cells_name_row_and_column(tmp_path, word):
    with pytest.raises(UserError, match=r"^log\.csv: row 4, column 'a': '.*' is not a number; "):
        read(tmp_path, ["t,a,b", "0,1,1", "", f'1,"{word}",1'])


@pytest.mark.parametrize("word", ["inf", "-Infinity", "1e999"])
def test_infinite_cells(tmp_path, word):
    with pytest.raises(UserError, match=r"row 2, column 'b': -?inf is not finite"):
        read(tmp_path, ["t,a,b", f"0,1,{word}"])


BROKEN = {
    "missing column": (["t,a", "0,1"], r"log\.csv: there is no column 'b'; the columns are: t, a"),
    "repeated column": (["t,a,b,a", "0,1,2,3"], r"column 'a' is there 2 times"),
    "only a header": (["t,a,b"], r"log\.csv: the file has a header but no rows"),
    "short row": (["t,a,b", "0,1,2", "1,2"], r"log\.csv: row 3 has 2 cells, the header has 3"),
    "long row": (["t,a,b", "0,1,2,3"], r"row 2 has 4 cells"),
    "no time": (["t,a,b", "0,1,2", ",1,2"], r"row 3, column 't': the time is missing"),
    "unsorted": (["t,a,b", "0,1,2", "2,1,2", "1,1,2"], r"row 4, column 't': the time 1 comes after 2"),
    "duplicate": (["t,a,b", "0,1,2", "1,1,2", "1,1,2"], r"row 4, column 't': the time 1 is there twice"),
    "nearly duplicate": (["t,a,b", "0,1,2", "0.01,1,2"], r"row 3.*: the times 0 and 0.01 fall on the same step"),
    "off the grid": (["t,a,b", "0,1,2", "1.4,1,2"], r"row 3, column 't': the time 1.4 is not on the grid of sample"),
    "too long": (
        ["t,a,b", "0,1,2", "1e15,1,2"],
        r"row 3, .*000 comes more than 50,000,000 steps .* after 0",
    ),
}


@pytest.mark.parametrize(("lines", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_table_is_one_line(tmp_path, lines, message):
    with pytest.raises(UserError, match=message):
        read(tmp_path, lines)


def test_files_that_are_no_tables(tmp_path):
    with pytest.raises(UserError, match="cannot read the table: No such file"):
        read(tmp_path, name="none.csv")
    with pytest.raises(UserError, match="cannot read the table: No such file"):
        read(tmp_path, name="none.parquet")
    for name, content, message in (
        ("a.csv", b"", "a.csv: the file is empty"),
        ("a.parquet", b"", "a.parquet: the file is empty"),
        ("b.csv", b"t,a\0\0\0\n", "b.csv: not a table of text: it has zero bytes"),
        ("b.parquet", b"PAR1 or not", "b.parquet: not a Parquet file"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=message):
            read(tmp_path, name=name)


def test_clock_times_of_an_epoch_are_on_the_grid(tmp_path):
    lines = ["t,a,b", *(f"{1.7e9 + 0.01 * k:.2f},{k},1" for k in range(500) if k != 7)]
    table = read(tmp_path, lines, sample_time=0.01)
    assert len(table.time) == 500
    assert np.flatnonzero(np.isnan(table.y[:, 0])).tolist() == [7]
    assert table.y[499, 1] == 499


def test_parquet_gives_the_same_as_csv(tmp_path):
    frame = pd.DataFrame({"t": [0, 1, 3], "a": [1.0, 1.5, -9999.0], "b": pd.array([2, None, 4], dtype="Int64")})
    frame.to_parquet(tmp_path / "log.parquet")
    np.testing.assert_array_equal(read(tmp_path, name="log.parquet").y, read(tmp_path, GOOD).y)


def test_parquet_errors_count_rows_from_one(tmp_path):
    pd.DataFrame({"t": [0, 1], "a": ["1", "x"], "b": [1, 2]}).to_parquet(tmp_path / "log.parquet")
    with pytest.raises(UserError, match=r"log\.parquet: row 2, column 'a': 'x' is not a number"):
        read(tmp_path, name="log.parquet")
    pd.DataFrame({"t": [0], "a": pd.to_datetime(["2024-01-01"]), "b": [1]}).to_parquet(tmp_path / "log.parquet")
    with pytest.raises(UserError, match=r"row 1, column 'a': '2024-01-01 00:00:00' is not a number"):
        read(tmp_path, name="log.parquet")


def test_known_inputs(tmp_path):
    table = read(tmp_path, ["t,a,b", "0,1,2", "1,,3"], y=["a"], u=["b"])
    assert table.u is not None
    assert table.u.tolist() == [[2.0], [3.0]]
    with pytest.raises(UserError, match=r"row 3, column 'b': a known input is missing; .*table\.transform"):
        read(tmp_path, ["t,a,b", "0,1,2", "1,1,"], y=["a"], u=["b"])
    with pytest.raises(UserError, match=r"row 3: 2 rows of the grid are absent before it, .*\(b\).*column of G"):
        read(tmp_path, ["t,a,b", "0,1,2", "3,1,3"], y=["a"], u=["b"])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("how", ["last", "error"])
def test_known_inputs_are_held_over_gaps(seed, how):
    """As pandas fills forward on the whole grid; in blocks of any size, also where rows are held back."""
    rng = np.random.default_rng(seed)
    index = np.cumsum(rng.choice([1, 1, 2, 5], 40)) - 1
    index -= index[0]
    values = rng.normal(size=(40, 2))
    values[rng.random((40, 2)) < 0.3] = np.nan
    values[0] = 1.0
    columns = {"t": index.astype(float), "a": np.arange(40.0), "b": values[:, 0], "c": values[:, 1]}
    cuts = [0, *np.sort(rng.integers(0, 40, 4)), 40]
    part = TablePart(
        file="log", time="t", sample_time=1.0, y=["a"], u=["b", "c"], on_gap_u="hold", on_duplicate=how, sparse=True
    )
    whole = Block("log", columns, np.arange(40) + 2)
    blocks = [whole.cut(begin, end) for begin, end in itertools.pairwise(cuts)]
    wanted = pd.DataFrame(values, index).reindex(np.arange(index[-1] + 1)).ffill()
    reader = TableReader("log", part)
    rows = [*map(reader.feed, blocks), reader.finish()]
    np.testing.assert_array_equal(filled(rows).u, wanted)
    pieces = list(on_grid(rows))
    assert all(len(piece.u) == len(piece.time) for piece in pieces if piece.u is not None)
    np.testing.assert_array_equal(np.concatenate([piece.u for piece in pieces if piece.u is not None]), wanted)
    lost = np.isnan(pd.DataFrame(values, index).reindex(wanted.index)).any(axis=1).sum()
    assert f"known inputs held at {lost} steps without a value" in dict(reader.notes(None))["clock"]


def test_inputs_that_cannot_be_held(tmp_path):
    with pytest.raises(UserError, match=r"row 2, column 'b': a known input is missing, and there is none before it"):
        read(tmp_path, ["t,a,b", "0,1,", "1,1,2"], y=["a"], u=["b"], on_gap_u="hold")
    with pytest.raises(ValueError, match="is for known inputs, and u is empty"):
        TablePart(file="log", sample_time=1.0, y=["a"], on_gap_u="hold")


def test_transform_sees_numbers_and_its_result_is_used(tmp_path):
    seen = {}

    def halves(frame):
        seen.update(frame.dtypes.astype(str))
        assert np.isnan(frame["a"].iloc[2])
        return frame.assign(a=frame["a"] / 2, b=frame["word"].map({"x": 1, "y": 2}))

    table = read(tmp_path, GOOD, transform=halves)
    assert seen["a"] == seen["b"] == "float64"
    np.testing.assert_array_equal(table.y, [[1, 0.5], [2, 0.75], [np.nan, np.nan], [np.nan, np.nan]])


def test_transform_mistakes_are_one_line(tmp_path):
    def fails(frame):
        return frame["speed"]

    for transform, message in (
        (fails, "fails raised KeyError: 'speed'"),
        (lambda frame: 3, "must return a DataFrame, got int"),
        (lambda frame: frame.iloc[:0], "returned no rows"),
        (lambda frame: frame.drop(columns="a"), "no column 'a'"),
        (lambda frame: frame.assign(a="?"), r"log.csv after <lambda>: row 1, column 'a': '\?' is not a number"),
    ):
        with pytest.raises(UserError, match=message):
            read(tmp_path, GOOD, transform=transform)


@pytest.mark.parametrize(
    ("row", "text", "parts"),
    [
        (4, "0.2,abc,0,fine", ["cart.csv: row 4, column 'pos': 'abc' is not a number"]),
        (4, "0.1,1,0,fine", ["cart.csv: row 4, column 't': the time 0.1 is there twice"]),
        (4, "0.05,1,0,fine", ["cart.csv: row 4, column 't': the time 0.05 comes after 0.1"]),
        (1, "t,position,vel,note", ["cart.csv: there is no column 'pos'; the columns are: t, position, vel, note"]),
    ],
)
def test_through_the_command_line(project, row, text, parts):
    path = project.folder / "cart.csv"
    lines = path.read_text().splitlines()
    lines[row - 1] = text
    project.write_table(lines)
    project.refused(*parts)


def test_an_empty_file_through_the_command_line(project):
    (project.folder / "cart.csv").write_text("")
    project.refused("gsisio: cart.csv: the file is empty")
    (project.folder / "cart.csv").unlink()
    project.refused("cart.csv: cannot read the table: No such file or directory")

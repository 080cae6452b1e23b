"""Writes the small logs in ``files``, one peculiarity each: ``python tests/cli/logs/make_files.py``.

Most hold the same record: t = 0, 1, 2 s, a = 1.5, 2.25, 1000.5 and b = -2, nothing, 4.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zipfile
from pathlib import Path

FOLDER = Path(__file__).parent / "files"
PLAIN = "t,a,b\n0,1.5,-2\n1,2.25,\n2,1000.5,4\n"
SEMICOLON = "t;a;b\n0;1,5;-2\n1;2,25;\n2;1000,5;4\n"


def clock(*stamps: str, head: str = "t") -> str:
    """A log with these stamps and a = 0, 1, 2, ..."""
    return f"{head},a\n" + "".join(f"{stamp},{row}\n" for row, stamp in enumerate(stamps))


TEXTS = {
    # Separators and numbers.
    "plain.csv": PLAIN,
    "semicolons.csv": SEMICOLON,
    "tabs.tsv": PLAIN.replace(",", "\t"),
    "bars.txt": PLAIN.replace(",", " | "),
    "spaces.txt": "   t        a    b\n   0      1.5   -2\n   1     2.25  nan\n   2   1000.5    4\n",
    "spaces_and_tabs.txt": "t\t a b\n0\t 1.5 -2\n1\t 2.25 nan\n2\t 1000.5 4\n",
    "decimal_comma_in_quotes.csv": 't,a,b\n0,"1,5",-2\n1,"2,25",\n2,"1000,5",4\n',
    "decimal_comma_one_column.csv": "a\n1,5\n2,25\n1000,5\n",
    "thousands_points.csv": SEMICOLON.replace("1000,5", "1.000,5"),
    "thousands_commas.csv": PLAIN.replace("1000.5", '"1,000.5"'),
    "thousands_spaces.csv": SEMICOLON.replace("1000,5", "1\u202f000,5"),
    "thousands_apostrophes.csv": PLAIN.replace("1000.5", "1'000.5"),
    "thousands_wrong.csv": SEMICOLON.replace("1000,5", "1.000,5").replace("2,25", "2.25"),
    "comma_ambiguous.csv": "t;a;b\n0;1,500;-2\n1;2,250;\n",
    "signs_and_exponents.csv": "t,a,b\n0,+1.5e0,-.2E1\n1, 225e-2 ,\n2,1.0005e+3,4.\n",
    # What stands around the cells.
    "comments.csv": "# made by hand\n" + PLAIN.replace("-2\n", "-2 # first row\n# break\n"),
    "header_in_comment.csv": "# t,a,b\n" + PLAIN.partition("\n")[2],
    "percent_comments.txt": "% t in s\n" + PLAIN.replace(",", "\t"),
    "preamble.csv": "Logger 7, firmware 2.1\nSerial number,12345\n\nStart,2024-05-01\n" + PLAIN,
    "units_row.csv": PLAIN.replace("t,a,b\n", "t,a,b\n[s],[m],[deg]\n"),
    "units_row_without_first.csv": "t;a;b\n;m;deg\n" + SEMICOLON.partition("\n")[2],
    "off_in_first_row.csv": "t;a;b\n;;off\n0;1,5;-2\n1;2,25;off\n",
    "units_and_types_rows.csv": SEMICOLON.replace("t;a;b\n", "t;a;b\ns;m;deg\nfloat;float;float\n"),
    "text_after_header.csv": PLAIN.replace("t,a,b\n", "t,a,b\nfirst run\n"),
    "no_header.csv": PLAIN.partition("\n")[2],
    "blank_lines.csv": PLAIN.replace("\n", "\n\n  \n"),
    "quotes.csv": 't,"a, raw","b",note\n0,"1.5",-2,"say ""x, y"""\n1,2.25,,"two\nlines"\n"2",1000.5,4,\n',
    "apostrophe_quotes.csv": "t,a,b,note\n0,1.5,-2,'x, y'\n1,2.25,,'z'\n2,1000.5,4,''\n",
    "trailing_commas.csv": PLAIN.replace("\n", ",\n"),
    "trailing_commas_in_rows.csv": PLAIN.replace("-2\n", "-2,\n").replace(",\n2", ",,\n2").replace("4\n", "4,\n"),
    "short_row.csv": PLAIN + "3,7\n",
    "long_row.csv": PLAIN.replace("2.25,", "2.25,,7"),
    "cut_off.csv": PLAIN.removesuffix(",4\n"),
    "header_only.csv": "t,a,b\n",
    "empty.csv": "",
    "column_twice.csv": "t,a,a,b\n0,1,1,2\n",
    "column_absent.csv": "time,a,b\n0,1,2\n",
    # Cells that are no numbers.
    "missing_words.csv": "t,a,b\n0,1.5,-2\n1,2.25,N/A\n2,1000.5,4\n3,NULL,nan\n4,#N/A,None\n5,,NaN\n",
    "missing_dashes.csv": PLAIN.replace("2.25,", "2.25,---"),
    "missing_number.csv": PLAIN.replace("2.25,", "2.25,-9999.0"),
    "a_word.csv": PLAIN.replace("2.25", "off"),
    "infinite.csv": PLAIN.replace("2.25", "-inf"),
    "mixed_decimals.csv": SEMICOLON.replace("2,25", "2.25"),
    # Clocks.
    "milliseconds.csv": clock("0", "1000", "2000"),
    "two_rows_in_milliseconds.csv": clock("0", "1000"),
    "epoch_milliseconds.csv": clock("1714557600000", "1714557600500", "1714557601500"),
    "epoch_falls.csv": clock("1395837505120", "1395837505140", "1395837505139"),
    "epoch_of_nothing.csv": clock("1714557", "1714558"),
    "thirty_hertz_us.csv": clock("1395837505000000", "1395837505033333", "1395837505066667", "1395837505166667"),
    "iso_utc.csv": clock("2024-05-01T10:00:00Z", "2024-05-01T10:00:01.000Z", "2024-05-01T10:00:03Z"),
    "iso_offset.csv": clock("2024-05-01 12:00:00+02:00", "2024-05-01 12:00:01+02:00", "2024-05-01 11:00:03+01:00"),
    "iso_local.csv": clock("2024-05-01 12:00:00", "2024-05-01 12:00:01", "2024-05-01 12:00:03"),
    "iso_mixed.csv": clock("2024-05-01T10:00:00Z", "2024-05-01T10:00:01"),
    "iso_wrong.csv": clock("2024-05-01T10:00:00", "2024-05-32T10:00:01"),
    "iso_slow.csv": clock("2024-05-01T10:00:00", "2024-05-01T10:16:40", "2024-05-01T10:33:20"),
    "clocks_go_forward.csv": clock("2024-03-31 01:59:59", "2024-03-31 03:00:00", "2024-03-31 03:00:01"),
    "clocks_go_back.csv": clock("2024-10-27 01:59:59", "2024-10-27 02:00:00", "2024-10-27 02:00:01"),
    "german_date.csv": clock("01.05.2024 12:00:00", "01.05.2024 12:00:01", "01.05.2024 12:00:03"),
    "date_and_time.csv": "Date,Time,a\n2024-05-01,10:00:00,0\n2024-05-01,10:00:01,1\n,,2\n2024-05-01,10:00:03,3\n",
    "german_date_and_time.csv": "Datum;Zeit;a\n30.04.2024;23:59:59,5;0\n01.05.2024;00:00:00,5;1\n",
    "stray_quote.csv": "t,a,b,note\n0,1.5,-2,5\" pipe\n1,2.25,,3\" x 2\"\n2,1000.5,4,\n",
    "time_of_day.csv": clock("23:59:58", "23:59:59"),
    "blank_time.csv": clock("0", "", "1", "2"),
    "blank_date.csv": clock("2024-05-01T10:00:00Z", "", "2024-05-01T10:00:01Z"),
    "unsorted.csv": clock("0", "2", "1", "3"),
    "twice.csv": clock("0", "1", "1", "2"),
    "nearly_twice.csv": clock("0", "0.99", "1.02", "2"),
    "jitter.csv": clock("0", "1.08", "1.95", "3.1", "5"),
    "off_the_grid.csv": clock("0", "1", "2.5", "3"),
    "uneven.csv": clock("0", "0.5", "2", "2.25"),
    "slow_clock.csv": clock(*(f"{0.103 * row:.3f}" for row in range(40))),
    "rare_rows.csv": clock("0", "5", "10", "20"),
    "one_long_gap.csv": clock("0", "1", "2", "50", "51"),
    "no_clock.csv": "a\n1\n2\n\n4\n",
    "no_clock_comments.csv": "# by hand\na\n1\n# break\n2 # two\n\n  # and\n4\n\n\n",
    "no_clock_quotes.csv": '# by hand\n"a"\n"1"\n# break\n"2" # two\n\n"4"\n',
    "trailing_comma_in_header.csv": PLAIN.replace("b\n", "b,\n"),
    "trailing_blanks.csv": PLAIN.replace("\n", ", \n"),
    "control_z.csv": PLAIN + "\x1a",
    "raw_counts.csv": "t,p,angle,speed,temp\n0,100,180,36,20\n1,200,-90,72,-40\n",
}  # fmt: skip
BYTES = {
    "latin.csv": "t,a,Drehwinkel [°]\n0,1.5,-2\n1,2.25,\n2,1000.5,4\n".encode("cp1252"),
    "utf16.csv": PLAIN.encode("utf-16"),
    "utf16_without_mark.csv": PLAIN.encode("utf-16-le"),
    "byte_order_mark.csv": PLAIN.encode("utf-8-sig"),
    "windows_lines.csv": PLAIN.replace("\n", "\r\n").encode(),
    "old_mac_lines.csv": PLAIN.replace("\n", "\r").encode(),
    "zero_bytes.csv": b"t,a,b\n0,1,2\n\0\0\0\0",
}


def archive(**members: str) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as target:
        for name, text in members.items():
            target.writestr(zipfile.ZipInfo(name.replace("_", ".")), text)
    return stream.getvalue()


def compressed() -> dict[str, bytes]:
    import pyarrow

    data = PLAIN.encode()
    packed = gzip.compress(data, mtime=0)
    return {
        "packed.csv.gz": packed,
        "packed_but_named.csv": packed,
        "packed_cut_off.csv.gz": packed[:-12],
        "packed.csv.bz2": bz2.compress(data),
        "packed.csv.xz": lzma.compress(data),
        "packed.csv.zst": pyarrow.compress(data, codec="zstd", asbytes=True),
        "packed.zip": archive(log_csv=PLAIN),
        "two_in_one.zip": archive(log_csv=PLAIN, more_csv=PLAIN),
    }


def write_parquet() -> None:
    import pandas

    frame = pandas.DataFrame({"a": [1.5, 2.25, 1000.5], "b": [-2.0, None, 4.0]})
    frame.to_parquet(FOLDER / "range_index.parquet")
    frame.set_axis(pandas.RangeIndex(3, name="t")).to_parquet(FOLDER / "named_range_index.parquet")
    frame.set_axis(pandas.Index([0.0, 1.0, 2.0], name="t")).to_parquet(FOLDER / "named_index.parquet")
    dates = pandas.date_range("2024-05-01 12:00", periods=3, freq="s", tz="Europe/Berlin")
    frame.set_axis(dates).to_parquet(FOLDER / "date_index.parquet")
    words = frame.assign(t=[0, 1, 2], b=["-2", None, "4"])
    words.to_parquet(FOLDER / "numbers_as_text.parquet", index=False)
    nanoseconds = [10**18, 10**18 + 10**9 + 30, 10**18 + 2 * 10**9]
    frame.assign(t=nanoseconds).to_parquet(FOLDER / "nanoseconds.parquet", index=False)


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, content in (BYTES | compressed() | {name: text.encode() for name, text in TEXTS.items()}).items():
        (FOLDER / name).write_bytes(content)
    write_parquet()


if __name__ == "__main__":
    main()

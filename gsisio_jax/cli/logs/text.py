"""Bytes of a file to blocks of whole lines of text: compression, encoding, line ends, quoted line breaks."""

from __future__ import annotations

import bz2
import codecs
import contextlib
import gzip
import io
import lzma
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from ..._extras import need
from ..errors import UserError, reason

HEAD = 1 << 18  # bytes that are looked at to find the dialect
BLOCK = 1 << 24  # characters that are parsed at a time
QUOTED_LINES = 1000  # of one cell, at most
_MAGIC = {
    b"\x1f\x8b": "gz",
    b"PK\x03\x04": "zip",
    b"PK\x05\x06": "zip",
    b"BZh": "bz2",
    b"\xfd7zXZ\x00": "xz",
    b"\x28\xb5\x2f\xfd": "zst",
}
_BOMS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))


def is_parquet(path: Path) -> bool:
    """By its first bytes, or by its name where it is not there or empty."""
    with contextlib.suppress(OSError), open(path, "rb") as stream:
        if start := stream.read(4):
            return start == b"PAR1" or path.suffix.lower() in (".parquet", ".pq")
    return path.suffix.lower() in (".parquet", ".pq")


def find_compression(start: bytes) -> str:
    """By the first bytes, not by the name: a renamed file is read all the same."""
    return next((name for magic, name in _MAGIC.items() if start.startswith(magic)), "none")


def compression_of(path: Path) -> str:
    """`find_compression` of a file."""
    with opened(path, "none") as stream:
        return find_compression(stream.read(8))


def find_encoding(head: bytes) -> str:
    """UTF-8 where the bytes are UTF-8, UTF-16 by its mark or by its zero bytes, else the code page of Windows.

    Raises:
        ValueError: zero bytes that no text has.
    """
    for mark, name in _BOMS:
        if head.startswith(mark):
            return name
    if b"\0" in head:
        odd, even = head[1::2].count(0), head[::2].count(0)
        if max(odd, even) > len(head) / 5 and min(odd, even) == 0:
            return "utf-16-le" if odd else "utf-16-be"
        raise ValueError("it has zero bytes")
    for name in ("utf-8", "cp1252"):
        with contextlib.suppress(UnicodeDecodeError):
            # A character that is cut in two at the end of the head is no error.
            codecs.getincrementaldecoder(name)().decode(head)
            return name
    return "latin-1"


@contextlib.contextmanager
def opened(path: Path, compression: str) -> Iterator[IO[bytes]]:
    """The decompressed bytes of a file.

    Args:
        path: the file.
        compression: as `compression_of` finds it.

    Raises:
        UserError: the file cannot be opened, or what is read inside the ``with`` block is damaged.
    """
    try:
        with contextlib.ExitStack() as stack:
            raw: Any = stack.enter_context(open(path, "rb"))
            yield _decompressed(raw, compression, path.name, stack)
    except (EOFError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, gzip.BadGzipFile) as error:
        raise UserError(f"{path.name}: the compressed file is damaged or ends too early: {reason(error)}") from error
    except OSError as error:
        raise UserError(f"{path}: cannot read the table: {reason(error)}") from error


def _decompressed(raw: Any, compression: str, name: str, stack: contextlib.ExitStack) -> Any:
    if compression == "gz":
        return stack.enter_context(gzip.GzipFile(fileobj=raw))
    if compression == "bz2":
        return stack.enter_context(bz2.BZ2File(raw))
    if compression == "xz":
        return stack.enter_context(lzma.LZMAFile(raw))
    if compression == "zst":
        pyarrow = need("pyarrow", extra="cli", purpose="reading .zst")
        return stack.enter_context(pyarrow.CompressedInputStream(pyarrow.PythonFile(raw), "zstd"))
    if compression == "zip":
        archive = stack.enter_context(zipfile.ZipFile(raw))
        members = [member for member in archive.namelist() if not member.endswith("/")]
        if len(members) != 1:
            listed = ", ".join(members[:5]) or "none"
            raise UserError(f"{name}: the archive must hold one file, it holds {len(members)} ({listed}); unpack it")
        return stack.enter_context(archive.open(members[0]))
    return raw


def head_of(stream: IO[bytes], size: int = HEAD) -> bytes:
    """The first bytes, also of a stream that hands out less than it is asked for."""
    parts: list[bytes] = []
    while size > 0 and (part := stream.read(size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def blocks_of_lines(
    stream: IO[bytes], encoding: str, quote: str, name: str, size: int = BLOCK
) -> Iterator[tuple[int, str]]:
    """Blocks of whole lines.

    Args:
        stream: decompressed bytes, at their beginning.
        encoding: of the text.
        quote: character around cells; a line break inside of a quoted cell ends no line.
        name: of the file, for messages.
        size: characters of a block; a longer line makes it longer.

    Yields:
        Number of the block's first line, from 1, and its text with line feeds as line ends, the last one included.

    Raises:
        UserError: bytes that the encoding does not know.
    """
    reader = io.TextIOWrapper(stream, encoding=encoding, newline=None)  # type: ignore[type-var]
    rest, line = "", 1
    try:
        while True:
            try:
                part = reader.read(size)
            except UnicodeError as error:
                raise UserError(
                    f"{name}: not {encoding} text near line {line + rest.count(chr(10))}: {reason(error)}; set "
                    'table.dialect.encoding, for example "cp1252"'
                ) from error
            text = rest + part
            cut = end_of_lines(text, quote) if part else len(text)
            # Empty lines wait for what follows them: at the end of the file they are no rows, not even of one column.
            lines = text[:cut].rstrip("\n")
            if lines:
                yield line, lines + "\n"
                line += lines.count("\n") + 1
                text = text[len(lines) + 1 :]
            rest = text
            if not part:
                return
    finally:
        # The caller closes its stream.
        with contextlib.suppress(ValueError):
            reader.detach()


def end_of_lines(text: str, quote: str) -> int:
    """Where the last whole line ends: 0 where there is none.

    >>> end_of_lines('1,2' + chr(10) + '3,"a' + chr(10), '"')
    4
    """
    end = cut = text.rfind("\n") + 1
    odd = text.count(quote, 0, cut) % 2
    for _ in range(QUOTED_LINES):
        if not odd or not cut:
            return cut
        before = text.rfind("\n", 0, cut - 1) + 1
        odd ^= text.count(quote, before, cut) % 2
        cut = before
    # No cell is as long as that: somewhere a quote stands for itself, as in 5" pipe.
    return end

"""Whole lines of standard input or of a file that grows, as they come."""

from __future__ import annotations

import codecs
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from .errors import UserError, reason
from .logs.cells import Block
from .logs.config import TablePart
from .logs.dialect import Dialect, sniff
from .logs.parser import Parser
from .logs.read import as_text
from .logs.text import end_of_lines, find_compression, is_parquet

POLL = 0.02  # seconds between two looks at a file that does not grow
READ = 1 << 20  # bytes at a time
HEAD = 1 << 16  # bytes in which the header must come
SURE = 3  # rows of numbers after which a header that has not come is missing


class Tail:
    """Blocks of a table that is being written.

    The dialect is found in the lines that are there when the first row is: what they do not show (that commas are
    decimal, say) the configuration has to say.

    Args:
        path: of the file; None is standard input, which ends.
        part: the table ``[table]`` of the configuration.

    Raises:
        UserError: the file cannot be followed, or what `Parser` raises.
    """

    def __init__(self, path: Path | None, part: TablePart):
        self.name = "standard input" if path is None else path.name
        self._path, self._part = path, part
        self.dialect: Dialect | None = None
        if path is not None and is_parquet(path):
            raise UserError(f"{path.name}: a Parquet file does not grow; --follow reads text")

    def __iter__(self) -> Iterator[Block]:
        """Blocks of rows that are complete; waits for more, in a file forever."""
        parser, line, head = None, 1, b""
        decoder: Any = None
        rest = ""
        for data in self._bytes():
            if parser is None:
                head += data
                parser = self._parser(head, ended=not data)
                if parser is None:
                    continue
                decoder = codecs.getincrementaldecoder(parser.dialect.encoding)()
                # The dialect is known: all that came before it is read now.
                data, ended = head, not data
            else:
                ended = not data
            text = (rest + self._decoded(decoder, data, ended, line)).replace("\r\n", "\n")
            if ended and text and not text.endswith("\n"):
                text += "\n"
            cut = len(text) if ended else end_of_lines(text, parser.dialect.quote)
            if cut:
                yield from parser.parse_up_to_fault(line, text[:cut])
                line += text.count("\n", 0, cut)
            rest = text[cut:]

    def _parser(self, head: bytes, ended: bool) -> Parser | None:
        """How the lines are written, once there are a header and a row."""
        if find_compression(head) != "none":
            raise UserError(
                f"{self.name}: --follow reads plain text; unpack it, for example by: gzip -dc FILE | gsisio ..."
            )
        part = self._part
        whole = head if ended else head[: head.rfind(b"\n") + 1]
        if not whole.strip() and not ended:
            return None
        dialect = sniff(whole, self.name, part.dialect, part.wanted, part.missing)
        known = set(part.wanted) <= set(dialect.columns)
        if not ended and len(head) < HEAD and len(dialect.sample) < (1 if known else SURE):
            return None
        self.dialect = dialect
        return Parser(self.name, dialect, part.wanted, part.missing, as_text(part, dialect))

    def _decoded(self, decoder: Any, data: bytes, ended: bool, line: int) -> str:
        try:
            return decoder.decode(data, final=ended)
        except UnicodeError as error:
            encoding = self.dialect and self.dialect.encoding
            raise UserError(
                f"{self.name}: not {encoding} text after line {line}: {reason(error)}; set table.dialect.encoding"
            ) from error

    def _bytes(self) -> Iterator[bytes]:
        """What is new; empty once, at the end of standard input."""
        if self._path is None:
            stream: Any = sys.stdin.buffer
            while data := stream.read1(READ):
                yield data
            yield b""
            return
        try:
            with open(self._path, "rb") as stream:
                while True:
                    if data := stream.read(READ):
                        yield data
                    else:
                        self._still_there(stream)
                        time.sleep(POLL)
        except OSError as error:
            raise UserError(f"{self._path}: cannot read the table: {reason(error)}") from error

    def _still_there(self, stream: IO[bytes]) -> None:
        assert self._path is not None
        mine = os.fstat(stream.fileno())
        try:
            now = os.stat(self._path)
        except FileNotFoundError:
            now = None
        if now is None or (now.st_dev, now.st_ino) != (mine.st_dev, mine.st_ino):
            raise UserError(f"{self.name}: the file was removed or replaced while it was followed")
        if mine.st_size < stream.tell():
            raise UserError(f"{self.name}: the file became shorter while it was followed")

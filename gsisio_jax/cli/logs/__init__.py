"""Logs as they come: any clock, any table of text or Parquet, onto the grid of the sample time.

In the order of the work: `config` (the keys of ``[table]``), `text` (compression, encoding, blocks of lines),
`dialect` with `layout` and `numerals` (separator, header, decimal comma ... by looking), `parser` and `parquet` (blocks
of columns), `cells` (to numbers), `transformed` (a function of the user), `stamps` (cells of the clock to seconds),
`clock` (seconds to indices of the grid), `units`, `reader` (blocks to rows on the grid), `read` (all of a file) and
`stream` (a long one in pieces).
"""

from .config import TablePart
from .read import Table, open_blocks, read_table
from .reader import Rows, TableReader
from .stream import TableStream

__all__ = ["Rows", "Table", "TablePart", "TableReader", "TableStream", "open_blocks", "read_table"]

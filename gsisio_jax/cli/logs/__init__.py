"""Logs as they come: any clock, any table of text or Parquet, onto the grid of the sample time.

In the order of the work: `config` (the keys of ``[table]``), `text` (compression, encoding, blocks of lines), `dialect`
(separator, header, decimal comma ... by looking), `cells` (blocks of columns), `stamps` (cells of the clock to seconds),
`clock` (seconds to indices of the grid), `units`, and `read`, which joins them block by block.
"""

from .config import TablePart
from .read import Rows, Table, TableReader, read_table

__all__ = ["Rows", "Table", "TablePart", "TableReader", "read_table"]

"""One table in place of the many files that a manifest names: each row says of which file it is.

A column ``file`` has the name of the file, as the table that `aacmm plan` writes has it; otherwise the columns
``artefact``, ``position`` and ``end``, those that are there, are joined: ``bar1``, ``03`` and ``a`` stand for
``bar1/03/a.csv``. An empty cell is left out.
"""

from collections.abc import Sequence

import numpy as np

from ..core.errors import InputError
from ..core.text import quoted, shorten
from .patterns import is_excluded, matching
from .text_table import TextTable

_FILE, _PARTS = "file", ("artefact", "position", "end")
_EXTENSION = ".csv"


class OneTable:
    """The rows of a table by the file that they are of. Raises `InputError` where no column says it."""

    def __init__(self, table: TextTable):
        self._table, self._used = table, set[str]()
        parts = [name for name in _PARTS if table.has([name])]
        columns = [_FILE] if table.has([_FILE]) else parts
        if not columns:
            raise InputError(
                f"{table.path} has neither a column 'file' nor columns 'artefact', 'position' and 'end', which say of "
                f"which file of the manifest each row is; the table has {table.shown()}."
            )
        cells = [table.texts(column) for column in columns]
        labels = ["/".join(filter(None, row)).removesuffix(_EXTENSION) for row in zip(*cells, strict=True)]
        if "" in labels:
            raise InputError(
                f"{table.path} row {labels.index('') + 1} says of no file that it is of; fill in its {columns[0]}."
            )
        self._labels = np.array(labels)

    def __contains__(self, file: str) -> bool:
        return bool(np.any(self._labels == file.removesuffix(_EXTENSION)))

    def rows(self, file: str) -> TextTable:
        """The rows of a file, as a table of their own."""
        label = file.removesuffix(_EXTENSION)
        self._used.add(label)
        return self._table.with_rows(np.flatnonzero(self._labels == label).tolist())

    def matches(self, pattern: str, exclude: Sequence[str] = ()) -> list[dict[str, str]]:
        """The values of the fields in braces, as of files that are in the table; none if no file matches."""
        files = [f"{label}{_EXTENSION}" for label in dict.fromkeys(self._labels.tolist())]
        return matching(pattern, [file for file in files if not is_excluded(file, exclude)])

    def check_used(self) -> None:
        """Raise `InputError` for rows of a file that the manifest does not name."""
        unused = [quoted(str(x)) for x in dict.fromkeys(self._labels.tolist()) if x not in self._used]
        if unused:
            raise InputError(
                f"{self._table.path} has rows of {shorten(unused)}, which no table of the manifest names; correct "
                "these rows, or add a table."
            )

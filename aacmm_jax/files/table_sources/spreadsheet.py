"""Tables in sheets of Excel (.xlsx). Formulas count as what they were when the file was saved."""

import io
import itertools
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.errors import InputError
from ...core.text import quoted, shorten
from .nested import table_text

_LARGEST_UNPACKED = 512 * 2**20
_MOST_CELLS = 20_000_000
_MOST_ROWS = 1_048_576  # of a sheet


def read(members: Mapping[str, bytes], tables: Sequence[str], corners: int) -> dict[str, Any]:
    """The lines of a sheet, its empty ones included, so that they are numbered as in the sheet."""
    import openpyxl

    (content,) = members.values()
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > _LARGEST_UNPACKED:
            raise InputError(f"unpacks to more than {_LARGEST_UNPACKED // 2**20} MiB; give a smaller file.")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of styles and extensions that are not read
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True, keep_links=False)
    names = [sheet.title for sheet in book.worksheets]
    unknown = [name for name in tables if name not in names]
    if unknown or len(tables) > 1:
        what = f"no sheet {quoted(unknown[0])}" if unknown else "one table in each sheet"
        raise InputError(f"has {what}; give one of its sheets: {shorten(list(map(quoted, names)), 12)}.")
    sheets = {name: _cells(book[name]) for name in tables or names}
    filled = [name for name, rows in sheets.items() if rows]
    if len(filled) != 1:
        choice = f"add table = {quoted(filled[0])}" if filled else "give a file that has some"
        raise InputError(f"has {len(filled)} sheets with cells ({shorten(filled, 12)}); {choice}.")
    return table_text(sheets[filled[0]], header=False)


def _cells(sheet: Any) -> list[list[Any]]:
    """The rows to the last one that is not empty; those that have numbers are as long as the longest of them."""
    sheet.reset_dimensions()  # what the file says of its size may be wrong
    rows: list[list[Any]] = []
    cells = 0
    for row in itertools.islice(sheet.iter_rows(values_only=True), _MOST_ROWS):
        values = list(row)
        while values and values[-1] in (None, ""):
            values.pop()
        rows.append(values)
        cells += len(row)
        if cells > _MOST_CELLS:
            raise InputError(f"has more than {_MOST_CELLS:,} cells in sheet {quoted(sheet.title)}; give a smaller one.")
    while rows and not rows[-1]:
        rows.pop()
    width = max((len(row) for row in rows if _has_number(row)), default=0)
    return [row + [None] * (width - len(row)) if _has_number(row) else row for row in rows]


def _has_number(row: Sequence[Any]) -> bool:
    return any(isinstance(value, int | float) and not isinstance(value, bool) for value in row)

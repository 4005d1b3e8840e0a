"""Tables as data: what a report shows as HTML, and what anything else may show in its own way.

A table is declared by its columns: a heading, and the key of a row or a function of it.

    table("Sockets", rows, {"socket": "name", "poses": "poses", "RMS [mm]": lambda row: number(row["rms"], 3)})
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral
from typing import Any, NamedTuple

Columns = dict[str, str | Callable[[Any], Any] | None]
_ZERO = 1e-9  # mm: smaller numbers are rounding errors
_MOST = 1e9  # from here on decimals mean nothing


class Cell(NamedTuple):
    """One cell of a table."""

    text: str
    value: float | None = None  # what the column is sorted by; None: the text
    mark: str = ""  # "good", "bad", "unsure", "outlier"


class Table(NamedTuple):
    """A table with headings; columns whose cells have values are right-aligned."""

    caption: str
    columns: tuple[str, ...]
    rows: list[list[Cell]]
    folded: bool = False  # shown on demand only, and not printed
    keys: int = 1  # columns that a terminal repeats where it is too narrow for all

    @property
    def numeric(self) -> list[bool]:
        """Which columns contain numbers."""
        return [any(row[i].value is not None for row in self.rows) for i in range(len(self.columns))]


def table(
    caption: str,
    rows: Iterable[Any],
    columns: Mapping[str, str | Callable[[Any], Any] | None] | Sequence[str],
    *,
    folded: bool = False,
    keys: int = 1,
) -> Table:
    """A table of rows by the headings of its columns.

    Args:
        caption: Its caption.
        rows: Anything; mappings where a column is a key.
        columns: Heading -> the key of a row, or what makes a text, a number or a `Cell` of it; None: no such column.
            Whole numbers have no decimals, others four. Headings alone, where each row is the cells themselves.
        folded: Whether it is shown on demand only.
        keys: Columns that a terminal repeats where it is too narrow for all.

    Returns:
        The table.
    """
    if not isinstance(columns, Mapping):
        return Table(caption, tuple(columns), [[_cell(value) for value in row] for row in rows], folded, keys)
    read = {
        heading: (lambda row, key=column: row.get(key)) if isinstance(column, str) else column
        for heading, column in columns.items()
        if column is not None
    }
    return Table(caption, tuple(read), [[_cell(value(row)) for value in read.values()] for row in rows], folded, keys)


def _cell(value: Any) -> Cell:
    if isinstance(value, Cell):
        return value
    if isinstance(value, bool):
        return Cell("yes" if value else "no")
    return Cell(value) if isinstance(value, str) else number(value, 0 if isinstance(value, Integral) else 4)


def number(
    value: float | None, decimals: int = 4, *, signed: bool = False, mark: str = "", rounded: bool = False
) -> Cell:
    """A cell with a number; a dash for None and NaN. ``rounded``: to these decimals of its U, even to 0."""
    if value is None or not math.isfinite(value):
        return Cell("–" if value is None or math.isnan(value) else "not determined", None, mark)
    shown = round(value, decimals) if rounded else value
    return Cell(format_number(shown, decimals, signed=signed), float(value), mark)


def format_number(value: float, decimals: int = 4, *, signed: bool = False) -> str:
    """A number with a fixed number of decimals, or in powers of ten if these would not show it."""
    sign = "+" if signed else ""
    if abs(value) < _ZERO:
        value = 0.0
    if not abs(value) < _MOST:
        return f"{value:{sign}.6g}".replace("-", "−")
    if value != 0 and abs(value) < 0.5 * 10**-decimals:
        return f"{value:{sign}.1e}".replace("-", "−")
    return f"{value:{sign}.{decimals}f}".replace("-", "−")

"""Text tables: comma, semicolon, tab or blank between columns, header lines allowed; and tables of other formats."""

import contextlib
import copy
import itertools
import os
import re
from collections.abc import Sequence

import numpy as np

from ..core.errors import InputError
from ..core.text import is_number, number, quoted, shorten
from .table_sources.sources import lines_of_source
from .text_lines import (
    AMBIGUOUS,
    Column,
    Line,
    along_axes,
    cells_of,
    decimal_of,
    delimiter_of,
    has_number,
    is_row,
    matching,
    names_of_columns,
    plain_name,
    stem_and_number,
    table_lines,
    trimmed,
    unit_in,
)

_LARGEST = 1e15  # encoder counts reach 1e10; beyond it squares lose what is measured
_PLAIN = frozenset("0123456789+-eE \t")  # and the decimal mark: float takes these as people read them, or not at all
_FEW = 3  # rows from which equal columns, or a shorter last number, are no coincidence
_LONG = 12  # columns, or characters of a name, that a message shows


class TextTable:
    """A text table whose columns are picked by header name, shell pattern or number from 1; other columns may be text.

    A name that the header does not have exactly is compared without regard to case, blanks and a unit in brackets.
    A header is a line of words before the first row: none of them begins like a number.

    ``delimiter`` and ``decimal`` are found where they are None; ``skip`` lines before the header are left out; of
    several lines of words, the header is the one that has the columns that are ``wanted``. Raises `InputError` where
    the file is no text, its rows differ in their number of columns, or several lines may be its header.

    A file in a format of `table_sources` is read as the text that its table would be; ``tables`` and ``corners`` are
    those of `lines_of_source`.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        delimiter: str | None = None,
        decimal: str | None = ".",
        skip: int = 0,
        wanted: Sequence[Column] = (),
        tables: Sequence[str] = (),
        corners: int = 0,
    ):
        self.path, self._hashes = path, False
        source = lines_of_source(path, tables, corners)
        self.note = "" if source is None else source.note  # what was read of it
        self._is_text, self._place = source is None, "line" if source is None else "row"
        if source is None:
            lines, self._ended = table_lines(path)
        elif delimiter or decimal == "," or (skip and source.header):
            raise InputError(
                f"{path} is not a text table, so delimiter, decimal and skip do not apply; remove these keys."
            )
        else:
            lines, self._ended, delimiter, decimal = source.lines, True, "\t", "."
        first = skip + (source is None or not source.header)
        if lines[skip : skip + 1] and (stated := re.fullmatch('"?sep=(.)"?', lines[skip])):  # of spreadsheets
            delimiter, skip = delimiter or stated[1], skip + 1
        delimiter = delimiter or delimiter_of(lines[skip:], decimal)
        self._decimal = decimal or decimal_of(lines[skip:], delimiter)
        words: list[Line] = []
        comments: list[Line] = []
        rows: list[Line] = []
        for line_number, line in enumerate(lines[skip:], start=first):
            cells = cells_of(line, delimiter)
            if not any(cell.strip(' \t"') for cell in cells):
                continue
            text, above = line.strip(' \t"'), (rows or words)[-1:]
            # A line that begins with "#" is a row only where it is as wide as what is above it, and has numbers.
            if text[:1] == "#" and not (above and len(cells) >= len(above[0][1]) and has_number(cells[1:])):
                comments += [] if rows else [(line_number, cells_of(text[1:].strip(" \t"), delimiter, header=True))]
            elif not rows and not is_row(cells):
                words.append((line_number, cells_of(line, delimiter, header=True)))
            else:
                rows.append((line_number, cells))
        if not rows:
            raise InputError(f"{path} contains no numbers; give one line per pose.")
        width = len(rows[0][1])
        for line_number, cells in rows:
            if len(cells) != width:
                raise InputError(
                    f"{path} {self._place} {line_number} has {len(cells)} columns, but those before it have {width}; "
                    "give all lines the same number of columns, or copy the file again if it is incomplete, or add "
                    f"skip = {line_number - 1} if the table begins in that line."
                )
        self._lines, self._rows = [number for number, _ in rows], [cells for _, cells in rows]
        # Columns at the end that are empty in all rows and without a name: lines that end with delimiters.
        named = max((len(trimmed(cells, 1)) for _, cells in words), default=0)
        while len(self._rows[0]) > max(1, named) and not any(row[-1] for row in self._rows):
            for row in self._rows:
                row.pop()
        self.width, self.length = len(self._rows[0]), len(self._rows)
        words = [(number, trimmed(cells, self.width)) for number, cells in words]
        self.title = words[-1][1] if words else []  # a line of words that may not name the columns
        # Names of the columns; empty where the table has none.
        self.header = [name.strip("\"'") for name in names_of_columns(path, self.width, words, comments, wanted)]

    def with_rows(self, kept: Sequence[int]) -> "TextTable":
        """The same table with these rows alone, counted from 0."""
        table = copy.copy(self)
        table._lines, table._rows = [self._lines[i] for i in kept], [self._rows[i] for i in kept]
        table.length = len(table._rows)
        return table

    @property
    def misnamed(self) -> bool:
        """Whether a line of several names is above the rows, but not one name for each column."""
        return not self.header and len(self.title) > 1

    def shown(self) -> str:
        """Its columns as a message shows them: names with their numbers."""
        if not self.header:
            others = f", but {len(self.title)} names in the header" if self.misnamed else " without names"
            return f"{self.width} columns{others}"
        most = max(_LONG, 150 // self.width)
        names = [f"{i} {quoted(name[:most])}" for i, name in enumerate(self.header, start=1)]
        return f"the columns {shorten(names, _LONG)}"

    def has(self, wanted: Sequence[Column]) -> bool:
        """Whether these columns are there. Raises `InputError` where only some of them are."""
        missing = [column for column in wanted if not self._matching(column)]
        if missing and len(missing) < len(wanted):
            others = shorten([str(column) for column in wanted if column not in missing])
            raise InputError(
                f"{self.path} has the columns {others}, but no column {quoted(str(missing[0]))}; correct the header, "
                "or pick the columns by number."
            )
        return not missing

    def _matching(self, column: Column) -> list[int]:
        if isinstance(column, int):
            return [column - 1] if 1 <= column <= self.width else []
        return matching(self.header, column)

    def unit(self, picked: Sequence[int], stated_unit: str | None = None, key: str = "q") -> str | None:
        """The unit that the header states for columns, counted from 0, or None.

        ``stated_unit``, that of the manifest, decides what the ambiguous grad is; ``key`` is what the manifest calls
        the quantity in ``units``. Raises `InputError` where the header states several units, or one that is not clear.
        """
        names = {unit_in(self.header[i]): self.header[i] for i in picked if self.header}
        names.pop(None, None)
        if len(names) > 1:
            shown = shorten([f"{quoted(name)} is in {str(unit)[:_LONG]}" for unit, name in names.items()], 2)
            raise InputError(
                f"{self.path} mixes units: {shown}; convert the columns to the same unit, and correct the header."
            )
        if AMBIGUOUS in names and stated_unit not in ("deg", "gon"):
            raise InputError(
                f"{self.path}: the header says {quoted(names[AMBIGUOUS])}, but grad means deg in German and gon "
                f'elsewhere; add units = {{ {key} = "deg" }} or {{ {key} = "gon" }}, or write deg or gon in the header.'
            )
        return stated_unit if AMBIGUOUS in names else next(iter(names), None)

    def pick(self, wanted: Sequence[Column]) -> list[int]:
        """Indices of columns, a pattern in the order of the header. Raises `InputError` for one that is not there."""
        picked: list[int] = []
        for column in wanted:
            indices = self._matching(column)
            if not indices:
                raise InputError(
                    f"{self.path} has no column {quoted(str(column))}; the table has {self.shown()}; pick another "
                    "column by name or by number, or correct the header."
                )
            if len(indices) > 1 and isinstance(column, str) and plain_name(column) in map(plain_name, self.header):
                raise InputError(
                    f"{self.path} gives the columns {shorten([str(i + 1) for i in indices])} the same name "
                    f"{quoted(column)}; use each name once, or pick the columns by number."
                )
            self.check_ascending(indices)
            picked += indices
        if len(set(picked)) < len(picked):
            raise InputError(
                f"{self.path}: {shorten([str(x)[:99] for x in wanted])} pick the same column twice; pick each column "
                "once."
            )
        return picked

    def check_ascending(self, picked: Sequence[int], line: str = "columns = [{}]") -> None:
        """Refuse columns whose names are numbered, or of axes, but not in their order; ``line``: what states it."""
        if len(picked) < 2 or not self.header:
            return
        names = [self.header[i] for i in picked]
        axes, numbered = along_axes(names), [pair for pair in map(stem_and_number, names) if pair]
        alike = len(numbered) == len(names) and len({stem.casefold() for stem, _ in numbered}) == 1
        numbers = [number for _, number in numbered] if alike else []
        order = axes or np.argsort(numbers, stable=True).tolist()
        if order == sorted(order) and len(set(numbers)) == len(numbers):
            return
        ordered = ", ".join(str(picked[i] + 1) for i in order)
        advice = (
            f"add {line.format(ordered)} to sort the columns by their numbers, or list each column once in the order "
            "of the joints."
        )
        if axes is not None:
            advice = f"pick the columns as a list in the order of the axes: [{ordered}]."
        shown = shorten([quoted(name[:_LONG]) for name in names], _LONG)
        raise InputError(f"{self.path} has the columns in the order {shown}; {advice}")

    def numbers(self, picked: Sequence[int], *, measured: bool = False, stated: bool = False) -> np.ndarray:
        """The numbers of columns, counted from 0, ``(rows, columns)``; ``measured``: they are not numbers of columns,
        and no two of them are the same unless somebody ``stated`` the columns."""
        hashed = next((i for i, row in enumerate(self._rows) if row[0].lstrip(' \t"').startswith("#")), None)
        if hashed is not None and not self._hashes:
            raise InputError(
                f"{self.path} line {self._lines[hashed]} begins with #, but has the same number of columns as the rows "
                "of numbers; remove the line if it is a comment, otherwise remove the # from its first cell."
            )
        # A file without a last line's end may be cut: then its last number has fewer decimals than the others.
        decimals = [len(row[-1].partition(self._decimal)[2]) for row in self._rows]
        if self.width - 1 in picked and not self._ended and len(decimals) >= _FEW and decimals[-1] < min(decimals[:-1]):
            raise InputError(
                f"{self.path} line {self._lines[-1]}: the last number, {quoted(self._rows[-1][-1])}, has fewer digits "
                "than all numbers above it, and the line has no line break, so the file may be incomplete; copy the "
                "file again, or add a line break if the file is complete."
            )
        table = np.stack([self._column(i) for i in picked], axis=1)
        if not measured:
            return table
        cells, count = [self._rows[0][i] for i in picked], len(picked)
        if count > 1 and any(sorted(cells) == sorted(map(str, range(i, i + count))) for i in (0, 1)):
            order = ", ".join(str(picked[i] + 1) for i in np.argsort(table[0]))
            raise InputError(
                f"{self.path} line {self._lines[0]} contains the column numbers {cells[0]} to {cells[-1]}; add skip = "
                f"{self._lines[0]} and columns = [{order}], or, if these numbers are measured values, write them with "
                "decimal points."
            )
        for (i, column), (j, other) in itertools.combinations(zip(picked, table.T, strict=True), 2):
            if not stated and self.length >= _FEW and np.ptp(column) > 0 and np.array_equal(column, other):
                raise InputError(
                    f"{self.path} has the same numbers in columns {i + 1} and {j + 1}; give each column once, or add "
                    f"columns = [{', '.join(str(index + 1) for index in picked)}] if both columns really have the same "
                    "readings."
                )
        return table

    def _column(self, index: int) -> np.ndarray:
        cells = [row[index] for row in self._rows]
        # Together where they are plain numbers: one by one they are most of the time that a large table takes.
        if set().union(*cells) <= _PLAIN | {self._decimal}:
            with contextlib.suppress(ValueError):
                values = np.array([float(cell.replace(self._decimal, ".")) for cell in cells])
                if np.abs(values).max() <= _LARGEST:
                    return values
        return np.array([self._number(i, index, cell) for i, cell in enumerate(cells)])

    def _number(self, row: int, index: int, cell: str) -> float:
        place = f"{self.path} {self._place} {self._lines[row]} column {index + 1}"
        if not self._is_text and not is_number(cell):
            what = f": {quoted(cell)} is not a number" if cell else " is empty"
            raise InputError(f"{place}{what}; correct the cell, or delete the row.")
        place += f": {quoted(cell)}"
        plain = cell.replace(self._decimal, ".")
        if not is_number(plain) or (self._decimal == "," and "." in cell):
            mark = 'add decimal = "," to its table' if self._decimal == "." else 'remove decimal = ","'
            raise InputError(
                f"{place} is not a number with the decimal mark '{self._decimal}'; write the number without quotes and "
                f"thousands separators, or {mark}, or add skip = {self._lines[row]} if the table begins after this "
                "line."
            )
        value = number(plain)
        if not abs(value) <= _LARGEST:
            raise InputError(f"{place} is not finite, or is implausibly large; correct the number.")
        return value

    def cells(self, index: int) -> list[str]:
        """The cells of a column, from 0, with decimal points."""
        return [row[index].replace(",", ".", 1) for row in self._rows]

    def texts(self, column: Column) -> np.ndarray:
        """The cells of one column."""
        (index,) = self.pick([column])
        self._hashes = self._hashes or index == 0  # "#2" is a text
        return np.array([row[index].strip("\"'") for row in self._rows])

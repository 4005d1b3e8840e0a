"""Text tables: comma, semicolon, tab or blank between columns, header lines allowed."""

import contextlib
import itertools
import math
import os
import re
from collections.abc import Sequence

import numpy as np

from ..core.errors import InputError, nearest
from ..core.text import is_number, number, quoted, shorten
from .column_names import (
    AMBIGUOUS,
    Column,
    along_axes,
    are_numbered,
    has_number,
    header_cells,
    is_row,
    matching,
    names_of_columns,
    plain_name,
    stem_and_number,
    stripped,
    trimmed,
    unit_in,
)
from .text_lines import cells_of, delimiter_of, table_lines

_LARGEST = 1e15  # encoder counts reach 1e10; beyond it squares lose what is measured
_PLAIN = frozenset("0123456789+-eE \t")  # and the decimal mark: float takes these as people read them, or not at all
_WITH_COMMA = re.compile("[+-]?[0-9]*,[0-9]+")
_DECIMALS = re.compile(r"[+-]?[0-9]*(?:\.([0-9]*))?(?:[eE][+-]?([0-9]*))?")
_FEW = 3  # rows from which equal columns, or a shorter last number, are no coincidence
_LONG = 12  # columns, or characters of a name, that a message shows


class TextTable:
    """A text table whose columns are picked by header name, shell pattern or number from 1; other columns may be text.

    A name that the header does not have exactly is compared without regard to case, blanks and a unit in brackets.
    A header is a line of words before the first row: none of them begins like a number.

    ``delimiter`` is found where it is None; ``skip`` lines before the header are left out; of several lines of words,
    the header is the one that has the columns that are ``wanted``. Raises `InputError` where the file is no text, its
    rows differ in their number of columns, or several lines may be its header.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        delimiter: str | None = None,
        decimal: str = ".",
        skip: int = 0,
        wanted: Sequence[Column] = (),
    ):
        self.path, self._decimal = path, decimal
        lines, self._ended = table_lines(path)
        if lines[skip : skip + 1] and (stated := re.fullmatch('"?sep=(.)"?', lines[skip])):  # of spreadsheets
            delimiter, skip = delimiter or stated[1], skip + 1
        delimiter = delimiter or delimiter_of(lines[skip:], decimal)
        words: list[tuple[int, list[str]]] = []
        comments: list[tuple[int, list[str]]] = []
        rows: list[tuple[int, list[str]]] = []
        hashed: set[int] = set()  # rows that begin like comments
        for line_number, line in enumerate(lines[skip:], start=skip + 1):
            if not line or line[0] in ' \t#"':
                text = line.strip(' \t"')
                if not text:
                    continue
                if text[0] == "#":
                    if not (words or rows) or not has_number(stripped(cells_of(line, delimiter)[1:])):
                        comments.append((line_number, header_cells(text[1:].strip(" \t"), delimiter)))
                        continue
                    hashed.add(line_number)
            cells = cells_of(line, delimiter)
            if not cells[0] and not any(cell.strip() for cell in cells):
                continue
            if len(rows) == len(hashed) and not is_row(stripped(cells)):
                words.append((line_number, header_cells(line, delimiter)))
            else:
                rows.append((line_number, cells))
        if hashed:  # lines that begin with "#" and are not as wide as the rows are comments
            width = next((len(cells) for number, cells in rows if number not in hashed), len(rows[0][1]))
            rows = [(number, cells) for number, cells in rows if number not in hashed or len(cells) == width]
        if not rows:
            raise InputError(f"{path} holds no numbers; give one line a pose.")
        self._lines, self._rows = [number for number, _ in rows], [cells for _, cells in rows]
        self._hashed = [number for number in self._lines if number in hashed]
        self._check_widths()
        # Columns at the end that are empty in all rows and without a name: lines that end with delimiters.
        named = max((len(trimmed(cells, 1)) for _, cells in words), default=0)
        while len(self._rows[0]) > max(1, named) and not any(row[-1].strip() for row in self._rows):
            for row in self._rows:
                row.pop()
        self.width, self.length = len(self._rows[0]), len(self._rows)
        words = [(number, trimmed(cells, self.width)) for number, cells in words]
        self._title = words[-1][1] if words else []  # a line of words that does not name the columns
        # Names of the columns; empty where the table has none.
        self.header = [name.strip("\"'") for name in names_of_columns(path, self.width, words, comments, wanted)]

    def _check_widths(self) -> None:
        width = len(self._rows[0])
        wrong = next((i for i, row in enumerate(self._rows) if len(row) != width), None)
        if wrong is None:
            return
        where, given = f"{self.path} line {self._lines[wrong]}", len(self._rows[wrong])
        if wrong == len(self._rows) - 1 > 0 and not self._ended and given < width:
            raise InputError(
                f"{where}, the last, ends after {given} of {width} columns, and without the end of a line, so the file "
                "is cut there; copy it again, or leave out that line."
            )
        begins = f", or add skip = {self._lines[wrong] - 1} if the table begins there"
        skip = begins if wrong < _LONG and width < given else ""
        raise InputError(f"{where} has {given} columns, the lines before it {width}; give all the same{skip}.")

    @property
    def misnamed(self) -> bool:
        """Whether a line of several names is above the rows, but not one name for each column."""
        return not self.header and len(self._title) > 1

    @property
    def misnumbered(self) -> bool:
        """Whether these are numbered, so that the order of the columns is not known."""
        return self.misnamed and are_numbered(self._title)

    def shown(self) -> str:
        """Its columns as a message shows them: names with their numbers."""
        if not self.header:
            others = f", but its header {len(self._title)} names" if self.misnamed else " without names"
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
                f"{self.path} has no column {quoted(str(missing[0]))}, but columns {others}; correct its header, or "
                "pick the columns by number."
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
            (unit, name), (other_unit, other), *_ = names.items()
            raise InputError(
                f"{self.path} mixes units: {quoted(name)} is in {str(unit)[:_LONG]}, {quoted(other)} in "
                f"{str(other_unit)[:_LONG]}; convert one of them, and change its header."
            )
        if AMBIGUOUS in names and stated_unit not in ("deg", "gon"):
            but = f", but the manifest says {stated_unit}" if stated_unit else ""
            raise InputError(
                f"{self.path}: the header says {quoted(names[AMBIGUOUS])}, and grad is deg in German and gon elsewhere"
                f'{but}; add units = {{ {key} = "deg" }}, or "gon", or write it in the header.'
            )
        return stated_unit if AMBIGUOUS in names else next(iter(names), None)

    def pick(self, wanted: Sequence[Column]) -> list[int]:
        """Indices of columns, a pattern in the order of the header. Raises `InputError` for one that is not there."""
        picked: list[int] = []
        for column in wanted:
            indices = self._matching(column)
            if not indices:
                raise InputError(f"{self.path} has {self._missing(column)}")
            if len(indices) > 1 and isinstance(column, str) and plain_name(column) in map(plain_name, self.header):
                numbers = shorten([str(i + 1) for i in indices])
                raise InputError(
                    f"{self.path} names the columns {numbers} all {quoted(column)}; give each name once, or pick them "
                    "by number."
                )
            self.check_ascending(indices)
            picked += indices
        if len(set(picked)) < len(picked):
            raise InputError(f"{self.path}: one column is picked twice by {shorten([str(x)[:99] for x in wanted])}.")
        return picked

    def _missing(self, column: Column) -> str:
        if isinstance(column, int):
            return f"{self.width} columns, so there is no column {column}; pick others."
        if self.header:
            return f"no column {quoted(column)}{nearest(column, [quoted(name)[1:-1] for name in self.header[:999]])}"
        if self._title:
            return (
                f"no column {quoted(column)}: its header has {len(self._title)} names, but its rows {self.width} "
                "columns; correct the header, or give numbers (decimal commas need another delimiter)."
            )
        first = [cell.strip(" \t\"'") for cell in self._rows[0]]
        if column in first:
            line = self._lines[0]
            return (
                f"no column {quoted(column)}: line {line} names it, but has numbers for names besides, so it is not a "
                f"header; add skip = {line}, and pick column {first.index(column) + 1} by its number."
            )
        return f"no column {quoted(column)}; it has no header: give numbers."

    def check_ascending(self, picked: Sequence[int], line: str = "columns = [{}]") -> None:
        """Refuse columns whose names are numbered, or of axes, but not in their order; ``line``: what states it."""
        if len(picked) < 2 or not self.header:
            return
        columns = [self.header[i] for i in picked]
        axes, numbered = along_axes(columns), [stem_and_number(name) for name in columns]
        stems = {stem.casefold() for stem, _ in filter(None, numbered)}
        numbers = [number for _, number in filter(None, numbered)] if len(stems) == 1 and all(numbered) else []
        if len(set(numbers)) < len(numbers):
            twice = next(name for name, number in zip(columns, numbers, strict=True) if numbers.count(number) > 1)
            raise InputError(f"{self.path} names the column {quoted(twice)} twice; give each column once.")
        order = axes or np.argsort(numbers).tolist()
        if order == sorted(order):
            return
        ordered = ", ".join(str(picked[i] + 1) for i in order)
        advice = f"add {line.format(ordered)} for that of their numbers, or the order of the joints."
        if axes is not None:
            advice = f"pick them as a list, [{ordered}], in that of the axes."
        names = shorten([quoted(name[:_LONG]) for name in columns], _LONG)
        raise InputError(f"{self.path} has its columns in the order {names}; {advice}")

    def numbers(self, picked: Sequence[int], *, measured: bool = False, stated: bool = False) -> np.ndarray:
        """The numbers of columns, counted from 0, ``(rows, columns)``; ``measured``: they are not numbers of columns,
        and no two of them are the same unless somebody ``stated`` the columns."""
        if self._hashed:
            raise InputError(
                f"{self.path} line {self._hashed[0]} begins with #, but has as many columns as the rows; leave it out "
                "if it is a comment, else write its first cell without #."
            )
        self._check_end(picked)
        if measured:
            self._check_first(picked)
        table = np.stack([self._column(i) for i in picked], axis=1)
        if measured and not stated:
            self._check_twice(picked, table)
        return table

    def _column(self, index: int) -> np.ndarray:
        cells = [row[index] for row in self._rows]
        # Together where they are plain numbers: one by one they are most of the time that a large table takes.
        if set().union(*cells) <= _PLAIN | {self._decimal}:
            with contextlib.suppress(ValueError):
                values = np.array([float(cell) for cell in cells] if self._decimal == "." else
                                  [float(cell.replace(",", ".")) for cell in cells])  # fmt: skip
                if np.abs(values).max() <= _LARGEST:
                    return values
        return np.array([self._number(i, index, cell.strip(" \t")) for i, cell in enumerate(cells)])

    def _number(self, row: int, index: int, cell: str) -> float:
        place = f"{self.path} line {self._lines[row]} column {index + 1}: {quoted(cell)}"
        plain = cell
        if self._decimal == ",":
            if "." in cell:
                raise InputError(
                    f"{place} has a point, but the decimal mark is stated to be a comma; write numbers without "
                    'separators of thousands, or leave out decimal = ",".'
                )
            plain = cell.replace(",", ".")
        if not is_number(plain):
            advice = "write it without quotes" if cell[:1] in "\"'" and cell else "correct it"
            if _WITH_COMMA.fullmatch(cell):
                advice = 'write it with a decimal point, or add decimal = "," to its table in the manifest'
            elif re.fullmatch(r"[+-]?[0-9]{1,3}(?:[,.' \u00a0\u2009\u202f][0-9]{3})+(?:[.,][0-9]*)?", cell):
                advice = "write it without separators of thousands"
            elif row == 0 and advice == "correct it":
                advice = f"correct it, or add skip = {self._lines[0]} if the table begins after that line"
            raise InputError(f"{place} is not a number; {advice}.")
        value = number(plain)
        if not math.isfinite(value):
            raise InputError(f"{place} is not finite; correct it.")
        if abs(value) > _LARGEST:
            raise InputError(f"{place} is larger than anything that is measured; correct it.")
        return value

    def is_numeric(self, index: int) -> bool:
        """Whether a column begins and ends with a number, also with a decimal comma."""
        return all(is_number(row[index].strip(" \t").replace(",", ".", 1)) for row in (self._rows[0], self._rows[-1]))

    def ascends(self, index: int) -> bool:
        """Whether every number of a column is larger than the one before it, as those of times and indices are."""
        try:
            values = [float(row[index].replace(",", ".")) for row in self._rows]
        except ValueError:
            return False
        return len(values) > 1 and bool(np.all(np.diff(values) > 0))

    def texts(self, column: Column) -> np.ndarray:
        """The cells of one column."""
        (index,) = self.pick([column])
        self._hashed = self._hashed if index else []  # "#2" is a text
        return np.array([row[index].strip(" \t").strip("\"'") for row in self._rows])

    def _check_first(self, picked: Sequence[int]) -> None:
        """Refuse numbers of columns as the first row."""
        cells = [self._rows[0][i].strip(" \t") for i in picked]
        counted = [[str(i + first) for i in range(len(cells))] for first in (0, 1)]
        if len(cells) < 2 or (cells not in counted and cells[::-1] not in counted):
            return
        order = ", ".join(str(i + 1) for i in sorted(picked, key=lambda i: int(self._rows[0][i])))
        add = f"add skip = {self._lines[0]}" + (f" and columns = [{order}]" if cells not in counted else "")
        raise InputError(
            f"{self.path} line {self._lines[0]} is {cells[0]} to {cells[-1]}, which are numbers of columns; {add}, or "
            "write it with decimal points if it was measured."
        )

    def _check_end(self, picked: Sequence[int]) -> None:
        """Refuse a last number that is shorter than all others of its column, in a file whose last line has no end."""
        if self._ended or self.length < _FEW or self.width - 1 not in picked:
            return
        cells = [row[-1].strip(" \t").replace(self._decimal, ".") for row in self._rows]
        digits = [tuple(map(len, match.groups(""))) if (match := _DECIMALS.fullmatch(x)) else None for x in cells]
        if digits[-1] is not None and any(
            all(other is not None and last < other[part] for other in digits[:-1])
            for part, last in enumerate(digits[-1])
        ):
            raise InputError(
                f"{self.path} line {self._lines[-1]}: the last number, {quoted(cells[-1])}, has fewer digits than all "
                "above it and no end of the line after it, so the file may be cut; copy it again, or end that line if "
                "it is complete."
            )

    def _check_twice(self, picked: Sequence[int], table: np.ndarray) -> None:
        """Refuse a column that is there twice."""
        if self.length < _FEW:
            return
        for (i, one), (j, other) in itertools.combinations(zip(picked, table.T, strict=True), 2):
            if np.ptp(one) > 0 and np.array_equal(one, other):
                raise InputError(
                    f"{self.path} has the same numbers in columns {i + 1} and {j + 1}; give each column once, or add "
                    f"columns = [{', '.join(str(column + 1) for column in picked)}] if these are right."
                )

"""Text tables: comma, semicolon, tab or blank between columns, header lines allowed."""

import contextlib
import fnmatch
import itertools
import math
import os
import re
from collections.abc import Sequence

import numpy as np

from ..core.errors import InputError, nearest
from ..core.text import is_number, number, quoted, shorten
from .column_names import plain_name, stem_and_number, unit_in, with_units
from .text_lines import cells_of, delimiter_of, table_lines

_LARGEST = 1e15  # encoder counts reach 1e10; beyond it squares lose what is measured
_LIKE_A_NUMBER = re.compile(r"[\"']?\s*[+-]?[.,]?\d")  # digits of any script
_PLAIN = frozenset("0123456789+-eE \t")  # and the decimal mark: float takes these as people read them, or not at all
_WITH_COMMA = re.compile("[+-]?[0-9]*,[0-9]+")
_DECIMALS = re.compile(r"[+-]?[0-9]*(?:\.([0-9]*))?(?:[eE][+-]?([0-9]*))?")
_FEW = 3  # rows from which equal columns, or a shorter last number, are no coincidence
_LONG = 12  # columns, or characters of a name, that a message shows

Column = str | int


class TextTable:
    """A text table whose columns are picked by header name, shell pattern or number from 1; other columns may be text.

    A name that the header does not have exactly is compared without regard to case, blanks and a unit in brackets.
    A header is a line of words before the first row: none of them begins like a number.

    Args:
        path: The file.
        delimiter: What divides its columns; None finds it.
        decimal: The decimal mark of its numbers.
        skip: Lines before its header.

    Raises:
        InputError: The file is no text, or its rows differ in their number of columns.
    """

    def __init__(self, path: str | os.PathLike, *, delimiter: str | None = None, decimal: str = ".", skip: int = 0):
        self._path, self._decimal = path, decimal
        lines, self._ended = table_lines(path)
        if lines[skip : skip + 1] and (stated := re.fullmatch('"?sep=(.)"?', lines[skip])):  # of spreadsheets
            delimiter, skip = delimiter or stated[1], skip + 1
        self._delimiter = delimiter or delimiter_of(lines[skip:], decimal)
        self._rows: list[list[str]] = []
        self._lines: list[int] = []
        words: list[list[str]] = []
        comment = ""
        for line_number, line in enumerate(lines[skip:], start=skip + 1):
            if not line or line[0] in ' \t#"':
                text = line.strip(' \t"')
                if not text or text[0] == "#":
                    comment = text[1:] if text and not self._rows else comment
                    continue
            cells = cells_of(line, self._delimiter)
            if not cells[0] and not any(cell.strip() for cell in cells):
                continue
            if not self._rows and not any(_LIKE_A_NUMBER.match(cell) or is_number(cell) for cell in _stripped(cells)):
                words.append(_stripped(self._header_cells(line)))
                continue
            self._rows.append(cells)
            self._lines.append(line_number)
        if not self._rows:
            raise InputError(f"{path} holds no numbers; give one line a pose.")
        self._check_widths()
        self._leave_out_trailing(words)
        words = [_trimmed(cells, self.width) for cells in words]
        self._title = words[-1] if words else []  # a line of words that does not name the columns
        self._header = self._names(words, _trimmed(_stripped(self._header_cells(comment)), self.width))

    def _header_cells(self, line: str) -> list[str]:
        """The cells of a line of names; between blanks, a unit belongs to the name before it."""
        return cells_of(re.sub(r"[ \t]+(?=[\[(])", "", line) if self._delimiter == " " else line, self._delimiter)

    def _check_widths(self) -> None:
        if len(set(map(len, self._rows))) == 1:
            return
        width = len(self._rows[0])
        wrong = next(i for i, row in enumerate(self._rows) if len(row) != width)
        where = f"{self._path} line {self._lines[wrong]}"
        if wrong == len(self._rows) - 1 > 0 and not self._ended and len(self._rows[wrong]) < width:
            raise InputError(
                f"{where}, the last, ends after {len(self._rows[wrong])} of {width} columns, and without the end of a "
                "line, so the file is cut there; copy it again, or leave out that line."
            )
        earlier = wrong < _LONG and width < len(self._rows[wrong])
        skip = f", or add skip = {self._lines[wrong] - 1} if the table begins there" if earlier else ""
        raise InputError(
            f"{where} has {len(self._rows[wrong])} columns, the lines before it {width}; give all the same{skip}."
        )

    def _leave_out_trailing(self, words: list[list[str]]) -> None:
        """Columns at the end that are empty in all rows and without a name: lines that end with delimiters."""
        named = max((len(_trimmed(cells, 1)) for cells in words), default=0)
        while self.width > max(1, named) and not any(row[-1].strip() for row in self._rows):
            for row in self._rows:
                row.pop()

    def _names(self, words: list[list[str]], comment: list[str]) -> list[str]:
        """The names of the columns, perhaps with units from a line of their own; none where they are not named."""
        names: list[str] = []
        if words and len(words[-1]) == self.width:
            before = words[-2] if len(words) > 1 and len(words[-2]) == self.width else [""] * self.width
            names = with_units(before, words[-1]) or words[-1]
        elif not words and len(comment) == self.width and not any(map(_LIKE_A_NUMBER.match, comment)):
            names = comment
        return [name.strip("\"'") for name in names]

    @property
    def path(self) -> str | os.PathLike:
        """The file."""
        return self._path

    @property
    def header(self) -> list[str]:
        """Names of the columns; empty where the table has none."""
        return self._header

    @property
    def misnamed(self) -> bool:
        """Whether a line of several names is above the rows, but not one name for each column."""
        return not self._header and len(self._title) > 1

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self._rows[0])

    @property
    def length(self) -> int:
        """Number of rows."""
        return len(self._rows)

    def shown(self) -> str:
        """Its columns as a message shows them: names with their numbers."""
        if not self._header:
            others = f", but its header {len(self._title)} names" if self.misnamed else " without names"
            return f"{self.width} columns{others}"
        names = [f"{i} {quoted(name[:_LONG])}" for i, name in enumerate(self._header, start=1)]
        return f"the columns {shorten(names, _LONG)}"

    def has(self, wanted: Sequence[Column]) -> bool:
        """Whether these columns are there. Raises `InputError` where only some of them are."""
        missing = [column for column in wanted if not self._matching(column)]
        if missing and len(missing) < len(wanted):
            others = shorten([str(column) for column in wanted if column not in missing])
            raise InputError(
                f"{self._path} has no column {quoted(str(missing[0]))}, but columns {others}; correct its header, or "
                "pick the columns by number."
            )
        return not missing

    def _matching(self, column: Column) -> list[int]:
        if isinstance(column, int):
            return [column - 1] if 1 <= column <= self.width else []
        wanted, plain = plain_name(column), [plain_name(name) for name in self._header]
        # As it stands first: q[1] is also a pattern, of q1.
        for names, text in ((self._header, column), (plain, wanted)):
            same = [i for i, name in enumerate(names) if name == text]
            if same:
                return same
        exact = [i for i, name in enumerate(self._header) if fnmatch.fnmatchcase(name, column)]
        return exact or [i for i, name in enumerate(plain) if fnmatch.fnmatchcase(name, wanted)]

    def unit(self, picked: Sequence[int]) -> str | None:
        """The unit that the header states for columns, counted from 0, or None. Raises `InputError` for several."""
        stated = {self._header[i]: unit_in(self._header[i]) for i in picked if self._header}
        found = {unit: name for name, unit in stated.items() if unit is not None}
        if len(found) > 1:
            (one, first), (other, second), *_ = found.items()
            raise InputError(
                f"{self._path} mixes units: {quoted(first)} is in {one[:_LONG]}, {quoted(second)} in {other[:_LONG]}; "
                "convert one of them, and change its header."
            )
        return next(iter(found), None)

    def pick(self, wanted: Sequence[Column]) -> list[int]:
        """Indices of columns, a pattern in the order of the header. Raises `InputError` for one that is not there."""
        found: list[int] = []
        for column in wanted:
            indices = self._matching(column)
            if not indices:
                raise InputError(f"{self._path} has {self._missing(column)}")
            if len(indices) > 1 and isinstance(column, str) and plain_name(column) in map(plain_name, self._header):
                numbers = shorten([str(i + 1) for i in indices])
                raise InputError(
                    f"{self._path} names the columns {numbers} all {quoted(column)}; give each name once, or pick them "
                    "by number."
                )
            self.check_ascending(indices)
            found += indices
        if len(set(found)) < len(found):
            raise InputError(f"{self._path}: one column is picked twice by {shorten([str(x)[:99] for x in wanted])}.")
        return found

    def _missing(self, column: Column) -> str:
        if isinstance(column, int):
            return f"{self.width} columns, so there is no column {column}; pick others."
        if self._header:
            return f"no column {quoted(column)}{nearest(column, [quoted(name)[1:-1] for name in self._header[:999]])}"
        if self._title:
            return (
                f"no column {quoted(column)}: its header has {len(self._title)} names, but its rows {self.width} "
                "columns; correct the header, or give numbers (decimal commas need another delimiter)."
            )
        return f"no column {quoted(column)}; it has no header: give numbers."

    def check_ascending(self, picked: Sequence[int], line: str = "columns = [{}]") -> None:
        """Refuse columns whose names are numbered, but not in their order; ``line``: what states the order."""
        numbered = [stem_and_number(self._header[i]) for i in picked] if self._header else []
        found = [x for x in numbered if x is not None]
        if len(picked) < 2 or len(found) < len(picked) or len({stem.casefold() for stem, _ in found}) > 1:
            return
        numbers = [x for _, x in found]
        if len(set(numbers)) < len(numbers):
            twice = self._header[picked[next(i for i, x in enumerate(numbers) if numbers.count(x) > 1)]]
            raise InputError(f"{self._path} names the column {quoted(twice)} twice; give each column once.")
        if numbers != sorted(numbers):
            ordered = line.format(", ".join(str(picked[i] + 1) for i in np.argsort(numbers)))
            names = shorten([quoted(self._header[i][:_LONG]) for i in picked], _LONG)
            raise InputError(
                f"{self._path} has its columns in the order {names}; add {ordered} for that of their numbers, or the "
                "order of the joints."
            )

    def numbers(self, picked: Sequence[int], *, distinct: bool = False) -> np.ndarray:
        """The numbers of columns, counted from 0, ``(rows, columns)``; ``distinct``: no two of them are the same."""
        self._check_end(picked)
        if distinct:
            self._check_first(picked)
        table = np.stack([self._column(i) for i in picked], axis=1)
        if distinct:
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
        place = f"{self._path} line {self._lines[row]} column {index + 1}: {quoted(cell)}"
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
            f"{self._path} line {self._lines[0]} is {cells[0]} to {cells[-1]}, which are numbers of columns; {add}, or "
            "write it with decimal points if it was measured."
        )

    def _check_end(self, picked: Sequence[int]) -> None:
        """Refuse a last number that is shorter than all others of its column, in a file whose last line has no end."""
        if self._ended or self.length < _FEW or self.width - 1 not in picked:
            return
        cells = [row[-1].strip(" \t").replace(self._decimal, ".") for row in self._rows]
        digits = [tuple(map(len, found.groups(""))) if (found := _DECIMALS.fullmatch(x)) else None for x in cells]
        if digits[-1] is not None and any(
            all(other is not None and last < other[part] for other in digits[:-1])
            for part, last in enumerate(digits[-1])
        ):
            raise InputError(
                f"{self._path} line {self._lines[-1]}: the last number, {quoted(cells[-1])}, has fewer digits than all "
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
                    f"{self._path} has the same numbers in columns {i + 1} and {j + 1}; give each column once, or "
                    "pick them with columns = [...]."
                )


def _stripped(cells: list[str]) -> list[str]:
    return [cell.strip(" \t") for cell in cells]


def _trimmed(cells: list[str], least: int) -> list[str]:
    """Cells without the empty ones at their end."""
    while len(cells) > least and not cells[-1]:
        cells = cells[:-1]
    return cells

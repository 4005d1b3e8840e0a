"""Text tables: comma, semicolon, tab or blank between columns, header lines allowed."""

import fnmatch
import math
import os
import re
from collections.abc import Sequence

import numpy as np

from ..core.errors import InputError, nearest
from ..core.text import is_number, number, quoted, shorten
from .inputs import InputFile

_LARGEST = 1e15  # encoder counts reach 1e10; beyond it squares lose what is measured
_LIKE_A_NUMBER = re.compile(r"[\"']?\s*[+-]?[.,]?\d")  # digits of any script
# Units as header lines state them, after a name ("X [mm]", "X (mm)", "x_mm"), and those that cannot be converted.
_UNITS = {name: name for name in ("mm", "m", "um", "inch", "rad", "deg", "arcsec")} | {
    "\u00b5m": "um", "\u03bcm": "um", "in": "inch", "\u00b0": "deg",
}  # fmt: skip
_OTHER_UNITS = ("cm", "dm", "nm", "ft", "mil", "gon", "grad", "mrad", "counts")
_IN_BRACKETS = re.compile(r"\s*(?:\[([^\]]*)\]|\(([^)\d]*)\))\s*$")
_AFTER_NAME = re.compile("_(mm|um|inch|deg|rad|arcsec)$")  # "_m" may mean anything
_FEW = 3  # rows from which equal columns are no coincidence


def read_numbers(path: str | os.PathLike, columns: Sequence[int] | None = None) -> np.ndarray:
    """Read a text table of numbers, ``(rows, columns)``; separated by comma, semicolon, tab or blank, headers ignored.

    A header is a line of words before the first row: none of them begins like a number. ``columns`` picks columns,
    counted from 1. Raises `InputError` that names the file, the line and the column.
    """
    lines = _lines(path)
    rows: list[list[float]] = []
    for line_number, line in enumerate(lines, start=1):
        cells = _cells(line)
        if cells == [""] or cells[0].startswith("#"):
            continue
        where = f"{path} line {line_number}"
        if not rows and not any(_LIKE_A_NUMBER.match(cell) or is_number(cell) for cell in cells):
            _check_header(where, cells)
            continue
        rows.append([_number(where, column, cell) for column, cell in enumerate(cells, start=1)])
        if len(rows) == 1:
            _check_first(where, cells)
        if len(rows[-1]) != len(rows[0]):
            raise InputError(
                f"{where} has {len(rows[-1])} columns, the lines before it {len(rows[0])}; give all the same."
            )
    if not rows:
        raise InputError(f"{path} holds no numbers; give one line a pose, with decimal points.")
    table = np.array(rows)
    chosen = list(range(1, table.shape[1] + 1)) if columns is None else list(columns)
    for column in chosen:
        if not 1 <= column <= table.shape[1]:
            raise InputError(f"{path} has {table.shape[1]} columns, so there is no column {column}; pick others.")
    table = table[:, [column - 1 for column in chosen]]
    _check_columns(path, table, chosen)
    return table


Column = str | int


class TextTable:
    """A text table whose columns are picked by header name, shell pattern or number from 1; other columns may be text.

    A name that the header does not have exactly is compared without regard to case, blanks and a unit in brackets.

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
        self._header: list[str] = []
        self._rows: list[tuple[str, list[str]]] = []
        for line_number, line in enumerate(_lines(path)[skip:], start=skip + 1):
            cells, where = _cells(line, delimiter, decimal), f"{path} line {line_number}"
            if cells == [""] or cells[0].startswith("#"):
                continue
            if not self._rows and not any(_LIKE_A_NUMBER.match(cell) or is_number(cell) for cell in cells):
                only_units = len(cells) == len(self._header) and all(_is_unit(cell) for cell in cells)
                self._header = (
                    [f"{a} [{_unit(b)}]" for a, b in zip(self._header, cells, strict=True)] if only_units else cells
                )
                continue
            if self._rows and len(cells) != len(self._rows[0][1]):
                count = len(self._rows[0][1])
                raise InputError(f"{where} has {len(cells)} columns, the lines before it {count}; give all the same.")
            self._rows.append((where, cells))
        if not self._rows:
            raise InputError(f"{path} holds no numbers; give one line a pose.")
        self._title = self._header  # a line of words that does not name the columns
        if len(self._header) != len(self._rows[0][1]):
            self._header = []

    @property
    def path(self) -> str | os.PathLike:
        """The file."""
        return self._path

    @property
    def header(self) -> list[str]:
        """Names of the columns; empty where the table has none."""
        return [name.strip("\"'") for name in self._header]

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self._rows[0][1])

    @property
    def length(self) -> int:
        """Number of rows."""
        return len(self._rows)

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
            return [column - 1] if 1 <= column <= len(self._rows[0][1]) else []
        if column in self._header:
            return [self._header.index(column)]
        exact = [i for i, name in enumerate(self._header) if fnmatch.fnmatchcase(name, column)]
        wanted = _plain_name(column)
        return exact or [i for i, name in enumerate(self._header) if fnmatch.fnmatchcase(_plain_name(name), wanted)]

    def unit(self, wanted: Sequence[Column]) -> str | None:
        """The unit that the header states for these columns, or None. Raises `InputError` for more than one."""
        stated = {self._header[i]: _stated_unit(self._header[i]) for i in self.pick(wanted) if self._header}
        found = {unit: name for name, unit in stated.items() if unit is not None}
        if len(found) > 1:
            (one, first), (other, second), *_ = found.items()
            raise InputError(
                f"{self._path} mixes units: {quoted(first)} is in {one}, {quoted(second)} in {other}; convert one of "
                "them, and change its header."
            )
        return next(iter(found), None)

    def pick(self, wanted: Sequence[Column]) -> list[int]:
        """Indices of columns, a pattern in the order of the header. Raises `InputError` for one that is not there."""
        found: list[int] = []
        for column in wanted:
            indices = self._matching(column)
            if not indices and isinstance(column, int):
                raise InputError(f"{self._path} has {len(self._rows[0][1])} columns, so there is no column {column}.")
            if not indices and isinstance(column, str):
                known = "; it has no header: give numbers."
                if self._header:
                    known = nearest(column, self._header)
                elif self._title:
                    known = (
                        f": its header has {len(self._title)} names, but its rows {len(self._rows[0][1])} columns; "
                        "correct the header, or give numbers."
                    )
                raise InputError(f"{self._path} has no column {quoted(column)}{known}")
            found += indices
        if len(set(found)) < len(found):
            raise InputError(f"{self._path}: one column is picked twice by {shorten([str(x) for x in wanted])}.")
        return found

    def numbers(self, wanted: Sequence[Column]) -> np.ndarray:
        """The numbers of columns, ``(rows, columns)``."""
        picked = self.pick(wanted)
        return np.array([[self._number(where, i, cells[i]) for i in picked] for where, cells in self._rows])

    def _number(self, where: str, index: int, cell: str) -> float:
        if self._decimal == "," and "." not in cell:
            cell = cell.replace(",", ".")
        advice = 'write it with a decimal point, or state decimal = "," and the delimiter in the manifest'
        return _number(where, index + 1, cell, advice)

    def texts(self, column: Column) -> np.ndarray:
        """The cells of one column."""
        (index,) = self.pick([column])
        return np.array([cells[index].strip("\"'") for _, cells in self._rows])


def _unit(cell: str) -> str:
    """What is inside the brackets, if there are any."""
    found = _IN_BRACKETS.fullmatch(cell)
    return ((found[1] or found[2] or "") if found else cell).strip().casefold()


def _is_unit(cell: str) -> bool:
    """Whether a cell of a header is a unit, or empty."""
    return _unit(cell) in (*_UNITS, *_OTHER_UNITS, "")


def _stated_unit(header: str) -> str | None:
    """The unit in a column's header, or None where it states none."""
    name = header.strip("\"'").casefold()
    bracketed, after = _IN_BRACKETS.search(name), _AFTER_NAME.search(name)
    unit = _unit(bracketed[0]) if bracketed else after[1] if after else ""
    return _UNITS.get(unit, unit if unit in _OTHER_UNITS else None)


def _plain_name(name: str) -> str:
    """A column's name, or a pattern, without case, quotes, unit in brackets and more than single blanks."""
    name = name.strip("\"'")
    bracketed = _IN_BRACKETS.search(name)
    if bracketed and _is_unit(bracketed[0].strip()):  # and not the characters of a pattern
        name = name[: bracketed.start()]
    return " ".join(name.casefold().split())


def _lines(path: str | os.PathLike) -> list[str]:
    try:
        return InputFile(path).text.split("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} cannot be read as text; give a text file of numbers, in UTF-8.") from error


def _cells(line: str, delimiter: str | None = None, decimal: str = ".") -> list[str]:
    if delimiter is None:
        known = (";", "\t") if decimal == "," else (";", ",", "\t")
        delimiter = next((one for one in known if one in line), None)
    elif delimiter == " ":
        delimiter = None
    cells = re.split("[ \t]+", line.strip(" \t")) if delimiter is None else line.split(delimiter)
    return [cell.strip(" \t") for cell in cells]


def _number(where: str, column: int, cell: str, advice_on_comma: str = "write it with a decimal point") -> float:
    place = f"{where} column {column}: {quoted(cell)}"
    if not is_number(cell):
        advice = "write it without quotes" if cell[:1] in "\"'" and cell else "correct it"
        if re.fullmatch("[+-]?[0-9]*,[0-9]+", cell):
            advice = advice_on_comma
        raise InputError(f"{place} is not a number; {advice}.")
    value = number(cell)
    if not math.isfinite(value):
        raise InputError(f"{place} is not finite; correct it.")
    if abs(value) > _LARGEST:
        raise InputError(f"{place} is larger than anything that is measured; correct it.")
    return value


def _check_header(where: str, cells: list[str]) -> None:
    """Refuse two columns of one name, where names are numbered."""
    for cell in cells:
        if re.search("[0-9]", cell) and cells.count(cell) > 1:
            raise InputError(f"{where} names the column {quoted(cell)} twice; give each column once.")


def _check_first(where: str, cells: list[str]) -> None:
    """Refuse numbers of columns as the first row."""
    counted = [[str(i + first) for i in range(len(cells))] for first in (0, 1)]
    if len(cells) > 1 and cells in counted:
        raise InputError(
            f"{where} is {cells[0]} to {cells[-1]}, which are numbers of columns; put # before it, or write it with "
            "decimal points if it was measured."
        )


def _check_columns(path: str | os.PathLike, table: np.ndarray, chosen: list[int]) -> None:
    """Refuse a column that is there twice."""
    if table.shape[0] < _FEW:
        return
    seen: dict[bytes, int] = {}
    for column, values in zip(chosen, table.T, strict=True):
        if np.ptp(values) > 0:
            twin = seen.setdefault(values.tobytes(), column)
            if twin != column:
                raise InputError(
                    f"{path} has the same numbers in columns {twin} and {column}; give each column once, or pick them "
                    "with columns = [...]."
                )

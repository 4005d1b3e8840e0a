"""Text tables of numbers: comma, semicolon, tab or blank between columns, header lines allowed."""

import math
import os
import re
from collections.abc import Sequence

import numpy as np

from ..core.errors import InputError
from ..core.text import is_number, number, quoted
from .inputs import InputFile

_LARGEST = 1e15  # encoder counts reach 1e10; beyond it squares lose what is measured
_LIKE_A_NUMBER = re.compile(r"[\"']?\s*[+-]?[.,]?\d")  # digits of any script
_FEW = 3  # rows from which equal columns are no coincidence


def read_numbers(path: str | os.PathLike, columns: Sequence[int] | None = None) -> np.ndarray:
    """Read a text table of numbers, ``(rows, columns)``; separated by comma, semicolon, tab or blank, headers ignored.

    A header is a line of words before the first row: none of them begins like a number. ``columns`` picks columns,
    counted from 1. Raises `InputError` that names the file, the line and the column.
    """
    try:
        lines = InputFile(path).text.split("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} cannot be read as text; give a text file of numbers, in UTF-8.") from error
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


def _cells(line: str) -> list[str]:
    delimiter = next((delimiter for delimiter in (";", ",", "\t") if delimiter in line), None)
    cells = re.split("[ \t]+", line.strip(" \t")) if delimiter is None else line.split(delimiter)
    return [cell.strip(" \t") for cell in cells]


def _number(where: str, column: int, cell: str) -> float:
    place = f"{where} column {column}: {quoted(cell)}"
    if not is_number(cell):
        advice = "write it without quotes" if cell[:1] in "\"'" and cell else "correct it"
        if re.fullmatch("[+-]?[0-9]*,[0-9]+", cell):
            advice = "write it with a decimal point"
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

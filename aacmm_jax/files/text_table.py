"""Text tables of numbers: comma, semicolon, tab or blank between columns, header lines allowed."""

import csv
import math
import os
from collections.abc import Sequence

import numpy as np

from ..core.errors import InputError
from .inputs import InputFile


def read_numbers(path: str | os.PathLike, columns: Sequence[int] | None = None) -> np.ndarray:
    """Read a text table of numbers, ``(rows, columns)``; separated by comma, semicolon, tab or blank, headers ignored.

    ``columns`` picks columns, counted from 1. Raises `InputError` that names the file, the line and the column.
    """
    try:
        lines = InputFile(path).text.splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path} cannot be read as text; give a text file of numbers, in UTF-8.") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        cells = _cells(line)
        if not cells or cells[0].startswith("#"):
            continue
        try:
            rows.append([_number(cell) for cell in cells])
        except ValueError as error:
            if not rows and not any(_is_number(cell) for cell in cells):
                continue  # a header
            column = next(i for i, cell in enumerate(cells, start=1) if not _is_number(cell))
            raise InputError(
                f"{path} line {number} column {column}: '{cells[column - 1]}' is not a number; correct it."
            ) from error
        if len(rows[-1]) != len(rows[0]):
            raise InputError(
                f"{path} line {number} has {len(rows[-1])} columns, the lines before it {len(rows[0])}; "
                "give all the same."
            )
        for column, value in enumerate(rows[-1], start=1):
            if not math.isfinite(value):
                raise InputError(
                    f"{path} line {number} column {column}: '{cells[column - 1]}' is not finite; correct it."
                )
    if not rows:
        raise InputError(f"{path} holds no numbers; give one line a pose, with decimal points.")
    table = np.array(rows)
    if columns is None:
        return table
    for column in columns:
        if not 1 <= column <= table.shape[1]:
            raise InputError(f"{path} has {table.shape[1]} columns, so there is no column {column}; pick others.")
    return table[:, [column - 1 for column in columns]]


def _cells(line: str) -> list[str]:
    for delimiter in (";", ",", "\t"):
        if delimiter in line:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]
    return line.split()


def _number(cell: str) -> float:
    if "_" in cell:
        raise ValueError  # Python takes 1_0 for 10
    return float(cell)


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True

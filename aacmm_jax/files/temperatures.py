"""Temperatures beside joint readings, in text tables and HDF5 files: a column, or variable, of their own."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from .hdf5 import Variable, numbering
from .inputs import InputFile
from .text_table import TextTable, read_numbers

TEMPERATURE = "temperature_C"


def reading_variables(
    name: str, readings: Float[np.ndarray, "N n"], joints: int, unit: str, rows: str = "pose"
) -> dict[str, Variable]:
    """Readings as variables: those of the joints, and the temperature that may follow them."""
    variables = numbering(rows, len(readings)) | numbering("joint", joints)
    variables[name] = Variable((rows, "joint"), readings[:, :joints], unit, "joint reading")
    if readings.shape[1] > joints:
        variables["temperature"] = Variable((rows,), readings[:, joints], "degC", "temperature of the arm")
    return variables


def readings_of(table: Mapping[str, np.ndarray], name: str) -> Float[np.ndarray, "N n"]:
    """The readings that `reading_variables` wrote, with the temperature last where there is one."""
    temperature = table.get("temperature")
    return table[name] if temperature is None else np.concatenate([table[name], temperature[:, None]], axis=1)


def numbers_and_temperature(
    file: InputFile, columns: Sequence[int] | None
) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, " N"] | None]:
    """Columns of a text table of numbers, from 1, by default all but that whose header is temperature_C; and this one,
    None where there is none."""
    table = TextTable(file) if TEMPERATURE.encode() in file.content else None
    if table is None or not table.has([TEMPERATURE]):
        return read_numbers(file, columns), None
    own = table.pick([TEMPERATURE])[0] + 1
    if columns is not None and own in columns:
        raise InputError(f"{file} column {own} is {TEMPERATURE}, no joint reading; leave it out of angles.columns.")
    chosen = [column for column in range(1, table.width + 1) if column != own] if columns is None else list(columns)
    return read_numbers(file, chosen), read_numbers(file, [own])[:, 0]


def with_temperature(
    q: Float[np.ndarray, "N n"], column: Float[np.ndarray, " N"] | None, stated: float | None, where: str
) -> Float[np.ndarray, "N m"]:
    """Readings with the temperature as a last column: of a table, or stated once for all; as they are without either.

    Raises:
        InputError: Both are given.
    """
    if column is not None and stated is not None:
        raise InputError(f"{where} has a column {TEMPERATURE}, and {TEMPERATURE} is stated besides; give one of them.")
    if stated is not None:
        column = np.full(len(q), float(stated))
    return q if column is None else np.concatenate([q, column[:, None]], axis=1)


def with_or_without_temperature(
    read: Callable[[Path, float | None], Float[np.ndarray, "N m"]],
) -> Callable[[Path, float | None], Float[np.ndarray, "N m"]]:
    """``read``, which refuses a file without temperatures after one with them, and the reverse."""
    earlier: list[tuple[int, Path]] = []

    def checked(file: Path, stated: float | None) -> Float[np.ndarray, "N m"]:
        readings = read(file, stated)
        earlier.append((readings.shape[1], file))
        (fewer, without), (more, other) = sorted((earlier[0], earlier[-1]))
        if fewer != more:
            raise InputError(
                f"{without} has no temperatures, but {other} has; give it a column {TEMPERATURE}, or state "
                f"{TEMPERATURE} in its table."
            )
        return readings

    return checked

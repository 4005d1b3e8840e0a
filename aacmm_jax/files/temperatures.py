"""Temperatures beside joint readings, in text tables and HDF5 files: a column, or variable, of their own."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from .hdf5 import Variable

TEMPERATURE = "temperature_C"


def reading_variables(
    name: str, readings: Float[np.ndarray, "N n"], joints: int, unit: str, rows: str = "pose"
) -> dict[str, Variable]:
    """Readings as variables: those of the joints, and the temperature that may follow them."""
    variables = {name: Variable((rows, "joint"), readings[:, :joints], unit, "joint reading")}
    if readings.shape[1] > joints:
        variables["temperature"] = Variable((rows,), readings[:, joints], "degC", "temperature of the arm")
    return variables


def readings_of(table: Mapping[str, np.ndarray], name: str) -> Float[np.ndarray, "N n"]:
    """The readings that `reading_variables` wrote, with the temperature last where there is one."""
    temperature = table.get("temperature")
    return table[name] if temperature is None else np.concatenate([table[name], temperature[:, None]], axis=1)


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

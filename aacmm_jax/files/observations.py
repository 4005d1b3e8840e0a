"""Observations in HDF5: one table each, of the entries that its kind declares; nothing here depends on a kind."""

import os
from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..data.observations.declared import Entry
from ..data.observations.observation import AbstractObservation, kinds
from .hdf5 import Stored, StoredTable, Table, Variable
from .records import Field, attribute_name, table_of

_PREFIX = "observation_"


def observation_tables(observations: Iterable[AbstractObservation], joints: int, unit: str = "rad") -> dict[str, Table]:
    """A table for each observation: arrays over its poses, and single values as attributes with the unit in the name.

    They are named by number, since names of observations may hold what names of groups may not. ``unit`` is that of
    readings, of so many joints.
    """
    return {f"{_PREFIX}{number}": _table(one, joints, unit) for number, one in enumerate(observations, start=1)}


def _table(observation: AbstractObservation, joints: int, unit: str) -> Table:
    stored = observation.stored()
    q = stored.pop("q", None)
    fields = {entry.name: _field(entry) for entry in observation.entries if entry.name in stored}
    table = table_of(SimpleNamespace(**stored), fields)
    readings = {} if q is None else reading_variables("q", np.asarray(q), joints, unit)
    attributes = {"kind": observation.kind, "name": observation.name} | dict(table.attributes)
    return Table(readings | table.variables, attributes)


def _field(entry: Entry) -> Field:
    content: Any = "number" if entry.content == "points" else entry.content
    return Field(entry.says, entry.unit, entry.dimensions, content)


def observations_of(path: str | os.PathLike, stored: Stored) -> list[AbstractObservation]:
    """The observations that a file holds, checked as when they were made. Raises `InputError`."""
    numbers = sorted(int(name.removeprefix(_PREFIX)) for name in stored.tables if name.startswith(_PREFIX))
    tables = [f"{_PREFIX}{number}" for number in numbers]
    return [_observation(path, stored.tables[name]) for name in tables]


def _observation(path: str | os.PathLike, table: StoredTable) -> AbstractObservation:
    attributes = table.attributes
    kind = kinds().get(attributes["kind"])
    if kind is None:
        raise InputError(
            f"{path} holds an observation of the unknown kind '{attributes['kind']}'; update aacmm_jax, or make the "
            "file again."
        )
    values: dict[str, Any] = {}
    for entry in kind.entries:
        name = entry.name if entry.dimensions else attribute_name(entry.name, _field(entry))
        source = table if entry.dimensions else attributes
        if entry.name == "q" and name in table:
            values[name] = readings_of(table, name)
        elif entry.required or name in source:
            value = source[name]
            values[entry.name] = value.astype(str) if entry.dimensions and entry.content == "text" else value
    return kind.rebuilt(attributes["name"], values)


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

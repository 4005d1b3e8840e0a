"""Observations in HDF5: one table each, of the entries that its kind declares; nothing here depends on a kind."""

import os
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..data.observations.observation import AbstractObservation, kinds
from .hdf5 import Stored, StoredTable, Table, Variable
from .temperatures import reading_variables, readings_of

_PREFIX = "observation_"


def observation_tables(observations: Iterable[AbstractObservation], joints: int, unit: str = "rad") -> dict[str, Table]:
    """A table for each observation: arrays over its poses, and single values as attributes with the unit in the name.

    They are named by number, since names of observations may hold what names of groups may not. ``unit`` is that of
    readings, of so many joints.
    """
    return {f"{_PREFIX}{number}": _table(one, joints, unit) for number, one in enumerate(observations, start=1)}


def _table(observation: AbstractObservation, joints: int, unit: str) -> Table:
    variables: dict[str, Variable] = {}
    attributes: dict[str, Any] = {"kind": observation.kind, "name": observation.name}
    stored = observation.stored()
    for entry in observation.entries:
        if entry.name not in stored:
            continue
        value = np.asarray(stored[entry.name])
        if not entry.dimensions:
            attributes[_attribute(entry.name, entry.unit)] = value.item()
            continue
        if entry.name == "q":
            variables |= reading_variables(entry.name, value, joints, unit)
            continue
        variables[entry.name] = Variable(entry.dimensions, value, entry.unit, entry.says)
    return Table(variables, attributes)


def _attribute(name: str, unit: str) -> str:
    return f"{name}_{unit}" if unit else name


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
        source, name = (table, entry.name) if entry.dimensions else (attributes, _attribute(entry.name, entry.unit))
        if entry.name == "q" and entry.name in table:
            values[entry.name] = readings_of(table, entry.name)
        elif entry.required or name in source:
            value = source[name]
            values[entry.name] = value.astype(str) if entry.dimensions and entry.content == "text" else value
    return kind.rebuilt(attributes["name"], values)

"""Joint readings and points in the text tables of a manifest, in mm and rad: their columns, units and temperatures."""

import os
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.text import quoted
from ..core.units import ANGLE_UNITS, LENGTH_UNITS
from ..data.capture import check_revolutions
from ..kinematics.arm import Arm
from .manifest_files import as_list
from .manifest_tables import Angles, PointsTable
from .table_columns import LINE, TEMPERATURE, TORQUE, header_units, position_columns, proposed_columns, reading_columns
from .text_lines import Column
from .text_table import TextTable


class Wanted(NamedTuple):
    """What the manifest states of the readings, or points, in a table."""

    columns: Sequence[Column] | None = None
    unit: str | None = None
    usual_unit: str | None = None  # of the preset, where neither the manifest nor the header states one
    taken: Sequence[int] = ()  # columns, from 0, that hold something else
    temperature: float | None = None


def checked_unit(
    where: object, what: str, header: str | None, stated: str | None, usual: str | None, units: Iterable[str]
) -> str | None:
    """The unit that the manifest states, or the header, or the preset. Raises `InputError` where the first two differ,
    or it is none of ``units``."""
    if header is not None and stated not in (None, header):
        raise InputError(
            f"{where}: the header of the {what} says {quoted(header)[1:-1]}, but the manifest says {stated}; correct "
            "one of the two."
        )
    unit = stated or header or usual
    if unit is not None and unit not in units:
        raise InputError(f"{where}: the {what} are in {quoted(unit)}; use one of {', '.join(units)}.")
    return unit


class Readings:
    """Joint readings of tables, in rad and mm, with the joints' torques, N m, and the arm's temperature as last columns
    where there are such.

    Raises `InputError` where columns are missing or not clear, units are missing or differ, or one table has torques or
    temperatures and another not.
    """

    def __init__(self, arm: Arm, angles: Angles | None):
        self._arm, self._angles = arm, angles
        self._first: tuple[int, str | os.PathLike] | None = None  # columns of readings of the first table, and its file
        self.columns: list[int] = []  # of the joints in the first table, from 1
        self.header: list[str] = []  # of the first table
        self.angles: Angles | None = None  # with which the first table was read, its header and units considered

    def __call__(self, text: TextTable, wanted: Wanted) -> Float[np.ndarray, "N n"]:
        """The readings of one table."""
        stated = wanted.columns
        if stated is None and self._angles is not None and self._angles.columns is not None:
            stated = as_list(self._angles.columns)
        of_torques = self._torques(text)
        picked = reading_columns(text, self._arm.joints, [*wanted.taken, *of_torques], stated)
        thermometer = text.pick([TEMPERATURE]) if text.has([TEMPERATURE]) else []
        if set(thermometer) & set(picked):
            raise InputError(
                f"{text.path} column {thermometer[0] + 1} is {TEMPERATURE}, not a joint reading; remove this column "
                "from the key columns."
            )
        numbers = text.numbers(picked, measured=True, stated=stated is not None)
        angles = self._angles_of(text, picked, wanted)
        q = angles.converted(numbers, self._arm)
        if of_torques:
            q = np.concatenate([q, text.numbers(of_torques)], axis=1)
        check_revolutions(str(text.path), q, self._arm, 'correct the header, or write unit = "deg" in [angles]')
        temperature = text.numbers(thermometer)[:, 0] if thermometer else None
        readings = with_temperature(q, temperature, wanted.temperature, str(text.path))
        if self._first is None:
            self._first, self.columns = (readings.shape[1], text.path), [i + 1 for i in picked]
            self.header, self.angles = list(text.header), angles
        if self._first[0] != readings.shape[1]:
            (less, without), (more, other) = sorted(
                (self._first, (readings.shape[1], text.path)), key=lambda table: table[0]
            )
            what, column = ("torques", TORQUE.format("1")) if more - less > 1 else ("temperatures", TEMPERATURE)
            add = f"add columns {column}, ... to {without}."
            if column == TEMPERATURE:
                add = f"add a column {TEMPERATURE} to {without}, or state {TEMPERATURE} in its table."
            raise InputError(f"{without} has no {what}, but {other} has {what}; {add}")
        return readings

    def _torques(self, text: TextTable) -> list[int]:
        """The columns of the joints' torques: those that the manifest names, or that have the usual names."""
        joints, stated = self._arm.joints, None if self._angles is None else self._angles.torques
        names = [TORQUE.format(joint) for joint in range(1, joints + 1)] if stated is None else as_list(stated)
        if joints == 1 or (stated is None and not text.has(names)):
            return []
        picked = text.pick(names)
        if len(picked) != joints:
            raise InputError(
                f"{text.path} has {len(picked)} columns of torques, but the arm has {joints} joints; pick one per "
                "joint with torques in [angles]."
            )
        return picked

    def _angles_of(self, text: TextTable, picked: Sequence[int], wanted: Wanted) -> Angles:
        """How these readings are written: what the table states comes first, then [angles], the header, the preset.

        What the manifest states must not contradict the header.
        """
        angles = self._angles
        unit = wanted.unit or (None if angles is None else angles.unit)
        angular, linear = header_units(text, picked, self._arm, unit)
        if angular == "counts" and unit is None:
            raise InputError(
                f'{text.path} has readings in counts; add [angles] with unit = "counts" and counts_per_turn = [...].'
            )
        possible = (*ANGLE_UNITS, "counts") if angles is not None and angles.unit == "counts" else ANGLE_UNITS
        unit = checked_unit(text.path, "readings", angular, unit, wanted.usual_unit, possible)
        if unit is None:
            raise InputError(
                "'angles' is missing, so the unit of the readings is not known; add [angles] with unit = "
                '"deg" or "rad", or state the unit in the header of the table, for example J1 [deg].'
            )
        stated = {} if angles is None else angles.model_dump(exclude_unset=True)
        if angles is None or unit != angles.unit:
            stated.pop("counts_per_turn", None)
        if linear is not None:
            units = (*LENGTH_UNITS, "counts")
            checked_unit(text.path, "prismatic joints", linear, stated.setdefault("linear_unit", linear), None, units)
        if linear == "counts" and "counts_per_mm" not in stated:
            raise InputError(
                f'{text.path} has readings in counts; add linear_unit = "counts" and counts_per_mm = [...].'
            )
        return Angles(**{**stated, "unit": unit})


def with_temperature(
    q: Float[np.ndarray, "N n"], column: Float[np.ndarray, " N"] | None, stated: float | None, where: str
) -> Float[np.ndarray, "N m"]:
    """Readings with the temperature as a last column: of a table, or stated once for all, but not both; as they are
    without either."""
    if column is not None and stated is not None:
        raise InputError(
            f"{where} has a column {TEMPERATURE}, but the manifest also states {TEMPERATURE}; give only one of the two."
        )
    if stated is not None:
        column = np.full(len(q), float(stated))
    return q if column is None else np.concatenate([q, column[:, None]], axis=1)


def points_of(text: TextTable, wanted: Wanted, points: PointsTable) -> Float[np.ndarray, "N 3"]:
    """The points of a table, mm."""
    columns = wanted.columns
    if columns is None and points.columns is not None:
        columns = as_list(points.columns)
    named = position_columns(text) if columns is None else None
    if columns is not None:
        picked = text.pick(columns)
    elif named is not None:
        picked = named[0]
    else:
        picked = [i for i in range(text.width) if i not in wanted.taken]
        text.check_ascending(picked)
    if len(picked) != 3:
        line = LINE.format(", ".join(str(i + 1) for i in proposed_columns(text, 3, wanted.taken)) or "...")
        raise InputError(
            f"{text.path} has {text.shown()}, but it is not clear which columns are x, y and z; add {line} with these "
            "three columns."
        )
    header = text.unit(picked, key="points") if named is None else named[1]
    unit = checked_unit(text.path, "points", header, wanted.unit or points.unit, wanted.usual_unit, LENGTH_UNITS)
    if unit is None:
        raise InputError(f'{text.path} does not state the unit of its points; add unit = "mm" to [points].')
    return text.numbers(picked, measured=True, stated=columns is not None) * LENGTH_UNITS[unit]

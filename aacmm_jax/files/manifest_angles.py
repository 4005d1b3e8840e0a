"""The table ``[angles]`` of a manifest: how joint readings are written; and readings from tables, in rad and mm."""

import math
import os
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat, model_validator

from ..core.errors import InputError
from ..core.text import quoted
from ..core.units import ANGLE_UNITS, LENGTH_UNITS
from ..data.capture_data import check_revolutions
from ..kinematics.arm import Arm, by_joint
from .manifest_tables import Picked, Wanted, as_list, checked_unit
from .table_columns import TEMPERATURE, reading_columns
from .text_table import TextTable
from .toml import Strict

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_ByJoint = _Positive | Annotated[list[_Positive], Field(min_length=1)]


class Angles(Strict):
    """How every column of readings is turned into rad, or mm of a prismatic joint."""

    unit: Literal["rad", "deg", "arcsec", "gon", "mrad", "counts"]
    counts_per_turn: _ByJoint | None = None
    sign: Literal[1, -1] | list[Literal[1, -1]] = 1
    offset: FiniteFloat | list[FiniteFloat] = 0.0
    columns: Picked | None = None
    linear_unit: Literal["mm", "m", "um", "inch", "counts"] = "mm"  # of prismatic joints
    counts_per_mm: _ByJoint | None = None

    @model_validator(mode="after")
    def _counts(self) -> "Angles":
        if (self.unit == "counts") != (self.counts_per_turn is not None):
            raise ValueError("give counts_per_turn with unit = 'counts', and only with it.")
        if (self.linear_unit == "counts") != (self.counts_per_mm is not None):
            raise ValueError("give counts_per_mm with linear_unit = 'counts', and only with it.")
        return self

    def converted(self, readings: Float[np.ndarray, "N n"], arm: Arm) -> Float[np.ndarray, "N n"]:
        """Readings in rad, and in mm of prismatic joints."""

        def numbers(key: str) -> np.ndarray:
            array = np.asarray(getattr(self, key), dtype=float)
            if array.ndim and array.shape != (arm.joints,):
                raise InputError(
                    f"angles.{key} has {array.size} values, but there are {arm.joints} joints; give one, or one a "
                    "joint."
                )
            return array

        angular = 2 * math.pi / numbers("counts_per_turn") if self.counts_per_turn else ANGLE_UNITS[self.unit]
        linear = 1 / numbers("counts_per_mm") if self.counts_per_mm else LENGTH_UNITS[self.linear_unit]
        units = np.where(by_joint(arm, False, True), linear, angular)
        return numbers("sign") * (readings - numbers("offset")) * units


def header_units(text: TextTable, picked: Sequence[int], arm: Arm, stated: str | None) -> tuple[str | None, str | None]:
    """The units that the header states for readings of revolute and of prismatic joints, or None; ``stated``: that of
    the former in the manifest.

    Raises:
        InputError: It states units of something else.
    """
    slides = [picked[i - 1] for i in arm.prismatic]
    turns = [i for i in picked if i not in slides]
    kinds = (("revolute", turns, ANGLE_UNITS, stated), ("prismatic", slides, LENGTH_UNITS, None))
    units = []
    for joints, columns, known, stated_unit in kinds:
        unit = text.unit(columns, stated_unit)
        if unit not in (None, "counts", *known):
            raise InputError(
                f"{text.path} states {quoted(unit)} for readings of {joints} joints "
                f"({quoted(text.header[columns[0]])}), but these are in {', '.join(known)} or counts; pick their "
                "columns with columns = [...], or correct the header."
            )
        units.append(unit)
    return units[0], units[1]


class Readings:
    """Joint readings of tables, in rad and mm, with the arm's temperature as a last column where there is one.

    Args:
        arm: The arm.
        angles: The table ``[angles]``, if there is one.

    Raises:
        InputError: Columns are missing or not clear, units are missing or differ, or one table has temperatures and
            another not.
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
        picked = reading_columns(text, self._arm.joints, wanted.taken, stated)
        thermometer = text.pick([TEMPERATURE]) if text.has([TEMPERATURE]) else []
        if set(thermometer) & set(picked):
            raise InputError(
                f"{text.path} column {thermometer[0] + 1} is {TEMPERATURE}, not a joint reading; leave it out of "
                "columns."
            )
        numbers = text.numbers(picked, measured=True, stated=stated is not None)
        angles = self._angles_of(text, picked, wanted)
        q = angles.converted(numbers, self._arm)
        check_revolutions(str(text.path), q, self._arm, 'correct the header, or write unit = "deg" in [angles]')
        temperature = text.numbers(thermometer)[:, 0] if thermometer else None
        readings = with_temperature(q, temperature, wanted.temperature, str(text.path))
        self._first = self._first or (readings.shape[1], text.path)
        self.columns, self.angles = self.columns or [i + 1 for i in picked], self.angles or angles
        self.header = self.header or list(text.header)
        if self._first[0] != readings.shape[1]:
            (_, without), (_, other) = sorted((self._first, (readings.shape[1], text.path)), key=lambda table: table[0])
            raise InputError(
                f"{without} has no temperatures, but {other} has; give it a column {TEMPERATURE}, or state "
                f"{TEMPERATURE} in its table."
            )
        return readings

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
        known = (*ANGLE_UNITS, "counts") if angles is not None and angles.unit == "counts" else ANGLE_UNITS
        unit = checked_unit(text.path, "readings", angular, unit, wanted.usual_unit, known)
        if unit is None:
            raise InputError(
                "'angles' is missing, so that the unit of the readings is not known; add [angles] with unit = \"deg\" "
                'or "rad", or state it in the header of the table, as J1 [deg].'
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
    """Readings with the temperature as a last column: of a table, or stated once for all; as they are without either.

    Raises:
        InputError: Both are given.
    """
    if column is not None and stated is not None:
        raise InputError(f"{where} has a column {TEMPERATURE}, and {TEMPERATURE} is stated besides; give one of them.")
    if stated is not None:
        column = np.full(len(q), float(stated))
    return q if column is None else np.concatenate([q, column[:, None]], axis=1)

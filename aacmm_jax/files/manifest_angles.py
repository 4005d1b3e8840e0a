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
from ..data.capture import check_revolutions
from ..kinematics.arm import Arm, by_joint
from .manifest_tables import Picked, Wanted, as_list
from .table_columns import check_not_taken, reading_columns
from .temperatures import TEMPERATURE, with_temperature
from .text_table import TextTable
from .toml import Strict

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Angles(Strict):
    """How every column of readings is turned into rad, or mm of a prismatic joint."""

    unit: Literal["rad", "deg", "arcsec", "gon", "mrad", "counts"]
    counts_per_turn: _Positive | Annotated[list[_Positive], Field(min_length=1)] | None = None
    sign: Literal[1, -1] | list[Literal[1, -1]] = 1
    offset: FiniteFloat | list[FiniteFloat] = 0.0
    columns: Picked | None = None
    linear_unit: Literal["mm", "m", "um", "inch", "counts"] = "mm"  # of prismatic joints
    counts_per_mm: _Positive | Annotated[list[_Positive], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _counts(self) -> "Angles":
        if (self.unit == "counts") != (self.counts_per_turn is not None):
            raise ValueError("give counts_per_turn with unit = 'counts', and only with it.")
        if (self.linear_unit == "counts") != (self.counts_per_mm is not None):
            raise ValueError("give counts_per_mm with linear_unit = 'counts', and only with it.")
        return self


def angles_of(angles: Angles | None, unit: str | None = None, preset: str | None = None) -> Angles:
    """How readings are written: what a table states comes first, then [angles], then the table's preset."""
    unit = unit if unit is not None or angles is not None else preset
    if unit is None and angles is None:
        raise InputError(
            "'angles' is missing, so that the unit of the readings is not known; add [angles] with unit = \"deg\" or "
            '"rad", or state it in the header of the table, as J1 [deg].'
        )
    if unit is None:
        assert angles is not None
        return angles
    if unit not in ANGLE_UNITS:
        raise InputError(f"units.q is '{unit}'; it must be one of {', '.join(ANGLE_UNITS)}.")
    same = ("sign", "offset", "linear_unit", "counts_per_mm")
    stated = {} if angles is None else {what: getattr(angles, what) for what in same}
    return Angles(unit=unit, **stated)  # pyright: ignore[reportArgumentType]


def in_rad(readings: np.ndarray, angles: Angles, arm: Arm) -> np.ndarray:
    """Readings in rad, and in mm of prismatic joints."""
    joints = readings.shape[1]

    def a_joint(value: float | list, what: str) -> np.ndarray:
        array = np.asarray(value, dtype=float)
        if array.ndim and array.shape != (joints,):
            raise InputError(
                f"angles.{what} has {array.size} values, but there are {joints} joints; give one, or one a joint."
            )
        return array

    unit = (
        2 * math.pi / a_joint(angles.counts_per_turn, "counts_per_turn")
        if angles.counts_per_turn
        else ANGLE_UNITS[angles.unit]
    )
    linear = (
        1 / a_joint(angles.counts_per_mm, "counts_per_mm") if angles.counts_per_mm else LENGTH_UNITS[angles.linear_unit]
    )
    units = np.where(by_joint(arm, False, True), linear, unit)
    return a_joint(angles.sign, "sign") * (readings - a_joint(angles.offset, "offset")) * units


def header_units(text: TextTable, picked: Sequence[int], arm: Arm, stated: str | None) -> tuple[str | None, str | None]:
    """The units that the header states for readings of revolute and of prismatic joints, or None; ``stated``: that of
    the former in the manifest.

    Raises:
        InputError: It states units of something else.
    """
    slides = [picked[i - 1] for i in arm.prismatic]
    turns = [i for i in picked if i not in slides]
    units = text.unit(turns, stated), text.unit(slides)
    for unit, known, columns, joints in zip(
        units, (ANGLE_UNITS, LENGTH_UNITS), (turns, slides), ("revolute", "prismatic"), strict=True
    ):
        if unit not in (None, "counts", *known):
            raise InputError(
                f"{text.path} states {quoted(str(unit))} for readings of {joints} joints "
                f"({quoted(text.header[columns[0]])}), but these are in {', '.join(known)} or counts; pick their "
                "columns with columns = [...], or correct the header."
            )
    return units


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
        self._tables: list[tuple[int, str | os.PathLike]] = []  # columns of readings of the first table, and its file
        self.columns: list[int] = []  # of the joints in the first table, from 1
        self.angles: Angles | None = None  # with which the first table was read, its header and units considered

    def __call__(self, text: TextTable, wanted: Wanted) -> Float[np.ndarray, "N n"]:
        """The readings of one table."""
        picked = self._picked(text, wanted)
        own = text.pick([TEMPERATURE]) if text.has([TEMPERATURE]) else []
        if set(own) & set(picked):
            raise InputError(
                f"{text.path} column {own[0] + 1} is {TEMPERATURE}, no joint reading; leave it out of columns."
            )
        stated = wanted.columns is not None or (self._angles is not None and self._angles.columns is not None)
        numbers = text.numbers(picked, measured=True, stated=stated)
        angles = self._angles_of(text, picked, wanted)
        q = in_rad(numbers, angles, self._arm)
        check_revolutions(str(text.path), q, self._arm, 'correct the header, or write unit = "deg" in [angles]')
        temperature = text.numbers(own)[:, 0] if own else None
        readings = with_temperature(q, temperature, wanted.temperature, str(text.path))
        self.columns, self.angles = self.columns or [i + 1 for i in picked], self.angles or angles
        self._tables = [*self._tables[:1], (readings.shape[1], text.path)]
        (fewer, without), (more, other) = sorted((self._tables[0], self._tables[-1]), key=lambda table: table[0])
        if fewer != more:
            raise InputError(
                f"{without} has no temperatures, but {other} has; give it a column {TEMPERATURE}, or state "
                f"{TEMPERATURE} in its table."
            )
        return readings

    def _picked(self, text: TextTable, wanted: Wanted) -> list[int]:
        columns, joints = wanted.columns, self._arm.joints
        if columns is None and self._angles is not None and self._angles.columns is not None:
            columns = as_list(self._angles.columns)
        if columns is None:
            return reading_columns(text, joints, wanted.taken)
        picked = text.pick(columns)
        check_not_taken(text, picked, wanted.taken)
        if len(picked) != joints:
            what = "angles.columns" if wanted.columns is None else "columns"
            raise InputError(
                f"{text.path}: {what} picks {len(picked)} columns for the readings, but the arm has {joints} joints; "
                "pick one a joint."
            )
        return picked

    def _angles_of(self, text: TextTable, picked: Sequence[int], wanted: Wanted) -> Angles:
        """How these readings are written: what the manifest states must not contradict the header."""
        stated_unit = wanted.unit or (None if self._angles is None else self._angles.unit)
        angular, linear = header_units(text, picked, self._arm, stated_unit)
        if angular == "counts" and self._angles is None and wanted.unit is None:
            raise InputError(
                f'{text.path} has readings in counts; add [angles] with unit = "counts" and counts_per_turn = [...].'
            )
        angles = angles_of(self._angles, wanted.unit, angular or wanted.usual_unit)
        given = self._angles is not None and "linear_unit" in self._angles.model_fields_set
        pairs = (
            (angular, angles.unit, "readings"),
            (linear, angles.linear_unit if given else linear, "prismatic joints"),
        )
        for header, stated, what in pairs:
            if header is not None and header != stated:
                raise InputError(
                    f"{text.path}: the header of the {what} says {header}, but the manifest {stated}; correct one of "
                    "them."
                )
        if linear == "counts" and angles.counts_per_mm is None:
            raise InputError(
                f'{text.path} has readings in counts; add linear_unit = "counts" and counts_per_mm = [...].'
            )
        return angles if linear is None else angles.model_copy(update={"linear_unit": linear})

"""The table ``[angles]`` of a manifest: how joint readings are written."""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat, PositiveInt, model_validator

from ..core.errors import InputError
from ..core.units import ARCSEC, DEG, LENGTH_UNITS
from ..kinematics.arm import Arm, by_joint
from .toml import Strict, each_once

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_UNITS = {"rad": 1.0, "deg": DEG, "arcsec": ARCSEC}


class Angles(Strict):
    """How every column of readings is turned into rad, or mm of a prismatic joint."""

    unit: Literal["rad", "deg", "arcsec", "counts"]
    counts_per_turn: _Positive | Annotated[list[_Positive], Field(min_length=1)] | None = None
    sign: Literal[1, -1] | list[Literal[1, -1]] = 1
    offset: FiniteFloat | list[FiniteFloat] = 0.0
    columns: Annotated[list[PositiveInt], AfterValidator(each_once)] | None = None
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
    if unit not in _UNITS:
        raise InputError(f"units.q is '{unit}'; it must be one of {', '.join(_UNITS)}.")
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
        else _UNITS[angles.unit]
    )
    linear = (
        1 / a_joint(angles.counts_per_mm, "counts_per_mm") if angles.counts_per_mm else LENGTH_UNITS[angles.linear_unit]
    )
    units = np.where(by_joint(arm, False, True), linear, unit)
    return a_joint(angles.sign, "sign") * (readings - a_joint(angles.offset, "offset")) * units

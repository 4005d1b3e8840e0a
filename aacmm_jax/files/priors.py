"""Priors in text: the table ``[priors]`` of an arm file, and ``--prior``."""

import re
from collections.abc import Mapping
from typing import Any

from pydantic import Field, FiniteFloat, PositiveFloat

from ..core.errors import InputError
from ..core.text import number
from ..core.units import ARCSEC, DEG, UM, M
from ..kinematics.arm import Arm
from ..kinematics.priors import MIXED, Prior, possible_names, unit_of_group
from .toml import Strict

_UNITS = {
    "mm": {"mm": 1.0, "um": UM, "m": M},
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": DEG, "arcsec": ARCSEC},
    # Of joint corrections.
    "rad/m": {"rad/m": 1.0, "mrad/m": 1e-3},
    "1/K": {"um/m/K": 1e-6, "/K": 1.0},
    "1": {"": 1.0},
}
_LEARN = "learn"
_VALUE = re.compile(r"(?:(?P<mean>[^\s]+?)\s*\+-\s*)?(?P<sd>[^\s]+?)\s*(?P<unit>[a-zKN/() ]*)")


class PriorTable(Strict):
    """The table ``[priors]`` of an arm file: by group, in the units of that file."""

    sd: dict[str, PositiveFloat] = Field(default_factory=dict)
    mean: dict[str, FiniteFloat] = Field(default_factory=dict)
    learn: list[str] = Field(default_factory=list)

    def prior(self, arm: Arm, length: float, angle: float) -> Prior:
        """The prior; ``length`` and ``angle`` are the file's units in mm and rad."""
        factors = {"mm": length, "rad": angle}  # others, such as rad/m, are the same in every file

        def converted(values: Mapping[str, float]) -> dict[str, float]:
            names = possible_names(arm)
            return {group: value * factors.get(unit_of_group(group, names), 1.0) for group, value in values.items()}

        prior = Prior(converted(self.sd), mean=converted(self.mean), learn=self.learn)
        prior.check(arm)
        return prior


def prior_toml(prior: Prior) -> dict[str, Any]:
    """The table ``[priors]`` of a prior, mm and rad; a group of which nothing is known cannot be in it."""
    sd = {group: float(value) for group, value in prior.sd.items()}
    learn = [group for group, learned in zip(prior.groups, prior.learned, strict=True) if learned]
    tables = {"sd": sd, "mean": {group: float(value) for group, value in prior.mean.items()}, "learn": learn}
    return {key: table for key, table in tables.items() if table}


def prior_of_text(text: str, arm: Arm) -> Prior | None:
    """The prior that ``--prior`` states, such as ``length=0.5mm,angle=0.05deg,alpha=learn,d_3=750.2+-0.1mm``.

    "learn" alone learns the standard deviations of lengths and of angles; "none" is None, no prior.

    Raises:
        InputError: the text is not of this form, or names no parameter of the arm.
    """
    if text.strip() == "none":
        return None
    if text.strip() == _LEARN:
        return Prior(learn=True)
    sd, mean, learn = {}, {}, []
    for part in filter(None, (part.strip() for part in text.split(","))):
        group, _, value = (word.strip() for word in part.rpartition("="))  # harmonics=2-3=learn
        group = {"length": "lengths", "angle": "angles"}.get(group, group)
        if group in sd or group in learn:
            raise InputError(f"--prior names '{group}' twice; name it once.")
        if group:
            Prior(learn=[group]).check(arm)
        if value == _LEARN:
            learn.append(group)
            continue
        match = _VALUE.fullmatch(value)
        unit = unit_of_group(group, possible_names(arm))
        factors = {} if unit == MIXED else _UNITS.get(unit, {unit.removeprefix("1"): 1.0})
        try:
            if match is None or match["unit"] not in factors:
                raise ValueError(value)
            sd[group] = number(match["sd"]) * factors[match["unit"]]
            if match["mean"] is not None:
                mean[group] = number(match["mean"]) * factors[match["unit"]]
        except ValueError as error:
            units = ", ".join(factors) or "one unit for lengths and one for angles, in groups of their own"
            raise InputError(
                f"--prior '{part}' is not of the form GROUP=NUMBER and unit ({units}), GROUP=MEAN+-NUMBER and unit, or "
                "GROUP=learn."
            ) from error
    prior = Prior(sd, mean=mean, learn=learn)
    prior.check(arm)
    return prior

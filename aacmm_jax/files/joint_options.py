"""What the options ``--model`` and ``--prior`` say of an arm's joints and parameters."""

import re
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.text import number
from ..core.units import ARCSEC, DEG, UM, M
from ..kinematics.arm import Arm, correction_names
from ..kinematics.corrected_arm import with_corrections
from ..kinematics.parameters import ArmSpecification
from ..kinematics.priors import MIXED, Prior, possible_names, unit_of_group
from .urdf import link_masses, urdf_chain

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


def with_model(specification: ArmSpecification, model: str) -> ArmSpecification:
    """The specification with another model of its joints; masses are those of its URDF, where it has one. Raises
    `InputError` where the model names an unknown kind."""
    if not model.strip():
        raise InputError("the model is empty; name dh alone for an arm without corrections.")
    arm = with_corrections(specification.arm, model, **masses_of(specification))
    gone = {*correction_names(specification.arm)} - {*correction_names(arm)}
    held = specification.held
    return specification._replace(
        arm=arm,
        held=None if held is None else tuple(name for name in held if name not in gone),
        free=tuple(name for name in specification.free if name not in gone),
        override={name: width for name, width in specification.override.items() if name not in gone},
    )


def masses_of(specification: ArmSpecification) -> dict[str, Any]:
    """Mass and centre of mass of each link, as arguments of `with_corrections`; none where they are unknown."""
    if specification.urdf is None:
        return {}
    masses = link_masses(urdf_chain(specification.urdf))
    return masses._asdict() if np.any(masses.mass > 0) else {}


def prior_of_text(text: str, arm: Arm) -> Prior | None:
    """The prior that ``--prior`` states, such as ``length=0.5mm,angle=0.05deg,alpha=learn,d_3=750.2+-0.1mm``.

    "learn" alone learns the standard deviations of lengths and of angles; "none" is None, no prior. Raises `InputError`
    where the text is not of this form, or names no parameter of the arm.
    """
    if text.strip() in ("none", _LEARN):
        return None if text.strip() == "none" else Prior(learn=True)
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

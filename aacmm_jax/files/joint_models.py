"""What joints do besides their readings, as people name it: the option ``--model``."""

from typing import Any

import numpy as np

from ..core.errors import InputError
from ..kinematics.arm import correction_names
from ..kinematics.corrected_arm import with_corrections
from ..kinematics.parameters import ArmSpecification
from .urdf import link_masses, urdf_chain


def with_model(specification: ArmSpecification, model: str) -> ArmSpecification:
    """The specification with another model of its joints; masses are those of its URDF, where it has one.

    Raises:
        InputError: The model names an unknown kind.
    """
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
    return {"mass": masses.mass, "centre": masses.centre} if np.any(masses.mass > 0) else {}

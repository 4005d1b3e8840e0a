"""A calibration with a named model of the joints: the arm with its corrections, coefficients free, and their prior."""

import numpy as np

from ..core.arguments import shown
from ..core.errors import InputError
from ..data.capture import Capture
from ..kinematics.arm import DOWN, Arm, correction_names, without_corrections
from ..kinematics.corrected_arm import with_corrections
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import Prior, default_prior
from ..uncertainty.target_parameters import determined_parameters


def with_joint_model(
    arm: Arm, capture: Capture, bounds: Bounds | None, model: str | None, prior: Prior | None
) -> tuple[Arm, Bounds, Prior | None]:
    """The arm, box and prior of a calibration with a model of the joints; without one, as they are given.

    The box is by default that of `default_bounds`; the prior of a model that of `default_prior`.
    """
    if model is None:
        if bounds is None:
            bounds = default_bounds(arm, capture)
            arm = bounds.space.base
        return arm, bounds, prior
    if not isinstance(model, str):
        raise InputError(f"the model is {shown(model)}; give a text such as 'gravity,harmonics=1'.")
    plain = without_corrections(arm)
    bounds = default_bounds(plain, capture) if bounds is None else bounds
    corrected = with_corrections(plain, model, gravity=DOWN if arm.gravity is None else arm.gravity)
    bounds = with_coefficients(bounds, corrected)
    arm = bounds.space.base  # with Hayati's beta, where the box has it
    if prior is None and arm.corrections is not None:
        prior = default_prior(arm)
    return arm, bounds, prior


def default_bounds(arm: Arm, capture: Capture) -> Bounds:
    """Around the parameters that such data determine, as for an arm's file without ``[identification]``, and without
    bounds around the coefficients of joint corrections."""
    plain = without_corrections(arm)
    try:
        space = determined_parameters(plain, capture)
    except InputError:
        space = Parameters.free_of(plain)
    bounds = Bounds.around(plain, space)
    return bounds if arm.corrections is None else with_coefficients(bounds, arm)


def with_coefficients(bounds: Bounds, arm: Arm) -> Bounds:
    """The box of the Denavit-Hartenberg parameters, with the coefficients of a corrected arm free and without bounds:
    their prior is enough."""
    kept = [i for i, name in enumerate(bounds.space.names) if name not in correction_names(bounds.space.base)]
    added = tuple(name for name in correction_names(arm) if not name.startswith("gravity_"))
    names = (*(bounds.space.names[i] for i in kept), *added)
    base = based_on(Parameters(bounds.space.base, names[: len(kept)]), arm).base
    endless = np.full(len(added), np.inf)
    sides = np.asarray(bounds.lower)[kept], np.asarray(bounds.upper)[kept]
    return Bounds(Parameters(base, names), np.concatenate([sides[0], -endless]), np.concatenate([sides[1], endless]))

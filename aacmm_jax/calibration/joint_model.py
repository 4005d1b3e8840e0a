"""A calibration with a named model of the joints: the arm with its corrections, coefficients free, and their prior; and
what a joint of the calibrated arm then does besides its reading, as a function of its reading."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arguments import shown
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..kinematics.arm import DOWN, Arm, correction_names, joint_limits, without_corrections
from ..kinematics.corrected_arm import function_values, with_corrections
from ..kinematics.corrections import Term
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import Prior, default_prior
from ..uncertainty.target_parameters import determined_parameters
from .record import CalibrationRecord, uncertainty_of

_POINTS = 400  # of a curve
_BEYOND = 0.15  # of its travel, on either side


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


class JointFunction(NamedTuple):
    """Corrections of one joint by its own reading, less their mean over the poses; rad, or mm of a prismatic joint."""

    reading: Float[np.ndarray, " points"]  # the travel of the poses and a little beyond, within the joint's limits
    value: Float[np.ndarray, " points"]
    expanded: Float[np.ndarray, " points"]  # expanded uncertainty, 95 %
    at_poses: Float[np.ndarray, " poses"]


def function_of_joint(
    record: CalibrationRecord, joint: int, q: Float[np.ndarray, "poses joints"], points: int = _POINTS
) -> JointFunction | None:
    """The functions of its own reading that correct a joint (harmonics, gear ratio), with their uncertainty.

    The mean over the poses is taken away: a zero offset takes it up.

    Args:
        record: A calibration.
        joint: Number of the joint, from 1.
        q: Readings of the poses, rad and mm.
        points: Number of readings, evenly spaced, at which the function is given.

    Returns:
        The function; None if the joint has no such corrections.
    """
    arm: Arm = to_numpy(record.calibrated.arm)
    if arm.corrections is None:
        return None
    chosen = {
        i: term
        for i, term in enumerate(arm.corrections.functions.terms)
        if term.joint == joint and isinstance(term, Term) and term.kind.of_own_reading
    }
    if not chosen:
        return None
    terms, coefficients = list(chosen.values()), np.asarray(arm.coefficients)[list(chosen)]
    travel = q[:, joint - 1]
    low, high = joint_limits(arm, None)[joint - 1] if arm.limits is not None or not arm.prismatic else (-np.inf, np.inf)
    beyond = _BEYOND * np.ptp(travel)
    at = np.linspace(max(travel.min() - beyond, low), min(travel.max() + beyond, high), points)
    rows = np.zeros((points, q.shape[1]))
    rows[:, joint - 1] = at
    gravity = np.asarray(arm.gravity)
    at_poses = function_values(arm.corrections.nominal, terms, q, gravity)
    mean = at_poses.mean(axis=1, keepdims=True)
    functions = function_values(arm.corrections.nominal, terms, rows, gravity) - mean
    names = [term.name for term in terms]
    free = [i for i, name in enumerate(names) if name in record.names]
    slopes = np.zeros((points, len(record.names)))
    slopes[:, [record.names.index(names[i]) for i in free]] = functions[free].T
    expanded = uncertainty_of(record).expanded_of(slopes)
    return JointFunction(at, coefficients @ functions, expanded, coefficients @ (at_poses - mean))

"""Which parameters of an arm a capture determines, where its file proposes none."""

import numpy as np

from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..data.observations.measured import MeasuredTransforms
from ..data.observations.observation import offset_of
from ..kinematics.arm import Arm, correction_names, parameter_names
from ..kinematics.parameters import Parameters
from ..kinematics.recorded_kinds import Expansion
from ..model.observed import Observed

# C, range of the temperatures below which a capture says less of the expansion than the material does: 80 poses over a
# volume of 1 m, with errors of 20 um each, determine the coefficient to about 10e-6 / K at 1 C.
_VARIES = 1.0
_AROUND = np.array([100.0, 50.0, 0.0])  # mm: an orientation says what points beside the target would say


def only_targets(capture: Capture) -> bool:
    """Whether every pose held a target at an unknown place in the last frame, and none the arm's own tip."""
    return not capture.sockets and all(observation.target for observation in capture.observations)


def determined_parameters(arm: Arm, capture: Capture | None = None) -> Parameters:
    """Parameters that are free where nothing is said: `Parameters.independent`, or of targets alone those that these
    determine; with temperatures that vary, the thermal expansion of an arm that has it.

    Raises `InputError` for an arm that has one configuration for each position of the tip, as with one or two joints.
    """
    if capture is None:
        return Parameters.independent(arm)
    space = independent_of_targets(arm, capture) if only_targets(capture) else Parameters.independent(arm)
    coefficient = Expansion.words[0]
    temperature = np.asarray(capture.readings)[:, arm.beside.slices(capture.columns)["thermometer"]]
    varies = temperature.size > 0 and float(np.ptp(temperature)) >= _VARIES
    if coefficient not in correction_names(arm) or not varies:
        return space
    names = (*space.names, coefficient)
    return Parameters(space.base, tuple(name for name in parameter_names(space.base) if name in names))


def independent_of_targets(arm: Arm, capture: Capture) -> Parameters:
    """`Parameters.independent` for a capture of `only_targets`.

    The unknown places of the targets take the part of the probe, and of the link after the last joint, so that these
    are fixed. What else is determined depends on how far the target is from the last axis, where the nominal arm finds
    it.
    """
    # NumPy compiles nothing.
    observed, space = to_numpy((Observed.of(capture, arm), Parameters(arm, ("probe_x",))))
    geometry = observed.split(np.asarray(observed.start(space, np.asarray(space.vector()))))
    places = [np.asarray(geometry[offset_of(observation.target)]) for observation in observed.observations]
    tip = max(places, key=lambda place: float(np.hypot(place[0], place[1])))
    if any(isinstance(observation, MeasuredTransforms) for observation in observed.observations):
        tip = tip + _AROUND
    chosen = Parameters.independent(arm.replace(probe=tip))
    n = arm.joints
    fixed = {f"alpha_{n}", f"a_{n}", f"d_{n}", f"theta_{n}", "probe_x", "probe_y", "probe_z"}
    return Parameters(chosen.base.replace(probe=arm.probe), tuple(name for name in chosen.names if name not in fixed))

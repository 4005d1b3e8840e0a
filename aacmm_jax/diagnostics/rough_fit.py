"""A robust fit of data that do not match the arm, from which a few wrong poses stand out.

Least squares spread the error of a wrong pose over all others. Here Tukey's loss takes all weight from it, and a prior
of how real arms differ from nominal ones keeps the parameters from following it, within wide bounds. Reference lengths
take no part.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.solve import solve
from ..calibration.task import Solving, task_of, without_lengths
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.units import DEG
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.observations.observation import AbstractObservation, offset_of
from ..kinematics.arm import Arm, correction_names
from ..kinematics.chain import forward_pass, joint_motion
from ..kinematics.parameters import ArmSpecification, Bounds, Parameters
from ..kinematics.priors import Prior
from ..kinematics.workspace import total_link_length
from ..model.observed import tips_of
from .equations import PROBE

# Standard deviations of a real arm's parameters from nominal ones, of its size or rad, and of its tips.
_LENGTH, _PROBE, _TWIST, _ZERO, _TIP = 0.004, 0.03, 0.5 * DEG, 1.5 * DEG, 5e-4
_BOX, _TURN, _TOOL = 0.1, 10 * DEG, 0.5  # half-widths of the bounds: lengths, angles, and the probe
_STEPS = 100  # most evaluations of each solve: what takes more has no solution near the nominal arm
_EXPLAINED = 0.003  # of the arm's size: a smaller residual is left by a real arm
_FAR = 8.0  # from the geometry, over the median pose or the usual errors of tips, beyond which a pose is wrong
_GAP = 3.0  # ratio of the distance of the nearest wrong pose to that of the farthest right one
_MOST = 0.25  # of all poses that may be wrong


class RoughFit(NamedTuple):
    """An arm and a geometry with which most poses agree."""

    arm: Arm
    names: tuple[str, ...]  # its free parameters
    observations: tuple[AbstractObservation, ...]  # sockets first
    parts: Mapping[str, Float[np.ndarray, " k"]]  # of the geometry
    size: float  # of the arm, mm
    rms: float  # distance from the geometry by the median pose, mm
    near: float  # the distance up to which a pose is right, mm
    limit: float  # and beyond which it is wrong

    def distances(self, observation: AbstractObservation) -> Float[np.ndarray, " m"]:
        """Distance of each pose of an observation from the geometry, mm; an angle counts as the arm's lever makes it.

        It may have other readings than those that were fitted, or poses of other observations.
        """
        geometry = to_numpy(self.arm.geometry)
        if observation.target:
            geometry = geometry._replace(probe=self.parts[offset_of(observation.target)])
        forward = forward_pass(geometry, joint_motion(geometry, np.asarray(observation.q)))
        unknowns = {name: np.asarray(self.parts[name])[:, None] for name in observation.unknowns}
        with np.errstate(all="ignore"):
            rows = observation.residual_with_errors(tips_of(forward, slice(None)), unknowns)
            in_mm = np.linalg.norm(observation.in_mm(rows.values, rows.by_tip), axis=0)
        angles = rows.values[observation.lengths :] if observation.other_unit == "rad" else np.zeros((0, len(in_mm)))
        return np.nan_to_num(np.hypot(in_mm, self.size / 4 * np.linalg.norm(angles, axis=0)), nan=np.inf)


def rough_fit(nominal: ArmSpecification, capture: Capture) -> RoughFit | None:
    """The fit of a capture; None where most poses do not agree with any arm near the nominal one."""
    base = to_numpy(nominal.bounds().space.base)
    free = [name for name in nominal.space().names if name not in correction_names(base)]
    names = tuple(dict.fromkeys([*free, *PROBE]))  # a tool may be anywhere; the prior decides what data leave open
    space, size = Parameters(base, names), max(total_link_length(base), 1e-9)
    prior = Prior({"lengths": _LENGTH * size, "angles": _TWIST, "theta": _ZERO, "probe": _PROBE * size})
    solving = Solving(
        robust="tukey", prior=prior, noise=Noise(seating=_TIP * size), hold=None, replace_noise=False, max_steps=_STEPS
    )
    try:
        tools = {name: _TOOL * size for name in names if name.startswith("probe")}
        bounds = Bounds.around(base, space, length=_BOX * size, angle=_TURN, override=tools)
        with np.errstate(all="ignore"):
            solution = solve(to_numpy(task_of(base, without_lengths(to_numpy(capture)), bounds, solving)))
    except (InputError, np.linalg.LinAlgError):
        return None
    linear = solution.linear
    split = linear.observed.split(np.asarray(linear.z)[len(names) :])
    parts = {name: np.asarray(numbers) for name, numbers in split.items()}
    arm = to_numpy(space.arm(np.asarray(linear.z)[: len(names)]))
    fit = RoughFit(arm, names, linear.observed.observations, parts, size, np.inf, np.inf, np.inf)
    distances = np.concatenate([fit.distances(observation) for observation in fit.observations])
    middle = float(np.median(distances))
    near = _FAR * max(middle, _TIP * size)
    fit = fit._replace(rms=np.sqrt(2) * middle, near=near, limit=_limit(np.sort(distances), near))
    return fit if middle <= _EXPLAINED * size and np.mean(distances > fit.limit) <= _MOST else None


def _limit(distances: Float[np.ndarray, " m"], least: float) -> float:
    """The largest gap between distances in their order, beyond ``least``: wrong poses are far from all others, where
    those of an arm that is worse than usual follow each other; infinite where there is no such gap."""
    after = np.flatnonzero(distances > least)
    after = after[after > 0]
    if not len(after):
        return np.inf
    ratios = distances[after] / np.maximum(distances[after - 1], least / _FAR)
    largest = int(np.argmax(ratios))
    return float(distances[after[largest]]) / np.sqrt(_GAP) if ratios[largest] > _GAP else np.inf

"""How far joints travel over the poses of a capture: what joints that stand still leave open, and which other poses are
near to those of a calibration."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arguments import checked_arguments
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.text import listed, pluralise
from ..core.units import DEG
from ..data.capture import Capture
from ..kinematics.arm import (
    Arm,
    by_joint,
    joint_limits,
    neighbouring_arm,
    parameter_names,
    with_arrays,
    without_corrections,
)
from ..kinematics.chain import reading_units
from ..kinematics.independence import determined_at, nearly_parallel
from ..kinematics.parameters import ArmSpecification, Parameters
from ..uncertainty.identifiability import observability

# An error of 1 mm across a joint's axis changes by 0.02 mm while the joint turns by 1 degree, and one of 1 mrad in the
# direction of a slide by as much over 20 mm: no more than a tip is seated or seen to. Poses within that say nothing.
_TURN, _SLIDE = 1.0 * DEG, 20.0
_SHORT = 20.0 * DEG
_SIGMA = 0.05  # mm, of tips: what these determine no better than usual bounds counts as open
_TARGET = np.array([100.0, 70.0, 50.0])  # mm
_QUERIES = 500  # poses of a capture, evenly chosen, whose distance from their nearest neighbour is computed
_AT_ONCE = 64
_NEAR = 0.95  # of the capture's poses are as near to another one as what counts as tried


class StandingJoint(NamedTuple):
    """A joint that (nearly) stands still.

    Example:
        >>> q = np.array(capture.q)
        >>> q[:, 4] = 0.2
        >>> print([(joint.joint, joint.range) for joint in aj.diagnostics.standing_joints(arm, q)])
        [(5, 0.0)]
    """

    joint: int  # from 1
    range: float  # between its least and its largest reading, rad, or mm of a prismatic joint
    poses: int


def standing_joints(arm: Arm, q: Float[AnyArray, "N n"]) -> tuple[StandingJoint, ...]:
    """Joints whose readings differ by less than 1 degree, or 20 mm; whole revolutions do not count.

    Args:
        arm: One arm, for which of its joints are prismatic.
        q: Readings of all poses, rad, and mm of prismatic joints.

    Example:
        >>> print(aj.diagnostics.standing_joints(arm, capture.q))
        ()
    """
    most = by_joint(arm, _TURN, _SLIDE)
    ranges = _ranges(arm, q)
    return tuple(StandingJoint(i + 1, float(x), len(q)) for i, x in enumerate(ranges) if x < most[i])


def _ranges(arm: Arm, q: Float[AnyArray, "N n"]) -> Float[np.ndarray, " n"]:
    """Between the least and the largest reading of each joint, without whole revolutions, rad or mm."""
    q = np.asarray(q)[:, : arm.joints]
    apart = q - q[:1]
    turned = apart - 2 * np.pi * np.round(apart / (2 * np.pi))
    return np.ptp(np.where(by_joint(arm, False, True), apart, turned), axis=0)


def short_travels(arm: Arm, capture: Capture) -> list[dict[str, Any]]:
    """Joints that turn, but by less than 20 degrees over several poses, in one sentence each.

    Their sign and the zeros of joints beside them rest on little: an arc of 20 degrees departs from its chord by 1.5 %
    of the radius at most.
    """
    q = np.asarray(capture.readings)
    if len(q) < 2:
        return []
    turns, rows = by_joint(arm, True, False), []
    for joint, travel in enumerate(_ranges(arm, q), start=1):
        if turns[joint - 1] and _TURN <= travel < _SHORT:
            says = (
                f"Joint {joint} turns by only {travel / DEG:.2g} deg over {pluralise(len(q), 'pose')}, which hardly "
                "determines its sign and the zeros of the joints beside it; let it turn by 40 deg or more, if its "
                "limits allow this."
            )
            rows.append({"joint": joint, "range_deg": travel / DEG, "poses": len(q), "says": says})
    return rows


def standing_rows(arm: Arm, capture: Capture, nominal: ArmSpecification | None = None) -> list[dict[str, Any]]:
    """Joints that (nearly) stand still over all poses, with what they leave open, in one sentence each; ``nominal`` has
    the free parameters that a calibration of the capture would take, where there is one."""
    still = standing_joints(arm, np.asarray(capture.readings))
    joints = [standing.joint for standing in still]
    remedy = "move this joint" if len(still) == 1 else "let every joint move"
    if nominal is not None and still:
        space = nominal.space()
        added = _open_parameters(space, capture, joints)
        held = {name for name in space.held if not name.startswith(("beta_", "gravity_"))} | added
        remedy += ", or calibrate "
        if added:
            remedy += f"with --held {','.join(name for name in parameter_names(space.base) if name in held)}"
        else:
            remedy += "with the default free parameters, which these data determine"
    rows = []
    for (joint, travel, poses), names in zip(still, lost_by_standing(arm, capture, joints), strict=True):
        unit, size = ("mm", travel) if joint in arm.prismatic else ("deg", travel / DEG)
        says = f"Joint {joint} moves too little ({size:.2g} {unit} over {pluralise(poses, 'pose')})"
        if names:
            says += f": {listed(names)} cannot be identified; {remedy}."
        else:
            says += ", but this leaves no further parameter undetermined."
        rows.append({"joint": joint, f"range_{unit}": size, "poses": poses, "lost": list(names), "says": says})
    return rows


def _open_parameters(space: Parameters, capture: Capture, joints: Sequence[int]) -> set[str]:
    """Free parameters to fix: those lost by standing, and one of each combination that is (nearly) undetermined."""
    # First as if they stood exactly still, since it is little, and mostly noise, that a small movement says.
    fixed = {name for names in lost_by_standing(space.base, capture, joints, space.names) for name in names}
    while capture.lengths or any(observation.fixes_scale for observation in capture.observations):
        left = Parameters(space.base, tuple(name for name in space.names if name not in fixed))
        seen = observability(left.base, capture, left, sigma=_SIGMA)
        if seen.null.shape[1]:
            fixed.add(left.names[int(np.argmax(np.abs(seen.null[:, 0])))])
        elif seen.trade_offs:
            fixed.add(seen.trade_offs[0].names[0])
        else:
            break
    return fixed


def lost_by_standing(
    arm: Arm, capture: Capture, joints: Sequence[int], names: Sequence[str] = ()
) -> list[tuple[str, ...]]:
    """Parameters that the poses would determine if these joints (from 1) moved in them, and do not while they stand.

    Of what cannot be separated, those of these joints are named; what two of them leave open together, with the later.
    ``names`` are the parameters in question, by default all that data may determine.
    """
    if not joints:
        return []
    base = to_numpy(arm)
    if not names:
        space = Parameters.independent(base)
        base = to_numpy(space.base)
        # Also what sockets do not determine of the nominal arm, but points that were seen on a target may.
        parallel = nearly_parallel(base)
        without = {f"d_{i}" if i in parallel else f"beta_{i}" for i in range(1, base.joints + 1)}
        others = [name for name in parameter_names(without_corrections(base)) if name not in without]
        names = list(dict.fromkeys([*space.names, *others]))
    of_joints = {f"{kind}_{joint}" for kind in ("alpha", "a", "d", "theta", "beta") for joint in joints}
    order = sorted(names, key=of_joints.__contains__)  # the last are lost first
    neighbour = neighbouring_arm(base, tuple(order))  # without the exact alignments of the nominal arm
    # A target's place is unknown, and seldom on the last axis.
    if any(observation.target for observation in capture.observations):
        neighbour = with_arrays(neighbour, probe=np.asarray(neighbour.probe) + _TARGET)
    low, high = np.asarray(joint_limits(arm, None)).T
    standing, random, left = np.asarray(capture.readings)[0], np.random.default_rng(0), []
    for count in range(len(joints) + 1):

        def changed(q: Float[np.ndarray, "m n"], still: Sequence[int] = joints[:count]) -> Float[np.ndarray, "m n"]:
            for i in (joint - 1 for joint in joints):
                q[:, i] = standing[i] if i + 1 in still else random.uniform(low[i], high[i], len(q))
            return q

        left.append(determined_at(neighbour, capture, order, changed))
    return [tuple(name for name in before if name not in after) for before, after in itertools.pairwise(left)]


class TriedPoses(NamedTuple):
    """Distances in joint space: root mean square over the joints, each the shorter way round, rad (slides: m)."""

    spacing: float  # within which 95 % of the calibration's poses have another one
    distance: Float[np.ndarray, " v"]  # of each other pose from the nearest one of the calibration
    outside: Int[np.ndarray, " v"]  # how many joints of each are outside the travel that the calibration has of them

    @property
    def tried(self) -> Bool[np.ndarray, " v"]:
        """Which poses are as near to one of the calibration as these are to one another."""
        return self.distance <= self.spacing


@checked_arguments
def tried_poses(arm: Arm, calibrated: Numbers, q: Numbers) -> TriedPoses:
    """How far poses are from those of a calibration, and these from one another.

    What a model lacks depends on the readings, so the data of a calibration contain such errors only near its own
    poses. Elsewhere, an uncertainty that follows from the model alone does not include them. ``calibrated`` are the
    readings that the arm was calibrated with, ``(N, n)``, and ``q`` those of other poses, rad (slides: mm); a
    temperature after them is left out. Raises `InputError` for fewer than two poses.
    """
    units = np.asarray(reading_units(arm.geometry))
    poses, others = (np.asarray(values, dtype=float)[:, : arm.joints] / units for values in (calibrated, q))
    if len(poses) < 2:
        raise InputError(
            f"the distance from the nearest other pose needs at least two poses, but there are {len(poses)}; give "
            "at least two poses of the calibration."
        )
    turns = np.array(by_joint(arm, True, False))

    def nearest(q: Float[np.ndarray, "v n"], same: np.ndarray | None = None) -> Float[np.ndarray, " v"]:
        """Distance of each pose from the nearest of the calibration; ``same``: which of these each of them is."""
        distances = np.empty(len(q))
        for start in range(0, len(q), _AT_ONCE):
            rows = slice(start, start + _AT_ONCE)
            apart = q[rows, None] - poses[None]
            squares = np.mean(np.where(turns, (apart + np.pi) % (2 * np.pi) - np.pi, apart) ** 2, axis=2)
            if same is not None:
                squares[np.arange(len(squares)), same[rows]] = np.inf
            distances[rows] = np.sqrt(squares.min(axis=1))
        return distances

    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _QUERIES)).round().astype(int))
    middle = np.where(turns, np.angle(np.mean(np.exp(1j * poses), axis=0)), 0.0)
    apart, travel = (np.where(turns, (q - middle + np.pi) % (2 * np.pi) - np.pi, q) for q in (others, poses))
    outside = np.sum((apart < travel.min(axis=0)) | (apart > travel.max(axis=0)), axis=1)
    return TriedPoses(float(np.quantile(nearest(poses[chosen], chosen), _NEAR)), nearest(others), outside)

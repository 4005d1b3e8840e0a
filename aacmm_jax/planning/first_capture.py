"""What the data of a first calibration can determine of an arm, and how many of them it needs; before any plan.

All of it follows from the derivatives of random poses over the whole workspace. A plan with positions of sockets and
chosen poses (`planning.design`) needs fewer poses than the numbers given here.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..core.text import pluralise
from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise, tip_covariances
from ..data.observations.measured import MeasuredPoints
from ..kinematics.arm import Arm, joint_limits, parameter_names
from ..kinematics.chain import joint_motion
from ..kinematics.independence import generic_poses
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import configurations_at, search_region
from ..uncertainty.identifiability import Observability, observability
from ..uncertainty.volume import default_length, sample_lengths
from .designs import Candidates, Objective, covariance_of
from .placement import FixturePlacement, candidates_of, pool_of
from .problem import PRIOR, DesignProblem, length_derivatives

COUNTS = (10, 15, 20, 30, 40, 60, 80, 120, 160, 240)  # of poses
_LENGTHS = 200  # that predictions are of
_DETERMINED = 10.0  # mm: a length known no better follows from the weak prior alone
_PLACEMENTS, _STARTS = 5, 40  # of sockets; and configurations in each socket
_SOCKETS = (2, 4, 6)  # in pairs at the ends of reference lengths
U_LENGTH, U_TRACKER = 0.002, 0.02  # mm: of reference lengths, and of each coordinate that a tracker measures
_STILL_AT, _FEW = (0.5, 0.25, 0.75), 40  # of a joint's range; and poses that say nothing
_POINTS = 240  # poses that a tracker sees


class Expected(NamedTuple):
    """The standard uncertainty of lengths that the calibration adds, from random poses."""

    data: str  # in words
    sockets: int
    u: dict[int, float]  # number of poses -> median over the volume, mm; infinite where it is not determined
    enough: int | None  # the fewest poses that add no more than the noise of two readings; None: none of `COUNTS` do


def determined_by(arm: Arm) -> dict[str, Observability]:
    """What sockets, sockets with a reference length, and a tracker determine, at their best.

    Args:
        arm: One arm that reaches a volume.

    Raises:
        InputError: The arm has a single configuration for each position of its tip, so that sockets say nothing.
    """
    arm = to_numpy(arm)
    sockets, length, points = _thorough(arm, None)
    # While coefficients are 0, gravity's direction changes nothing.
    every = Parameters(arm, tuple(name for name in parameter_names(arm) if not name.startswith("gravity_")))
    target = [MeasuredPoints("tracker", seen.q, seen.points, station="tracker", target="target") for seen in points]
    kinds = {
        "sockets": Capture(sockets),
        "sockets and a reference length": Capture(sockets, length),
        "a tracker that measures the probe": Capture({}, observations=points),
        "a tracker that measures a target at an unknown position": Capture({}, observations=target),
    }
    return {data: observability(arm, capture, every) for data, capture in kinds.items()}


def still_joints(arm: Arm) -> list[tuple[str, ...] | None]:
    """Of each joint the parameters that sockets with a reference length do not determine where it does not move; None:
    without it the tip cannot stay in a socket."""
    arm = to_numpy(arm)
    names, limits, still = Parameters.independent(arm).names, np.asarray(joint_limits(arm, None)), []
    for joint in range(arm.joints):
        lost = None
        for share in _STILL_AT:
            held = limits.copy()
            held[joint] = limits[joint, 0] + share * np.ptp(limits[joint])
            sockets, length, _ = _thorough(arm, held)
            if sum(len(q) for q in sockets.values()) < _FEW:
                continue
            left = Parameters.independent(arm, Capture(sockets, length)).names
            lost = tuple(name for name in names if name not in left)
            break
        still.append(lost)
    return still


def first_capture(arm: Arm, noise: Noise) -> tuple[float, list[Expected]]:
    """The uncertainty of a length by the noise of the readings at both ends (median over the volume, mm), and what
    calibrations from random poses would add to it, by what is recorded and how much.

    Sockets are in pairs, at the ends of reference lengths that are anywhere in the workspace; the numbers are medians
    over a few such placements.

    Raises:
        InputError: The noise is none, or no length fits into the workspace.
    """
    noise.check(arm.joints)
    arm, noise = to_numpy((arm, noise))
    space = Parameters.independent(arm)
    arm, length = space.base, default_length(arm)
    start, end = sample_lengths(arm, _LENGTHS, length=length, seed=1)
    between = np.asarray(arm.position(end)) - np.asarray(arm.position(start))
    along = between / np.linalg.norm(between, axis=1, keepdims=True)
    functions = length_derivatives(arm, space, start, end)
    both = sum(np.asarray(tip_covariances(arm.geometry, joint_motion(arm.geometry, q), noise)) for q in (start, end))
    u_reading = float(np.median(np.sqrt(np.einsum("vc,cdv,vd->v", along, both, along))))
    problem = DesignProblem(
        search_region(arm, None, 0.0, -np.inf, 0), space, noise, Objective("functions", functions, 0.0)
    )
    rows = []
    for sockets in _SOCKETS:
        pairs = tuple((i, i + 1) for i in range(0, sockets, 2))
        starts, ends = sample_lengths(arm, _PLACEMENTS * sockets // 2, length=length, seed=2)
        points = np.stack([np.asarray(arm.position(starts)), np.asarray(arm.position(ends))], axis=1)
        placed = []
        for part in np.split(points, _PLACEMENTS):
            places = FixturePlacement(part.reshape(-1, 3), pairs, (U_LENGTH,) * len(pairs))
            pool = pool_of(problem, *configurations_at(problem.region, places.points, _STARTS))
            placed.append((candidates_of(problem, places, pool), len(pool.q)))
        words = f"{sockets} sockets, {pluralise(sockets // 2, 'reference length')} of {length:.0f} mm"
        rows.append(_expected(words, sockets, placed, functions, u_reading))
    rows.append(_expected("a tracker", 0, [_seen(problem)], functions, u_reading))
    return u_reading, rows


def _thorough(
    arm: Arm, limits: Float[np.ndarray, "n 2"] | None
) -> tuple[dict[str, np.ndarray], list[ReferenceLength], list[MeasuredPoints]]:
    """Poses all over the workspace: in sockets, with one reference length, and as a tracker sees them."""
    poses = generic_poses(arm, limits)
    q, sizes = np.asarray(poses.q), poses.sizes
    tips, ends = np.asarray(arm.position(q)), np.cumsum(sizes)
    sockets = {f"S{i}": q[end - size : end] for i, (size, end) in enumerate(zip(sizes, ends, strict=True))}
    length = ReferenceLength("S0", "S1", float(np.linalg.norm(tips[0] - tips[sizes[0]])), U_LENGTH)
    return sockets, [length], [MeasuredPoints("tracker", q, tips, u=U_TRACKER)]


def _seen(problem: DesignProblem) -> tuple[Candidates, int]:
    """Random poses that a tracker sees from an unknown place."""
    # A tip that is not seated scatters by its readings, and by the tracker.
    noise = Noise(encoder_arcsec=np.asarray(problem.noise.encoder_arcsec), seating=U_TRACKER)
    q = problem.region.draw(_POINTS)
    pool = pool_of(problem._replace(noise=to_numpy(noise)), q, np.zeros(len(q), dtype=int))
    tips = np.asarray(problem.arm.position(q))
    turned = np.cross(np.eye(3)[None], tips[:, None] / 1000).swapaxes(1, 2)  # mm a mrad about each axis
    frame = np.concatenate([turned, np.tile(np.eye(3), (len(q), 1, 1))], axis=2)
    rows = np.concatenate([pool.jacobian, -pool.roots @ frame], axis=2)
    return Candidates(rows, pool.owner, PRIOR * np.eye(rows.shape[2]), len(problem.space.names)), len(q)


def _expected(
    data: str, sockets: int, placed: Sequence[tuple[Candidates, int]], functions: np.ndarray, u_reading: float
) -> Expected:
    u = {}
    for count in COUNTS:
        medians = []
        for candidates, number in placed:
            if not number:
                medians.append(np.inf)
                continue
            whole = candidates.information(candidates.rows) - candidates.base
            covariance = covariance_of(candidates.base + count / number * whole, candidates.parameters)
            medians.append(float(np.median(np.sqrt(np.einsum("vp,pq,vq->v", functions, covariance, functions)))))
        u[count] = float(np.median(medians)) if np.median(medians) < _DETERMINED else np.inf
        if sockets and count < 2 * sockets:
            u[count] = np.inf
    enough = next((count for count, value in u.items() if value <= u_reading), None)
    return Expected(data, sockets, u, enough)

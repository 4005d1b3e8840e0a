"""The scale anchor of stage 1: a free length kept at its start, or what determines the scale well without one.

Repeatability does not determine the scale of an arm whose lengths are all free: with every length times k, all tips are
where they were times k. That ends where something in mm stays as it is. A fixed length is judged by how far tips move
under a relative change of it, once the free parameters have adapted. Readings of prismatic joints are judged by how
well the longest free length is determined without an anchor, which depends on the poses: a linear axis that stands
still determines no length, and neither does the quill of a SCARA, which has one height in every pose of a socket.
"""

import math
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..core.arguments import shown
from ..core.arrays import is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.text import shorten
from ..data.capture import Capture
from ..data.noise import Noise, at_tip
from ..kinematics.arm import (
    Arm,
    is_length,
    is_single,
    jacobian_at,
    natural_steps,
    neighbouring_arm,
    parameter_names,
    value_of,
    with_chains,
)
from ..kinematics.independence import equations, generic_poses, poses_in_sockets
from ..kinematics.inverse_kinematics import SocketPoses, project_to_centroids
from ..kinematics.parameters import Parameters, based_on
from ..kinematics.workspace import total_link_length
from ..model.scale import Partners

Method = Literal["two-stage", "joint"]

# Fixed lengths and slides set the scale where repeatability with them would determine it to this relative standard
# uncertainty ...
_LARGEST_UNCERTAINTY = 1e-4
# ... and slides contradict an anchor, if its start is wrong by its tolerance, where they would determine it to this: no
# length is kept then, also where reference lengths are needed besides. (With all lengths free the scale comes out
# smaller by degrees of freedom times its relative variance: here 2e-4 at most, a fifth of its uncertainty.)
_LARGEST_OF_SLIDES = 1e-3
# Both with 200 equations to spare (about 70 poses) and, where the noise is not given, tips that scatter by so many mm.
_EQUATIONS = 200
_SCATTER = 0.02
_CONFIGURATIONS = 100
_EXACT = 1e-9  # residual, relative to the column, below which free lengths replace a fixed one exactly


class ScaleAnchor(NamedTuple):
    """What sets the scale in stage 1, and whether it may be divided; static, so that it may fix a compiled program."""

    hold: str | None = None  # free length that stage 1 keeps at its start
    # Whether a length is free; False too where neither an anchor nor the values of the arm are known.
    free: bool = False
    # Fixed lengths, and readings ``q_i`` of prismatic joints, that determine the scale well, so that a division by k
    # changes nothing.
    set_by: tuple[str, ...] = ()
    # Fixed lengths that free ones replace exactly in a division; None where some have no such partner, as slides have
    # not, or are not known.
    partners: Partners | None = None

    @property
    def can_scale(self) -> bool:
        """Whether stage 2 changes the arm: not where fixed lengths set the scale, or no length is free."""
        return self.free and not self.set_by


def scale_anchor(
    space: Parameters,
    arm: Arm,
    hold: str | None,
    noise: Noise | None = None,
    capture: SocketPoses | None = None,
) -> ScaleAnchor:
    """What sets the scale of stage 1.

    ``hold`` names a free length, or is None for no anchor. "longest" is the longest free link, but for two cases: no
    anchor where fixed lengths determine the scale well, to 1e-4 by repeatability alone (0.02 mm, 70 poses), or slides
    of prismatic joints to 1e-3. d_3 = 750 mm, known from a drawing, sets the scale; probe_x = 0.6 mm does not, and d_7
    with a free probe along the same axis not at all.

    ``capture`` is where slides are judged; by default, or where its readings are traced, poses all over the workspace.

    Raises `InputError` for an angle, a parameter that is not free, or "longest" with an arm whose values are traced.
    """
    space = based_on(space, arm)
    arm = space.base
    concrete = is_concrete(*jax.tree.leaves(arm))
    lengths = [name for name in space.names if is_length(name)]
    hold = _checked_hold(hold, space, lengths, concrete)
    fixed, slides = fixed_lengths(arm, space), tuple(f"q_{i}" for i in arm.prismatic)
    partners = None if fixed or slides else ((), ())
    longest = None
    if concrete and lengths:
        # A link; but the links of a gantry are slides, and all that scales with the wrist may be the probe.
        sizes = {name: float(np.abs(value_of(arm, name)).max()) for name in lengths}
        links = [name for name in lengths if not name.startswith("probe") and name != "d_1" and sizes[name]]
        longest = max(links or lengths, key=sizes.__getitem__)
    set_by, without_anchor = (), False
    if concrete and (fixed or slides):
        with jax.ensure_compile_time_eval():
            single = arm if is_single(arm) else jax.tree.map(lambda leaf: leaf.reshape(-1, leaf.shape[-1])[0], arm)
            both = [] if slides else _columns_of_both(single, space, fixed)
            if longest is not None and hold in (None, "longest"):
                moving = fixed
                if slides:
                    scaling, moving = _of_slides(single, space, longest, capture)
                else:
                    # How the free parameters, and a common relative change of the fixed lengths, move the tips, mm.
                    values, p = np.array([value_of(single, name) for name in fixed]), len(space.names)
                    scaling = [(rows[:, :p] * natural_steps(space.names), rows[:, p:] @ values) for rows in both]
                # A change of what scales is imitated by the free parameters as well as they can. What is left is what
                # repeatability sees of the scale, mm RMS for a relative change of 1. The nominal arm may be in a
                # special position that the real one does not share, so the smaller of two residuals counts: at the
                # nominal arm, and at a neighbouring one.
                left = [wanted - free @ np.linalg.lstsq(free, wanted, rcond=1e-10)[0] for free, wanted in scaling]
                least = min(float(np.sqrt(np.mean(residual**2))) for residual in left)
                # Of a tip coordinate, mm, as the noise has it for a tip at half of the arm's reach.
                scatter = _SCATTER
                if noise is not None and is_concrete(noise.encoder, noise.seating):
                    scatter = math.hypot(*at_tip(noise, single, total_link_length(single) / 2))
                u = scatter / (math.sqrt(_EQUATIONS) * max(least, 1e-300))
                set_by = (moving or fixed) if u <= _LARGEST_UNCERTAINTY else ()
                without_anchor = bool(slides) and u <= _LARGEST_OF_SLIDES
        if not slides:
            partners = _partners(arm, both, space, fixed)
    if hold == "longest":
        hold = None if set_by or without_anchor else longest
    return ScaleAnchor(hold, hold is not None or (concrete and bool(lengths)), set_by, partners)


def _checked_hold(hold: object, space: Parameters, lengths: list[str], concrete: bool) -> str | None:
    """A length, "longest", or None, as where no length is free."""
    if not isinstance(hold, str | None):
        raise InputError(f"hold is {shown(hold)}; give the name of a length, 'longest' or None.")
    if hold not in (None, "longest", *lengths):
        space.index(hold)
        advice = f"; hold a length, for example '{lengths[0]}'" if lengths else ", and no length is free; omit hold"
        raise InputError(f"hold is '{hold}', which is an angle{advice}.")
    if hold == "longest" and (not lengths or len(space.names) == 1):
        return None
    if hold == "longest" and not concrete:
        raise InputError(
            "hold='longest' needs the values of the arm, which are not known inside jit, vmap or a derivative; name "
            "the length to hold."
        )
    return hold


def fixes_scale(capture: Capture) -> bool:
    """Whether reference lengths or other observations of a capture fix the scale."""
    return bool(capture.lengths) or any(observation.fixes_scale for observation in capture.observations)


def default_method(arm: Arm, general: bool) -> Method:
    """The method where none is given: two stages, but one joint solve where more than lengths fixes the scale.

    ``general``: whether there are observations besides sockets and lengths, or a robust loss.
    """
    return "joint" if general or arm.prismatic else "two-stage"


def method_of(
    arm: Arm, capture: Capture, space: Parameters, noise: Noise | None, method: Method | None, at_once: bool
) -> tuple[Method, bool]:
    """The method of a calibration, and whether everything is solved at once from the beginning: where more than sockets
    and lengths take part, or ``at_once``. Raises `InputError` for another method, and where nothing fixes the scale."""
    # Whether slides of prismatic joints determine the scale, where nothing else does.
    by_slides = bool(arm.prismatic) and not fixes_scale(capture) and bool(space.lengths.any())
    by_slides = by_slides and scale_anchor(space, arm, "longest", noise, capture).hold is None
    at_once = at_once or bool(capture.observations) or by_slides
    method = default_method(arm, at_once) if method is None else method
    if method == "two-stage" and at_once:
        raise InputError(
            "method='two-stage' applies only to sockets with reference lengths, and cannot be combined with a robust "
            "loss, a prior or the covariances of a batch; use method='joint'."
        )
    if not by_slides and not fixes_scale(capture):
        raise InputError(
            "the capture contains no reference length, so the scale cannot be fixed; add a reference length "
            "between two sockets, or take the scale from the nominal arm (--scale nominal; from Python, identify "
            "for stage 1 alone)."
        )
    return method, at_once


def scale_set_by_clause(names: tuple[str, ...]) -> str:
    """The beginning of a warning about fixed lengths, or slides, that set the scale."""
    slides = [name.removeprefix("q_") for name in names if name.startswith("q_")]
    if slides:
        joints = "joint" if len(slides) == 1 else "joints"
        return f"the readings of {joints} {', '.join(slides)} in mm already set the scale"
    verbs = "is fixed and already sets" if len(names) == 1 else "are fixed and already set"
    return f"{shorten(names)} {verbs} the scale"


def fixed_lengths(arm: Arm, space: Parameters) -> tuple[str, ...]:
    """Fixed lengths that the scale concerns: all but ``d_1`` and, where values are known, those that are zero."""
    names = [name for name in parameter_names(arm) if is_length(name) and name not in ("d_1", *space.names)]
    if not is_concrete(*jax.tree.leaves(arm)):
        return tuple(names)
    return tuple(name for name in names if np.any(value_of(arm, name) != 0))


def _columns_of_both(arm: Arm, space: Parameters, fixed: tuple[str, ...]) -> list[Float[np.ndarray, "rows k"]]:
    """Derivatives of the tips by free parameters and fixed lengths at random configurations, less what they have in
    common: of the nominal arm and of a neighbouring one, which has no special position."""
    names, matrices = (*space.names, *fixed), []
    q = with_chains(arm, np.random.default_rng(0).uniform(-np.pi, np.pi, (_CONFIGURATIONS, arm.joints)))
    for variant in (arm, neighbouring_arm(arm, space.names)):
        columns = jacobian_at(variant, q, names)
        matrices.append((columns - columns.mean(axis=0)).reshape(-1, len(names)))
    return matrices


def _of_slides(
    arm: Arm, space: Parameters, longest: str, capture: SocketPoses | None
) -> tuple[list[tuple[np.ndarray, np.ndarray]], tuple[str, ...]]:
    """How the other free parameters, and a relative change of the longest length, move the tips of every socket apart;
    and which slides move. At the poses of a capture, of the first of a batch, brought to their sockets; else at poses
    all over the workspace."""
    if capture is not None and capture.sizes and is_concrete(capture.q):
        q = np.asarray(capture.q)
        poses = poses_in_sockets(q.reshape(-1, *q.shape[-2:])[0], tuple(capture.sizes))
    else:
        prismatic = np.isin(np.arange(1, arm.joints + 1), arm.prismatic)
        limits = np.where(prismatic[:, None], [-500.0, 500.0], [-np.pi, np.pi]).tolist()
        poses = generic_poses(arm.replace(limits=limits) if arm.limits is None else arm)
    others, matrices = [name for name in space.names if name != longest], []
    for variant in (to_numpy(arm), neighbouring_arm(arm, space.names)):
        q = project_to_centroids(variant, poses, targets_of=arm)
        rows = equations(variant, poses, (*others, longest), q)[0].reshape(-1, len(space.names))
        matrices.append((rows[:, :-1] * natural_steps(others), rows[:, -1] * value_of(arm, longest)))
    travels = np.ptp(np.asarray(poses.q), axis=0)
    return matrices, tuple(f"q_{joint}" for joint in arm.prismatic if travels[joint - 1] > 1.0)  # mm


def _partners(arm: Arm, columns: list[np.ndarray], space: Parameters, fixed: tuple[str, ...]) -> Partners | None:
    """Free lengths that replace the fixed ones exactly, whatever the free angles are.

    Tips are linear in the lengths, so the weights are a linear least squares; that they serve two arms with different
    free angles shows that they follow from the fixed angles alone (alpha_n = 0 makes d_n and probe_z one).
    """
    angles = [name for name in parameter_names(arm) if not is_length(name) and name not in space.names]
    if any(np.ptp(value_of(arm, name)) > 0 for name in angles):
        return None  # the arms of this batch have different fixed angles
    free = tuple(name for name in space.names if is_length(name) and name != "d_1")
    rows = np.concatenate(columns)
    replaceable = rows[:, [space.names.index(name) for name in free]]
    wanted = rows[:, len(space.names) :]
    weights = np.linalg.lstsq(replaceable, wanted, rcond=1e-10)[0] if free else np.zeros((0, len(fixed)))
    if np.any(np.linalg.norm(wanted - replaceable @ weights, axis=0) > _EXACT * np.linalg.norm(wanted, axis=0) + 1e-12):
        return None
    weights = np.where(np.abs(weights) < _EXACT, 0.0, weights)
    by_name = dict(zip(free, weights.tolist(), strict=True))
    return fixed, tuple(tuple(by_name.get(name, [0.0] * len(fixed))) for name in space.names)

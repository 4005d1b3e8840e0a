"""What a calibration's model may lack: known functions of the readings and of the order of the poses.

Of joint i, the model's angle is its reading and a zero. What it lacks is a further function phi of the readings, whose
column is that of theta_i times phi: harmonics of an eccentric, tilted or oval encoder, a wrong gear ratio, the moment
of gravity about the axis where the joint or the link behind it bends, a zero that drifts from pose to pose. A base that
moves and an arm that grows, meanwhile or with its temperature, move the tip itself.
"""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..kinematics.arm import Arm
from ..kinematics.chain import ForwardPass, forward_pass, joint_motion
from .group_equations import Rows

Kind = Literal[
    "zero",
    "first harmonic",
    "second harmonic",
    "gear ratio",
    "gravity",
    "drifting zero",
    "drifting base",
    "growing arm",
    "thermal expansion",
]


class MissingTerm(NamedTuple):
    """A term that the model may lack: of one joint, in mrad, or of the tip, in mm."""

    kind: Kind
    joint: int | None  # from 1; None: of the tip
    values: Float[np.ndarray, "N _k"] | Float[np.ndarray, "N 3 _k"]  # pose by pose, for coefficients of 1


def columns_of(terms: Sequence[MissingTerm], rows: Sequence[Rows], joints: int) -> list[Float[np.ndarray, "R _"]]:
    """The columns of each term in the rows of all poses."""
    of_joints = [term for term in terms if term.joint is not None]
    of_tip = [term for term in terms if term.joint is None]
    owner = np.array([term.joint for term in of_joints for _ in range(term.values.shape[1])], dtype=int) - 1
    factors, moves = (np.concatenate([term.values for term in some], axis=-1) for some in (of_joints, of_tip))
    blocks = []
    for each in rows:
        by_joints = each.extra[..., :joints][..., owner] * factors[each.poses][:, None]
        both = np.concatenate([by_joints, each.by_tip @ moves[each.poses]], axis=2)
        blocks.append(both.reshape(-1, both.shape[2]))
    ends = np.cumsum([term.values.shape[-1] for term in (*of_joints, *of_tip)])
    return np.split(np.concatenate(blocks), ends[:-1], axis=1)


def missing_terms(arm: Arm, q: Float[np.ndarray, "N n"]) -> list[MissingTerm]:
    """Everything that is looked for.

    Args:
        arm: The calibrated arm.
        q: All readings in their order, rad; with a thermometer, the temperature last, C.
    """
    forward = forward_pass(arm.geometry, joint_motion(arm.geometry, q))
    order = np.linspace(-1.0, 1.0, len(q))[:, None]
    tip = np.moveaxis(np.asarray(forward.tip), -1, 0)
    return [
        *(
            term
            for joint in range(arm.joints)
            for term in _of_joint(forward, q[:, joint, None], order, joint, joint + 1 in arm.prismatic)
        ),
        MissingTerm("drifting base", None, order[:, :, None] * np.eye(3)),
        MissingTerm("growing arm", None, order[:, :, None] * tip[:, :, None] / 1e3),  # by 1 mm a m
        *(
            MissingTerm("thermal expansion", None, (temperature - 20)[:, None, None] * tip[:, :, None] / 1e3)
            for temperature in q[:, arm.joints :].T
            if np.ptp(temperature) > 0
        ),
    ]


def _of_joint(
    forward: ForwardPass, q: Float[np.ndarray, "N 1"], order: Float[np.ndarray, "N 1"], joint: int, slides: bool
) -> Iterator[MissingTerm]:
    yield MissingTerm("zero", joint + 1, np.ones_like(q))
    yield MissingTerm("gear ratio", joint + 1, q)
    yield MissingTerm("drifting zero", joint + 1, order)
    if slides:  # a scale has no revolution to repeat, and carries what it moves
        return
    yield MissingTerm("first harmonic", joint + 1, np.concatenate([np.cos(q), np.sin(q)], axis=1))
    yield MissingTerm("second harmonic", joint + 1, np.concatenate([np.cos(2 * q), np.sin(2 * q)], axis=1))
    yield MissingTerm("gravity", joint + 1, _moments(forward, joint))


def _moments(forward: ForwardPass, joint: int) -> Float[np.ndarray, "N k"]:
    """Moments of gravity about a joint's axis by a unit mass at the origin of each frame that it moves, and at the tip,
    with the base upright; m.

    Masses and stiffness are not known, so each point has a coefficient of its own.
    """
    points = np.concatenate([np.asarray(forward.origin)[joint:], np.asarray(forward.tip)[None]])
    arms = points - np.asarray(forward.origin_before)[joint]
    axis = np.asarray(forward.z_before)[joint]
    return (axis[1] * arms[:, 0] - axis[0] * arms[:, 1]).T / 1e3

"""Kinds of joint corrections by what was recorded beside the readings, and by the side on which a joint rests."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace
from ..core.rotations import cross
from .beside import Readings
from .chain import ForwardPass, last_joints
from .correction_kinds import (
    KILO,
    REFERENCE_TEMPERATURE,
    STANDARD_GRAVITY,
    AbstractCorrection,
    Gravity,
    Loads,
    Rows,
    Sought,
    Term,
    moments_about,
)

HANGS = "hang"  # the word of coefficients of play by gravity
_BALANCED = 0.1  # part of a moment, below which gravity does not decide on which side of its play a joint rests


class Backlash(AbstractCorrection):
    """Play: half of it behind the reading of a joint that was moved to the pose with rising readings, half of it ahead
    after falling ones. The coefficient is the whole play, in the plain case positive.

    The direction is recorded beside the readings; without it, or where it is 0, nothing is added. With
    ``backlash=gravity`` a joint rests on the side to which the weight of the links after it turns it, taken to be equal
    weights at the origins of their frames and at the tip, on a base that stands upright: a side that follows from the
    pose, so that nothing need be recorded. Where the moment is nearly balanced, less than a tenth of what these levers
    could make, the side is taken in proportion.
    """

    model = "backlash"
    words = ("play", HANGS)
    description = "backlash of joints"
    unit = "rad"
    usual_size = 1e-3
    usual_of_slide = 0.05
    column = "directions"
    has_options = True
    sought = (
        Sought("backlash", "", "the direction of approach of joint {i}", "backlash", of_slides=True),
        Sought(
            "backlash by gravity", "gravity", "the side to which gravity turns joint {i}", "backlash", rather="gravity"
        ),
    )

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        if option not in ("", "gravity"):
            raise InputError(f"backlash={option} is unknown; write backlash, or backlash=gravity.")
        return tuple(Term(self, HANGS if option else "play", 0, joint) for joint in range(1, joints + 1))

    def option_of(self, terms: Sequence[Term]) -> str:
        return "gravity" if terms[0].word == HANGS else ""

    def column_of(self, term: Term) -> str:
        return "" if term.word == HANGS else self.column

    def values(self, terms: Sequence[Term], q: Readings, forward: ForwardPass) -> Rows:
        rows = [
            (self._by_direction if term.word == "play" else self._by_gravity)(term.joint - 1, q, forward)
            for term in terms
        ]
        batch = np.broadcast_shapes(*(row.shape for row in rows))
        return namespace(q, forward).stack([namespace(row).broadcast_to(row, batch) for row in rows])

    def _by_direction(self, joint: int, q: Readings, forward: ForwardPass) -> Float[AnyArray, "... 1 N"]:
        return 0.0 * q.joints[joint] if q.directions is None else -0.5 * q.directions[joint]

    def _by_gravity(self, joint: int, q: Readings, forward: ForwardPass) -> Float[AnyArray, "... 1 N"]:
        xp = namespace(forward)
        last, n = last_joints(forward), len(forward.origin)
        points = xp.stack([forward.tip if j in last else forward.origin[j] for j in range(joint, n)])
        levers = points - forward.origin_before[joint]
        levers = levers if forward.members is None else levers * forward.members[joint:n]
        moment = -cross(forward.z_before[joint], xp.sum(levers, axis=0))[..., 2:, :]
        size = xp.sum(xp.sqrt(xp.sum(levers**2, axis=-2, keepdims=True)), axis=0)
        size = xp.where(size > 0, size, 1.0)  # 0 of a joint of another chain
        return 0.5 * xp.clip(moment / (_BALANCED * size), -1.0, 1.0)


class Expansion(AbstractCorrection):
    """The difference of the thermometer from 20 C, 0 for readings without one: all lengths, and the travel of
    carriages, grow by it times one coefficient (steel 11.5e-6 / K, aluminium 23e-6, carbon fibre along it 1e-6)."""

    model = "expansion"
    words = ("expansion",)
    description = "thermal expansion of all lengths"
    unit = "1/K"
    usual_size = 2e-5
    of_arm = True
    column = "thermometer"
    sought = (Sought("thermal expansion", "", "temperature", "an arm that expands"),)

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        return (Term(self, "expansion", 0, 0),)

    def wrong(self, term: Term, joints: int) -> str:
        return "applies to the whole arm, so its name must have no number" if term.number or term.joint else ""

    def values(self, terms: Sequence[Term], q: Readings, forward: ForwardPass) -> Rows:
        return 0.0 * q.joints[:1] if q.thermometer is None else q.thermometer - REFERENCE_TEMPERATURE


class Load(AbstractCorrection):
    """Compliance under a load that was recorded beside the readings: a mass, kg, besides what the arm always carries,
    at the tip, or with the centre of mass that the arm has as ``load_centre``. A joint yields to the moment of its
    weight about the axis, rad/(kN m)."""

    model = "load"
    words = ("payload",)
    description = "joint compliances under a load at the tip"
    unit = "rad/(kN m)"
    usual_size = 1e-2  # 1 mrad for 100 N m
    usual_of_slide = 0.5
    rows = 3
    column = "load"
    sought = (
        Sought("load", "", "the moment of the load about joint {i}", "a joint or link that bends under the load"),
    )

    def values(self, terms: Sequence[Term], q: Readings, forward: ForwardPass) -> Rows:
        moments = moments_about(terms, [(1.0, self._centre(q, forward))] * len(terms), forward)
        return 0.0 * moments if q.load is None else KILO * STANDARD_GRAVITY * q.load * moments

    def _centre(self, q: Readings, forward: ForwardPass) -> Float[AnyArray, "... 3 N"]:
        """Where the load is, mm: its centre of mass, in the frame after the last joint that moves a pose."""
        if q.load_centre is None:
            return forward.tip
        centre = np.array(q.load_centre).reshape(-1, 3, *(1,) * forward.tip.ndim)
        if forward.members is not None:  # that of the chain of each pose
            of_chain = forward.members[len(forward.origin) :]
            centre = centre * of_chain.reshape(-1, 3, *of_chain.shape[1:])
        along = centre.sum(axis=0)
        return forward.origin[-1] + sum(along[k] * axis for k, axis in enumerate(forward.frame))


class Torque(AbstractCorrection):
    """Compliance: a joint yields to the torque of its drive, which was recorded beside its reading, N m (N of a slide).

    Unlike `Gravity`, this holds for whatever loads the joint: a tool, a cable, a process. Drives carry the arm, so that
    torques have the sign of what holds it against gravity. Where none were recorded, as for poses that are planned,
    simulated or commanded, they are those that hold masses that are known, in a base that stands upright; without
    masses they are 0.
    """

    model = "torque"
    words = ("torque",)
    description = "joint compliances under measured torques"
    unit = "rad/(kN m)"
    usual_size = 1e-2  # 1 mrad for 100 N m
    usual_of_slide = 0.5
    column = "torques"
    of_masses = True

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        return tuple(Term(self, "torque", 0, joint, loads) for joint in range(1, joints + 1))

    def values(self, terms: Sequence[Term], q: Readings, forward: ForwardPass) -> Rows:
        numbers = np.array([term.joint - 1 for term in terms])
        if q.torques is not None:
            return KILO * q.torques[numbers]
        if terms[0].loads is None:
            return 0.0 * q.joints[numbers]
        # Gravity points along -z: what holds the arm has the opposite sign, that of the moments' last component.
        return Gravity().values(terms, q, forward)[2::3]

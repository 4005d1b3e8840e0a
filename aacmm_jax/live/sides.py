"""From which side each joint came to a pose, and every pose from both sides: a joint with play rests elsewhere then."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.units import DEG
from ..kinematics.arm import Arm, by_joint
from ..planning.motion import start_from
from .places import COLUMNS, Setup, TakenPose
from .proposals import NextPose

_REVERSAL, _REVERSAL_LINEAR = 0.1 * DEG, 0.1  # rad, mm: a joint that turns back by less trembles
_SAME, _SAME_LINEAR = 1 * DEG, 5.0  # rad, mm: poses that differ by less are one pose, reached twice


class Sides:
    """From which side the joints came to where they are: 1 with rising readings, -1 with falling ones, 0 not known."""

    def __init__(self, arm: Arm):
        self._least = np.array(by_joint(arm, _REVERSAL, _REVERSAL_LINEAR))
        self._farthest: Float[np.ndarray, " n"] | None = None  # reading of each joint that is farthest on its way
        self.now = np.zeros(arm.joints)

    def add(self, q: Float[np.ndarray, " n"]) -> None:
        """The next readings."""
        moved = q - (q if self._farthest is None else self._farthest)
        turned = np.abs(moved) > self._least  # farther on its way, or back by more than it trembles
        self.now = np.where(turned, np.sign(moved), self.now)
        farther = turned | (moved * self.now > 0)
        self._farthest = q.copy() if self._farthest is None else np.where(farther, q, self._farthest)

    def columns(self) -> dict[str, float]:
        """As they are recorded beside a pose."""
        return {COLUMNS["directions"].format(i): float(side) for i, side in enumerate(self.now, start=1)}


def check_nothing_holds(setup: Setup) -> None:
    """`InputError` where a place holds the tip, which a motion from both sides takes out of it."""
    held = next((place.name for place in setup.places if not place.is_free), None)
    if held is not None:
        raise InputError(
            f"taking every pose from both sides moves the tip out of what holds it, but '{held}' is touched; leave out "
            "--both-sides, or measure the tip with an instrument or camera."
        )


def sides_of(columns: Mapping[str, float], joints: int) -> Float[np.ndarray, " n"]:
    """The sides that are recorded beside a pose; 0 where they are not."""
    return np.array([columns.get(COLUMNS["directions"].format(i), 0.0) for i in range(1, joints + 1)])


def from_both_sides(
    arm: Arm, proposed: NextPose | None, taken: Sequence[TakenPose], skipped: Sequence[NextPose] = ()
) -> NextPose | None:
    """The last pose again with its joints from their other sides, where it was reached once only; else the proposed
    one, with sides that are drawn, so that play of one joint differs from that of another.

    Args:
        arm: The arm, whose limits hold for the start of the motion.
        proposed: The pose to take next, if there is one.
        taken: The poses that count, in order.
        skipped: Proposals that are not to be made again.
    """
    sides = np.random.default_rng(len(taken)).choice([-1.0, 1.0], arm.joints)
    if taken:
        last, q = taken[-1], taken[-1].q[: arm.joints]
        alike = [pose.place == last.place and _is_same(arm, pose.q, q) for pose in taken]
        reached = next((i for i, same in enumerate(reversed(alike)) if not same), len(alike))
        gone = any(pose.place == last.place and _is_same(arm, pose.q, q) for pose in skipped)
        if reached % 2 and not gone:
            before = sides_of(last.columns, arm.joints)
            sides = np.where(before == 0, sides, -before)
            proposed = NextPose(last.place, q, f"Pose {last.number} again, each joint from its other side.", 0.0)
    return None if proposed is None else proposed._replace(approach=start_from(arm, proposed.q, sides))


def _is_same(arm: Arm, q: Float[np.ndarray, " n"], other: Float[np.ndarray, " n"]) -> bool:
    away = np.abs(q[: arm.joints] - other[: arm.joints])
    return bool(np.all(away < by_joint(arm, _SAME, _SAME_LINEAR)))

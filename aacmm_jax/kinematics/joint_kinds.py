"""Which joints of an arm or robot are prismatic, fixed or follow another, and which chains they form."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray, namespace

_UNIT = 1000.0  # mm: a slide of 1 mm counts as much as a rotation of 1 mrad, like the natural steps of parameters


_LINK = 1e-3  # of a chain's number, for each joint


def body_of(chain: Any, joint: Any = 0) -> Any:
    """The number of the tip of a chain (0), or of the link after a joint of it, from 1."""
    return chain + _LINK * joint


def _link_of(numbers: Float[AnyArray, "..."]) -> Any:
    """The joint before the link of each number; 0 of tips."""
    xp = namespace(numbers)
    return xp.round((numbers - xp.floor(numbers)) / _LINK).astype(int)


@jax.tree_util.register_static
@dataclass(frozen=True)
class JointKinds:
    """Which joints are prismatic, fixed or follow another, and which chains they form: static in every program.

    A single chain of revolute joints has None in its place: its programs are then those without such terms.
    """

    prismatic: tuple[bool, ...]
    # Joints without a reading of their own, from 0: the joint, the one that it follows, the factor, and an offset (rad,
    # mm). Fixed joints have the factor 0.
    followers: tuple[tuple[int, int, float, float], ...] = ()
    chains: tuple[tuple[int, ...], ...] = ()  # joints of each chain of a robot, from 0; none of an arm

    @property
    def units(self) -> Float[np.ndarray, " n"]:
        """Changes of the readings that count as much as each other: 1 rad, and 1000 mm of prismatic joints."""
        return np.where(self.mask(), _UNIT, 1.0)

    def mask(self, rank: int = 1) -> Bool[np.ndarray, "n ..."]:
        """Whether each joint is prismatic, with axes of length 1 after the first up to the given rank."""
        return np.asarray(self.prismatic).reshape(-1, *(1,) * (rank - 1))

    @cached_property
    def by_reading(self) -> Float[np.ndarray, "n n"]:
        """How much each joint moves with each reading; joints that follow others have no reading of their own."""
        matrix = np.eye(len(self.prismatic))
        for joint, source, factor, _ in self.followers:
            matrix[joint] = factor * matrix[source]
        return matrix

    @property
    def read(self) -> Float[np.ndarray, " n"]:
        """1 for joints that have a reading of their own, 0 for those that follow others."""
        return np.isin(np.arange(len(self.prismatic)), [joint for joint, *_ in self.followers], invert=True).astype(
            float
        )

    def fewest(self, q: Any) -> int:
        """The smallest number of joints with a reading of their own in a chain: of readings ``(..., columns)`` that are
        known, one that these poses are of."""
        if not self.chains:
            return int(self.read.sum())
        known = isinstance(q, np.ndarray) and q.size
        numbers = np.unique(q[..., len(self.read)]) if known else np.arange(len(self.chains))
        return int((self.members(numbers)[:, : len(self.read)] @ self.read).min())

    @cached_property
    def _of_chain(self) -> Float[np.ndarray, "c m"]:
        """1 where a joint, and after the joints a coordinate of the tips, is of a chain."""
        table = np.zeros((len(self.chains), len(self.prismatic) + 3 * len(self.chains)))
        for number, joints in enumerate(self.chains):
            first = len(self.prismatic) + 3 * number
            table[number, [*joints, first, first + 1, first + 2]] = 1.0
        return table

    @cached_property
    def _depth(self) -> Float[np.ndarray, " m"]:
        """How many joints of its chain come before each joint; of coordinates of the tips, all joints."""
        depth = np.full(self._of_chain.shape[1], float(len(self.prismatic)))
        for joints in self.chains:
            depth[list(joints)] = np.arange(len(joints))
        return depth

    def members(self, numbers: Float[AnyArray, "..."]) -> Float[AnyArray, "... m"]:
        """1 where a joint, and after the joints a coordinate of the tips, moves the body of which a pose is.

        The number of a body is that of a chain, of which it is the tip; or, of the link after a joint (from 1), that of
        a chain plus a thousandth of the joint's: `body_of`.
        """
        xp, chain = namespace(numbers), numbers.astype(int)
        last = np.concatenate([self._depth[-1:], self._depth[: len(self.prismatic)]])
        reach, depth = xp.asarray(last)[_link_of(numbers)][..., None], self._depth.reshape(*(1,) * numbers.ndim, -1)
        return xp.where(xp.asarray(depth) <= reach, xp.asarray(self._of_chain)[chain], 0.0)

    def is_body(self, numbers: Float[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
        """Whether each number is that of a chain's tip, or of a link of a chain."""
        inside = (numbers >= 0) & (numbers < len(self.chains))
        known = np.where(inside, numbers, 0.0)
        chain, link = known.astype(int), np.minimum(_link_of(known), len(self.prismatic))
        inside &= np.abs(numbers - body_of(chain, link)) < 1e-6
        return np.asarray(inside & ((link == 0) | (self._of_chain[chain, link - 1] > 0)))


def of_joints(geometry: Any, rows: Float[AnyArray, "columns ..."], offset: float = 1.0) -> Float[AnyArray, "n ..."]:
    """The readings of the joints alone, which come first, without what was recorded beside them: of joints without one,
    what the joint that they follow says. ``offset`` 0 for changes of the readings."""
    joints, kinds = geometry.alpha.shape[-1], geometry.kinds
    readings = rows if rows.shape[0] == joints else rows[:joints]
    if kinds is None or not kinds.followers:
        return readings
    offsets = np.zeros((joints, *(1,) * (rows.ndim - 1)))
    for joint, _, _, zero in kinds.followers:
        offsets[joint] = offset * zero
    return namespace(rows).tensordot(kinds.by_reading, readings, axes=1) + offsets


def members_of(geometry: Any, rows: Float[AnyArray, "columns ..."]) -> Float[AnyArray, "m ..."] | None:
    """`JointMotion.members`, from the column after the joints of a robot: the number of a pose's body."""
    if geometry.kinds is None or not geometry.kinds.chains:
        return None
    return namespace(rows).moveaxis(geometry.kinds.members(rows[geometry.alpha.shape[-1]]), -1, 0)


def to_tips(geometry: Any, rows: Float[AnyArray, "columns ..."]) -> Float[AnyArray, "columns ..."]:
    """The readings of a robot with the whole chain of each pose, of whose link it may be."""
    xp, joints = namespace(rows), geometry.alpha.shape[-1]
    return xp.concatenate([rows[:joints], xp.floor(rows[joints : joints + 1]), rows[joints + 1 :]])


def tips_at(geometry: Any, q: Float[AnyArray, "N columns"]) -> Float[AnyArray, "... 3"]:
    """The probe of an arm, or that of each pose's chain ``(N, 3)``, in its last frame, mm; 0 of a link."""
    if geometry.kinds is None or not geometry.kinds.chains:
        return geometry.probe
    number = q[:, geometry.alpha.shape[-1]]
    tips = geometry.probe.reshape(*geometry.probe.shape[:-1], -1, 3)[..., number.astype(int), :]
    at_tip = (_link_of(number) == 0).reshape(*(1,) * (tips.ndim - 2), -1, 1)
    return namespace(tips, q).where(at_tip, tips, 0.0)

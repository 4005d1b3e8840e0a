"""Which joints of an arm or robot are prismatic, fixed or follow another, and which chains they form."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray, namespace

_UNIT = 1000.0  # mm: a slide of 1 mm counts as much as a rotation of 1 mrad, like the natural steps of parameters


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
        counts = self.members[:, : len(self.read)] @ self.read
        known = isinstance(q, np.ndarray) and q.size
        return int(counts[np.unique(q[..., len(self.read)].astype(int))].min() if known else counts.min())

    @cached_property
    def members(self) -> Float[np.ndarray, "c m"]:
        """1 where a joint, and after the joints a coordinate of the tips, is of a chain."""
        table = np.zeros((len(self.chains), len(self.prismatic) + 3 * len(self.chains)))
        for number, joints in enumerate(self.chains):
            first = len(self.prismatic) + 3 * number
            table[number, [*joints, first, first + 1, first + 2]] = 1.0
        return table


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
    """`JointMotion.members`, from the column after the joints of a robot: the number of a pose's chain, from 0."""
    if geometry.kinds is None or not geometry.kinds.chains:
        return None
    xp, chain = namespace(rows), rows[geometry.alpha.shape[-1]]
    return xp.moveaxis(xp.asarray(geometry.kinds.members)[chain.astype(int)], -1, 0)


def tips_at(geometry: Any, q: Float[AnyArray, "N columns"]) -> Float[AnyArray, "... 3"]:
    """The probe of an arm, or that of each pose's chain ``(N, 3)``, in its last frame, mm."""
    if geometry.kinds is None or not geometry.kinds.chains:
        return geometry.probe
    chain = q[:, geometry.alpha.shape[-1]].astype(int)
    return geometry.probe.reshape(*geometry.probe.shape[:-1], -1, 3)[..., chain, :]

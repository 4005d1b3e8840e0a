"""Joints of a robot that were read once for several poses: those that carry all bodies of a contact.

Where two tips, or a tip and a surface, touched each other, both poses have the same readings of the joints that both
chains share, a torso or a rail. An error of such a reading moves both bodies together, so that it cancels in the
contact, whose place is unknown anyway: it is no error of these poses.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np

from ..core.arrays import is_concrete
from ..data.observations.contacts import AbstractContact
from ..data.observations.held import Socket, position_of
from ..data.observations.observation import AbstractObservation
from ..kinematics.arm import Arm

ReadOnce = tuple[tuple[int, tuple[int, ...]], ...]  # joints, from 0, and the poses in which each of them is no error


def joints_read_once(
    observations: Sequence[AbstractObservation], arm: Arm | None, ends: Iterable[Sequence[str]]
) -> ReadOnce:
    """The joints and poses of all contacts: one pose of each of several bodies, whose common joints have exactly the
    same readings, at a place that ``ends`` of no reference length is. None where readings are traced."""
    if arm is None or not arm.chains or not is_concrete(*(observation.q for observation in observations)):
        return ()
    poses, first, joints, kinds = defaultdict(list), 0, arm.joints, arm.geometry.kinds
    assert kinds is not None
    for observation in observations:
        if isinstance(observation, Socket) and not observation.target:
            poses[observation.position] += range(first, first + len(observation.q))
        elif isinstance(observation, AbstractContact):
            for i, name in enumerate(observation.socket, start=first):
                poses[position_of(name)].append(i)
        first += len(observation.q)
    q, measured = np.concatenate([np.asarray(observation.q) for observation in observations]), set().union(*ends)
    found = defaultdict(list)
    for name, rows in poses.items():
        if not 1 < len(rows) <= len(kinds.chains) or name in measured:
            continue
        bodies = q[rows, joints]
        common = np.flatnonzero(kinds.members(bodies)[:, :joints].all(axis=0))
        if len(set(bodies)) == len(rows) and np.all(q[rows][:, common] == q[rows[0], common]):
            for joint in common.tolist():
                found[joint] += rows
    return tuple((joint, tuple(sorted(rows))) for joint, rows in sorted(found.items()))

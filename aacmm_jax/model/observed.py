"""What a capture observed, as arrays: poses, unknown geometry, and observations in groups of one kind and shape.

The unknowns z are the p free parameters of the arm, then the numbers of the unknown geometry in the order of the
`Layout`: shared blocks first, then those that the solver eliminates. Sockets are observations here like any other. A
reference length is a relation between the positions of two sockets, a certified value one of a geometry with itself.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, namespace, pytree, set_at, static, to_numpy
from ..data.capture import Capture, check_one_capture, check_readings
from ..data.observations.declared import is_known
from ..data.observations.held import platform_frames, position_of
from ..data.observations.observation import AbstractObservation, Rows, Tips, offset_of
from ..data.observations.reduced_rows import MOVED
from ..kinematics.arm import Arm
from ..kinematics.chain import Geometry, JointMotion, forward_pass, joint_motion, tips_at
from ..kinematics.parameters import Parameters
from ..solver.arrow import split
from .layout import Layout, layout_of, unknowns_of
from .read_once import ReadOnce, joints_read_once
from .sockets import means_over_sockets

_STEPS = {"mm": 1.0, "rad": 1e-3, "px": 1.0, "1": 1.0}  # natural steps, as those of the arm's parameters


@pytree
class Observed:
    """Everything that a capture observed, as arrays: sockets first, then its other observations."""

    observations: tuple[AbstractObservation, ...]
    stacks: tuple[AbstractObservation, ...]  # the observations of each group of the layout as one
    q: Float[AnyArray, "M n"]
    motion: JointMotion | None  # None where the arm does not matter, but only what is unknown
    nominal: Float[AnyArray, " l"]  # reference lengths, mm
    u: Float[AnyArray, " l"]
    ends: tuple[tuple[str, str], ...] = static()  # names of the positions at their ends
    layout: Layout = static()
    read_once: ReadOnce = static()  # joints whose errors are none of some poses

    @classmethod
    def of(
        cls,
        capture: Capture,
        arm: Arm | None,
        *,
        lengths: bool = True,
        shared: Sequence[str] = (),
        read_once: ReadOnce | None = None,
    ) -> "Observed":
        """What a capture observed, by an arm with such joints; None where only what is unknown matters. Without its
        reference ``lengths`` sockets are independent of each other; ``shared`` as for `layout_of`; ``read_once`` is
        that of other readings, where those of the capture are traced. Raises `InputError` for a batch of captures."""
        check_one_capture(capture)
        capture = to_numpy(capture)
        if arm is not None:
            check_readings(capture, arm)
        xp, observations = namespace(capture), to_numpy(capture.parts)
        q = xp.concatenate([observation.q for observation in observations])
        references, ends = (capture.lengths, ends_of(capture)) if lengths else ((), ())
        layout = layout_of(observations, ends, shared)
        return cls(
            observations=observations,
            stacks=_stacks(observations, layout),
            q=q,
            motion=None if arm is None else joint_motion(to_numpy(arm.geometry), q),
            nominal=xp.stack([length.value for length in references]) if references else np.zeros(0),
            u=xp.stack([length.u for length in references]) if references else np.zeros(0),
            ends=ends,
            layout=layout,
            read_once=joints_read_once(observations, arm, ends_of(capture)) if read_once is None else read_once,
        )

    def moved(
        self, arm: Arm, q: Float[AnyArray, "M n"], observations: tuple[AbstractObservation, ...] | None = None
    ) -> "Observed":
        """The same at other readings, and with observations that have changed along."""
        changed = {} if observations is None else self._changed(observations)
        return dataclasses.replace(self, q=q, motion=joint_motion(arm.geometry, q), **changed)

    def _changed(self, observations: tuple[AbstractObservation, ...]) -> dict[str, Any]:
        return {"observations": observations, "stacks": _stacks(observations, self.layout)}

    @cached_property
    def counted(self) -> Float[np.ndarray, "n M"] | None:
        """1 where an error of a joint's reading is one of a pose, else 0; None where all are."""
        if not self.read_once:
            return None
        assert self.motion is not None
        counted = np.ones((len(self.motion.cos), len(self.q)))
        for joint, poses in self.read_once:
            counted[joint, list(poses)] = 0.0
        return counted

    @cached_property
    def blocks(self) -> dict[str, tuple[str, ...]]:
        """The parts of the unknown geometry in the order of its numbers, and the unit of each of these."""
        return dict(self.layout.parts)

    @cached_property
    def names(self) -> list[str]:
        """The parts in the order in which the observations name them."""
        return list(dict.fromkeys(name for observation in self.observations for name in unknowns_of(observation)))

    @property
    def positions(self) -> dict[str, np.ndarray]:
        """Indices of the numbers of each part among all of them."""
        return self.layout.positions

    @cached_property
    def steps(self) -> np.ndarray:
        """Natural step of each number: 1 mm, 1 mrad."""
        steps = {name: tuple(_STEPS[unit] for unit in units) for name, units in self.blocks.items()}
        for observation in self.observations:
            if not observation.linear:
                steps |= observation.steps
        return np.concatenate([steps[name] for name in self.blocks])

    @cached_property
    def slices(self) -> list[slice]:
        """The poses of each observation."""
        ends = np.cumsum([0, *(observation.q.shape[0] for observation in self.observations)]).tolist()
        return [slice(first, end) for first, end in itertools.pairwise(ends)]

    @cached_property
    def equations(self) -> int:
        """Number of equations: rows of all poses, reference lengths and certified values."""
        rows = sum(observation.pose_equations.sum() for observation in self.observations)
        known = (is_known(u) for _, u in self.certified().values())
        return int(rows) + len(self.ends) + sum(int(np.sum(mask)) for mask in known)

    @cached_property
    def arm_equations(self) -> int:
        """Those of them that show errors of the arm: of rows that are reduced, the first ones."""
        counts = [observation.equations for observation in self.observations]
        return self.equations - sum(int(count[MOVED:].sum()) for count in counts if count is not None)

    @cached_property
    def apart(self) -> int:
        """Unknowns that are determined without the arm: those that do not move a target as a whole, such as
        intrinsics."""
        used = (observation for observation in self.observations if observation.reduces)
        names = {name for observation in used for name in observation.apart}
        return sum(len(self.blocks[name]) for name in names)

    def split(self, geometry: Float[AnyArray, " g"]) -> dict[str, Float[AnyArray, " k"]]:
        """The numbers of each part."""
        ends = np.cumsum([0, *(len(units) for _, units in self.layout.parts)]).tolist()
        return {
            name: geometry[i:j] for (name, _), (i, j) in zip(self.layout.parts, itertools.pairwise(ends), strict=True)
        }

    def distances(
        self, geometry: Float[AnyArray, " g"], ends: Sequence[tuple[str, str]]
    ) -> tuple[Float[AnyArray, " l"], Float[AnyArray, "l g"]]:
        """Distances between the positions with these names, mm, and their derivatives by the numbers of the geometry:
        the unit vector at the end, and its opposite at the start."""
        xp = namespace(geometry)
        index = np.array([[self.positions[name] for name in pair] for pair in ends], dtype=int).reshape(-1, 2, 3)
        between = geometry[index[:, 1]] - geometry[index[:, 0]]
        sizes = xp.sqrt(xp.sum(between**2, axis=1))
        units, rows = between / sizes[:, None], np.arange(len(index))[:, None]
        pull = set_at(xp.zeros((len(index), len(geometry))), (rows, index[:, 0]), -units)
        return sizes, set_at(pull, (rows, index[:, 1]), units)

    def by_unknowns(
        self, derivatives: Float[AnyArray, "q g"], parameters: int
    ) -> tuple[Float[AnyArray, "q h"], list[Float[AnyArray, "q _ _"]]]:
        """Derivatives by the geometry as those by the head, with so many parameters, and by components; natural
        steps."""
        xp = namespace(derivatives)
        head, components = split(derivatives * self.steps[None], self.layout.shared, self.layout.classes)
        return xp.concatenate([xp.zeros((len(derivatives), parameters)), head], axis=1), components

    def certified(self) -> dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]:
        """Parts that have certified values: the values and their standard uncertainties."""
        values: dict[str, Any] = {}
        for observation in self.observations:
            if not observation.linear:  # sockets have none, and there may be thousands
                values |= observation.certified_values()
        return values

    def chain(self, space: Parameters, vector: Float[AnyArray, " p"], geometry: Float[AnyArray, " g"]) -> Geometry:
        """The chain with the tip that each pose held."""
        arm = space.geometry(vector)
        if not any(group.targeted for group in self.layout.groups):
            return arm
        xp, parts, probes = namespace(arm, geometry), self.split(geometry), []
        for observation in self.observations:
            probe = parts[offset_of(observation.target)] if observation.target else tips_at(arm, observation.q)
            probes.append(xp.broadcast_to(probe, (observation.q.shape[0], 3)))
        return arm._replace(probe=xp.concatenate(probes))

    def start(self, space: Parameters, vector: Float[AnyArray, " p"]) -> Float[AnyArray, " g"]:
        """The unknown geometry as the observations say, one after the other, by an arm that is nearly right; the frames
        of a platform as all that stands on it says together."""
        arm = space.geometry(vector)
        forward = forward_pass(arm, self.motion)
        tips = [tips_of(forward, rows) for rows in self.slices]
        parts: dict[str, Any] = {}
        for observation, tips_seen in zip(self.observations, tips, strict=True):
            probe = tips_at(arm, observation.q[:1]).reshape(3)
            new = observation.start(tips_seen, probe)
            if observation.target:
                new = {offset_of(observation.target): probe} | new
            parts = new | parts  # what another observation says stays
        parts |= platform_frames(self.observations, tips)
        for observation, tips_seen in zip(self.observations, tips, strict=True):
            parts = observation.start_with(tips_seen, parts) | parts
        return namespace(arm, forward).concatenate([parts[name] for name in self.blocks])

    def squared_distances(self, rows: Sequence[Rows]) -> list[Float[AnyArray, " _"]]:
        """Squared distances of the poses of each group from their geometry, mm^2, by the rows of the groups."""
        in_mm = [stack.in_mm(part.values, part.by_tip) for stack, part in zip(self.stacks, rows, strict=True)]
        return [namespace(vectors).sum(vectors**2, axis=0) for vectors in in_mm]

    def mean_by_observation(self, by_group: Sequence[Float[AnyArray, " _"]]) -> Float[AnyArray, " k"]:
        """Means over the poses of each observation of values with the poses of each group."""
        xp = namespace(by_group)
        members = np.concatenate([group.members for group in self.layout.groups])
        pairs = zip(by_group, self.layout.groups, strict=True)
        means = xp.concatenate([means_over_sockets(values, group.counts) for values, group in pairs])
        return means[np.argsort(members)]

    def by_observation(self, by_group: Sequence[Float[AnyArray, "... _"]]) -> list[Float[AnyArray, "... _"]]:
        """Arrays with the poses of each group last, as one for each observation."""
        by_observation: list[Any] = [None] * len(self.observations)
        for group, values in zip(self.layout.groups, by_group, strict=True):
            first = 0
            for number, count in zip(group.members, group.counts, strict=True):
                by_observation[number] = values[..., first : first + count]
                first += count
        return by_observation


def ends_of(capture: Capture) -> tuple[tuple[str, str], ...]:
    """Names of the positions at the ends of a capture's reference lengths."""
    return tuple((position_of(length.start), position_of(length.end)) for length in capture.lengths)


def _stacks(observations: tuple[AbstractObservation, ...], layout: Layout) -> tuple[AbstractObservation, ...]:
    members = [[observations[number] for number in group.members] for group in layout.groups]
    return tuple(some[0] if len(some) == 1 else type(some[0]).stacked(some) for some in members)


def tips_of(forward: Any, rows: Any) -> Tips:
    """The tips of some poses, and the axes of their last frames."""
    x, y, z = (axis[:, rows] for axis in forward.frame)
    return Tips(forward.tip[:, rows], (x, y, z))

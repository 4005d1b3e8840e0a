"""Where to put what is in a kit: random placements, ranked by the poses that they allow, then moved a little."""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from ..calibration.evaluation import fit_geometry
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.rotations import rotation_vector
from ..data.capture import Capture
from ..data.observations.observation import AbstractObservation, AbstractSimulated
from ..kinematics.workspace import TOOL_AXIS, Cone, SearchRegion, cones_of, reached, total_link_length
from ..model.observed import Observed
from ..uncertainty.linearisation import Linearisation
from .fedorov_exchange import Candidates, relaxed_value
from .information import PRIOR, DesignProblem
from .motion import approaches, hardly_reached
from .options import PlacementRegion
from .placement import best_layout

_PLACEMENTS, _DESIGNED, _NEIGHBOURS = 120, 8, 60
_STARTS, _DESIGN_STARTS = 120, 400  # random configurations for each thing: of the first score, and of the second
_ITERATIONS = 8  # of the relaxed design
_REACHED = 0.25  # fraction of the starts that must arrive in every place of what is placed
_LEAST_CANDIDATES = 8  # of every place of what stands where it is
_LEAST_U = 1e-4  # mm: an exact certified value would be a row of infinite weight
_START_AGREES = 0.1  # mm or rad: a start of the geometry that is farther off is fitted
_TRIES = 200
_SHIFT, _ROTATION = 0.06, 0.4  # of a neighbour: relative to the sum of the links; rad


class KitItem(NamedTuple):
    """An artefact or an instrument, and what may be chosen about it.

    Example:
        >>> ends = {"1": (0, 0, 0), "2": (300, 0, 0)}
        >>> bar = aj.data.observations.SimulatedArtefact("ball bar", ends, 2, u=0.001)
        >>> item = aj.planning.KitItem(bar, places=3, turned="vertical")
        >>> print(item.simulated.name, item.places)
        ball bar 3
    """

    simulated: AbstractSimulated
    places: int = 1  # how many placements to choose; 0 leaves it where it is
    turned: Literal["any", "vertical", "not"] = "any"  # about which axes it may be turned
    half_angle: float = math.pi  # of the cone from which the tool comes to it, rad
    # Out of its seats: in an artefact's own frame, for everything else in the base frame.
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @property
    def has_cone(self) -> bool:
        """Whether it can be approached from some directions only."""
        return self.half_angle < math.pi


class PlacedKit(NamedTuple):
    """Things in their places."""

    items: tuple[KitItem, ...]  # of which each is a placement
    kit: tuple[AbstractSimulated, ...]
    frames: tuple[Float[np.ndarray, " 6"] | None, ...]  # None of what stands where it is

    @property
    def parts(self) -> tuple[str, ...]:
        """The name of the item of each."""
        return tuple(item.simulated.name for item in self.items)

    def placed(self, frames: Sequence[Float[np.ndarray, " 6"] | None]) -> "PlacedKit":
        """The same things elsewhere."""
        things = zip(self.items, self.kit, frames, strict=True)
        kit: list[Any] = [
            thing if frame is None else item.simulated.placed(thing.name, frame) for item, thing, frame in things
        ]
        return PlacedKit(self.items, tuple(kit), tuple(frames))


class _WithoutErrors(np.random.Generator):
    """Errors that are all 0: a plan has the certified values that were stated, and measured values of the arm."""

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        return loc + 0.0 * scale * np.zeros(() if size is None else size)


def region_of(region: SearchRegion, simulated: AbstractSimulated, item: KitItem | None = None) -> SearchRegion:
    """The region of the tip that an observation holds, with the cone of its item."""
    if simulated.offset is not None:
        region = region._replace(arm=region.arm.replace(probe=simulated.offset))
    if item is None:
        return region
    normal = np.asarray(simulated.orientation) @ np.asarray(item.normal, dtype=float)
    axis = TOOL_AXIS if region.cones is None else tuple(region.cones.tool_axis.tolist())
    return region._replace(cones=cones_of([Cone(item.half_angle, tuple(normal.tolist()))], axis))


def set_up(
    region: SearchRegion,
    simulated: AbstractSimulated,
    starts: int,
    share: float = 0.0,
    item: KitItem | None = None,
    retract: float = 0.0,
) -> AbstractObservation:
    """Poses in one thing from random starts, as the observation that they would give without errors of the arm.

    ``item`` says from which cone it is approached, and ``retract`` how far its approach points are, mm. Raises
    `InputError` where a place is reached from fewer than this ``share`` of the starts, or hardly ever.
    """
    seat = region_of(region, simulated, item)
    places = len(simulated.changed(poses=1).tips(np.random.default_rng(0)))
    many = simulated.changed(poses=max(starts // places, 2 * _LEAST_CANDIDATES))
    tips = many.tips(region.random)
    q, good = reached(seat, seat.draw(len(tips)), tips, scattered=True)
    if item is not None:
        good[good] = approachable(seat, q[good], item, retract)
    transforms = np.asarray(seat.arm.pose(q)).copy()
    transforms[:, :3, 3] = tips
    # In NumPy: every number of poses would be another program of JAX.
    whole = to_numpy(many.recorded(q, transforms, _WithoutErrors(np.random.PCG64(0))))
    counts = np.bincount(whole.places[good], minlength=int(whole.places.max()) + 1)
    tried = np.bincount(whole.places)
    if np.any(counts < np.maximum(share * tried, _LEAST_CANDIDATES)):
        point = tips[whole.places == int(np.argmin(counts / tried))][0]
        raise InputError(hardly_reached(f"'{simulated.name}'", point))
    return whole.select(np.flatnonzero(good))


def approachable(
    region: SearchRegion, q: Float[np.ndarray, "c n"], item: KitItem, retract: float
) -> Bool[np.ndarray, " c"]:
    """Which poses of an item can be taken by way of their approach points; all where it has none."""
    if not (retract and item.has_cone and region.cones is not None):
        return np.ones(len(q), dtype=bool)
    return approaches(region, q, np.tile(region.cones.normals, (len(q), 1)), retract).possible


def candidates_of_kit(problem: DesignProblem, observations: Sequence[AbstractObservation]) -> Candidates:
    """The information that each pose of the observations would add, and that of certified values alone."""
    observed, space = Observed.of(Capture({}, (), observations), problem.arm), problem.space
    vector, p = np.asarray(space.vector()), len(space.names)

    def linear_at(geometry: Float[AnyArray, " g"]) -> Linearisation:
        z = np.concatenate([vector, np.asarray(geometry)])
        return Linearisation.at(observed, space, z, noise=problem.noise, least=_LEAST_U)

    linear = linear_at(observed.start(space, vector))
    if max(np.abs(rows.values).max() for rows in linear.point.rows) > _START_AGREES:
        linear = linear_at(fit_geometry(problem.arm, observed, {}, problem.noise).geometry)
    parts = linear.dense()
    rows = np.zeros((len(observed.q), max(3, *(part.shape[1] for part in parts)), len(linear.z)))
    owner = np.empty(len(observed.q), dtype=int)
    places = 0
    for observation, part, poses in zip(observed.observations, parts, observed.slices, strict=True):
        rows[poses, : part.shape[1]] = np.moveaxis(np.asarray(part) * linear.steps[:, None, None], 0, 2).swapaxes(0, 1)
        owner[poses] = places + observation.places
        places = owner[poses].max() + 1
    relations, _, u = linear.relations()
    scaled = relations * linear.steps / np.maximum(u, _LEAST_U)[:, None]
    return Candidates(rows, owner, PRIOR * np.eye(len(linear.z)) + scaled.T @ scaled, p)


def least_poses(observations: Sequence[AbstractObservation]) -> Int[np.ndarray, " s"]:
    """For each place of each observation: as many as determine its own unknowns, and two at least."""
    least = []
    for observation in observations:
        unknowns = sum(len(units) for units in observation.unknowns.values()) + (3 if observation.target else 0)
        places = int(observation.places.max()) + 1
        least += [max(2, math.ceil((unknowns + 1) / (observation.rows * places)))] * places
    return np.array(least)


def place(
    problem: DesignProblem,
    items: Sequence[KitItem],
    poses: int,
    ranges: PlacementRegion,
    report: Callable[[str, float], None],
) -> PlacedKit:
    """The best placement found of what is to be placed; the rest stands where it is."""
    of_things, kit = [], []
    for item in items:
        name = item.simulated.name
        if item.places and item.simulated.placed(name, np.zeros(6)) is None:
            raise InputError(f"'{name}' is an instrument and has no placements; remove its number of places.")
        names = [f"{name}/{i + 1}" for i in range(item.places)] if item.places > 1 else [name]
        kit += [item.simulated.changed(name=one) for one in names]
        of_things += [item] * len(names)
    standing = PlacedKit(tuple(of_things), tuple(kit), (None,) * len(kit))
    if not any(item.places for item in items):
        return standing
    return _Search(problem, standing, poses, ranges).best(report)


class _Search(NamedTuple):
    problem: DesignProblem
    standing: PlacedKit
    poses: int
    ranges: PlacementRegion

    def best(self, report: Callable[[str, float], None]) -> PlacedKit:
        """Random placements scored by random poses, the best few by relaxed designs, then neighbours of the best."""
        stage = "Placing the kit"
        scored: list[tuple[float, int, PlacedKit]] = []
        for number in range(_PLACEMENTS):
            report(stage, 0.4 * number / _PLACEMENTS)
            frames = [self._random_frame(item) if item.places else None for item in self.standing.items]
            layout = self.standing.placed(frames)
            pools = self._pools(layout, _STARTS)
            if pools is not None:
                scored.append((self._value(pools, 0), number, layout))
        if not scored:
            raise InputError(
                "no placement of the kit was found that can be reached well; give a region nearer to the arm, fewer "
                "places, or wider cones."
            )
        return best_layout(
            [layout for _, _, layout in sorted(scored)[:_DESIGNED]],
            lambda layout, best, pools: self._pools(layout, _DESIGN_STARTS, best, pools),
            lambda layout, pools: self._value(pools, _ITERATIONS),
            self._neighbour,
            _NEIGHBOURS,
            lambda fraction: report(stage, fraction),
        )

    def _value(self, pools: Sequence[AbstractObservation], iterations: int) -> float:
        candidates = candidates_of_kit(self.problem, pools)
        return relaxed_value(candidates, self.poses, self.problem.objective, iterations)

    def _pools(
        self,
        layout: PlacedKit,
        starts: int,
        before: PlacedKit | None = None,
        known: Sequence[AbstractObservation] | None = None,
    ) -> list[AbstractObservation] | None:
        """Poses in everything, those of what has not moved kept; None where something is hard to reach."""
        pools = []
        for i, (item, simulated, frame) in enumerate(zip(*layout, strict=True)):
            if before is not None and known is not None and frame is before.frames[i]:
                pools.append(known[i])
                continue
            try:
                share = 0.0 if frame is None else _REACHED
                pools.append(set_up(self.problem.region, simulated, starts, share, item))
            except InputError:
                if frame is None:
                    raise
                return None
        return pools

    def _random_frame(self, item: KitItem) -> Float[np.ndarray, " 6"]:
        """A rotation, and the middle of the thing where the tip of a random configuration is."""
        random = self.problem.region.random
        local = _extent(item.simulated)
        for _ in range(_TRIES):
            turn = {
                "any": Rotation.from_quat(random.normal(size=4)),
                "vertical": Rotation.from_rotvec([0, 0, random.uniform(-np.pi, np.pi)]),
                "not": Rotation.identity(),
            }[item.turned]
            middle = np.asarray(self.problem.arm.position(self.problem.region.draw(1)))[0]
            frame = _about(turn, local.mean(axis=0), middle)
            if self.ranges.contains(turn.apply(local) + frame[3:]).all():
                return frame
        raise InputError(f"'{item.simulated.name}' does not fit into the region; widen it.")

    def _neighbour(self, layout: PlacedKit) -> PlacedKit | None:
        """With one thing shifted and turned a little, or None where that leaves the region."""
        random = self.problem.region.random
        which = random.choice([i for i, frame in enumerate(layout.frames) if frame is not None])
        item, frame = layout.items[which], layout.frames[which]
        assert frame is not None
        axes = {"any": [1, 1, 1], "vertical": [0, 0, 1], "not": [0, 0, 0]}[item.turned]
        turn = Rotation.from_rotvec(_ROTATION * random.normal(size=3) * axes) * Rotation.from_rotvec(frame[:3])
        local = _extent(item.simulated)
        old = Rotation.from_rotvec(frame[:3]).apply(local.mean(axis=0)) + frame[3:]
        shift = _SHIFT * total_link_length(self.problem.arm) * random.normal(size=3)
        new = _about(turn, local.mean(axis=0), old + shift)
        if not self.ranges.contains(turn.apply(local) + new[3:]).all():
            return None
        return layout.placed([new if i == which else frame for i, frame in enumerate(layout.frames)])


def _extent(simulated: AbstractSimulated) -> Float[np.ndarray, "m 3"]:
    """Some of the points of a thing, where it stands."""
    return simulated.changed(poses=20).tips(np.random.default_rng(0))


def _about(turn: Rotation, middle: Float[np.ndarray, " 3"], to: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 6"]:
    """The frame that turns a thing and takes its middle to a point."""
    matrix = turn.as_matrix()
    return np.concatenate([np.asarray(rotation_vector(matrix)), to - matrix @ middle])

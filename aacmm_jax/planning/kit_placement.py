"""Where to put what is in a kit: random placements, ranked by the poses that they allow, then moved a little.

The information of a pose is that of the model's own rows (`uncertainty.linearisation`), so every kind of observation
that can be simulated can be planned, and nothing here depends on a kind.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from ..calibration.evaluation import fit_geometry
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.rotations import rotation_vector
from ..data.capture import Capture, ReferenceLength
from ..data.observations.observation import AbstractObservation
from ..data.observations.simulated import AbstractSimulated
from ..kinematics.workspace import TOOL_AXIS, Cone, SearchRegion, cones_of, lowest_point, reached, total_link_length
from ..model.observed import Observed
from ..uncertainty.linearisation import Linearisation
from .designs import Candidates, best_layout, relaxed_value
from .motion import approaches, hardly_reached
from .problem import PRIOR, DesignProblem

_PLACEMENTS, _DESIGNED, _NEIGHBOURS = 120, 8, 60
_STARTS, _DESIGN_STARTS = 120, 400  # random configurations for each thing: of the first score, and of the second
_ITERATIONS = 8  # of the relaxed design
_REACHED = 0.25  # fraction of the starts that must arrive in every place of what is placed
_LEAST_CANDIDATES = 8  # of every place of what stands where it is
_LEAST_U = 1e-4  # mm: an exact certified value would be a row of infinite weight
_START_AGREES = 0.1  # mm or rad: a start of the geometry that is farther off is fitted
_TRIES = 200
_SHIFT, _ROTATION = 0.06, 0.4  # of a neighbour: relative to the sum of the links; rad

Frame = Float[np.ndarray, " 6"]


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


class Thing(NamedTuple):
    """An item in one of its places."""

    item: KitItem
    simulated: AbstractSimulated
    frame: Frame | None = None  # None of what stands where it is

    def at(self, frame: Frame) -> "Thing":
        """The same thing elsewhere."""
        simulated: Any = self.item.simulated.placed(self.simulated.name, frame)
        return Thing(self.item, simulated, frame)

    def seat(self, region: SearchRegion) -> SearchRegion:
        """The region of the tip that it holds, with its cone."""
        simulated = self.simulated
        if simulated.offset is not None:
            region = region._replace(arm=region.arm.replace(probe=simulated.offset))
        if simulated.aim is not None:  # a camera leads a point before it, which may be below the table
            cone = Cone(simulated.aim.half_angle, simulated.aim.normal)
            return region._replace(cones=cones_of([cone], simulated.aim.axis), above=-math.inf)
        normal = np.asarray(simulated.orientation) @ np.asarray(self.item.normal, dtype=float)
        axis = TOOL_AXIS if region.cones is None else tuple(region.cones.tool_axis.tolist())
        return region._replace(cones=cones_of([Cone(self.item.half_angle, tuple(normal.tolist()))], axis))

    def usable(self, region: SearchRegion, q: Float[np.ndarray, "c n"], retract: float) -> Bool[np.ndarray, " c"]:
        """Which poses, that reach it, can be measured, and taken by way of its approach points where it has these."""
        seat, aim = self.seat(region), self.simulated.aim
        if aim is not None:
            on_arm = region.arm.replace(probe=np.array(aim.place))
            return self.simulated.measurable(np.asarray(seat.arm.pose(q))) & (lowest_point(on_arm, q) >= region.above)
        if not (retract and self.item.has_cone and seat.cones is not None):
            return np.ones(len(q), dtype=bool)
        return approaches(seat, q, np.tile(seat.cones.normals, (len(q), 1)), retract)[1]

    def recorded(self, region: SearchRegion, q: Float[np.ndarray, "c n"], poses: AbstractObservation | None) -> Any:
        """Poses with these readings, as they would be recorded without errors: those of an observation, moved about
        their tips, or measured anew where the measured values depend on how they are moved."""
        if poses is not None and self.simulated.aim is None:
            return poses.changed(q=q)
        transforms = np.asarray(self.seat(region).arm.pose(q))
        return to_numpy(self.simulated.changed(poses=len(q)).recorded(q, transforms, _without_errors()))


class _WithoutErrors(np.random.Generator):
    """Errors that are all 0: a plan has the certified values that were stated, and measured values of the arm."""

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        return loc + 0.0 * scale * np.zeros(() if size is None else size)


def _without_errors() -> np.random.Generator:
    return _WithoutErrors(np.random.PCG64(0))


def set_up(
    region: SearchRegion, thing: Thing, starts: int, share: float = 0.0, retract: float = 0.0
) -> AbstractObservation:
    """Poses in one thing from random starts, as the observation that they would give without errors of the arm.

    ``retract`` says how far its approach points are, mm. Raises `InputError` where a place is reached from fewer than
    this ``share`` of the starts, or hardly ever.
    """
    seat, simulated = thing.seat(region), thing.simulated
    places = len(simulated.changed(poses=1).tips(np.random.default_rng(0)))
    many = simulated.changed(poses=max(starts // places, 2 * _LEAST_CANDIDATES))
    tips = many.tips(region.random)
    q, good = reached(seat, seat.draw(len(tips)), tips, scattered=True)
    good[good] = thing.usable(region, q[good], retract)
    if simulated.aim is not None:
        if np.sum(good) < max(share * many.poses, _LEAST_CANDIDATES):
            raise InputError(
                f"'{simulated.name}' can be measured in {np.sum(good)} of {len(good)} random poses only; move the "
                "target or the camera, or allow other distances or tilts."
            )
        return thing.recorded(region, q[good], None)
    transforms = np.asarray(seat.arm.pose(q)).copy()
    transforms[:, :3, 3] = tips
    # In NumPy: every number of poses would be another program of JAX.
    whole = to_numpy(many.recorded(q, transforms, _without_errors()))
    counts = np.bincount(whole.places[good], minlength=int(whole.places.max()) + 1)
    tried = np.bincount(whole.places)
    if np.any(counts < np.maximum(share * tried, _LEAST_CANDIDATES)):
        point = tips[whole.places == int(np.argmin(counts / tried))][0]
        raise InputError(hardly_reached(f"'{simulated.name}'", point))
    return whole.select(np.flatnonzero(good))


def candidates_of_kit(
    problem: DesignProblem, observations: Sequence[AbstractObservation], lengths: Sequence[ReferenceLength] = ()
) -> Candidates:
    """The information that each pose of the observations would add, and that of certified values and reference lengths
    alone; unknowns are in the order of `Observed.of`."""
    return candidates_at(linearisation_of_kit(problem, observations, lengths), len(problem.space.names))


def candidates_at(linear: Linearisation, parameters: int) -> Candidates:
    """The same of a linearisation, whose first unknowns are so many parameters."""
    rows, owner = rows_by_pose(linear)
    relations, _ = rows_of_relations(linear)
    return Candidates(rows, owner, PRIOR * np.eye(len(linear.z)) + relations.T @ relations, parameters)


def linearisation_of_kit(
    problem: DesignProblem,
    observations: Sequence[AbstractObservation],
    lengths: Sequence[ReferenceLength] = (),
    found: tuple[Float[np.ndarray, " p"], Mapping[str, AnyArray]] | None = None,
) -> Linearisation:
    """Poses that were not taken yet, linearised with the nominal arm, or with ``found``: parameters, and the geometry
    of what was measured already, by the names of `Observed.of`."""
    observed, space = Observed.of(Capture({}, lengths, observations), problem.arm), problem.space

    def at(vector: Float[np.ndarray, " p"], geometry: Float[AnyArray, " g"]) -> Linearisation:
        z = np.concatenate([vector, np.asarray(geometry)])
        return Linearisation.at(observed, space, z, noise=problem.noise, least=_LEAST_U)

    if found is not None:
        vector, blocks = found
        start = observed.split(np.asarray(observed.start(space, vector)))
        return at(vector, np.concatenate([np.ravel(blocks.get(name, start[name])) for name in observed.blocks]))
    vector = np.asarray(space.vector())
    linear = at(vector, observed.start(space, vector))
    if max(np.abs(rows.values).max() for rows in linear.point.rows) > _START_AGREES:
        linear = at(vector, fit_geometry(problem.arm, observed, {}, problem.noise).geometry)
    return linear


def residual_vectors(linear: Linearisation) -> Float[np.ndarray, "m 3"]:
    """By which vector the tip of each pose is off, in the base frame, mm; 0 along what the pose does not measure."""
    vectors = np.zeros((len(linear.observed.q), 3))
    for part in linear.parts():
        by_tip = np.asarray(part.by_tip)
        values, moved = (np.asarray(part.observation.in_mm(np.asarray(x), by_tip)) for x in (part.values, by_tip))
        vectors[part.poses] = np.einsum("cxm,cm->mx", moved, values)
    return vectors


def rows_by_pose(linear: Linearisation) -> tuple[Float[np.ndarray, "m r z"], Int[np.ndarray, " m"]]:
    """Whitened derivatives of each pose by all unknowns in natural steps, and the place that it belongs to."""
    parts, observed = linear.dense(), linear.observed
    rows = np.zeros((len(observed.q), max(3, *(part.shape[1] for part in parts)), len(linear.z)))
    owner = np.empty(len(observed.q), dtype=int)
    places = 0
    for observation, part, poses in zip(observed.observations, parts, observed.slices, strict=True):
        rows[poses, : part.shape[1]] = np.moveaxis(np.asarray(part) * linear.steps[:, None, None], 0, 2).swapaxes(0, 1)
        owner[poses] = places + observation.places
        places = owner[poses].max() + 1
    return rows, owner


def rows_of_relations(linear: Linearisation) -> tuple[Float[np.ndarray, "l z"], Float[np.ndarray, " l"]]:
    """Whitened derivatives of reference lengths and certified values by all unknowns in natural steps, and their
    residuals in standard deviations."""
    relations, residuals, u = linear.relations()
    u = np.maximum(u, _LEAST_U)
    return relations * linear.steps / u[:, None], residuals / u


def least_poses(observations: Sequence[AbstractObservation]) -> Int[np.ndarray, " s"]:
    """For each place of each observation: as many as determine its own unknowns, and two at least."""
    least = []
    for observation in observations:
        unknowns = sum(len(units) for units in observation.unknowns.values()) + (3 if observation.target else 0)
        places = int(observation.places.max()) + 1
        least += [max(2, math.ceil((unknowns + 1) / (observation.rows * places)))] * places
    return np.array(least)


def place(problem: DesignProblem, items: Sequence[KitItem], poses: int) -> list[Thing]:
    """The best placement found of what is to be placed; the rest stands where it is."""
    things = []
    for item in items:
        name = item.simulated.name
        if item.places and item.simulated.placed(name, np.zeros(6)) is None:
            raise InputError(
                f"'{name}' is an instrument, which the plan does not place; set its number of placements (places) to 0."
            )
        names = [f"{name}/{i + 1}" for i in range(item.places)] if item.places > 1 else [name]
        things += [Thing(item, item.simulated.changed(name=name)) for name in names]
    if not any(item.places for item in items):
        return things

    def value(pools: Sequence[AbstractObservation], iterations: int) -> float:
        return relaxed_value(candidates_of_kit(problem, pools), poses, problem.objective, iterations)

    def report(fraction: float) -> None:
        problem.options.report("Placing the kit", fraction)

    scored: list[tuple[float, int, list[Thing]]] = []
    for number in range(_PLACEMENTS):
        report(0.4 * number / _PLACEMENTS)
        layout = [thing.at(_random_frame(problem, thing.item)) if thing.item.places else thing for thing in things]
        pools = _pools(problem, layout, _STARTS)
        if pools is not None:
            scored.append((value(pools, 0), number, layout))
    if not scored:
        raise InputError(
            "no placement of the kit was found in which the arm reaches every item in enough poses; give a region "
            "nearer to the arm, fewer placements, or wider cones."
        )
    return best_layout(
        [layout for _, _, layout in sorted(scored)[:_DESIGNED]],
        lambda layout, best, pools: _pools(problem, layout, _DESIGN_STARTS, best, pools),
        lambda layout, pools: value(pools, _ITERATIONS),
        lambda layout: _neighbour(problem, layout),
        _NEIGHBOURS,
        report,
    )


def _pools(
    problem: DesignProblem,
    layout: Sequence[Thing],
    starts: int,
    before: Sequence[Thing] | None = None,
    reusable: Sequence[AbstractObservation] | None = None,
) -> list[AbstractObservation] | None:
    """Poses in everything, those of what has not moved reused; None where something is hard to reach."""
    pools = []
    for i, thing in enumerate(layout):
        if before is not None and reusable is not None and thing.frame is before[i].frame:
            pools.append(reusable[i])
            continue
        try:
            pools.append(set_up(problem.region, thing, starts, 0.0 if thing.frame is None else _REACHED))
        except InputError:
            if thing.frame is None:
                raise
            return None
    return pools


def _random_frame(problem: DesignProblem, item: KitItem) -> Frame:
    """A rotation, and the middle of the thing where the tip of a random configuration is."""
    random = problem.region.random
    for _ in range(_TRIES):
        turn = {
            "any": Rotation.from_quat(random.normal(size=4)),
            "vertical": Rotation.from_rotvec([0, 0, random.uniform(-np.pi, np.pi)]),
            "not": Rotation.identity(),
        }[item.turned]
        middle = np.asarray(problem.arm.position(problem.region.draw(1)))[0]
        frame = _frame_within(problem, item, turn, middle)
        if frame is not None:
            return frame
    raise InputError(f"'{item.simulated.name}' does not fit into the region; widen the region.")


def _neighbour(problem: DesignProblem, layout: Sequence[Thing]) -> list[Thing] | None:
    """With one thing shifted and turned a little, or None where that leaves the region."""
    random = problem.region.random
    which = random.choice([i for i, thing in enumerate(layout) if thing.frame is not None])
    item, frame = layout[which].item, layout[which].frame
    assert frame is not None
    axes = {"any": [1, 1, 1], "vertical": [0, 0, 1], "not": [0, 0, 0]}[item.turned]
    former = Rotation.from_rotvec(frame[:3])
    turn = Rotation.from_rotvec(_ROTATION * random.normal(size=3) * axes) * former
    middle = former.apply(_points_of(item).mean(axis=0)) + frame[3:]
    shift = _SHIFT * total_link_length(problem.arm) * random.normal(size=3)
    moved = _frame_within(problem, item, turn, middle + shift)
    if moved is None:
        return None
    return [thing.at(moved) if i == which else thing for i, thing in enumerate(layout)]


def _frame_within(
    problem: DesignProblem, item: KitItem, turn: Rotation, middle: Float[np.ndarray, " 3"]
) -> Frame | None:
    """The frame that turns a thing and takes its middle to a point; None where that is not within the region."""
    points, matrix = _points_of(item), turn.as_matrix()
    frame = np.concatenate([np.asarray(rotation_vector(matrix)), middle - matrix @ points.mean(axis=0)])
    return frame if problem.contains(turn.apply(points) + frame[3:]).all() else None


def _points_of(item: KitItem) -> Float[np.ndarray, "m 3"]:
    """Some of the points of a thing, where it stands."""
    return item.simulated.changed(poses=20).tips(np.random.default_rng(0))

"""The poses that may be taken next: candidates in every place, and the set of them that reaches a target first.

After every pose the candidates are moved to where things were found, by the arm as it is calibrated so far. Rows of
other places and of another arm would seem to tell apart what the poses cannot: a SCARA whose plate was 12 mm lower than
stated was promised a fall of U from 0.3 mm to 0.03 mm by every pose, and got none of it.

The pose that is best on its own is often a poor start of a design. So all that is left of a capture is planned, by
exchange (`planning.designs`), again after every pose and from what was taken until then; of the planned poses the one
nearest to the present readings comes next.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..data.capture import Capture
from ..data.capture_data import ReferenceLength
from ..data.observations.observation import AbstractObservation
from ..kinematics.arm import Arm, joint_limits
from ..kinematics.chain import reading_units
from ..kinematics.workspace import lowest_point, reached
from ..model.observed import Observed
from ..planning.designs import Candidates, covariance_of, exchange
from ..planning.kit import neighbours
from ..planning.kit_placement import Thing, candidates_at, linearisation_of_kit, residual_vectors, set_up
from ..planning.motion import joint_weights
from ..planning.placement import LEAST_POSES
from ..planning.problem import DesignProblem, PlanOptions
from .places import FREE, Setup, TakenPose, by_thing, label_of

TEN = 10  # poses that a prediction is for
_STARTS, _OF_CAMERAS = 2000, 600  # random configurations in all things; with images, each of which has many rows
_FIRST, _MOST, _ADDED = 30, 60, 3  # poses of a plan where nothing is stated; the most ahead; added to them at once
_LEAST_ABOVE = 0.01  # share of random configurations above a table
_SEARCHED = 400  # candidates that an exchange tries, drawn anew after every pose
_SCALE_U = 1e-6  # of the scale of the nominal arm, where it is taken as exact

Observations = Sequence[AbstractObservation]


class Pool(NamedTuple):
    """Candidates in one session."""

    q: Float[np.ndarray, "c n"]
    place: Int[np.ndarray, " c"]  # index of each one's place in the setup
    candidates: Candidates
    columns: dict[str, np.ndarray]  # of each part of the unknown geometry, among all unknowns

    def known(self, information: Float[np.ndarray, "P P"]) -> Candidates:
        """The candidates, where so much is known already of their unknowns and perhaps of others."""
        rows = self.candidates.rows
        wider = np.pad(rows, ((0, 0), (0, 0), (0, len(information) - rows.shape[2])))
        return self.candidates._replace(rows=wider, base=information)


class Search:
    """The candidates of a setup, and its first plan.

    Args:
        setup: The arm, and the places.
        options: How poses are planned; by default as is usual for the arm's class, and above the table where no place
            is below it.

    Raises:
        InputError: No place can be reached, or there is nothing to plan for such an arm.
    """

    def __init__(self, setup: Setup, options: PlanOptions | None = None):
        self.setup = setup
        if options is None:
            options = PlanOptions.usual(setup.noise)._replace(space=setup.specification.space(), above=_table(setup))
        self.problem = DesignProblem.of(setup.specification.arm, options)
        arm = self.problem.arm
        self.weights = joint_weights(arm) / np.broadcast_to(reading_units(arm.geometry), (arm.joints,))
        self.things, self.unreached = dict[str, Thing](), dict[str, str]()
        drawn, groups = list[AbstractObservation](), by_thing(setup)
        for name, places in groups.items():
            thing = Thing(places[0].item, places[0].thing)
            try:
                starts = (_OF_CAMERAS if places[0].kind == "pixels" else _STARTS) // len(groups)
                poses = set_up(self.problem.region, thing, starts, retract=self.problem.options.retract)
            except InputError as error:
                self.unreached[name] = str(error)
                continue
            self.things[name] = thing
            drawn.append(poses)
        if not self.things:
            raise InputError(next(iter(self.unreached.values())))
        measured = setup.lengths or arm.prismatic or any(part.fixes_scale for part in drawn)
        self.scaled = bool(measured)  # whether anything determines the scale; else that of the nominal arm is taken
        self._names = {place.name: i for i, place in enumerate(setup.places)}
        self._pools: dict[tuple[str, str], Pool] = {}
        self._found: tuple[np.ndarray, Mapping[str, AnyArray]] | None = None
        self._without_unseen(self._pool([drawn], "", "").candidates)
        every = np.full(len(setup.places), LEAST_POSES)
        stated, self.planned = self._stated(drawn)
        first = [stated, drawn] if self.planned else [drawn]
        if not self.planned:
            pool = self._pool(first, "", "")
            self.planned = self.chosen(pool.candidates, min(_FIRST, len(pool.q)), least=every, sweeps=3)
        # Poses near to chosen ones are often far better than random ones.
        self._stated_sets = self._sets = [*first, self._near(first[0])]  # where things were stated, and found
        if len(first) == 1:
            self.planned = self.chosen(self.pool().candidates, len(self.planned), self.planned, every, sweeps=2)

    def _without_unseen(self, candidates: Candidates) -> None:
        """Take parameters that no candidate sees as exact, as the probe where a camera is beside it."""
        names = self.problem.space.names
        seen = np.abs(candidates.rows[:, :, : len(names)]).max(axis=(0, 1)) > 0
        objective, lengths = self.problem.objective, self.problem.lengths * seen
        if objective.kind == "functions":
            objective = objective._replace(functions=objective.functions * seen)
        self.problem = self.problem._replace(objective=objective, lengths=lengths)
        if not seen.all():
            unseen = ", ".join(name for name, known in zip(names, seen, strict=True) if not known)
            self.unreached[""] = f"Nothing here measures {unseen}: U takes them as exact."

    def follow(
        self, vector: Float[np.ndarray, " p"], arm: Arm, geometry: Mapping[str, AnyArray], session: str, probe: str
    ) -> None:
        """Move the candidates to where things were found, and take their rows there, with the parameters and the arm
        found; the session and its probe as in `pool`. A candidate that cannot be there stays where it was stated."""
        self._found, self._pools = (vector, geometry), {}
        region, self._sets = self.problem.region._replace(arm=arm), [list(own) for own in self._stated_sets]
        for own in self._sets:
            linear = linearisation_of_kit(self.problem, _in_session(own, session, probe), (), self._found)
            off, first = residual_vectors(linear), 0
            for i, (thing, part) in enumerate(zip(self.things.values(), own, strict=True)):
                rows, first = slice(first, first + len(part.q)), first + len(part.q)
                if thing.simulated.table in FREE:
                    continue
                q, seat = np.asarray(part.q), thing.seat(region)
                there, good = reached(seat, q, np.asarray(seat.arm.position(q)) - off[rows])
                # At a limit of a joint two may become one, which a capture would count once.
                good &= np.isin(np.arange(len(q)), np.unique(there, axis=0, return_index=True)[1])
                own[i] = part.changed(q=np.where(good[:, None], there, q))

    def away(self, q: Float[np.ndarray, "... n"], other: Float[np.ndarray, "... n"]) -> Float[np.ndarray, "..."]:
        """How far joints move from one configuration to another, summed, rad."""
        return np.asarray(np.abs((q - other) * self.weights).sum(axis=-1))

    def chosen(
        self,
        candidates: Candidates,
        count: int,
        start: Sequence[int] = (),
        least: int | Int[np.ndarray, " s"] = 0,
        sweeps: int = 0,
    ) -> list[int]:
        """The best candidates, beginning with some, and at least so many in each place."""
        if not isinstance(least, int):  # nothing is asked of a place without candidates
            there = np.bincount(candidates.owner)
            least = np.minimum(least[: len(there)], there)
        return exchange(candidates, count, self.problem.objective, least=least, sweeps=sweeps, start=start).tolist()

    def pool(self, session: str = "", probe: str = "") -> Pool:
        """The candidates in a session of several: its name, and that of its probe as in `join_sessions`."""
        if (session, probe) not in self._pools:
            self._pools[session, probe] = self._pool(self._sets, session, probe)
        return self._pools[session, probe]

    def u(self, information: Float[np.ndarray, "P P"]) -> float:
        """Largest standard uncertainty of a length over the volume, mm."""
        covariance = covariance_of(information, len(self.problem.space.names))
        return float(np.sqrt(max(self.variances(covariance).max(), 0.0)))

    def variances(self, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " v"]:
        """Of the lengths over the volume, mm^2."""
        return np.sum(self.problem.lengths @ covariance * self.problem.lengths, axis=1)

    def lacking(self, taken: Sequence[TakenPose]) -> Bool[np.ndarray, " s"]:
        """Which places have fewer poses than are wanted there; all of them, where none that can be reached has."""
        counts = Counter(pose.place for pose in taken)
        lacks = np.array([counts[place.name] < place.wanted for place in self.setup.places])
        lacks &= np.isin(np.arange(len(lacks)), self.pool().place)
        return lacks if lacks.any() else ~lacks

    def ahead(
        self, known: Candidates, ahead: Sequence[int], least: Int[np.ndarray, " s"], target: float | None,
        lacking: Bool[np.ndarray, " s"],
    ) -> list[int]:  # fmt: skip
        """What is left to be taken, planned again in the places that lack poses: as many poses as before, or some more
        or less where these do not reach the target (a standard uncertainty, mm) or fewer do; at least so many in each
        place."""
        random, rows, count = self.problem.region.random, np.flatnonzero(lacking[known.owner]), len(ahead)
        ahead = [row for row in ahead if lacking[known.owner[row]]]
        tried = np.unique([*ahead, *random.choice(rows, min(_SEARCHED, len(rows)), replace=False)]).astype(int)
        part = known._replace(rows=known.rows[tried], owner=known.owner[tried])
        chosen = self.chosen(part, max(count, 1), np.searchsorted(tried, ahead).tolist(), least * lacking, sweeps=1)

        def u(rows: Sequence[int]) -> float:
            return self.u(part.information(part.rows[list(rows)]))

        if target is not None and u(chosen) > target and len(chosen) < _MOST:
            chosen = self.chosen(part, len(chosen) + _ADDED, chosen, least, sweeps=1)
        while target is not None and len(chosen) > 1 and u(chosen) <= target:  # without that which is worth least
            spare = np.bincount(part.owner[chosen], minlength=len(least)) > least
            fewer = [[*chosen[:i], *chosen[i + 1 :]] for i in range(len(chosen)) if spare[part.owner[chosen[i]]]]
            best = min(fewer, key=u, default=chosen)
            if best is chosen or u(best) > target:
                break
            chosen = best
        return tried[chosen].tolist()

    def ten(self, known: Candidates, ahead: Sequence[int]) -> Float[np.ndarray, "P P"]:
        """The information after the ten best of the poses ahead, or after all and further ones."""
        rows = np.array(ahead, dtype=int)
        part = known._replace(rows=known.rows[rows], owner=known.owner[rows])
        first = rows[self.chosen(part, min(TEN, len(rows)))]
        return known.information(known.rows[self.chosen(known, TEN, first.tolist())])

    def _pool(self, sets: Sequence[Observations], session: str, probe: str) -> Pool:
        q, places, parts, prefix = [], [], [], f"{session}/" if session else ""
        columns: dict[str, np.ndarray] = {}
        for own in sets:
            q += [np.asarray(part.q) for part in own]
            places += [self._names[name] for part in own for name in _places_of(part)]
            parts_here = _in_session(own, session, probe)
            ends = {part.name for part in parts_here if part.kind == "socket"}
            lengths = [
                ReferenceLength(prefix + length.start, prefix + length.end, length.value, length.u)
                for length in self.setup.lengths
                if {prefix + length.start, prefix + length.end} <= ends
            ]
            linear = linearisation_of_kit(self.problem, parts_here, lengths, self._found)
            parts.append(candidates_at(linear, len(self.problem.space.names)))
            positions = Observed.of(Capture({}, lengths, parts_here), self.problem.arm).positions
            columns = {name: len(self.problem.space.names) + at for name, at in positions.items()}
        most = max(part.rows.shape[1] for part in parts)
        rows = [np.pad(part.rows, ((0, 0), (0, most - part.rows.shape[1]), (0, 0))) for part in parts]
        base = parts[0].base.copy()
        if not self.scaled:
            space = self.problem.space
            along = np.where(space.lengths, np.asarray(space.vector()), 0.0)  # natural steps of lengths are mm
            along /= _SCALE_U * (along @ along)
            base[: len(along), : len(along)] += np.outer(along, along)
        candidates = parts[0]._replace(rows=np.concatenate(rows), owner=np.array(places), base=base)
        return Pool(np.concatenate(q), np.array(places), candidates, columns)

    def _stated(self, drawn: Observations) -> tuple[list[AbstractObservation], list[int]]:
        """The poses that were planned, in each thing, one that was drawn where there are none; and their numbers."""
        stated, numbers, first = [], list[int](), 0
        for thing, part in zip(self.things.values(), drawn, strict=True):
            rows = {name: row for row, name in enumerate(_places_of(part))}
            poses = [(q, rows[place]) for place, q in self.setup.planned if place in rows]
            numbers += range(first, first + len(poses))
            q = np.array([q for q, _ in poses] or np.asarray(part.q)[:1])
            stated.append(thing.recorded(self.problem.region, q, part.select([row for _, row in poses] or [0])))
            first += len(q)
        return stated, numbers

    def _near(self, parts: Observations) -> list[AbstractObservation]:
        """Other poses near to the planned ones, which are the first candidates, in each thing."""
        near, first = [], 0
        for thing, part in zip(self.things.values(), parts, strict=True):
            chosen, first = np.array(self.planned) - first, first + len(part.q)
            rows = chosen[(chosen >= 0) & (chosen < len(part.q))]
            poses = part.select(np.sort(rows) if len(rows) else np.array([0]))
            around = neighbours(self.problem, thing, poses)
            same = (np.asarray(around.q)[:, None] == np.asarray(poses.q)).all(axis=2).any(axis=1)
            near.append(around.select(np.flatnonzero(~same)) if not same.all() else poses)
        return near


def _table(setup: Setup) -> float:
    """Height of the table, mm: at the base, unless a place is below it or the arm hardly ever is above it, as where the
    first axis points down."""
    arm = to_numpy(setup.specification.arm)
    ends = np.asarray(joint_limits(arm, None))
    q = np.random.default_rng(0).uniform(ends[:, 0], ends[:, 1], (_STARTS, arm.joints))
    heights = [float(place.position[2]) for place in setup.places if place.position is not None]
    below = min(heights, default=0.0) < 0 or np.mean(lowest_point(arm, q) >= 0) < _LEAST_ABOVE
    return -math.inf if below else 0.0


def _in_session(parts: Observations, session: str, probe: str) -> list[AbstractObservation]:
    return [part.in_session(session, probe) for part in parts] if session else list(parts)


def _places_of(poses: AbstractObservation) -> list[str]:
    """Name of the place of each pose."""
    label = label_of(poses)
    return [f"{poses.name}/{point}" for point in poses.stored()[label]] if label else [poses.name] * len(poses.q)

"""The pose to take next, of those that are planned: the one that tells most for the effort of going there, with few
changes from thing to thing.

At first a few poses are taken in each socket or artefact, since a calibration needs all of them; then more in a row.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..kinematics.arm import Arm
from ..kinematics.workspace import reached
from ..planning.designs import Candidates, covariance_of
from ..planning.motion import approaches, move_contacts
from ..planning.placement import LEAST_POSES
from .candidates import Search
from .limits import gained
from .places import TakenPose

_HERE = 0.15  # rad, summed over joints: nearer than this a pose is the same
_FIRST_VISIT, _VISIT = 4, 8  # poses in a row in one thing while others still have too few, and afterwards
_AWAY = 1e3  # rad that count for a change of place against the order
_POSE, _LEAST_GAIN = 1.0, 1e-3  # rad that taking a pose counts besides the motion; least gain of one
_UNPLANNED, _TRIED = 10.0, 30  # rad that count for a candidate that is not planned; how many of these are tried
_MOVES = 6  # that are checked for collisions


class NextPose(NamedTuple):
    """A pose to take: its place, the readings to go to, why, how far the joints move, rad, and the readings of its
    approach point, if it has one."""

    place: str
    q: Float[np.ndarray, " n"]
    why: str
    distance: float
    approach: Float[np.ndarray, " n"] | None = None


class Proposals:
    """Proposes poses of a capture.

    Args:
        search: The candidates.
        known: They, with what is known so far.
        arm: The arm as it is calibrated so far, or the nominal one.
        positions: Of the places that were found with it.
        taken: The poses that count, in order.
        now: Present readings, if they are known.
        skipped: Proposals that are not to be made again.
    """

    def __init__(
        self, search: Search, known: Candidates, arm: Arm, positions: Mapping[str, Float[np.ndarray, " 3"]],
        taken: Sequence[TakenPose], now: Float[np.ndarray, " n"] | None, skipped: Sequence[NextPose],
    ):  # fmt: skip
        self.search, self.known, self.arm, self.positions = search, known, arm, positions
        self.taken, self.now, self.skipped, self.pool = taken, now, skipped, search.pool()
        places, names = search.setup.places, list(search.things)
        self._things = np.array([names.index(p.thing.name) if p.thing.name in names else -1 for p in places])
        by_name = {place.name: thing for place, thing in zip(places, self._things, strict=True)}
        self._visited = [int(by_name[pose.place]) for pose in taken if by_name[pose.place] >= 0]
        self._counts = np.bincount(self._visited, minlength=len(names))

    def again(self, pose: TakenPose, why: str) -> NextPose | None:
        """A pose that does not fit, once more; None where that was skipped."""
        q = pose.q[: len(self.search.weights)]
        return None if self._is_old(pose.place, q, last=False) else self._proposed(pose.place, q, why, False)

    def best(self, ahead: Sequence[int], place: str | None) -> NextPose | None:
        """Of the planned candidates the one that is worth most for its effort and that the joints can move to without a
        collision, or of all candidates, where none is left; in ``place``, where that is given, else in the places that
        lack poses, and in others only where there is no other way."""
        owner, names = self.known.owner, [place.name for place in self.search.setup.places]
        inside = self.search.lacking(self.taken) if place is None else np.array([name == place for name in names])
        planned, every = np.array([*ahead, *self._in_needy_things()], dtype=int), np.arange(len(self.pool.q))
        choices = [(planned[inside[owner[planned]]], False), (every[inside[owner]], True), (every, True)]
        for rows, unplanned in choices if place is None else choices[:2]:
            rows = np.array([i for i in rows if not self._is_old(names[owner[i]], self.pool.q[i])], dtype=int)
            if unplanned and len(rows):  # of all of them those that are worth most
                part = self.known._replace(rows=self.known.rows[rows], owner=owner[rows])
                rows = rows[self.search.chosen(part, min(_MOVES, len(rows)))]
            for row in self._in_order(rows, ahead):
                why = gained(self.search.problem, self.known, row)
                if (proposed := self._proposed(names[owner[row]], self.pool.q[row], why)) is not None:
                    return proposed
        return None

    def _is_old(self, place: str, q: np.ndarray, last: bool = True) -> bool:
        """Whether a pose was just taken, or skipped."""
        old = [pose.q for pose in self.skipped if pose.place == place]
        old += [self.taken[-1].q[: len(q)]] if last and self.taken else []
        return any(self.search.away(q, other) < _HERE for other in old)

    def _in_order(self, rows: Int[np.ndarray, " r"], ahead: Sequence[int]) -> list[int]:
        """The first few of some candidates, those without a collision on the way first."""
        now = self.now
        if now is None or not len(rows):
            return rows[:_MOVES].tolist()
        effort = _POSE + self.search.away(self.pool.q[rows], now) + _UNPLANNED * ~np.isin(rows, ahead)
        effort += self._change_of_place(self._things[self.known.owner[rows]])
        first = rows[np.argsort(effort / self._gains(rows))[:_MOVES]]
        contacts = move_contacts(self.search.problem.region, np.tile(now, (len(first), 1)), self.pool.q[first])
        return [int(i) for i, _ in sorted(zip(first, contacts, strict=True), key=lambda pair: pair[1] is not None)]

    def _gains(self, rows: Int[np.ndarray, " r"]) -> Float[np.ndarray, " r"]:
        """By how much each candidate lowers the variances of lengths: the mean difference of their logarithms."""

        def logs(information: np.ndarray) -> np.ndarray:
            return np.log(self.search.variances(covariance_of(information, self.known.parameters)))

        before = logs(self.known.base)
        gains = [np.mean(before - logs(self.known.information(self.known.rows[[row]]))) for row in rows]
        return np.maximum(gains, _LEAST_GAIN)

    def _in_needy_things(self) -> list[int]:
        """Some candidates in things that have too few poses, since few may be planned there, which prove impossible."""
        things = self._things[self.known.owner]
        return [
            int(i) for k in np.flatnonzero(self._counts < LEAST_POSES) for i in np.flatnonzero(things == k)[:_TRIED]
        ]

    def _change_of_place(self, things: Int[np.ndarray, " r"]) -> Float[np.ndarray, " r"]:
        """What a candidate in another thing than the last pose counts beside the motion to it, rad."""
        if not self._visited:
            return np.zeros(len(things))
        here, few = self._visited[-1], bool(self._counts.min() < LEAST_POSES)
        run = next((i for i, thing in enumerate(reversed(self._visited)) if thing != here), len(self._visited))
        if run < (_FIRST_VISIT if few else _VISIT):
            return _AWAY * (things != here)
        return _AWAY * ((things == here) + (self._counts[things] if few else 0.0))

    def _proposed(self, place: str, q: np.ndarray, why: str, fresh: bool = True) -> NextPose | None:
        """A pose with its tip where the place is, by the arm as it is calibrated so far; None where it cannot be there,
        or would be no other pose, though a ``fresh`` one is wanted."""
        region, approach = self.search.problem.region, None
        thing, now = self.search.things[self.search.setup.place(place).thing.name], self.now
        if fresh and place in self.positions:
            seat = thing.seat(region._replace(arm=self.arm))
            there, good = reached(seat, q[None], self.positions[place][None])
            if not good[0] or self._is_old(place, there[0]):
                return None
            q = there[0]
        retract, seat = self.search.problem.options.retract, thing.seat(region)
        if retract and thing.item.has_cone and seat.cones is not None:
            above, good = approaches(seat, q[None], seat.cones.normals[:1], retract)
            approach = above[0] if good[0] else None
        return NextPose(place, q, why, 0.0 if now is None else float(self.search.away(q, now)), approach)

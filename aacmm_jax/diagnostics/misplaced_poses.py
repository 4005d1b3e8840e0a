"""Poses whose rows were mixed up: under the name of another place, exchanged, late by some rows, or with a reading that
is far off.

A robust fit (`rough_fit`) shows which poses are wrong. What was done to them is then tried one by one: a correction
explains a pose if it brings the tip to where that fit expects it. One mistake that explains all wrong poses comes
before several that explain one or two each.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.text import listed, pluralise
from ..core.units import DEG
from ..data.capture import Capture
from ..data.observations.observation import AbstractObservation
from .hypotheses import pose_names
from .rough_fit import RoughFit

_ROWS = 3  # most rows by which readings are late or early
_TURNS = 90  # readings of a joint that are tried, over a full turn
_REFINED = 20  # halvings of the step between these
_APART = 4.0  # the factor by which any other joint must explain a pose worse for one to be named
_MOST_WRONG = 40  # poses, of which pairs are compared

Place = tuple[str, str]  # name of a socket or observation, and the point of it, if it has several


class Misplaced(NamedTuple):
    """Poses that one mistake explains."""

    poses: tuple[int, ...]  # numbers among all poses
    names: tuple[str, ...]
    says: str  # the mistake, a sentence
    distance: float  # of the farthest of them from where it is expected, mm
    groups: tuple[str, ...] = ()  # sockets or observations that the mistake is about

    @property
    def concerns(self) -> tuple[str, ...]:
        """What is wrong, first: the pose, or the groups to which several belong."""
        return (*self.names, *self.groups) if len(self.names) == 1 else (*self.groups, *self.names)


def misplaced_poses(fit: RoughFit, capture: Capture) -> list[Misplaced]:
    """The mistakes that explain which poses of a capture are wrong in its rough fit, the largest first."""
    return _Search(fit, capture).run()


class _Search:
    """The wrong poses of a rough fit, and what is tried on them."""

    def __init__(self, fit: RoughFit, capture: Capture):
        self.fit, self.names = fit, pose_names(capture)[0]
        sizes = [observation.q.shape[0] for observation in fit.observations]
        self.owner = np.repeat(np.arange(len(sizes)), sizes)
        self.row = np.concatenate([np.arange(size) for size in sizes])
        self.q = np.concatenate([np.asarray(observation.q) for observation in fit.observations])
        self.away = np.concatenate([fit.distances(observation) for observation in fit.observations])
        self.wrong: list[int] = np.flatnonzero(self.away > fit.limit).tolist()

    def run(self) -> list[Misplaced]:
        left, mistakes = self.wrong, list[Misplaced]()
        for explain in (self._late, self._exchanged_places, self._exchanged_readings, self._elsewhere, self._joint):
            mistakes += explain(left) if left else []
            explained = {pose for mistake in mistakes for pose in mistake.poses}
            left = [pose for pose in left if pose not in explained]
        return sorted(mistakes, key=lambda mistake: -len(mistake.poses))

    def _mistake(self, poses: Sequence[int], says: str, groups: Sequence[str] = ()) -> Misplaced:
        names, away = tuple(self.names[pose] for pose in poses), float(self.away[list(poses)].max())
        return Misplaced(tuple(poses), names, says, away, tuple(dict.fromkeys(groups)))

    def _with_readings(self, pose: int, q: Float[np.ndarray, "k n"]) -> Float[np.ndarray, " k"]:
        """Distances of one pose with each of several readings."""
        observation = self.fit.observations[self.owner[pose]].select(np.full(len(q), self.row[pose]))
        return self.fit.distances(observation.changed(q=q))

    def _late(self, wrong: list[int]) -> list[Misplaced]:
        """All readings some rows late or early, also over the borders of sockets and files; not where all wrong poses
        of one place fit one other: then its name is the simpler mistake."""
        grouped = list(self._by_place(wrong).values())
        if len(wrong) < 2 or [len(poses) for poses in grouped] == [len(wrong)]:
            return []
        for rows in (by for size in range(1, _ROWS + 1) for by in (size, -size)):
            # Both the reading that such a pose should have, and the pose that should have its reading.
            pairs = [(pose, pose + rows) for pose in wrong] + [(pose - rows, pose) for pose in wrong]
            pairs = [(pose, at) for pose, at in pairs if min(pose, at) >= 0 and max(pose, at) < len(self.q)]
            apart = np.array([self._with_readings(pose, self.q[[at]])[0] for pose, at in pairs])
            if len(pairs) > len(wrong) and np.all(apart <= self.fit.near):
                side, other = ("late", "next") if rows > 0 else ("early", "previous")
                which = f"the {other} row" if abs(rows) == 1 else f"{abs(rows)} rows further"
                says = f"the readings are {pluralise(abs(rows), 'row')} {side}: these poses fit with those of {which}"
                return [self._mistake(wrong, says)]
        return []

    def _places(self, wrong: list[int]) -> dict[int, Place]:
        """Where each wrong pose fits: the closest other socket, observation or point."""
        closest, places = dict.fromkeys(wrong, self.fit.near), {}
        for other in self.fit.observations:
            labels = [entry.name for entry in other.entries if entry.of_poses and entry.content == "text"]
            fields = [name for name in other.by_pose if name not in labels]
            poses = [pose for pose in closest if self._alike(pose, other)]
            if not poses:
                continue
            pairs = [(self.fit.observations[self.owner[pose]], self.row[pose]) for pose in poses]
            rows = {name: np.stack([np.asarray(getattr(part, name))[row] for part, row in pairs]) for name in fields}
            for first in np.unique(other.places, return_index=True)[1]:
                moved = other.select(np.full(len(poses), first)).changed(**rows)
                place = other.name, " ".join(getattr(other, label)[first] for label in labels)
                for pose, distance in zip(poses, self.fit.distances(moved), strict=True):
                    if distance < closest[pose]:
                        closest[pose], places[pose] = distance, place
        return places

    def _alike(self, pose: int, other: AbstractObservation) -> bool:
        """Whether a pose could have been recorded as one of another observation."""
        own = self.fit.observations[self.owner[pose]]
        return type(own) is type(other) and own.by_pose == other.by_pose

    def _own_place(self, pose: int) -> Place:
        own, row = self.fit.observations[self.owner[pose]], self.row[pose]
        labels = [entry.name for entry in own.entries if entry.of_poses and entry.content == "text"]
        return own.name, " ".join(getattr(own, label)[row] for label in labels)

    def _by_place(self, wrong: list[int]) -> dict[tuple[Place, Place], list[int]]:
        """Wrong poses by where they were recorded and where they fit."""
        grouped: dict[tuple[Place, Place], list[int]] = {}
        for pose, place in self._places(wrong).items():
            grouped.setdefault((self._own_place(pose), place), []).append(pose)
        return grouped

    def _exchanged_places(self, wrong: list[int]) -> list[Misplaced]:
        """Two sockets, observations or points under each other's name."""
        grouped, mistakes = self._by_place(wrong), []
        for (own, place), poses in grouped.items():
            back = grouped.get((place, own), [])
            if own < place and min(len(poses), len(back)) > 1:
                says = f"{_words(own)} and {_words(place)} are exchanged: poses of each fit the other"
                mistakes.append(self._mistake([*poses, *back], says, (own[0], place[0])))
        return mistakes

    def _exchanged_readings(self, wrong: list[int]) -> list[Misplaced]:
        """Pairs of poses that fit with each other's readings."""
        wrong, mistakes = wrong[:_MOST_WRONG], []
        fits = np.array([self._with_readings(pose, self.q[wrong]) <= self.fit.near for pose in wrong])
        left = np.ones(len(wrong), dtype=bool)
        for i, j in zip(*np.nonzero(np.triu(fits & fits.T, 1)), strict=True):
            if left[i] and left[j]:
                left[[i, j]] = False
                names = listed([self.names[wrong[i]], self.names[wrong[j]]])
                says = f"the readings of {names} are exchanged: each fits with those of the other"
                mistakes.append(self._mistake([wrong[i], wrong[j]], says))
        return mistakes

    def _elsewhere(self, wrong: list[int]) -> list[Misplaced]:
        """Poses under the name of another socket, observation or point."""
        return [
            self._mistake(poses, f"recorded under {_words(own)}, but {_words(place)} fits", (own[0], place[0]))
            for (own, place), poses in self._by_place(wrong).items()
        ]

    def _joint(self, wrong: list[int]) -> list[Misplaced]:
        """Single poses, with the reading that alone explains why they are far off, if there is one."""
        return [self._mistake([pose], self._off(pose)) for pose in wrong]

    def _off(self, pose: int) -> str:
        turning = [i for i in range(self.fit.arm.joints) if i + 1 not in self.fit.arm.prismatic]
        least = {}
        for joint in turning:
            turns, step = np.arange(_TURNS) * (2 * np.pi / _TURNS) - np.pi, 2 * np.pi / _TURNS
            for _ in range(_REFINED):
                tried = np.repeat(self.q[[pose]], len(turns), axis=0)
                tried[:, joint] += turns
                distances = self._with_readings(pose, tried)
                best = int(np.argmin(distances))
                least[joint] = float(distances[best]), float(turns[best])
                step /= 2
                turns = turns[best] + step * np.array([-1.0, 0.0, 1.0])
        (joint, (distance, turn)), *others = sorted(least.items(), key=lambda item: item[1][0])
        says = f"{self.away[pose]:.2g} mm off"
        if distance > self.fit.near or any(_APART * distance > other for _, (other, _) in others):
            return says
        return f"{says}, as if the reading of joint {joint + 1} were wrong by {-turn / DEG:.2g} deg"


def _words(place: Place) -> str:
    name, label = place
    return f"{label} of {name}" if label else name

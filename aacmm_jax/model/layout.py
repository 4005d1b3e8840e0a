"""Where the numbers of an unknown geometry stand, and which observations are evaluated together.

The unknowns of a problem are the parameters, then the shared blocks of geometry (what several observations use), then
the private ones, which the solver eliminates. What one observation alone uses is one component; a reference length
makes one of the components of its two sockets. A component of more than a few dozen numbers joins the shared blocks,
since a dense block of that size costs as much.

Everything here is static: it follows from names and numbers of poses, and fixes a compiled program.
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..data.observations.observation import POINT, AbstractObservation, offset_of

_LARGEST_COMPONENT = 36  # numbers
_MOST_STACKED = 200  # poses of an observation that is evaluated together with others

Units = tuple[str, ...]


class Role(NamedTuple):
    """One of the unknowns of a group's observations: a part of the geometry for each of them."""

    first: tuple[int, ...]  # index of the first number of each part among the geometry's
    size: int
    private: bool


class Group(NamedTuple):
    """Observations of one kind and shape, whose rows are evaluated at once."""

    members: tuple[int, ...]  # numbers of the observations, component by component
    poses: tuple[tuple[int, int], ...]  # of each member, first and last but one among all
    roles: tuple[Role, ...]  # as the kind names its unknowns; then the place of the target, where there is one
    targeted: bool
    of: int  # class of the components; -1 where no unknown is private
    sizes: tuple[int, ...]  # poses of each component
    start: tuple[int, ...]  # of each member's private numbers within its component

    @property
    def counts(self) -> tuple[int, ...]:
        """Poses of each member."""
        return tuple(last - first for first, last in self.poses)

    @property
    def index(self) -> slice | np.ndarray:
        """Its poses among all."""
        if all(one[1] == other[0] for one, other in zip(self.poses, self.poses[1:], strict=False)):
            return slice(self.poses[0][0], self.poses[-1][1])
        return np.concatenate([np.arange(first, last) for first, last in self.poses])


class Layout(NamedTuple):
    """The unknown geometry of a problem and the groups of its observations."""

    parts: tuple[tuple[str, Units], ...]  # names and units of the numbers, shared ones first
    shared: int  # numbers of the shared blocks
    classes: tuple[tuple[int, int], ...]  # number and size of the components of each class
    linear: int  # how many of the classes, the last ones, have rows linear in their numbers: positions of sockets
    groups: tuple[Group, ...]

    @property
    def means_alone(self) -> bool:
        """Whether all that is unknown are positions of sockets, which are means of tips where all weigh the same."""
        return not self.shared and self.linear == len(self.classes)

    @property
    def positions(self) -> dict[str, np.ndarray]:
        """Indices of the numbers of each part among all of them."""
        return _positions(self.parts)

    def component_of(self, index: int) -> tuple[int, int, int]:
        """Class, component, and place in it of a number of the geometry; -1, 0 and itself of a shared one."""
        if index < self.shared:
            return -1, 0, index
        first = self.shared
        for number, (count, size) in enumerate(self.classes):
            if index < first + count * size:
                return number, (index - first) // size, (index - first) % size
            first += count * size
        raise IndexError(index)


@lru_cache(maxsize=32)
def _positions(parts: tuple[tuple[str, Units], ...]) -> dict[str, np.ndarray]:
    ends = np.cumsum([len(units) for _, units in parts])
    return {name: np.arange(end - len(units), end) for (name, units), end in zip(parts, ends, strict=True)}


def unknowns_of(observation: AbstractObservation) -> dict[str, Units]:
    """Parts of the geometry that an observation uses, with the place of its target last."""
    found = dict(observation.unknowns)
    if observation.target:
        found[offset_of(observation.target)] = POINT
    return found


def layout_of(observations: Sequence[AbstractObservation], ends: Sequence[tuple[str, str]]) -> Layout:
    """The layout of a problem; ``ends`` are the names of the positions at the ends of its reference lengths."""
    return _Problem(observations, ends).layout()


class _Problem:
    """What `layout_of` knows of each observation."""

    def __init__(self, observations: Sequence[AbstractObservation], ends: Sequence[tuple[str, str]]):
        self.observations = observations
        self.used = [unknowns_of(observation) for observation in observations]
        self.units: dict[str, Units] = {}
        users: dict[str, list[int]] = {}
        for number, parts in enumerate(self.used):
            self.units |= parts
            for name in parts:
                users.setdefault(name, []).append(number)
        alone = {name: numbers[0] for name, numbers in users.items() if len(numbers) == 1}
        # A length with one shared end says something of what is shared alone.
        half = {name for pair in ends if (pair[0] in alone) != (pair[1] in alone) for name in pair}
        alone = {name: number for name, number in alone.items() if name not in half}
        # The first observation of the component of each.
        self.component = _connected(len(observations), [(alone[a], alone[b]) for a, b in ends if a in alone])
        self.size = np.zeros(len(observations), dtype=int)  # numbers of the component that an observation is first of
        for name, number in alone.items():
            self.size[self.component[number]] += len(self.units[name])
        self.private = {name for name, number in alone.items() if self.numbers_of(number) <= _LARGEST_COMPONENT}
        self.coupled = {one for number, one in enumerate(self.component) if one != number}

    def numbers_of(self, number: int) -> int:
        """How many numbers the component of an observation has."""
        return int(self.size[self.component[number]])

    def own(self, number: int) -> list[str]:
        """The private parts of an observation."""
        return [name for name in self.used[number] if name in self.private]

    def kind(self, number: int) -> object:
        """What the components of one class have in common; None without private parts."""
        if not self.own(number):
            return None
        if self.component[number] in self.coupled:
            return "coupled", self.numbers_of(number)
        return self.key(number)

    def key(self, number: int) -> object:
        """What observations that are evaluated together have in common; the number itself of one that is alone."""
        one, alike = self.observations[number], self.observations[number].alike
        together = self.component[number] in self.coupled and bool(self.own(number))
        if alike is None or one.q.shape[-2] > _MOST_STACKED:
            return number, together
        roles = tuple((units, name in self.private) for name, units in self.used[number].items())
        return type(one), alike, bool(one.target), roles, self.numbers_of(number) if together else 0

    def is_linear(self, number: int) -> bool:
        """Whether an observation is linear in a component that is its own."""
        one = self.observations[number]
        return one.linear and len(self.used[number]) == 1 and self.component[number] not in self.coupled

    def layout(self) -> Layout:
        """The layout."""
        everything = range(len(self.observations))
        members: dict[object, list[int]] = {}
        for number in everything:
            members.setdefault(self.key(number), []).append(number)
        of_class: dict[object, list[int]] = {}
        for number in everything:
            if self.own(number):
                of_class.setdefault(self.kind(number), []).append(number)
        kinds = sorted(of_class, key=lambda kind: self.is_linear(of_class[kind][0]))
        shared = [name for name in self.units if name not in self.private]
        order, classes, place = list(shared), [], {}
        for kind in kinds:
            components = list(dict.fromkeys(self.component[number] for number in of_class[kind]))
            place |= {one: i for i, one in enumerate(components)}
            by_component: dict[int, list[str]] = {one: [] for one in components}
            for number in of_class[kind]:
                by_component[self.component[number]] += self.own(number)
            order += [name for names in by_component.values() for name in names]
            classes.append((len(components), self.numbers_of(of_class[kind][0])))
        parts = tuple((name, self.units[name]) for name in order)
        count = sum(len(self.units[name]) for name in shared)
        linear = sum(self.is_linear(of_class[kind][0]) for kind in kinds)
        layout = Layout(parts, count, tuple(classes), linear, ())
        number_of = {kind: i for i, kind in enumerate(kinds)}
        ordered = (sorted(some, key=lambda number: place.get(self.component[number], 0)) for some in members.values())
        groups = (self._group(some, layout, number_of.get(self.kind(some[0]), -1), place) for some in ordered)
        return layout._replace(groups=tuple(groups))

    def _group(self, members: list[int], layout: Layout, of: int, place: dict[int, int]) -> Group:
        positions = layout.positions
        roles = tuple(
            Role(tuple(int(positions[name][0]) for name in names), len(self.units[names[0]]), names[0] in self.private)
            for names in zip(*(self.used[number] for number in members), strict=True)
        )
        stops = np.cumsum([one.q.shape[-2] for one in self.observations]).tolist()
        counts = [self.observations[number].q.shape[-2] for number in members]
        poses = tuple((stops[number] - count, stops[number]) for number, count in zip(members, counts, strict=True))
        sizes, start = (), ()
        if of >= 0:
            components = [place[self.component[number]] for number in members]
            sizes = tuple(np.bincount(components, weights=counts, minlength=layout.classes[of][0]).astype(int).tolist())
            own = next(role for role in roles if role.private)
            start = tuple(layout.component_of(index)[2] for index in own.first)
        return Group(tuple(members), poses, roles, bool(self.observations[members[0]].target), of, sizes, start)


def _connected(count: int, pairs: Iterable[tuple[int, int]]) -> list[int]:
    """For each of some things the first of those that pairs connect it with."""
    found = list(range(count))

    def root(number: int) -> int:
        while found[number] != number:
            found[number] = found[found[number]]
            number = found[number]
        return number

    for one, other in pairs:
        low, high = sorted((root(one), root(other)))
        found[high] = low
    return [root(number) for number in range(count)]

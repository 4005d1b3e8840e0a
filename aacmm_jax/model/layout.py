"""Where the numbers of an unknown geometry stand, and which observations are evaluated together.

The unknowns of a problem are the parameters, then the shared blocks of geometry (what several observations use), then
the private ones, which the solver eliminates. What one observation alone uses is one component; a reference length
makes one of the components of its two sockets. A component of more than a few dozen numbers joins the shared blocks,
since a dense block of that size costs as much.

Everything here is static: it follows from names and numbers of poses, and fixes a compiled program.

Example: of two sockets that a length joins, and a tracker that saw two targets,
    layout = layout_of(observations, [("position of A", "position of B")])
    layout.shared     # 6: the tracker's frame, which both targets use
    layout.classes    # ((1, 6),): one component of two positions, coupled by the length
"""

from collections.abc import Iterable, Sequence
from functools import cached_property, lru_cache
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
        if all(pair[1] == following[0] for pair, following in zip(self.poses, self.poses[1:], strict=False)):
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
    target = {offset_of(observation.target): POINT} if observation.target else {}
    return dict(observation.unknowns) | target


def layout_of(observations: Sequence[AbstractObservation], ends: Sequence[tuple[str, str]]) -> Layout:
    """The layout of a problem; ``ends`` are the names of the positions at the ends of its reference lengths."""
    used = [unknowns_of(observation) for observation in observations]
    users: dict[str, list[int]] = {}
    for number, parts in enumerate(used):
        for name in parts:
            users.setdefault(name, []).append(number)
    alone = {name: numbers[0] for name, numbers in users.items() if len(numbers) == 1}
    # A length with one shared end says something of what is shared alone.
    half = {name for pair in ends if (pair[0] in alone) != (pair[1] in alone) for name in pair}
    alone = {name: number for name, number in alone.items() if name not in half}
    component = _connected(len(observations), [(alone[a], alone[b]) for a, b in ends if a in alone])
    return _Problem(observations, used, alone, component).layout()


def _connected(count: int, pairs: Iterable[tuple[int, int]]) -> list[int]:
    """For each of some things the first of those that pairs connect it with."""
    parents = list(range(count))

    def root(number: int) -> int:
        while parents[number] != number:
            parents[number] = parents[parents[number]]
            number = parents[number]
        return number

    for pair in pairs:
        low, high = sorted(map(root, pair))
        parents[high] = low
    return [root(number) for number in range(count)]


class _Problem:
    """What follows from the parts that observations use, and from those that one alone uses."""

    def __init__(
        self,
        observations: Sequence[AbstractObservation],
        used: list[dict[str, Units]],
        alone: dict[str, int],
        component: list[int],  # the first observation of the component of each
    ):
        self.observations, self.used, self.component = observations, used, component
        self.units = {name: units for parts in used for name, units in parts.items()}
        size = np.zeros(len(observations), dtype=int)
        for name, number in alone.items():
            size[component[number]] += len(self.units[name])
        self.size = size[component].tolist()  # how many numbers the component of each observation has
        self.private = {name for name, number in alone.items() if self.size[number] <= _LARGEST_COMPONENT}
        coupled = {first for number, first in enumerate(component) if first != number}
        self.coupled = [first in coupled for first in component]

    def own(self, number: int) -> list[str]:
        """The private parts of an observation."""
        return [name for name in self.used[number] if name in self.private]

    def kind(self, number: int) -> object:
        """What the components of one class have in common."""
        return ("coupled", self.size[number]) if self.coupled[number] else self.key(number)

    def key(self, number: int) -> object:
        """What observations that are evaluated together have in common; the number itself of one that is alone."""
        observation = self.observations[number]
        together = self.coupled[number] and bool(self.own(number))
        if observation.alike is None or observation.q.shape[-2] > _MOST_STACKED:
            return number, together
        roles = tuple((units, name in self.private) for name, units in self.used[number].items())
        size = self.size[number] if together else 0
        return type(observation), observation.alike, bool(observation.target), roles, size

    def is_linear(self, number: int) -> bool:
        """Whether an observation is linear in a component that is its own."""
        return self.observations[number].linear and len(self.used[number]) == 1 and not self.coupled[number]

    @cached_property
    def classes(self) -> list[list[int]]:
        """Observations of the components of each class; classes with linear rows come last."""
        by_kind: dict[object, list[int]] = {}
        for number in range(len(self.observations)):
            if self.own(number):
                by_kind.setdefault(self.kind(number), []).append(number)
        return sorted(by_kind.values(), key=lambda numbers: self.is_linear(numbers[0]))

    def layout(self) -> Layout:
        """The layout."""
        names = [name for name in self.units if name not in self.private]
        shared, sizes, places, number_of = sum(len(self.units[name]) for name in names), [], {}, {}
        for of, numbers in enumerate(self.classes):
            components: dict[int, list[str]] = {}
            for number in numbers:
                components.setdefault(self.component[number], []).extend(self.own(number))
            places |= {first: place for place, first in enumerate(components)}
            number_of |= dict.fromkeys(numbers, of)
            names += [name for parts in components.values() for name in parts]
            sizes.append((len(components), self.size[numbers[0]]))
        linear = sum(self.is_linear(numbers[0]) for numbers in self.classes)
        layout = Layout(tuple((name, self.units[name]) for name in names), shared, tuple(sizes), linear, ())
        members: dict[object, list[int]] = {}
        for number in range(len(self.observations)):
            members.setdefault(self.key(number), []).append(number)
        ordered = (sorted(some, key=lambda number: places.get(self.component[number], 0)) for some in members.values())
        groups = (self._group(some, layout, number_of.get(some[0], -1), places) for some in ordered)
        return layout._replace(groups=tuple(groups))

    def _group(self, members: list[int], layout: Layout, of: int, places: dict[int, int]) -> Group:
        positions = layout.positions
        roles = tuple(
            Role(tuple(int(positions[name][0]) for name in names), len(self.units[names[0]]), names[0] in self.private)
            for names in zip(*(self.used[number] for number in members), strict=True)
        )
        stops = np.cumsum([observation.q.shape[-2] for observation in self.observations]).tolist()
        counts = [self.observations[number].q.shape[-2] for number in members]
        poses = tuple((stops[number] - count, stops[number]) for number, count in zip(members, counts, strict=True))
        sizes, start = (), ()
        if of >= 0:
            components = [places[self.component[number]] for number in members]
            sizes = tuple(np.bincount(components, weights=counts, minlength=layout.classes[of][0]).astype(int).tolist())
            own = next(role for role in roles if role.private)
            start = tuple(layout.component_of(index)[2] for index in own.first)
        return Group(tuple(members), poses, roles, bool(self.observations[members[0]].target), of, sizes, start)

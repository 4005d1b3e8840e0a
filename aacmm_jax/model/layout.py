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

import itertools
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
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
    class_index: int  # index of the class of the components; -1 where no unknown is private
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


def layout_of(
    observations: Sequence[AbstractObservation], ends: Sequence[tuple[str, str]], shared: Sequence[str] = ()
) -> Layout:
    """The layout of a problem; ``ends`` are the names of the positions at the ends of its reference lengths. Parts that
    are named ``shared`` are so even where one observation alone uses them."""
    used = [unknowns_of(observation) for observation in observations]
    units = {name: units for parts in used for name, units in parts.items()}
    users = Counter(name for parts in used for name in parts)
    together = set(shared)
    own = [(number, parts) for number, parts in enumerate(used) if observations[number].eliminates]
    alone = {name: number for number, parts in own for name in parts if users[name] == 1 and name not in together}
    # A length with one shared end says something of what is shared alone.
    half = {name for pair in ends if (pair[0] in alone) != (pair[1] in alone) for name in pair}
    alone = {name: number for name, number in alone.items() if name not in half}
    # The first observation of the component of each: a length makes one component of those that it joins.
    component = np.arange(len(observations))
    for pair in ends:
        if pair[0] in alone:
            low, high = sorted(component[alone[name]] for name in pair)
            component[component == high] = low
    first = component.tolist()
    sizes = Counter[int]()  # numbers of each component
    for name, number in alone.items():
        sizes[first[number]] += len(units[name])
    private = {name for name, number in alone.items() if sizes[first[number]] <= _LARGEST_COMPONENT}
    members = Counter(first)
    problem = [
        _Member(number, observation, parts, [n for n in parts if n in private], at, sizes[at], members[at] > 1)
        for number, (observation, parts, at) in enumerate(zip(observations, used, first, strict=True))
    ]
    classes = _by(lambda member: member.kind, [member for member in problem if member.private])
    classes = sorted(classes, key=lambda members: members[0].is_linear)  # those with linear rows come last
    names, shapes, places, class_index_of = [name for name in units if name not in private], [], {}, {}
    of_shared = sum(len(units[name]) for name in names)
    for number, some in enumerate(classes):
        components: dict[int, list[str]] = {}
        for member in some:
            components.setdefault(member.first, []).extend(member.private)
        places |= {at: place for place, at in enumerate(components)}
        class_index_of |= {member.number: number for member in some}
        names += itertools.chain(*components.values())
        shapes.append((len(components), some[0].size))
    linear = sum(some[0].is_linear for some in classes)
    layout = Layout(tuple((name, units[name]) for name in names), of_shared, tuple(shapes), linear, ())
    stops = np.cumsum([observation.q.shape[-2] for observation in observations]).tolist()
    groups = []
    for some in _by(lambda member: member.key, problem):
        ordered = sorted(some, key=lambda member: places.get(member.first, 0))
        groups.append(_group(ordered, layout, class_index_of.get(some[0].number, -1), places, stops))
    return layout._replace(groups=tuple(groups))


def _by(label: Callable[["_Member"], Hashable], members: Sequence["_Member"]) -> list[list["_Member"]]:
    """Members with the same label together."""
    together: dict[Hashable, list[_Member]] = {}
    for member in members:
        together.setdefault(label(member), []).append(member)
    return list(together.values())


class _Member(NamedTuple):
    """An observation of a problem."""

    number: int
    observation: AbstractObservation
    parts: dict[str, Units]
    private: list[str]  # the parts that it alone uses
    first: int  # number of the first observation of its component
    size: int  # of its component
    coupled: bool  # whether a length makes one component of it and others

    @property
    def key(self) -> Hashable:
        """What observations that are evaluated together have in common; the number itself of one that is alone."""
        together = self.coupled and bool(self.private)
        if self.observation.alike is None or self.observation.q.shape[-2] > _MOST_STACKED:
            return self.number, together
        roles = tuple((units, name in self.private) for name, units in self.parts.items())
        targeted, size = bool(self.observation.target), self.size if together else 0
        return type(self.observation), self.observation.alike, targeted, roles, size

    @property
    def kind(self) -> Hashable:
        """What the components of one class have in common."""
        return ("coupled", self.size) if self.coupled else self.key

    @property
    def is_linear(self) -> bool:
        """Whether the observation is linear in a component that is its own."""
        return self.observation.linear and len(self.parts) == 1 and not self.coupled


def _group(
    members: Sequence[_Member], layout: Layout, class_index: int, places: dict[int, int], stops: Sequence[int]
) -> Group:
    positions, roles = layout.positions, []
    for names in zip(*(member.parts for member in members), strict=True):
        first = tuple(int(positions[name][0]) for name in names)
        roles.append(Role(first, len(members[0].parts[names[0]]), names[0] in members[0].private))
    counts = [member.observation.q.shape[-2] for member in members]
    poses = tuple((stops[member.number] - m, stops[member.number]) for member, m in zip(members, counts, strict=True))
    sizes, start = (), ()
    if class_index >= 0:
        components = [places[member.first] for member in members]
        sizes = tuple(
            np.bincount(components, weights=counts, minlength=layout.classes[class_index][0]).astype(int).tolist()
        )
        private = next(role for role in roles if role.private)
        start = tuple(layout.component_of(index)[2] for index in private.first)
    numbers, targeted = tuple(member.number for member in members), bool(members[0].observation.target)
    return Group(numbers, poses, tuple(roles), targeted, class_index, sizes, start)

"""Where the numbers of an unknown geometry stand, and which observations are evaluated together.

The unknowns of a problem are the parameters, then the shared blocks of geometry (what several observations use), then
the private ones, which the solver eliminates. What one observation alone uses is one component; a reference length
makes one of the components of its two sockets. A component of more than a few dozen numbers joins the shared blocks,
since a dense block of that size costs as much.

Everything here is static: it follows from names and numbers of poses, and fixes a compiled program.
"""

from collections.abc import Iterable, Sequence
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
    of: int | None  # class of the components; None where no unknown is private
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
    groups: tuple[Group, ...]

    @property
    def positions(self) -> dict[str, np.ndarray]:
        """Indices of the numbers of each part among all of them."""
        found, first = {}, 0
        for name, units in self.parts:
            found[name] = np.arange(first, first + len(units))
            first += len(units)
        return found

    def component_of(self, index: int) -> tuple[int | None, int, int]:
        """Class, component, and place in it of a number of the geometry; None, 0 and itself of a shared one."""
        if index < self.shared:
            return None, 0, index
        first = self.shared
        for number, (count, size) in enumerate(self.classes):
            if index < first + count * size:
                return number, (index - first) // size, (index - first) % size
            first += count * size
        raise IndexError(index)


def unknowns_of(observation: AbstractObservation) -> dict[str, Units]:
    """Parts of the geometry that an observation uses, with the place of its target last."""
    found = dict(observation.unknowns)
    if observation.target:
        found[offset_of(observation.target)] = POINT
    return found


def layout_of(observations: Sequence[AbstractObservation], ends: Sequence[tuple[str, str]]) -> Layout:
    """The layout of a problem; ``ends`` are the names of the positions at the ends of its reference lengths."""
    used = [unknowns_of(observation) for observation in observations]
    units, users = {}, {}
    for number, parts in enumerate(used):
        units |= parts
        for name in parts:
            users.setdefault(name, []).append(number)
    private = {name: numbers[0] for name, numbers in users.items() if len(numbers) == 1}
    # A length with one shared end says something of what is shared alone.
    private = {
        name: number
        for name, number in private.items()
        if all(name not in pair or (pair[0] in private and pair[1] in private) for pair in ends)
    }
    joined = _joined(len(used), [(private[a], private[b]) for a, b in ends if a in private and b in private])
    size = np.zeros(len(used), dtype=int)
    for name, number in private.items():
        size[joined[number]] += len(units[name])
    private = {name: joined[number] for name, number in private.items() if size[joined[number]] <= _LARGEST_COMPONENT}
    coupled = {joined[number] for number in range(len(used)) if joined[number] != number}
    gathered: dict[object, list[int]] = {}
    for number, (observation, parts) in enumerate(zip(observations, used, strict=True)):
        gathered.setdefault(_key(number, observation, parts, private, coupled, size, joined), []).append(number)
    shared = [name for name in units if name not in private]
    order, classes, class_of, component_of = list(shared), [], {}, {}
    for key, members in gathered.items():
        own = [name for name in used[members[0]] if name in private]
        kind = ("coupled", int(size[joined[members[0]]])) if joined[members[0]] in coupled else key
        if not own or kind in class_of:
            continue
        class_of[kind] = len(classes)
        everyone = members if kind is key else [n for n in range(len(used)) if _of_kind(n, kind, coupled, size, joined)]
        roots = list(dict.fromkeys(joined[number] for number in everyone))
        component_of |= {root: place for place, root in enumerate(roots)}
        for root in roots:
            order += [name for number in everyone if joined[number] == root for name in used[number] if name in private]
        classes.append((len(roots), int(size[joined[members[0]]])))
    first = dict(zip(order, np.cumsum([0, *(len(units[name]) for name in order)]).tolist(), strict=False))
    ends_of = np.cumsum([observation.q.shape[-2] for observation in observations]).tolist()
    groups = []
    for key, members in gathered.items():
        kind = ("coupled", int(size[joined[members[0]]])) if joined[members[0]] in coupled else key
        of = class_of.get(kind)
        if of is not None:
            members = sorted(members, key=lambda number: component_of[joined[number]])
        groups.append(_group(members, used, units, private, first, ends_of, observations, of, classes, component_of,
                             joined, sum(len(units[name]) for name in shared)))  # fmt: skip
    return Layout(
        parts=tuple((name, units[name]) for name in order),
        shared=sum(len(units[name]) for name in shared),
        classes=tuple(classes),
        groups=tuple(groups),
    )


def _of_kind(number: int, kind: tuple, coupled: set[int], size: np.ndarray, joined: list[int]) -> bool:
    return joined[number] in coupled and int(size[joined[number]]) == kind[1]


def _joined(count: int, pairs: Iterable[tuple[int, int]]) -> list[int]:
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


def _key(
    number: int,
    observation: AbstractObservation,
    parts: dict[str, Units],
    private: dict[str, int],
    coupled: set[int],
    size: np.ndarray,
    joined: list[int],
) -> object:
    """What observations that are evaluated together have in common; the number itself of one that is alone."""
    alike = observation.alike
    roles = tuple((units, name in private) for name, units in parts.items())
    together = joined[number] in coupled and any(name in private for name in parts)
    whole = int(size[joined[number]]) if together else 0
    if alike is None or observation.q.shape[-2] > _MOST_STACKED:
        return number, whole
    return type(observation), alike, bool(observation.target), roles, whole


def _group(
    members: list[int],
    used: list[dict[str, Units]],
    units: dict[str, Units],
    private: dict[str, int],
    first: dict[str, int],
    ends_of: list[int],
    observations: Sequence[AbstractObservation],
    of: int | None,
    classes: list[tuple[int, int]],
    component_of: dict[int, int],
    joined: list[int],
    shared: int,
) -> Group:
    names = list(zip(*(used[number] for number in members), strict=True))
    roles = tuple(Role(tuple(first[name] for name in each), len(units[each[0]]), each[0] in private) for each in names)
    counts = [observations[number].q.shape[-2] for number in members]
    sizes, start = (), ()
    if of is not None:
        begin = shared + sum(count * size for count, size in classes[:of])
        components = [component_of[joined[number]] for number in members]
        sizes = tuple(np.bincount(components, weights=counts, minlength=classes[of][0]).astype(int).tolist())
        own = next(role for role in roles if role.private)
        start = tuple((index - begin) % classes[of][1] for index in own.first)
    poses = tuple((ends_of[number] - observations[number].q.shape[-2], ends_of[number]) for number in members)
    return Group(tuple(members), poses, roles, bool(observations[members[0]].target), of, sizes, start)

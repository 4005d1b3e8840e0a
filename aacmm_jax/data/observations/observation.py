"""What every kind of observation says: the constraint between the tip and an unknown geometry, and how both are found.

A kind is one file of this folder: its data, the unknowns of its geometry, a start for them from nearly right tips, and
its residuals with their derivatives. What it does not say (weights, covariance, robust losses, derivatives of a whole
calibration) is the same for all kinds.
"""

import abc
import functools
import importlib
import inspect
import itertools
import pkgutil
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...core.numpy_or_jax import AnyArray, namespace, numpy_if_known
from ...core.pytree import register
from .declared import Declared, number, text

POINT = ("mm",) * 3
FRAME = ("rad",) * 3 + POINT

# The numbers of each unknown as columns: one for all poses (p = 1), or one for each pose (p = m).
Unknowns = Mapping[str, Float[AnyArray, "k p"]]
Parts = dict[str, Float[AnyArray, " k"]]  # of each unknown
Certified = dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]


class Tips(NamedTuple):
    """The tips of an observation's poses, mm, and the axes of the last frame, all in the base frame."""

    position: Float[AnyArray, "3 m"]
    axes: tuple[Float[AnyArray, "3 m"], Float[AnyArray, "3 m"], Float[AnyArray, "3 m"]]


class Rows(NamedTuple):
    """Residuals of an observation, r for each of its m poses, mm (orientations: rad), and their derivatives."""

    values: Float[AnyArray, "r m"]
    by_tip: Float[AnyArray, "r 3 m"]
    by_unknowns: dict[str, Float[AnyArray, "k r m"]]
    measured: Float[AnyArray, "m r r"]  # covariance of what was measured, without the arm's own errors
    by_rotation: Float[AnyArray, "r 3 m"] | None = None  # by a small rotation of the last frame, rad


class Quantity(NamedTuple):
    """A quantity in words: what is certified or stated of an observation, or a part of the geometry that was found."""

    says: str
    values: Float[np.ndarray, " k"]
    unit: str  # mm, rad, or 1
    u: float | None = None  # standard uncertainty of a certified value; 0 where it is taken as exact


class AbstractObservation(Declared):
    """Poses in which the tip and an unknown geometry satisfy a constraint.

    ``target`` names the tip that the poses held: "" is the arm's own probe, any other name a tip at an unknown place in
    the last frame, shared by all observations that name it (a reflector, a remounted probe).

    Observations are PyTrees: numbers are leaves, names and what `completed` derives from the data are not.
    """

    kind: ClassVar[str]
    table: ClassVar[str]  # name of its tables in a manifest
    rotates: ClassVar[bool] = False  # whether the residual depends on the rotation of the last frame
    stacks: ClassVar[bool] = True  # whether it can be evaluated together with others of the kind: see `alike`
    rows: int  # residuals of a pose
    # Whether the residual is linear in all unknowns, with derivatives that do not depend on tips and unknowns.
    linear: bool = False
    fixes_scale: bool = False  # whether it determines the scale of the arm
    q: Float[AnyArray, "m n"] = number("joint reading", "rad", "pose", "joint")
    target: str = text("tip that was held or seen; empty: the arm's own probe", default="")

    _of_poses: ClassVar[tuple[str, ...]]

    # Of a repeated calibration: what is added to the residuals (r, m), and certified values in place of its own.
    shift: Float[AnyArray, "r m"] | None
    drawn: Parts | None

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        leaves = [entry.name for entry in cls.entries if entry.content == "number"] + ["shift", "drawn"]
        others = [entry.name for entry in cls.entries if entry.content != "number"]
        cls._of_poses = tuple(entry.name for entry in cls.entries if entry.dimensions[:1] == ("pose",))
        register(cls, (*leaves,), ("name", *others, *cls.derived_fields))

    def __init__(self, name: str, *values: Any, **options: Any):
        vars(self).update(shift=None, drawn=None)
        super().__init__(name, *values, **options)

    # What a kind says.

    @abc.abstractmethod
    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        """The unknowns from nearly right tips; ``offset`` is the arm's own probe in the last frame, mm."""

    @abc.abstractmethod
    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        """The residuals at these tips and this geometry, whose numbers are columns: one for all poses, or one each.

        Derivatives by unknowns are those of a pose by the numbers of its own column. A kind that is `stacked` takes
        its `stated` numbers, too, as one for all poses or one each."""

    @property
    def certified(self) -> Certified:
        """Unknowns that have a certified value: the values, and their standard uncertainties."""
        return {}

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        """A part of the unknown geometry as a person reads it; a kind whose numbers need another form says so itself,
        such as a plane with its normal."""
        return quantities_by_unit(self.unknowns[part], values)

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        """Raise `InputError` where nearly right tips (mm) cannot determine the unknown geometry."""

    # What follows from it.

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the parts of the unknown geometry, and the unit, mm or rad, of each of its numbers. A name that
        several observations use is one geometry."""
        present = {name: one for name, one in self.parts.items() if not one.when or getattr(self, one.when)}
        return {getattr(self, name): one.units_of(self) for name, one in present.items()}

    @property
    def alike(self) -> Hashable | None:
        """What observations of this class, with as many unknowns of the same units, must have in common to be `stacked`
        and evaluated together; None for one that is evaluated alone."""
        if not self.stacks:
            return None
        choices = [*self.derived_fields, *(entry.name for entry in self.entries if entry.content == "truth")]
        absent = tuple(name for name in self.stated if getattr(self, name) is None)
        return (*(getattr(self, name) for name in choices), absent)

    @property
    def by_pose(self) -> tuple[str, ...]:
        """Fields with one row a pose."""
        return tuple(name for name in self._of_poses if getattr(self, name) is not None)

    @property
    def stated(self) -> tuple[str, ...]:
        """Fields with one number, or None; where stacked, with one a pose."""
        return tuple(entry.name for entry in self.entries if entry.content == "number" and not entry.dimensions)

    @classmethod
    def stacked(cls, observations: Sequence["AbstractObservation"]) -> "AbstractObservation":
        """The poses of observations that are `alike` as those of one, whose residual takes a column of unknowns for
        each pose, by the names of the first observation: the unknowns of all have one order.

        Only its residual means something: names, certified values and starts are those of each observation.
        """
        first, poses = observations[0], [one.q.shape[0] for one in observations]
        fields = {}
        for field in (*first.by_pose, *first.stated):
            values = [getattr(one, field) for one in observations]
            if field in first.stated and values[0] is not None:
                values = [namespace(value).broadcast_to(value, (m,)) for value, m in zip(values, poses, strict=True)]
            fields[field] = _joined(values)
        if first.shift is not None:
            shifts = [one.shift for one in observations]
            fields["shift"] = namespace(shifts).concatenate(shifts, axis=1)
        return first.changed(**fields)

    @classmethod
    def rebuilt(cls, name: str, stored: Mapping[str, Any]) -> "AbstractObservation":
        """An observation of this kind from the values of its entries, which are checked; place after place, where its
        poses belong to several."""
        made, stored = object.__new__(cls), dict(stored)
        for label in cls.entries:
            if label.content == "text" and label.dimensions == ("pose",) and label.name in stored:
                _, first, place = np.unique(stored[label.name], return_index=True, return_inverse=True)
                order = np.argsort(first[place], kind="stable")
                several = [entry.name for entry in cls.entries if entry.dimensions[:1] == ("pose",)]
                stored |= {
                    field: np.asarray(stored[field])[order]
                    for field in several
                    if field in stored and len(np.shape(stored[field])) and len(stored[field]) == len(order)
                }
        AbstractObservation.__init__(made, name, **stored)
        return made

    def residual_with_errors(self, tips: Tips, unknowns: Unknowns) -> Rows:
        """The residual, with what a repeated calibration adds."""
        rows = self.residual(tips, unknowns)
        return rows if self.shift is None else rows._replace(values=rows.values + self.shift)

    def with_errors(
        self, q: Float[AnyArray, "*batch m n"], shift: Float[AnyArray, "*batch r m"], values: Mapping[str, AnyArray]
    ) -> "AbstractObservation":
        """The same observation with other errors than it was recorded with: other readings, rad, a constant added to
        each residual, mm and rad, and other certified values, by the names of the certified parts."""
        return self.changed(q=q, shift=shift, drawn=dict(values))

    def certified_values(self) -> Certified:
        """What is `certified`, with the values of a repeated calibration where it is one."""
        if self.drawn is None:
            return self.certified
        return {name: (self.drawn[name], u) for name, (_, u) in self.certified.items()}

    def in_session(self, session: str, probe: str) -> "AbstractObservation":
        """The same observation in a session of several: with its name, and its own probe where there is one."""
        names = {label: getattr(self, label) for label in ("name", *(e.name for e in self.entries if e.of_session))}
        target = f"{session}/{self.target}" if self.target else probe
        here = {label: f"{session}/{name}" for label, name in names.items() if name is not None}
        return self.changed(**here, target=target)

    def select(self, poses: Sequence[int] | np.ndarray) -> "AbstractObservation":
        """The same observation with some of its poses, in their order."""
        fields = {field: getattr(self, field) for field in self.by_pose}
        rows = np.asarray(poses)
        return self.changed(
            **{
                field: tuple(values[i] for i in poses) if isinstance(values, tuple) else _taken(values, rows)
                for field, values in fields.items()
            }
        )

    @property
    def places(self) -> Int[np.ndarray, " m"]:
        """A number for each pose, equal for poses with the same constraint: of one point of an artefact, of one
        plane."""
        labels = [values for values in (getattr(self, field) for field in self.by_pose) if isinstance(values, tuple)]
        rows = list(zip(*labels, strict=True)) if labels else [()] * self.q.shape[-2]
        numbers = {row: place for place, row in enumerate(dict.fromkeys(rows))}
        return np.array([numbers[row] for row in rows])


@numpy_if_known
def _taken(values: AnyArray, rows: Int[np.ndarray, " k"]) -> AnyArray:
    return values[rows]


def _joined(values: Sequence[Any]) -> Any:
    """A field of several observations, arrays or tuples with an item for each pose, as that of one; None of None."""
    if values[0] is None:
        return None
    if isinstance(values[0], tuple):
        return tuple(itertools.chain(*values))
    return namespace(values).concatenate(values)


def quantities_by_unit(units: Sequence[str], values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
    """Positions, rotations and frames, told by the units of their numbers; other numbers as they are, unit by unit."""
    if tuple(units) == FRAME:
        return (Quantity("position of the origin", values[3:], "mm"), Quantity("rotation vector", values[:3], "rad"))
    if tuple(units) == POINT:
        return (Quantity("position", values, "mm"),)
    if tuple(units) == FRAME[:3]:
        return (Quantity("rotation vector", values, "rad"),)
    kinds = dict.fromkeys(units)
    return tuple(Quantity("value", values[[one == unit for one in units]], unit) for unit in kinds)


def certified_quantities(observation: AbstractObservation) -> tuple[Quantity, ...]:
    """What is certified of the artefact of an observation, by the entries of its kind: the values of its certificate,
    one quantity for each row of a table such as the coordinates of points."""
    stored, certified = observation.stored(), []
    for entry in observation.entries:
        if not entry.uncertainty or entry.name not in stored:
            continue
        values, u = np.asarray(stored[entry.name]), float(stored.get(entry.uncertainty, 0.0))
        if values.ndim < 2:
            certified.append(Quantity(entry.says, np.atleast_1d(values), entry.unit, u))
        else:
            rows = zip(stored[entry.dimensions[0]], values, strict=True)
            certified += [Quantity(f"{entry.says} of {name}", row, entry.unit, u) for name, row in rows]
    return tuple(certified)


def stated_quantities(observation: AbstractObservation) -> tuple[Quantity, ...]:
    """What else was stated of an observation as a whole, where it is not zero: the diameter of a stylus, an u."""
    certified = {name for e in observation.entries if e.uncertainty for name in (e.name, e.uncertainty)}
    values = {name: value for name, value in observation.stored().items() if name in observation.stated}
    return tuple(
        Quantity(entry.says, np.atleast_1d(np.asarray(values[entry.name])), entry.unit)
        for entry in observation.entries
        if entry.name not in certified and float(values.get(entry.name, 0.0)) != 0
    )


def offset_of(target: str) -> str:
    """Name of the unknown place of a target in the last frame."""
    return f"offset of {target}"


OTHER_KINDS: list[type[Declared]] = []  # observations and what simulates them, from elsewhere than this folder


def kinds() -> dict[str, type[AbstractObservation]]:
    """Every kind of observations by its name: those of the files of this folder, and others."""
    by_class = {one.__name__: one for one in classes() if issubclass(one, AbstractObservation)}
    return {by_class[name].kind: by_class[name] for name in sorted(by_class)}


def classes() -> list[type[Declared]]:
    """The classes of observations, and of what simulates them, that are not abstract."""
    return [*_classes_of_files(), *OTHER_KINDS]


@functools.cache
def _classes_of_files() -> list[type[Declared]]:
    names = [f"{__package__}.{module.name}" for module in pkgutil.iter_modules([str(Path(__file__).parent)])]
    members = [one for name in names for one in vars(importlib.import_module(name)).values() if isinstance(one, type)]
    return [one for one in dict.fromkeys(members) if issubclass(one, Declared) and not inspect.isabstract(one)]

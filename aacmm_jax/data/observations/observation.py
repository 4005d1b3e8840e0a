"""What every kind of observation says: the constraint between the tip and an unknown geometry, and how both are found.

A kind has its data, the unknowns of its geometry, a start for them from nearly right tips, and its residuals with their
derivatives. What it does not say (weights, covariance, robust losses, derivatives of a whole calibration) is the same
for all kinds. Beside it stands what simulates it: the true geometry, where the tip goes, and what is then recorded.
"""

import abc
import itertools
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...core.linear_algebra import inverse_positive_definite, products_by_column
from ...core.numpy_or_jax import AnyArray, namespace, numpy_if_known, register
from ...core.rotations import rotation_matrix
from .declared import Declared, declared

OTHER_UNITS = ("rad", "px")  # of residuals that are not in mm
POINT = ("mm",) * 3
FRAME = ("rad",) * 3 + POINT
# Two components of the rotation vector that turns z to the normal, and the distance from the origin.
PLANE = ("rad", "rad", "mm")
# Two components of the rotation vector that turns z to the axis' direction, and where the axis meets the plane through
# the origin across it, along the x and y axes that are turned likewise.
AXIS = ("rad", "rad", "mm", "mm")

# Added to the normal matrix of the tip's displacement, of its trace: large against rounding, small against 1.
_UNSEEN = 1e-9

# The numbers of each unknown as columns: one for all poses (p = 1), or one for each pose (p = m).
Unknowns = Mapping[str, Float[AnyArray, "k p"]]
Parts = dict[str, Float[AnyArray, " k"]]  # of each unknown
Certified = dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]
Readings = Float[np.ndarray, "m n"]
Transforms = Float[np.ndarray, "m 4 4"]


class Tips(NamedTuple):
    """The tips of an observation's poses, mm, and the axes of the last frame, all in the base frame."""

    position: Float[AnyArray, "3 m"]
    axes: tuple[Float[AnyArray, "3 m"], Float[AnyArray, "3 m"], Float[AnyArray, "3 m"]]


class Rows(NamedTuple):
    """Residuals of an observation, r for each of its m poses, in the units that its kind declares, and their
    derivatives by mm and rad."""

    values: Float[AnyArray, "r m"]
    by_tip: Float[AnyArray, "r 3 m"]
    by_unknowns: dict[str, Float[AnyArray, "k r m"]]
    measured: Float[AnyArray, "m r r"]  # covariance of what was measured, without the arm's own errors
    by_rotation: Float[AnyArray, "r 3 m"] | None = None  # by a small rotation of the last frame, rad
    # Of rows that are reduced (`reduced_rows`): the orthonormal combinations of the rows before.
    basis: Float[AnyArray, "m s n"] | None = None


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
    # The unit of each residual of a pose: those in mm first, then others that all are in rad, or all in px. A property
    # where it depends on the data.
    row_units: tuple[str, ...]
    derived: ClassVar[tuple[str, ...]] = ()  # fields of `completed` that are no entries
    rotates: ClassVar[bool] = False  # whether the residual depends on the rotation of the last frame
    reduces: ClassVar[bool] = False  # whether it has so many residuals a pose that they are reduced to fewer rows
    stacks: ClassVar[bool] = True  # whether it can be evaluated together with others of the kind: see `alike`
    # Whether geometry that no other observation uses is eliminated; else it stands beside the arm's parameters, so that
    # there is something to solve for where no parameter is free.
    eliminates: ClassVar[bool] = True
    # Whether the residual is linear in all unknowns, with derivatives that do not depend on tips and unknowns.
    linear: ClassVar[bool] = False
    fixes_scale: bool = False  # whether it determines the scale of the arm
    q: Float[AnyArray, "m n"] = declared("joint reading", "rad", "pose", "joint")
    target: str = declared("target that was seated or measured; empty for the arm's own probe", default="")

    # Of a repeated calibration: what is added to the residuals (r, m), and certified values in place of its own.
    shift: Float[AnyArray, "r m"] | None
    drawn: Parts | None

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if isinstance(units := getattr(cls, "row_units", ()), tuple):
            _check_row_units(cls.__name__, units)
        leaves = [entry.name for entry in cls.entries if entry.content == "number"] + ["shift", "drawn"]
        others = [entry.name for entry in cls.entries if entry.content != "number"]
        register(cls, (*leaves,), ("name", *others, *cls.derived))

    def __init__(self, name: str, *values: Any, **options: Any):
        vars(self).update(shift=None, drawn=None)
        super().__init__(name, *values, **options)

    # What a kind says.

    @abc.abstractmethod
    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        """The unknowns from nearly right tips; ``offset`` is the arm's own probe in the last frame, mm."""

    def start_with(self, tips: Tips, parts: Mapping[str, Any]) -> Parts:
        """Unknowns that follow from those of other observations, which have started."""
        return {}

    @abc.abstractmethod
    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        """The residuals at these tips and this geometry, whose numbers are columns: one for all poses, or one each.
        A kind that is `stacked` takes its `stated` numbers, too, as one for all poses or one each."""

    @property
    def certified(self) -> Certified:
        """Unknowns that have a certified value: the values, and their standard uncertainties."""
        return {}

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        """A part of the unknown geometry as a person reads it, by the units of its numbers."""
        return quantities_by_unit(self.unknowns[part], values)

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        """Raise `InputError` where nearly right tips (mm) cannot determine the unknown geometry."""

    # What follows from it.

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the parts of the unknown geometry, and the unit, mm or rad, of each of its numbers. A name that
        several observations use is one geometry."""
        present = {name: part for name, part in self.parts.items() if not part.when or getattr(self, part.when)}
        return {getattr(self, name): part.units_of(self) for name, part in present.items()}

    @property
    def steps(self) -> Mapping[str, tuple[float, ...]]:
        """Natural steps of parts of the geometry that are not those of their units."""
        return {}

    @property
    def rows(self) -> int:
        """Number of residuals of a pose."""
        return len(self.row_units)

    @property
    def equations(self) -> Int[np.ndarray, "r m"] | None:
        """How many equations each row stands for, where this is not 1 for all (None): several of the last row where
        rows are reduced, none of a row that a pose lacks."""
        return None

    @property
    def apart(self) -> tuple[str, ...]:
        """Parts of the geometry of a kind that `reduces` which do not move the target as a whole."""
        return ()

    @property
    def pose_equations(self) -> Int[np.ndarray, " m"]:
        """How many equations each pose gives."""
        counts = self.equations
        return np.full(self.q.shape[-2], self.rows) if counts is None else counts.sum(axis=0)

    def reduced(self, rows: Rows, shift: AnyArray | None = None, weights: Any = None) -> Rows:
        """The residuals of a kind that `reduces`, as fewer rows that say the same: see `reduced_rows`."""
        return rows

    @property
    def lengths(self) -> int:
        """How many of them are in mm: the first ones."""
        return self.row_units.count("mm")

    @property
    def other_unit(self) -> str:
        """The unit of the residuals that are not in mm; empty where all of them are."""
        return self.row_units[-1] if self.rows > self.lengths else ""

    def other_sizes(self, rows: Float[AnyArray, "r m"]) -> Float[AnyArray, " m"]:
        """The size of each pose's residuals that are not in mm; of a corner, where there are several."""
        xp = namespace(rows)
        return xp.sqrt(xp.sum(rows[self.lengths :] ** 2, axis=0))

    @property
    def other_counts(self) -> Int[np.ndarray, " m"]:
        """How many things, such as corners, each of `other_sizes` is the root mean square of."""
        return np.ones(self.q.shape[-2], dtype=int)

    def in_mm(self, rows: Float[AnyArray, "r *k m"], by_tip: Float[AnyArray, "r 3 m"]) -> Float[AnyArray, "c *k m"]:
        """Residuals, or their derivatives by k numbers, as a vector whose length is the distance of the tip from the
        geometry, mm: the residuals in mm themselves; of a kind without any, the shortest displacement of the tip that
        changes the residuals so, by their derivatives with respect to the tip."""
        return rows[: self.lengths] if self.lengths else displacement(rows, by_tip)

    @property
    def alike(self) -> Hashable | None:
        """What observations of this class, with as many unknowns of the same units, must have in common to be `stacked`
        and evaluated together; None for one that is evaluated alone."""
        if not self.stacks:
            return None
        choices = [*self.derived, *(entry.name for entry in self.entries if entry.content == "truth")]
        absent = tuple(name for name in self.stated if getattr(self, name) is None)
        return (*(getattr(self, name) for name in choices), absent, self.row_units)

    @property
    def by_pose(self) -> tuple[str, ...]:
        """Fields with one row a pose."""
        names = (entry.name for entry in self.entries if entry.of_poses)
        return tuple(name for name in names if getattr(self, name) is not None)

    @property
    def stated(self) -> tuple[str, ...]:
        """Fields with one number, or None; where stacked, with one a pose."""
        return tuple(entry.name for entry in self.entries if entry.content == "number" and not entry.dimensions)

    @classmethod
    def stacked(cls, observations: Sequence["AbstractObservation"]) -> "AbstractObservation":
        """The poses of observations that are `alike` as those of one, of which only the residual means something: it
        takes a column of unknowns for each pose, by the names of the first observation."""
        first, fields = observations[0], {}
        for field in (*first.by_pose, *first.stated, "shift"):
            values = [getattr(observation, field) for observation in observations]
            if values[0] is None:
                continue
            if isinstance(values[0], tuple):
                fields[field] = tuple(itertools.chain(*values))
                continue
            if field in first.stated:
                poses = [observation.q.shape[0] for observation in observations]
                values = [namespace(value).broadcast_to(value, (m,)) for value, m in zip(values, poses, strict=True)]
            fields[field] = namespace(values).concatenate(values, axis=1 if field == "shift" else 0)
        return first.changed(**fields)

    @classmethod
    def rebuilt(cls, name: str, stored: Mapping[str, Any]) -> "AbstractObservation":
        """An observation of this kind from the values of its entries, which are checked; place after place, where its
        poses belong to several."""
        made, stored = object.__new__(cls), dict(stored)
        for label in cls.entries:
            if label.content == "text" and label.of_poses and label.name in stored:
                _, first, place = np.unique(stored[label.name], return_index=True, return_inverse=True)
                order = np.argsort(first[place], kind="stable")
                several = [entry.name for entry in cls.entries if entry.of_poses and entry.name in stored]
                rows = {field: np.asarray(stored[field]) for field in several}
                stored |= {field: values[order] for field, values in rows.items() if values.shape[:1] == order.shape}
        AbstractObservation.__init__(made, name, **stored)
        return made

    def residual_with_errors(self, tips: Tips, unknowns: Unknowns) -> Rows:
        """The residual, with what a repeated calibration adds."""
        rows = self.residual(tips, unknowns)
        if self.reduces:
            return self.reduced(rows, self.shift)
        return rows if self.shift is None else rows._replace(values=rows.values + self.shift)

    def with_errors(
        self, q: Float[AnyArray, "*batch m n"], shift: Float[AnyArray, "*batch r m"], values: Mapping[str, AnyArray]
    ) -> "AbstractObservation":
        """The same observation with other errors than it was recorded with: other readings, rad, a constant added to
        each residual, in its unit, and other certified values, by the names of the certified parts."""
        return self.changed(q=q, shift=shift, drawn=dict(values))

    def certified_values(self) -> Certified:
        """What is `certified`, with the values of a repeated calibration where it is one."""
        if self.drawn is None:
            return self.certified
        return {name: (self.drawn[name], u) for name, (_, u) in self.certified.items()}

    def in_session(self, session: str, probe: str) -> "AbstractObservation":
        """The same observation in a session of several: with its name, and its own probe where there is one."""
        labels = ("name", *(entry.name for entry in self.entries if entry.of_session))
        here = {label: f"{session}/{getattr(self, label)}" for label in labels if getattr(self, label) is not None}
        return self.changed(**here, target=f"{session}/{self.target}" if self.target else probe)

    def select(self, poses: Sequence[int] | np.ndarray) -> "AbstractObservation":
        """The same observation with some of its poses, in their order."""
        rows = np.asarray(poses)
        taken, fields = numpy_if_known(lambda values: values[rows]), {}
        for field in self.by_pose:
            values = getattr(self, field)
            fields[field] = tuple(values[i] for i in poses) if isinstance(values, tuple) else taken(values)
        return self.changed(**fields)

    @property
    def places(self) -> Int[np.ndarray, " m"]:
        """A number for each pose, equal for poses with the same constraint: of one point of an artefact, of one
        plane."""
        labels = [entry.name for entry in self.entries if entry.of_poses and entry.content == "text"]
        rows = list(zip(*(getattr(self, label) for label in labels), strict=True)) or [()] * self.q.shape[-2]
        numbers = {row: place for place, row in enumerate(dict.fromkeys(rows))}
        return np.array([numbers[row] for row in rows])


def _check_row_units(name: str, units: tuple[str, ...]) -> None:
    others = units[units.count("mm") :]
    if "mm" in others or len(set(others)) > 1 or not set(others) <= set(OTHER_UNITS):
        raise TypeError(
            f"row_units of {name} are {units}; declare the rows in mm first, followed by rows that are all in rad or "
            "all in px."
        )


def displacement(rows: Float[AnyArray, "r *k m"], by_tip: Float[AnyArray, "r 3 m"]) -> Float[AnyArray, "3 *k m"]:
    """The shortest displacement of the tip, mm, that changes rows nearly so, by their derivatives."""
    xp = namespace(rows, by_tip)
    normal = xp.einsum("ram,rbm->mab", by_tip, by_tip)
    # Directions of the tip that no residual depends on, such as the line of sight, get no displacement.
    least = _UNSEEN * xp.einsum("maa->m", normal) + 1e-300
    inverse = inverse_positive_definite(normal + least[:, None, None] * xp.asarray(np.eye(3))[None])
    return products_by_column(xp.einsum("mab,rbm->arm", inverse, by_tip), rows)


def quantities_by_unit(units: Sequence[str], values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
    """Positions, rotations, frames, planes and axes, told by the units of their numbers; other numbers as they are,
    unit by unit."""
    units = tuple(units)
    if units == FRAME:
        return (Quantity("position of the origin", values[3:], "mm"), Quantity("rotation vector", values[:3], "rad"))
    if units == POINT:
        return (Quantity("position", values, "mm"),)
    if units == FRAME[:3]:
        return (Quantity("rotation vector", values, "rad"),)
    if units in (PLANE, AXIS):
        turned = np.asarray(rotation_matrix(np.append(values[:2], 0.0)))
        if units == PLANE:
            return (Quantity("normal", turned[:, 2], "1"), Quantity("distance from the origin", values[2:], "mm"))
        point = turned[:, :2] @ values[2:]
        return (Quantity("direction of the axis", turned[:, 2], "1"), Quantity("point of the axis", point, "mm"))
    return tuple(Quantity("value", values[np.array(units) == unit], unit) for unit in dict.fromkeys(units))


def certified_quantities(observation: AbstractObservation) -> tuple[Quantity, ...]:
    """What is certified of the artefact of an observation: the values of its certificate, one quantity for each row of
    a table such as the coordinates of points."""
    stored, certified = observation.stored(), []
    for entry in (entry for entry in observation.entries if entry.uncertainty and entry.name in stored):
        values, u = np.atleast_1d(stored[entry.name]), float(stored.get(entry.uncertainty, 0.0))
        rows = {entry.says: values}
        if values.ndim == 2:
            names = [f"{entry.says} of {name}" for name in stored[entry.dimensions[0]]]
            rows = dict(zip(names, values, strict=True))
        certified += [Quantity(says, row, entry.unit, u) for says, row in rows.items()]
    return tuple(certified)


def stated_quantities(observation: AbstractObservation) -> tuple[Quantity, ...]:
    """What else was stated of an observation as a whole, where it is not zero: the diameter of a stylus, an u."""
    entries, stored = observation.entries, observation.stored()
    certified = {name for entry in entries if entry.uncertainty for name in (entry.name, entry.uncertainty)}
    stated = {name: np.atleast_1d(stored[name]) for name in observation.stated if name in stored}
    others = [entry for entry in entries if entry.name in stated and entry.name not in certified]
    return tuple(Quantity(e.says, stated[e.name], e.unit) for e in others if float(stated[e.name][0]) != 0)


def stated_u(observation: AbstractObservation) -> Float[np.ndarray, " k"]:
    """The standard uncertainties that were stated of what an observation measured, mm; none where none was stated."""
    stored = observation.stored()
    if stored.get("covariance") is not None:
        return np.sqrt(np.diagonal(np.asarray(stored["covariance"]), axis1=-2, axis2=-1)).ravel()
    in_mm = any(entry.name == "u" and entry.unit == "mm" for entry in observation.entries)
    return np.asarray(stored["u"], dtype=float).ravel() if in_mm and stored.get("u") is not None else np.zeros(0)


def offset_of(target: str) -> str:
    """Name of the unknown place of a target in the last frame."""
    return f"offset of {target}"

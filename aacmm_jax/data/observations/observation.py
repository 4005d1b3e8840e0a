"""What every kind of observation says: what its poses owe to an unknown geometry, and how both are found.

A kind is one file of this folder: its data, the unknowns of its geometry, a start for them from nearly right tips, and
its residuals with their derivatives. What it does not say (weights, covariance, robust losses, derivatives of a whole
calibration) is the same for all kinds.
"""

import abc
import copy
import dataclasses
from collections.abc import Callable, Hashable, Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ...core.arguments import real_number, shown, truth_value, whole_number
from ...core.arrays import Numbers, as_array, as_floats, is_concrete
from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray, namespace, numpy_if_known
from .columns import joined_poses, taken

MOST_POSES = 100_000  # to simulate, as in a study

POINT = ("mm",) * 3
FRAME = ("rad",) * 3 + POINT

# The numbers of each unknown as columns: one for all poses (p = 1), or one for each pose (p = m).
Unknowns = Mapping[str, Float[AnyArray, "k p"]]


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


class Entry(NamedTuple):
    """One of the data of a kind, as files hold it and a manifest states it."""

    name: str
    says: str
    unit: str = ""  # none for text and truth values
    dimensions: tuple[str, ...] = ()  # of an array: the first is "pose" where there is a row for each pose
    content: Literal["number", "text", "truth"] = "number"
    required: bool = False
    uncertainty: str = ""  # of a certified value: name of the entry with its standard uncertainty


class Quantity(NamedTuple):
    """A quantity in words: what is certified or stated of an observation, or a part of the geometry that was found."""

    says: str
    values: Float[np.ndarray, " k"]
    unit: str  # mm, rad, or 1
    u: float | None = None  # standard uncertainty of a certified value; 0 where it is taken as exact


READINGS = Entry("q", "joint reading", "rad", ("pose", "joint"), required=True)
TARGET = Entry("target", "tip that was held or seen; empty: the arm's own probe", content="text")


class AbstractObservation(eqx.Module):
    """Poses in which the tip owes something to an unknown geometry.

    ``target`` names the tip that the poses held: "" is the arm's own probe, any other name a tip at an unknown place in
    the last frame, shared by all observations that name it (a reflector, a remounted probe).
    """

    kind: ClassVar[str]
    by_pose: ClassVar[tuple[str, ...]] = ("q",)  # fields with one row a pose
    stated: ClassVar[tuple[str, ...]] = ()  # fields with one number, or None; where stacked, with one a pose
    table: ClassVar[str]  # name of its tables in a manifest
    entries: ClassVar[tuple[Entry, ...]]
    rotates: ClassVar[bool] = False  # whether the residual depends on the rotation of the last frame
    rows: eqx.AbstractClassVar[int]
    name: eqx.AbstractVar[str]
    target: eqx.AbstractVar[str]
    q: eqx.AbstractVar[Float[AnyArray, "m n"]]

    @property
    @abc.abstractmethod
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the parts of the unknown geometry, and the unit, mm or rad, of each of its numbers. A name that
        several observations use is one geometry."""

    @property
    def fixes_scale(self) -> bool:
        """Whether the observation determines the scale of the arm."""
        return False

    @property
    def certified(self) -> dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]:
        """Unknowns that have a certified value: the values, and their standard uncertainties."""
        return {}

    @property
    def linear(self) -> bool:
        """Whether the residual is linear in all unknowns, with derivatives that do not depend on tips and unknowns."""
        return False

    @property
    def alike(self) -> Hashable | None:
        """What observations of this class, with as many unknowns of the same units, must have in common to be `stacked`
        and evaluated together; None for one that is evaluated alone."""
        return None

    @classmethod
    def stacked(cls, observations: Sequence["AbstractObservation"]) -> "AbstractObservation":
        """The poses of observations that are `alike` as those of one, whose residual takes a column of unknowns for
        each pose, by the names of the first observation: the unknowns of all have one order.

        Only its residual means something: names, certified values and starts are those of each observation.
        """
        first = observations[0]
        changed, poses = copy.copy(first), [one.q.shape[0] for one in observations]
        for field in (*cls.by_pose, *cls.stated):
            values = [getattr(one, field) for one in observations]
            if field in cls.stated and values[0] is not None:
                values = [namespace(value).broadcast_to(value, (m,)) for value, m in zip(values, poses, strict=True)]
            object.__setattr__(changed, field, joined_poses(values))
        return changed

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        """A part of the unknown geometry as a person reads it; a kind whose numbers need another form says so itself,
        such as a plane with its normal."""
        return quantities_by_unit(self.unknowns[part], values)

    @abc.abstractmethod
    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        """The unknowns from nearly right tips; ``offset`` is the arm's own probe in the last frame, mm."""

    @abc.abstractmethod
    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        """The residuals at these tips and this geometry, whose numbers are columns: one for all poses, or one each.

        Derivatives by unknowns are those of a pose by the numbers of its own column. A kind that is `stacked` takes
        its `stated` numbers, too, as one for all poses or one each."""

    def stored(self) -> dict[str, Any]:
        """The values of the entries, from which `rebuilt` makes the same observation; without those that have none."""
        found = {entry.name: getattr(self, entry.name, None) for entry in self.entries}
        return {name: value for name, value in found.items() if value is not None}

    @classmethod
    def rebuilt(cls, name: str, stored: Mapping[str, Any]) -> "AbstractObservation":
        """An observation of this kind from the values of its entries, which are checked again."""
        constructor: Any = cls
        return constructor(name, **stored)

    @property
    def labels(self) -> tuple[str, ...]:
        """Fields that name something of this observation; in another session it is another one."""
        return ("name",)

    def in_session(self, session: str, probe: str) -> "AbstractObservation":
        """The same observation in a session of several: with its name, and its own probe where there is one."""
        names = {
            label: f"{session}/{getattr(self, label)}" for label in self.labels if getattr(self, label) is not None
        }
        target = f"{session}/{self.target}" if self.target else probe
        changed = copy.copy(self)
        for field, value in {**names, "target": target}.items():
            object.__setattr__(changed, field, value)
        return changed

    def renamed(self, name: str) -> "AbstractObservation":
        """The same observation with another name."""
        changed = copy.copy(self)
        object.__setattr__(changed, "name", name)
        return changed

    def with_target(self, target: str) -> "AbstractObservation":
        """The same observation with another tip held."""
        changed = copy.copy(self)
        object.__setattr__(changed, "target", target)
        return changed

    def select(self, poses: Sequence[int] | np.ndarray) -> "AbstractObservation":
        """The same observation with some of its poses, in their order."""
        changed = copy.copy(self)
        for field in self.by_pose:
            values = getattr(self, field)
            chosen = tuple(values[i] for i in poses) if isinstance(values, tuple) else taken(values, np.asarray(poses))
            object.__setattr__(changed, field, chosen)
        return changed

    @property
    def places(self) -> Int[np.ndarray, " m"]:
        """A number for each pose, equal for poses that owe the same: of one point of an artefact, of one plane."""
        static = [values for values in (getattr(self, field) for field in self.by_pose) if isinstance(values, tuple)]
        rows = list(zip(*static, strict=True)) if static else [()] * self.q.shape[-2]
        numbers = {row: number for number, row in enumerate(dict.fromkeys(rows))}
        return np.array([numbers[row] for row in rows])

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        """Raise `InputError` where nearly right tips (mm) cannot determine the unknown geometry."""


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
    stored, found = observation.stored(), []
    for entry in observation.entries:
        if not entry.uncertainty or entry.name not in stored:
            continue
        values, u = np.asarray(stored[entry.name]), float(stored.get(entry.uncertainty, 0.0))
        if values.ndim < 2:
            found.append(Quantity(entry.says, np.atleast_1d(values), entry.unit, u))
        else:
            rows = zip(stored[entry.dimensions[0]], values, strict=True)
            found += [Quantity(f"{entry.says} of {name}", row, entry.unit, u) for name, row in rows]
    return tuple(found)


def stated_quantities(observation: AbstractObservation) -> tuple[Quantity, ...]:
    """What else was stated of an observation as a whole, where it is not zero: the diameter of a stylus, an u."""
    stored, entries = observation.stored(), observation.entries
    certified = {name for entry in entries if entry.uncertainty for name in (entry.name, entry.uncertainty)}
    numbers = (entry for entry in entries if entry.content == "number" and not entry.dimensions)
    return tuple(
        Quantity(entry.says, np.atleast_1d(np.asarray(stored[entry.name])), entry.unit)
        for entry in numbers
        if entry.name in stored and entry.name not in certified and float(stored[entry.name]) != 0
    )


def offset_of(target: str) -> str:
    """Name of the unknown place of a target in the last frame."""
    return f"offset of {target}"


def checked_name(name: object, what: str) -> str:
    """A name of one line, or `InputError`."""
    if not isinstance(name, str) or not name.strip() or name.splitlines() != [name]:
        raise InputError(f"{what} has the name {shown(name)}; give it a name of one line.")
    return name


def checked_target(target: object) -> str:
    """The name of a target, which may be empty, or `InputError`."""
    return "" if isinstance(target, str) and not target else checked_name(target, "a target")


def checked_truth(where: str, value: Any) -> bool:
    """True or False, or `InputError`."""
    truth_value(value, where)
    return bool(value)


def checked_readings(where: str, readings: Numbers) -> AnyArray:
    """Joint readings ``(m, n)``, rad, or mm of prismatic joints, or `InputError` that says what is wrong with them."""
    array = as_array(readings, where, like=np.zeros(0))
    if array.ndim != 2 or 0 in array.shape:
        raise InputError(
            f"{where} has shape {array.shape}; give one row a pose and one column a joint, at least one of each."
        )
    if is_concrete(array):
        _check_values(where, np.asarray(array))
    return array


def _check_values(where: str, array: np.ndarray) -> None:
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        row, column = bad[0] + 1
        raise InputError(
            f"{where} pose {row} joint {column} is {array[row - 1, column - 1]}; every reading must be finite."
        )


def checked_values(where: str, values: Numbers, shape: tuple[int, ...]) -> AnyArray:
    """Measured values of a shape, or `InputError`."""
    array = as_floats(values, where)
    if array.shape != shape:
        raise InputError(f"{where} has shape {array.shape}; give {shape}, one row a pose.")
    return array


def checked_scalar(where: str, value: Numbers, *, positive: bool = False) -> AnyArray:
    """One number, zero or positive, or `InputError`."""
    array = as_floats(value, where)
    if array.ndim:
        raise InputError(f"{where} has shape {array.shape}; give one number.")
    if is_concrete(array) and (float(array) < 0 or (positive and float(array) == 0)):
        raise InputError(f"{where} is {float(array):g}; it must be {'positive' if positive else 'zero or positive'}.")
    return array


def is_exact(u: AnyArray) -> bool:
    """Whether a certified value is exact, and not an unknown of its own; a traced uncertainty is not known to be 0."""
    return is_concrete(u) and float(u) == 0


def checked_covariances(where: str, u: Numbers | None, covariance: Numbers | None, poses: int) -> AnyArray:
    """Covariances ``(m, 3, 3)`` of measured points, mm^2, from one of both statements: ``u`` a number, one a coordinate
    or one a coordinate and pose; ``covariance`` one for all poses or one each."""
    if u is not None and covariance is not None:
        raise InputError(f"{where}: u and covariance are both given; give one of them.")
    if covariance is None:
        array = as_floats(0.0 if u is None else u, f"u of {where}")
        if array.shape not in ((), (3,), (poses, 3)):
            raise InputError(f"u of {where} has shape {array.shape}; give one number, three, or ({poses}, 3).")
        if is_concrete(array) and np.any(np.asarray(array) < 0):
            raise InputError(f"u of {where} is negative; a standard uncertainty must be zero or positive.")
        return _squares_on_the_diagonal(array, poses)
    array = as_floats(covariance, f"covariance of {where}")
    if array.shape not in ((3, 3), (poses, 3, 3)):
        raise InputError(f"covariance of {where} has shape {array.shape}; give (3, 3) or ({poses}, 3, 3).")
    array = namespace(array).broadcast_to(array, (poses, 3, 3))
    if is_concrete(array):
        known = np.asarray(array)
        symmetric = np.allclose(known, known.swapaxes(-1, -2), rtol=1e-6, atol=1e-15)
        if not symmetric or np.linalg.eigvalsh(known).min() < -1e-12 * max(np.abs(known).max(), 1e-300):
            raise InputError(f"covariance of {where} is not symmetric and positive; give variances in mm^2.")
    return array


@numpy_if_known
def _squares_on_the_diagonal(array: Float[AnyArray, "..."], poses: int) -> Float[AnyArray, "m 3 3"]:
    """Of one number, of three, or of three a pose."""
    array = namespace(array).broadcast_to(array if array.ndim else array[None], (poses, 3))
    return array[:, :, None] ** 2 * np.eye(3)[None]


def numbers(what: str, *shape: int) -> Callable[[Any], np.ndarray]:
    """Converter of a field of a simulation: true values of a shape, or `InputError`."""

    def converted(values: Any) -> np.ndarray:
        array = np.asarray(as_floats(values, f"the {what} to simulate"))
        if array.shape != shape:
            raise InputError(f"the {what} to simulate has shape {array.shape}; give {shape}.")
        return array

    return converted


class AbstractSimulated(eqx.Module):
    """An observation to simulate: the true geometry, where the tip goes, and what is then recorded.

    Every kind has a field ``poses``: the number of poses, of each place where there are several (points of an artefact,
    two planes).
    """

    table: ClassVar[str]  # name of its tables in the file of a kit
    name: eqx.AbstractVar[str]

    def __check_init__(self) -> None:
        checked_name(self.name, "an observation to simulate")
        for field in dataclasses.fields(self):
            value: Any = getattr(self, field.name)
            what = f"{field.name} of '{self.name}'"
            kinds = get_args(field.type) if isinstance(field.type, UnionType) else (field.type,)
            if value is None:
                if NoneType in kinds:
                    continue
                raise InputError(f"{what} is missing; give it.")
            if bool in kinds:
                truth_value(value, what)
            elif int in kinds:
                whole_number(value, what)
                if not 1 <= value <= MOST_POSES:
                    raise InputError(f"{what} is {value}; give at least one, and {MOST_POSES:,} at most.")
            elif float in kinds:
                real_number(value, what)
                checked_scalar(what, value)
            elif str in kinds:
                checked_target(value) if field.name == "target" else checked_name(value, what)

    @property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        """The true place of the target in the last frame, mm; None for the arm's own probe."""
        return None

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> "AbstractSimulated | None":
        """The same thing under another name and moved rigidly: by a rotation vector (rad) about the base's origin, and
        then by a translation (mm). None where there is nothing to place, such as for an instrument that sees all."""
        return None

    @property
    def orientation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation of its own frame in the base frame; the identity where it has none."""
        return np.eye(3)

    @abc.abstractmethod
    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        """Where the tip is, mm, without the noise of the seat."""

    @abc.abstractmethod
    def recorded(
        self, q: Float[np.ndarray, "m n"], transforms: Float[np.ndarray, "m 4 4"], random: np.random.Generator
    ) -> AbstractObservation:
        """The observation from the readings, and from the true transforms of the tip."""

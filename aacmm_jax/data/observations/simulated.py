"""Observations to simulate: the true geometry, where the tip goes, and what is then recorded."""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
from jaxtyping import Float

from ...core.arguments import real_number, truth_value, whole_number
from ...core.arrays import as_floats
from ...core.errors import InputError
from .declared import Declared, Entry, checked_name, checked_scalar, count, number, text
from .observation import AbstractObservation, classes

MOST_POSES = 100_000  # as in a study


class AbstractSimulated(Declared):
    """An observation to simulate.

    Every kind declares an entry ``poses``: the number of poses, of each place where there are several (points of an
    artefact, two planes).
    """

    keyword_only: ClassVar[bool] = False
    table: ClassVar[str]  # name of its tables in the file of a kit
    poses: int

    def checked(self, entry: Entry, value: Any, where: str, sizes: dict[str | int, int]) -> Any:
        what = f"{entry.name} of {where}"
        if value is None:
            raise InputError(f"{what} is missing; give it.")
        if entry.content == "truth":
            truth_value(value, what)
        elif entry.content == "count":
            whole_number(value, what)
            if not 1 <= value <= MOST_POSES:
                raise InputError(f"{what} is {value}; give at least one, and {MOST_POSES:,} at most.")
        elif entry.content == "text":
            return value if value == "" and entry.default == "" else checked_name(value, what)
        elif entry.content == "points":
            if not isinstance(value, Mapping) or not value:
                raise InputError(f"{what} must be a dictionary of each point's name and coordinates.")
            return {checked_name(name, what): tuple(_array(f"{name} of {what}", (3,), p)) for name, p in value.items()}
        elif entry.dimensions:
            return _array(what, entry.dimensions, value)
        else:
            real_number(value, what)
            checked_scalar(what, value)
        return value

    @property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        """The true place of the target in the last frame, mm; None for the arm's own probe."""
        return None

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> Self | None:
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


def _array(what: str, shape: tuple[str | int, ...], values: Any) -> Float[np.ndarray, "..."]:
    array = np.asarray(as_floats(values, what))
    wanted = tuple(3 if size == "axis" else size for size in shape)
    if len(array.shape) != len(wanted) or any(w not in (g, "names") for w, g in zip(wanted, array.shape, strict=True)):
        raise InputError(f"{what} has shape {array.shape}; give {wanted}.")
    return array


class AbstractInBox(AbstractSimulated):
    """What an instrument measures at random places in a box."""

    box: np.ndarray = number("lowest and highest coordinates of the tip in the base frame", "mm", 2, 3)
    poses: int = count("number of poses")

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return random.uniform(self.box[0], self.box[1], (self.poses, 3))


class AbstractOfTarget(AbstractSimulated):
    """What may be recorded with a target in place of the arm's own probe."""

    target: str = text("name of the target", default="")
    place: np.ndarray | None = number("true place of the target in the last frame", "mm", 3, default=None)

    def completed(self, where: str) -> Mapping[str, Any]:
        if bool(self.target) != (self.place is not None):
            raise InputError(f"{where} needs both, a target and its place in the last frame, or neither.")
        return {}

    @property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        return self.place


def simulated_kinds() -> dict[str, type[AbstractSimulated]]:
    """Everything that can be simulated, by the name of its tables."""
    found = {one.__name__: one for one in classes() if issubclass(one, AbstractSimulated)}
    return {found[name].table: found[name] for name in sorted(found)}

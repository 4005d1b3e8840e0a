"""Observations to simulate: the true geometry, where the tip goes, and what is then recorded."""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.rotations import rotation_matrix, rotation_vector
from .declared import Declared, count, number, text
from .observation import AbstractObservation, classes

Readings = Float[np.ndarray, "m n"]
Transforms = Float[np.ndarray, "m 4 4"]


class AbstractSimulated(Declared):
    """An observation to simulate.

    Every kind declares an entry ``poses``: the number of poses, of each place where there are several (points of an
    artefact, two planes).
    """

    keyword_only: ClassVar[bool] = False
    table: ClassVar[str]  # name of its tables in the file of a kit
    poses: int

    @property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        """The true place of the target in the last frame, mm; None for the arm's own probe."""
        return None

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> "AbstractSimulated | None":
        """The same thing under another name and moved rigidly: by a rotation vector (rad) about the base's origin, and
        then by a translation (mm). None where there is nothing to place, such as for an instrument that sees all."""
        turn, moving = np.asarray(rotation_matrix(frame[:3])), [entry for entry in self.entries if entry.moves]
        moved = {}
        for entry in moving:
            value = getattr(self, entry.name)
            if entry.moves == "frame":
                whole = turn @ np.asarray(rotation_matrix(value[:3]))
                moved[entry.name] = np.concatenate([rotation_vector(whole), turn @ value[3:] + frame[3:]])
            else:
                moved[entry.name] = value @ turn.T + (frame[3:] if entry.moves == "point" else 0.0)
        return self.changed(name=name, **moved) if moving else None

    @property
    def orientation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation of its own frame in the base frame; the identity where it has none."""
        frames = [getattr(self, entry.name) for entry in self.entries if entry.moves == "frame"]
        return np.asarray(rotation_matrix(frames[0][:3])) if frames else np.eye(3)

    @abc.abstractmethod
    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        """Where the tip is, mm, without the noise of the seat."""

    @abc.abstractmethod
    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> AbstractObservation:
        """The observation from the readings, and from the true transforms of the tip."""


class AbstractInBox(AbstractSimulated):
    """What an instrument measures at random places in a box."""

    box: Float[np.ndarray, "2 3"] = number("lowest and highest coordinates of the tip in the base frame", "mm")
    poses: int = count("number of poses")

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return random.uniform(self.box[0], self.box[1], (self.poses, 3))


class AbstractOfTarget(AbstractSimulated):
    """What may be recorded with a target in place of the arm's own probe."""

    target: str = text("name of the target", default="")
    place: Float[np.ndarray, "3"] | None = number("true place of the target in the last frame", "mm", default=None)

    def completed(self, where: str) -> Mapping[str, Any]:
        if bool(self.target) != (self.place is not None):
            raise InputError(f"{where} needs both, a target and its place in the last frame, or neither.")
        return {}

    @property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        return self.place


def simulated_kinds() -> dict[str, type[AbstractSimulated]]:
    """Everything that can be simulated, by the name of its tables."""
    by_class = {one.__name__: one for one in classes() if issubclass(one, AbstractSimulated)}
    return {by_class[name].table: by_class[name] for name in sorted(by_class)}

"""What simulates an observation of every kind, and the kinds that there are.

Beside each kind of observation stands a class of what is simulated: the true geometry, where the tip goes, and what is
then recorded.
"""

import abc
import functools
import importlib
import inspect
import itertools
import pkgutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...core.errors import InputError
from ...core.rotations import rotation_matrix, rotation_vector
from .declared import Declared, declared
from .observation import AbstractObservation, Readings, Transforms


class Aim(NamedTuple):
    """A cone of directions from which something can be measured, and where on the arm it is measured."""

    axis: tuple[float, float, float]  # of the last frame: points within the cone, against its normal
    normal: tuple[float, float, float]  # in the base frame
    half_angle: float  # rad
    place: tuple[float, float, float]  # in the last frame, mm: what must stay above the table


class AbstractSimulated(Declared):
    """An observation to simulate.

    Every kind declares an entry ``poses``: the number of poses, of each place where there are several (points of an
    artefact, two planes).
    """

    keyword_only: ClassVar[bool] = False
    table: ClassVar[str]  # name of its tables in the file of a kit
    poses: int
    offset: Float[np.ndarray, " 3"] | None = None  # true place of the target in the last frame, mm; None: the probe
    aim: Aim | None = None  # from where it can be measured, if not from everywhere

    @abc.abstractmethod
    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        """Where the tip is, mm, without the noise of the seat."""

    @abc.abstractmethod
    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> AbstractObservation:
        """The observation from the readings, and from the true transforms of the tip."""

    def measurable(self, transforms: Transforms) -> Bool[np.ndarray, " m"]:
        """Which of the true transforms of the tip allow a measurement."""
        return np.ones(len(transforms), dtype=bool)

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> "AbstractSimulated | None":
        """The same thing under another name and moved rigidly: by a rotation vector (rad) about the base's origin, and
        then by a translation (mm). None where there is nothing to place, such as for an instrument that sees all."""
        turn, moved = np.asarray(rotation_matrix(frame[:3])), {}
        for entry in (entry for entry in self.entries if entry.moves):
            value = getattr(self, entry.name)
            if entry.moves == "frame":
                whole = turn @ np.asarray(rotation_matrix(value[:3]))
                moved[entry.name] = np.concatenate([rotation_vector(whole), turn @ value[3:] + frame[3:]])
            else:
                moved[entry.name] = value @ turn.T + (frame[3:] if entry.moves == "point" else 0.0)
        return self.changed(name=name, **moved) if moved else None

    @property
    def orientation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation of its own frame in the base frame; the identity where it has none."""
        frames = [getattr(self, entry.name) for entry in self.entries if entry.moves == "frame"]
        return np.asarray(rotation_matrix(frames[0][:3])) if frames else np.eye(3)


class AbstractOfTarget(AbstractSimulated):
    """What may be recorded with a target in place of the arm's own probe."""

    target: str = declared("name of the target", default="")
    place: Float[np.ndarray, "3"] | None = declared("true position of the target in the last frame", "mm", default=None)

    def completed(self, where: str) -> Mapping[str, Any]:
        if bool(self.target) != (self.place is not None):
            raise InputError(
                f"{where} needs both a target and its position in the last frame (place), or neither; add one or "
                "remove the other."
            )
        return {"offset": self.place}


OTHER_KINDS: list[type[Declared]] = []  # observations and what simulates them, from elsewhere than this folder


@functools.cache
def _classes_of_files() -> list[type[Declared]]:
    names = [f"{__package__}.{module.name}" for module in pkgutil.iter_modules([str(Path(__file__).parent)])]
    members = itertools.chain(*(vars(importlib.import_module(name)).values() for name in names))
    return [kind for kind in dict.fromkeys(filter(inspect.isclass, members)) if issubclass(kind, Declared)]


def _classes_by(base: type, label: str) -> dict[str, Any]:
    classes = sorted((*_classes_of_files(), *OTHER_KINDS), key=lambda kind: kind.__name__)
    return {getattr(kind, label): kind for kind in classes if issubclass(kind, base) and hasattr(kind, label)}


def kinds() -> dict[str, type[AbstractObservation]]:
    """Every kind of observations by its name: those of the files of this folder, and others."""
    return _classes_by(AbstractObservation, "kind")


def simulated_kinds() -> dict[str, type[AbstractSimulated]]:
    """Everything that can be simulated, by the name of its tables."""
    return _classes_by(AbstractSimulated, "table")

"""What every camera model says, and the models by their names.

A camera's frame has its origin in the centre of projection, x to the right of the image, y downwards, and z along the
optical axis, away from the camera. Pixel centres have integer coordinates, the first pixel 0 and 0. Points and values
are columns, with any further axes; intrinsics have the same further axes, or 1 in their place.
"""

import abc
import functools
import importlib
import inspect
import pkgutil
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray, namespace

_STEPS = {"p1": 0.01, "p2": 0.01, "k1": 0.1, "k2": 1.0, "k3": 10.0, "k4": 0.1, "k5": 1.0, "k6": 10.0}


class Projected(NamedTuple):
    """Points as a camera sees them, and the derivatives."""

    values: Float[AnyArray, "d ..."]  # px, or mm of a camera that measures points
    by_point: Float[AnyArray, "d 3 ..."]  # 1/mm times the unit of the values
    by_intrinsics: Float[AnyArray, "k d ..."]


class AbstractCamera(abc.ABC):
    """A camera model. What follows from it needs no state, so that there is one object of each class."""

    name: ClassVar[str]
    dimension: ClassVar[int] = 2  # numbers of a measured corner
    unit: ClassVar[str] = "px"  # of these
    names: ClassVar[tuple[str, ...]]  # of all intrinsics; a camera may have the first ones only
    counts: ClassVar[tuple[int, ...]]  # how many of them a camera may have

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each of the intrinsics."""
        return tuple("px" if name in ("fx", "fy", "cx", "cy") else "1" for name in self.names)

    @property
    def steps(self) -> tuple[float, ...]:
        """A natural step of each of the intrinsics: roughly what moves a corner far from the middle by a pixel."""
        return tuple(_STEPS.get(name, 1.0) for name in self.names)

    def check_count(self, count: int, where: str) -> None:
        """Raise `InputError` for a number of intrinsics that the model does not have."""
        if count not in self.counts:
            wanted = " or ".join(map(str, self.counts))
            raise InputError(
                f"{where} has {count} intrinsics, but the model '{self.name}' has {wanted}; give "
                f"{', '.join(self.names[: self.counts[-1]]) or 'none'}, in this order."
            )

    @abc.abstractmethod
    def project(self, points: Float[AnyArray, "3 ..."], intrinsics: Float[AnyArray, "k ..."]) -> Projected:
        """Where points (mm, in the camera's frame) appear."""

    @abc.abstractmethod
    def directions(self, values: Float[np.ndarray, "d ..."], intrinsics: Float[np.ndarray, " k"]) -> np.ndarray:
        """Unit vectors ``(3, ...)`` from the centre of projection towards what appears at these values."""

    def folded(
        self, points: Float[np.ndarray, "3 ..."], intrinsics: Float[np.ndarray, " k"]
    ) -> Bool[np.ndarray, "..."]:
        """Whether points lie behind the camera, or so far aside that the distortion folds back: farther points would
        appear nearer to the middle."""
        return np.zeros(points.shape[1:], dtype=bool)


class AbstractLens(AbstractCamera):
    """A lens: a distorted image at unit distance, which focal lengths and centre (fx, fy, cx, cy, px) make pixels."""

    largest: ClassVar[float]  # of what is searched for a fold: of the quantity of `aside`

    @abc.abstractmethod
    def distorted(
        self, points: Float[AnyArray, "3 ..."], coefficients: Float[AnyArray, "k ..."]
    ) -> tuple[Float[AnyArray, "2 ..."], Float[AnyArray, "2 3 ..."], list[AnyArray]]:
        """The image at unit distance, and its derivatives by the point and by each of the coefficients."""

    @abc.abstractmethod
    def aside(self, points: Float[np.ndarray, "3 ..."]) -> Float[np.ndarray, "..."]:
        """How far from the axis points lie: what the distortion is a function of."""

    @abc.abstractmethod
    def radius(self, aside: Float[np.ndarray, "..."], coefficients: Float[np.ndarray, " k"]) -> np.ndarray:
        """The distance from the centre at which points so far aside appear, at unit distance, without tangential
        distortion."""

    @abc.abstractmethod
    def from_aside(self, aside: Float[np.ndarray, "..."]) -> tuple[np.ndarray, np.ndarray]:
        """Sine and cosine of the angle from the axis."""

    def project(self, points: Float[AnyArray, "3 ..."], intrinsics: Float[AnyArray, "k ..."]) -> Projected:
        xp = namespace(points, intrinsics)
        plane, by_point, by_coefficients = self.distorted(points, intrinsics[4:])
        focal = intrinsics[:2]
        zero, one = xp.zeros_like(plane[0]), xp.ones_like(plane[0])
        x, y = plane
        affine = [xp.stack(pair) for pair in ((x, zero), (zero, y), (one, zero), (zero, one))]
        by_intrinsics = xp.stack([*affine, *(focal * part for part in by_coefficients)])
        return Projected(focal * plane + intrinsics[2:4], focal[:, None] * by_point, by_intrinsics)

    def fold(self, coefficients: Float[np.ndarray, " k"]) -> float:
        """How far aside points may lie before the distortion folds back; infinite where it does not."""
        aside = np.linspace(0.0, self.largest, 2001)
        falls = np.flatnonzero(np.diff(self.radius(aside, coefficients)) <= 0)
        return float(aside[falls[0]]) if len(falls) else np.inf

    def folded(
        self, points: Float[np.ndarray, "3 ..."], intrinsics: Float[np.ndarray, " k"]
    ) -> Bool[np.ndarray, "..."]:
        return ~(self.aside(points) <= min(self.fold(intrinsics[4:]), self.largest))

    def directions(self, values: Float[np.ndarray, "d ..."], intrinsics: Float[np.ndarray, " k"]) -> np.ndarray:
        columns = (-1, *(1,) * (values.ndim - 1))
        plane = (values - intrinsics[2:4].reshape(columns)) / intrinsics[:2].reshape(columns)
        coefficients = intrinsics[4:]
        # The radial part from a table, then Newton's steps with the whole distortion.
        aside = np.linspace(0.0, min(self.fold(coefficients), self.largest), 2001)
        size = np.hypot(*plane)
        sine, cosine = self.from_aside(np.interp(size, self.radius(aside, coefficients), aside))
        around = plane / np.where(size > 0, size, 1.0)
        found = np.stack([*(sine * around), cosine])
        for _ in range(8):
            image, by_point, _ = self.distorted(found, coefficients.reshape(columns))
            # Across the direction: two unit vectors, along which it is moved.
            aslant = np.where(
                np.abs(found[0]) < 0.7, np.eye(3)[:, 0].reshape(columns), np.eye(3)[:, 1].reshape(columns)
            )
            first = np.cross(found, np.broadcast_to(aslant, found.shape), axis=0)
            first = first / np.linalg.norm(first, axis=0)
            second = np.cross(found, first, axis=0)
            a, b = (np.einsum("dc...,c...->d...", by_point, across) for across in (first, second))
            rest, determinant = plane - image, a[0] * b[1] - a[1] * b[0]
            safe = np.where(np.abs(determinant) > 1e-9, determinant, np.inf)
            step = (rest[0] * b[1] - rest[1] * b[0]) / safe * first + (a[0] * rest[1] - a[1] * rest[0]) / safe * second
            found = found + step / np.maximum(1.0, 5 * np.linalg.norm(step, axis=0))
            found = found / np.linalg.norm(found, axis=0)
        return found


@functools.cache
def camera_models() -> dict[str, AbstractCamera]:
    """Every camera model by its name: those of the files of this folder."""
    modules = [f"{__package__}.{module.name}" for module in pkgutil.iter_modules([str(Path(__file__).parent)])]
    classes = [
        kind for name in modules for kind in vars(importlib.import_module(name)).values() if inspect.isclass(kind)
    ]
    models = [kind() for kind in dict.fromkeys(classes) if issubclass(kind, AbstractCamera) and "name" in vars(kind)]
    return {model.name: model for model in sorted(models, key=lambda model: model.name)}

"""What files hold besides numbers: an arm with its name and its proposed identification, a capture with its arms."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from ..core.arrays import as_floats
from ..core.errors import InputError
from ..kinematics.arm import Arm, is_single
from ..kinematics.parameters import Bounds, Parameters
from .capture import Capture


class ArmSpecification(NamedTuple):
    """An arm as a file states it: the arm, its name, and how its maker would have it identified (mm, rad)."""

    arm: Arm
    name: str = ""
    held: tuple[str, ...] | None = None  # None: the default of `Parameters.free_of`
    length: float = 10.0  # half-width of the bounds of lengths
    angle: float = 0.0175  # and of angles
    override: Mapping[str, float] = MappingProxyType({})  # half-widths by parameter name

    def bounds(self) -> Bounds:
        """The box that the file proposes."""
        space = Parameters.free_of(self.arm, held=self.held)
        return Bounds.around(self.arm, space, length=self.length, angle=self.angle, override=self.override)


SphereTest = Literal["effective-diameter", "probing", "articulation"]
SPHERE_TESTS = get_args(SphereTest)


class ProbedSphere(NamedTuple):
    """A reference sphere as it was touched, for acceptance tests; it takes no part in a calibration. mm and rad.

    ``groups`` are joint angles ``(m, n)`` or points ``(m, 3)`` of the probe's centre, one group for each sphere that is fitted: the repeats of
    ASME's effective diameter, the 25 points of ISO's probing test, or the orientations of its articulation test.
    """

    name: str
    test: SphereTest
    groups: tuple[Float[np.ndarray, "m n"], ...]
    diameter: float  # calibrated
    u: float = 0.0  # standard uncertainty of the diameter
    stylus: float = 0.0  # diameter of the ball of the probe; 0 where points lie on the sphere itself
    form: float = 0.0  # calibrated form error of the sphere


class Recording(NamedTuple):
    """A capture with the nominal arm that recorded it and, for a simulation, the true one."""

    capture: Capture
    nominal: ArmSpecification
    true: ArmSpecification | None = None
    seed: int | None = None
    spheres: tuple[ProbedSphere, ...] = ()
    sources: tuple[str, ...] = ()  # files that it was read from: name and SHA-256, the latest first
    measured: str = ""  # day on which it was recorded, ISO 8601; empty where that is not stated


def checked_sphere(sphere: ProbedSphere, columns: int | None = None) -> ProbedSphere:
    """The same sphere with its groups as arrays, or `InputError` that names it."""
    where = f"sphere '{sphere.name}'"
    if sphere.test not in SPHERE_TESTS:
        raise InputError(f"{where}: test is '{sphere.test}'; it must be one of {', '.join(SPHERE_TESTS)}.")
    for what, value, least in (
        ("diameter", sphere.diameter, 1e-6),
        ("u", sphere.u, 0.0),
        ("stylus", sphere.stylus, 0.0),
        ("form", sphere.form, 0.0),
    ):
        if not (np.isfinite(value) and value >= least):
            raise InputError(f"{where}: {what} is {value:g} mm; it must be {'positive' if least else 'zero or positive'}.")
    groups = tuple(np.asarray(as_floats(group, where)) for group in sphere.groups)
    for group in groups:
        if group.ndim != 2 or not len(group) or (columns is not None and group.shape[1] != columns):
            raise InputError(
                f"{where} has a group of shape {group.shape}; give one row a touched point"
                + (f" and {columns} columns." if columns is not None else ".")
            )
    if not groups:
        raise InputError(f"{where} has no touched points; give at least one group.")
    return sphere._replace(groups=groups)


def single(arm: Arm) -> Arm:
    """The same arm, or `InputError` for a batch of arms: a file holds one."""
    if not is_single(arm):
        raise InputError("a file holds one arm, but this is a batch; take one of it first.")
    return arm

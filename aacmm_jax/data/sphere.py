"""Reference spheres as they were touched, for acceptance tests."""

from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from ..core.arrays import as_floats
from ..core.errors import InputError

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

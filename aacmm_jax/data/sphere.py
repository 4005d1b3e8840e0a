"""Reference spheres probed for acceptance tests."""

from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from ..core.arrays import as_floats
from ..core.errors import InputError

SphereTest = Literal["effective-diameter", "probing", "articulation"]
SPHERE_TESTS = get_args(SphereTest)


class ProbedSphere(NamedTuple):
    """A reference sphere as it was probed for an acceptance test; it takes no part in a calibration.

    Args:
        name: Name of the sphere.
        test: The test that it is for.
        groups: Joint readings ``(m, n)``, rad, or centres of the probe ``(m, 3)``, mm; one group for each sphere that
            is fitted: the repeats of ASME's effective diameter, the 25 points of ISO's probing test, or the
            orientations of its articulation test.
        diameter: Calibrated diameter, mm.
        u: Standard uncertainty (k = 1) of the diameter, mm.
        stylus: Diameter of the probe's ball, mm; 0 where the points are on the sphere itself.
        form: Calibrated form error of the sphere, mm.
        u_form: Standard uncertainty (k = 1) of the form error, mm.

    Example:
        >>> nine = np.array(aj.simulate(true, {"A": (400, 200, 300)}, poses=9, seed=1).sockets["A"])
        >>> sphere = aj.data.ProbedSphere("sphere", "effective-diameter", (nine,), diameter=25.0, u=0.0005)
        >>> print(len(sphere.groups), sphere.groups[0].shape)
        1 (9, 6)
    """

    name: str
    test: SphereTest
    groups: tuple[Float[np.ndarray, "m n"], ...]
    diameter: float
    u: float = 0.0
    stylus: float = 0.0
    form: float = 0.0
    u_form: float = 0.0


def checked_sphere(sphere: ProbedSphere, columns: int | None = None) -> ProbedSphere:
    """The same sphere with its groups as arrays, or `InputError` that names the sphere."""
    where = f"sphere '{sphere.name}'"
    if sphere.test not in SPHERE_TESTS:
        raise InputError(f"{where}: test is '{sphere.test}'; it must be one of {', '.join(SPHERE_TESTS)}.")
    for what in ("diameter", "u", "stylus", "form", "u_form"):
        value, positive = getattr(sphere, what), what == "diameter"
        if not (np.isfinite(value) and (value >= 1e-6 if positive else value >= 0)):
            raise InputError(f"{where}: {what} is {value:g} mm; it must be {'' if positive else 'zero or '}positive.")
    groups = tuple(np.asarray(as_floats(group, where)) for group in sphere.groups)
    for group in groups:
        if group.ndim != 2 or not len(group) or (columns is not None and group.shape[1] != columns):
            raise InputError(
                f"{where} has a group of shape {group.shape}; give one row a probed point"
                + (f" and {columns} columns." if columns is not None else ".")
            )
    if not groups:
        raise InputError(f"{where} has no probed points; give at least one group.")
    return sphere._replace(groups=groups)

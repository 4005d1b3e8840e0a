"""What acceptance tests look at and what they come to; and the figures that they take of points.

Formulas follow secondary sources, which each function names, with the edition that these describe: the standards were not at hand.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError
from ..data.capture import ReferenceLength
from ..data.sphere import ProbedSphere
from ..kinematics.workspace import Reach
from .decision import Decision, worst
from .spheres import enclosing_sphere, fit_sphere, points_of

METRICS = {
    "Deltam": "largest half range of a coordinate in a socket",
    "Length": "largest deviation of a length",
    "Length_Range": "largest less smallest deviation of lengths",
    "Length_2RMS": "twice the RMS deviation of lengths",
    "D_Eff": "largest error of the effective diameter",
    "SPAT": "largest distance from the mean point",
    "SPAT_2s": "twice the standard deviation about the mean point",
    "Volumetric": "largest deviation of a bar",
    "Volumetric_Range": "largest less smallest deviation of bars",
    "Volumetric_2RMS": "twice the RMS deviation of bars",
    "P_Size": "size error of a sphere of 25 points (P_Size.Sph.1x25)",
    "P_Form": "form error of a sphere of 25 points (P_Form.Sph.1x25)",
    "L_Dia": "sphere round five centres, each from its own orientation (L_Dia.5x5.Art)",
    "E_Uni": "length error, single readings (E_Uni)",
}
_GRAVITY = ("conforms", "undecided", "fails")


class Part(NamedTuple):
    """One measurement that a figure rests on: a socket, a length, a sphere. mm."""

    where: str
    value: float
    expanded: float  # U of the test value, coverage factor 2
    length: float | None = None  # calibrated length that was measured, where it is one: limits may grow with it
    limit: float | None = None  # MPE
    decision: Decision | None = None  # None without a limit


class Metric(NamedTuple):
    """One figure of a test; its name is a key of `METRICS`."""

    name: str
    parts: tuple[Part, ...]

    @property
    def worst(self) -> Part:
        """With limits the part that is decided worst, and of several the one nearest to its limit or farthest beyond; else the largest."""

        def badness(part: Part) -> tuple[int, float]:
            if part.limit is None or part.decision is None:
                return 0, abs(part.value)
            return _GRAVITY.index(part.decision), abs(part.value) - part.limit

        return max(self.parts, key=badness)

    @property
    def value(self) -> float:
        """Value of the worst part, mm."""
        return self.worst.value

    @property
    def decision(self) -> Decision | None:
        """What all parts come to together."""
        return worst([part.decision for part in self.parts if part.decision is not None])

    @property
    def failing(self) -> int:
        """How many parts fail."""
        return sum(part.decision == "fails" for part in self.parts)


class AcceptanceTest(NamedTuple):
    """What one test found, and what its full procedure would have needed besides (nothing, where it is complete)."""

    standard: str
    title: str
    figures: tuple[Metric, ...]
    missing: tuple[str, ...]

    @property
    def decision(self) -> Decision | None:
        """What all figures come to together; None without limits."""
        return worst([figure.decision for figure in self.figures if figure.decision is not None])


class Measured(NamedTuple):
    """Points in mm, as an arm measures them or as they were recorded: what acceptance tests look at."""

    sockets: Mapping[str, Float[np.ndarray, "m 3"]]
    lengths: tuple[ReferenceLength, ...] = ()
    spheres: tuple[ProbedSphere, ...] = ()  # with groups of points
    reach: Reach | None = None
    known: frozenset[str] = frozenset()  # sockets that the arm was identified from: their repeatability is no test
    seen: bool = False  # whether the arm was identified from all of this, so that nothing here is a test
    sources: tuple[str, ...] = ()  # files that points were read from
    measured: str = ""  # day on which they were recorded

    @property
    def tested(self) -> dict[str, Float[np.ndarray, "m 3"]]:
        """The sockets whose repeatability counts."""
        return {name: points for name, points in self.sockets.items() if name not in self.known}


def half_range(points: Numbers) -> float:
    """Deltam: the largest over axes of (max - min) / 2 of the points ``(m, 3)`` of one socket, mm (Cheng et al. 2018, eq. 11-12)."""
    return float(np.ptp(points_of(points, "points of a socket"), axis=0).max() / 2)


def spat(points: Numbers) -> tuple[float, float]:
    """ASME B89.4.22-2004, single-point articulation: largest distance of points ``(m, 3)`` from their mean, and 2 s, mm.

    s = sqrt(sum of squared distances / (m - 1)). From background knowledge of the standard.
    """
    given = points_of(points, "points of a socket")
    if len(given) < 2:
        raise InputError("one point has no scatter; articulate the arm about the socket and take at least two.")
    distances = np.linalg.norm(given - given.mean(axis=0), axis=1)
    return float(distances.max()), 2 * math.sqrt(float(distances @ distances) / (len(given) - 1))


def two_rms(deviations: Numbers) -> float:
    """Twice the root mean square of deviations from the calibrated values, mm (ASME B89.4.22; Cheng et al. 2018, section 4.4)."""
    given = np.asarray(as_floats(deviations, "deviations"))
    if not given.size:
        raise InputError("there are no deviations, so they have no root mean square; measure some.")
    return 2 * math.sqrt(float(np.mean(given**2)))


def size_error(points: Numbers, diameter: float, stylus: float = 0.0) -> float:
    """Diameter of the least-squares sphere, less that of the probe's ball, less the calibrated one, mm.

    With 25 points P_Size.Sph.1x25 (ISO 10360-12:2016), with 9 the error of the effective diameter (ASME B89.4.22-2004).
    """
    return 2 * fit_sphere(points).radius - stylus - diameter


def form_error(points: Numbers) -> float:
    """P_Form.Sph.1x25 (ISO 10360-12:2016): span of the points' distances from the centre of the least-squares sphere, mm."""
    return fit_sphere(points).form


def articulated_location(groups: Sequence[Numbers]) -> float:
    """L_Dia.5x5.Art (ISO 10360-12:2016): diameter, mm, of the smallest sphere round the centres of spheres fitted to each group.

    One group of five points for each of five orientations of the wrist; from background knowledge of the standard.
    """
    return 2 * enclosing_sphere([fit_sphere(group).centre for group in groups])[1]

"""What tests compute of points, spheres and lengths; the metrics of each test of the standards.

The texts of the standards were not available: formulas follow secondary sources and background knowledge of them.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError, naming
from ..data.recording import ProbedSphere, SphereTest
from .geometry import EXACT_POINTS, enclosing_sphere, fit_sphere, points_of
from .judgement import Influences
from .results import Measured, Metric, MetricValue, metric_value, percent

ZONES = ((0.0, 0.2), (0.2, 0.8), (0.8, 1.0))  # near, middle and far of ASME B89.4.22: fractions of the reach
SPAT_POSES = 10
BARS = ((0.5, 0.75), (1.2, 1.5))  # of ASME B89.4.22: fractions of the reach
LONGEST = 0.66  # least length of the longest bar of ISO 10360-12, as a part of the measuring range


def half_range(points: Numbers) -> float:
    """Deltam: the largest over the axes of (max - min) / 2, mm.

    Source: Cheng et al. 2018, equations 11 and 12.

    Args:
        points: Points ``(m, 3)`` of one socket, mm, at least one.

    Example:
        >>> print(aj.acceptance.half_range([[0.0, 0.0, 0.0], [0.02, 0.01, 0.0], [0.01, 0.0, 0.03]]))
        0.015
    """
    return float(np.ptp(points_of(points, "points of a socket"), axis=0).max() / 2)


def spat(points: Numbers) -> tuple[float, float]:
    """Single-point articulation: largest distance of a point from the mean point, and 2 s, mm.

    Source: ASME B89.4.22-2004, stated from background knowledge: s = sqrt(sum of squared distances / (m - 1)).

    Args:
        points: Points ``(m, 3)`` of one socket, mm, at least two.

    Example:
        >>> largest, two_s = aj.acceptance.spat([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.01, 0.0, 0.03]])
        >>> print(f"{largest:.4f} mm, {two_s:.4f} mm")
        0.0200 mm, 0.0400 mm
    """
    given = points_of(points, "points of a socket")
    if len(given) < 2:
        raise InputError(
            "one point has no scatter; articulate the arm about the socket and record at least two points."
        )
    distances = np.linalg.norm(given - given.mean(axis=0), axis=1)
    return float(distances.max()), 2 * math.sqrt(float(distances @ distances) / (len(given) - 1))


def size_error(points: Numbers, diameter: float, stylus: float = 0.0) -> float:
    """Diameter of the least-squares sphere, less the diameters of the probe's ball and of the calibrated sphere, mm.

    Source: of 25 points P_Size.Sph.1x25 (ISO 10360-12:2016), of 9 the error of the effective diameter (ASME
    B89.4.22-2004); the formula is stated from secondary sources.

    Args:
        points: Points ``(m, 3)`` of the probe's centre, mm, as `fit_sphere` takes them.
        diameter: Calibrated diameter, mm.
        stylus: Diameter of the probe's ball, mm; 0 if the points lie on the sphere itself.

    Example:
        >>> directions = np.concatenate([np.eye(3), -np.eye(3)])
        >>> print(f"{aj.acceptance.size_error(15.51 * directions, 25.0, stylus=6.0):.4f} mm")
        0.0200 mm
    """
    return 2 * fit_sphere(points).radius - stylus - diameter


def form_error(points: Numbers) -> float:
    """P_Form.Sph.1x25: range of the points' distances from the centre of the least-squares sphere, mm.

    Source: ISO 10360-12:2016, stated from secondary sources.

    Args:
        points: Points ``(m, 3)`` on one sphere, mm, as `fit_sphere` takes them.

    Example:
        >>> directions = np.concatenate([np.eye(3), -np.eye(3)])
        >>> points = (12.5 + 0.01 * np.array([1, 0, 0, 1, 0, 0]))[:, None] * directions
        >>> print(f"{aj.acceptance.form_error(points):.4f} mm")
        0.0100 mm
    """
    return fit_sphere(points).form


def articulated_location(groups: Sequence[Numbers]) -> float:
    """L_Dia.5x5.Art: diameter of the smallest sphere around the centres of the spheres fitted to each group, mm.

    Source: ISO 10360-12:2016, stated from background knowledge.

    Args:
        groups: Points ``(m, 3)`` on one sphere, mm, one group for each orientation of the wrist (five of five points).

    Example:
        >>> directions = np.concatenate([np.eye(3), -np.eye(3)])
        >>> centres = ([0.0, 0.0, 0.0], [0.02, 0.0, 0.0])
        >>> print(round(aj.acceptance.articulated_location([12.5 * directions + centre for centre in centres]), 6))
        0.02
    """
    return 2 * enclosing_sphere([fit_sphere(group).centre for group in groups])[1]


def two_rms(deviations: Numbers) -> float:
    """Twice the root mean square of deviations from calibrated values, mm.

    Source: ASME B89.4.22-2004, volumetric test, stated from background knowledge; Cheng et al. 2018, section 4.4.

    Args:
        deviations: Deviations of any shape, mm, at least one.

    Example:
        >>> print(f"{aj.acceptance.two_rms([0.01, -0.02, 0.005]):.4f} mm")
        0.0265 mm
    """
    given = np.asarray(as_floats(deviations, "deviations"))
    if not given.size:
        raise InputError("the root mean square of no deviations is not defined; give at least one deviation.")
    return 2 * math.sqrt(float(np.mean(given**2)))


def _readings(measured: Measured, influences: Influences) -> tuple[list[MetricValue], np.ndarray]:
    """Every length as single readings: the i-th point at one end with the i-th at the other; thermal expansion of
    artefact and arm, where it is stated, is corrected. And the u of each: of the artefact, and of the test, mm."""
    values, u = [], []
    for length in measured.lengths:
        start, end = (measured.sockets[name] for name in (length.start, length.end))
        pairs, value = min(len(start), len(end)), float(length.value)
        deviations = np.linalg.norm(end[:pairs] - start[:pairs], axis=1) - value + influences.correction(value)
        of_length = float(length.u), influences.u_of(value)
        for number, deviation in enumerate(deviations.tolist(), start=1):
            where = f"{length.start} - {length.end}" + (f", reading {number}" if pairs > 1 else "")
            values.append(metric_value(where, deviation, *of_length)._replace(length=value))
            u.append(of_length)
    return values, np.array(u).reshape(-1, 2)


def _deviations(name: str, measured: Measured, influences: Influences) -> list[Metric]:
    """Largest deviation, range and twice the RMS; only the first of a single reading.

    The calibration error is common to lengths of one artefact and independent between artefacts, and nothing states
    which lengths share one. So U of the range takes the errors as independent, and U of the RMS as fully correlated (by
    the Cauchy-Schwarz inequality it cannot be larger).
    """
    values, u = _readings(measured, influences)
    largest = Metric(name, tuple(values))
    if len(values) < 2:
        return [largest]
    deviations = np.array([value.value for value in values])
    low, high = int(deviations.argmin()), int(deviations.argmax())
    where, span = f"{values[low].where} to {values[high].where}", float(deviations[high] - deviations[low])
    of_span = metric_value(where, span, *u[[low, high]].T.ravel().tolist())
    of_rms = metric_value(f"{len(values)} readings", two_rms(deviations), *map(two_rms, u.T))
    return [largest, Metric(f"{name}_Range", (of_span,)), Metric(f"{name}_2RMS", (of_rms,))]


def single_point_and_length(measured: Measured, influences: Influences) -> list[Metric]:
    """Deltam in every socket, and the deviations of lengths (Cheng et al. 2018, section 4, after reference 17)."""
    sockets = {name: points for name, points in measured.tested.items() if len(points) > 1}
    deltam = tuple(metric_value(name, half_range(points), influences.u) for name, points in sockets.items())
    return [Metric("Deltam", deltam), *_deviations("Length", measured, influences)]


def spheres_for(measured: Measured, test: SphereTest) -> list[ProbedSphere]:
    """The spheres touched for one test."""
    return [sphere for sphere in measured.spheres if sphere.test == test]


def _sizes(measured: Measured, influences: Influences, test: SphereTest) -> Iterator[tuple]:
    """Sphere, number of the group, its points, and the value of its size."""
    for sphere in spheres_for(measured, test):
        for number, group in enumerate(sphere.groups, start=1):
            with naming(f"sphere '{sphere.name}', group {number}"):
                error = size_error(group, sphere.diameter, sphere.stylus) + influences.correction(sphere.diameter)
            several = len(sphere.groups) > 1 or test == "effective-diameter"
            where = sphere.name + (f", repeat {number}" if several else "")
            yield sphere, group, metric_value(where, error, sphere.u, influences.u_of(sphere.diameter))


def effective_diameter(measured: Measured, influences: Influences) -> list[Metric]:
    """Largest |D - Dcal| of a sphere."""
    return [Metric("D_Eff", tuple(value for *_, value in _sizes(measured, influences, "effective-diameter")))]


def articulation(measured: Measured, influences: Influences) -> list[Metric]:
    """Scatter in sockets of 10 articulations or more; distances are from the shoulder (see `arm_reach`)."""
    values: list[list[MetricValue]] = [[], []]
    for name, points in articulated(measured).items():
        zone = zone_of(measured, points)
        where = name if zone is None else f"{name} ({percent(zone)} of the reach)"
        for of_metric, value in zip(values, spat(points), strict=True):
            of_metric.append(metric_value(where, value, influences.u))
    return [Metric(name, tuple(of_metric)) for name, of_metric in zip(("SPAT", "SPAT_2s"), values, strict=True)]


def articulated(measured: Measured) -> dict[str, np.ndarray]:
    """The sockets with enough articulations."""
    return {name: points for name, points in measured.tested.items() if len(points) >= SPAT_POSES}


def zone_of(measured: Measured, points: np.ndarray) -> tuple[float, float] | None:
    """The zone of the reach that a socket is in; None where the shoulder is unknown."""
    if measured.reach is None:
        return None
    fraction = float(np.linalg.norm(points.mean(axis=0) - measured.reach.shoulder)) / (measured.size or 0.0) * 2
    return next((zone for zone in ZONES if fraction <= zone[1]), ZONES[-1])


def bar_range(bar: tuple[float, float], radius: float) -> str:
    """The lengths of a bar of ASME B89.4.22 in words."""
    return f"{percent(bar)} of the reach ({bar[0] * radius:.0f} to {bar[1] * radius:.0f} mm)"


def volumetric(measured: Measured, influences: Influences) -> list[Metric]:
    """Largest |L - Lcal|, range and twice the RMS."""
    return _deviations("Volumetric", measured, influences)


def probing(measured: Measured, influences: Influences) -> list[Metric]:
    """Size and form error of 25 points on a sphere.

    The uncertainty of the form error contains half the certified form F of the sphere, and u(F) (ISO/TS 23165:2006,
    stated from background knowledge: U = k sqrt((F/2)^2 + u(F)^2)).
    """
    rows = list(_sizes(measured, influences, "probing"))
    form = [
        metric_value(size.where, form_error(group), sphere.form / 2, sphere.u_form, influences.u)
        for sphere, group, size in rows
        if len(group) > EXACT_POINTS
    ]
    return [Metric("P_Size", tuple(size for *_, size in rows)), Metric("P_Form", tuple(form))]


def location(measured: Measured, influences: Influences) -> list[Metric]:
    """Articulated location: 5 points on a sphere in each of 5 orientations."""
    values = []
    for sphere in spheres_for(measured, "articulation"):
        if len(sphere.groups) > 1:  # the sphere around one centre always has the diameter zero
            with naming(f"sphere '{sphere.name}'"):
                error = articulated_location(sphere.groups)
            values.append(metric_value(sphere.name, error, sphere.form / 2, sphere.u_form, influences.u))
    return [Metric("L_Dia", tuple(values))]


def length_error(measured: Measured, influences: Influences) -> list[Metric]:
    """Length error of single readings. The repeated readings that the standard permits are not taken into account."""
    return [Metric("E_Uni", tuple(_readings(measured, influences)[0]))]

"""ISO 10360-12:2016: probing (P_Size, P_Form), articulated location (L_Dia), length error (E_Uni), planned procedure.

The text of the standard was not available: `TESTS` says of each requirement where it was found, and how certain it is.
"""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from ..core.arrays import Numbers
from ..core.errors import naming
from .geometry import LEAST_SPREAD, unit_rows
from .judgement import Influences
from .lengths import length_readings
from .procedure_items import PlannedItems, PlannedSphere, ProcedureRegion, bar_items, socket_in_zone, touch_item
from .requirements import (
    CALIBRATED,
    CONDITIONS,
    RANGE_STATED,
    Requirement,
    StandardTest,
    groups_of_touches,
    of_bars,
    sphere_positions,
    sphere_size,
    spheres_for,
    spread_places,
    spread_touches,
    touches,
)
from .results import Measured, Metric, metric_value
from .spheres import EXACT_POINTS, enclosing_sphere, fit_sphere, size_error
from .standards import ISO_10360_12

_PROBING_POINTS, _ORIENTATIONS, _ORIENTATION_POINTS = 25, 5, 5
_LENGTHS, _POSITIONS, _REPEATS = 5, 7, 3
_LONGEST, _LONGEST_PLANNED = 0.66, 0.68  # least length of the longest bar, and what is planned; fractions of the range
# Where the sphere is planned, once in each: fractions of half the range, and the least poses that reach it.
_SPHERE_ZONES, _SPHERE_POSES = ((0.2, 0.5), (0.5, 0.8)), 10
_SPHERES_APART = 0.3  # of both planned places, as a part of the reach
_LEAST_TURN = math.radians(10)  # of the probe between two orientations
_KREON = "digitalscan3d.com/iso-10360-12-standard-for-measuring-arms (Kreon)"
_OBERON = "oberon3d.com, on ISO 10360-12 (the same maker, in Polish)"
_PROBING, _LOCATION, _LENGTH_ERROR = "probing size and form", "articulated location", "length error"


def form_error(points: Numbers) -> float:
    """P_Form.Sph.1x25: range of the points' distances from the centre of the least-squares sphere.

    Source: ISO 10360-12:2016, stated from secondary sources.

    Args:
        points: Points ``(m, 3)`` on one sphere, mm.

    Returns:
        The form error, mm.

    Raises:
        InputError: The points do not determine a sphere.

    Example:
        >>> directions = np.concatenate([np.eye(3), -np.eye(3)])
        >>> points = (12.5 + 0.01 * np.array([1, 0, 0, 1, 0, 0]))[:, None] * directions
        >>> print(f"{aj.acceptance.form_error(points):.4f} mm")
        0.0100 mm
    """
    return fit_sphere(points).form


def articulated_location(groups: Sequence[Numbers]) -> float:
    """L_Dia.5x5.Art: diameter of the smallest sphere that contains the centres of the spheres fitted to each group.

    Source: ISO 10360-12:2016, stated from background knowledge.

    Args:
        groups: Points ``(m, 3)`` on one sphere, mm, one group for each orientation of the wrist (five of five points).

    Returns:
        The diameter, mm.

    Raises:
        InputError: The points of a group do not determine a sphere.

    Example:
        >>> directions = np.concatenate([np.eye(3), -np.eye(3)])
        >>> centres = ([0.0, 0.0, 0.0], [0.02, 0.0, 0.0])
        >>> print(round(aj.acceptance.articulated_location([12.5 * directions + centre for centre in centres]), 6))
        0.02
    """
    return 2 * enclosing_sphere([fit_sphere(group).centre for group in groups])[1]


def _probing_metrics(measured: Measured, influences: Influences) -> list[Metric]:
    """Size and form error of 25 points on a sphere.

    The uncertainty of the form error contains half the certified form F of the sphere, and u(F) (ISO/TS 23165:2006,
    stated from background knowledge: U = k sqrt((F/2)^2 + u(F)^2)).
    """
    size, form = [], []
    for sphere in spheres_for(measured, "probing"):
        for number, group in enumerate(sphere.groups, start=1):
            where = sphere.name + (f", repeat {number}" if len(sphere.groups) > 1 else "")
            with naming(f"sphere '{sphere.name}', group {number}"):
                error = size_error(group, sphere.diameter, sphere.stylus) + influences.correction(sphere.diameter)
            size.append(metric_value(where, error, sphere.u, influences.u_of(sphere.diameter)))
            if len(group) > EXACT_POINTS:
                form.append(metric_value(where, form_error(group), sphere.form / 2, sphere.u_form, influences.u))
    return [Metric("P_Size", tuple(size)), Metric("P_Form", tuple(form))]


def _location_metrics(measured: Measured, influences: Influences) -> list[Metric]:
    """Articulated location: 5 points on a sphere in each of 5 orientations."""
    values = []
    for sphere in spheres_for(measured, "articulation"):
        if len(sphere.groups) > 1:  # the sphere around one centre always has the diameter zero
            with naming(f"sphere '{sphere.name}'"):
                error = articulated_location(sphere.groups)
            values.append(metric_value(sphere.name, error, sphere.form / 2, sphere.u_form, influences.u))
    return [Metric("L_Dia", tuple(values))]


def _length_metrics(measured: Measured, influences: Influences) -> list[Metric]:
    """Length error of single readings. The repeated readings that the standard permits are not taken into account."""
    return [Metric("E_Uni", tuple(reading.as_value(influences) for reading in length_readings(measured, influences)))]


def _orientations_lacking(measured: Measured) -> str:
    if measured.postures is None:
        return "Points do not tell the orientations of the probe; record joint readings."
    for (name, test), groups in measured.postures.probes.items():
        means = (
            unit_rows(np.array([directions.mean(axis=0) for directions in groups])) if test == "articulation" else []
        )
        for mean, other in itertools.combinations(means, 2):
            if mean @ other > math.cos(_LEAST_TURN):
                return f"The orientations of the probe must differ; on sphere '{name}' two are nearly the same."
    return ""


def _longest_lacking(measured: Measured) -> str:
    if measured.measuring_range is None:
        return ""  # a requirement of its own
    longest, least = max(float(length.value) for length in measured.lengths), _LONGEST * measured.measuring_range
    if longest >= least:
        return ""
    return f"A length of {least:.0f} mm or more is required (66 % of the range); the longest has {longest:.0f} mm."


TESTS = (
    StandardTest(
        ISO_10360_12,
        _PROBING,
        _probing_metrics,
        (
            sphere_size("probing", 10, 51, ("as in ISO 10360-5", "background")),
            touches("probing", _PROBING_POINTS, (_KREON, "public source")),
            spread_touches("probing", _PROBING_POINTS, ("pattern of ISO 10360-5", "own reading")),
            sphere_positions("probing", 2, (_KREON, "public source")),
            RANGE_STATED,
            CALIBRATED,
            CONDITIONS,
        ),
    ),
    StandardTest(
        ISO_10360_12,
        _LOCATION,
        _location_metrics,
        (
            sphere_size("articulation", 10, 51, ("as in ISO 10360-5", "background")),
            groups_of_touches("articulation", _ORIENTATIONS, "orientations", (_KREON, "public source")),
            touches("articulation", _ORIENTATION_POINTS, (_KREON, "public source")),
            spread_touches("articulation", _ORIENTATION_POINTS, ("as for 25 points", "own reading")),
            Requirement(
                "five different orientations of the probe, by 10 degrees or more",
                _KREON,
                "own reading",
                _orientations_lacking,
            ),
            sphere_positions("articulation", 2, (_OBERON, "public source")),
            RANGE_STATED,
            CALIBRATED,
            CONDITIONS,
        ),
    ),
    StandardTest(
        ISO_10360_12,
        _LENGTH_ERROR,
        _length_metrics,
        (
            of_bars("lengths", _LENGTHS, ("as in ISO 10360-2 (a maker's public summary: 5 gauges)", "background")),
            of_bars("positions of each", _POSITIONS, ("as in ISO 10360-2 (the same: 7 directions)", "own reading")),
            of_bars("readings", _REPEATS, ("as in ISO 10360-2 (the same: 3 times)", "background")),
            of_bars("directions of each", 1, ("as in ISO 10360-2, with diagonals of the volume", "own reading")),
            spread_places(True, LEAST_SPREAD, ("the lengths are to sample the volume", "own reading")),
            RANGE_STATED,
            Requirement(
                "the longest length at least 66 % of the measuring range",
                "as in ISO 10360-2 of the longest diagonal",
                "background",
                _longest_lacking,
            ),
            Requirement(
                "lengths probed from one direction at both ends, or between centres; sockets are. E_Bi is another test",
                "ISO 10360-12, symbols of makers",
                "background",
            ),
            CALIBRATED,
            CONDITIONS,
        ),
    ),
)


def default_bars(measuring_range: float) -> list[float]:
    """Five lengths in equal steps, the longest a little over the standard's 66 % of the range, mm."""
    longest = _LONGEST_PLANNED * measuring_range
    return [round(longest * number / _LENGTHS) for number in range(1, _LENGTHS + 1)]


def unsuitable_bars(measuring_range: float, lengths: list[float]) -> list[str]:
    """A sentence if the longest bar is too short."""
    least = _LONGEST * measuring_range
    if lengths[-1] >= least:
        return []
    return [f"The longest bar, {lengths[-1]:g} mm, is under 66 % of the range ({least:.0f} mm)."]


def procedure_items(region: ProcedureRegion, diameter: float, stylus: float, bars: list[float]) -> PlannedItems:
    """In two places 25 points on a sphere, five in each of five orientations; bars in seven positions, three times."""
    touches, spheres = [], []
    for place, zone in enumerate(_SPHERE_ZONES, start=1):
        others = [sphere.centre for sphere in spheres]
        centre, _ = socket_in_zone(region, zone, _SPHERE_POSES, others, _SPHERES_APART * region.reach.radius)
        sphere = PlannedSphere(f"sphere{place}", "probing", centre, diameter, stylus)
        articulated = sphere._replace(test="articulation")
        touches.append(touch_item(region, sphere, _PROBING, _PROBING_POINTS, 1))
        for number in range(1, _ORIENTATIONS + 1):
            azimuth = 2 * math.pi * number / _ORIENTATIONS
            touches.append(touch_item(region, articulated, _LOCATION, _ORIENTATION_POINTS, number, azimuth))
        spheres += [sphere, articulated]
    sockets, lengths = [], []
    for number, length in enumerate(bars, start=1):
        ends, pairs = bar_items(region, f"bar{number}", length, _POSITIONS, _REPEATS, _LENGTH_ERROR)
        sockets += ends
        lengths += pairs
    return PlannedItems(sockets, touches, lengths, spheres, [])

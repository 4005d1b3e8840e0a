"""ISO 10360-12:2016: probing (P_Size, P_Form), articulated location (L_Dia), length error (E_Uni), planned procedure.

The text of the standard was not available: the probing test follows public sources, the others background knowledge.
"""

import math
from collections.abc import Sequence

from ..core.arrays import Numbers
from ..core.text import pluralise
from ..kinematics.workspace import Reach
from .lengths import distinct_lengths, length_readings, values_by_artefact
from .procedure_items import PlannedItems, PlannedSphere, ProcedureRegion, bar_items, socket_in_zone, touch_item
from .results import AcceptanceTest, Measured, Metric, acceptance_test, metric_value
from .spheres import EXACT_POINTS, enclosing_sphere, errors_named, fit_sphere, missing_touches, size_error
from .standards import ISO_10360_12

_PROBING_POINTS, _ORIENTATIONS, _ORIENTATION_POINTS = 25, 5, 5
_LENGTHS, _POSITIONS, _REPEATS = 5, 7, 3
_LONGEST, _LONGEST_PLANNED = 0.66, 0.68  # least length of the longest bar, and what is planned; fractions of the range
_SPHERE_ZONE, _SPHERE_POSES = (0.2, 0.8), 10  # where the sphere is planned: fractions of the reach, poses that reach it
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
    """
    return 2 * enclosing_sphere([fit_sphere(group).centre for group in groups])[1]


def probing(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """Size and form error of 25 points on a sphere.

    Half of the sphere's form error counts as a standard uncertainty of the form (ISO/TS 23165; background knowledge).
    """
    size, form, missing = [], [], []
    for sphere in (sphere for sphere in measured.spheres if sphere.test == "probing"):
        for number, group in enumerate(sphere.groups, start=1):
            where = sphere.name + (f", repeat {number}" if len(sphere.groups) > 1 else "")
            with errors_named(sphere, number):
                size.append(metric_value(where, size_error(group, sphere.diameter, sphere.stylus), sphere.u, u_test))
            if len(group) > EXACT_POINTS:
                form.append(metric_value(where, form_error(group), sphere.form / 2, u_test))
        missing += missing_touches(sphere, groups=1, points=_PROBING_POINTS, of="groups")
    metrics = [Metric("P_Size", tuple(size)), Metric("P_Form", tuple(form))]
    return acceptance_test(ISO_10360_12, _PROBING, metrics, missing)


def location(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """Articulated location L_Dia.5x5.Art: 5 points on a sphere in each of 5 orientations."""
    values, missing = [], []
    for sphere in (sphere for sphere in measured.spheres if sphere.test == "articulation"):
        if len(sphere.groups) > 1:  # the sphere around one centre always has the diameter zero
            with errors_named(sphere):
                values.append(metric_value(sphere.name, articulated_location(sphere.groups), sphere.form / 2, u_test))
        missing += missing_touches(sphere, groups=_ORIENTATIONS, points=_ORIENTATION_POINTS, of="orientations")
    return acceptance_test(ISO_10360_12, _LOCATION, [Metric("L_Dia", tuple(values))], missing)


def length_error(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """Length error E_Uni: 5 lengths in 7 positions, 3 readings each; the longest at least 66 % of the range.

    The range is taken as twice the reach. The repeated readings that the standard permits are not taken into account.
    """
    values = tuple(reading.as_value(u_test) for reading in length_readings(measured))
    missing = []
    lengths = distinct_lengths(measured.lengths)
    bars = values_by_artefact(lengths)
    repeats = [len(measured.sockets[name]) for length in lengths for name in (length.start, length.end)]
    if len(bars) < _LENGTHS or min(map(len, bars)) < _POSITIONS or min(repeats) < _REPEATS:
        missing.append(
            f"{_LENGTHS} lengths in {_POSITIONS} positions, {_REPEATS} readings each: "
            f"{_LENGTHS * _POSITIONS * _REPEATS} in all ({pluralise(len(values), 'reading')} of "
            f"{pluralise(len(bars), 'length')} given)"
        )
    if measured.reach is None:
        missing.append("the reach of the arm, to judge the longest length")
    elif values and max(float(length.value) for length in measured.lengths) < _least_longest(measured.reach):
        missing.append(f"a length of {_least_longest(measured.reach):.0f} mm or more (66 % of the range)")
    return acceptance_test(ISO_10360_12, _LENGTH_ERROR, [Metric("E_Uni", values)], missing)


def default_bars(reach: Reach) -> list[float]:
    """Five lengths in equal steps, the longest a little over the standard's 66 % of the range, mm."""
    longest = _LONGEST_PLANNED * 2 * reach.radius
    return [round(longest * number / _LENGTHS) for number in range(1, _LENGTHS + 1)]


def unsuitable_bars(reach: Reach, lengths: list[float]) -> list[str]:
    """A sentence if the longest bar is too short."""
    least = _least_longest(reach)
    if lengths[-1] >= least:
        return []
    return [f"The longest bar, {lengths[-1]:g} mm, is under 66 % of the range ({least:.0f} mm)."]


def procedure_items(region: ProcedureRegion, diameter: float, stylus: float, bars: list[float]) -> PlannedItems:
    """25 points on a sphere, five in each of five orientations, and bars in seven positions, three times each."""
    centre, _ = socket_in_zone(region, _SPHERE_ZONE, _SPHERE_POSES)
    sphere = PlannedSphere("sphere", "probing", centre, diameter, stylus)
    articulated = sphere._replace(test="articulation")
    touches = [touch_item(region, sphere, _PROBING, _PROBING_POINTS, 1)]
    touches += [
        touch_item(region, articulated, _LOCATION, _ORIENTATION_POINTS, number, 2 * math.pi * number / _ORIENTATIONS)
        for number in range(1, _ORIENTATIONS + 1)
    ]
    sockets, lengths = [], []
    for number, length in enumerate(bars, start=1):
        ends, pairs = bar_items(region, f"bar{number}", length, _POSITIONS, _REPEATS, _LENGTH_ERROR)
        sockets += ends
        lengths += pairs
    return PlannedItems(sockets, touches, lengths, [sphere, articulated], [])


def _least_longest(reach: Reach) -> float:
    return _LONGEST * 2 * reach.radius

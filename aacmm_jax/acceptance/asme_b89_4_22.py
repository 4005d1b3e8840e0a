"""ASME B89.4.22-2004: effective diameter, single-point articulation (SPAT), volumetric test, and the planned procedure.

The text of the standard was not available: formulas and procedures follow background knowledge of it.
"""

import math

import numpy as np

from ..core.arrays import Numbers
from ..core.errors import InputError
from ..kinematics.workspace import Reach
from .lengths import deviation_metrics, distinct_lengths, length_readings, values_by_artefact
from .procedure_items import (
    OutOfReach,
    PlannedItems,
    PlannedSphere,
    ProcedureItem,
    ProcedureRegion,
    bar_items,
    far_apart,
    socket_in_zone,
    touch_item,
)
from .results import AcceptanceTest, Measured, Metric, acceptance_test, metric_value, percent
from .spheres import errors_named, missing_touches, points_of, size_error
from .standards import ASME_B89_4_22

ZONES = {"near": (0.0, 0.2), "middle": (0.2, 0.8), "far": (0.8, 1.0)}  # fractions of the reach
BARS = ((0.5, 0.75), (1.2, 1.5))  # fractions of the reach
_SPAT_POSES, _POSITIONS, _DIAMETER_POINTS, _DIAMETER_REPEATS = 10, 20, 9, 3
_DIAMETER, _SPAT, _VOLUMETRIC = "effective diameter", "single-point articulation", "volumetric"


def spat(points: Numbers) -> tuple[float, float]:
    """Scatter of the points of one socket in the single-point articulation test.

    Source: ASME B89.4.22-2004, stated from background knowledge: s = sqrt(sum of squared distances / (m - 1)).

    Args:
        points: Points ``(m, 3)``, mm.

    Returns:
        Largest distance of a point from the mean point, and 2 s, mm.

    Raises:
        InputError: There are fewer than two points.
    """
    given = points_of(points, "points of a socket")
    if len(given) < 2:
        raise InputError("one point has no scatter; articulate the arm about the socket and take at least two.")
    distances = np.linalg.norm(given - given.mean(axis=0), axis=1)
    return float(distances.max()), 2 * math.sqrt(float(distances @ distances) / (len(given) - 1))


def effective_diameter(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """Largest |D - Dcal| of a sphere of 10 to 50 mm: 9 points, 3 repeats."""
    values, missing = [], []
    for sphere in (sphere for sphere in measured.spheres if sphere.test == "effective-diameter"):
        for number, group in enumerate(sphere.groups, start=1):
            with errors_named(sphere, number):
                error = size_error(group, sphere.diameter, sphere.stylus)
            values.append(metric_value(f"{sphere.name}, repeat {number}", error, sphere.u, u_test))
        missing += missing_touches(sphere, groups=_DIAMETER_REPEATS, points=_DIAMETER_POINTS, of="repeats")
    return acceptance_test(ASME_B89_4_22, _DIAMETER, [Metric("D_Eff", tuple(values))], missing)


def single_point_articulation(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """A socket in each of three zones of the reach (0 to 20, 20 to 80, 80 to 100 %), 10 articulations in each.

    Distances are from the shoulder (see `arm_reach`); sockets with fewer poses are left out.
    """
    largest, scatter, zones = [], [], set()
    reach = measured.reach
    for name, points in measured.tested.items():
        if len(points) < _SPAT_POSES:
            continue
        zone = None if reach is None else _zone(reach, points)
        zones.add(zone)
        where = name if zone is None else f"{name} ({percent(zone)} of the reach)"
        for values, value in zip((largest, scatter), spat(points), strict=True):
            values.append(metric_value(where, value, u_test))
    missing = ["the reach of the arm, to distinguish its zones"]
    if reach is not None:
        missing = [
            f"a socket with {_SPAT_POSES} poses at {percent(zone)} of the reach ({zone[0] * reach.radius:.0f} to "
            f"{zone[1] * reach.radius:.0f} mm from the shoulder)"
            for zone in ZONES.values()
            if zone not in zones
        ]
    metrics = [Metric("SPAT", tuple(largest)), Metric("SPAT_2s", tuple(scatter))]
    return acceptance_test(ASME_B89_4_22, _SPAT, metrics, missing)


def volumetric(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """Largest |L - Lcal|, range and twice the RMS: two bars (50 to 75, 120 to 150 % of the reach), 20 positions."""
    missing = []
    lengths = distinct_lengths(measured.lengths)
    if len(lengths) < _POSITIONS:
        missing.append(f"{_POSITIONS} positions of the bars ({len(lengths)} given)")
    bars = values_by_artefact(lengths)
    if len(bars) != len(BARS):
        missing.append(f"two bars, no fewer and no more ({len(bars)} given)")
    elif min(map(len, bars)) < _POSITIONS // 4:
        missing.append(f"each bar in {_POSITIONS // 4} positions or more")
    if measured.reach is None:
        missing.append("the reach of the arm, to judge the lengths of the bars")
    else:
        radius = measured.reach.radius
        values = np.array([float(length.value) for length in measured.lengths]) / radius
        missing += [
            f"a bar of {_bar_range(bar, radius)}" for bar in BARS if not np.any((values >= bar[0]) & (values <= bar[1]))
        ]
    names = ("Volumetric", "Volumetric_Range", "Volumetric_2RMS")
    metrics = deviation_metrics(length_readings(measured), u_test, names)
    return acceptance_test(ASME_B89_4_22, _VOLUMETRIC, metrics, missing)


def default_bars(reach: Reach) -> list[float]:
    """Lengths of bars in the middle of the standard's ranges, mm."""
    return [round(float(np.mean(bar)) * reach.radius) for bar in BARS]


def unsuitable_bars(reach: Reach, lengths: list[float]) -> list[str]:
    """Sentences on bars outside the standard's ranges."""
    return [
        f"A bar of {length:g} mm is not {_bar_range(bar, reach.radius)}."
        for bar, length in zip(BARS, lengths, strict=True)
        if not bar[0] <= length / reach.radius <= bar[1]
    ]


def procedure_items(region: ProcedureRegion, diameter: float, stylus: float, bars: list[float]) -> PlannedItems:
    """A socket in every zone that can be reached, three repeats on a sphere, and two bars in ten positions each."""
    sockets, lengths, left_out = [], [], []
    for name, zone in ZONES.items():
        try:
            point, q = socket_in_zone(region, zone, _SPAT_POSES)
        except OutOfReach as error:
            left_out.append(f"{error} The test leaves out that zone.")
            continue
        q = q[far_apart(q, _SPAT_POSES)]
        sockets.append(ProcedureItem(_SPAT, f"spat/{name}", 1, np.tile(point, (len(q), 1)), q))
    middle = next((item.points[0] for item in sockets if item.name == "spat/middle"), None)
    if middle is None:
        raise InputError(f"{left_out[0]} Nothing can be tested without the middle zone; lower the table or the margin.")
    sphere = PlannedSphere("sphere", "effective-diameter", middle, diameter, stylus)
    repeats = range(1, _DIAMETER_REPEATS + 1)
    touches = [touch_item(region, sphere, _DIAMETER, _DIAMETER_POINTS, number) for number in repeats]
    for number, length in enumerate(bars, start=1):
        ends, pairs = bar_items(region, f"bar{number}", length, _POSITIONS // len(bars), 1, _VOLUMETRIC)
        sockets += ends
        lengths += pairs
    return PlannedItems(sockets, touches, lengths, [sphere], left_out)


def _bar_range(bar: tuple[float, float], radius: float) -> str:
    return f"{percent(bar)} of the reach ({bar[0] * radius:.0f} to {bar[1] * radius:.0f} mm)"


def _zone(reach: Reach, points: np.ndarray) -> tuple[float, float]:
    fraction = float(np.linalg.norm(points.mean(axis=0) - reach.shoulder)) / reach.radius
    return next((zone for zone in ZONES.values() if fraction <= zone[1]), ZONES["far"])

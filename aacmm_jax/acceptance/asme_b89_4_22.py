"""ASME B89.4.22-2004: effective diameter, single-point articulation (SPAT), volumetric test, and the planned procedure.

The text of the standard was not available: formulas and procedures follow background knowledge of it.
"""

import math
from collections.abc import Sequence

import numpy as np

from ..core.arrays import Numbers
from ..core.errors import InputError, naming
from ..data.sphere import ProbedSphere
from ..kinematics.workspace import Reach
from .geometry import LEAST_SPREAD, LEFT_OR_RIGHT, elbow_sides, least_turn
from .judgement import Influences
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
from .requirements import (
    CALIBRATED,
    CONDITIONS,
    RANGE_STATED,
    Origin,
    Requirement,
    StandardTest,
    groups_of_touches,
    groups_where,
    of_bars,
    of_spheres,
    sphere_size,
    spheres_for,
    spread_places,
    spread_touches,
    touches,
)
from .results import Measured, Metric, metric_value, percent
from .spheres import points_of, size_error
from .standards import ASME_B89_4_22

ZONES = {"near": (0.0, 0.2), "middle": (0.2, 0.8), "far": (0.8, 1.0)}  # fractions of the reach
BARS = ((0.5, 0.75), (1.2, 1.5))  # fractions of the reach
_SPAT_POSES, _POSITIONS, _DIAMETER_POINTS, _DIAMETER_REPEATS = 10, 20, 9, 3
_LEAST_TURN, _LEAST_ELBOW = math.radians(15), 3  # of rings of touches; poses with the elbow on either side
_BACKGROUND: Origin = ("background knowledge of ASME B89.4.22", "background")
_READING: Origin = (_BACKGROUND[0], "own reading")
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

    Example:
        >>> largest, two_s = aj.acceptance.spat([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.01, 0.0, 0.03]])
        >>> print(f"{largest:.4f} mm, {two_s:.4f} mm")
        0.0200 mm, 0.0400 mm
    """
    given = points_of(points, "points of a socket")
    if len(given) < 2:
        raise InputError("one point has no scatter; articulate the arm about the socket and take at least two.")
    distances = np.linalg.norm(given - given.mean(axis=0), axis=1)
    return float(distances.max()), 2 * math.sqrt(float(distances @ distances) / (len(given) - 1))


def _diameter_metrics(measured: Measured, influences: Influences) -> list[Metric]:
    """Largest |D - Dcal| of a sphere."""
    values = []
    for sphere in spheres_for(measured, "effective-diameter"):
        for number, group in enumerate(sphere.groups, start=1):
            with naming(f"sphere '{sphere.name}', group {number}"):
                error = size_error(group, sphere.diameter, sphere.stylus) + influences.correction(sphere.diameter)
            u = influences.u_of(sphere.diameter)
            values.append(metric_value(f"{sphere.name}, repeat {number}", error, sphere.u, u))
    return [Metric("D_Eff", tuple(values))]


def _articulation_metrics(measured: Measured, influences: Influences) -> list[Metric]:
    """Scatter in sockets of 10 articulations or more; distances are from the shoulder (see `arm_reach`)."""
    largest, scatter = [], []
    for name, points in _articulated(measured).items():
        zone = _zone(measured, points)
        where = name if zone is None else f"{name} ({percent(zone)} of the reach)"
        for values, value in zip((largest, scatter), spat(points), strict=True):
            values.append(metric_value(where, value, influences.u))
    return [Metric("SPAT", tuple(largest)), Metric("SPAT_2s", tuple(scatter))]


def _volumetric_metrics(measured: Measured, influences: Influences) -> Sequence[Metric]:
    """Largest |L - Lcal|, range and twice the RMS."""
    names = ("Volumetric", "Volumetric_Range", "Volumetric_2RMS")
    return deviation_metrics(length_readings(measured, influences), influences, names)


def _articulated(measured: Measured) -> dict[str, np.ndarray]:
    return {name: points for name, points in measured.tested.items() if len(points) >= _SPAT_POSES}


def _straight_rings(sphere: ProbedSphere) -> list[str]:
    return groups_where(
        sphere, lambda group: len(group) >= _DIAMETER_POINTS and least_turn(group) < _LEAST_TURN, "repeat"
    )


def _zones_lacking(measured: Measured) -> str:
    if measured.reach is None:
        return "The reach of the arm and its shoulder are unknown, so that its zones cannot be told apart."
    radius = _radius(measured, measured.reach)
    zones = {_zone(measured, points) for points in _articulated(measured).values()}
    absent = [
        f"at {percent(zone)} of the reach ({zone[0] * radius:.0f} to {zone[1] * radius:.0f} mm from the shoulder)"
        for zone in ZONES.values()
        if zone not in zones
    ]
    return f"A socket with {_SPAT_POSES} poses is required {' and '.join(absent)}." if absent else ""


def _elbow_lacking(measured: Measured) -> str:
    if measured.postures is None:
        return "Points do not tell on which side the elbow was; record joint readings."
    bad = []
    for name in _articulated(measured):
        sides = np.sin(measured.postures.elbows[name])
        if min(np.sum(sides >= math.sin(LEFT_OR_RIGHT)), np.sum(sides <= -math.sin(LEFT_OR_RIGHT))) < _LEAST_ELBOW:
            bad.append(name)
    if not bad:
        return ""
    few = f"{_LEAST_ELBOW} poses"
    return f"The elbow must be on the left in {few} and on the right in {few} of every socket ({', '.join(bad)})."


def _two_bars_lacking(measured: Measured) -> str:
    groups = values_by_artefact(distinct_lengths(measured.lengths))
    if len(groups) != len(BARS):
        return f"Two bars are required, no fewer and no more ({len(groups)} given)."
    return "" if min(map(len, groups)) >= _POSITIONS // 4 else f"Each bar is required in {_POSITIONS // 4} positions."


def _bar_lengths_lacking(measured: Measured) -> str:
    if measured.reach is None and measured.measuring_range is None:
        return "The reach of the arm is unknown, so that the lengths of the bars cannot be judged."
    radius = _radius(measured, measured.reach)
    values = np.array([float(length.value) for length in measured.lengths]) / radius
    wanted = [_bar_range(bar, radius) for bar in BARS if not np.any((values >= bar[0]) & (values <= bar[1]))]
    return f"A bar of {' and one of '.join(wanted)} is required." if wanted else ""


TESTS = (
    StandardTest(
        ASME_B89_4_22,
        _DIAMETER,
        _diameter_metrics,
        (
            sphere_size("effective-diameter", 10, 50, _BACKGROUND),
            touches("effective-diameter", _DIAMETER_POINTS, _BACKGROUND),
            groups_of_touches("effective-diameter", _DIAMETER_REPEATS, "repeats", _BACKGROUND),
            spread_touches("effective-diameter", _DIAMETER_POINTS, _READING),
            of_spheres(
                "rings of touches turned against each other, by 22.5 deg or more (15 as touched by hand)",
                "effective-diameter",
                _straight_rings,
                "The rings of touches must be turned by 22.5 deg or more against each other ({}).",
                _BACKGROUND,
            ),
            CALIBRATED,
            CONDITIONS,
        ),
    ),
    StandardTest(
        ASME_B89_4_22,
        _SPAT,
        _articulation_metrics,
        (
            Requirement(
                "a socket with 10 articulations in each of three zones: 0 to 20, 20 to 80, 80 to 100 % of the reach",
                *_BACKGROUND,
                _zones_lacking,
            ),
            Requirement(
                "the elbow on the left and on the right: in 3 poses each or more, 15 degrees off the vertical",
                "FARO's public instructions swing the elbow from side to side",
                "own reading",
                _elbow_lacking,
            ),
            RANGE_STATED,
            CONDITIONS,
        ),
    ),
    StandardTest(
        ASME_B89_4_22,
        _VOLUMETRIC,
        _volumetric_metrics,
        (
            Requirement("two bars, each in 5 positions or more", *_BACKGROUND, _two_bars_lacking),
            Requirement("bars of 50 to 75 % and of 120 to 150 % of the reach", *_BACKGROUND, _bar_lengths_lacking),
            of_bars("positions", _POSITIONS, _READING),
            of_bars("directions", 1, _READING),
            spread_places(False, LEAST_SPREAD, _READING),
            RANGE_STATED,
            CALIBRATED,
            CONDITIONS,
        ),
    ),
)


def default_bars(measuring_range: float) -> list[float]:
    """Lengths of bars in the middle of the standard's ranges, mm."""
    return [round(float(np.mean(bar)) * measuring_range / 2) for bar in BARS]


def unsuitable_bars(measuring_range: float, lengths: list[float]) -> list[str]:
    """Sentences on bars outside the standard's ranges."""
    radius = measuring_range / 2
    return [
        f"A bar of {length:g} mm is not {_bar_range(bar, radius)}."
        for bar, length in zip(BARS, lengths, strict=True)
        if not bar[0] <= length / radius <= bar[1]
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
        q = q[_both_sides(elbow_sides(region.search.arm, q, region.reach), q)]
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


def _radius(measured: Measured, reach: Reach | None) -> float:
    """The reach: half of the maker's measuring range, or that of the model where it is not stated, mm."""
    if measured.measuring_range is not None or reach is None:
        return (measured.measuring_range or 0.0) / 2
    return reach.radius


def _zone(measured: Measured, points: np.ndarray) -> tuple[float, float] | None:
    if measured.reach is None:
        return None
    away = float(np.linalg.norm(points.mean(axis=0) - measured.reach.shoulder))
    fraction = away / _radius(measured, measured.reach)
    return next((zone for zone in ZONES.values() if fraction <= zone[1]), ZONES["far"])


def _both_sides(sides: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Indices of poses far apart, half of them with the elbow on each side as far as there are such."""
    far = np.abs(sides) >= LEFT_OR_RIGHT
    halves = [np.flatnonzero(far & (sides > 0)), np.flatnonzero(far & (sides < 0))]
    chosen = [half[far_apart(q[half], _SPAT_POSES // 2)] for half in halves if len(half)]
    first = np.concatenate([*chosen, np.zeros(0, dtype=int)]).astype(int)
    others = np.setdiff1d(np.arange(len(q)), first)
    missing = _SPAT_POSES - len(first)
    return first if missing <= 0 else np.concatenate([first, others[far_apart(q[others], missing)]])

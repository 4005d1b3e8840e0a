"""Acceptance tests of arms: JJF 1408 as Cheng et al. 2018 use it, ASME B89.4.22, ISO 10360-12.

The texts of the standards were not at hand: formulas and procedures follow secondary sources, which each function names, and the edition
that these describe. Every figure is of single readings, never of means: a test is about what one measurement does. Uncertainties are what
the tester brings (artefacts, and what is stated besides); the arm's own scatter is what is tested (ISO 14253-5 and ISO/TS 23165 see it so).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .arm import Arm
from .arrays import Numbers
from .capture import ReferenceLength
from .decision import Decision, Limit, decide, worst
from .errors import InputError
from .recording import ProbedSphere, Recording
from .spheres import enclosing_sphere, fit_sphere, points_of
from .volume import Reach, reach_of

FACTOR = 2.0  # coverage factor of the expanded uncertainties
FIGURES = {
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
ZONES = ((0.0, 0.2), (0.2, 0.8), (0.8, 1.0))  # of the reach
BARS = ((0.5, 0.75), (1.2, 1.5))  # of the reach
SPAT_POSES, POSITIONS, REPEATS = 10, 20, 3
UNI_LENGTHS, UNI_POSITIONS, _UNI_LONGEST = 5, 7, 0.66
_ALIKE = 0.01  # lengths that differ by less are of one artefact


class Part(NamedTuple):
    """One measurement that a figure rests on: a socket, a length, a sphere. mm."""

    where: str
    value: float
    expanded: float  # U of the test value, coverage factor 2
    length: float = 0.0  # calibrated length that was measured, where it is one: limits may grow with it
    limit: float | None = None  # MPE
    decision: Decision | None = None  # None without a limit


class Figure(NamedTuple):
    """One figure of a test; its name is a key of `FIGURES`."""

    name: str
    parts: tuple[Part, ...]

    @property
    def worst(self) -> Part:
        """The part nearest to its limit, or beyond it; without limits the largest."""
        return max(self.parts, key=lambda part: abs(part.value) - (part.limit or 0.0) + part.expanded)

    @property
    def value(self) -> float:
        """Value of the worst part, mm."""
        return self.worst.value

    @property
    def decision(self) -> Decision | None:
        """What all parts come to together."""
        return worst([part.decision for part in self.parts if part.decision is not None])


class AcceptanceTest(NamedTuple):
    """What one test found, and what its full procedure would have needed besides (nothing, where it is complete)."""

    standard: str
    title: str
    figures: tuple[Figure, ...]
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

    @property
    def tested(self) -> dict[str, Float[np.ndarray, "m 3"]]:
        """The sockets whose repeatability counts."""
        return {name: points for name, points in self.sockets.items() if name not in self.known}


def measured_by(arm: Arm, recording: Recording) -> Measured:
    """What an arm measures where a recording's poses were taken."""
    sockets = {name: np.asarray(arm.position(q)) for name, q in recording.capture.sockets.items()}
    spheres = tuple(
        sphere._replace(groups=tuple(np.asarray(arm.position(group)) for group in sphere.groups))
        for sphere in recording.spheres
    )
    return Measured(sockets, recording.capture.lengths, spheres, reach_of(arm))


def accept(measured: Measured, limits: Mapping[str, Limit] | None = None, u_test: float = 0.0) -> list[AcceptanceTest]:
    """Every test that the measured points allow.

    ``limits``: MPE by the name of a figure (a key of `FIGURES`). ``u_test``: standard uncertainty, mm, that the seat, fixture and temperature add
    to every test value. Raises `InputError` for a limit whose figure cannot be had from these points.
    """
    if not (math.isfinite(u_test) and u_test >= 0):
        raise InputError(f"the uncertainty of the test is {u_test:g} mm; it must be zero or positive.")
    tests = [test for run in _TESTS if (test := run(measured, u_test)) is not None]
    limits = dict(limits or {})
    there = {figure.name for test in tests for figure in test.figures}
    for name in limits:
        if name not in FIGURES:
            raise InputError(f"there is no figure '{name}'; limits can be given for {', '.join(FIGURES)}.")
        if name not in there:
            raise InputError(f"a limit is given for {name} ({FIGURES[name]}), but the capture holds nothing to measure it on.")
    return [test._replace(figures=tuple(_decided(figure, limits) for figure in test.figures)) for test in tests]


def _decided(figure: Figure, limits: Mapping[str, Limit]) -> Figure:
    if figure.name not in limits:
        return figure
    parts = []
    for part in figure.parts:
        limit = limits[figure.name].at(part.length)
        parts.append(part._replace(limit=limit, decision=decide(part.value, limit, part.expanded)))
    return figure._replace(parts=tuple(parts))


# --- Figures of points ---------------------------------------------------------------------------------------------------


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
    given = np.asarray(deviations, dtype=float)
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


# --- Tests -----------------------------------------------------------------------------------------------------------------


def _part(where: str, value: float, *u: float) -> Part:
    return Part(where, value, FACTOR * math.sqrt(sum(own**2 for own in u)))


class _Reading(NamedTuple):
    """One reading of a length, mm."""

    where: str
    deviation: float
    u: float
    length: float

    def part(self, u_test: float) -> Part:
        return _part(self.where, self.deviation, self.u, u_test)._replace(length=self.length)


def _readings(measured: Measured) -> list[_Reading]:
    """Every length as single readings. The i-th pose at one end goes with the i-th at the other."""
    found = []
    for length in measured.lengths:
        start, end = (measured.sockets[name] for name in (length.start, length.end))
        pairs = min(len(start), len(end))
        values = np.linalg.norm(end[:pairs] - start[:pairs], axis=1) - float(length.value)
        for number, value in enumerate(values, start=1):
            where = f"{length.start} - {length.end}" + (f", reading {number}" if pairs > 1 else "")
            found.append(_Reading(where, float(value), float(length.u), float(length.value)))
    return found


def _summed(readings: list[_Reading], u_test: float, names: tuple[str, str, str]) -> tuple[Figure, ...]:
    """Largest deviation, range and twice the RMS.

    Lengths of one artefact share their calibration's error, others do not, and nothing says which do; so U of the range takes them as
    independent, and U of the RMS as one (by Cauchy and Schwarz it cannot be larger).
    """
    deviations = np.array([reading.deviation for reading in readings])
    u = np.array([reading.u for reading in readings])
    least, most = readings[int(deviations.argmin())], readings[int(deviations.argmax())]
    largest = Figure(names[0], tuple(reading.part(u_test) for reading in readings))
    if len(readings) < 2:
        return (largest,)
    span = _part(f"{least.where} to {most.where}", most.deviation - least.deviation, least.u, most.u, u_test, u_test)
    square = _part(f"{len(readings)} readings", two_rms(deviations), 2 * float(np.sqrt(np.mean(u**2))), 2 * u_test)
    return largest, Figure(names[1], (span,)), Figure(names[2], (square,))


def jjf_1408(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """JJF 1408 as Cheng et al. 2018 use it (section 4): Deltam in every socket, and the deviations of lengths.

    The paper's verification takes a length 30 times in different places; its Table 3 takes Deltam of 70 poses.
    """
    several = {name: points for name, points in measured.tested.items() if len(points) > 1}
    figures = []
    if several:
        figures.append(Figure("Deltam", tuple(_part(name, half_range(points), u_test) for name, points in several.items())))
    readings = _readings(measured)
    if readings:
        figures += _summed(readings, u_test, ("Length", "Length_Range", "Length_2RMS"))
    missing = [] if several else ["a socket held in several poses"]
    missing += [] if len(readings) >= 30 else [f"30 readings of a length ({len(readings)} are there)"]
    return _test("JJF 1408", "single point and length, as in Cheng et al. 2018", figures, missing)


def asme_diameter(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ASME B89.4.22-2004, effective diameter: a sphere of 10 to 50 mm, 9 points, 3 repeats; largest \\|D - Dcal\\|. Background knowledge."""
    spheres = [sphere for sphere in measured.spheres if sphere.test == "effective-diameter"]
    parts, missing = [], []
    for sphere in spheres:
        for number, group in enumerate(sphere.groups, start=1):
            value = size_error(group, sphere.diameter, sphere.stylus)
            parts.append(_part(f"{sphere.name}, repeat {number}", value, sphere.u, u_test))
        missing += _wanted(sphere, groups=REPEATS, points=9, of="repeats")
        if not 10 <= sphere.diameter <= 50:
            missing.append(f"a sphere of 10 to 50 mm ('{sphere.name}' has {sphere.diameter:g} mm)")
    return _test("ASME B89.4.22", "effective diameter", [Figure("D_Eff", tuple(parts))] if parts else [], missing)


def asme_single_point(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ASME B89.4.22-2004, single-point articulation (SPAT): a socket in each of three zones of the reach (0 to 20, 20 to 80, 80 to 100 %),
    10 articulations in each; a socket of fewer is not looked at. Background knowledge; distances are from the shoulder (see `reach_of`)."""
    largest, spread, seen = [], [], set()
    for name, points in measured.tested.items():
        if len(points) < SPAT_POSES:
            continue
        zone = None if measured.reach is None else _zone(measured.reach, points)
        seen.add(zone)
        where = name if zone is None else f"{name} ({percent(ZONES[zone])} of the reach)"
        for parts, value in zip((largest, spread), spat(points), strict=True):
            parts.append(_part(where, value, u_test))
    missing = []
    if measured.reach is None:
        missing.append("the reach of the arm, to tell its zones apart")
    else:
        missing += [
            f"a socket with {SPAT_POSES} poses at {percent(zone)} of the reach ({zone[0] * measured.reach.radius:.0f} to "
            f"{zone[1] * measured.reach.radius:.0f} mm from the shoulder)"
            for number, zone in enumerate(ZONES)
            if number not in seen
        ]
    figures = [Figure(name, tuple(parts)) for name, parts in (("SPAT", largest), ("SPAT_2s", spread)) if parts]
    return _test("ASME B89.4.22", "single-point articulation", figures, missing)


def asme_volumetric(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ASME B89.4.22-2004, volumetric: two bars, of 50 to 75 % and of 120 to 150 % of the reach, 20 positions in all; largest \\|L - Lcal\\|,
    range, and twice the RMS. Background knowledge."""
    readings = _readings(measured)
    missing = []
    if len(measured.lengths) < POSITIONS:
        missing.append(f"{POSITIONS} positions of the bars ({len(measured.lengths)} are there)")
    if measured.reach is None:
        missing.append("the reach of the arm, to judge the bars' lengths")
    else:
        values = np.array([float(length.value) for length in measured.lengths]) / measured.reach.radius
        missing += [
            f"a bar of {percent(bar)} of the reach ({bar[0] * measured.reach.radius:.0f} to {bar[1] * measured.reach.radius:.0f} mm)"
            for bar in BARS
            if not np.any((values >= bar[0]) & (values <= bar[1]))
        ]
    figures = _summed(readings, u_test, ("Volumetric", "Volumetric_Range", "Volumetric_2RMS")) if readings else ()
    return _test("ASME B89.4.22", "volumetric", figures, missing)


def iso_probing(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ISO 10360-12:2016, probing size and form: 25 points on a sphere. Found in public sources."""
    size, form, missing = [], [], []
    for sphere in (sphere for sphere in measured.spheres if sphere.test == "probing"):
        for number, group in enumerate(sphere.groups, start=1):
            where = sphere.name + (f", repeat {number}" if len(sphere.groups) > 1 else "")
            size.append(_part(where, size_error(group, sphere.diameter, sphere.stylus), sphere.u, u_test))
            form.append(_part(where, form_error(group), u_test))
        missing += _wanted(sphere, groups=1, points=25, of="groups")
    figures = [Figure(name, tuple(parts)) for name, parts in (("P_Size", size), ("P_Form", form)) if parts]
    return _test("ISO 10360-12", "probing size and form", figures, missing)


def iso_articulation(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ISO 10360-12:2016, articulated location L_Dia.5x5.Art: 5 points in each of 5 orientations. Background knowledge."""
    parts, missing = [], []
    for sphere in (sphere for sphere in measured.spheres if sphere.test == "articulation"):
        parts.append(_part(sphere.name, articulated_location(sphere.groups), u_test))
        missing += _wanted(sphere, groups=5, points=5, of="orientations")
    return _test("ISO 10360-12", "articulated location", [Figure("L_Dia", tuple(parts))] if parts else [], missing)


def iso_length(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ISO 10360-12:2016, length error E_Uni: 5 lengths in 7 positions, 3 readings each; the longest at least 66 % of the range.

    The range is taken as twice the reach. Background knowledge.
    """
    parts = [reading.part(u_test) for reading in _readings(measured)]
    missing = []
    values = np.sort([float(length.value) for length in measured.lengths])
    bars = np.split(values, np.flatnonzero(np.diff(values) > _ALIKE * values[1:]) + 1) if len(values) else []
    positions = [len(bar) for bar in bars]
    if len(bars) < UNI_LENGTHS or min(positions, default=0) < UNI_POSITIONS or len(parts) < REPEATS * len(values):
        missing.append(
            f"{UNI_LENGTHS} lengths in {UNI_POSITIONS} positions, {REPEATS} readings each: 105 in all ({len(parts)} readings of {len(bars)} {'length' if len(bars) == 1 else 'lengths'} are there)"
        )
    if measured.reach is None:
        missing.append("the reach of the arm, to judge the longest length")
    elif len(values) and values[-1] < _UNI_LONGEST * 2 * measured.reach.radius:
        missing.append(f"a length of {_UNI_LONGEST * 2 * measured.reach.radius:.0f} mm or more (66 % of the range)")
    return _test("ISO 10360-12", "length error", [Figure("E_Uni", tuple(parts))] if parts else [], missing)


_TESTS: tuple[Callable[[Measured, float], AcceptanceTest | None], ...] = (
    jjf_1408, asme_diameter, asme_single_point, asme_volumetric, iso_probing, iso_articulation, iso_length,
)  # fmt: skip


def _test(standard: str, title: str, figures: Sequence[Figure], missing: list[str]) -> AcceptanceTest | None:
    return AcceptanceTest(standard, title, tuple(figures), tuple(missing)) if figures else None


def _wanted(sphere: ProbedSphere, *, groups: int, points: int, of: str) -> list[str]:
    found = []
    if len(sphere.groups) < groups:
        found.append(f"{groups} {of} of sphere '{sphere.name}' ({len(sphere.groups)} are there)")
    short = min(len(group) for group in sphere.groups)
    if short < points:
        found.append(f"{points} points a group on sphere '{sphere.name}' (one has {short})")
    return found


def _zone(reach: Reach, points: Float[np.ndarray, "m 3"]) -> int:
    share = float(np.linalg.norm(points.mean(axis=0) - reach.shoulder)) / reach.radius
    return next(number for number, (_, end) in enumerate(ZONES) if share <= end or number == len(ZONES) - 1)


def percent(span: tuple[float, float]) -> str:
    """A share of the reach in words."""
    return f"{100 * span[0]:.0f} to {100 * span[1]:.0f} %"

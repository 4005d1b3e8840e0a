"""Acceptance tests of arms: JJF 1408-2013 as Cheng et al. 2018 use it, ASME B89.4.22-2004, ISO 10360-12:2016.

The texts of the standards were not at hand: formulas and procedures follow secondary sources, which each function names, and the edition
that these describe. Every figure is of single readings, never of means: a test is about what one measurement does. Uncertainties are what
the tester brings (artefacts, and what is stated besides); the arm's own scatter is what is tested (ISO 14253-5 and ISO/TS 23165 see it so).
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError, nearest
from ..data.capture import ReferenceLength
from ..data.recording import Recording
from ..data.sphere import ProbedSphere, checked_sphere
from ..kinematics.arm import Arm
from ..kinematics.workspace import Reach as Reach
from ..kinematics.workspace import arm_reach
from .decision import Limit, decide
from .metrics import METRICS as FIGURES
from .metrics import AcceptanceTest as AcceptanceTest
from .metrics import Measured as Measured
from .metrics import Metric as Figure
from .metrics import Part as Part
from .metrics import articulated_location as articulated_location
from .metrics import form_error as form_error
from .metrics import half_range as half_range
from .metrics import size_error as size_error
from .metrics import spat as spat
from .metrics import two_rms as two_rms
from .spheres import points_of

FACTOR = 2.0  # coverage factor of the expanded uncertainties
ZONES = ((0.0, 0.2), (0.2, 0.8), (0.8, 1.0))  # of the reach
BARS = ((0.5, 0.75), (1.2, 1.5))  # of the reach
SPAT_POSES, POSITIONS, REPEATS = 10, 20, 3
UNI_LENGTHS, UNI_POSITIONS, UNI_LONGEST = 5, 7, 0.66
_CHECKS = 30  # of a length, in different places: Cheng et al. 2018, section 4.4
_SPHERES = (10.0, 51.0)  # mm: 10 to 50 after ASME B89.4.22, 10 to 51 after ISO 10360 (background knowledge)
_FAR = 1e6  # mm: no arm reaches a kilometre
_LEAST_DIVISOR = 1e-3
_FIXED = 4  # points that a sphere goes through exactly: they have no form error
_ALIKE = 0.01  # lengths that differ by less are of one artefact


def measured_by(arm: Arm, recording: Recording) -> Measured:
    """What an arm measures where a recording's poses were taken."""
    sockets = {name: np.asarray(arm.position(q)) for name, q in recording.capture.sockets.items()}
    spheres = tuple(
        sphere._replace(groups=tuple(np.asarray(arm.position(group)) for group in sphere.groups))
        for sphere in recording.spheres
    )
    return Measured(sockets, recording.capture.lengths, spheres, arm_reach(arm))


def unstated(tests: Sequence[AcceptanceTest]) -> list[str]:
    """Figures that were decided although nothing of their uncertainty was stated."""
    figures = (figure for test in tests for figure in test.figures)
    return [figure.name for figure in figures if figure.decision is not None and figure.worst.expanded == 0]


def run(measured: Measured, limits: Mapping[str, Limit | float] | None = None, u_test: float = 0.0) -> list[AcceptanceTest]:
    """Every test that the measured points allow.

    ``limits``: MPE by the name of a figure (a key of `FIGURES`), a `Limit` or a number of mm. ``u_test``: standard uncertainty, mm, that the
    seat, fixture and temperature add to every test value. Raises `InputError` for points that are none, and for a limit whose figure cannot
    be had from these points, or that grows with a length where the figure is of none.
    """
    measured = _checked(measured)
    u_test = _number(u_test, "the standard uncertainty of the test")
    given = checked_limits(limits or {})
    tests = [test for run in _TESTS if (test := run(measured, u_test)) is not None]
    if measured.seen:
        unseen = "sockets and lengths that the arm was not identified from"
        tests = [test._replace(missing=(unseen, *test.missing)) for test in tests]
    there = {figure.name for test in tests for figure in test.figures}
    for name in given:
        if name not in there:
            unseen = " that the calibration has not seen" if measured.known else ""
            raise InputError(
                f"a limit is given for {name} ({FIGURES[name]}), but the capture holds nothing{unseen} to measure it on."
            )
    return [test._replace(figures=tuple(_decided(figure, given) for figure in test.figures)) for test in tests]


def _checked(measured: Measured) -> Measured:
    sockets = {name: points_of(points, f"the points of socket '{name}'") for name, points in measured.sockets.items()}
    for length in measured.lengths:
        for end in (length.start, length.end):
            if end not in sockets:
                raise InputError(
                    f"length '{length.start}' to '{length.end}' names the unknown socket '{end}'{nearest(end, sockets)}"
                )
    spheres = tuple(checked_sphere(sphere, 3) for sphere in measured.spheres)
    for name, points in (*sockets.items(), *((sphere.name, group) for sphere in spheres for group in sphere.groups)):
        if np.abs(points).max() > _FAR:
            raise InputError(f"'{name}' holds a coordinate beyond {_FAR:g} mm; give points in mm.")
    return measured._replace(sockets=sockets, spheres=spheres)


def _number(value: float, what: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} is {value!r}; give a number of mm.") from error
    if not 0 <= number <= _FAR:
        raise InputError(f"{what} is {number:g} mm; it must be zero or positive, and finite.")
    return number


def checked_limits(limits: Mapping[str, Limit | float]) -> dict[str, Limit]:
    """Limits by the name of a figure, numbers made into `Limit`; `InputError` for what is no figure or no limit."""
    found = {}
    for name, limit in limits.items():
        if name not in FIGURES:
            raise InputError(f"there is no figure '{name}'{nearest(name, list(FIGURES))}")
        fixed, divisor = limit if isinstance(limit, Limit) else (limit, math.inf)
        if not divisor >= _LEAST_DIVISOR:
            raise InputError(
                f"the limit of {name} grows by the length over {divisor:g}; give a divisor of {_LEAST_DIVISOR:g} or more."
            )
        found[name] = Limit(_number(fixed, f"the limit of {name}"), divisor)
    return found


def _decided(figure: Figure, limits: Mapping[str, Limit]) -> Figure:
    if figure.name not in limits:
        return figure
    parts = []
    for part in figure.parts:
        if part.length is None and math.isfinite(limits[figure.name].divisor):
            raise InputError(
                f"the limit of {figure.name} grows with a length, but the figure is of none; give it as a number alone."
            )
        limit = limits[figure.name].at(part.length or 0.0)
        parts.append(part._replace(limit=limit, decision=decide(part.value, limit, part.expanded)))
    return figure._replace(parts=tuple(parts))


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
    """JJF 1408-2013 as Cheng et al. 2018 use it (section 4; their reference 17): Deltam in every socket, and the deviations of lengths.

    The paper's verification takes a length 30 times in different places; its Table 3 takes Deltam of 70 poses.
    """
    several = {name: points for name, points in measured.tested.items() if len(points) > 1}
    figures = []
    if several:
        figures.append(Figure("Deltam", tuple(_part(name, half_range(points), u_test) for name, points in several.items())))
    readings = _readings(measured)
    if readings:
        figures += _summed(readings, u_test, ("Length", "Length_Range", "Length_2RMS"))
    enough = any(len(points) >= SPAT_POSES for points in several.values())
    missing = [] if enough else [f"a socket held in {SPAT_POSES} poses or more"]
    placements = len(_placements(measured.lengths))
    missing += [] if placements >= _CHECKS else [f"a length in {_CHECKS} places ({placements} are there)"]
    return _test("JJF 1408", "single point and length, as in Cheng et al. 2018", figures, missing)


def asme_diameter(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ASME B89.4.22-2004, effective diameter: a sphere of 10 to 50 mm, 9 points, 3 repeats; largest |D - Dcal|. Background knowledge."""
    spheres = [sphere for sphere in measured.spheres if sphere.test == "effective-diameter"]
    parts, missing = [], []
    for sphere in spheres:
        for number, group in enumerate(sphere.groups, start=1):
            with _of(sphere, number):
                value = size_error(group, sphere.diameter, sphere.stylus)
            parts.append(_part(f"{sphere.name}, repeat {number}", value, sphere.u, u_test))
        missing += _wanted(sphere, groups=REPEATS, points=9, of="repeats")
    return _test("ASME B89.4.22", "effective diameter", [Figure("D_Eff", tuple(parts))] if parts else [], missing)


def asme_single_point(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ASME B89.4.22-2004, single-point articulation (SPAT): a socket in each of three zones of the reach (0 to 20, 20 to 80, 80 to 100 %),
    10 articulations in each; a socket of fewer is not looked at. Background knowledge; distances are from the shoulder (see `arm_reach`)."""
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
    """ASME B89.4.22-2004, volumetric: two bars, of 50 to 75 % and of 120 to 150 % of the reach, 20 positions in all; largest |L - Lcal|,
    range, and twice the RMS. Background knowledge."""
    readings = _readings(measured)
    missing = []
    lengths = _placements(measured.lengths)
    if len(lengths) < POSITIONS:
        missing.append(f"{POSITIONS} positions of the bars ({len(lengths)} are there)")
    sizes = _bars(lengths)
    if len(sizes) != len(BARS):
        missing.append(f"two bars, no fewer and no more ({len(sizes)} are there)")
    elif min(map(len, sizes)) < POSITIONS // 4:
        missing.append(f"each bar in {POSITIONS // 4} positions or more")
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
    """ISO 10360-12:2016, probing size and form: 25 points on a sphere. Found in public sources.

    Half of the sphere's own form error counts as a standard uncertainty of the form found (as ISO/TS 23165; background knowledge).
    """
    size, form, missing = [], [], []
    for sphere in (sphere for sphere in measured.spheres if sphere.test == "probing"):
        for number, group in enumerate(sphere.groups, start=1):
            where = sphere.name + (f", repeat {number}" if len(sphere.groups) > 1 else "")
            with _of(sphere, number):
                size.append(_part(where, size_error(group, sphere.diameter, sphere.stylus), sphere.u, u_test))
            if len(group) > _FIXED:
                form.append(_part(where, form_error(group), sphere.form / 2, u_test))
        missing += _wanted(sphere, groups=1, points=25, of="groups")
    figures = [Figure(name, tuple(parts)) for name, parts in (("P_Size", size), ("P_Form", form)) if parts]
    return _test("ISO 10360-12", "probing size and form", figures, missing)


def iso_articulation(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ISO 10360-12:2016, articulated location L_Dia.5x5.Art: 5 points in each of 5 orientations. Background knowledge."""
    parts, missing = [], []
    for sphere in (sphere for sphere in measured.spheres if sphere.test == "articulation"):
        if len(sphere.groups) > 1:  # the sphere round one centre is always zero
            with _of(sphere):
                parts.append(_part(sphere.name, articulated_location(sphere.groups), sphere.form / 2, u_test))
        missing += _wanted(sphere, groups=5, points=5, of="orientations")
    return _test("ISO 10360-12", "articulated location", [Figure("L_Dia", tuple(parts))] if parts else [], missing)


def iso_length(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """ISO 10360-12:2016, length error E_Uni: 5 lengths in 7 positions, 3 readings each; the longest at least 66 % of the range.

    The range is taken as twice the reach. Background knowledge. What the standard allows of repeating a reading is not applied.
    """
    parts = [reading.part(u_test) for reading in _readings(measured)]
    missing = []
    values = [float(length.value) for length in measured.lengths]
    placed = _placements(measured.lengths)
    bars = _bars(placed)
    positions = [len(bar) for bar in bars]
    repeats = min((min(len(measured.sockets[name]) for name in (length.start, length.end)) for length in placed), default=0)
    if len(bars) < UNI_LENGTHS or min(positions, default=0) < UNI_POSITIONS or repeats < REPEATS:
        missing.append(
            f"{UNI_LENGTHS} lengths in {UNI_POSITIONS} positions, {REPEATS} readings each: 105 in all ({len(parts)} readings of {len(bars)} {'length' if len(bars) == 1 else 'lengths'} are there)"
        )
    if measured.reach is None:
        missing.append("the reach of the arm, to judge the longest length")
    elif values and max(values) < UNI_LONGEST * 2 * measured.reach.radius:
        missing.append(f"a length of {UNI_LONGEST * 2 * measured.reach.radius:.0f} mm or more (66 % of the range)")
    return _test("ISO 10360-12", "length error", [Figure("E_Uni", tuple(parts))] if parts else [], missing)


_TESTS: tuple[Callable[[Measured, float], AcceptanceTest | None], ...] = (
    jjf_1408, asme_diameter, asme_single_point, asme_volumetric, iso_probing, iso_articulation, iso_length,
)  # fmt: skip


def _test(standard: str, title: str, figures: Sequence[Figure], missing: list[str]) -> AcceptanceTest | None:
    return AcceptanceTest(standard, title, tuple(figures), tuple(missing)) if figures else None


@contextlib.contextmanager
def _of(sphere: ProbedSphere, group: int | None = None) -> Iterator[None]:
    """Say which sphere, and which of its groups, something is wrong with."""
    try:
        yield
    except InputError as error:
        where = f"sphere '{sphere.name}'" + ("" if group is None else f", group {group}")
        raise InputError(f"{where}: {error}") from error


def _placements(lengths: Sequence[ReferenceLength]) -> list[ReferenceLength]:
    """Lengths between different pairs of sockets."""
    return list({frozenset((length.start, length.end)): length for length in lengths}.values())


def _bars(lengths: Sequence[ReferenceLength]) -> list[Float[np.ndarray, " k"]]:
    """Calibrated lengths, those of one artefact (alike to 1 %) together."""
    values = np.sort([float(length.value) for length in lengths])
    return np.split(values, np.flatnonzero(np.diff(values) > _ALIKE * values[1:]) + 1) if len(values) else []


def _wanted(sphere: ProbedSphere, *, groups: int, points: int, of: str) -> list[str]:
    found = []
    if not _SPHERES[0] <= sphere.diameter <= _SPHERES[1]:
        found.append(f"a sphere of {_SPHERES[0]:g} to {_SPHERES[1]:g} mm ('{sphere.name}' has {sphere.diameter:g} mm)")
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

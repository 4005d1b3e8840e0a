"""The tests of the standards as data: metrics, what a test needs, from which source that is known, and how certain.

The texts of the standards were not available to this project. A source names where the requirement was found; clause
numbers are given only if they were found there.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from ..data.recording import ProbedSphere, SphereTest
from . import geometry, metrics
from .judgement import Influences
from .metrics import BARS, LONGEST, SPAT_POSES, ZONES, articulated, bar_range, spheres_for, zone_of
from .results import AcceptanceTest, Measured, Metric, percent
from .standards import ASME_B89_4_22, EDITIONS, ISO_10360_12, JJF_1408

Confidence = Literal[
    "public source",  # a public page that is named
    "background",  # background knowledge of the standard, without a source at hand
    "own reading",  # required by the standard in words; the numerical limit is ours
]
Metrics = Callable[[Measured, Influences], Sequence[Metric]]
Origin = tuple[str, Confidence]  # the source, and how certain it is
_LEAST_APART = 0.1  # of two positions of a sphere, as a part of the measuring range
_LEAST_SPREAD = 0.1  # of the places of bars, as a part of the measuring range
_LEAST_RING_TURN, _LEAST_PROBE_TURN = math.radians(15), math.radians(10)
_LEAST_ELBOW = 3  # poses with the elbow on either side


class Requirement(NamedTuple):
    """One thing that a standard's test needs."""

    says: str
    source: str
    confidence: Confidence
    # Gives a sentence on what is lacking, "" if nothing is; None if recorded data cannot show whether it is met.
    lacking: Callable[[Measured], str] | None = None


class StandardTest(NamedTuple):
    """A test of a standard: its metrics, and what a procedure needs to bear the standard's name."""

    standard: str  # a key of `standards.EDITIONS`
    title: str
    metrics: Metrics
    requirements: tuple[Requirement, ...]

    def run(self, measured: Measured, influences: Influences) -> AcceptanceTest | None:
        """The test of those metrics that have values; None if none has."""
        with_values = tuple(metric for metric in self.metrics(measured, influences) if metric.values)
        if not with_values:
            return None
        checks = (requirement.lacking for requirement in self.requirements)
        sentences = (check(measured) for check in checks if check is not None)
        return AcceptanceTest(self.standard, self.title, with_values, tuple(filter(None, sentences)))


def _wrong(measured: Measured, test: SphereTest, wrong: Callable[[ProbedSphere], list[str]]) -> str | None:
    named = [text for sphere in spheres_for(measured, test) for text in wrong(sphere)]
    return ", ".join(named) if named else None


def _groups(
    measured: Measured, test: SphereTest, condition: Callable[[np.ndarray], bool], kind: str = "group"
) -> str | None:
    """The groups of touches of the spheres of a test that are so."""
    return _wrong(
        measured,
        test,
        lambda sphere: [f"'{sphere.name}', {kind} {i}" for i, group in enumerate(sphere.groups, 1) if condition(group)],
    )


def _sphere_positions(measured: Measured, test: SphereTest, positions: int) -> int:
    groups = [
        group
        for sphere in spheres_for(measured, test)
        for group in sphere.groups
        if len(group) >= geometry.EXACT_POINTS
    ]
    if not (measured.size and groups):
        return max(len(groups), 1)
    return len(
        geometry.separate(
            np.array([geometry.fit_sphere(group).centre for group in groups]), _LEAST_APART * measured.size
        )
    )


def _orientations(measured: Measured) -> str | None:
    if measured.postures is None:
        return "Points alone do not show the orientations of the probe; record joint readings."
    for (name, test), groups in measured.postures.probes.items():
        if test == "articulation":
            means = geometry.unit_rows(np.array([directions.mean(axis=0) for directions in groups]))
            if any(mean @ other > math.cos(_LEAST_PROBE_TURN) for mean, other in itertools.combinations(means, 2)):
                return (
                    f"The orientations of the probe must differ; on sphere '{name}', two orientations are nearly "
                    "the same."
                )
    return None


def _zones(measured: Measured) -> str | None:
    if measured.reach is None:
        return "The reach and the shoulder of the arm are unknown, so the zones of the reach cannot be determined."
    radius = (measured.size or 0.0) / 2
    zones = {zone_of(measured, points) for points in articulated(measured).values()}
    absent = [
        f"at {percent(zone)} of the reach ({zone[0] * radius:.0f} to {zone[1] * radius:.0f} mm from the shoulder)"
        for zone in ZONES
        if zone not in zones
    ]
    return f"A socket with {SPAT_POSES} poses is required {' and '.join(absent)}." if absent else None


def _elbow(measured: Measured) -> str | None:
    if measured.postures is None:
        return "Points alone do not show on which side the elbow was; record joint readings."
    bad = []
    for name in articulated(measured):
        sides = np.sin(measured.postures.elbows[name])
        if (
            min(np.sum(sides >= math.sin(geometry.LEFT_OR_RIGHT)), np.sum(sides <= -math.sin(geometry.LEFT_OR_RIGHT)))
            < _LEAST_ELBOW
        ):
            bad.append(name)
    sentence = (
        f"Every socket must have {_LEAST_ELBOW} poses with the elbow on the left and {_LEAST_ELBOW} poses with the "
        f"elbow on the right (fewer in: {', '.join(bad)})."
    )
    return sentence if bad else None


def _two_bars(measured: Measured, positions: int) -> str | None:
    bars = _bars(measured)
    if len(bars) != len(BARS):
        return f"Exactly two bars are required ({len(bars)} given)."
    fewest = min(len(bar.lengths) for bar in bars)
    return None if fewest >= positions else f"Each bar must be measured in {positions} positions."


def _bar_lengths(measured: Measured) -> str | None:
    if measured.size is None:
        return "The reach of the arm is unknown, so the lengths of the bars cannot be checked."
    radius = measured.size / 2
    values = np.array([float(length.value) for length in measured.lengths]) / radius
    wanted = [bar_range(bar, radius) for bar in BARS if not np.any((values >= bar[0]) & (values <= bar[1]))]
    return f"A bar of {' and one of '.join(wanted)} is required." if wanted else None


def _longest(measured: Measured) -> str | None:
    if measured.measuring_range is None:
        return None  # a requirement of its own
    longest, least = max(float(length.value) for length in measured.lengths), LONGEST * measured.measuring_range
    sentence = f"A length of {least:.0f} mm or more is required (66 % of the range); the longest is {longest:.0f} mm."
    return None if longest >= least else sentence


def _bars(measured: Measured, by_bar: bool = True) -> list[geometry.BarPositions]:
    positions = geometry.bar_positions(measured)
    return positions.artefacts() if by_bar else [positions]


def _places(measured: Measured, by_bar: bool) -> str | None:
    """Of bars over the measuring volume; not judged where its size is unknown."""
    size = measured.size
    if size is None:
        return "The size of the measuring volume is unknown, so the positions of the bars cannot be checked."
    narrowest = min(bar.spread(size) for bar in _bars(measured, by_bar))
    sentence = (
        f"The bars must be spread over the measuring volume: their midpoints scatter by {100 * narrowest:.1f} % of "
        f"the size of the volume; at least {100 * _LEAST_SPREAD:.0f} % is required."
    )
    return None if narrowest >= _LEAST_SPREAD else sentence


# Requirements by kind: what they say; the sentence on what is lacking; and what puts that into words (None where
# nothing is lacking, "" where the sentence takes no words), or counts what the last number is the least of. In
# both texts, {0} is what is lacking, {1} and so on the numbers that a test gives.
_KINDS: dict[str, tuple[str, str, Callable[..., str | int | None]]] = {
    "size": (
        "a sphere with a diameter of {2} to {3} mm",
        "A sphere with a diameter of {2} to {3} mm is required ({0}).",
        lambda m, test, low, high: _wrong(
            m, test, lambda s: [] if low <= s.diameter <= high else [f"'{s.name}' has {s.diameter:g} mm"]
        ),
    ),
    "touches": (
        "{2} points in every group of touches",
        "{2} points per group are required (fewer: {0}).",
        lambda m, test, points: _groups(m, test, lambda group: len(group) < points),
    ),
    "spread of touches": (
        "touches spread over at least a hemisphere: no gap more than 8 degrees wider than in the recommended pattern",
        "The touches must be spread over a hemisphere (not spread: {0}).",
        # Groups that are too small are named under the number of touches.
        lambda m, test, points: _groups(
            m, test, lambda group: len(group) >= points and not geometry.covers_hemisphere(group, points)
        ),
    ),
    "groups": (
        "{2} {3} of the sphere",
        "{2} {3} of a sphere are required ({0}).",
        lambda m, test, number, _: _wrong(
            m, test, lambda s: [f"'{s.name}' has {len(s.groups)}"] if len(s.groups) < number else []
        ),
    ),
    "rings": (
        "each ring of touches rotated by at least 22.5 deg against the ring above it (15 deg is accepted for touches "
        "made by hand)",
        "The rings of touches must be rotated by at least 22.5 deg relative to each other (not the case in {0}).",
        lambda m, test, points: _groups(
            m, test, lambda group: len(group) >= points and geometry.least_turn(group) < _LEAST_RING_TURN, "repeat"
        ),
    ),
    "places of the sphere": (
        "the sphere in {2} positions at least 10 % of the range apart; the worse result counts",
        "The sphere must be measured in {2} positions that are far apart; the number of positions measured is {0}.",
        _sphere_positions,
    ),
    "orientations": ("five orientations of the probe that differ by at least 10 degrees", "{0}", _orientations),
    "zones": (
        "a socket with 10 articulations in each of three zones: 0 to 20, 20 to 80, 80 to 100 % of the reach",
        "{0}",
        _zones,
    ),
    "elbow": (
        "the elbow at least 15 degrees off the vertical, in at least 3 poses on the left and 3 poses on the right",
        "{0}",
        _elbow,
    ),
    "two bars": ("two bars, each in at least {1} positions", "{0}", _two_bars),
    "lengths of the bars": ("one bar of 50 to 75 % and one of 120 to 150 % of the reach", "{0}", _bar_lengths),
    "longest": ("a longest length of at least 66 % of the measuring range", "{0}", _longest),
    "lengths": (
        "{1} different calibrated lengths",
        "{1} different lengths are required ({0} given).",
        lambda m, needed: len(_bars(m)),
    ),
    "readings": (
        "{1} readings of each length in each position",
        "{1} readings in each position are required (one position has {0}).",
        lambda m, needed: min(geometry.bar_positions(m).readings.tolist(), default=0),
    ),
    "positions": (
        "{1} positions of the bars that differ by at least 10 degrees in direction or by at least 5 % of the range in "
        "location",
        "{1} different positions are required ({0} given).",
        lambda m, needed: sum(bar.distinct(m.size) for bar in _bars(m)),
    ),
    "positions of each": (
        "{1} positions of every length that differ by at least 10 degrees in direction or by at least 5 % of the "
        "range in location",
        "{1} different positions of every length are required (one length has {0}).",
        lambda m, needed: min(bar.distinct(m.size) for bar in _bars(m)),
    ),
    "directions": (
        "bar directions spread over three dimensions: their RMS angle to every plane is at least 10 degrees",
        "The directions of the bars must be horizontal, vertical and inclined, not all in one plane.",
        lambda m, by_bar: None if all(bar.in_all_directions for bar in _bars(m, by_bar)) else "",
    ),
    "places": (
        "bars spread over the measuring volume: the RMS scatter of their midpoints is at least 10 % of the range",
        "{0}",
        _places,
    ),
    "socket": (
        "a socket in at least {1} poses (70 in Table 3 of Cheng et al. 2018)",
        "A socket measured in {1} poses or more is required.",
        lambda m, poses: None if any(len(points) >= poses for points in m.tested.values()) else "",
    ),
    "range": (
        "the measuring range is stated by the maker",
        "The measuring range stated by the maker is missing (measuring_range).",
        lambda m: "" if m.measuring_range is None else None,
    ),
}


def _need(kind: str, origin: Origin, *numbers: int | str | bool) -> Requirement:
    """A requirement of a kind with its numbers; those of spheres begin with the test that they were touched for."""
    says, sentence, lacking = _KINDS[kind]

    def check(measured: Measured) -> str:
        words = lacking(measured, *numbers)
        enough = words is None or (isinstance(words, int) and words >= int(numbers[-1]))
        return "" if enough else sentence.format(words, *numbers)

    return Requirement(says.format("", *numbers), *origin, check)


_ASME: Origin = ("background knowledge of ASME B89.4.22", "background")
_ASME_READING: Origin = (_ASME[0], "own reading")
_KREON: Origin = ("digitalscan3d.com/iso-10360-12-standard-for-measuring-arms (Kreon)", "public source")
_OBERON: Origin = ("oberon3d.com, on ISO 10360-12 (Kreon, in Polish)", "public source")
_ISO_5: Origin = ("as in ISO 10360-5", "background")
_PAPER = "Cheng et al. 2018, section 4"
_RANGE = _need("range", ("data sheets of makers give the range as a diameter", "background"))
_CONDITIONS = Requirement(
    "the test is done within the rated conditions of the maker: temperature and its gradients, warm-up, mounting",
    *("ISO 10360 and ASME B89.4.22 in general", "background"),
)
_CALIBRATED = Requirement(
    "artefacts are calibrated and traceable, and differ from those on which the probe was qualified",
    *("ISO 10360 in general", "background"),
)


def _test(standard: str, title: str, metrics: Metrics, *requirements: Requirement) -> StandardTest:
    return StandardTest(standard, title, metrics, (*requirements, _CONDITIONS))


TESTS = (
    _test(
        JJF_1408,
        "single point and length, as in Cheng et al. 2018",
        metrics.single_point_and_length,
        _need("socket", (_PAPER, "own reading"), 10),
        _need("positions", (f"{_PAPER}: a length measured 30 times", "own reading"), 30),
        _CALIBRATED,
    ),
    _test(
        ASME_B89_4_22,
        "effective diameter",
        metrics.effective_diameter,
        _need("size", _ASME, "effective-diameter", 10, 50),
        _need("touches", _ASME, "effective-diameter", 9),
        _need("groups", _ASME, "effective-diameter", 3, "repeats"),
        _need("spread of touches", _ASME_READING, "effective-diameter", 9),
        _need("rings", _ASME, "effective-diameter", 9),
        _CALIBRATED,
    ),
    _test(
        ASME_B89_4_22,
        "single-point articulation",
        metrics.articulation,
        _need("zones", _ASME),
        _need("elbow", ("in FARO's public instructions, the elbow is swung from side to side", "own reading")),
        _RANGE,
    ),
    _test(
        ASME_B89_4_22,
        "volumetric",
        metrics.volumetric,
        _need("two bars", _ASME, 5),
        _need("lengths of the bars", _ASME),
        _need("positions", _ASME_READING, 20),
        _need("directions", _ASME_READING, False),
        _need("places", _ASME_READING, False),
        _RANGE,
        _CALIBRATED,
    ),
    _test(
        ISO_10360_12,
        "probing size and form",
        metrics.probing,
        _need("size", _ISO_5, "probing", 10, 51),
        _need("touches", _KREON, "probing", 25),
        _need("spread of touches", ("pattern of ISO 10360-5", "own reading"), "probing", 25),
        _need("places of the sphere", _KREON, "probing", 2),
        _RANGE,
        _CALIBRATED,
    ),
    _test(
        ISO_10360_12,
        "articulated location",
        metrics.location,
        _need("size", _ISO_5, "articulation", 10, 51),
        _need("groups", _KREON, "articulation", 5, "orientations"),
        _need("touches", _KREON, "articulation", 5),
        _need("spread of touches", ("as for 25 points", "own reading"), "articulation", 5),
        _need("orientations", (_KREON[0], "own reading")),
        _need("places of the sphere", _OBERON, "articulation", 2),
        _RANGE,
        _CALIBRATED,
    ),
    _test(
        ISO_10360_12,
        "length error",
        metrics.length_error,
        _need("lengths", ("as in ISO 10360-2 (a maker's public summary: 5 gauges)", "background"), 5),
        _need("positions of each", ("as in ISO 10360-2 (a maker's public summary: 7 directions)", "own reading"), 7),
        _need("readings", ("as in ISO 10360-2 (a maker's public summary: 3 readings)", "background"), 3),
        _need("directions", ("as in ISO 10360-2, with diagonals of the volume", "own reading"), True),
        _need("places", ("the lengths must sample the volume", "own reading"), True),
        _RANGE,
        _need("longest", ("as in ISO 10360-2 for the longest diagonal", "background")),
        Requirement(
            "lengths probed from the same direction at both ends, or between centres, as with sockets (not E_Bi)",
            *("ISO 10360-12, symbols of makers", "background"),
        ),
        _CALIBRATED,
    ),
)


def requirements_table() -> str:
    """The requirements of every test as Markdown: whether they are checked, their source, and how certain that is.

    Example:
        >>> print(aj.acceptance.requirements_table().splitlines()[0])
        ## JJF 1408-2013
    """
    lines = []
    for standard, tests in itertools.groupby(TESTS, key=lambda test: test.standard):
        lines += [f"## {EDITIONS[standard]}", "", "| test | requirement | checked | source | confidence |"]
        lines += ["|---|---|---|---|---|"]
        for test in tests:
            for says, source, confidence, lacking in test.requirements:
                checked = "no" if lacking is None else "yes"
                lines.append(f"| {test.title} | {says} | {checked} | {source} | {confidence} |")
        lines.append("")
    return "\n".join(lines)

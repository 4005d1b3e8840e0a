"""Requirements of standards as data: what a test needs, what of it is checked, from which source, and how certain.

A standard is one module with a table of `StandardTest`. What its text says was not available to this project; a source
names where the requirement was found, and no clause number that was not.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from ..data.sphere import ProbedSphere, SphereTest
from .geometry import BarPositions, all_bars, bar_positions, covers_hemisphere, separate_places, size_of
from .judgement import Influences
from .lengths import distinct_lengths, values_by_artefact
from .results import AcceptanceTest, Measured, Metric
from .spheres import EXACT_POINTS, fit_sphere
from .standards import EDITIONS

Confidence = Literal["public source", "secondary source", "background", "own reading"]
Origin = tuple[str, Confidence]  # the source, and how certain it is
CONFIDENCES: dict[Confidence, str] = {
    "public source": "found in a public page that is named",
    "secondary source": "stated by a paper or data sheet, not by the standard itself",
    "background": "background knowledge of the standard, without a source at hand",
    "own reading": "the standard asks for it in words; the number by which it is judged is ours",
}
_LEAST_APART = 0.1  # of two positions of a sphere, as a part of the measuring range


class Requirement(NamedTuple):
    """One thing that a standard's test needs."""

    says: str
    source: str
    confidence: Confidence
    # A sentence on what the measured lacks of it, "" where nothing; None where nothing recorded can tell.
    lacking: Callable[[Measured], str] | None = None


class StandardTest(NamedTuple):
    """A test of a standard: its metrics, and what a procedure needs to bear the standard's name."""

    standard: str  # a key of `standards.EDITIONS`
    title: str
    metrics: Callable[[Measured, Influences], Sequence[Metric]]
    requirements: tuple[Requirement, ...]

    def run(self, measured: Measured, influences: Influences) -> AcceptanceTest | None:
        """The test of those metrics that have values; None if none has."""
        metrics = tuple(metric for metric in self.metrics(measured, influences) if metric.values)
        if not metrics:
            return None
        checks = (requirement.lacking for requirement in self.requirements)
        sentences = (check(measured) for check in checks if check is not None)
        return AcceptanceTest(self.standard, self.title, metrics, tuple(filter(None, sentences)))


def _range_lacking(measured: Measured) -> str:
    stated = measured.measuring_range is not None
    return "" if stated else "The measuring range that the maker states is not given (measuring_range)."


RANGE_STATED = Requirement(
    "the measuring range is the one that the maker states",
    *("data sheets of makers give it as a diameter", "background"),
    _range_lacking,
)
CONDITIONS = Requirement(
    "the test is done within the maker's rated conditions: temperature and its gradients, warm-up, mounting",
    *("ISO 10360 and ASME B89.4.22 in general", "background"),
)
CALIBRATED = Requirement(
    "artefacts are calibrated and traceable, and are not those that the probe was qualified on",
    *("ISO 10360 in general", "background"),
)


def spheres_for(measured: Measured, test: SphereTest) -> list[ProbedSphere]:
    """The spheres touched for one test."""
    return [sphere for sphere in measured.spheres if sphere.test == test]


def of_spheres(
    says: str, test: SphereTest, wrong: Callable[[ProbedSphere], Iterable[str]], sentence: str, origin: Origin
) -> Requirement:
    """A requirement of every sphere of a test: ``wrong`` names what lacks it, where the sentence has ``{}``."""

    def lacking(measured: Measured) -> str:
        named = [text for sphere in spheres_for(measured, test) for text in wrong(sphere)]
        return sentence.format(", ".join(named)) if named else ""

    return Requirement(says, *origin, lacking)


def groups_where(sphere: ProbedSphere, condition: Callable[[np.ndarray], bool], kind: str = "group") -> list[str]:
    """The groups of touches that are so, as sentences name them."""
    numbers = (number for number, group in enumerate(sphere.groups, start=1) if condition(group))
    return [f"'{sphere.name}', {kind} {number}" for number in numbers]


def sphere_size(test: SphereTest, low: float, high: float, origin: Origin) -> Requirement:
    """A sphere with a diameter in a range, mm."""

    def wrong(sphere: ProbedSphere) -> list[str]:
        return [] if low <= sphere.diameter <= high else [f"'{sphere.name}' has {sphere.diameter:g} mm"]

    size = f"a sphere of {low:g} to {high:g} mm"
    return of_spheres(size, test, wrong, f"A{size[1:]} is required ({{}}).", origin)


def touches(test: SphereTest, points: int, origin: Origin) -> Requirement:
    """So many touches in every group."""

    def wrong(sphere: ProbedSphere) -> list[str]:
        return groups_where(sphere, lambda group: len(group) < points)

    says = f"{points} points in every group of touches"
    return of_spheres(says, test, wrong, f"{points} points per group are required (fewer: {{}}).", origin)


def spread_touches(test: SphereTest, points: int, origin: Origin) -> Requirement:
    """Touches spread over a hemisphere; of groups that are too small, `touches` speaks."""

    def wrong(sphere: ProbedSphere) -> list[str]:
        return groups_where(sphere, lambda group: len(group) >= points and not covers_hemisphere(group, points))

    says = "touches evenly over at least a hemisphere: no gap wider by 8 degrees than those of the recommended pattern"
    sentence = "The touches must be spread over a hemisphere ({}: they are not)."
    return of_spheres(says, test, wrong, sentence, origin)


def groups_of_touches(test: SphereTest, groups: int, kind: str, origin: Origin) -> Requirement:
    """So many repeats or orientations of every sphere."""

    def wrong(sphere: ProbedSphere) -> list[str]:
        return [f"'{sphere.name}' has {len(sphere.groups)}"] if len(sphere.groups) < groups else []

    sentence = f"{groups} {kind} of a sphere are required ({{}})."
    return of_spheres(f"{groups} {kind} of the sphere", test, wrong, sentence, origin)


def sphere_positions(test: SphereTest, positions: int, origin: Origin) -> Requirement:
    """The sphere in so many positions."""

    def lacking(measured: Measured) -> str:
        fitted = [group for s in spheres_for(measured, test) for group in s.groups if len(group) >= EXACT_POINTS]
        size = size_of(measured)
        count = separate_places([fit_sphere(g).centre for g in fitted], _LEAST_APART * size) if size else len(fitted)
        if count >= positions:
            return ""
        return f"The sphere must be measured in {positions} positions far apart; it was in {max(count, 1)}."

    says = f"the sphere in {positions} positions, of which the worse counts; apart by 10 % of the range or more"
    return Requirement(says, *origin, lacking)


class _Count(NamedTuple):
    """A number that the positions of bars have, in a measuring range (mm) whose size may be unknown; ``{n}`` is the
    one that is needed, ``{}`` the one that they have."""

    says: str
    sentence: str
    count: Callable[[list[BarPositions], float | None], float]


_DIRECTIONS = (
    "directions of the bars in all three dimensions, 10 degrees out of any plane (RMS)",
    "The directions must be horizontal, vertical and inclined, not in one plane.",
)
_COUNTS = {
    "lengths": _Count(
        "{n} different calibrated lengths",
        "{n} different lengths are required ({} given).",
        lambda bars, size: len(bars),
    ),
    "readings": _Count(
        "{n} readings of each length in each position",
        "{n} readings in each position are required (a position has {}).",
        lambda bars, size: min((number for bar in bars for number in bar.readings), default=0),
    ),
    "positions": _Count(
        "{n} positions of the bars, different by 10 degrees, or in place by 5 % of the range",
        "{n} different positions are required ({} given).",
        lambda bars, size: sum(len(bar.distinct(size).readings) for bar in bars),
    ),
    "positions of each": _Count(
        "{n} positions of every length, different by 10 degrees, or in place by 5 % of the range",
        "{n} different positions of every length are required (one has {}).",
        lambda bars, size: min(len(bar.distinct(size).readings) for bar in bars),
    ),
    "directions": _Count(*_DIRECTIONS, lambda bars, size: all_bars(bars).in_all_directions),
    "directions of each": _Count(*_DIRECTIONS, lambda bars, size: all(bar.in_all_directions for bar in bars)),
}


def _bars(measured: Measured) -> list[BarPositions]:
    groups = values_by_artefact(distinct_lengths(measured.lengths))
    return bar_positions(measured, [group.tolist() for group in groups])


def of_bars(kind: str, needed: int, origin: Origin) -> Requirement:
    """So many of a key of `_COUNTS`."""
    says, sentence, count = _COUNTS[kind]

    def lacking(measured: Measured) -> str:
        number = count(_bars(measured), size_of(measured))
        return "" if number >= needed else sentence.format(number, n=needed)

    return Requirement(says.format(n=needed), *origin, lacking)


def spread_places(every_bar: bool, least: float, origin: Origin) -> Requirement:
    """Bars in places over the measuring volume; not judged where its size is unknown."""

    def lacking(measured: Measured) -> str:
        bars, size = _bars(measured), size_of(measured)
        if size is None:
            return "The size of the measuring volume is unknown, so that the places of the bars cannot be judged."
        narrowest = min(bar.spread(size) for bar in (bars if every_bar else [all_bars(bars)]))
        if narrowest >= least:
            return ""
        return (
            f"The places must be spread over the measuring volume: their middles scatter by {100 * narrowest:.1f} % of "
            f"it, and {100 * least:.0f} % are required."
        )

    says = f"places over the measuring volume: middles scatter by {100 * least:.0f} % of the range or more (RMS)"
    return Requirement(says, *origin, lacking)


def requirements_table(tests: Sequence[StandardTest]) -> str:
    """The requirements of tests as Markdown, those that are checked and those that nothing recorded can show."""
    lines = []
    for standard in dict.fromkeys(test.standard for test in tests):
        lines += [f"## {EDITIONS[standard]}", "", "| test | requirement | checked | source | confidence |"]
        lines += ["|---|---|---|---|---|"]
        for test in (test for test in tests if test.standard == standard):
            for requirement in test.requirements:
                says, source, confidence, lacking = requirement
                checked = "no" if lacking is None else "yes"
                lines.append(f"| {test.title} | {says} | {checked} | {source} | {confidence} |")
        lines.append("")
    return "\n".join(lines)

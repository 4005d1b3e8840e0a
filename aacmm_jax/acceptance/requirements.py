"""Requirements of standards as data: what a test needs, what of it is checked, from which source, and how certain.

A standard is one module with a table of `StandardTest`. What its text says was not available to this project; a source
names where the requirement was found, and no clause number that was not.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from ..core.text import pluralise
from ..data.sphere import ProbedSphere, SphereTest
from .geometry import all_bars, bar_positions, covers_hemisphere, separate_places, size_of
from .influences import Influences
from .lengths import distinct_lengths, values_by_artefact
from .results import AcceptanceTest, Measured, Metric
from .spheres import EXACT_POINTS, fit_sphere
from .standards import EDITIONS

Confidence = Literal["public source", "secondary source", "background", "own reading"]
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
        found = tuple(metric for metric in self.metrics(measured, influences) if metric.values)
        if not found:
            return None
        checks = (requirement.lacking for requirement in self.requirements)
        sentences = (check(measured) for check in checks if check is not None)
        return AcceptanceTest(self.standard, self.title, found, tuple(filter(None, sentences)))


RANGE_STATED = Requirement(
    "the measuring range is the one that the maker states",
    "data sheets of makers give it as a diameter",
    "background",
    lambda measured: (
        ""
        if measured.measuring_range is not None
        else "The measuring range that the maker states is not given (measuring_range)."
    ),
)
CONDITIONS = Requirement(
    "the test is done within the maker's rated conditions: temperature and its gradients, warm-up, mounting",
    "ISO 10360 and ASME B89.4.22 in general",
    "background",
)
CALIBRATED = Requirement(
    "artefacts are calibrated and traceable, and are not those that the probe was qualified on",
    "ISO 10360 in general",
    "background",
)


def spheres_for(measured: Measured, test: SphereTest) -> list[ProbedSphere]:
    """The spheres touched for one test."""
    return [sphere for sphere in measured.spheres if sphere.test == test]


def sphere_size(test: SphereTest, low: float, high: float, source: str, confidence: Confidence) -> Requirement:
    """A sphere with a diameter in a range, mm."""

    def lacking(measured: Measured) -> str:
        wrong = [sphere for sphere in spheres_for(measured, test) if not low <= sphere.diameter <= high]
        named = ", ".join(f"'{sphere.name}' has {sphere.diameter:g} mm" for sphere in wrong)
        return f"A sphere of {low:g} to {high:g} mm is required ({named})." if wrong else ""

    return Requirement(f"a sphere of {low:g} to {high:g} mm", source, confidence, lacking)


def touches(test: SphereTest, points: int, source: str, confidence: Confidence) -> Requirement:
    """So many touches in every group."""

    def lacking(measured: Measured) -> str:
        fewest = {s.name: min(map(len, s.groups)) for s in spheres_for(measured, test)}
        few = [f"'{name}' has a group of {count}" for name, count in fewest.items() if count < points]
        return f"{points} points per group are required ({', '.join(few)})." if few else ""

    return Requirement(f"{points} points in every group of touches", source, confidence, lacking)


def spread_touches(test: SphereTest, points: int, source: str, confidence: Confidence) -> Requirement:
    """Touches spread over a hemisphere."""

    def lacking(measured: Measured) -> str:
        bad = [
            f"'{sphere.name}', group {number}"
            for sphere in spheres_for(measured, test)
            for number, group in enumerate(sphere.groups, start=1)
            if len(group) >= points and not covers_hemisphere(group, points)
        ]
        return f"The touches must be spread over a hemisphere ({', '.join(bad)}: they are not)." if bad else ""

    return Requirement(
        "touches evenly over at least a hemisphere: no gap wider by 8 degrees than those of the recommended pattern",
        source,
        confidence,
        lacking,
    )


def groups_of_touches(test: SphereTest, groups: int, of: str, source: str, confidence: Confidence) -> Requirement:
    """So many repeats or orientations of every sphere."""

    def lacking(measured: Measured) -> str:
        few = [s for s in spheres_for(measured, test) if len(s.groups) < groups]
        named = ", ".join(f"'{sphere.name}' has {len(sphere.groups)}" for sphere in few)
        return f"{groups} {of} of a sphere are required ({named})." if few else ""

    return Requirement(f"{groups} {of} of the sphere", source, confidence, lacking)


def sphere_positions(test: SphereTest, positions: int, source: str, confidence: Confidence) -> Requirement:
    """The sphere in so many positions."""

    def lacking(measured: Measured) -> str:
        fitted = [group for s in spheres_for(measured, test) for group in s.groups if len(group) >= EXACT_POINTS]
        size = size_of(measured)
        found = separate_places([fit_sphere(g).centre for g in fitted], _LEAST_APART * size) if size else len(fitted)
        if found >= positions:
            return ""
        return f"The sphere must be measured in {positions} positions far apart; it was in {max(found, 1)}."

    return Requirement(
        f"the sphere in {positions} positions, of which the worse counts; apart by 10 % of the range or more",
        source,
        confidence,
        lacking,
    )


def bars_lacking(
    check: Callable[[list, float | None], str],
) -> Callable[[Measured], str]:
    """A check of the positions of bars, with the size of the measuring range (mm) where it is known."""

    def lacking(measured: Measured) -> str:
        groups = values_by_artefact(distinct_lengths(measured.lengths))
        return check(bar_positions(measured, [group.tolist() for group in groups]), size_of(measured))

    return lacking


def different_positions(positions: int, each: bool, source: str, confidence: Confidence) -> Requirement:
    """So many different positions, of every bar or of all together."""

    def check(bars: list, size: float | None) -> str:
        counts = [len(bar.distinct(size).readings) for bar in bars]
        if each:
            few = [f"{bar.length:.0f} mm: {n}" for bar, n in zip(bars, counts, strict=True) if n < positions]
            return f"{positions} different positions of every length are required ({', '.join(few)})." if few else ""
        found = sum(counts)
        return "" if found >= positions else f"{positions} different positions are required ({found} given)."

    what = "of every length" if each else "of the bars"
    says = f"{positions} positions {what}, different by 10 degrees, or in place by 5 % of the range"
    return Requirement(says, source, confidence, bars_lacking(check))


def all_directions(each: bool, source: str, confidence: Confidence) -> Requirement:
    """Bars in directions that are not all in one plane."""

    def check(bars: list, size: float | None) -> str:
        wrong = [bar for bar in (bars if each else [all_bars(bars)]) if not bar.in_all_directions]
        if not wrong:
            return ""
        named = f" ({', '.join(f'{bar.length:.0f} mm' for bar in wrong)}: they are not)" if each else ""
        return f"The directions must be horizontal, vertical and inclined, not in one plane{named}."

    says = "directions of the bars in all three dimensions, 10 degrees out of any plane (RMS)"
    return Requirement(says, source, confidence, bars_lacking(check))


def spread_places(each: bool, least: float, source: str, confidence: Confidence) -> Requirement:
    """Bars in places over the measuring volume; not judged where its size is unknown."""

    def check(bars: list, size: float | None) -> str:
        if size is None:
            return "The size of the measuring volume is unknown, so that the places of the bars cannot be judged."
        narrow = [bar for bar in (bars if each else [all_bars(bars)]) if bar.spread(size) < least]
        if not narrow:
            return ""
        found = min(bar.spread(size) for bar in narrow)
        return (
            f"The places must be spread over the measuring volume: their middles scatter by {100 * found:.1f} % of it, "
            f"and {100 * least:.0f} % are required."
        )

    says = f"places over the measuring volume: middles scatter by {100 * least:.0f} % of the range or more (RMS)"
    return Requirement(says, source, confidence, bars_lacking(check))


def lengths_given(count: int, source: str, confidence: Confidence) -> Requirement:
    """So many different lengths."""

    def check(bars: list, size: float | None) -> str:
        return "" if len(bars) >= count else f"{count} different lengths are required ({len(bars)} given)."

    return Requirement(f"{count} different calibrated lengths", source, confidence, bars_lacking(check))


def readings_of_each(repeats: int, source: str, confidence: Confidence) -> Requirement:
    """So many readings in each position."""

    def check(bars: list, size: float | None) -> str:
        few = min((number for bar in bars for number in bar.readings), default=0)
        if few >= repeats:
            return ""
        return f"{repeats} readings in each position are required (one has {pluralise(few, 'reading')})."

    return Requirement(f"{repeats} readings of each length in each position", source, confidence, bars_lacking(check))


def requirements_table(tests: Sequence[StandardTest]) -> str:
    """The requirements of tests as Markdown, those that are checked and those that nothing recorded can show."""
    lines = []
    for standard in dict.fromkeys(test.standard for test in tests):
        lines += [f"## {EDITIONS[standard]}", "", "| test | requirement | checked | source | confidence |"]
        lines += ["|---|---|---|---|---|"]
        for test in (test for test in tests if test.standard == standard):
            for one in test.requirements:
                checked = "no" if one.lacking is None else "yes"
                lines.append(f"| {test.title} | {one.says} | {checked} | {one.source} | {one.confidence} |")
        lines.append("")
    return "\n".join(lines)

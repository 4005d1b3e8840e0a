"""Errors of lengths, placement by placement; metrics of acceptance tests; uncertainty over the working volume."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..acceptance.results import AcceptanceTest
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.errors import InputError
from ..core.units import DEG
from ..diagnostics.joint_travel import TriedPoses
from ..summaries.calibration import metrics_by_socket_and_length
from ..summaries.tables import by_columns, decimals_for, format_number, numbers
from ..uncertainty.coverage import U_AT_LEVEL
from ..uncertainty.volume import VolumetricUncertainty
from .charts import Axis, Chart, Marks, Plot, borders, level, linear, names, runs, shades, thinned
from .figures import draw

_NAMED = 16  # most lengths or placements along an axis
_LEAST = 1e-6  # mm: drawn for a limit of zero
_ACROSS, _UP = "distance from the first axis [mm]", "height [mm]"
# By their shade: how far from the poses of a calibration another pose is.
_TRIED = (
    "near a calibration pose",
    "",
    "farther, every joint within its calibrated travel",
    "one joint outside its calibrated travel",
    "",
    "two joints or more outside",
)
_TIPS = 400  # most tips of the calibration that are drawn


def by_placement(between: Sequence[tuple[str, str]]) -> tuple[np.ndarray, Axis, np.ndarray]:
    """Errors of lengths, given by their ends, side by side, those of one placement together: ends that have a folder in
    common ("monday/a", "monday/b"). The abscissa of each error; the axis, which names the lengths, or the placements
    where there are too many lengths; and the borders between them."""
    lengths = [f"{start} – {end}" for start, end in between]
    folders = [[name.rpartition("/")[0] for name in ends] for ends in between]
    placements = [
        start if start and start == end else length for (start, end), length in zip(folders, lengths, strict=True)
    ]
    place_number = {name: number for number, name in enumerate(dict.fromkeys(placements))}
    length_number = {name: number for number, name in enumerate(dict.fromkeys(lengths))}
    keys = [(place_number[place], length_number[length]) for place, length in zip(placements, lengths, strict=True)]
    order = sorted(range(len(keys)), key=lambda i: keys[i])
    x = np.empty(len(keys))
    x[order] = np.arange(len(keys))
    alone = len(length_number) == len(place_number)  # each length in a placement of its own
    for words, plural in ((placements if alone else lengths, "length"), (placements, "placement")):
        ticks, edges = runs([words[i] for i in order])
        if len(ticks) <= _NAMED:
            return x, Axis(plural, -0.6, len(x) - 0.4, ticks, named=True), edges
    title = f"{len(length_number)} lengths in {len(place_number)} placements, one after the other"
    return x, Axis(title, -0.6, len(x) - 0.4, named=True), np.zeros(0)


def _errors_plot(axis: Axis, edges: np.ndarray, marks: Sequence[Marks]) -> Plot:
    ends = [end for part in marks for end in (part.y, part.low, part.high) if end is not None]
    return Plot(axis, linear("measured − calibrated [mm]", *ends, [0.0]), (*marks, borders(edges), level(0.0)))


def length_chart(rows: Sequence[Mapping[str, Any]], earlier: Mapping[str, np.ndarray]) -> Chart:
    """Errors of reference lengths by the calibrated arm, with U where there is one, and by an earlier one; mm.

    Rows are those of a summary, with "from", "to", "error_mm" and "expanded_mm".
    """
    x, axis, edges = by_placement([(row["from"], row["to"]) for row in rows])
    error = np.array([row["error_mm"] for row in rows])
    expanded = np.array([np.nan if row["expanded_mm"] is None else row["expanded_mm"] for row in rows])
    words = [
        f"{row['from']} – {row['to']}: {format_number(row['error_mm'], signed=True)} mm"
        + ("" if row["expanded_mm"] is None else f", U {format_number(row['expanded_mm'])} mm")
        for row in rows
    ]
    marks = [Marks(name, x, values, "diamond", "accent") for name, values in earlier.items()]
    name = "calibrated" + (f", with {U_AT_LEVEL}" if np.any(np.isfinite(expanded)) else "")
    marks.append(Marks(name, x, error, "square", "main", words, error - expanded, error + expanded, size=7))
    description = "Measured minus calibrated value" + (", before and after the scale fix." if earlier else ".")
    return Chart("lengths", "Errors of the reference lengths", description, (_errors_plot(axis, edges, marks),))


def reading_errors_chart(tests: Sequence[AcceptanceTest]) -> Chart | None:
    """Errors of single readings of lengths (E_Uni) by the calibrated arm, and their limits; None without such a
    test."""
    metric = next((metric for test in tests for metric in test.metrics if metric.name == "E_Uni"), None)
    if metric is None:
        return None
    ends = [part.where.partition(", reading ")[0].split(" - ", 1) for part in metric.values]
    x, axis, edges = by_placement([(pair[0], pair[-1]) for pair in ends])
    values, bars = (np.array([getattr(part, name) for part in metric.values]) for name in ("value", "expanded"))
    words = [
        f"{part.where}: {format_number(part.value, signed=True)} mm; length {part.length:g} mm"
        + (f", MPE {format_number(part.limit)} mm" if part.limit is not None else "")
        for part in metric.values
    ]
    name = "single readings" + (", with U" if np.any(bars > 0) else "")
    marks = [Marks(name, x, values, "dot", "main", words, values - bars, values + bars, size=5)]
    limits = np.array([np.nan if part.limit is None else part.limit for part in metric.values])
    description = "Errors of single readings of the reference lengths with the calibrated arm"
    if np.any(np.isfinite(limits)):
        order = np.argsort(x)
        marks += [Marks("MPE", x[order], side * limits[order], "dashed", "ink") for side in (1, -1)]
        description += ", and their limits"
    return Chart("length-errors", "Errors of lengths", f"{description}.", (_errors_plot(axis, edges, marks),))


def reference_length_errors(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the errors of the reference lengths before and after the scale fix, mm, with expanded uncertainty U.

    Args:
        record: The calibration; `InputError` if it has no reference lengths.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.reference_length_errors(record).figure.savefig("figure.svg")
    """
    capture, evaluations = record.recording.capture, record.evaluations()
    if not capture.lengths:
        raise InputError("the calibration has no reference lengths, so there are no length errors to draw.")
    rows = metrics_by_socket_and_length(capture, evaluations["calibrated"], uncertainty_of(record))["lengths"]
    earlier = {"stage 1": np.asarray(evaluations["stage1"].error)} if record.stage1_apart else {}
    return draw(length_chart(rows, earlier).plots[0], axes)


def metrics_chart(tests: Sequence[AcceptanceTest]) -> Chart:
    """The worst value of every metric with U, divided by its limit if limits were given."""
    metrics = [metric for test in tests for metric in test.metrics]
    limited = [metric for metric in metrics if metric.worst.limit is not None]
    y, lines, title, divisors = "|value| [mm]", [], "Metrics", np.ones(len(metrics))
    description = "The value of each metric, with U. No limit was given."
    if limited:
        metrics, y, lines, title = limited, "|value| / MPE", [1.0], "Metrics against their limits"
        divisors = np.array([max(metric.worst.limit or 0.0, _LEAST) for metric in metrics])
        description = (
            "The value of each metric divided by its limit, with U. The decisions in the tables follow their "
            "decision rule, whose guard band may be smaller than U."
        )
    values = np.array([abs(metric.value) for metric in metrics]) / divisors
    bars = np.array([metric.worst.expanded for metric in metrics]) / divisors
    words = [f"{metric.name}: {format_number(metric.value)} mm at {metric.worst.where}" for metric in metrics]
    labels = [f"{metric.name}: {metric.decision}" if metric.decision else metric.name for metric in metrics]
    # An absolute value is not negative, so a bar that is longer than its value ends at 0.
    low, high = np.maximum(values - bars, 0.0), values + bars
    marks = Marks("", np.arange(len(metrics)), values, "square", "main", words, low, high, size=8)
    axes = names("", labels), linear(y, high, lines, [0.0], zero=True)
    return Chart("margins", title, description, (Plot(*axes, (marks, level(*lines)), height=240),))


def acceptance_metrics(tests: Sequence[AcceptanceTest], axes: Any = None) -> Any:
    """Plot the worst value of every metric that has a limit, divided by the limit, with its expanded uncertainty.

    The decision beside each name follows its rule, whose guard band may be less than the bar.

    Args:
        tests: Acceptance tests of one arm (`acceptance.run`); `InputError` if no metric has a limit.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> measured = aj.acceptance.measured_by(result.arm, aj.Recording(two_bars, nominal))
        >>> tests = aj.acceptance.run(measured, limits={"SPAT": 0.1, "Length": 0.05})
        >>> aj.plot.acceptance_metrics(tests).figure.savefig("acceptance.svg")
    """
    if not any(metric.worst.limit for test in tests for metric in test.metrics):
        raise InputError("no metric has a limit to compare with; give limits to acceptance.run.")
    return draw(metrics_chart(tests).plots[0], axes)


def _section(start: np.ndarray, shaded: tuple[np.ndarray, Any], said: Sequence[str], name: str = "", **style) -> Marks:
    """Points of half a section through the volume, mm, with their shades, those of the last shade on top."""
    shade, limits = shaded
    order = np.argsort(shade, kind="stable")
    words = [f"({', '.join(f'{x:.0f}' for x in start[i])}) mm: {said[i]}" for i in order]
    radius = np.hypot(start[:, 0], start[:, 1])
    return Marks(name, radius[order], start[order, 2], words=words, shade=shade[order], limits=limits, **style)


def volume_chart(volume: VolumetricUncertainty) -> Chart:
    """U of lengths over the working volume: half a section through it."""
    finite = np.isfinite(volume.expanded_length)
    expanded, name = volume.expanded_length[finite], f"U of a {volume.length:.4g} mm length"
    shade, limits = shades(expanded)
    said = [f"U = {format_number(u, decimals_for(u))} mm" for u in expanded.tolist()]
    marks = _section(volume.start[finite], (shade, limits if np.any(finite) else ()), said, name, unit="mm")
    axes = linear(_ACROSS, np.hypot(volume.start[:, 0], volume.start[:, 1]), [0.0]), linear(_UP, volume.start[:, 2])
    description = "Height against distance from the first axis; a larger mark shows a larger U."
    return Chart("volume", f"{name} over the volume", description, (Plot(*axes, (marks,), height=380),))


def volumetric_uncertainty_map(volume: VolumetricUncertainty, axes: Any = None) -> Any:
    """Plot the expanded uncertainty U of lengths over the working volume: larger and darker marks are more uncertain.

    Each length is marked at the height and the distance from the first axis where it starts.

    Args:
        volume: The result of `volumetric_uncertainty`; `InputError` if no length has a finite uncertainty.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> volume = aj.volumetric_uncertainty(aj.uncertainty_of(result), points=20)
        >>> axes = aj.plot.volumetric_uncertainty_map(volume)
    """
    if not np.any(np.isfinite(volume.expanded_length)):
        raise InputError("the data do not determine lengths over the volume, so there is no uncertainty to draw.")
    return draw(volume_chart(volume).plots[0], axes)


def tried_chart(volume: VolumetricUncertainty, tips: np.ndarray, poses: TriedPoses) -> Chart:
    """Half a section through the volume: random poses by how far they are from what the calibration has, the tips of
    the calibration, mm, and a table of the classes with U of a tip in each."""
    shade = tried_shades(poses)
    said = [
        f"{distance / DEG:.0f} deg from the nearest calibration pose; {_TRIED[i]}"
        for distance, i in zip(poses.distance.tolist(), shade.tolist(), strict=True)
    ]
    tips = tips[thinned(len(tips), _TIPS)]
    across = np.hypot(tips[:, 0], tips[:, 1])
    random = _section(volume.start, (shade, ()), said, size=5, classes=_TRIED)
    marks = random, Marks("tips of the calibration", across, tips[:, 2], "square", "accent", size=4)
    axes = linear(_ACROSS, random.x, across, [0.0]), linear(_UP, volume.start[:, 2], tips[:, 2])
    parts = [(name, shade == i) for i, name in enumerate(_TRIED) if name]
    u = [volume.expanded_tip[part] for _, part in parts]
    table = by_columns(
        "Random poses within the joint limits, by how far they are from the calibration",
        {
            "class": [name for name, _ in parts],
            "share [%]": numbers([100 * float(np.mean(part)) for _, part in parts], 0),
            "median U of a tip [mm]": numbers([float(np.median(values)) if len(values) else np.nan for values in u]),
            "largest [mm]": numbers([float(np.max(values)) if len(values) else np.nan for values in u]),
        },
    )
    description = (
        "Tip positions of random poses over the whole volume. Near: no farther from a calibration pose than these are "
        "from one another. Farther, within the travel that the calibration has of every joint, the model interpolates; "
        "outside this travel it extrapolates."
    )
    plot = Plot(*axes, marks, height=380)
    return Chart("tried", "Coverage of the working volume", description, (plot,), table)


def tried_shades(poses: TriedPoses) -> np.ndarray:
    """The shade of each pose in `_TRIED`."""
    return np.where(poses.tried, 0, np.array([2, 3, 5])[np.minimum(poses.outside, 2)])

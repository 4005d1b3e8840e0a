"""Errors of lengths, placement by placement, and metrics of acceptance tests against their limits."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..acceptance.results import AcceptanceTest
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.errors import InputError
from ..summaries.tables import format_number
from .charts import Axis, Chart, Marks, Plot, borders, level, linear, names, ordinates, runs
from .figures import draw

_NAMED = 16  # most lengths or placements along an axis
_LEAST = 1e-6  # mm: drawn for a limit of zero
_TITLE = "measured − value [mm]"


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


def length_chart(between: Sequence[tuple[str, str]], errors: Mapping[str, np.ndarray], expanded: np.ndarray) -> Chart:
    """Errors of reference lengths, given by their ends, by one arm or two, mm; the last with its U, NaN where there is
    none."""
    x, axis, edges = by_placement(between)
    *earlier, (last, error) = errors.items()
    words = [
        f"{start} – {end}: {format_number(value, signed=True)} mm"
        + (f", U {format_number(bar)} mm" if np.isfinite(bar) else "")
        for (start, end), value, bar in zip(between, error.tolist(), expanded.tolist(), strict=True)
    ]
    marks = [Marks(name, x, values, "diamond", "accent") for name, values in earlier]
    name = f"{last}, with U (95 %)" if np.any(np.isfinite(expanded)) else last
    low, high = error - expanded, error + expanded
    marks.append(Marks(name, x, error, "square", "main", words, low, high, size=7))
    y = linear(_TITLE, *ordinates(marks), [0.0])
    description = "Measured minus calibrated value" + (", before and after the scale fix." if earlier else ".")
    plot = Plot(axis, y, (*marks, borders(edges), level(0.0)))
    return Chart("lengths", "Errors of the reference lengths", description, (plot,))


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
    low, high = values - bars, values + bars
    name = "single readings" + (", with U" if np.any(bars > 0) else "")
    marks = [Marks(name, x, values, "dot", "main", words, low, high, size=5)]
    limits = np.array([np.nan if part.limit is None else part.limit for part in metric.values])
    limited, order = bool(np.any(np.isfinite(limits))), np.argsort(x)
    if limited:
        marks += [Marks("MPE", x[order], side * limits[order], "dashed", "ink") for side in (1, -1)]
    y = linear(_TITLE, *ordinates(marks), [0.0])
    description = "Errors of the reference lengths, reading by reading, by the calibrated arm"
    plot = Plot(axis, y, (*marks, borders(edges), level(0.0)))
    return Chart(
        "length-errors", "Errors of lengths", description + (", and their limits." if limited else "."), (plot,)
    )


def reference_length_errors(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the errors of the reference lengths before and after the scale fix, mm, with expanded uncertainty (95 %).

    Args:
        record: The calibration.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If the calibration has no reference lengths.

    Example:
        >>> axes = aj.plot.reference_length_errors(record)
        >>> print(axes.get_ylabel())
        measured − value [mm]
    """
    lengths = record.recording.capture.lengths
    if not lengths:
        raise InputError("the calibration has no reference lengths, so there are no errors of lengths to draw.")
    evaluations = record.evaluations()
    stages = {"stage 1": "stage1", "calibrated": "calibrated"} if record.stage1_apart else {"calibrated": "calibrated"}
    errors = {name: np.asarray(evaluations[stage].error) for name, stage in stages.items()}
    u, stated = np.asarray(evaluations["calibrated"].u), np.array([float(length.u) for length in lengths])
    expanded = np.where(np.isfinite(u), uncertainty_of(record).expanded_by_scatter(u, stated), np.nan)
    return draw(length_chart([(length.start, length.end) for length in lengths], errors, expanded).plots[0], axes)


def metrics_chart(tests: Sequence[AcceptanceTest]) -> Chart:
    """The worst value of every metric with U, divided by its limit if limits were given."""
    metrics = [metric for test in tests for metric in test.metrics]
    limited = [metric for metric in metrics if metric.worst.limit is not None]
    if limited:
        metrics, y, lines = limited, "|value| / MPE", [1.0]
        divisors = [max(metric.worst.limit or 0.0, _LEAST) for metric in metrics]
        title = "Metrics against their limits"
        description = (
            "The value of each metric, divided by its limit, with U. The decisions are in the tables: they follow the "
            "rule stated above, whose guard band may be less than U."
        )
    else:
        y, lines, divisors = "|value| [mm]", [], [1.0] * len(metrics)
        title, description = "Metrics", "The value of each metric, with U. No limit was given."
    values = np.array([abs(metric.value) / divisor for metric, divisor in zip(metrics, divisors, strict=True)])
    bars = np.array([metric.worst.expanded / divisor for metric, divisor in zip(metrics, divisors, strict=True)])
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
        tests: Acceptance tests of one arm (`acceptance.run`).
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If no metric has a limit.

    Example:
        >>> measured = aj.acceptance.measured_by(result.arm, aj.Recording(two_bars, nominal))
        >>> tests = aj.acceptance.run(measured, limits={"SPAT": 0.1, "Length": 0.05})
        >>> axes = aj.plot.acceptance_metrics(tests)
        >>> axes.figure.savefig("acceptance.svg")
    """
    if not any(metric.worst.limit for test in tests for metric in test.metrics):
        raise InputError("no metric has a limit to be drawn against; give limits to accept.")
    return draw(metrics_chart(tests).plots[0], axes)

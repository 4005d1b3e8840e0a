"""Errors of lengths, placement by placement: of reference lengths, and reading by reading against their limits."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..acceptance.results import AcceptanceTest
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.errors import InputError
from ..summaries.tables import format_number
from .charts import Axis, Chart, Marks, Plot, borders, level, linear
from .figures import draw

_NAMED = 16  # most lengths or placements along an axis
_TITLE = "measured − value [mm]"


def by_placement(between: Sequence[tuple[str, str]]) -> tuple[np.ndarray, Axis, np.ndarray]:
    """Errors of lengths side by side, those of one placement together.

    Args:
        between: The ends of the length of each error. Names that have a folder in common ("monday/a", "monday/b") are
            of one placement.

    Returns:
        The abscissa of each error; the axis, which names the lengths, or the placements where there are too many
        lengths; and the borders between them.
    """
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
        sorted_words = [words[i] for i in order]
        last = [i for i, word in enumerate(sorted_words) if i + 1 == len(order) or sorted_words[i + 1] != word]
        if len(last) <= _NAMED:
            edges = np.array([-1, *last]) + 0.5
            middles = (edges[:-1] + edges[1:]) / 2
            ticks = tuple((float(at), sorted_words[i]) for at, i in zip(middles, last, strict=True))
            return x, Axis(plural, -0.6, len(x) - 0.4, ticks, named=True), edges[1:-1]
    title = f"{len(length_number)} lengths in {len(place_number)} placements, one after the other"
    return x, Axis(title, -0.6, len(x) - 0.4, named=True), np.zeros(0)


def length_chart(
    between: Sequence[tuple[str, str]], errors: Mapping[str, np.ndarray], expanded: np.ndarray, id: str = "lengths"
) -> Chart:
    """Errors of reference lengths by one arm or two, the last with its expanded uncertainty.

    Args:
        between: The ends of each length.
        errors: Name of an arm -> measured minus calibrated value, mm.
        expanded: U of the errors by the last arm, mm; NaN where there is none.
        id: Identifier of the chart.

    Returns:
        The chart.
    """
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
    y = linear(_TITLE, *errors.values(), low, high, [0.0])
    description = "Measured minus calibrated value" + (", before and after the scale fix." if earlier else ".")
    plot = Plot(axis, y, (*marks, borders(edges), level(0.0)))
    return Chart(id, "Errors of the reference lengths", description, (plot,))


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
    y = linear(_TITLE, low, high, limits, -limits, [0.0])
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

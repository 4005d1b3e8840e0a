"""Charts of errors of lengths, placement by placement."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from . import charts
from .elements import Chart, ReportTable, format_number

_NAMED = 16  # most lengths or placements along an axis


def by_placement(between: Sequence[tuple[str, str]]) -> tuple[np.ndarray, charts.Axis, np.ndarray]:
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
        one if one and one == other else length for (one, other), length in zip(folders, lengths, strict=True)
    ]
    place_number = {name: number for number, name in enumerate(dict.fromkeys(placements))}
    length_number = {name: number for number, name in enumerate(dict.fromkeys(lengths))}
    keys = [(place_number[place], length_number[length]) for place, length in zip(placements, lengths, strict=True)]
    order = sorted(range(len(keys)), key=lambda i: keys[i])
    x = np.empty(len(keys))
    x[order] = np.arange(len(keys))
    one_each = len(length_number) == len(place_number)
    for words, plural in ((placements if one_each else lengths, "length"), (placements, "placement")):
        sorted_words = [words[i] for i in order]
        last = [i for i, word in enumerate(sorted_words) if i + 1 == len(order) or sorted_words[i + 1] != word]
        if len(last) <= _NAMED:
            borders = np.array([-1, *last]) + 0.5
            middles = (borders[:-1] + borders[1:]) / 2
            ticks = tuple((float(at), sorted_words[i]) for at, i in zip(middles, last, strict=True))
            return x, charts.Axis(plural, -0.6, len(x) - 0.4, ticks, named=True), borders[1:-1]
    title = f"{len(length_number)} lengths in {len(place_number)} placements, one after the other"
    return x, charts.Axis(title, -0.6, len(x) - 0.4, ()), np.zeros(0)


def length_chart(
    lengths: Sequence[Mapping[str, Any]],
    errors: Mapping[str, np.ndarray],
    table: ReportTable,
    id: str = "lengths",
) -> Chart:
    """Errors of reference lengths by one arm or two, the last with its expanded uncertainty.

    Args:
        lengths: Rows of a summary: "from", "to" and "expanded_mm".
        errors: Name of an arm -> measured minus calibrated value, mm.
        table: The numbers.
        id: Identifier of the chart.

    Returns:
        The chart.
    """
    between = [(row["from"], row["to"]) for row in lengths]
    x, axis, borders = by_placement(between)
    expanded = np.array([row["expanded_mm"] or np.nan for row in lengths])
    *earlier, (last, error) = errors.items()
    hover = [
        f"{start} – {end}: {format_number(value, signed=True)} mm"
        + (f", U {format_number(bar)} mm" if np.isfinite(bar) else "")
        for (start, end), value, bar in zip(between, error.tolist(), expanded.tolist(), strict=True)
    ]
    marks = [charts.Marks(name, x, values, "diamond", "accent") for name, values in earlier]
    says = f"{last}, with U (95 %)" if np.any(np.isfinite(expanded)) else last
    marks.append(charts.Marks(says, x, error, "square", "main", hover, error - expanded, error + expanded, size=7))
    y = charts.linear("measured − value [mm]", *errors.values(), error - expanded, error + expanded, [0.0])
    description = "Measured minus calibrated value" + (", before and after the scale fix." if earlier else ".")
    plot = charts.Plot(axis, y, tuple(marks), borders, [0.0])
    return Chart(id, "Errors of the reference lengths", description, (plot,), table)

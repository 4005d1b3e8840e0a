"""Figures of drift: changes of parameters and of lengths between two calibrations, or over the dates of several."""

import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.text import pluralise
from ..drift.results import Drift, Trend, in_words
from ..summaries.result_tables import listed_apart
from ..uncertainty.coverage import in_percent
from .charts import SERIES, Axis, Chart, Marks, Plot, histogram, linear, names
from .figures import check_format, draw, new_figure, save_figure

_CROWDED = 0.03  # calibrations nearer in time than this fraction of the whole are spaced evenly
_ROOM = 0.08  # of an axis, between two dates
_FAR = 8.0  # changes beyond so many expanded uncertainties need an axis that shortens what is far out
_RATIO = "change / expanded uncertainty"


def save_drift_trend(trend: Trend, path: Path) -> None:
    """Write the figure of `drift_trend` into a file.

    Args:
        trend: The comparison of two calibrations or more (`drift.trend`).
        path: The file to write, whole or not at all; its name ends in ``.png``, ``.svg`` or ``.pdf``.

    Example:
        >>> from pathlib import Path
        >>> trend = aj.drift.trend([record, record_in_june], ["2026-01-31", "2026-06-30"], points=20)
        >>> aj.plot.save_drift_trend(trend, Path("drift.svg"))
    """
    check_format(path)
    save_figure(drift_trend(trend)[0].figure, path)


def drift_trend(trend: Trend, axes: Any = None) -> Any:
    """Plot changes of the parameters over their expanded uncertainty and, below, the effect on lengths.

    Three calibrations or more are plotted over time; two parameter by parameter, with the lengths as a histogram.

    Args:
        trend: The comparison of two calibrations or more (`drift.trend`).
        axes: Two axes to plot into, which are returned; new ones if None.

    Example:
        >>> trend = aj.drift.trend([record, record_in_june], ["2026-01-31", "2026-06-30"], points=20)
        >>> changes, lengths = aj.plot.drift_trend(trend)
        >>> changes.figure.savefig("drift.svg")
    """
    if axes is None:
        axes = new_figure((8.2, 6.8)).subplots(2, 1, height_ratios=(1.9, 1))
    for plot, part in zip(trend_plots(trend), axes, strict=True):
        draw(plot, part)
    return axes


def trend_plots(trend: Trend) -> tuple[Plot, ...]:
    """Plots of the changes of the parameters and of lengths; without the lengths of two calibrations if these are not
    there one by one, as in a comparison that was read from a file."""
    if len(trend.drifts) == 1:
        (drift,) = trend.drifts
        plots = (_changes_of_two(drift), *([_lengths_of_two(drift)] if len(drift.lengths.change) else []))
    else:
        seconds = np.array([date.timestamp() for date in trend.dates])
        span, count = seconds[-1] - seconds[0], len(seconds)
        # By date unless they would overlap.
        even = span <= 0 or np.min(np.diff(seconds)) < _CROWDED * span
        positions = np.arange(count, dtype=float) if even else (seconds - seconds[0]) / span * (count - 1)
        by_file = trend.dated_by_file or (False,) * count
        form = _date_form(trend.dates)
        dates = [f"{date:{form}}{'*' if file else ''}" for date, file in zip(trend.dates, by_file, strict=True)]
        title = "calibration" + (", evenly spaced" if even else "")
        title += " (*: date of the file, because the manifest states no date)" if any(by_file) else ""
        ticks = tuple(zip(positions.tolist(), dates, strict=True))
        x = linear(title, positions, margin=0.03)._replace(ticks=ticks, named=True)
        # The dates stand below the lower axes alone.
        undated = x._replace(title="", ticks=tuple((at, "") for at, _ in x.ticks))
        plots = _changes_over_time(trend, undated, positions), _lengths_over_time(trend, x, positions)
    return plots


def _changes_over_time(trend: Trend, x: Axis, positions: np.ndarray) -> Plot:
    drift = trend.drifts[-1]
    ratio = np.divide(trend.change, trend.expanded, out=np.full_like(trend.change, np.nan), where=trend.expanded > 0)
    ratio[0] = 0.0
    last = np.abs(np.nan_to_num(ratio[-1]))
    named = [i for i in np.argsort(-last) if last[i] > 1][: len(SERIES)]
    others = [i for i in range(len(trend.names)) if i not in named]
    beyond = [(positions[k], ratio[k, i]) for i in others for k in np.flatnonzero(np.abs(ratio[:, i]) > 1)]
    at, over = np.array(beyond).reshape(-1, 2).T
    marks = [
        _within(x),
        *(Marks("", positions, ratio[:, i], "line", "soft", size=3) for i in others),
        Marks("", at, over, "ring", "soft", size=5),
    ]
    for i, style in zip(named, SERIES, strict=False):
        name = f"{trend.names[i]} {in_words(drift.units[i], float(drift.change[i]))}"
        marks.append(Marks(name, positions, ratio[:, i], joined=True, **style))
    title = (
        f"Change of {len(trend.names)} parameters from the first calibration; band: expanded uncertainty "
        f"({in_percent(drift.level)})\nnamed curves: parameters beyond the band at the last date (at most "
        f"{len(SERIES)}); open circles: other values beyond the band"
    )
    return Plot(x, _ratio_axis(ratio), tuple(marks), title + _not_shown(drift))


def _lengths_over_time(trend: Trend, x: Axis, positions: np.ndarray) -> Plot:
    """Change of lengths over the volume from the first calibration, and what the uncertainties alone predict; um."""
    lengths = [drift.lengths for drift in trend.drifts]
    rows = (
        ("largest", [abs(length.largest) for length in lengths], "triangle", "soft"),
        ("RMS", [length.rms for length in lengths], "square", "main"),
        ("RMS expected from the uncertainties alone", [length.rms_by_chance for length in lengths], "ring", "accent"),
    )
    marks = tuple(
        Marks(name, positions[1:], 1e3 * np.where(np.isfinite(values), values, np.nan), symbol, tone, joined=True)
        for name, values, symbol, tone in rows
    )
    y = linear(f"change of {lengths[0].length:g} mm\nlengths [um]", *(part.y for part in marks), zero=True)
    return Plot(x, y, marks)


def due_chart(trend: Trend, due: Mapping[str, Any] | None) -> Chart:
    """RMS change of lengths over all calibrations, and until the next one is due (``due`` of a summary); mm."""
    lengths, first = [drift.lengths for drift in trend.drifts], trend.dates[0]
    days = np.array([(date - first) / datetime.timedelta(days=1) for date in trend.dates])
    rms = np.array([0.0, *(length.rms for length in lengths)])
    chance = np.array([np.nan, *(length.rms_by_chance for length in lengths)])
    form = _date_form(trend.dates)
    words = [f"{date:{form}}: {value:.4f} mm" for date, value in zip(trend.dates, rms.tolist(), strict=True)]
    marks = [
        Marks("RMS change of lengths", days, rms, "square", "main", words, joined=True, size=7),
        Marks("expected from the uncertainties alone", days, chance, "ring", "soft"),
    ]
    labels = {float(day): f"{date:{form}}" for day, date in zip(days, trend.dates, strict=True)}
    if due:
        date = datetime.datetime.fromisoformat(due["date"])
        day = (date - first) / datetime.timedelta(days=1)
        rise = due["rate_mm_per_year"] / 365.25 * np.array([0.0, day])
        marks += [
            Marks("at the rate seen until now", [0.0, day], rise, "dashed", "accent"),
            Marks("next calibration due", [day], rise[1:], "diamond", "accent", [f"{date:%Y-%m-%d}: due"]),
        ]
        labels[day] = f"{date:%Y-%m-%d}"
    axis = linear("", [*labels], margin=0.1)  # so that the outermost dates have room
    # The last dates first, as many as have room.
    ticks: list[tuple[float, str]] = []
    for at, label in sorted(labels.items(), reverse=True):
        if not ticks or ticks[-1][0] - at > _ROOM * (axis.high - axis.low):
            ticks.append((at, label))
    axis = axis._replace(ticks=tuple(reversed(ticks)), named=True)
    y = linear("RMS change [mm]", *(part.y for part in marks), zero=True)
    says = f"Lengths of {lengths[0].length:g} mm over the working volume, by each calibration less the first."
    return Chart("due", "Drift of the arm", says, (Plot(axis, y, tuple(marks), height=260),))


def _date_form(dates: Sequence[datetime.datetime]) -> str:
    """Dates that are told apart: those of one day by their time."""
    return "%Y-%m-%d" if dates[-1] - dates[0] > datetime.timedelta(days=1) else "%m-%d %H:%M"


def _changes_of_two(drift: Drift) -> Plot:
    """Changes between two calibrations over their expanded uncertainty; those beyond it are filled, with their value.

    Of hundreds of coefficients of harmonics, those beyond it are drawn.
    """
    listed = {row["parameter"] for row in listed_apart([{"parameter": name} for name in drift.names])[0]}
    chosen = [
        i for i, name in enumerate(drift.names) if not drift.reasons[i] and (name in listed or bool(drift.moved[i]))
    ]
    change, expanded, moved = drift.change[chosen], drift.expanded[chosen], drift.moved[chosen]
    ratio, x = np.divide(change, expanded, out=np.full_like(change, np.nan), where=expanded > 0), np.arange(len(chosen))
    said = [f" {in_words(drift.units[i], float(drift.change[i]))}" if drift.moved[i] else "" for i in chosen]
    axis = names("", [drift.names[i] + words for i, words in zip(chosen, said, strict=True)])
    marks = (
        _within(axis),
        Marks("", x, ratio, "bars", low=np.minimum(ratio, 0), high=np.maximum(ratio, 0), size=2),
        Marks("", x[~moved], ratio[~moved], "ring", "ink", size=7),
        Marks("", x[moved], ratio[moved], "square", size=7),
    )
    title = (
        f"New minus old calibration: {int(moved.sum())} of {len(chosen)} parameters beyond the band (expanded "
        f"uncertainty of the change, {in_percent(drift.level)})"
    )
    return Plot(axis, _ratio_axis(ratio), marks, title + _not_shown(drift))


def _lengths_of_two(drift: Drift) -> Plot:
    lengths = drift.lengths
    counts, edges = np.histogram(1e3 * lengths.change, bins=40)
    marks = [histogram(counts, edges)]
    for name, rms, symbol, tone in (
        ("RMS expected from the uncertainties alone", lengths.rms_by_chance, "dashed", "accent"),
        ("RMS of the changes", lengths.rms, "line", "main"),
    ):
        if np.isfinite(rms):
            # From one side to the other, interrupted between them.
            x, height = 1e3 * rms * np.array([-1, -1, np.nan, 1, 1]), 1.1 * counts.max()
            marks.append(Marks(name, x, [0, height, np.nan, height, 0], symbol, tone))
    title = f"change of {lengths.length:g} mm lengths over the volume [um]"
    return Plot(linear(title, edges, *(part.x for part in marks)), linear("lengths", counts, zero=True), tuple(marks))


def _ratio_axis(ratio: np.ndarray) -> Axis:
    """The axis of changes over their expanded uncertainty: that of the inverse hyperbolic sine if any is far out."""
    largest = np.nanmax(np.abs(ratio), initial=1.0)
    axis = linear(_RATIO, ratio, [-1.0, 1.0], margin=0.1)
    if largest <= _FAR:
        return axis
    steps = (2, 5, 10, 20) if largest < 40 else (10, 100, 1000, 10_000, 100_000)
    ticks = [tick for tick in steps if tick < 2 * largest]
    values = [-tick for tick in reversed(ticks)] + [-1, 0, 1] + ticks
    low, high = (np.sinh(1.1 * np.arcsinh(end)) for end in (axis.low, axis.high))
    shown = tuple((float(at), f"{at:g}".replace("-", "−")) for at in values if low <= at <= high)
    return Axis(_RATIO, float(low), float(high), shown, "asinh")


def _within(x: Axis) -> Marks:
    return Marks("", [x.low, x.high], [0.0, 0.0], "band", "soft", low=[-1.0, -1.0], high=[1.0, 1.0])


def _not_shown(drift: Drift) -> str:
    without = len(drift.names) - drift.reasons.count("")
    return f";\nnot shown: {pluralise(without, 'change')} without an uncertainty" if without else ""

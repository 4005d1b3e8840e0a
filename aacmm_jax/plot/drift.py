"""Figures of drift: changes of parameters and of lengths between two calibrations, or over the dates of several."""

from pathlib import Path
from typing import Any

import numpy as np

from ..drift.results import Drift, Trend, in_words
from .style import ACCENT, COLORS, DARK, LINES, MARKERS, check_format, save_figure

_LIGHT = "0.72"
_NAMED = len(MARKERS)  # lines that remain distinct, each with its name
_CROWDED = 0.03  # calibrations nearer in time than this fraction of the whole are spaced evenly
_FAR = 8.0  # changes beyond so many expanded uncertainties need a logarithmic axis


def save_drift_trend(trend: Trend, path: Path) -> None:
    """Write the figure of `drift_trend` into a file.

    Args:
        trend: The comparison of two calibrations or more (`drift.trend`).
        path: The file to write, whole or not at all; its name ends in ``.png``, ``.svg`` or ``.pdf``.

    Raises:
        InputError: For another format, or if the file cannot be written.

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
        axes: Two axes to plot into; new ones if None.

    Returns:
        Both axes.

    Example:
        >>> trend = aj.drift.trend([record, record_in_june], ["2026-01-31", "2026-06-30"], points=20)
        >>> changes, lengths = aj.plot.drift_trend(trend)
        >>> changes.figure.savefig("drift.svg")
    """
    if axes is None:
        from matplotlib.figure import Figure

        axes = Figure(figsize=(8.2, 6.8), layout="constrained").subplots(2, 1, height_ratios=(1.9, 1))
    if len(trend.drifts) == 1:
        parameter_drift(trend.drifts[0], axes[0])
        length_drift(trend.drifts[0], axes[1])
    else:
        positions = _positions_in_time(trend, axes)
        parameter_trend(trend, axes[0], positions)
        length_trend(trend, axes[1], positions)
    return axes


def parameter_trend(trend: Trend, axes: Any, positions: np.ndarray | None = None) -> Any:
    """Plot each parameter's change from the first calibration over its expanded uncertainty.

    The parameters that are beyond it in the last calibration are named.

    Args:
        trend: The comparison of three calibrations or more (`drift.trend`).
        axes: Axes to plot into.
        positions: Abscissa of each calibration; evenly spaced if None.

    Returns:
        The axes.

    Example:
        >>> import matplotlib.pyplot as plt
        >>> dates = ["2026-01-31", "2026-06-30", "2026-12-31"]
        >>> trend = aj.drift.trend([record, record_in_june, record], dates, points=20)
        >>> axes = aj.plot.parameter_trend(trend, plt.subplots()[1])
        >>> print(axes.get_ylabel())
        change / expanded uncertainty
    """
    positions = np.arange(len(trend.dates)) if positions is None else positions
    ratio = _ratio(trend.change, trend.expanded)
    ratio[0] = 0.0
    last = np.abs(np.where(np.isnan(ratio[-1]), 0.0, ratio[-1]))
    named = [i for i in np.argsort(-last) if last[i] > 1][:_NAMED]
    _band(axes, np.nanmax(np.abs(ratio), initial=1.0))
    for i in range(len(trend.names)):
        if i not in named:
            axes.plot(positions, ratio[:, i], color=_LIGHT, linewidth=0.8, zorder=1)
            beyond = np.abs(ratio[:, i]) > 1
            open_circles = {"color": "white", "markeredgecolor": "0.45", "markersize": 4, "zorder": 2}
            axes.plot(positions[beyond], ratio[beyond, i], "o", **open_circles)
    drift, labels = trend.drifts[-1], []
    for i, color, line, marker in zip(named, COLORS, LINES, MARKERS, strict=False):
        style = {"color": color, "linestyle": line, "marker": marker, "markersize": 5, "linewidth": 1.5, "zorder": 3}
        axes.plot(positions, ratio[:, i], **style)
        labels.append((ratio[-1, i], f"{trend.names[i]} {in_words(drift.units[i], float(drift.change[i]))}", color))
    _label_ends(axes, labels, positions)
    _title_changes(
        axes,
        f"Change of {len(trend.names)} parameters from the first calibration; band: expanded uncertainty "
        f"({100 * drift.level:g} %)\nnamed: beyond the band at the end (at most {_NAMED}); "
        "open circles: other values beyond it",
        drift,
    )
    return axes


def length_trend(trend: Trend, axes: Any, positions: np.ndarray | None = None) -> Any:
    """Change of lengths over the volume from the first calibration, and what the uncertainties alone predict; um."""
    positions = np.arange(len(trend.dates)) if positions is None else positions
    lengths = [drift.lengths for drift in trend.drifts]
    by_chance = "RMS by the uncertainties alone"
    rows = (
        ([abs(length.largest) for length in lengths], "largest", {"color": "0.5", "marker": "^", "linestyle": ":"}),
        ([length.rms for length in lengths], "RMS", {"color": DARK, "marker": "s", "linestyle": "-"}),
        ([length.rms_by_chance for length in lengths], by_chance, {"color": ACCENT, "linestyle": "--"}),
    )
    for values, label, style in rows:
        finite = np.where(np.isfinite(values), 1e3 * np.asarray(values), np.nan)
        axes.plot(positions[1:], finite, label=label, markersize=5, **style)
    axes.set_xlim(*_limits(positions))
    axes.set_ylim(bottom=0)
    axes.set_ylabel(f"change of {lengths[0].length:g} mm\nlengths [um]")
    axes.grid(True, axis="y", alpha=0.3)
    axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), ncols=3, borderaxespad=0.1)
    return axes


def parameter_drift(drift: Drift, axes: Any) -> Any:
    """Changes between two calibrations over their expanded uncertainty; those beyond it are filled and named."""
    chosen = [i for i, reason in enumerate(drift.reasons) if not reason]
    ratio, moved = _ratio(drift.change, drift.expanded)[chosen], drift.moved[chosen]
    positions = np.arange(len(chosen))
    _band(axes, np.nanmax(np.abs(ratio), initial=1.0))
    axes.vlines(positions, 0, ratio, color=np.where(moved, DARK, _LIGHT), linewidth=1.2)
    axes.plot(positions[~moved], ratio[~moved], "o", color="white", markeredgecolor="0.35", markersize=6)
    axes.plot(positions[moved], ratio[moved], "s", color=DARK, markersize=6)
    crowded = np.any(np.diff(positions[moved]) < 3)
    for i in positions[moved]:
        up = ratio[i] > 0
        style = {"va": "bottom" if up else "top", "ha": "center", "rotation": 90 if crowded else 0, "fontsize": 8}
        text = in_words(drift.units[chosen[i]], float(drift.change[chosen[i]]))
        offset = {"xytext": (0, 7 if up else -7), "textcoords": "offset points"}
        axes.annotate(text, (i, ratio[i]), color=DARK, **offset, **style)
    style = {"rotation": 60, "ha": "right", "rotation_mode": "anchor", "fontsize": 8}
    axes.set_xticks(positions, [drift.names[i] for i in chosen], **style)
    axes.set_xlim(-0.8, max(len(chosen), 1) - 0.2)
    axes.margins(y=0.3 if crowded else 0.15)
    _title_changes(
        axes,
        f"New less old calibration: {int(moved.sum())} of {len(chosen)} parameters beyond the band, "
        f"their expanded uncertainty ({100 * drift.level:g} %)",
        drift,
    )
    return axes


def length_drift(drift: Drift, axes: Any) -> Any:
    """Histogram of the changes of lengths between two calibrations, and what the uncertainties alone predict."""
    lengths = drift.lengths
    axes.hist(1e3 * lengths.change, bins=40, color="0.8", edgecolor="0.45", linewidth=0.6)
    axes.axvline(0, color="0.3", linewidth=0.8)
    for rms, color, line, label in (
        (lengths.rms_by_chance, ACCENT, "--", "RMS by the uncertainties alone"),
        (lengths.rms, DARK, "-", "RMS found"),
    ):
        for side in (-1, 1) if np.isfinite(rms) else ():
            style = {"color": color, "linestyle": line, "linewidth": 1.5, "label": label if side > 0 else None}
            axes.axvline(1e3 * side * rms, **style)
    axes.set_xlabel(f"change of {lengths.length:g} mm lengths over the volume [um]")
    axes.set_ylabel("lengths")
    axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, borderaxespad=0.1)
    return axes


def _ratio(change: np.ndarray, expanded: np.ndarray) -> np.ndarray:
    """Changes over their expanded uncertainty; NaN without one."""
    return np.where(expanded > 0, change / np.where(expanded > 0, expanded, 1.0), np.nan)


def _title_changes(axes: Any, title: str, drift: Drift) -> None:
    without = len(drift.names) - drift.reasons.count("")
    note = f"\nnot shown: {without} without an uncertainty of change" if without else ""
    axes.set_ylabel("change / expanded uncertainty")
    axes.set_title(title + note, fontsize=9.5, loc="left")


def _positions_in_time(trend: Trend, axes: Any) -> np.ndarray:
    """Abscissas of the calibrations, by date unless they would overlap, in steps of one; sets the ticks of both."""
    seconds = np.array([date.timestamp() for date in trend.dates])
    span = seconds[-1] - seconds[0]
    even = span <= 0 or np.min(np.diff(seconds)) < _CROWDED * span
    count = len(seconds)
    positions = np.arange(count, dtype=float) if even else (seconds - seconds[0]) / span * (count - 1)
    date_format = "%Y-%m-%d" if span > 86400 else "%m-%d %H:%M"
    by_file = trend.dated_by_file or (False,) * count
    mark = "*" if any(by_file) and not all(by_file) else ""
    dates = [
        f"{date:{date_format}}{mark if of_file else ''}" for date, of_file in zip(trend.dates, by_file, strict=True)
    ]
    axes[0].set_xticks(positions, [])
    axes[1].set_xticks(positions, dates, rotation=45, ha="right", rotation_mode="anchor", fontsize=8)
    label = "calibration" + (", evenly spaced" if even else "")
    if any(by_file):
        label += f" ({mark}{': ' if mark else ''}when its file was made; the manifest states no date)"
    axes[1].set_xlabel(label)
    return positions


def _limits(positions: np.ndarray) -> tuple[float, float]:
    margin = 0.03 * (positions[-1] - positions[0])
    return float(positions[0] - margin), float(positions[-1] + margin)


def _band(axes: Any, largest: float) -> None:
    """The band of changes within their expanded uncertainty; the axis is logarithmic beyond it if any is far out."""
    if largest > _FAR:
        axes.set_yscale("symlog", linthresh=2, linscale=1.2)
        steps = (2, 5, 10, 20) if largest < 40 else (10, 100, 1000, 10_000, 100_000)
        ticks = [value for value in steps if value < 2 * largest]
        values = [-value for value in reversed(ticks)] + [-1, 0, 1] + ticks
        axes.set_yticks(values, [f"{value:g}" for value in values])
        axes.minorticks_off()
    axes.axhspan(-1, 1, color="0.92", zorder=0)
    axes.axhline(0, color="0.5", linewidth=0.8, zorder=0)
    for side in (-1, 1):
        axes.axhline(side, color="0.5", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)


def _label_ends(axes: Any, labels: list[tuple[float, str, str]], positions: np.ndarray) -> None:
    """Label the ends of lines at the right (value, text, color), moved apart where the labels would overlap."""
    axes.set_xlim(*_limits(positions))
    low, high = axes.get_ylim()
    transform = axes.transData + axes.transAxes.inverted()
    wanted = sorted((float(transform.transform((positions[-1], label[0]))[1]), *label) for label in labels)
    heights = np.array([height for height, *_ in wanted])
    least = 0.055
    for _ in range(200):
        tight = np.flatnonzero(np.diff(heights) < least - 1e-6)
        if not len(tight):
            break
        for i in tight:
            push = (least - (heights[i + 1] - heights[i])) / 2
            heights[i], heights[i + 1] = heights[i] - push, heights[i + 1] + push
    # From the middle of a label's left edge: from its centre, a steep line would cross the labels above and below.
    arrow = {"arrowstyle": "-", "color": "0.6", "linewidth": 0.7, "relpos": (0, 0.5), "shrinkA": 2, "shrinkB": 4}
    style = {"textcoords": "axes fraction", "fontsize": 8.5, "va": "center", "annotation_clip": False}
    for height, (_, value, text, color) in zip(heights, wanted, strict=True):
        axes.annotate(text, (positions[-1], value), xytext=(1.03, height), color=color, arrowprops=arrow, **style)
    axes.set_ylim(low, high)

"""Charts of drift (matplotlib, without its global state), readable in grey: changes over any number of calibrations."""

from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..drift.results import Drift, Trend, in_words
from ..files.whole_file import whole_file

FORMATS = ("png", "svg", "pdf")
_DARK, _LIGHT, _ACCENT = "#1b3a6b", "0.72", "#d95f02"
_LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (2, 1)), (0, (4, 1, 1, 1)))
_MARKERS = "os^Dv<>p"
_MOST = len(_MARKERS)  # lines that are told apart and named
_CROWDED = 0.03  # of the span of time: calibrations nearer than this are drawn one after the other, evenly
_FAR = 8.0  # changes beyond so many expanded uncertainties are drawn on a logarithmic axis


def check_format(path: Path) -> str:
    """The format that a figure's file name asks for, or `InputError` for another than PNG, SVG and PDF."""
    suffix = path.suffix.lower().removeprefix(".")
    if suffix not in FORMATS:
        raise InputError(f"{path} is no figure that can be drawn; end its name in .png, .svg or .pdf.")
    return suffix


def save_trend(table: Trend, path: Path) -> None:
    """Draw `trend` into a file, PNG, SVG or PDF by its name, whole or not at all."""
    suffix = check_format(path)
    panels = trend(table)
    with whole_file(path) as temporary:
        panels[0].figure.savefig(temporary, format=suffix, dpi=150)


def trend(table: Trend, axes: Any = None) -> Any:
    """Changes of the parameters over their expanded uncertainty and, below, the effect on lengths; returns both axes.

    Over time where there are three calibrations or more; of two, parameter by parameter, with the lengths as a histogram.
    """
    if axes is None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8.2, 6.8), layout="constrained")
        axes = figure.subplots(2, 1, height_ratios=(1.9, 1))
    if len(table.drifts) == 1:
        plot_parameters(table.drifts[0], axes[0])
        plot_length_changes(table.drifts[0], axes[1])
    else:
        places = _places(table, axes)
        plot_changes(table, axes[0], places)
        plot_lengths(table, axes[1], places)
    return axes


def plot_changes(table: Trend, axes: Any, places: np.ndarray | None = None) -> Any:
    """Every parameter's change from the first calibration over its expanded uncertainty; those beyond it at the end by name."""
    places = np.arange(len(table.dates)) if places is None else places
    ratio = np.where(table.expanded > 0, table.change / np.where(table.expanded > 0, table.expanded, 1.0), np.nan)
    ratio[0] = 0.0
    last = np.abs(np.where(np.isnan(ratio[-1]), 0.0, ratio[-1]))
    named = [i for i in np.argsort(-last) if last[i] > 1][:_MOST]
    _band(axes, np.nanmax(np.abs(ratio), initial=1.0))
    for i in range(len(table.names)):
        if i not in named:
            axes.plot(places, ratio[:, i], color=_LIGHT, linewidth=0.8, zorder=1)
            beyond = np.abs(ratio[:, i]) > 1
            axes.plot(places[beyond], ratio[beyond, i], "o", color="white", markeredgecolor="0.45", markersize=4, zorder=2)
    for rank, i in enumerate(named):
        axes.plot(
            places, ratio[:, i], color=_shade(rank), linestyle=_LINES[rank], marker=_MARKERS[rank], markersize=5, linewidth=1.5, zorder=3
        )  # fmt: skip
    texts = [f"{table.names[i]} {in_words(table.names[i], float(table.drifts[-1].change[i]))}" for i in named]
    _label_ends(
        axes, [(ratio[-1, i], text, _shade(rank)) for rank, (i, text) in enumerate(zip(named, texts, strict=True))], places
    )
    axes.set_ylabel("change / expanded uncertainty")
    drift = table.drifts[-1]
    axes.set_title(
        f"Change of {len(table.names)} parameters from the first calibration; band: expanded uncertainty ({100 * drift.level:g} %)\n"
        f"named: beyond the band at the end (at most {_MOST}); open circles: other values beyond it{_left_out(drift)}",
        fontsize=9.5, loc="left",
    )  # fmt: skip
    return axes


def plot_lengths(table: Trend, axes: Any, places: np.ndarray | None = None) -> Any:
    """Change of lengths over the volume from the first calibration, beside what the uncertainties alone would give; um."""
    places = np.arange(len(table.dates)) if places is None else places
    lengths = [drift.lengths for drift in table.drifts]
    rows = (
        ([abs(length.largest) for length in lengths], "largest", {"color": "0.5", "marker": "^", "linestyle": ":"}),
        ([length.rms for length in lengths], "RMS", {"color": _DARK, "marker": "s", "linestyle": "-"}),
        ([length.rms_by_chance for length in lengths], "RMS by the uncertainties alone", {"color": _ACCENT, "linestyle": "--"}),
    )
    for values, label, style in rows:
        shown = np.where(np.isfinite(values), 1e3 * np.asarray(values), np.nan)
        axes.plot(places[1:], shown, label=label, markersize=5, **style)
    axes.set_xlim(*_limits(places))
    axes.set_ylim(bottom=0)
    axes.set_ylabel(f"change of {lengths[0].length:g} mm\nlengths [um]")
    axes.grid(True, axis="y", alpha=0.3)
    axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), ncols=3, borderaxespad=0.1)
    return axes


def plot_parameters(drift: Drift, axes: Any) -> Any:
    """Of two calibrations: every parameter's change over its expanded uncertainty, those beyond it filled and by name."""
    chosen = [i for i, reason in enumerate(drift.reasons) if not reason]
    safe = np.where(drift.expanded > 0, drift.expanded, 1.0)
    ratio = np.where(drift.expanded > 0, drift.change / safe, np.nan)[chosen]
    places = np.arange(len(chosen))
    _band(axes, np.nanmax(np.abs(ratio), initial=1.0))
    moved = drift.moved[chosen]
    axes.vlines(places, 0, ratio, color=np.where(moved, _DARK, _LIGHT), linewidth=1.2)
    axes.plot(places[~moved], ratio[~moved], "o", color="white", markeredgecolor="0.35", markersize=6)
    axes.plot(places[moved], ratio[moved], "s", color=_DARK, markersize=6)
    crowded = np.any(np.diff(places[moved]) < 3)
    for place in places[moved]:
        text = in_words(drift.names[chosen[place]], float(drift.change[chosen[place]]))
        axes.annotate(
            text, (place, ratio[place]), xytext=(0, 7 if ratio[place] > 0 else -7), textcoords="offset points", fontsize=8, color=_DARK,
            ha="center", rotation=90 if crowded else 0, va="bottom" if ratio[place] > 0 else "top",
        )  # fmt: skip
    axes.set_xticks(places, [drift.names[i] for i in chosen], rotation=60, ha="right", rotation_mode="anchor", fontsize=8)
    axes.set_xlim(-0.8, max(len(chosen), 1) - 0.2)
    axes.margins(y=0.3 if crowded else 0.15)
    axes.set_ylabel("change / expanded uncertainty")
    axes.set_title(
        f"New less old calibration: {int(moved.sum())} of {len(chosen)} parameters beyond the band, their expanded uncertainty "
        f"({100 * drift.level:g} %){_left_out(drift)}",
        fontsize=9.5, loc="left",
    )  # fmt: skip
    return axes


def plot_length_changes(drift: Drift, axes: Any) -> Any:
    """Of two calibrations: how the changes of lengths over the volume are distributed, beside what the uncertainties alone would give."""
    lengths = drift.lengths
    axes.hist(1e3 * lengths.change, bins=40, color="0.8", edgecolor="0.45", linewidth=0.6)
    axes.axvline(0, color="0.3", linewidth=0.8)
    if np.isfinite(lengths.rms_by_chance):
        for side in (-1, 1):
            label = "RMS by the uncertainties alone" if side > 0 else None
            axes.axvline(1e3 * side * lengths.rms_by_chance, color=_ACCENT, linestyle="--", linewidth=1.5, label=label)
    for side in (-1, 1):
        axes.axvline(
            1e3 * side * lengths.rms, color=_DARK, linestyle="-", linewidth=1.5, label="RMS found" if side > 0 else None
        )
    axes.set_xlabel(f"change of {lengths.length:g} mm lengths over the volume [um]")
    axes.set_ylabel("lengths")
    axes.legend(frameon=False, fontsize=8, loc="upper right")
    return axes


def _left_out(drift: Drift) -> str:
    count = len(drift.names) - drift.compared
    return f"\nnot shown: {count} without an uncertainty of change" if count else ""


def _places(table: Trend, axes: Any) -> np.ndarray:
    """Where calibrations stand on both axes: at their dates, or evenly where some would lie on one another; and the ticks."""
    seconds = np.array([date.timestamp() for date in table.dates])
    span = seconds[-1] - seconds[0]
    even = span <= 0 or np.min(np.diff(seconds)) < _CROWDED * span
    places = np.arange(len(seconds), dtype=float) if even else (seconds - seconds[0]) / span * (len(seconds) - 1)
    form = "%Y-%m-%d" if span > 86400 else "%m-%d %H:%M"
    texts = [f"{date:{form}}" for date in table.dates]
    axes[0].set_xticks(places, [])
    axes[1].set_xticks(places, texts, rotation=45, ha="right", rotation_mode="anchor", fontsize=8)
    axes[1].set_xlabel("calibration" + (", evenly spaced" if even else ""))
    return places


def _limits(places: np.ndarray) -> tuple[float, float]:
    span = places[-1] - places[0]
    return float(places[0] - 0.03 * span), float(places[-1] + 0.03 * span)


def _band(axes: Any, most: float) -> None:
    """The band within which a change is no more than its expanded uncertainty; logarithmic beyond, where changes are far out."""
    if most > _FAR:
        axes.set_yscale("symlog", linthresh=2, linscale=1.2)
        steps = (2, 5, 10, 20) if most < 40 else (10, 100, 1000, 10_000, 100_000)
        ticks = [value for value in steps if value < 2 * most]
        values = [-value for value in reversed(ticks)] + [-1, 0, 1] + ticks
        axes.set_yticks(values, [f"{value:g}" for value in values])
        axes.minorticks_off()
    axes.axhspan(-1, 1, color="0.92", zorder=0)
    axes.axhline(0, color="0.5", linewidth=0.8, zorder=0)
    for side in (-1, 1):
        axes.axhline(side, color="0.5", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)


def _shade(rank: int) -> str:
    return ("#1b3a6b", "#d95f02", "#111111", "#1b7a5a", "#7a3b8f", "#555555", "#a33b3b", "#3a6fb0")[rank]


def _label_ends(axes: Any, labels: list[tuple[float, str, str]], places: np.ndarray) -> None:
    """Names at the right of the lines' ends, moved apart where they would lie on one another."""
    axes.set_xlim(*_limits(places))
    low, high = axes.get_ylim()
    transform = axes.transData + axes.transAxes.inverted()
    wanted = sorted((float(transform.transform((places[-1], value))[1]), value, text, color) for value, text, color in labels)
    heights = np.array([height for height, *_ in wanted])
    least = 0.055
    for _ in range(200):
        gaps = np.diff(heights)
        tight = np.flatnonzero(gaps < least - 1e-6)
        if not len(tight):
            break
        for i in tight:
            push = (least - (heights[i + 1] - heights[i])) / 2
            heights[i], heights[i + 1] = heights[i] - push, heights[i + 1] + push
    for height, (_, value, text, color) in zip(heights, wanted, strict=True):
        axes.annotate(
            text, (places[-1], value), xytext=(1.03, height), textcoords="axes fraction", fontsize=8.5, color=color, va="center",
            arrowprops={"arrowstyle": "-", "color": "0.6", "linewidth": 0.7, "shrinkA": 1, "shrinkB": 4}, annotation_clip=False,
        )  # fmt: skip
    axes.set_ylim(low, high)

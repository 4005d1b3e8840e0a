"""Figures of a Monte Carlo study; each takes its results."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..study.results import Results
from ..study.statistics import (
    METRICS,
    correlation,
    factor_title,
    level_text,
    level_title,
    metric_title,
    shown_unit,
)
from .style import ACCENT, COLORS, DARK, LINES, MARKERS, axes_or_new, label_axes, logarithmic, new_figure, save_figure

_WIDTHS = ("bounds.length_mm", "bounds.angle_deg")
_WIDE = 10  # characters of a level: longer ones do not fit beside each other
_SHIFTS = ("bounds.length_shift_mm", "bounds.angle_shift_deg")


def study_metric(results: Results, metric: str = "length_error", axes: Any = None) -> Any:
    """Plot one metric of a study against the factor with the most levels: median, 5th and 95th percentile of the
    converged trials, the other factors side by side.

    Args:
        results: The study.
        metric: Name of the metric, a key of `study.statistics.METRICS`.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If there is no such metric.

    Example:
        >>> axes = aj.plot.study_metric(results, "de_stage1")
        >>> print(axes.get_xlabel(), axes.get_ylabel())
        half-width of lengths [mm] DE before the scale fix [mm]
    """
    if metric not in METRICS:
        raise InputError(f"a study has no metric '{metric}'; choose one of {', '.join(METRICS)}.")
    axes = axes_or_new(axes)
    factors = results.study.factors
    along = max(factors, key=lambda name: len(factors[name])) if factors else None
    runs = {"": [0]} if along is None else _runs(results, along, most=len(MARKERS))
    positive, values = True, []
    for i, (words, cells) in enumerate(runs.items()):
        low, middle, high = _percentiles(results, metric, cells)
        x = np.array([0 if along is None else _index(results, cell)[along] for cell in cells])
        x = x + 0.6 * ((i + 0.5) / len(runs) - 0.5)  # side by side at each level
        style = {"fmt": MARKERS[i], "color": COLORS[i], "capsize": 3, "markersize": 5, "label": words or None}
        axes.errorbar(x, middle, yerr=[middle - low, high - middle], **style)
        positive &= bool(np.all(low[np.isfinite(low)] > 0))
        values.append(middle[np.isfinite(middle)])
    if positive and _spans_decades(list(np.concatenate(values)[:, None])):
        logarithmic(axes)
    axes.set_xticks(
        *([[0], ["all trials"]] if along is None else [range(len(factors[along])), _levels(results, along)])
    )
    label_axes(axes, "" if along is None else factor_title(along), metric_title(metric))
    if len(runs) > 1:
        axes.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return axes


def save_study_figures(results: Results, folder: Path) -> list[Path]:
    """Write every figure that the study's factors allow into a folder, as PNG.

    Args:
        results: The study.
        folder: The folder, made if there is none.

    Returns:
        The files written.

    Raises:
        InputError: If the folder or a file cannot be written.

    Example:
        >>> from pathlib import Path
        >>> written = aj.plot.save_study_figures(results, Path("figures"))
        >>> print(written[0].name)
        convergence.png
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{folder} cannot be made: {reason}; choose another folder.") from error
    written = []
    for name, figure in _possible_figures(results).items():
        written.append(folder / f"{name}.png")
        save_figure(figure(), written[-1])
    return written


def _possible_figures(results: Results) -> dict[str, Any]:
    """Functions that make the figures, by file name."""
    figures: dict[str, Any] = {"convergence": lambda: study_convergence(results)}
    if not any(np.any(results.column("converged", cell) == 1) for cell in range(len(results.study.cells))):
        return figures
    for names, prefix, plot in (
        (tuple(results.study.factors), "distributions", study_distributions),
        (_WIDTHS, "error_against", study_errors),
        (_SHIFTS, "k_against", study_scale),
    ):
        for factor in names:
            if factor in results.study.factors:
                name = f"{prefix}_{factor.replace('.', '_')}"
                figures[name] = lambda factor=factor, plot=plot: plot(results, factor)
    figures["correlation"] = lambda: study_correlation(results, 1)
    return figures


def study_distributions(
    results: Results, factor: str, metrics: Sequence[str] = ("de", "length_error", "angle_error")
) -> Any:
    """Plot how metrics are distributed at each level of a factor, over all other factors, as box plots.

    Args:
        results: The study.
        factor: Name of a varied factor.
        metrics: Names of the metrics, one panel each; those of stage 1 if the study has no scale fix.

    Returns:
        The figure.

    Example:
        >>> aj.plot.study_distributions(results, "bounds.length_mm").savefig("distributions.svg")
    """
    names = [name for name in (_available(results, metric) for metric in metrics) if name]
    figure, axes = _panels(1, len(names), (4.3 * len(names), 3.8))
    for panel, name in zip(axes[0], names, strict=True):
        values = [_values(results, name, cells) for cells in _cells_by_level(results, factor)]
        panel.boxplot(
            [v if len(v) else [np.nan] for v in values], whis=(5, 95), showfliers=False,
            tick_labels=_levels(results, factor), medianprops={"color": DARK, "linewidth": 1.8},
        )  # fmt: skip
        if max(len(label.get_text()) for label in panel.get_xticklabels()) > _WIDE:
            panel.tick_params(axis="x", labelrotation=20)
            for label in panel.get_xticklabels():
                label.set(ha="right", rotation_mode="anchor")
        _finish(panel, factor_title(factor), _title(name))
        if all(np.nanmin(v, initial=np.inf) > 0 for v in values) and _spans_decades(values):
            panel.set_yscale("log")
    others = [factor_title(name) for name in results.study.factors if name != factor]
    pooled = f"\ntrials pooled over all levels of: {', '.join(others)}" if others else ""
    figure.suptitle(f"boxes: quartiles and median; whiskers: 5 % and 95 %{pooled}", fontsize=9)
    return figure


def study_errors(results: Results, factor: str) -> Any:
    """Plot the largest length or angle error before and after the scale fix against a half-width of the bounds.

    Args:
        results: The study.
        factor: ``"bounds.length_mm"`` or ``"bounds.angle_deg"``, varied in the study.

    Returns:
        The figure, with medians and bands from the 5th to the 95th percentile.

    Example:
        >>> aj.plot.study_errors(results, "bounds.length_mm").savefig("errors.svg")
    """
    kind = "length_error" if "length" in factor else "angle_error"
    runs = _runs(results, factor, most=4)
    figure, axes = _panels(1, len(runs), (5 * len(runs), 3.9), sharey=True)
    for panel, (words, cells) in zip(axes[0], runs.items(), strict=True):
        x = [float(results.study.factors[factor][_index(results, cell)[factor]]) for cell in cells]
        # Angles are the same after the fix: the line before it is wide enough to be seen below the other.
        for name, color, label, marker, size in (
            (f"{kind}_stage1", ACCENT, "before the scale fix", "^", 12),
            (kind, DARK, "after", "s", 5),
        ):
            low, middle, high = _percentiles(results, name, cells)
            if np.any(np.isfinite(middle)):
                panel.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0)
                panel.plot(x, middle, color=color, marker=marker, label=label, markersize=size, linewidth=size / 3)
        panel.set_xscale("log")
        panel.set_xticks(x, [f"{value:g}" for value in x])
        panel.minorticks_off()
        logarithmic(panel)
        _finish(panel, factor_title(factor), _title(kind) if panel is axes[0, 0] else "", fill(words, 60))
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", frameon=False, ncols=2)
    return figure


def study_scale(results: Results, factor: str) -> Any:
    """Plot the error of the scale that stage 1 leaves (found / true - 1) against a shift of the bounds' centre.

    Args:
        results: The study.
        factor: ``"bounds.length_shift_mm"`` or ``"bounds.angle_shift_deg"``, varied in the study.

    Returns:
        The figure, with medians and bands from the 5th to the 95th percentile.

    Example:
        >>> aj.plot.study_scale(results, "bounds.length_shift_mm").savefig("scale.svg")
    """
    runs = _runs(results, factor, most=len(MARKERS))
    figure, axes = _panels(1, 1, (6.4, 4.2 + 0.16 * len(runs)))
    panel = axes[0, 0]
    for i, (words, cells) in enumerate(runs.items()):
        x = [float(results.study.factors[factor][_index(results, cell)[factor]]) for cell in cells]
        low, middle, high = (1e6 * (part - 1) for part in _percentiles(results, "scale", cells))
        if len(runs) <= 4:
            panel.fill_between(x, low, high, color=COLORS[i], alpha=0.12, linewidth=0)
        style = {"color": COLORS[i], "linestyle": LINES[i], "marker": MARKERS[i], "label": words or None}
        panel.plot(x, middle, **style)
    panel.axhline(0.0, color="0.4", linewidth=0.9, linestyle="--")
    _finish(panel, factor_title(factor), "error of the scale of stage 1 [parts in a million]")
    if len(runs) > 1:
        figure.legend(loc="outside upper center", frameon=False, fontsize=8)
    return figure


def study_correlation(results: Results, cell: int) -> Any:
    """Plot the correlations of the parameters' errors in one cell.

    Args:
        results: The study.
        cell: The cell, counted from 1.

    Returns:
        The figure.

    Raises:
        InputError: If the study has no such cell.

    Example:
        >>> aj.plot.study_correlation(results, cell=1).savefig("correlation.svg")
    """
    count = len(results.study.cells)
    if not 1 <= cell <= count:
        raise InputError(f"cell is {cell}; the study has cells 1 to {count}.")
    names = results.study.space.names
    figure, axes = _panels(1, 1, (6.8, 5.8))
    panel = axes[0, 0]
    image = panel.imshow(correlation(results, cell - 1), vmin=-1, vmax=1, cmap="RdBu_r")
    panel.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    panel.set_yticks(range(len(names)), names, fontsize=8)
    words = _cell_label(results, cell - 1)
    title = f"correlation of parameter errors, cell {cell}{': ' if words else ''}{words}"
    panel.set_title(fill(title, 70), fontsize=10)
    figure.colorbar(image, ax=panel, shrink=0.85)
    return figure


def study_convergence(results: Results) -> Any:
    """Plot the percentage of trials that converged over the two factors with the most levels, or along the only one.

    Args:
        results: The study.

    Returns:
        The figure.

    Example:
        >>> aj.plot.study_convergence(results).savefig("convergence.svg")
    """
    factors = sorted(results.study.factors, key=lambda name: -len(results.study.factors[name]))[:2]
    levels = [_levels(results, name) for name in factors] + [["all"]] * (2 - len(factors))
    total, good = np.zeros((2, len(levels[1]), len(levels[0])))
    for cell in range(len(results.study.cells)):
        index = _index(results, cell)
        at = (index[factors[1]] if len(factors) > 1 else 0, index[factors[0]] if factors else 0)
        converged = results.column("converged", cell)
        total[at] += np.sum(converged >= 0)
        good[at] += np.sum(converged == 1)
    percentage = np.divide(100 * good, total, out=np.full_like(good, np.nan), where=total > 0)
    least = min(float(np.nanmin(percentage, initial=100.0)), 99.0)
    darkest = 100 - 2.5 * (100 - least)  # so that the least that was found is a middle grey
    figure, axes = _panels(1, 1, (1.9 + 0.75 * max(len(levels[0]), 4), 1.9 + 0.5 * len(levels[1])))
    panel = axes[0, 0]
    panel.imshow(percentage, vmin=darkest, vmax=100, cmap="Greys_r", aspect="auto")
    for (row, column), value in np.ndenumerate(percentage):
        text = "-" if np.isnan(value) else f"{value:.0f}" if value in (0, 100) else f"{value:.1f}"
        color = "white" if value < (darkest + 100) / 2 else "black"
        panel.text(column, row, text, ha="center", va="center", fontsize=8, color=color)
    panel.set_xticks(range(len(levels[0])), levels[0])
    panel.set_yticks(range(len(levels[1])), levels[1])
    panel.set_xlabel(factor_title(factors[0]) if factors else "")
    panel.set_ylabel(fill(factor_title(factors[1]), 14 + 8 * len(levels[1])) if len(factors) > 1 else "")
    panel.set_title("trials that converged [%]", fontsize=10)
    return figure


def _panels(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Any, Any]:
    """A new figure, and its axes as an array."""
    figure = new_figure(size)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def _available(results: Results, metric: str) -> str | None:
    """The metric, or that of stage 1 where the study has no scale fix."""
    cells = range(len(results.study.cells))
    for name in (metric, f"{metric}_stage1"):
        if name in METRICS and any(len(_values(results, name, [cell])) for cell in cells):
            return name
    return None


def _values(results: Results, metric: str, cells: Sequence[int]) -> np.ndarray:
    """A metric of the converged trials of some cells; angles in arcseconds."""
    rows = [results.column(metric, cell)[results.column("converged", cell) == 1] for cell in cells]
    values = shown_unit(metric)[1] * np.concatenate(rows)
    return values[np.isfinite(values)]


def _percentiles(results: Results, metric: str, cells: Sequence[int]) -> np.ndarray:
    """5th, 50th and 95th percentile in each cell; NaN where no trial converged."""
    rows = [_values(results, metric, [cell]) for cell in cells]
    return np.array([np.percentile(row, (5, 50, 95)) if len(row) else [np.nan] * 3 for row in rows]).T


def _index(results: Results, cell: int) -> dict[str, int]:
    """Which level of every factor a cell has."""
    sizes = [len(levels) for levels in results.study.factors.values()]
    chosen = np.unravel_index(cell, sizes) if sizes else ()
    return {name: int(i) for name, i in zip(results.study.factors, chosen, strict=True)}


def _cells_by_level(results: Results, factor: str) -> list[list[int]]:
    cells = range(len(results.study.cells))
    index = [_index(results, cell)[factor] for cell in cells]
    return [[cell for cell in cells if index[cell] == i] for i in range(len(results.study.factors[factor]))]


def _runs(results: Results, factor: str, most: int) -> dict[str, list[int]]:
    """Runs of cells that differ in one factor only and in its order, by the levels of the other factors in words."""
    runs: dict[str, list[int]] = {}
    for cell in range(len(results.study.cells)):
        runs.setdefault(_cell_label(results, cell, without=factor), []).append(cell)
    for cells in runs.values():
        cells.sort(key=lambda cell: results.study.factors[factor][_index(results, cell)[factor]])
    if len(runs) > most:
        chosen = np.unique(np.linspace(0, len(runs) - 1, most).round().astype(int))
        runs = {words: cells for i, (words, cells) in enumerate(runs.items()) if i in chosen}
    return runs


def _cell_label(results: Results, cell: int, without: str = "") -> str:
    """The levels of a cell's factors in words."""
    factors, index = results.study.factors, _index(results, cell)
    return ", ".join(level_title(name, factors[name][i]) for name, i in index.items() if name != without)


def _levels(results: Results, factor: str) -> list[str]:
    return [level_text(level) for level in results.study.factors[factor]]


def _title(metric: str) -> str:
    return f"{METRICS[metric].removesuffix(' after the scale fix')} [{shown_unit(metric)[0] or '1'}]"


def _spans_decades(values: list[np.ndarray]) -> bool:
    """Whether medians differ more than tenfold."""
    medians = [np.median(v) for v in values if len(v)]
    return bool(medians and max(medians) > 10 * min(medians))


def _finish(panel: Any, x: str, y: str, title: str = "") -> None:
    panel.set(xlabel=x, ylabel=y)
    panel.set_title(title, fontsize=9)
    panel.grid(True, which="major", axis="y", alpha=0.3)

"""Figures of a Monte Carlo study; each takes its results."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..study.blocks import METRICS
from ..study.results import correlation
from ..study.store import Results
from ..study.tables import factor_title, level_text, level_title, metric_title, shown_unit
from ..summaries.tables import format_number
from .charts import SERIES, Marks, Plot, linear, logarithmic, names, thinned
from .figures import draw, draw_all, save_figure
from .parameters import correlation_plot

_MOST_PLOTS = 12  # of a metric, each with a combination of factors
_WIDE = 20  # times: positive values over a wider range need a logarithmic axis
_SCALE_ERROR = "error of the scale of stage 1 [parts per million]"
# A name, a metric, and the cells at each level of the factor, whose trials are pooled.
_Series = tuple[str, str, Sequence[Sequence[int]]]


def study_metric(results: Results, metric: str = "length_error", axes: Any = None) -> Any:
    """Plot one metric of a study against the factor with the most levels: median, 5th and 95th percentile of the
    converged trials, the other factors side by side.

    Args:
        results: The study.
        metric: Name of the metric, a key of `study.blocks.METRICS`.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.study_metric(results, "de_stage1").figure.savefig("figure.svg")
    """
    if metric not in METRICS:
        raise InputError(f"'{metric}' is not a metric of a study; choose one of {', '.join(METRICS)}.")
    return draw(metric_plots(results, metric, together=True)[0], axes)


def metric_plots(results: Results, metric: str, factor: str = "", *, together: bool = False) -> tuple[Plot, ...]:
    """A metric against a factor, by default that with the most levels: a plot for each combination of the levels of
    the others, or all ``together`` side by side."""
    factors = results.study.factors
    factor = factor or max(factors, key=lambda name: len(factors[name]), default="")
    if together:
        runs = _runs(results, factor, len(SERIES))
        panels = {"": [(words if len(runs) > 1 else "", metric, cells) for words, cells in runs.items()]}
    else:
        panels = {words: [("", metric, cells)] for words, cells in _runs(results, factor, _MOST_PLOTS).items()}
    return _plots(results, factor, panels)


def _plots(results: Results, factor: str, panels: Mapping[str, Sequence[_Series]]) -> tuple[Plot, ...]:
    """Plots by their titles, on the same axes: at each level of the factor the median of every series with a bar from
    the 5th to the 95th percentile, side by side."""
    levels = _levels(results, factor)
    metrics = {metric for series in panels.values() for _, metric, _ in series}
    title = _SCALE_ERROR if metrics == {"scale"} else metric_title(min(metrics, key=len))
    if len(metrics) > 1:  # before and after
        title = title.replace(" after the scale fix", "")
    marks: dict[str, list[Marks]] = {words: [] for words in panels}
    ends = np.zeros(0)
    for words, series in panels.items():
        for i, (name, quantity, cells) in enumerate(series):
            low, middle, high = _percentiles(results, quantity, cells, (5, 50, 95))
            said = [
                f"{level}: median {format_number(b)}, 5 % {format_number(a)}, 95 % {format_number(c)}"
                for level, a, b, c in zip(levels, low.tolist(), middle.tolist(), high.tolist(), strict=True)
            ]
            ends = np.concatenate([ends, low[np.isfinite(low)], high[np.isfinite(high)]])
            x = np.arange(len(levels)) + 0.6 * ((i + 0.5) / len(series) - 0.5)
            marks[words].append(Marks(name, x, middle, **SERIES[i], words=said, low=low, high=high))
    wide = len(ends) and ends.min() > 0 and ends.max() > _WIDE * ends.min()
    axes = names(factor_title(factor) if factor else "", levels), (logarithmic if wide else linear)(title, ends)
    height = 280 if len(panels) == 1 else 200
    return tuple(
        Plot(*axes, tuple(series), title=words[:1].upper() + words[1:], height=height)
        for words, series in marks.items()
    )


def save_study_figures(results: Results, folder: Path) -> list[Path]:
    """Write every figure that the study's factors allow into a folder, as PNG; returns the files.

    Args:
        results: The study.
        folder: The folder, made if there is none.

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
        raise InputError(f"the folder {folder} cannot be created: {reason}; choose another folder.") from error
    figures: dict[str, Callable[[], Any]] = {"convergence": lambda: study_convergence(results)}
    factors = results.study.factors
    if any(np.any(results.column("converged", cell) == 1) for cell in range(len(results.study.cells))):
        for chosen, prefix, plot in (
            (tuple(factors), "distributions", study_distributions),
            (("bounds.length_mm", "bounds.angle_deg"), "error_against", study_errors),
            (("bounds.length_shift_mm", "bounds.angle_shift_deg"), "k_against", study_scale),
        ):
            for factor in chosen:
                if factor in factors:
                    figures[f"{prefix}_{factor.replace('.', '_')}"] = partial(plot, results, factor)
        figures["correlation"] = lambda: study_correlation(results, 1)
    for name, figure in figures.items():
        save_figure(figure(), folder / f"{name}.png")
    return [folder / f"{name}.png" for name in figures]


def study_distributions(
    results: Results, factor: str, metrics: Sequence[str] = ("de", "length_error", "angle_error")
) -> Any:
    """Plot how metrics are distributed at each level of a factor, over all other factors: quartiles as boxes, medians
    as marks, and whiskers from the 5th to the 95th percentile; returns the figure.

    Args:
        results: The study.
        factor: Name of a varied factor.
        metrics: Names of the metrics, one panel each; those of stage 1 if the study has no scale fix.

    Example:
        >>> aj.plot.study_distributions(results, "bounds.length_mm").savefig("distributions.svg")
    """
    index, plots = _index(results)[factor], []
    cells = [np.flatnonzero(index == i).tolist() for i in range(len(results.study.factors[factor]))]
    for metric in metrics:
        for name in (metric, f"{metric}_stage1"):
            low, high = _percentiles(results, name, cells, (25, 75)) if name in METRICS else np.full((2, 1), np.nan)
            if np.any(np.isfinite(low)):
                (plot,) = _plots(results, factor, {"": [("", name, cells)]})
                box = Marks("", np.arange(len(cells)), low, "bars", low=low, high=high, size=16)
                plots.append(plot._replace(marks=(box, *plot.marks)))
                break
    figure = draw_all(plots, len(plots), (4.3, 4.4))
    others = [factor_title(name) for name in results.study.factors if name != factor]
    pooled = f"\ntrials pooled over all levels of: {', '.join(others)}" if others else ""
    figure.suptitle(f"boxes: quartiles and median; whiskers: 5 % and 95 %{pooled}", fontsize=9)
    return figure


def study_errors(results: Results, factor: str) -> Any:
    """Plot the largest length or angle error before and after the scale fix against a half-width of the bounds: medians
    and bars from the 5th to the 95th percentile; returns the figure.

    Args:
        results: The study.
        factor: ``"bounds.length_mm"`` or ``"bounds.angle_deg"``, varied in the study.

    Example:
        >>> aj.plot.study_errors(results, "bounds.length_mm").savefig("errors.svg")
    """
    kind = "length_error" if "length" in factor else "angle_error"
    stages = {"before the scale fix": f"{kind}_stage1", "after": kind}
    panels = {
        fill(words, 60): [(name, metric, cells) for name, metric in stages.items()]
        for words, cells in _runs(results, factor, most=4).items()
    }
    return draw_all(_plots(results, factor, panels), len(panels), (5, 3.9))


def study_scale(results: Results, factor: str) -> Any:
    """Plot the error of the scale that stage 1 leaves (found / true - 1) against a shift of the bounds' centre, as
    `study_errors` does.

    Args:
        results: The study.
        factor: ``"bounds.length_shift_mm"`` or ``"bounds.angle_shift_deg"``, varied in the study.

    Example:
        >>> aj.plot.study_scale(results, "bounds.length_shift_mm").savefig("scale.svg")
    """
    return draw_all(metric_plots(results, "scale", factor, together=True), 1, (6.4, 5.4))


def study_correlation(results: Results, cell: int) -> Any:
    """Plot the correlations of the parameters' errors in one cell: darker is stronger, with the sign written where it
    is at least 0.5; returns the figure.

    Args:
        results: The study.
        cell: The cell, counted from 1.

    Example:
        >>> aj.plot.study_correlation(results, cell=1).savefig("correlation.svg")
    """
    count = len(results.study.cells)
    if not 1 <= cell <= count:
        raise InputError(f"cell is {cell}; the study has cells 1 to {count}.")
    words = _cell_label(results, cell - 1)
    title = fill(f"correlation of parameter errors, cell {cell}{': ' if words else ''}{words}", 70)
    plot = correlation_plot(list(results.study.space.names), correlation(results, cell - 1), title)
    return draw_all([plot], 1, (6.8, 6.8))


def study_convergence(results: Results) -> Any:
    """Plot the percentage of trials that converged over the two factors with the most levels, or along the only one;
    returns the figure.

    Args:
        results: The study.

    Example:
        >>> aj.plot.study_convergence(results).savefig("convergence.svg")
    """
    factors = sorted(results.study.factors, key=lambda name: -len(results.study.factors[name]))
    factors = [*factors, "", ""][:2]
    levels, count = [_levels(results, name) for name in factors], len(results.study.cells)
    i, j = (_index(results).get(name, np.zeros(count, dtype=int)) for name in factors)
    total, good = np.zeros((2, len(levels[1]), len(levels[0])))
    for cell in range(count):
        converged = results.column("converged", cell)
        total[j[cell], i[cell]] += np.sum(converged >= 0)
        good[j[cell], i[cell]] += np.sum(converged == 1)
    percentage = np.divide(100 * good, total, out=np.full_like(good, np.nan), where=total > 0).ravel()
    y, x = (part.ravel() for part in np.indices(total.shape))
    # The least is a middle shade, on which its number can be read.
    failed = 100 - np.nan_to_num(percentage, nan=100.0)
    shade = np.rint(2 * failed / max(failed.max(), 1.0)).astype(int)
    marks = (
        Marks("", x, y, "boxes", shade=shade, box=(1.0, 1.0)),
        Marks("", x, y, "text", "ink", ["-" if np.isnan(p) else f"{p:.4g}" for p in percentage], size=8),
    )
    axes = []
    for name, labels in zip(factors, levels, strict=True):
        title = fill(factor_title(name) if name else "", 14 + 8 * len(labels))
        axes.append(names(title, labels)._replace(low=-0.5, high=len(labels) - 0.5))
    size = 1.9 + 0.75 * max(len(levels[0]), 4), 1.9 + 0.5 * len(levels[1])
    return draw_all([Plot(axes[0], axes[1], marks, title="trials that converged [%]")], 1, size)


def _percentiles(
    results: Results, metric: str, levels: Sequence[Sequence[int]], percentiles: Sequence[int]
) -> np.ndarray:
    """Percentiles over the converged trials of the cells at each level, in the unit in which the metric is drawn; NaN
    where there are none."""
    columns = []
    for cells in levels:
        values = np.concatenate([results.column(metric, c)[results.column("converged", c) == 1] for c in cells])
        values = 1e6 * (values - 1) if metric == "scale" else shown_unit(metric)[1] * values
        values = values[np.isfinite(values)]
        columns.append(np.percentile(values if len(values) else [np.nan], percentiles))
    return np.array(columns).T


def _index(results: Results) -> dict[str, np.ndarray]:
    """The number of the level of every factor in each cell."""
    factors = results.study.factors
    sizes = [len(levels) for levels in factors.values()]
    chosen = np.unravel_index(np.arange(len(results.study.cells)), sizes) if sizes else ()
    return dict(zip(factors, chosen, strict=True))


def _runs(results: Results, factor: str, most: int) -> dict[str, list[list[int]]]:
    """Runs of cells that differ in one factor only, in its order, by the levels of the other factors in words."""
    runs: dict[str, list[list[int]]] = {}
    for cell in range(len(results.study.cells)):
        runs.setdefault(_cell_label(results, cell, without=factor), []).append([cell])
    labels = list(runs)
    return {labels[i]: runs[labels[i]] for i in thinned(len(labels), most).tolist()}


def _cell_label(results: Results, cell: int, without: str = "") -> str:
    factors = results.study.factors
    levels = {name: factors[name][at[cell]] for name, at in _index(results).items() if name != without}
    return ", ".join(level_title(name, level) for name, level in levels.items())


def _levels(results: Results, factor: str) -> list[str]:
    return [level_text(level) for level in results.study.factors[factor]] if factor else ["all trials"]

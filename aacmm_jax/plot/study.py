"""Figures of a Monte Carlo study; each takes its results."""

from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..study.results import Results
from ..study.statistics import METRICS, correlation, factor_title, level_text, level_title, shown_unit
from ..summaries.tables import format_number
from .charts import SERIES, Marks, Plot, level, linear, logarithmic, names, ordinates
from .figures import draw, draw_all, save_figure
from .uncertainty import correlation_plot

_WIDTHS = ("bounds.length_mm", "bounds.angle_deg")
_SHIFTS = ("bounds.length_shift_mm", "bounds.angle_shift_deg")
_ENDS = (5, 50, 95)  # percentiles
_MOST_PLOTS = 12  # of a metric, each with a combination of factors
_WIDE = 20  # times: positive values over a wider range need a logarithmic axis


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
    return draw(metric_plots(results, metric, lambda cells: _percentiles(results, metric, cells), True)[0], axes)


def metric_plots(
    results: Results, metric: str, percentiles: Callable[[Sequence[int]], np.ndarray], together: bool = False
) -> tuple[Plot, ...]:
    """A metric against the factor with the most levels: medians of the converged trials, with bars from the 5th to the
    95th percentile, which ``percentiles`` gives of each cell; for each combination of the other factors a plot, or all
    ``together`` side by side."""
    factors, (unit, _) = results.study.factors, metric_unit(metric)
    along = max(factors, key=lambda name: len(factors[name])) if factors else None
    most = len(SERIES) if together else _MOST_PLOTS
    all_runs = {"": [0]} if along is None else _runs(results, along, most)
    groups = [all_runs] if together else [{words: cells} for words, cells in all_runs.items()]
    values = [[percentiles(cells) for cells in runs.values()] for runs in groups]
    every = np.concatenate([part.ravel() for parts in values for part in parts])
    every = every[np.isfinite(every)]
    wide = bool(len(every)) and every.min() > 0 and every.max() > _WIDE * every.min()
    y = (logarithmic if wide else linear)(METRICS[metric] + (f" [{unit}]" if unit else ""), every)
    x_axis = names("", ["all trials"]) if along is None else names(factor_title(along), _levels(results, along))
    plots = []
    for runs, parts in zip(groups, values, strict=True):
        marks = []
        for i, ((words, cells), ends) in enumerate(zip(runs.items(), parts, strict=True)):
            at = np.array([0 if along is None else _index(results, cell)[along] for cell in cells])
            x = at + 0.6 * ((i + 0.5) / len(runs) - 0.5)  # side by side at each level
            said = [
                f"cell {cell + 1}: median {format_number(b)} {unit}, 5 % {format_number(a)}, 95 % {format_number(c)}"
                for cell, (a, b, c) in zip(cells, ends.T.tolist(), strict=True)
            ]
            name = words if len(runs) > 1 else ""
            marks.append(Marks(name, x, ends[1], **SERIES[i], words=said, low=ends[0], high=ends[2]))
        title = "" if len(runs) > 1 else next(iter(runs))
        height = 280 if len(groups) == 1 else 200
        plots.append(Plot(x_axis, y, tuple(marks), title=title[:1].upper() + title[1:], height=height))
    return tuple(plots)


def metric_unit(metric: str) -> tuple[str, float]:
    """The unit in which a metric is drawn, and the factor to it."""
    return ("parts in a million", 1e6) if metric == "scale_error" else shown_unit(metric)


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
    figures: dict[str, Callable[[], Any]] = {"convergence": lambda: study_convergence(results)}
    factors = results.study.factors
    if any(np.any(results.column("converged", cell) == 1) for cell in range(len(results.study.cells))):
        for chosen, prefix, plot in (
            (tuple(factors), "distributions", study_distributions),
            (_WIDTHS, "error_against", study_errors),
            (_SHIFTS, "k_against", study_scale),
        ):
            figures |= {
                f"{prefix}_{factor.replace('.', '_')}": lambda factor=factor, plot=plot: plot(results, factor)
                for factor in chosen
                if factor in factors
            }
        figures["correlation"] = lambda: study_correlation(results, 1)
    for name, figure in figures.items():
        save_figure(figure(), folder / f"{name}.png")
    return [folder / f"{name}.png" for name in figures]


def study_distributions(
    results: Results, factor: str, metrics: Sequence[str] = ("de", "length_error", "angle_error")
) -> Any:
    """Plot how metrics are distributed at each level of a factor, over all other factors: quartiles as boxes, medians
    as marks, and whiskers from the 5th to the 95th percentile.

    Args:
        results: The study.
        factor: Name of a varied factor.
        metrics: Names of the metrics, one panel each; those of stage 1 if the study has no scale fix.

    Returns:
        The figure.

    Example:
        >>> aj.plot.study_distributions(results, "bounds.length_mm").savefig("distributions.svg")
    """
    index = [_index(results, cell)[factor] for cell in range(len(results.study.cells))]
    cells = [[cell for cell, at in enumerate(index) if at == i] for i in range(len(results.study.factors[factor]))]
    x, axis = np.arange(len(cells)), names(factor_title(factor), _levels(results, factor))
    plots = []
    for name in filter(None, (_available(results, metric) for metric in metrics)):
        low, q25, median, q75, high = np.array([_quantiles(_values(results, name, level_cells), (5, 25, 50, 75, 95))
                                                for level_cells in cells]).T  # fmt: skip
        marks = (
            Marks("", x, median, "bars", low=q25, high=q75, size=16),
            Marks("", x, median, "square", low=low, high=high, size=5),
        )
        wide = np.nanmin(low, initial=np.inf) > 0 and np.nanmax(median) > _WIDE / 2 * np.nanmin(median)
        plots.append(Plot(axis, (logarithmic if wide else linear)(_title(name), low, high), marks))
    figure = draw_all(plots, len(plots), (4.3, 3.8))
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
    x = _values_of_factor(results, factor, next(iter(runs.values())))
    # Angles are the same after the fix: the line before it is wide enough to be seen below the other.
    stages: dict[str, dict[str, Any]] = {
        f"{kind}_stage1": {"name": "before the scale fix", "tone": "accent", "symbol": "triangle", "size": 15},
        kind: {"name": "after", "tone": "main", "symbol": "square", "size": 6},
    }
    panels = {
        fill(words, 60): [
            part for name, style in stages.items() for part in _curve(x, _percentiles(results, name, cells), **style)
        ]
        for words, cells in runs.items()
    }
    y = logarithmic(_title(kind), *(ends for marks in panels.values() for ends in ordinates(marks)))
    x_axis = logarithmic(factor_title(factor), x)._replace(ticks=tuple((float(at), f"{at:g}") for at in x))
    plots = [Plot(x_axis, y, tuple(marks), title=words) for words, marks in panels.items()]
    return draw_all(plots, len(plots), (5, 3.9))


def _curve(x: np.ndarray, ends: np.ndarray, *, band: bool = True, **style: Any) -> list[Marks]:
    """Medians as joined points, with a band from the 5th to the 95th percentile; nothing where no trial converged."""
    low, middle, high = ends
    if not np.any(np.isfinite(middle)):
        return []
    curve = Marks(x=x, y=middle, joined=True, **style)
    return [Marks("", x, middle, "band", style["tone"], low=low, high=high), curve] if band else [curve]


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
    runs = _runs(results, factor, most=len(SERIES))
    marks = [level(0.0)]
    for style, (words, cells) in zip(SERIES, runs.items(), strict=False):
        ends, name = 1e6 * (_percentiles(results, "scale", cells) - 1), words if len(runs) > 1 else ""
        x = _values_of_factor(results, factor, cells)
        marks += _curve(x, ends, band=len(runs) <= 4, name=name, **style)
    x_axis = linear(factor_title(factor), *(part.x for part in marks))
    y = linear("error of the scale of stage 1 [parts in a million]", *ordinates(marks))
    return draw_all([Plot(x_axis, y, tuple(marks))], 1, (6.4, 4.2 + 0.16 * len(runs)))


def study_correlation(results: Results, cell: int) -> Any:
    """Plot the correlations of the parameters' errors in one cell: darker is stronger, with the sign written where it
    is at least 0.5.

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
    words = _cell_label(results, cell - 1)
    title = fill(f"correlation of parameter errors, cell {cell}{': ' if words else ''}{words}", 70)
    plot = correlation_plot(list(results.study.space.names), correlation(results, cell - 1), title)
    return draw_all([plot], 1, (6.8, 6.8))


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
    percentage = np.divide(100 * good, total, out=np.full_like(good, np.nan), where=total > 0).ravel()
    y, x = (part.ravel() for part in np.indices(total.shape))
    # The least is a middle shade, on which its number can be read.
    failed = 100 - np.nan_to_num(percentage, nan=100.0)
    shade = np.rint(2 * failed / max(failed.max(), 1.0)).astype(int)
    words = ["-" if np.isnan(p) else f"{p:.0f}" if p in (0, 100) else f"{p:.1f}" for p in percentage]
    marks = (
        Marks("", x, y, "boxes", shade=shade, box=(1.0, 1.0)),
        Marks("", x, y, "text", "ink", words, size=8),
    )
    titles = (
        factor_title(factors[0]) if factors else "",
        fill(factor_title(factors[1]), 14 + 8 * len(levels[1])) if len(factors) > 1 else "",
    )
    x_axis, y_axis = (
        names(title, labels)._replace(low=-0.5, high=len(labels) - 0.5)
        for title, labels in zip(titles, levels, strict=True)
    )
    size = 1.9 + 0.75 * max(len(levels[0]), 4), 1.9 + 0.5 * len(levels[1])
    return draw_all([Plot(x_axis, y_axis, marks, title="trials that converged [%]")], 1, size)


def _available(results: Results, metric: str) -> str | None:
    """The metric, or that of stage 1 where the study has no scale fix."""
    cells = range(len(results.study.cells))
    for name in (metric, f"{metric}_stage1"):
        if name in METRICS and any(len(_values(results, name, [cell])) for cell in cells):
            return name
    return None


def _values(results: Results, metric: str, cells: Sequence[int]) -> np.ndarray:
    """A metric of the converged trials of some cells, in the unit in which it is drawn."""
    rows = [results.column(metric, cell)[results.column("converged", cell) == 1] for cell in cells]
    values = metric_unit(metric)[1] * np.concatenate(rows)
    return values[np.isfinite(values)]


def _quantiles(values: np.ndarray, percentiles: Sequence[int]) -> np.ndarray:
    return np.percentile(values, percentiles) if len(values) else np.full(len(percentiles), np.nan)


def _percentiles(results: Results, metric: str, cells: Sequence[int]) -> np.ndarray:
    """5th, 50th and 95th percentile in each cell; NaN where no trial converged."""
    return np.array([_quantiles(_values(results, metric, [cell]), _ENDS) for cell in cells]).T


def _index(results: Results, cell: int) -> dict[str, int]:
    """Which level of every factor a cell has."""
    sizes = [len(levels) for levels in results.study.factors.values()]
    chosen = np.unravel_index(cell, sizes) if sizes else ()
    return {name: int(i) for name, i in zip(results.study.factors, chosen, strict=True)}


def _values_of_factor(results: Results, factor: str, cells: Sequence[int]) -> np.ndarray:
    levels = results.study.factors[factor]
    return np.array([float(levels[_index(results, cell)[factor]]) for cell in cells])


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
    return f"{METRICS[metric].removesuffix(' after the scale fix')} [{metric_unit(metric)[0] or '1'}]"

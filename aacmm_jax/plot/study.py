"""Figures of a study (matplotlib), readable in grey; each takes the results and returns a matplotlib figure."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..files.whole_file import whole_file
from ..study.results import Results
from ..study.specification import unit
from ..study.statistics import METRICS, correlation

_BEFORE, _AFTER = "#d95f02", "#1b3a6b"
_UNITS = {"de": "mm", "deltam": "mm", "length_error": "mm", "angle_error": "arcsec"}
_ARCSEC = 3600 * 180 / np.pi
_WIDTHS = ("bounds.length_mm", "bounds.angle_deg")
_SHIFTS = ("bounds.length_shift_mm", "bounds.angle_shift_deg")


def write_figures(results: Results, folder: Path) -> list[Path]:
    """Every figure that the study's factors give sense to, as PNG in a folder; the paths written."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder} cannot be made: {(error.strerror or str(error)).lower()}; choose another folder."
        ) from error
    factors, made = results.study.factors, {}
    converged = any(np.any(results.column("converged", cell) == 1) for cell in range(len(results.study.cells)))
    made["convergence"] = lambda: convergence_map(results)
    if not converged:
        factors = {}
    for factor in factors:
        made[f"distributions_{factor.replace('.', '_')}"] = lambda factor=factor: distributions(results, factor)
    for factor in _WIDTHS:
        if factor in factors:
            made[f"error_against_{factor.replace('.', '_')}"] = lambda factor=factor: errors_against(results, factor)
    for factor in _SHIFTS:
        if factor in factors:
            made[f"k_against_{factor.replace('.', '_')}"] = lambda factor=factor: scale_against(results, factor)
    if converged:
        made["correlation"] = lambda: correlations(results, 1)
    written = []
    for name, draw in made.items():
        figure = draw()
        with whole_file(folder / f"{name}.png") as temporary:
            figure.savefig(temporary, format="png", dpi=150)
        pyplot.close(figure)
        written.append(folder / f"{name}.png")
    return written


def distributions(results: Results, factor: str, figures: Sequence[str] = ("de", "length_error", "angle_error")) -> Any:
    """How figures are distributed at each level of a factor, over all other factors: median, quartiles, 5 and 95 %."""
    from matplotlib import pyplot

    levels = _levels(results, factor)
    shown = [name for name in map(lambda name: _there(results, name), figures) if name]
    drawing, axes = pyplot.subplots(1, len(shown), figsize=(4.3 * len(shown), 3.8), layout="constrained", squeeze=False)
    for panel, name in zip(axes[0], shown, strict=True):
        values = [_values(results, name, cells) for cells in _cells_by(results, factor)]
        panel.boxplot(
            [v if len(v) else [np.nan] for v in values], whis=(5, 95), showfliers=False, tick_labels=levels,
            medianprops={"color": _AFTER, "linewidth": 1.8},
        )  # fmt: skip
        _finish(panel, _axis(factor), _title(name))
        if all(np.nanmin(v, initial=np.inf) > 0 for v in values) and _spans(values):
            panel.set_yscale("log")
    drawing.suptitle("boxes: quartiles and median; whiskers: 5 % and 95 %", fontsize=9)
    return drawing


def errors_against(results: Results, factor: str) -> Any:
    """Largest length error (or angle error) before and after the scale fix against a half-width of the box: median, 5 to 95 %."""
    from matplotlib import pyplot

    kind = "length_error" if "length" in factor else "angle_error"
    others = _others(results, factor, most=4)
    drawing, axes = pyplot.subplots(
        1, len(others), figsize=(5 * len(others), 3.9), layout="constrained", squeeze=False, sharey=True
    )
    for panel, (words, cells) in zip(axes[0], others.items(), strict=True):
        x = [float(results.study.factors[factor][_index(results, cell)[factor]]) for cell in cells]
        for name, color, text, marker in (
            (f"{kind}_stage1", _BEFORE, "before the scale fix", "^"),
            (kind, _AFTER, "after", "s"),
        ):
            rows = [_values(results, name, [cell]) for cell in cells]
            if any(len(row) for row in rows):
                low, middle, high = np.array([np.percentile(row, (5, 50, 95)) if len(row) else [np.nan] * 3 for row in rows]).T
                panel.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0)
                panel.plot(x, middle, color=color, marker=marker, label=text)
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_xticks(x, [f"{value:g}" for value in x])
        panel.minorticks_off()
        _finish(panel, _axis(factor), _title(kind) if panel is axes[0, 0] else "", words)
    axes[0, 0].legend(frameon=False)
    return drawing


def scale_against(results: Results, factor: str) -> Any:
    """The scale that stage 1 leaves (found / true) against a shift of the box's centre: median, 5 to 95 %."""
    from matplotlib import pyplot

    drawing, panel = pyplot.subplots(figsize=(6, 4.2), layout="constrained")
    others = _others(results, factor, most=10)
    for i, (words, cells) in enumerate(others.items()):
        x = [float(results.study.factors[factor][_index(results, cell)[factor]]) for cell in cells]
        rows = [_values(results, "scale", [cell]) for cell in cells]
        low, middle, high = np.array([np.percentile(row, (5, 50, 95)) if len(row) else [np.nan] * 3 for row in rows]).T
        shade = str(0.65 * i / max(len(others) - 1, 1))
        if len(others) <= 4:
            panel.fill_between(x, low, high, color=shade, alpha=0.12, linewidth=0)
        panel.plot(x, middle, color=shade, marker="os^Dv<>p*h"[i % 10], label=words or None)
    panel.axhline(1.0, color=_BEFORE, linewidth=0.9, linestyle="--")
    _finish(panel, _axis(factor), "scale of stage 1, found / true")
    if len(others) > 1:
        panel.legend(frameon=False, fontsize=8)
    return drawing


def correlations(results: Results, cell: int) -> Any:
    """Correlation of the errors of all parameters in one cell (counted from 1)."""
    from matplotlib import pyplot

    names = results.study.space.names
    drawing, panel = pyplot.subplots(figsize=(6.8, 5.8), layout="constrained")
    image = panel.imshow(correlation(results, cell - 1), vmin=-1, vmax=1, cmap="RdBu_r")
    panel.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    panel.set_yticks(range(len(names)), names, fontsize=8)
    panel.set_title(f"correlation of parameter errors, cell {cell}{_words_of(results, cell - 1)}", fontsize=10)
    drawing.colorbar(image, ax=panel, shrink=0.85)
    return drawing


def convergence_map(results: Results) -> Any:
    """Share of trials that converged: over the two factors with the most levels, or along the only one."""
    from matplotlib import pyplot

    factors = sorted(results.study.factors, key=lambda name: -len(results.study.factors[name]))[:2]
    levels = [_levels(results, name) for name in factors] + [["all"]] * (2 - len(factors))
    total, good = np.zeros((2, len(levels[1]), len(levels[0])))
    for cell in range(len(results.study.cells)):
        index = _index(results, cell)
        place = (index[factors[1]] if len(factors) > 1 else 0, index[factors[0]] if factors else 0)
        converged = results.column("converged", cell)
        total[place] += np.sum(converged >= 0)
        good[place] += np.sum(converged == 1)
    share = np.divide(100 * good, total, out=np.full_like(good, np.nan), where=total > 0)
    size = (1.6 + 0.75 * max(len(levels[0]), 4), 1.7 + 0.45 * len(levels[1]))
    drawing, panel = pyplot.subplots(figsize=size, layout="constrained")
    panel.imshow(share, vmin=0, vmax=100, cmap="Greys_r", aspect="auto")
    for (row, column), value in np.ndenumerate(share):
        text = "-" if np.isnan(value) else f"{value:.0f}" if value in (0, 100) else f"{value:.1f}"
        panel.text(column, row, text, ha="center", va="center", fontsize=8, color="white" if value < 50 else "black")
    panel.set_xticks(range(len(levels[0])), levels[0])
    panel.set_yticks(range(len(levels[1])), levels[1])
    panel.set_xlabel(_axis(factors[0]) if factors else "")
    panel.set_ylabel(_axis(factors[1]) if len(factors) > 1 else "")
    panel.set_title("trials that converged [%]", fontsize=10)
    return drawing


def _there(results: Results, name: str) -> str | None:
    """The figure, or what stands for it where the study has no scale fix."""
    for candidate in (name, f"{name}_stage1"):
        if candidate in METRICS and any(len(_values(results, candidate, [cell])) for cell in range(len(results.study.cells))):
            return candidate
    return None


def _values(results: Results, name: str, cells: Sequence[int]) -> np.ndarray:
    """A figure of the converged trials of some cells; angles in arcseconds."""
    factor = _ARCSEC if name.startswith("angle") else 1.0
    rows = [results.column(name, cell)[results.column("converged", cell) == 1] for cell in cells]
    values = factor * np.concatenate(rows)
    return values[np.isfinite(values)]


def _index(results: Results, cell: int) -> dict[str, int]:
    """Which level of every factor a cell has."""
    sizes = [len(levels) for levels in results.study.factors.values()]
    chosen = np.unravel_index(cell, sizes) if sizes else ()
    return {name: int(i) for name, i in zip(results.study.factors, chosen, strict=True)}


def _cells_by(results: Results, factor: str) -> list[list[int]]:
    cells = range(len(results.study.cells))
    index = [_index(results, cell)[factor] for cell in cells]
    return [[cell for cell in cells if index[cell] == i] for i in range(len(results.study.factors[factor]))]


def _others(results: Results, factor: str, most: int) -> dict[str, list[int]]:
    """Runs of cells that differ in one factor only, by the levels of the others in words; in order of the factor."""
    runs: dict[str, list[int]] = {}
    for cell in range(len(results.study.cells)):
        runs.setdefault(_words_of(results, cell, without=factor), []).append(cell)
    for cells in runs.values():
        cells.sort(key=lambda cell: results.study.factors[factor][_index(results, cell)[factor]])
    if len(runs) > most:
        chosen = np.unique(np.linspace(0, len(runs) - 1, most).round().astype(int))
        runs = {words: cells for i, (words, cells) in enumerate(runs.items()) if i in chosen}
    return runs


def _words_of(results: Results, cell: int, without: str = "") -> str:
    factors, index = results.study.factors, _index(results, cell)
    words = [_with_unit(_axis(name), _text(factors[name][i])) for name, i in index.items() if name != without]
    return (": " if not without and words else "") + ", ".join(words)


def _with_unit(axis: str, level: str) -> str:
    name, _, measure = axis.partition(" [")
    return f"{name} {level}" + (f" {measure[:-1]}" if measure else "")


def _levels(results: Results, factor: str) -> list[str]:
    return [_text(level) for level in results.study.factors[factor]]


def _text(level: float | str) -> str:
    return level if isinstance(level, str) else f"{level:g}"


def _axis(factor: str) -> str:
    known = {
        "bounds.length_mm": "half-width of lengths [mm]",
        "bounds.angle_deg": "half-width of angles [deg]",
        "bounds.length_shift_mm": "shift of the centre, lengths [mm]",
        "bounds.angle_shift_deg": "shift of the centre, angles [deg]",
        "identification.hold": "held length",
        "identification.method": "method",
        "capture.poses": "poses in a socket",
        "capture.sockets": "sockets",
        "reference.positions": "positions of the reference length",
    }
    if factor in known:
        return known[factor]
    table, _, name = factor.partition(".")
    words = name.removesuffix(f"_{unit(factor)}").replace("_", " ")
    prefix = {"reference": "reference ", "deviation": "deviation of "}.get(table, "")
    return prefix + words + (f" [{unit(factor)}]" if unit(factor) != "1" else "")


def _title(name: str) -> str:
    measure = _UNITS.get(name.removesuffix("_stage1"), "1")
    return f"{METRICS[name].removesuffix(' after the scale fix')} [{measure}]"


def _spans(values: list[np.ndarray]) -> bool:
    """Whether medians differ more than tenfold."""
    medians = [np.median(v) for v in values if len(v)]
    return bool(medians) and max(medians) > 10 * min(medians)


def _finish(panel: Any, x: str, y: str, title: str = "") -> None:
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    panel.set_title(title, fontsize=9)
    panel.grid(True, which="major", axis="y", alpha=0.3)

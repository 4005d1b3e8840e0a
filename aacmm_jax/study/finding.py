"""What a study found, in a sentence: how far each factor that it varies changes the errors."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .tables import factor_title, level_text, level_title, shown_unit

_METRICS = {  # the first that a study has, and what people call it
    "length_error": "length errors",
    "angle_error": "angle errors",
    "de": "distances from the centroid",
    "length_error_stage1": "length errors of stage 1",
    "de_stage1": "distances from the centroid in stage 1",
}
_ALIKE = 0.1  # relative difference of medians up to which levels are said to make no difference
_CERTAIN = 2.0  # Monte Carlo standard errors up to which a difference may be chance
_MOST = 3  # factors


class _Effect(NamedTuple):
    """A factor with its levels in order, and the median error at each, over that at the best level."""

    name: str
    levels: Sequence[float | str]
    ratios: np.ndarray


def finding(summary: Mapping[str, Any]) -> str:
    """The sentence; empty while no trial has converged. ``summary`` is that of `study_summary` for all cells."""
    cells = summary["results"]
    metric = next((name for name in _METRICS if all(name in cell["figures"] for cell in cells)), None)
    if metric is None:
        return ""
    unit, factor = shown_unit(metric)
    values = np.array([max(factor * cell["figures"][metric]["p50"]["value"], 1e-300) for cell in cells])
    errors = np.array([factor * (cell["figures"][metric]["p50"]["se"] or 0.0) for cell in cells])
    if len(cells) == 1:
        high = factor * cells[0]["figures"][metric]["p95"]["value"]
        return f"The {_METRICS[metric]} have a median of {values[0]:.2g} {unit}; 95 % are below {high:.2g} {unit}."
    varied = [name for name, levels in summary["factors"].items() if len(levels) > 1]
    effects = [_effect(name, summary["factors"], cells, values, errors) for name in varied]
    effects = sorted(effects, key=lambda effect: -effect.ratios.max())
    large = [effect for effect in effects if effect.ratios.max() > 1 + _ALIKE]
    what = _METRICS[metric]
    if not large:
        names = " or ".join(factor_title(name).partition(" [")[0] for name in varied)
        return f"No level of {names} changes the {what} by more than {100 * _ALIKE:.0f} %."
    sentences = [_in_words(effect, what) for effect in large[:_MOST]]
    means = " (means over the other factors)" if len(varied) > 1 else ""
    return " ".join(f"{sentence[:1].upper()}{sentence[1:]}{means}." for sentence in sentences)


def _effect(
    name: str,
    factors: Mapping[str, Sequence[float | str]],
    cells: Sequence[Mapping[str, Any]],
    values: np.ndarray,
    errors: np.ndarray,
) -> _Effect:
    """The geometric mean over the cells of each level; a difference within Monte Carlo errors counts as none."""
    levels = list(factors[name])
    if not any(isinstance(level, str) for level in levels):
        levels = sorted(levels)
    of_level = [np.array([cell["factors"][name] == level for cell in cells]) for level in levels]
    logs = np.array([np.log(values[mask]).mean() for mask in of_level])
    relative = [np.sqrt(np.mean((errors / values)[mask] ** 2) / mask.sum()) for mask in of_level]
    best = int(np.argmin(logs))
    chance = _CERTAIN * np.hypot(relative, relative[best])
    return _Effect(name, levels, np.where(logs - logs[best] > chance, np.exp(logs - logs[best]), 1.0))


def _in_words(effect: _Effect, what: str) -> str:
    """The largest effect of a factor, and from which level on it has none."""
    worst, alike = int(np.argmax(effect.ratios)), effect.ratios <= 1 + _ALIKE
    ratio, levels, unit = effect.ratios[worst], effect.levels, factor_title(effect.name).partition(" [")[2][:-1]
    times = f"{ratio:.2g}" if ratio < 10 else f"{ratio:.0f}"
    says = f"{level_title(effect.name, levels[worst])} makes {what} {times} times as large"
    from_there, up_to_there = (
        int(alike[::-1].argmin()),
        int(alike.argmin()),
    )  # how many levels at either end make no difference
    if worst == 0 and from_there > 1 and not isinstance(levels[0], str):
        return f"{says}; from {level_text(levels[len(levels) - from_there])} {unit} on, it makes no difference"
    if worst == len(levels) - 1 and up_to_there > 1 and not isinstance(levels[0], str):
        return f"{says}; up to {level_text(levels[up_to_there - 1])} {unit}, it makes no difference"
    return f"{says} as with {level_text(levels[int(np.argmin(effect.ratios))])} {unit}".rstrip()

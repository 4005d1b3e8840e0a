"""Results of a study as people use them: labelled arrays, and statistics of each cell with Monte Carlo standard errors.

Trials of a cell fall into groups that are independent of each other: each draws from its own part of the pose pool.
Standard errors come from the scatter between groups, so they contain the whole Monte Carlo error, that of the finite
pools included, and need no formula for the statistic: one group at a time is left out (delete-a-group jackknife).
"""

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import require
from ..files.hdf5 import undamaged
from ..kinematics.arm import parameter_unit
from ..solver.reason import Reason, numbers_of
from .blocks import DIMENSIONS, METRICS, VARIABLES
from .definition import POOL_PARTS
from .finding import finding
from .store import Results, factor_columns

if TYPE_CHECKING:
    import xarray

PERCENTILES = (5, 50, 95)
_REASONS = ("gradient", "step", "rounding", "max_steps", "stalled", "nonfinite")


def open_study(path: str | os.PathLike) -> "xarray.Dataset":
    """Open the results of a study as an xarray dataset: lazily, or whole where they are in blocks, as while it runs.

    Args:
        path: File of the study (HDF5).

    Returns:
        Variables ``(cell, trial)`` and ``(cell, trial, parameter)`` with the names, units and long names of the file;
        mm and rad. Cells carry the levels of the study's factors: of one factor as the dimension itself, of several as
        a MultiIndex, so that ``data.sel(bounds_length_mm=5)`` picks cells and ``data.unstack("cell")`` makes every
        factor a dimension. Trials not yet run are NaN, whole numbers -1 (``active`` -128).

    Raises:
        InputError: Where the file is missing, damaged or no study, or xarray is not installed.

    Example:
        >>> data = aj.study.open_study("study.h5")
        >>> print(data.de_stage1.mean("trial").values.round(4), "mm")
        [0.009  0.0098 0.0091 0.0091] mm
    """
    require("data", "open_study")
    import xarray

    results = Results.of(path)
    study = results.study
    with undamaged(path):
        if results.finished:
            data = xarray.open_dataset(results.path, group="trials", engine="h5netcdf")
        else:
            data = xarray.Dataset(coords={"parameter": list(study.space.names)})
            for name, kind in VARIABLES.items():
                values, described = results.empty(name), {"units": kind.units, "long_name": kind.long_name}
                data[name] = xarray.Variable(DIMENSIONS[: values.ndim], values, described)
            for block in results.finished_blocks():
                for name, values in results.of_block(block).items():
                    data[name].values[block.slices] = values
        labels = {
            name: ("cell", np.asarray(column.values), {"units": column.units, "long_name": column.long_name})
            for name, column in factor_columns(study).items()
        }
        nominal = ("parameter", np.asarray(study.space.vector()), {"long_name": "value in the nominal arm"})
        data = data.assign_coords(labels | {"nominal": nominal})
        if len(labels) == 1:
            data = data.swap_dims(cell=next(iter(labels)))
        elif labels:
            data = data.drop_vars("cell", errors="ignore").set_index(cell=list(labels))
    data.attrs = {
        "name": study.specification.name,
        "seed": study.specification.seed,
        "finished": results.finished,
        "specification": study.specification.model_dump_json(exclude_unset=True),
    }
    return data


def study_summary(results: Results, only: int | None = None) -> dict[str, Any]:
    """Summarise a study as ``aacmm show --json`` prints it.

    Args:
        results: The study.
        only: Only this cell, counted from 1; all if None.

    Returns:
        The study's name, arm, seed, size and factors, under "results" the `cell_summary` of each cell, and under
        "finding" how far each factor changes the errors, in a sentence.

    Example:
        >>> summary = aj.study.study_summary(results)
        >>> print(summary["trials"], summary["finished"], len(summary["results"]))
        20 True 4
    """
    study = results.study
    cells = [cell_summary(results, cell) for cell in range(len(study.cells)) if only is None or cell == only - 1]
    summary = {
        "kind": "study",
        "name": study.specification.name,
        "arm": study.nominal.name,
        "seed": study.specification.seed,
        "finished": results.finished,
        "cells": len(study.cells),
        "trials": study.trials,
        "trials_run": sum(cell["trials_run"] for cell in cells),
        "factors": study.factors,
        "results": cells,
    }
    return summary | {"finding": finding(summary)}


def cell_summary(results: Results, cell: int) -> dict[str, Any]:
    """Statistics of the trials of one cell, each a dictionary of its ``value`` and Monte Carlo standard error ``se``.

    Args:
        results: The study.
        cell: The cell, counted from 0.

    Returns:
        Fractions of trials that converged, had the truth within their bounds, or ended on a bound; under "figures"
        mean, standard deviation ("spread") and percentiles of each metric of `METRICS` over the converged trials, mm
        and rad; under "parameters" the bias and standard deviation of each parameter.

    Example:
        >>> summary = aj.study.cell_summary(results, 0)
        >>> print(summary["converged"]["value"], summary["figures"].keys() >= {"de", "deltam"})
        1.0 True
    """
    columns = results.columns(cell)
    ran = columns["converged"] >= 0
    columns = {name: values[ran] for name, values in columns.items()}
    good = columns["converged"] == 1
    labels = {column.long_name: column.values[cell] for column in factor_columns(results.study).values()}
    reasons = {name: int(numbers_of(getattr(Reason, name))) for name in _REASONS}
    summary: dict[str, Any] = {
        "cell": cell + 1,
        "factors": labels,
        "trials_run": int(ran.sum()),
        "converged": statistic(np.mean, good.astype(float), columns["group"]),
        "truth_inside": statistic(np.mean, columns["truth_inside"].astype(float), columns["group"]),
        "reasons": {name: int(np.sum(columns["reason"] == number)) for name, number in reasons.items()},
        "steps_mean": float(columns["steps"].mean()) if ran.any() else None,
        "figures": {},
    }
    for name in METRICS:
        finite = good & np.isfinite(columns[name])
        if finite.any():
            summary["figures"][name] = distribution(columns[name][finite], columns["group"][finite])
    return summary | _parameters(results, cell)


def distribution(values: Float[np.ndarray, " t"], groups: Int[np.ndarray, " t"]) -> dict[str, Any]:
    """Mean, standard deviation (key "spread") and percentiles, each with its standard error."""
    order, names = np.argsort(values), ("mean", "spread", *(f"p{percentile}" for percentile in PERCENTILES))
    columns = statistic(_figures, values[order], groups[order])
    figures = {name: {key: column[i] for key, column in columns.items()} for i, name in enumerate(names)}
    return {name: figure for name, figure in figures.items() if len(values) > 1 or name != "spread"}


def _figures(ordered: Float[np.ndarray, " t"]) -> Float[np.ndarray, " f"]:
    """Those of sorted values; percentiles are linear between neighbours as in `numpy.percentile`, which would sort."""
    places = np.array(PERCENTILES) / 100 * (len(ordered) - 1)
    percentiles = np.interp(places, np.arange(len(ordered)), ordered)
    return np.array([ordered.mean(), np.std(ordered, ddof=min(len(ordered) - 1, 1)), *percentiles])


def statistic(function: Callable, values: np.ndarray, groups: Int[np.ndarray, " t"]) -> dict[str, Any]:
    """A statistic of trials and its Monte Carlo standard error (None where there are too few groups)."""
    if not len(values):
        return {"value": None, "se": None}
    value = np.asarray(function(values))
    # Groups of at least the square root of all trials: the jackknife of a percentile that leaves out fewer at a time is
    # inconsistent (Shao and Wu 1989).
    groups = groups % max(int(len(values) ** 0.5), 2)
    members = np.unique(groups)
    count = len(members)
    none = [None] * len(value) if value.ndim else None
    if count < 2:
        return {"value": value.tolist(), "se": none}
    se = _jackknife(np.array([function(values[groups != group]) for group in members]))
    # No scatter at all (every trial converged) does not mean that the value has no error.
    return {"value": value.tolist(), "se": none if not np.any(se) else se.tolist()}


def _jackknife(rest: np.ndarray) -> np.ndarray:
    """The standard error of a statistic from its values with one group left out each (Efron and Stein 1981)."""
    return np.asarray(np.sqrt((len(rest) - 1) / len(rest) * np.sum((rest - rest.mean(axis=0)) ** 2, axis=0)))


def _parameters(results: Results, cell: int) -> dict[str, Any]:
    """Bias and standard deviation of every parameter that the cell identifies, and how often it is on a bound, from
    sums over groups."""
    study, space = results.study, results.study.space
    identified = study.identified(study.settings[cell])[0].names
    # By group: number of trials, errors, their squares, active bounds, trials with any.
    sums = np.zeros((5, POOL_PARTS, len(space.names)))
    for error, active, group in results.errors(cell):
        for g in np.unique(group):
            rows = group == g
            on_bound = active[rows] != 0
            moments = rows.sum(), error[rows].sum(axis=0), (error[rows] ** 2).sum(axis=0)
            for total, part in zip(sums, (*moments, on_bound.sum(axis=0), on_bound.any(axis=1).sum()), strict=True):
                total[g] += part
    sums = sums[:, sums[0, :, 0] > 0]
    if not sums.size:
        return {"on_a_bound": {"value": None, "se": None}, "parameters": []}

    def statistics(groups: np.ndarray) -> np.ndarray:
        n, first, second, active, any_active = groups.sum(axis=1)
        n = np.maximum(n, 1)
        deviation = np.sqrt(np.maximum(second / n - (first / n) ** 2, 0) * n / np.maximum(n - 1, 1))
        return np.stack([first / n, deviation, active / n, any_active / n])

    value, se = statistics(sums), np.full((4, len(space.names)), np.nan)
    if sums.shape[1] > 1:
        se = _jackknife(np.array([statistics(np.delete(sums, g, axis=1)) for g in range(sums.shape[1])]))

    def entry(row: int, i: int) -> dict[str, Any]:
        return {"value": float(value[row, i]), "se": None if np.isnan(se[row, i]) else float(se[row, i])}

    parameters = [
        {"parameter": name, "unit": parameter_unit(space.base, name)}
        | {key: entry(row, i) for row, key in enumerate(("bias", "spread", "on_a_bound"))}
        for i, name in enumerate(space.names)
        if name in identified
    ]
    return {"on_a_bound": entry(3, 0), "parameters": parameters}


def correlation(results: Results, cell: int) -> Float[np.ndarray, "p p"]:
    """Correlation of parameter errors over the converged trials of a cell (counted from 0); 0 where one is constant."""
    count, first, second = 0, 0.0, 0.0
    for error, _, _ in results.errors(cell):
        count, first, second = count + len(error), first + error.sum(axis=0), second + error.T @ error
    p = len(results.study.space.names)
    if count < 2:
        return np.full((p, p), np.nan)
    covariance = second / count - np.outer(first / count, first / count)
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0))
    scale = np.outer(deviation, deviation)
    return np.divide(covariance, scale, out=np.zeros_like(scale), where=scale > 0)

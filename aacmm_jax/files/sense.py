"""Whether the values of a file make sense, whoever wrote it: checked whenever it is loaded, and before it is shown.

These checks need the tables alone and no JAX, so that ``aacmm show`` can print the summary in a file without it.
"""

import datetime
import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..acceptance.standards import STANDARDS
from .hdf5 import Stored, check_sense, names_in, read_tables, undamaged

_ROUNDING = 1e-6  # of k
_LARGEST_U = 0.1  # of k: a larger one says nothing about it


def check_shown(path: str | os.PathLike, kind: str, summary: Mapping[str, Any]) -> None:
    """Raise `InputError` where values of a file, or the summary in it, make no sense."""
    stored = read_tables(path, (kind,))
    with undamaged(path):
        if stored.attributes.get("of") == "points":
            check_points(path, stored)
            return
        check_recording(path, stored)
        if kind == "evaluation":
            check_evaluation(path, stored)
        if kind == "calibration":
            check_calibration(path, stored)
            pairs = [
                (np.nan if summary[key] is None else summary[key], stored.attributes[key])
                for key in ("scale_k", "scale_u", "converged")
            ]
            same = all(one == other or (np.isnan(one) and np.isnan(other)) for one, other in pairs)
            check_sense(path, {"its summary is not that of its values": not same})


def check_recording(path: str | os.PathLike, stored: Stored) -> None:
    """Raise `InputError` where a capture or one of its arms cannot be."""
    tables, attributes = stored.tables, stored.attributes
    joints = tables["capture"]["angle"].shape[1]
    arms = [arrays for name, arrays in tables.items() if name.endswith("_arm")]
    check_sense(
        path,
        {
            "its arm has another number of joints than its readings": any(len(x["alpha"]) != joints for x in arms),
            "the day of measurement is no date": not _is_date(attributes.get("measured", "")),
            "its seed is no whole number": not isinstance(attributes.get("seed", 0), int),
            "its acceptance procedure is unknown": not set(names_in(attributes.get("acceptance"))) <= set(STANDARDS),
        },
    )


def check_calibration(path: str | os.PathLike, stored: Stored) -> None:
    """Raise `InputError` where a value is not one that a calibration can have.

    k is a weighted mean of measured over certified lengths, so it lies between the least and the largest of them; its
    lengths are between positions by weighted poses, and those stored between centroids, which differ by less than u.
    """
    table, reference, attributes = stored.tables["parameters"], stored.tables["reference"], stored.attributes
    names, covariance = table["parameter"].tolist(), table["covariance"]
    vectors = [table[key] for key in ("lower", "upper", "active_stage1", "active", "determined")]
    square = (covariance, table["open"])
    count = len(names)
    check_sense(
        path,
        {
            "the parameters have arrays of other shapes": any(x.shape != (count,) for x in vectors)
            or any(x.shape != (count, count) for x in square),
            "a parameter is named twice": len(set(names)) != count,
            "a parameter is both free and fixed": bool(set(names) & set(names_in(attributes.get("held")))),
        },
    )
    k, u_k, converged = (attributes[name] for name in ("scale_k", "scale_u", "converged"))
    ratios = [
        reference[f"measured_{stage}"] / reference["value"]
        for stage in ("stage1", "calibrated")
        if len(reference["value"]) and f"measured_{stage}" in reference
    ]
    # Only the division by k needs reference lengths.
    scaled = attributes["method"] == "two-stage"
    finite = all(np.all(np.isfinite(x)) for x in ((k, u_k, covariance) if scaled else (covariance,)))
    slack = _ROUNDING + (3 * u_k if u_k < _LARGEST_U else 0.0)
    stated = ("encoder_arcsec", "linear_encoder_mm", "seating_mm")
    noise = np.concatenate([np.atleast_1d(attributes.get(what, 0.0)) for what in stated])
    sampled = stored.tables.get("monte_carlo")
    check_sense(
        path,
        {
            "a lower bound is above the upper": not np.all(vectors[0] <= vectors[1]),
            "an active bound is neither lower nor upper": not np.all(np.isin(vectors[2:4], (-1, 0, 1))),
            "the scale k is not positive": not k > 0 and not np.isnan(k),
            "the uncertainty of k is negative": bool(u_k < 0),
            "a converged calibration has a scale or covariance that is not finite": converged and not finite,
            "the scale k is not that of its lengths": converged
            and (scaled or not np.isnan(k))
            and bool(ratios)
            and not any(ratio.min() - slack <= k <= ratio.max() + slack for ratio in ratios),
            "the covariance is not one": finite and not _is_semidefinite(covariance),
            "the method is unknown": attributes["method"] not in ("two-stage", "joint", "repeatability"),
            "its number of steps is negative": attributes["steps"] < 0,
            "its degrees of freedom are not positive": not attributes["freedom"] > 0,
            "a standard deviation of its noise is negative": bool(np.any(noise < 0)),
            "a verdict of its Monte Carlo is neither yes nor no": sampled is not None
            and not np.all(np.isin(sampled["agrees"], (0, 1))),
        },
    )


def check_evaluation(path: str | os.PathLike, stored: Stored) -> None:
    """Raise `InputError` where a limit or an uncertainty of an evaluation cannot be."""
    limits = [value for name, value in stored.attributes.items() if name.startswith("most_")]
    covariance = stored.tables.get("uncertainty", {}).get("covariance", np.zeros((0, 0)))
    check_sense(
        path,
        {
            "a limit is negative or not finite": not all(0 <= value < math.inf for value in limits),
            "the uncertainty of the test is negative or not finite": not 0 <= stored.attributes["u_test_mm"] < math.inf,
            "a standard is unknown": not set(names_in(stored.attributes.get("standards"))) <= set(STANDARDS),
            "the covariance is not that of real numbers": not _is_semidefinite(covariance),
        },
    )


def check_points(path: str | os.PathLike, stored: Stored) -> None:
    """Raise `InputError` where the points of an evaluation, or what is stated about them, cannot be."""
    table, attributes = stored.tables["points"], stored.attributes
    shoulder = attributes.get("shoulder_mm", [0.0] * 3)
    check_sense(
        path,
        {
            "a position is not three finite numbers": table["position"].shape != (len(table["socket"]), 3)
            or not np.all(np.isfinite(table["position"])),
            "the uncertainty of the test is negative or not finite": not 0 <= attributes["u_test_mm"] < math.inf,
            "the reach is not positive and finite": not 0 < attributes.get("reach_mm", 1.0) < math.inf,
            "the shoulder is not three finite numbers": len(shoulder) != 3 or not np.all(np.isfinite(shoulder)),
        },
    )


def _is_semidefinite(covariance: np.ndarray) -> bool:
    """Whether a matrix is symmetric, and its correlations have no eigenvalue below zero, to rounding."""
    variance = np.diag(covariance)
    if np.any(variance < 0):
        return False
    root = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = covariance / root / root[:, None]
    symmetric = np.allclose(correlation, correlation.T, rtol=0, atol=1e-9)
    return symmetric and bool(np.all(np.linalg.eigvalsh(correlation) > -1e-6))


def _is_date(text: str) -> bool:
    try:
        return not text or bool(datetime.date.fromisoformat(text[:10]))
    except ValueError:
        return False

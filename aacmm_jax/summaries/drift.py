"""Comparisons of calibrations as plain dictionaries with the unit in every key, and as CSV."""

from typing import Any

import numpy as np

from ..core.text import csv_text
from ..drift.results import Drift, Trend
from ..drift.statistics import LengthChange, ProbeTest


def drift_summary(drift: Drift) -> dict[str, Any]:
    """Two calibrations compared; None for what is unknown or infinite."""
    joint, units = drift.joint_test, dict(zip(drift.names, drift.units, strict=True))
    return {
        "kind": "comparison",
        "level": drift.level,
        "warnings": list(drift.warnings),
        "findings": drift.findings(),
        "parameters": _rows(drift),
        "compared": drift.compared,
        "moved": int(drift.moved.sum()),
        "moved_by_chance": drift.by_chance,
        "joint": {
            "statistic": _finite(joint.statistic),
            "rank": joint.rank,
            "freedom": _finite(joint.degrees_of_freedom),
            "p": _finite(joint.p),
            "parameters": list(joint.names),
            "causes": [{"parameter": name, "unit": units[name], "change": amount} for name, amount in joint.causes],
            "probe": None if joint.probe is None else _probe_summary(joint.probe),
        },
        "lengths": lengths_summary(drift.lengths),
    }


def _probe_summary(probe: ProbeTest) -> dict[str, Any]:
    """Of the hypothesis that only the probe changed."""
    return {
        "remounted": bool(probe.remounted),
        "statistic_left": probe.statistic,
        "rank": probe.rank,
        "p": _finite(probe.p),
        "ratio": probe.ratio,
        "change_mm": dict(probe.change),
    }


def compared_summary(trend: Trend, labels: list[str], arm: str) -> dict[str, Any]:
    """The first calibration against the last in full, and the trend of all; ``labels`` in the order given."""
    summary = {"kind": "comparison", "arm": arm, "old": labels[trend.order[0]], "new": labels[trend.order[-1]]}
    summary |= {"old_created": trend.dates[0].isoformat(), "new_created": trend.dates[-1].isoformat()}
    summary |= drift_summary(trend.drifts[-1])
    return summary | {"warnings": trend.warnings, "trend": trend_summary(trend, labels)}


def change_exceeded(lengths: LengthChange, limit: float | None) -> tuple[list[str], list[str]]:
    """Sentences on a limit of the largest change of a length, mm: kept, and exceeded."""
    if limit is None:
        return [], []
    kept = abs(lengths.largest) <= limit
    verdict = (
        f"the largest change of a length of {lengths.length:g} mm is {abs(lengths.largest):.4f} mm, "
        f"{'within' if kept else 'over'} the limit of {limit:g} mm."
    )
    return ([verdict], []) if kept else ([], [verdict])


def lengths_summary(lengths: LengthChange) -> dict[str, Any]:
    """Changes of lengths over the working volume."""
    return {
        "length_mm": lengths.length,
        "places": len(lengths.change),
        "rms_mm": lengths.rms,
        "rms_by_chance_mm": _finite(lengths.rms_by_chance),
        "percentile_95_mm": float(np.quantile(np.abs(lengths.change), 0.95)),
        "largest_mm": lengths.largest,
        "mean_mm": float(np.mean(lengths.change)),
        "mean_um_per_m": 1e6 * lengths.scale_change,
        "mean_expanded_um_per_m": _finite(1e6 * lengths.expanded_scale_change),
        "moved_share": float(np.mean(lengths.moved)),
    }


def trend_summary(trend: Trend, labels: list[str]) -> list[dict[str, Any]]:
    """Every calibration of a trend in the order of their dates; ``labels`` in the order given."""
    rows: list[dict[str, Any]] = [{"calibration": labels[trend.order[0]], "created": trend.dates[0].isoformat()}]
    for date, position, drift in zip(trend.dates[1:], trend.order[1:], trend.drifts, strict=True):
        rows.append({
            "calibration": labels[position],
            "created": date.isoformat(),
            "moved": int(drift.moved.sum()),
            "moved_by_chance": drift.by_chance,
            "p": _finite(drift.joint_test.p),
            "lengths": lengths_summary(drift.lengths),
            "parameters": _rows(drift),
        })  # fmt: skip
    return rows


def drift_csv(trend: Trend, labels: list[str]) -> str:
    """Every parameter of every calibration but the first, compared with the first, in its unit; empty if unknown."""
    columns = ("parameter", "unit", "old", "new", "change", "u", "expanded", "moved", "without")
    rows: list[list[Any]] = [["old_calibration", "new_calibration", "new_created", *columns]]
    for date, position, drift in zip(trend.dates[1:], trend.order[1:], trend.drifts, strict=True):
        for row in _rows(drift):
            cells = ["" if row[name] is None else row[name] for name in columns]
            rows.append([labels[trend.order[0]], labels[position], date.isoformat(), *cells])
    return csv_text(rows)


def _rows(drift: Drift) -> list[dict[str, Any]]:
    return [
        {
            "parameter": name,
            "unit": drift.units[i],
            "old": float(drift.old[i]),
            "new": float(drift.new[i]),
            "change": float(drift.change[i]),
            "u": _finite(drift.u[i]),
            "expanded": _finite(drift.expanded[i]),
            "moved": bool(drift.moved[i]) if not drift.reasons[i] else None,
            "without": drift.reasons[i] or None,
        }
        for i, name in enumerate(drift.names)
    ]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None

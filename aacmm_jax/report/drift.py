"""The report of calibrations that were compared: whether the arm has changed, and in what."""

import datetime
import math
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..core.text import pluralise
from ..drift.results import Drift, Trend
from ..plot.charts import Chart
from ..plot.drift import due_chart, trend_plots
from ..summaries.drift import comparison_tables
from .elements import Block, Report, Section

_CHANGED = (
    "Changes of the parameters from the first calibration, divided by their expanded uncertainty; below, for three "
    "calibrations or more, the changes of lengths over the working volume."
)


def comparison_report(summary: dict[str, Any]) -> Report:
    """The report of compared calibrations (`files.load_comparison`), except for the origin of its file."""
    p, lengths, due = summary["joint"]["p"], summary["lengths"], summary.get("due")
    changed = p is not None and p < 1 - summary["level"]
    doubtful = p is None or changed or bool(summary["warnings"] or summary.get("failed"))
    tables: Any = comparison_tables(summary)  # and sentences
    blocks: list[Block] = [Chart("changes", "Changes", _CHANGED, trend_plots(_trend_of(summary))), *tables]
    return Report(
        title=f"Comparison of calibrations, {summary['arm'] or 'an arm'}",
        subtitle=f"{pluralise(len(summary['trend']), 'calibration')}: {summary['new']} compared with {summary['old']}",
        verdict=summary["answer"],
        verdict_mark="unsure" if doubtful else "good",
        warnings=[*summary["warnings"], *(f"Over the limit: {sentence}" for sentence in summary.get("failed", ()))],
        numbers=[
            ("Parameters changed beyond U", f"{summary['moved']} of {summary['compared']}", ""),
            (f"Lengths of {lengths['length_mm']:g} mm, RMS change", f"{lengths['rms_mm']:.4f}\u00a0mm", ""),
            ("Next calibration due", due["date"][:10], f"before lengths change by {due['limit_mm']:.2g} mm")
            if due
            else ("Largest change of a length", f"{lengths['largest_mm']:.4f}\u00a0mm", ""),
        ],
        picture=due_chart(_trend_of(summary), summary.get("due")),
        facts=[],
        sections=[
            Section("found", "What was found", [*([due["says"]] if due else []), *summary["findings"]]),
            Section("changes", "Parameters and lengths", blocks),
        ],
    )


def _trend_of(summary: Mapping[str, Any]) -> Trend:
    """As much of a trend as charts need: of lengths, what the summary states."""
    first, *others = summary["trend"]
    dates = tuple(datetime.datetime.fromisoformat(row["created"]) for row in (first, *others))
    return Trend(dates, tuple(range(len(dates))), tuple(_drift_of(row, summary["level"]) for row in others))


def _drift_of(row: Mapping[str, Any], level: float) -> Drift:
    rows, lengths = row["parameters"], row["lengths"]

    def column(key: str) -> np.ndarray:
        return np.array([math.nan if part[key] is None else part[key] for part in rows], dtype=float)

    columns = {key: column(key) for key in ("old", "new", "u", "expanded")}
    known = {key: math.nan if lengths[f"{key}_mm"] is None else lengths[f"{key}_mm"] for key in _OF_LENGTHS}
    stated: Any = SimpleNamespace(**known, change=np.zeros(0))
    unknown: Any = None  # the tests of all parameters together are in the sentences
    return Drift(
        names=tuple(part["parameter"] for part in rows),
        units=tuple(part["unit"] for part in rows),
        **columns,
        degrees_of_freedom=np.full(len(rows), math.nan),
        reasons=tuple(part["without"] or "" for part in rows),
        level=level,
        joint_test=unknown,
        lengths=stated,
        warnings=(),
    )


_OF_LENGTHS = ("length", "rms", "rms_by_chance", "largest")

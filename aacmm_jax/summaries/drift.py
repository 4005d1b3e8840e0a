"""Comparisons of calibrations: as plain dictionaries with the unit in every key, as CSV, and as people see them."""

from typing import Any

import numpy as np

from ..core.text import csv_text
from ..core.units import people_read, people_read_change
from ..drift.due import next_due
from ..drift.results import Drift, Trend
from ..drift.statistics import LengthChange
from ..uncertainty.coverage import COVERAGE_FACTOR, in_percent
from . import tables
from .result_tables import listed_apart
from .tables import Cell, Styled, View, attributes, decimals_for, listed, number, plain, rows_of


def drift_summary(drift: Drift) -> dict[str, Any]:
    """Two calibrations compared; None for what is unknown or infinite."""
    joint, units = drift.joint_test, dict(zip(drift.names, drift.units, strict=True))
    probe = joint.probe
    return {
        "kind": "comparison",
        **attributes(drift, "answer", "level", "warnings", "compared", moved_by_chance="by_chance"),
        "findings": drift.findings(),
        "parameters": _rows(drift),
        "moved": int(drift.moved.sum()),
        "joint": {
            **attributes(joint, "statistic", "rank", "p", freedom="degrees_of_freedom", parameters="names"),
            "causes": [{"parameter": name, "unit": units[name], "change": amount} for name, amount in joint.causes],
            "detectable": [
                {"parameter": name, "unit": units[name], "change": plain(size)}
                for name, size in zip(joint.names, joint.detectable, strict=True)
            ],
            # Of the hypothesis that only the probe changed.
            "probe": probe
            and attributes(probe, "remounted", "rank", "p", "ratio", statistic_left="statistic")
            | {"change_mm": dict(probe.change)},
        },
        "lengths": _lengths(drift.lengths),
    }


def compared_summary(trend: Trend, labels: list[str], arm: str, limit: float | None = None) -> dict[str, Any]:
    """The first calibration against the last in full, and the trend of all; ``labels`` in the order given. ``limit`` is
    the change of a length at which the next calibration is due, mm; by default what the uncertainties alone show."""
    first, created = labels[trend.order[0]], trend.dates[0].isoformat()
    summary = {"kind": "comparison", "arm": arm, "old": first, "new": labels[trend.order[-1]]}
    summary |= {"old_created": created, "new_created": trend.dates[-1].isoformat()}
    rows: list[dict[str, Any]] = [{"calibration": first, "created": created}]
    for date, position, drift in zip(trend.dates[1:], trend.order[1:], trend.drifts, strict=True):
        rows.append({
            "calibration": labels[position],
            "created": date.isoformat(),
            "moved": int(drift.moved.sum()),
            "moved_by_chance": drift.by_chance,
            "p": plain(drift.joint_test.p),
            "lengths": _lengths(drift.lengths),
            "parameters": _rows(drift),
        })  # fmt: skip
    due = _due(trend, limit)
    return summary | drift_summary(trend.drifts[-1]) | {"warnings": trend.warnings, "trend": rows, "due": due}


def _due(trend: Trend, limit: float | None) -> dict[str, Any] | None:
    """By when the arm is to be calibrated again; None where its calibrations do not show it."""
    last, probe = trend.drifts[-1].lengths, trend.drifts[-1].joint_test.probe
    if probe is not None and probe.remounted:
        return None  # which is no drift
    stated = limit if limit is not None else COVERAGE_FACTOR * last.rms_by_chance
    due = next_due(trend.dates, [drift.lengths.rms for drift in trend.drifts], stated)
    if due is None:
        return None
    what = f"{due.limit:.2g} mm ({'the limit' if limit is not None else 'U of the change'})"
    says = f"Next calibration due by {due.date:%Y-%m-%d}: at the rate seen until now ({due.rate:.2g} mm a year, RMS), "
    if due.capped:
        says += (
            f"lengths of {last.length:g} mm will have changed by less than {what} then, but the arm has not been "
            "observed over a longer time."
        )
    else:
        says += f"lengths of {last.length:g} mm will have changed by {what} then."
    return {"date": due.date.isoformat(), "rate_mm_per_year": due.rate, "limit_mm": due.limit, "says": says}


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


def _lengths(lengths: LengthChange) -> dict[str, Any]:
    """Changes of lengths over the working volume."""
    names = ("rms", "rms_by_chance", "largest", "length")
    return attributes(lengths, **{f"{name}_mm": name for name in names}) | {
        "places": len(lengths.change),
        "percentile_95_mm": float(np.quantile(np.abs(lengths.change), 0.95)),
        "mean_mm": float(np.mean(lengths.change)),
        "mean_um_per_m": 1e6 * lengths.scale_change,
        "mean_expanded_um_per_m": plain(1e6 * lengths.expanded_scale_change),
        "moved_share": float(np.mean(lengths.moved)),
    }


def _rows(drift: Drift) -> list[dict[str, Any]]:
    return rows_of(
        parameter=drift.names,
        unit=drift.units,
        old=drift.old,
        new=drift.new,
        change=drift.change,
        u=drift.u,
        expanded=drift.expanded,
        moved=[None if reason else moved for moved, reason in zip(drift.moved.tolist(), drift.reasons, strict=True)],
        without=[reason or None for reason in drift.reasons],
    )


def drift_csv(trend: Trend, labels: list[str]) -> str:
    """Every parameter of every calibration but the first, compared with the first, in its unit; empty if unknown."""
    rows: list[list[Any]] = []
    for date, position, drift in zip(trend.dates[1:], trend.order[1:], trend.drifts, strict=True):
        pair = [labels[trend.order[0]], labels[position], date.isoformat()]
        rows += [[*pair, *("" if value is None else value for value in row.values())] for row in _rows(drift)]
    return csv_text([["old_calibration", "new_calibration", "new_created", *_rows(trend.drifts[0])[0]], *rows])


def comparison(summary: dict[str, Any]) -> View:
    """The answer, findings in sentences, then the numbers: the last against the first; of three or more, all against
    the first."""
    yield Styled(summary["answer"])
    new, old = (f"{summary[which]} ({summary[f'{which}_created'][:10]})" for which in ("new", "old"))
    yield f"{summary['arm']}: {new} compared with {old}"
    yield from tables.warnings_of(summary)
    yield from summary["findings"]
    yield from [summary["due"]["says"]] if summary.get("due") else []
    yield from comparison_tables(summary)
    yield from tables.limits_of(summary)
    yield from tables.written_of(summary)


def comparison_tables(summary: dict[str, Any]) -> View:
    """Parameters and lengths of the last calibration less those of the first; of three or more, all of them."""
    yield from _parameters(summary)
    lengths = summary["lengths"]
    keys = ("rms_mm", "rms_by_chance_mm", "percentile_95_mm", "largest_mm", "mean_mm")
    yield listed(
        f"Lengths of {lengths['length_mm']:g} mm, new minus old, at {lengths['places']} positions in the volume [mm]",
        [["not determined" if lengths[key] is None else lengths[key] for key in keys]],
        ("RMS", "RMS expected from the uncertainties", "95th percentile", "largest", "mean"),
    )
    if len(summary["trend"]) > 2:
        first, *others = summary["trend"]
        rows: list[list[Any]] = [["1", first["calibration"], first["created"][:10], *[None] * 6]]
        for i, row in enumerate(others, start=2):
            lengths, p = row["lengths"], row["p"]
            probability = "-" if p is None else "< 0.0001" if p < 1e-4 else f"{p:.2g}"
            numbers = [lengths[key] for key in ("rms_mm", "rms_by_chance_mm", "largest_mm")]
            cells = [row["moved"], probability, *numbers, number(lengths["mean_um_per_m"], 1, signed=True)]
            rows.append([str(i), row["calibration"], row["created"][:10], *cells])
        headings = (
            "",
            "calibration",
            "date",
            "beyond U",
            "p of all changes",
            "RMS [mm]",
            "RMS expected [mm]",
            "largest [mm]",
        )
        title = "Each calibration minus the first (the error of the first calibration is contained in every row)"
        yield listed(title, rows, (*headings, "mean [um/m]"))
        yield "For the change of every parameter from the first calibration, use --csv, --json or --figure."


def _parameters(summary: dict[str, Any]) -> View:
    """Values to the digits that the uncertainty of their change allows, changes in small units: um, arcsec."""
    apart, _ = listed_apart(summary["parameters"])
    # Of hundreds of harmonics, those that moved.
    shown = [row for row in summary["parameters"] if row["moved"] or row in apart]
    rows = []
    for row in shown:
        (factor, unit), (fine, small_unit) = people_read(row["unit"]), people_read_change(row["unit"])
        coarse_u, fine_u = (row["expanded"] and scale * row["expanded"] for scale in (factor, fine))
        decimals, small = decimals_for(coarse_u, 5), decimals_for(fine_u, 2)
        old, new = (number(factor * row[which], decimals, rounded=True) for which in ("old", "new"))
        change = number(fine * row["change"], small, signed=True, rounded=True)
        mark = row["without"] or (Cell("* beyond U", None, "outlier") if row["moved"] else "")
        rows.append((row["parameter"], mark, unit, old, new, small_unit, change, number(fine_u, small)))
    title = f"Parameters: changes, with their expanded uncertainties U ({in_percent(summary['level'])})"
    yield listed(title, rows, ("parameter", "", "unit", "old", "new", "unit", "change", "U"))
    left_out = len(summary["parameters"]) - len(shown)
    if left_out:
        yield (
            f"Not listed: {left_out} coefficients of harmonics, which changed by less than U; --json and --csv "
            "list them all."
        )

"""The command ``compare``."""

from pathlib import Path
from typing import Any

import typer

from ..core.errors import InputError
from ..core.units import people_read, people_read_change
from ..files.hdf5 import read_tables
from ..files.outputs import together, write_text
from ..summaries.harmonics import listed_apart
from ..summaries.tables import Cell, Styled, Table, decimals_for, limits_of, listed, number, warnings_of, written_of
from . import options
from .app import app, examples, show_summary, with_spinner
from .calibration_views import View
from .options import argument, option


@app.command(
    epilog=examples(
        "aacmm compare march.h5 september.h5",
        "aacmm compare 2023.h5 2024.h5 2025.h5 --figure trend.png --max-length-change-mm 0.05",
    )
)
def compare(
    files: list[Path] = argument(
        "OLD.h5 NEW.h5 [MORE.h5 ...]",
        "Calibrations of one arm, written by calibrate: two in this order; more than two are ordered by date.",
    ),
    level: float = option("P", "Coverage probability of the expanded uncertainties.", default=0.95),
    length_mm: float | None = option(
        "MM",
        "Compute the change of this length all over the volume. Default: 300, or half a small arm's reach.",
    ),
    figure: Path | None = option(
        "FILE", "Plot the changes, over time for three calibrations or more: PNG, SVG or PDF by the name."
    ),
    csv: Path | None = option("FILE", "Write every parameter of every calibration."),
    max_length_change_mm: float | None = option(
        "MM", "Exit code 1 where a length changes by more than this from the first to the last.", min=0
    ),
    as_json: bool = options.JSON,
) -> None:
    """Compare calibrations of one arm.

    Reports which parameters changed beyond their uncertainty, and what that does to lengths.
    """
    from ..files.calibrations import load_calibration
    from ..summaries.drift import change_exceeded, compared_summary, drift_csv

    if len(files) < 2:
        raise InputError(f"{files[0]} alone cannot be compared; name at least two calibrations.")
    if figure is not None:
        from ..plot.figures import check_format

        check_format(figure)
    with together(figure, csv):
        records = [load_calibration(file) for file in files]
        created = [
            record.recording.measured or read_tables(file, ("calibration",)).attributes["created"]
            for record, file in zip(records, files, strict=True)
        ]
        labels = [str(file) for file in files]
        settings = {"level": level, "length": length_mm, "labels": labels}
        trend = with_spinner("Comparing", lambda: _compared(records, created, settings))
        trend = trend._replace(dated_by_file=tuple(not records[i].recording.measured for i in trend.order))
        summary: dict[str, Any] = compared_summary(trend, labels, records[0].recording.nominal.name)
        summary["kept"], summary["failed"] = change_exceeded(trend.drifts[-1].lengths, max_length_change_mm)
        if figure is not None:
            from ..plot import save_drift_trend

            save_drift_trend(trend, figure)
        if csv is not None:
            write_text(csv, drift_csv(trend, labels))
    written = [str(path) for path in (figure, csv) if path is not None]
    show_summary(summary | ({"written": ", ".join(written)} if written else {}), as_json, comparison)
    if summary["failed"]:
        raise typer.Exit(1)


def _compared(records: list, created: list[str], settings: dict[str, Any]) -> Any:
    """The trend over all files; of two, in the order in which they are named, whatever their dates."""
    from ..drift.comparison import compare, moment, trend
    from ..drift.results import Trend

    labels = settings["labels"]
    if len(records) > 2:
        by_date = trend(records, created, **settings)
        if list(by_date.order) == sorted(by_date.order):
            return by_date
        warning = (
            f"Ordered by date, not as named: {', '.join(labels[i] for i in by_date.order)}. The date is when the poses "
            "were measured, where the manifest states it, and otherwise when the file was made."
        )
        first, *others = by_date.drifts
        return by_date._replace(drifts=(first._replace(warnings=(warning, *first.warnings)), *others))
    drift = compare(*records, **settings)
    old, new = (moment(date) for date in created)
    if new < old:
        warning = (
            f"{labels[1]} was made before {labels[0]} ({new:%Y-%m-%d %H:%M} and {old:%Y-%m-%d %H:%M}): is the order "
            "right?"
        )
        drift = drift._replace(warnings=(*drift.warnings, warning))
    return Trend((old, new), (0, 1), (drift,))


def comparison(summary: dict[str, Any]) -> View:
    """Findings in sentences, then the numbers: the last against the first; of three or more, all against the first."""
    new, old = (f"{summary[which]} ({summary[f'{which}_created'][:10]})" for which in ("new", "old"))
    yield [Styled(summary["arm"]), f": {new} against {old}"]
    yield from warnings_of(summary)
    yield from summary["findings"]
    yield from _parameters(summary)
    lengths = summary["lengths"]
    keys = ("rms_mm", "rms_by_chance_mm", "percentile_95_mm", "largest_mm", "mean_mm")
    yield listed(
        f"Lengths of {lengths['length_mm']:g} mm, new minus old, at {lengths['places']} positions in the volume [mm]",
        [["not determined" if lengths[key] is None else lengths[key] for key in keys]],
        ("RMS", "RMS by the uncertainties alone", "95th percentile", "largest", "mean"),
    )
    if len(summary["trend"]) > 2:
        yield _trend(summary["trend"])
        yield "The change of every parameter from the first calibration: --csv, --json, --figure."
    yield from limits_of(summary)
    yield from written_of(summary)


def _parameters(summary: dict[str, Any]) -> View:
    """Values to the digits that the uncertainty of their change allows, changes in small units: um, arcsec."""
    # Of hundreds of harmonics, those that moved.
    names = {row["parameter"] for row in summary["parameters"] if row["moved"]}
    names |= {row["parameter"] for row in listed_apart(summary["parameters"])[0]}
    rows = []
    for row in (row for row in summary["parameters"] if row["parameter"] in names):
        (factor, unit), (fine, small_unit) = people_read(row["unit"]), people_read_change(row["unit"])
        expanded = row["expanded"]
        decimals = decimals_for(None if expanded is None else factor * expanded, 5)
        small = decimals_for(None if expanded is None else fine * expanded, 2)
        old, new = (number(factor * row[which], decimals, rounded=True) for which in ("old", "new"))
        change = number(fine * row["change"], small, signed=True, rounded=True)
        u = number(None if expanded is None else fine * expanded, small)
        mark = row["without"] or Cell("* beyond U" if row["moved"] else "", None, "outlier")
        rows.append((row["parameter"], unit, old, new, small_unit, change, u, mark))
    title = f"Parameters: change with its expanded uncertainty U ({100 * summary['level']:g} %)"
    yield listed(title, rows, ("parameter", "unit", "old", "new", "unit", "change", "U", ""))
    left_out = len(summary["parameters"]) - len(names)
    if left_out > 0:
        yield f"Not listed: {left_out} coefficients of harmonics that did not move beyond U; --json, --csv."


def _trend(calibrations: list[dict[str, Any]]) -> Table:
    rows = []
    for i, row in enumerate(calibrations, start=1):
        cells: list[Any] = [None] * 6
        if i > 1:
            lengths, p = row["lengths"], row["p"]
            probability = "-" if p is None else "< 0.0001" if p < 1e-4 else f"{p:.2g}"
            numbers = (lengths[key] for key in ("rms_mm", "rms_by_chance_mm", "largest_mm"))
            cells = [row["moved"], probability, *numbers, number(lengths["mean_um_per_m"], 1, signed=True)]
        rows.append((str(i), row["calibration"], row["created"][:10], *cells))
    headings = ("", "calibration", "date", "beyond U", "p together", "RMS [mm]", "by chance [mm]", "largest [mm]")
    title = "Each calibration against the first (whose own error is in all of them)"
    return listed(title, rows, (*headings, "mean [um/m]"))

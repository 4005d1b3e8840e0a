"""The command ``compare``."""

from pathlib import Path
from typing import Any

import typer

from .. import files, plot, summaries
from ..core.errors import InputError
from ..files.hdf5 import read_tables
from ..files.outputs import together, write_text
from . import options
from .app import app, examples, show_summary, with_spinner
from .options import argument, option


@app.command(
    epilog=examples(
        "aacmm compare march.h5 september.h5",
        "aacmm compare 2023.h5 2024.h5 2025.h5 --figure trend.png --max-length-change-mm 0.05",
    )
)
def compare(
    paths: list[Path] = argument(
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
    if len(paths) < 2:
        raise InputError(f"{paths[0]} alone cannot be compared; name at least two calibrations.")
    options.check_figure(figure)
    words = summaries.drift
    with together(figure, csv):
        records = [files.load_calibration(path) for path in paths]
        created = [
            record.recording.measured or read_tables(path, ("calibration",)).attributes["created"]
            for record, path in zip(records, paths, strict=True)
        ]
        labels = [str(path) for path in paths]
        settings = {"level": level, "length": length_mm, "labels": labels}
        trend = with_spinner("Comparing", lambda: _compared(records, created, settings))
        trend = trend._replace(dated_by_file=tuple(not records[i].recording.measured for i in trend.order))
        summary: dict[str, Any] = words.compared_summary(trend, labels, records[0].recording.nominal.name)
        summary["kept"], summary["failed"] = words.change_exceeded(trend.drifts[-1].lengths, max_length_change_mm)
        if figure is not None:
            plot.save_drift_trend(trend, figure)
        if csv is not None:
            write_text(csv, words.drift_csv(trend, labels))
    written = ", ".join(str(path) for path in (figure, csv) if path is not None)
    show_summary(summary | ({"written": written} if written else {}), as_json, words.comparison)
    if summary["failed"]:
        raise typer.Exit(1)


def _compared(records: list, created: list[str], settings: dict[str, Any]) -> Any:
    """The trend over all files; of two, in the order in which they are named, whatever their dates."""
    from ..drift.comparison import compare, moment, trend
    from ..drift.results import Trend

    labels = settings["labels"]
    if len(records) == 2:
        drift, (old, new) = compare(*records, **settings), map(moment, created)
        warning = (
            f"{labels[1]} was made before {labels[0]} ({new:%Y-%m-%d %H:%M} and {old:%Y-%m-%d %H:%M}): is the order "
            "right?"
        )
        warnings = (*drift.warnings, warning) if new < old else drift.warnings
        return Trend((old, new), (0, 1), (drift._replace(warnings=warnings),))
    by_date = trend(records, created, **settings)
    if list(by_date.order) == sorted(by_date.order):
        return by_date
    warning = (
        f"Ordered by date, not as named: {', '.join(labels[i] for i in by_date.order)}. The date is when the poses "
        "were measured, where the manifest states it, and otherwise when the file was made."
    )
    first, *others = by_date.drifts
    return by_date._replace(drifts=(first._replace(warnings=(warning, *first.warnings)), *others))

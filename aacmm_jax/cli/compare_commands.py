"""The command ``compare``."""

from pathlib import Path
from typing import Annotated, Any

import typer

from ..core.errors import InputError
from ..files.hdf5 import read_tables
from ..files.outputs import together, write_text
from .app import Json, app, examples, show_summary, with_spinner


@app.command(
    epilog=examples(
        "aacmm compare march.h5 september.h5",
        "aacmm compare 2023.h5 2024.h5 2025.h5 --figure trend.png --max-length-change-mm 0.05",
    )
)
def compare(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="OLD.h5 NEW.h5 [MORE.h5 ...]",
            help="Calibrations of one arm, written by calibrate: two in this order; more than two are ordered by date.",
        ),
    ],
    level: Annotated[
        float, typer.Option(metavar="P", help="Coverage probability of the expanded uncertainties.")
    ] = 0.95,
    length_mm: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Length whose change is computed all over the volume. Default 300, or half a small arm's reach.",
        ),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Plot the changes, over time for three calibrations or more: PNG, SVG or PDF by the name.",
        ),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write every parameter of every calibration.")
    ] = None,
    max_length_change_mm: Annotated[
        float | None,
        typer.Option(
            min=0, metavar="MM", help="Exit code 1 where a length changes by more than this from the first to the last."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare calibrations of one arm.

    Reports which parameters changed beyond their uncertainty, and what that does to lengths.
    """
    from ..files.calibrations import load_calibration
    from ..summaries.drift import change_exceeded, compared_summary, drift_csv
    from . import compare_display

    if len(files) < 2:
        raise InputError(f"{files[0]} alone cannot be compared; name at least two calibrations.")
    if figure is not None:
        from ..plot.figures import check_format

        check_format(figure)
    with together(figure, csv):
        records = [load_calibration(file) for file in files]
        created = [record.recording.measured or _created(file) for record, file in zip(records, files, strict=True)]
        labels = [str(file) for file in files]
        found = with_spinner("Comparing", lambda: _compared(records, created, labels, level, length_mm))
        found = found._replace(dated_by_file=tuple(not records[i].recording.measured for i in found.order))
        summary: dict[str, Any] = compared_summary(found, labels, records[0].recording.nominal.name)
        summary["kept"], summary["failed"] = change_exceeded(found.drifts[-1].lengths, max_length_change_mm)
        written = []
        if figure is not None:
            from ..plot import save_drift_trend

            save_drift_trend(found, figure)
            written.append(str(figure))
        if csv is not None:
            write_text(csv, drift_csv(found, labels))
            written.append(str(csv))
    show_summary(summary | ({"written": ", ".join(written)} if written else {}), as_json, compare_display.comparison)
    if summary["failed"]:
        raise typer.Exit(1)


def _compared(records: list, created: list[str], labels: list[str], level: float, length: float | None) -> Any:
    """The trend over all files; of two, in the order in which they are named, whatever their dates."""
    from ..drift.comparison import compare, moment, trend
    from ..drift.results import Trend

    if len(records) > 2:
        found = trend(records, created, level=level, length=length, labels=labels)
        if list(found.order) != sorted(found.order):
            warning = (
                f"Ordered by date, not as named: {', '.join(labels[i] for i in found.order)}. The date is when the "
                "poses were measured, where the manifest states it, and otherwise when the file was made."
            )
            first = found.drifts[0]
            found = found._replace(drifts=(first._replace(warnings=(warning, *first.warnings)), *found.drifts[1:]))
        return found
    drift = compare(*records, level=level, length=length, labels=labels)
    dates = tuple(moment(date) for date in created)
    if dates[1] < dates[0]:
        warning = (
            f"{labels[1]} was made before {labels[0]} ({dates[1]:%Y-%m-%d %H:%M} and {dates[0]:%Y-%m-%d %H:%M}): "
            "is the order right?"
        )
        drift = drift._replace(warnings=(*drift.warnings, warning))
    return Trend(dates, (0, 1), (drift,))


def _created(file: Path) -> str:
    """When a calibration's file was made."""
    return read_tables(file, ("calibration",)).attributes["created"]

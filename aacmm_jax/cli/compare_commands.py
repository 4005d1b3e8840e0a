"""The command ``compare``."""

from pathlib import Path
from typing import Annotated, Any

import typer

from ..core.errors import InputError
from ..files.hdf5 import need, read_tables
from ..files.whole_file import write_text
from .app import Json, app, show_summary, with_spinner


@app.command(epilog="Examples: aacmm compare march.h5 september.h5; "
             "aacmm compare 2023.h5 2024.h5 2025.h5 --figure trend.png --max-length-change-mm 0.05")  # fmt: skip
def compare(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="OLD.h5 NEW.h5 [MORE.h5 ...]",
            help="Calibrations of one arm, written by calibrate: two in this order; more are put in the order in which they were made.",
        ),
    ],
    level: Annotated[float, typer.Option(help="Coverage of the expanded uncertainties.")] = 0.95,
    length_mm: Annotated[
        float | None,
        typer.Option(help="Lengths that are followed over the volume. Default 300, or half of a small arm's reach."),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="Draw the changes, of three calibrations or more over time: PNG, SVG or PDF by the name."),
    ] = None,
    csv: Annotated[Path | None, typer.Option("--csv", help="Write every parameter of every calibration as CSV.")] = None,
    max_length_change_mm: Annotated[
        float | None,
        typer.Option(min=0, help="Exit with code 1 where the largest change of a length from first to last is larger."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say what moved between calibrations, beyond its uncertainty, and what that does to lengths."""
    from ..files.calibrations import load_calibration
    from ..summaries.drift import change_exceeded, compared_summary, drift_csv
    from . import compare_display

    if len(files) < 2:
        raise InputError(f"{files[0]} alone cannot be compared; name at least two calibrations.")
    _check_outputs(files, figure, csv)
    records = [load_calibration(file) for file in files]
    created = [record.recording.measured or _created(file) for record, file in zip(records, files, strict=True)]
    labels = [str(file) for file in files]
    found = with_spinner("Comparing", lambda: _compared(records, created, labels, level, length_mm))
    summary: dict[str, Any] = compared_summary(found, labels, records[0].recording.nominal.name)
    summary["kept"], summary["failed"] = change_exceeded(found.drifts[-1].lengths, max_length_change_mm)
    written = []
    if figure is not None:
        from ..plot.drift import save_trend

        save_trend(found, figure)
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
            caution = (
                f"Ordered by their dates, not as they were named: {', '.join(labels[i] for i in found.order)}. The date is when poses were "
                "measured, where the manifest states it, and else when the file was made."
            )
            first = found.drifts[0]
            found = found._replace(drifts=(first._replace(warnings=(caution, *first.warnings)), *found.drifts[1:]))
        return found
    drift = compare(*records, level=level, length=length, labels=labels)
    dates = tuple(moment(date) for date in created)
    if dates[1] < dates[0]:
        caution = f"{labels[1]} was made before {labels[0]} ({dates[1]:%Y-%m-%d %H:%M} and {dates[0]:%Y-%m-%d %H:%M}): is the order right?"
        drift = drift._replace(warnings=(*drift.warnings, caution))
    return Trend(dates, (0, 1), (drift,))


def _created(file: Path) -> str:
    """When a calibration's file was made."""

    attributes = read_tables(file, ("calibration",)).attributes
    need(file, attributes, "created", of="attribute")
    return attributes["created"]


def _check_outputs(files: list[Path], figure: Path | None, csv: Path | None) -> None:
    from ..plot.drift import check_format

    if figure is not None:
        check_format(figure)
    for output in (figure, csv):
        if output is not None and output.exists() and any(file.exists() and output.samefile(file) for file in files):
            raise InputError(f"{output} is one of the calibrations; choose another output.")
    if figure is not None and csv is not None and figure.resolve() == csv.resolve():
        raise InputError(f"{figure} is given for the figure and for the table; choose another for one of them.")

"""The command ``show``."""

from pathlib import Path
from typing import Annotated

import typer

from ..core.errors import InputError
from ..files.hdf5 import read_tables
from .app import Json, app, show_summary


@app.command(epilog="Example: aacmm show calibration.h5")
def show(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="Capture, calibration, evaluation or study (HDF5), or an arm: TOML file or shipped name."
        ),
    ],
    cell: Annotated[int | None, typer.Option(min=1, help="Of a study: one cell in full.")] = None,
    figures: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Of a study: draw its figures as PNG.")] = None,
    as_json: Json = False,
) -> None:
    """Print what a file holds."""
    from ..files.arms import load_specification
    from ..files.calibrations import load_calibration
    from ..files.captures import load_capture
    from ..summaries.calibration import arm_summary, calibration_summary, capture_summary
    from . import display

    if file.suffix in ("", ".toml") and not (file.is_file() and file.suffix == ""):
        show_summary(arm_summary(load_specification(str(file))), as_json, display.arm)
        return
    stored = read_tables(file, ("capture", "calibration", "evaluation", "study"), without=("trials",))
    if stored.attributes["kind"] == "study":
        from .study_commands import show_study

        show_study(file, cell, figures, as_json)
        return
    if cell is not None or figures is not None:
        raise InputError(f"{file} holds a {stored.attributes['kind']}; --cell and --figures are for studies.")
    if stored.attributes["kind"] == "evaluation":
        from .result_commands import show_evaluation

        show_evaluation(file, stored.attributes.get("of") == "points", as_json)
    elif stored.attributes["kind"] == "capture":
        show_summary(capture_summary(load_capture(file)), as_json, display.capture)
    else:
        show_summary(calibration_summary(load_calibration(file)), as_json, display.calibration)

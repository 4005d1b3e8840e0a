"""The command ``calibrate``."""

import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import IdentifiabilityWarning, InputError
from .app import CaptureFile, Json, Only, Without, app, show_summary, with_spinner


@app.command(epilog="Example: aacmm calibrate capture.h5 -o calibration.h5 --without 'test*' --method joint")
def calibrate(
    capture: CaptureFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration to write (HDF5).")],
    method: Annotated[
        Literal["two-stage", "joint"], typer.Option(help="Scale fix after stage 1, or one least squares of poses and lengths.")
    ] = "two-stage",
    hold: Annotated[
        str, typer.Option(help="Length held in stage 1: a name, 'longest', or 'none' to free all as the paper does.")
    ] = "longest",
    only: Only = None,
    without: Without = None,
    held: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Parameters that are not identified, with commas; replaces the arm's own list."),
    ] = None,
    free: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Parameters to free besides, with commas (beta_2 for Hayati's angle).")
    ] = None,
    length_bound_mm: Annotated[float | None, typer.Option(min=0, help="Half-width of the bounds of lengths.")] = None,
    angle_bound_deg: Annotated[float | None, typer.Option(min=0, help="Half-width of the bounds of angles.")] = None,
    bound: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=WIDTH", help="Half-width of one parameter's bounds, mm or deg; repeatable."),
    ] = None,
    encoder_arcsec: Annotated[
        float | None, typer.Option(min=0, help="Known standard deviation of a reading: weighs poses. Default: estimated.")
    ] = None,
    seating_mm: Annotated[
        float | None, typer.Option(min=0, help="Known standard deviation, a coordinate, of the seat. Default: estimated.")
    ] = None,
    cross_validate: Annotated[
        bool | None,
        typer.Option(
            help="Leave out placements of the reference length one after the other. Default: yes, for a recorded capture of several."
        ),
    ] = None,
    monte_carlo: Annotated[
        bool, typer.Option("--monte-carlo", help="Check the uncertainties by Monte Carlo (JCGM 101); a minute or two.")
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse parameters that such data could not determine even without noise.")
    ] = False,
    figure: Annotated[Path | None, typer.Option(help="Draw the residuals pose by pose as PNG.")] = None,
    max_steps: Annotated[int, typer.Option(min=1, help="Step limit of each solve.")] = 300,
    as_json: Json = False,
) -> None:
    """Identify the arm from repeatability, and fix its scale with the reference lengths."""
    from ..calibration.record import record_of
    from ..calibration.stages import calibrate as run
    from ..files.calibrations import save_calibration
    from ..files.captures import load_capture
    from ..files.whole_file import fingerprint
    from ..summaries.calibration import calibration_summary
    from ..summaries.warnings import plausible
    from . import display, options

    if output.exists() and output.samefile(capture):
        raise InputError(f"{output} is the capture itself; choose another output, so that held-out sockets are not lost.")
    recording = load_capture(capture)
    recording = recording._replace(
        capture=recording.capture.select(only or None, without or ()), sources=(fingerprint(capture), *recording.sources)
    )
    bounds = options.bounds(recording.nominal, held, free, length_bound_mm, angle_bound_deg, bound or [])
    recording = recording._replace(nominal=recording.nominal._replace(arm=bounds.space.base))
    solving = {
        "method": method,
        "hold": None if hold == "none" else hold,
        "noise": options.noise(encoder_arcsec, seating_mm),
    }
    capture_used = recording.capture
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)  # the summary says it
        result = with_spinner(
            "Calibrating",
            lambda: run(bounds.space.base, capture_used, bounds, **solving, max_steps=max_steps, strict=strict),
        )
        record = record_of(result, recording)
        if cross_validate or (
            cross_validate is None and recording.true is None and _several(capture_used, len(bounds.space.names))
        ):
            from ..calibration.cross_validation import cross_validate as validated

            found = with_spinner("Cross-validating", lambda: validated(bounds.space.base, capture_used, bounds, **solving))
            record = record._replace(validation=found)
    if monte_carlo:
        from ..calibration.sampling import monte_carlo as sample

        sampled = with_spinner("Drawing trials", lambda: sample(result, capture_used))
        record = record._replace(sampled=sampled.table(), sampled_says=" ".join(sampled.sentences()))
    save_calibration(output, record)
    if figure is not None:
        from ..plot import save_calibration_figure

        save_calibration_figure(record, figure)
    show_summary(calibration_summary(record) | {"written": str(output)}, as_json, display.calibration)
    if not record.converged or not plausible(record.k):
        raise typer.Exit(1)


def _several(capture: Any, parameters: int) -> bool:
    """Whether the reference length stood in several placements, so that each can be left out."""
    if len(capture.lengths) < 2:
        return False
    from ..calibration.cross_validation import can_cross_validate

    return can_cross_validate(capture, parameters)

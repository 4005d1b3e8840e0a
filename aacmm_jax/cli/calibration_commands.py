"""The command ``calibrate``."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import IdentifiabilityWarning, InputError
from ..core.text import number
from ..core.units import DEG
from ..files.outputs import reading, together
from .app import CaptureFile, Json, Only, Without, app, examples, show_summary, with_spinner


@app.command(
    epilog=examples(
        "aacmm calibrate capture.h5 -o calibration.h5",
        "aacmm calibrate capture.h5 -o calibration.h5 --without 'test*' --method joint",
    )
)
def calibrate(
    capture: CaptureFile,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.h5", help="Calibration to write (HDF5).")],
    method: Annotated[
        Literal["two-stage", "joint"],
        typer.Option(
            help="two-stage: repeatability, then the scale by the reference lengths; joint: one least squares of both."
        ),
    ] = "two-stage",
    hold: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Length that anchors the scale in stage 1: a parameter, 'longest', or 'none' as in the paper.",
        ),
    ] = "longest",
    only: Only = None,
    without: Without = None,
    held: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES", help="Parameters that are fixed, separated by commas; replaces the list in the arm's file."
        ),
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES", help="Further parameters to identify, separated by commas (beta_2: Hayati's angle)."
        ),
    ] = None,
    length_bound_mm: Annotated[
        float | None, typer.Option(min=0, metavar="MM", help="Half-width of the bounds of length parameters.")
    ] = None,
    angle_bound_deg: Annotated[
        float | None, typer.Option(min=0, metavar="DEG", help="Half-width of the bounds of angle parameters.")
    ] = None,
    bound: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=WIDTH", help="Half-width of the bounds of one parameter, in mm or deg; repeatable."),
    ] = None,
    encoder_arcsec: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="ARCSEC",
            help="Known standard deviation of a joint reading, for the weights. Default: estimated.",
        ),
    ] = None,
    seating_mm: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="MM",
            help="Known standard deviation of the tip in its socket, for each coordinate. Default: estimated.",
        ),
    ] = None,
    cross_validate: Annotated[
        bool | None,
        typer.Option(
            help="Calibrate once without each placement of the reference length, and test the result there. "
            "Default: yes, for a recorded capture with several placements."
        ),
    ] = None,
    monte_carlo: Annotated[
        bool,
        typer.Option("--monte-carlo", help="Check the uncertainties by Monte Carlo (JCGM 101); takes a minute or two."),
    ] = False,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Refuse free parameters that such data could not determine even without noise."),
    ] = False,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Plot the residual of every pose: PNG, SVG or PDF by the name.")
    ] = None,
    max_steps: Annotated[
        int, typer.Option(min=1, max=1_000_000, metavar="N", help="Largest number of steps of each solve.")
    ] = 300,
    as_json: Json = False,
) -> None:
    """Identify the parameters of an arm from a capture.

    Stage 1 makes the tips of each socket coincide; the reference lengths then fix the scale.
    """
    from ..calibration.checks import plausible
    from ..calibration.record import record_of
    from ..calibration.single import calibrate as run
    from ..files.calibrations import save_calibration
    from ..files.captures import load_capture
    from ..files.inputs import InputFile, fingerprint
    from ..summaries.calibration import calibration_summary
    from ..summaries.warnings import does_not_fit
    from . import calibration_display

    with together(output, figure):
        reading(capture)
        if figure is not None:
            from ..plot.style import check_format

            check_format(figure)
        recording = load_capture(read := InputFile(capture))
        recording = recording._replace(
            capture=recording.capture.select(only or None, without or ()),
            sources=(fingerprint(read), *recording.sources),
        )
        bounds = _bounds(recording.nominal, held, free, length_bound_mm, angle_bound_deg, bound or [])
        recording = recording._replace(nominal=recording.nominal._replace(arm=bounds.space.base))
        solving = {
            "method": method,
            "hold": None if hold == "none" else hold,
            "noise": _noise(encoder_arcsec, seating_mm),
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

                found = with_spinner(
                    "Cross-validating", lambda: validated(bounds.space.base, capture_used, bounds, **solving)
                )
                record = record._replace(validation=found)
        if monte_carlo:
            from ..calibration.sampling import monte_carlo as sample

            sampled = with_spinner("Drawing trials", lambda: sample(result, capture_used))
            record = record._replace(sampled=sampled.table(), sampled_says=" ".join(sampled.sentences()))
        summary = calibration_summary(record)
        save_calibration(output, record, summary)
        if figure is not None:
            from ..plot import save_calibration_figure

            save_calibration_figure(record, figure)
    show_summary(summary | {"written": str(output)}, as_json, calibration_display.calibration)
    if not record.converged or not plausible(record.k) or record.implausible_residual or does_not_fit(record):
        raise typer.Exit(1)


def _bounds(
    nominal: Any,
    held: str | None,
    free: str | None,
    length_mm: float | None,
    angle_deg: float | None,
    single: Sequence[str],
) -> Any:
    """The bounds that the arm's file proposes, changed by what the command line says."""
    from ..kinematics.arm import is_length
    from ..kinematics.parameters import Bounds, Parameters

    names = _names(held) if held is not None else nominal.held
    space = Parameters.free_of(nominal.arm, held=names, free=_names(free or ""))
    override = {name: width for name, width in nominal.override.items() if name in space.names}
    seen = set()
    for text in single:
        name, _, width = text.partition("=")
        if name in seen:
            raise InputError(f"--bound gives {name} two half-widths; give it one.")
        seen.add(name)
        try:
            value = number(width.strip())
        except ValueError as error:
            raise InputError(f"--bound '{text}' is not of the form NAME=WIDTH, in mm or deg.") from error
        override[name] = value if is_length(name) else value * DEG
    return Bounds.around(
        space.base,
        space,
        length=nominal.length if length_mm is None else length_mm,
        angle=nominal.angle if angle_deg is None else angle_deg * DEG,
        override=override,
    )


def _noise(encoder_arcsec: float | None, seating_mm: float | None) -> Any:
    """The noise that is known: both of its parts, or None."""
    from ..data.noise import Noise

    if encoder_arcsec is None and seating_mm is None:
        return None
    if encoder_arcsec is None or seating_mm is None:
        missing = "--seating-mm" if seating_mm is None else "--encoder-arcsec"
        raise InputError(f"{missing} is missing: give both standard deviations, or neither to have both estimated.")
    return Noise(encoder_arcsec=encoder_arcsec, seating=seating_mm)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _several(capture: Any, parameters: int) -> bool:
    """Whether the reference length was measured in several placements, so that each can be left out."""
    if len(capture.lengths) < 2:
        return False
    from ..calibration.cross_validation import can_cross_validate

    return can_cross_validate(capture, parameters)

"""What is done with a calibration: ``evaluate``, ``report``, ``export``."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import InputError
from ..files.hdf5 import read_tables
from ..files.whole_file import fingerprint, write_text
from .app import CalibrationFile, Json, Only, Without, app, show_summary, with_spinner

About = Annotated[
    Path | None,
    typer.Option(metavar="FILE.toml", help="Laboratory, customer, item, persons, dates, as a certificate states them."),
]


@app.command(
    epilog="Examples: aacmm evaluate calibration.h5 capture.h5 --mpe Deltam=0.05 --mpe E_Uni=0.025+L/40000; aacmm evaluate points.toml"
)
def evaluate(
    calibration: Annotated[
        Path,
        typer.Argument(
            metavar="CALIBRATION.h5", help="Calibration written by calibrate; or alone a manifest (TOML) of points."
        ),
    ],
    capture: Annotated[Path | None, typer.Argument(metavar="CAPTURE.h5", help="Capture written by import or simulate.")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Evaluation to write (HDF5), for aacmm report.")] = None,
    only: Only = None,
    without: Without = None,
    mpe: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIGURE=A[+L/K]",
            help="Limit of an acceptance figure in mm, decided by ISO 14253-1; repeatable. Exit code 1 where one is not met.",
        ),
    ] = None,
    test_u_mm: Annotated[
        float, typer.Option(min=0, help="Standard uncertainty that seat, fixture and temperature add to every test value.")
    ] = 0.0,
    max_rms_mm: Annotated[float | None, typer.Option(min=0, help="Exit with code 1 where the RMS distance is larger.")] = None,
    max_deltam_mm: Annotated[float | None, typer.Option(min=0, help="Exit with code 1 where Deltam is larger.")] = None,
    max_length_error_mm: Annotated[
        float | None, typer.Option(min=0, help="Exit with code 1 where any length's error is larger.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Try a calibration on a capture, with sockets it has never seen, and run every acceptance test that the capture holds."""
    from ..acceptance.decision import read_limits
    from ..acceptance.suite import FIGURES
    from . import acceptance_display

    limits = read_limits(mpe or [], FIGURES)
    maxima = {"rms_mm": max_rms_mm, "deltam_mm": max_deltam_mm, "length_error_largest_mm": max_length_error_mm}
    maxima = {name: value for name, value in maxima.items() if value is not None}
    if capture is None:
        if maxima or only or without:
            raise InputError(
                "with a manifest of points there are only --mpe, --test-u-mm, --output and --json; name a calibration and a capture for more."
            )
        summary = _evaluated_points(calibration, output, limits, test_u_mm)
        show_summary(summary, as_json, acceptance_display.points)
    else:
        summary = _evaluated(calibration, capture, output, (only, without), limits, test_u_mm, maxima)
        show_summary(summary, as_json, acceptance_display.evaluation)
    undecided = [test for test in summary["acceptance"] if test["decision"] in ("fails", "undecided")]
    if summary["failed"] or undecided:
        raise typer.Exit(1)


@app.command(epilog="Example: aacmm report calibration.h5 -o report.html")
def report(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.h5", help="A calibration, an evaluation (aacmm evaluate -o) or a study.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Report to write: one HTML file that needs no network.")],
    about: About = None,
    as_json: Json = False,
) -> None:
    """Write a report that can be handed on: warnings, results, uncertainty, charts and tables in one HTML file, which prints well."""
    from ..files.administrative_data import read_administrative_data
    from ..report import write_report
    from . import acceptance_display

    show_summary(
        with_spinner(
            "Writing the report", lambda: write_report(file, output, None if about is None else read_administrative_data(about))
        ),
        as_json,
        acceptance_display.report,
    )


def show_evaluation(file: Path, of_points: bool, as_json: bool) -> None:
    """What an evaluation's file holds, printed."""
    from ..files.evaluations import load_evaluation, load_points
    from ..summaries.evaluation import evaluation_summary, points_summary
    from . import acceptance_display

    if of_points:
        show_summary(points_summary(load_points(file)), as_json, acceptance_display.points)
    else:
        show_summary(evaluation_summary(load_evaluation(file)), as_json, acceptance_display.evaluation)


def _evaluated(
    calibration: Path, capture: Path, output: Path | None, choice: tuple, limits: Any, u_test: float, maxima: dict[str, float]
) -> dict[str, Any]:
    from ..acceptance.record import evaluation_of
    from ..files.calibrations import load_calibration
    from ..files.captures import load_capture
    from ..files.evaluations import save_evaluation
    from ..files.whole_file import fingerprint
    from ..summaries.evaluation import evaluation_summary

    if output is not None:
        for given in (calibration, capture):
            if output.exists() and given.exists() and output.samefile(given):
                raise InputError(f"{output} is one of the files to evaluate; choose another output.")
    record, recording = load_calibration(calibration), load_capture(capture)
    recording = recording._replace(
        capture=recording.capture.select(choice[0] or None, choice[1] or ()),
        sources=(fingerprint(calibration), fingerprint(capture), *recording.sources),
    )
    found = evaluation_of(record, recording, limits=limits, u_test=u_test, maxima=maxima)
    summary = with_spinner("Evaluating", lambda: evaluation_summary(found))
    if output is not None:
        save_evaluation(output, found)
        summary["written"] = str(output)
    return summary


def _evaluated_points(manifest: Path, output: Path | None, limits: Any, u_test: float) -> dict[str, Any]:
    from ..acceptance.record import PointsRecord
    from ..files.evaluations import save_points
    from ..files.points import read_points
    from ..summaries.evaluation import points_summary

    if manifest.suffix != ".toml":
        raise InputError(f"{manifest} alone cannot be evaluated; name a capture too, or a manifest (TOML) of points.")
    if output is not None and output.exists() and manifest.exists() and output.samefile(manifest):
        raise InputError(f"{output} is the manifest itself; choose another output.")
    record = PointsRecord(read_points(manifest), limits, u_test)
    summary = points_summary(record)
    if output is not None:
        save_points(output, record)
        summary["written"] = str(output)
    return summary


@app.command(
    epilog="Examples: aacmm export calibration.h5 --format toml -o arm.toml; aacmm export calibration.h5 --format dcc --about laboratory.toml -o certificate.xml"
)
def export(
    calibration: CalibrationFile,
    form: Annotated[
        Literal["toml", "json", "csv", "dcc"],
        typer.Option(
            "--format",
            help="toml: an arm file; json: everything; csv: the parameters; dcc: a Digital Calibration Certificate (XML).",
        ),
    ] = "toml",
    which: Annotated[
        Literal["calibrated", "nominal", "true"], typer.Option("--arm", help="Which arm, for toml; true: of a simulation.")
    ] = "calibrated",
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write; standard output without it.")] = None,
    about: About = None,
) -> None:
    """Write a calibrated arm for other programs."""
    if about is not None and form != "dcc":
        raise InputError("--about is for certificates; give it with --format dcc.")
    for given in (calibration, about):
        if output is not None and given is not None and output.exists() and given.exists() and output.samefile(given):
            raise InputError(f"{output} is what the export is made from; choose another output.")
    from ..files.arms import specification_toml
    from ..files.calibrations import load_calibration
    from ..summaries.calibration import calibration_summary, parameters_csv

    record = load_calibration(calibration)
    arms = {"calibrated": record.calibrated, "nominal": record.recording.nominal, "true": record.recording.true}
    arm = arms[which]
    if arm is None:
        raise InputError(f"{calibration} is not of a simulation, so it holds no true arm.")
    if not record.converged:
        typer.echo(f"Warning: {calibration} did not converge: {record.reason}", err=True)
    source = (
        f"calibrated from {sum(record.recording.capture.sizes)} poses, {record.method}, k = {record.k:.8f}"
        if which == "calibrated"
        else ""
    )
    text = {
        "toml": lambda: specification_toml(arm, source=source),
        "json": lambda: json.dumps(calibration_summary(record), indent=2) + "\n",
        "csv": lambda: parameters_csv(record),
        "dcc": lambda: _certificate(calibration, record, about),
    }[form]()
    if output is None:
        typer.echo(text, nl=False)
    else:
        write_text(output, text)


def _certificate(calibration: Path, record: Any, about: Path | None) -> str:
    from ..certificate.document import dcc
    from ..files.administrative_data import AdministrativeData as Stated
    from ..files.administrative_data import read_administrative_data

    made = read_tables(calibration, ("calibration",)).attributes
    sources = [fingerprint(calibration), *record.recording.sources]
    return dcc(
        record,
        Stated() if about is None else read_administrative_data(about),
        created=made["created"],
        sources=sources,
        command=made["command"],
    )

"""What is done with results: ``evaluate``, ``report``, ``export``, ``show``."""

import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import InputError
from ..core.text import printable
from ..files.hdf5 import read_summary
from ..files.inputs import InputFile
from ..files.outputs import check_kept, together, write_text
from ..files.sense import check_shown
from .app import (
    KEPT,
    BaseLink,
    CalibrationFile,
    Json,
    Only,
    TipLink,
    Without,
    app,
    examples,
    prepare_jax,
    show_summary,
    warn_of_unusable,
    with_spinner,
)
from .evaluations import certificate, evaluated, evaluated_points
from .export_formats import exported

_ARM_SUFFIXES = ("", ".toml", ".urdf", ".xacro", ".yaml", ".yml")
_FORMATS = {".urdf": "urdf", ".json": "json", ".csv": "csv", ".yaml": "ur", ".yml": "ur", ".py": "python"}
_OF_ONE_ARM = ("toml", "urdf", "table", "ur", "python")

About = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml", help="Administrative data of a certificate: laboratory, customer, item, persons, dates."
    ),
]


@app.command(
    epilog=examples(
        "aacmm evaluate calibration.h5 capture.h5 --mpe Deltam=0.05 --mpe E_Uni=0.025+L/40000",
        "aacmm evaluate points.toml",
    )
)
def evaluate(
    calibration: Annotated[
        Path,
        typer.Argument(
            metavar="CALIBRATION.h5", help="Calibration, written by calibrate; or, alone, a manifest of points (TOML)."
        ),
    ],
    capture: Annotated[
        Path | None, typer.Argument(metavar="CAPTURE.h5", help="Capture, written by import or simulate.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE.h5", help="Evaluation to write (HDF5), for aacmm report." + KEPT),
    ] = None,
    only: Only = None,
    without: Without = None,
    mpe: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=A[+L/K]",
            help="Maximum permissible error of an acceptance test, mm (L: the length); repeatable. Exit code 1 where "
            "one is not met by the decision rule.",
        ),
    ] = None,
    acceptance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[jjf|asme|iso]",
            help="Run the acceptance tests of JJF 1408, ASME B89.4.22 or ISO 10360-12; repeatable. Default: those of "
            "the standard that the capture was made for, of --mpe, and of all for a manifest of points.",
        ),
    ] = None,
    test_u_mm: Annotated[
        str,
        typer.Option(
            metavar="A[+L/K]",
            help="Standard uncertainty that seat and fixture add to every test value (L: the length).",
        ),
    ] = "0",
    expansion: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OF=C,U,T,U",
            help="Thermal expansion of the artefact or the arm in an acceptance test: coefficient in 1e-6/K, "
            "temperature in C, each with its standard uncertainty; 'artefact=11.5,1,20.8,0.2'. Lengths are corrected. "
            "Of the arm only where it does not compensate its own.",
        ),
    ] = None,
    rule: Annotated[
        Literal["iso-2017", "iso-2013", "simple"] | None,
        typer.Option(
            help="Decision rule: ISO 14253-1:2017 (95 % probability), its guard band of 2013, or simple acceptance "
            "(ASME B89.7.3.1, 4:1). Default: simple for ASME, else iso-2017."
        ),
    ] = None,
    range_mm: Annotated[
        float | None,
        typer.Option(min=0, metavar="MM", help="Measuring range that the maker states, a diameter; else of the files."),
    ] = None,
    max_rms_mm: Annotated[
        float | None, typer.Option(min=0, metavar="MM", help="Exit code 1 where the RMS distance is larger.")
    ] = None,
    max_deltam_mm: Annotated[
        float | None, typer.Option(min=0, metavar="MM", help="Exit code 1 where Deltam is larger.")
    ] = None,
    max_length_error_mm: Annotated[
        float | None, typer.Option(min=0, metavar="MM", help="Exit code 1 where the error of any length is larger.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Test a calibration on a capture that it has not seen.

    Errors on data that the calibration has not used are printed next to those that its uncertainty predicts. A manifest
    of points is tested without a calibration.
    """
    from ..acceptance.decision import limit_of_text, read_limits
    from ..acceptance.influences import Influences, read_expansions
    from ..acceptance.results import METRICS
    from . import acceptance_display

    u_test, bodies = limit_of_text(test_u_mm, f"--test-u-mm {test_u_mm}"), read_expansions(expansion or [])
    of_test = {
        "limits": read_limits(mpe or [], METRICS),
        "u_test": u_test.fixed,
        "influences": Influences(0.0, 1 / u_test.divisor, bodies.get("artefact"), bodies.get("arm")),
        "rule": rule,
    }
    maxima = {"rms_mm": max_rms_mm, "deltam_mm": max_deltam_mm, "length_error_largest_mm": max_length_error_mm}
    maxima = {name: value for name, value in maxima.items() if value is not None}
    if capture is None:
        if maxima or only or without:
            raise InputError(
                "a manifest of points takes no --max-..., --only and --without; name a calibration and a capture for "
                "these options."
            )
        summary = evaluated_points(calibration, output, acceptance, range_mm, of_test)
        show_summary(summary, as_json, acceptance_display.points)
    else:
        of_test |= {"maxima": maxima, "standards": acceptance}
        summary = evaluated(calibration, capture, output, (only, without), range_mm, of_test)
        show_summary(summary, as_json, acceptance_display.evaluation)
    undecided = [test for test in summary["acceptance"] if test["decision"] in ("fails", "undecided")]
    if summary["failed"] or undecided:
        raise typer.Exit(1)


@app.command(epilog=examples("aacmm report calibration.h5 -o report.html"))
def report(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.h5",
            help="Calibration, evaluation (evaluate -o), study or compared models (compare-models -o).",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE.html",
            help="Report to write: one HTML file that needs no network connection." + KEPT,
        ),
    ],
    about: About = None,
    as_json: Json = False,
) -> None:
    """Write a report of a result as one HTML file.

    It holds warnings, results, uncertainties, charts and tables, and can be printed.
    """
    from ..files.administrative_data import read_administrative_data
    from ..report import write_report
    from . import acceptance_display

    with together(output):
        stated = None if about is None else read_administrative_data(about)
        summary = with_spinner("Writing the report", lambda: write_report(file, output, stated))
    show_summary(summary, as_json, acceptance_display.report)


@app.command(
    epilog=examples(
        "aacmm export calibration.h5 --format toml -o arm.toml",
        "aacmm export calibration.h5 -o robot.urdf",
        "aacmm export calibration.h5 --format table --convention craig --units m-rad",
        "aacmm export calibration.h5 --format dcc --evaluation tests.h5 --about laboratory.toml -o certificate.xml",
    )
)
def export(
    calibration: CalibrationFile,
    form: Annotated[
        Literal["toml", "json", "csv", "dcc", "urdf", "table", "offsets", "ur", "python"] | None,
        typer.Option(
            "--format",
            help="toml: the arm; json: the whole summary; csv: parameters; dcc: Digital Calibration Certificate (XML); "
            "urdf: the URDF of the nominal arm, with calibrated origins; table: D-H table (CSV); offsets: zero offsets "
            "of the joints alone, refitted; ur: kinematics.yaml of Universal Robots; python: a program that needs only "
            "NumPy. Default: by the name of the output (.urdf, .json, .csv, .yaml, .py), else toml.",
        ),
    ] = None,
    which: Annotated[
        Literal["calibrated", "nominal", "true"] | None,
        typer.Option(
            "--arm",
            help="Which arm to write with --format toml, urdf, table, ur or python; a simulation has a true one. "
            "Default: calibrated.",
        ),
    ] = None,
    convention: Annotated[
        Literal["standard", "craig"] | None, typer.Option(help="Of --format table. Default: standard.")
    ] = None,
    units: Annotated[
        Literal["mm-deg", "m-rad"] | None, typer.Option(help="Of --format table. Default: mm-deg.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="File to write. Default: standard output." + KEPT,
        ),
    ] = None,
    about: About = None,
    evaluation: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.h5",
            help="Of --format dcc: an evaluation (aacmm evaluate -o) of this calibration, whose acceptance tests are "
            "added.",
        ),
    ] = None,
) -> None:
    """Write a calibration for other programs or controllers."""
    written_as: str = form or _FORMATS.get("" if output is None else output.suffix.lower(), "toml")
    if (about is not None or evaluation is not None) and written_as != "dcc":
        raise InputError("--about and --evaluation are for certificates; give them with --format dcc.")
    if which is not None and written_as not in _OF_ONE_ARM:
        raise InputError(
            f"--arm is for --format {', '.join(_OF_ONE_ARM)}; leave it out, as {written_as} holds what it needs."
        )
    if (convention is not None or units is not None) and written_as != "table":
        raise InputError("--convention and --units are for tables; give them with --format table.")
    from ..files.calibrations import load_calibration

    with together(output):
        record = load_calibration(read := InputFile(calibration))
        arms = {"calibrated": record.calibrated, "nominal": record.recording.nominal, "true": record.recording.true}
        specification = arms[which or "calibrated"]
        if specification is None:
            raise InputError(f"{calibration} is not of a simulation, so it has no true arm; choose another --arm.")
        warn_of_unusable(calibration, record)
        source = ""
        if which in (None, "calibrated"):
            scale = "" if math.isnan(record.k) else f", k = {record.k:.8f}"
            source = f"calibrated from {len(record.recording.capture.readings)} poses, {record.method}{scale}"
        if written_as == "dcc":
            text, notes = certificate(read, record, about, evaluation), ()
        else:
            text, notes = exported(record, specification, written_as, source, convention, units)
        if output is not None:
            if written_as == "urdf" and (original := record.recording.nominal.urdf) and text != original.text:
                check_kept(output, original.text)
            write_text(output, text)
    typer.echo(text, nl=False) if output is None else typer.echo(f"Written: {output}")
    for note in notes:
        typer.echo(printable(note), err=output is None)


@app.command(epilog=examples("aacmm show calibration.h5", "aacmm show panda"))
def show(
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="Capture, calibration, evaluation, study or compared models (HDF5), or an arm: a TOML file, a URDF, a "
            "kinematics.yaml or a shipped name.",
        ),
    ],
    cell: Annotated[int | None, typer.Option(min=1, metavar="N", help="Of a study: show this cell in full.")] = None,
    figures: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Of a study: write its figures (PNG) to this folder.")
    ] = None,
    base: BaseLink = None,
    tip: TipLink = None,
    as_json: Json = False,
) -> None:
    """Print the content of a file."""
    path = Path(file)
    if path.suffix in _ARM_SUFFIXES and not (os.path.isfile(path) and path.suffix == ""):
        _show_arm(file, base, tip, as_json)
        return
    if base is not None or tip is not None:
        raise InputError(f"--base and --tip are links of a URDF, and {file} is none; leave them out.")
    attributes, summary = read_summary(path, ("capture", "calibration", "evaluation", "study", "model comparison"))
    kind = attributes["kind"]
    if kind == "study":
        from .study_commands import show_study

        prepare_jax()
        show_study(path, cell, figures, as_json)
        return
    if cell is not None or figures is not None:
        raise InputError(f"{file} holds a {kind}; --cell and --figures are for studies.")
    from . import acceptance_display, calibration_display
    from .models_command import display as display_models

    if kind == "evaluation" and attributes.get("of") == "points":
        kind = "points"
    display = {
        "capture": calibration_display.capture,
        "calibration": calibration_display.calibration,
        "evaluation": acceptance_display.evaluation,
        "points": acceptance_display.points,
        "model comparison": display_models,
    }[kind]
    if summary is None or kind == "model comparison":  # whose tables hold all of it
        summary = _summary_of(path, kind)
    else:
        check_shown(path, attributes["kind"], summary)
    show_summary(summary, as_json, display)


def _show_arm(file: str, base: str | None, tip: str | None, as_json: bool) -> None:
    from ..files.arms import load_specification
    from ..summaries.calibration import arm_summary
    from . import calibration_display

    prepare_jax()
    specification = load_specification(file, base=base, tip=tip)
    summary = arm_summary(specification)
    if specification.urdf is not None:
        from ..files.urdf import urdf_chain

        summary["urdf"]["first_frame_in_base_mm"] = urdf_chain(specification.urdf).base.tolist()
    show_summary(summary, as_json, calibration_display.arm)


def _summary_of(file: Path, kind: str) -> dict[str, Any]:
    """The summary of a file that holds none: one written through Python, or by another version."""
    from ..files.calibrations import load_calibration
    from ..files.captures import load_capture
    from ..files.compared_models import load_compared_models
    from ..files.evaluations import load_evaluation, load_points
    from ..summaries.calibration import calibration_summary, capture_summary
    from ..summaries.evaluation import evaluation_summary, points_summary

    load, summarise = {
        "capture": (load_capture, capture_summary),
        "calibration": (load_calibration, calibration_summary),
        "evaluation": (load_evaluation, evaluation_summary),
        "points": (load_points, points_summary),
        "model comparison": (load_compared_models, dict),
    }[kind]
    prepare_jax()
    return summarise(load(file))

"""What is done with results: ``evaluate``, ``report``, ``show``."""

import os
from pathlib import Path
from typing import Any, Literal

import typer

from ..core.errors import InputError
from ..core.text import shorten
from ..files.hdf5 import read_summary
from ..files.inputs import InputFile, fingerprint
from ..files.outputs import together
from ..files.sense import check_shown
from . import options
from .app import app, examples, prepare_jax, show_summary, with_spinner
from .options import argument, option, output

_ARM_SUFFIXES = ("", ".toml", ".urdf", ".xacro", ".yaml", ".yml")
ABOUT = option("FILE.toml", "Administrative data of a certificate: laboratory, customer, item, persons, dates.")
# How each kind of file is read, its summary, and what people see of it: functions by module, imported when needed.
_KINDS = {
    "capture": ("captures.load_capture", "calibration.capture_summary", "calibration_views.capture"),
    "calibration": (
        "calibrations.load_calibration",
        "calibration.calibration_summary",
        "calibration_views.calibration",
    ),
    "evaluation": ("evaluations.load_evaluation", "evaluation.evaluation_summary", "evaluation_views.evaluation"),
    "points": ("evaluations.load_evaluation", "evaluation.points_summary", "evaluation_views.points"),
}


@app.command(
    epilog=examples(
        "aacmm evaluate calibration.h5 capture.h5 --mpe Deltam=0.05 --mpe E_Uni=0.025+L/40000",
        "aacmm evaluate points.toml",
    )
)
def evaluate(
    calibration: Path = argument(
        "CALIBRATION.h5", "Calibration, written by calibrate; or, alone, a manifest of points (TOML)."
    ),
    capture: Path | None = argument("CAPTURE.h5", "Capture, written by import or simulate.", None),
    output: Path | None = output("FILE.h5", "Evaluation to write (HDF5), for aacmm report.", None),
    only: list[str] | None = options.ONLY,
    without: list[str] | None = options.WITHOUT,
    mpe: list[str] | None = option(
        "NAME=A[+L/K]",
        "Maximum permissible error of an acceptance test, mm (L: the length); repeatable. Exit code 1 where one is not "
        "met by the decision rule.",
    ),
    acceptance: list[str] | None = option(
        "[jjf|asme|iso]",
        "Run the acceptance tests of JJF 1408, ASME B89.4.22 or ISO 10360-12; repeatable. Default: those of the "
        "standard that the capture was made for, of --mpe, and of all for a manifest of points.",
    ),
    test_u_mm: str = option(
        "A[+L/K]",
        "Standard uncertainty that seat and fixture add to every test value (L: the length).",
        default="0",
    ),
    expansion: list[str] | None = option(
        "OF=C,U,T,U",
        "Thermal expansion of the artefact or the arm in an acceptance test: coefficient in 1e-6/K, temperature in C, "
        "each with its standard uncertainty; 'artefact=11.5,1,20.8,0.2'. Lengths are corrected. Give it for the arm "
        "only where the arm does not compensate its own expansion.",
    ),
    rule: Literal["iso-2017", "iso-2013", "simple"] | None = option(
        None,
        "Decision rule: ISO 14253-1:2017 (95 % probability), its guard band of 2013, or simple acceptance "
        "(ASME B89.7.3.1, 4:1). Default: simple for ASME, else iso-2017.",
    ),
    range_mm: float | None = option(
        "MM", "Measuring range that the maker states, a diameter. Default: that of the files.", min=0
    ),
    max_rms_mm: float | None = option("MM", "Exit code 1 where the RMS distance is larger.", min=0),
    max_deltam_mm: float | None = option("MM", "Exit code 1 where Deltam is larger.", min=0),
    max_length_error_mm: float | None = option("MM", "Exit code 1 where the error of any length is larger.", min=0),
    as_json: bool = options.JSON,
) -> None:
    """Test a calibration on a capture that it has not seen.

    Errors on data that the calibration has not used are printed next to those that its uncertainty predicts. A manifest
    of points is tested without a calibration.
    """
    from ..acceptance.judgement import Influences, limit_of_text, read_expansions, read_limits
    from ..acceptance.results import METRICS
    from . import evaluation_views

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
        summary = _evaluated_points(calibration, output, acceptance, range_mm, of_test)
        show_summary(summary, as_json, evaluation_views.points)
    else:
        of_test |= {"maxima": maxima, "standards": acceptance}
        summary = _evaluated(calibration, capture, output, (only, without), range_mm, of_test)
        show_summary(summary, as_json, evaluation_views.evaluation)
    undecided = [test for test in summary["acceptance"] if test["decision"] in ("fails", "undecided")]
    if summary["failed"] or undecided:
        raise typer.Exit(1)


def _evaluated(
    calibration: Path,
    capture: Path,
    output: Path | None,
    choice: tuple,
    measuring_range: float | None,
    of_test: dict[str, Any],
) -> dict[str, Any]:
    """Evaluate a calibration on a capture; the summary."""
    from ..acceptance.record import evaluation_of
    from ..diagnostics.findings import findings_of, sentences
    from ..files.calibrations import load_calibration
    from ..files.captures import load_capture
    from ..files.evaluations import save_evaluation
    from ..summaries.evaluation import evaluation_summary

    with together(output):
        read = InputFile(calibration), InputFile(capture)
        record, recording = load_calibration(read[0]), load_capture(read[1])
        recording = recording._replace(
            capture=recording.capture.select(choice[0] or None, choice[1] or ()),
            sources=(*map(fingerprint, read), *recording.sources),
            measuring_range=measuring_range or recording.measuring_range,
        )
        stored = read_summary(read[0], ("calibration",))[1]
        warnings = sentences(findings_of(record)) if stored is None else stored["warnings"]
        evaluation = evaluation_of(record, recording, **of_test)._replace(calibration_warnings=tuple(warnings))
        summary = with_spinner("Evaluating", lambda: evaluation_summary(evaluation))
        if not summary["acceptance"]:
            _refuse_options_of_tests(of_test, measuring_range)
        if output is not None:
            save_evaluation(output, evaluation, summary)
            summary["written"] = str(output)
    return summary


def _refuse_options_of_tests(of_test: dict[str, Any], measuring_range: float | None) -> None:
    """Raise `InputError` where options are given that only acceptance tests have, and none was made."""
    influences = of_test["influences"]
    given = {
        "--rule": of_test["rule"] is not None,
        "--test-u-mm": of_test["u_test"] > 0 or influences.u_relative > 0,
        "--expansion": influences.artefact is not None or influences.arm is not None,
        "--range-mm": measuring_range is not None,
    }
    if any(given.values()):
        raise InputError(
            f"{shorten([name for name, there in given.items() if there])} applies to acceptance tests only; this "
            "capture supports none, or none was requested: name them with --acceptance, or leave the option out."
        )


def _evaluated_points(
    manifest: Path,
    output: Path | None,
    standards: list[str] | None,
    measuring_range: float | None,
    of_test: dict[str, Any],
) -> dict[str, Any]:
    """Run the acceptance tests of a manifest of points; the summary."""
    from ..acceptance.record import PointsRecord
    from ..acceptance.standards import STANDARDS, checked_standards
    from ..files.evaluations import save_evaluation
    from ..files.manifest import read_points
    from ..summaries.evaluation import points_summary

    if manifest.suffix != ".toml":
        raise InputError(
            f"{manifest} alone cannot be evaluated; name a capture as well, or a manifest of points (TOML)."
        )
    with together(output):
        chosen = checked_standards(STANDARDS if standards is None else standards)
        measured = read_points(manifest)
        measured = measured._replace(measuring_range=measuring_range or measured.measuring_range)
        record = PointsRecord(measured, standards=chosen, **of_test)
        summary = points_summary(record)
        if output is not None:
            save_evaluation(output, record, summary)
            summary["written"] = str(output)
    return summary


@app.command(epilog=examples("aacmm report calibration.h5 -o report.html"))
def report(
    file: Path = argument("FILE.h5", "File to report: a calibration, evaluation, study or model comparison."),
    output: Path = output("FILE.html", "Report to write: one HTML file that needs no network connection."),
    about: Path | None = ABOUT,
    as_json: bool = options.JSON,
) -> None:
    """Write a report of a result as one HTML file.

    It holds warnings, results, uncertainties, charts and tables, and can be printed.
    """
    from ..files.administrative_data import read_administrative_data
    from ..report import write_report
    from . import evaluation_views

    with together(output):
        stated = None if about is None else read_administrative_data(about)
        summary = with_spinner("Writing the report", lambda: write_report(file, output, stated))
    show_summary(summary, as_json, evaluation_views.report)


@app.command(epilog=examples("aacmm show calibration.h5", "aacmm show panda"))
def show(
    file: str = argument(
        "FILE",
        "File to show: a capture, calibration, evaluation, study or model comparison (HDF5), or an arm: a TOML file, a "
        "URDF, a kinematics.yaml or a shipped name.",
    ),
    cell: int | None = option("N", "Show this cell of a study in full.", min=1),
    figures: Path | None = option("FOLDER", "Write the figures of a study (PNG) to this folder."),
    base: str | None = options.BASE_LINK,
    tip: str | None = options.TIP_LINK,
    as_json: bool = options.JSON,
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
    if kind == "model comparison":  # whose tables hold all of it
        from ..files.compared_models import load_compared_models
        from .calibration_commands import compared_models

        prepare_jax()
        show_summary(dict(load_compared_models(path)), as_json, compared_models)
        return
    if kind == "evaluation" and attributes.get("of") == "points":
        kind = "points"
    load, summarise, view = _KINDS[kind]
    if summary is None:  # of a file that was written through Python, or by another version
        prepare_jax()
        summary = _imported("summaries", summarise)(_imported("files", load)(path))
    else:
        check_shown(path, attributes["kind"], summary)
    show_summary(summary, as_json, _imported("cli", view))


def _imported(folder: str, name: str) -> Any:
    """A function of a module that is imported only now."""
    from importlib import import_module

    module, _, function = name.partition(".")
    return getattr(import_module(f"...{folder}.{module}", __name__), function)


def _show_arm(file: str, base: str | None, tip: str | None, as_json: bool) -> None:
    from ..files.arms import load_specification
    from ..summaries.calibration import arm_summary
    from . import calibration_views

    prepare_jax()
    specification = load_specification(file, base=base, tip=tip)
    summary = arm_summary(specification)
    if specification.urdf is not None:
        from ..files.urdf import urdf_chain

        summary["urdf"]["first_frame_in_base_mm"] = urdf_chain(specification.urdf).base.tolist()
    show_summary(summary, as_json, calibration_views.arm)

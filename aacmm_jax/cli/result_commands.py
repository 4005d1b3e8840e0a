"""What is done with results: ``evaluate``, ``report``, ``show``."""

import os
from pathlib import Path
from typing import Any, Literal

import typer

from .. import acceptance as acceptance_tests
from .. import files, pipeline, plot, summaries
from ..core.errors import InputError
from ..files.hdf5 import read_summary
from ..files.inputs import ROBOT_FILES, InputFile, fingerprint
from ..files.outputs import together
from ..files.stored_checks import check_shown
from . import options, views
from .app import command, prepare_jax, read_recording, show_summary, with_spinner
from .arm_command import first_frame
from .options import argument, option, output

_ARM_SUFFIXES = ("", ".toml", *ROBOT_FILES, ".yaml", ".yml", ".conf")
# What reads each kind of file, what makes its summary, and what people see of it.
_KINDS = {
    "capture": ("load_capture", "calibration.capture_summary", views.capture),
    "calibration": ("load_calibration", "calibration.calibration_summary", views.calibration),
    "evaluation": ("load_evaluation", "evaluation.evaluation_summary", views.evaluation),
    "points": ("load_evaluation", "evaluation.points_summary", views.points),
}

_COMPARISONS = {
    "model comparison": ("load_compared_models", "compared_models.compared_models"),
    "comparison": ("load_comparison", "drift.comparison"),
}


@command(
    "aacmm evaluate calibration.h5 capture.h5 --mpe Deltam=0.05 --mpe E_Uni=0.025+L/40000",
    "aacmm evaluate points.toml",
)
def evaluate(
    calibration: Path = argument(
        "Calibration, written by aacmm calibrate; or a manifest of recorded points (TOML), for which no capture is "
        "given.",
        "CALIBRATION.h5",
    ),
    capture: Path | None = argument(
        "Capture, written by aacmm import or aacmm simulate; or the manifest of one.",
        "CAPTURE.h5|MANIFEST.toml",
        None,
    ),
    output: Path | None = output("File to write the evaluation to (HDF5); aacmm report reads it.", "FILE.h5", None),
    only: list[str] | None = options.ONLY,
    without: list[str] | None = options.WITHOUT,
    mpe: list[str] | None = option(
        "Maximum permissible error (mm) of an acceptance test; L is the measured length. May be given several times. "
        "The exit code is 1 if a value does not conform by the decision rule.",
        "NAME=A[+L/K]",
    ),
    acceptance: list[str] | None = option(
        "Run the acceptance tests of JJF 1408, ASME B89.4.22 or ISO 10360-12; may be given several times. Default: "
        "the tests of the standard for which the capture was made, and those that --mpe names; for a manifest of "
        "points, the tests of all standards.",
        "[jjf|asme|iso]",
    ),
    test_u_mm: str = option(
        "Standard uncertainty (mm) that seat and fixture add to every test value; L is the measured length.",
        "A[+L/K]",
        default="0",
    ),
    expansion: list[str] | None = option(
        "Thermal expansion of the artefact or the arm in an acceptance test: coefficient (1e-6/K) and temperature "
        "(C), each followed by its standard uncertainty, for example 'artefact=11.5,1,20.8,0.2'. Lengths are "
        "corrected for this expansion. Give the expansion of the arm only if the arm does not compensate for its "
        "temperature.",
        "OF=C,U,T,U",
    ),
    rule: Literal["iso-2017", "iso-2013", "simple"] | None = option(
        "Decision rule: ISO 14253-1:2017 (95 % probability), ISO 14253-1:2013 (guard band U), or simple acceptance "
        "(ASME B89.7.3.1, 4:1). Default: simple for ASME, otherwise iso-2017."
    ),
    range_mm: float | None = option(
        "Measuring range (a diameter) stated by the maker. Default: the range stated in the capture or manifest.", min=0
    ),
    max_rms_mm: float | None = option(
        "Exit with code 1 if the RMS distance of the poses from their geometry is larger than this.", min=0
    ),
    max_deltam_mm: float | None = option(
        "Exit with code 1 if Deltam (largest half range of a coordinate in a socket) is larger than this.", min=0
    ),
    max_length_error_mm: float | None = option(
        "Exit with code 1 if the error of any length is larger than this.", min=0
    ),
    keep: list[str] | None = option(
        "Keep what the calibration found instead of fitting it to the capture: the position of the target on the arm "
        "('target', if it was not remounted), or the frame of the instrument or artefact in the base frame ('frame', "
        "if neither has moved). May be given twice.",
        "[target|frame]",
    ),
    residuals: Path | None = options.RESIDUALS,
    as_json: bool = options.JSON,
) -> None:
    """Test a calibration on a capture that was not used for it.

    Errors on held-out data are printed next to the errors that the uncertainty of the calibration predicts. A manifest
    of points is tested without a calibration.
    """
    from ..acceptance.judgement import limit_of_text, read_expansions, read_limits
    from ..pipeline.capture_evaluation import evaluate_points

    u_test, bodies = limit_of_text(test_u_mm, f"--test-u-mm {test_u_mm}"), read_expansions(expansion or [])
    maxima = {"rms_mm": max_rms_mm, "deltam_mm": max_deltam_mm, "length_error_largest_mm": max_length_error_mm}
    chosen = pipeline.EvaluationOptions(
        only=only or None,
        without=without or (),
        limits=read_limits(mpe or [], acceptance_tests.METRICS),
        u_test=u_test.fixed,
        influences=acceptance_tests.Influences(0.0, 1 / u_test.divisor, bodies.get("artefact"), bodies.get("arm")),
        rule=rule,
        standards=acceptance,
        measuring_range=range_mm,
        keep=tuple(keep or ()),
        maxima={name: value for name, value in maxima.items() if value is not None},
    )
    if residuals is not None and capture is None:
        raise InputError("--residuals is of the poses of a capture, but only points are given; leave it out.")
    with together(output, residuals):
        if capture is None:
            record = evaluate_points(_points(calibration), **chosen._asdict())
            summarise = summaries.evaluation.points_summary
        else:
            record = _evaluation(InputFile(calibration), capture, chosen)
            summarise = summaries.evaluation.evaluation_summary
        summary = with_spinner("Evaluating", lambda: summarise(record))
        if output is not None:
            files.save_evaluation(output, record, summary)
            summary["written"] = str(output)
        if residuals is not None:
            options.write_residuals(residuals, record)
    show_summary(summary, as_json, views.points if capture is None else views.evaluation)
    if not summary["verdict"]["achieved"]:
        raise typer.Exit(1)


def _evaluation(calibration: InputFile, capture: Path, chosen: Any) -> Any:
    """The record of a calibration evaluated on a capture, whose warnings the calibration's file may have."""
    from ..pipeline.capture_evaluation import evaluate_capture

    record, recording = files.load_calibration(calibration), read_recording(capture)
    sources = (fingerprint(calibration), *recording.sources)
    stored = read_summary(calibration, ("calibration",))[1]
    chosen = chosen._replace(calibration_warnings=None if stored is None else stored["warnings"])
    return evaluate_capture(record, recording._replace(sources=sources), **chosen._asdict())


def _points(manifest: Path) -> Any:
    """The points of a manifest."""
    if manifest.suffix != ".toml":
        raise InputError(
            f"{manifest} alone cannot be evaluated; name a capture as well, or a manifest of points (TOML)."
        )
    return files.read_points(manifest)


@command("aacmm report calibration.h5 -o report.html")
def report(
    file: Path = argument(
        "File to write a report of: a calibration, evaluation, study, model comparison or comparison of calibrations.",
        "FILE.h5",
    ),
    output: Path = output(
        "File to write the report to: one HTML file, which can be read without a network connection.", "FILE.html"
    ),
    about: Path | None = options.ABOUT,
    as_json: bool = options.JSON,
) -> None:
    """Write a report of a result as one HTML file.

    The report contains warnings, results, uncertainties, charts and tables, and can be printed.
    """
    from ..report import write_report

    with together(output):
        stated = None if about is None else files.read_administrative_data(about)
        summary = with_spinner("Writing the report", lambda: write_report(file, output, stated))
    show_summary(summary, as_json, views.report)


@command("aacmm show calibration.h5", "aacmm show panda")
def show(
    file: str = argument(
        "File to show: a capture, calibration, evaluation, study, model comparison or comparison of calibrations "
        "(HDF5), or an arm (TOML file, URDF, MJCF, kinematics.yaml, or the name of an arm that ships with aacmm).",
        "FILE",
    ),
    cell: int | None = option("Show all results of this cell of a study.", "N", min=1),
    figures: Path | None = option("Write the figures of a study (PNG) to this folder.", "FOLDER"),
    base: str | None = options.BASE_LINK,
    tip: list[str] | None = options.TIP_LINK,
    as_json: bool = options.JSON,
) -> None:
    """Print the content of a file."""
    path = Path(file)
    if path.suffix in _ARM_SUFFIXES and not (os.path.isfile(path) and path.suffix == ""):
        prepare_jax()
        specification = files.load_specification(file, base=base, tip=tip)
        summary = summaries.calibration.arm_summary(specification)
        if specification.urdf is not None:
            summary["urdf"]["first_frame_in_base_mm"] = first_frame(specification).tolist()
        show_summary(summary, as_json, views.arm)
        return
    if base is not None or tip is not None:
        raise InputError(
            f"--base and --tip name links of a URDF or MJCF, but {file} is neither; leave out --base and --tip."
        )
    attributes, summary = read_summary(path, (*_KINDS, "study", *_COMPARISONS))
    kind = attributes["kind"]
    if kind == "study":
        prepare_jax()
        _show_study(path, cell, figures, as_json)
        return
    if cell is not None or figures is not None:
        raise InputError(f"{file} is not a study but a file of the kind '{kind}'; leave out --cell and --figures.")
    if kind in _COMPARISONS:  # whose summary holds all of it
        prepare_jax()
        load, view = _COMPARISONS[kind]
        module, _, function = view.partition(".")
        show_summary(getattr(files, load)(path), as_json, getattr(getattr(summaries, module), function))
        return
    load, summarise, view = _KINDS["points" if attributes.get("of") == "points" else kind]
    if summary is None:  # of a file that was written through Python, or by another version
        prepare_jax()
        module, _, function = summarise.partition(".")
        summary = getattr(getattr(summaries, module), function)(getattr(files, load)(path))
    else:
        check_shown(path, kind, summary)
    show_summary(summary, as_json, view)


def _show_study(file: Path, cell: int | None, figures: Path | None, as_json: bool) -> None:
    """Print a study's results, and draw its figures."""
    from ..study.results import study_summary
    from ..study.store import Results
    from ..study.tables import study_view

    results = Results.of(file)
    if cell is not None and cell > len(results.study.cells):
        raise InputError(
            f"{file} has {len(results.study.cells)} cells, so there is no cell {cell}; choose a cell from 1 to "
            f"{len(results.study.cells)}."
        )
    summary = with_spinner("Reading", lambda: study_summary(results, cell))
    if figures is not None:
        with together():
            paths = with_spinner("Drawing", lambda: plot.save_study_figures(results, figures))
        summary["figures_written"] = [str(path) for path in paths]
    show_summary(summary, as_json, study_view)

"""The commands ``calibrate``, ``compare-models`` and ``compare``."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import typer

from .. import files, pipeline, plot, summaries
from ..core.errors import IdentifiabilityWarning, InputError
from ..files.hdf5 import read_tables
from ..files.inputs import InputFile, fingerprint
from ..files.outputs import reading, together, write_text
from ..model.loss_names import LossName
from ..uncertainty.coverage import LEVEL
from . import arm_options, options, views
from .app import command, read_recording, show_summary, with_spinner
from .options import argument, flag, option, output, seed


@command(
    "aacmm calibrate capture.toml",
    "aacmm calibrate capture.h5 -o calibration.h5",
    "aacmm calibrate capture.h5 -o calibration.h5 --without 'test*' --method joint",
    "aacmm calibrate monday.h5 tuesday.h5 -o calibration.h5 --robust tukey",
    "aacmm calibrate capture.h5 -o calibration.h5 --prior length=0.5mm,angle=0.05deg",
    "aacmm calibrate capture.h5 -o calibration.h5 --hold-out 0.3 --residuals residuals.csv",
)
def calibrate(
    capture: list[Path] = argument(
        "Capture or manifest; or several of one arm, each of one session.", "CAPTURE.h5|MANIFEST.toml ..."
    ),
    output: Path | None = output(
        "Calibration to write (HDF5). Default: the name of the first capture, ending in -calibration.h5.",
        "FILE.h5",
        None,
    ),
    method: Literal["two-stage", "joint"] | None = option(
        "two-stage: identify the parameters from the repeatability in each socket, then set the scale with the "
        "reference lengths; joint: one least-squares fit of all data. Default: joint if there are observations other "
        "than sockets, a robust loss or a prior; otherwise two-stage."
    ),
    robust: LossName | None = option(
        "Use this robust loss, which down-weights outlying poses and lists them. It turns off the search for noisy "
        "encoders."
    ),
    model: str | None = option(
        "Model these non-geometric errors of the joints, for example dh,gravity,harmonics=1+2,gear,coupled=2-3; dh "
        "alone includes none of them; gravity=masses takes the masses of the URDF as known. Default: the model of the "
        "arm file; if it has none, the model that predicts held-out regions best.",
        "KINDS",
    ),
    prior: str | None = option(
        "Prior standard deviations of parameters about their nominal values, for example 'length=0.5mm,angle=0.05deg' "
        "or 'd_3=750.2+-0.1mm'. 'alpha=learn' estimates the standard deviation of the group alpha from the data, and "
        "'learn' estimates the standard deviations of all groups; 'none' uses no prior. Default: the prior of the arm "
        "file.",
        "GROUP=SD,...",
    ),
    scale: Literal["measured", "nominal"] = option(
        "nominal: solve stage 1 only and keep the scale of the nominal arm, for a capture with no measurement that "
        "fixes the scale.",
        default="measured",
    ),
    same_probe: bool = flag(
        "--same-probe", "Use one probe position for all sessions, because the probe was not remounted."
    ),
    hold_out: str | None = option(
        "Do not calibrate with these poses, and test the result on them: a share of the poses of each observation, "
        "drawn at random ('0.3'), or a group by its name or shell pattern (a socket, a placement, a session).",
        "SHARE|GROUP",
    ),
    only_poses: int | None = option(
        "Calibrate with N poses drawn at random, and test the result on the remaining poses.", "N", min=1
    ),
    seed: int = seed("--hold-out and --only-poses"),
    hold: str = option(
        "Length parameter that stage 1 holds constant (scale anchor): its name, 'longest', or 'none' as in Cheng et "
        "al. 2018.",
        "NAME",
        default="longest",
    ),
    only: list[str] | None = options.ONLY,
    without: list[str] | None = options.WITHOUT,
    held: str | None = option(
        "Hold these parameters at their nominal values (names separated by commas). Default: the list in the arm file.",
        "NAMES",
    ),
    arm_fixed: bool = flag(
        "--arm-fixed",
        "Hold all parameters of the arm at their nominal values: identify only the geometry, such as the mount of a "
        "camera (hand-eye calibration).",
    ),
    free: str | None = option(
        "Also identify these parameters (names separated by commas), for example the Hayati angle beta_2.", "NAMES"
    ),
    length_bound_mm: float | None = option("Half-width of the bounds of length parameters.", min=0),
    angle_bound_deg: float | None = option("Half-width of the bounds of angle parameters.", min=0),
    bound: list[str] | None = option(
        "Half-width of the bounds of one parameter, in mm or deg; may be given several times.", "NAME=WIDTH"
    ),
    encoder_arcsec: float | None = options.KNOWN_ENCODER_NOISE,
    linear_encoder_mm: float | None = options.LINEAR_ENCODER_NOISE,
    seating_mm: float | None = options.KNOWN_SEATING_NOISE,
    keep_noise: bool = flag(
        "--keep-noise", "Do not re-estimate the noise of an encoder found to be noisier than stated."
    ),
    shared_errors: bool = option(
        "Look for errors shared by several poses, and include these errors in the uncertainties.", default=True
    ),
    cross_validate: bool | None = option(
        "Hold out each placement, station or other group of observations in turn, calibrate with the others, and test "
        "the result on the group held out. Of one group (one tracker and one target), its observations are held out in "
        "turn if the manifest divides it into at least three ('group'), or else regions of joint space "
        "(from 40 poses on). Default: yes for a recorded capture with several placements of the reference length, "
        "unless --model, --prior or --robust is given."
    ),
    leave_out: list[str] | None = option(
        "With --cross-validate: hold out, as one group, all sockets and observations whose names match ('monday/*'); "
        "may be given several times.",
        "PATTERN",
    ),
    monte_carlo: bool = flag(
        "--monte-carlo", "Check the uncertainties by Monte Carlo simulation (JCGM 101), which takes a minute or two."
    ),
    strict: bool = flag(
        "--strict",
        "Stop with an error if there are free parameters that the data could not determine even without noise.",
    ),
    remove_contradicting: bool = flag(
        "--remove-contradicting",
        "Leave out a socket, placement or station that contradicts all others, even with --no-automatic.",
    ),
    automatic: bool = option(
        "Use a prior if there are too few data, correct readings whose order, signs, zeros or units are wrong, widen "
        "default bounds that the fit reaches, leave out groups that contradict all others, and choose the model of the "
        "joints that predicts held-out regions best. What is stated by options or the arm file stays as stated.",
        default=True,
    ),
    residuals: Path | None = options.RESIDUALS,
    figure: Path | None = option("Plot the residual of every pose to this file (.png, .svg or .pdf).", "FILE"),
    max_steps: int = option(
        "Maximum number of solver steps in each least-squares fit.", "N", default=300, min=1, max=1_000_000
    ),
    as_json: bool = options.JSON,
) -> None:
    """Identify the parameters of an arm from captures.

    Stage 1 makes the tips of each socket coincide; the reference lengths then fix the scale. Observations of other
    kinds (measured points, spheres, planes, artefacts) are fitted together with all other data. Several captures are
    sessions of one arm.
    """
    from ..diagnostics.usability import does_not_fit
    from ..files.arm_tables import prior_of_text, with_model
    from ..pipeline.capture_calibration import calibrate_capture

    # Options that have the name and the values of an argument of `calibrate_capture` are passed as they are.
    alike = {
        name: value for name, value in locals().items() if name in pipeline.CaptureOptions._fields and name != "prior"
    }
    chosen = pipeline.CaptureOptions(**alike)._replace(
        hold=None if hold == "none" else hold,
        noise=arm_options.known_noise(encoder_arcsec, seating_mm, linear_encoder_mm),
        replace_noise=not keep_noise,
        leave_out=tuple(leave_out or ()),
        hold_out=options.share_or_name(hold_out),
        stage=with_spinner,
    )
    output = Path(f"{capture[0].stem}-calibration.h5") if output is None else output
    with together(output, figure, residuals):
        for file in capture:
            reading(file)
        options.check_figure(figure)
        recording = _recording(capture, same_probe)
        recording = recording._replace(capture=recording.capture.select(only or None, without or ()))
        nominal = recording.nominal if model is None else with_model(recording.nominal, model)
        nominal = (
            arm_options.with_fixed_arm(nominal, held, free)
            if arm_fixed
            else arm_options.with_parameters(nominal, held, free)
        )
        nominal = arm_options.bounded(nominal, length_bound_mm, angle_bound_deg, bound or [])
        if prior is not None:
            chosen = chosen._replace(prior=prior_of_text(prior, nominal.arm))
        record = calibrate_capture(recording._replace(nominal=nominal), **chosen._asdict())
        summary = summaries.calibration.calibration_summary(record)
        files.save_calibration(output, record, summary)
        if figure is not None:
            plot.save_calibration_figure(record, figure)
        if residuals is not None:
            options.write_residuals(residuals, record)
    show_summary(summary | {"written": str(output)}, as_json, views.calibration)
    if any(row["severity"] == "unusable" for row in summary["findings"]) or does_not_fit(record):
        raise typer.Exit(1)


def _recording(paths: Sequence[Path], same_probe: bool) -> Any:
    """The recording of a file, or of several as the sessions of one arm, with the digests of the files."""
    if same_probe and len(paths) == 1:
        raise InputError("--same-probe applies to several captures only; name all captures, or leave out --same-probe.")
    sessions = {}
    for path in paths:
        recording = read_recording(path)
        if path.stem in sessions:
            raise InputError(
                f"two captures have the file name '{path.stem}', which becomes the name of the session; rename "
                "one of the files."
            )
        sessions[path.stem] = recording
    return pipeline.join_recordings(sessions, same_probe=same_probe)


@command(
    "aacmm compare-models capture.h5",
    'aacmm compare-models capture.h5 --models "dh;gravity;gravity,harmonics=1" --leave-out "monday/*" '
    '--leave-out "tuesday/*"',
    name="compare-models",
)
def compare_models(
    capture: Path = argument(
        "Capture, written by aacmm import or aacmm simulate; or the manifest of one.", "CAPTURE.h5|MANIFEST.toml"
    ),
    models: str | None = option(
        "Models to compare, from the simplest to the most complex, separated by semicolons; each is written as for "
        "calibrate --model. Default: dh; gravity; harmonics=1; gravity,harmonics=1; functions (harmonics=1-31); "
        "gravity,functions; if the capture contains directions of approach, loads or temperatures, also each of these "
        "models with backlash, load or expansion.",
        "MODELS",
    ),
    leave_out: list[str] | None = option(
        "Hold out, as one group, all sockets and observations whose names match ('monday/*'); may be given several "
        "times. Default: each placement, station or other group in turn if there are at least three; otherwise, in "
        "turn, the lower and the upper half of the travel of each joint.",
        "PATTERN",
    ),
    only_poses: int | None = option("Use N poses drawn at random, to save time.", "N", min=1),
    seed: int = seed("--only-poses"),
    only: list[str] | None = options.ONLY,
    without: list[str] | None = options.WITHOUT,
    encoder_arcsec: float | None = options.KNOWN_ENCODER_NOISE,
    linear_encoder_mm: float | None = options.LINEAR_ENCODER_NOISE,
    seating_mm: float | None = options.KNOWN_SEATING_NOISE,
    output: Path | None = output(
        "File to write the comparison to (HDF5); aacmm show and aacmm report read it.", "FILE.h5", None
    ),
    as_json: bool = options.JSON,
) -> None:
    """Compare models of the joints on held-out regions.

    The prior of each model is learned from all poses. Each region is then held out in turn, and predicted by the model
    fitted to the other regions.
    """
    from ..data.capture import draw_poses
    from ..files.arm_tables import masses_of
    from ..pipeline.model_ladder import compare_models as run

    with together(output):
        reading(capture)
        recording = _recording([capture], same_probe=False)
    chosen = None if models is None else tuple(model.strip() for model in models.split(";"))
    if chosen is not None and not all(chosen):
        raise InputError(
            f"--models '{models}' contains an empty model; write exactly one semicolon between two models."
        )
    part, nominal = recording.capture.select(only or None, without or ()), recording.nominal
    if only_poses is not None:
        part = draw_poses(part, only_poses, seed)
    noise = arm_options.known_noise(encoder_arcsec, seating_mm, linear_encoder_mm)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        compared = with_spinner("Comparing models", lambda: run(
            nominal, part, models=chosen, regions=leave_out, noise=noise, **masses_of(nominal)
        ))  # fmt: skip
    summary = summaries.compared_models.compared_models_summary(compared, nominal.name)
    summary["poses"] = len(part.readings)
    if output is not None:
        files.save_compared_models(output, summary, recording.sources[:1], None if only_poses is None else seed)
        summary["written"] = str(output)
    show_summary(summary, as_json, summaries.compared_models.compared_models)
    if not compared.recommended.result.converged:
        raise typer.Exit(1)


@command(
    "aacmm compare march.h5 september.h5 -o changes.h5",
    "aacmm compare 2023.h5 2024.h5 2025.h5 --figure trend.png --max-length-change-mm 0.05",
)
def compare(
    paths: list[Path] = argument(
        "Calibrations of one arm, written by aacmm calibrate. Two are compared in the order given; three or more are "
        "ordered by date.",
        "OLD.h5 NEW.h5 [MORE.h5 ...]",
    ),
    level: float = option("Coverage probability of the expanded uncertainties.", "P", default=LEVEL),
    length_mm: float | None = option(
        "Compute the changes of lengths of this size throughout the working volume. Default: 300, or half the total "
        "link length if that is shorter."
    ),
    figure: Path | None = option(
        "Plot the changes to this file (.png, .svg or .pdf); for three or more calibrations, against time.", "FILE"
    ),
    csv: Path | None = option("Write every parameter of every calibration to this file (CSV).", "FILE"),
    max_length_change_mm: float | None = option(
        "Exit with code 1 if a length changes by more than this from the first calibration to the last. The next "
        "calibration is due before lengths change by this; default: by U of their change.",
        min=0,
    ),
    output: Path | None = output(
        "File to write the comparison to (HDF5); aacmm show and aacmm report read it.", "FILE.h5", None
    ),
    as_json: bool = options.JSON,
) -> None:
    """Compare calibrations of one arm.

    The command says whether the arm has changed, which parameters changed beyond their uncertainty, and how measured
    lengths change; or from which size on a change would have been seen.
    """
    if len(paths) < 2:
        raise InputError(f"{paths[0]} alone cannot be compared; name at least two calibrations.")
    options.check_figure(figure)
    words = summaries.drift
    with together(output, figure, csv):
        records = [files.load_calibration(path) for path in paths]
        created = [
            record.recording.measured or read_tables(path, ("calibration",)).attributes["created"]
            for record, path in zip(records, paths, strict=True)
        ]
        labels = [str(path) for path in paths]
        settings = {"level": level, "length": length_mm, "labels": labels}
        trend = with_spinner("Comparing", lambda: _compared(records, created, settings))
        trend = trend._replace(dated_by_file=tuple(not records[i].recording.measured for i in trend.order))
        summary: dict[str, Any] = words.compared_summary(
            trend, labels, records[0].recording.nominal.name, max_length_change_mm
        )
        summary["kept"], summary["failed"] = words.change_exceeded(trend.drifts[-1].lengths, max_length_change_mm)
        if figure is not None:
            plot.save_drift_trend(trend, figure)
        if csv is not None:
            write_text(csv, words.drift_csv(trend, labels))
        if output is not None:
            files.save_comparison(output, summary, [fingerprint(InputFile(path)) for path in paths])
    written = ", ".join(str(path) for path in (output, figure, csv) if path is not None)
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
            f"{labels[1]} ({new:%Y-%m-%d %H:%M}) was made before {labels[0]} ({old:%Y-%m-%d %H:%M}); check the order."
        )
        warnings = (*drift.warnings, warning) if new < old else drift.warnings
        return Trend((old, new), (0, 1), (drift._replace(warnings=warnings),))
    by_date = trend(records, created, **settings)
    if list(by_date.order) == sorted(by_date.order):
        return by_date
    warning = (
        "The calibrations are compared in the order of their dates, not in the order given: "
        f"{', '.join(labels[i] for i in by_date.order)}. The date is the date of measurement if the manifest states "
        "one, otherwise the date of the file."
    )
    first, *others = by_date.drifts
    return by_date._replace(drifts=(first._replace(warnings=(warning, *first.warnings)), *others))

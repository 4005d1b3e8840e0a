"""``arm``: an arm looked at before its first calibration, a template of an arm file, readings compared with an arm."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from .. import data, diagnostics, files, plot, summaries
from ..core.errors import InputError
from ..core.text import pluralise
from ..files.inputs import InputFile
from ..files.outputs import together, write_text
from ..summaries.tables import Styled, View, formatted, listed, number, warnings_of, written_of
from ..uncertainty.coverage import COVERAGE_FACTOR, K_IN_WORDS
from . import options, views
from .app import command, read_recording, show_summary, with_spinner
from .options import argument, numbers_option, option

_CAPTURES = (".toml", ".h5")  # others are tables


@command(
    "aacmm arm robot.urdf --tip tool0 --figure arm.png",
    "aacmm arm --new my-arm.toml --joints 6",
    "aacmm arm my-arm.toml --check poses.csv --unit deg",
    "aacmm arm panda --check capture.toml",
)
def arm(
    file: str | None = argument(
        "A TOML file, a URDF, MJCF (.xml), a kinematics.yaml, or the name of an arm that ships with aacmm.", "ARM", None
    ),
    new: Path | None = option(
        "Write a template arm file in which every key is explained. An existing file is never replaced.", "FILE.toml"
    ),
    joints: int | None = option("Number of joints in the template. Default: 6.", "N", min=1, max=20),
    check: Path | None = option(
        "Compare recorded readings with the arm. The file is a manifest (TOML), a capture (HDF5) or a table (CSV). A "
        "table has the readings in columns q_1, q_2, ... Measured tip positions are in columns x, y, z (mm, unless "
        "the header states another unit), and measured orientations in qw, qx, qy, qz or rx, ry, rz. If the table has "
        "no positions, a column socket names the socket of each pose; without this column, all poses are assumed to "
        "be in one socket.",
        "POSES",
    ),
    unit: Literal["deg", "rad"] | None = option(
        "Unit of the readings in a table. Default: the unit in the header; if the header states none, the unit is "
        "inferred from the size of the readings."
    ),
    figure: Path | None = option(
        "Draw the arm with all readings zero, and its reach, to this file (.png, .svg or .pdf).", "FILE.png"
    ),
    encoder_arcsec: float | None = options.USUAL_ENCODER_NOISE,
    seating_mm: float | None = options.USUAL_SEATING_NOISE,
    model: str | None = option(
        "Model of non-geometric joint errors, as for calibrate --model; for example gravity,harmonics=1.", "MODEL"
    ),
    base: str | None = options.BASE_LINK,
    tip: list[str] | None = options.TIP_LINK,
    probe: str | None = option(
        "Position (mm) of the tool tip in the frame of the last link, for a URDF, MJCF or kinematics.yaml.", "X,Y,Z"
    ),
    as_json: bool = options.JSON,
) -> None:
    """Analyse an arm before its first calibration.

    The command prints the axes with all readings zero, the reach of the arm, the redundant parameters, the number of
    parameters that sockets, reference lengths and a tracker determine, and the number of poses that a first capture
    needs.

    --check finds the order, signs, zero offsets and units of the columns with which recorded readings fit the arm, and
    prints the table [angles] for the manifest. Positions in a table must be in the base frame (for a URDF: in its base
    link). The frame of a tracker in a manifest is determined from the data. The exit code is 1 if no order, signs, zero
    offsets and units make the readings fit the arm.
    """
    from ..files.arm_tables import arm_template, with_model

    if new is not None:
        if file is not None or check is not None or figure is not None:
            raise InputError(
                "--new writes a template and does not read an arm; leave out the arm, --check and --figure."
            )
        with together(new):
            if os.path.lexists(new):
                raise InputError(f"{new} already exists; give another name, or remove the file.")
            write_text(new, arm_template(joints or 6))
        summary = {"kind": "arm template", "joints": joints or 6, "written": str(new)}
        show_summary(summary, as_json, lambda shown: [f"Written: {shown['written']}. View this arm: aacmm arm {new}"])
        return
    if file is None:
        raise InputError(
            "no arm is given; name an arm file, write a template with --new my-arm.toml, or name a shipped arm: "
            f"{', '.join(files.shipped_arms())}."
        )
    if joints is not None:
        raise InputError("--joints applies to a template only; give --new too.")
    options.check_figure(figure)
    with together(figure):
        tool = None if probe is None else numbers_option("--probe", probe, "X,Y,Z in mm", 3)
        specification = files.load_specification(file, base=base, tip=tip, probe=tool)
    if check is not None:
        if figure is not None or encoder_arcsec is not None or seating_mm is not None:
            raise InputError("--check only compares readings; leave out --figure, --encoder-arcsec and --seating-mm.")
        if model is not None:
            raise InputError("--check only compares readings; leave out --model.")
        summary = _checked(specification, check, unit)
        show_summary(summary, as_json, reading_check)
        if not summary["explained"]:
            raise typer.Exit(1)
        return
    if unit is not None:
        raise InputError("--unit applies only to a table that --check reads; leave out --unit.")
    specification = specification if model is None else with_model(specification, model)
    frame = first_frame(specification)
    with together(figure):
        usual = options.assumed_noise(file, {"base": base, "tip": tip}, encoder_arcsec, seating_mm)
        look = summaries.arm_survey.arm_survey
        summary = with_spinner("Analysing the arm", lambda: look(specification, usual, base=frame, model=model))
        if frame is not None:
            summary["urdf"]["first_frame_in_base_mm"] = frame.tolist()
        if figure is not None:
            plot.save_arm_figure(specification.arm, figure, title=specification.name, base=frame)
            summary["written"] = str(figure)
    show_summary(summary, as_json, survey)


def first_frame(specification: Any) -> Any:
    """The first frame of an arm, of a robot that of its first chain, in the base link of its URDF; None for others."""
    urdf = specification.urdf
    return None if urdf is None else files.urdf_chain(urdf._replace(tips=urdf.tips[:1]), alone=len(urdf.tips) == 1).base


def _checked(specification: Any, path: Path, unit: str | None) -> dict[str, Any]:
    """What a check of a manifest, a capture or a table finds."""
    suffix = path.suffix.lower()
    if suffix not in _CAPTURES:
        return _checked_table(specification, path, unit)
    if unit is not None:
        raise InputError(
            f"--unit applies to tables only, but {path} itself states the unit of the readings; leave out --unit."
        )
    recording = read_recording(path)
    joints = recording.nominal.arm.joints
    if joints != specification.arm.joints:
        raise InputError(
            f"{path} has readings of {joints} joints, but the arm has {specification.arm.joints} joints; name the arm "
            "with which these readings were recorded."
        )
    return checked_recording(specification, recording, path if suffix == ".toml" else None)


def _checked_table(specification: Any, path: Path, unit: str | None) -> dict[str, Any]:
    from ..files.table_columns import read_poses

    table, frame = read_poses(InputFile(path), specification.arm, unit=unit, recorded=True), first_frame(specification)
    positions = None if table.poses is None else table.poses[:, :3, 3]
    rotations = table.poses[:, :3, :3] if table.poses is not None and table.oriented else None
    if positions is not None and frame is not None:
        frame = np.linalg.inv(frame)
        positions = positions @ frame[:3, :3].T + frame[:3, 3]
        rotations = None if rotations is None else frame[:3, :3] @ rotations
    tips = {"sockets": table.sockets if positions is None else None, "positions": positions, "rotations": rotations}
    check = with_spinner("Comparing", lambda: diagnostics.check_readings(specification.arm, table.q, **tips))
    if positions is not None:
        seen = data.observations.MeasuredPoints("table", table.q, positions, station="table")
        capture = data.Capture({}, observations=[seen])
    else:
        owner = np.array(table.sockets)
        capture = data.Capture({name: table.q[owner == name] for name in dict.fromkeys(owner.tolist())})
    return _check_summary(specification, check, capture, table.unit, table.length_unit)


def checked_recording(
    specification: Any, recording: Any, manifest: Path | None, written: Sequence[Any] = ()
) -> dict[str, Any]:
    """What a check of a recording finds, with the lines of its manifest that correct it, where it has one; ``written``
    are its rotations, of which any convention is tried."""
    from ..diagnostics.capture_check import check_capture
    from ..files.manifest import deviations_of_manifest
    from ..files.reading_checks import positions_unit, rotation_rows
    from ..pipeline.reading_sets import compare_points, compare_reading_sets, points_sentence, reading_sets_sentence

    check = with_spinner("Comparing", lambda: check_capture(specification.arm, recording.capture, recording.usual))
    unit = "rad" if manifest is None else None
    of_file = {"nominal": recording.nominal, "manifest": manifest}
    summary = _check_summary(specification, check, recording.capture, unit, positions_unit(manifest), **of_file)
    if manifest is not None:
        sets = with_spinner("Calibrating", lambda: compare_reading_sets(recording))
        summary |= {"reading_sets": sets, "reading_sets_sentence": reading_sets_sentence(sets, check.poses)}
        others = deviations_of_manifest(manifest)
        points = with_spinner("Calibrating", lambda: compare_points(recording, others))
        summary |= {"points": points, "points_sentence": points_sentence(points)}
        summary["rotations"] = rotation_rows(manifest, written, check, specification.arm)
    return summary


def _check_summary(
    specification: Any,
    check: Any,
    capture: Any,
    unit: str | None,
    positions: str,
    *,
    nominal: Any = None,
    manifest: Path | None = None,
) -> dict[str, Any]:
    from ..diagnostics.joint_travel import short_travels, standing_rows
    from ..diagnostics.reading_check import reading_check_summary
    from ..files.reading_checks import angles_toml, units_toml

    angles = check.couplings or (check.explained and check.best.hypothesis._replace(length=1.0).changes)
    return reading_check_summary(check, specification.name, unit=unit, positions=positions) | {
        "angles": angles_toml(check.best, unit, manifest, check.couplings) if angles else None,
        "units": units_toml(check.best, positions) if check.explained or check.couplings else None,
        "standing": standing_rows(specification.arm, capture, nominal),
        "short_travels": short_travels(specification.arm, capture),
        "reading_sets": [],
        "reading_sets_sentence": "",
        "points": [],
        "points_sentence": "",
        "rotations": [],
    }


def reading_check(summary: dict[str, Any]) -> View:
    """Readings compared with an arm."""
    from ..diagnostics.reading_check import alternatives_sentence

    yield Styled(summary["sentence"], "green" if summary["fits"] else "yellow" if summary["explained"] else "red")
    outside = (summary["found"] or summary["given"])["readings_outside_limits"]
    yield from filter(None, (
        summary["tip"],
        summary["unit"] and f"The readings are assumed to be in {summary['unit']}.",
        outside and f"Outside the joint limits: {pluralise(outside, 'reading')}.",
        alternatives_sentence(summary["alternatives"], summary["known_positions"]),
        *(Styled(row["says"], "yellow") for row in (*summary["standing"], *summary["short_travels"])),
        summary["reading_sets_sentence"],
        summary["points_sentence"],
        *_rotations(summary["rotations"]),
    ))  # fmt: skip
    for key, where in (("units", ", in the table of the measured positions"), ("angles", "")):
        if summary[key] is not None:
            yield f"\nWrite in the manifest{where}:\n{summary[key]}".rstrip("\n")
    yield (
        f"\n{pluralise(summary['poses'], 'pose')}; {summary['hypotheses']:,} combinations of column order, signs, "
        "zero offsets and units were tried."
    )


def _rotations(rows: Sequence[dict[str, Any]]) -> Iterator[Any]:
    """The conventions of measured rotations: what fits, a table, and the lines of the manifest."""
    for name in dict.fromkeys(row["table"] for row in rows):
        of_table = [row for row in rows if row["table"] == name]
        best, fitting = of_table[0], [row for row in of_table if row["fits"]]
        if not fitting:
            yield Styled(
                f"No convention makes the rotations of '{name}' fit the arm: {best['rms_deg']:.3g} deg RMS at best.",
                "red",
            )
        else:
            others = [row for row in fitting[1:] if not row["equivalent"]]
            equal = len(fitting) - 1 - len(others)
            yield (
                f"The rotations of '{name}' are {best['rotation']}{' in ' * bool(best['unit'])}{best['unit']}: "
                f"{best['rms_deg']:.3g} deg RMS with the nominal arm"
                + (f"; {pluralise(equal, 'other convention')} equivalent in these poses" if equal else "")
                + (f"; {pluralise(len(others), 'other convention')} fit as well" if others else "")
                + ("." if best["taken"] else f". Write in its table: {' and '.join(best['lines'])}")
            )
        columns: dict[str, Any] = {
            "convention": "rotation",
            "unit": "unit",
            "positions [mm]": "rms_mm",
            "orientations [deg]": "rms_deg",
            "fits": lambda row: ("equivalent" if row["equivalent"] else "yes") if row["fits"] else "no",
        }
        yield listed("", of_table, columns)


def survey(summary: dict[str, Any]) -> View:
    """An arm before its first calibration: what to record, then why."""
    if summary["advice"]:
        yield summary["advice"]
    yield from views.arm(summary)
    yield from warnings_of(summary)
    rows = [
        (
            "tip" if row["joint"] is None else row["joint"],
            *(number(x, 3) for x in row["origin_mm"]),
            *(number(x, 4, rounded=True) for x in row["axis"]),
        )
        for row in summary["frames"]
    ]
    headings = ("joint", "through x [mm]", "y [mm]", "z [mm]", "direction x", "y", "z")
    yield listed("Axes at zero readings", rows, headings)
    reach = summary["reach_mm"]
    yield (
        f"\nReach: {reach['nearest']:.0f} to {reach['farthest']:.0f} mm from the shoulder, which is on the first axis "
        f"at ({', '.join(f'{x:.0f}' for x in reach['shoulder'])}) mm (self-collision is not considered). The total "
        f"length of the links is {reach['links']:.0f} mm."
    )
    if summary["determined"]:
        yield from _determined(summary)
    for arm_class in summary["needed"]:
        yield from _needed(arm_class)
    yield from written_of(summary)


def _determined(summary: dict[str, Any]) -> View:
    """What data can and cannot determine of the arm."""
    yield [
        "\n",
        Styled("Redundant parameters"),
        f" (no data can determine them one by one; the arm has {summary['parameters']} parameters in total):",
    ]
    yield from (f"  {text}" for text in summary["redundant"])
    if summary["weak"]:
        yield [Styled("Poorly determined"), " (even with poses spread over the whole workspace):"]
        yield from (f"  {text}" for text in summary["weak"])
    why = [text for row in summary["determined"][1:2] for text in row["corrections"]]
    if summary["corrections_left_out"] or why:
        yield [Styled("Joint corrections"), ":"]
        yield from (f"  {text}" for text in (*summary["corrections_left_out"], *why))
    for i in summary["parallel"]:
        yield f"  Axes {i} and {i + 1} are nearly parallel: beta_{i} is identified instead of d_{i}."
    columns = {"data": "data", "parameters": "determined", "well": "well_determined", "scale": "scale"}
    yield listed("Number of parameters that each kind of data can determine", summary["determined"], columns)
    yield (
        f"Parameters to identify from sockets and a reference length ({len(summary['free'])}): "
        f"{', '.join(summary['free'])}."
    )
    yield ["\n", Styled("Effect if one joint does not move in any pose")]

    def lost(row: dict[str, Any]) -> str:
        if row["lost"] is None:
            return "(too few moving joints are left to turn the arm about a socket)"
        return ", ".join(row["lost"]) or "-"

    yield listed("", summary["still"], {"joint": "joint", "no longer well determined": lost})


def _needed(arm_class: dict[str, Any]) -> View:
    """What a first capture with so many poses reaches."""
    title = "Contribution of the calibration (from random poses) to U of a measured length"
    yield ["\n", Styled(title), f" [mm, {K_IN_WORDS}]: {arm_class['class']}"]
    columns: dict[str, Any] = {"data": "data"}
    for count in arm_class["rows"][0]["u_mm"]:
        columns[f"{count} poses"] = lambda row, count=count: row["u_mm"][count] and COVERAGE_FACTOR * row["u_mm"][count]
    columns["enough"] = lambda row: row["enough_poses"] or None
    yield listed("", arm_class["rows"], columns)
    yield (
        f"Medians over the working volume. Assumed: standard deviations of {arm_class['encoder_arcsec']:.3g} arcsec "
        f"(encoders) and {arm_class['seating_mm']:.3g} mm (seating; {arm_class['noise_source']}); standard "
        f"uncertainties u = {arm_class['u_length_mm']:g} mm (reference lengths) and u = {arm_class['u_tracker_mm']:g} "
        "mm per coordinate (tracker). Two sockets with a reference length are equivalent to a ball bar in one "
        "placement."
    )
    yield (
        "Enough: the smallest number of poses for which this contribution is smaller than the contribution of the "
        f"reading noise, {formatted(COVERAGE_FACTOR * arm_class['u_reading_mm'])} mm."
    )

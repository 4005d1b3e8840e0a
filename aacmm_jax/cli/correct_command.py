"""``correct``: commanded poses into readings with which a calibrated arm reaches them."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from ..core.errors import InputError
from ..core.text import pluralise
from ..files.inputs import InputFile
from ..files.outputs import together
from ..summaries.tables import formatted, listed, warnings_of, written_of
from . import options
from .app import app, examples, show_summary, warn_of_unusable
from .calibration_views import View
from .options import argument, names_option, numbers_option, option, output

_MOST_ROWS = 20  # that are printed


@app.command(
    epilog=examples(
        "aacmm correct calibration.h5 poses.csv -o corrected.csv --unit deg",
        "aacmm correct calibration.h5 poses.csv -o corrected.csv --unit deg --near 0,-90,90,0,90,0 --probe 0,0,150",
    )
)
def correct(
    calibration: Path = options.CALIBRATION_FILE,
    poses: Path = argument(
        "POSES.csv",
        "A row for each commanded pose: the joint readings (columns q_1, q_2, ..., or no others); or position x, y, z "
        "(mm) with qw, qx, qy, qz (quaternion) or rx, ry, rz (rotation vector).",
    ),
    output: Path = output("FILE.csv", "Table with corrected readings to write."),
    unit: Literal["deg", "rad"] | None = option(
        None,
        "Unit of joint readings and rotation vectors when the header states none (q_1_deg). Readings of prismatic "
        "joints are in mm.",
    ),
    columns: str | None = option(
        "NAMES",
        "Columns of the joint readings where they are not named q_1, q_2, ...: names, a pattern, or numbers from 1, "
        "separated by commas. Default: all columns of a table with one for each joint.",
    ),
    length_unit: Literal["mm", "m", "um", "inch"] | None = option(
        None, "Unit of positions when the column header has none (e.g. x_m). Default: mm."
    ),
    near: str | None = option(
        "Q1,Q2,...",
        "Search near these readings, for positions with orientations. Default: columns q_1, q_2, ... of the table.",
    ),
    probe: str | None = option(
        "X,Y,Z",
        "Use this tip of the tool in the last frame for both arms, mm. Default: the nominal and the calibrated probe, "
        "whose difference is corrected too.",
    ),
    temperature: float | None = option(
        "C", "Temperature of an arm that was calibrated with its thermal expansion. Default: column temperature_C."
    ),
    as_json: bool = options.JSON,
) -> None:
    """Turn commanded poses into corrected joint readings.

    A controller that knows the nominal arm means by joint readings the pose that the nominal arm has at them. The
    corrected readings put the calibrated arm there: position and orientation in the base frame of both arms. Positions
    with orientations in POSES.csv are in that frame, too; of a URDF, in its base link. Seven or more joints change as
    little as possible; fewer than six correct the position alone. Rotations of the tool that the calibration's data do
    not determine stay nominal.

    Readings are those of the nominal arm, as its joints count them: signs and offsets that a manifest gives for the
    recorded angles of a capture are not applied.

    The table written has the columns and the unit of the one that was read. The readings of a row that cannot be
    reached, within the nominal arm's joint limits, are left empty, and the exit code is 1: no arm is to be sent there.
    """
    from ..core.numpy_or_jax import to_numpy
    from ..files.calibrations import load_calibration
    from ..files.outputs import write_text
    from ..files.pose_tables import corrected_csv, read_poses
    from ..kinematics.inverse_kinematics import corrected_readings, readings_at_poses
    from ..summaries.correction import correction_summary

    begin = None if near is None else numbers_option("--near", near, "Q1,Q2,... with a reading for each joint")
    picked = None if columns is None else [int(x) if x.isdecimal() else x for x in names_option(columns)]
    with together(output):
        record = load_calibration(InputFile(calibration))
        nominal, calibrated = to_numpy((record.recording.nominal.arm, record.calibrated.arm))
        if probe is not None:
            tool = numbers_option("--probe", probe, "X,Y,Z in mm", 3)
            nominal, calibrated = nominal.replace(probe=tool), calibrated.replace(probe=tool)
        commanded = read_poses(
            InputFile(poses), nominal, unit=unit, near=begin, columns=picked, length_unit=length_unit
        )
        q = _at_temperature(commanded, calibrated, temperature)
        if commanded.poses is None:
            corrected = corrected_readings(nominal, calibrated, q)
        else:
            corrected = readings_at_poses(calibrated, q, in_first_frame(record, commanded.poses), nominal.limits)
        given = {"unit": commanded.unit, "of_readings": commanded.poses is None}
        summary = correction_summary(nominal, calibrated, q, corrected, **given)
        summary["probe_mm"] = [np.asarray(arm.probe).tolist() for arm in (nominal, calibrated)]
        if commanded.temperature is not None and q.shape[1] == calibrated.joints:
            summary["warnings"].append(
                "the arm was calibrated without thermal expansion, so that column temperature_C changes nothing; "
                "calibrate with --model expansion for corrections by temperature."
            )
        write_text(output, corrected_csv(commanded, np.asarray(corrected.q), np.asarray(corrected.reached)))
        summary["written"] = str(output)
    warn_of_unusable(calibration, record)
    show_summary(summary, as_json, corrections)
    if summary["not_reached"]:
        raise typer.Exit(1)


def _at_temperature(commanded: Any, calibrated: Any, temperature: float | None) -> np.ndarray:
    """The readings, with the temperature of an arm that expands."""
    from ..data.capture_data import check_temperatures
    from ..files.manifest_rows import with_temperature
    from ..kinematics.arm import correction_names
    from ..kinematics.corrections import Expansion

    if Expansion.words[0] not in correction_names(calibrated):
        if temperature is not None:
            raise InputError("the arm was calibrated without thermal expansion; leave out --temperature.")
        return commanded.q
    if commanded.temperature is None and temperature is None:
        raise InputError(
            "the arm was calibrated with its thermal expansion; give --temperature, or a column temperature_C."
        )
    q = with_temperature(commanded.q, commanded.temperature, temperature, str(commanded.table.path))
    where = "--temperature" if commanded.temperature is None else str(commanded.table.path)
    check_temperatures(where, q[:, calibrated.joints :])
    return q


def in_first_frame(record: Any, poses: np.ndarray) -> np.ndarray:
    """Poses in the frame in which the Denavit-Hartenberg chain begins; of a URDF they are given in its base link."""
    nominal = record.recording.nominal
    if nominal.urdf is None:
        return poses
    from ..files.urdf import urdf_chain

    return np.linalg.inv(urdf_chain(nominal.urdf).base) @ poses


def corrections(summary: dict[str, Any]) -> View:
    """How far poses are reached with corrected readings, and how much readings change."""
    yield from warnings_of(summary)
    meant, has = (", ".join(f"{x:.3f}" for x in probe) for probe in summary["probe_mm"])
    if meant == has:
        yield f"The tip is at ({has}) mm in the last frame."
    else:
        yield (
            f"The controller means the tip at ({meant}) mm in the last frame, the calibrated arm's is at ({has}) mm: "
            "right for the probe of the calibration. State another tool with --probe X,Y,Z."
        )
    rows, missed = summary["rows"], summary["not_reached"]
    yield f"{rows - len(missed)} of {pluralise(rows, 'pose')} reached with corrected readings."
    if len(missed) < rows:
        # Of the arithmetic, not of the arm: how far it is really off is what an evaluation with unseen data says.
        distance = formatted(summary["largest_distance_mm"])
        yield f"Largest distance from a pose with them, if the arm is as calibrated: {distance} mm."
    if summary["largest_distance_before_mm"] is not None:
        yield f"Without the correction: {formatted(summary['largest_distance_before_mm'])} mm."
    for key, what, unit in (("largest_change", "reading", "deg"), ("largest_slide", "slide", "mm")):
        row = summary[key]
        if row is not None:
            where = f"(joint {row['joint']}, row {row['row']})"
            yield f"Largest change of a {what}: {row[f'change_{unit}']:.4f} {unit} {where}."
    if missed:
        first = f", the first {_MOST_ROWS}, all by --json" if len(missed) > _MOST_ROWS else ""
        yield listed(f"Not reached{first}", missed[:_MOST_ROWS], {
            "row": "row",
            "distance left [mm]": "distance_mm",
            "angle left [deg]": "angle_deg",
            "joints at a limit": lambda row: ", ".join(map(str, row["joints_at_limit"])) or "-",
        })  # fmt: skip
    yield from written_of(summary)

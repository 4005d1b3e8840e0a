"""``correct``: commanded poses into readings with which a calibrated arm reaches them."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from .. import files, kinematics, summaries
from ..core.errors import InputError
from ..files.inputs import InputFile
from ..files.outputs import together, write_text
from . import options
from .app import app, examples, show_summary, warn_of_unusable
from .options import argument, names_option, numbers_option, option, output


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
    from ..files.pose_tables import corrected_csv, read_poses

    begin = None if near is None else numbers_option("--near", near, "Q1,Q2,... with a reading for each joint")
    picked = None if columns is None else [int(x) if x.isdecimal() else x for x in names_option(columns)]
    with together(output):
        record = files.load_calibration(InputFile(calibration))
        nominal, calibrated = to_numpy((record.recording.nominal.arm, record.calibrated.arm))
        if probe is not None:
            tool = numbers_option("--probe", probe, "X,Y,Z in mm", 3)
            nominal, calibrated = nominal.replace(probe=tool), calibrated.replace(probe=tool)
        commanded = read_poses(
            InputFile(poses), nominal, unit=unit, near=begin, columns=picked, length_unit=length_unit
        )
        q = _at_temperature(commanded, calibrated, temperature)
        if commanded.poses is None:
            corrected = kinematics.corrected_readings(nominal, calibrated, q)
        else:
            targets = in_first_frame(record, commanded.poses)
            corrected = kinematics.readings_at_poses(calibrated, q, targets, nominal.limits)
        summary = summaries.correction.correction_summary(
            nominal, calibrated, q, corrected, unit=commanded.unit, of_readings=commanded.poses is None
        )
        summary["probe_mm"] = [np.asarray(arm.probe).tolist() for arm in (nominal, calibrated)]
        if commanded.temperature is not None and q.shape[1] == calibrated.joints:
            summary["warnings"].append(
                "the arm was calibrated without thermal expansion, so that column temperature_C changes nothing; "
                "calibrate with --model expansion for corrections by temperature."
            )
        write_text(output, corrected_csv(commanded, np.asarray(corrected.q), np.asarray(corrected.reached)))
        summary["written"] = str(output)
    warn_of_unusable(calibration, record)
    show_summary(summary, as_json, summaries.correction.corrections)
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
    table = str(commanded.table.path)
    q = with_temperature(commanded.q, commanded.temperature, temperature, table)
    check_temperatures("--temperature" if commanded.temperature is None else table, q[:, calibrated.joints :])
    return q


def in_first_frame(record: Any, poses: np.ndarray) -> np.ndarray:
    """Poses in the frame in which the Denavit-Hartenberg chain begins; of a URDF they are given in its base link."""
    urdf = record.recording.nominal.urdf
    return poses if urdf is None else np.linalg.inv(files.urdf_chain(urdf).base) @ poses

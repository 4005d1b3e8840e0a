"""``correct``: corrects commanded poses for a controller that keeps the nominal arm."""

from pathlib import Path
from typing import Literal

import numpy as np
import typer

from .. import files, kinematics, summaries
from ..core.errors import InputError
from ..core.units import ANGLE_UNITS
from ..files.inputs import InputFile
from ..files.outputs import together, write_text
from . import options
from .app import command, show_summary, warn_of_unusable
from .arm_command import first_frame
from .chains import named_chain
from .commanded import (
    at_temperature,
    columns_as_recorded,
    in_first_frame,
    named_frame,
    other_tip,
    targets_words,
    tool_tip,
    written_as,
)
from .options import argument, flag, names_option, numbers_option, option, output


@command(
    "aacmm correct calibration.h5 poses.csv -o corrected.csv --unit deg",
    "aacmm correct calibration.h5 poses.csv -o corrected.csv --as-recorded",
    "aacmm correct robot.h5 left.csv -o corrected.csv --unit deg --chain left",
    "aacmm correct calibration.h5 points.csv -o commanded.csv --unit deg --near 0,-90,90,0,90,0 --write poses",
    "aacmm correct calibration.h5 poses.csv -o corrected.csv --unit deg --near 0,-90,90,0,90,0 --probe 0,0,150",
    "aacmm correct robot.h5 points.csv -o corrected.csv --unit deg --in-frame tracker --probe reflector",
)
def correct(
    calibration: Path = options.CALIBRATION_FILE,
    poses: Path = argument(
        "Table with one row per commanded pose. The columns are either joint readings (q_1, q_2, ..., or any names if "
        "there are no other columns), or positions x, y, z (mm) with qw, qx, qy, qz (quaternion) or rx, ry, rz "
        "(rotation vector).",
        "POSES.csv",
    ),
    output: Path = output("File to write the table of corrected readings to (CSV).", "FILE.csv"),
    unit: Literal["deg", "rad"] | None = option(
        "Unit of joint readings and rotation vectors if the header does not state it (as q_1_deg does). Readings of "
        "prismatic joints are in mm."
    ),
    columns: str | None = option(
        "Columns of the joint readings if they are not named q_1, q_2, ...: names, a pattern, or column numbers from "
        "1, separated by commas. Default: all columns, if the table has exactly one column per joint.",
        "NAMES",
    ),
    as_recorded: bool = flag(
        "--as-recorded",
        "The joint readings, and so the corrected ones, are as in the recording: its unit, signs, offsets and names of "
        "columns apply.",
    ),
    length_unit: Literal["mm", "m", "um", "inch"] | None = option(
        "Unit of positions if the column header does not state it (as x_m does). Default: mm."
    ),
    positions: str | None = option(
        "Columns of the positions if they are not named x, y, z: three names or column numbers, separated by commas.",
        "NAMES",
    ),
    in_frame: str | None = option(
        "Frame of the positions, as the calibration found it: the instrument (tracker), board or artefact, by its name "
        "or that of its observation. Default: the base frame of the arm.",
        "NAME",
    ),
    near: str | None = option(
        "For a table of positions: readings from which the search for the joint readings starts, in the configuration "
        "(elbow, wrist) in which the arm is to be; positions without orientations keep the orientation that the "
        "nominal arm has at these readings. Default: the columns q_1, q_2, ... of the table, one start per row.",
        "Q1,Q2,...",
    ),
    probe: str | None = option(
        "Tip of the tool in the last frame (mm), the same for the nominal and the calibrated arm; or the name of a "
        "target whose position the calibration found. Default: the tip of each arm, not a target; if the calibration "
        "changed the tip, this change is corrected too.",
        "X,Y,Z or TARGET",
    ),
    temperature: float | None = option(
        "Temperature (C) of the arm, if the arm was calibrated with thermal expansion. Default: the column "
        "temperature_C of the table.",
        "C",
    ),
    chain: str | None = option(
        "Chain of a robot that the table is of; its columns are the joints of this chain.", "NAME"
    ),
    write: Literal["readings", "poses"] = option(
        "What to write: corrected joint readings, or, for a controller that takes poses only, the corrected poses to "
        "command, in the units and columns of the table.",
        default="readings",
    ),
    as_json: bool = options.JSON,
) -> None:
    """Correct commanded poses, as joint readings or poses.

    A controller that uses the nominal parameters expects the tip in the pose that the nominal arm has at the commanded
    joint readings. The corrected readings bring the tip of the calibrated arm to this pose. The nominal and the
    calibrated arm have the same base frame; positions and orientations in POSES.csv are in this frame too (for a URDF:
    in its base link), or in the frame of --in-frame. With seven or more joints, the readings change as little as
    possible; with fewer than six joints, only the position is corrected. Rotations of the tool that the calibration
    data do not determine stay nominal.

    The readings are joint values of the nominal arm, unless --as-recorded applies the signs and offsets that the
    manifest gives for the readings of the capture.

    The output table has the columns and the unit of the input table. If the pose of a row cannot be reached within the
    joint limits of the nominal arm, its readings are left empty and the exit code is 1. Do not send an arm to such a
    pose.

    A table with positions and readings is a table of positions: the search starts from the readings of each row. If it
    has no readings, give --near. Without orientations, the tool keeps the orientation that the nominal arm has at these
    readings. If the targets are positions of a reflector as a tracker sees them, give --in-frame and --probe: readings
    alone correct the arm's own error only, and not the difference between the tracker's frame and the arm's base.

    Corrected poses (--write poses) hold for a controller that computes joint readings with the nominal
    parameters and in the configuration (elbow, wrist) of the readings given.
    """
    from ..core.numpy_or_jax import to_numpy
    from ..files.table_columns import corrected_csv, corrected_poses_csv, read_poses
    from ..kinematics.arm import by_joint

    begin = None if near is None else numbers_option("--near", near, "Q1,Q2,... with one reading per joint")
    picked, placed = (
        None if names is None else [int(x) if x.isdecimal() else x for x in names_option(names)]
        for names in (columns, positions)
    )
    with together(output):
        record = files.load_calibration(InputFile(calibration))
        nominal, calibrated = to_numpy((record.recording.nominal.arm, record.calibrated.arm))
        own = named_chain(nominal, chain)
        written = written_as(record, unit) if as_recorded else None
        if written is not None:
            unit = "deg" if written.unit == "deg" else "rad"
            picked = picked or columns_as_recorded(InputFile(poses), written)
        if probe is not None:
            tool = tool_tip(record, own, probe)
            nominal, calibrated = nominal.replace(probe=tool), calibrated.replace(probe=tool)
        commanded = read_poses(
            InputFile(poses),
            nominal if own is None else own.arm,
            unit=unit,
            near=begin,
            columns=picked,
            positions=placed,
            length_unit=length_unit,
        )
        by_unit = np.array(by_joint(nominal if own is None else own.arm, ANGLE_UNITS[commanded.unit], 1.0))
        if written is not None:
            if not commanded.columns:
                raise InputError(f"--as-recorded applies to joint readings, but {poses} has none; leave it out.")
            commanded = commanded._replace(q=written.joint_values(commanded.q / by_unit))
        if in_frame is not None and commanded.poses is None:
            raise InputError(
                f"--in-frame applies to positions, but {poses} has no columns x, y and z; name the columns of the "
                "positions with --positions."
            )
        given = commanded if own is None else commanded._replace(q=own.readings(commanded.q))
        q = at_temperature(given, calibrated, temperature)
        meant = np.array(nominal.pose(q[:, : nominal.beside.own]))
        oriented = commanded.oriented or commanded.poses is None
        if commanded.poses is None:
            targets = meant
        elif in_frame is None:
            targets = in_first_frame(record, commanded.poses)
        else:
            targets = named_frame(record, in_frame) @ commanded.poses
        targets[:, :3, :3] = targets[:, :3, :3] if oriented else meant[:, :3, :3]
        if write == "poses":
            to_command, corrected = kinematics.corrected_targets(nominal, calibrated, q, targets, oriented=oriented)
            base = first_frame(record.recording.nominal)
            in_file = to_command if base is None else base @ to_command  # also of targets in another frame
            text = corrected_poses_csv(commanded, in_file, np.asarray(corrected.reached))
        else:
            corrected = kinematics.readings_at_poses(calibrated, q, targets, nominal.limits)
            found = np.asarray(corrected.q)
            found = found if own is None else own.of_robot(found)
            found = found if written is None else written.readings(found) * by_unit
            text = corrected_csv(commanded, found, np.asarray(corrected.reached))
        summary = summaries.correction.correction_summary(
            nominal,
            calibrated,
            q,
            corrected,
            unit=commanded.unit,
            of_readings=commanded.poses is None,
            targets=targets if commanded.columns else None,
            recorded=np.asarray(record.recording.capture.readings),
        )
        if write == "poses" and in_frame is not None:
            summary["warnings"].append("The poses to command are in the base frame of the arm, not that of --in-frame.")
        summary["targets"] = targets_words(record, commanded, in_frame)
        tip = slice(None) if own is None else slice(3 * own.number, 3 * own.number + 3)
        summary["probe_mm"] = [np.asarray(arm.probe)[tip].tolist() for arm in (nominal, calibrated)]
        if probe is None and (commanded.poses is not None or summary["position_only"]):
            summary["warnings"] += other_tip(record, own, np.asarray(nominal.probe)[tip])
        if commanded.temperature is not None and q.shape[1] == calibrated.beside.own:
            summary["warnings"].append(
                "The arm was calibrated without thermal expansion, so the column temperature_C has no effect; "
                "calibrate with --model expansion to correct for temperature."
            )
        write_text(output, text)
        summary["written"] = str(output)
    warn_of_unusable(calibration, record)
    show_summary(summary, as_json, summaries.correction.corrections)
    if summary["not_reached"]:
        raise typer.Exit(1)

"""``correct``: commanded poses into readings with which a calibrated arm reaches them."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from rich.markup import escape

from ..core.errors import InputError
from ..core.text import number, pluralise
from ..files.inputs import InputFile
from ..files.outputs import together
from .app import KEPT, CalibrationFile, Json, app, bad_option, examples, names_option, show_summary, warn_of_unusable
from .display import formatted, new_console, new_table, print_table, print_warnings, print_written

_MOST_ROWS = 20  # that are printed


@app.command(
    epilog=examples(
        "aacmm correct calibration.h5 poses.csv -o corrected.csv --unit deg",
        "aacmm correct calibration.h5 poses.csv -o corrected.csv --unit deg --near 0,-90,90,0,90,0 --probe 0,0,150",
    )
)
def correct(
    calibration: CalibrationFile,
    poses: Annotated[
        Path,
        typer.Argument(
            metavar="POSES.csv",
            help="A row for each commanded pose: the joint readings (columns q_1, q_2, ..., or no others); or position "
            "x, y, z (mm) with qw, qx, qy, qz (quaternion) or rx, ry, rz (rotation vector).",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE.csv", help="Table with corrected readings to write." + KEPT)
    ],
    unit: Annotated[
        Literal["deg", "rad"] | None,
        typer.Option(
            help="Of joint readings and rotation vectors; needed where the header does not say it (q_1_deg). Readings "
            "of prismatic joints are in mm."
        ),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Columns of the joint readings where they are not named q_1, q_2, ...: names, a pattern, or numbers "
            "from 1, separated by commas. Default: all columns of a table with one for each joint.",
        ),
    ] = None,
    length_unit: Annotated[
        Literal["mm", "m", "um", "inch"] | None,
        typer.Option(help="Of positions whose header states no unit (x_m). Default mm."),
    ] = None,
    near: Annotated[
        str | None,
        typer.Option(
            metavar="Q1,Q2,...",
            help="Of positions with orientations: readings to begin with, near which a solution is wanted. Default: "
            "columns q_1, q_2, ... of the table.",
        ),
    ] = None,
    probe: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="The tool's tip in the last frame, mm, the same for both arms. Default: the nominal and the "
            "calibrated probe, whose difference is corrected too.",
        ),
    ] = None,
    temperature: Annotated[
        float | None,
        typer.Option(
            metavar="C",
            help="Temperature of an arm that was calibrated with its thermal expansion. Default: column temperature_C.",
        ),
    ] = None,
    as_json: Json = False,
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
    from ..files.commanded_poses import corrected_csv, read_commanded_poses
    from ..files.outputs import write_text
    from ..kinematics.correction import corrected_readings, readings_at_poses
    from ..summaries.correction import correction_summary

    begin = None if near is None else _numbers("--near", near, "Q1,Q2,... with a reading for each joint")
    picked = None if columns is None else [int(x) if x.isdecimal() else x for x in names_option(columns)]
    with together(output):
        record = load_calibration(InputFile(calibration))
        nominal, calibrated = to_numpy((record.recording.nominal.arm, record.calibrated.arm))
        if probe is not None:
            tip = _numbers("--probe", probe, "X,Y,Z in mm")
            if len(tip) != 3:
                bad_option("--probe", probe, "X,Y,Z in mm")
            nominal, calibrated = nominal.replace(probe=tip), calibrated.replace(probe=tip)
        commanded = read_commanded_poses(
            InputFile(poses), nominal, unit=unit, near=begin, columns=picked, length_unit=length_unit
        )
        q = _at_temperature(commanded, calibrated, temperature)
        if commanded.poses is None:
            found = corrected_readings(nominal, calibrated, q)
        else:
            found = readings_at_poses(calibrated, q, in_first_frame(record, commanded.poses), nominal.limits)
        given = {"unit": commanded.unit, "of_readings": commanded.poses is None}
        summary = correction_summary(nominal, calibrated, q, found, **given)
        summary["probe_mm"] = [np.asarray(arm.probe).tolist() for arm in (nominal, calibrated)]
        if commanded.temperature is not None and q.shape[1] == calibrated.joints:
            summary["warnings"].append(
                "the arm was calibrated without thermal expansion, so that column temperature_C changes nothing; "
                "calibrate with --model expansion for corrections by temperature."
            )
        write_text(output, corrected_csv(commanded, np.asarray(found.q), np.asarray(found.reached)))
        summary["written"] = str(output)
    warn_of_unusable(calibration, record)
    show_summary(summary, as_json, _display)
    if summary["not_reached"]:
        raise typer.Exit(1)


def _at_temperature(commanded: Any, calibrated: Any, temperature: float | None) -> np.ndarray:
    """The readings, with the temperature of an arm that expands."""
    from ..data.reference_length import check_temperatures
    from ..files.temperatures import with_temperature
    from ..kinematics.arm import correction_names
    from ..kinematics.corrections.expansion import Expansion

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


def _numbers(option: str, text: str, form: str) -> tuple[float, ...]:
    try:
        values = tuple(number(part.strip()) for part in text.split(","))
    except ValueError:
        bad_option(option, text, form)
    if not np.all(np.isfinite(values)):
        raise InputError(f"{option} '{text}' holds a value that is not finite; give finite numbers.")
    return values


def in_first_frame(record: Any, poses: np.ndarray) -> np.ndarray:
    """Poses in the frame in which the Denavit-Hartenberg chain begins; of a URDF they are given in its base link."""
    nominal = record.recording.nominal
    if nominal.urdf is None:
        return poses
    from ..files.urdf import urdf_chain

    return np.linalg.inv(urdf_chain(nominal.urdf).base) @ poses


def _display(summary: dict[str, Any]) -> None:
    console = new_console()
    print_warnings(console, summary)
    meant, has = (", ".join(f"{x:.3f}" for x in probe) for probe in summary["probe_mm"])
    if meant == has:
        console.print(f"Of a tip at ({has}) mm in the last frame.")
    else:
        console.print(
            f"The controller means the tip at ({meant}) mm in the last frame, the calibrated arm's is at ({has}) mm: "
            "right for the probe of the calibration. State another tool with --probe X,Y,Z."
        )
    rows, missed, largest = summary["rows"], summary["not_reached"], summary["largest_change"]
    console.print(f"{rows - len(missed)} of {pluralise(rows, 'pose')} reached with corrected readings.")
    if len(missed) < rows:
        # Of the arithmetic, not of the arm: how far it is really off is what an evaluation with unseen data says.
        console.print(
            "Largest distance from a pose with them, if the arm is as calibrated: "
            f"{formatted(summary['largest_distance_mm'])} mm."
        )
    if largest is not None:
        console.print(f"Without the correction: {formatted(summary['largest_distance_before_mm'])} mm.")
        console.print(
            f"Largest change of a reading: {largest['change_deg']:.4f} deg (joint {largest['joint']}, row "
            f"{largest['row']})."
        )
    if summary["largest_slide"] is not None:
        slide = summary["largest_slide"]
        console.print(
            f"Largest change of a slide: {slide['change_mm']:.4f} mm (joint {slide['joint']}, row {slide['row']})."
        )
    if missed:
        shown = f", the first {_MOST_ROWS}, all by --json" if len(missed) > _MOST_ROWS else ""
        table = new_table(f"\nNot reached{shown}", "row", "distance left [mm]", "angle left [deg]", "joints at a limit")
        for row in missed[:_MOST_ROWS]:
            table.add_row(
                str(row["row"]),
                formatted(row["distance_mm"]),
                formatted(row["angle_deg"]),
                escape(", ".join(map(str, row["joints_at_limit"])) or "-"),
            )
        print_table(console, table)
    print_written(console, summary)

"""``export``: writes a calibration for controllers and other programs."""

import json
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from .. import files, summaries
from ..core.errors import InputError
from ..core.text import printable, shorten
from ..files.inputs import InputFile, fingerprint
from ..files.outputs import check_kept, together, write_text
from . import options
from .app import command, warn_of_unusable
from .arm_command import first_frame
from .certificate_command import dcc_of
from .chains import one_chain_of
from .options import flag, names_option, option, output

_ROBOTS = ("urdf", "mjcf")
_FORMATS = {".urdf": "urdf", ".xml": "mjcf", ".json": "json", ".csv": "csv", ".py": "python"}
_FORMATS |= dict.fromkeys((".yaml", ".yml"), "ur")
_ZEROS = ("lerobot", "kuka", "ros-calibration")  # all but the last need --file
_OF_CAMERA = ("camera-info", "joint-origin", "static-transform", "opencv", "matrix")
_OF_ONE_CHAIN = ("toml", "table", "offsets", "ur", "python", *_ZEROS)
_OF_ONE_ARM = ("toml", *_ROBOTS, "table", "ur", "python")


@command(
    "aacmm export calibration.h5 --format toml -o arm.toml",
    "aacmm export calibration.h5 -o robot.urdf",
    "aacmm export calibration.h5 --format table --convention craig --units m-rad",
    "aacmm export calibration.h5 --format camera-info --camera webcam -o webcam.yaml",
    "aacmm export calibration.h5 --format table --chain left",
    "aacmm export calibration.h5 --format joint-origin",
    "aacmm export calibration.h5 --format dcc --evaluation tests.h5 --about laboratory.toml -o certificate.xml",
)
def export(
    calibration: Path = options.CALIBRATION_FILE,
    form: Literal[
        "toml",
        "json",
        "csv",
        "dcc",
        "urdf",
        "mjcf",
        "table",
        "offsets",
        "ur",
        "python",
        "camera-info",
        "joint-origin",
        "static-transform",
        "opencv",
        "matrix",
        "lerobot",
        "kuka",
        "ros-calibration",
    ]
    | None = option(
        "toml: arm file; json: complete summary; csv: parameters; dcc: Digital Calibration Certificate (XML); urdf, "
        "mjcf: the URDF or MJCF of the nominal arm, with calibrated origins; table: D-H table (CSV); offsets: "
        "refitted zero offsets of the joints only, for controllers that can master an axis at a stated reading (ABB, "
        "FANUC, Staeubli and others); ur: kinematics.yaml of Universal Robots; python: a program that "
        "needs only NumPy; "
        "camera-info: intrinsics of a camera (ROS, YAML); joint-origin, static-transform, opencv, matrix: frame of a "
        "camera or target, as the fixed joint of a URDF, a command of ROS 2, YAML of OpenCV, or 4 x 4 matrix (mm); "
        "lerobot, kuka, ros-calibration: zero offsets of the joints only, in LeRobot's calibration file, in KUKA's "
        "$machine.dat ($MAMES), or as <calibration> in the URDF. "
        "Default: the format of the output's extension (.urdf, .xml, .json, .csv, .yaml, .py), otherwise toml.",
        "FORMAT",
        "--format",
    ),
    which: Literal["calibrated", "nominal", "true"] | None = option(
        "Arm to write with --format toml, urdf, mjcf, table, ur or python. Only a simulation has a true arm. Default: "
        "calibrated.",
        None,
        "--arm",
    ),
    convention: Literal["standard", "craig"] | None = option("D-H convention for --format table. Default: standard."),
    units: Literal["mm-deg", "m-rad"] | None = option("Units for --format table. Default: mm-deg."),
    chain: str | None = option(
        "Chain of a robot to write, in the base frame of this chain; needed for table, offsets, ur, python, lerobot, "
        "kuka and ros-calibration, possible for toml.",
        "NAME",
    ),
    camera: str | None = option(
        "Camera to write, if the calibration has several: its name, or that of the observation.", "NAME"
    ),
    frame: Literal["mount", "place"] | None = option(
        "Frame to write with the formats of frames: mount: what is on the arm (camera or target), in the flange or in "
        "the tip link of the URDF; place: what stands still, in the base. Default: mount."
    ),
    file: Path | None = option(
        "File of the controller to take over with other zero offsets (--format lerobot or kuka).", "FILE"
    ),
    motors: str | None = option(
        "Motor (lerobot) or number of the axis (kuka) of each joint, separated by commas, with a minus before one that "
        "counts against the joint, or that adds its offset, as Dynamixel motors do. Default: in the order of the file, "
        "with the signs of the recording.",
        "NAMES",
    ),
    output: Path | None = output("File to write. Default: standard output.", "FILE", None),
    about: Path | None = options.ABOUT,
    evaluation: Path | None = options.EVALUATION,
    force: bool = flag("--force", "Export a calibration that is not usable all the same."),
) -> None:
    """Write a calibration for other programs or controllers."""
    written_as: str = form or _FORMATS.get("" if output is None else output.suffix.lower(), "toml")
    if (about is not None or evaluation is not None) and written_as != "dcc":
        raise InputError("--about and --evaluation apply to certificates only; give --format dcc too.")
    if which is not None and written_as not in _OF_ONE_ARM:
        raise InputError(
            f"--arm applies to --format {', '.join(_OF_ONE_ARM)} only; leave it out with --format {written_as}."
        )
    if (convention is not None or units is not None) and written_as != "table":
        raise InputError("--convention and --units apply to tables only; give --format table too.")
    if (camera is not None or frame is not None) and written_as not in _OF_CAMERA:
        raise InputError(f"--camera and --frame apply to cameras only; give --format {', '.join(_OF_CAMERA)} too.")
    if frame is not None and written_as == "camera-info":
        raise InputError("--frame does not apply to --format camera-info; leave it out.")
    if (file is not None) != (written_as in _ZEROS[:-1]) or (motors is not None and file is None):
        formats = " and ".join(_ZEROS[:-1])
        raise InputError(f"--file is needed for --format {formats}, and --motors and --file apply to no other format.")
    notes: list[str] = []
    with together(output):
        record = files.load_calibration(read := InputFile(calibration))
        if chain is not None:
            if written_as not in _OF_ONE_CHAIN:
                raise InputError(f"--chain applies to --format {', '.join(_OF_ONE_CHAIN)} only; leave it out.")
            record = one_chain_of(record, chain)
        nominal = record.recording.nominal
        arms = {"calibrated": record.calibrated, "nominal": nominal, "true": record.recording.true}
        specification = arms[which or "calibrated"]
        if specification is None:
            raise InputError(
                f"{calibration} is not a calibration of simulated data, so it has no true arm; choose another value "
                "for --arm."
            )
        warn_of_unusable(calibration, record, force or which in ("nominal", "true"))
        if written_as == "dcc":
            text = dcc_of(read, record, about, evaluation)
        elif written_as == "table":
            text = files.dh_table(
                specification.arm,
                convention=convention or "standard",
                units=units or "mm-deg",
                base=first_frame(nominal),
            )
            notes = _left_out_of_table(record, specification.arm)
        elif written_as in _OF_CAMERA:
            text = _of_camera(record, written_as, camera, frame or "mount")
        elif written_as in _ZEROS:
            text, notes = _zeros_in_file(record, written_as, file, motors)
        elif written_as in _ROBOTS:
            text, notes = _urdf(record, specification, written_as)
        else:
            text = _text(record, specification, written_as, which in (None, "calibrated"))
        if output is not None:
            if written_as in _ROBOTS and nominal.urdf and text != nominal.urdf.text:
                check_kept(output, nominal.urdf.text)
            write_text(output, text)
    typer.echo(text, nl=False) if output is None else typer.echo(f"Written: {output}")
    for note in notes:
        typer.echo(printable(note), err=output is None)


def _text(record: Any, specification: Any, form: str, calibrated: bool) -> str:
    """The text of a format that needs no words beside it."""
    nominal, capture = record.recording.nominal, record.recording.capture
    if form == "json":
        return json.dumps(summaries.calibration.calibration_summary(record), indent=2) + "\n"
    if form == "csv":
        return summaries.calibration.parameters_csv(record)
    if form == "ur":
        return files.ur_kinematics_yaml(specification.arm)
    if form == "offsets":
        comments = "".join(f"# {note}\n" for note in _of_models(record))
        return comments + files.zero_offsets_csv(_zero_offsets(record))
    scale = "" if math.isnan(record.k) else f", k = {record.k:.8f}"
    source = f"calibrated from {len(capture.readings)} poses, {record.method}{scale}" if calibrated else ""
    if form == "toml":
        from ..files.arms import specification_toml

        return specification_toml(specification, source=source)
    name = specification.name.removesuffix(", calibrated") if source else specification.name
    title = ", ".join(part for part in (name, source) if part)
    written = record.recording.recorded_as
    return files.python_program(specification.arm, title=title, base=first_frame(nominal), recorded_as=written)


def _zero_offsets(record: Any) -> Any:
    recording = record.recording
    nominal, read_as = recording.nominal.arm, recording.read_as
    readings = np.asarray(recording.capture.readings)[:, : nominal.joints]
    zeros = files.zero_offsets(nominal, record.calibrated.arm, readings, free=record.names, within_limits=True)
    complete = read_as and sorted(map(abs, read_as)) == list(range(1, nominal.joints + 1))
    return zeros._replace(read_as=read_as if complete else None)


def _zeros_in_file(record: Any, form: str, file: Path | None, motors: str | None) -> tuple[str, list[str]]:
    """A controller's file with the zero offsets, and what they leave."""
    from ..files.controllers import ZERO_FILES
    from ..files.controllers.offsets import remaining_error

    zeros, source = _zero_offsets(record), record.recording.nominal.urdf
    if file is None:
        if source is None:
            raise InputError(f"the nominal arm was not read from a URDF, which --format {form} needs; choose offsets.")
        written = files.ros_calibration(source, zeros)
    else:
        written = ZERO_FILES[form](InputFile(file), zeros, None if motors is None else names_option(motors))
    notes = [*remaining_error(zeros), *_of_models(record), *_signs_of(record, zeros, motors), *written.notes]
    if form == "lerobot" and file is not None and not _recorded_with(record, InputFile(file)):
        notes.append(
            f"Warning: the readings were not recorded with {file} (calibration = ... in [angles] of the manifest), so "
            "the offsets are wrong by any difference between its zeros and those of the readings; do not use them "
            "unless the zeros are the same."
        )
    return written.text, notes


def _recorded_with(record: Any, file: InputFile) -> bool:
    """Whether a controller's file is one of those from which the readings became angles."""
    digest = fingerprint(file).rpartition(" (")[2]
    return any(source.endswith(digest) for source in record.recording.sources)


def _of_models(record: Any) -> list[str]:
    """Which model zero offsets are to be calibrated with, where it was another."""
    said = "The calibration models errors of the joints, which zero offsets cannot hold: calibrate with --model dh."
    return [] if record.calibrated.arm.corrections is None else [said]


def _signs_of(record: Any, zeros: Any, motors: str | None) -> list[str]:
    """How the signs with which the joints were recorded take part in a controller's file, where they matter."""
    recorded = zeros.read_as
    if recorded is None:
        if "sign" not in record.recording.stated or motors is not None:
            return []
        return [
            "Warning: the calibration does not store the signs stated in [angles]; state them with --motors (a minus "
            "before each joint that was recorded with sign = -1)."
        ]
    against = ", ".join(str(i) for i, number in enumerate(recorded, start=1) if number < 0)
    if motors is None:
        return [f"Signs as recorded: joint {against} counts against its motor."] if against else []
    named = names_option(motors)
    if [name.startswith("-") for name in named] == [number < 0 for number in recorded]:
        return []
    return [
        f"Warning: --motors has other signs than the recording, where sign is -1 for joint {against or 'none'}; this "
        "is right only for motors that add their offset (Dynamixel)."
    ]


def _of_camera(record: Any, form: str, named: str | None, frame: str) -> str:
    """Intrinsics of a camera, or the frame of what is on the arm or stands still."""
    from ..files import camera_files

    rows = summaries.cameras.camera_rows(record)
    chosen = [row for row in rows if named in (None, row["camera"], row["observation"])]
    names = list(dict.fromkeys(row["camera"] for row in chosen))
    if len(names) != 1:
        known = ", ".join(dict.fromkeys(row["camera"] for row in rows))
        if not rows:
            raise InputError(f"the calibration has no camera; choose another format than {form}.")
        raise InputError(f"choose one camera with --camera: {known}.")
    row = chosen[0]
    if form == "camera-info":
        values = np.array([number["value"] for number in row["intrinsics"]])
        size = row["image_size_px"] and (int(row["image_size_px"][0]), int(row["image_size_px"][1]))
        return camera_files.camera_info_yaml(row["camera"], camera_files.StoredCamera(row["model"], values, size))
    part = row[frame]
    parent = "flange" if part["in"] == "last frame" else part["in"]
    write = {
        "joint-origin": camera_files.joint_origin,
        "static-transform": camera_files.static_transform,
        "opencv": camera_files.transform_storage,
        "matrix": camera_files.matrix_text,
    }
    return write[form](parent, part["of"], np.array(part["matrix_mm"]))


def _left_out_of_table(record: Any, arm: Any) -> list[str]:
    """What Denavit-Hartenberg parameters alone leave out, where they do."""
    from ..kinematics.arm import without_corrections

    if arm.corrections is None or not np.any(arm.coefficients):
        return []
    q = np.asarray(record.recording.capture.readings)
    moved = np.linalg.norm(np.asarray(arm.position(q)) - np.asarray(without_corrections(arm).position(q)), axis=1)
    return [
        f"The table contains the {np.count_nonzero(arm.coefficients)} coefficients of joint corrections as comments "
        "only. Without these corrections, the tip positions in the poses of the calibration change by up to "
        f"{moved.max():.3g} mm."
    ]


def _urdf(record: Any, specification: Any, form: str) -> tuple[str, list[str]]:
    nominal = record.recording.nominal
    if nominal.urdf is not None and nominal.urdf.format.lower() != form:
        raise InputError(
            f"the nominal arm was read from {nominal.urdf.format}; choose --format {nominal.urdf.format.lower()}."
        )
    result, what = files.urdf_of(specification.arm, nominal), "Joints" if form == "urdf" else "Bodies, joints and sites"
    if not result.changed and not result.notes:
        return result.text, ["No origin changed."]
    return result.text, [
        f"{what} whose origin changed: {shorten(result.changed, 12) or 'none'}.",
        *(note[0].upper() + note[1:] for note in result.notes),
        "Left unchanged as far as possible, because measurements of the tip do not determine them: the base, and the "
        "position of each frame along its joint axis and its angle about this axis.",
    ]

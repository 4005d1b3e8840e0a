"""What ``arm --check`` and ``import --check`` find: whether readings are those of the arm, and what they lack."""

from pathlib import Path
from typing import Any

import numpy as np
import typer

from ..core.errors import InputError
from ..files.inputs import InputFile
from .app import show_summary, with_spinner

_CAPTURES = (".toml", ".h5")  # others are tables


def check_arm(specification: Any, path: Path, unit: str | None, as_json: bool) -> None:
    """Print what a check of a manifest, a capture or a table finds; exit code 1 where nothing makes it fit."""
    from . import arm_display

    if path.suffix.lower() in _CAPTURES:
        if unit is not None:
            raise InputError(f"--unit is for a table, but {path} says the unit of its readings; leave it out.")
        summary = _of_capture(specification, path)
    else:
        summary = _of_table(specification, path, unit)
    show_summary(summary, as_json, arm_display.check)
    if not summary["explained"]:
        raise typer.Exit(1)


def check_recording(specification: Any, recording: Any, manifest: Path | None) -> dict[str, Any]:
    """What a check of a recording finds, with the lines of its manifest that correct it, where it has one."""
    from ..files.reading_checks import positions_unit
    from ..summaries.reading_check import check_capture, standing_rows

    found = with_spinner("Comparing", lambda: check_capture(specification.arm, recording.capture))
    summary = _summary(
        specification, found, None if manifest is not None else "rad", positions_unit(manifest), manifest
    )
    summary["standing"] = standing_rows(specification.arm, recording.capture, recording.nominal)
    if manifest is not None:
        from ..files.reading_checks import compare_reading_sets, reading_sets_sentence

        sets = with_spinner("Calibrating", lambda: compare_reading_sets(manifest, recording))
        summary["reading_sets"] = [
            {"role": one.role, "lines": list(one.lines), "rms_mm": one.rms, "taken": one.taken} for one in sets
        ]
        summary["reading_sets_sentence"] = reading_sets_sentence(sets, found.poses)
    return summary


def _summary(specification: Any, found: Any, unit: str | None, positions: str, manifest: Path | None) -> dict[str, Any]:
    from ..files.reading_checks import angles_toml, units_toml
    from ..summaries.reading_check import reading_check_summary

    best = found.best
    summary = reading_check_summary(found, specification.name, unit=unit, positions=positions)
    angles = found.explained and (best.hypothesis.changes or best.angle != 1)
    summary["angles"] = angles_toml(best, unit, manifest) if angles else None
    summary["units"] = units_toml(best, positions) if found.explained else None
    return summary | {"standing": [], "reading_sets": [], "reading_sets_sentence": ""}


def _of_capture(specification: Any, path: Path) -> dict[str, Any]:
    from ..files.captures import load_capture
    from ..files.manifest import read_manifest

    read = read_manifest if path.suffix.lower() == ".toml" else load_capture
    recording = read(InputFile(path)) if read is load_capture else read(path)
    joints = recording.nominal.arm.joints
    if joints != specification.arm.joints:
        raise InputError(
            f"{path} has readings of {joints} joints, but the arm has {specification.arm.joints}; name its arm."
        )
    return check_recording(specification, recording, path if read is read_manifest else None)


def _of_table(specification: Any, path: Path, unit: str | None) -> dict[str, Any]:
    from ..diagnostics.reading_check import check_readings
    from ..files.commanded_poses import read_known_poses
    from ..summaries.reading_check import standing_rows

    joints = specification.arm.joints
    known = read_known_poses(InputFile(path), joints, unit=unit)
    positions, rotations = known.positions, known.rotations
    if positions is not None and specification.urdf is not None:
        from ..files.urdf import urdf_chain

        frame = np.linalg.inv(urdf_chain(specification.urdf).base)
        positions = positions @ frame[:3, :3].T + frame[:3, 3]
        rotations = None if rotations is None else frame[:3, :3] @ rotations
    found = with_spinner(
        "Comparing",
        lambda: check_readings(
            specification.arm, known.q, sockets=known.sockets, positions=positions, rotations=rotations
        ),
    )
    summary = _summary(specification, found, known.unit, known.length_unit, None)
    summary["standing"] = standing_rows(specification.arm, _capture_of(known, positions))
    return summary


def _capture_of(known: Any, positions: Any) -> Any:
    """The poses of a table as a capture: in sockets, or as points that were seen."""
    from ..data.capture import Capture
    from ..data.observations.measured_points import MeasuredPoints

    if positions is not None:
        return Capture({}, observations=[MeasuredPoints("table", known.q, positions, station="table")])
    owner = np.array(known.sockets)
    return Capture({name: known.q[owner == name] for name in dict.fromkeys(known.sockets)})

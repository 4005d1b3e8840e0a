"""``arm --check`` and ``import --check``: whether readings are those of the arm, and what they lack."""

from pathlib import Path
from typing import Any

import numpy as np
import typer

from ..core.errors import InputError
from ..core.text import pluralise
from ..files.inputs import InputFile
from ..summaries.tables import Styled
from .app import show_summary, with_spinner
from .calibration_views import View

_CAPTURES = (".toml", ".h5")  # others are tables


def check_arm(specification: Any, path: Path, unit: str | None, as_json: bool) -> None:
    """Print what a check of a manifest, a capture or a table finds; exit code 1 where nothing makes it fit."""
    if path.suffix.lower() in _CAPTURES:
        if unit is not None:
            raise InputError(f"--unit is for a table, but {path} says the unit of its readings; leave it out.")
        summary = _of_capture(specification, path)
    else:
        summary = _of_table(specification, path, unit)
    show_summary(summary, as_json, view)
    if not summary["explained"]:
        raise typer.Exit(1)


def check_recording(specification: Any, recording: Any, manifest: Path | None) -> dict[str, Any]:
    """What a check of a recording finds, with the lines of its manifest that correct it, where it has one."""
    from ..diagnostics.joint_travel import standing_rows
    from ..diagnostics.reading_check import check_capture
    from ..files.reading_checks import positions_unit

    check = with_spinner("Comparing", lambda: check_capture(specification.arm, recording.capture))
    summary = _summary(
        specification, check, None if manifest is not None else "rad", positions_unit(manifest), manifest
    )
    summary["standing"] = standing_rows(specification.arm, recording.capture, recording.nominal)
    if manifest is not None:
        from ..files.reading_checks import compare_reading_sets, reading_sets_sentence

        sets = with_spinner("Calibrating", lambda: compare_reading_sets(manifest, recording))
        summary["reading_sets"] = sets
        summary["reading_sets_sentence"] = reading_sets_sentence(sets, check.poses)
    return summary


def _summary(specification: Any, check: Any, unit: str | None, positions: str, manifest: Path | None) -> dict[str, Any]:
    from ..diagnostics.reading_words import reading_check_summary
    from ..files.reading_checks import angles_toml, units_toml

    best = check.best
    summary = reading_check_summary(check, specification.name, unit=unit, positions=positions)
    angles = check.explained and best.hypothesis._replace(length=1.0).changes
    summary["angles"] = angles_toml(best, unit, manifest) if angles else None
    summary["units"] = units_toml(best, positions) if check.explained else None
    return summary | {"standing": [], "reading_sets": [], "reading_sets_sentence": ""}


def _of_capture(specification: Any, path: Path) -> dict[str, Any]:
    from ..files.captures import load_capture
    from ..files.manifest import read_manifest

    is_manifest = path.suffix.lower() == ".toml"
    recording = read_manifest(path) if is_manifest else load_capture(InputFile(path))
    joints = recording.nominal.arm.joints
    if joints != specification.arm.joints:
        raise InputError(
            f"{path} has readings of {joints} joints, but the arm has {specification.arm.joints}; name its arm."
        )
    return check_recording(specification, recording, path if is_manifest else None)


def _of_table(specification: Any, path: Path, unit: str | None) -> dict[str, Any]:
    from ..data.capture import Capture
    from ..data.observations.measured import MeasuredPoints
    from ..diagnostics.joint_travel import standing_rows
    from ..diagnostics.reading_check import check_readings
    from ..files.pose_tables import read_poses

    table = read_poses(InputFile(path), specification.arm, unit=unit, recorded=True)
    positions = None if table.poses is None else table.poses[:, :3, 3]
    rotations = table.poses[:, :3, :3] if table.poses is not None and table.oriented else None
    if positions is not None and specification.urdf is not None:
        from ..files.urdf import urdf_chain

        frame = np.linalg.inv(urdf_chain(specification.urdf).base)
        positions = positions @ frame[:3, :3].T + frame[:3, 3]
        rotations = None if rotations is None else frame[:3, :3] @ rotations
    tips = {"sockets": table.sockets if positions is None else None, "positions": positions, "rotations": rotations}
    check = with_spinner("Comparing", lambda: check_readings(specification.arm, table.q, **tips))
    if positions is not None:
        capture = Capture({}, observations=[MeasuredPoints("table", table.q, positions, station="table")])
    else:
        owner = np.array(table.sockets)
        capture = Capture({name: table.q[owner == name] for name in dict.fromkeys(owner.tolist())})
    summary = _summary(specification, check, table.unit, table.length_unit, None)
    summary["standing"] = standing_rows(specification.arm, capture)
    return summary


def view(summary: dict[str, Any]) -> View:
    """Readings compared with an arm."""
    from ..diagnostics.reading_words import alternatives_sentence

    yield Styled(summary["sentence"], "green" if summary["fits"] else "yellow" if summary["explained"] else "red")
    if summary["tip"]:
        yield summary["tip"]
    if summary["unit"] is not None:
        yield f"Readings were taken to be in {summary['unit']}."
    outside = (summary["found"] or summary["given"])["readings_outside_limits"]
    if outside:
        yield f"{pluralise(outside, 'reading')} are outside the joint limits."
    alternatives = alternatives_sentence(summary["alternatives"], summary["known_positions"])
    if alternatives:
        yield alternatives
    for row in summary["standing"]:
        yield Styled(row["says"], "yellow")
    if summary["reading_sets_sentence"]:
        yield summary["reading_sets_sentence"]
    if summary["units"] is not None:
        yield f"\nIn the manifest, in the table of the measured positions:\n{summary['units']}".rstrip("\n")
    if summary["angles"] is not None:
        yield f"\nIn the manifest:\n{summary['angles']}".rstrip("\n")
    yield f"\n{pluralise(summary['poses'], 'pose')}, {summary['hypotheses']:,} possibilities tried."

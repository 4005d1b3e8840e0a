"""The texts that ``aacmm export`` writes, by format, and what is to be said with them."""

import json
from typing import Any

import numpy as np


def exported(
    record: Any, specification: Any, form: str, source: str, convention: str | None, units: str | None
) -> tuple[str, tuple[str, ...]]:
    """The text of one format, and sentences about it.

    Args:
        record: The calibration.
        specification: The arm that is to be written.
        form: The format; a certificate is made elsewhere.
        source: What the arm is from, in words.
        convention: Of a table.
        units: Of a table.
    """
    from ..files import controllers

    nominal = record.recording.nominal
    if form == "toml":
        from ..files.arms import specification_toml

        return specification_toml(specification, source=source), ()
    if form in ("json", "csv"):
        from ..summaries.calibration import calibration_summary, parameters_csv

        if form == "csv":
            return parameters_csv(record), ()
        return json.dumps(calibration_summary(record), indent=2) + "\n", ()
    if form == "urdf":
        return _urdf(specification, nominal)
    if form == "ur":
        from ..files.ur_kinematics import ur_kinematics_yaml

        return ur_kinematics_yaml(specification.arm), ()
    if form == "offsets":
        readings = np.asarray(record.recording.capture.readings)[:, : nominal.arm.joints]
        found = controllers.zero_offsets(nominal.arm, record.calibrated.arm, readings)
        return controllers.zero_offsets_csv(found), ()
    base = None
    if nominal.urdf is not None:
        from ..files.urdf import urdf_chain

        base = urdf_chain(nominal.urdf).base
    if form == "python":
        title = ", ".join(part for part in (specification.name, source) if part)
        return controllers.python_program(specification.arm, title=title, base=base), ()
    options: Any = {"convention": convention or "standard", "units": units or "mm-deg"}
    table = controllers.dh_table(specification.arm, base=base, **options)
    return table, _without_corrections(specification.arm, record.recording.capture.readings)


def _without_corrections(arm: Any, readings: Any) -> tuple[str, ...]:
    """What Denavit-Hartenberg parameters alone leave out, where they do."""
    from ..kinematics.arm import without_corrections

    if arm.corrections is None or not np.any(arm.coefficients):
        return ()
    q = np.asarray(readings)
    moved = np.linalg.norm(np.asarray(arm.position(q)) - np.asarray(without_corrections(arm).position(q)), axis=1)
    return (
        f"The {np.count_nonzero(arm.coefficients)} coefficients of joint corrections stand in comments: by the table "
        f"alone the tip is elsewhere by up to {moved.max():.3g} mm over the poses of the calibration.",
    )


def _urdf(specification: Any, nominal: Any) -> tuple[str, tuple[str, ...]]:
    from ..core.text import shorten
    from ..files.urdf import urdf_of

    found = urdf_of(specification.arm, nominal)
    if not found.changed and not found.notes:
        return found.text, ("No origin changed.",)
    return found.text, (
        f"Joints with another origin: {shorten(found.changed, 12) or 'none'}.",
        *(note[0].upper() + note[1:] for note in found.notes),
        "The base, and where each frame is along its axis and about it, stay as they were as far as they can: data on "
        "the tip do not determine them.",
    )

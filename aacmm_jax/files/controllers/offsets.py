"""The zero offsets of joints, which are all that most controllers take of a calibration, and their table as CSV."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.text import quoted, shorten
from ...core.units import DEG
from ...kinematics.arm import Arm, by_joint, natural_steps, one_chain, with_arrays
from ...kinematics.parameters import Parameters, single
from .tables import row_of

_ENOUGH = 30  # steps of Gauss and Newton, of which some five are needed


class ZeroOffsets(NamedTuple):
    """The zero offsets of the joints with which the nominal arm comes closest to a calibrated one.

    Example:
        >>> zeros = aj.files.ZeroOffsets(np.array([0.01]), ("rad",), np.zeros(3), 1.0, 0.1, 0.2)
        >>> print(aj.files.zero_offsets_csv(zeros).splitlines()[-1])
        1,0.5729577951308232,0.01
    """

    offsets: Float[np.ndarray, " n"]  # to add to the readings, rad, or mm of prismatic joints
    units: tuple[str, ...]  # of each, rad or mm
    probe: Float[np.ndarray, " 3"]  # the tip in the nominal arm's last frame that goes with them, mm
    rms_nominal: float  # distance to the calibrated arm without offsets, the probe fitted, mm
    rms: float  # the same with the offsets, mm
    largest: float  # mm


class ZerosInFile(NamedTuple):
    """A file with other zero offsets."""

    text: str
    notes: tuple[str, ...]  # what it means, in sentences


def zero_offsets(nominal: Arm, calibrated: Arm, q: Float[np.ndarray, "N n"]) -> ZeroOffsets:
    """The restriction of a calibration to zero offsets, for controllers that take nothing else.

    Offsets and probe minimise the distance of the nominal arm's tips from the calibrated arm's over the readings. The
    change is the smallest that does: a rotation about the last axis is one of the probe, too. The rest of the
    calibration remains as an error.

    Args:
        nominal: The arm that the controller has.
        calibrated: The calibrated arm.
        q: Readings, rad, or mm of prismatic joints: of the capture, or of the poses that matter.

    Example:
        >>> zeros = aj.files.zero_offsets(arm, result.arm, np.array(capture.q))
        >>> print(f"{zeros.rms_nominal:.2f} mm without offsets, {zeros.rms:.2f} mm with them")
        1.92 mm without offsets, 1.48 mm with them
    """
    nominal, calibrated = (one_chain(single(arm), "a table of joint zero offsets") for arm in (nominal, calibrated))
    if nominal.joints != calibrated.joints:
        raise InputError(
            f"the arms have {nominal.joints} and {calibrated.joints} joints; give two arms with the same number of "
            "joints."
        )
    targets, probe = np.asarray(calibrated.position(q)), np.asarray(calibrated.probe)
    kinds, tip = by_joint(nominal, "theta", "d"), ["probe_x", "probe_y", "probe_z"]
    offsets, distances = [f"{kind}_{i}" for i, kind in enumerate(kinds, start=1)], []
    begin = with_arrays(nominal, probe=probe)
    for names in (tip, [*offsets, *tip]):
        space, steps = Parameters(begin, tuple(names)), natural_steps(names)
        vector = np.asarray(space.vector())
        for _ in range(_ENOUGH):
            arm = space.arm(vector)
            errors = targets - np.asarray(arm.position(q))
            columns = np.asarray(arm.jacobian(q, names)) * steps
            change = np.linalg.lstsq(columns.reshape(-1, len(names)), errors.ravel(), rcond=1e-9)[0]
            vector = vector + change * steps
            if np.all(np.abs(change) < 1e-10):
                break
        distances.append(np.linalg.norm(errors, axis=1))
    rms_nominal, rms = (float(np.sqrt(np.mean(values**2))) for values in distances)
    change = vector[:-3] - np.asarray(Parameters(begin, tuple(offsets)).vector())
    units = tuple(by_joint(nominal, "rad", "mm"))
    return ZeroOffsets(change, units, vector[-3:], rms_nominal, rms, float(distances[1].max()))


def zero_offsets_csv(zeros: ZeroOffsets) -> str:
    """Zero offsets as CSV, with the error that remains in comments.

    Args:
        zeros: The offsets, from `zero_offsets`; rad, or mm of prismatic joints.

    Example:
        >>> zeros = aj.files.zero_offsets(arm, result.arm, np.array(capture.q))
        >>> print(aj.files.zero_offsets_csv(zeros).splitlines()[0])
        # Add these offsets to the joint readings of the nominal arm.
    """
    lines = [
        "# Add these offsets to the joint readings of the nominal arm.",
        f"# With these offsets, the tips of the nominal and the calibrated arm differ by {zeros.rms:.4f} mm RMS, at "
        f"most {zeros.largest:.4f} mm",
        f"# ({zeros.rms_nominal:.4f} mm RMS without the offsets). Position of the tip in the last frame: "
        f"{row_of(zeros.probe, ' ')} mm.",
    ]
    units = ["deg", "rad", *(["mm"] if "mm" in zeros.units else [])]
    lines.append(",".join(["joint", *(f"offset_{unit}" for unit in units)]))
    for i, (offset, kind) in enumerate(zip(zeros.offsets, zeros.units, strict=True), start=1):
        values = {"deg": offset / DEG, "rad": offset} if kind == "rad" else {"mm": offset}
        lines.append(",".join([str(i), *(row_of((values[unit],)) if unit in values else "" for unit in units)]))
    return "\n".join(lines) + "\n"


def entries_of_joints(
    usual: list[str], known: list[str], named: Sequence[str] | None, zeros: ZeroOffsets, what: str
) -> list[tuple[str, int]]:
    """The entry of each joint in the file, and the sign of its readings against those of the joint."""
    joints = len(zeros.offsets)
    chosen = [(name.removeprefix("-"), -1 if name.startswith("-") else 1) for name in named or usual[:joints]]
    names = [name for name, _ in chosen]
    unknown = [name for name in names if name not in known]
    if unknown or len(names) != joints or len(set(names)) != joints:
        said = f"there is no {what} {quoted(unknown[0])}" if unknown else f"{joints} joints need as many names"
        raise InputError(f"{said}; name one {what} per joint (--motors) of those in the file: {shorten(known, 12)}.")
    return chosen

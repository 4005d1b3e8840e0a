"""The zero offsets of joints, which are all that most controllers take of a calibration, and their table as CSV."""

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.text import quoted, shorten
from ...core.units import DEG
from ...kinematics.arm import Arm, by_joint, joint_limits, natural_steps, one_chain, with_arrays
from ...kinematics.parameters import Parameters, single
from .tables import row_of

_ENOUGH = 30  # steps of Gauss and Newton, of which some five are needed
_POSES = 1000  # within the joint limits


class ZeroOffsets(NamedTuple):
    """The zero offsets of the joints with which the nominal arm comes closest to a calibrated one.

    Example:
        >>> zeros = aj.files.ZeroOffsets(np.array([0.01]), ("rad",), np.zeros(3), 1.0, 0.1, 0.2)
        >>> print(aj.files.zero_offsets_csv(zeros).splitlines()[-1])
        1,0.5729577951308232,0.01
    """

    offsets: Float[np.ndarray, " n"]  # to add to the readings, rad, or mm of prismatic joints
    units: tuple[str, ...]  # of each, rad or mm
    probe: Float[np.ndarray, " 3"]  # the tip of both arms in the last frame, mm
    rms_nominal: float  # distance of the nominal arm's tips from the calibrated arm's without offsets, mm
    rms: float  # the same with the offsets, mm
    largest: float  # mm
    within_limits: tuple[float, float, float] | None = None  # the same three in poses over all joint limits
    held: tuple[int, ...] = ()  # joints, from 1, whose zero the calibration does not determine: offset 0
    read_as: tuple[int, ...] | None = None  # `Recording.read_as`


class ZerosInFile(NamedTuple):
    """A file with other zero offsets."""

    text: str
    notes: tuple[str, ...]  # what it means, in sentences


def zero_offsets(
    nominal: Arm,
    calibrated: Arm,
    q: Float[np.ndarray, "N n"],
    *,
    free: Collection[str] | None = None,
    within_limits: bool = False,
) -> ZeroOffsets:
    """The restriction of a calibration to zero offsets, for controllers that take nothing else.

    The offsets minimise the distance of the nominal arm's tips from the calibrated arm's over the readings; both have
    the tip of the calibrated arm in their last frame. The rest of the calibration remains as an error.

    Args:
        nominal: The arm that the controller has.
        calibrated: The calibrated arm.
        q: Readings, rad, or mm of prismatic joints: of the capture, or of the poses that matter.
        free: Parameters that the calibration determined (``theta_i``; ``d_i`` of prismatic joints). The other joints
            get no offset. By default all get one.
        within_limits: Fit over random poses within the joint limits as well, with the same weight as over ``q``, and
            state what remains there: a few poses in a part of the volume alone give offsets that are worse elsewhere.

    Example:
        >>> zeros = aj.files.zero_offsets(arm, result.arm, np.array(capture.q))
        >>> print(f"{zeros.rms_nominal:.2f} mm without offsets, {zeros.rms:.2f} mm with them")
        2.05 mm without offsets, 1.61 mm with them
    """
    nominal, calibrated = (one_chain(single(arm), "a table of joint zero offsets") for arm in (nominal, calibrated))
    if nominal.joints != calibrated.joints:
        raise InputError(
            f"the arms have {nominal.joints} and {calibrated.joints} joints; give two arms with the same number of "
            "joints."
        )
    regions = [np.asarray(q)]
    if within_limits:
        low, high = np.asarray(joint_limits(nominal, None)).T
        regions.append(np.random.default_rng(0).uniform(low, high, (_POSES, nominal.joints)))
    start = with_arrays(nominal, probe=np.asarray(calibrated.probe))
    names = [f"{kind}_{i}" for i, kind in enumerate(by_joint(nominal, "theta", "d"), start=1)]
    moved = [i for i, name in enumerate(names) if free is None or name in free]
    offsets, chosen = np.zeros(len(names)), [names[i] for i in moved]
    space, steps = Parameters(start, tuple(names)), natural_steps(chosen)
    zero, weights = np.asarray(space.vector()), [1 / math.sqrt(len(region)) for region in regions]
    targets = [np.asarray(calibrated.position(region)) for region in regions]

    def errors() -> list[np.ndarray]:
        arm = space.arm(zero + offsets)
        return [target - np.asarray(arm.position(region)) for target, region in zip(targets, regions, strict=True)]

    before = [_statistics(part) for part in errors()]
    for _ in range(_ENOUGH if moved else 0):
        arm, parts = space.arm(zero + offsets), errors()
        columns = [np.asarray(arm.jacobian(region, chosen)).reshape(-1, len(chosen)) * steps for region in regions]
        change = np.linalg.lstsq(
            np.concatenate([weight * part for weight, part in zip(weights, columns, strict=True)]),
            np.concatenate([weight * part.ravel() for weight, part in zip(weights, parts, strict=True)]),
            rcond=1e-9,
        )[0]
        offsets[moved] += change * steps
        if np.all(np.abs(change) < 1e-10):
            break
    figures = [(was, *now) for (was, _), now in zip(before, map(_statistics, errors()), strict=True)]
    return ZeroOffsets(
        offsets,
        tuple(by_joint(nominal, "rad", "mm")),
        np.asarray(calibrated.probe),
        *figures[0],
        within_limits=figures[1] if within_limits else None,
        held=tuple(i for i in range(1, len(names) + 1) if i - 1 not in moved),
    )


def _statistics(errors: Float[np.ndarray, "N 3"]) -> tuple[float, float]:
    """Root mean square and largest distance, mm."""
    distances = np.linalg.norm(errors, axis=1)
    return float(np.sqrt(np.mean(distances**2))), float(distances.max())


def remaining_error(zeros: ZeroOffsets) -> list[str]:
    """What zero offsets leave of the distance between the nominal and the calibrated arm, in sentences."""

    def figures(nominal: float, rms: float, largest: float) -> str:
        return f"by {rms:.4f} mm RMS, at most {largest:.4f} mm ({nominal:.4f} mm RMS without offsets)"

    figures_of = {"in the poses given": (zeros.rms_nominal, zeros.rms, zeros.largest)}
    if zeros.within_limits is not None:
        figures_of = {"in the recorded poses": zeros[3:6], "over all joint limits": zeros.within_limits}
    parts = [f"{where} {figures(*values)}" for where, values in figures_of.items()]
    notes = [
        f"With these zero offsets, the tips of the nominal and the calibrated arm differ {'; '.join(parts)}.",
        f"Both arms have the tip of the calibration in the last frame: {row_of(zeros.probe, ' ')} mm.",
    ]
    no_gain = [where for where, (nominal, rms, _) in figures_of.items() if rms >= nominal]
    if no_gain:
        notes.append(
            f"Warning: {' and '.join(no_gain)}, the arm is not better with these offsets than without them; keep the "
            "nominal zeros, or use the whole calibration (aacmm correct, or export the arm)."
        )
    if zeros.held:
        notes.append(
            "The calibration does not determine the zeros of these joints, so they get no offset: "
            f"{', '.join(map(str, zeros.held))}."
        )
    return notes


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
        *(f"# {x}" for x in remaining_error(zeros)),
    ]
    recorded = zeros.read_as or ()
    if against := [str(i) for i, number in enumerate(recorded, start=1) if number < 0]:
        lines.append(f"# Recorded with the opposite sign, so subtract there instead: joint {', '.join(against)}.")
    units = ["deg", "rad", *(["mm"] if "mm" in zeros.units else [])]
    lines.append(",".join(["joint", *(f"offset_{unit}" for unit in units)]))
    for i, (offset, kind) in enumerate(zip(zeros.offsets, zeros.units, strict=True), start=1):
        values = {"deg": offset / DEG, "rad": offset} if kind == "rad" else {"mm": offset}
        lines.append(",".join([str(i), *(row_of((values[unit],)) if unit in values else "" for unit in units)]))
    return "\n".join(lines) + "\n"


def entries_of_joints(
    usual: list[str], known: list[str], named: Sequence[str] | None, zeros: ZeroOffsets, what: str
) -> list[tuple[str, int]]:
    """The entry of each joint in the file, and the sign of its readings against those of the joint: as named, else as
    the joints were recorded."""
    joints = len(zeros.offsets)
    recorded = zeros.read_as or tuple(range(1, joints + 1))
    if named is None and len(usual) >= joints:
        return [(usual[abs(number) - 1], 1 if number > 0 else -1) for number in recorded]
    chosen = [(name.removeprefix("-"), -1 if name.startswith("-") else 1) for name in named or usual]
    names = [name for name, _ in chosen]
    unknown = [name for name in names if name not in known]
    if unknown or len(names) != joints or len(set(names)) != joints:
        said = f"there is no {what} {quoted(unknown[0])}" if unknown else f"{joints} joints need as many names"
        raise InputError(f"{said}; name one {what} per joint (--motors) of those in the file: {shorten(known, 12)}.")
    return chosen

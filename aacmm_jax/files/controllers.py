"""What a robot's controller or a program takes of a calibrated arm: tables, zero offsets alone, a Python program."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arguments import checked_arguments
from ..core.errors import InputError
from ..core.rotations import roll_pitch_yaw
from ..core.units import DEG
from ..kinematics.arm import (
    Arm,
    by_joint,
    correction_names,
    natural_steps,
    parameter_unit,
    value_of,
    with_arrays,
    without_corrections,
)
from ..kinematics.axes_to_dh import Transform, canonical_origins, geometry_of
from ..kinematics.chain import Geometry
from ..kinematics.parameters import Parameters, single

_UNITS = {"mm-deg": ("mm", "deg", 1.0, 1 / DEG), "m-rad": ("m", "rad", 1e-3, 1.0)}
_STANDARD = "T_i = Rz(q_i + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)"
_CRAIG = "T_i = Tx(a) Rx(alpha) Ry(beta) Rz(q_i + theta) Tz(d), with a, alpha and beta of the link before joint i"
_SLIDES = "readings of the prismatic joints ({}) are added to d: Rz(theta) Tz(q_i + d)"
_ENOUGH = 30  # steps of Gauss and Newton, of which some five are needed


class ZeroOffsets(NamedTuple):
    """The zero offsets of the joints with which the nominal arm comes closest to a calibrated one."""

    offsets: Float[np.ndarray, " n"]  # to add to the readings, rad, or mm of prismatic joints
    units: tuple[str, ...]  # of each, rad or mm
    probe: Float[np.ndarray, " 3"]  # the tip in the nominal arm's last frame that goes with them, mm
    rms_nominal: float  # distance to the calibrated arm without offsets, the probe fitted, mm
    rms: float  # the same with the offsets, mm
    largest: float  # mm


@checked_arguments
def dh_table(
    arm: Arm,
    *,
    convention: Literal["standard", "craig"] = "standard",
    units: Literal["mm-deg", "m-rad"] = "mm-deg",
    base: Transform | None = None,
) -> str:
    """A Denavit-Hartenberg table as CSV, with comments that say what each column is and where base and tip are.

    Args:
        arm: One arm.
        convention: ``"standard"``, or ``"craig"`` (modified): the link before each joint instead of that after it.
        units: ``"mm-deg"`` or ``"m-rad"``.
        base: The first frame in a robot's base link, mm, where it is another one.

    Example:
        >>> for line in aj.files.dh_table(arm).splitlines()[-3:]:
        ...     print(line)
        4,0.0,0.0,62.0,-90.00021045914971,0.0
        5,0.0,500.0,0.0,-90.00021045914971,0.0
        6,0.0,11.5,0.0,-90.0,0.0
    """
    length_unit, angle_unit, length, angle = _UNITS[units]

    def placed(transform: Transform) -> str:
        xyz, rpy = length * transform[:3, 3], angle * roll_pitch_yaw(transform[:3, :3])
        return f"x y z = {_row(xyz, ' ')} {length_unit}, roll pitch yaw = {_row(rpy, ' ')} {angle_unit}"

    geometry = geometry_of(without_corrections(single(arm)))
    links = np.stack([length * geometry.a, angle * geometry.alpha, angle * _beta(geometry)], axis=1)
    lines = [f"# {_CRAIG if convention == 'craig' else _STANDARD}"]
    if arm.prismatic:
        lines.append(f"# {_SLIDES.format(', '.join(map(str, arm.prismatic)))}")
    if base is not None and not np.array_equal(base, np.eye(4)):
        lines.append(f"# first frame in the base link: {placed(base)}")
    if convention == "craig":
        links = np.concatenate([np.zeros((1, 3)), links[:-1]])
        lines.append(f"# tip in the last frame: {placed(canonical_origins(geometry)[-1])}")
    else:
        lines.append(f"# tip in the last frame: x y z = {_row(length * geometry.probe, ' ')} {length_unit}")
    heads = [f"theta_{angle_unit}", f"d_{length_unit}", f"a_{length_unit}", f"alpha_{angle_unit}", f"beta_{angle_unit}"]
    lines.append(",".join(["joint", *heads]))
    joints = np.stack([angle * geometry.theta, length * geometry.d], axis=1)
    lines += [f"{i},{_row(row)}" for i, row in enumerate(np.concatenate([joints, links], axis=1), start=1)]
    if arm.corrections is not None:
        lines.append("# coefficients of joint corrections, which are not Denavit-Hartenberg parameters:")
        coefficients = ((name, float(value_of(arm, name))) for name in correction_names(arm))
        lines += [f"# {name} = {value!r} {parameter_unit(arm, name)}" for name, value in coefficients if value != 0]
    return "\n".join(lines) + "\n"


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
    nominal, calibrated = single(nominal), single(calibrated)
    if nominal.joints != calibrated.joints:
        raise InputError(f"the arms have {nominal.joints} and {calibrated.joints} joints; give arms with as many.")
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
        # To be added to the joint readings of the nominal arm.
    """
    lines = [
        "# To be added to the joint readings of the nominal arm.",
        f"# Distance of the tip from the calibrated arm's: RMS {zeros.rms:.4f} mm, largest {zeros.largest:.4f} mm; RMS",
        f"# {zeros.rms_nominal:.4f} mm without the offsets. Tip in the last frame: {_row(zeros.probe, ' ')} mm.",
    ]
    units = ["deg", "rad", *(["mm"] if "mm" in zeros.units else [])]
    lines.append(",".join(["joint", *(f"offset_{unit}" for unit in units)]))
    for i, (offset, kind) in enumerate(zip(zeros.offsets, zeros.units, strict=True), start=1):
        values = {"deg": offset / DEG, "rad": offset} if kind == "rad" else {"mm": offset}
        lines.append(",".join([str(i), *(_row((values[unit],)) if unit in values else "" for unit in units)]))
    return "\n".join(lines) + "\n"


def python_program(arm: Arm, *, title: str, base: Transform | None = None) -> str:
    """A Python program of the arm that needs NumPy only: ``position(q)`` and ``pose(q)``, mm and rad.

    Args:
        arm: One arm.
        title: The first line of its documentation.
        base: The first frame in a robot's base link, mm; poses are in the base link then.

    Example:
        >>> program = aj.files.python_program(result.arm, title="Calibrated arm")
        >>> namespace = {}
        >>> exec(program, namespace)
        >>> print(np.abs(namespace["position"](q) - result.arm.position(q)).max() < 1e-9)
        True
    """
    geometry = geometry_of(single(arm))
    values = {"THETA": geometry.theta, "D": geometry.d, "A": geometry.a, "ALPHA": geometry.alpha}
    values |= {"BETA": _beta(geometry), "PROBE": geometry.probe}
    constants = [f"{name} = [{_row(row, ', ')}]" for name, row in values.items()]
    constants.append(f"PRISMATIC = {by_joint(arm, False, True)}")
    rows = ",\n".join(f"    [{_row(row, ', ')}]" for row in (np.eye(4) if base is None else base))
    template = Path(__file__).with_name("templates") / "program.txt"
    return template.read_text("utf-8").format(title=repr(title), base=rows, constants="\n".join(constants))


def _beta(geometry: Geometry) -> Float[np.ndarray, " n"]:
    return np.zeros(len(geometry.theta)) if geometry.beta is None else np.asarray(geometry.beta)


def _row(values: Iterable[float], separator: str = ",") -> str:
    # Below 1e-12 of any unit is rounding.
    return separator.join(repr(float(value) if abs(value) > 1e-12 else 0.0) for value in values)

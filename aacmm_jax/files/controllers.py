"""What a robot's controller or a program takes of a calibrated arm: tables, zero offsets alone, a Python program; and
the kinematics of Universal Robots' arms, as their ROS driver and ``ur_description`` exchange it.

``kinematics.yaml`` has the origin (x, y, z in m; roll, pitch, yaw in rad) of every joint in the frame of the joint
before it. A robot itself has Denavit-Hartenberg parameters by the common normal, ``dh_theta``, ``dh_a``, ``dh_d`` and
``dh_alpha``, whose frames on the nearly parallel axes 2, 3 and 4 may be hundreds of metres away. Both are read. On
writing, these frames are put back to where the axis crosses the plane of the frame before, as the driver's calibration
correction does (UniversalRobots/Universal_Robots_ROS2_Driver, ur_calibration/doc/algorithm.rst).
"""

import math
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arguments import checked_arguments
from ..core.arrays import Numbers
from ..core.errors import InputError, naming
from ..core.rotations import roll_pitch_yaw, roll_pitch_yaw_matrix
from ..core.text import is_number, number, quoted
from ..core.units import DEG
from ..kinematics.arm import (
    Arm,
    arm_of,
    by_joint,
    correction_names,
    natural_steps,
    one_chain,
    parameter_unit,
    value_of,
    with_arrays,
    without_corrections,
)
from ..kinematics.axes_to_dh import (
    Axes,
    Transform,
    canonical_origins,
    dh_of_axes,
    geometry_of,
    inverse,
    without_far_frames,
)
from ..kinematics.chain import Geometry
from ..kinematics.parameters import ArmSpecification, Parameters, single, with_tool
from .inputs import InputFile

_UNITS = {"mm-deg": ("mm", "deg", 1.0, 1 / DEG), "m-rad": ("m", "rad", 1e-3, 1.0)}
_STANDARD = "T_i = Rz(q_i + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)"
_CRAIG = "T_i = Tx(a) Rx(alpha) Ry(beta) Rz(q_i + theta) Tz(d), with a, alpha and beta of the link before joint i"
_SLIDES = "readings of the prismatic joints ({}) are added to d: Rz(theta) Tz(q_i + d)"
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
        f"{_row(zeros.probe, ' ')} mm.",
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


_JOINTS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
_DH = ("dh_theta", "dh_a", "dh_d", "dh_alpha")
_LIMITS = (-2 * math.pi, 2 * math.pi)  # of every joint of these robots
_LARGEST = 1e5  # m and rad: frames on nearly parallel axes are hundreds of metres away
_LINE = re.compile(r"( *)([\w-]+) *:(?: +([^#]*?))?\s*(?:#.*)?")


def read_ur_kinematics(path: str | os.PathLike, *, probe: Numbers | None = None) -> ArmSpecification:
    """The arm of a ``kinematics.yaml``, or of a YAML file with a robot's D-H parameters; ``probe`` as of `load_arm`.

    It is in the controller's base frame (``base_link_inertia`` of the URDF); its limits are those of these robots'
    joints, two revolutions.
    """
    text = InputFile(path).text
    with naming(path):
        entries = _entries(text)
        if any(name in entries for name in _DH):
            theta, a, d, alpha = (_numbers_of(entries, name, len(_JOINTS)) for name in _DH)
            geometry = Geometry(alpha, 1000 * a, 1000 * d, theta, None, np.zeros(3))
        else:
            geometry = _of_origins(entries)
        arm = without_far_frames(arm_of(geometry, [_LIMITS] * len(_JOINTS)))
        if probe is not None:
            arm = with_tool(arm, probe)
        return ArmSpecification(arm, os.path.splitext(os.path.basename(os.fspath(path)))[0])


def ur_kinematics_yaml(arm: Arm) -> str:
    """A ``kinematics.yaml`` of an arm of six joints, for ``ur_description`` and the driver.

    Frames on nearly parallel axes are where the axis crosses the plane of the frame before; the base, the readings and
    the tip stay. The tip in the tool flange's frame, which the file has no place for, is stated as a comment.

    Args:
        arm: One arm; mm and rad become m and rad in the file.

    Example:
        >>> for line in aj.files.ur_kinematics_yaml(aj.load_arm("ur10e")).splitlines()[-3:]:
        ...     print(line)
            pitch: 0.0
            yaw: 0.0
          hash: aacmm_jax_calibration
    """
    if single(arm).joints != len(_JOINTS):
        raise InputError(
            f"kinematics.yaml describes six joints, but the arm has {arm.joints}; choose another --format."
        )
    values = [
        # 0.0 is added, as -0.0 becomes 0.0.
        [repr(float(x) + 0.0) for x in (*origin[:3, 3] / 1000, *roll_pitch_yaw(origin[:3, :3]))]
        for origin in canonical_origins(geometry_of(without_far_frames(arm)))
    ]
    lines = [
        "# Written by aacmm_jax: origins of the joints of a calibrated arm, in m and rad.",
        "# The driver warns that the hash differs from the controller's, because these are not the factory parameters.",
        f"# Tip in the frame of the tool flange, to be entered as TCP in the controller: {' '.join(values[-1])}",
        "kinematics:",
    ]
    for name, numbers in zip(_JOINTS, values[:-1], strict=True):
        lines += [f"  {name}:", *(f"    {key}: {text}" for key, text in zip(_COORDINATES, numbers, strict=True))]
    return "\n".join([*lines, "  hash: aacmm_jax_calibration"]) + "\n"


def _of_origins(entries: dict[str, str]) -> Geometry:
    directions, points, frame = [], [], np.eye(4)
    for name in _JOINTS:
        numbers = np.concatenate([_numbers_of(entries, f"kinematics.{name}.{key}", 1) for key in _COORDINATES])
        origin = np.eye(4)
        origin[:3, :3] = roll_pitch_yaw_matrix(numbers[3:])
        origin[:3, 3] = 1000 * numbers[:3]
        frame = frame @ origin
        directions.append(frame[:3, 2])
        points.append(frame[:3, 3])
    base, geometry = dh_of_axes(Axes(np.array(directions), np.array(points), frame))
    if np.abs(inverse(base)[:3, :] - np.eye(4)[:3, :]).max() > 1e-9:
        raise InputError("the axis of the first joint is not the z axis of the base; correct kinematics.shoulder.")
    return geometry


def _numbers_of(entries: dict[str, str], name: str, count: int) -> Float[np.ndarray, " k"]:
    """The numbers of an entry, m and rad."""
    if name not in entries:
        of_joints = ", which a kinematics.yaml has for each of its six joints" if count == 1 else ""
        raise InputError(f"'{name}' is missing; add this entry{of_joints}.")
    parts = entries[name].strip("[] ").replace(",", " ").split()
    numbers = np.array([number(part) if is_number(part) else math.nan for part in parts])
    if len(parts) != count or not np.all(np.abs(numbers) < _LARGEST):
        asked = "a finite number" if count == 1 else "six finite numbers"
        raise InputError(f"'{name}' is {quoted(entries[name])}; give {asked} below {_LARGEST:g}, in m or rad.")
    return numbers


def _entries(text: str) -> dict[str, str]:
    """The values of a YAML file of nested keys by dotted name, as text: the part of YAML that these files use."""
    entries: dict[str, str] = {}
    above: list[tuple[int, str]] = []
    for count, line in enumerate(text.split("\n"), start=1):
        if not line.strip() or line.lstrip().startswith(("#", "---")):
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise InputError(f"line {count} is not of the form 'key: value'; correct the line.")
        indent, key, value = len(match[1]), match[2], match[3] or ""
        while above and above[-1][0] >= indent:
            above.pop()
        name = ".".join([*(part for _, part in above), key])
        if name in entries:
            raise InputError(f"line {count}: '{name}' occurs twice; remove one of the two.")
        entries[name] = value
        if not value:
            above.append((indent, key))
    return entries

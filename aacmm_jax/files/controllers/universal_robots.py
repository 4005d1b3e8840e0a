"""Kinematics of Universal Robots' arms, as their ROS driver and ``ur_description`` exchange it, and as a robot has it.

``kinematics.yaml`` has the origin (x, y, z in m; roll, pitch, yaw in rad) of every joint in the frame of the joint
before it. A robot itself has Denavit-Hartenberg parameters by the common normal, ``dh_theta``, ``dh_a``, ``dh_d`` and
``dh_alpha``, whose frames on the nearly parallel axes 2, 3 and 4 may be hundreds of metres away. Both are read. On
writing, these frames are put back to where the axis crosses the plane of the frame before, as the driver's calibration
correction does (UniversalRobots/Universal_Robots_ROS2_Driver, ur_calibration/doc/algorithm.rst).

On the robot, ``calibration.conf`` has what its parameters differ by, ``delta_theta`` to ``delta_alpha``, from the
nominal ones in section [DH] of ``urcontrol.conf``, m and rad (forum.universal-robots.com, topic 18921).
"""

import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers
from ...core.errors import InputError, naming
from ...core.rotations import roll_pitch_yaw, roll_pitch_yaw_matrix
from ...core.text import is_number, number, quoted
from ...kinematics.arm import Arm, arm_of
from ...kinematics.axes_to_dh import Axes, canonical_origins, dh_of_axes, geometry_of, inverse, without_far_frames
from ...kinematics.chain import Geometry
from ...kinematics.parameters import ArmSpecification, single, with_tool
from ..inputs import InputFile
from ..yaml_text import yaml_content

_JOINTS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
_DH = ("theta", "a", "d", "alpha")
_LIMITS = (-2 * math.pi, 2 * math.pi)  # of every joint of these robots
_LARGEST = 1e5  # m and rad: frames on nearly parallel axes are hundreds of metres away
_ROW = re.compile(r"^[ \t]*(\w+)[ \t]*=[ \t]*(\[[^\[\]#\n]*\]|\d+)", re.MULTILINE)  # of *.conf
_NEAR = 10.0, 0.05  # mm and rad: calibrations of these robots are nearer to the nominal parameters of the model
_CALIBRATED = 2  # of calibration_status: 0 not initialised, 1 not linearised


def read_ur_kinematics(path: str | os.PathLike, *, probe: Numbers | None = None) -> ArmSpecification:
    """The arm of a ``kinematics.yaml``, of a YAML file with a robot's D-H parameters, or of a ``calibration.conf``
    beside its ``urcontrol.conf``; ``probe`` as of `load_arm`.

    It is in the controller's base frame (``base_link_inertia`` of the URDF); its limits are those of these robots'
    joints, two revolutions.
    """
    file = InputFile(path)
    text, nominal = file.text, None
    with naming(path):
        if Path(file).suffix.lower() == ".conf":
            geometry, nominal = _of_robot(text, Path(file))
        elif any(f"dh_{kind}" in (content := yaml_content(text)) for kind in _DH):
            geometry = _geometry(*(_numbers_of(content, f"dh_{kind}", len(_JOINTS)) for kind in _DH))
        else:
            geometry = _of_origins(content)
        arm = without_far_frames(arm_of(geometry, [_LIMITS] * len(_JOINTS)))
        if nominal is not None:
            _check_near(geometry_of(arm), nominal)
        if probe is not None:
            arm = with_tool(arm, probe)
        return ArmSpecification(arm, Path(file).stem)


def _geometry(theta: np.ndarray, a: np.ndarray, d: np.ndarray, alpha: np.ndarray) -> Geometry:
    return Geometry(alpha, 1000 * a, 1000 * d, theta, None, np.zeros(3))


def _of_robot(text: str, file: Path) -> tuple[Geometry, Geometry]:
    """The nominal parameters of ``urcontrol.conf`` with the differences of a ``calibration.conf``, and without."""
    rows = dict(reversed(_ROW.findall(text)))  # the first of each name
    kinds = [f"delta_{kind}" for kind in _DH]
    differences = np.zeros((4, len(_JOINTS)))
    if any(kind in rows for kind in kinds):
        differences = np.array([_numbers_of(rows, kind, len(_JOINTS)) for kind in kinds])
        if (status := rows.get("calibration_status", str(_CALIBRATED))) != str(_CALIBRATED):
            raise InputError(f"calibration_status is {quoted(status)}, not {_CALIBRATED}; give a finished calibration.")
        beside = sorted(file.parent.glob("urcontrol.conf*"))
        if "alpha" not in rows and len(beside) != 1:
            raise InputError(
                f"there are {len(beside)} files urcontrol.conf beside it, but the nominal parameters in [DH] of one "
                "are needed; put the robot's own there."
            )
        rows = rows if "alpha" in rows else dict(reversed(_ROW.findall(InputFile(beside[0]).text)))
    nominal = [_numbers_of(rows, kind, len(_JOINTS)) for kind in _DH[1:]]
    table = np.array([np.zeros(len(_JOINTS)), *nominal])
    return _geometry(*(table + differences)), _geometry(*table)


def _check_near(calibrated: Geometry, nominal: Geometry) -> None:
    length, turn = _NEAR
    turned = np.angle(np.exp(1j * (calibrated.theta - nominal.theta)))
    moved = np.maximum(np.abs(calibrated.a - nominal.a), np.abs(calibrated.d - nominal.d))
    if np.any(moved > length) or np.any(np.abs(turned) > turn):
        raise InputError(
            f"the calibrated lengths differ from those in [DH] of urcontrol.conf by up to {moved.max():.0f} mm, "
            f"and zeros of joints by up to {np.abs(turned).max():.2f} rad; give that of the robot's model."
        )


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


def _of_origins(content: dict[str, Any]) -> Geometry:
    directions, points, frame = [], [], np.eye(4)
    for name in _JOINTS:
        numbers = np.concatenate([_numbers_of(content, f"kinematics.{name}.{key}", 1) for key in _COORDINATES])
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


def _numbers_of(content: Any, name: str, count: int) -> Float[np.ndarray, " k"]:
    """The numbers of an entry, by its name with dots, m and rad."""
    for part in name.split("."):
        content = content.get(part) if isinstance(content, dict) else None
    if content is None:
        of_joints = ", which a kinematics.yaml has for each of its six joints" if count == 1 else ""
        raise InputError(f"'{name}' is missing; add this entry{of_joints}.")
    text = " ".join(map(str, content)) if isinstance(content, list) else str(content)
    parts = text.strip("[] ").replace(",", " ").split()
    numbers = np.array([number(part) if is_number(part) else math.nan for part in parts])
    if len(parts) != count or not np.all(np.abs(numbers) < _LARGEST):
        asked = "a finite number" if count == 1 else "six finite numbers"
        raise InputError(f"'{name}' is {quoted(text)}; give {asked} below {_LARGEST:g}, in m or rad.")
    return numbers

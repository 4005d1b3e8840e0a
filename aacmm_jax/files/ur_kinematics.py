"""The kinematics of Universal Robots' arms, as their ROS driver and ``ur_description`` exchange it.

``kinematics.yaml`` has the origin (x, y, z in m; roll, pitch, yaw in rad) of every joint in the frame of the joint
before it. A robot itself has Denavit-Hartenberg parameters by the common normal, ``dh_theta``, ``dh_a``, ``dh_d`` and
``dh_alpha``, whose frames on the nearly parallel axes 2, 3 and 4 may be hundreds of metres away. Both are read. On
writing, these frames are put back to where the axis crosses the plane of the frame before, as the driver's calibration
correction does (UniversalRobots/Universal_Robots_ROS2_Driver, ur_calibration/doc/algorithm.rst).
"""

import math
import os
import re

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers
from ..core.errors import InputError, naming
from ..core.rotations import roll_pitch_yaw, roll_pitch_yaw_matrix
from ..core.text import number, quoted
from ..kinematics.arm import Arm, arm_of
from ..kinematics.axes_to_dh import (
    Axes,
    canonical_origins,
    dh_of_axes,
    geometry_of,
    inverse,
    without_far_frames,
)
from ..kinematics.chain import Geometry
from ..kinematics.parameters import ArmSpecification, single, with_tool
from .inputs import InputFile

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
    file = InputFile(path)
    with naming(path):
        try:
            text = file.text
        except UnicodeDecodeError as error:
            raise InputError("it is not text in UTF-8; name a YAML file.") from error
        entries = _entries(text)
        if any(name in entries for name in _DH):
            theta, a, d, alpha = (_numbers_of(entries, name, len(_JOINTS)) for name in _DH)
            geometry = Geometry(alpha, 1000 * a, 1000 * d, theta, None, np.zeros(3))
        else:
            geometry = _of_origins(entries)
        arm = without_far_frames(arm_of(geometry, [_LIMITS] * len(_JOINTS)))
        if probe is not None:
            arm = with_tool(arm, probe)
        return ArmSpecification(arm, os.path.splitext(os.path.basename(os.fspath(file)))[0])


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
        raise InputError(f"kinematics.yaml is of six joints, but the arm has {arm.joints}; choose another --format.")
    values = [
        # 0.0 is added, as -0.0 becomes 0.0.
        [repr(float(x) + 0.0) for x in (*origin[:3, 3] / 1000, *roll_pitch_yaw(origin[:3, :3]))]
        for origin in canonical_origins(geometry_of(without_far_frames(arm)))
    ]
    lines = [
        "# Written by aacmm_jax: origins of the joints of a calibrated arm, m and rad.",
        "# The driver warns that the hash is not the controller's, as the parameters are not those of the factory.",
        f"# The tip in the tool flange's frame, for the controller's TCP: {' '.join(values[-1])}",
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
        raise InputError("the first axis is not the z axis of the base (kinematics.shoulder); correct it there.")
    return geometry


def _numbers_of(entries: dict[str, str], name: str, count: int) -> Float[np.ndarray, " k"]:
    """The numbers of an entry, m and rad."""
    if name not in entries:
        of_joints = "; a kinematics.yaml has it for each of six joints." if count == 1 else "; add it."
        raise InputError(f"'{name}' is missing{of_joints}")
    parts = entries[name].strip("[] ").replace(",", " ").split()
    try:
        numbers = np.array([number(part) for part in parts])
    except ValueError:
        numbers = np.array([math.nan])
    if len(parts) != count or not np.all(np.abs(numbers) < _LARGEST):
        asked = "a finite number" if count == 1 else "six finite numbers"
        raise InputError(f"'{name}' is {quoted(entries[name])}; give {asked} below {_LARGEST:g}, m or rad.")
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
            raise InputError(f"line {count} is not of the form 'key: value'; correct it.")
        indent, key, value = len(match[1]), match[2], match[3] or ""
        while above and above[-1][0] >= indent:
            above.pop()
        name = ".".join([*(part for _, part in above), key])
        if name in entries:
            raise InputError(f"line {count}: '{name}' is there twice; take one out.")
        entries[name] = value
        if not value:
            above.append((indent, key))
    return entries

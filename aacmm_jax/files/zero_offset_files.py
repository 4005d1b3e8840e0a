"""Zero offsets of joints in the files of drivers and controllers, of which everything else stays.

LeRobot: calibration of the motors, JSON. A motor's position is what its encoder reads less ``homing_offset``, in counts
of which a turn has 4096 (huggingface/lerobot, src/lerobot/motors/feetech/feetech.py; Dynamixel motors add the offset:
dynamixel/dynamixel.py).
KUKA: ``$MAMES[i]`` in ``$machine.dat``, degrees or mm: the position that axis i gets when it is mastered at its notch
(KUKA Roboter GmbH: KR C2 Operating Handbook, Machine Data, 2005, section 2.1.7).
ROS: ``<calibration rising=... falling=.../>`` of a URDF's joint: the positions at which its reference switch changes
(wiki.ros.org/urdf/XML/joint). robot_calibration adds the offset of a joint to ``rising``, for drivers that read it.
"""

import json
import math
import os
import re
from collections.abc import Sequence
from typing import NamedTuple

from ..core.errors import InputError
from ..core.text import number, quoted, shorten
from ..core.units import DEG
from ..kinematics.parameters import UrdfSource
from .controllers import ZeroOffsets
from .inputs import InputFile
from .lerobot_motors import RESOLUTION, read_motors
from .urdf import urdf_chain
from .xml_text import replaced, with_values

_FARTHEST = 2047  # counts: the largest homing offset that LeRobot's motors store
_MAMES = re.compile(
    r"^([ \t]*(?:REAL[ \t]+)?\$MAMES\[(\d{1,3})\][ \t]*=[ \t]*)([-+]?\d+\.?\d*(?:[eE][-+]?\d+)?)", re.MULTILINE
)


class ZerosInFile(NamedTuple):
    """A file with other zero offsets."""

    text: str
    notes: tuple[str, ...]  # what it means, in sentences


def lerobot_calibration(
    path: str | os.PathLike, zeros: ZeroOffsets, motors: Sequence[str] | None = None
) -> ZerosInFile:
    """LeRobot's calibration file with the homing offsets that make readings those of the calibrated arm.

    Args:
        path: The file.
        zeros: The offsets, from `zero_offsets`; rad.
        motors: The motor of each joint, with ``-`` before it where its readings count against those of the arm, or
            where the motor adds its offset (Dynamixel). By default those of the file in order, without ``gripper``.

    Example:
        >>> from pathlib import Path
        >>> text = '{"pan": {"id": 1, "drive_mode": 0, "homing_offset": 10, "range_min": 0, "range_max": 4095}}'
        >>> _ = Path("motors.json").write_text(text)
        >>> zeros = aj.files.ZeroOffsets(np.array([0.01]), ("rad",), np.zeros(3), 1.0, 0.1, 0.2)
        >>> print(aj.files.lerobot_calibration("motors.json", zeros).text.split(",")[2].strip())
        "homing_offset": 3
    """
    found = read_motors(InputFile(path))
    if "mm" in zeros.units:
        raise InputError("the arm has prismatic joints, whose zero offsets are not counts of a turn; use offsets.")
    rounded, content = 0.0, {name: motor.model_dump() for name, motor in found.items()}
    chosen = _entries([name for name in found if name != "gripper"], list(found), motors, zeros, "motor")
    for (name, sign), offset in zip(chosen, zeros.offsets, strict=True):
        exact = sign * float(offset) * RESOLUTION / (2 * math.pi)
        content[name]["homing_offset"] = new = found[name].homing_offset - round(exact)
        rounded = max(rounded, abs(exact - round(exact)) * 360 / RESOLUTION)
        if abs(new) > _FARTHEST:
            raise InputError(
                f"motor {quoted(name)} would have the homing offset {new}, beyond the {_FARTHEST} counts that it "
                "stores; calibrate the motors nearer to the middle of their range first."
            )
    notes = (
        f"Homing offsets are whole counts of {360 / RESOLUTION:.3f} deg; by rounding, readings are off by up to "
        f"{rounded:.3f} deg.",
        "The ranges stay, so that the middle of a range remains the zero of its motor.",
    )
    return ZerosInFile(json.dumps(content, indent=4) + "\n", notes)


def kuka_machine_data(path: str | os.PathLike, zeros: ZeroOffsets, axes: Sequence[str] | None = None) -> ZerosInFile:
    """KUKA's ``$machine.dat`` with other ``$MAMES``, which apply from the next mastering on.

    Args:
        path: The file.
        zeros: The offsets, from `zero_offsets`; rad, or mm of prismatic joints.
        axes: The number of each joint's axis, with ``-`` before it where the axis counts against the joint; by default
            1, 2, ... in order.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("machine.dat").write_text("$MAMES[1]=-20.0")
        >>> zeros = aj.files.ZeroOffsets(np.array([0.1]) * np.pi / 180, ("rad",), np.zeros(3), 1.0, 0.1, 0.2)
        >>> print(aj.files.kuka_machine_data("machine.dat", zeros).text)
        $MAMES[1]=-19.9
    """
    file = InputFile(path)
    text = file.text and file.content.decode()  # with its own line ends
    known = [match[2] for match in _MAMES.finditer(text)]
    if not known:
        raise InputError(f"{path} has no line $MAMES[1]=..., as $machine.dat has for each axis; give this file.")
    added: dict[str, float] = {}
    chosen = _entries(known, known, axes, zeros, "axis")
    for (axis, sign), offset, unit in zip(chosen, zeros.offsets, zeros.units, strict=True):
        added[axis] = sign * float(offset) / (DEG if unit == "rad" else 1.0)

    def stated(match: re.Match[str]) -> str:
        return match[0] if match[2] not in added else f"{match[1]}{round(number(match[3]) + added[match[2]], 6)!r}"

    notes = (
        "$MAMES applies when an axis is mastered again; changing machine data wrongly can damage the robot, so keep "
        "the original file and try the axes slowly.",
    )
    return ZerosInFile(_MAMES.sub(stated, text), notes)


def ros_calibration(source: UrdfSource, zeros: ZeroOffsets) -> ZerosInFile:
    """A URDF whose joints have the zero offsets in ``<calibration>``; origins stay.

    Args:
        source: The URDF that the arm was read from.
        zeros: The offsets, from `zero_offsets`; rad, or mm of prismatic joints, which become m.

    Example:
        >>> robot = aj.files.load_specification("robot.urdf")
        >>> zeros = aj.files.ZeroOffsets(np.array([0.0, 0.01, 0.0]), ("rad",) * 3, np.zeros(3), 1.0, 0.1, 0.2)
        >>> text = aj.files.ros_calibration(robot.urdf, zeros).text
        >>> print([line.strip() for line in text.splitlines() if "calibration" in line])
        ['<calibration rising="0.01"/>']
    """
    if source.format != "URDF":
        raise InputError("the nominal arm was read from MJCF, which has no <calibration>; export mjcf.")
    content, changes = source.text.encode(), []
    for joint, offset, unit in zip(urdf_chain(source).joints, zeros.offsets, zeros.units, strict=True):
        amount = float(offset) * (1.0 if unit == "rad" else 1e-3)
        old = joint.element.child("calibration")
        edges = [] if old is None else [edge for edge in ("rising", "falling") if edge in old.attributes]
        values = {edge: repr(float(old.numbers(edge, (0.0,))[0]) + amount) for edge in edges if old is not None}
        values = values or {"rising": repr(amount)}
        if amount and old is not None:
            changes.append((*old.place, with_values(content[slice(*old.place)].decode(), values)))
        elif amount:  # after the joint's start tag, indented as what follows
            after = content[(end := joint.element.place[1]) :]
            tag = with_values("<calibration/>", values)
            changes.append((end, end, after[: len(after) - len(after.lstrip())].decode() + tag))
    return ZerosInFile(replaced(source.text, changes), (
        "<calibration> holds zero offsets only, and only drivers that read it apply them; do not use it together with "
        "origins of --format urdf, which contain the offsets.",
    ))  # fmt: skip


def _entries(
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

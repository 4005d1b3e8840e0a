"""LeRobot's calibration of its motors (JSON): the angles that its numbers stand for, and other zero offsets.

A motor's position is what its encoder reads less ``homing_offset``, in counts of which a turn has 4096
(huggingface/lerobot, src/lerobot/motors/feetech/feetech.py; Dynamixel motors add the offset: dynamixel/dynamixel.py).
"""

import json
import math
import os
from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from ...core.errors import InputError
from ...core.text import quoted, shorten
from ..inputs import InputFile
from ..manifest_tables import Angles
from ..toml import Strict, validated
from .offsets import ZeroOffsets, ZerosInFile, entries_of_joints

_RESOLUTION = 4096  # counts of one turn of the motors that LeRobot's arms have: STS3215, XL330, XL430
_FARTHEST = 2047  # counts: the largest homing offset that LeRobot's motors store


class _Motor(Strict):
    """What LeRobot stores of a motor: counts, of which the offset is subtracted before LeRobot reads them."""

    id: int
    drive_mode: Literal[0, 1]  # 1: turned round
    homing_offset: int
    range_min: int = Field(ge=-(2**31), le=2**31)
    range_max: int = Field(ge=-(2**31), le=2**31)


class _Motors(Strict):
    motors: dict[str, _Motor]


def _read_motors(file: InputFile) -> dict[str, _Motor]:
    """The motors of a calibration file by name, in its order. Raises `InputError`."""
    try:
        content = json.loads(file.content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file} is not valid JSON ({error}); give the calibration file of LeRobot.") from error
    if not isinstance(content, dict) or not content or not all(isinstance(motor, dict) for motor in content.values()):
        raise InputError(
            f"{file} is not a calibration of LeRobot, which has id, drive_mode, homing_offset, range_min and range_max "
            "for each motor; calibrate the motors with lerobot-calibrate."
        )
    motors = validated(_Motors, {"motors": content}, str(file)).motors
    for name, motor in motors.items():
        if motor.range_max <= motor.range_min:
            raise InputError(f"{file}: the range of motor '{name}' is empty; calibrate the motors again.")
    return motors


def angles_by_motors(angles: Angles, file: InputFile, joints: int) -> Angles:
    """How readings are written that LeRobot made with this calibration: [angles] with counts, offsets and signs.

    LeRobot's zero is the middle of a motor's range. Its degrees take a turn as 4095 counts, though it has 4096; its
    percent, -100 to 100 over the range, are counted the other way where the drive mode is 1. (``_normalize`` of
    lerobot/motors/motors_bus.py, as of 2025.) ``sign`` and ``offset`` of [angles] apply as to other readings.
    """
    motors = _read_motors(file)
    if len(motors) < joints:
        raise InputError(
            f"{file} has {len(motors)} motors ({shorten(list(motors), 8)}), but the arm has {joints} joints; give the "
            "calibration file of this arm."
        )
    chosen = list(motors.values())[:joints]  # behind them is that of the gripper
    signs = angles.sign if isinstance(angles.sign, list) else [angles.sign] * joints
    offsets = angles.offset if isinstance(angles.offset, list) else [angles.offset] * joints
    counts: list[float] = [_RESOLUTION] * joints
    if angles.unit == "deg":
        counts = [360 * _RESOLUTION / (_RESOLUTION - 1)] * joints
    elif angles.unit == "percent":
        counts = [_RESOLUTION * 200 / (motor.range_max - motor.range_min) for motor in chosen]
        signs = [-sign if motor.drive_mode else sign for sign, motor in zip(signs, chosen, strict=False)]
    else:
        middles = [(motor.range_min + motor.range_max) / 2 for motor in chosen]
        offsets = [offset + middle for offset, middle in zip(offsets, middles, strict=False)]
    stated = angles.model_dump(exclude_unset=True, exclude={"calibration"})
    converted = {**stated, "unit": "counts", "counts_per_turn": counts, "sign": signs, "offset": offsets}
    return Angles(**converted).of_lerobot(angles)


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
    found = _read_motors(InputFile(path))
    if "mm" in zeros.units:
        raise InputError("the arm has prismatic joints, whose zero offsets are not counts of a turn; use offsets.")
    rounded, content = 0.0, {name: motor.model_dump() for name, motor in found.items()}
    chosen = entries_of_joints([name for name in found if name != "gripper"], list(found), motors, zeros, "motor")
    for (name, sign), offset in zip(chosen, zeros.offsets, strict=True):
        exact = sign * float(offset) * _RESOLUTION / (2 * math.pi)
        content[name]["homing_offset"] = new = found[name].homing_offset - round(exact)
        rounded = max(rounded, abs(exact - round(exact)) * 360 / _RESOLUTION)
        if abs(new) > _FARTHEST:
            raise InputError(
                f"motor {quoted(name)} would have the homing offset {new}, beyond the {_FARTHEST} counts that it "
                "stores; calibrate the motors nearer to the middle of their range first."
            )
    notes = (
        f"Homing offsets are whole counts of {360 / _RESOLUTION:.3f} deg; by rounding, readings are off by up to "
        f"{rounded:.3f} deg.",
        "The ranges stay, so that the middle of a range remains the zero of its motor.",
    )
    return ZerosInFile(json.dumps(content, indent=4) + "\n", notes)

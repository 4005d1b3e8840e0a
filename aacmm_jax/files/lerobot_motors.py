"""LeRobot's calibration of its motors (JSON), and the angles that its numbers stand for."""

import json
from typing import Literal

from pydantic import Field

from ..core.errors import InputError
from ..core.text import shorten
from .inputs import InputFile
from .manifest_tables import Angles
from .toml import Strict, validated

RESOLUTION = 4096  # counts of one turn of the motors that LeRobot's arms have: STS3215, XL330, XL430


class Motor(Strict):
    """What LeRobot stores of a motor: counts, of which the offset is subtracted before LeRobot reads them."""

    id: int
    drive_mode: Literal[0, 1]  # 1: turned round
    homing_offset: int
    range_min: int = Field(ge=-(2**31), le=2**31)
    range_max: int = Field(ge=-(2**31), le=2**31)


class _Motors(Strict):
    motors: dict[str, Motor]


def read_motors(file: InputFile) -> dict[str, Motor]:
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
    motors = read_motors(file)
    if len(motors) < joints:
        raise InputError(
            f"{file} has {len(motors)} motors ({shorten(list(motors), 8)}), but the arm has {joints} joints; give the "
            "calibration file of this arm."
        )
    chosen = list(motors.values())[:joints]  # behind them is that of the gripper
    signs = angles.sign if isinstance(angles.sign, list) else [angles.sign] * joints
    offsets = angles.offset if isinstance(angles.offset, list) else [angles.offset] * joints
    counts: list[float] = [RESOLUTION] * joints
    if angles.unit == "deg":
        counts = [360 * RESOLUTION / (RESOLUTION - 1)] * joints
    elif angles.unit == "percent":
        counts = [RESOLUTION * 200 / (motor.range_max - motor.range_min) for motor in chosen]
        signs = [-sign if motor.drive_mode else sign for sign, motor in zip(signs, chosen, strict=False)]
    else:
        middles = [(motor.range_min + motor.range_max) / 2 for motor in chosen]
        offsets = [offset + middle for offset, middle in zip(offsets, middles, strict=False)]
    stated = angles.model_dump(exclude_unset=True, exclude={"calibration"})
    return Angles(**{**stated, "unit": "counts", "counts_per_turn": counts, "sign": signs, "offset": offsets})

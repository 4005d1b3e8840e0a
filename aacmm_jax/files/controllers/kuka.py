"""KUKA's machine data: ``$MAMES[i]`` in ``$machine.dat``, degrees or mm, is the position that axis i gets when it is
mastered at its notch (KUKA Roboter GmbH: KR C2 Operating Handbook, Machine Data, 2005, section 2.1.7)."""

import os
import re
from collections.abc import Sequence

from ...core.errors import InputError
from ...core.text import number
from ...core.units import DEG
from ..inputs import InputFile
from .offsets import ZeroOffsets, ZerosInFile, entries_of_joints

_MAMES = re.compile(
    r"^([ \t]*(?:REAL[ \t]+)?\$MAMES\[(\d{1,3})\][ \t]*=[ \t]*)([-+]?\d+\.?\d*(?:[eE][-+]?\d+)?)", re.MULTILINE
)


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
    chosen = entries_of_joints(known, known, axes, zeros, "axis")
    for (axis, sign), offset, unit in zip(chosen, zeros.offsets, zeros.units, strict=True):
        added[axis] = sign * float(offset) / (DEG if unit == "rad" else 1.0)

    def stated(match: re.Match[str]) -> str:
        return match[0] if match[2] not in added else f"{match[1]}{round(number(match[3]) + added[match[2]], 6)!r}"

    notes = (
        "$MAMES applies when an axis is mastered again; changing machine data wrongly can damage the robot, so keep "
        "the original file and try the axes slowly.",
    )
    return ZerosInFile(_MAMES.sub(stated, text), notes)

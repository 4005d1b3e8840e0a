"""Tables of poses, as joint readings or as positions with orientations: commanded and corrected, or recorded."""

import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.errors import InputError
from ..core.text import csv_text
from ..core.units import DEG, LENGTH_UNITS
from ..kinematics.arm import Arm, by_joint
from .table_columns import TEMPERATURE, find_named, header_units, position_columns, reading_columns
from .text_lines import Column
from .text_table import TextTable

_ANGLES = {"deg": DEG, "rad": 1.0}
_QUATERNION, _ROTATION = ("qw", "qx", "qy", "qz"), ("rx", "ry", "rz")
_ROUNDED = 1e-3  # of a quaternion's length: three decimals at least


class PoseTable(NamedTuple):
    """What a table of poses holds."""

    q: Float[np.ndarray, "N n"]  # readings, or where the search for a commanded pose begins, rad and mm
    poses: Float[np.ndarray, "N 4 4"] | None  # in the frame that the file uses, mm; None: those of the readings
    oriented: bool  # whether the table states orientations
    unit: str  # of the readings of revolute joints, deg or rad; those of prismatic joints are in mm
    length_unit: str  # of the positions in the file
    sockets: tuple[str, ...]  # of each pose
    arm: Arm
    table: TextTable
    columns: tuple[int, ...]  # of the readings, counted from 0; none: `near` was used
    temperature: Float[np.ndarray, " N"] | None  # C


def read_poses(
    path: str | os.PathLike,
    arm: Arm,
    *,
    unit: str | None = None,
    near: Sequence[float] | None = None,
    columns: Sequence[Column] | None = None,
    length_unit: str | None = None,
    recorded: bool = False,
) -> PoseTable:
    """Read a table with a row for each pose. Raises `InputError`.

    Of commanded poses: either joint readings, in columns named q_1, q_2, ... (or q1, joint_1, j1, a1; with a unit, as
    q_1_deg, if the header states it), or in all columns of a table without such names, or in ``columns``. Or positions
    and orientations: x, y, z (mm, or the header's unit; or px, py, pz) with qw, qx, qy, qz (quaternion) or rx, ry, rz
    (rotation vector, in ``unit`` unless the header says it), and the readings to begin with in columns as above, or
    ``near``. A column temperature_C is the arm's.

    Of poses that were ``recorded``: joint readings, and the position of the tip, perhaps with its orientation; without
    positions all poses are of one socket, or of those that a column ``socket`` names. A table without header has a
    column for each joint, and after them perhaps x, y and z.

    ``unit``, deg or rad, is that of revolute joints where the header does not say it, and of ``near``; recorded ones up
    to a revolution are in rad otherwise. ``length_unit``: of positions whose header states none, by default mm.
    """
    table, joints = TextTable(path), arm.joints
    position = position_columns(table)
    orientation = find_named(table, _QUATERNION) or find_named(table, _ROTATION, tuple(_ANGLES))
    if recorded and not table.header and table.width in (joints, joints + 3):
        picked, after = list(range(joints)), list(range(joints, table.width))
        position = (after, None) if after else None
    else:
        required, taken = recorded or orientation is None, position[0] if position else ()
        picked = reading_columns(table, joints, taken, columns, line="--columns {}", required=required)
    header, linear = header_units(table, picked, arm, unit) if picked else (None, None)
    if linear not in (None, "mm"):
        raise InputError(f"{path} states {linear} for readings of prismatic joints; convert them to mm.")
    if header is not None and (header not in _ANGLES or unit not in (None, header)):
        raise InputError(f"{path} states {header} for joint readings; give them in deg or rad, and leave out --unit.")
    if bool(picked) == (near is not None):
        raise InputError(
            f"{path} needs joint readings once: give columns q_1 to q_{joints} and leave out --near, or --near alone."
        )
    if near is not None and len(near) != joints:
        raise InputError(f"--near has {len(near)} readings, but the arm {joints} joints; give one per joint.")
    readings = table.numbers(picked) if near is None else np.tile(near, (table.length, 1))
    unit = header or unit
    if unit is None and recorded:
        unit = "deg" if np.abs(readings[:, by_joint(arm, True, False)]).max(initial=0) > 2 * np.pi else "rad"
    if unit is None:
        raise InputError(f"{path} does not say the unit of joint readings; give --unit deg or --unit rad.")
    poses = None
    if orientation is not None or (recorded and position is not None):
        poses = _poses(table, _ANGLES[unit], position, orientation or ([], None), length_unit)
    return PoseTable(
        np.array(by_joint(arm, _ANGLES[unit], 1.0)) * readings,
        poses,
        orientation is not None,
        unit,
        "mm" if position is None else position[1] or "mm",
        tuple(table.texts("socket")) if table.header and table.has(["socket"]) else ("A",) * table.length,
        arm,
        table,
        tuple(picked),
        table.numbers(table.pick([TEMPERATURE]))[:, 0] if table.has([TEMPERATURE]) else None,
    )


def corrected_csv(commanded: PoseTable, q: Float[np.ndarray, "N n"], reached: Bool[np.ndarray, " N"]) -> str:
    """The table with corrected readings in place of those commanded, or after the other columns, in the same unit.

    The readings (rad and mm) of rows that are not ``reached`` are left empty, so that nobody sends an arm there.
    """
    table, arm = commanded.table, commanded.arm
    rows = (q / np.array(by_joint(arm, _ANGLES[commanded.unit], 1.0))).T
    cells = [[repr(float(x)) if good else "" for x, good in zip(row, reached, strict=True)] for row in rows]
    names = [f"q_{i}_{unit}" for i, unit in enumerate(by_joint(arm, commanded.unit, "mm"), start=1)]
    header, joint_of = table.header, {column: i for i, column in enumerate(commanded.columns)}
    columns: list[tuple[str, Sequence[str]]] = []
    for i in range(table.width):
        joint = joint_of.get(i)
        name = header[i] if header else f"column_{i + 1}" if joint is None else names[joint]
        columns.append((name, list(table.texts(i + 1)) if joint is None else cells[joint]))
    if not commanded.columns:
        columns += zip(names, cells, strict=True)
    return csv_text([[name for name, _ in columns], *zip(*(column for _, column in columns), strict=True)])


def _poses(
    table: TextTable,
    angle: float,
    position: tuple[list[int], str | None] | None,
    orientation: tuple[list[int], str | None],
    length: str | None,
) -> Float[np.ndarray, "N 4 4"]:
    """Positions, mm, and orientations, where there are some; ``angle`` and ``length``: units of a rotation vector and
    of positions that the header does not state."""
    from scipy.spatial.transform import Rotation

    if position is None:
        raise InputError(f"{table.path} has orientations, but no positions in columns x, y and z; add them.")
    unit, (columns, rotation_unit) = position[1] or length or "mm", orientation
    if unit not in LENGTH_UNITS or length not in (None, unit) or rotation_unit not in (None, *_ANGLES):
        raise InputError(
            f"{table.path} states positions in {unit}; give one of {', '.join(LENGTH_UNITS)}, angles in deg or rad, "
            "and leave out --length-unit."
        )
    poses = np.tile(np.eye(4), (table.length, 1, 1))
    poses[:, :3, 3] = LENGTH_UNITS[unit] * table.numbers(position[0])
    if len(columns) == len(_QUATERNION):
        quaternions = table.numbers(columns)
        wrong = np.flatnonzero(np.abs(np.linalg.norm(quaternions, axis=1) - 1) > _ROUNDED)
        if len(wrong):
            raise InputError(
                f"{table.path} row {wrong[0] + 1}: the quaternion is not of length 1; correct it, or its columns."
            )
        poses[:, :3, :3] = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    elif columns:
        vectors = (angle if rotation_unit is None else _ANGLES[rotation_unit]) * table.numbers(columns)
        poses[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
    return poses

"""Which columns of a text table hold the readings of the joints, or positions; and tables of poses."""

import os
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.errors import InputError
from ..core.text import csv_text, is_number, pluralise, quoted
from ..core.units import ANGLE_UNITS, DEG, LENGTH_UNITS
from ..kinematics.arm import Arm, by_joint
from .text_lines import SI, Column, are_numbered, bare_name, stem_and_number
from .text_table import TextTable

# Words beside the number in the names of readings: q_1, joint 1, A1, axis_1, actual_q_0, /panda_joint1/position, ...
_OF_JOINTS = re.compile("q|j|a|ax|axis|axes|achse|joints?|jnt|jpos|gelenk|theta|th|\u03b8|enc|encoder|angle|winkel|rax")
# Words in the names of other quantities that joints have.
_OF_OTHERS = re.compile(
    "qd+|d+q|dtheta|vel|velocity|velocities|speed|acc|acceleration|tau|torques?|effort|moments?|force|currents?|"
    "voltage|power|temp|temperatures?|error|err|mode|limit|min|max|std|sigma|u|control|output|contact|collision|brake|"
    "tcp|pose|probe|direction"
)
# First words in the names of columns that hold no reading.
_NO_JOINT = re.compile("[xyzt]|time|timestamp|date|stamp|index|row|point|socket|group|name|nr|no")
# Universal Robots' joints in ROS, whose messages have them in alphabetical order.
OF_UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
_POSITIONS = (("x", "y", "z"), ("px", "py", "pz"))
BESIDE = {  # the columns of what was recorded beside the joints' readings, with {} one a joint
    "torques": "torque_{}_Nm",
    "directions": "direction_{}",
    "load": "load_kg",
    "thermometer": "temperature_C",
}
TEMPERATURE = BESIDE["thermometer"]
LINE = "columns = [{}]"  # what a manifest states; of commands it is an option


def _words(stem: str) -> list[str]:
    """The words of a name: JointPosition is two."""
    return re.findall(r"[^\W\d_]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", stem).casefold())


class _Family(NamedTuple):
    """Columns whose names differ in the last number only."""

    columns: list[int]  # from 0
    of_joints: bool  # whether its words are those of joint readings
    whole: bool  # whether its numbers count the joints, from 0 or 1


def _families(table: TextTable, joints: int) -> list[_Family]:
    members: dict[str, list[tuple[int, str, int]]] = {}
    for column, name in enumerate(table.header):
        if (numbered := stem_and_number(name)) is not None:
            members.setdefault(numbered[0].casefold(), []).append((column, *numbered))
    families = []
    for family in members.values():
        columns, (stem, *_), numbers = zip(*family, strict=True)
        words = _words(stem)
        of_joints = any(map(_OF_JOINTS.fullmatch, words)) and not any(map(_OF_OTHERS.fullmatch, words))
        whole = sorted(numbers) == list(range(min(numbers), joints + min(numbers))) and min(numbers) < 2
        families.append(_Family(list(columns), of_joints, whole))
    return families


def _check_not_taken(table: TextTable, columns: Sequence[int], taken: Sequence[int]) -> None:
    both = next((i for i in columns if i in taken), None)
    if both is not None:
        name = f" {quoted(table.header[both])}" if table.header else ""
        raise InputError(
            f"{table.path} column {both + 1}{name} is one of the joint readings, but is also picked as group, session "
            "or measured value; pick another column."
        )


def reading_columns(
    table: TextTable,
    joints: int,
    taken: Sequence[int] = (),
    stated: Sequence[Column] | None = None,
    *,
    line: str = LINE,
    required: bool = True,
    names: Sequence[str] = (),
) -> list[int]:
    """The columns of the joint readings, from 0: those ``stated``, else those with the ``names`` that the arm's file
    gives its joints, or that LeRobot gives its motors (``shoulder_pan.pos``, without the gripper), or with usual names
    of joints, or all that are not ``taken`` where these are as many as the joints, and nothing in the header
    contradicts it.

    ``line`` is what states columns, for messages. Raises `InputError` with the line to add where several sets of
    columns have such names, their numbers do not ascend, or they are ``required`` and not clear.
    """
    if stated is not None:
        picked = table.pick(stated)
        _check_not_taken(table, picked, taken)
        if len(picked) != joints:
            raise InputError(
                f"{table.path}: {len(picked)} columns are picked for the readings, but the arm has {joints} joints; "
                "pick one column per joint."
            )
        return picked

    def stated_by(columns: Sequence[int]) -> str:
        return line.format(", ".join(str(i + 1) for i in columns))

    titles = [bare_name(title).removesuffix(".pos") for title in table.header]  # as LeRobot names its motors' positions
    if len(names) == joints and all(titles.count(name) == 1 for name in names):
        picked = [titles.index(name) for name in names]
        _check_not_taken(table, picked, taken)
        return picked
    motors = [i for i, title in enumerate(table.header) if bare_name(title).endswith(".pos")]
    motors = [i for i in motors if titles[i] != "gripper"]
    if len(motors) == joints and not set(motors) & set(taken):  # LeRobot's, in the order of the joints
        return motors
    families = _families(table, joints)
    named = [family for family in families if family.of_joints and not set(family.columns) <= set(taken)]
    whole = [family.columns for family in named if family.whole]
    if len(whole) > 1:
        choices = [f"{stated_by(columns)} ({quoted(table.header[columns[0]])}, ...)" for columns in whole]
        raise InputError(f"{table.path} has several columns per joint; add {' or '.join(choices[:4])}.")
    # Where none is whole, one of as many columns is there twice.
    for columns in whole or [family.columns for family in named if len(family.columns) == joints]:
        table.check_ascending(columns, line)
        _check_not_taken(table, columns, taken)
    if whole or not required:
        return whole[0] if whole else []
    beside = [i for name in (BESIDE["load"], TEMPERATURE) if table.has([name]) for i in table.pick([name])]
    free = [i for i in range(table.width) if i not in taken and i not in beside]
    names = [bare_name(table.header[i]) for i in free if table.header]
    foreign = any(_NO_JOINT.fullmatch(word) for name in names for word in _words(name)[:1])
    if len(free) == joints and not foreign and not named and not (table.misnamed and are_numbered(table.title)):
        table.check_ascending(free, line)
        if _Family(free, False, True) in families or joints == 1 or not any(names):
            return free
    guess = [family.columns for family in families if family.whole]
    guess = [columns for columns in guess if all(_is_numeric(table, i) for i in columns)]
    of_ur = [[i for i, name in enumerate(table.header) if joint in name.casefold()] for joint in OF_UR]
    if joints == len(OF_UR) and all(len(columns) == 1 for columns in of_ur):
        guess = [[columns[0] for columns in of_ur]]
    proposed = guess[0] if guess else proposed_columns(table, joints, taken)
    add = f"add {stated_by(proposed)} if these columns are the readings of the joints in order"
    if not proposed:
        add = (
            f"pick one column per joint with {line.format('...')}, or correct the header (for example, name the "
            f"columns q_1 to q_{joints}), or correct the delimiter if it was confused with a decimal comma"
        )
    raise InputError(
        f"{table.path} has {table.shown()}, but it is not clear which columns hold the readings of the arm's {joints} "
        f"joints; {add}."
    )


def proposed_columns(table: TextTable, count: int, taken: Sequence[int] = ()) -> list[int]:
    """So many columns of numbers, from 0, without times or indices before them; none where others may be meant."""
    numeric = [i for i in range(table.width) if i not in taken and _is_numeric(table, i)]
    while len(numeric) > count:
        cells = table.cells(numeric[0])
        # Each number is larger than the one before it in a column of times or indices.
        if len(cells) < 2 or not all(map(is_number, cells)) or np.any(np.diff(np.array(cells, dtype=float)) <= 0):
            break
        numeric.pop(0)
    return numeric if len(numeric) == count and not table.misnamed else []


def _is_numeric(table: TextTable, index: int) -> bool:
    """Whether a column begins and ends with a number."""
    cells = table.cells(index)
    return is_number(cells[0]) and is_number(cells[-1])


def find_named(
    table: TextTable, names: Sequence[str], units: Sequence[str] = ()
) -> tuple[list[int], str | None] | None:
    """Columns of these names, from 0, alone or with a unit after them, and the unit that the header states."""
    for unit in ("", *units) if table.header else ():
        wanted = [f"{name}_{unit}" if unit else name for name in names]
        if table.has(wanted):
            picked = table.pick(wanted)
            return picked, unit or table.unit(picked)
    return None


def position_columns(table: TextTable) -> tuple[list[int], str | None] | None:
    """The columns of a position, and the unit that the header states."""
    choices = (find_named(table, names, tuple(LENGTH_UNITS)) for names in _POSITIONS)
    return next(filter(None, choices), None)


def _stated_positions(table: TextTable, columns: Sequence[Column]) -> tuple[list[int], str | None]:
    picked = table.pick(columns)
    if len(picked) != 3:
        raise InputError(f"{table.path}: {len(picked)} columns are picked for the positions; pick three, x, y and z.")
    return picked, table.unit(picked, key="points")


def header_units(text: TextTable, picked: Sequence[int], arm: Arm, stated: str | None) -> tuple[str | None, str | None]:
    """The units that the header states for readings of revolute and of prismatic joints, or None; ``stated``: that of
    the former in the manifest. Raises `InputError` where it states units of something else."""
    slides = [picked[i - 1] for i in arm.prismatic]
    turns = [i for i in picked if i not in slides]
    kinds = (("revolute", turns, ANGLE_UNITS, stated), ("prismatic", slides, LENGTH_UNITS, None))
    units = []
    for joints, columns, possible, stated_unit in kinds:
        unit = text.unit(columns, stated_unit)
        unit = {"revolute": "rad", "prismatic": "m"}[joints] if unit == SI else unit
        if unit not in (None, "counts", *possible):
            raise InputError(
                f"{text.path} has readings of {joints} joints in {quoted(unit)} (column "
                f"{quoted(text.header[columns[0]])}), but readings must be in {', '.join(possible)} or counts; pick "
                "the columns of the readings with columns = [...], or correct the header."
            )
        units.append(unit)
    return units[0], units[1]


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
    position: tuple[int, ...]  # columns of the positions, counted from 0
    temperature: Float[np.ndarray, " N"] | None  # C


def read_poses(
    path: str | os.PathLike,
    arm: Arm,
    *,
    unit: str | None = None,
    near: Sequence[float] | None = None,
    columns: Sequence[Column] | None = None,
    positions: Sequence[Column] | None = None,
    length_unit: str | None = None,
    recorded: bool = False,
) -> PoseTable:
    """Read a table with a row for each pose. Raises `InputError`.

    Of commanded poses: either joint readings, in columns named q_1, q_2, ... (or q1, joint_1, j1, a1; with a unit, as
    q_1_deg, if the header states it), or in all columns of a table without such names, or in ``columns``. Or positions
    x, y, z (mm, or the header's unit; or px, py, pz, or in the columns ``positions``), with or without an orientation:
    qw, qx, qy, qz (quaternion) or rx, ry, rz (rotation vector, in ``unit`` unless the header says it), and the readings
    to begin with in columns as above, or ``near``. The caller chooses the orientation of positions alone. A column
    temperature_C is the arm's.

    Of poses that were ``recorded``: joint readings, and the position of the tip, perhaps with its orientation; without
    positions all poses are of one socket, or of those that a column ``socket`` names. A table without header has a
    column for each joint, and after them perhaps x, y and z.

    ``unit``, deg or rad, is that of revolute joints where the header does not say it, and of ``near``; recorded ones up
    to a revolution are in rad otherwise. ``length_unit``: of positions whose header states none, by default mm.
    """
    table, joints = TextTable(path), arm.joints
    position = position_columns(table) if positions is None else _stated_positions(table, positions)
    orientation = find_named(table, _QUATERNION) or find_named(table, _ROTATION, tuple(_ANGLES))
    if recorded and not table.header and table.width in (joints, joints + 3):
        picked, after = list(range(joints)), list(range(joints, table.width))
        position = (after, None) if after else None
    else:
        taken = position[0] if position else ()
        required = recorded or (orientation is None and position is None)
        picked = reading_columns(table, joints, taken, columns, line="--columns {}", required=required)
    header, linear = header_units(table, picked, arm, unit) if picked else (None, None)
    if linear not in (None, "mm"):
        raise InputError(f"{path} has readings of prismatic joints in {linear}; convert these readings to mm.")
    if header is not None and (header not in _ANGLES or unit not in (None, header)):
        raise InputError(
            f"the header of {path} states {header} for the joint readings; give the readings in deg or rad, and omit "
            "--unit."
        )
    if picked and near is not None:
        found = quoted(table.header[picked[0]]) if table.header else f"number {picked[0] + 1}"
        raise InputError(
            f"{path} has joint readings in {pluralise(joints, 'column')} (the first is {found}), and --near gives "
            "readings too; leave out --near, or the columns."
        )
    if not picked and near is None:
        raise InputError(
            f"{path} has positions, but no joint readings that the search starts from; add columns q_1 to q_{joints}, "
            "name the columns of the readings with --columns, or give --near."
        )
    if near is not None and len(near) != joints:
        raise InputError(
            f"--near has {len(near)} readings, but the arm has {joints} joints; give one reading per joint."
        )
    readings = table.numbers(picked) if near is None else np.tile(near, (table.length, 1))
    unit = header or unit
    if unit is None and recorded:
        unit = "deg" if np.abs(readings[:, by_joint(arm, True, False)]).max(initial=0) > 2 * np.pi else "rad"
    if unit is None:
        raise InputError(f"{path} does not state the unit of the joint readings; give --unit deg or --unit rad.")
    poses = None
    if orientation is not None or position is not None:
        poses = _poses(table, _ANGLES[unit], position, orientation or ([], None), length_unit)
    return PoseTable(
        np.array(by_joint(arm, _ANGLES[unit], 1.0)) * readings,
        poses,
        orientation is not None,
        unit,
        "mm" if position is None else position[1] or length_unit or "mm",
        tuple(table.texts("socket")) if table.header and table.has(["socket"]) else ("A",) * table.length,
        arm,
        table,
        tuple(picked),
        () if position is None else tuple(position[0]),
        table.numbers(table.pick([TEMPERATURE]))[:, 0] if table.has([TEMPERATURE]) else None,
    )


def corrected_csv(commanded: PoseTable, q: Float[np.ndarray, "N n"], reached: Bool[np.ndarray, " N"]) -> str:
    """The table with corrected readings in place of those commanded, or after the other columns, in the same unit.

    The readings (rad and mm) of rows that are not ``reached`` are left empty, so that no arm is sent there.
    """
    units = np.array(by_joint(commanded.arm, _ANGLES[commanded.unit], 1.0))
    names = [f"q_{i}_{unit}" for i, unit in enumerate(by_joint(commanded.arm, commanded.unit, "mm"), start=1)]
    return _with_columns(commanded.table, commanded.columns, names, q / units, reached)


def corrected_poses_csv(
    commanded: PoseTable, poses: Float[np.ndarray, "N 4 4"], reached: Bool[np.ndarray, " N"]
) -> str:
    """The table with corrected poses (mm, in the frame of the file) in place of those commanded, or after the other
    columns: positions, and orientations unless the table has positions alone; as `corrected_csv`."""
    from scipy.spatial.transform import Rotation

    table, unit = commanded.table, commanded.unit
    quaternion, vector = find_named(table, _QUATERNION), None
    columns, names = list(commanded.position), [] if commanded.position else ["x_mm", "y_mm", "z_mm"]
    values = poses[:, :3, 3] / LENGTH_UNITS[commanded.length_unit]
    turns = Rotation.from_matrix(poses[:, :3, :3])
    if quaternion is not None:
        columns, values = [*columns, *quaternion[0]], np.hstack([values, turns.as_quat(scalar_first=True)])
    elif commanded.oriented or commanded.poses is None:
        vector = find_named(table, _ROTATION, tuple(_ANGLES))
        stated = unit if vector is None or vector[1] is None else vector[1]
        columns, names = [*columns, *(vector[0] if vector else [])], names + [f"{name}_{unit}" for name in _ROTATION]
        values = np.hstack([values, turns.as_rotvec() / _ANGLES[stated]])
    return _with_columns(table, columns, names, values, reached)


def _with_columns(
    table: TextTable,
    picked: Sequence[int],
    names: Sequence[str],
    values: Float[np.ndarray, "N k"],
    reached: Bool[np.ndarray, " N"],
) -> str:
    """The table with values in the ``picked`` columns, and those that are more than these after the others.

    ``names`` are of columns that the table does not name; those of rows that are not ``reached`` are empty.
    """
    cells = [[repr(float(x)) if good else "" for x, good in zip(row, reached, strict=True)] for row in values.T]
    header, place_of = table.header, {column: i for i, column in enumerate(picked)}
    columns: list[tuple[str, Sequence[str]]] = []
    for i in range(table.width):
        place = place_of.get(i)
        name = header[i] if header else f"column_{i + 1}" if place is None else names[place]
        columns.append((name, list(table.texts(i + 1)) if place is None else cells[place]))
    columns += zip(names[len(names) - (len(cells) - len(picked)) :], cells[len(picked) :], strict=True)
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
        raise InputError(f"{table.path} has orientations, but no columns x, y and z with positions; add these columns.")
    unit, (columns, rotation_unit) = position[1] or length or "mm", orientation
    if unit not in LENGTH_UNITS or length not in (None, unit) or rotation_unit not in (None, *_ANGLES):
        raise InputError(
            f"{table.path} states positions in {unit}; give positions in one of {', '.join(LENGTH_UNITS)} and angles "
            "in deg or rad, and omit --length-unit."
        )
    poses = np.tile(np.eye(4), (table.length, 1, 1))
    poses[:, :3, 3] = LENGTH_UNITS[unit] * table.numbers(position[0])
    if len(columns) == len(_QUATERNION):
        quaternions = table.numbers(columns)
        wrong = np.flatnonzero(np.abs(np.linalg.norm(quaternions, axis=1) - 1) > _ROUNDED)
        if len(wrong):
            raise InputError(
                f"{table.path} row {wrong[0] + 1}: the length of the quaternion is not 1; correct the quaternion, or "
                "pick the right columns."
            )
        poses[:, :3, :3] = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    elif columns:
        vectors = (angle if rotation_unit is None else _ANGLES[rotation_unit]) * table.numbers(columns)
        poses[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
    return poses

"""Which columns of a text table hold the readings of the joints, or positions, where nobody has stated them."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..core.errors import InputError
from ..core.text import is_number, quoted
from ..core.units import ANGLE_UNITS, LENGTH_UNITS
from ..kinematics.arm import Arm
from .text_lines import Column, are_numbered, bare_name, stem_and_number
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
_OF_UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
_POSITIONS = (("x", "y", "z"), ("px", "py", "pz"))
TEMPERATURE = "temperature_C"  # the column of the arm's temperature
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
            f"{table.path} column {both + 1}{name} is one of the joint readings, but is also picked for something else "
            "(group, session, or a measured value); pick another."
        )


def reading_columns(
    table: TextTable,
    joints: int,
    taken: Sequence[int] = (),
    stated: Sequence[Column] | None = None,
    *,
    line: str = LINE,
    required: bool = True,
) -> list[int]:
    """The columns of the joint readings, from 0: those ``stated``, else those with names of joints, or all that are not
    ``taken`` where these are as many as the joints, and nothing in the header contradicts it.

    ``line`` is what states columns, for messages. Raises `InputError` with the line to add where several sets of
    columns have such names, their numbers do not ascend, or they are ``required`` and not clear.
    """
    if stated is not None:
        picked = table.pick(stated)
        _check_not_taken(table, picked, taken)
        if len(picked) != joints:
            raise InputError(
                f"{table.path}: {len(picked)} columns are picked for the readings, but the arm has {joints} joints; "
                "pick one a joint."
            )
        return picked

    def stated_by(columns: Sequence[int]) -> str:
        return line.format(", ".join(str(i + 1) for i in columns))

    families = _families(table, joints)
    named = [family for family in families if family.of_joints and not set(family.columns) <= set(taken)]
    whole = [family.columns for family in named if family.whole]
    if len(whole) > 1:
        choices = [f"{stated_by(columns)} ({quoted(table.header[columns[0]])}, ...)" for columns in whole]
        raise InputError(f"{table.path} has several columns of each joint; add {' or '.join(choices[:4])}.")
    # Where none is whole, one of as many columns is there twice.
    for columns in whole or [family.columns for family in named if len(family.columns) == joints]:
        table.check_ascending(columns, line)
        _check_not_taken(table, columns, taken)
    if whole or not required:
        return whole[0] if whole else []
    temperature = table.pick([TEMPERATURE]) if table.has([TEMPERATURE]) else []
    free = [i for i in range(table.width) if i not in taken and i not in temperature]
    names = [bare_name(table.header[i]) for i in free if table.header]
    foreign = any(_NO_JOINT.fullmatch(word) for name in names for word in _words(name)[:1])
    if len(free) == joints and not foreign and not named and not (table.misnamed and are_numbered(table.title)):
        table.check_ascending(free, line)
        if _Family(free, False, True) in families or joints == 1 or not any(names):
            return free
    guess = [family.columns for family in families if family.whole]
    guess = [columns for columns in guess if all(_is_numeric(table, i) for i in columns)]
    of_ur = [[i for i, name in enumerate(table.header) if joint in name.casefold()] for joint in _OF_UR]
    if joints == len(_OF_UR) and all(len(columns) == 1 for columns in of_ur):
        guess = [[columns[0] for columns in of_ur]]
    proposed = guess[0] if guess else proposed_columns(table, joints, taken)
    add = f"add {stated_by(proposed)} if these are the joints in their order"
    if not proposed:
        add = (
            "correct the header, or the delimiter where decimal commas are taken for it, or pick one column a joint "
            f"with {line.format('...')}, or name them q_1 to q_{joints}"
        )
    raise InputError(
        f"{table.path} has {table.shown()}, and it is not clear which of them are those of the arm's {joints} joints; "
        f"{add}."
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


def header_units(text: TextTable, picked: Sequence[int], arm: Arm, stated: str | None) -> tuple[str | None, str | None]:
    """The units that the header states for readings of revolute and of prismatic joints, or None; ``stated``: that of
    the former in the manifest.
    """
    slides = [picked[i - 1] for i in arm.prismatic]
    turns = [i for i in picked if i not in slides]
    kinds = (("revolute", turns, ANGLE_UNITS, stated), ("prismatic", slides, LENGTH_UNITS, None))
    units = []
    for joints, columns, possible, stated_unit in kinds:
        unit = text.unit(columns, stated_unit)
        if unit not in (None, "counts", *possible):
            raise InputError(
                f"{text.path} states {quoted(unit)} for readings of {joints} joints "
                f"({quoted(text.header[columns[0]])}), but these are in {', '.join(possible)} or counts; pick their "
                "columns with columns = [...], or correct the header."
            )
        units.append(unit)
    return units[0], units[1]

"""Joint readings and points in the text tables of a manifest, in mm and rad: their columns, units and temperatures."""

import os
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError, nearest
from ..core.text import listed, quoted
from ..core.units import ANGLE_UNITS, LENGTH_UNITS
from ..data.capture import check_revolutions
from ..data.recording import RecordedAs
from ..kinematics.arm import Arm, by_joint
from ..kinematics.beside import BY_JOINT, COLUMNS
from ..kinematics.robots import ChainOf, chain_of
from .manifest_files import as_list
from .manifest_tables import Angles, PointsTable
from .table_columns import BESIDE, LINE, header_units, position_columns, proposed_columns, reading_columns
from .text_lines import Column
from .text_table import TextTable

_MOVED, _SLID = 2e-3, 0.1  # rad, mm: a smaller motion does not tell from which side a joint was moved


class Wanted(NamedTuple):
    """What the manifest states of the readings, or points, in a table."""

    columns: Sequence[Column] | None = None
    unit: str | None = None
    usual_unit: str | None = None  # of the preset, where neither the manifest nor the header states one
    taken: Sequence[int] = ()  # columns, from 0, that hold something else
    beside: Mapping[str, float | None] = {}  # one value for all rows, of what each row may have in a column
    chain: str | None = None  # of a robot: the one that the poses are of
    link: int | str | None = None  # of this chain; by default its tip


def checked_unit(
    where: object, what: str, header: str | None, stated: str | None, usual: str | None, units: Iterable[str]
) -> str | None:
    """The unit that the manifest states, or the header, or the preset. Raises `InputError` where the first two differ,
    or it is none of ``units``."""
    if header is not None and stated not in (None, header):
        raise InputError(
            f"{where}: the header of the {what} says {quoted(header)[1:-1]}, but the manifest says {stated}; correct "
            "one of the two."
        )
    unit = stated or header or usual
    if unit is not None and unit not in units:
        raise InputError(f"{where}: the {what} are in {quoted(unit)}; use one of {', '.join(units)}.")
    return unit


def recorded_as(angles: Angles, arm: Arm, names: Sequence[str]) -> RecordedAs:
    """How readings are written that ``[angles]`` turns into joint values; ``names`` of their columns."""
    constants = angles.converted(np.zeros((1, arm.joints)), arm)
    factors = (angles.converted(np.eye(arm.joints), arm) - constants).T
    return RecordedAs(tuple(names), angles.lerobot_unit or angles.unit, factors, constants[0])


class Readings:
    """Joint readings of tables, in rad and mm, with what was recorded beside them in the last columns (`beside`).

    Raises `InputError` where columns are missing or not clear, units are missing or differ, or one table has torques,
    directions, loads or temperatures and another not.
    """

    def __init__(
        self,
        arm: Arm,
        angles: Angles | None,
        names: Mapping[str, Sequence[str]] = MappingProxyType({}),
        links: Mapping[str, Mapping[str, int]] = MappingProxyType({}),
    ):
        self._arm, self._angles, self._names = arm, angles, names  # of the joints in a robot's file, by tip
        self._links = links  # likewise, with the number of the joint before each
        self._first: str | os.PathLike | None = None  # the file of the first table
        self.beside: tuple[str, ...] = ()  # what the tables have beside the readings
        self.columns: list[int] = []  # of the joints in the first table, from 1
        self.header: list[str] = []  # of the first table
        self.angles: Angles | None = None  # with which the first table was read, its header and units considered

    def __call__(self, text: TextTable, wanted: Wanted) -> Float[np.ndarray, "N n"]:
        """The readings of one table."""
        stated, arm, chain = wanted.columns, self._arm, self._chain(wanted.chain)
        if chain is not None:
            arm = chain.arm
        if stated is None and self._angles is not None and self._angles.columns is not None:
            stated = as_list(self._angles.columns)
        beside = {
            name: columns
            for name in COLUMNS
            if not (name == "directions" and self._in_order) and (columns := self._columns_of(text, name, arm))
        }
        of_joints = [i for name in BY_JOINT for i in beside.get(name, [])]
        names = self._names.get(wanted.chain or next(iter(self._names), ""), [])
        picked = reading_columns(text, arm.joints, [*wanted.taken, *of_joints], stated, names=names)
        for name, columns in beside.items():
            if set(columns) & set(picked):
                raise InputError(
                    f"{text.path} column {columns[0] + 1} is {BESIDE[name]}, not a joint reading; remove this column "
                    "from the key columns."
                )
        numbers = text.numbers(picked, measured=True, stated=stated is not None)
        angles = self._angles_of(text, picked, wanted, arm)
        q = angles.converted(numbers, arm)
        check_revolutions(str(text.path), q, arm, 'correct the header, or write unit = "deg" in [angles]')
        recorded = {name: text.numbers(columns) for name, columns in beside.items()}
        if self._in_order:
            recorded["directions"] = directions_of_order(q, np.array(by_joint(arm, _MOVED, _SLID)))
        for name, value in wanted.beside.items():
            column = stated_or_recorded(value, recorded.get(name), BESIDE[name], str(text.path), len(q))
            recorded |= {} if column is None else {name: column}
        recorded = {name: recorded[name] for name in COLUMNS if name in recorded}
        if self._first is None:
            self._first, self.beside, self.columns = text.path, tuple(recorded), [i + 1 for i in picked]
            self.header, self.angles = list(text.header), angles
        for name in (name for name in COLUMNS if (name in self.beside) != (name in recorded)):
            without, other = (text.path, self._first) if name in self.beside else (self._first, text.path)
            what, add = name, f"add columns {BESIDE[name].format(1)}, ... to {without}."
            if name not in BY_JOINT:
                what = "temperatures" if name == "thermometer" else name
                add = f"add a column {BESIDE[name]} to {without}, or state {BESIDE[name]} in its table."
            raise InputError(f"{without} has no {what}, but {other} has {what}; {add}")
        if chain is not None:
            q = chain.readings(q, self._link(wanted))
            recorded |= {name: chain.spread(recorded[name]) for name in BY_JOINT if name in recorded}
        return np.hstack([q, *recorded.values()])

    @property
    def recorded_as(self) -> RecordedAs | None:
        """How the readings of the first table are written; None of a robot of several chains."""
        angles = self.angles
        if angles is None or self._arm.chains:
            return None
        names = [self.header[i - 1] if i <= len(self.header) else f"column {i}" for i in self.columns]
        return recorded_as(angles, self._arm, names)

    def _chain(self, stated: str | None) -> ChainOf | None:
        """The chain of a robot that the manifest states for a table; None for an arm."""
        if not self._arm.chains and stated is None:
            return None
        names = [name for name, _ in self._arm.chains]
        if stated is None:
            raise InputError(f"the arm has the chains {listed(names)}; state the chain of the table (chain = ...).")
        return chain_of(self._arm, stated)

    def _link(self, wanted: Wanted) -> int | None:
        """The number of the link that the manifest names."""
        if not isinstance(wanted.link, str):
            return wanted.link
        numbers = {link: number for link, number in self._links.get(wanted.chain or "", {}).items() if number}
        if wanted.link not in numbers:
            raise InputError(
                f"chain '{wanted.chain}' has no moving link '{wanted.link}'{nearest(wanted.link, numbers)}"
            )
        return numbers[wanted.link]

    @property
    def _in_order(self) -> bool:
        return self._angles is not None and self._angles.directions == "order"

    def _columns_of(self, text: TextTable, name: str, arm: Arm) -> list[int]:
        """The columns of what was recorded beside the readings: those that the manifest names, or that have the usual
        names."""
        count, stated = arm.joints if name in BY_JOINT else 1, getattr(self._angles, name, None)
        names = [BESIDE[name].format(i + 1) for i in range(count)] if stated is None else as_list(stated)
        if (count == 1 and name == "torques") or (stated is None and not text.has(names)):
            return []
        picked = text.pick(names)
        if len(picked) != count:
            raise InputError(
                f"{text.path} has {len(picked)} columns of {name}, but the arm has {count} joints; pick one per joint "
                f"with {name} in [angles]."
            )
        return picked

    def _angles_of(self, text: TextTable, picked: Sequence[int], wanted: Wanted, arm: Arm) -> Angles:
        """How these readings are written: what the table states comes first, then [angles], the header, the preset.

        What the manifest states must not contradict the header.
        """
        angles = self._angles
        unit = wanted.unit or (None if angles is None else angles.unit)
        angular, linear = header_units(text, picked, arm, unit)
        if angles is not None and angles.lerobot_unit is not None:
            if wanted.unit is not None:
                raise InputError(
                    f"{text.path}: the manifest states a unit for this table, but LeRobot's numbers are in that of "
                    f"[angles], which has calibration ({angles.lerobot_unit}); remove the unit of the table."
                )
            checked_unit(text.path, "readings", angular, angles.lerobot_unit, None, (angles.lerobot_unit,))
            angular = None
        if angular == "counts" and unit is None:
            raise InputError(
                f'{text.path} has readings in counts; add [angles] with unit = "counts" and counts_per_turn = [...].'
            )
        possible = (*ANGLE_UNITS, "counts") if angles is not None and angles.unit == "counts" else ANGLE_UNITS
        unit = checked_unit(text.path, "readings", angular, unit, wanted.usual_unit, possible)
        if unit is None:
            raise InputError(
                "'angles' is missing, so the unit of the readings is not known; add [angles] with unit = "
                '"deg" or "rad", or state the unit in the header of the table, for example J1 [deg].'
            )
        stated = {} if angles is None else angles.model_dump(exclude_unset=True)
        if angles is None or unit != angles.unit:
            stated.pop("counts_per_turn", None)
        if linear is not None:
            units = (*LENGTH_UNITS, "counts")
            checked_unit(text.path, "prismatic joints", linear, stated.setdefault("linear_unit", linear), None, units)
        if linear == "counts" and "counts_per_mm" not in stated:
            raise InputError(
                f'{text.path} has readings in counts; add linear_unit = "counts" and counts_per_mm = [...].'
            )
        return Angles(**{**stated, "unit": unit}).of_lerobot(angles and angles.written)


def directions_of_order(q: Float[np.ndarray, "N n"], least: Float[np.ndarray, " n"]) -> Float[np.ndarray, "N n"]:
    """From which side each joint was moved to its reading, of poses in the order of recording: the sign of its last
    motion that is larger than ``least``, since a smaller one is noise or within the play; 0 before the first."""
    directions, turned_at = np.zeros_like(q), q[:1].copy()
    for i in range(1, len(q)):
        moved = np.abs(q[i] - turned_at[0]) > least
        directions[i] = np.where(moved, np.sign(q[i] - turned_at[0]), directions[i - 1])
        turned_at[0] = np.where(moved, q[i], turned_at[0])
    return directions


def stated_or_recorded(
    stated: float | None, column: Float[np.ndarray, "N 1"] | None, name: str, where: str, rows: int
) -> Float[np.ndarray, "N 1"] | None:
    """A column of a table, or what is stated once for all its rows, but not both; None without either."""
    if column is not None and stated is not None:
        raise InputError(f"{where} has a column {name}, but the manifest also states {name}; give only one of the two.")
    return column if stated is None else np.full((rows, 1), float(stated))


def points_of(text: TextTable, wanted: Wanted, points: PointsTable) -> Float[np.ndarray, "N 3"]:
    """The points of a table, mm."""
    columns = wanted.columns
    if columns is None and points.columns is not None:
        columns = as_list(points.columns)
    named = position_columns(text) if columns is None else None
    if columns is not None:
        picked = text.pick(columns)
    elif named is not None:
        picked = named[0]
    else:
        picked = [i for i in range(text.width) if i not in wanted.taken]
        text.check_ascending(picked)
    if len(picked) != 3:
        line = LINE.format(", ".join(str(i + 1) for i in proposed_columns(text, 3, wanted.taken)) or "...")
        raise InputError(
            f"{text.path} has {text.shown()}, but it is not clear which columns are x, y and z; add {line} with these "
            "three columns."
        )
    header = text.unit(picked, key="points") if named is None else named[1]
    unit = checked_unit(text.path, "points", header, wanted.unit or points.unit, wanted.usual_unit, LENGTH_UNITS)
    if unit is None:
        raise InputError(f'{text.path} does not state the unit of its points; add unit = "mm" to [points].')
    return text.numbers(picked, measured=True, stated=columns is not None) * LENGTH_UNITS[unit]

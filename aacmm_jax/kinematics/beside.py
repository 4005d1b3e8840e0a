"""What may be recorded beside the joints' readings, and which columns of an array of readings it is.

A new quantity is one name in `COLUMNS` and one field of `Readings`; what reads it is a kind of correction.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray
from ..core.text import listed

COLUMNS = {  # in the order of the columns, which follow those of the joints: what each is called in sentences
    "torques": "their torques",
    "directions": "their directions of approach",
    "load": "a load",
    "thermometer": "a thermometer",
}
ALL = tuple(COLUMNS)
CHAIN = "chain"  # of a robot, and never missing: the number of a pose's chain
_RANGES = {"torques": (-100.0, 100.0), "directions": (-1.0, 1.0), "load": (0.0, 5.0), "thermometer": (10.0, 30.0)}
_NEUTRAL = {"thermometer": 20.0}  # where it changes nothing; 0 of the others
BY_JOINT = ("torques", "directions")  # one column a joint; of others there is one in all


class Readings(NamedTuple):
    """Rows of readings by what they are; None where it was not recorded."""

    joints: Float[AnyArray, "n ... 1 N"]  # rad, mm of prismatic joints
    torques: Float[AnyArray, "n ... 1 N"] | None = None  # of the joints' drives, N m; N of prismatic joints
    directions: Float[AnyArray, "n ... 1 N"] | None = None  # 1: reached with rising readings, -1: falling, 0: unknown
    load: Float[AnyArray, "1 ... 1 N"] | None = None  # kg
    thermometer: Float[AnyArray, "1 ... 1 N"] | None = None  # C
    load_centre: tuple[float, ...] | None = None  # that of `Beside`


@jax.tree_util.register_static
@dataclass(frozen=True)
class Beside:
    """Which columns the readings of an arm have after those of its joints: static in every program.

    Readings may lack some of them, so that their number of columns tells which they have. Where several choices have
    the same number, ``recorded`` comes first, then all.
    """

    joints: int
    recorded: tuple[str, ...] = ()  # what the arm is stated to have, in the order of `COLUMNS`
    possible: tuple[str, ...] = ()  # with what its corrections read
    chains: int = 0  # of a robot: the first column after the joints is the number of a pose's chain, and never missing
    load_centre: tuple[float, ...] | None = None  # of mass, mm in the last frame, of each chain; None: the tip

    def width(self, names: Iterable[str]) -> int:
        """Number of columns of readings that have these beside those of the joints."""
        return self.own + sum(self.joints if name in BY_JOINT else 1 for name in names)

    @property
    def own(self) -> int:
        """Number of columns that are never missing: the joints and the number of the chain."""
        return self.joints + bool(self.chains)

    @property
    def widths(self) -> tuple[int, ...]:
        """All numbers of columns that readings may have."""
        return tuple(sorted({self.width(names) for names in _choices(self.possible)}))

    def names(self, columns: int) -> tuple[str, ...]:
        """What readings with so many columns have beside those of the joints; `InputError` where it is not clear."""
        fitting = _fitting(self, columns)
        if len(fitting) == 1:
            return fitting[0]
        have = f"readings have {columns} columns, but the arm has {self.joints} joints"
        if not fitting:
            raise InputError(f"{have}; give one column per joint{extras(self.possible)}.")
        which = " or ".join(listed([COLUMNS[name] for name in names]) for names in fitting)
        arguments = " or ".join(listed([f"{name}=True" for name in names]) for names in fitting)
        raise InputError(f"{have}, so the other columns may be {which}; use an arm with {arguments}.")

    def slices(self, columns: int) -> dict[str, slice]:
        """The columns of everything in `COLUMNS`; empty slices where readings with so many columns lack it."""
        names, slices, end = self.names(columns), {}, self.own
        for name in COLUMNS:
            start, end = end, end + (0 if name not in names else self.joints if name in BY_JOINT else 1)
            slices[name] = slice(start, end)
        return slices

    def split(self, rows: Float[AnyArray, "columns ..."]) -> Readings:
        """Readings with the columns first, by what they are."""
        found = {name: rows[part] for name, part in self.slices(rows.shape[0]).items() if part.start < part.stop}
        return Readings(rows[: self.joints], **found, load_centre=self.load_centre)

    def is_clear(self, names: tuple[str, ...]) -> bool:
        """Whether readings that have these are taken to have them."""
        return _fitting(self, self.width(names)) == (names,)

    def laid_out(self, readings: Float[np.ndarray, "N columns"], names: Sequence[str]) -> Float[np.ndarray, "N others"]:
        """Readings that have these columns beside those of the joints, as an arm takes them: without what it does not
        have, and with what changes nothing (0, 20 C) where its columns would not be clear otherwise."""
        slices = Beside(self.joints, tuple(names), tuple(names), self.chains).slices(readings.shape[1])
        kept = tuple(name for name in self.possible if name in names)
        without = tuple(name for name in self.possible if name != "torques" or name in names)
        chosen = next(filter(self.is_clear, (kept, without, self.possible)))
        columns = [readings[:, : self.own]]
        for name in chosen:
            neutral = np.full((len(readings), self.width([name]) - self.own), _NEUTRAL.get(name, 0.0))
            columns.append(readings[:, slices[name]] if name in names else neutral)
        return np.hstack(columns)

    def drawn(self, count: int, random: np.random.Generator) -> Float[np.ndarray, "count k"]:
        """Random values of all columns after those of the joints, for questions that no recording answers; chains take
        turns."""
        widths = {name: self.width([name]) - self.own for name in self.possible}
        chain = np.arange(float(count))[:, None] % max(self.chains, 1)
        drawn = [random.uniform(*_RANGES[name], (count, width)) for name, width in widths.items()]
        return np.hstack([chain[:, : self.own - self.joints], *drawn])


def _choices(names: tuple[str, ...]) -> list[tuple[str, ...]]:
    """All selections of some names, the largest first."""
    return [some for count in range(len(names), -1, -1) for some in itertools.combinations(names, count)]


@lru_cache(1024)
def _fitting(beside: Beside, columns: int) -> tuple[tuple[str, ...], ...]:
    """What readings with so many columns may have beside those of the joints: one choice, where it is clear."""
    first = [names for names in (beside.recorded, beside.possible) if beside.width(names) == columns]
    return tuple(first[:1] or (names for names in _choices(beside.possible) if beside.width(names) == columns))


def extras(names: Iterable[str]) -> str:
    """What follows the joints, in words: ", their torques, and a thermometer"."""
    return "".join(f", {'' if name in BY_JOINT else 'and '}{COLUMNS[name]}" for name in names)

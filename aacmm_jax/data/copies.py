"""Copies of data: a copy is no measurement of its own, so it counts once and is reported."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

from ..core.arrays import is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray
from ..core.text import pluralise, shorten
from .observations.observation import AbstractObservation
from .observations.socket import Socket


class Repeated(NamedTuple):
    """Copies of data that a capture leaves out, because a copy is no measurement of its own."""

    poses: tuple[tuple[str, int], ...] = ()  # sockets and other observations, and the number of copies in each
    lengths: tuple[tuple[str, str], ...] = ()  # both ends of each copy

    def sentences(self) -> list[str]:
        """What was left out, for warnings."""
        found = []
        if self.poses:
            number = pluralise(sum(count for _, count in self.poses), "pose")
            sockets = shorten([f"{name} ({count})" for name, count in self.poses])
            found.append(
                f"Counted once: {number} with exactly the readings and values of another pose of the same socket or "
                f"observation: {sockets}; a copy is no measurement of its own. Was the arm recorded at rest, or a file "
                "pasted twice?"
            )
        if self.lengths:
            ends = shorten([f"{start} - {end}" for start, end in self.lengths])
            found.append(
                f"Counted once: reference lengths given again with the same value and u: {ends}; delete the copies."
            )
        return found


NOTHING_REPEATED = Repeated()


def without_copies(block: AnyArray) -> AnyArray:
    """The first of each pose of a socket, in their order. Only known values are compared."""
    if not is_concrete(block):
        return block
    first = first_of_each(block)
    return block if len(first) == block.shape[0] else np.asarray(block)[first]


def observation_without_copies(observation: AbstractObservation) -> AbstractObservation:
    """The same observation with the first of each pose; the same reading may have been measured several times."""
    values = [getattr(observation, field) for field in observation.by_pose]
    if not is_concrete(*values):
        return observation
    first = first_of_each(*values)
    return observation if len(first) == observation.q.shape[0] else observation.select(first)


def first_of_each(*values: Any) -> list[int]:
    """Numbers of the rows of arrays, or of tuples, that differ from all rows before them."""
    first: dict[tuple[bytes, ...], int] = {}
    arrays = [np.asarray(value) for value in values]
    arrays = [array + 0.0 if array.dtype.kind == "f" else array for array in arrays]  # which has no negative zero
    for i, rows in enumerate(zip(*arrays, strict=True)):
        first.setdefault(tuple(row.tobytes() for row in rows), i)
    return list(first.values())


def check_different(blocks: Mapping[str, Array | np.ndarray], observations: Iterable[AbstractObservation]) -> None:
    """Refuse two sockets, or two observations of one kind, with exactly the same poses: one file given twice."""
    values = [(name, Socket.kind, [block]) for name, block in blocks.items()]
    values += [(one.name, one.kind, [getattr(one, field) for field in one.by_pose]) for one in observations]
    seen: dict[tuple[str, bytes], str] = {}
    for name, kind, arrays in values:
        if is_concrete(*arrays) and len(arrays[0]) > 1:
            key = kind, b"".join(np.asarray(array).tobytes() for array in arrays)
            twin = seen.setdefault(key, name)
            if twin != name:
                what = "sockets" if kind == Socket.kind else "observations"
                raise InputError(f"{what} '{twin}' and '{name}' have exactly the same poses; is one file given twice?")

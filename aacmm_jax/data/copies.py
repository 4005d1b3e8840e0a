"""Which poses of a capture tell something of their own: copies count once, and visits were not seated anew."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from ..core.arrays import Numbers, is_concrete
from ..core.errors import InputError, nearest
from ..core.text import pluralise, shorten
from .observations.held import Socket
from .observations.observation import AbstractObservation


class Repeated(NamedTuple):
    """Copies of data that a capture leaves out, because a copy is no measurement of its own."""

    poses: tuple[tuple[str, int], ...] = ()  # sockets and other observations, and the number of copies in each
    lengths: tuple[tuple[str, str], ...] = ()  # both ends of each copy

    def and_also(self, poses: Mapping[str, int], lengths: Iterable[tuple[str, str]]) -> "Repeated":
        """With other copies too: how many poses of each socket and observation, and the ends of lengths."""
        before = dict(self.poses)
        counts = before | {name: before.get(name, 0) + count for name, count in poses.items()}
        return Repeated(tuple((name, count) for name, count in counts.items() if count), (*self.lengths, *lengths))

    def of(self, names: Collection[str]) -> "Repeated":
        """Those in some sockets and observations."""
        return Repeated(
            tuple((name, count) for name, count in self.poses if name in names),
            tuple((start, end) for start, end in self.lengths if start in names and end in names),
        )

    def sentences(self) -> list[str]:
        """What was left out, for warnings."""
        sentences = []
        if self.poses:
            number = pluralise(sum(count for _, count in self.poses), "pose")
            sockets = shorten([f"{name} ({count})" for name, count in self.poses])
            sentences.append(
                f"Counted once: {number} with exactly the readings and values of another pose of the same socket or "
                f"observation: {sockets}; a copy is no measurement of its own. Was the arm recorded at rest, or a file "
                "pasted twice?"
            )
        if self.lengths:
            ends = shorten([f"{start} - {end}" for start, end in self.lengths])
            sentences.append(
                f"Counted once: reference lengths given again with the same value and u: {ends}; delete the copies."
            )
        return sentences


NOTHING_REPEATED = Repeated()
UNKNOWN = -1  # visit


def without_copies(observation: AbstractObservation) -> AbstractObservation:
    """The same observation with the first of each pose; the same reading may have been measured several times. Only
    known values are compared."""
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


def check_different(observations: Iterable[AbstractObservation]) -> None:
    """Refuse two sockets, or two observations of one kind, with exactly the same poses: one file given twice."""
    seen: dict[tuple[str, bytes], AbstractObservation] = {}
    for one in observations:
        arrays = [getattr(one, field) for field in one.by_pose]
        if is_concrete(*arrays) and one.q.shape[0] > 1:
            twin = seen.setdefault((one.kind, b"".join(np.asarray(array).tobytes() for array in arrays)), one)
            if twin is not one:
                what = "sockets" if one.kind == Socket.kind else "observations"
                raise InputError(
                    f"{what} '{twin.name}' and '{one.name}' have exactly the same poses; is one file given twice?"
                )


def checked_visits(visits: Mapping[str, Numbers] | None, sockets: Sequence[Socket]) -> tuple[int, ...] | None:
    """A number for the visit of each pose of the sockets, each other visit another one; None where none is known.

    Args:
        visits: Number of the visit of each pose by socket.
        sockets: All sockets; the first of each pose is kept, as in a capture.

    Raises:
        InputError: A socket is unknown, or its visits are not one whole number a pose.
    """
    if visits is not None and not isinstance(visits, Mapping):
        raise InputError("the visits must be a dictionary: {'A': [1, 1, 2, 2]}, one number for each pose of a socket.")
    if not visits:
        return None
    names = [socket.name for socket in sockets]
    for name in visits:
        if name not in names:
            raise InputError(f"visits are given for the unknown socket '{name}'{nearest(name, names)}")
    numbered, next_number = [], 0
    for socket in sockets:
        poses, rows = socket.q.shape[0], np.full(socket.q.shape[0], UNKNOWN)
        if socket.name in visits:
            given = np.asarray(visits[socket.name])
            numbers = given.shape == (poses,) and given.dtype.kind in "iuf"
            if not numbers or not np.all(np.isfinite(given)) or np.any(given != np.round(given)):
                raise InputError(
                    f"the visits of socket '{socket.name}' must be {poses} whole numbers, one for each of its poses."
                )
            rows = next_number + np.unique(given, return_inverse=True)[1]
            next_number = int(rows.max()) + 1
        numbered.append(rows[first_of_each(socket.q)] if is_concrete(socket.q) else rows)
    return tuple(int(number) for number in np.concatenate(numbered))


def visits_of(capture: Any) -> dict[str, Int[np.ndarray, " m"]]:
    """The visit of each pose of the sockets of a capture whose visits are known."""
    if capture.visits is None:
        return {}
    parts = np.split(np.array(capture.visits, dtype=int), np.cumsum(capture.sizes)[:-1])
    return {name: rows for name, rows in zip(capture.names, parts, strict=True) if np.all(rows != UNKNOWN)}

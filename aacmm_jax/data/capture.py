"""Captures: joint readings taken while the tip rested in fixed sockets, reference lengths, and other observations."""

import fnmatch
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..core.arguments import checked_arguments, items_of, shown
from ..core.arrays import Numbers, is_concrete, joined
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray, namespace
from ..core.random_keys import random_generator
from ..core.text import shorten
from ..kinematics.arm import Arm
from .capture_data import (
    NOTHING_REPEATED,
    UNKNOWN,
    ReferenceLength,
    Repeated,
    check_beside,
    check_revolutions,
    checked_parts,
    described,
    different_lengths,
    different_poses,
    numbered_visits,
)
from .observations.declared import checked_name
from .observations.held import Socket, sockets_of
from .observations.observation import AbstractObservation


class Capture(eqx.Module):
    """Poses grouped by the socket in which the tip rested, reference lengths between sockets, and other observations.

    A socket's position is unknown and is eliminated by the centroid of its poses; one pose at an end is enough for a
    length. All poses are kept in one array ``q`` of shape ``(N, n)``, socket after socket, so that they are evaluated
    together.

    A copy adds no information, but would make every uncertainty too small: poses of a socket with the same reading of
    every joint count once, and so do poses of an observation with the same readings and measured values, and reference
    lengths with the same sockets, value and u. ``repeated`` says which were left out. Only known values are compared: a
    capture made of traced values, and a batch, keep their copies.

    Args:
        sockets: Socket name -> joint readings, shape ``(m, n)``, rad, or mm of prismatic joints; m poses may differ
            from socket to socket. What is recorded beside them follows in more columns (torques, directions, load,
            temperature; see `Arm`); likewise in observations.
        lengths: Reference lengths between these sockets, or one.
        observations: What else ties the tip down (`data.observations`): measured points, spheres, planes, artefacts.
        repeated: Copies that were left out of these data before.
        sessions: Names of the sessions of `join_sessions`; what belongs to one is named ``session/name``.
        visits: Socket name -> number of the visit of each of its poses ``(m,)``; the tip was lifted between visits.

    Raises:
        InputError: For names that are empty, longer than a line or given twice, readings that are not finite,
            sockets or observations of different joint counts or with the same poses, and lengths that
            join unknown sockets.

    Example:
        >>> poses = {"A": [q, q + 0.1, q + 0.2], "B": [q - 0.1]}
        >>> small = aj.Capture(poses, lengths=[aj.ReferenceLength("A", "B", value=500.012, u=0.002)])
        >>> print(small.names, small.sizes, small.q.shape)
        ('A', 'B') (3, 1) (4, 6)
    """

    q: Float[AnyArray, "N n"]
    lengths: tuple[ReferenceLength, ...]
    observations: tuple[AbstractObservation, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)
    repeated: Repeated = eqx.field(static=True)
    sessions: tuple[str, ...] = eqx.field(static=True)
    visits: tuple[int, ...] | None = eqx.field(static=True)  # of each pose of a socket, where they are known

    def __init__(
        self,
        sockets: Mapping[str, Numbers],
        lengths: Iterable[ReferenceLength] | ReferenceLength = (),
        observations: Iterable[AbstractObservation] | AbstractObservation = (),
        repeated: Repeated = NOTHING_REPEATED,
        sessions: Iterable[str] = (),
        visits: Mapping[str, Numbers] | None = None,
    ):
        # Sockets are observations like any other; they alone are kept as one array, since there may be thousands.
        given = checked_parts(sockets, observations)
        rows = different_poses(given)
        parts = [part if kept is None else part.select(kept) for part, kept in zip(given, rows, strict=True)]
        seats, self.observations = parts[: len(sockets)], tuple(parts[len(sockets) :])
        self.q = joined([part.q for part in seats]) if seats else jnp.zeros((0, given[0].q.shape[-1]))
        self.names = tuple(part.name for part in seats)
        self.sizes = tuple(part.q.shape[0] for part in seats)
        ends = [*self.names, *(part.name for part in self.observations if isinstance(part, Socket))]
        self.lengths, copies = different_lengths(lengths, ends)
        counts = dict(repeated.poses)
        for before, part in zip(given, parts, strict=True):
            counts[part.name] = counts.get(part.name, 0) + before.q.shape[0] - part.q.shape[0]
        left_out = tuple((name, count) for name, count in counts.items() if count)
        self.repeated = Repeated(left_out, (*repeated.lengths, *copies))
        names = (checked_name(session, "a session") for session in items_of(sessions, "sessions"))
        self.sessions = tuple(dict.fromkeys(names))
        for part in parts if self.sessions else ():
            self.session_of(part.name)
        self.visits = numbered_visits(visits, given[: len(sockets)], rows)

    @property
    def parts(self) -> tuple[AbstractObservation, ...]:
        """All observations, the sockets first."""
        return (*sockets_of(self.sockets), *self.observations)

    def session_of(self, name: str) -> str:
        """The session of a socket or observation, by its name; `InputError` where it belongs to none."""
        sessions = [session for session in self.sessions if name.startswith(f"{session}/")]
        if not sessions:
            raise InputError(
                f"'{name}' does not belong to any of the sessions {shorten(self.sessions)}; give its name as "
                "session/name, as join_sessions does."
            )
        return max(sessions, key=len)

    @property
    def columns(self) -> int:
        """Number of columns of the readings: one a joint, and those of what was recorded beside them."""
        return self.q.shape[-1]

    @property
    def sockets(self) -> dict[str, Float[Array | np.ndarray, "*batch m n"]]:
        """Joint readings by socket, ``(m, n)`` each, of a batch ``(batch, m, n)``; rad."""
        q = np.asarray(self.q) if is_concrete(self.q) else self.q
        ends = np.cumsum(self.sizes)
        return {name: q[..., end - size : end, :] for name, size, end in zip(self.names, self.sizes, ends, strict=True)}

    @property
    def readings(self) -> Float[AnyArray, "M n"]:
        """Joint readings of all poses, those of sockets first, ``(M, n)``; rad."""
        blocks = [self.q, *(observation.q for observation in self.observations)]
        return namespace(*blocks).concatenate(blocks)

    @property
    def owner(self) -> Int[np.ndarray, " N"]:
        """Index of the socket of each pose, ``(N,)``."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    def ends(self) -> Int[np.ndarray, "l 2"]:
        """Socket indices of both ends of every reference length, ``(l, 2)``."""
        pairs = [(self.names.index(length.start), self.names.index(length.end)) for length in self.lengths]
        return np.array(pairs, dtype=int).reshape(-1, 2)

    def select(self, only: Iterable[str] | str | None = None, without: Iterable[str] | str = ()) -> "Capture":
        """Select sockets and other observations by name, with the reference lengths between the sockets.

        Args:
            only: Names or shell patterns (``"hole_*"``) of what to keep; None keeps all.
            without: Names or shell patterns of what to leave out.

        Returns:
            A capture of what remains, in its order.

        Raises:
            InputError: Where a pattern matches nothing, nothing remains, or the capture is a batch.
        """
        check_one_capture(self)
        names = names_in(self)
        kept = names if only is None else _matching(names, only, "only")
        dropped = _matching(names, without, "without")
        kept = [name for name in kept if name not in dropped]
        if not kept:
            raise InputError("the selection contains no socket and no other observation; select at least one.")
        poses, lengths = self.repeated
        copies = tuple((start, end) for start, end in lengths if start in kept and end in kept)
        return part_of(self, kept, repeated=Repeated(tuple(row for row in poses if row[0] in kept), copies))


def _matching(names: Sequence[str], patterns: Iterable[str] | str, what: str) -> list[str]:
    chosen: set[str] = set()
    for pattern in [patterns] if isinstance(patterns, str) else items_of(patterns, what):
        if not isinstance(pattern, str):
            raise InputError(f"a pattern is {shown(pattern)}; give names of sockets, or shell patterns.")
        matches = {name for name in names if name == pattern or fnmatch.fnmatchcase(name, pattern)}
        if not matches:
            raise InputError(f"no socket matches '{pattern}'{nearest(pattern, names)}")
        chosen |= matches
    return [name for name in names if name in chosen]


def names_in(capture: Capture) -> tuple[str, ...]:
    """Names of the sockets and the other observations of a capture."""
    return (*capture.names, *(observation.name for observation in capture.observations))


def visits_of(capture: Capture) -> dict[str, Int[np.ndarray, " m"]]:
    """The visit of each pose of the sockets of a capture whose visits are known."""
    if capture.visits is None:
        return {}
    parts = np.split(np.array(capture.visits, dtype=int), np.cumsum(capture.sizes)[:-1])
    return {name: rows for name, rows in zip(capture.names, parts, strict=True) if np.all(rows != UNKNOWN)}


def part_of(
    capture: Capture,
    names: Collection[str],
    rows: Mapping[str, Int[np.ndarray, " k"]] | None = None,
    repeated: Repeated = NOTHING_REPEATED,
) -> Capture:
    """Sockets and other observations by their exact names, which `Capture.select` would take for patterns, with the
    reference lengths between them; of those in ``rows`` only these poses."""
    rows, visits = rows or {}, visits_of(capture)
    parts = [part.select(rows[part.name]) if part.name in rows else part for part in capture.parts]
    sockets = {part.name: part.q for part in parts[: len(capture.names)] if part.name in names}
    others = [part for part in parts[len(capture.names) :] if part.name in names]
    lengths = [length for length in capture.lengths if length.start in names and length.end in names]
    visits = {name: visit[rows.get(name, slice(None))] for name, visit in visits.items() if name in sockets}
    return Capture(sockets, lengths, others, repeated, capture.sessions, visits)


def drawn_poses(capture: Capture, count: int, seed: int = 0) -> dict[str, Bool[np.ndarray, " m"]]:
    """Draw so many poses of a capture at random, of sockets and other observations alike: which of the poses of each
    were drawn. Raises `InputError` where the capture is a batch, or has not more poses than ``count``."""
    check_one_capture(capture)
    sizes = {part.name: part.q.shape[0] for part in capture.parts}
    total = sum(sizes.values())
    if not 0 < count < total:
        raise InputError(f"{count} of {total} poses cannot be selected at random; give a number from 1 to {total - 1}.")
    drawn = np.zeros(total, dtype=bool)
    drawn[random_generator(seed).choice(total, count, replace=False)] = True
    return dict(zip(sizes, np.split(drawn, np.cumsum(list(sizes.values()))[:-1]), strict=True))


def draw_poses(capture: Capture, count: int, seed: int = 0) -> Capture:
    """The capture of `drawn_poses`, with the reference lengths whose two sockets it has."""
    rows = {name: np.flatnonzero(drawn) for name, drawn in drawn_poses(capture, count, seed).items()}
    return part_of(capture, [name for name in rows if len(rows[name])], rows)


@checked_arguments
def join_sessions(captures: Mapping[str, Capture], *, own_probe: bool = True) -> Capture:
    """Join captures that one arm took in several sessions, with its probe remounted in between, or on another base.

    Sockets, artefacts and stations of different sessions are different ones; what is unknown of the arm is the same.

    Args:
        captures: Name of a session -> its capture. Names of sockets and observations become ``session/name``.
        own_probe: Whether every session after the first has a probe of its own, whose place in the last frame is
            unknown; False where the probe stayed as it was.

    Returns:
        One capture of all sessions, to calibrate as a whole.

    Raises:
        InputError: A capture is a batch, or one has targets in more than one session.

    Example:
        >>> monday = aj.simulate(true, {"A": (400, 200, 300)}, poses=5, seed=1)
        >>> friday = aj.simulate(true, {"A": (500, 200, 300)}, poses=5, seed=2)
        >>> both = aj.join_sessions({"monday": monday, "friday": friday})
        >>> print(both.names, [observation.name for observation in both.observations])
        ('monday/A',) ['friday/A']
    """
    if not isinstance(captures, Mapping) or not captures:
        raise InputError("the sessions must be a dictionary of captures by name: {'Monday': capture, ...}.")
    sockets: dict[str, Numbers] = {}
    visits: dict[str, Numbers] = {}
    lengths: list[ReferenceLength] = []
    observations: list[AbstractObservation] = []
    for number, (session, capture) in enumerate(captures.items()):
        if not isinstance(capture, Capture):
            raise InputError(f"session '{session}' is a {type(capture).__name__}; give an aj.Capture.")
        check_one_capture(capture)
        checked_name(session, "a session")
        probe = f"probe of {session}" if number and own_probe else ""
        parts = [part.in_session(session, probe) for part in capture.parts]
        seated = 0 if probe else len(capture.names)  # sockets with another tip are observations
        sockets |= {part.name: part.q for part in parts[:seated]}
        observations += parts[seated:]
        visits |= {f"{session}/{name}": rows for name, rows in visits_of(capture).items() if not probe}
        for length in capture.lengths:
            start, end = f"{session}/{length.start}", f"{session}/{length.end}"
            lengths.append(replace(length, start=start, end=end))
    return Capture(sockets, lengths, observations, sessions=tuple(captures), visits=visits)


def stack_captures(captures: Iterable[Capture]) -> Capture:
    """Stack captures into a batch for `identify_many`.

    Args:
        captures: Captures with the same sockets, numbers of poses, joints and reference lengths.

    Returns:
        A capture whose ``q`` is ``(batch, N, n)`` and whose lengths are ``(batch,)``; rad and mm.

    Raises:
        InputError: Where there is none, one is a batch, or they differ in shape.

    Example:
        >>> drawn = [aj.simulate(true, sockets, poses=10, noise=noise, seed=seed) for seed in (1, 2, 3)]
        >>> print(aj.stack_captures(drawn).q.shape)
        (3, 20, 6)
    """
    captures = items_of(captures, "captures")
    if not captures:
        raise InputError("the list of captures is empty; give at least one capture.")
    for capture in captures:
        if not isinstance(capture, Capture):
            raise InputError(f"one of the captures is a {type(capture).__name__}; give a list of aj.Capture.")
        check_one_capture(capture)
    # Copies that were left out, sessions and visits may differ; those of the first are kept.
    first, shapes = captures[0], set()
    arrays = [(capture.q, capture.lengths, capture.observations) for capture in captures]
    for capture, part in zip(captures, arrays, strict=True):
        leaves, structure = jax.tree.flatten(part)
        shapes.add((capture.names, capture.sizes, structure, tuple(np.shape(leaf) for leaf in leaves)))
    if len(shapes) != 1:
        raise InputError(
            "all captures of a batch must have the same sockets, reference lengths and observations, and the same "
            "numbers of poses and joints."
        )

    def stacked(*leaves: Any) -> Any:
        return np.stack(leaves) if is_concrete(*leaves) else jnp.stack(leaves)

    return eqx.tree_at(lambda c: (c.q, c.lengths, c.observations), first, jax.tree.map(stacked, *arrays))


def check_one_capture(capture: Capture) -> None:
    """Raise `InputError` for a batch of `stack_captures`."""
    if capture.q.ndim != 2:
        raise InputError(
            "the capture is a batch of stacked captures, but a single capture is needed; use the captures of the "
            "batch separately."
        )


def as_read_by(capture: Capture, recorded: Arm, arm: Arm) -> Capture:
    """A capture of one arm with the columns that another one has beside the joints' readings (`Beside.laid_out`)."""
    if recorded.joints != arm.joints or capture.columns not in recorded.possible_columns:
        return capture
    names = recorded.beside.names(capture.columns)
    if arm.beside.is_clear(names):
        return capture
    parts = [part.changed(q=arm.beside.laid_out(np.asarray(part.q), names)) for part in capture.parts]
    count = len(capture.names)
    return Capture(
        {part.name: part.q for part in parts[:count]},
        capture.lengths,
        parts[count:],
        capture.repeated,
        capture.sessions,
        visits_of(capture),
    )


def check_readings(capture: Capture, arm: Arm, *, advice: str = "convert with numpy.deg2rad") -> None:
    """Raise `InputError` where known readings of an arm's revolute joints look like degrees, with advice on them."""
    for part in capture.parts:
        if is_concrete(part.q) and part.q.shape[-1] in arm.possible_columns:
            check_beside(described(part), np.asarray(part.q), arm)
            check_revolutions(described(part), part.q, arm, advice)

"""Captures: joint readings taken while the tip rested in fixed sockets, reference lengths, and other observations."""

import fnmatch
from collections.abc import Collection, Iterable, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core.arguments import items_of, shown
from ..core.arrays import Numbers, is_concrete, joined
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray, namespace
from ..core.random_keys import random_generator
from ..core.text import shorten
from ..kinematics.arm import Arm, by_joint
from .copies import NOTHING_REPEATED, Repeated, check_different, checked_visits, visits_of, without_copies
from .observations.declared import checked_name, checked_readings
from .observations.held import Socket, sockets_of
from .observations.observation import AbstractObservation
from .reference_length import ReferenceLength, check_temperatures

# Encoders of joints without limits count a few revolutions at most; larger readings are degrees taken for radians.
_MOST_RADIANS = 8 * np.pi


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
            from socket to socket. Of an arm with a thermometer ``(m, n + 1)``, with the temperature last, C; likewise
            in observations.
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
        seats = _checked_sockets(sockets)
        given = (*seats, *_checked_observations(observations, sockets))
        _check_columns(given)
        different = [without_copies(part) for part in given]
        check_different(different)
        seated = different[: len(sockets)]
        self.q = joined([part.q for part in seated]) if seated else jnp.zeros((0, given[0].q.shape[-1]))
        self.names = tuple(part.name for part in seated)
        self.sizes = tuple(part.q.shape[0] for part in seated)
        self.observations = tuple(different[len(sockets) :])
        ends = [*self.names, *(part.name for part in self.observations if isinstance(part, Socket))]
        self.lengths, copies = _different_lengths(_checked_lengths(lengths, ends))
        left_out = {one.name: one.q.shape[0] - kept.q.shape[0] for one, kept in zip(given, different, strict=True)}
        self.repeated = repeated.and_also(left_out, copies)
        names = (checked_name(session, "a session") for session in items_of(sessions, "sessions"))
        self.sessions = tuple(dict.fromkeys(names))
        for part in different if self.sessions else ():
            self.session_of(part.name)
        self.visits = checked_visits(visits, seats)

    @property
    def parts(self) -> tuple[AbstractObservation, ...]:
        """All observations, the sockets first."""
        return (*sockets_of(self.sockets), *self.observations)

    def session_of(self, name: str) -> str:
        """The session of a socket or observation, by its name; `InputError` where it belongs to none."""
        sessions = [session for session in self.sessions if name.startswith(f"{session}/")]
        if not sessions:
            raise InputError(
                f"'{name}' is in none of the sessions {shorten(self.sessions)}; name it session/name, as join_sessions "
                "does."
            )
        return max(sessions, key=len)

    @property
    def columns(self) -> int:
        """Number of columns of the readings: one a joint, and one more of an arm with a thermometer."""
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
        only = [only] if isinstance(only, str) else only
        only = None if only is None else items_of(only, "only")
        without = [without] if isinstance(without, str) else items_of(without, "without")
        names = names_in(self)
        kept = names if only is None else _matching(names, only)
        dropped = _matching(names, without)
        kept = [name for name in kept if name not in dropped]
        if not kept:
            raise InputError("no socket is left after the selection; widen it.")
        return part_of(self, kept, repeated=self.repeated.of(kept))


def names_in(capture: Capture) -> tuple[str, ...]:
    """Names of the sockets and the other observations of a capture."""
    return (*capture.names, *(observation.name for observation in capture.observations))


def part_of(
    capture: Capture,
    names: Collection[str],
    rows: Mapping[str, Int[np.ndarray, " k"]] | None = None,
    repeated: Repeated = NOTHING_REPEATED,
) -> Capture:
    """Sockets and other observations by their exact names, which `Capture.select` would take for patterns, with the
    reference lengths between them; of those in ``rows`` only these poses."""
    rows = rows or {}
    parts = [part if part.name not in rows else part.select(rows[part.name]) for part in capture.parts]
    sockets = {part.name: part.q for part in parts[: len(capture.names)] if part.name in names}
    others = [part for part in parts[len(capture.names) :] if part.name in names]
    lengths = [length for length in capture.lengths if length.start in names and length.end in names]
    visits = {
        name: visit[rows[name]] if name in rows else visit
        for name, visit in visits_of(capture).items()
        if name in sockets
    }
    return Capture(sockets, lengths, others, repeated, capture.sessions, visits)


def draw_poses(capture: Capture, count: int, seed: int = 0) -> tuple[Capture, Capture]:
    """Divide the poses of a capture at random: some to calibrate with, the others to test the result on.

    Args:
        capture: The capture.
        count: How many poses to draw, of sockets and other observations alike.
        seed: Of the random numbers.

    Returns:
        A capture of the drawn poses, and one of the others; each with the reference lengths whose two sockets it has.

    Raises:
        InputError: The capture is a batch, or has not more poses than these.
    """
    check_one_capture(capture)
    sizes = {part.name: part.q.shape[0] for part in capture.parts}
    total = sum(sizes.values())
    if not 0 < count < total:
        raise InputError(f"{count} of {total} poses cannot be drawn; give a number from 1 to {total - 1}.")
    drawn = np.zeros(total, dtype=bool)
    drawn[random_generator(seed).choice(total, count, replace=False)] = True
    of_parts = dict(zip(sizes, np.split(drawn, np.cumsum(list(sizes.values()))[:-1]), strict=True))
    rows = [{name: np.flatnonzero(part == wanted) for name, part in of_parts.items()} for wanted in (True, False)]
    first, second = (part_of(capture, [name for name in chosen if len(chosen[name])], chosen) for chosen in rows)
    return first, second


def check_one_capture(capture: Capture) -> None:
    """Raise `InputError` for a batch of `stack_captures`."""
    if capture.q.ndim != 2:
        raise InputError(
            "the capture is a batch of stacked captures, but one capture is needed; use the captures one by one."
        )


def check_sockets_only(capture: Capture, what: str) -> None:
    """Raise `InputError` for a capture with observations besides sockets and lengths, which ``what`` does not know."""
    if capture.observations:
        names = shorten([observation.name for observation in capture.observations])
        raise InputError(
            f"{what} takes sockets and reference lengths only, but the capture has other observations ({names}); make "
            "a capture without them."
        )


def _matching(names: Sequence[str], patterns: Iterable[str]) -> list[str]:
    chosen: set[str] = set()
    for pattern in patterns:
        if not isinstance(pattern, str):
            raise InputError(f"a pattern is {shown(pattern)}; give names of sockets, or shell patterns.")
        chosen_now = {name for name in names if name == pattern or fnmatch.fnmatchcase(name, pattern)}
        if not chosen_now:
            raise InputError(f"no socket matches '{pattern}'{nearest(pattern, names)}")
        chosen |= chosen_now
    return [name for name in names if name in chosen]


def _checked_sockets(sockets: Mapping[str, Numbers]) -> tuple[Socket, ...]:
    if not isinstance(sockets, Mapping):
        raise InputError(
            f"the sockets are a {type(sockets).__name__}; give a dictionary of names and readings: "
            '{"A": q}, q of shape (poses, joints).'
        )
    for name in sockets:
        checked_name(name, "a socket")
    return sockets_of({name: checked_readings(f"socket '{name}'", q) for name, q in sockets.items()})


def _checked_observations(
    observations: Iterable[AbstractObservation] | AbstractObservation, sockets: Collection[str]
) -> tuple[AbstractObservation, ...]:
    single = isinstance(observations, AbstractObservation)
    checked = (observations,) if single else tuple(items_of(observations, "observations"))
    for observation in checked:
        if not isinstance(observation, AbstractObservation):
            raise InputError(f"{observation!r} is no observation; give one of aj.data.observations, such as a Sphere.")
    names = [observation.name for observation in checked]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two observations have the name '{name}'; give each a name of its own.")
        if name in sockets:
            raise InputError(f"a socket and an observation have the name '{name}'; give each a name of its own.")
    if not checked and not sockets:
        raise InputError("a capture needs at least one socket with poses, or another observation.")
    return checked


def _check_columns(parts: Sequence[AbstractObservation]) -> None:
    """All readings are of one arm."""
    width = parts[0].q.shape[-1]
    for part in parts:
        if part.q.shape[-1] != width:
            raise InputError(
                f"{_described(part)} has {part.q.shape[-1]} columns, but {_described(parts[0])} has {width}; give one "
                "column a joint, and the temperature after them to all or to none."
            )


def _described(part: AbstractObservation) -> str:
    return f"{'socket' if isinstance(part, Socket) else 'observation'} '{part.name}'"


def _checked_lengths(
    lengths: Iterable[ReferenceLength] | ReferenceLength, sockets: Sequence[str]
) -> tuple[ReferenceLength, ...]:
    checked = (lengths,) if isinstance(lengths, ReferenceLength) else tuple(items_of(lengths, "lengths"))
    for length in checked:
        if not isinstance(length, ReferenceLength):
            raise InputError(f"{shown(length)} is no reference length; give aj.ReferenceLength(start, end, value, u).")
        for end in (length.start, length.end):
            if end not in sockets:
                raise InputError(
                    f"reference length '{length.start}' to '{length.end}' names the unknown socket '{end}'"
                    f"{nearest(end, sockets)}"
                )
    return checked


def _different_lengths(
    lengths: tuple[ReferenceLength, ...],
) -> tuple[tuple[ReferenceLength, ...], tuple[tuple[str, str], ...]]:
    """The first of each reference length, and the ends of those that repeat it, perhaps in the other direction."""
    different, copies, seen = [], [], set()
    for length in lengths:
        key = None
        if is_concrete(length.value, length.u) and not np.ndim(length.value):
            key = frozenset((length.start, length.end)), float(length.value), float(length.u)
        if key is not None and key in seen:
            copies.append((length.start, length.end))
            continue
        seen.add(key)
        different.append(length)
    return tuple(different), tuple(copies)


def check_readings(capture: Capture, arm: Arm, *, advice: str = "convert with numpy.deg2rad") -> None:
    """Raise `InputError` where known readings of an arm's revolute joints look like degrees, with advice on them."""
    joints, columns = arm.joints, arm.columns
    for part in capture.parts:
        if is_concrete(part.q) and part.q.shape[-1] in (joints, columns):
            check_temperatures(_described(part), np.asarray(part.q)[..., joints:])
            check_revolutions(_described(part), part.q, arm, advice)


def check_revolutions(where: str, readings: AnyArray, arm: Arm, advice: str) -> None:
    """Raise `InputError` where readings of revolute joints look like degrees."""
    angular = np.array(by_joint(arm, True, False))
    joints = len(angular)
    size = np.where(angular, np.abs(np.asarray(readings)[..., :joints]), 0.0).reshape(-1, joints)
    if size.size and size.max() > _MOST_RADIANS:
        row, column = np.argwhere(size == size.max())[0] + 1
        raise InputError(
            f"{where} pose {row} joint {column} is {size.max():g} rad, more than four revolutions: these look like "
            f"degrees; {advice}."
        )

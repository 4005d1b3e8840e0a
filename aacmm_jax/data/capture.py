"""Captures: joint readings taken while the tip rested in fixed sockets, and reference lengths between sockets."""

import fnmatch
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core.arguments import checked_arguments, items_of, shown
from ..core.arrays import Numbers, is_concrete, joined
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray, namespace
from ..core.text import shorten
from ..kinematics.arm import Arm, by_joint
from .copies import NOTHING_REPEATED, Repeated, check_different, observation_without_copies, without_copies
from .observations.declared import checked_name, checked_readings
from .observations.observation import AbstractObservation
from .observations.socket import Socket
from .reference_length import ReferenceLength, check_temperatures
from .visits import checked_visits, visits_of

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
        if not isinstance(sockets, Mapping):
            raise InputError(
                f"the sockets are a {type(sockets).__name__}; give a dictionary of names and readings: "
                '{"A": q}, q of shape (poses, joints).'
            )
        self.observations = _checked_observations(observations, sockets)
        if not sockets and not self.observations:
            raise InputError("a capture needs at least one socket with poses, or another observation.")
        blocks = {
            checked_name(name, "a socket"): checked_readings(f"socket '{name}'", angles)
            for name, angles in sockets.items()
        }
        of_all = {f"socket '{name}'": block for name, block in blocks.items()}
        of_all |= {f"observation '{observation.name}'": observation.q for observation in self.observations}
        first, width = next((where, block.shape[-1]) for where, block in of_all.items())
        for where, block in of_all.items():
            if block.shape[-1] != width:
                raise InputError(
                    f"{where} has {block.shape[-1]} columns, but {first} has {width}; give one column a joint, "
                    "and the temperature after them to all or to none."
                )
        different = {name: without_copies(block) for name, block in blocks.items()}
        counts = {name: block.shape[0] for name, block in blocks.items()}
        counts |= {observation.name: observation.q.shape[0] for observation in self.observations}
        self.observations = tuple(observation_without_copies(observation) for observation in self.observations)
        check_different(different, self.observations)
        self.q = joined(list(different.values())) if different else jnp.zeros((0, width))
        self.names = tuple(different)
        self.sizes = tuple(block.shape[0] for block in different.values())
        given = (lengths,) if isinstance(lengths, ReferenceLength) else tuple(items_of(lengths, "lengths"))
        for length in given:
            if not isinstance(length, ReferenceLength):
                raise InputError(
                    f"{shown(length)} is no reference length; give aj.ReferenceLength(start, end, value, u)."
                )
            known = (*self.names, *(o.name for o in self.observations if isinstance(o, Socket)))
            for end in (length.start, length.end):
                if end not in known:
                    raise InputError(
                        f"reference length '{length.start}' to '{length.end}' names the unknown socket '{end}'"
                        f"{nearest(end, known)}"
                    )
        self.lengths, copies = _different_lengths(given)
        poses = dict(repeated.poses)
        sizes = dict(zip(self.names, self.sizes, strict=True))
        sizes |= {observation.name: observation.q.shape[0] for observation in self.observations}
        for name, size in sizes.items():
            poses[name] = poses.get(name, 0) + counts[name] - size
        self.repeated = Repeated(
            tuple((name, count) for name, count in poses.items() if count), (*repeated.lengths, *copies)
        )
        self.sessions = tuple(
            dict.fromkeys(checked_name(session, "a session") for session in items_of(sessions, "sessions"))
        )
        for name in (*self.names, *(o.name for o in self.observations)) if self.sessions else ():
            self.session_of(name)
        self.visits = checked_visits(visits, blocks)

    def session_of(self, name: str) -> str:
        """The session of a socket or observation, by its name; `InputError` where it belongs to none."""
        found = [session for session in self.sessions if name.startswith(f"{session}/")]
        if not found:
            raise InputError(
                f"'{name}' is in none of the sessions {shorten(self.sessions)}; name it session/name, as join_sessions "
                "does."
            )
        return max(found, key=len)

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
        known = [*self.names, *(observation.name for observation in self.observations)]
        kept = known if only is None else _matching(known, only)
        dropped = _matching(known, without)
        kept = [name for name in kept if name not in dropped]
        if not kept:
            raise InputError("no socket is left after the selection; widen it.")
        sockets = self.sockets
        lengths = [length for length in self.lengths if length.start in kept and length.end in kept]
        repeated = Repeated(
            tuple((name, count) for name, count in self.repeated.poses if name in kept),
            tuple((start, end) for start, end in self.repeated.lengths if start in kept and end in kept),
        )
        others = [observation for observation in self.observations if observation.name in kept]
        chosen = {name: sockets[name] for name in self.names if name in kept}
        return Capture(chosen, lengths, others, repeated, self.sessions, visits_of(self, kept))


def names_in(capture: Capture) -> tuple[str, ...]:
    """Names of the sockets and the other observations of a capture."""
    return (*capture.names, *(observation.name for observation in capture.observations))


def part_of(capture: Capture, names: Collection[str]) -> Capture:
    """Sockets and other observations by their exact names, which `Capture.select` would take for patterns, with the
    reference lengths between them."""
    lengths = [length for length in capture.lengths if length.start in names and length.end in names]
    others = [observation for observation in capture.observations if observation.name in names]
    sockets = {name: q for name, q in capture.sockets.items() if name in names}
    return Capture(sockets, lengths, others, sessions=capture.sessions, visits=visits_of(capture, names))


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
            raise InputError(f"a pattern is {pattern!r}; give names of sockets, or shell patterns.")
        found = {name for name in names if name == pattern or fnmatch.fnmatchcase(name, pattern)}
        if not found:
            raise InputError(f"no socket matches '{pattern}'{nearest(pattern, names)}")
        chosen |= found
    return [name for name in names if name in chosen]


def _checked_observations(
    observations: Iterable[AbstractObservation] | AbstractObservation, sockets: Iterable[str]
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
        raise InputError("the sessions are no dictionary; give the captures by name: {'Monday': capture, ...}.")
    sockets: dict[str, Numbers] = {}
    visits: dict[str, Numbers] = {}
    lengths: list[ReferenceLength] = []
    observations: list[AbstractObservation] = []
    for number, (session, capture) in enumerate(captures.items()):
        if not isinstance(capture, Capture):
            raise InputError(f"session '{session}' is a {type(capture).__name__}; give an aj.Capture.")
        check_one_capture(capture)
        checked_name(session, "a session")
        for name, readings in capture.sockets.items():
            if number and own_probe:
                observations.append(Socket(f"{session}/{name}", readings, target=f"probe of {session}"))
            else:
                sockets[f"{session}/{name}"] = readings
        visits |= {f"{session}/{name}": rows for name, rows in visits_of(capture).items()}
        lengths += [
            ReferenceLength(f"{session}/{length.start}", f"{session}/{length.end}", length.value, length.u)
            for length in capture.lengths
        ]
        own = f"probe of {session}" if number and own_probe else ""
        observations += [observation.in_session(session, own) for observation in capture.observations]
    visits = {name: rows for name, rows in visits.items() if name in sockets}
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
    for capture in captures:
        if not isinstance(capture, Capture):
            raise InputError(f"a capture to stack is a {type(capture).__name__}; give a list of aj.Capture.")
    if not captures:
        raise InputError("there is no capture to stack; give at least one.")
    for capture in captures:
        check_one_capture(capture)
    shapes = {
        (c.names, c.sizes, tuple((r.start, r.end) for r in c.lengths), c.columns, _form(c.observations))
        for c in captures
    }
    if len(shapes) != 1:
        raise InputError(
            "captures of a batch must have the same sockets, numbers of poses, joints, lengths and observations."
        )
    arrays = [(capture.q, capture.lengths, capture.observations) for capture in captures]
    return eqx.tree_at(
        lambda c: (c.q, c.lengths, c.observations),
        captures[0],
        jax.tree.map(lambda *leaves: np.stack(leaves) if is_concrete(*leaves) else jnp.stack(leaves), *arrays),
    )


def _form(observations: tuple[AbstractObservation, ...]) -> tuple[Any, ...]:
    """What observations must share to be stacked."""
    leaves, structure = jax.tree.flatten(observations)
    return structure, tuple(leaf.shape for leaf in leaves)


def check_readings(capture: Capture, arm: Arm, *, advice: str = "convert with numpy.deg2rad") -> None:
    """Raise `InputError` where known readings of an arm's revolute joints look like degrees, with advice on them."""
    joints, columns = arm.joints, arm.columns
    of_sockets = [(f"socket '{name}'", readings) for name, readings in capture.sockets.items()]
    for where, readings in [*of_sockets, *((f"observation '{one.name}'", one.q) for one in capture.observations)]:
        if not is_concrete(readings) or readings.shape[-1] not in (joints, columns):
            continue
        check_temperatures(where, np.asarray(readings)[..., joints:])
        check_revolutions(where, readings, arm, advice)


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

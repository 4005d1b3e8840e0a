"""What a capture is made of, and its checks: reference lengths, different poses and lengths, visits to sockets."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.arguments import Range, checked, items_of, shown
from ..core.arrays import Numbers, is_concrete
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray
from ..core.text import pluralise, shorten
from ..kinematics.arm import Arm, by_joint, check_chain
from ..kinematics.correction_kinds import REFERENCE_TEMPERATURE
from .observations.declared import checked_name, checked_readings
from .observations.held import Socket, sockets_of
from .observations.observation import AbstractObservation

# Encoders of joints without limits count a few revolutions at most; larger readings are degrees taken for radians.
_MOST_RADIANS = 8 * np.pi
UNKNOWN = -1  # visit
_LENGTH = Annotated[Float[AnyArray, ""], Range(above=0, unit="mm")]
_UNCERTAINTY = Annotated[Float[AnyArray, ""], Range(least=0, unit="mm")]
_TEMPERATURES = (-50.0, 100.0)  # C; room temperatures in kelvins are outside
_LARGEST_EXPANSION = 1e-3  # 1/K: plastics expand by up to 2e-4


class ReferenceLength(eqx.Module):
    """A physical artefact: the certified distance between two sockets.

    Args:
        start: Name of the socket at one end.
        end: Name of the socket at the other end.
        value: Calibrated length, scalar, mm.
        u: Standard uncertainty (k = 1) of ``value``, scalar, mm.
        corrected: Whether ``value`` or ``u`` already contains the artefact's thermal expansion.

    Raises:
        InputError: Where both ends are one socket, ``value`` is not positive or ``u`` is negative.

    Example:
        >>> bar = aj.ReferenceLength("A", "B", value=500.012, u=0.002)
        >>> print(aj.Capture({"A": [q, q + 0.1], "B": [q + 0.2]}, lengths=[bar]).lengths[0].u)
        0.002
    """

    start: str = eqx.field(static=True)
    end: str = eqx.field(static=True)
    value: Float[AnyArray, ""]
    u: Float[AnyArray, ""]
    corrected: bool = eqx.field(static=True)

    def __init__(self, start: str, end: str, value: Numbers, u: Numbers = 0.0, corrected: bool = False):
        for name in (start, end):
            if not isinstance(name, str):
                raise InputError(f"an end of a reference length is {shown(name)}; give the name of a socket.")
        self.start, self.end = start, end
        where = f"reference length '{start}' to '{end}'"
        if start == end:
            raise InputError(f"{where} joins a socket to itself; give two different sockets.")
        self.value = checked(value, _LENGTH, where)
        self.u = checked(u, _UNCERTAINTY, f"u of {where}")
        self.corrected = bool(corrected)

    @classmethod
    def at_temperature(
        cls,
        start: str,
        end: str,
        value: float,
        u: float = 0.0,
        *,
        expansion: float,
        temperature: float,
        u_expansion: float = 0.0,
        u_temperature: float = 0.0,
    ) -> "ReferenceLength":
        """A length that is certified at 20 C and was measured at another temperature: value (1 + expansion (T - 20)).

        ``expansion`` is the artefact's coefficient of thermal expansion, 1/K, and ``temperature`` its own when it was
        measured, C, each with its standard uncertainty. Raises `InputError` as a `ReferenceLength` does, and where the
        temperature is not in C, or the expansion not in 1/K.
        """
        where = f"reference length '{start}' to '{end}'"
        check_temperatures(where, np.asarray(temperature, dtype=float))
        if not (abs(expansion) <= _LARGEST_EXPANSION and 0 <= u_expansion <= _LARGEST_EXPANSION):
            raise InputError(
                f"{where} has an expansion of {expansion:g} /K with u = {u_expansion:g} /K, but no artefact expands "
                f"by more than {_LARGEST_EXPANSION:g} /K; give both in 1/K (steel: 11.5e-6)."
            )
        if not 0 <= u_temperature < np.inf:
            raise InputError(f"{where} has u_temperature = {u_temperature:g} K; give zero or a positive number.")
        warmer = temperature - REFERENCE_TEMPERATURE
        parts = (value * warmer * u_expansion, value * expansion * u_temperature)
        corrected = any((expansion * warmer, *parts))
        return cls(start, end, value * (1 + expansion * warmer), float(np.linalg.norm((u, *parts))), corrected)


class Repeated(NamedTuple):
    """Copies of data that a capture leaves out, because a copy is no measurement of its own."""

    poses: tuple[tuple[str, int], ...] = ()  # sockets and other observations, and the number of copies in each
    lengths: tuple[tuple[str, str], ...] = ()  # both ends of each copy

    def sentences(self) -> list[str]:
        """What was left out, for warnings."""
        sentences = []
        if self.poses:
            number = pluralise(sum(count for _, count in self.poses), "pose")
            sockets = shorten([f"{name} ({count})" for name, count in self.poses])
            sentences.append(
                f"Duplicates ignored: {number} with exactly the same readings and values as another pose of the same "
                f"socket or observation: {sockets}. A copy is not an independent measurement. Was the arm recorded "
                "while at rest, or was a file pasted twice?"
            )
        if self.lengths:
            ends = shorten([f"{start} - {end}" for start, end in self.lengths])
            sentences.append(
                f"Duplicates ignored: reference lengths given more than once with the same value and u: {ends}; "
                "delete the copies."
            )
        return sentences


NOTHING_REPEATED = Repeated()


def described(part: AbstractObservation) -> str:
    """A socket or observation in a message."""
    return f"{'socket' if isinstance(part, Socket) else 'observation'} '{part.name}'"


def checked_parts(sockets: Mapping[str, Numbers], observations: Any) -> tuple[AbstractObservation, ...]:
    """The sockets and the other observations of a capture, or `InputError`."""
    if not isinstance(sockets, Mapping):
        raise InputError(
            f"the sockets are a {type(sockets).__name__}; give a dictionary of names and readings: "
            '{"A": q}, with q of shape (poses, joints).'
        )
    for name in sockets:
        checked_name(name, "a socket")
    seats = sockets_of({name: checked_readings(f"socket '{name}'", q) for name, q in sockets.items()})
    others = [observations] if isinstance(observations, AbstractObservation) else items_of(observations, "observations")
    names = set(sockets)
    for observation in others:
        if not isinstance(observation, AbstractObservation):
            raise InputError(
                f"{observation!r} is not an observation; give an observation from aj.data.observations, such as a "
                "Sphere."
            )
        if observation.name in names:
            both = "a socket and an observation" if observation.name in sockets else "two observations"
            raise InputError(f"{both} have the name '{observation.name}'; give them different names.")
        names.add(observation.name)
    parts = (*seats, *others)
    if not parts:
        raise InputError("a capture needs at least one socket with poses, or another observation.")
    width = parts[0].q.shape[-1]
    for part in parts:
        if part.q.shape[-1] != width:
            raise InputError(
                f"{described(part)} has {part.q.shape[-1]} columns, but {described(parts[0])} has {width}; give one "
                "column per joint, and what is recorded beside them either everywhere or nowhere."
            )
    return parts


def different_poses(parts: Iterable[AbstractObservation]) -> list[list[int] | None]:
    """The first of each pose of every part; None where all differ. The same reading may have been measured several
    times, and only known values are compared.

    Raises `InputError` for two sockets, or two observations of one kind, with exactly the same poses: one file given
    twice.
    """
    kept: list[list[int] | None] = []
    seen: dict[Any, AbstractObservation] = {}
    for part in parts:
        values = [getattr(part, field) for field in part.by_pose]
        if not is_concrete(*values):
            kept.append(None)
            continue
        first: dict[tuple[bytes, ...], int] = {}
        arrays = [np.asarray(value) for value in values]
        arrays = [array + 0.0 if array.dtype.kind == "f" else array for array in arrays]  # which has no negative zero
        for i, rows in enumerate(zip(*arrays, strict=True)):
            first.setdefault(tuple(row.tobytes() for row in rows), i)
        twin = seen.setdefault((part.kind, *first), part) if len(first) > 1 else part
        if twin is not part:
            what = "sockets" if part.kind == Socket.kind else "observations"
            raise InputError(
                f"{what} '{twin.name}' and '{part.name}' have exactly the same poses; was one file given twice?"
            )
        kept.append(None if len(first) == part.q.shape[0] else list(first.values()))
    return kept


def different_lengths(
    lengths: Any, sockets: Sequence[str]
) -> tuple[tuple[ReferenceLength, ...], list[tuple[str, str]]]:
    """The first of each reference length, or `InputError`; and the ends of those that repeat one, perhaps in the other
    direction."""
    different, copies, seen = [], [], set()
    for length in (lengths,) if isinstance(lengths, ReferenceLength) else items_of(lengths, "lengths"):
        if not isinstance(length, ReferenceLength):
            raise InputError(
                f"{shown(length)} is not a reference length; give aj.ReferenceLength(start, end, value, u)."
            )
        ends = length.start, length.end
        for end in ends:
            if end not in sockets:
                raise InputError(
                    f"reference length '{ends[0]}' to '{ends[1]}' names the unknown socket '{end}'"
                    f"{nearest(end, sockets)}"
                )
        if is_concrete(length.value, length.u) and not np.ndim(length.value):
            key = frozenset(ends), float(length.value), float(length.u)
            if key in seen:
                copies.append(ends)
                continue
            seen.add(key)
        different.append(length)
    return tuple(different), copies


def numbered_visits(
    visits: Mapping[str, Numbers] | None, sockets: Sequence[AbstractObservation], kept: Sequence[list[int] | None]
) -> tuple[int, ...] | None:
    """A number for the visit of each of the ``kept`` poses of the sockets, each other visit another one; None where
    none is known, and `InputError` where a socket is unknown, or its visits are not one whole number a pose."""
    if visits is not None and not isinstance(visits, Mapping):
        raise InputError("the visits must be a dictionary: {'A': [1, 1, 2, 2]}, one number for each pose of a socket.")
    if not visits:
        return None
    names = [socket.name for socket in sockets]
    for name in visits:
        if name not in names:
            raise InputError(f"visits are given for the unknown socket '{name}'{nearest(name, names)}")
    numbers: list[int] = []
    following = 0
    for socket, rows in zip(sockets, kept, strict=False):
        poses = socket.q.shape[0]
        of_poses = np.full(poses, UNKNOWN)
        if socket.name in visits:
            given = np.asarray(visits[socket.name])
            whole = given.shape == (poses,) and given.dtype.kind in "iuf"
            if not whole or not np.all(np.isfinite(given)) or np.any(given != np.round(given)):
                raise InputError(
                    f"the visits of socket '{socket.name}' must be {poses} whole numbers, one for each of its poses."
                )
            of_poses = following + np.unique(given, return_inverse=True)[1]
            following = int(of_poses.max()) + 1
        numbers += of_poses[slice(None) if rows is None else rows].tolist()
    return tuple(numbers)


def check_revolutions(where: str, readings: AnyArray, arm: Arm, advice: str) -> None:
    """Raise `InputError` where readings of revolute joints look like degrees."""
    angular = np.array(by_joint(arm, True, False))
    joints = len(angular)
    size = np.where(angular, np.abs(np.asarray(readings)[..., :joints]), 0.0).reshape(-1, joints)
    if size.size and size.max() > _MOST_RADIANS:
        row, column = np.argwhere(size == size.max())[0] + 1
        raise InputError(
            f"{where} pose {row} joint {column} is {size.max():g} rad, more than four revolutions, so the readings are "
            f"probably in degrees; {advice}."
        )


def check_beside(where: str, readings: Float[np.ndarray, "... columns"], arm: Arm) -> None:
    """Raise `InputError` where what was recorded beside the joints' readings cannot be what the arm has it for."""
    check_chain(arm, readings, where)
    columns = {name: readings[..., part] for name, part in arm.beside.slices(readings.shape[-1]).items()}
    check_temperatures(where, columns["thermometer"])
    directions, load = columns["directions"], columns["load"]
    if np.any(wrong := ~np.isin(directions, (-1.0, 0.0, 1.0))):
        *_, row, column = np.argwhere(wrong)[0]
        raise InputError(
            f"{where} pose {row + 1} has the direction {directions[wrong].flat[0]:g} of joint {column + 1}; give 1 "
            "where the reading was rising, -1 where it was falling, or 0 where this is unknown."
        )
    if np.any(load < 0):
        raise InputError(f"{where} has a load of {load.min():g} kg; give the mass at the tip in kg, 0 for none.")


def check_temperatures(where: str, temperatures: Float[np.ndarray, "..."]) -> None:
    """Raise `InputError` where temperatures are not in degrees Celsius; ``where`` names what has them."""
    low, high = _TEMPERATURES
    wrong = temperatures[~((temperatures >= low) & (temperatures <= high))]
    if wrong.size:
        raise InputError(
            f"{where} has a temperature of {wrong.flat[0]:g} C, which is not between {low:g} and {high:g}; give "
            "degrees Celsius."
        )

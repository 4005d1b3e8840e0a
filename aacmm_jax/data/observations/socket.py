"""A socket: the tip is at one point, whose position is unknown."""

import copy
import dataclasses
from collections.abc import Hashable, Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers
from ...core.numpy_or_jax import AnyArray, namespace
from .columns import each_pose, no_covariance
from .frames import moved
from .observation import (
    POINT,
    READINGS,
    TARGET,
    AbstractObservation,
    AbstractSimulated,
    Entry,
    Rows,
    Tips,
    Unknowns,
    checked_name,
    checked_readings,
    checked_target,
    numbers,
)


class Socket(AbstractObservation):
    """Poses with the tip at one point. The sockets of a `Capture` are the same, with their positions eliminated.

    Args:
        name: Name of the socket.
        q: Joint readings ``(m, n)``, rad.
        target: Name of the tip, by default the arm's own probe.

    Raises:
        InputError: Readings are not finite, or not ``(m, n)``.

    Example:
        >>> hole = aj.data.observations.Socket("hole", capture.sockets["A"])
        >>> print(hole.q.shape, [*hole.unknowns])
        (40, 6) ['position of hole']
    """

    kind: ClassVar[str] = "socket"
    table: ClassVar[str] = "socket"
    entries: ClassVar[tuple[Entry, ...]] = (
        READINGS,
        TARGET,
    )
    rows: ClassVar[int] = 3
    q: Float[AnyArray, "m n"]
    name: str = eqx.field(static=True)
    target: str = eqx.field(static=True)

    def __init__(self, name: str, q: Numbers, *, target: str = ""):
        self.name = checked_name(name, "a socket")
        self.q = checked_readings(f"socket '{name}'", q)
        self.target = checked_target(target)

    @property
    def position(self) -> str:
        """Name of the unknown position."""
        return position_of(self.name)

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return {self.position: POINT}

    @property
    def linear(self) -> bool:
        return True

    @property
    def alike(self) -> Hashable | None:
        return ()

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        return {self.position: namespace(tips).mean(tips.position, axis=1)}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        identity = each_pose(namespace(tips, unknowns).asarray(np.eye(3)), self.q.shape[0])
        return Rows(
            values=tips.position - unknowns[self.position],
            by_tip=identity,
            by_unknowns={self.position: -identity},
            measured=no_covariance(3, self.q.shape[0]),
        )


def sockets_of(readings: Mapping[str, Float[AnyArray, "m n"]]) -> tuple[Socket, ...]:
    """Sockets whose names and readings a capture has checked: each as a copy of the first, since equinox takes 0.1 ms
    to make and check one, and there may be thousands."""
    made: list[Socket] = []
    for name, q in readings.items():
        if not made:
            made.append(Socket(name, q))
            continue
        one = copy.copy(made[0])
        object.__setattr__(one, "name", name)
        object.__setattr__(one, "q", q)
        made.append(one)
    return tuple(made)


def position_of(socket: str) -> str:
    """Name of the unknown position of a socket."""
    return f"position of {socket}"


class SimulatedSocket(AbstractSimulated):
    """Poses with the tip in one socket.

    Args:
        name: Name of the socket.
        point: Its position in the base frame ``(3,)``, mm.
        poses: Number of poses.
        target: Name of the tip, and ``place``, its true place in the last frame ``(3,)``, mm; by default the arm's own
            probe.

    Example:
        >>> sockets_kind = aj.data.observations.SimulatedSocket
        >>> cone = sockets_kind("cone", (400, 200, 300), 10, target="tool", place=(20, 0, 80))
        >>> seated = aj.simulate(true, {}, observations=[cone]).observations[0]
        >>> print(seated.q.shape, [*seated.unknowns])
        (10, 6) ['position of cone']
    """

    table: ClassVar[str] = "socket"
    name: str = eqx.field(static=True)
    point: np.ndarray = eqx.field(converter=numbers("point", 3))
    poses: int = eqx.field(static=True)
    target: str = eqx.field(static=True, default="")
    place: tuple[float, float, float] | None = eqx.field(static=True, default=None)

    @property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        return None if self.place is None else np.asarray(self.place, dtype=float)

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> "SimulatedSocket":
        return dataclasses.replace(self, name=name, point=moved(frame, self.point))

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return np.tile(self.point, (self.poses, 1))

    def recorded(
        self, q: Float[np.ndarray, "m n"], transforms: Float[np.ndarray, "m 4 4"], random: np.random.Generator
    ) -> Socket:
        return Socket(self.name, q, target=self.target)

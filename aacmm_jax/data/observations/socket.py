"""A socket: the tip is at one point, whose position is unknown."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ...core.numpy_or_jax import AnyArray, namespace
from .declared import count, number, part
from .frames import each_pose, no_covariance
from .observation import POINT, AbstractObservation, Parts, Rows, Tips, Unknowns
from .simulated import AbstractOfTarget, Readings, Transforms


class Socket(AbstractObservation):
    """Poses with the tip at one point. The sockets of a `Capture` are the same, with their positions eliminated.

    Raises:
        InputError: Readings are not finite, or not ``(m, n)``.

    Example:
        >>> hole = aj.data.observations.Socket("hole", capture.sockets["A"])
        >>> print(hole.q.shape, [*hole.unknowns])
        (40, 6) ['position of hole']
    """

    kind, table, noun, rows, linear = "socket", "socket", "socket", 3, True
    position = part("position of {name}", *POINT)

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        return {self.position: namespace(tips).mean(tips.position, axis=1)}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        m, part = self.q.shape[0], self.position
        identity = each_pose(namespace(tips, unknowns).asarray(np.eye(3)), m)
        return Rows(tips.position - unknowns[part], identity, {part: -identity}, no_covariance(3, m))


def sockets_of(readings: Mapping[str, Float[AnyArray, "m n"]]) -> tuple[Socket, ...]:
    """Sockets whose names and readings a capture has checked: each as a copy of the first, since there may be
    thousands."""
    first = [Socket(name, q) for name, q in [*readings.items()][:1]]
    return tuple(first[0].changed(name=name, q=q) for name, q in readings.items())


def position_of(socket: str) -> str:
    """Name of the unknown position of a socket."""
    return f"position of {socket}"


class SimulatedSocket(AbstractOfTarget):
    """Poses with the tip in one socket.

    Example:
        >>> sockets_kind = aj.data.observations.SimulatedSocket
        >>> cone = sockets_kind("cone", (400, 200, 300), 10, target="tool", place=(20, 0, 80))
        >>> seated = aj.simulate(true, {}, observations=[cone]).observations[0]
        >>> print(seated.q.shape, [*seated.unknowns])
        (10, 6) ['position of cone']
    """

    table = "socket"
    point: Float[np.ndarray, "3"] = number("position in the base frame", "mm", moves="point")
    poses: int = count("number of poses")

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return np.tile(self.point, (self.poses, 1))

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Socket:
        return Socket(self.name, q, target=self.target)

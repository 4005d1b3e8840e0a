"""Contacts of a tip with a surface that another chain of a robot carries: data without any instrument.

A contact is two poses at one moment. The pose of the chain that touches is that of a socket of its own; the pose of the
chain that carries the surface is a pose of the contact, which names this socket. The position of the socket is the
unknown that both have in common, so that a contact is worth one equation. The surface is unknown, in the last frame of
the chain that carries it, about its tip; or, where the poses are those of an inner link, in the frame of this link.
"""

import abc
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import cross
from .declared import Part, declared
from .geometry import variances
from .held import position_of
from .observation import PLANE, POINT, Parts, Readings, Rows, Tips, Transforms, Unknowns
from .simulated import AbstractSimulated
from .touched import AbstractSimulatedRound, AbstractTouched, Plane, Sphere


class AbstractContact(AbstractTouched):
    """Contacts with a surface in the last frame of the chain that carries it."""

    rotates, stacks = True, False  # the unknowns have the names of its own sockets
    socket: tuple[str, ...]

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return {**super().unknowns, **{position_of(name): POINT for name in dict.fromkeys(self.socket)}}

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        return {}  # the tips that touch are those of other observations

    def start_with(self, tips: Tips, parts: Mapping[str, Any]) -> Parts:
        missing = next((name for name in self.socket if position_of(name) not in parts), None)
        if missing is not None:
            raise InputError(
                f"{self.noun} '{self.name}' names the socket '{missing}', in which no tip was; give the poses of the "
                "chain that touches the surface."
            )
        points = namespace(parts).stack([parts[position_of(name)] for name in self.socket], axis=1)
        return super().start(Tips(self._seen(tips, points), tips.axes), np.zeros(3))

    def _seen(self, tips: Tips, points: Float[AnyArray, "3 m"]) -> Float[AnyArray, "3 m"]:
        """Points in the last frame, about its tip."""
        xp = namespace(tips, points)
        return xp.stack([xp.sum(axis * (points - tips.position), axis=0) for axis in tips.axes])

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        points = namespace(unknowns).concatenate([unknowns[position_of(name)] for name in self.socket], axis=1)
        rows = super().residual(Tips(self._seen(tips, points), tips.axes), unknowns)
        # By the point, in the base frame; the tip that carries the frame moves it the other way.
        xp, (x, y, z) = namespace(tips, points), tips.axes
        by_point = x * rows.by_tip[:, 0] + y * rows.by_tip[:, 1] + z * rows.by_tip[:, 2]
        by_unknowns = dict(rows.by_unknowns)
        for name in dict.fromkeys(self.socket):
            of_name = np.array([other == name for other in self.socket])
            by_unknowns[position_of(name)] = xp.where(of_name[None], by_point, 0.0)[:, None]
        by_rotation = cross(by_point, points - tips.position)
        form = variances(self.form, points.shape[1])
        return Rows(rows.values, -by_point[None], by_unknowns, form, by_rotation[None])

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        needed = sum(len(units) for name, units in self.unknowns.items() if not name.startswith(position_of("")))
        if tips.shape[1] < needed:
            raise InputError(
                f"{self.noun} '{self.name}' has {tips.shape[1]} contacts, but there are {needed} unknowns; record more."
            )

    def in_session(self, session: str, probe: str) -> Any:
        other = super().in_session(session, probe)
        return other.changed(socket=tuple(f"{session}/{name}" for name in self.socket))


class SphereContact(AbstractContact, Sphere):
    """Contacts of a tip with a sphere that another chain of a robot carries.

    Raises:
        InputError: Shapes do not fit, or a diameter or uncertainty is negative.

    Example:
        >>> contacts = aj.data.observations.SphereContact("ball", capture.q[:2], ("1", "2"), diameter=25.0, stylus=6.0)
        >>> print([*contacts.unknowns])
        ['centre of ball', 'position of 1', 'position of 2']
    """

    kind, table, noun = "sphere contact", "contact_sphere", "sphere contact"
    socket: tuple[str, ...] = declared("socket whose pose of another chain touched the surface", "", "pose")
    geometry = Part("centre of {name}", *POINT)
    size = Part("radius of {name}", "mm", when="free")


class PlaneContact(AbstractContact, Plane):
    """Contacts of a tip with a plane that another chain of a robot carries.

    Raises:
        InputError: Readings are not finite, or ``form`` is negative.

    Example:
        >>> contacts = aj.data.observations.PlaneContact("plate", capture.q[:2], ("1", "2"), form=0.002)
        >>> print([*contacts.unknowns])
        ['plane plate', 'position of 1', 'position of 2']
    """

    kind, table, noun = "plane contact", "contact_plane", "plane contact"
    socket: tuple[str, ...] = declared("socket whose pose of another chain touched the surface", "", "pose")
    geometry = Part("plane {name}", *PLANE)


class AbstractSimulatedContact(AbstractSimulated):
    """Contacts while the tip that carries the surface, or the origin of the link, is anywhere in a box."""

    region: Float[np.ndarray, "2 3"]
    poses: int
    touching: str
    carrying: str
    link: int | None = declared(
        "link that carries it, the number of the joint of the chain before it", default=None, more="None: the last one"
    )

    def completed(self, where: str) -> Mapping[str, Any]:
        if self.touching == self.carrying:
            raise InputError(f"{where} touches and carries with the chain '{self.carrying}'; name two chains.")
        return super().completed(where)

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return random.uniform(*np.sort(self.region, axis=0), size=(self.poses, 3))

    @abc.abstractmethod
    def surface_points(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        """Where the centre of the tip's ball touches ``(m, 3)``, mm, in the frame that carries the surface, about its
        tip."""

    @property
    def sockets(self) -> tuple[str, ...]:
        """Names of the sockets with the poses that touch."""
        return tuple(f"{self.name}/{i + 1}" for i in range(self.poses))

    def touched(self, transforms: Transforms, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        """Where the other tip is, in the base frame, by the true transforms of the tip that carries the surface."""
        points = self.surface_points(random)
        return np.einsum("mij,mj->mi", transforms[:, :3, :3], points) + transforms[:, :3, 3]


class SimulatedSphereContact(AbstractSimulatedContact, AbstractSimulatedRound):
    """Contacts with a sphere, or with a cap of it, while the tip that carries it is anywhere in a box.

    Example:
        >>> box = [[200, -100, 200], [300, 100, 400]]
        >>> ball = aj.data.observations.SimulatedSphereContact("ball", box, (0, 0, 50), 25.0, 12, "left", "right")
        >>> print(ball.sockets[0])
        ball/1
    """

    table = "contact_sphere"
    region: Float[np.ndarray, "2 3"] = declared(
        "box of the tip that carries the sphere, or of the link's origin, in the base frame", "mm"
    )
    centre: Float[np.ndarray, "3"] = declared("centre in the frame that carries it, about its tip", "mm")
    diameter: float = declared("true diameter", "mm")
    poses: int = declared("number of contacts")
    touching: str = declared("chain whose tip touches")
    carrying: str = declared("chain that carries the sphere")

    def surface_points(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        directions = random.normal(size=(self.poses, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return self.centre + (self.diameter + self.stylus) / 2 * directions

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> SphereContact:
        return SphereContact(self.name, q, self.sockets, **self.certificate(random))


class SimulatedPlaneContact(AbstractSimulatedContact):
    """Contacts at random places of a rectangle, while the tip that carries it is anywhere in a box.

    Example:
        >>> box, sides = [[200, -100, 200], [300, 100, 400]], [[80, 0, 0], [0, 80, 0]]
        >>> plate = aj.data.observations.SimulatedPlaneContact("plate", box, (0, 0, 50), sides, 12, "left", "right")
        >>> print(plate.sockets[-1])
        plate/12
    """

    table = "contact_plane"
    region: Float[np.ndarray, "2 3"] = declared(
        "box of the tip that carries the plane, or of the link's origin, in the base frame", "mm"
    )
    corner: Float[np.ndarray, "3"] = declared("corner of the rectangle in the frame that carries it", "mm")
    sides: Float[np.ndarray, "2 3"] = declared("two sides of the rectangle as vectors", "mm")
    poses: int = declared("number of contacts")
    touching: str = declared("chain whose tip touches")
    carrying: str = declared("chain that carries the plane")

    def surface_points(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return self.corner + random.uniform(size=(self.poses, 2)) @ self.sides

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> PlaneContact:
        return PlaneContact(self.name, q, self.sockets)

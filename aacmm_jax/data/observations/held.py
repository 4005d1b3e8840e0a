"""The tip held in points: sockets, and artefacts of certified points, such as ball bars and plates."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers
from ...core.errors import InputError, nearest
from ...core.linear_algebra import products_by_column
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import fitted_frame, rotation_matrix
from .declared import NAME, Part, checked_readings, declared, is_exact
from .geometry import each_pose, placed, rows_of_points
from .observation import (
    FRAME,
    POINT,
    AbstractObservation,
    Certified,
    Parts,
    Quantity,
    Readings,
    Rows,
    Tips,
    Transforms,
    Unknowns,
)
from .simulated import AbstractOfTarget, AbstractSimulated


class Socket(AbstractObservation):
    """Poses with the tip at one point. The sockets of a `Capture` are the same, with their positions eliminated.

    Raises:
        InputError: Readings are not finite, or not ``(m, n)``.

    Example:
        >>> hole = aj.data.observations.Socket("hole", capture.sockets["A"])
        >>> print(hole.q.shape, [*hole.unknowns])
        (40, 6) ['position of hole']
    """

    kind, table, noun, row_units, linear = "socket", "socket", "socket", POINT, True
    position = Part("position of {name}", *POINT)

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        return {self.position: namespace(tips).mean(tips.position, axis=1)}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        position = unknowns[self.position]
        identity = each_pose(namespace(tips, position).asarray(np.eye(3)), self.q.shape[0])
        return rows_of_points(tips, position, {self.position: identity})


def sockets_of(readings: Mapping[str, Float[AnyArray, "m n"]]) -> tuple[Socket, ...]:
    """Sockets whose names and readings a capture has checked: each as a copy of the first, since there may be
    thousands."""
    first = [Socket(name, q) for name, q in [*readings.items()][:1]]
    return tuple(first[0].changed(name=name, q=q) for name, q in readings.items())


def position_of(socket: str) -> str:
    """Name of the unknown position of a socket."""
    return f"position of {socket}"


class Artefact(AbstractObservation):
    """Poses with the tip in the points of an artefact, whose coordinates are certified and whose placement is unknown.

    Sockets of a plant whose coordinates another machine has measured are one with a single placement, which says where
    the base of the arm is.

    Args:
        name: Name of the observation, and of its placement where that has none.
        points: Name of a point -> its certified coordinates ``(3,)``, mm, in the artefact's frame.
        q: Name of a point -> joint readings in it ``(m, n)``, rad.

    Raises:
        InputError: A point with poses has no coordinates, or shapes do not fit.

    Example:
        >>> holes = {"1": (0, 0, 0), "2": (300, 0, 0), "3": (300, 300, 0)}
        >>> poses = dict(zip(holes, capture.q[:12].reshape(3, 4, 6)))
        >>> plate = aj.data.observations.Artefact("plate", holes, poses, u=0.002)
        >>> print(plate.q.shape, [*plate.unknowns])
        (12, 6) ['placement plate', 'coordinates of plate']
    """

    kind, table, noun, row_units = "artefact", "artefact", "artefact", POINT
    point: tuple[str, ...] = declared("point of the artefact in which the tip was seated", "", "pose")
    names: tuple[str, ...] = declared("point of the artefact", "", "names")
    coordinates: Float[AnyArray, "c 3"] = declared("certified coordinates", "mm", "names", "axis", uncertainty="u")
    u: Float[AnyArray, ""] = declared(
        "standard uncertainty of a coordinate",
        "mm",
        default=0.0,
        more="the error of a coordinate is the same in every placement",
    )
    artefact: str = declared(
        "name of the artefact",
        default=NAME,
        more="all observations of the same artefact have the same errors of the coordinates",
    )
    placement: str = declared(
        "name of the placement of the artefact",
        default=NAME,
        of_session=True,
        more="all observations of the same placement have the same frame",
    )
    index: str | None = declared(
        "index of the platform that carries the artefact", default=None, of_session=True,
        more="the placement is then relative to the platform, and the platform has one frame per index",
    )  # fmt: skip
    derived = ("free",)  # whether the coordinates are unknowns with certified values
    frame = Part("placement {placement}", *FRAME)
    platform = Part("index {index}", *FRAME, when="index")
    shape = Part("coordinates of {artefact}", *POINT, when="free", repeated="coordinates")
    stacks = False  # it has points of its own
    free: bool

    def __init__(self, name: str, points: Mapping[str, Numbers], q: Mapping[str, Numbers], **options: Any):
        where = f"artefact '{name}'"
        if not isinstance(points, Mapping) or not isinstance(q, Mapping) or not points or not q:
            raise InputError(
                f"{where} needs two dictionaries: the coordinates of its points, and the readings at these points."
            )
        blocks = {point: checked_readings(f"{where} point '{point}'", readings) for point, readings in q.items()}
        widths = {block.shape[1] for block in blocks.values()}
        if len(widths) > 1:
            raise InputError(
                f"{where} has readings with {' and '.join(map(str, sorted(widths)))} columns; give one column per "
                "joint."
            )
        readings = namespace(*blocks.values()).concatenate(list(blocks.values()))
        held = [point for point, block in blocks.items() for _ in range(block.shape[0])]
        super().__init__(name, readings, held, list(points), list(points.values()), **options)

    def completed(self, where: str) -> Mapping[str, Any]:
        if len(self.names) != len(self.coordinates):
            raise InputError(
                f"{where} has {len(self.names)} names for {len(self.coordinates)} points; give one name per point."
            )
        for point in dict.fromkeys(self.point):
            if point not in self.names:
                raise InputError(
                    f"{where} has poses in the point '{point}', which has no coordinates{nearest(point, self.names)}"
                )
        return {"free": not is_exact(self.u)}

    @property
    def owner(self) -> np.ndarray:
        """Index of the point of each pose, ``(m,)``."""
        return np.array([self.names.index(point) for point in self.point])

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if part != self.shape:
            return super().quantities(part, values)
        rows = zip(self.names, values.reshape(-1, 3), strict=True)
        return tuple(Quantity(f"coordinates of {name}", row, "mm") for name, row in rows)

    @property
    def fixes_scale(self) -> bool:
        return len(set(self.point)) > 1

    @property
    def certified(self) -> Certified:
        if not self.free:
            return {}
        values = self.coordinates.reshape(-1)
        return {self.shape: (values, namespace(values, self.u).broadcast_to(self.u, values.shape))}

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        # Where the platform's frames are unknown too, the placement carries all of it: `platform_frames` says more, by
        # all observations together.
        parts: Parts = {self.frame: fitted_frame(_coordinates(self), tips.position)}
        if self.index is not None:
            parts[self.platform] = namespace(tips, self.coordinates).zeros(6)
        if self.free:
            parts[self.shape] = self.coordinates.reshape(-1)
        return parts

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, owner, m = namespace(tips, unknowns, self.coordinates), self.owner, self.q.shape[0]
        coordinates = unknowns[self.shape] if self.free else self.coordinates.reshape(-1, 1)
        p = coordinates.shape[1]
        held = coordinates.reshape(-1, 3, p)[owner, :, np.arange(m) if p > 1 else 0].T
        # t - (R x + o) with the placement's R and o. On a platform, t - (R_i (R x + o) + o_i), so that derivatives by
        # the placement are turned by R_i, and those by the coordinates x are -R_i R.
        points, by_frame, rotation = placed(unknowns[self.frame], held)
        by_unknowns = {}
        if self.index is not None:
            points, by_unknowns[self.platform], outer = placed(unknowns[self.platform], points)
            by_frame = products_by_column(outer, by_frame.swapaxes(0, 1)).swapaxes(0, 1)
            rotation = products_by_column(outer, rotation)
        by_unknowns[self.frame] = by_frame
        if self.free:
            chosen = xp.asarray(np.eye(len(self.names))[:, owner])
            by_point = chosen[:, None, None, :] * rotation.swapaxes(0, 1)[None]
            by_unknowns[self.shape] = by_point.reshape(-1, 3, m)
        return rows_of_points(tips, points, by_unknowns)


Frame = Float[AnyArray, " 6"]
Held = list[tuple[Artefact, Float[AnyArray, "3 m"]]]  # an artefact of each observation, and the tips in its points


def platform_frames(observations: Sequence[AbstractObservation], tips: Sequence[Tips]) -> dict[str, Frame]:
    """Frames of the platform at each index, and of all placements, from nearly right tips; none without a platform.

    An index follows from the points of all placements that are already known on the platform together, since those of
    one bar leave a turn about its line open; placements that are new at this index then follow from it. Of indices that
    no known placement reaches, the first has the frame zero, since nothing measured says what the platform's own is.
    """
    # By the name of the platform's frame. What does not stand on it, "", comes first: its frame is that of the base.
    waiting: dict[str, Held] = {"": []}
    for observation, tip in zip(observations, tips, strict=True):
        if isinstance(observation, Artefact):
            name = "" if observation.index is None else observation.platform
            waiting.setdefault(name, []).append((observation, tip.position))
    if len(waiting) == 1:
        return {}
    placements: dict[str, Frame] = {}
    indices: dict[str, Frame] = {}

    def poses(name: str) -> int:
        return sum(artefact.q.shape[0] for artefact, _ in waiting[name] if artefact.frame in placements)

    while waiting:
        name = "" if "" in waiting else max(waiting, key=poses)
        held = waiting.pop(name)
        before = [(artefact, position) for artefact, position in held if artefact.frame in placements]
        index = np.zeros(6)
        if before:
            points = [placed(placements[artefact.frame], _coordinates(artefact))[0] for artefact, _ in before]
            index = _fitted(points, [position for _, position in before])
        indices[name] = index
        rotation = rotation_matrix(index[:3])
        for frame in dict.fromkeys(artefact.frame for artefact, _ in held if artefact.frame not in placements):
            same = [(artefact, position) for artefact, position in held if artefact.frame == frame]
            on_platform = [rotation.T @ (position - index[3:, None]) for _, position in same]
            placements[frame] = _fitted([_coordinates(artefact) for artefact, _ in same], on_platform)
    del indices[""]
    return placements | indices


def _fitted(points: Sequence[Float[AnyArray, "3 _"]], targets: Sequence[Float[AnyArray, "3 _"]]) -> Frame:
    xp = namespace(points, targets)
    return fitted_frame(xp.concatenate(points, axis=1), xp.concatenate(targets, axis=1))


def _coordinates(artefact: Artefact) -> Float[AnyArray, "3 m"]:
    return artefact.coordinates[artefact.owner].T


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
    point: Float[np.ndarray, "3"] = declared("position in the base frame", "mm", moves="point")
    poses: int = declared("number of poses")

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return np.tile(self.point, (self.poses, 1))

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Socket:
        return Socket(self.name, q, target=self.target)


class SimulatedArtefact(AbstractSimulated):
    """Poses in every point of an artefact.

    Example:
        >>> bar = {"near": (0, 0, 0), "far": (300, 0, 0)}
        >>> frame = (0, 0, 0.7, 300, -200, 300)
        >>> placed = aj.data.observations.SimulatedArtefact("bar", bar, 5, frame, u=0.0005)
        >>> print(aj.simulate(true, {}, observations=[placed]).observations[0].q.shape)
        (10, 6)
    """

    table = "artefact"
    points: dict[str, Float[np.ndarray, "3"]] = declared("true coordinates of each point", "mm")
    poses: int = declared("number of poses")
    frame: Float[np.ndarray, "6"] = declared(
        "frame of the artefact in the base frame: rotation vector (rad) and origin (mm)",
        default=(0.0,) * 6,
        moves="frame",
    )
    errors: Float[np.ndarray, "c 3"] | None = declared(
        "errors of the certified coordinates", "mm", default=None, more="every placement has the same errors"
    )
    u: float = declared("standard uncertainty of the certified coordinates", "mm", default=0.0)
    artefact: str = declared("name of the artefact", default=NAME)
    placement: str | None = declared("name of the placement", default=None)
    index: str | None = declared("index of the platform that carries the artefact", default=None)

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        coordinates = np.repeat(np.array(list(self.points.values())), self.poses, axis=0)
        return coordinates @ rotation_matrix(self.frame[:3]).T + self.frame[3:]

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Artefact:
        certified = np.array(list(self.points.values())) + (0.0 if self.errors is None else self.errors)
        blocks = q.reshape(len(self.points), self.poses, -1)
        names = dict(artefact=self.artefact, placement=self.placement, index=self.index)
        points, held = (dict(zip(self.points, rows, strict=True)) for rows in (certified, blocks))
        return Artefact(self.name, points, held, u=self.u, **names)

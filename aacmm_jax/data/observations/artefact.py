"""Artefacts of certified points: ball bars, plates of balls or holes, tetrahedra; in each of their placements."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers
from ...core.errors import InputError, nearest
from ...core.linear_algebra import products_by_column
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import fitted_frame, rotation_matrix, rotation_vector
from .columns import each_pose, no_covariance
from .frames import moved, placed
from .observation import (
    FRAME,
    READINGS,
    TARGET,
    AbstractObservation,
    AbstractSimulated,
    Entry,
    Quantity,
    Rows,
    Tips,
    Unknowns,
    checked_name,
    checked_readings,
    checked_scalar,
    checked_target,
    checked_values,
    is_exact,
    numbers,
)


class Artefact(AbstractObservation):
    """Poses with the tip in the points of an artefact, whose coordinates are certified and whose placement is unknown.

    Sockets of a plant whose coordinates another machine has measured are one with a single placement, which says where
    the base of the arm is.

    Args:
        name: Name of the observation, and of its placement where that has none.
        points: Name of a point -> its certified coordinates ``(3,)``, mm, in the artefact's frame.
        q: Name of a point -> joint readings in it ``(m, n)``, rad.
        u: Standard uncertainty (k = 1) of each coordinate, mm. Its error is the same in every placement.
        artefact: Name of the artefact; observations of one artefact share the errors of its coordinates.
        placement: Name of the placement; observations of one placement share its frame.
        index: Name of the index of an indexed platform that carries the artefact. The placement is then one on the
            platform, and the platform has a frame for each index, shared by all that stands on it.
        target: Name of the tip, by default the arm's own probe.

    Raises:
        InputError: A point with poses has no coordinates, or shapes do not fit.

    Example:
        >>> holes = {"1": (0, 0, 0), "2": (300, 0, 0), "3": (300, 300, 0)}
        >>> poses = dict(zip(holes, capture.q[:12].reshape(3, 4, 6)))
        >>> plate = aj.data.observations.Artefact("plate", holes, poses, u=0.002)
        >>> print(plate.q.shape, [*plate.unknowns])
        (12, 6) ['placement plate', 'coordinates of plate']
    """

    kind: ClassVar[str] = "artefact"
    by_pose: ClassVar[tuple[str, ...]] = ("q", "owner")
    table: ClassVar[str] = "artefact"
    entries: ClassVar[tuple[Entry, ...]] = (
        READINGS,
        Entry("point", "point of the artefact that held the tip", dimensions=("pose",), content="text", required=True),
        Entry("names", "point of the artefact", dimensions=("names",), content="text", required=True),
        Entry("coordinates", "certified coordinates", "mm", ("names", "axis"), required=True, uncertainty="u"),
        Entry("u", "standard uncertainty of a coordinate", "mm"),
        Entry("artefact", "name of the artefact", content="text"),
        Entry("placement", "name of its placement", content="text"),
        Entry("index", "index of the platform that carries it", content="text"),
        TARGET,
    )
    rows: ClassVar[int] = 3
    q: Float[AnyArray, "m n"]
    coordinates: Float[AnyArray, "c 3"]
    u: Float[AnyArray, ""]
    name: str = eqx.field(static=True)
    artefact: str = eqx.field(static=True)
    placement: str = eqx.field(static=True)
    index: str | None = eqx.field(static=True)
    target: str = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)  # of the points, all of the artefact
    owner: tuple[int, ...] = eqx.field(static=True)  # point of each pose
    free: bool = eqx.field(static=True)  # whether the coordinates are unknowns with certified values

    def __init__(
        self,
        name: str,
        points: Mapping[str, Numbers],
        q: Mapping[str, Numbers],
        *,
        u: Numbers = 0.0,
        artefact: str | None = None,
        placement: str | None = None,
        index: str | None = None,
        target: str = "",
    ):
        self.name = checked_name(name, "an artefact")
        where = f"artefact '{name}'"
        if not isinstance(points, Mapping) or not isinstance(q, Mapping) or not points or not q:
            raise InputError(f"{where} needs two dictionaries: its points' coordinates, and the readings in them.")
        for point in q:
            if point not in points:
                raise InputError(f"{where} has poses in '{point}', which has no coordinates{nearest(point, points)}")
        blocks = {point: checked_readings(f"{where} point '{point}'", readings) for point, readings in q.items()}
        widths = {block.shape[1] for block in blocks.values()}
        if len(widths) > 1:
            raise InputError(f"{where} has readings of {sorted(widths)} columns; give one column a joint.")
        self.names = tuple(points)
        rows = [checked_values(f"{where} point '{point}'", value, (3,)) for point, value in points.items()]
        self.coordinates = namespace(*rows).stack(rows)
        self.q = namespace(*blocks.values()).concatenate(list(blocks.values()))
        self.owner = tuple(self.names.index(point) for point, block in blocks.items() for _ in range(block.shape[0]))
        self.u = checked_scalar(f"u of {where}", u)
        self.artefact = checked_name(name if artefact is None else artefact, "an artefact")
        self.placement = checked_name(name if placement is None else placement, "a placement")
        self.index = None if index is None else checked_name(index, "an index")
        self.target = checked_target(target)
        self.free = not is_exact(self.u)

    def stored(self) -> dict[str, Any]:
        point = np.array([self.names[i] for i in self.owner])
        return super().stored() | {"point": point, "names": np.array(self.names)}

    @classmethod
    def rebuilt(cls, name: str, stored: Mapping[str, Any]) -> "Artefact":
        held = np.asarray(stored["point"])
        points = dict(zip(np.asarray(stored["names"]).tolist(), stored["coordinates"], strict=True))
        q = {point: stored["q"][held == point] for point in dict.fromkeys(held.tolist())}
        rest = {key: value for key, value in stored.items() if key not in ("q", "point", "names", "coordinates")}
        return cls(name, points, q, **rest)

    @property
    def frame(self) -> str:
        """Name of the frame of its placement."""
        return f"placement {self.placement}"

    @property
    def platform(self) -> str:
        """Name of the platform's frame at this index."""
        return f"index {self.index}"

    @property
    def shape(self) -> str:
        """Name of the coordinates, where they are unknowns with certified values."""
        return f"coordinates of {self.artefact}"

    @property
    def labels(self) -> tuple[str, ...]:
        return ("name", "placement", "index")

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        found = {self.frame: FRAME}
        if self.index is not None:
            found[self.platform] = FRAME
        if self.free:
            found[self.shape] = ("mm",) * self.coordinates.size
        return found

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if part != self.shape:
            return super().quantities(part, values)
        rows = zip(self.names, values.reshape(-1, 3), strict=True)
        return tuple(Quantity(f"coordinates of {name}", row, "mm") for name, row in rows)

    @property
    def fixes_scale(self) -> bool:
        return len(set(self.owner)) > 1

    @property
    def certified(self) -> dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]:
        if not self.free:
            return {}
        values = self.coordinates.reshape(-1)
        return {self.shape: (values, namespace(values, self.u).broadcast_to(self.u, values.shape))}

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        xp = namespace(tips, self.coordinates)
        frame = fitted_frame(self.coordinates[np.array(self.owner)].T, tips.position)
        # Where the platform's frames are unknown too, the placement carries all of it: `platform_frames` says more, by
        # all observations together.
        found = {self.frame: frame}
        if self.index is not None:
            found[self.platform] = xp.zeros(6)
        if self.free:
            found[self.shape] = self.coordinates.reshape(-1)
        return found

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, owner, m = namespace(tips, unknowns, self.coordinates), np.array(self.owner), self.q.shape[0]
        coordinates = self.coordinates.reshape(-1, 1)
        if self.free:
            coordinates = unknowns[self.shape]
        p = coordinates.shape[1]
        held = coordinates.reshape(-1, 3, p)[owner, :, np.arange(m) if p > 1 else 0].T
        points, by_frame, rotation = placed(unknowns[self.frame], held)
        by_unknowns = {}
        if self.index is not None:
            points, by_platform, outer = placed(unknowns[self.platform], points)
            by_frame = products_by_column(outer, by_frame.swapaxes(0, 1)).swapaxes(0, 1)
            rotation = products_by_column(outer, rotation)
            by_unknowns[self.platform] = -by_platform
        by_unknowns[self.frame] = -by_frame
        if self.free:
            chosen = xp.asarray((owner[None, :] == np.arange(len(self.names))[:, None]).astype(float))
            each = -chosen[:, None, None, :] * rotation.swapaxes(0, 1)[None]
            by_unknowns[self.shape] = each.reshape(-1, 3, m)
        return Rows(
            values=tips.position - points,
            by_tip=each_pose(xp.asarray(np.eye(3)), m),
            by_unknowns=by_unknowns,
            measured=no_covariance(3, m),
        )


class SimulatedArtefact(AbstractSimulated):
    """Poses in every point of an artefact.

    Args:
        name: Name of the observation.
        points: Name of a point -> its true coordinates in the artefact's frame ``(3,)``, mm.
        poses: Number of poses in each point.
        frame: The artefact's frame in the base frame: rotation vector (rad) and origin (mm), ``(6,)``.
        errors: Errors of the certified coordinates ``(c, 3)``, mm, which all placements share.
        u: Their standard uncertainty, mm.
        artefact: Name of the artefact, by default that of the observation.
        placement: Name of the placement, likewise.
        index: Name of the index of a platform.

    Example:
        >>> bar = {"near": (0, 0, 0), "far": (300, 0, 0)}
        >>> frame = (0, 0, 0.7, 300, -200, 300)
        >>> placed = aj.data.observations.SimulatedArtefact("bar", bar, 5, frame, u=0.0005)
        >>> print(aj.simulate(true, {}, observations=[placed]).observations[0].q.shape)
        (10, 6)
    """

    table: ClassVar[str] = "artefact"
    name: str = eqx.field(static=True)
    points: dict[str, tuple[float, float, float]] = eqx.field(static=True)
    poses: int = eqx.field(static=True)
    frame: np.ndarray = eqx.field(converter=numbers("frame", 6), default=(0.0,) * 6)
    errors: np.ndarray | None = None
    u: float = 0.0
    artefact: str | None = eqx.field(static=True, default=None)
    placement: str | None = eqx.field(static=True, default=None)
    index: str | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if not isinstance(self.points, Mapping) or not self.points:
            raise InputError(f"points of '{self.name}' are no dictionary; give each point's name and coordinates.")
        for point, coordinates in self.points.items():
            numbers(f"point '{checked_name(point, 'a point')}'", 3)(coordinates)
        if self.errors is not None:
            numbers("errors of the coordinates", len(self.points), 3)(self.errors)

    @property
    def orientation(self) -> Float[np.ndarray, "3 3"]:
        return np.asarray(rotation_matrix(self.frame[:3]))

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> "SimulatedArtefact":
        turned = rotation_matrix(frame[:3]) @ rotation_matrix(self.frame[:3])
        whole = np.concatenate([rotation_vector(turned), moved(frame, self.frame[3:])])
        return dataclasses.replace(self, name=name, artefact=self.artefact or self.name, frame=whole)

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        coordinates = np.repeat(np.array(list(self.points.values())), self.poses, axis=0)
        return coordinates @ rotation_matrix(self.frame[:3]).T + self.frame[3:]

    def recorded(
        self, q: Float[np.ndarray, "m n"], transforms: Float[np.ndarray, "m 4 4"], random: np.random.Generator
    ) -> Artefact:
        certified = np.array(list(self.points.values())) + (0.0 if self.errors is None else self.errors)
        blocks = q.reshape(len(self.points), self.poses, -1)
        return Artefact(
            self.name,
            dict(zip(self.points, certified, strict=True)),
            dict(zip(self.points, blocks, strict=True)),
            u=self.u,
            artefact=self.artefact,
            placement=self.placement,
            index=self.index,
        )

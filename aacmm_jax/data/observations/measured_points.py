"""Points of the tip as an instrument saw them: a laser tracker, a coordinate measuring machine, a camera."""

import abc
from collections.abc import Hashable, Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers
from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import fitted_frame
from .columns import each_pose
from .frames import frame_and_offset, placed, seen_from, turned_covariances
from .observation import (
    FRAME,
    READINGS,
    TARGET,
    AbstractObservation,
    AbstractSimulated,
    Entry,
    Rows,
    Tips,
    Unknowns,
    checked_covariances,
    checked_name,
    checked_readings,
    checked_target,
    checked_values,
    numbers,
    offset_of,
)

MEASURED = (
    READINGS,
    Entry("points", "measured point", "mm", ("pose", "axis"), required=True),
    Entry("u", "standard uncertainty of a coordinate", "mm", ("pose", "axis")),
    Entry("covariance", "covariance of a point", "mm^2", ("pose", "axis", "axis_2")),
    Entry("station", "station of the instrument", content="text"),
    TARGET,
)
_FLAT = 1e-6  # second singular value of points on a line, of the first
_SAME = 1e-9  # mm


class AbstractMeasured(AbstractObservation):
    """What an instrument measured in a frame of its own, which all observations of one station share."""

    points: eqx.AbstractVar[Float[AnyArray, "m 3"]]
    station: eqx.AbstractVar[str]

    @property
    def frame(self) -> str:
        """Name of the unknown frame of the station."""
        return f"frame of {self.station}"

    @property
    def labels(self) -> tuple[str, ...]:
        return ("name", "station")

    @property
    def fixes_scale(self) -> bool:
        return True

    @property
    def alike(self) -> Hashable | None:
        return ()

    @abc.abstractmethod
    def without_errors(self, tips: Tips, unknowns: Mapping[str, Float[AnyArray, " k"]]) -> "AbstractMeasured":
        """The same observation, had the instrument measured exactly these tips."""

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        check_spread(f"observation '{self.name}'", np.asarray(self.points).T)


class MeasuredPoints(AbstractMeasured):
    """Points of the tip, measured by an instrument in a frame of its own, which is unknown.

    Args:
        name: Name of the observation, and of its station where that has none.
        q: Joint readings ``(m, n)``, rad.
        points: Measured points ``(m, 3)``, mm, in the instrument's frame.
        u: Standard uncertainty (k = 1) of the points, mm: one number, one a coordinate, or one each ``(m, 3)``.
        covariance: Instead of ``u``, the covariance of all points ``(3, 3)``, or of each ``(m, 3, 3)``, mm^2.
        station: Name of the instrument's station; observations of one station share its frame.
        target: Name of the tip that was seen, such as a reflector on the flange, whose place in the last frame is then
            unknown; by default the arm's own probe.

    Raises:
        InputError: Shapes do not fit, a value is not finite, or a covariance is not positive.

    Example:
        >>> seen = true.position(capture.q) + np.array([1000.0, 2000.0, -300.0])
        >>> tracker = aj.data.observations.MeasuredPoints("tracker", capture.q, seen, u=0.02)
        >>> print(tracker.points.shape, [*tracker.unknowns])
        (50, 3) ['frame of tracker']
    """

    kind: ClassVar[str] = "points"
    by_pose: ClassVar[tuple[str, ...]] = ("q", "points", "covariance")
    table: ClassVar[str] = "points"
    entries: ClassVar[tuple[Entry, ...]] = MEASURED
    rows: ClassVar[int] = 3
    q: Float[AnyArray, "m n"]
    points: Float[AnyArray, "m 3"]
    covariance: Float[AnyArray, "m 3 3"]
    name: str = eqx.field(static=True)
    station: str = eqx.field(static=True)
    target: str = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        q: Numbers,
        points: Numbers,
        *,
        u: Numbers | None = None,
        covariance: Numbers | None = None,
        station: str | None = None,
        target: str = "",
    ):
        self.name = checked_name(name, "an observation")
        where = f"observation '{name}'"
        self.q = checked_readings(where, q)
        poses = self.q.shape[0]
        self.points = checked_values(f"points of {where}", points, (poses, 3))
        self.covariance = checked_covariances(where, u, covariance, poses)
        self.station = checked_name(name if station is None else station, "a station")
        self.target = checked_target(target)

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return {self.frame: FRAME}

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        if not self.target:
            return {self.frame: fitted_frame(self.points.T, tips.position)}
        frame, found = frame_and_offset(self.points.T, tips, offset)
        return {self.frame: frame, offset_of(self.target): found}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp = namespace(tips, unknowns, self.points)
        seen = placed(unknowns[self.frame], self.points.T)
        return Rows(
            values=tips.position - seen.points,
            by_tip=each_pose(xp.asarray(np.eye(3)), self.q.shape[0]),
            by_unknowns={self.frame: -seen.by_frame},
            measured=turned_covariances(seen.rotation, self.covariance),
        )

    def without_errors(self, tips: Tips, unknowns: Mapping[str, Float[AnyArray, " k"]]) -> "MeasuredPoints":
        return eqx.tree_at(lambda o: o.points, self, seen_from(unknowns[self.frame], tips.position.T))


def check_spread(where: str, points: Float[np.ndarray, "3 m"]) -> None:
    """Raise `InputError` for points on a line, which leave a rotation about it open."""
    if points.shape[1] < 3:
        raise InputError(f"{where} has {points.shape[1]} points, but its frame needs three at least; measure more.")
    sizes = np.linalg.svd(points - points.mean(axis=1, keepdims=True), compute_uv=False)
    if sizes[0] < _SAME:  # one point, such as a socket, whose frame's rotation is of no consequence
        return
    if sizes[1] <= _FLAT * sizes[0]:
        raise InputError(
            f"the points of {where} are on one line, about which its frame can turn; measure points beside the line."
        )


class SimulatedPoints(AbstractSimulated):
    """Points that an instrument measures at random places in a box.

    Args:
        name: Name of the observation.
        box: Lowest and highest coordinates of the tip ``(2, 3)`` in the base frame, mm.
        poses: Number of points.
        frame: The instrument's frame in the base frame: rotation vector (rad) and origin (mm), ``(6,)``.
        u: Standard uncertainty of each coordinate, mm.
        target: Name of the target; by default the arm's probe.
        place: The target's true place in the last frame ``(3,)``, mm.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> tracker = aj.data.observations.SimulatedPoints("tracker", box, 50, (0, 0, 1.0, 2000, 0, 0), u=0.02)
        >>> seen = aj.simulate(true, {}, observations=[tracker]).observations[0]
        >>> print(seen.points.shape, [*seen.unknowns])
        (50, 3) ['frame of tracker']
    """

    table: ClassVar[str] = "points"
    name: str = eqx.field(static=True)
    box: np.ndarray = eqx.field(converter=numbers("box", 2, 3))
    poses: int = eqx.field(static=True)
    frame: np.ndarray = eqx.field(converter=numbers("frame", 6), default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    u: float = 0.0
    target: str = eqx.field(static=True, default="")
    place: tuple[float, float, float] | None = eqx.field(static=True, default=None)

    @property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        return None if self.place is None else numbers("place of the target", 3)(self.place)

    def __check_init__(self) -> None:
        if bool(self.target) != (self.offset is not None):
            raise InputError(f"'{self.name}' needs both, a target and its place in the last frame, or neither.")

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return random.uniform(self.box[0], self.box[1], (self.poses, 3))

    def recorded(
        self, q: Float[np.ndarray, "m n"], transforms: Float[np.ndarray, "m 4 4"], random: np.random.Generator
    ) -> MeasuredPoints:
        points = seen_from(self.frame, transforms[:, :3, 3]) + self.u * random.normal(size=(len(q), 3))
        return MeasuredPoints(self.name, q, points, u=self.u, target=self.target)

"""Transforms of a target on the last frame, positions and orientations, as an instrument saw them."""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers, is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import products_by_column
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import cross, rotation_and_derivative, rotation_derivative, rotation_matrix, rotation_vector
from .columns import each_pose, variances
from .frames import frame_and_offset, placed, seen_from, turned_covariances
from .measured_points import MEASURED, AbstractMeasured
from .observation import (
    FRAME,
    AbstractSimulated,
    Entry,
    Rows,
    Tips,
    Unknowns,
    checked_covariances,
    checked_name,
    checked_readings,
    checked_scalar,
    checked_values,
    numbers,
    offset_of,
)


class MeasuredTransforms(AbstractMeasured):
    """Positions and orientations of a target that is fixed to the last frame, measured by an instrument (6-D probe).

    Both frames are unknown: the instrument's in the base frame, and the target's in the last frame.

    Args:
        name: Name of the observation, and of its station where that has none.
        q: Joint readings ``(m, n)``, rad.
        points: Measured positions ``(m, 3)``, mm, in the instrument's frame.
        rotations: Measured orientations ``(m, 3, 3)``: the target's axes as columns, in the instrument's frame.
        u_angle: Standard uncertainty (k = 1) of the orientation about each axis, rad.
        u: Standard uncertainty (k = 1) of the positions, mm: one number, one a coordinate, or one each ``(m, 3)``.
        covariance: Instead of ``u``, the covariance of all positions ``(3, 3)``, or of each ``(m, 3, 3)``, mm^2.
        station: Name of the instrument's station; observations of one station share its frame.
        target: Name of the target; by default that of the observation.

    Raises:
        InputError: Shapes do not fit, a matrix is no rotation, or a covariance is not positive.

    Example:
        >>> seen = true.pose(capture.q)
        >>> probe = aj.data.observations.MeasuredTransforms(
        ...     "6-D probe", capture.q, seen[:, :3, 3], seen[:, :3, :3], u=0.02, u_angle=1e-4
        ... )
        >>> print([*probe.unknowns])
        ['frame of 6-D probe', 'orientation of 6-D probe']
    """

    kind: ClassVar[str] = "transforms"
    by_pose: ClassVar[tuple[str, ...]] = ("q", "points", "rotations", "covariance")
    table: ClassVar[str] = "transforms"
    entries: ClassVar[tuple[Entry, ...]] = (
        *MEASURED,
        Entry("rotations", "measured axes of the target, as columns", "1", ("pose", "axis", "axis_2"), required=True),
        Entry("u_angle", "standard uncertainty of an orientation about each axis", "rad", required=True),
    )
    stated: ClassVar[tuple[str, ...]] = ("u_angle",)
    rows: ClassVar[int] = 6
    rotates: ClassVar[bool] = True
    q: Float[AnyArray, "m n"]
    points: Float[AnyArray, "m 3"]
    rotations: Float[AnyArray, "m 3 3"]
    covariance: Float[AnyArray, "m 3 3"]
    u_angle: Float[AnyArray, ""]
    name: str = eqx.field(static=True)
    station: str = eqx.field(static=True)
    target: str = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        q: Numbers,
        points: Numbers,
        rotations: Numbers,
        *,
        u_angle: Numbers,
        u: Numbers | None = None,
        covariance: Numbers | None = None,
        station: str | None = None,
        target: str | None = None,
    ):
        self.name = checked_name(name, "an observation")
        where = f"observation '{name}'"
        self.q = checked_readings(where, q)
        poses = self.q.shape[0]
        self.points = checked_values(f"points of {where}", points, (poses, 3))
        self.rotations = checked_values(f"rotations of {where}", rotations, (poses, 3, 3))
        if is_concrete(self.rotations):
            known = np.asarray(self.rotations)
            proper = np.allclose(known @ known.swapaxes(-1, -2), np.eye(3), atol=1e-6)
            if not proper or np.any(np.linalg.det(known) < 0):
                raise InputError(f"{where} has a matrix that is no rotation; give right-handed unit axes as columns.")
        self.covariance = checked_covariances(where, u, covariance, poses)
        self.u_angle = checked_scalar(f"u_angle of {where}", u_angle, positive=True)
        self.station = checked_name(name if station is None else station, "a station")
        self.target = checked_name(name if target is None else target, "a target")

    @property
    def orientation(self) -> str:
        """Name of the rotation of the target in the last frame."""
        return f"orientation of {self.target}"

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return {self.frame: FRAME, self.orientation: ("rad",) * 3}

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        xp = namespace(tips, self.points)
        frame, found = frame_and_offset(self.points.T, tips, offset)
        # The first pose says how the target is turned in the last frame; the fit does the rest.
        axes = xp.stack(tips.axes, axis=1)[:, :, 0]
        turned = axes.T @ rotation_matrix(frame[:3]) @ self.rotations[0]
        return {self.frame: frame, offset_of(self.target): found, self.orientation: rotation_vector(turned)}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, m = namespace(tips, unknowns, self.points), self.q.shape[0]
        frame, orientation = unknowns[self.frame], unknowns[self.orientation]
        place = placed(frame, self.points.T)
        axes = xp.stack(tips.axes)  # (i, 3, m): the axis i
        # The target's axes j as the arm has them, and as they were seen: (j, 3, m) and (3, j, m).
        target, by_target = rotation_and_derivative(orientation)
        predicted = products_by_column(target.swapaxes(0, 1), axes)
        seen = products_by_column(place.rotation, xp.moveaxis(self.rotations, 0, -1))
        angle, left, right = _logarithm(products_by_column(predicted.swapaxes(0, 1), seen.swapaxes(0, 1)))
        by_station = -products_by_column(rotation_derivative(frame[:3]).swapaxes(0, 1), right.swapaxes(0, 1))
        inside = products_by_column(by_target.swapaxes(0, 1), axes)
        by_orientation = products_by_column(left, inside.swapaxes(0, 1)).swapaxes(0, 1)
        none = xp.zeros((3, 3, m))
        covariance = turned_covariances(place.rotation, self.covariance)
        angular = variances(self.u_angle, m) * xp.asarray(np.eye(3))[None]
        square = xp.zeros((m, 3, 3))
        return Rows(
            values=xp.concatenate([tips.position - place.points, angle]),
            by_tip=xp.concatenate([each_pose(xp.asarray(np.eye(3)), m), none]),
            by_unknowns={
                self.frame: xp.concatenate([-place.by_frame, xp.concatenate([by_station, none])], axis=1),
                self.orientation: xp.concatenate([none, by_orientation], axis=1),
            },
            measured=xp.concatenate(
                [xp.concatenate([covariance, square], axis=2), xp.concatenate([square, angular], axis=2)], axis=1
            ),
            by_rotation=xp.concatenate([none, left]),
        )

    def without_errors(self, tips: Tips, unknowns: Mapping[str, Float[AnyArray, " k"]]) -> "MeasuredTransforms":
        xp, frame = namespace(tips, unknowns), unknowns[self.frame]
        station, target = rotation_matrix(frame[:3]), rotation_matrix(unknowns[self.orientation])
        axes = xp.moveaxis(xp.stack(tips.axes, axis=1), -1, 0)  # (m, 3, 3)
        exact = (seen_from(frame, tips.position.T), station.T @ axes @ target)
        return eqx.tree_at(lambda o: (o.points, o.rotations), self, exact)


def _logarithm(
    matrix: Float[AnyArray, "3 3 m"],
) -> tuple[Float[AnyArray, "3 m"], Float[AnyArray, "3 3 m"], Float[AnyArray, "3 3 m"]]:
    """Vectors of rotations well below a right angle, and their derivatives by a small rotation before and after.

    With w the vector: log(exp(e) exp(w)) = w + J^-1(w) e, J^-1(w) = I - W / 2 + c W^2, and after: J^-1(-w).
    """
    xp = namespace(matrix)
    half = [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    sine_axis = xp.stack(half) / 2
    square = xp.sum(sine_axis**2, axis=0)
    cosine = (matrix[0, 0] + matrix[1, 1] + matrix[2, 2] - 1) / 2
    small = square < 1e-12
    sine = xp.sqrt(xp.where(small, 1.0, square))
    angle = xp.arctan2(sine, cosine)
    w = xp.where(small, 1 + square / 6, angle / sine)[None] * sine_axis
    t2 = xp.sum(w**2, axis=0)
    near = t2 < 1e-6
    t = xp.sqrt(xp.where(near, 1.0, t2))
    c = xp.where(near, 1 / 12 + t2 / 720, 1 / t**2 - (1 + xp.cos(t)) / (2 * t * xp.sin(t)))
    identity = xp.asarray(np.eye(3))[:, :, None]
    columns = [cross(w, xp.broadcast_to(identity[:, i], w.shape)) for i in range(3)]
    skew = xp.stack(columns, axis=1)
    twice = xp.einsum("ijm,jkm->ikm", skew, skew)
    return w, identity - skew / 2 + c[None, None] * twice, identity + skew / 2 + c[None, None] * twice


class SimulatedTransforms(AbstractSimulated):
    """Transforms of a target that an instrument measures at random places in a box.

    Args:
        name: Name of the observation, and of the target.
        box: Lowest and highest coordinates of the target ``(2, 3)`` in the base frame, mm.
        poses: Number of transforms.
        offset_and_orientation: True place (mm) and rotation vector (rad) of the target in the last frame ``(6,)``.
        frame: The instrument's frame in the base frame: rotation vector (rad) and origin (mm), ``(6,)``.
        u: Standard uncertainty of each coordinate, mm.
        u_angle: Standard uncertainty about each axis, rad.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> probe = aj.data.observations.SimulatedTransforms("6-D probe", box, 20, u=0.01, u_angle=2e-4)
        >>> print(aj.simulate(aj.load_arm("ur10e"), {}, observations=[probe]).observations[0].rotations.shape)
        (20, 3, 3)
    """

    table: ClassVar[str] = "transforms"
    name: str = eqx.field(static=True)
    box: np.ndarray = eqx.field(converter=numbers("box", 2, 3))
    poses: int = eqx.field(static=True)
    offset_and_orientation: np.ndarray = eqx.field(converter=numbers("offset and orientation", 6), default=(0.0,) * 6)
    frame: np.ndarray = eqx.field(converter=numbers("frame", 6), default=(0.0,) * 6)
    u: float = 0.0
    u_angle: float = 1e-4

    @property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        return self.offset_and_orientation[:3]

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return random.uniform(self.box[0], self.box[1], (self.poses, 3))

    def recorded(
        self, q: Float[np.ndarray, "m n"], transforms: Float[np.ndarray, "m 4 4"], random: np.random.Generator
    ) -> MeasuredTransforms:
        station, target = rotation_matrix(self.frame[:3]), rotation_matrix(self.offset_and_orientation[3:])
        points = seen_from(self.frame, transforms[:, :3, 3]) + self.u * random.normal(size=(len(q), 3))
        errors = self.u_angle * random.normal(size=(len(q), 3))
        rotations = np.stack(
            [
                rotation_matrix(error) @ station.T @ transform[:3, :3] @ target
                for error, transform in zip(errors, transforms, strict=True)
            ]
        )
        return MeasuredTransforms(self.name, q, points, rotations, u=self.u, u_angle=self.u_angle)

"""What an instrument measured of the tip: points, transforms of a target, and distances from a pivot."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.arrays import is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import products_by_column
from ...core.numpy_or_jax import AnyArray, namespace, numpy_if_known
from ...core.rotations import (
    fitted_frame,
    rotation_and_derivative,
    rotation_matrix,
    rotation_vector,
)
from .declared import NAME, Part, declared
from .geometry import (
    distances_from_point,
    fitted_pivot,
    frame_and_offset,
    placed,
    rotation_logarithm,
    rows_of_points,
    seen_from,
    turned_covariances,
    variances,
)
from .observation import (
    FRAME,
    POINT,
    AbstractObservation,
    Parts,
    Readings,
    Rows,
    Tips,
    Transforms,
    Unknowns,
    offset_of,
)
from .simulated import AbstractOfTarget, AbstractSimulated

_FLAT = 1e-6  # second singular value of points on a line, of the first
_SAME = 1e-9  # mm


class MeasuredPoints(AbstractObservation):
    """Points of the tip, measured by an instrument in an unknown frame, which all observations of one station share.

    Raises:
        InputError: Shapes do not fit, a value is not finite, or a covariance is not positive.

    Example:
        >>> seen = true.position(capture.q) + np.array([1000.0, 2000.0, -300.0])
        >>> tracker = aj.data.observations.MeasuredPoints("tracker", capture.q, seen, u=0.02)
        >>> print(tracker.points.shape, [*tracker.unknowns])
        (50, 3) ['frame of tracker']
    """

    kind, table, row_units = "points", "points", POINT
    points: Float[AnyArray, "m 3"] = declared("measured point", "mm", "pose", "axis")
    u: AnyArray | None = declared(
        "standard uncertainty of a coordinate", "mm", "pose", "axis", default=None, spread=0,
        more="k = 1: one number, one number per coordinate, or one number per point and coordinate ``(m, 3)``",
    )  # fmt: skip
    covariance: Float[AnyArray, "m 3 3"] = declared(
        "covariance of a point", "mm^2", "pose", "axis", "axis_2", default=None, spread=2,
        more="instead of u: one covariance for all points ``(3, 3)``, or one per point ``(m, 3, 3)``",
    )  # fmt: skip
    station: str = declared(
        "station of the instrument",
        default=NAME,
        of_session=True,
        more="all observations of the same station have the same frame",
    )
    frame = Part("frame of {station}", *FRAME)
    fixes_scale = True

    def completed(self, where: str) -> Mapping[str, Any]:
        if self.covariance is None:
            # Residuals are weighted by covariances, so these are kept in place of u.
            u = np.zeros((self.q.shape[0], 3)) if self.u is None else self.u
            return {"covariance": numpy_if_known(lambda u: u[:, :, None] ** 2 * np.eye(3)[None])(u), "u": None}
        if self.u is not None:
            raise InputError(f"{where}: u and covariance are both given; give one of them.")
        if is_concrete(self.covariance):
            values = np.asarray(self.covariance)
            symmetric = np.allclose(values, values.swapaxes(-1, -2), rtol=1e-6, atol=1e-15)
            if not symmetric or np.linalg.eigvalsh(values).min() < -1e-12 * max(np.abs(values).max(), 1e-300):
                raise InputError(
                    f"covariance of {where} is not symmetric and positive semidefinite; give variances in mm^2."
                )
        return {}

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        where, points = f"observation '{self.name}'", np.asarray(self.points)
        if len(points) < 3:
            raise InputError(
                f"{where} has {len(points)} points, but its frame needs at least three; measure more points."
            )
        sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        # The rotation of the frame is of no consequence where all points are one, such as a socket.
        if sizes[0] >= _SAME and sizes[1] <= _FLAT * sizes[0]:
            raise InputError(
                f"the points of {where} lie on one line, so the rotation of its frame about this line is "
                "undetermined; measure points off the line."
            )

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        if not self.target:
            return {self.frame: fitted_frame(self.points.T, tips.position)}
        frame, place = frame_and_offset(self.points.T, tips, offset, getattr(self, "rotations", None))
        return {self.frame: frame, offset_of(self.target): place}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        seen = placed(unknowns[self.frame], self.points.T)
        measured = turned_covariances(seen.rotation, self.covariance)
        return rows_of_points(tips, seen.points, {self.frame: seen.by_frame}, measured)


class MeasuredTransforms(MeasuredPoints):
    """Positions and orientations of a target that is fixed to the last frame, measured by an instrument (6-D probe).

    Both frames are unknown: the instrument's in the base frame, and the target's in the last frame.

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

    kind, table, rotates = "transforms", "transforms", True
    row_units = (*POINT, "rad", "rad", "rad")
    rotations: Float[AnyArray, "m 3 3"] = declared(
        "measured orientation of the target, with its axes as columns", "1", "pose", "axis", "axis_2"
    )
    u_angle: Float[AnyArray, ""] = declared(
        "standard uncertainty of an orientation about each axis", "rad", positive=True
    )
    target: str = declared("target that was measured", default=NAME)
    orientation = Part("orientation of {target}", *FRAME[:3])  # of the target in the last frame

    def completed(self, where: str) -> Mapping[str, Any]:
        if is_concrete(self.rotations):
            matrices = np.asarray(self.rotations)
            orthogonal = np.allclose(matrices @ matrices.swapaxes(-1, -2), np.eye(3), atol=1e-6)
            if not orthogonal or np.any(np.linalg.det(matrices) < 0):
                raise InputError(
                    f"{where} has a matrix that is not a rotation; give right-handed unit axes as columns."
                )
        return super().completed(where)

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        parts = super().start(tips, offset)
        # The first pose says how the target is turned in the last frame; the fit does the rest.
        axes = namespace(tips).stack([axis[:, 0] for axis in tips.axes])
        turned = axes @ rotation_matrix(parts[self.frame][:3]) @ self.rotations[0]
        return parts | {self.orientation: rotation_vector(turned)}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, m, turn = namespace(tips, unknowns, self.points), self.q.shape[0], unknowns[self.frame][:3]
        points = super().residual(tips, unknowns)
        axes = xp.stack(tips.axes)  # (i, 3, m): the axis i
        # The target's axes j as the arm has them, and as they were seen: (j, 3, m) and (3, j, m).
        target, by_target = rotation_and_derivative(unknowns[self.orientation])
        predicted = products_by_column(target.swapaxes(0, 1), axes)
        seen = products_by_column(rotation_matrix(turn), xp.moveaxis(self.rotations, 0, -1))
        angle, left, right = rotation_logarithm(products_by_column(predicted.swapaxes(0, 1), seen.swapaxes(0, 1)))
        by_station = -products_by_column(rotation_and_derivative(turn)[1].swapaxes(0, 1), right.swapaxes(0, 1))
        inside = products_by_column(by_target.swapaxes(0, 1), axes)
        by_orientation = products_by_column(left, inside.swapaxes(0, 1)).swapaxes(0, 1)
        none, square = xp.zeros((3, 3, m)), xp.zeros((m, 3, 3))
        by_frame = xp.concatenate([by_station, none])
        angular = variances(self.u_angle, m) * xp.asarray(np.eye(3))[None]
        measured = [xp.concatenate([points.measured, square], axis=2), xp.concatenate([square, angular], axis=2)]
        return Rows(
            values=xp.concatenate([points.values, angle]),
            by_tip=xp.concatenate([points.by_tip, none]),
            by_unknowns={
                self.frame: xp.concatenate([points.by_unknowns[self.frame], by_frame], axis=1),
                self.orientation: xp.concatenate([none, by_orientation], axis=1),
            },
            measured=xp.concatenate(measured, axis=1),
            by_rotation=xp.concatenate([none, left]),
        )


class Distances(AbstractObservation):
    """Measured distances of the tip from a pivot whose position is unknown: a telescoping ball bar, a draw wire.

    Raises:
        InputError: Shapes do not fit, or a distance is not positive.

    Example:
        >>> bar = aj.data.observations.Distances("telescoping bar", capture.q[:3], [310.2, 352.7, 401.9], u=0.001)
        >>> print([*bar.unknowns])
        ['pivot of telescoping bar']
    """

    kind, table, row_units = "distances", "distances", ("mm",)
    values: Float[AnyArray, " m"] = declared("measured distance from the pivot", "mm", "pose")
    u: Float[AnyArray, " m"] = declared(
        "standard uncertainty of a distance",
        "mm",
        "pose",
        default=0.0,
        spread=0,
        more="one number, or one number per distance",
    )
    constant: bool = declared(
        "whether an unknown constant is added to all distances", default=False,
        more="for example, for a telescoping bar whose zero is unknown",
    )  # fmt: skip
    pivot = Part("pivot of {name}", *POINT)
    zero = Part("constant of {name}", "mm", when="constant")
    fixes_scale = True

    def completed(self, where: str) -> Mapping[str, Any]:
        if not self.constant and is_concrete(self.values) and np.any(np.asarray(self.values) <= 0):
            raise InputError(
                f"{where} has a distance that is not positive; give positive distances in mm, or constant=True."
            )
        return {}

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        pivot, zero = fitted_pivot(tips.position, self.values, self.constant)
        return {self.pivot: pivot} | ({self.zero: zero[None]} if self.constant else {})

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, m = namespace(tips, unknowns, self.values), self.q.shape[0]
        distance, towards, by_pivot = distances_from_point(tips.position, unknowns[self.pivot])
        by_unknowns, values = {self.pivot: by_pivot[:, None]}, self.values
        if self.constant:
            values = values + unknowns[self.zero][0]
            by_unknowns[self.zero] = -xp.ones((1, 1, m))
        return Rows((distance - values)[None], towards[None], by_unknowns, variances(self.u, m))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        needs = "pivot and constant need at least five" if self.constant else "pivot needs at least four"
        if tips.shape[1] < 4 + self.constant:
            raise InputError(
                f"observation '{self.name}' has {tips.shape[1]} distances, but its {needs}; measure more distances."
            )


class AbstractInBox(AbstractSimulated):
    """What an instrument measures at random places in a box."""

    box: Float[np.ndarray, "2 3"] = declared("lowest and highest coordinates of the tip in the base frame", "mm")
    poses: int = declared("number of poses")

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return random.uniform(self.box[0], self.box[1], (self.poses, 3))


class SimulatedPoints(AbstractInBox, AbstractOfTarget):
    """Points that an instrument measures at random places in a box.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> tracker = aj.data.observations.SimulatedPoints("tracker", box, 50, (0, 0, 1.0, 2000, 0, 0), u=0.02)
        >>> seen = aj.simulate(true, {}, observations=[tracker]).observations[0]
        >>> print(seen.points.shape, [*seen.unknowns])
        (50, 3) ['frame of tracker']
    """

    table = "points"
    frame: Float[np.ndarray, "6"] = declared(
        "frame of the instrument in the base frame: rotation vector (rad) and origin (mm)", default=(0.0,) * 6
    )
    u: float = declared("standard uncertainty of each coordinate", "mm", default=0.0)

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> MeasuredPoints:
        points = seen_from(self.frame, transforms[:, :3, 3]) + self.u * random.normal(size=(len(q), 3))
        return MeasuredPoints(self.name, q, points, u=self.u, target=self.target)


class SimulatedTransforms(AbstractInBox):
    """Transforms of a target that an instrument measures at random places in a box.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> probe = aj.data.observations.SimulatedTransforms("6-D probe", box, 20, u=0.01, u_angle=2e-4)
        >>> print(aj.simulate(aj.load_arm("ur10e"), {}, observations=[probe]).observations[0].rotations.shape)
        (20, 3, 3)
    """

    table = "transforms"
    offset_and_orientation: Float[np.ndarray, "6"] = declared(
        "true position (mm) and rotation vector (rad) of the target in the last frame", default=(0.0,) * 6
    )
    frame: Float[np.ndarray, "6"] = declared(
        "frame of the instrument in the base frame: rotation vector (rad) and origin (mm)", default=(0.0,) * 6
    )
    u: float = declared("standard uncertainty of each coordinate", "mm", default=0.0)
    u_angle: float = declared("standard uncertainty about each axis", "rad", default=1e-4)

    def completed(self, where: str) -> Mapping[str, Any]:
        return {"offset": self.offset_and_orientation[:3]}

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> MeasuredTransforms:
        station, target = rotation_matrix(self.frame[:3]), rotation_matrix(self.offset_and_orientation[3:])
        points = seen_from(self.frame, transforms[:, :3, 3]) + self.u * random.normal(size=(len(q), 3))
        errors = self.u_angle * random.normal(size=(len(q), 3))
        turned = zip(errors, transforms[:, :3, :3], strict=True)
        rotations = np.stack([rotation_matrix(error) @ station.T @ axes @ target for error, axes in turned])
        return MeasuredTransforms(self.name, q, points, rotations, u=self.u, u_angle=self.u_angle)


class SimulatedDistances(AbstractInBox):
    """Distances from a pivot to random places in a box.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> wire = aj.data.observations.SimulatedDistances("draw wire", box, 20, (1000, 0, 0), u=0.01)
        >>> print(aj.simulate(true, {}, observations=[wire]).observations[0].values.shape)
        (20,)
    """

    table = "distances"
    pivot: Float[np.ndarray, "3"] = declared("pivot in the base frame", "mm", moves="point")
    u: float = declared("standard uncertainty of each distance", "mm", default=0.0)

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Distances:
        true = np.linalg.norm(transforms[:, :3, 3] - self.pivot, axis=1)
        return Distances(self.name, q, true + self.u * random.normal(size=len(q)), u=self.u)

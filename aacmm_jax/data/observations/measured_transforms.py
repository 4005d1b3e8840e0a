"""Transforms of a target on the last frame, positions and orientations, as an instrument saw them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.arrays import is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import products_by_column
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import rotation_and_derivative, rotation_derivative, rotation_matrix, rotation_vector
from .declared import NAME, number, part, text
from .fits import frame_and_offset
from .frames import each_pose, placed, rotation_logarithm, seen_from, turned_covariances, variances
from .measured_points import AbstractMeasured
from .observation import FRAME, Parts, Rows, Tips, Unknowns, offset_of
from .simulated import AbstractInBox, Readings, Transforms


class MeasuredTransforms(AbstractMeasured):
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

    kind, table, rows, rotates = "transforms", "transforms", 6, True
    rotations: Float[AnyArray, "m 3 3"] = number(
        "measured axes of the target, as columns", "1", "pose", "axis", "axis_2"
    )
    u_angle: Float[AnyArray, ""] = number(
        "standard uncertainty of an orientation about each axis", "rad", positive=True
    )
    target: str = text("target that was seen", default=NAME)
    orientation = part("orientation of {target}", *FRAME[:3])  # of the target in the last frame

    def completed(self, where: str) -> Mapping[str, Any]:
        if is_concrete(self.rotations):
            matrices = np.asarray(self.rotations)
            orthogonal = np.allclose(matrices @ matrices.swapaxes(-1, -2), np.eye(3), atol=1e-6)
            if not orthogonal or np.any(np.linalg.det(matrices) < 0):
                raise InputError(f"{where} has a matrix that is no rotation; give right-handed unit axes as columns.")
        return super().completed(where)

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        xp = namespace(tips, self.points)
        frame, place = frame_and_offset(self.points.T, tips, offset)
        # The first pose says how the target is turned in the last frame; the fit does the rest.
        axes = xp.stack(tips.axes, axis=1)[:, :, 0]
        turned = axes.T @ rotation_matrix(frame[:3]) @ self.rotations[0]
        return {self.frame: frame, offset_of(self.target): place, self.orientation: rotation_vector(turned)}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, m = namespace(tips, unknowns, self.points), self.q.shape[0]
        frame, orientation = unknowns[self.frame], unknowns[self.orientation]
        place = placed(frame, self.points.T)
        axes = xp.stack(tips.axes)  # (i, 3, m): the axis i
        # The target's axes j as the arm has them, and as they were seen: (j, 3, m) and (3, j, m).
        target, by_target = rotation_and_derivative(orientation)
        predicted = products_by_column(target.swapaxes(0, 1), axes)
        seen = products_by_column(place.rotation, xp.moveaxis(self.rotations, 0, -1))
        angle, left, right = rotation_logarithm(products_by_column(predicted.swapaxes(0, 1), seen.swapaxes(0, 1)))
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

    def without_errors(self, tips: Tips, unknowns: Parts) -> "MeasuredTransforms":
        xp, frame = namespace(tips, unknowns), unknowns[self.frame]
        station, target = rotation_matrix(frame[:3]), rotation_matrix(unknowns[self.orientation])
        axes = xp.moveaxis(xp.stack(tips.axes, axis=1), -1, 0)  # (m, 3, 3)
        return self.changed(points=seen_from(frame, tips.position.T), rotations=station.T @ axes @ target)


class SimulatedTransforms(AbstractInBox):
    """Transforms of a target that an instrument measures at random places in a box.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> probe = aj.data.observations.SimulatedTransforms("6-D probe", box, 20, u=0.01, u_angle=2e-4)
        >>> print(aj.simulate(aj.load_arm("ur10e"), {}, observations=[probe]).observations[0].rotations.shape)
        (20, 3, 3)
    """

    table = "transforms"
    offset_and_orientation: Float[np.ndarray, "6"] = number(
        "true place (mm) and rotation vector (rad) of the target in the last frame", default=(0.0,) * 6
    )
    frame: Float[np.ndarray, "6"] = number(
        "frame of the instrument in the base frame: rotation vector (rad) and origin (mm)", default=(0.0,) * 6
    )
    u: float = number("standard uncertainty of each coordinate", "mm", default=0.0)
    u_angle: float = number("standard uncertainty about each axis", "rad", default=1e-4)

    @property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        return self.offset_and_orientation[:3]

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> MeasuredTransforms:
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

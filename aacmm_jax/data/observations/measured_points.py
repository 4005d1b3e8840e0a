"""Points of the tip as an instrument saw them: a laser tracker, a coordinate measuring machine, a camera."""

import abc
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers, as_floats, is_concrete
from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray, namespace, numpy_if_known
from ...core.rotations import fitted_frame
from .declared import NAME, number, part, text
from .fits import frame_and_offset
from .frames import each_pose, placed, seen_from, turned_covariances
from .observation import FRAME, AbstractObservation, Parts, Rows, Tips, Unknowns, offset_of
from .simulated import AbstractInBox, AbstractOfTarget, Readings, Transforms

_FLAT = 1e-6  # second singular value of points on a line, of the first
_SAME = 1e-9  # mm


class AbstractMeasured(AbstractObservation):
    """What an instrument measured in a frame of its own, which all observations of one station share."""

    points: Float[AnyArray, "m 3"] = number("measured point", "mm", "pose", "axis")
    u: AnyArray | None = number(
        "standard uncertainty of a coordinate",
        "mm",
        "pose",
        "axis",
        default=None,
        spread=True,
        more="k = 1: one number, one for each coordinate, or one for each of all ``(m, 3)``",
    )
    covariance: Float[AnyArray, "m 3 3"] = number(
        "covariance of a point",
        "mm^2",
        "pose",
        "axis",
        "axis_2",
        default=None,
        raw=True,
        more="instead of u: of all points ``(3, 3)``, or of each ``(m, 3, 3)``",
    )
    station: str = text(
        "station of the instrument", default=NAME, of_session=True, more="observations of one station share its frame"
    )
    frame = part("frame of {station}", *FRAME)
    fixes_scale = True

    def completed(self, where: str) -> Mapping[str, Any]:
        if self.u is not None and self.covariance is not None:
            raise InputError(f"{where}: u and covariance are both given; give one of them.")
        poses = self.q.shape[0]
        if self.covariance is not None:
            return {"covariance": _checked_covariances(where, self.covariance, poses)}
        # Residuals are weighted by covariances, so these are kept in place of u.
        return {"covariance": _on_diagonals(np.zeros((poses, 3)) if self.u is None else self.u), "u": None}

    @abc.abstractmethod
    def without_errors(self, tips: Tips, unknowns: Parts) -> "AbstractMeasured":
        """The same observation, had the instrument measured exactly these tips."""

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        check_spread(f"observation '{self.name}'", np.asarray(self.points).T)


class MeasuredPoints(AbstractMeasured):
    """Points of the tip, measured by an instrument in a frame of its own, which is unknown.

    Raises:
        InputError: Shapes do not fit, a value is not finite, or a covariance is not positive.

    Example:
        >>> seen = true.position(capture.q) + np.array([1000.0, 2000.0, -300.0])
        >>> tracker = aj.data.observations.MeasuredPoints("tracker", capture.q, seen, u=0.02)
        >>> print(tracker.points.shape, [*tracker.unknowns])
        (50, 3) ['frame of tracker']
    """

    kind, table, rows = "points", "points", 3

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        if not self.target:
            return {self.frame: fitted_frame(self.points.T, tips.position)}
        frame, place = frame_and_offset(self.points.T, tips, offset)
        return {self.frame: frame, offset_of(self.target): place}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        identity = namespace(tips, unknowns, self.points).asarray(np.eye(3))
        seen = placed(unknowns[self.frame], self.points.T)
        return Rows(
            values=tips.position - seen.points,
            by_tip=each_pose(identity, self.q.shape[0]),
            by_unknowns={self.frame: -seen.by_frame},
            measured=turned_covariances(seen.rotation, self.covariance),
        )

    def without_errors(self, tips: Tips, unknowns: Parts) -> "MeasuredPoints":
        return self.changed(points=seen_from(unknowns[self.frame], tips.position.T))


@numpy_if_known
def _on_diagonals(u: Float[AnyArray, "m 3"]) -> Float[AnyArray, "m 3 3"]:
    """Variances, mm^2."""
    return u[:, :, None] ** 2 * np.eye(3)[None]


def _checked_covariances(where: str, covariance: Numbers, poses: int) -> Float[AnyArray, "m 3 3"]:
    """Covariances of all points or of each, mm^2, or `InputError`."""
    array = as_floats(covariance, f"covariance of {where}")
    if array.shape not in ((3, 3), (poses, 3, 3)):
        raise InputError(f"covariance of {where} has shape {array.shape}; give (3, 3) or ({poses}, 3, 3).")
    array = namespace(array).broadcast_to(array, (poses, 3, 3))
    if is_concrete(array):
        values = np.asarray(array)
        symmetric = np.allclose(values, values.swapaxes(-1, -2), rtol=1e-6, atol=1e-15)
        if not symmetric or np.linalg.eigvalsh(values).min() < -1e-12 * max(np.abs(values).max(), 1e-300):
            raise InputError(f"covariance of {where} is not symmetric and positive; give variances in mm^2.")
    return array


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
    frame: Float[np.ndarray, "6"] = number(
        "frame of the instrument in the base frame: rotation vector (rad) and origin (mm)", default=(0.0,) * 6
    )
    u: float = number("standard uncertainty of each coordinate", "mm", default=0.0)

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> MeasuredPoints:
        points = seen_from(self.frame, transforms[:, :3, 3]) + self.u * random.normal(size=(len(q), 3))
        return MeasuredPoints(self.name, q, points, u=self.u, target=self.target)

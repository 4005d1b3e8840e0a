"""From joint axes in space to Denavit-Hartenberg parameters with Hayati's beta, and back to the origins of joints.

A chain is known by its axes at reading 0 (lines with a direction) and by the frame of its tip. Two frames on the same
axis differ by a rotation about it and a shift along it, which no data on the tip determine: D-H fixes both by rule,
other descriptions (URDF) by habit. So a conversion keeps both, and `calibrated_frames` goes back with the least change.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from .arm import NEARLY_PARALLEL, Arm, arm_of, one_chain
from .chain import Geometry

Vector = Float[np.ndarray, " 3"]
Transform = Float[np.ndarray, "4 4"]
_NO_LENGTH, _NO_ANGLE = 1e-12, 1e-15  # mm and rad: below the rounding of a chain of some metres
UNCHANGED = 2e-11, 2e-14  # mm and rad: far above the rounding of a round trip, far below 1e-9 mm at any tip


class Axes(NamedTuple):
    """The joint axes and the tip of a chain at reading 0, in the frame of its base."""

    directions: Float[np.ndarray, "n 3"]  # unit vectors; a reading counts by the right-hand rule, a slide along them
    points: Float[np.ndarray, "n 3"]  # mm, on each axis (anywhere, of a slide); frames stay at them where D-H allows it
    tip: Transform  # mm


def rotation(axis: int, angle: float) -> Transform:
    """The rotation about the axis x (0), y (1) or z (2) by an angle in rad."""
    i, j = ((1, 2), (2, 0), (0, 1))[axis]
    matrix = np.eye(4)
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[j, i] = math.sin(angle)
    matrix[i, j] = -matrix[j, i]
    return matrix


def inverse(transform: Transform) -> Transform:
    """The inverse of a rigid transform."""
    result = np.eye(4)
    result[:3, :3] = transform[:3, :3].T
    result[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return result


def same_transform(first: Transform, second: Transform) -> bool:
    """Whether two transforms are the same to rounding."""
    (length, angle), difference = UNCHANGED, np.abs(first - second)
    return bool(difference[:3, 3].max() <= length and difference[:3, :3].max() <= angle)


def dh_link(theta: float, d: float, a: float, alpha: float, beta: float) -> Transform:
    """Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta); mm and rad."""
    link = rotation(2, theta) @ rotation(0, alpha) @ rotation(1, beta)
    link[:3, 3] = a * math.cos(theta), a * math.sin(theta), d
    return link


def _links(geometry: Geometry) -> list[list[float]]:
    """theta, d, a, alpha and beta of each joint of one arm."""
    beta = np.zeros_like(geometry.alpha) if geometry.beta is None else geometry.beta
    return np.array([geometry.theta, geometry.d, geometry.a, geometry.alpha, beta]).T.tolist()


def dh_frames(geometry: Geometry, base: Transform) -> list[Transform]:
    """The D-H frames 0 to n of one arm at reading 0; ``base`` is frame 0."""
    frames = [base]
    for row in _links(geometry):
        frames.append(frames[-1] @ dh_link(*row))
    return frames


def _with_probe(frame: Transform, geometry: Geometry) -> Transform:
    """The last frame with the tip as its origin."""
    tip = frame.copy()
    tip[:3, 3] += tip[:3, :3] @ np.asarray(geometry.probe)
    return tip


def tip_frame(geometry: Geometry, base: Transform) -> Transform:
    """The last D-H frame at reading 0, with the tip as its origin."""
    return _with_probe(dh_frames(geometry, base)[-1], geometry)


def geometry_of(arm: Arm) -> Geometry:
    """The parameters of an arm as NumPy arrays, or `InputError` for joint corrections: for formats without these."""
    one_chain(arm, "this format")
    if arm.corrections is not None:
        raise InputError(
            "the arm has joint corrections, which this format cannot store; calibrate again with --model dh, write "
            "TOML, write only the joint zero offsets (--format offsets), or correct the commanded poses (aacmm "
            "correct)."
        )
    return jax.tree.map(np.asarray, arm.geometry)


def dh_of_axes(axes: Axes, *, keep_points: bool = True) -> tuple[Transform, Geometry]:
    """Exact D-H parameters of a chain; readings keep their sign, since z of every frame is along its axis.

    Neighbouring axes within about 1 degree of parallel or antiparallel get Hayati's beta; standard D-H would put the
    next frame hundreds of metres away (Hayati and Mirmirani 1985). Their ``d`` is such that the next frame is at the
    given point of its axis, or 0 without ``keep_points``. The last frame has the orientation of the tip, by alpha,
    theta and beta of the last joint. Returned are the first D-H frame in the frame of the base (the same frame where
    the first axis is its z axis), and the parameters, mm and rad; ``beta`` is None where it is not needed.
    """
    base = _first_frame(axes.directions[0], axes.points[0])
    frame, rows = base, []
    for direction, point in zip(axes.directions[1:], axes.points[1:], strict=True):
        point = frame[:3, :3].T @ (point - frame[:3, 3])
        rows.append(_to_axis(frame[:3, :3].T @ direction, point, keep_points))
        frame = frame @ dh_link(*rows[-1])
    row, probe = _to_frame(inverse(frame) @ axes.tip)
    theta, d, a, alpha, beta = np.array([*rows, row]).T
    return base, Geometry(alpha, a, d, theta, beta if np.any(beta) else None, probe)


def _first_frame(direction: Vector, point: Vector) -> Transform:
    """The frame with z along the first axis that is rotated least (after pi about x, for an axis that points down),
    with its origin nearest to that of the base."""
    frame, down = np.eye(4), direction[2] < 0
    x, y, z = (direction[0], -direction[1], -direction[2]) if down else direction
    # Rodrigues' formula about z cross the axis, whose sine is the length of (x, y) and whose cosine is z.
    frame[:3, :3] = [
        [1 - x * x / (1 + z), -x * y / (1 + z), x],
        [-x * y / (1 + z), 1 - y * y / (1 + z), y],
        [-x, -y, z],
    ]
    if down:
        frame = np.diag([1.0, -1.0, -1.0, 1.0]) @ frame  # pi about x, without the rounding of a sine
    frame[:3, 3] = point - (point @ direction) * direction
    return frame + 0.0  # without -0.0


def _to_axis(direction: Vector, point: Vector, keep_point: bool) -> tuple[float, ...]:
    """theta, d, a, alpha and beta to a frame on the next axis, which is given in the frame on this one."""
    sine = math.hypot(direction[0], direction[1])
    if sine < NEARLY_PARALLEL:
        if not keep_point:
            point = point - point[2] / direction[2] * direction
        # Hayati's form: no common normal, but the next frame at the point itself, d along z and a in the plane.
        d, a = float(point[2]), math.hypot(point[0], point[1])
        theta = math.atan2(point[1], point[0]) if a > _NO_LENGTH else 0.0
        if abs(theta) > math.pi / 2 + _NO_ANGLE:  # zero offsets of less than a quarter revolution, as tables have them
            theta, a = theta - math.copysign(math.pi, theta), -a
        x, y, z = rotation(2, -theta)[:3, :3] @ direction
        beta = math.atan2(x, math.hypot(y, z))
        beta = 0.0 if abs(beta) < _NO_ANGLE else beta
    else:
        # The common normal ends on the next axis at the point that is nearest to z.
        foot = point - (point[:2] @ direction[:2]) / sine**2 * direction
        normal = np.array([-direction[1], direction[0]]) / sine
        d, a = float(foot[2]), float(foot[:2] @ normal)
        theta = math.atan2(normal[1], normal[0])
        quarter = abs(abs(theta) - math.pi / 2) < _NO_ANGLE
        if (a < 0 or (a == 0 and theta < 0)) if quarter else abs(theta) > math.pi / 2:
            theta, a = theta - math.copysign(math.pi, theta), -a
        beta = 0.0
        _, y, z = rotation(2, -theta)[:3, :3] @ direction
    return theta, d, a if abs(a) > _NO_LENGTH else 0.0, math.atan2(-y + 0.0, z), beta  # -0.0 would make -pi of pi


def _to_frame(tip: Transform) -> tuple[tuple[float, ...], Vector]:
    """theta, d, a, alpha and beta to a frame with the orientation of the tip, and the tip in it.

    The orientation is Rz(theta) Rx(alpha) Ry(beta). Every angle is that of what those before it leave, so that the
    product is exact also where theta and beta have the same axis.
    """
    turn = tip[:3, :3]
    singular = math.hypot(turn[0, 1], turn[1, 1]) < _NO_ANGLE
    theta = math.atan2(turn[1, 0], turn[0, 0]) if singular else math.atan2(-turn[0, 1], turn[1, 1])
    choices = []
    for angle in (theta, theta - math.copysign(math.pi, theta)):
        left = rotation(2, -angle)[:3, :3] @ turn
        alpha = math.atan2(left[2, 1], left[1, 1])
        left = rotation(0, -alpha)[:3, :3] @ left
        choices.append((angle, alpha, math.atan2(left[0, 2], left[0, 0])))
    angles = min(choices, key=lambda angles: (abs(angles[2]) > math.pi / 2, abs(angles[0]) > math.pi / 2 + _NO_ANGLE))
    theta, alpha, beta = (angle if abs(angle) > _NO_ANGLE else 0.0 for angle in angles)
    x, y, z = rotation(2, -theta)[:3, :3] @ tip[:3, 3]
    last = (rotation(0, alpha) @ rotation(1, beta))[:3, :3]
    probe = last.T @ [0.0, y, 0.0] if abs(y) > _NO_LENGTH else np.zeros(3)
    return (theta, float(z), float(x) if abs(x) > _NO_LENGTH else 0.0, alpha, beta), probe


def without_far_frames(arm: Arm) -> Arm:
    """The same arm with d = 0 and Hayati's beta between nearly parallel axes; positions, readings and probe stay.

    A table by the common normal alone puts frames on nearly parallel axes far from the arm (those of Universal Robots
    hundreds of metres), where parameters trade off with each other and no calibration can tell them apart.

    Args:
        arm: One arm.

    Example:
        >>> far = aj.load_arm("robot.urdf").replace(alpha=[-1.570796, 1e-5, 0.0], d=[300.0, 40000.0, -40000.0])
        >>> near = aj.kinematics.without_far_frames(far)
        >>> print(near.d.round(1), near.beta)
        [300.   0.   0.] [ 0.000000e+00 -9.999995e-09  0.000000e+00]
    """
    geometry = geometry_of(arm)
    *frames, last = dh_frames(geometry, np.eye(4))
    directions, points = (np.array([frame[:3, i] for frame in frames]) for i in (2, 3))
    _, near = dh_of_axes(Axes(directions, points, last), keep_points=False)
    return arm_of(near._replace(probe=near.probe + geometry.probe, kinds=geometry.kinds), arm.limits)


def calibrated_frames(
    origins: list[Transform],
    nominal: Geometry,
    calibrated: Geometry,
    base: Transform,
    calibrated_base: Transform | None = None,
    branching: Sequence[int] = (),
) -> list[Transform]:
    """Origins of the joints of a calibrated chain, each in the frame of the joint before it, at reading 0; mm.

    A frame on axis i turns about its axis with theta_i, so that a link keeps its shape where only zero offsets changed,
    and is where the axis passes nearest to the nominal origin, as the calibrated joint before it carries that; that of
    a prismatic joint moves on along its axis with d_i, for the same reason. An origin that does not change comes back
    as it was, to the bit. ``nominal`` and ``base`` are what `dh_of_axes` gave; calibration changes ``base`` only of an
    arm that stands beside another one. Joints from 0 that are ``branching`` neither turn nor slide by their offset.
    """
    before, after = (
        dh_frames(nominal, base),
        dh_frames(calibrated, base if calibrated_base is None else calibrated_base),
    )
    was, now, changed = np.eye(4), np.eye(4), []
    for i, origin in enumerate(origins):
        was, expected = was @ origin, now @ origin
        own = i not in branching
        turn = rotation(2, float(calibrated.theta[i] - nominal.theta[i]) if own else 0.0)
        frame = after[i] @ turn @ inverse(before[i]) @ was
        point, axis = after[i][:3, 3], after[i][:3, 2]
        slides = nominal.kinds is not None and nominal.kinds.prismatic[i]
        offset = float(calibrated.d[i] - nominal.d[i]) if slides and own else 0.0
        frame[:3, 3] = point + ((expected[:3, 3] - point) @ axis + offset) * axis
        unchanged = same_transform(frame, expected)
        changed.append(origin if unchanged else inverse(now) @ frame)
        # Not the product of what is returned: an inverse by transposition doubles the rounding from joint to joint.
        now = expected if unchanged else frame
    return changed


def canonical_origins(geometry: Geometry) -> list[Transform]:
    """Origins of the joints with z along every axis, as D-H has them: T_i = Tx(a) Rx(alpha) Ry(beta) Rz(theta) Tz(d).

    Length, twist and beta are of the joint before. The transform of the tip in the last joint's frame is one more.
    """
    origins, link = [], np.eye(4)
    for theta, d, a, alpha, beta in _links(geometry):
        origins.append(link @ dh_link(theta, d, 0.0, 0.0, 0.0))
        link = dh_link(0.0, 0.0, a, alpha, beta)
    return [*origins, _with_probe(link, geometry)]

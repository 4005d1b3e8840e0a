"""Points in unknown frames, and the sphere, plane, cylinder or frame that is closest to nearly right tips.

In NumPy and in JAX, so that studies start in a compiled program. The starts are in closed form but for the cylinder's,
which has none.
"""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...core.linear_algebra import length_and_direction, products_by_column, semidefinite_eigen, solve_positive_definite
from ...core.numpy_or_jax import AnyArray, namespace, scan
from ...core.rotations import cross, cross_matrix, fitted_frame, rotation_and_derivative, rotation_matrix
from .observation import Rows, Tips

_DIRECTIONS = 300  # of axes that are tried: a hemisphere in steps of about 8 degrees
_LARGEST_RADIUS = 30.0  # root mean square distances from the middle
_TRIED = 16  # directions that are refined
_FEW_STEPS, _STEPS = 5, 8  # of their refinement, and of the best one's
_NEAR = 0.01  # of the size of the points: distances from the tips that a nominal arm may leave
_SEEN = 1e-6  # singular value, of the largest, of what poses show of a target's place
_ROUNDS = 25  # of the search for a rotation
# Rotation vectors: none, quarter and half turns about the axes, thirds about the diagonals of a cube.
_TURNS = np.array(
    [
        *(np.pi / 2 * k * axis for axis in np.eye(3) for k in (-1, 1, 2)),
        *(2 * np.pi / 3 * np.array(signs) / math.sqrt(3) for signs in itertools.product((-1, 1), repeat=3)),
        *(np.pi * np.array(axis) / math.sqrt(2) for axis in ((1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1))),
        np.pi * np.array((0, 1, -1)) / math.sqrt(2),
        np.zeros(3),
    ]
)

# Distances of tips from a geometry, mm, and their derivatives by the tips, unit vectors, and by the geometry's numbers.
Distances = tuple[Float[AnyArray, " m"], Float[AnyArray, "3 m"], Float[AnyArray, "k m"]]


def each_pose(matrix: Float[AnyArray, "r c"], poses: int) -> Float[AnyArray, "r c m"]:
    """The same matrix for every pose."""
    return namespace(matrix).broadcast_to(matrix[:, :, None], (*matrix.shape, poses))


def variances(u: Float[AnyArray, "..."] | float, poses: int) -> Float[AnyArray, "m 1 1"]:
    """Covariances of one residual a pose, from one standard uncertainty for all or from one each."""
    xp = namespace(u)
    square = xp.reshape(xp.asarray(u**2), (-1, 1, 1))
    return square if len(square) == poses else xp.broadcast_to(square, (poses, 1, 1))


def rows_of_points(
    tips: Tips,
    points: Float[AnyArray, "3 p"],
    by_unknowns: dict[str, Float[AnyArray, "k 3 m"]],
    measured: Float[AnyArray, "m 3 3"] | None = None,
) -> Rows:
    """Tips less the points where they ought to be, whose derivatives are given; nothing ``measured`` has no error."""
    m = tips.position.shape[1]
    identity = each_pose(namespace(tips, points).asarray(np.eye(3)), m)
    by_unknowns = {name: -derivative for name, derivative in by_unknowns.items()}
    return Rows(tips.position - points, identity, by_unknowns, np.zeros((m, 3, 3)) if measured is None else measured)


class Placed(NamedTuple):
    """Points of a frame in the frame around it; p is 1 for one frame, m for a frame of each point."""

    points: Float[AnyArray, "3 m"]  # mm
    by_frame: Float[AnyArray, "6 3 m"]  # derivatives by the six numbers of the frame
    rotation: Float[AnyArray, "3 3 p"]


def placed(frame: Float[AnyArray, "6 ..."], coordinates: Float[AnyArray, "3 m"]) -> Placed:
    """Points (mm) of one frame, or of a frame each ``(6, m)``, in the frame around it."""
    xp, columns, m = namespace(frame, coordinates), frame.reshape(6, -1), coordinates.shape[1]
    rotation, axes = rotation_and_derivative(columns[:3])
    turned = products_by_column(rotation, coordinates)
    # A change of component k turns the points by a small rotation about column k of the derivative.
    small = cross_matrix(axes)  # (3, 3, k, p)
    by_rotation = products_by_column(xp.moveaxis(small, 2, 0).reshape(9, 3, -1), turned).reshape(3, 3, m)
    identity = each_pose(xp.asarray(np.eye(3)), m)
    return Placed(turned + columns[3:], xp.concatenate([by_rotation, identity]), rotation)


def seen_from(frame: Float[AnyArray, " 6"], points: Float[AnyArray, "m 3"]) -> Float[AnyArray, "m 3"]:
    """Points of the frame around a frame, as coordinates in that frame, mm; undoes `placed`."""
    return (points - frame[3:]) @ rotation_matrix(frame[:3])


def turned_covariances(rotation: Float[AnyArray, "3 3 p"], covariance: Float[AnyArray, "m 3 3"]) -> AnyArray:
    """Covariances R C R^T ``(m, 3, 3)`` of what is turned, by one rotation (p = 1) or by one each (p = m)."""
    # As one product with the nine numbers of a covariance: for one rotation that takes an eighth of the time of two.
    both = (rotation[:, None, :, None] * rotation[None, :, None, :]).reshape(9, 9, -1)
    return products_by_column(both, covariance.reshape(-1, 9).T).T.reshape(-1, 3, 3)


def rotation_logarithm(
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
    identity, skew = xp.asarray(np.eye(3))[:, :, None], cross_matrix(w)
    twice = xp.einsum("ijm,jkm->ikm", skew, skew)
    return w, identity - skew / 2 + c[None, None] * twice, identity + skew / 2 + c[None, None] * twice


def heights(tips: Float[AnyArray, "3 m"], plane: Float[AnyArray, "3 p"]) -> Distances:
    """Heights of tips over a plane, or over one each."""
    xp = namespace(tips, plane)
    rotation, axes = rotation_and_derivative(xp.concatenate([plane[:2], xp.zeros_like(plane[:1])]))
    normal = rotation[:, 2]
    # The normal, and its derivatives by the two components.
    rows = xp.stack([normal, cross(axes[:, 0], normal), cross(axes[:, 1], normal)])
    height, *by_turn = products_by_column(rows, tips)
    return height - plane[2], xp.broadcast_to(normal, tips.shape), xp.stack([*by_turn, -xp.ones_like(height)])


def distances_from_point(tips: Float[AnyArray, "3 m"], point: Float[AnyArray, "3 p"]) -> Distances:
    """Distances of tips from a point, or from one each."""
    distance, direction = length_and_direction(tips - point)
    return distance, direction, -direction


def distances_from_axis(tips: Float[AnyArray, "3 m"], axis: Float[AnyArray, "4 ..."]) -> Distances:
    """Distances of tips from an axis, or from one each."""
    xp, axis = namespace(tips, axis), axis.reshape(4, -1)
    rotation, axes = rotation_and_derivative(xp.concatenate([axis[:2], xp.zeros_like(axis[:1])]))
    across_axis = rotation[:, :2]
    between = products_by_column(across_axis.swapaxes(0, 1), tips) - axis[2:]
    distance, across = length_and_direction(between)
    direction = products_by_column(across_axis, across)
    # A small rotation v of the axes moves a tip t by -v x t in them, and the distance by -v.(t x direction).
    by_rotation = -products_by_column(axes[:, :2].swapaxes(0, 1), cross(tips, direction))
    return distance, direction, xp.concatenate([by_rotation, -across])


def _about_middle(points: Float[AnyArray, "3 m"]) -> tuple[AnyArray, AnyArray, Float[AnyArray, "3 m"]]:
    """The middle of points ``(3, 1)``, their root mean square coordinate about it, and the points in this unit."""
    xp = namespace(points)
    middle = xp.mean(points, axis=1, keepdims=True)
    size = xp.sqrt(xp.mean((points - middle) ** 2)) + 1e-12
    return middle, size, (points - middle) / size


def fitted_pivot(
    tips: Float[AnyArray, "3 m"], values: Float[AnyArray, " m"] | float, constant: bool
) -> tuple[Float[AnyArray, " 3"], Float[AnyArray, ""]]:
    """The point at measured distances from tips, and the constant that is added to all; with the distances 0, the
    centre and the radius of a sphere.

    By linear least squares: |t - p|^2 = (v + c)^2 is linear in p, in c^2 - |p|^2 and, with a ``constant``, in c.
    """
    xp = namespace(tips, values)
    middle, size, centred = _about_middle(tips)
    values = values / size
    columns = [2 * centred, xp.ones_like(centred[:1])] + ([2 * values[None]] if constant else [])
    design = xp.concatenate(columns)
    normal = design @ design.T + 1e-12 * tips.shape[1] * xp.asarray(np.eye(len(design)))
    solution = solve_positive_definite(normal, design @ (xp.sum(centred**2, axis=0) - values**2))
    radius = xp.sqrt(xp.maximum(solution[3] + xp.sum(solution[:3] ** 2), 0.0))
    return middle[:, 0] + size * solution[:3], size * (solution[4] if constant else radius)


def fitted_sphere(tips: Float[AnyArray, "3 m"], radius: Any) -> tuple[Float[AnyArray, " 3"], Float[AnyArray, ""]]:
    """Centre and radius of the sphere through points, whatever radius is certified."""
    return fitted_pivot(tips, 0.0, constant=False)


def fitted_plane(tips: Float[AnyArray, "3 m"], size: Any) -> tuple[Float[AnyArray, " 3"], None]:
    """The plane that points are closest to: its numbers as `heights` takes them, with the normal upwards."""
    xp = namespace(tips)
    middle = xp.mean(tips, axis=1)
    centred = tips - middle[:, None]
    scatter = centred @ centred.T
    _, vectors = semidefinite_eigen(scatter / (xp.trace(scatter) + 1e-300))
    normal = vectors[:, 2] / xp.sqrt(xp.sum(vectors[:, 2] ** 2))
    normal = xp.where(normal[2] < 0, -normal, normal)
    return xp.concatenate([turned_z(normal), (normal @ middle)[None]]), None


def turned_z(direction: Float[AnyArray, " 3"]) -> Float[AnyArray, " 2"]:
    """The first two components of the rotation vector, whose third is 0, that turns z to a unit vector upwards."""
    xp = namespace(direction)
    sine = xp.sqrt(direction[0] ** 2 + direction[1] ** 2)
    level = sine < 1e-12
    factor = xp.where(level, 1.0, xp.arctan2(sine, direction[2]) / xp.where(level, 1.0, sine))
    return xp.stack([-direction[1] * factor, direction[0] * factor])


def _axis_through(turn: Float[AnyArray, " 2"], point: Float[AnyArray, " 3"]) -> Float[AnyArray, " 4"]:
    """The numbers of the axis through a point."""
    xp = namespace(turn, point)
    return xp.concatenate([turn, (rotation_matrix(xp.concatenate([turn, xp.zeros(1)])).T @ point)[:2]])


def fitted_cylinder(tips: Float[AnyArray, "3 m"], radius: Float[AnyArray, ""] | None) -> tuple[AnyArray, AnyArray]:
    """Axis ``(4,)`` and radius of the cylinder that points are closest to; of this radius where it is known.

    For a given direction the best circle of the points' projections is a linear problem (|y|^2 = 2 c.y + k). Directions
    all over a hemisphere are tried, and the best of them are refined by Levenberg-Marquardt.
    """
    xp = namespace(tips, radius)
    middle, size, centred = _about_middle(tips)
    frames, least = _frames(centred), 1e-9 * centred.shape[1]
    y = xp.einsum("kca,cm->kam", frames[:, :, :2], centred)
    a, b, c = (xp.sum(y[:, i] * y[:, j], axis=1) for i, j in ((0, 0), (0, 1), (1, 1)))
    a, c = a + least, c + least
    right = xp.sum(xp.sum(y**2, axis=1)[:, None] * y, axis=2) / 2
    centres = xp.stack([c * right[:, 0] - b * right[:, 1], a * right[:, 1] - b * right[:, 0]], axis=1)
    centres = centres / (a * c - b**2)[:, None]
    distances = xp.sqrt(xp.sum((y - centres[:, :, None]) ** 2, axis=1))
    radii = xp.mean(distances, axis=1) if radius is None else xp.zeros(len(frames)) + radius / size
    upwards = xp.where(frames[:, 2, 2] < 0, -1.0, 1.0)[:, None] * frames[:, :, 2]
    # The best circles, and the principal axes: a few touches may lie nearly on several cylinders.
    error = xp.mean((distances - radii[:, None]) ** 2, axis=1)
    tried = xp.concatenate([xp.arange(3), 3 + xp.argsort(error[3:])[:_TRIED]])

    def refined(best: AnyArray, i: AnyArray) -> tuple[AnyArray, AnyArray]:
        first = _axis_through(turned_z(upwards[i]), frames[i, :, :2] @ centres[i])
        solution, cost = _refined(centred, xp.concatenate([first, radii[i][None]]), _FEW_STEPS, free=radius is None)
        # A plane is a cylinder too, of a radius far beyond the points.
        cost = xp.where(xp.abs(solution[4]) < _LARGEST_RADIUS, cost, cost + 1e6) if radius is None else cost
        return xp.where(cost < best[5], xp.concatenate([solution, cost[None]]), best), cost

    worst = xp.concatenate([xp.zeros(5), xp.zeros(1) + np.inf])
    best, _ = scan(refined, worst, tried)
    solution, _ = _refined(centred, best[:5], _STEPS, free=radius is None)
    position = size * solution[2:4] + _axis_through(solution[:2], middle[:, 0])[2:]
    return xp.concatenate([solution[:2], position]), size * solution[4]


def _frames(centred: Float[AnyArray, "3 m"]) -> Float[AnyArray, "k 3 3"]:
    """Axes that are tried, each as the last column of a rotation: the points' principal axes, since the axis of a long
    cylinder must be known to better than a step, and axes all over a hemisphere, by the golden angle."""
    xp = namespace(centred)
    _, principal = semidefinite_eigen(centred @ centred.T)
    _, principal = length_and_direction(principal)
    ordered = [principal[:, np.array(order)] for order in ((1, 2, 0), (2, 0, 1), (0, 1, 2))]
    height = (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    angle = np.pi * (3 - math.sqrt(5)) * np.arange(_DIRECTIONS)
    turns = np.arccos(height) * np.stack([np.cos(angle), np.sin(angle), np.zeros(_DIRECTIONS)])
    return xp.concatenate([xp.stack(ordered), xp.asarray(np.moveaxis(np.asarray(rotation_matrix(turns)), -1, 0))])


def _refined(
    tips: Float[AnyArray, "3 m"], first: Float[AnyArray, " 5"], steps: int, *, free: bool
) -> tuple[Float[AnyArray, " 5"], Float[AnyArray, ""]]:
    """Axis and radius with the least squares of the distances from the cylinder, from a start nearby; and the sum."""
    xp = namespace(tips, first)
    identity = xp.asarray(np.eye(5))

    def rows(z: Float[AnyArray, " 5"]) -> Float[AnyArray, "6 m"]:
        distance, _, by_axis = distances_from_axis(tips, z[:4])
        by_radius = -xp.ones_like(tips[:1]) if free else xp.zeros_like(tips[:1])
        return xp.concatenate([by_axis, by_radius, (distance - z[4])[None]])

    def step(state: tuple[AnyArray, AnyArray, AnyArray], _: Any) -> tuple[tuple[AnyArray, AnyArray, AnyArray], None]:
        z, at_z, damping = state
        gram = at_z @ at_z.T
        damped = gram[:5, :5] * (1 + damping * identity) + 1e-9 * tips.shape[1] * identity
        new = z - solve_positive_definite(damped, gram[:5, 5])
        there = rows(new)
        better = xp.sum(there[5] ** 2) < gram[5, 5]
        return (xp.where(better, new, z), xp.where(better, there, at_z), xp.where(better, 0.1, 10.0) * damping), None

    (solution, last, _), _ = scan(step, (first, rows(first), xp.asarray(1e-3)), length=steps)
    return solution, xp.sum(last[5] ** 2)


def frame_and_offset(
    coordinates: Float[AnyArray, "3 m"],
    tips: Tips,
    offset: AnyArray,
    rotations: Float[AnyArray, "m 3 3"] | None = None,
) -> tuple[AnyArray, AnyArray]:
    """A station's frame and the place of its target in the last frame, from points that the station measured.

    The tips are o + A p, with A the axes of the last frame; in the station's frame, whose rotation in the base frame is
    R, the points y are R y + c = o + A p. In R, c and p this is linear, so R is found as a matrix first, which then
    becomes the nearest rotation. Where that leaves the points far from the tips, as of few poses or of a wrist that
    turns about one point, rotations are searched, outside of compiled programs; with the orientations of the target
    that the station saw (``rotations``), where there are some.
    """
    xp, m = namespace(coordinates, tips, offset), coordinates.shape[1]
    axes = xp.stack(tips.axes, axis=1)  # (3, 3, m): columns are axes
    origin = tips.position - xp.einsum("cpm,p->cm", axes, offset)
    _, size, centred = _about_middle(coordinates)
    identity = xp.asarray(np.eye(3))
    # Unknowns: R by rows (9, times the size), the station's centre (3), p (3).
    by_matrix = (identity[:, :, None, None] * centred[None, None]).reshape(3, 9, m)
    design = xp.concatenate([by_matrix, each_pose(identity, m), -axes], axis=1)
    normal = xp.einsum("cum,cvm->uv", design, design)
    right = xp.einsum("cum,cm->u", design, origin)
    place = solve_positive_definite(normal + 1e-9 * m * xp.asarray(np.eye(15)), right)[12:]
    frame = fitted_frame(coordinates, origin + xp.einsum("cpm,p->cm", axes, place))
    if xp is not np:
        return frame, place
    rows = np.moveaxis(design, 1, 2).reshape(3 * m, 15) * np.array([float(size)] * 9 + [1.0] * 6)
    basis, singular, vectors = np.linalg.svd(rows[:, 9:], full_matrices=False)
    whole = singular > _SEEN * singular[0]
    basis, inverse = basis[:, whole], vectors[whole].T / singular[whole]
    left = np.concatenate([rows[:, :9], origin.reshape(-1, 1)], axis=1)
    left = left - basis @ (basis.T @ left)  # what no centre and no place of the target explains
    if rotations is not None:
        # The target's orientation in the last frame, A^T R S with S as the station saw it, is one for all poses.
        turned = np.einsum("iam,mjb->mabij", axes, np.asarray(rotations)).reshape(m, 9, 9)
        turned = float(size) * (turned - turned.mean(axis=0)).reshape(9 * m, 9)
        left = np.concatenate([left, np.concatenate([turned, np.zeros((9 * m, 1))], axis=1)])
    gram = left.T @ left
    first = np.asarray(rotation_matrix(frame[:3]))
    if _costs(gram, first[None])[0] <= (_NEAR * float(size)) ** 2 * m:
        return frame, place
    turn = _searched(gram, first)
    solved = inverse @ (basis.T @ (origin.reshape(-1) - rows[:, :9] @ turn.reshape(9)))
    place = solved[3:]
    return fitted_frame(coordinates, origin + np.einsum("cpm,p->cm", axes, place)), place


def _costs(gram: Float[np.ndarray, "10 10"], turns: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, " k"]:
    """Sums of squares of rows (L, b), whose products these are: |L r - b|^2 of rotations r by their rows."""
    whole = np.concatenate([turns.reshape(-1, 9), -np.ones((len(turns), 1))], axis=1)
    return np.einsum("ki,ij,kj->k", whole, gram, whole)


def _searched(gram: Float[np.ndarray, "10 10"], first: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation with the smallest sum of squares, by Levenberg and Marquardt from rotations all over."""
    turns = np.concatenate([first[None], np.moveaxis(np.asarray(rotation_matrix(_TURNS.T)), -1, 0)])
    costs, damping = _costs(gram, turns), np.full(len(turns), 1e-3)
    crosses = np.asarray(cross_matrix(np.eye(3)))  # of the axes, one each
    for _ in range(_ROUNDS):
        by_turn = np.einsum("abe,kbc->keac", crosses, turns).reshape(-1, 3, 9)
        slope = np.einsum("kei,ki->ke", by_turn, turns.reshape(-1, 9) @ gram[:9, :9] - gram[:9, 9])
        curvature = np.einsum("kei,ij,kfj->kef", by_turn, gram[:9, :9], by_turn)
        scale = np.trace(curvature, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3 + 1e-300 * np.eye(3)
        step = -np.linalg.solve(curvature + (damping[:, None, None] + 1e-12) * scale, slope[..., None])[..., 0]
        new = np.moveaxis(np.asarray(rotation_matrix(step.T)), -1, 0) @ turns
        there = _costs(gram, new)
        better = there < costs
        turns, costs = np.where(better[:, None, None], new, turns), np.where(better, there, costs)
        damping = damping * np.where(better, 0.2, 5.0)
    return turns[np.argmin(costs)]

"""Starts for unknown geometries: the sphere, plane, cylinder or frame that is closest to nearly right tips.

All in closed form but the cylinder, which has none. In NumPy and in JAX, so that studies start in a compiled program.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.linear_algebra import length_and_direction, products_by_column, semidefinite_eigen, solve_positive_definite
from ...core.numpy_or_jax import AnyArray, namespace, scan
from ...core.rotations import cross, fitted_frame, rotation_and_derivative, rotation_matrix
from .frames import as_columns
from .observation import Tips

_DIRECTIONS = 300  # of axes that are tried: a hemisphere in steps of about 8 degrees
_LARGEST_RADIUS = 30.0  # root mean square distances from the middle
_TRIED = 16  # directions that are refined
_FEW_STEPS, _STEPS = 5, 8  # of their refinement, and of the best one's


def fitted_sphere(tips: Float[AnyArray, "3 m"]) -> tuple[Float[AnyArray, " 3"], Float[AnyArray, ""]]:
    """Centre and radius of the sphere through points, by linear least squares: |t|^2 = 2 c.t + r^2 - |c|^2."""
    xp = namespace(tips)
    middle = xp.mean(tips, axis=1, keepdims=True)
    size = xp.sqrt(xp.mean((tips - middle) ** 2)) + 1e-12
    centred = (tips - middle) / size
    design = xp.concatenate([2 * centred, xp.ones_like(centred[:1])])
    normal = design @ design.T + 1e-12 * tips.shape[1] * xp.asarray(np.eye(4))
    solution = solve_positive_definite(normal, design @ xp.sum(centred**2, axis=0))
    radius = xp.sqrt(xp.maximum(solution[3] + xp.sum(solution[:3] ** 2), 0.0))
    return middle[:, 0] + size * solution[:3], size * radius


def fitted_plane(tips: Float[AnyArray, "3 m"]) -> Float[AnyArray, " 3"]:
    """The plane that points are closest to: its numbers as `Plane` has them, with the normal upwards."""
    xp = namespace(tips)
    middle = xp.mean(tips, axis=1)
    centred = tips - middle[:, None]
    scatter = centred @ centred.T
    _, vectors = semidefinite_eigen(scatter / (xp.trace(scatter) + 1e-300))
    normal = vectors[:, 2] / xp.sqrt(xp.sum(vectors[:, 2] ** 2))
    normal = xp.where(normal[2] < 0, -normal, normal)
    return xp.concatenate([turned_z(normal), (normal @ middle)[None]])


def turned_z(direction: Float[AnyArray, " 3"]) -> Float[AnyArray, " 2"]:
    """The first two components of the rotation vector, whose third is 0, that turns z to a unit vector upwards."""
    xp = namespace(direction)
    sine = xp.sqrt(direction[0] ** 2 + direction[1] ** 2)
    level = sine < 1e-12
    factor = xp.where(level, 1.0, xp.arctan2(sine, direction[2]) / xp.where(level, 1.0, sine))
    return xp.stack([-direction[1] * factor, direction[0] * factor])


def distances_from_axis(
    tips: Float[AnyArray, "3 m"], axis: Float[AnyArray, "4 ..."]
) -> tuple[Float[AnyArray, " m"], Float[AnyArray, "3 m"], Float[AnyArray, "4 m"]]:
    """Distances of tips from an axis (or from one each), mm, the unit vectors from the axis to the tips, and the
    derivatives of the distances by the axis' numbers."""
    xp, axis = namespace(tips, axis), as_columns(axis)
    w = xp.concatenate([axis[:2], xp.zeros_like(axis[:1])])
    rotation, axes = rotation_and_derivative(w)
    across_axis = rotation[:, :2]
    between = products_by_column(across_axis.swapaxes(0, 1), tips) - axis[2:]
    distance, across = length_and_direction(between)
    direction = products_by_column(across_axis, across)
    # A small rotation v of the axes moves a tip t by -v x t in them, and the distance by -v.(t x direction).
    by_rotation = -products_by_column(axes[:, :2].swapaxes(0, 1), cross(tips, direction))
    return distance, direction, xp.concatenate([by_rotation, -across])


def fitted_cylinder(
    tips: Float[AnyArray, "3 m"], radius: Float[AnyArray, ""] | None
) -> tuple[Float[AnyArray, " 4"], Float[AnyArray, ""]]:
    """Axis and radius of the cylinder that points are closest to; of this radius where it is known.

    For a given direction the best circle of the points' projections is a linear problem (|y|^2 = 2 c.y + k). Directions
    all over a hemisphere are tried, and the best of them are refined by Levenberg-Marquardt.
    """
    xp = namespace(tips, radius)
    middle = xp.mean(tips, axis=1, keepdims=True)
    size = xp.sqrt(xp.mean((tips - middle) ** 2)) + 1e-12
    centred = (tips - middle) / size
    frames = _frames(centred)
    centres, distances = _circles(frames, centred)
    radii = xp.mean(distances, axis=1) if radius is None else xp.zeros(len(frames)) + radius / size
    upwards = xp.where(frames[:, 2, 2] < 0, -1.0, 1.0)[:, None] * frames[:, :, 2]
    # The best circles, and the principal axes: a few touches may lie nearly on several cylinders.
    error = xp.mean((distances - radii[:, None]) ** 2, axis=1)
    tried = xp.concatenate([xp.arange(3), 3 + xp.argsort(error[3:])[:_TRIED]])

    def refined(best: AnyArray, i: AnyArray) -> tuple[AnyArray, AnyArray]:
        first = _moved(turned_z(upwards[i]), frames[i, :, :2] @ centres[i])
        solution, cost = _refined(centred, xp.concatenate([first, radii[i][None]]), _FEW_STEPS, free=radius is None)
        # A plane is a cylinder too, of a radius far beyond the points.
        cost = xp.where(xp.abs(solution[4]) < _LARGEST_RADIUS, cost, cost + 1e6) if radius is None else cost
        return xp.where(cost < best[5], xp.concatenate([solution, cost[None]]), best), cost

    worst = xp.concatenate([xp.zeros(5), xp.zeros(1) + np.inf])
    best, _ = scan(refined, worst, tried)
    solution, _ = _refined(centred, best[:5], _STEPS, free=radius is None)
    position = size * solution[2:4] + _moved(solution[:2], middle[:, 0])[2:]
    return xp.concatenate([solution[:2], position]), size * solution[4]


def _circles(
    frames: Float[AnyArray, "k 3 3"], centred: Float[AnyArray, "3 m"]
) -> tuple[Float[AnyArray, "k 2"], Float[AnyArray, "k m"]]:
    """Centres of the circles through the projections of points along the last axis of each frame, and the distances of
    the projections from them."""
    xp, least = namespace(frames, centred), 1e-9 * centred.shape[1]
    y = xp.einsum("kca,cm->kam", frames[:, :, :2], centred)
    a, b, c = (xp.sum(y[:, i] * y[:, j], axis=1) for i, j in ((0, 0), (0, 1), (1, 1)))
    a, c = a + least, c + least
    right = xp.sum(xp.sum(y**2, axis=1)[:, None] * y, axis=2) / 2
    centre = xp.stack([c * right[:, 0] - b * right[:, 1], a * right[:, 1] - b * right[:, 0]], axis=1)
    centre = centre / (a * c - b**2)[:, None]
    return centre, xp.sqrt(xp.sum((y - centre[:, :, None]) ** 2, axis=1))


def _moved(turn: Float[AnyArray, " 2"], point: Float[AnyArray, " 3"]) -> Float[AnyArray, " 4"]:
    """The numbers of the axis through a point."""
    xp = namespace(turn, point)
    return xp.concatenate([turn, (rotation_matrix(xp.concatenate([turn, xp.zeros(1)])).T @ point)[:2]])


def _frames(centred: Float[AnyArray, "3 m"]) -> Float[AnyArray, "k 3 3"]:
    """Axes that are tried, each as the last column of a rotation: the points' principal axes, since the axis of a long
    cylinder must be known to better than a step, and axes all over a hemisphere, by the golden angle."""
    xp = namespace(centred)
    _, principal = semidefinite_eigen(centred @ centred.T)
    principal = principal / xp.sqrt(xp.sum(principal**2, axis=0) + 1e-300)[None]
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
    coordinates: Float[AnyArray, "3 m"], tips: Tips, offset: Float[AnyArray, " 3"]
) -> tuple[Float[AnyArray, " 6"], Float[AnyArray, " 3"]]:
    """A station's frame and the place of its target in the last frame, from points that the station measured.

    The tips are o + A p, with A the axes of the last frame; in the station's frame, whose rotation in the base frame is
    R, the points y are R y + c = o + A p. In R, c and p this is linear, so R is found as a matrix first, which then
    becomes the nearest rotation.
    """
    xp = namespace(coordinates, tips, offset)
    axes = xp.stack(tips.axes, axis=1)  # (3, 3, m): columns are axes
    origin = tips.position - xp.einsum("cpm,p->cm", axes, offset)
    size = xp.sqrt(xp.mean((coordinates - xp.mean(coordinates, axis=1, keepdims=True)) ** 2)) + 1e-9
    centred = (coordinates - xp.mean(coordinates, axis=1, keepdims=True)) / size
    m = coordinates.shape[1]
    identity = xp.asarray(np.eye(3))
    # Unknowns: R by rows (9, times the size), the station's centre (3), minus p (3).
    by_matrix = (identity[:, :, None, None] * centred[None, None]).reshape(3, 9, m)
    by_centre = xp.broadcast_to(identity[:, :, None], (3, 3, m))
    design = xp.concatenate([by_matrix, by_centre, -axes], axis=1)
    normal = xp.einsum("cum,cvm->uv", design, design)
    right = xp.einsum("cum,cm->u", design, origin)
    solution = solve_positive_definite(normal + 1e-9 * m * xp.asarray(np.eye(15)), right)
    place = solution[12:]
    target = origin + xp.einsum("cpm,p->cm", axes, place)
    return fitted_frame(coordinates, target), place

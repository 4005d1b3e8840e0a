"""Signs and zeros of the joints by what a camera saw: each hypothesis is a hand-eye calibration, A X = Z B.

Of each pose, A is the frame of the last joint in the base frame by a hypothesis, and B the frame of what the arm
carries (camera or target) in that of what stands still, as the image shows it. Where X and Z are unknown, positions
alone leave zeros tens of degrees off as likely as the right ones; orientations do not.
"""

import itertools

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm
from ..kinematics.chain import tip_pose
from .reading_search import Hypothesis

_MOST = 20_000  # hypotheses: about two seconds
_BLOCK = 2_000
_POSES = 24  # evenly from beginning to end
_KEPT = 24
_WEAK = 1e-6  # of a pose: keeps a place that is not determined at the tip


def hand_eye_hypotheses(
    arm: Arm,
    q: Float[np.ndarray, "m n"],
    points: Float[np.ndarray, "m 3"],
    axes: Float[np.ndarray, "m 3 3"],
    size: float,
) -> list[Hypothesis]:
    """The most likely signs and zeros of the columns in their order, the best first; none where too many are possible.

    Tried are all signs, and zeros of the joints in eighths of a revolution, or in quarters where those are too many:
    the base takes up the zero of the first joint, and the mount that of the last one.

    Args:
        arm: The nominal arm.
        q: Readings, rad.
        points: Of what the arm carries, in the frame of what stands still, mm.
        axes: Its axes there, as columns.
        size: Of the arm, mm; a quarter of it is the lever of an error of orientation.
    """
    n, poses = arm.joints, np.unique(np.linspace(0, len(q) - 1, min(len(q), _POSES)).astype(int))
    q, points, axes = q[poses], points[poses], axes[poses]
    signs = np.array(list(itertools.product((1, -1), repeat=n)))
    free = [0 < i < n - 1 and i + 1 not in arm.prismatic for i in range(n)]
    steps = next((k for k in (8, 4) if len(signs) * k ** sum(free) <= _MOST), None)
    if steps is None:
        return []
    grid = (len(signs), *(steps if moves else 1 for moves in free))
    costs = np.empty(np.prod(grid))
    for start in range(0, len(costs), _BLOCK):
        rows = np.arange(start, min(start + _BLOCK, len(costs)))
        sign, *turns = np.unravel_index(rows, grid)
        zeros = 2 * np.pi / steps * np.stack(turns, axis=1)
        costs[rows] = _costs(arm, q * signs[sign][:, None] + zeros[:, None], points, axes, size / 4)
    costs = costs.reshape(grid)
    least = np.ones(grid, dtype=bool)  # no neighbour, whose zero is one step away, is better
    for axis, shift in itertools.product(range(1, n + 1), (1, -1)):
        least &= costs <= np.roll(costs, shift, axis)
    chosen = np.argwhere(least)[np.argsort(costs[least], kind="stable")[:_KEPT]].tolist()
    turn, order = 2 * np.pi / steps, tuple(range(n))
    return [Hypothesis(order, tuple(signs[sign].tolist()), tuple(turn * k for k in turns)) for sign, *turns in chosen]


def _costs(
    arm: Arm,
    q: Float[np.ndarray, "h m n"],
    points: Float[np.ndarray, "m 3"],
    axes: Float[np.ndarray, "m 3 3"],
    lever: float,
) -> Float[np.ndarray, " h"]:
    """Sum of squares, mm2, after the mount and the place of what stands still have been fitted (Shah 2013)."""
    poses = np.asarray(tip_pose(to_numpy(arm.geometry), q.reshape(-1, arm.joints))).reshape(*q.shape[:2], 4, 4)
    turned, tips = poses[..., :3, :3], poses[..., :3, 3]
    # The trace of the sum of A X B^T Z^T is bilinear in the elements of X and Z.
    products = np.einsum("hmab,mcd->hacbd", turned, axes, optimize=True).reshape(len(q), 9, 9)
    left, _, right = np.linalg.svd(products)
    place, mount = _rotations(left[:, :, 0]), _rotations(right[:, 0])
    turning = np.sum((turned @ mount[:, None] - place[:, None] @ axes) ** 2, axis=(1, 2, 3)) / 2  # of small angles
    seen = points @ place.swapaxes(1, 2) - tips
    seen -= seen.mean(axis=1, keepdims=True)
    design = turned - turned.mean(axis=1, keepdims=True)
    normal = np.sum(design.swapaxes(2, 3) @ design, axis=1) + _WEAK * len(points) * np.eye(3)
    offset = np.linalg.solve(normal, np.sum(design.swapaxes(2, 3) @ seen[..., None], axis=1))
    return lever**2 * turning + np.sum((seen[..., None] - design @ offset[:, None]) ** 2, axis=(1, 2, 3))


def _rotations(elements: Float[np.ndarray, "h 9"]) -> Float[np.ndarray, "h 3 3"]:
    """The rotations nearest to multiples, also negative ones, of rotations."""
    matrices = elements.reshape(-1, 3, 3)
    u, _, v = np.linalg.svd(matrices * np.sign(np.linalg.det(matrices))[:, None, None])
    return u @ v

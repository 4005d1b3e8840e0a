"""The Denavit-Hartenberg chain: one forward pass from base to tip. Its derivatives are in `jacobian`.

Layout of the arrays: joints first, then the batch, then the three components of a vector, then the N configurations:
``(n, ..., 3, N)``. One loop over the joints works on contiguous rows of configurations, which suits XLA on a CPU and
on a GPU. (Measured, 70 configurations x 21 columns on one core: 30 us; unrolled joint by joint 180-580 us, because
XLA then computes the chain again for every column. `forward_pass_by_joints` prevents that, for batches on a CPU.)
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray, compiled, namespace, scan

_UNIT = 1000.0  # mm: a slide of 1 mm counts as much as a rotation of 1 mrad, like the natural steps of parameters


@jax.tree_util.register_static
@dataclass(frozen=True)
class JointKinds:
    """Which joints of a chain are prismatic: a node without leaves, so that it is static in every program.

    A chain of revolute joints has None in its place: its programs are then those of an arm that knows no other joints.
    """

    prismatic: tuple[bool, ...]

    @property
    def units(self) -> Float[np.ndarray, " n"]:
        """Changes of the readings that count as much as each other: 1 rad, and 1000 mm of prismatic joints."""
        return np.where(self.mask(), _UNIT, 1.0)

    def mask(self, rank: int = 1) -> Bool[np.ndarray, "n ..."]:
        """Whether each joint is prismatic, with axes of length 1 after the first up to the given rank."""
        return np.asarray(self.prismatic).reshape(-1, *(1,) * (rank - 1))


class Geometry(NamedTuple):
    """Parameters of a chain as arrays, and the static facts about its joints.

    Lengths mm, angles rad; ``beta`` is None where Hayati's angle is unused, ``kinds`` where all joints are revolute.
    """

    alpha: Float[AnyArray, "... n"]
    a: Float[AnyArray, "... n"]
    d: Float[AnyArray, "... n"]
    theta: Float[AnyArray, "... n"]
    beta: Float[AnyArray, "... n"] | None
    probe: Float[AnyArray, "... 3"]
    kinds: JointKinds | None = None


class JointMotion(NamedTuple):
    """What readings do to the joints: all that the chain needs of them, evaluated once a capture.

    A revolute joint rotates by its reading, a prismatic one slides by it along its axis. ``slide`` is None for a chain
    of revolute joints.
    """

    cos: Float[AnyArray, "n ... 1 N"]
    sin: Float[AnyArray, "n ... 1 N"]
    slide: Float[AnyArray, "n ... 1 N"] | None  # mm


class ForwardPass(NamedTuple):
    """The last frame, the tip, and the unit axes and origins that the Jacobian is made of; base frame, mm.

    The axes and origins are arrays with the joints first; of `forward_pass_by_joints`, tuples of one array a joint.
    """

    frame: tuple[Float[AnyArray, "... 3 N"], Float[AnyArray, "... 3 N"], Float[AnyArray, "... 3 N"]]  # x, y, z
    tip: Float[AnyArray, "... 3 N"]
    z_before: Float[AnyArray, "n ... 3 N"]  # axis of the reading, theta and d
    origin_before: Float[AnyArray, "n ... 3 N"]
    x: Float[AnyArray, "n ... 3 N"]  # axis of a and alpha
    y: Float[AnyArray, "n ... 3 N"] | None  # axis of beta
    origin: Float[AnyArray, "n ... 3 N"]
    kinds: JointKinds | None = None


def joints_first(values: Any, rank: int) -> Any:
    """``(..., n) -> (n, ..., 1, N)``: the last axis first, ``rank`` batch axes, and one for components before the last.

    Accepts NumPy and JAX arrays.
    """
    moved = values.transpose(values.ndim - 1, *range(values.ndim - 1))
    batch = (1,) * (rank - moved.ndim + 1) + moved.shape[1:]
    return moved.reshape(*moved.shape[:1], *batch[:-1], 1, *batch[-1:])


def reading_units(geometry: Geometry) -> Float[np.ndarray, " n"]:
    """`JointKinds.units`, also for a chain of revolute joints."""
    return np.ones(geometry.alpha.shape[-1]) if geometry.kinds is None else geometry.kinds.units


def joint_motion(geometry: Geometry, q: Float[AnyArray, "... n"]) -> JointMotion:
    """What readings do to the joints of a chain, for `forward_pass`: computed once for many arms of the same kind.

    Cosines and sines are half of the time of a forward pass. Only the static part of the geometry matters, so that one
    motion serves every iteration of an identification.

    Args:
        geometry: The chain, whose parameters may be anything.
        q: Readings ``(..., n)``, rad, or mm of prismatic joints.
    """
    return joint_motion_of_rows(geometry, joints_first(q, max(q.ndim - 1, 1)))


def joint_motion_of_rows(geometry: Geometry, rows: Float[AnyArray, "n ... 1 N"]) -> JointMotion:
    """`joint_motion` of readings that have the joints first and the configurations last."""
    xp = namespace(rows)
    if geometry.kinds is None:
        return JointMotion(xp.cos(rows), xp.sin(rows), None)
    prismatic = geometry.kinds.mask(rows.ndim)
    angle = xp.where(prismatic, 0.0, rows)
    return JointMotion(xp.cos(angle), xp.sin(angle), xp.where(prismatic, rows, 0.0))


@compiled
def forward_pass(geometry: Geometry, motion: JointMotion) -> ForwardPass:
    """All frames from the base to the tip: T_i = Rz(q + theta) Tz(d) Tx(a) Rx(alpha) [Ry(beta)] of a revolute joint,
    Rz(theta) Tz(q + d) Tx(a) Rx(alpha) [Ry(beta)] of a prismatic one.

    Batches of the parameters (their leading axes) and of the motion (configurations last) broadcast.
    """
    return _forward_pass(geometry, motion, scan)


def forward_pass_by_joints(geometry: Geometry, motion: JointMotion) -> ForwardPass:
    """`forward_pass` in JAX without a loop, which fills its outputs with zeros first and copies every joint into them.

    With the Jacobian columns it takes half the time on a CPU, but twice as long to compile. The condition, which always
    holds, keeps XLA from computing the chain again in whatever uses it: it does not look into the branches. (It ignores
    an ``optimization_barrier``.)
    """

    def compute(geometry: Geometry, motion: JointMotion) -> ForwardPass:
        return _forward_pass(geometry, motion, _unrolled)

    def never(*operands: Any) -> ForwardPass:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(compute, *operands))

    possible = ~(motion.cos.ravel()[0] > 2)  # true of every cosine, also of NaN
    return jax.lax.cond(possible, compute, never, geometry, motion)


def _unrolled(body: Callable, start: Any, inputs: Any) -> tuple[Any, Any]:
    """`scan` without a loop; its outputs are tuples of one array a step."""
    rows, structure = jax.tree.flatten(inputs)
    carry, outputs = start, []
    for i in range(len(rows[0])):
        carry, output = body(carry, jax.tree.unflatten(structure, [row[i] for row in rows]))
        outputs.append(output)
    return carry, jax.tree.map(lambda *leaves: leaves, *outputs)


def _forward_pass(geometry: Geometry, motion: JointMotion, loop: Callable) -> ForwardPass:
    xp = namespace(geometry, motion)
    rank = max(motion.cos.ndim - 2, *(leaf.ndim - 1 for leaf in jax.tree.leaves(geometry)))
    motion = jax.tree.map(lambda t: xp.reshape(t, t.shape[:1] + (1,) * (rank + 2 - t.ndim) + t.shape[1:]), motion)
    parameters = jax.tree.map(lambda leaf: joints_first(leaf, rank), geometry)
    cos_theta, sin_theta = xp.cos(parameters.theta), xp.sin(parameters.theta)
    inputs = (
        (motion.cos * cos_theta - motion.sin * sin_theta, motion.sin * cos_theta + motion.cos * sin_theta),
        (xp.cos(parameters.alpha), xp.sin(parameters.alpha)),
        None if parameters.beta is None else (xp.cos(parameters.beta), xp.sin(parameters.beta)),
        parameters.a,
        parameters.d if motion.slide is None else parameters.d + motion.slide,
    )

    def joint(frame, row):
        (x, y, z), origin = frame
        (cos_angle, sin_angle), (cos_alpha, sin_alpha), beta, a, d = row
        new_x = cos_angle * x + sin_angle * y
        rotated_y = cos_angle * y - sin_angle * x
        new_origin = origin + d * z + a * new_x
        new_y = cos_alpha * rotated_y + sin_alpha * z
        new_z = cos_alpha * z - sin_alpha * rotated_y
        axes = (z, origin, new_x, None if beta is None else new_y, new_origin)
        if beta is not None:
            cos_beta, sin_beta = beta
            new_x, new_z = cos_beta * new_x - sin_beta * new_z, sin_beta * new_x + cos_beta * new_z
        return ((new_x, new_y, new_z), new_origin), axes

    batch = np.broadcast_shapes(*(leaf.shape[1:] for leaf in jax.tree.leaves((motion, parameters))))
    shape = (*batch[:-2], 3, batch[-1])
    axes_of_base = [xp.broadcast_to(axis.reshape((1,) * len(batch[:-2]) + (3, 1)), shape) for axis in xp.eye(3)]
    start = ((axes_of_base[0], axes_of_base[1], axes_of_base[2]), xp.zeros(shape))
    (frame, origin), axes = loop(joint, start, inputs)
    probe = parameters.probe
    tip = origin + probe[0] * frame[0] + probe[1] * frame[1] + probe[2] * frame[2]
    return ForwardPass(frame, tip, *axes, kinds=geometry.kinds)


def components_last(
    rows: Float[AnyArray, "... 3 N"], geometry: Geometry, q: Float[AnyArray, "... n"]
) -> Float[AnyArray, "... 3"]:
    """``(..., 3, N) -> (..., N, 3)``; without the axis of configurations where neither q nor the arm has a batch."""
    moved = namespace(rows).moveaxis(rows, -2, -1)
    return moved if max(leaf.ndim for leaf in jax.tree.leaves((geometry, q))) > 1 else moved[0]


@compiled
def tip_pose(geometry: Geometry, q: Float[AnyArray, "... n"]) -> Float[AnyArray, "... 4 4"]:
    """Homogeneous pose of the last frame with the tip as its origin (mm), in the base frame."""
    forward = forward_pass(geometry, joint_motion(geometry, q))
    columns = [components_last(rows, geometry, q) for rows in (*forward.frame, forward.tip)]
    xp = namespace(geometry, q)
    top = xp.stack(columns, axis=-1)
    bottom = xp.broadcast_to(xp.asarray(np.eye(4)[3]).reshape((1,) * (top.ndim - 1) + (4,)), (*top.shape[:-2], 1, 4))
    return xp.concatenate([top, bottom], axis=-2)

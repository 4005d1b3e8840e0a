"""The Denavit-Hartenberg chain: one forward pass from base to tip. Its derivatives are in `jacobian`.

Layout of the arrays: joints first, then the batch, then the three components of a vector, then the N configurations:
``(n, ..., 3, N)``. One loop over the joints works on contiguous rows of configurations, which suits XLA on a CPU and
on a GPU. (Measured, 70 configurations x 21 columns on one core: 30 us; unrolled joint by joint 180-580 us, because
XLA then computes the chain again for every column. `forward_pass_by_joints` prevents that, for batches on a CPU.)
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, compiled, namespace, scan

SinesCosines = tuple[Float[AnyArray, "n ... 1 N"], Float[AnyArray, "n ... 1 N"]]


class Geometry(NamedTuple):
    """Parameters of a chain as arrays. Lengths mm, angles rad; ``beta`` is None where Hayati's angle is unused."""

    alpha: Float[AnyArray, "... n"]
    a: Float[AnyArray, "... n"]
    d: Float[AnyArray, "... n"]
    theta: Float[AnyArray, "... n"]
    beta: Float[AnyArray, "... n"] | None
    probe: Float[AnyArray, "... 3"]


class ForwardPass(NamedTuple):
    """The last frame, the tip, and the unit axes and origins that the Jacobian is made of; base frame, mm.

    The axes and origins are arrays with the joints first; of `forward_pass_by_joints`, tuples of one array a joint.
    """

    frame: tuple[Float[AnyArray, "... 3 N"], Float[AnyArray, "... 3 N"], Float[AnyArray, "... 3 N"]]  # x, y, z
    tip: Float[AnyArray, "... 3 N"]
    z_before: Float[AnyArray, "n ... 3 N"]  # axis of q, theta and d
    origin_before: Float[AnyArray, "n ... 3 N"]
    x: Float[AnyArray, "n ... 3 N"]  # axis of a and alpha
    y: Float[AnyArray, "n ... 3 N"] | None  # axis of beta
    origin: Float[AnyArray, "n ... 3 N"]


def joints_first(values: Any, rank: int) -> Any:
    """``(..., n) -> (n, ..., 1, N)``: the last axis first, ``rank`` batch axes, and one for components before the last.

    Accepts NumPy and JAX arrays.
    """
    moved = values.transpose(values.ndim - 1, *range(values.ndim - 1))
    batch = (1,) * (rank - moved.ndim + 1) + moved.shape[1:]
    return moved.reshape(*moved.shape[:1], *batch[:-1], 1, *batch[-1:])


def sines_cosines(q: Float[AnyArray, "... n"]) -> SinesCosines:
    """Cosines and sines of joint angles for `forward_pass`: computed once for many arms, they save half of its time."""
    rows, xp = joints_first(q, max(q.ndim - 1, 1)), namespace(q)
    return xp.cos(rows), xp.sin(rows)


@compiled
def forward_pass(geometry: Geometry, sines_cosines: SinesCosines) -> ForwardPass:
    """All frames from the base to the tip: T_i = Rz(q + theta) Tz(d) Tx(a) Rx(alpha) [Ry(beta)].

    Batches of the parameters (their leading axes) and of the sines and cosines (configurations last) broadcast.
    """
    return _forward_pass(geometry, sines_cosines, scan)


def forward_pass_by_joints(geometry: Geometry, sines_cosines: SinesCosines) -> ForwardPass:
    """`forward_pass` in JAX without a loop, which fills its outputs with zeros first and copies every joint into them.

    With the Jacobian columns it takes half the time on a CPU, but twice as long to compile. The condition, which always
    holds, keeps XLA from computing the chain again in whatever uses it: it does not look into the branches. (It ignores
    an ``optimization_barrier``.)
    """

    def compute(geometry: Geometry, sines_cosines: SinesCosines) -> ForwardPass:
        return _forward_pass(geometry, sines_cosines, _unrolled)

    def never(*operands: Any) -> ForwardPass:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(compute, *operands))

    possible = ~(sines_cosines[0].ravel()[0] > 2)  # true of every cosine, also of NaN
    return jax.lax.cond(possible, compute, never, geometry, sines_cosines)


def _unrolled(body: Callable, start: Any, inputs: Any) -> tuple[Any, Any]:
    """`scan` without a loop; its outputs are tuples of one array a step."""
    rows, structure = jax.tree.flatten(inputs)
    carry, outputs = start, []
    for i in range(len(rows[0])):
        carry, output = body(carry, jax.tree.unflatten(structure, [row[i] for row in rows]))
        outputs.append(output)
    return carry, jax.tree.map(lambda *leaves: leaves, *outputs)


def _forward_pass(geometry: Geometry, sines_cosines: SinesCosines, loop: Callable) -> ForwardPass:
    xp = namespace(geometry, sines_cosines)
    rank = max(sines_cosines[0].ndim - 2, *(leaf.ndim - 1 for leaf in jax.tree.leaves(geometry)))
    cos_q, sin_q = (xp.reshape(t, t.shape[:1] + (1,) * (rank + 2 - t.ndim) + t.shape[1:]) for t in sines_cosines)
    parameters = jax.tree.map(lambda leaf: joints_first(leaf, rank), geometry)
    cos_theta, sin_theta = xp.cos(parameters.theta), xp.sin(parameters.theta)
    inputs = (
        (cos_q * cos_theta - sin_q * sin_theta, sin_q * cos_theta + cos_q * sin_theta),
        (xp.cos(parameters.alpha), xp.sin(parameters.alpha)),
        None if parameters.beta is None else (xp.cos(parameters.beta), xp.sin(parameters.beta)),
        parameters.a,
        parameters.d,
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

    batch = np.broadcast_shapes(*(leaf.shape[1:] for leaf in jax.tree.leaves((sines_cosines, parameters))))
    shape = (*batch[:-2], 3, batch[-1])
    axes_of_base = [xp.broadcast_to(axis.reshape((1,) * len(batch[:-2]) + (3, 1)), shape) for axis in xp.eye(3)]
    start = ((axes_of_base[0], axes_of_base[1], axes_of_base[2]), xp.zeros(shape))
    (frame, origin), axes = loop(joint, start, inputs)
    probe = parameters.probe
    tip = origin + probe[0] * frame[0] + probe[1] * frame[1] + probe[2] * frame[2]
    return ForwardPass(frame, tip, *axes)


def components_last(
    rows: Float[AnyArray, "... 3 N"], geometry: Geometry, q: Float[AnyArray, "... n"]
) -> Float[AnyArray, "... 3"]:
    """``(..., 3, N) -> (..., N, 3)``; without the axis of configurations where neither q nor the arm has a batch."""
    moved = namespace(rows).moveaxis(rows, -2, -1)
    return moved if max(leaf.ndim for leaf in jax.tree.leaves((geometry, q))) > 1 else moved[0]


@compiled
def tip_pose(geometry: Geometry, q: Float[AnyArray, "... n"]) -> Float[AnyArray, "... 4 4"]:
    """Homogeneous pose of the last frame with the tip as its origin (mm), in the base frame."""
    forward = forward_pass(geometry, sines_cosines(q))
    columns = [components_last(rows, geometry, q) for rows in (*forward.frame, forward.tip)]
    xp = namespace(geometry, q)
    top = xp.stack(columns, axis=-1)
    bottom = xp.broadcast_to(xp.asarray(np.eye(4)[3]).reshape((1,) * (top.ndim - 1) + (4,)), (*top.shape[:-2], 1, 4))
    return xp.concatenate([top, bottom], axis=-2)

"""The Denavit-Hartenberg chain itself: tip position, tip pose and their exact derivatives.

Layout of the kernels: joints first, then the batch, with the three components of a vector before its last axis, the poses:
``(n, ..., 3, N)``. One loop over the joints works on whole contiguous rows of poses, which suits XLA on a CPU and a GPU
alike. (Measured, 70 poses x 21 columns on one core: 30 us; written out joint by joint 180-580 us, because XLA then computes
the chain anew for every column, and compiling takes four times as long.)

Geometry behind every derivative: turning the chain by a small angle about a unit axis ``u`` through a point ``o`` moves
the tip by ``u x (tip - o)``; sliding it along ``u`` moves the tip by ``u``. So each Jacobian column is read off an axis of
the chain.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core._compat import SymbolicZero
from ..core.arrays import is_concrete

SinesCosines = tuple[Float[Array, "n ... 1 N"], Float[Array, "n ... 1 N"]]


class Geometry(NamedTuple):
    """Parameters of a chain as arrays. Lengths mm, angles rad; ``beta`` is None where Hayati's angle is unused."""

    alpha: Float[Array, "... n"]
    a: Float[Array, "... n"]
    d: Float[Array, "... n"]
    theta: Float[Array, "... n"]
    beta: Float[Array, "... n"] | None
    probe: Float[Array, "... 3"]


class ForwardPass(NamedTuple):
    """The last frame, the tip, and what the joints leave for the derivatives: unit axes and points on them; base frame, mm."""

    frame: tuple[Float[Array, "... 3 N"], Float[Array, "... 3 N"], Float[Array, "... 3 N"]]  # x, y, z
    tip: Float[Array, "... 3 N"]
    z_before: Float[Array, "n ... 3 N"]  # axis of q, theta and d
    origin_before: Float[Array, "n ... 3 N"]
    x: Float[Array, "n ... 3 N"]  # axis of a and alpha
    y: Float[Array, "n ... 3 N"] | None  # axis of beta
    origin: Float[Array, "n ... 3 N"]


def _rows(values: Any, rank: int) -> Any:
    """``(..., n) -> (n, ..., 1, N)``: last axis first, the batch filled up with ones to ``rank`` axes, and an axis for
    components before the last. Takes arrays of NumPy and of JAX.
    """
    moved = values.transpose(values.ndim - 1, *range(values.ndim - 1))
    batch = (1,) * (rank - moved.ndim + 1) + moved.shape[1:]
    return moved.reshape(*moved.shape[:1], *batch[:-1], 1, *batch[-1:])


def sines_cosines(q: Float[Array, "... n"]) -> SinesCosines:
    """Cosines and sines of joint angles, as `forward_pass` takes them: computed once for many arms, they save half of its time."""
    if is_concrete(q):  # at the edges, where NumPy saves compiling four kernels
        rows = _rows(np.asarray(q), max(q.ndim - 1, 1))
        return jax.device_put((np.cos(rows), np.sin(rows)))
    rows = _rows(q, max(q.ndim - 1, 1))
    return jnp.cos(rows), jnp.sin(rows)


@jax.jit
def forward_pass(geometry: Geometry, sines_cosines: SinesCosines) -> ForwardPass:
    """Walk the chain from base to flange: T_i = Rz(q + theta) Tz(d) Tx(a) Rx(alpha) [Ry(beta)].

    Batches of the parameters (their leading axes) and of the turns (poses last) broadcast.
    """
    rank = max(sines_cosines[0].ndim - 2, *(leaf.ndim - 1 for leaf in jax.tree.leaves(geometry)))
    cos_q, sin_q = (jnp.reshape(t, t.shape[:1] + (1,) * (rank + 2 - t.ndim) + t.shape[1:]) for t in sines_cosines)
    parameters = jax.tree.map(lambda leaf: _rows(leaf, rank), geometry)
    cos_theta, sin_theta = jnp.cos(parameters.theta), jnp.sin(parameters.theta)
    inputs = (
        (cos_q * cos_theta - sin_q * sin_theta, sin_q * cos_theta + cos_q * sin_theta),
        (jnp.cos(parameters.alpha), jnp.sin(parameters.alpha)),
        None if parameters.beta is None else (jnp.cos(parameters.beta), jnp.sin(parameters.beta)),
        parameters.a,
        parameters.d,
    )

    def joint(frame, row):
        (x, y, z), origin = frame
        (cos_turn, sin_turn), (cos_twist, sin_twist), tilts, a, d = row
        new_x = cos_turn * x + sin_turn * y
        turned_y = cos_turn * y - sin_turn * x
        new_origin = origin + d * z + a * new_x
        new_y = cos_twist * turned_y + sin_twist * z
        new_z = cos_twist * z - sin_twist * turned_y
        axes = (z, origin, new_x, None if tilts is None else new_y, new_origin)
        if tilts is not None:
            cos_tilt, sin_tilt = tilts
            new_x, new_z = cos_tilt * new_x - sin_tilt * new_z, sin_tilt * new_x + cos_tilt * new_z
        return ((new_x, new_y, new_z), new_origin), axes

    batch = jnp.broadcast_shapes(*(leaf.shape[1:] for leaf in jax.tree.leaves((sines_cosines, parameters))))
    shape = (*batch[:-2], 3, batch[-1])
    axes_of_base = [jnp.broadcast_to(axis.reshape((1,) * len(batch[:-2]) + (3, 1)), shape) for axis in jnp.eye(3)]
    start = ((axes_of_base[0], axes_of_base[1], axes_of_base[2]), jnp.zeros(shape))
    (frame, origin), axes = jax.lax.scan(joint, start, inputs)
    probe = parameters.probe
    tip = origin + probe[0] * frame[0] + probe[1] * frame[1] + probe[2] * frame[2]
    return ForwardPass(frame, tip, *axes)


def _cross(u: Float[Array, "... 3 N"], v: Float[Array, "... 3 N"]) -> Float[Array, "... 3 N"]:
    (u0, u1, u2), (v0, v1, v2) = ((w[..., 0, :], w[..., 1, :], w[..., 2, :]) for w in (u, v))
    return jnp.stack([u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0], axis=-2)


def jacobian_columns(forward: ForwardPass) -> dict[str, Float[Array, "k ... 3 N"]]:
    """Derivative of the tip by every parameter: kind -> one vector a joint (or a probe axis).

    ``theta`` also serves for q: the two enter only as their sum.
    """
    tip = forward.tip[None]
    columns = {
        "alpha": _cross(forward.x, tip - forward.origin),
        "a": forward.x,
        "d": forward.z_before,
        "theta": _cross(forward.z_before, tip - forward.origin_before),
        "probe": jnp.stack(forward.frame),
    }
    if forward.y is not None:
        columns["beta"] = _cross(forward.y, tip - forward.origin)
    return columns


@partial(jax.jit, static_argnames=("entries",))
def stacked_jacobian_columns(forward: ForwardPass, entries: tuple[tuple[str, int], ...]) -> Float[Array, "... p 3 N"]:
    """The Jacobian columns of named entries (kind and 0-based index; ``q`` counts as ``theta``), in their order."""
    columns = jacobian_columns(forward)
    chosen = [columns["theta" if kind == "q" else kind][i] for kind, i in entries]
    return jnp.stack(chosen, axis=-3) if chosen else jnp.zeros((*forward.tip.shape[:-2], 0, *forward.tip.shape[-2:]))


def _unrolled(rows: Float[Array, "... 3 N"], geometry: Geometry, q: Float[Array, "... n"]) -> Float[Array, "... 3"]:
    """Components last, as people index them; without the pose axis where neither q nor the arm has a batch."""
    moved = jnp.moveaxis(rows, -2, -1)
    return moved if max(leaf.ndim for leaf in jax.tree.leaves((geometry, q))) > 1 else moved[0]


@jax.custom_jvp
def _tip_position(geometry: Geometry, q: Float[Array, "... n"]) -> Float[Array, "... 3"]:
    return _unrolled(forward_pass(geometry, sines_cosines(q)).tip, geometry, q)


def _tip_position_jvp(primals, tangents):
    geometry, q = primals
    geometry_dot, q_dot = tangents
    forward = forward_pass(geometry, sines_cosines(q))
    columns = jacobian_columns(forward)
    rank = forward.tip.ndim - 1
    pairs = [(kind, getattr(geometry_dot, kind)) for kind in columns] + [("theta", q_dot)]
    moved = jnp.zeros_like(forward.tip)
    for kind, tangent in pairs:
        # Unperturbed arguments arrive as symbolic zeros: a derivative by parameters then never touches q.
        if not isinstance(tangent, SymbolicZero):
            moved = moved + jnp.sum(columns[kind] * _rows(tangent, rank), axis=0)
    return _unrolled(forward.tip, geometry, q), _unrolled(moved, geometry, q)


_tip_position.defjvp(_tip_position_jvp, symbolic_zeros=True)


@jax.jit
def tip_position(geometry: Geometry, q: Float[Array, "... n"]) -> Float[Array, "... 3"]:
    """Tip position in mm, in the base frame. Leading shapes of the parameters and of q broadcast.

    JAX's own differentiation of this function uses the analytic columns, forward and reverse, to any order.
    """
    return _tip_position(geometry, q)


@jax.jit
def tip_pose(geometry: Geometry, q: Float[Array, "... n"]) -> Float[Array, "... 4 4"]:
    """Homogeneous pose of the last frame with the tip as its origin (mm), in the base frame."""
    forward = forward_pass(geometry, sines_cosines(q))
    columns = [_unrolled(rows, geometry, q) for rows in (*forward.frame, forward.tip)]
    top = jnp.stack(columns, axis=-1)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]).reshape((1,) * (top.ndim - 1) + (4,)), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


@partial(jax.jit, static_argnames=("entries",))
def tip_jacobian(geometry: Geometry, q: Float[Array, "... n"], entries: tuple[tuple[str, int], ...]) -> Float[Array, "... 3 p"]:
    """Derivative of the tip by the named entries, each a kind (``alpha`` ... ``probe``, or ``q``) and a 0-based index."""
    stacked = stacked_jacobian_columns(forward_pass(geometry, sines_cosines(q)), entries)
    columns = jnp.moveaxis(stacked, -1, -3)
    batched = max(leaf.ndim for leaf in jax.tree.leaves((geometry, q))) > 1
    return jnp.moveaxis(columns if batched else columns[0], -2, -1)

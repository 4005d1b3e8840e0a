"""The Denavit-Hartenberg chain itself: tip position, tip pose and their exact derivatives.

Everything here is written component by component (a vector is a tuple of three arrays) and joint by joint.
An array of thousands of poses then stays one contiguous vector per component, which is what both XLA's CPU
code generator and a GPU want; 3x3 matrix products in the innermost axes are several times slower.

Geometry used by every derivative: turning the chain by a small angle about a unit axis ``u`` through a point
``o`` moves the tip by ``u x (tip - o)``; sliding it along ``u`` moves the tip by ``u``. So each Jacobian column
is read off an axis of the chain.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalars = Float[Array, "..."]
Vector = tuple[Scalars, Scalars, Scalars]
KINDS = ("alpha", "a", "d", "theta", "beta", "probe")


class Geometry(NamedTuple):
    """Parameters of a chain as arrays. Lengths mm, angles rad; ``beta`` is None where Hayati's angle is unused."""

    alpha: Float[Array, "... n"]
    a: Float[Array, "... n"]
    d: Float[Array, "... n"]
    theta: Float[Array, "... n"]
    beta: Float[Array, "... n"] | None
    probe: Float[Array, "... 3"]


class Frame(NamedTuple):
    """An orthonormal frame: axes ``x``, ``y``, ``z`` and ``origin`` (mm), in the base frame."""

    x: Vector
    y: Vector
    z: Vector
    origin: Vector


class JointAxes(NamedTuple):
    """What one joint leaves for the derivatives: unit axes, and the points those axes pass through."""

    z_before: Vector  # axis of q, theta and d
    origin_before: Vector
    x: Vector  # axis of a and alpha
    y: Vector  # axis of beta
    origin: Vector


def _combine(first: Scalars, u: Vector, second: Scalars, v: Vector) -> Vector:
    return (first * u[0] + second * v[0], first * u[1] + second * v[1], first * u[2] + second * v[2])


def _moved(origin: Vector, first: Scalars, u: Vector, second: Scalars, v: Vector) -> Vector:
    step = _combine(first, u, second, v)
    return (origin[0] + step[0], origin[1] + step[1], origin[2] + step[2])


def _cross(u: Vector, v: Vector) -> Vector:
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


def _minus(u: Vector, v: Vector) -> Vector:
    return (u[0] - v[0], u[1] - v[1], u[2] - v[2])


def walk(geometry: Geometry, q: Float[Array, "... n"]) -> tuple[Frame, list[JointAxes]]:
    """Walk the chain from base to flange: T_i = Rz(q + theta) Tz(d) Tx(a) Rx(alpha) [Ry(beta)].

    Returns the last frame and, joint by joint, the axes that the derivatives need. Leading shapes broadcast.
    """
    zero, one = jnp.zeros(()), jnp.ones(())
    frame = Frame((one, zero, zero), (zero, one, zero), (zero, zero, one), (zero, zero, zero))
    joints = []
    for i in range(q.shape[-1]):
        turn = q[..., i] + geometry.theta[..., i]
        cos_turn, sin_turn = jnp.cos(turn), jnp.sin(turn)
        x = _combine(cos_turn, frame.x, sin_turn, frame.y)
        y = _combine(-sin_turn, frame.x, cos_turn, frame.y)
        origin = _moved(frame.origin, geometry.d[..., i], frame.z, geometry.a[..., i], x)
        cos_twist, sin_twist = jnp.cos(geometry.alpha[..., i]), jnp.sin(geometry.alpha[..., i])
        y, z = _combine(cos_twist, y, sin_twist, frame.z), _combine(-sin_twist, y, cos_twist, frame.z)
        joints.append(JointAxes(frame.z, frame.origin, x, y, origin))
        if geometry.beta is not None:
            cos_tilt, sin_tilt = jnp.cos(geometry.beta[..., i]), jnp.sin(geometry.beta[..., i])
            x, z = _combine(cos_tilt, x, -sin_tilt, z), _combine(sin_tilt, x, cos_tilt, z)
        frame = Frame(x, y, z, origin)
    return frame, joints


def _tip(frame: Frame, probe: Float[Array, "... 3"]) -> Vector:
    in_plane = _moved(frame.origin, probe[..., 0], frame.x, probe[..., 1], frame.y)
    along = probe[..., 2]
    return (
        in_plane[0] + along * frame.z[0],
        in_plane[1] + along * frame.z[1],
        in_plane[2] + along * frame.z[2],
    )


def _stack(vector: Vector) -> Float[Array, "... 3"]:
    return jnp.stack(jnp.broadcast_arrays(*vector), axis=-1)


def _tip_and_columns(
    geometry: Geometry, q: Float[Array, "... n"]
) -> tuple[Vector, dict[str, list[Vector]]]:
    """Tip, and the derivative of the tip with respect to every parameter: kind -> one vector a joint (or a probe axis).

    ``theta`` also serves for q: the two enter only as their sum.
    """
    frame, joints = walk(geometry, q)
    tip = _tip(frame, geometry.probe)
    columns: dict[str, list[Vector]] = {
        "alpha": [_cross(joint.x, _minus(tip, joint.origin)) for joint in joints],
        "a": [joint.x for joint in joints],
        "d": [joint.z_before for joint in joints],
        "theta": [_cross(joint.z_before, _minus(tip, joint.origin_before)) for joint in joints],
        "probe": [frame.x, frame.y, frame.z],
    }
    if geometry.beta is not None:
        columns["beta"] = [_cross(joint.y, _minus(tip, joint.origin)) for joint in joints]
    return tip, columns


@jax.custom_jvp
def tip_position(geometry: Geometry, q: Float[Array, "... n"]) -> Float[Array, "... 3"]:
    """Tip position in mm, in the base frame. Leading shapes of the parameters and of q broadcast.

    JAX's own differentiation of this function uses the analytic columns, forward and reverse, to any order.
    """
    frame, _ = walk(geometry, q)
    return _stack(_tip(frame, geometry.probe))


def _tip_position_jvp(primals, tangents):
    geometry, q = primals
    geometry_dot, q_dot = tangents
    tip, columns = _tip_and_columns(geometry, q)
    pairs = [(kind, getattr(geometry_dot, kind)) for kind in columns] + [("theta", q_dot)]
    total = [jnp.zeros(()), jnp.zeros(()), jnp.zeros(())]
    for kind, tangent in pairs:
        # Unperturbed arguments arrive as symbolic zeros: a derivative by parameters then never touches q.
        if isinstance(tangent, jax.custom_derivatives.SymbolicZero):
            continue
        for i, column in enumerate(columns[kind]):
            for axis in range(3):
                total[axis] = total[axis] + column[axis] * tangent[..., i]
    position = _stack(tip)
    return position, jnp.broadcast_to(_stack((total[0], total[1], total[2])), position.shape)


tip_position.defjvp(_tip_position_jvp, symbolic_zeros=True)


def tip_pose(geometry: Geometry, q: Float[Array, "... n"]) -> Float[Array, "... 4 4"]:
    """Homogeneous pose of the last frame with the tip as its origin (mm), in the base frame."""
    frame, _ = walk(geometry, q)
    columns = [_stack(frame.x), _stack(frame.y), _stack(frame.z), _stack(_tip(frame, geometry.probe))]
    top = jnp.stack(jnp.broadcast_arrays(*columns), axis=-1)
    bottom = jnp.broadcast_to(jnp.array([[0.0, 0.0, 0.0, 1.0]]), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def tip_jacobian(
    geometry: Geometry, q: Float[Array, "... n"], entries: tuple[tuple[str, int], ...]
) -> Float[Array, "... 3 p"]:
    """Derivative of the tip by the named entries, each a kind (``alpha`` ... ``probe``, or ``q``) and a 0-based index."""
    tip, columns = _tip_and_columns(geometry, q)
    columns["q"] = columns["theta"]
    shape = _stack(tip).shape
    chosen = [jnp.broadcast_to(_stack(columns[kind][i]), shape) for kind, i in entries]
    return jnp.stack(chosen, axis=-1) if chosen else jnp.zeros((*shape, 0))

"""The Jacobian: exact derivatives of the tip by every parameter and joint reading, from the axes of the chain.

Rotating the chain beyond a point o by a small angle about a unit axis u moves the tip by u x (tip - o) and the last
frame by the rotation vector u; sliding it along u moves the tip by u. So each column follows from one axis of the
forward pass:

    theta_i, q_i   z before the joint, through the origin before it          d_i      z before the joint
    alpha_i        x after it, through the origin after it                   a_i      x after it
    beta_i         y after it, through the origin after it                   probe    axes of the last frame

A coefficient c_b moves one joint by phi_b, so that its column is phi_b times that of the joint's reading; the scale of
all lengths moves the tip by itself, tip / scale, since the tip is linear in them.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core._compat import SymbolicZero
from ..core.numpy_or_jax import AnyArray, compiled, namespace, set_at
from ..core.rotations import cross
from .chain import (
    ByJoint,
    ForwardPass,
    Geometry,
    JointKinds,
    JointMotion,
    KnownFunctions,
    Vectors,
    components_last,
    forward_pass,
    forward_pass_by_joints,
    joint_errors,
    joint_motion,
    joints_first,
    of_joints,
)

Indices = tuple[tuple[str, int], ...]  # parameters: each a kind (or ``q``, a reading) and a 0-based index
Columns = Float[AnyArray, "... p 3 N"]

_ROTATIONS = {"alpha": ("x", "origin"), "theta": ("z_before", "origin_before"), "beta": ("y", "origin")}
_SLIDES = {"a": "x", "d": "z_before", "probe": "frame"}
_ALL = slice(None)


def _column(forward: ForwardPass, kind: str, at: int | slice) -> Vectors:
    """Derivative of the tip by a geometric parameter of one joint (or probe axis), or of all."""
    tip = forward.tip if isinstance(at, int) else forward.tip[None]
    if kind in _ROTATIONS:
        axis, origin = (getattr(forward, name)[at] for name in _ROTATIONS[kind])
        return _of_chain(cross(axis, tip - origin), forward, at)
    if kind == "probe":
        axis = _of_chain(namespace(tip).stack(forward.frame * _tips(forward))[at], forward, at, len(forward.x))
    else:
        axis = _of_chain(getattr(forward, _SLIDES[kind])[at], forward, at)
    if forward.errors is None or forward.errors.scale is None:
        return axis
    return axis * (forward.errors.scale if isinstance(at, int) else forward.errors.scale[None])  # lengths expand


def _tips(forward: ForwardPass) -> int:
    """Number of chains, each with a tip."""
    return 1 if forward.kinds is None else max(1, len(forward.kinds.chains))


def _of_chain(columns: Vectors, forward: ForwardPass, at: int | slice, first: int = 0) -> Vectors:
    """Derivatives by joints, or by coordinates of tips, which come after the joints: 0 for those of other chains."""
    if forward.members is None:
        return columns
    at = slice(first or None, None if first else len(forward.x)) if isinstance(at, slice) else first + at
    return columns * forward.members[at]


def _columns(forward: ForwardPass, kind: str) -> Float[AnyArray, "k ... 3 N"]:
    """Derivative of the tip by all parameters of a kind."""
    if kind in ("coefficients", "gravity"):
        return _by_errors(forward, kind, joint_columns(forward), _tip_by_scale(forward))
    return _column(forward, kind, _ALL)


def _by_errors(forward: ForwardPass, kind: str, by_joint: ByJoint, by_scale: Vectors) -> Float[AnyArray, "k ... 3 N"]:
    """Columns of coefficients or of gravity, from those of the joints and of the scale of all lengths."""
    assert forward.errors is not None
    if kind == "gravity":
        return namespace(by_joint).sum(forward.errors.by_gravity * by_joint[:, None], axis=0)
    functions = forward.errors.functions
    if functions.expands:  # the last, -1, is that of the scale
        by_joint = namespace(by_joint).concatenate([by_joint, by_scale[None]])
    return forward.errors.by_coefficient * by_joint[functions.moved]


def _tip_by_scale(forward: ForwardPass) -> Vectors:
    """Derivative of the tip by the scale of all lengths."""
    return forward.tip if forward.errors is None or forward.errors.scale is None else forward.tip / forward.errors.scale


def joint_columns(forward: ForwardPass) -> ByJoint:
    """Derivative of the tip by every joint, mm per rad, or mm per mm of a prismatic joint."""
    rotations = _column(forward, "theta", _ALL)
    if forward.kinds is None:
        return rotations
    slides = _column(forward, "d", _ALL)
    return namespace(forward).where(forward.kinds.mask(rotations.ndim), slides, rotations)


def joint_rotations(forward: ForwardPass) -> ByJoint:
    """Derivative of the last frame's orientation, as a rotation vector, by every joint."""
    if forward.kinds is None:
        return forward.z_before
    rotations = namespace(forward).where(forward.kinds.mask(forward.z_before.ndim), 0.0, forward.z_before)
    return _of_chain(rotations, forward, _ALL)


def reading_columns(forward: ForwardPass) -> ByJoint:
    """Derivative of the tip by every joint reading, mm per rad, or mm per mm of a prismatic joint.

    A reading enters only in its sum with ``theta``, or with ``d`` of a prismatic joint, of its joint and of those that
    move with it (`chain.full_couplings`). That corrections change with the readings, by as little as a gear ratio errs,
    is left out here; `tip_jacobian` has it.
    """
    return _by_readings(forward, joint_columns(forward))


def reading_rotations(forward: ForwardPass) -> ByJoint:
    """Derivative of the last frame's orientation, as a rotation vector, by every joint reading."""
    return _by_readings(forward, joint_rotations(forward))


def _by_readings(forward: ForwardPass, by_joint: ByJoint) -> ByJoint:
    """Derivatives by readings, from those by joints."""
    if forward.kinds is not None and forward.kinds.followers:
        by_joint = namespace(by_joint).tensordot(forward.kinds.by_reading.T, by_joint, axes=1)
    if forward.errors is None or forward.errors.couplings is None:
        return by_joint
    columns = [by_joint[joint] for joint in range(by_joint.shape[0])]
    for factor, (_, source, moved) in zip(forward.errors.couplings, forward.errors.functions.couplings, strict=True):
        columns[source] = columns[source] + factor * by_joint[moved]
    return namespace(by_joint).stack(columns)


def _parameters(kinds: JointKinds | None, indices: Indices) -> Indices:
    """The parameters, with theta or d, which a reading is added to, in the place of ``q``."""
    slides = () if kinds is None else kinds.prismatic
    return tuple((("d" if any(slides[i : i + 1]) else "theta") if kind == "q" else kind, i) for kind, i in indices)


@compiled(jit=partial(jax.jit, static_argnames=("indices",)))
def stacked_jacobian_columns(forward: ForwardPass, indices: Indices) -> Columns:
    """The Jacobian columns of some parameters."""
    wanted = _parameters(forward.kinds, indices)
    if isinstance(forward.x, tuple):
        return _stacked([_column(forward, kind, i) for kind, i in wanted], forward)
    columns = {kind: _columns(forward, kind) for kind in dict.fromkeys(kind for kind, _ in wanted)}
    return _stacked([columns[kind][i] for kind, i in wanted], forward)


def rotation_columns(forward: ForwardPass, indices: Indices) -> Columns:
    """Derivative of the last frame's orientation, as a rotation vector, by some parameters; 0 for lengths."""
    still, wanted = namespace(forward).zeros_like(forward.tip), _parameters(forward.kinds, indices)
    axes: dict[str, Any] = {kind: getattr(forward, axis) for kind, (axis, _) in _ROTATIONS.items()}
    for kind in {kind for kind, _ in wanted} & {"coefficients", "gravity"}:
        axes[kind] = _by_errors(forward, kind, joint_rotations(forward), still)
    columns = [still if axes.get(kind) is None else axes[kind][i] for kind, i in wanted]
    of_joint = [kind in _ROTATIONS for kind, _ in wanted]
    masked = zip(columns, wanted, of_joint, strict=True)
    return _stacked([_of_chain(column, forward, i) if own else column for column, (_, i), own in masked], forward)


def _stacked(columns: list[Vectors], forward: ForwardPass) -> Columns:
    xp, shape = namespace(forward), forward.tip.shape
    return xp.stack(columns, axis=-3) if columns else xp.zeros((*shape[:-2], 0, *shape[-2:]))


class SharedColumns(NamedTuple):
    """Parameters whose columns are multiples of fewer columns, as those of a joint's coefficients are of its reading's.

    What is done to all columns (weights, products) then need be done to few of them.
    """

    few: Indices  # parameters whose columns are needed
    source: Int[np.ndarray, " p"]  # of which of them each parameter's column is a multiple
    coefficients: Int[np.ndarray, " c"]  # the parameters that are coefficients of joints
    functions: Int[np.ndarray, " c"]  # their functions

    def multiplied(self, columns: Float[AnyArray, "b r m"], forward: Any, rows: Any) -> Float[AnyArray, "p r m"]:
        """Columns of all parameters at some of the configurations, from the few."""
        if not len(self.functions):
            return columns
        assert forward.errors is not None
        by_function = forward.errors.by_coefficient[self.functions][..., rows]
        factors = namespace(columns, forward).ones((len(self.source), *by_function.shape[1:]))
        return columns[self.source] * set_at(factors, self.coefficients, by_function)


@lru_cache(maxsize=32)
def shared_columns(functions: KnownFunctions | None, indices: Indices) -> SharedColumns:
    """How the columns of some parameters follow from fewer, for an arm with these corrections."""
    # Thermal expansion moves no joint (-1): its column is its own.
    moved = [-1 if functions is None or kind != "coefficients" else int(functions.moved[i]) for kind, i in indices]
    wanted = [("q", joint) if joint >= 0 else index for joint, index in zip(moved, indices, strict=True)]
    few = {index: place for place, index in enumerate(dict.fromkeys(wanted))}
    coefficients = np.flatnonzero(np.array(moved, dtype=int) >= 0)
    return SharedColumns(
        few=tuple(few),
        source=np.array([few[index] for index in wanted], dtype=int),
        coefficients=coefficients,
        functions=np.array([indices[i][1] for i in coefficients], dtype=int),
    )


class PoseColumns(NamedTuple):
    """Tips and last frames of poses, and their derivatives by some parameters."""

    tip: Vectors
    frame: tuple[Vectors, Vectors, Vectors]
    columns: Columns  # of the tip
    turned: Columns | None  # of the last frame's orientation, as rotation vectors


def pose_columns(geometry: Geometry, motion: JointMotion, indices: Indices, rotations: bool) -> PoseColumns:
    """Of one chain without corrections; under `jax.vmap` in the way that is fastest for a batch on each platform.

    No derivative passes.
    """

    def computed(forward_pass: Callable, *operands: Any) -> PoseColumns:
        forward = forward_pass(*operands)
        turned = rotation_columns(forward, indices) if rotations else None
        return PoseColumns(forward.tip, forward.frame, stacked_jacobian_columns(forward, indices), turned)

    @jax.custom_batching.custom_vmap
    def of_one(geometry: Geometry, motion: JointMotion) -> PoseColumns:
        return computed(forward_pass, geometry, motion)

    def of_many(size: int, batched: Any, geometry: Geometry, motion: JointMotion) -> tuple[PoseColumns, Any]:
        del size

        def chain(leaf: Array, many: bool) -> Array:  # (w, 1, n), or (w, N, 3) of a tip for each pose
            leaf = leaf if many else leaf[None]
            return leaf if leaf.ndim > 2 else leaf[:, None]

        geometry = jax.tree.map(chain, geometry, batched[0])
        # Joints first, then the batch, configurations last.
        motion = jax.tree.map(lambda leaf, many: jnp.moveaxis(leaf, 0, 1) if many else leaf, motion, batched[1])
        on_cpu, elsewhere = partial(computed, forward_pass_by_joints), partial(computed, forward_pass)
        result = jax.lax.platform_dependent(geometry, motion, cpu=on_cpu, default=elsewhere)
        return result, jax.tree.map(lambda _: True, result)

    of_one.def_vmap(of_many)
    return of_one(geometry, motion)


def _plain_tip_position(geometry: Geometry, q: Float[AnyArray, "... n"]) -> Float[AnyArray, "... 3"]:
    return components_last(forward_pass(geometry, joint_motion(geometry, q)).tip, geometry, q)


_tip_position = jax.custom_jvp(_plain_tip_position)


def _tip_position_jvp(primals, tangents):
    geometry, q = primals
    geometry_dot, q_dot = tangents
    forward = forward_pass(geometry, joint_motion(geometry, q))
    rank = forward.tip.ndim - 1
    moved = jnp.zeros_like(forward.tip)
    kinds = ("alpha", "a", "d", "theta", *(() if forward.y is None else ("beta",)), "probe")
    for kind in kinds if forward.errors is None else (*kinds, "coefficients", "gravity"):
        tangent = getattr(geometry_dot, kind)
        # Unperturbed arguments arrive as symbolic zeros: a derivative by parameters then never touches q.
        if not isinstance(tangent, SymbolicZero):
            moved = moved + jnp.sum(_columns(forward, kind) * joints_first(tangent, rank), axis=0)
    if not isinstance(q_dot, SymbolicZero):
        moved = moved + jnp.sum(joint_columns(forward) * of_joints(geometry, joints_first(q_dot, rank), 0.0), axis=0)
        if geometry.corrections is not None:  # which change with the readings, and so does the scale of all lengths
            errors = lambda q: joint_errors(geometry, joint_motion(geometry, q))  # noqa: E731
            _, (by_joints, by_scale) = jax.jvp(errors, (q,), (q_dot,))
            moved = moved + jnp.sum(joint_columns(forward) * by_joints, axis=0) + by_scale * _tip_by_scale(forward)
    return components_last(forward.tip, geometry, q), components_last(moved, geometry, q)


_tip_position.defjvp(_tip_position_jvp, symbolic_zeros=True)


@compiled
def tip_position(geometry: Geometry, q: Float[AnyArray, "... n"]) -> Float[AnyArray, "... 3"]:
    """Tip position in mm, in the base frame. Leading shapes of the parameters and of q broadcast.

    JAX's own differentiation of this function uses the analytic columns, forward and reverse, to any order.
    """
    return (_plain_tip_position if namespace(geometry, q) is np else _tip_position)(geometry, q)


@compiled(jit=partial(jax.jit, static_argnames=("indices",)))
def tip_jacobian(geometry: Geometry, q: Float[AnyArray, "... n"], indices: Indices) -> Float[AnyArray, "... 3 p"]:
    """Derivative of the tip by some parameters or readings."""
    forward = forward_pass(geometry, joint_motion(geometry, q))
    stacked, xp = stacked_jacobian_columns(forward, indices), namespace(geometry, q)
    columns = xp.moveaxis(stacked, -1, -3)
    batched = max(leaf.ndim for leaf in jax.tree.leaves((geometry, q))) > 1
    columns = xp.moveaxis(columns if batched else columns[0], -2, -1)
    for place, (kind, i) in enumerate(indices):
        # Corrections change with the reading as well, and joints may follow it.
        follows = geometry.kinds is not None and geometry.kinds.followers
        if kind == "q" and (follows or geometry.corrections is not None):
            unit = jnp.broadcast_to(jnp.eye(q.shape[-1])[i], q.shape)
            by_reading = jax.jvp(partial(_tip_position, geometry), (jnp.asarray(q),), (unit,))[1]
            columns = set_at(columns, (..., place), xp.asarray(by_reading))
    return columns

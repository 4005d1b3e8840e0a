"""The Denavit-Hartenberg chain: one forward pass from base to tip. Its derivatives are in `jacobian`.

Layout of the arrays: joints first, then the batch, then the three components of a vector, then the N configurations:
``(n, ..., 3, N)``. One loop over the joints works on contiguous rows of configurations, which suits XLA on a CPU and
on a GPU. (Measured, 70 configurations x 21 columns on one core: 30 us; unrolled joint by joint 180-580 us, because
XLA then computes the chain again for every column. `forward_pass_by_joints` prevents that, for batches on a CPU.)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.numpy_or_jax import AnyArray, broadcast_after_first, compiled, namespace, scan

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


@runtime_checkable
class KnownFunction(Protocol):
    """A function of the readings that a coefficient multiplies: a term of `kinematics.corrections`; hashable."""

    @property
    def joint(self) -> int:
        """The joint that it moves, from 1; 0 where it scales all lengths."""
        ...

    @property
    def name(self) -> str:
        """Name of the coefficient."""
        ...

    @property
    def unit(self) -> str:
        """Unit of the coefficient."""
        ...

    @property
    def rows(self) -> int:
        """1, or 3 where the function is the product of the direction of gravity with three rows."""
        ...

    @property
    def kind(self) -> "KindOfFunctions":
        """What evaluates it."""
        ...


@runtime_checkable
class KindOfFunctions(Protocol):
    """What evaluates functions of a kind all at once, of which an arm may have hundreds."""

    def values(
        self, terms: Sequence[Any], q: Float[AnyArray, "n ... 1 N"], forward: "ForwardPass"
    ) -> Float[AnyArray, "rows ... 1 N"]:
        """Their rows at N configurations, with the nominal arm's frames there."""
        ...


@jax.tree_util.register_static
@dataclass(frozen=True)
class KnownFunctions:
    """The functions of a chain's corrections, static in every program."""

    each: tuple[KnownFunction, ...]

    def __hash__(self) -> int:
        return hash(self.names)  # kept: every call of a compiled program asks for it

    def values(self, q: Float[AnyArray, "n ... 1 N"], forward: "ForwardPass") -> Float[AnyArray, "rows ... 1 N"]:
        """All rows at N configurations, with the nominal arm's frames there."""
        values = [own[0].kind.values(own, q, forward) for own in self._of_one_kind]
        # Those of frames have the batch of the nominal arms, others that of the readings alone.
        batch = np.broadcast_shapes(*(each.shape[1:] for each in values))
        return namespace(q, forward).concatenate([broadcast_after_first(each, batch) for each in values])

    @cached_property
    def _of_one_kind(self) -> list[tuple[KnownFunction, ...]]:
        """Neighbours of the same kind."""
        return [tuple(own) for _, own in groupby(self.each, key=lambda function: type(function.kind))]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        return tuple(function.name for function in self.each)

    @cached_property
    def moved(self) -> Int[np.ndarray, " k"]:
        """The joint, from 0, that each function moves."""
        return np.array([function.joint - 1 for function in self.each])

    @cached_property
    def by_gravity(self) -> Bool[np.ndarray, " k"]:
        """Whether a function is the product of the direction of gravity with three rows."""
        return np.array([function.rows == 3 for function in self.each])

    @cached_property
    def first_row(self) -> Int[np.ndarray, " k"]:
        """The first row of each function."""
        rows = np.where(self.by_gravity, 3, 1)
        return np.cumsum(rows) - rows

    @cached_property
    def term_of_row(self) -> Int[np.ndarray, " rows"]:
        """The function, from 0, that each row belongs to."""
        return np.repeat(np.arange(len(self.each)), np.where(self.by_gravity, 3, 1))

    @property
    def component_of_row(self) -> Int[np.ndarray, " rows"]:
        """The component of gravity that each row is multiplied by; 3 for those of other functions."""
        return np.where(
            self.by_gravity[self.term_of_row], np.arange(len(self.term_of_row)) - self.first_row[self.term_of_row], 3
        )

    def of_joints(self, joints: int) -> Float[np.ndarray, "n k"]:
        """1 where a function moves a joint, else 0."""
        return (np.arange(joints)[:, None] == self.moved).astype(float)

    @property
    def of_lengths(self) -> Float[np.ndarray, " k"]:
        """1 for the functions that scale all lengths, else 0."""
        return np.array([float(function.joint == 0) for function in self.each])


class Corrections(NamedTuple):
    """What joints do besides their readings: known functions, and the arm on whose frames they are evaluated."""

    functions: KnownFunctions
    nominal: "Geometry"  # without corrections


class Geometry(NamedTuple):
    """Parameters of a chain as arrays, and the static facts about its joints.

    Lengths mm, angles rad; ``beta`` is None where Hayati's angle is unused, ``kinds`` where all joints are revolute,
    the last three where joints do what they read.
    """

    alpha: Float[AnyArray, "... n"]
    a: Float[AnyArray, "... n"]
    d: Float[AnyArray, "... n"]
    theta: Float[AnyArray, "... n"]
    beta: Float[AnyArray, "... n"] | None
    probe: Float[AnyArray, "... 3"]
    kinds: JointKinds | None = None
    coefficients: Float[AnyArray, "... k"] | None = None  # of the corrections' functions
    gravity: Float[AnyArray, "... 3"] | None = None  # its direction in the base frame
    corrections: Corrections | None = None


class JointMotion(NamedTuple):
    """What readings do to the joints: all that the chain needs of them, evaluated once a capture.

    A revolute joint rotates by its reading, a prismatic one slides by it along its axis. ``slide`` is None for a chain
    of revolute joints, ``functions`` for one without corrections.
    """

    cos: Float[AnyArray, "n ... 1 N"]
    sin: Float[AnyArray, "n ... 1 N"]
    slide: Float[AnyArray, "n ... 1 N"] | None  # mm
    functions: Float[AnyArray, "rows ... 1 N"] | None = None  # of the corrections


class JointErrors(NamedTuple):
    """Derivatives of what the corrections add to each joint's theta, or d of a prismatic joint."""

    by_coefficient: Float[AnyArray, "k ... 1 N"]  # of the one joint that it moves, or of the scale
    by_gravity: Float[AnyArray, "n 3 ... 1 N"]
    functions: KnownFunctions
    scale: Float[AnyArray, "... 1 N"] | None  # of all lengths, by thermal expansion; None without a term of it


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
    errors: JointErrors | None = None  # of a chain with corrections


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

    Cosines and sines are half of the time of a forward pass. Of the geometry, only what an identification does not
    change matters: the kinds of the joints, and the nominal arm of its corrections.

    Args:
        geometry: The chain, whose parameters may be anything.
        q: Readings ``(..., n)``, rad, or mm of prismatic joints; ``(..., n + 1)`` with a thermometer, C.
    """
    return joint_motion_of_rows(geometry, joints_first(q, max(q.ndim - 1, 1)))


def of_joints(geometry: Geometry, rows: Float[AnyArray, "columns ..."]) -> Float[AnyArray, "n ..."]:
    """The readings of the joints alone, which come first, without that of a thermometer."""
    joints = geometry.alpha.shape[-1]
    return rows if rows.shape[0] == joints else rows[:joints]


def joint_motion_of_rows(geometry: Geometry, rows: Float[AnyArray, "n ... 1 N"]) -> JointMotion:
    """`joint_motion` of readings that have the joints first and the configurations last."""
    corrections = geometry.corrections
    xp = namespace(rows, corrections)
    readings = of_joints(geometry, rows)
    if geometry.kinds is None:
        motion = JointMotion(xp.cos(readings), xp.sin(readings), None)
    else:
        prismatic = geometry.kinds.mask(rows.ndim)
        angle = xp.where(prismatic, 0.0, readings)
        motion = JointMotion(xp.cos(angle), xp.sin(angle), xp.where(prismatic, readings, 0.0))
    if corrections is None:
        return motion
    forward = forward_pass(corrections.nominal, motion)
    return motion._replace(functions=corrections.functions.values(rows, forward))


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


def _with_rank(motion: JointMotion, rank: int) -> JointMotion:
    """The motion with as many batch axes."""
    return jax.tree.map(lambda t: t.reshape(t.shape[:1] + (1,) * (rank + 2 - t.ndim) + t.shape[1:]), motion)


def _forward_pass(geometry: Geometry, motion: JointMotion, loop: Callable) -> ForwardPass:
    xp = namespace(geometry, motion)
    rank = max(motion.cos.ndim - 2, *(leaf.ndim - 1 for leaf in jax.tree.leaves(geometry)))
    motion = _with_rank(motion, rank)
    parameters = jax.tree.map(lambda leaf: joints_first(leaf, rank), geometry)
    theta, d, a, probe, errors = parameters.theta, parameters.d, parameters.a, parameters.probe, None
    if motion.slide is not None:
        d = d + motion.slide
    if geometry.corrections is not None:
        added, errors = _joint_errors(parameters, motion, geometry.corrections.functions)
        mask = np.zeros(()) if geometry.kinds is None else geometry.kinds.mask(added.ndim)
        theta = theta + (added if geometry.kinds is None else xp.where(mask, 0.0, added))
        d = d if geometry.kinds is None else d + xp.where(mask, added, 0.0)
        if errors.scale is not None:
            d, a, probe = (lengths * errors.scale[None] for lengths in (d, a, probe))
    cos_theta, sin_theta = xp.cos(theta), xp.sin(theta)
    inputs = (
        (motion.cos * cos_theta - motion.sin * sin_theta, motion.sin * cos_theta + motion.cos * sin_theta),
        (xp.cos(parameters.alpha), xp.sin(parameters.alpha)),
        None if parameters.beta is None else (xp.cos(parameters.beta), xp.sin(parameters.beta)),
        a,
        d,
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
    tip = origin + probe[0] * frame[0] + probe[1] * frame[1] + probe[2] * frame[2]
    return ForwardPass(frame, tip, *axes, kinds=geometry.kinds, errors=errors)


def _joint_errors(
    parameters: Geometry, motion: JointMotion, functions: KnownFunctions
) -> tuple[Float[AnyArray, "n ... 1 N"], JointErrors]:
    """What the corrections add to each joint, and its derivatives; ``parameters`` have the joints first."""
    xp = namespace(parameters, motion)
    assert motion.functions is not None
    assert parameters.coefficients is not None
    assert parameters.gravity is not None
    rows, gravity, joints = motion.functions, parameters.gravity, functions.of_joints(len(parameters.theta))
    by_coefficient, by_gravity = rows, xp.zeros((len(joints), 3, *rows.shape[1:]))
    heavy = np.flatnonzero(functions.by_gravity)
    if len(heavy):
        moments = [rows[functions.first_row[heavy] + i] for i in range(3)]
        moment = gravity[:1] * moments[0] + gravity[1:2] * moments[1] + gravity[2:] * moments[2]
        others = functions.first_row[~functions.by_gravity]
        order = np.argsort(np.concatenate([heavy, np.flatnonzero(~functions.by_gravity)]))
        by_coefficient = xp.concatenate([moment, xp.broadcast_to(rows[others], (len(others), *moment.shape[1:]))])[
            order
        ]
        weighted = xp.stack([parameters.coefficients[heavy] * each for each in moments], axis=1)
        by_gravity = xp.tensordot(joints[:, heavy], weighted, axes=1)
    added = xp.tensordot(joints, parameters.coefficients * by_coefficient, axes=1)
    of_lengths, scale = functions.of_lengths, None
    if of_lengths.any():
        scale = 1.0 + xp.tensordot(of_lengths, parameters.coefficients * by_coefficient, axes=1)
    return added, JointErrors(by_coefficient, by_gravity, functions, scale)


def joint_errors(
    geometry: Geometry, motion: JointMotion
) -> tuple[Float[AnyArray, "n ... 1 N"], Float[AnyArray, "... 1 N"]]:
    """What the corrections add to each joint's theta, rad, or to d of a prismatic joint, mm; the scale of lengths."""
    assert geometry.corrections is not None
    rank = max(motion.cos.ndim - 2, *(leaf.ndim - 1 for leaf in jax.tree.leaves(geometry)))
    parameters = jax.tree.map(lambda leaf: joints_first(leaf, rank), geometry)
    added, errors = _joint_errors(parameters, _with_rank(motion, rank), geometry.corrections.functions)
    return added, namespace(added).ones_like(added[0]) if errors.scale is None else errors.scale


def length_scale(geometry: Geometry, q: Float[AnyArray, "N n"]) -> Float[AnyArray, " N"]:
    """What all lengths of one arm are multiplied by at readings with a thermometer; 1 without thermal expansion."""
    if geometry.corrections is None or not geometry.corrections.functions.of_lengths.any():
        return namespace(q).ones_like(q[:, 0])
    return joint_errors(geometry, joint_motion(geometry, q))[1][0]


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

"""The Denavit-Hartenberg chain: one forward pass from base to tip. Its derivatives are in `jacobian`.

From the frame before joint i to the frame after it (Denavit and Hartenberg 1955; Cheng et al. 2018, eq. 1):

    T_i = Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i) [Ry(beta_i)]     revolute
    T_i = Rz(theta_i) Tz(q_i + d_i) Tx(a_i) Rx(alpha_i) [Ry(beta_i)]     prismatic

and the tip is T_1 ... T_n probe. With corrections a joint turns (or slides) by q + theta + sum_b c_b phi_b(q, T),
coefficients times known functions of the readings, and all lengths grow by 1 + sum_b c_b phi_b over the functions of
thermal expansion. They enter in three lines of `_forward_pass`.

Layout of the arrays: joints first, then the batch, then the three components of a vector, then the N configurations:
``(n, ..., 3, N)``. One loop over the joints works on contiguous rows of configurations, which suits XLA on a CPU and
on a GPU. (Measured, 70 configurations x 21 columns on one core: 30 us; unrolled joint by joint 180-580 us, because
XLA then computes the chain again for every column. `forward_pass_by_joints` prevents that, for batches on a CPU.)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.numpy_or_jax import AnyArray, compiled, namespace, scan, set_at
from .beside import Beside, Readings
from .joint_kinds import JointKinds, members_of, of_joints, to_tips
from .joint_kinds import tips_at as tips_at

Vectors = Float[AnyArray, "... 3 N"]
ByJoint = Float[AnyArray, "n ... 3 N"]  # a vector of each joint


@jax.tree_util.register_static
@dataclass(frozen=True)
class KnownFunctions:
    """The functions of a chain's corrections, static in every program: which there are is in `correction_kinds`.

    A function of gravity is the product of the direction of gravity g with three rows,

        phi_b = g_x r_b1 + g_y r_b2 + g_z r_b3,    and so    dphi_b/dg_i = r_bi,

    so that the direction can be calibrated as well; every other function is one row. The rows depend on the readings
    alone, since frames are those of the nominal arm: they are evaluated once a capture (`joint_motion`), the sums once
    an iteration (`_errors_of`).
    """

    terms: tuple[Any, ...]  # of `corrections.Term`: a coefficient's name, unit, joint and kind

    def __hash__(self) -> int:
        return hash(self.names)  # kept: every call of a compiled program asks for it

    def values(self, q: Readings, forward: Any) -> Float[AnyArray, "rows ... 1 N"]:
        """All rows at N configurations, with the nominal arm's forward pass there; neighbours of one kind together."""
        runs = [tuple(run) for _, run in groupby(self.terms, key=lambda term: type(term.kind))]
        values, xp = [run[0].kind.values(run, q, forward) for run in runs], namespace(q, forward)
        # Those of frames have the batch of the nominal arms, others that of the readings alone.
        batch = np.broadcast_shapes(*(rows.shape[1:] for rows in values))
        filled = [rows.reshape(len(rows), *(1,) * (len(batch) + 1 - rows.ndim), *rows.shape[1:]) for rows in values]
        return xp.concatenate([xp.broadcast_to(rows, (len(rows), *batch)) for rows in filled])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        return tuple(term.name for term in self.terms)

    @cached_property
    def moved(self) -> Int[np.ndarray, " k"]:
        """The joint, from 0, that each function moves; -1 where it scales all lengths."""
        return np.array([term.joint - 1 for term in self.terms])

    @cached_property
    def by_gravity(self) -> Bool[np.ndarray, " k"]:
        """Whether a function is the product of the direction of gravity with three rows."""
        return np.array([term.kind.rows == 3 for term in self.terms])

    @cached_property
    def first_row(self) -> Int[np.ndarray, " k"]:
        """The first row of each function."""
        sizes = np.where(self.by_gravity, 3, 1)
        return np.cumsum(sizes) - sizes

    @cached_property
    def couplings(self) -> tuple[tuple[int, int, int], ...]:
        """Of each function that is another joint's reading: its number, that joint, and the one it moves, from 0."""
        terms = enumerate(self.terms)
        return tuple((b, term.number - 1, term.joint - 1) for b, term in terms if term.kind.of_other_reading)

    @cached_property
    def columns(self) -> frozenset[str]:
        """Which of `beside.COLUMNS` the functions read."""
        return frozenset(term.kind.column_of(term) for term in self.terms) - {""}

    @property
    def expands(self) -> bool:
        """Whether some function scales all lengths."""
        return bool(np.any(self.moved < 0))


class JointErrors(NamedTuple):
    """What the corrections add to each joint's theta (d of a prismatic joint), and its derivatives."""

    added: Float[AnyArray, "n ... 1 N"]  # rad, or mm
    by_coefficient: Float[AnyArray, "k ... 1 N"]  # of the one joint that it moves, or of the scale
    by_gravity: Float[AnyArray, "n 3 ... 1 N"]
    functions: KnownFunctions
    scale: Float[AnyArray, "... 1 N"] | None  # of all lengths; None without thermal expansion
    couplings: Float[AnyArray, "c ... 1 N"] | None  # `full_couplings`


class Corrections(NamedTuple):
    """What joints do besides their readings: known functions, and the arm on whose frames they are evaluated."""

    functions: KnownFunctions
    nominal: "Geometry"  # without corrections


class Geometry(NamedTuple):
    """Parameters of a chain as arrays, and the static facts about its joints; mm and rad."""

    alpha: Float[AnyArray, "... n"]
    a: Float[AnyArray, "... n"]
    d: Float[AnyArray, "... n"]
    theta: Float[AnyArray, "... n"]
    beta: Float[AnyArray, "... n"] | None  # Hayati's angle; None where it is unused
    probe: Float[AnyArray, "... 3"]  # of several chains one after the other
    kinds: JointKinds | None = None
    coefficients: Float[AnyArray, "... k"] | None = None  # of the corrections' functions
    gravity: Float[AnyArray, "... 3"] | None = None  # its direction in the base frame
    corrections: Corrections | None = None  # None where joints do what they read
    beside: Beside | None = None  # what readings have beside those of the joints; None for nothing


class JointMotion(NamedTuple):
    """What readings do to the joints: all that the chain needs of them, evaluated once a capture.

    A revolute joint rotates by its reading, a prismatic one slides by it along its axis. ``slide`` is None for a chain
    of revolute joints, ``functions`` for one without corrections. Of a robot with several chains, ``members`` is 1
    where a joint, and after the joints a coordinate of the tips, is of the chain of a pose, else 0.
    """

    cos: Float[AnyArray, "n ... 1 N"]
    sin: Float[AnyArray, "n ... 1 N"]
    slide: Float[AnyArray, "n ... 1 N"] | None  # mm
    functions: Float[AnyArray, "rows ... 1 N"] | None = None  # of the corrections
    members: Float[AnyArray, "m ... 1 N"] | None = None


class ForwardPass(NamedTuple):
    """The last frame, the tip, and the unit axes and origins that the Jacobian is made of; base frame, mm.

    The axes and origins are arrays with the joints first; of `forward_pass_by_joints`, tuples of one array a joint.
    """

    frame: tuple[Vectors, Vectors, Vectors]  # x, y, z
    tip: Vectors
    z_before: ByJoint  # axis of the reading, theta and d
    origin_before: ByJoint
    x: ByJoint  # axis of a and alpha
    y: ByJoint | None  # axis of beta
    origin: ByJoint
    kinds: JointKinds | None = None
    errors: JointErrors | None = None  # of a chain with corrections
    members: Float[AnyArray, "m ... 1 N"] | None = None  # of several chains


def last_joints(forward: ForwardPass) -> set[int]:
    """The joints, from 0, whose link ends in a tip: one of each chain."""
    chains = () if forward.kinds is None else forward.kinds.chains
    return {joints[-1] for joints in chains} or {len(forward.origin) - 1}


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
    change matters: the kinds of the joints, and the nominal arm of its corrections. ``q`` is ``(..., n)``, rad, or mm
    of prismatic joints; what was recorded beside them follows (`beside`).
    """
    return joint_motion_of_rows(geometry, joints_first(q, max(q.ndim - 1, 1)))


def joint_motion_of_rows(geometry: Geometry, rows: Float[AnyArray, "n ... 1 N"]) -> JointMotion:
    """`joint_motion` of readings that have the joints first and the configurations last."""
    corrections = geometry.corrections
    xp, readings, members = namespace(rows, corrections), of_joints(geometry, rows), members_of(geometry, rows)
    moving = readings if members is None else readings * members[: len(readings)]
    if geometry.kinds is None:
        motion = JointMotion(xp.cos(readings), xp.sin(readings), None)
    else:
        prismatic = geometry.kinds.mask(rows.ndim)
        angle = xp.where(prismatic, 0.0, moving)
        slide = xp.where(prismatic, moving, 0.0) if any(geometry.kinds.prismatic) else None
        motion = JointMotion(xp.cos(angle), xp.sin(angle), slide, members=members)
    if corrections is None:
        return motion
    functions, moved = corrections.functions, motion
    if members is not None:  # the links after one weigh on it too
        whole_chains = to_tips(geometry, rows)
        moved = joint_motion_of_rows(geometry._replace(corrections=None), whole_chains)
        rows = whole_chains
    if functions.couplings and np.any(functions.by_gravity):
        # Where a reading moves another joint by as much as its own, the frames at the readings alone are far off.
        whole = full_couplings(functions, joints_first(geometry.coefficients, rows.ndim - 2))
        nominal = geometry._replace(coefficients=None, gravity=None, corrections=None)
        coupled = coupled_joints(functions, whole, readings)
        coupled = coupled if members is None else xp.concatenate([coupled, rows[len(coupled) : len(coupled) + 1]])
        moved = joint_motion_of_rows(nominal, coupled)
    recorded = Readings(readings) if geometry.beside is None else geometry.beside.split(rows)._replace(joints=readings)
    return motion._replace(functions=functions.values(recorded, forward_pass(corrections.nominal, moved)))


def full_couplings(functions: KnownFunctions, coefficients: Float[AnyArray, "k ..."]) -> Float[AnyArray, "c ..."]:
    """The whole part of each coupling's coefficient: 1 or -1 of a joint that keeps its direction when another one
    moves, as with parallel links; 0 of couplings that are errors."""
    return namespace(coefficients).round(coefficients[np.array([number for number, _, _ in functions.couplings])])


def coupled_joints(
    functions: KnownFunctions, whole: Float[AnyArray, "c ..."], readings: Float[AnyArray, "n ..."]
) -> Float[AnyArray, "n ..."]:
    """The angles of joints that move with others, from their readings."""
    joints = [readings[joint] for joint in range(readings.shape[0])]
    for factor, (_, source, moved) in zip(whole, functions.couplings, strict=True):
        joints[moved] = joints[moved] + factor * readings[source]
    return namespace(readings, whole).stack(joints)


@compiled
def forward_pass(geometry: Geometry, motion: JointMotion) -> ForwardPass:
    """All frames from the base to the tip.

    Batches of the parameters (their leading axes) and of the motion (configurations last) broadcast.
    """
    return _forward_pass(geometry, motion, scan)


def forward_pass_by_joints(geometry: Geometry, motion: JointMotion) -> ForwardPass:
    """`forward_pass` in JAX without a loop, which fills its outputs with zeros first and copies every joint into them.

    With the Jacobian columns it takes half the time on a CPU, but twice as long to compile. The condition, which always
    holds, keeps XLA from computing the chain again in whatever uses it: it does not look into the branches. (It ignores
    an ``optimization_barrier``.)
    """

    def unrolled(body: Callable, carry: Any, inputs: Any) -> tuple[Any, Any]:
        rows, structure = jax.tree.flatten(inputs)
        outputs = []
        for i in range(len(rows[0])):
            carry, output = body(carry, jax.tree.unflatten(structure, [row[i] for row in rows]))
            outputs.append(output)
        return carry, jax.tree.map(lambda *leaves: leaves, *outputs)

    def compute(geometry: Geometry, motion: JointMotion) -> ForwardPass:
        return _forward_pass(geometry, motion, unrolled)

    def never(*operands: Any) -> ForwardPass:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(compute, *operands))

    possible = ~(motion.cos.ravel()[0] > 2)  # true of every cosine, also of NaN
    return jax.lax.cond(possible, compute, never, geometry, motion)


def _joints_first(geometry: Geometry, motion: JointMotion) -> tuple[Geometry, JointMotion]:
    """Parameters with the joints first, and the motion, both with as many batch axes as the larger of them."""
    rank = max(motion.cos.ndim - 2, *(leaf.ndim - 1 for leaf in jax.tree.leaves(geometry)))
    motion = jax.tree.map(lambda t: t.reshape(t.shape[:1] + (1,) * (rank + 2 - t.ndim) + t.shape[1:]), motion)
    return jax.tree.map(lambda leaf: joints_first(leaf, rank), geometry), motion


def _forward_pass(geometry: Geometry, motion: JointMotion, loop: Callable) -> ForwardPass:
    xp = namespace(geometry, motion)
    parameters, motion = _joints_first(geometry, motion)
    if motion.members is not None:
        parameters = _of_chains(parameters, motion.members)
    theta, d, a, probe, errors = parameters.theta, parameters.d, parameters.a, parameters.probe, None
    if motion.slide is not None:
        d = d + motion.slide
    if geometry.corrections is not None:
        errors = _errors_of(parameters, motion)
        if motion.members is not None:
            errors = errors._replace(added=errors.added * motion.members[: len(errors.added)])
        if geometry.kinds is None:
            theta = theta + errors.added
        else:
            slides = geometry.kinds.mask(errors.added.ndim)
            theta, d = theta + xp.where(slides, 0.0, errors.added), d + xp.where(slides, errors.added, 0.0)
        if errors.scale is not None:
            d, a, probe = (lengths * errors.scale[None] for lengths in (d, a, probe))
    # The angle of a joint is a sum, whose cosine and sine follow from those of its parts: the readings' are known.
    cos_theta, sin_theta = xp.cos(theta), xp.sin(theta)
    inputs = (
        (motion.cos * cos_theta - motion.sin * sin_theta, motion.sin * cos_theta + motion.cos * sin_theta),
        (xp.cos(parameters.alpha), xp.sin(parameters.alpha)),
        None if parameters.beta is None else (xp.cos(parameters.beta), xp.sin(parameters.beta)),
        a,
        d,
    )

    def joint(frame: Any, row: Any) -> tuple[Any, Any]:
        # [x y z] <- [x y z] Rz Rx Ry; the origin moves by d along z, which Rz keeps, and by a along the new x.
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
    x, y, z = (xp.broadcast_to(axis.reshape((1,) * len(batch[:-2]) + (3, 1)), shape) for axis in xp.eye(3))
    (frame, origin), axes = loop(joint, ((x, y, z), xp.zeros(shape)), inputs)
    tip = origin + probe[0] * frame[0] + probe[1] * frame[1] + probe[2] * frame[2]
    return ForwardPass(frame, tip, *axes, kinds=geometry.kinds, errors=errors, members=motion.members)


def _of_chains(parameters: Geometry, members: Float[AnyArray, "m ... 1 N"]) -> Geometry:
    """The parameters of the chain of each pose, with the joints first: joints of other chains do not move anything."""
    joints = len(parameters.theta)
    of_joints, probe = members[:joints], parameters.probe
    rows = {kind: getattr(parameters, kind) for kind in ("alpha", "a", "d", "theta", "beta")}
    masked = {kind: None if values is None else values * of_joints for kind, values in rows.items()}
    if len(probe) > 3:  # else that of the target that each pose held
        each = probe * members[joints:]
        probe = each.reshape(len(each) // 3, 3, *each.shape[1:]).sum(axis=0)
    return parameters._replace(**masked, probe=probe)


def _errors_of(parameters: Geometry, motion: JointMotion) -> JointErrors:
    """The errors of the joints; parameters and motion have the joints first."""
    assert parameters.corrections is not None
    functions, joints = parameters.corrections.functions, len(parameters.theta)
    rows: Any = motion.functions
    coefficients: Any = parameters.coefficients
    gravity: Any = parameters.gravity
    xp = namespace(rows, coefficients, gravity)
    of_joints = (np.arange(joints)[:, None] == functions.moved).astype(float)  # 1 where a function moves a joint
    by_coefficient, by_gravity = rows, xp.zeros((joints, 3, *rows.shape[1:]))
    heavy = np.flatnonzero(functions.by_gravity)
    if len(heavy):
        of_axes = [rows[functions.first_row[heavy] + i] for i in range(3)]
        moments = gravity[:1] * of_axes[0] + gravity[1:2] * of_axes[1] + gravity[2:] * of_axes[2]
        first = xp.broadcast_to(rows[functions.first_row], (len(functions.terms), *moments.shape[1:]))
        by_coefficient = set_at(first, heavy, moments)
        weighted = xp.stack([coefficients[heavy] * axis for axis in of_axes], axis=1)
        by_gravity = xp.tensordot(of_joints[:, heavy], weighted, axes=1)
    products = coefficients * by_coefficient
    added, scale = xp.tensordot(of_joints, products, axes=1), None
    couplings = full_couplings(functions, coefficients) if functions.couplings else None
    if functions.expands:
        scale = 1.0 + xp.tensordot((functions.moved < 0).astype(float), products, axes=1)
    return JointErrors(added, by_coefficient, by_gravity, functions, scale, couplings)


def joint_errors(
    geometry: Geometry, motion: JointMotion
) -> tuple[Float[AnyArray, "n ... 1 N"], Float[AnyArray, "... 1 N"]]:
    """What the corrections add to each joint's theta, rad, or to d of a prismatic joint, mm; the scale of lengths."""
    errors = _errors_of(*_joints_first(geometry, motion))
    return errors.added, namespace(errors.added).ones_like(errors.added[0]) if errors.scale is None else errors.scale


def length_scale(geometry: Geometry, q: Float[AnyArray, "N n"]) -> Float[AnyArray, " N"]:
    """What all lengths of one arm are multiplied by at readings with a thermometer; 1 without thermal expansion."""
    if geometry.corrections is None or not geometry.corrections.functions.expands:
        return namespace(q).ones_like(q[:, 0])
    return joint_errors(geometry, joint_motion(geometry, q))[1][0]


def frame_axes(forward: ForwardPass) -> tuple[AnyArray, AnyArray, AnyArray]:
    """The axes x, y, z of the frames after each joint, joints first.

    Hayati's angle turns x and z about y, so that y = z x x where it is unused, and x = y x z after it.
    """
    xp = namespace(forward)
    z = xp.concatenate([forward.z_before[1:], forward.frame[2][None]])
    if forward.y is None:
        return forward.x, xp.cross(z, forward.x, axis=-2), z
    return xp.cross(forward.y, z, axis=-2), forward.y, z


def components_last(rows: Vectors, geometry: Geometry, q: Float[AnyArray, "... n"]) -> Float[AnyArray, "... 3"]:
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

"""What joints do besides their readings: coefficients times known functions of the readings, in arrays.

A joint turns (or slides) by q + theta + sum_b c_b phi_b(q, T), and all lengths grow by 1 + sum_b c_b phi_b over the
functions of thermal expansion. A function of gravity is the product of the direction of gravity g with three rows,

    phi_b = g_x r_b1 + g_y r_b2 + g_z r_b3,    and so    dphi_b/dg_i = r_bi,

so that the direction can be calibrated as well; every other function is one row. The rows depend on the readings alone,
since frames are those of the nominal arm: they are evaluated once a capture (`chain.joint_motion`), the sums once an
iteration (`joint_errors_of`). Which functions there are is in `corrections`.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.numpy_or_jax import AnyArray, namespace, set_at


@jax.tree_util.register_static
@dataclass(frozen=True)
class KnownFunctions:
    """The functions of a chain's corrections, static in every program."""

    terms: tuple[Any, ...]  # of `corrections.Term`: a coefficient's name, unit, joint and kind

    def __hash__(self) -> int:
        return hash(self.names)  # kept: every call of a compiled program asks for it

    def values(self, q: Float[AnyArray, "n ... 1 N"], forward: Any) -> Float[AnyArray, "rows ... 1 N"]:
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


def joint_errors_of(
    functions: KnownFunctions,
    rows: Float[AnyArray, "rows ... 1 N"],
    coefficients: Float[AnyArray, "k ... 1 _"],
    gravity: Float[AnyArray, "3 ... 1 _"],
    joints: int,
) -> JointErrors:
    """The errors of the joints of a chain from the rows of its functions."""
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
    if functions.expands:
        scale = 1.0 + xp.tensordot((functions.moved < 0).astype(float), products, axes=1)
    return JointErrors(added, by_coefficient, by_gravity, functions, scale)

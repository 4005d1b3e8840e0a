"""The row builder: the residuals of every group of observations at a point, and their derivatives.

A group's rows are evaluated at once: the kind says how they follow the tips, the rotation of the last frame and its
own unknowns; the chain's analytic columns say how tips and rotations follow the parameters. Derivatives are kept by the
head of the arrow (parameters and shared geometry), and by the private numbers of the component that a row belongs to.
"""

from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import inverse_cholesky
from ..core.numpy_or_jax import AnyArray, namespace, set_at
from ..data.observations.observation import Rows
from ..kinematics.chain import ForwardPass, forward_pass
from ..kinematics.jacobian import (
    PoseColumns,
    pose_columns,
    rotation_columns,
    shared_columns,
    stacked_jacobian_columns,
)
from ..kinematics.parameters import Parameters
from ..solver.arrow import split
from .layout import Group, Layout
from .observed import Observed, tips_of
from .sockets import to_poses

_SMALL = 6  # rows, up to which sums are as fast as a product of matrices


class PriorRows(NamedTuple):
    """What is known of the parameters besides the observations: rows weight (x - mean), of standard deviation 1."""

    mean: Float[AnyArray, " p"]
    weight: Float[AnyArray, " p"]  # one over a standard deviation; 0 where nothing is known

    def residual(self, z: Float[AnyArray, " z"]) -> Float[AnyArray, " p"]:
        """The rows at a point."""
        return self.weight * (z[: self.mean.shape[0]] - self.mean)


class Whitening(NamedTuple):
    """What makes rows of standard deviation 1 of the residuals."""

    # Of each group, inverse Cholesky factors; None where all rows of a problem weigh the same, in mm.
    roots: tuple[Float[AnyArray, "_ _ _"] | None, ...]
    lengths: Float[AnyArray, " l"]  # one over a standard deviation
    certified: dict[str, Float[AnyArray, " k"]]
    prior: PriorRows | None = None
    # Of each group, the basis of rows that are reduced: where these are given, a kind's own residuals are reduced after
    # their weighting.
    bases: tuple[Float[AnyArray, "_ _ _"] | None, ...] = ()


class RowBlock(eqx.Module):
    """Rows of one group, or of relations, in standard deviations, with r of them for each of m poses."""

    white: Float[AnyArray, "r m"]
    by_head: Float[AnyArray, "h r m"] | None  # by parameters and shared geometry; None: they depend on neither
    # By the numbers of the component of each pose. None where it has none, or where the rows are coordinates less those
    # of a point, all of one weight.
    by_own: Float[AnyArray, "k r m"] | None
    class_index: int = eqx.field(static=True)  # index of the class of these components; -1 without
    sizes: tuple[int, ...] = eqx.field(static=True)  # poses of each of them, in their order
    counts: tuple[int, ...] = eqx.field(static=True, default=())  # equations of each pose, where these are not r


class PointRows(NamedTuple):
    """All rows at one point of the unknowns, before anything is weighted."""

    forward: ForwardPass | PoseColumns
    rows: list[Rows]  # of each group


def rows_at(
    space: Parameters, observed: Observed, z: Float[AnyArray, " z"], batch: bool = False, whole: bool = False
) -> PointRows:
    """The residuals of every group, with their derivatives by tips and unknowns; in a ``batch`` in the way that is
    fastest there, through which no derivative passes. Those of kinds that reduce theirs are not if ``whole``."""
    p, rows = len(space.names), []
    chain = observed.chain(space, z[:p], z[p:])
    if batch and chain.corrections is None and observed.motion is not None:
        rotations = any(stack.rotates for stack in observed.stacks)
        forward = pose_columns(chain, observed.motion, space.indices(), rotations)
    else:
        forward = forward_pass(chain, observed.motion)
    for group, stack in zip(observed.layout.groups, observed.stacks, strict=True):
        unknowns = {}
        for name, role in zip(stack.unknowns, group.roles, strict=False):
            # One column where all poses share the numbers, else one for each pose.
            if len(set(role.first)) == 1:
                unknowns[name] = z[p + role.first[0] :][: role.size, None]
            else:
                index = np.asarray(role.first)[None, :] + np.arange(role.size)[:, None]
                unknowns[name] = to_poses(z[p:][index], group.counts)
        residual = stack.residual if whole and stack.reduces else stack.residual_with_errors
        rows.append(residual(tips_of(forward, group.index), unknowns))
    return PointRows(forward, rows)


def row_blocks(
    space: Parameters, observed: Observed, z: Float[AnyArray, " z"], point: PointRows, whitening: Whitening
) -> list[RowBlock]:
    """The rows of every group with their derivatives, whitened; then those of lengths and certified values."""
    forward, layout, p = point.forward, observed.layout, len(space.names)
    xp = namespace(forward, z)
    if isinstance(forward, PoseColumns):
        shared = shared_columns(None, space.indices())
        columns, turned = forward.columns, forward.turned
    else:
        shared = shared_columns(None if forward.errors is None else forward.errors.functions, space.indices())
        columns = stacked_jacobian_columns(forward, shared.few)
        rotates = any(rows.by_rotation is not None for rows in point.rows)
        turned = rotation_columns(forward, shared.few) if rotates else None
    own_probe = np.array([kind == "probe" for kind, _ in shared.few])
    blocks = []
    parts = zip(layout.groups, observed.stacks, point.rows, whitening.roots, strict=True)
    for number, (group, stack, rows, root) in enumerate(parts):
        poses = group.index
        tip_columns = columns[..., poses]
        if root is None and stack.linear:  # a tip less a point
            by_parameters = shared.multiplied(tip_columns, forward, poses)
            by_head = _by_head(by_parameters, [rows.values[None]], group, layout.shared)
            blocks.append(RowBlock(rows.values, by_head, None, group.class_index, group.sizes))
            continue
        assert root is not None
        if stack.reduces and rows.basis is None:
            basis = whitening.bases[number]
            assert basis is not None
            rows = stack.reduced(rows, stack.shift, (basis, root))
        else:
            rows = _whitened(rows, root)
        if group.targeted and own_probe.any():
            tip_columns = xp.where(own_probe[:, None, None], 0.0, tip_columns)
        by_parameters = times(rows.by_tip, tip_columns)
        if rows.by_rotation is not None:
            assert turned is not None
            by_parameters = by_parameters + times(rows.by_rotation, turned[..., poses])
        by_parameters = shared.multiplied(by_parameters, forward, poses)
        by_roles = [rows.by_unknowns[name] for name in stack.unknowns]
        if group.targeted:
            by_roles.append(times(rows.by_tip, xp.stack([axis[:, poses] for axis in forward.frame])))
        by_head = _by_head(by_parameters, by_roles, group, layout.shared)
        by_own = None if group.class_index < 0 else _by_own(by_roles, group, layout.classes[group.class_index][1])
        counts = tuple(stack.pose_equations.tolist()) if stack.reduces else ()
        blocks.append(RowBlock(rows.values, by_head, by_own, group.class_index, group.sizes, counts))
    return [*blocks, *_relations(observed, z[p:], whitening, p)]


def _by_head(
    by_parameters: Float[AnyArray, "p r m"], by_roles: list[Float[AnyArray, "_ _ _"]], group: Group, shared: int
) -> Float[AnyArray, "h r m"]:
    """Derivatives by the parameters and by all shared numbers, of which the group uses some."""
    if not shared:
        return by_parameters
    xp, pieces = namespace(by_parameters, by_roles), {}
    owner = np.repeat(np.arange(len(group.members)), group.counts)
    for derivative, role in zip(by_roles, group.roles, strict=True):
        if not role.private:
            for first in dict.fromkeys(role.first):
                uses = np.array([other == first for other in role.first])
                piece = derivative if uses.all() else xp.where(uses[owner], derivative, 0.0)
                pieces[first] = pieces[first] + piece if first in pieces else piece
    parts, reached = [by_parameters], 0
    for first, piece in [*sorted(pieces.items()), (shared, None)]:
        parts.append(xp.zeros((first - reached, *by_parameters.shape[1:])))
        if piece is not None:
            parts.append(piece)
            reached = first + piece.shape[0]
    return xp.concatenate(parts)


def _by_own(by_roles: list[Float[AnyArray, "_ _ _"]], group: Group, size: int) -> Float[AnyArray, "k r m"]:
    """Derivatives by the numbers of the component of each pose, in their order."""
    xp = namespace(by_roles)
    private = xp.concatenate([by for by, role in zip(by_roles, group.roles, strict=True) if role.private])
    if private.shape[0] == size:
        return private
    start = np.repeat(np.asarray(group.start), group.counts)
    whole = xp.zeros((size, *private.shape[1:]))
    for first in np.unique(start):
        piece = xp.where(start == first, private, 0.0)
        whole = set_at(whole, slice(first, first + private.shape[0]), whole[first : first + private.shape[0]] + piece)
    return whole


def _relations(observed: Observed, geometry: Float[AnyArray, " g"], whitening: Whitening, p: int) -> list[RowBlock]:
    """Rows of lengths and of certified values: of each class of components, and of the shared geometry."""
    certified, positions, layout = observed.certified(), observed.positions, observed.layout
    if not observed.ends and not certified:
        return []
    sizes, pull = observed.distances(geometry, observed.ends)
    errors, slopes, weights = [sizes - observed.nominal], [pull], [whitening.lengths]
    for name, (value, _) in certified.items():
        errors.append(geometry[positions[name]] - value)
        slopes.append((positions[name][:, None] == np.arange(len(geometry))).astype(float))
        weights.append(whitening.certified[name])
    xp = namespace(geometry, whitening)
    weight, slope, error = map(xp.concatenate, (weights, slopes, errors))
    white, (head, components) = weight * error, split(weight[:, None] * slope, layout.shared, layout.classes)
    # All numbers of a relation belong to one component, or all of them are shared.
    first = [int(positions[pair[0]][0]) for pair in observed.ends]
    first += [int(index) for name in certified for index in positions[name]]
    blocks = []
    for class_index, (rows, owner) in _relations_by_class(layout, tuple(first)).items():
        if class_index < 0:
            by_head = xp.concatenate([xp.zeros((p, len(rows))), head[rows].T])[:, None]
            blocks.append(RowBlock(white[rows][None], by_head, None, class_index, ()))
        else:
            poses = tuple(np.bincount(owner, minlength=layout.classes[class_index][0]).tolist())
            blocks.append(
                RowBlock(white[rows][None], None, components[class_index][rows, owner].T[:, None], class_index, poses)
            )
    return blocks


@lru_cache(maxsize=32)
def _relations_by_class(layout: Layout, first: tuple[int, ...]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Numbers of the relations of each class and their components, which they are sorted by; of ``first`` numbers."""
    located = [layout.component_of(index)[:2] for index in first]
    by_class = {}
    for class_index in dict.fromkeys(place[0] for place in located):
        rows = np.array([row for row, place in enumerate(located) if place[0] == class_index])
        owner = np.array([located[row][1] for row in rows])
        order = np.argsort(owner, kind="stable")
        by_class[class_index] = rows[order], owner[order]
    return by_class


def _whitened(rows: Rows, root: Float[AnyArray, "m r r"]) -> Rows:
    """Rows in standard deviations: their few derivatives by tip and geometry cost less than those by all parameters."""
    xp = namespace(rows.values, root)
    roots = xp.moveaxis(root, 0, -1)

    def product(other: Float[AnyArray, "s c m"]) -> Float[AnyArray, "r c m"]:
        return xp.moveaxis(times(roots, xp.moveaxis(other, 1, 0)), 0, 1)

    return rows._replace(
        values=times(roots, rows.values[None])[0],
        by_tip=product(rows.by_tip),
        by_rotation=None if rows.by_rotation is None else product(rows.by_rotation),
        by_unknowns={name: times(roots, derivative) for name, derivative in rows.by_unknowns.items()},
    )


def times(matrices: Float[AnyArray, "r c m"], columns: Float[AnyArray, "k c m"]) -> Float[AnyArray, "k r m"]:
    """One matrix a pose times its columns, written as sums: XLA computes many products of small matrices several times
    as slowly."""
    xp = namespace(matrices, columns)
    if xp is np and columns.shape[1] > _SMALL:
        by_pose = np.moveaxis(np.asarray(matrices), 2, 0) @ np.moveaxis(np.asarray(columns), (2, 1), (0, 1))
        return np.moveaxis(by_pose, (0, 1, 2), (2, 1, 0))
    return xp.stack([sum(row[c][None] * columns[:, c] for c in range(columns.shape[1])) for row in matrices], axis=1)


def whitening_of(
    rows: list[Rows],
    observed: Observed,
    of_arm: list[Float[AnyArray, "_ _ _"]],
    least: Float[AnyArray, ""],
) -> Whitening:
    """From the covariance of every row: what was measured, plus what the arm's own errors make of it (``of_arm``).

    ``least`` (mm) is the smallest standard uncertainty of a certified value or length that counts as such: an exact one
    would be a row of infinite weight.
    """
    xp = namespace([part.values for part in rows], of_arm, least)
    roots = tuple(inverse_cholesky(part.measured + arm) for part, arm in zip(rows, of_arm, strict=True))
    certified = {name: 1 / xp.maximum(u, least) for name, (_, u) in observed.certified().items()}
    bases = tuple(part.basis for part in rows)
    known = any(basis is not None for basis in bases)
    return Whitening(roots, 1 / xp.maximum(observed.u, least), certified, bases=bases if known else ())

"""Observations of all kinds as one least squares: the free parameters and every unknown geometry, and their rows.

The unknowns z are the p free parameters of the arm, then the numbers of each unknown geometry. Sockets are observations
here like any other. A reference length is a relation between the positions of two sockets, a certified value one of a
geometry with itself.
"""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import inverse_cholesky
from ..core.numpy_or_jax import AnyArray, added_to, namespace, to_numpy
from ..data.capture import Capture, check_one_capture, check_readings
from ..data.observations.measured_points import AbstractMeasured
from ..data.observations.observation import POINT, AbstractObservation, Rows, Tips, offset_of
from ..data.observations.platform import platform_frames
from ..data.observations.socket import Socket, position_of
from ..kinematics.arm import Arm
from ..kinematics.chain import ForwardPass, JointMotion, forward_pass, joint_motion
from ..kinematics.jacobian import rotation_columns, shared_columns, stacked_jacobian_columns
from ..kinematics.parameters import Parameters
from ..solver.active_set import QuadraticModel
from .robust import Loss

_STEPS = {"mm": 1.0, "rad": 1e-3}  # natural steps, as those of the arm's parameters


class Observed(eqx.Module):
    """Everything that a capture observed, as arrays: sockets first, then its other observations."""

    observations: tuple[AbstractObservation, ...]
    q: Float[AnyArray, "M n"]
    motion: JointMotion | None  # None where the arm does not matter, but only what is unknown
    nominal: Float[AnyArray, " l"]  # reference lengths, mm
    u: Float[AnyArray, " l"]
    ends: tuple[tuple[str, str], ...] = eqx.field(static=True)  # names of the positions at their ends
    parts: tuple[tuple[str, tuple[str, ...]], ...] = eqx.field(static=True)  # of the unknown geometry; see `blocks`

    @classmethod
    def of(cls, capture: Capture, arm: Arm | None) -> "Observed":
        """What a capture observed, by an arm with such joints; None where only what is unknown matters.

        Raises `InputError` for a batch of captures.
        """
        check_one_capture(capture)
        capture = to_numpy(capture)
        if arm is not None:
            check_readings(capture, arm)
        xp = namespace(capture)
        sockets = tuple(Socket(name, readings) for name, readings in capture.sockets.items())
        observations = to_numpy((*sockets, *capture.observations))
        q = xp.concatenate([observation.q for observation in observations])
        lengths = capture.lengths
        return cls(
            observations=observations,
            q=q,
            motion=None if arm is None else joint_motion(to_numpy(arm.geometry), q),
            nominal=xp.stack([length.value for length in lengths]) if lengths else np.zeros(0),
            u=xp.stack([length.u for length in lengths]) if lengths else np.zeros(0),
            ends=tuple((position_of(length.start), position_of(length.end)) for length in lengths),
            parts=_parts(observations),
        )

    def moved(
        self, arm: Arm, q: Float[AnyArray, "M n"], observations: tuple[AbstractObservation, ...] | None = None
    ) -> "Observed":
        """The same at other readings, and with observations that have changed along."""
        observations = self.observations if observations is None else observations
        changed = (observations, q, joint_motion(arm.geometry, q))
        return eqx.tree_at(lambda o: (o.observations, o.q, o.motion), self, changed)

    def measured_without_errors(
        self, space: Parameters, vector: Float[AnyArray, " p"], geometry: Float[AnyArray, " g"]
    ) -> "Observed":
        """The same, had every instrument measured exactly the tips of this arm in this geometry."""
        forward, parts = self.forward(space, vector, geometry), self.split(geometry)
        observations = tuple(
            one.without_errors(_tips(forward, rows), parts) if isinstance(one, AbstractMeasured) else one
            for one, rows in zip(self.observations, self.slices, strict=True)
        )
        return eqx.tree_at(lambda o: o.observations, self, observations)

    @property
    def blocks(self) -> dict[str, tuple[str, ...]]:
        """The parts of the unknown geometry, and the unit of each of their numbers."""
        return dict(self.parts)

    @property
    def positions(self) -> dict[str, np.ndarray]:
        """Indices of the numbers of each part among all of them."""
        ends = np.cumsum([len(units) for units in self.blocks.values()])
        return {
            name: np.arange(end - len(units), end) for (name, units), end in zip(self.blocks.items(), ends, strict=True)
        }

    @property
    def steps(self) -> np.ndarray:
        """Natural step of each number: 1 mm, 1 mrad."""
        return np.array([_STEPS[unit] for units in self.blocks.values() for unit in units])

    @property
    def slices(self) -> list[slice]:
        """The poses of each observation."""
        ends = np.cumsum([observation.q.shape[0] for observation in self.observations])
        return [
            slice(end - observation.q.shape[0], end) for observation, end in zip(self.observations, ends, strict=True)
        ]

    @property
    def equations(self) -> int:
        """Number of rows of `observed_rows`."""
        rows = sum(observation.rows * observation.q.shape[0] for observation in self.observations)
        return rows + len(self.ends) + sum(len(value) for value, _ in self.certified().values())

    def split(self, geometry: Float[AnyArray, " g"]) -> dict[str, Float[AnyArray, " k"]]:
        """The numbers of each part."""
        return {name: geometry[rows[0] : rows[-1] + 1] for name, rows in self.positions.items()}

    def certified(self) -> dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]:
        """Parts that have certified values: the values and their standard uncertainties."""
        found: dict[str, Any] = {}
        for observation in self.observations:
            found |= observation.certified
        return found

    def forward(self, space: Parameters, vector: Float[AnyArray, " p"], geometry: Float[AnyArray, " g"]) -> ForwardPass:
        """All poses by an arm, each with the tip that it held."""
        arm, parts = space.geometry(vector), self.split(geometry)
        if any(observation.target for observation in self.observations):
            xp = namespace(arm, geometry)
            offsets = [
                xp.broadcast_to(
                    parts[offset_of(observation.target)] if observation.target else arm.probe,
                    (observation.q.shape[0], 3),
                )
                for observation in self.observations
            ]
            arm = arm._replace(probe=xp.concatenate(offsets))
        return forward_pass(arm, self.motion)

    def start(self, space: Parameters, vector: Float[AnyArray, " p"]) -> Float[AnyArray, " g"]:
        """The unknown geometry as the observations say, one after the other, by an arm that is nearly right; the frames
        of a platform as all that stands on it says together."""
        arm = space.geometry(vector)
        forward = forward_pass(arm, self.motion)
        tips = [_tips(forward, rows) for rows in self.slices]
        found: dict[str, Any] = {}
        for observation, own in zip(self.observations, tips, strict=True):
            new = observation.start(own, arm.probe)
            if observation.target:
                new = {offset_of(observation.target): arm.probe} | new
            found = new | found  # what another observation has found stays
        found |= platform_frames(self.observations, tips)
        return namespace(arm, forward).concatenate([found[name] for name in self.blocks])


def _parts(observations: tuple[AbstractObservation, ...]) -> tuple[tuple[str, tuple[str, ...]], ...]:
    found: dict[str, tuple[str, ...]] = {}
    for observation in observations:
        found.update(observation.unknowns)
        if observation.target:
            found[offset_of(observation.target)] = POINT
    return tuple(found.items())


def _tips(forward: ForwardPass, rows: slice) -> Tips:
    x, y, z = (axis[:, rows] for axis in forward.frame)
    return Tips(forward.tip[:, rows], (x, y, z))


class Linear(NamedTuple):
    """One observation's rows at a point, with the derivatives by the numbers that they depend on."""

    rows: Rows
    jacobian: Float[AnyArray, "k r m"]
    indices: np.ndarray  # of those numbers in z


class PriorRows(NamedTuple):
    """What is known of the parameters besides the observations: rows weight (x - mean), of standard deviation 1."""

    mean: Float[AnyArray, " p"]
    weight: Float[AnyArray, " p"]  # one over a standard deviation; 0 where nothing is known


class Whitening(NamedTuple):
    """What makes rows of standard deviation 1 of the residuals."""

    roots: tuple[Float[AnyArray, "_ _ _"], ...]  # of each observation, inverse Cholesky factors
    lengths: Float[AnyArray, " l"]  # one over a standard deviation
    certified: dict[str, Float[AnyArray, " k"]]
    prior: PriorRows | None = None


def linear_rows(
    space: Parameters, observed: Observed, z: Float[AnyArray, " z"], whitening: Whitening | None = None
) -> list[Linear]:
    """The rows of every observation and their analytic derivatives; with ``whitening`` in standard deviations."""
    p = len(space.names)
    forward = observed.forward(space, z[:p], z[p:])
    xp, parts, positions = namespace(forward, z), observed.split(z[p:]), observed.positions
    functions = None if forward.errors is None else forward.errors.functions
    shared = shared_columns(functions, space.indices())
    columns = stacked_jacobian_columns(forward, shared.few)
    own_probe = np.array([kind == "probe" for kind, _ in shared.few])
    turned = None
    found = []
    for number, (observation, rows) in enumerate(zip(observed.observations, observed.slices, strict=True)):
        residual = _residual(observation, forward, rows, parts)
        if whitening is not None:
            residual = _whitened_rows(residual, whitening.roots[number])
        mine = columns[..., rows]
        blocks, indices = [], [np.arange(p)]
        if observation.target:
            mine = xp.where(own_probe[:, None, None], 0.0, mine)
        by_parameters = _times(residual.by_tip, mine)
        if residual.by_rotation is not None:
            turned = rotation_columns(forward, shared.few) if turned is None else turned
            by_parameters = by_parameters + _times(residual.by_rotation, turned[..., rows])
        by_parameters = shared.multiplied(by_parameters, forward, rows)
        if observation.target:
            axes = xp.stack([axis[:, rows] for axis in forward.frame])
            blocks.append(_times(residual.by_tip, axes))
            indices.append(p + positions[offset_of(observation.target)])
        for name, derivative in residual.by_unknowns.items():
            blocks.append(derivative)
            indices.append(p + positions[name])
        found.append(Linear(residual, xp.concatenate([by_parameters, *blocks]), np.concatenate(indices)))
    return found


def _residual(observation: AbstractObservation, forward: ForwardPass, rows: slice, parts: dict[str, AnyArray]) -> Rows:
    # Through the class: a bound method of Equinox is a module made anew, which takes as long as a socket's residual.
    return type(observation).residual(observation, _tips(forward, rows), parts)


def residual_rows(space: Parameters, observed: Observed, z: Float[AnyArray, " z"]) -> list[Rows]:
    """The rows of every observation, without derivatives by the parameters."""
    p = len(space.names)
    forward, parts = observed.forward(space, z[:p], z[p:]), observed.split(z[p:])
    return [
        _residual(observation, forward, rows, parts)
        for observation, rows in zip(observed.observations, observed.slices, strict=True)
    ]


def observed_rows(
    z: Float[AnyArray, " z"], args: tuple[Parameters, Observed, Whitening, Loss | None]
) -> tuple[AnyArray, ...]:
    """Whitened residuals of observations, lengths, certified values and the prior; half their sum of squares is what
    is minimised."""
    space, observed, whitening, loss = args
    parts = observed.split(z[len(space.names) :])
    found = []
    for residual, root in zip(residual_rows(space, observed, z), whitening.roots, strict=True):
        values = residual.values
        white = namespace(values, root).einsum("mab,bm->am", root, values)
        found.append(white if loss is None else loss.transformed(white))
    length, certified = _relations(observed, whitening, parts)
    prior = () if whitening.prior is None else (_of_prior(whitening.prior, z),)
    return (*found, length, *certified.values(), *prior)


def _of_prior(prior: PriorRows, z: Float[AnyArray, " z"]) -> Float[AnyArray, " p"]:
    return prior.weight * (z[: prior.mean.shape[0]] - prior.mean)


def _relations(
    observed: Observed, whitening: Whitening, parts: dict[str, AnyArray]
) -> tuple[Float[AnyArray, " l"], dict[str, Float[AnyArray, " k"]]]:
    """Whitened residuals of reference lengths and of certified values."""
    xp = namespace(parts, whitening)
    vectors = _vectors(observed, parts)
    lengths = whitening.lengths * (xp.sqrt(xp.sum(vectors**2, axis=1)) - observed.nominal)
    certified = {
        name: whitening.certified[name] * (parts[name] - value) for name, (value, _) in observed.certified().items()
    }
    return lengths, certified


def _vectors(observed: Observed, parts: dict[str, AnyArray]) -> Float[AnyArray, "l 3"]:
    xp = namespace(parts)
    if not observed.ends:
        return xp.zeros((0, 3))
    return xp.stack([parts[end] - parts[start] for start, end in observed.ends])


def certified_and_lengths(
    observed: Observed, z: Float[AnyArray, " z"], p: int
) -> tuple[Float[np.ndarray, "l z"], Float[np.ndarray, " l"]]:
    """Derivatives of reference lengths and of certified values by all unknowns, and their standard uncertainties."""
    unit, positions = np.eye(len(z)), observed.positions
    vectors = np.asarray(_vectors(observed, observed.split(z[p:])))
    directions = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    rows, u = [np.zeros((0, len(z)))], [np.zeros(0)]
    for (start, end), direction, own in zip(observed.ends, directions, np.asarray(observed.u), strict=True):
        rows.append((direction @ (unit[p + positions[end]] - unit[p + positions[start]]))[None])
        u.append(own[None])
    for name, (_, own) in observed.certified().items():
        rows.append(unit[p + positions[name]])
        u.append(np.asarray(own))
    return np.concatenate(rows), np.concatenate(u)


def observed_model(
    z: Float[AnyArray, " z"], args: tuple[Parameters, Observed, Whitening, Loss | None]
) -> QuadraticModel:
    """Cost, gradient and Gram matrix of `observed_rows`, block by block of the unknowns."""
    space, observed, whitening, loss = args
    xp, p = namespace(z, args), len(space.names)
    cost, gradient, gram = xp.zeros(()), xp.zeros_like(z), xp.zeros((z.shape[0], z.shape[0]))
    of_parameters, values = [], []
    for linear in linear_rows(space, observed, z, whitening):
        white, jacobian = linear.rows.values, linear.jacobian
        if loss is not None:
            each, weight = loss.cost_and_weight(white)
            cost = cost + xp.sum(each)
            white, jacobian = xp.sqrt(weight)[None] * white, xp.sqrt(weight)[None, None] * jacobian
        else:
            cost = cost + 0.5 * xp.sum(white**2)
        flat, own = jacobian.reshape(jacobian.shape[0], -1), linear.indices[p:]
        of_parameters.append(flat[:p])
        values.append(white.reshape(-1))
        gradient = added_to(gradient, own, flat[p:] @ values[-1])
        gram = added_to(gram, np.ix_(own, own), flat[p:] @ flat[p:].T)
        crossed = flat[p:] @ flat[:p].T
        gram = added_to(added_to(gram, (own, slice(p)), crossed), (slice(p), own), crossed.T)
    # The parameters are in all rows: one large product instead of one for each observation.
    whole, own = xp.concatenate(of_parameters, axis=1), slice(p)
    gradient = added_to(gradient, own, whole @ xp.concatenate(values))
    gram = added_to(gram, (own, own), whole @ whole.T)
    parts, positions = observed.split(z[p:]), observed.positions
    lengths, certified = _relations(observed, whitening, parts)
    vectors = _vectors(observed, parts)
    for i, (start, end) in enumerate(observed.ends):
        direction = vectors[i] / xp.sqrt(xp.sum(vectors[i] ** 2)) * whitening.lengths[i]
        row, indices = xp.concatenate([-direction, direction]), p + np.concatenate([positions[start], positions[end]])
        cost = cost + 0.5 * lengths[i] ** 2
        gradient = added_to(gradient, indices, row * lengths[i])
        gram = added_to(gram, np.ix_(indices, indices), row[:, None] * row[None, :])
    for name, residual in certified.items():
        indices = p + positions[name]
        cost = cost + 0.5 * xp.sum(residual**2)
        gradient = added_to(gradient, indices, whitening.certified[name] * residual)
        gram = added_to(gram, (indices, indices), whitening.certified[name] ** 2)
    if whitening.prior is not None:
        weight, residual, own = whitening.prior.weight, _of_prior(whitening.prior, z), np.arange(p)
        cost = cost + 0.5 * xp.sum(residual**2)
        gradient = added_to(gradient, own, weight * residual)
        gram = added_to(gram, (own, own), weight**2)
    return QuadraticModel(cost, gradient, gram)


def _whitened_rows(rows: Rows, root: Float[AnyArray, "m r r"]) -> Rows:
    """Rows in standard deviations: their few derivatives by tip and geometry cost less than those by all parameters."""
    each = namespace(rows.values, root).moveaxis(root, 0, -1)
    return rows._replace(
        values=_times(each, rows.values[None])[0],
        by_tip=_product(each, rows.by_tip),
        by_rotation=None if rows.by_rotation is None else _product(each, rows.by_rotation),
        by_unknowns={name: _times(each, derivative) for name, derivative in rows.by_unknowns.items()},
    )


def _product(one: Float[AnyArray, "r s m"], other: Float[AnyArray, "s c m"]) -> Float[AnyArray, "r c m"]:
    """The product of two matrices a pose."""
    xp = namespace(one, other)
    return xp.moveaxis(_times(one, xp.moveaxis(other, 1, 0)), 0, 1)


def whitened(linear: Linear, root: Float[AnyArray, "m r r"]) -> tuple[Float[AnyArray, "r m"], Float[AnyArray, "k r m"]]:
    """An observation's residuals and derivatives in standard deviations."""
    xp = namespace(linear.jacobian, root)
    each = xp.moveaxis(root, 0, -1)
    both = _times(each, xp.concatenate([linear.rows.values[None], linear.jacobian]))
    return both[0], both[1:]


def _times(matrices: Float[AnyArray, "r c m"], columns: Float[AnyArray, "k c m"]) -> Float[AnyArray, "k r m"]:
    """One matrix a pose times its columns, written as sums: XLA computes many products of small matrices several times
    as slowly."""
    xp = namespace(matrices, columns)
    return xp.stack([sum(row[c][None] * columns[:, c] for c in range(columns.shape[1])) for row in matrices], axis=1)


def whitening_of(
    linear: list[Linear],
    observed: Observed,
    of_arm: list[Float[AnyArray, "_ _ _"]],
    least: Float[AnyArray, ""],
) -> Whitening:
    """From the covariance of every row: what was measured, plus what the arm's own errors make of it (``of_arm``).

    ``least`` (mm) is the smallest standard uncertainty of a certified value or length that counts as such: an exact one
    would be a row of infinite weight.
    """
    xp = namespace([part.rows.values for part in linear], of_arm, least)
    roots = tuple(inverse_cholesky(part.rows.measured + arm) for part, arm in zip(linear, of_arm, strict=True))
    certified = {name: 1 / xp.maximum(u, least) for name, (_, u) in observed.certified().items()}
    return Whitening(roots, 1 / xp.maximum(observed.u, least), certified)

"""A problem at one point: its rows, how they are weighed, and how the unknowns follow them.

This is the only place that builds rows outside of a solve. A result keeps the linearisation of its last solve, and
whatever judges or uses a result reads it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray, namespace, set_at
from ..data.noise import Noise
from ..data.observations.observation import AbstractObservation
from ..kinematics.parameters import Parameters
from ..model.elimination import cost_and_weights
from ..model.observed import Observed
from ..model.robust import Loss
from ..model.rows import PointRows, PriorRows, RowBlock, Whitening, row_blocks, rows_at, whitening_of
from ..solver.arrow import joined
from .linear_propagation import Influence
from .tip_errors import ArmErrors, arm_errors, covariance_of_noise, covariance_of_sigma


class ObservationRows(NamedTuple):
    """The rows of one observation, r for each of its m poses."""

    observation: AbstractObservation
    poses: slice  # among all
    values: Float[AnyArray, "r m"]  # mm and rad
    by_tip: Float[AnyArray, "r 3 m"]
    by_readings: Float[AnyArray, "r n m"]  # mm (or rad) a rad, or a mm of prismatic joints
    by_seat: Float[AnyArray, "r c m"]
    measured: Float[AnyArray, "m r r"]  # covariance of what was measured
    root: Float[AnyArray, "m r r"]  # inverse Cholesky factor of the covariance of the rows
    weight: Float[AnyArray, " m"]  # by a robust loss


class Linearisation(NamedTuple):
    """A problem linear at a point."""

    observed: Observed
    space: Parameters
    z: Float[AnyArray, " z"]  # parameters, then the unknown geometry
    point: PointRows
    errors: list[ArmErrors]
    whitening: Whitening
    blocks: list[RowBlock]  # whitened rows of groups, then of lengths and certified values
    weights: list[Float[AnyArray, " _"] | None]

    @classmethod
    def at(
        cls,
        observed: Observed,
        space: Parameters,
        z: Float[AnyArray, " z"],
        *,
        noise: Noise | None = None,
        sigma: Float[AnyArray, ""] | float = 1.0,
        least: Float[AnyArray, ""] | float,
        loss: Loss | None = None,
        prior: PriorRows | None = None,
    ) -> "Linearisation":
        """At parameters and geometry, by the noise of readings and seat, or where that is None by the standard
        deviation ``sigma`` of a tip coordinate; ``least`` is the smallest u of what is certified, mm."""
        point = rows_at(space, observed, z)
        errors = arm_errors(point, observed)
        xp = namespace(z, sigma)
        of_arm = [
            covariance_of_sigma(error, xp.asarray(sigma)) if noise is None else covariance_of_noise(error, noise)
            for error in errors
        ]
        whitening = whitening_of(point.rows, observed, of_arm, xp.asarray(least))._replace(prior=prior)
        return cls.of(observed, space, z, point, errors, whitening, loss)

    @classmethod
    def of(
        cls,
        observed: Observed,
        space: Parameters,
        z: Float[AnyArray, " z"],
        point: PointRows,
        errors: list[ArmErrors],
        whitening: Whitening,
        loss: Loss | None,
    ) -> "Linearisation":
        """Of rows and weights that are known."""
        blocks = row_blocks(space, observed, z, point, whitening)
        _, weights = cost_and_weights(blocks, loss, len(observed.layout.groups))
        return cls(observed, space, z, point, errors, whitening, blocks, weights)

    @property
    def height(self) -> int:
        """Number of the head's unknowns: parameters and shared geometry."""
        return len(self.space.names) + self.observed.layout.shared

    @property
    def steps(self) -> Float[AnyArray, " z"]:
        """Natural steps of all unknowns."""
        xp = namespace(self.z)
        return xp.concatenate([self.space.scale, xp.asarray(self.observed.steps)])

    def influence(self, fixed: Bool[AnyArray, " z"] | None = None) -> Influence:
        """How the unknowns follow the rows, with some fixed, such as parameters on a bound."""
        xp = namespace(self.z, fixed)
        fixed = xp.zeros(self.z.shape[0], dtype=bool) if fixed is None else fixed
        steps, classes = xp.where(fixed, 0.0, self.steps), self.observed.layout.classes
        return Influence.of(
            self.blocks, self.weights, classes, steps, self.whitening.prior, xp.asarray(fixed)[: self.height]
        )

    def with_fitted_geometry(self) -> Float[AnyArray, " z"]:
        """The unknowns with the private geometry as its rows have it by this head; exact where they are linear."""
        return self.fitted(np.arange(self.z.shape[0]) < self.height)

    def fitted(self, fixed: Bool[AnyArray, " z"]) -> Float[AnyArray, " z"]:
        """The unknowns one step of Gauss and Newton further, but for the fixed ones; of steps that change no row, the
        shortest. A prior takes no part."""
        head, components = self.influence(fixed).response([block.white[None] for block in self.blocks])
        return self.z + self.steps * joined(head[:, 0], *(part[..., 0] for part in components))

    def parts(self) -> list[ObservationRows]:
        """The rows, observation by observation."""
        xp, observed, rows = namespace(self.z), self.observed, self.point.rows
        weights = [
            xp.ones(block.white.shape[1]) if weight is None else weight
            for block, weight in zip(self.blocks[: len(rows)], self.weights, strict=False)
        ]
        by_group = (
            [part.values for part in rows],
            [part.by_tip for part in rows],
            [error.by_readings for error in self.errors],
            [error.by_seat for error in self.errors],
            [xp.moveaxis(part.measured, 0, -1) for part in rows],
            [xp.moveaxis(root, 0, -1) for root in self.whitening.roots],
            weights,
        )
        columns = [observed.by_observation(arrays) for arrays in by_group]
        for index in (4, 5):  # matrices, of which the pose is the first axis again
            columns[index] = [xp.moveaxis(matrices, -1, 0) for matrices in columns[index]]
        return [
            ObservationRows(*values) for values in zip(observed.observations, observed.slices, *columns, strict=True)
        ]

    def white(self) -> list[Float[AnyArray, "_ _"]]:
        """Whitened residuals of each observation."""
        groups = len(self.observed.layout.groups)
        return self.observed.by_observation([block.white for block in self.blocks[:groups]])

    def by_head(self) -> list[Float[AnyArray, "h _ _"]]:
        """Whitened derivatives of each observation by parameters and shared geometry."""
        groups = len(self.observed.layout.groups)
        return self.observed.by_observation([_present(block.by_head) for block in self.blocks[:groups]])

    def by_private(self) -> list[Float[AnyArray, "_ _ _"]]:
        """Whitened derivatives of each observation by the private geometry that it alone uses."""
        derivatives: list[AnyArray] = [np.zeros((0, 0, 0))] * len(self.observed.observations)
        for group, block in zip(self.observed.layout.groups, self.blocks, strict=False):
            size = sum(role.size for role in group.roles if role.private)
            first = 0
            for i, (number, count) in enumerate(zip(group.members, group.counts, strict=True)):
                poses = slice(first, first + count)
                if block.by_own is None:
                    derivatives[number] = namespace(block.white).zeros((0, *block.white[:, poses].shape))
                else:
                    derivatives[number] = block.by_own[group.start[i] : group.start[i] + size, :, poses]
                first += count
        return derivatives

    def private(self) -> list[np.ndarray]:
        """Indices of the private geometry of each observation, in the order of `by_private`."""
        indices: list[np.ndarray] = [np.zeros(0, dtype=int)] * len(self.observed.observations)
        for group in self.observed.layout.groups:
            for i, number in enumerate(group.members):
                parts = [np.arange(role.size) + role.first[i] for role in group.roles if role.private]
                indices[number] = np.concatenate(parts) if parts else indices[number]
        return indices

    def dense(self) -> list[Float[AnyArray, "z _ _"]]:
        """Whitened derivatives of each observation by all unknowns; as large as all of them together."""
        derivatives = []
        for head, private, index in zip(self.by_head(), self.by_private(), self.private(), strict=True):
            whole = namespace(head).zeros((self.z.shape[0], *head.shape[1:]))
            whole = set_at(whole, slice(0, self.height), head)
            derivatives.append(set_at(whole, len(self.space.names) + index, private) if len(index) else whole)
        return derivatives

    def relations(self) -> tuple[Float[np.ndarray, "l z"], Float[np.ndarray, " l"], Float[np.ndarray, " l"]]:
        """Derivatives of reference lengths and certified values by all unknowns, their residuals (mm, rad), and their
        standard uncertainties."""
        observed, p = self.observed, len(self.space.names)
        positions, parts = observed.positions, observed.split(np.asarray(self.z)[p:])
        unit, rows, residuals, u = np.eye(len(self.z)), [np.zeros((0, len(self.z)))], [np.zeros(0)], [np.zeros(0)]
        for (start, end), nominal, u_of_row in zip(observed.ends, observed.nominal, observed.u, strict=True):
            between = np.asarray(parts[end] - parts[start])
            size = np.linalg.norm(between)
            rows.append(((between / size) @ (unit[p + positions[end]] - unit[p + positions[start]]))[None])
            residuals.append(np.reshape(size - nominal, 1))
            u.append(np.reshape(u_of_row, 1))
        for name, (value, u_of_row) in observed.certified().items():
            rows.append(unit[p + positions[name]])
            residuals.append(np.asarray(parts[name] - value))
            u.append(np.asarray(u_of_row))
        return np.concatenate(rows), np.concatenate(residuals), np.concatenate(u)


def _present(rows: Float[AnyArray, "h r m"] | None) -> Float[AnyArray, "h r m"]:
    assert rows is not None  # those of poses always depend on the parameters
    return rows

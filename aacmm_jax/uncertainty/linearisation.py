"""A problem at one point: its rows, how they are weighed, and how the unknowns follow them.

This is the only place that builds rows outside of a solve. A result keeps the linearisation of its last solve, and
whatever judges or uses a result reads it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.numpy_or_jax import AnyArray, namespace, set_at
from ..data.noise import Noise
from ..data.observations.observation import AbstractObservation
from ..kinematics.independence import LEAST_MOVEMENT, SHARE_OF_BOUNDS
from ..kinematics.parameters import Bounds, Parameters
from ..model.elimination import cost_and_weights
from ..model.observed import Observed
from ..model.robust import Loss
from ..model.rows import PointRows, PriorRows, RowBlock, Whitening, row_blocks, rows_at, whitening_of
from ..solver.arrow import joined
from .covariance import inverse_information
from .linear_propagation import ArmErrors, Influence, arm_errors, covariance_of_noise, covariance_of_sigma


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
    white: Float[AnyArray, "r m"]  # whitened residuals
    by_head: Float[AnyArray, "h r m"]  # whitened derivatives by parameters and shared geometry
    by_private: Float[AnyArray, "k r m"]  # and by the geometry that it alone uses
    private: np.ndarray  # indices of that among all geometry

    def without_rest(self) -> "ObservationRows":
        """Without the row of those that are reduced which stands for many: see `data.observations.reduced_rows`."""
        if not self.observation.reduces:
            return self
        rows = {name: getattr(self, name)[:-1] for name in ("values", "by_tip", "by_readings", "by_seat", "white")}
        columns = {name: getattr(self, name)[:, :-1] for name in ("by_head", "by_private")}
        square = {name: getattr(self, name)[:, :-1, :-1] for name in ("measured", "root")}
        return self._replace(**rows, **columns, **square)


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
        xp, observed, parts = namespace(self.z), self.observed, {}
        groups = zip(observed.layout.groups, self.point.rows, self.errors, self.whitening.roots, strict=True)
        for (group, rows, error, root), block, weight in zip(groups, self.blocks, self.weights, strict=False):
            weight = xp.ones(block.white.shape[1]) if weight is None else weight
            roles = [role for role in group.roles if role.private]
            size, first = sum(role.size for role in roles), 0
            assert block.by_head is not None
            assert root is not None
            for i, (number, count) in enumerate(zip(group.members, group.counts, strict=True)):
                at, first = slice(first, first + count), first + count
                by_private, private = xp.zeros((0, *block.white[:, at].shape)), np.zeros(0, dtype=int)
                if block.by_own is not None:
                    by_private = block.by_own[group.start[i] : group.start[i] + size, :, at]
                    private = np.concatenate([private, *(np.arange(role.size) + role.first[i] for role in roles)])
                parts[number] = ObservationRows(
                    observed.observations[number],
                    observed.slices[number],
                    rows.values[..., at],
                    rows.by_tip[..., at],
                    error.by_readings[..., at],
                    error.by_seat[..., at],
                    rows.measured[at],
                    root[at],
                    weight[at],
                    block.white[:, at],
                    block.by_head[..., at],
                    by_private,
                    private,
                )
        return [parts[number] for number in range(len(parts))]

    def white(self) -> list[Float[AnyArray, "_ _"]]:
        """Whitened residuals of each observation."""
        groups = len(self.observed.layout.groups)
        return self.observed.by_observation([block.white for block in self.blocks[:groups]])

    def dense(self) -> list[Float[AnyArray, "z _ _"]]:
        """Whitened derivatives of each observation by all unknowns; as large as all of them together."""
        derivatives = []
        for part in self.parts():
            whole = namespace(part.by_head).zeros((self.z.shape[0], *part.white.shape))
            whole = set_at(whole, slice(0, self.height), part.by_head)
            derivatives.append(set_at(whole, len(self.space.names) + part.private, part.by_private))
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


def of_active_bounds(
    linear: Linearisation, active: Int[AnyArray, " p"], bounds: Bounds, sigma: Float[AnyArray, ""]
) -> Float[AnyArray, "p p"]:
    """What is added to a covariance for the widths of those active bounds that end a near-degenerate direction.

    A covariance at active bounds is conditional: the parameter on its bound counts as known, and all others follow from
    that. This is right where the data would carry the parameter well past its bound, so that the bound is knowledge. It
    is wrong where the parameter drifted there along a near-degenerate direction (`kinematics.independence`): then the
    bound is the accidental end of that direction, and the parameters that imitate each other inherit a false exactness
    from it.

    For such a parameter i, with the best imitation v of one step of it by the parameters inside their bounds, the
    data leave everything between the bounds equally likely. With a half-width h, the mean square of a rectangular
    distribution about an estimate at its edge is (2 h)^2 / 3 (JCGM 100, F.2.4.5: an offset that is not corrected
    counts in full), and (2 h)^2 / 3 v v^T is added to the covariance. The information on v includes the reference
    lengths, so that the scale of an arm that stage 1 shrank to its bounds is not meant: the lengths determine it.

    ``linear`` is all that ties the parameters down, at the result; ``active`` is not 0 of parameters on a bound;
    ``sigma`` is the standard deviation of a tip coordinate, mm.
    """
    xp, p = namespace(linear.z, active), len(linear.space.names)
    if xp is np and not np.any(active):
        return np.zeros((p, p))
    influence = linear.influence()
    information, shared = influence.information, linear.observed.layout.shared
    on_bound = xp.concatenate([active != 0, xp.zeros(shared, dtype=bool)])
    inverse, _, _ = inverse_information(information, on_bound)
    # Column i: one step of a parameter on its bound, and what the parameters inside their bounds do to imitate it.
    follow = xp.where(on_bound[:, None], 0.0, -inverse @ information)
    directions = xp.where(on_bound[None, :], xp.asarray(np.eye(p + shared)) + follow, 0.0)
    information_along = xp.einsum("pi,pq,qi->i", directions, information, directions)
    scale = linear.space.scale
    widths = xp.where(active != 0, (bounds.upper - bounds.lower) / scale, 0.0)
    # A bound with none opposite counts as one of the default box of `Bounds.around`, in natural steps.
    default = xp.where(xp.asarray(linear.space.lengths), 10.0, 17.5)
    half_widths = xp.concatenate([xp.where(xp.isfinite(widths), widths / 2, default), xp.zeros(shared)])
    # Rows are in standard deviations of about sigma, so that this is how far a tip moves on average.
    movement = information_along * sigma**2 / linear.observed.q.shape[0]
    size = xp.where(on_bound, xp.sum(directions**2, axis=0), 1.0)
    weak = information_along * (SHARE_OF_BOUNDS * half_widths) ** 2 < 1
    weak = on_bound & (weak | (movement < LEAST_MOVEMENT**2 * size))
    variance = xp.where(weak, (2 * half_widths) ** 2 / 3, 0.0)
    added = (directions[:p] * variance[None, :]) @ directions[:p].T
    return scale[:, None] * added * scale[None, :]

"""What a calibrated arm's uncertainty means where it is used: of its parameters, of a tip, of a length, all over its volume."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..calibration.results import Calibration, Identification
from ..core.arrays import Numbers, is_concrete
from ..core.errors import InputError
from ..data.noise import Noise, tip_covariances
from ..data.simulation import limits_of
from ..files.calibrations import CalibrationRecord
from ..kinematics.arm import Arm, parameter_names
from ..kinematics.chain import turns_of
from ..kinematics.independence import moved_onto
from ..kinematics.parameters import Parameters, is_length

# A direction that is open is uncertain by 10 mm or 10 mrad at least: through this much of it, 0.1 um.
_REACHED = 1e-5
_LENGTH_MM = 300.0  # lengths of the map, where none is given: those of the paper's checks


class Uncertainty(eqx.Module):
    """Uncertainty of a calibrated arm: standard uncertainties, in mm and rad, of whatever it is asked for.

    What the calibration adds; with ``reading=True`` the noise of the readings themselves too, as given to the calibration or as
    estimated by it. Where something follows a direction that the data leave open, it is infinite. The base frame counts as
    exact: ``d_1`` and ``theta_1`` only say where it is.
    """

    arm: Arm
    covariance: Float[Array, "p p"]
    stretch: Float[Array, " w"]  # of lengths that were held but divided by k (see `covariance.Covariance`)
    open: Float[Array, "p p"]  # projector onto undetermined directions, natural steps
    noise: Noise
    u_k: Float[Array, ""] | None
    names: tuple[str, ...] = eqx.field(static=True)
    freedom: float = eqx.field(static=True)  # degrees of freedom; infinite where the noise was given

    @property
    def space(self) -> Parameters:
        """The free parameters."""
        return Parameters(self.arm, self.names)

    @property
    def u(self) -> Float[Array, " p"]:
        """Standard uncertainty of each free parameter; infinite where only a combination is determined.

        0 on a bound; but after two stages lengths there follow k, and have its uncertainty.
        """
        alone = jnp.sqrt(jnp.diagonal(self.covariance))
        return jnp.where(jnp.diagonal(self.open) > 1e-6, jnp.inf, alone)

    @property
    def correlation(self) -> Float[Array, "p p"]:
        """Correlation of the free parameters; 0 with those that are on a bound."""
        u = jnp.sqrt(jnp.diagonal(self.covariance))
        safe = jnp.where(u > 0, u, 1.0)
        return self.covariance / (safe[:, None] * safe[None, :])

    def correlated(self, least: float = 0.9) -> list[tuple[str, str, float]]:
        """Pairs of parameters whose correlation is at least so strong, the strongest first: (name, name, correlation)."""
        if not 0 <= least <= 1:
            raise InputError(f"least is {least:g}; give a correlation between 0 and 1.")
        table = np.asarray(self.correlation)
        pairs = [(i, j) for i in range(len(table)) for j in range(i) if abs(table[i, j]) >= least]
        found = [(self.names[j], self.names[i], float(table[i, j])) for i, j in pairs]
        return sorted(found, key=lambda entry: -abs(entry[2]))

    def factor(self, level: float = 0.95) -> float:
        """Coverage factor of a level: Student's t for the degrees of freedom (JCGM 100, annex G)."""
        if not 0 < level < 1:
            raise InputError(f"level is {level:g}; give a share between 0 and 1, for example 0.95.")
        from scipy import stats

        tail = 0.5 + level / 2
        return float(stats.norm.ppf(tail) if math.isinf(self.freedom) else stats.t.ppf(tail, self.freedom))

    def tip(self, q: Numbers, *, reading: bool = False) -> Float[Array, "... 3 3"]:
        """Covariance of the tip's position in the base frame at joint angles ``(..., n)``, mm^2."""
        q = self._poses(q)
        spread = self.spread_of(self.slopes(q))
        return spread + self._read(q) if reading else spread

    def length(self, start: Numbers, end: Numbers, *, reading: bool = False) -> Float[Array, "..."]:
        """Standard uncertainty of the distance between the tips at two poses, ``(..., n)`` each, mm."""
        start, end = self._poses(start), self._poses(end)
        try:
            np.broadcast_shapes(start.shape, end.shape)
        except ValueError as error:
            raise InputError(f"the poses have shapes {start.shape} and {end.shape}; give as many ends as starts.") from error
        between = self.arm.position(end) - self.arm.position(start)
        if is_concrete(between) and np.any(np.linalg.norm(between, axis=-1) < 1e-6):
            raise InputError("both poses put the tip in the same place, so there is no length between them; give others.")
        direction = between / jnp.linalg.norm(between, axis=-1, keepdims=True)
        along = jnp.einsum("...c,...cp->...p", direction, self.slopes(end) - self.slopes(start))
        variance = self.spread_of(along[..., None, :])[..., 0, 0]
        if reading:
            both = self._read(start) + self._read(end)
            variance = variance + jnp.einsum("...c,...cd,...d->...", direction, both, direction)
        return jnp.sqrt(variance)

    def slopes(self, q: Float[Array, "... n"]) -> Float[Array, "... 3 w"]:
        """Derivatives of the tip by the free parameters and, last, by a stretch of the lengths that were held."""
        free = self.arm.jacobian(q, self.names)
        held = [n for n in parameter_names(self.arm) if is_length(n) and n not in ("d_1", *self.names)]
        if not held:
            return jnp.concatenate([free, jnp.zeros((*free.shape[:-1], 1))], axis=-1)
        values = Parameters(self.arm, tuple(held)).vector()
        return jnp.concatenate([free, (self.arm.jacobian(q, held) @ values)[..., None]], axis=-1)

    def spread_of(self, slopes: Float[Array, "... k w"]) -> Float[Array, "... k k"]:
        """Covariance of functions with these derivatives (as `slopes` gives them); infinite where they follow what is open."""
        p = len(self.names)
        upper = jnp.concatenate([self.covariance, self.stretch[:-1, None]], axis=1)
        whole = jnp.concatenate([upper, self.stretch[None]])
        spread = slopes @ whole @ jnp.swapaxes(slopes, -1, -2)
        return jnp.where(self._lost(slopes[..., :p])[..., None], jnp.inf, spread)

    def _poses(self, q: Numbers) -> Float[Array, "... n"]:
        q = self.arm._checked(q)
        if is_concrete(q) and not np.all(np.isfinite(np.asarray(q))):
            raise InputError("a joint angle is not finite; give angles in rad.")
        return q

    def _read(self, q: Float[Array, "... n"]) -> Float[Array, "... 3 3"]:
        flat = q.reshape(-1, q.shape[-1])
        spread = jnp.moveaxis(tip_covariances(self.arm.geometry, turns_of(flat), self.noise), -1, 0)
        return spread.reshape(*q.shape[:-1], 3, 3)

    def _lost(self, slope: Float[Array, "... k p"]) -> Array:
        """Which rows follow a direction that is open."""
        inside = slope @ (self.space.scale[:, None] * self.open)
        return jnp.sqrt(jnp.sum(inside**2, axis=-1)) > _REACHED


def uncertainty_of(result: Calibration | Identification | CalibrationRecord) -> Uncertainty:
    """The uncertainty of a calibration, just made or loaded from a file; of an identification, with the scale as it was held."""
    if isinstance(result, CalibrationRecord):
        return Uncertainty(
            arm=result.calibrated.arm,
            covariance=jnp.asarray(result.covariance),
            stretch=jnp.asarray(result.stretch),
            open=jnp.asarray(result.open),
            noise=result.noise,
            u_k=jnp.asarray(result.u_k),
            names=result.names,
            freedom=result.freedom,
        )
    scale = result.scale
    return Uncertainty(
        arm=result.arm,
        covariance=result.covariance,
        stretch=result.spread.stretch,
        open=result.spread.open,
        noise=result.noise,
        u_k=None if scale is None else scale.u,
        names=result.space.names,
        freedom=result.freedom,
    )


class Volume(NamedTuple):
    """The uncertainty over the working volume, point by point, as NumPy arrays: mm, standard (k = 1).

    At each point a tip and a length that starts there, in poses taken at random.
    """

    length: float  # how long the lengths are
    q: Float[np.ndarray, "v n"]
    q_end: Float[np.ndarray, "v n"]
    start: Float[np.ndarray, "v 3"]
    end: Float[np.ndarray, "v 3"]
    u_tip: Float[np.ndarray, " v"]  # along the direction in which it is largest
    u_length: Float[np.ndarray, " v"]
    u_length_reading: Float[np.ndarray, " v"]  # with the noise of the readings at both ends

    @property
    def summary(self) -> dict[str, float]:
        """Median, 95th percentile and largest standard uncertainty, mm."""
        found = {"length_mm": self.length}
        for name in ("u_tip", "u_length", "u_length_reading"):
            values = getattr(self, name)
            found |= {
                f"{name}_median_mm": float(np.median(values)),
                f"{name}_95_mm": float(np.quantile(values, 0.95, method="higher")),  # no sum, so infinite ones are allowed
                f"{name}_largest_mm": float(np.max(values)),
            }
        return found


def over_volume(
    uncertainty: Uncertainty, *, points: int = 400, length: float | None = None, limits: Any = None, seed: int = 0
) -> Volume:
    """Uncertainty of tips and of lengths (mm; default 300, or half the reach of a small arm) all over the reachable volume.

    Points are where random poses within the joint limits take the tip. Raises `InputError` where no length fits.
    """
    if not isinstance(uncertainty, Uncertainty):
        raise InputError("over_volume takes an uncertainty; make one of a calibration with aj.uncertainty_of(result).")
    length = default_length(uncertainty.arm) if length is None else length
    start, end = check_lengths(uncertainty.arm, points, length=length, limits=limits, seed=seed)
    tips, spread, plain, read = _volume(uncertainty, jnp.asarray(start), jnp.asarray(end))
    tips = np.asarray(tips)
    return Volume(length, start, end, tips[0], tips[1], np.asarray(spread), np.asarray(plain), np.asarray(read))


@eqx.filter_jit
def _volume(uncertainty: Uncertainty, start: Array, end: Array) -> tuple[Array, Array, Array, Array]:
    spread = uncertainty.tip(start)
    finite = jnp.where(jnp.isfinite(spread), spread, 0.0)
    largest = jnp.sqrt(jnp.linalg.eigvalsh(finite)[..., -1])
    largest = jnp.where(jnp.all(jnp.isfinite(spread), axis=(-1, -2)), largest, jnp.inf)
    tips = jnp.stack([uncertainty.arm.position(q) for q in (start, end)])
    return tips, largest, uncertainty.length(start, end), uncertainty.length(start, end, reading=True)


def default_length(arm: Arm) -> float:
    """300 mm, or half of what a smaller arm's links add up to."""
    return min(_LENGTH_MM, 0.5 * links_of(arm))


def links_of(arm: Arm) -> float:
    """What the links and the probe measure together, without the base's height, mm."""
    return float(np.abs(arm.a).sum() + np.abs(np.asarray(arm.d)[1:]).sum() + np.linalg.norm(np.asarray(arm.probe)))


def check_lengths(
    arm: Arm, count: int, *, length: float | None, limits: Any = None, seed: int = 0
) -> tuple[Float[np.ndarray, "v n"], Float[np.ndarray, "v n"]]:
    """Lengths all over the volume, as the poses at their two ends: of ``length`` mm in random directions, or (None) between
    independent poses. Within the joint limits, and where both ends can be reached."""
    if length is not None and not 0 < length < 2 * links_of(arm):
        raise InputError(f"a length of {length:g} mm does not fit into the volume of this arm; give a shorter one.")
    if count < 1:
        raise InputError(f"{count} points cannot be looked at; give at least one.")
    random, allowed = (
        np.random.default_rng(seed),
        np.asarray(limits_of(arm, None if limits is None else np.asarray(limits).tolist())),
    )
    draw = lambda m: random.uniform(allowed[:, 0], allowed[:, 1], (m, arm.joints))  # noqa: E731
    if length is None:
        return draw(count), draw(count)
    starts, ends, found = [], [], 0
    for _ in range(60):
        q = draw(2 * count)
        turn = random.normal(size=(2 * count, 3))
        targets = np.asarray(arm.position(q)) + length * turn / np.linalg.norm(turn, axis=1, keepdims=True)
        other, arrived = moved_onto(arm, draw(2 * count), targets, allowed)
        starts.append(q[arrived])
        ends.append(other[arrived])
        found += int(arrived.sum())
        if found >= count:
            return np.concatenate(starts)[:count], np.concatenate(ends)[:count]
    raise InputError(
        f"lengths of {length:g} mm find no place that the arm reaches within its joint limits; give a shorter one."
    )

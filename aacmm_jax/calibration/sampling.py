"""Uncertainty without linearisation: Monte Carlo after JCGM 101, and the bootstrap over poses."""

import math
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..core.arguments import OneOf, Range, checked_arguments
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray
from ..core.random_keys import random_generator
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Parameters
from ..kinematics.priors import Prior
from ..model.loss_names import LossName
from ..uncertainty.coverage import LEVEL, in_percent
from ..uncertainty.volume import default_length, sample_lengths
from .batch import calibrate_many
from .record import uncertainty_of
from .redrawn import truth_of
from .results import Calibration

Level = Annotated[float, Range(above=0, most=0.9999)]  # coverage probability

_LENGTHS = 24  # lengths over the working volume whose distribution is found with those of the parameters and k
_LEAST = 10  # trials that converge, of which a distribution is made
_REFINED = 5  # the standard's own tolerance is divided by this where a linear result is validated (JCGM 101, 8.2)


class Sampled(NamedTuple):
    """A calibration's outputs over many trials, as NumPy arrays: mm and rad, k, and mm for the lengths.

    ``quantities`` are the parameters' names, ``k`` and ``length 1`` ... . Failed solves are left out of ``values``.

    Example:
        >>> sampled = aj.monte_carlo(result, capture, most=10000)
        >>> at = sampled.quantities.index("k")
        >>> print(sampled.trials, f"{sampled.low[at]:.5f} to {sampled.high[at]:.5f}")
        10000 0.99920 to 0.99925
    """

    quantities: tuple[str, ...]
    estimate: Float[np.ndarray, " q"]  # of the calibration itself
    u: Float[np.ndarray, " q"]
    low: Float[np.ndarray, " q"]  # as probable to be below it as above the other end
    high: Float[np.ndarray, " q"]
    linear_u: Float[np.ndarray, " q"]  # what the law of propagation says
    factor: Float[np.ndarray, " q"]  # of the linear interval
    tolerance: Float[np.ndarray, " q"]  # delta of JCGM 101, 7.9.2
    stable: bool  # the adaptive procedure ended before ``most`` trials
    trials: int
    failed: int
    level: float
    values: Float[np.ndarray, "t q"]

    @property
    def agrees(self) -> Bool[np.ndarray, " q"]:
        """Where both ends of the linear interval agree with the sampled ones to the tolerance (JCGM 101, 8.2)."""
        half = self.factor * self.linear_u
        off = np.stack([self.estimate - half - self.low, self.estimate + half - self.high])
        return np.all(np.abs(off) <= self.tolerance, axis=0)

    def table(self) -> dict[str, np.ndarray]:
        """The distribution in a few columns, as calibration files keep it."""
        columns = {name: getattr(self, name) for name in ("estimate", "u", "low", "high", "linear_u", "agrees")}
        return {"quantity": np.array(self.quantities), **columns}

    def sentences(self) -> list[str]:
        """Whether the linear result may be used, and where not."""
        unstable = f"After {self.trials} trials the intervals are not yet stable; allow more trials."
        failed = f"{self.failed} of {self.trials} trials did not converge and were left out."
        sentences = [unstable] * (not self.stable) + [failed] * (self.failed > 0)
        apart = [name for name, good in zip(self.quantities, self.agrees, strict=True) if not good]
        says = (
            f"agree with the intervals from {self.trials} Monte Carlo trials within the tolerance of JCGM 101, for "
            f"every parameter{', k,' if 'k' in self.quantities else ''} and lengths over the volume."
        )
        if apart:
            says = (
                f"differ from the Monte Carlo intervals by more than the tolerance of JCGM 101 for {len(apart)} of "
                f"{len(self.quantities)} quantities: {', '.join(apart[:8])}{' ...' if len(apart) > 8 else ''}; use "
                "the Monte Carlo intervals."
            )
        return [*sentences, f"The linear {in_percent(self.level)} intervals {says}"]


@checked_arguments
def monte_carlo(
    result: Calibration,
    capture: Capture,
    *,
    level: Level = LEVEL,
    digits: Annotated[int, OneOf((1, 2))] = 1,
    most: int = 1_000_000,
    lengths: tuple[np.ndarray, np.ndarray] | None = None,
    noise: Noise | None = None,
    seed: int = 0,
) -> Sampled:
    """Propagation of distributions (JCGM 101:2008): the whole calibration is repeated on readings drawn anew.

    Readings are drawn about poses in which the calibrated arm meets its sockets exactly, certified values with their u.
    Shared errors (``result.shared``) are drawn too. Of captures with other observations, residuals are drawn
    about 0: readings, seat and measured values have new errors, by the geometry that was found. Blocks of
    max(100 / (1 - level), 10,000) trials are added until mean, u and both ends of the interval of every quantity are
    stable to a fifth of the tolerance (section 7.9). Bounds act in every trial as they did in the calibration, so the
    distribution ends where one is active. A prior is an observation like others: its means have new errors too, of its
    standard deviations, learned ones as they were found.

    Args:
        result: what `calibrate` returned.
        capture: the capture that it was identified from.
        level: coverage probability of the intervals.
        digits: significant digits of u that must be stable, 1 or 2.
        most: most trials.
        lengths: poses at both ends of the lengths to follow ``(v, n)`` each, rad; by default 24 over the working
            volume.
        noise: standard deviations of readings and seat, instead of the calibration's own.
        seed: of the random numbers.

    Returns:
        Distribution of every parameter, k and the lengths, with the linear result to compare it with.

    Raises:
        InputError: a number is out of range, the calibration had a robust loss (a bootstrap keeps bad poses), or fewer
            than ten trials converge.

    Example:
        >>> sampled = aj.monte_carlo(result, capture, most=10000)
        >>> at = sampled.quantities.index("d_3")
        >>> print(f"d_3: u = {sampled.u[at]:.3f} mm; by the linear propagation {sampled.linear_u[at]:.3f} mm")
        d_3: u = 0.010 mm; by the linear propagation 0.010 mm
    """
    random_generator(seed)
    if noise is not None:
        noise.check(result.arm.joints)
    noise = result.noise if noise is None else noise
    block = max(math.ceil(100 / (1 - level)), 10_000)
    if most < block:
        raise InputError(f"most is {most}, but one block has {block} trials; allow at least {block} trials.")
    repeated, truth = Repeated.of(result, capture, lengths), truth_of(result, capture)
    freedom = result.degrees_of_freedom
    values, failed, blocks, stable = [], 0, [], False
    while sum(map(len, values)) + failed < most and not stable:
        random, parts = np.random.default_rng([seed, len(values)]), []
        # So many at a time that the readings of each take 200 MB at most.
        slices = max(int(2.5e7 / truth.size), 1)
        for count in (min(slices, block - first) for first in range(0, block, slices)):
            # Noise estimated with few degrees of freedom is itself uncertain: its scale is drawn too, which gives
            # Student's t (JCGM 101, 6.4.9).
            scale = 1.0 if math.isinf(freedom) else np.sqrt(freedom / random.chisquare(freedom, size=(count, 1, 1)))
            captures, errors = truth.drawn(count, noise, random, scale)
            means = repeated.prior_means(count, random)
            solved, lost = repeated.solved(captures, means, errors and errors.coefficients)
            parts.append(solved)
            failed += lost
        values.append(np.concatenate(parts))
        _check_some(values[-1], block, "Monte Carlo", "check the calibration or widen the bounds")
        ends = np.quantile(values[-1], [(1 - level) / 2, (1 + level) / 2], axis=0)
        blocks.append(np.stack([values[-1].mean(axis=0), values[-1].std(axis=0, ddof=1), *ends]))
        # Twice the standard deviation of the averages over blocks, of the worst of mean, u and both ends (7.9.4).
        spread = 2 * np.std(blocks, axis=0, ddof=1).max(axis=0) / math.sqrt(len(blocks)) if blocks[1:] else np.inf
        u = np.concatenate(values).std(axis=0, ddof=1)
        stable = bool(np.all(spread <= numerical_tolerance(u, digits) / _REFINED))
    return repeated.sampled(np.concatenate(values), failed, level, digits, stable=stable)


@checked_arguments
def bootstrap(
    result: Calibration,
    capture: Capture,
    *,
    trials: Annotated[int, Range(least=100)] = 2000,
    level: Level = LEVEL,
    robust: LossName | None = None,
    seed: int = 0,
) -> Sampled:
    """The calibration repeated on poses drawn with replacement, and certified values drawn with their u.

    Poses are drawn from those of each socket; of other observations from those under the same constraint, such as one
    point of an artefact. It only assumes that the errors of poses are independent. (The variance of a socket of m poses
    is (m - 1) / m too small.) Means of a prior are drawn with its standard deviations.

    Args:
        result: what `calibrate` returned.
        capture: the capture that it was identified from.
        trials: how many repetitions, at least 100.
        level: coverage probability of the intervals.
        robust: the robust loss of the calibration, where it had one.
        seed: of the random numbers.

    Returns:
        Distribution of every parameter, k and lengths over the working volume.

    Raises:
        InputError: too few trials, poses that cannot be drawn one in the place of another, another loss than the
            calibration's, or fewer than ten of them converge.

    Example:
        >>> sampled = aj.bootstrap(result, capture, trials=100)
        >>> at = sampled.quantities.index("probe_z")
        >>> print(sampled.trials, f"trials: probe_z from {sampled.low[at]:.3f} to {sampled.high[at]:.3f} mm")
        100 trials: probe_z from 102.497 to 102.503 mm
    """
    random, repeated = random_generator(seed), Repeated.of(result, capture, None, robust)
    captures = truth_of(result, capture).resampled(trials, random)
    values, failed = repeated.solved(captures, repeated.prior_means(trials, random, about_means=True))
    _check_some(values, trials, "bootstrap", "there are too few poses per socket for a bootstrap; record more poses")
    return repeated.sampled(values, failed, level, 1)


def _check_some(values: np.ndarray, trials: int, what: str, remedy: str) -> None:
    if len(values) < _LEAST:
        raise InputError(f"only {len(values)} of {trials} {what} trials converged; {remedy}.")


def numerical_tolerance(u: Float[np.ndarray, " q"], digits: int) -> Float[np.ndarray, " q"]:
    """delta = 10^l / 2, where u = c 10^l with an integer c of so many digits (JCGM 101, 7.9.2)."""
    safe = np.where(u > 0, u, 1.0)
    exponent = np.floor(np.log10(safe)) - (digits - 1)
    # 9.96 rounds to 10, which has one digit more.
    exponent += np.round(safe / 10**exponent) >= 10**digits
    return np.where(u > 0, 0.5 * 10**exponent, 0.0)


class Repeated(NamedTuple):
    """A calibration that is repeated on other data, and the lengths whose distribution is followed."""

    result: Calibration
    ends: tuple[Float[np.ndarray, "v n"], Float[np.ndarray, "v n"]]
    robust: LossName | None

    @classmethod
    def of(
        cls, result: Calibration, capture: Capture, lengths: tuple[Any, Any] | None, robust: LossName | None = None
    ) -> "Repeated":
        """Refuses trials that would be solved with another loss than the calibration, or of another capture."""
        joint = result.method == "joint"
        if not joint and (capture.observations or robust is not None):
            raise InputError(
                "the calibration used sockets and lengths without a robust loss; give the capture of this "
                "calibration, and no robust loss."
            )
        lost = any(bool(np.any(np.asarray(weights) < 1)) for weights in result.observed.weights)
        if joint and lost and robust is None:
            raise InputError(
                "a robust loss reduced the weight of poses in this calibration; use bootstrap with the same loss "
                "(robust='huber', for example), or calibrate without a robust loss."
            )
        if lengths is None:
            lengths = sample_lengths(result.arm, _LENGTHS, length=default_length(result.arm))
        shapes = [np.shape(poses) for poses in lengths] if isinstance(lengths, tuple | list) else []
        if len(shapes) != 2 or len(shapes[0]) != 2 or shapes[0] != shapes[1]:
            raise InputError(
                "lengths must be two arrays of poses, each of shape (v, n): the start and the end of each length."
            )
        return cls(result, (np.asarray(lengths[0]), np.asarray(lengths[1])), robust)

    def prior_means(
        self, count: int, random: np.random.Generator, about_means: bool = False
    ) -> Float[np.ndarray, "t p"] | None:
        """Parameters of so many arms in which those with a prior have its means, drawn anew: about the calibration's
        parameters, or about the means themselves."""
        prior, names = self.result.prior, self.result.space.names
        if prior is None:
            return None
        index = [names.index(name) for name in prior.names]
        centre, sd, weight = np.array(self.result.parameters), np.zeros(len(names)), np.asarray(prior.weight)
        sd[index] = np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0), 0.0)
        if about_means:
            centre[index] = prior.mean
        return centre + sd * random.normal(size=(count, len(sd)))

    def solved(
        self,
        captures: Capture,
        means: Float[np.ndarray, "t p"] | None = None,
        coefficients: np.ndarray | None = None,
    ) -> tuple[np.ndarray, int]:
        """Outputs of the trials that converged ``(t, q)``, and how many did not.

        ``means`` are those of the prior; ``coefficients`` those of functions that the model lacks: with them lengths
        are off by more than follows from the parameters.
        """
        result, prior, shared = self.result, self.result.prior, self.result.shared
        # What sets the scale, and the noise that weights the poses, are the calibration's own.
        options: dict[str, Any] = {"noise": result.weighting_noise, "robust": self.robust, "method": result.method}
        first, space = result, Parameters(result.arm, result.space.names)
        arm = result.arm
        if result.method == "two-stage":
            first, arm, options["hold"] = result.stage1, result.stage1.arm, result.hold
        elif prior is not None and means is not None:
            arm = space.arm(means)
            weights = zip(prior.names, np.asarray(prior.weight).tolist(), strict=True)
            options["prior"] = Prior({name: 1 / weight for name, weight in weights if weight > 0})
        many = calibrate_many(arm, captures, result.bounds, start=first.parameters, **options)
        lengths = _lengths_of(space, jnp.asarray(many.parameters), jax.tree.map(jnp.asarray, self.ends))
        if coefficients is not None and shared is not None and shared.names:
            # Derivatives of the lengths by the coefficients of functions that the model lacks.
            whole = uncertainty_of(result).complete
            by_tips = [np.asarray(whole.derivatives(q))[..., -len(shared.names) :] for q in self.ends]
            between = np.subtract(*(np.asarray(whole.arm.position(q)) for q in reversed(self.ends)))
            direction = between / np.linalg.norm(between, axis=1, keepdims=True)
            by_functions = np.einsum("vc,vck->vk", direction, by_tips[1] - by_tips[0])
            lengths = np.asarray(lengths) + coefficients @ by_functions.T
        scale = [] if many.k is None else [many.k[:, None]]
        values = np.hstack([many.parameters, *scale, np.asarray(lengths)])
        return values[many.converged], int(np.sum(~many.converged))

    def sampled(self, values: np.ndarray, failed: int, level: float, digits: int, stable: bool = True) -> Sampled:
        """The trials' distribution, with the linear result to compare it with."""
        result, linear = self.result, uncertainty_of(self.result)
        u_length, expanded = np.asarray(linear.length(*self.ends)), linear.expanded_length(*self.ends, level=level)
        low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2], axis=0)
        u, lengths = values.std(axis=0, ddof=1), _lengths_by(result.arm, self.ends)
        scale = result.scale if result.method == "two-stage" else None  # a joint solve divides by no k
        k, u_k = ([], []) if scale is None else ([float(scale.value)], [float(scale.u)])
        factor_k = [linear.expanded_k(level) / u_of_k for u_of_k in u_k]
        return Sampled(
            quantities=(*result.space.names, *("k" for _ in k), *(f"length {i + 1}" for i in range(len(lengths)))),
            estimate=np.concatenate([result.parameters, k, np.asarray(lengths)]),
            u=u,
            low=low,
            high=high,
            linear_u=np.concatenate([linear.u, u_k, u_length]),
            factor=np.concatenate([linear.factor(level), factor_k, expanded / np.where(u_length > 0, u_length, 1.0)]),
            tolerance=numerical_tolerance(u, digits),
            stable=stable,
            trials=len(values) + failed,
            failed=failed,
            level=level,
            values=values,
        )


def _lengths_by(arm: Arm, ends: tuple[AnyArray, AnyArray]) -> AnyArray:
    return jnp.linalg.norm(arm.position(ends[0]) - arm.position(ends[1]), axis=-1)


@eqx.filter_jit
def _lengths_of(space: Parameters, parameters: Array, ends: tuple[Array, Array]) -> Array:
    return jax.lax.map(lambda vector: _lengths_by(space.arm(vector), ends), parameters, batch_size=256)

"""Uncertainty without linearisation: Monte Carlo after JCGM 101, and the bootstrap over poses."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..core.arguments import checked_arguments
from ..core.arrays import Numbers, random_generator
from ..core.errors import InputError
from ..data.capture import Capture, check_sockets_only
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.inverse_kinematics import project_to_centroids
from ..kinematics.parameters import Parameters
from ..uncertainty.volume import default_length, sample_lengths
from .batch import BatchOptions, BatchTask
from .record import uncertainty_of
from .results import Calibration

_LENGTHS = 24  # lengths over the working volume whose distribution is found with those of the parameters and k
_REFINED = 5  # the standard's own tolerance is divided by this where a linear result is validated (JCGM 101, 8.2)


class Sampled(NamedTuple):
    """A calibration's outputs over many trials, as NumPy arrays: mm and rad, k, and mm for the lengths.

    ``quantities`` are the parameters' names, ``k`` and ``length 1`` ... . Failed solves are left out of ``values``.
    """

    quantities: tuple[str, ...]
    estimate: Float[np.ndarray, " q"]  # of the calibration itself
    u: Float[np.ndarray, " q"]
    low: Float[np.ndarray, " q"]  # as probable to be below it as above the other end
    high: Float[np.ndarray, " q"]
    linear_u: Float[np.ndarray, " q"]  # what the law of propagation says
    factor: float  # of the linear interval
    tolerance: Float[np.ndarray, " q"]  # delta of JCGM 101, 7.9.2
    stable: bool  # the adaptive procedure ended before ``most`` trials
    trials: int
    failed: int
    level: float
    values: Float[np.ndarray, "t q"]

    @property
    def agrees(self) -> Bool[np.ndarray, " q"]:
        """Where both ends of the linear interval agree with the sampled ones to the tolerance (JCGM 101, 8.2)."""
        off = np.stack(
            [
                self.estimate - self.factor * self.linear_u - self.low,
                self.estimate + self.factor * self.linear_u - self.high,
            ]
        )
        return np.all(np.abs(off) <= self.tolerance, axis=0)

    def table(self) -> dict[str, np.ndarray]:
        """The distribution in a few columns, as calibration files keep it."""
        columns = {name: getattr(self, name) for name in ("estimate", "u", "low", "high", "linear_u", "agrees")}
        return {"quantity": np.array(self.quantities), **columns}

    def sentences(self) -> list[str]:
        """Whether the linear result may be used, and where not."""
        found = [] if self.stable else [f"After {self.trials} trials the intervals are not yet stable; allow more."]
        if self.failed:
            found.append(f"{self.failed} of {self.trials} trials did not converge and are left out.")
        apart = [name for name, good in zip(self.quantities, self.agrees, strict=True) if not good]
        percent = f"{100 * self.level:g} %"
        if apart:
            found.append(
                f"The linear {percent} intervals differ from the Monte Carlo ones by more than the tolerance of JCGM "
                f"101 for {len(apart)} of {len(self.quantities)} quantities: {', '.join(apart[:8])}"
                f"{' ...' if len(apart) > 8 else ''}; use the Monte Carlo ones."
            )
        else:
            found.append(
                f"The linear {percent} intervals agree with those of {self.trials} Monte Carlo trials within the "
                "tolerance of JCGM 101, for every parameter, k, and lengths over the volume."
            )
        return found


@checked_arguments
def monte_carlo(
    result: Calibration,
    capture: Capture,
    *,
    level: float = 0.95,
    digits: int = 1,
    most: int = 1_000_000,
    lengths: tuple[np.ndarray, np.ndarray] | None = None,
    noise: Noise | None = None,
    seed: int = 0,
) -> Sampled:
    """Propagation of distributions (JCGM 101:2008): the whole calibration is repeated on readings drawn anew.

    Readings are drawn about poses in which the calibrated arm meets its sockets exactly, certified lengths with their
    u. Blocks of max(100 / (1 - level), 10,000) trials are added until mean, u and both ends of the interval of every
    quantity are stable to a fifth of the tolerance (section 7.9). Bounds act in every trial as they did in the
    calibration, so the distribution ends where one is active.

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
        InputError: a number is out of range, or hardly any trial converges.
    """
    if digits not in (1, 2):
        raise InputError(f"digits is {digits}; give 1 or 2 significant digits of the uncertainty.")
    _check_level(level)
    random_generator(seed)
    if noise is not None:
        noise.check(result.arm.joints)
    noise = result.noise if noise is None else noise
    block = max(math.ceil(100 / (1 - level)), 10_000)
    if most < block:
        raise InputError(f"most is {most}, but one block of trials has {block}; allow that many at least.")
    task = _RepeatedTask.of(result, capture, lengths)
    exact, moves = _exact(result.arm, capture)
    true_lengths = np.asarray(_lengths_by(result.arm, capture))
    drawn, failed, blocks = [], 0, []
    stable = False
    while sum(map(len, drawn)) + failed < most and not stable:
        random = np.random.default_rng([seed, len(drawn)])
        parts = []
        for count in _slices(block, exact.size):
            # Noise estimated with few degrees of freedom is itself uncertain: its scale is drawn too, which gives
            # Student's t (JCGM 101, 6.4.9).
            known = math.isinf(result.degrees_of_freedom)
            level_of = (
                1.0
                if known
                else np.sqrt(
                    result.degrees_of_freedom / random.chisquare(result.degrees_of_freedom, size=(count, 1, 1))
                )
            )
            seats = float(noise.seating) * level_of * random.normal(size=(count, *exact.shape[:1], 3))
            readings = exact + np.einsum("Nic,tNc->tNi", moves, seats)
            readings += np.asarray(noise.encoder) * level_of * random.normal(size=readings.shape)
            values = true_lengths + task.u * random.normal(size=(count, len(task.u)))
            solved, lost = task.solved(readings, values)
            parts.append(solved)
            failed += lost
        found = np.concatenate(parts)
        drawn.append(found)
        if len(found) < 10:
            raise InputError(
                "hardly any Monte Carlo trial converges; widen the bounds, or look at the calibration first."
            )
        low, high = np.quantile(found, [(1 - level) / 2, (1 + level) / 2], axis=0)
        blocks.append(np.stack([found.mean(axis=0), found.std(axis=0, ddof=1), low, high]))
        u = np.concatenate(drawn).std(axis=0, ddof=1)
        stable = len(blocks) > 1 and bool(np.all(_instability(blocks) <= numerical_tolerance(u, digits) / _REFINED))
    return task.sampled(result, np.concatenate(drawn), stable, failed, level, digits)


@checked_arguments
def bootstrap(
    result: Calibration, capture: Capture, *, trials: int = 2000, level: float = 0.95, seed: int = 0
) -> Sampled:
    """The calibration repeated on poses drawn with replacement from each socket, and lengths drawn with their u.

    It only assumes that the errors of poses are independent. (The variance of a socket of m poses is (m - 1) / m too
    small.)

    Args:
        result: what `calibrate` returned.
        capture: the capture that it was identified from.
        trials: how many repetitions, at least 100.
        level: coverage probability of the intervals.
        seed: of the random numbers.

    Returns:
        Distribution of every parameter, k and lengths over the working volume.

    Raises:
        InputError: too few trials, or hardly any of them converges.
    """
    if trials < 100:
        raise InputError(f"{trials} trials show no distribution; ask for at least 100.")
    _check_level(level)
    random = random_generator(seed)
    starts = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    task = _RepeatedTask.of(result, capture, None)
    rows = np.concatenate(
        [start + random.integers(size, size=(trials, size)) for start, size in zip(starts, capture.sizes, strict=True)],
        axis=1,
    )
    nominal = np.array([float(length.value) for length in capture.lengths])
    found, failed = task.solved(
        np.asarray(capture.q)[rows], nominal + task.u * random.normal(size=(trials, len(nominal)))
    )
    if len(found) < 10:
        raise InputError("hardly any bootstrap trial converges: too few poses a socket for this; record more.")
    return task.sampled(result, found, True, failed, level, 1)


def _check_level(level: float) -> None:
    if not 0 < level <= 0.9999:
        raise InputError(f"level is {level:g}; give a probability between 0 and 0.9999, for example 0.95.")


def numerical_tolerance(u: Float[np.ndarray, " q"], digits: int) -> Float[np.ndarray, " q"]:
    """delta = 10^l / 2, where u = c 10^l with an integer c of so many digits (JCGM 101, 7.9.2)."""
    safe = np.where(u > 0, u, 1.0)
    exponent = np.floor(np.log10(safe)) - (digits - 1)
    # 9.96 rounds to 10, which has one digit more.
    exponent += np.round(safe / 10**exponent) >= 10**digits
    return np.where(u > 0, 0.5 * 10**exponent, 0.0)


def _instability(blocks: list[np.ndarray]) -> Float[np.ndarray, " q"]:
    """Twice the standard deviation of the averages over blocks, of the worst of mean, u and both ends."""
    count = len(blocks)
    return 2 * np.std(blocks, axis=0, ddof=1).max(axis=0) / math.sqrt(count)


def _slices(block: int, numbers: int) -> list[int]:
    """Sizes of the parts of a block of trials, so that the readings of each take 200 MB at most."""
    most = max(int(2.5e7 / numbers), 1)
    return [min(most, block - first) for first in range(0, block, most)]


def _exact(arm: Arm, capture: Capture) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N n 3"]]:
    """Poses that hold their socket exactly, and the least change of the joints for each mm that the tip shall move."""
    q = project_to_centroids(arm, capture)
    by_joints = np.asarray(arm.jacobian(q, [f"q_{i}" for i in range(1, arm.joints + 1)]))
    return q, np.linalg.pinv(by_joints, rcond=1e-8)


def _lengths_by(arm: Arm, capture: Capture) -> np.ndarray:
    tips = np.asarray(arm.position(project_to_centroids(arm, capture)))
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    ends = capture.ends()
    return np.linalg.norm(tips[first[ends[:, 0]]] - tips[first[ends[:, 1]]], axis=1)


class _RepeatedTask(NamedTuple):
    """What is the same in all trials."""

    result: Calibration
    capture: Capture
    start: Float[np.ndarray, "v n"]
    end: Float[np.ndarray, "v n"]
    u: Float[np.ndarray, " l"]

    @classmethod
    def of(
        cls, result: Calibration, capture: Capture, lengths: tuple[np.ndarray, np.ndarray] | None
    ) -> "_RepeatedTask":
        check_sockets_only(capture, "resampling")
        if lengths is not None and (
            not isinstance(lengths, tuple | list)
            or len(lengths) != 2
            or np.ndim(lengths[0]) != 2
            or np.shape(lengths[0]) != np.shape(lengths[1])
        ):
            raise InputError(
                "lengths must be two arrays of poses, (v, n) each: where each length starts, and where it ends."
            )
        start, end = lengths or sample_lengths(result.arm, _LENGTHS, length=default_length(result.arm))
        u = np.array([float(length.u) for length in capture.lengths])
        return cls(result, capture, np.asarray(start), np.asarray(end), u)

    def solved(self, q: Float[np.ndarray, "t N n"], values: Float[np.ndarray, "t l"]) -> tuple[np.ndarray, int]:
        """Outputs of the trials that converged ``(t, q)``, and how many did not."""
        result = self.result
        stage1, bounds = result.stage1, result.bounds
        # What sets the scale, and the noise that weights the poses, are the calibration's own.
        task = BatchTask.of(
            stage1.arm,
            batch_of_captures(self.capture, q, values),
            (bounds.lower, bounds.upper),
            stage1.parameters,
            result.space,
            BatchOptions(noise=result.given_noise),
            stage1.anchor,
        )
        many = task.calibrate(result.method)
        good = many.converged
        ends = (jnp.asarray(self.start), jnp.asarray(self.end))
        lengths = _lengths_of(Parameters(result.arm, result.space.names), jnp.asarray(many.parameters), ends)
        assert many.k is not None  # stage 1 of sockets and lengths
        found = np.hstack([many.parameters, many.k[:, None], np.asarray(lengths)])
        return found[good], int(np.sum(~good))

    def sampled(
        self, result: Calibration, values: np.ndarray, stable: bool, failed: int, level: float, digits: int
    ) -> Sampled:
        """The trials' distribution, with the linear result to compare it with."""
        linear = uncertainty_of(result)
        u_length = np.asarray(linear.length(self.start, self.end))
        u = values.std(axis=0, ddof=1)
        low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2], axis=0)
        start, end = (np.asarray(result.arm.position(q)) for q in (self.start, self.end))
        lengths = np.linalg.norm(start - end, axis=1)
        assert result.scale is not None  # of sockets and lengths
        estimate = np.concatenate([result.parameters, [result.scale.value], lengths])
        return Sampled(
            quantities=(*result.space.names, "k", *(f"length {i + 1}" for i in range(len(self.start)))),
            estimate=estimate,
            u=u,
            low=low,
            high=high,
            linear_u=np.concatenate([linear.u, [float(result.scale.u)], u_length]),
            factor=linear.factor(level),
            tolerance=numerical_tolerance(u, digits),
            stable=stable,
            trials=len(values) + failed,
            failed=failed,
            level=level,
            values=values,
        )


@eqx.filter_jit
def _lengths_of(space: Parameters, parameters: Array, ends: tuple[Array, Array]) -> Array:
    def one(vector: Array) -> Array:
        arm = space.arm(vector)
        return jnp.linalg.norm(arm.position(ends[0]) - arm.position(ends[1]), axis=-1)

    return jax.lax.map(one, parameters, batch_size=256)


def batch_of_captures(capture: Capture, q: Numbers, values: Numbers, u: Numbers | None = None) -> Capture:
    """A batch of captures like this one, with other readings and reference lengths, as `identify_many` takes it.

    Args:
        capture: The sockets with their numbers of poses, and the reference lengths, l of them.
        q: Readings ``(batch, N, n)``, socket after socket, rad.
        values: Certified values of the reference lengths ``(batch, l)``, mm.
        u: Their standard uncertainties, likewise; by default the capture's.

    Returns:
        The captures; nothing is checked.
    """
    lengths = range(len(capture.lengths))
    if u is None:
        own = [np.asarray(length.u) for length in capture.lengths]
        u = np.broadcast_to(np.stack(own), np.shape(values)) if own else np.zeros((len(np.asarray(q)), 0))
    leaves = lambda c: [c.q, *(c.lengths[i].value for i in lengths), *(c.lengths[i].u for i in lengths)]  # noqa: E731
    columns = [np.asarray(column)[:, i] for column in (values, u) for i in lengths]
    return eqx.tree_at(leaves, capture, [np.asarray(q), *columns])

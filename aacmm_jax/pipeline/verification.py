"""Whether the parameters that a maker or controller states are good: `verify` tests them on a handful of poses.

Both arms, nominal and as delivered, are compared with the same poses, after what a maker does not state is eliminated
from each: the tip of the tool, the frames of base and instrument, and the positions of sockets. What is left of the two
differs by D = r_nominal - r_delivered, which both arms predict. The regression r_nominal = b D + error says how much of
the stated correction is real: all of it where b = 1, nothing where b = 0. The delivered arm has the smaller sum of
squares if and only if b > 1/2, so that b against 1/2 is the paired test. Errors of one pose may have any covariance;
their standard error is that of the cluster-robust estimator CR3, with degrees of freedom after Satterthwaite (Bell and
McCaffrey 2002, Survey Methodology 28, 169-181).

Poses in two sockets are no sample of the working volume. So a verdict needs a second test: the share b over the whole
volume, by the posterior of a calibration with these poses whose prior is about the *other* arm. It is about the nominal
arm (b = 0) where the verdict is "better", and about the delivered one (b = 1) where it is "worse": what these poses do
not show speaks against the verdict.

Where neither is decided, the two may be equivalent: the ratio of their RMS errors over the working volume lies between
`MARGIN` and 1 / `MARGIN`. That is decided by two one-sided tests at 5 % (Schuirmann 1987, Journal of Pharmacokinetics
and Biopharmaceutics 15, 657-680), with the posteriors about both arms: of whichever speaks against it more.

Delivered parameters that are the nominal ones have nothing to be compared with but a calibration. They are "not good"
where, at 5 %, a calibration with these poses would leave less than `MARGIN` of their error over the working volume in
the posterior about them. They are "good" where it is expected to leave more, and that error is no larger than the RMS
error that these poses show may be: else the poses say too little of the working volume.

No verdict is given where the data do not match the arm: where `calibrate_capture` calls a calibration with these poses
unusable, or corrects their readings or leaves poses out as mixed up. Its tests are the only ones of that.
"""

import math
import warnings
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.solve import solve
from ..calibration.task import Solving, task_of
from ..core.arguments import checked_arguments
from ..core.blas_threads import one_blas_thread
from ..core.distributions import chi_square_quantile, student_quantile, student_tail
from ..core.errors import IdentifiabilityWarning, InputError
from ..core.numpy_or_jax import to_numpy
from ..data.recording import Recording
from ..diagnostics.equations import EXACT, LEAST_U
from ..kinematics.arm import (
    Arm,
    by_joint,
    joint_limits,
    natural_steps,
    parameter_names,
    probe_names,
    reading_as,
    tips_of,
    with_chains,
    without_corrections,
)
from ..kinematics.parameters import ArmSpecification, Bounds, Parameters
from ..uncertainty.linearisation import Linearisation
from .data_match import data_mismatch

VerdictHere = Literal["better", "worse", "not decided"]
Verdict = Literal["better", "worse", "equivalent", "good", "not good", "not decided"]
LEVEL = 0.05  # of the two-sided test, and of each of the two one-sided tests of equivalence
MARGIN = 0.7  # of the smaller to the larger RMS error over the working volume: equivalent from here on
_LENGTHS = 1000.0  # mm; half-width of the box of lengths and of the tip
_TESTED = 300  # poses that stand for the working volume
_DRAWS = 4000  # from the posterior
_SCALES, _NOISES = np.geomspace(0.02, 50, 40), np.geomspace(1e-3, 5, 40)  # of parameters' errors, and of the noise
_FACTOR = 1.5  # ln 4.5
_SAME = 1e-9  # of the residuals: the two arms do not differ in these poses
_MOST = 1000  # poses that may be asked for
_RANK = 1e-9
_TURNED = 3e-3  # of the residuals: so far they follow some steps of 1 mrad, and of 1 mm in 1 m
_BY_LENGTHS = 0.9  # share of a direction's information, from which lengths show it, and poses hardly
_FIXED = ("d_1",)  # a solve has at least one parameter; this one does not change
_FEWEST = 4  # poses
_LEAST_LEFT = 1e-6  # share of a row that the unknowns leave: what they explain whole shows no error


class Accuracy(NamedTuple):
    """RMS error of the tip by one arm, mm, with the interval at `coverage.LEVEL`.

    Example:
        >>> checked = aj.verify(aj.Recording(two_bars, nominal), nominal._replace(arm=true))
        >>> print(checked.delivered.rms < checked.nominal.rms)
        True
    """

    rms: float  # of the distance of a pose from its geometry, for the degrees of freedom that the geometry took
    lower: float
    upper: float
    degrees_of_freedom: float  # effective ones, of the interval

    @property
    def expanded(self) -> float:
        """The expanded uncertainty U: the distance to the farther end of the interval, mm."""
        return max(self.upper - self.rms, self.rms - self.lower)


class Verification(NamedTuple):
    """What `verify` found.

    Example:
        >>> checked = aj.verify(aj.Recording(two_bars, nominal), nominal._replace(arm=true))
        >>> print(checked.verdict, checked.poses, checked.equations, checked.unknowns)
        better 60 182 15
    """

    verdict: Verdict  # of the delivered parameters against the nominal ones; of the same ones, against a calibration
    nominal: Accuracy
    delivered: Accuracy
    share: float  # of the correction from nominal to delivered that is real: 1 all, 0 nothing, 0.5 no better than none
    share_lower: float  # interval at `coverage.LEVEL`
    share_upper: float
    probability: float  # of such a share or a farther one from 0.5, where both arms are equally good
    poses: int
    equations: int
    unknowns: int  # tip, frames and positions of sockets
    decided_by: int | None  # poses that decide between the two, at these errors; None: more than a thousand
    length_errors: Float[np.ndarray, "2 l"]  # of the reference lengths by both arms, between centroids of sockets, mm
    distances: Float[np.ndarray, "2 m"]  # of the poses from their geometry by both arms, mm; sockets first
    volume: (
        float  # RMS error of the delivered arm over the working volume, as a calibration with these poses sees it, mm
    )
    recalibrated: float  # and at least that of an arm calibrated with these poses: its parameters' part, mm
    ratio_lower: float  # of the delivered to the nominal arm's RMS error over the working volume, 90 % interval
    ratio_upper: float
    verdict_here: VerdictHere  # for poses such as these
    same: bool  # whether the two arms do not differ in these poses
    mismatch: str = ""  # why the data do not match the arm, so that there is no verdict; empty where they do
    warnings: tuple[str, ...] = ()  # of what was recorded, and of this mismatch

    @property
    def gain(self) -> float:
        """What a recalibration with these poses gains at most over the working volume, mm."""
        return self.volume - self.recalibrated


@checked_arguments
@one_blas_thread
def verify(recording: Recording, delivered: ArmSpecification | Arm | None = None) -> Verification:
    """Test the parameters that a maker or controller states on a handful of poses, against the nominal parameters.

    The tip of the tool, the frames of instruments and targets, and the positions of sockets are unknown and are
    eliminated from both arms. The verdict is "better" or "worse" where a two-sided paired test at 5 % says so: of two
    arms that are equally good, one in forty is called better and one in forty worse. It is "equivalent" where neither
    is decided, and two one-sided tests at 5 % show that the smaller RMS error over the working volume is at least 70 %
    of the larger; else "not decided". What the poses do not show of the working volume counts against any verdict.
    Parameters that are the nominal ones are "not good" if, by a one-sided test at 5 %, a calibration with these poses
    would leave less than 70 % of their error over the working volume. They are "good" if it is expected to leave more,
    and the expected error there is no larger than the upper limit of the RMS error in these poses. Data that do not
    match the arm, by the tests of `calibrate_capture`, get no verdict.

    Args:
        recording: poses in sockets, on a board, or seen by a tracker; its nominal arm is the one to compare with.
        delivered: the arm with the stated parameters; by default the recording's ``as_found``.

    Returns:
        Accuracy of both arms, the verdict, how many poses decide it, and what a recalibration would gain.

    Raises:
        InputError: no delivered arm is given, the arms differ in their joints, or there are too few poses.

    Example:
        >>> checked = aj.verify(aj.Recording(two_bars, nominal), nominal._replace(arm=true))
        >>> print(checked.verdict, f"{checked.nominal.rms:.1f} mm become {checked.delivered.rms:.3f} mm")
        better 1.8 mm become 0.014 mm
    """
    given = delivered if delivered is not None else recording.as_found
    if given is None:
        raise InputError(
            "the delivered parameters are not given; name the controller's own file with --delivered, or the nominal "
            "arm, or as_found in the manifest."
        )
    nominal = recording.nominal.arm
    arm = given.arm if isinstance(given, ArmSpecification) else given
    if (arm.joints, arm.prismatic) != (nominal.joints, nominal.prismatic):
        raise InputError(
            f"the delivered arm has {arm.joints} joints or other prismatic joints than the nominal arm, which has "
            f"{nominal.joints}; give two descriptions of the same arm."
        )
    recording = to_numpy(recording)
    plain = without_corrections(nominal)
    arms = [to_numpy(plain), to_numpy(reading_as(without_corrections(arm), plain.recorded))]
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        linear, sigmas = zip(*(_fitted(one, recording.capture) for one in arms), strict=True)
        sigma = max(math.sqrt(np.mean(np.square(sigmas))), EXACT)
        rows = [_Rows.of(fit, sigma) for fit in linear]
        unknowns, equations = rows[1].rank, len(rows[1].residual)
        if equations - unknowns < 3 * 2:
            raise InputError(
                f"{equations} equations for {unknowns} unknowns (tip, frames and positions) test nothing; record at "
                "least four poses in each of two sockets, or six that an instrument sees."
            )
        accuracies = [_accuracy(fit, part) for fit, part in zip(linear, rows, strict=True)]
        paired = _paired(*rows)
        # The prior is about the arm that the verdict would be against: few poses cannot decide by it.
        from_nominal, from_delivered = (
            _Volume.of(arms[i], arms[1 - i], linear[i], linear[1 - i], sigma) for i in (0, 1)
        )
    ratios = np.array([np.quantile(r, (LEVEL, 1 - LEVEL)) for r in (from_nominal.ratio, 1 / from_delivered.ratio)])
    lower, upper = float(ratios[:, 0].min()), float(ratios[:, 1].max())
    sure = {"better": from_nominal.probability, "worse": from_delivered.probability, "not decided": 0.0}
    mismatch, said = data_mismatch(recording)
    verdict: Verdict = "not decided"
    if mismatch:
        pass
    elif sure[paired.verdict] > 1 - LEVEL / 2:
        verdict = paired.verdict
    elif not paired.same and lower >= MARGIN and upper <= 1 / MARGIN:
        verdict = "equivalent"
    elif paired.same:
        error, left = from_delivered.error, from_delivered.left
        if left < MARGIN * float(np.quantile(from_delivered.errors, LEVEL)):
            verdict = "not good"
        elif left >= MARGIN * error and error <= accuracies[1].upper:
            verdict = "good"
    return Verification(
        verdict=verdict,
        nominal=accuracies[0],
        delivered=accuracies[1],
        share=paired.share,
        share_lower=paired.share - paired.half_width,
        share_upper=paired.share + paired.half_width,
        probability=paired.probability,
        poses=rows[1].poses,
        equations=equations,
        unknowns=unknowns,
        decided_by=paired.poses_to_decide(rows[1].poses),
        length_errors=np.array([_length_errors(*pair, recording.capture) for pair in zip(arms, linear, strict=True)]),
        distances=np.array([_distances(part) for part in linear]),
        volume=from_delivered.error,
        recalibrated=from_delivered.left,
        ratio_lower=lower,
        ratio_upper=upper,
        verdict_here=paired.verdict,
        same=paired.same,
        mismatch=mismatch,
        warnings=said,
    )


def _fitted(arm: Arm, capture: Any) -> tuple[Linearisation, float]:
    """With the unknown geometry, and the tip where it is not a target's, that fit an arm best; and the standard
    deviation of a tip coordinate, mm."""
    targeted = not capture.sizes and all(observation.target for observation in capture.observations)
    space = Parameters(arm, _FIXED if targeted else tuple(probe_names(tips_of(arm))))
    bounds = Bounds.around(arm, space, length=0.0 if targeted else _LENGTHS)
    solution = solve(to_numpy(task_of(arm, capture, bounds, Solving(hold=None, replace_noise=False))))
    return solution.linear, float(solution.state.sigma)


class _Rows(NamedTuple):
    """Residuals of one arm in the standard deviations of both, without what the unknowns explain."""

    residual: Float[np.ndarray, " R"]
    basis: Float[np.ndarray, "R k"]  # orthonormal, of what the unknowns explain
    pose: np.ndarray  # of each row; a number of its own for each reference length and certified value
    poses: int

    @property
    def rank(self) -> int:
        """Number of unknowns that the rows determine."""
        return self.basis.shape[1]

    @classmethod
    def of(cls, fit: Linearisation, sigma: float) -> "_Rows":
        """With the weights of this standard deviation of a tip coordinate, mm."""
        linear = Linearisation.at(fit.observed, fit.space, fit.z, sigma=sigma, least=LEAST_U)
        values, columns, owner = _stacked(linear)
        basis = _basis(columns[:, len(_FIXED) :] if fit.space.names == _FIXED else columns)
        return cls(_without(basis, values), basis, owner, fit.observed.q.shape[0])


def _stacked(linear: Linearisation, noise: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All rows in standard deviations, their derivatives, and the pose of each; reference lengths and certified values
    have numbers of their own. Rows of poses have errors of ``noise`` standard deviations, and so have those of lengths
    by the u that is stated for them."""
    values, columns, pose, first = [], [], [], 0
    for part, derivative in zip(linear.parts(), linear.dense(), strict=True):
        white = part.without_rest().white  # a last row that stands for the noise of many corners knows no arm
        rows, poses = white.shape
        values.append(np.asarray(white).T.ravel())
        columns.append(np.asarray(derivative)[:, :rows].transpose(2, 1, 0).reshape(rows * poses, -1))
        pose.append(np.repeat(first + np.arange(poses), rows))
        first += poses
    derivatives, errors, u = linear.relations()
    weight = noise / np.maximum(u, LEAST_U)
    return (
        np.concatenate([*values, weight * errors]),
        np.concatenate([*columns, weight[:, None] * derivatives]),
        np.concatenate([*pose, first + np.arange(len(errors))]),
    )


def _basis(columns: Float[np.ndarray, "R k"]) -> Float[np.ndarray, "R r"]:
    """An orthonormal basis of what columns span."""
    sizes = np.linalg.norm(columns, axis=0)
    basis, values, _ = np.linalg.svd(columns / np.where(sizes > 0, sizes, 1.0), full_matrices=False)
    return basis[:, values > _RANK * values.max(initial=1e-300)]


def _without(basis: Float[np.ndarray, "R r"], values: Float[np.ndarray, "R ..."]) -> Float[np.ndarray, "R ..."]:
    return values - basis @ (basis.T @ values)


def _distances(fit: Linearisation) -> Float[np.ndarray, " m"]:
    """Of all poses from their geometry, mm."""
    squares = fit.observed.by_observation(fit.observed.squared_distances(fit.point.rows))
    return np.sqrt(np.concatenate([np.asarray(part) for part in squares]))


def _length_errors(arm: Arm, fit: Linearisation, capture: Any) -> Float[np.ndarray, " l"]:
    """Between the centroids of sockets, mm: their positions are fitted to the lengths and show next to no error."""
    errors = fit.relations()[1][: len(capture.lengths)].copy()
    tips = np.asarray(_with_tip(arm, fit)[0].position(capture.q))
    centroids = {name: tips[capture.owner == i].mean(axis=0) for i, name in enumerate(capture.names)}
    for i, length in enumerate(capture.lengths):
        if {length.start, length.end} <= centroids.keys():
            errors[i] = np.linalg.norm(centroids[length.end] - centroids[length.start]) - length.value
    return errors


def _accuracy(fit: Linearisation, rows: _Rows) -> Accuracy:
    squares = _distances(fit) ** 2
    equations, freedom = len(rows.residual), len(rows.residual) - rows.rank
    mean = max(float(squares.mean()), EXACT**2)
    # Squared distances of single poses scatter more, or less, than those of one normal distribution.
    scatter = float(squares.var(ddof=1)) / len(squares)
    effective = float(np.clip(2 * mean**2 / max(scatter, 1e-300), 1.0, freedom))
    rms = math.sqrt(mean * equations / freedom)
    low, high = (
        rms * math.sqrt(effective / chi_square_quantile(level, effective)) for level in (1 - LEVEL / 2, LEVEL / 2)
    )
    return Accuracy(rms, low, high, effective)


class _Paired(NamedTuple):
    """The regression of the nominal residuals on what the correction predicts."""

    share: float
    u: float
    half_width: float  # of the interval at `coverage.LEVEL`
    probability: float
    same: bool

    @property
    def verdict(self) -> VerdictHere:
        if self.same or abs(self.share - 0.5) <= self.half_width:
            return "not decided"
        return "better" if self.share > 0.5 else "worse"

    def poses_to_decide(self, poses: int) -> int | None:
        """How many poses such as these decide, if the share stays as it is; None: more than a thousand."""
        if self.same:
            return None
        apart = max(abs(self.share - 0.5), 1e-9)
        needed = poses * (float(student_quantile(1 - LEVEL / 2, 1000)) * self.u / apart) ** 2
        return max(math.ceil(needed), _FEWEST) if needed <= _MOST else None


def _paired(nominal: _Rows, delivered: _Rows) -> _Paired:
    basis, first = delivered.basis, nominal.residual
    first = _without(basis, first)
    step = first - delivered.residual
    size = float(step @ step)
    if size <= _SAME**2 * max(float(first @ first), 1e-300):
        return _Paired(0.5, math.inf, math.inf, 1.0, True)
    share = float(step @ first) / size
    whole, rest = np.concatenate([basis, step[:, None] / math.sqrt(size)], axis=1), first - share * step
    scores, spreads = [], []
    for number in np.unique(delivered.pose):
        rows = delivered.pose == number
        values, vectors = np.linalg.eigh(np.eye(int(rows.sum())) - whole[rows] @ whole[rows].T)
        kept = values > _LEAST_LEFT
        score = vectors[:, kept] @ ((vectors[:, kept].T @ step[rows]) / values[kept])
        scores.append(float(score @ rest[rows]))
        # The score as a function of independent errors of all rows.
        spread = -whole @ (whole[rows].T @ score)
        spread[rows] += score
        spreads.append(spread)
    count, gram = len(scores), np.array(spreads) @ np.array(spreads).T
    u = math.sqrt((count - 1) / count * float(np.sum(np.square(scores)))) / size
    freedom = max(np.trace(gram) ** 2 / np.sum(gram**2), 1.0)
    half_width = float(student_quantile(1 - LEVEL / 2, freedom)) * u
    ratio = np.array([abs(share - 0.5) / max(u, 1e-300)])
    probability = float(student_tail(ratio, np.array([freedom]))[0])
    return _Paired(share, u, half_width, probability, False)


class _Posterior(NamedTuple):
    """Of the parameters' errors in natural steps, for each size s of them and each noise t.

    In the basis of the singular vectors its covariance is diagonal.
    """

    weight: Float[np.ndarray, "s t"]
    mean: Float[np.ndarray, "s t p"]
    spread: Float[np.ndarray, "s t p"]  # variance
    basis: Float[np.ndarray, "p p"]

    @classmethod
    def of_rows(
        cls,
        values: Float[np.ndarray, " R"],
        columns: Float[np.ndarray, "R k"],
        steps: Float[np.ndarray, " p"],
        lengths: int,
    ) -> "_Posterior":
        """From rows, of which the last ones are of ``lengths``, and their derivatives, first by the parameters, then by
        the unknowns, which are eliminated."""
        parameters = len(steps)
        explained = _basis(columns[:, parameters:])
        columns, values = _without(explained, columns[:, :parameters] * steps), _without(explained, values)
        left, sizes, right = np.linalg.svd(columns, full_matrices=len(columns) < parameters)
        # A turn or a scaling of everything moves no row but by turning or scaling its residual, which says nothing.
        # Not so of a direction that lengths show.
        by_lengths = np.sum(left[len(values) - lengths :, : len(sizes)] ** 2, axis=0) > _BY_LENGTHS
        determined = sizes > np.maximum(_RANK * sizes[0], np.where(by_lengths, 0, _TURNED * np.linalg.norm(values)))
        seen = np.where(determined, left.T @ values, 0.0)
        unseen = len(values) - explained.shape[1] - int(np.sum(determined))
        sizes, seen = (np.pad(part, (0, parameters - len(part))) for part in (np.where(determined, sizes, 0), seen))
        scale, noise = _SCALES[:, None, None], _NOISES[None, :, None]
        variance = scale**2 * sizes**2 + noise**2
        evidence = np.sum(np.where(sizes > 0, np.log(variance) + seen**2 / variance, 0.0), axis=2)
        rest = max(float(values @ values - seen @ seen), 0.0)
        evidence += (unseen * np.log(noise**2) + rest / noise**2)[..., 0] + (np.log(scale[..., 0]) / _FACTOR) ** 2
        weight = np.exp(-(evidence - evidence.min()) / 2)
        mean, spread = -(scale**2) * sizes * seen / variance, scale**2 * noise**2 / variance
        return cls(weight / weight.sum(), mean, spread, right.T)

    @property
    def noise(self) -> float:
        """Expected noise of the poses, in the standard deviations of the rows."""
        return math.sqrt(np.sum(self.weight * _NOISES**2))

    def drawn(self, random: np.random.Generator) -> Float[np.ndarray, "d p"]:
        """Errors that it holds likely."""
        cells = random.choice(self.weight.size, _DRAWS, p=self.weight.ravel())
        mean, spread = (values.reshape(self.weight.size, -1)[cells] for values in (self.mean, self.spread))
        return mean + np.sqrt(spread) * random.normal(size=spread.shape)


class _Volume(NamedTuple):
    """What these poses say of the errors of an arm over the working volume."""

    probability: float  # that more than half of the step to the other arm is real there
    ratio: Float[np.ndarray, " d"]  # draws of the other arm's RMS error over this one's
    errors: Float[np.ndarray, " d"]  # and of this one's, mm
    left: float  # RMS error of a calibration with these poses, mm

    @property
    def error(self) -> float:
        """Expected RMS error of the arm, mm."""
        return math.sqrt(np.mean(self.errors**2))

    @classmethod
    def of(cls, arm: Arm, other: Arm, fit: Linearisation, of_other: Linearisation, sigma: float) -> "_Volume":
        """``fit`` and ``of_other`` have the tips of both arms; ``sigma`` as for `_Rows`.

        The parameters' errors are s times independent normal numbers of 1 mm and 1 mrad, as those of real arms, and the
        noise is t times ``sigma``. Both are unknown: the posterior is summed over them, weighted by the evidence, with
        s expected to be 1 to a factor of 4.5.
        """
        (arm, tip), (other, _) = _with_tip(arm, fit), _with_tip(other, of_other)
        names = tuple(name for name in parameter_names(arm) if not name.startswith(("probe", "beta")))
        geometry = np.asarray(fit.z)[len(fit.space.names) :]
        space = Parameters(arm, (*names, *tip))
        z = np.concatenate([np.asarray(space.vector()), geometry])
        linear, steps = Linearisation.at(fit.observed, space, z, sigma=sigma, least=LEAST_U), natural_steps(names)
        lengths = len(linear.relations()[2])
        posterior = _Posterior.of_rows(*_stacked(linear)[:2], steps, lengths)
        if lengths:  # u of a length is in mm, and not in units of the noise, which is known only now
            posterior = _Posterior.of_rows(*_stacked(linear, posterior.noise)[:2], steps, lengths)
        limits = np.asarray(joint_limits(arm, None))
        limits = np.where(np.array(by_joint(arm, True, False))[:, None], np.clip(limits, -math.pi, math.pi), limits)
        random = np.random.default_rng(0)
        q = with_chains(arm, random.uniform(limits[:, 0], limits[:, 1], (_TESTED, arm.joints)))
        tips, by = np.asarray(arm.position(q)), np.asarray(arm.jacobian(q, (*names, *probe_names(tips_of(arm)))))
        turned = np.stack([np.cross(axis, tips) for axis in np.eye(3)], axis=2)
        free = np.concatenate([turned, np.tile(np.eye(3), (_TESTED, 1, 1)), by[:, :, len(names) :]], axis=2)
        frames, by = _basis(free.reshape(3 * _TESTED, -1)), by[:, :, : len(names)].reshape(3 * _TESTED, -1)
        step = _without(frames, (np.asarray(other.position(q)) - tips).ravel())
        by_parameters = _without(frames, by) * steps @ posterior.basis
        remaining = float(np.sum(posterior.weight * (posterior.spread @ np.sum(by_parameters**2, axis=0))))
        errors = posterior.drawn(random) @ by_parameters.T
        own, others = np.sum(errors**2, axis=1), np.sum((errors - step) ** 2, axis=1)
        probability, ratio = float(np.mean(others < own)), np.sqrt(others / np.maximum(own, 1e-300))
        return cls(probability, ratio, np.sqrt(own / _TESTED), math.sqrt(remaining / _TESTED))


def _with_tip(arm: Arm, fit: Linearisation) -> tuple[Arm, tuple[str, ...]]:
    """The arm with the tip that was found, and the names of its coordinates; none where all tips are targets."""
    if fit.space.names == _FIXED:
        return arm, ()
    names = tuple(probe_names(tips_of(arm)))
    return arm.replace(probe=np.asarray(fit.z)[: len(names)]), names

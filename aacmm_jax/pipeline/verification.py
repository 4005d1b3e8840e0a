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
"""

import math
import warnings
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.scale_anchor import fixes_scale
from ..calibration.solve import solve
from ..calibration.task import Solving, task_of
from ..core.arguments import checked_arguments
from ..core.distributions import chi_square_quantile, student_quantile, student_tail
from ..core.errors import IdentifiabilityWarning, InputError
from ..core.numpy_or_jax import to_numpy
from ..data.recording import Recording
from ..diagnostics.equations import LEAST_U, PROBE
from ..kinematics.arm import Arm, by_joint, joint_limits, without_corrections
from ..kinematics.parameters import ArmSpecification, Bounds, Parameters
from ..kinematics.priors import Prior
from ..uncertainty.linearisation import Linearisation
from .single import calibrate, identify

Verdict = Literal["better", "worse", "not decided"]
LEVEL = 0.05  # of the two-sided test
_LENGTHS = 1000.0  # mm; half-width of the box of lengths and of the tip
_TESTED = 300  # poses that stand for the working volume
_SAME = 1e-9  # of the residuals: the two arms do not differ in these poses
_MOST = 1000  # poses that may be asked for
_RANK = 1e-9
_FIXED = ("d_1",)  # a solve has at least one parameter; this one does not change
_EXACT = 1e-6  # mm: smaller residuals are rounding errors
_FEWEST = 4  # poses
_LEAST_LEFT = 1e-6  # share of a row that the unknowns leave: what they explain whole shows no error


class Accuracy(NamedTuple):
    """RMS error of the tip by one arm, mm, with its 95 % interval.

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
        better 60 184 15
    """

    verdict: Verdict  # of the delivered parameters against the nominal ones
    nominal: Accuracy
    delivered: Accuracy
    share: float  # of the correction from nominal to delivered that is real: 1 all, 0 nothing, 0.5 no better than none
    share_lower: float  # 95 % interval
    share_upper: float
    probability: float  # of such a share or a farther one from 0.5, where both arms are equally good
    poses: int
    equations: int
    unknowns: int  # tip, frames and positions of sockets
    decided_by: int | None  # poses that decide between the two, at these errors; None: more than a thousand
    length_errors: Float[np.ndarray, "2 l"]  # of the reference lengths by both arms, mm
    volume: (
        float  # RMS error of the delivered arm over the working volume, as a calibration with these poses has it, mm
    )
    recalibrated: float  # and that of an arm calibrated with these poses, mm
    verdict_here: Verdict  # for poses such as these
    same: bool  # whether the two arms do not differ in these poses

    @property
    def gain(self) -> float:
        """What a recalibration with these poses gains over the working volume, mm."""
        return self.volume - self.recalibrated


@checked_arguments
def verify(recording: Recording, delivered: ArmSpecification | Arm | None = None) -> Verification:
    """Test the parameters that a maker or controller states on a handful of poses, against the nominal parameters.

    The tip of the tool, the frames of instruments and targets, and the positions of sockets are unknown and are
    eliminated from both arms. The verdict is "better" or "worse" where a two-sided paired test at 5 % says so, else
    "not decided": of two arms that are equally good, one in forty is called better and one in forty worse. What
    the poses do not show of the rest of the working volume counts against any verdict.

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
        better 1.9 mm become 0.013 mm
    """
    given = delivered if delivered is not None else recording.as_found
    if given is None:
        raise InputError(
            "the delivered parameters are not given; name the controller's own file with --delivered, or as_found in "
            "the manifest."
        )
    nominal = recording.nominal.arm
    arm = given.arm if isinstance(given, ArmSpecification) else given
    if (arm.joints, arm.prismatic) != (nominal.joints, nominal.prismatic):
        raise InputError(
            f"the delivered arm has {arm.joints} joints or other prismatic joints than the nominal arm, which has "
            f"{nominal.joints}; give two descriptions of the same arm."
        )
    recording = to_numpy(recording)
    arms = [to_numpy(without_corrections(nominal)), to_numpy(_read_alike(arm, nominal))]
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        fits = [_fitted(one, recording.capture) for one in arms]
        sigma = max(math.sqrt(sum(float(fit.sigma) ** 2 for fit in fits) / len(fits)), _EXACT)
        rows = [_Rows.of(fit.linear, sigma) for fit in fits]
        unknowns = rows[1].rank
        equations = len(rows[1].residual)
        if equations - unknowns < 3 * 2:
            raise InputError(
                f"{equations} equations for {unknowns} unknowns (tip, frames and positions) test nothing; record at "
                "least four poses in each of two sockets, or six that an instrument sees."
            )
        accuracies = [_accuracy(fit.linear, part) for fit, part in zip(fits, rows, strict=True)]
        paired = _paired(*rows)
        linear = [fit.linear for fit in fits]
        # The prior is about the arm that the verdict would be against: few poses cannot decide by it.
        from_nominal = _Recalibration.of(*arms, *linear, recording.capture)
        from_delivered = _Recalibration.of(*arms[::-1], *linear[::-1], recording.capture)
    freedom = max(equations - unknowns - len(Parameters.free_of(arms[0]).names), _FEWEST)
    wide = float(student_quantile(1 - LEVEL / 2, freedom))
    everywhere = {
        "better": from_nominal.share - wide * from_nominal.u > 0.5,
        "worse": 1 - from_delivered.share + wide * from_delivered.u < 0.5,
        "not decided": True,
    }
    verdict: Verdict = paired.verdict if everywhere[paired.verdict] else "not decided"
    return Verification(
        *(verdict, *accuracies),
        *(paired.share, paired.share - paired.half_width, paired.share + paired.half_width, paired.probability),
        *(rows[1].poses, equations, unknowns, paired.poses_to_decide(rows[1].poses)),
        np.array([fit.linear.relations()[1][: len(recording.capture.lengths)] for fit in fits]),
        *(from_delivered.error, from_delivered.left, paired.verdict, paired.same),
    )


def _read_alike(arm: Arm, nominal: Arm) -> Arm:
    """The arm without corrections, taking what is recorded beside the joints as the nominal one does."""
    return without_corrections(arm).replace(torques=nominal.torques, thermometer=nominal.thermometer)


def _fitted(arm: Arm, capture: Any) -> "_Fit":
    """The unknown geometry, and the tip where it is not a target's, that fit an arm best."""
    targeted = not capture.sizes and all(observation.target for observation in capture.observations)
    space = Parameters(arm, _FIXED if targeted else PROBE)
    bounds = Bounds.around(arm, space, length=0.0 if targeted else _LENGTHS)
    solution = solve(to_numpy(task_of(arm, capture, bounds, Solving(hold=None, replace_noise=False))))
    return _Fit(solution.linear, solution.state.sigma)


class _Fit(NamedTuple):
    linear: Linearisation
    sigma: Any  # standard deviation of a tip coordinate, mm


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
        values, columns, pose, first = [], [], [], 0
        for white, derivative in zip(linear.white(), linear.dense(), strict=True):
            rows, poses = white.shape
            values.append(np.asarray(white).T.ravel())
            columns.append(np.asarray(derivative).transpose(2, 1, 0).reshape(rows * poses, -1))
            pose.append(np.repeat(first + np.arange(poses), rows))
            first += poses
        derivatives, errors, u = linear.relations()
        weight = 1 / np.maximum(u, LEAST_U)
        value = np.concatenate([*values, weight * errors])
        column = np.concatenate([*columns, weight[:, None] * derivatives]) * linear.steps
        column = column[:, len(_FIXED) :] if fit.space.names == _FIXED else column
        basis, sizes, _ = np.linalg.svd(column, full_matrices=False)
        basis = basis[:, sizes > _RANK * sizes.max(initial=1e-300)]
        owner = np.concatenate([*pose, first + np.arange(len(errors))])
        return cls(value - basis @ (basis.T @ value), basis, owner, first)


def _accuracy(fit: Linearisation, rows: _Rows) -> Accuracy:
    squares = np.concatenate([np.asarray(part) for part in fit.observed.squared_distances(fit.point.rows)])
    equations, freedom = len(rows.residual), len(rows.residual) - rows.rank
    mean = max(float(squares.mean()), _EXACT**2)
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
    half_width: float  # of the 95 % interval
    probability: float
    same: bool

    @property
    def verdict(self) -> Verdict:
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
    first = first - basis @ (basis.T @ first)
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
    probability = 2 * float(student_tail(ratio, np.array([freedom]))[0])
    return _Paired(share, u, half_width, probability, False)


class _Recalibration(NamedTuple):
    """A calibration with these poses that begins at one arm, and what follows for the working volume."""

    share: float  # of the step to the other arm that is real there: what holds for poses that were not recorded
    u: float
    error: float  # RMS error of the arm over the working volume, mm
    left: float  # and that of the calibrated arm

    @classmethod
    def of(cls, arm: Arm, other: Arm, fit: Linearisation, of_other: Linearisation, capture: Any) -> "_Recalibration":
        """``fit`` and ``of_other`` have the tips of both arms. The prior of a real arm is about ``arm``."""
        (arm, tip), (other, _) = _with_tip(arm, fit), _with_tip(other, of_other)
        names = tuple(dict.fromkeys([*Parameters.free_of(arm).names, *tip]))
        bounds = Bounds.around(arm, Parameters(arm, names), length=_LENGTHS, angle=math.pi)
        prior = Prior({"lengths": 1.0, "angles": 1e-3, "probe": math.inf}, learn=("lengths", "angles"))
        options: dict[str, Any] = {"prior": prior, "replace_noise": False, "hold": None}
        if fixes_scale(capture):
            options |= {"shared_errors": False, "undetermined": "ignore", "method": "joint"}
            result = to_numpy(calibrate(arm, capture, bounds, **options))
        else:
            result = to_numpy(identify(arm, capture, bounds, **options))
        limits = np.asarray(joint_limits(arm, None))
        limits = np.where(np.array(by_joint(arm, True, False))[:, None], np.clip(limits, -math.pi, math.pi), limits)
        q = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_TESTED, arm.joints))
        tips, count = np.asarray(arm.position(q)), 3 * _TESTED
        moved = np.stack([np.cross(axis, tips) for axis in np.eye(3)], axis=2)
        turned = np.asarray(arm.pose(q))[:, :3, :3]
        free = np.concatenate([moved, np.tile(np.eye(3), (_TESTED, 1, 1)), turned], axis=2).reshape(count, -1)
        free = np.linalg.qr(free)[0]  # the frame of the base, and the tip

        def rest(columns: np.ndarray) -> np.ndarray:
            return columns - free @ (free.T @ columns)

        step = rest((np.asarray(other.position(q)) - tips).ravel())
        by_parameters = rest(np.asarray(arm.jacobian(q, names)).reshape(count, -1))
        change, covariance = np.asarray(result.parameters) - bounds.space.vector(), np.asarray(result.covariance)
        along = step @ by_parameters / max(float(step @ step), 1e-300)
        left = float(np.einsum("rp,pq,rq->", by_parameters, covariance, by_parameters)) / _TESTED
        error = float(np.sum((by_parameters @ change) ** 2)) / _TESTED
        u = math.sqrt(max(float(along @ covariance @ along), 0.0))
        return cls(float(along @ change), u, math.sqrt(error + left), math.sqrt(left))


def _with_tip(arm: Arm, fit: Linearisation) -> tuple[Arm, tuple[str, ...]]:
    """The arm with the tip that was found, and the names of its coordinates; none where all tips are targets."""
    if fit.space.names == _FIXED:
        return arm, ()
    return arm.replace(probe=np.asarray(fit.z)[: len(PROBE)]), PROBE

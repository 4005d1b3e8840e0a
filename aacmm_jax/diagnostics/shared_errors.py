"""Errors that poses share, found in the residuals of a calibration and added to its uncertainty.

Looked for are, each only where a test of the residuals says so with a probability below 10 %: errors of the tip that
all poses of a visit share (marked in the capture, or successive poses where none are), and functions of the readings
that the model lacks (`uncertainty.shared_errors`). The gate keeps the intervals of a calibration in which nothing is
wrong as they are. Errors that all poses of a socket share, which only reference lengths show, are always allowed for
where three lengths or more compare them, as far as these leave them possible. After a robust loss, poses count with the
weights of the solution, as if these were given, and bad ones, which lost most of it, not at all.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..calibration.redrawn import functions_of, places_of
from ..calibration.results import Calibration
from ..calibration.stages import Sensitivities
from ..core.distributions import chi_square_tail, f_tail
from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm, correction_names, natural_steps
from ..kinematics.corrected_arm import with_corrections, with_further_corrections
from ..kinematics.corrections import coefficient_of, shared_model
from ..kinematics.priors import default_prior
from ..uncertainty.covariance import DISAGREEMENT
from ..uncertainty.degrees_of_freedom import Law
from ..uncertainty.shared_errors import SharedErrors
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS
from .equations import EXACT, PRIOR, Rows, lengths_in_solve, residual_rms
from .findings import Case
from .random_effects import (
    NULL,
    Effects,
    OneVariance,
    SharedProblem,
    group_deviations,
    one_variance,
    problem_of_poses,
    scale_of_lengths,
    second_moments,
    with_lengths,
)
from .residual_tests import alike, form_test, in_succession, score_tests

_GATE = 0.1  # probability of a test below which an effect is looked at
# Poses over which successive errors may be alike. Over a third of the poses of a socket and more they are as good as
# alike in all, which poses do not show.
_LENGTHS, _PART = (2.0, 5.0, 15.0), 3
_MOST_PATTERNS = 8  # of successive poses of one socket: slower ones matter, faster ones are like noise
# Part of the residuals of poses above which the size of the arm explains them, to which residuals of sockets are in
# proportion: parameters, or errors of places, of which poses say nothing.
_MOST_OF_POSES = 0.5
_NEIGHBOURS = 1.0  # rad, over which errors of neighbouring configurations are alike
# Of the weight of a pose after a robust loss: less remains beyond 13 standard deviations with Huber, 4 with Tukey.
# Shared errors of a few standard deviations cost weight, too, and are what is looked for.
_TRUSTED = 0.1
_FEWEST = 6  # degrees of freedom
# Median of the standard deviation of errors of the tip that poses share, of that of the residuals, as it is expected
# beforehand; three lengths say so little that it decides how wide intervals are (`benchmarks/NOTES.md`).
_USUAL = 1.25
# Differences between lengths from which errors of places are always allowed for. So few do not show that there are
# none: with three lengths, a gate closes in a third of the captures in which places err by as much as single poses.
_FEW = 2


def amend(result: Calibration, case: Case, sensitivities: Callable[[], Sensitivities]) -> Calibration:
    """The calibration with the errors that its poses share in its covariance.

    What is left of an estimated noise is that of single poses. The covariance by the noise of all stays: where chance
    looks like shared errors, intervals do not become narrower.
    """
    with np.errstate(all="ignore"):
        addition = _addition(case, sensitivities)
    if addition is None:
        return result
    shared, added, variance = addition
    before = result.parameter_covariance
    if PLACES in shared.kinds:
        before = before.without(DISAGREEMENT)
    covariance = before._replace(
        matrix=before.matrix + added,
        noise=jax.tree.map(lambda leaf: np.sqrt(variance) * leaf, before.noise),
    )
    if not np.all(np.isfinite(covariance.matrix)):
        return result
    return eqx.tree_at(
        lambda r: (r.parameter_covariance, r.shared),
        result,
        (covariance, shared),
        is_leaf=lambda x: x is None,
    )


def _addition(
    case: Case, sensitivities: Callable[[], Sensitivities]
) -> tuple[SharedErrors, Float[np.ndarray, "p p"], float] | None:
    """The errors that were found, what they add, and the variance of independent errors, over that of all."""
    record, (rows, relations) = case.record, case.chunks
    # What is left of poses that lost most of their weight to a robust loss is no noise.
    weights = np.concatenate([np.asarray(part) for part in record.observed.weights])
    trusted = [part.at(weights[part.poses] > _TRUSTED) for part in rows]
    rows = [part for part in trusted if len(part.poses)]
    if not rows or residual_rms(rows) < EXACT:
        return None
    prior = [block for block in relations if block.fixture == PRIOR]
    of_poses = problem_of_poses(record, rows, prior, sensitivities)
    whole = sum(float(np.sum(part.residual**2)) for part in rows)
    if lengths_in_solve(record) and of_poses.left.cost < _MOST_OF_POSES * whole:
        relations = [*relations, scale_of_lengths(record, relations)]
        of_poses = problem_of_poses(record, rows, [*prior, relations[-1]], sensitivities)
    if of_poses.left.degrees_of_freedom < _FEWEST:
        return None
    problem = with_lengths(of_poses, relations)
    tips, functions = _visits(of_poses), _functions(of_poses)
    # All but places by the poses alone: lengths that contradict each other would be put down to whatever moves them.
    effects = Effects.none(of_poses.left, record.given_noise is not None)
    chances = [(tips.probability, True)] + ([] if functions is None else [(functions.probability, False)])
    for probability, of_tips in sorted(chances):  # the clearer effect first: it may explain the other
        if probability >= _GATE:
            continue
        if of_tips:
            tips = tips.of(of_poses, effects)
            effects = tips.joined(of_poses, effects)
        elif functions is not None:
            functions = functions.of(effects)
            effects = effects.joined(functions.columns, functions.sd**2 @ functions.members)
    functions = None if functions is None or not len(functions.sd) else functions
    with_tips = tips.joined(problem, Effects.none(problem.left, effects.given))
    every = with_tips if functions is None else functions.joined(problem, with_tips)
    places = _places(problem, every)
    if tips.learned is None and places.learned is None and functions is None:
        return None
    return _summed(problem, (tips, places), functions, places.joined(problem, with_tips), places.joined(problem, every))


def _summed(
    problem: SharedProblem, tips: "tuple[_Tips, ...]", functions: "_Functions | None", without: Effects, every: Effects
) -> tuple[SharedErrors, Float[np.ndarray, "p p"], float]:
    """What all effects add; ``without`` knows those of the tips, and ``every`` all."""
    learned = [(effect, effect.learned) for effect in tips if effect.learned is not None]
    kinds, units = [effect.kind for effect, _ in learned], ["mm" for _ in learned]
    laws, p = [law for _, law in learned], len(problem.record.names)
    sds, added = [np.sqrt(law.variance) for law in laws], np.zeros((len(laws), p, p))
    for whole, (effect, law) in zip(added, learned, strict=True):
        by_effect = problem.by_patterns(effect.patterns[0])
        whole += law.variance * by_effect @ by_effect.T
    law = Law(
        np.full(len(laws), np.inf), np.array([law.ratios for law in laws]), np.array([law.weights for law in laws])
    )
    follow, moments, by_group, names = np.zeros((p, 0)), np.zeros((0, 0)), np.zeros((0, 0, 0)), ()
    if functions is not None:
        names, follow, steps = functions.names, functions.follow, functions.steps
        columns = problem.turned(*functions.turned)
        moments, by_group = second_moments(without, columns, functions.sd, functions.members)
        moments, by_group = (part * steps[:, None] * steps for part in (moments, by_group))
        kinds, units = [*kinds, *functions.kinds], [*units, *functions.units]
        sds += [sd * steps[np.argmax(group)] for sd, group in zip(functions.sd, functions.members, strict=True)]
        of_functions = Law.of(functions.degrees_of_freedom)
        law = law.joined(of_functions) if laws else of_functions
    lengths = [effect.length for effect, _ in learned if np.isfinite(effect.length)]
    shared = SharedErrors(
        kinds=tuple(kinds),
        units=tuple(units),
        names=names,
        sd=np.array(sds),
        moments=moments,
        follow=follow,
        correlation_length=np.asarray(lengths[0] if lengths else np.nan),
        added=added,
        by_group=by_group,
        law=law,
    )
    return shared, added.sum(axis=0) + follow @ moments @ follow.T, every.variance


class _Tips(NamedTuple):
    """Errors of the tip that poses share: patterns over all poses, of which the most likely ones are taken."""

    kind: str
    probability: float
    patterns: list[Float[np.ndarray, "M c"]]
    lengths: tuple[float, ...] = (np.nan,)  # of correlation, for each of the patterns
    learned: OneVariance | None = None
    length: float = np.nan

    def of(self, problem: SharedProblem, effects: Effects) -> "_Tips":
        """With the variance of the most likely patterns.

        Errors that poses share are about as large as those of single poses.
        """
        usual = _USUAL * residual_rms(problem.rows)
        fits = [one_variance(effects, problem.moved(patterns), usual) for patterns in self.patterns]
        best = int(np.argmax([fit.log_likelihood for fit in fits]))
        return self._replace(patterns=[self.patterns[best]], learned=fits[best], length=self.lengths[best])

    def joined(self, problem: SharedProblem, effects: Effects) -> Effects:
        """Effects with this one."""
        if self.learned is None:
            return effects
        columns = problem.moved(self.patterns[0])
        return effects.joined(columns, np.full(columns.shape[1], self.learned.variance))


def _chance_of_alike(problem: SharedProblem, pairs: Callable[[Rows], np.ndarray]) -> float:
    """Probability that tips of poses err so much alike by chance; ``pairs`` says by how much each two poses of one part
    of the rows would, (m, m), with a zero diagonal."""
    kernels = [alike(part.by_tip, pairs(part)) for part in problem.rows]
    if not any(np.any(kernel) for kernel in kernels):
        return 1.0
    return form_test(problem.left, kernels, problem.record.given_noise is None).probability


def _visits(problem: SharedProblem) -> _Tips:
    """Of visits as they are marked, or of successive poses."""
    capture, total = problem.record.recording.capture, len(np.asarray(problem.record.recording.capture.readings))
    if capture.visits is not None:
        marked = np.full(total, -1)
        marked[: len(capture.visits)] = capture.visits

        def same_visit(part: Rows) -> np.ndarray:
            visits = marked[part.poses]
            return (visits[:, None] == visits) & (visits >= 0)[:, None] & ~np.eye(len(visits), dtype=bool)

        numbers = [number for number in np.unique(marked) if number >= 0]
        return _Tips(VISITS, _chance_of_alike(problem, same_visit), [(marked[:, None] == numbers).astype(float)])
    probability = _chance_of_alike(problem, lambda part: in_succession(len(part.poses)))
    if not probability < _GATE:
        return _Tips(SUCCESSIVE, 1.0, [])
    most = max(float(np.median([len(part.poses) for part in problem.rows])) / _PART, _LENGTHS[0])
    lengths = tuple(length for length in _LENGTHS if length <= most)
    patterns = [
        np.concatenate([_smooth_patterns(part, length, total) for part in problem.rows], axis=1) for length in lengths
    ]
    return _Tips(SUCCESSIVE, probability, patterns, lengths)


def _smooth_patterns(part: Rows, length: float, total: int) -> Float[np.ndarray, "M c"]:
    """Principal patterns over successive poses whose correlation falls by 1 / e over a length, in poses."""
    order = np.arange(len(part.poses))
    values, vectors = np.linalg.eigh(np.exp(-np.abs(order[:, None] - order) / length))
    largest = np.argsort(values)[::-1][:_MOST_PATTERNS]
    patterns = np.zeros((total, len(largest)))
    patterns[part.poses] = vectors[:, largest] * np.sqrt(values[largest])
    return patterns


class _Functions(NamedTuple):
    """Functions of the readings that the model lacks, in groups."""

    probability: float
    names: tuple[str, ...]
    kinds: list[str]
    units: list[str]
    members: Float[np.ndarray, "g k"]
    steps: Float[np.ndarray, " k"]
    turned: tuple[Float[np.ndarray, "M k"], np.ndarray, Float[np.ndarray, " k"]]  # what `SharedProblem.turned` takes
    columns: Float[np.ndarray, "R k"]
    follow: Float[np.ndarray, "p k"]
    sd: Float[np.ndarray, " g"] = np.zeros(0)  # of each group, natural steps
    degrees_of_freedom: Float[np.ndarray, " g"] = np.zeros(0)

    def of(self, effects: Effects) -> "_Functions":
        """With the standard deviation of each group."""
        sd, degrees_of_freedom = group_deviations(effects, self.columns, self.members)
        return self._replace(sd=sd, degrees_of_freedom=degrees_of_freedom)

    def joined(self, problem: SharedProblem, effects: Effects) -> Effects:
        """Effects with these."""
        return effects.joined(problem.turned(*self.turned), self.sd**2 @ self.members)


def _functions(problem: SharedProblem) -> _Functions | None:
    """What the arm does not have of the functions that joints may follow."""
    arm: Arm = to_numpy(problem.record.calibrated.arm)
    names = missing_functions(arm)
    if not names:
        return None
    values, joints = functions_of(names, arm, np.asarray(problem.record.recording.capture.readings))
    steps = natural_steps(names)
    columns = problem.turned(values, joints, steps)
    prior = default_prior(with_further_corrections(arm, names)).of(names, np.zeros(len(names)))
    assert prior is not None
    members = np.zeros((len(prior.members), len(names)))
    for row, group in zip(members, prior.members, strict=True):
        row[list(group)] = 1.0
    candidates: dict[tuple[int, tuple[float, ...]], list[int]] = {}
    for i in range(len(names)):
        candidates.setdefault((int(joints[i]), tuple(members[:, i])), []).append(i)
    tests = score_tests(problem.left, [columns[:, together] for together in candidates.values()])
    number = sum(test.degrees_of_freedom[0] > 0 for test in tests)
    return _Functions(
        probability=min(min((test.probability for test in tests), default=1.0) * number, 1.0),
        names=names,
        kinds=list(prior.groups),
        units=list(prior.units),
        members=members,
        steps=steps,
        turned=(values, joints, steps),
        columns=columns,
        follow=problem.by_functions(values, joints),
    )


def missing_functions(arm: Arm) -> tuple[str, ...]:
    """Coefficients of the functions that joints may follow and that an arm does not have."""
    if arm.prismatic:
        return ()
    present = correction_names(arm)
    terms = {name: coefficient_of(name) for name in correction_names(with_corrections(arm, shared_model()))}
    # By known masses a joint bends with one coefficient, and by unknown ones with one for each link.
    by_gravity = [] if arm.corrections is None else arm.corrections.functions.by_gravity
    bends = bool(np.any(by_gravity))
    return tuple(
        name
        for name, term in terms.items()
        if term is not None and name not in present and not (bends and term.kind.rows == 3)
    )


def _places(problem: SharedProblem, effects: Effects) -> _Tips:
    """Errors that all poses of a socket share, which only lengths show."""
    capture = problem.record.recording.capture
    nothing = _Tips(PLACES, 1.0, [])
    if len(capture.lengths) < 2:
        return nothing
    patterns = places_of(capture)
    columns = problem.moved(patterns)
    information, r = effects.product(columns, columns), effects.left.values[:, None]
    values, vectors = np.linalg.eigh(information)
    seen = values > NULL * max(values.max(initial=0.0), 1e-300)
    if not seen.any():
        return nothing
    by_poses = np.where(np.arange(len(r))[:, None] < sum(part.residual.size for part in problem.rows), r, 0.0)
    explained = np.sum((vectors[:, seen].T @ effects.product(columns, by_poses)[:, 0]) ** 2 / values[seen])
    if explained > _MOST_OF_POSES * float(effects.product(by_poses, by_poses)[0, 0]):
        return nothing
    number = int(seen.sum())
    freedom = effects.left.degrees_of_freedom - number
    places = nothing._replace(patterns=[patterns])
    if number >= _FEW:
        return places.of(problem, effects)
    square = float(np.sum((vectors[:, seen].T @ effects.product(columns, r)[:, 0]) ** 2 / values[seen]))
    if effects.given:
        probability = chi_square_tail(square, number)
    else:
        rest = max(float(effects.product(r, r)[0, 0]) - square, 1e-300)
        probability = f_tail(square / number / (rest / freedom), number, freedom)
    if not len(effects.variances):
        probability = min(probability, _chance_of_neighbours(problem))
    return places.of(problem, effects) if probability < _GATE else nothing


def _chance_of_neighbours(problem: SharedProblem) -> float:
    """Probability that poses of one socket at neighbouring configurations err so much alike by chance."""
    q = np.asarray(problem.record.recording.capture.readings)

    def near(part: Rows) -> np.ndarray:
        apart = q[part.poses][:, None] - q[part.poses]
        distance = np.sqrt(np.sum(4 * np.sin(apart / 2) ** 2, axis=2))
        return np.exp(-distance / _NEIGHBOURS) - np.eye(len(distance))

    return _chance_of_alike(problem, near)

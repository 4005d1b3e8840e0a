"""Shared errors, found in the residuals of a calibration and added to its uncertainty.

Looked for are, each only where a test of the residuals says so with a probability below 10 %: errors of the tip that
all poses of a visit share (marked in the capture, or successive poses where none are), and functions of the readings
that the model lacks (`uncertainty.covariance`). The gate keeps the intervals of a calibration in which nothing is
wrong as they are. Errors that all poses of a socket share, which only reference lengths show, are always allowed for
where two lengths or more compare them, as far as these leave them possible. After a robust loss, poses count with the
weights of the solution, as if these were given, and bad ones, which lost most of it, not at all.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..calibration.redrawn import functions_of, places_of
from ..calibration.results import Calibration
from ..calibration.stages import Sensitivities
from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm, correction_names, natural_steps
from ..kinematics.corrected_arm import with_corrections, with_further_corrections
from ..kinematics.corrections import coefficient_of, shared_model
from ..kinematics.priors import default_prior
from ..uncertainty.covariance import DISAGREEMENT, SharedErrors
from ..uncertainty.degrees_of_freedom import Law
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS
from .equations import EXACT, PRIOR, Rows, lengths_in_solve, residual_rms
from .findings import Case
from .random_effects import (
    Effects,
    OneVariance,
    SharedProblem,
    group_deviations,
    one_variance,
    scale_of_lengths,
    second_moments,
    with_lengths,
)
from .residual_tests import Residuals, alike, form_test, in_succession, score_tests

_GATE = 0.1  # probability of a test below which an effect is looked at
# Poses over which successive errors may be alike. Over a third of the poses of a socket and more they are as good as
# alike in all, which poses do not show.
_LENGTHS, _PART = (2.0, 5.0, 15.0), 3
_MOST_PATTERNS = 8  # of successive poses of one socket: slower ones matter, faster ones are like noise
# Part of the residuals of poses above which the size of the arm explains them, to which residuals of sockets are in
# proportion: parameters, or errors of places, of which poses say nothing.
_MOST_OF_POSES = 0.5
# Of the weight of a pose after a robust loss: less remains beyond 13 standard deviations with Huber, 4 with Tukey.
# Shared errors of a few standard deviations cost weight, too, and are what is looked for.
_TRUSTED = 0.1
_FEWEST = 6  # degrees of freedom
# Median of the standard deviation of errors of the tip that poses share, of that of the residuals, as it is expected
# beforehand. Three lengths say so little that it decides how wide intervals are: a seat that shifts by several times
# what single poses scatter is common, and a smaller scale costs coverage there (`benchmarks/NOTES.md`).
_USUAL = 2.5
_EVEN = 6.0  # square of the number of differences between lengths at which it is as likely as not that places err


def amend(result: Calibration, case: Case, sensitivities: Callable[[], Sensitivities]) -> Calibration:
    """The calibration with the errors that its poses share in its covariance.

    What is left of an estimated noise is that of single poses. The covariance by the noise of all stays: where chance
    looks like shared errors, intervals do not become narrower.
    """
    if not case.record.names:  # they are added to the covariance of parameters
        return result
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


class _Tips(NamedTuple):
    """Errors of the tip that poses share: patterns over all poses, x, y and z each."""

    kind: str
    learned: OneVariance
    patterns: Float[np.ndarray, "M c"]
    length: float  # of correlation

    def joined(self, problem: SharedProblem, effects: Effects) -> Effects:
        """Effects with this one."""
        columns = problem.moved(self.patterns)
        return effects.joined(columns, np.full(columns.shape[1], self.learned.variance))


def _tips(
    problem: SharedProblem,
    effects: Effects,
    kind: str,
    candidates: dict[float, Float[np.ndarray, "M c"]],
    probability: float = 1.0,
) -> _Tips:
    """The most likely of some patterns, with their variance.
    ``probability``: that there are such errors, beforehand."""
    usual = _USUAL * residual_rms(problem.rows)
    fits = [one_variance(effects, problem.moved(patterns), usual, probability) for patterns in candidates.values()]
    best = int(np.argmax([fit.log_likelihood for fit in fits]))
    length = list(candidates)[best]
    return _Tips(kind, fits[best], candidates[length], length)


class _Functions(NamedTuple):
    """Functions of the readings that the model lacks, in groups."""

    names: tuple[str, ...]
    values: Float[np.ndarray, "M k"]
    joints: np.ndarray  # from 0
    steps: Float[np.ndarray, " k"]
    groups: dict[str, str]  # with their units
    members: Float[np.ndarray, "g k"]
    sd: Float[np.ndarray, " g"] = np.zeros(0)  # of each group, natural steps
    degrees_of_freedom: Float[np.ndarray, " g"] = np.zeros(0)

    def columns(self, problem: SharedProblem) -> Float[np.ndarray, "R k"]:
        """How they move the rows, in natural steps."""
        return problem.turned(self.values, self.joints, self.steps)

    def joined(self, problem: SharedProblem, effects: Effects) -> Effects:
        """Effects with these."""
        return effects.joined(self.columns(problem), self.sd**2 @ self.members)


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
    blocks = [*(part.block("") for part in rows), *(block for block in relations if block.fixture == PRIOR)]
    left, whole = Residuals.of(blocks), sum(float(np.sum(part.residual**2)) for part in rows)
    if lengths_in_solve(record) and left.cost < _MOST_OF_POSES * whole:
        relations = [*relations, scale_of_lengths(record, relations)]
        left = Residuals.of([*blocks, relations[-1]])
    if left.degrees_of_freedom < _FEWEST:
        return None
    of_poses = SharedProblem(record, rows, left, sensitivities(), None)
    problem, given = with_lengths(of_poses, relations), record.given_noise is not None
    chance_of_tips, kind, candidates = _visits(of_poses)
    chance_of_functions, functions = _functions(of_poses)
    # All but places by the poses alone: lengths that contradict each other would be put down to whatever moves them.
    effects, visits, lacking = Effects.none(left, given), None, None
    for probability, of_tips in sorted([(chance_of_tips, True), (chance_of_functions, False)]):
        # The clearer effect first: it may explain the other.
        if probability >= _GATE:
            continue
        if of_tips:
            visits = _tips(of_poses, effects, kind, candidates)
            effects = visits.joined(of_poses, effects)
        elif functions is not None:
            sd, freedom = group_deviations(effects, functions.columns(of_poses), functions.members)
            lacking = functions._replace(sd=sd, degrees_of_freedom=freedom)
            effects = lacking.joined(of_poses, effects)
    without = Effects.none(problem.left, given)
    without = without if visits is None else visits.joined(problem, without)
    every = without if lacking is None else lacking.joined(problem, without)
    places = _places(problem, every)
    if places is not None:
        without, every = (places.joined(problem, known_effects) for known_effects in (without, every))
    tips = [effect for effect in (visits, places) if effect is not None]
    if not tips and lacking is None:
        return None
    shared = _summed(problem, tips, lacking, without)
    added = np.asarray(shared.added.sum(axis=0) + shared.follow @ shared.moments @ shared.follow.T)
    return shared, added, every.variance


def _summed(problem: SharedProblem, tips: list[_Tips], functions: _Functions | None, without: Effects) -> SharedErrors:
    """What all effects add; ``without`` has those of the tips."""
    p, laws = len(problem.record.names), [effect.learned for effect in tips]
    added = np.zeros((len(tips), p, p))
    for whole, effect in zip(added, tips, strict=True):
        by_effect = np.einsum("paN,Nc->pca", problem.sensitivities.tips, effect.patterns).reshape(p, -1)
        whole += effect.learned.variance * by_effect @ by_effect.T
    law = Law(
        np.full(len(laws), np.inf), np.array([law.ratios for law in laws]), np.array([law.weights for law in laws])
    )
    lengths = [effect.length for effect in tips if np.isfinite(effect.length)]
    shared = SharedErrors(
        kinds=tuple(effect.kind for effect in tips),
        units=("mm",) * len(tips),
        names=(),
        sd=np.array([np.sqrt(law.variance) for law in laws]),
        moments=np.zeros((0, 0)),
        follow=np.zeros((p, 0)),
        correlation_length=np.asarray(lengths[0] if lengths else np.nan),
        added=added,
        by_group=np.zeros((0, 0, 0)),
        law=law,
    )
    if functions is None:
        return shared
    steps, sd, members = functions.steps, functions.sd, functions.members
    moments, by_group = second_moments(without, functions.columns(problem), sd, members)
    of_functions = Law.of(functions.degrees_of_freedom)
    return dataclasses.replace(
        shared,
        kinds=(*shared.kinds, *functions.groups),
        units=(*shared.units, *functions.groups.values()),
        names=functions.names,
        sd=np.concatenate([shared.sd, sd * steps[np.argmax(members, axis=1)]]),
        moments=moments * steps[:, None] * steps,
        # By coefficients in their own units.
        follow=np.einsum("pkN,Nk->pk", problem.sensitivities.joints[:, functions.joints], functions.values),
        by_group=by_group * steps[:, None] * steps,
        law=law.joined(of_functions) if laws else of_functions,
    )


def _chance_of_alike(problem: SharedProblem, pairs: Callable[[Rows], np.ndarray]) -> float:
    """Probability that tips of poses err so much alike by chance; ``pairs`` says by how much each two poses of one part
    of the rows would, (m, m), with a zero diagonal."""
    kernels = [alike(part.by_tip, pairs(part)) for part in problem.rows]
    if not any(np.any(kernel) for kernel in kernels):
        return 1.0
    return form_test(problem.left, kernels, problem.record.given_noise is None).probability


def _visits(problem: SharedProblem) -> tuple[float, str, dict[float, Float[np.ndarray, "M c"]]]:
    """Of visits as they are marked, or of successive poses: the probability by chance, the kind, and patterns by the
    length over which they are alike."""
    capture, rows = problem.record.recording.capture, problem.rows
    total = len(np.asarray(capture.readings))
    if capture.visits is not None:
        marked = np.full(total, -1)
        marked[: len(capture.visits)] = capture.visits

        def same_visit(part: Rows) -> np.ndarray:
            visits = marked[part.poses]
            return (visits[:, None] == visits) & (visits >= 0)[:, None] & ~np.eye(len(visits), dtype=bool)

        numbers = [number for number in np.unique(marked) if number >= 0]
        return _chance_of_alike(problem, same_visit), VISITS, {np.nan: (marked[:, None] == numbers).astype(float)}
    probability, candidates = _chance_of_alike(problem, lambda part: in_succession(len(part.poses))), {}
    most = max(float(np.median([len(part.poses) for part in rows])) / _PART, _LENGTHS[0])
    for length in _LENGTHS:
        if probability < _GATE and length <= most:
            patterns = [np.zeros((total, 0))]
            for part in rows:
                # Principal patterns over successive poses whose correlation falls by 1 / e over the length.
                order = np.arange(len(part.poses))
                values, vectors = np.linalg.eigh(np.exp(-np.abs(order[:, None] - order) / length))
                largest = np.argsort(values)[::-1][:_MOST_PATTERNS]
                patterns.append(np.zeros((total, len(largest))))
                patterns[-1][part.poses] = vectors[:, largest] * np.sqrt(values[largest])
            candidates[length] = np.concatenate(patterns, axis=1)
    return probability, SUCCESSIVE, candidates


def _functions(problem: SharedProblem) -> tuple[float, _Functions | None]:
    """What the arm does not have of the functions that joints may follow, and the probability that residuals follow
    one of them so much by chance."""
    arm: Arm = to_numpy(problem.record.calibrated.arm)
    names = missing_functions(arm)
    if not names:
        return 1.0, None
    values, joints = functions_of(names, arm, np.asarray(problem.record.recording.capture.readings))
    prior = default_prior(with_further_corrections(arm, names)).of(names, np.zeros(len(names)))
    assert prior is not None
    members = np.zeros((len(prior.members), len(names)))
    for row, group in zip(members, prior.members, strict=True):
        row[list(group)] = 1.0
    groups = dict(zip(prior.groups, prior.units, strict=True))
    functions = _Functions(names, values, joints, natural_steps(names), groups, members)
    columns = functions.columns(problem)
    candidates: dict[tuple[int, tuple[float, ...]], list[int]] = {}
    for i in range(len(names)):
        candidates.setdefault((int(joints[i]), tuple(members[:, i])), []).append(i)
    tests = score_tests(problem.left, [columns[:, together] for together in candidates.values()])
    number = sum(test.degrees_of_freedom[0] > 0 for test in tests)
    return min(min((test.probability for test in tests), default=1.0) * number, 1.0), functions


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


def _places(problem: SharedProblem, effects: Effects) -> _Tips | None:
    """Errors that all poses of a socket share, which only lengths show."""
    capture, r = problem.record.recording.capture, effects.left.values
    if len(capture.lengths) < 2:
        return None
    patterns = places_of(capture)
    columns = problem.moved(patterns)
    by_poses = np.where(np.arange(len(r)) < sum(part.residual.size for part in problem.rows), r, 0.0)
    values, squares = effects.spectrum(columns, by_poses)
    number = len(values)
    whole = float(effects.product(by_poses[:, None], by_poses[:, None])[0, 0])
    if not number or np.sum(squares / values) > _MOST_OF_POSES * whole:
        return None
    return _tips(problem, effects, PLACES, {np.nan: patterns}, probability_of_places(number))


def probability_of_places(differences: int) -> float:
    """Probability beforehand that places err at all, where so many differences between lengths can show it.

    Many differences decide by themselves. A few say so little that what is expected beforehand decides how wide U is,
    and a single one may as well be that of a wrong length: with even odds, U would be several times too large in one
    sound capture of ten (`benchmarks/NOTES.md`).
    """
    return differences**2 / (differences**2 + _EVEN)

"""What is wrong with a calibration, the cause that explains most of its residuals first: forward selection among single
mistakes and faults.

A cause is either further columns of the linear equations (one pose that is off, a function of readings, a step of a
zero, of the base or of a seat, a parameter that is fixed, a certified value) or a variance (one encoder, or one socket
or observation, that is noisier than the others). What a cause would explain is twice the gain of the log likelihood,
profiled over the level of the noise: -n log(1 - g) of columns that take the part g of the sum of squares, and the
likelihood ratio of a variance, by the residuals of single poses, each in units of its own standard deviation. That of
a pose alone is its deletion residual (Cook and Weisberg 1982), so that a bad pose does not count in what it is compared
with. From this, log n is subtracted for each unknown (Schwarz 1978, Annals of Statistics 6) and twice log m for the
choice among m causes of a family.

Of those that are significant, the best one joins the model, and the others are compared with what it leaves. Thus a
cause that only imitates the first one is never named, and nothing is where nothing is significant.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.distributions import chi_square_tail, f_tail
from .culprit_words import Culprit, Result, in_words
from .equations import Block, Rows, wider
from .findings import Case, by_equations
from .hypotheses import pose_names, shifted_seats, steps
from .missing_terms import FoundTerm, columns_of
from .possible_causes import Cause, of_certified, of_functions, of_parameters, of_variances
from .residual_tests import LEVEL, PRESENT, SURE, Candidates, Residuals, ScoreTest, Studentised, studentised

MOST_CAUSES = 6  # that are looked for one after the other
_MOST_POSES = 6  # besides these
_AS_WELL = 6.0  # difference of the criterion below which another cause explains as much
# Part of the residuals. A step of a joint, 1 mrad, turns the residuals themselves by 1e-3 of their size, and so does
# the frame of a station that imitates it: in what is left of its column after the frame, linear equations are wrong.
_SECOND_ORDER = 3e-3
# Mean square of a pose that is off, over that of the others. Errors that the model lacks reach 49 among the 1,443 poses
# of `examples/mukca`; less is enough where the pose is also this part of all squares, which such errors are not.
_FAR, _NEAR, _MUCH = 60.0, 25.0, 0.1
_MOSTLY = 0.5  # part of a column that certified values and lengths see
_NOTHING = 0.02  # part of all excess, below which a cause is not named
# Of the gain of the best cause: what a step can lose where its pose is only near that of the change.
_NEARLY, _MOST_REFINED = 0.5, 4
_FACTORS = np.geomspace(0.1, 1e4, 32)  # of variances, in units of what they add to the mean square


class Selection(NamedTuple):
    """The causes of a calibration, the best one first, and the equations with these as further unknowns."""

    culprits: tuple[Culprit, ...]
    rows: list[Rows]
    relations: list[Block]
    remaining: float  # part of the sum of squares that no named cause explains


def culprits_of(case: Case) -> tuple[Culprit, ...]:
    """The causes that explain the residuals of a calibration, the one that explains most first."""
    return case.once(selection).culprits


@by_equations
def missing(case: Case) -> tuple[FoundTerm, ...]:
    """The terms that the model of a calibration lacks."""
    return tuple(culprit.term for culprit in culprits_of(case) if culprit.term is not None and culprit.kind == "term")


@by_equations
def explained(case: Case) -> tuple[list[Rows], list[Block]]:
    """The equations of a calibration, with all causes as further unknowns, and whitened by the noise that they show."""
    chosen = case.once(selection)
    return chosen.rows, chosen.relations


def is_clear(case: Case, level: float) -> bool:
    """Whether a cause other than a noisy joint is less probable than a level by chance.

    In most cases the cause that explains most is, and then no others are searched for.
    """
    if not case.scatters:
        return False
    search = case.once(_search)
    while search.first is None and search.found_next():
        pass
    first = search.first
    if first is not None and first.cause.kind != "noisy joint" and first.probability < level:
        return True
    return any(culprit.kind != "noisy joint" and culprit.probability < level for culprit in culprits_of(case))


@by_equations
def selection(case: Case) -> Selection:
    """Forward selection among all causes."""
    rows, relations = case.chunks
    if not case.scatters:
        return Selection((), rows, relations, 1.0)
    return case.once(_search).run()


class _Search:
    """The selection, cause by cause."""

    def __init__(self, case: Case):
        self.case, (self.rows, self.relations) = case, case.chunks
        self.names = pose_names(case.record.recording.capture)[0]
        self.causes, parameters = [*of_functions(case), *of_certified(case)], of_parameters(case)
        self.anchor = [cause for cause in parameters if cause.name == case.equations.anchor]
        self.parameters = [cause for cause in parameters if cause not in self.anchor] + self.anchor
        self.noises = of_variances(case, self.rows)
        self.added: list[Callable[[], Float[np.ndarray, "R c"]]] = []  # columns of the causes that were chosen
        self.chosen: list[tuple[Result, list[Result]]] = []
        self.shares: list[tuple[float, int]] = []  # of all squares, and unknowns
        self.remaining = 1.0  # part of the squares
        self.sizes: dict[str, int] = {}  # causes of each family
        self.least = _SECOND_ORDER * float(np.sqrt(case.left.cost))
        self._begin()
        self.freedom = self.left.degrees_of_freedom

    def _begin(self) -> None:
        """By the rows as they are weighted now."""
        self.left = Residuals.of([*(part.block("") for part in self.rows), *self.relations])
        self.candidates = Candidates.of(self.left, self._columns(self.causes))
        self.fixed = Candidates.of(self.left, self._columns(self.parameters))
        for columns in self.added:
            self._extend(columns())

    def _extend(self, columns: Float[np.ndarray, "R c"]) -> None:
        before = self.left.basis.shape[1]
        self.left = self.left.extended(columns)
        self.candidates = self.candidates.less(self.left.basis[:, before:])
        self.fixed = self.fixed.less(self.left.basis[:, before:])

    def _columns(self, causes: Sequence[Cause]) -> list[Float[np.ndarray, "R _"]]:
        count, of_relations = len(self.case.left.values), sum(len(block.residual) for block in self.relations)
        of_terms = iter(columns_of([cause.term for cause in causes if cause.term is not None], self.rows, of_relations))
        first = count - of_relations
        return [next(of_terms) if cause.term else np.eye(count, 1, -first - cause.row) for cause in causes]

    def _at_this_scale(self) -> Candidates:
        """Fixed parameters, less what the scale anchor does: with both free, the arm could shrink, and with it its
        residuals."""
        if not self.anchor:
            return self.fixed
        whole, anchor = self.fixed.projected, self.fixed.projected[:, -1:]
        others = whole - anchor @ (anchor.T @ whole) / self._of_anchor()
        return self.fixed._replace(parts=self.fixed.parts[:-1], projected=others)

    def _of_anchor(self) -> float:
        """Squared length of what the model leaves of the scale anchor; infinite where that is nothing."""
        square = float(np.sum(self.fixed.projected[:, -1] ** 2))
        return square if square > PRESENT else np.inf

    def _of_pose(self, number: int) -> Float[np.ndarray, "R r"]:
        """Columns with which a pose agrees whatever its residuals are."""
        start = 0
        for part in self.rows:
            m, r = part.residual.shape
            (place,) = np.nonzero(part.poses == number)
            if len(place):
                columns = np.zeros((len(self.left.values), r))
                columns[start + r * place[0] + np.arange(r), np.arange(r)] = 1.0
                return columns
            start += m * r
        raise KeyError(number)

    @property
    def first(self) -> Result | None:
        """The first cause that is named, whatever follows; the seat never is."""
        return next((result for result, _ in self.chosen if result.cause.kind != "tip"), None)

    def found_next(self) -> bool:
        """Whether there is a further cause, which joins the model."""
        results = self._results() if len(self.chosen) < MOST_CAUSES + _MOST_POSES else []
        if not results:
            return False
        best, *others = self._at_their_poses(sorted(results, key=lambda result: -result.criterion))
        if best.cause.kind != "pose" and sum(r.cause.kind != "pose" for r, _ in self.chosen) >= MOST_CAUSES:
            return False
        alike = [other for other in others if other.criterion > best.criterion - _AS_WELL]
        best, alike = _likelier_first(best, alike)
        self.chosen.append((best, alike))
        added = 1 if best.test is None else best.test.degrees_of_freedom[0]
        self.shares.append((self.remaining * best.share, added))
        self.remaining *= 1 - best.share
        self._take(best)
        return True

    def run(self) -> Selection:
        """All causes."""
        while self.found_next():
            pass
        each = self.remaining / max(self.left.degrees_of_freedom, 1)  # of one degree of freedom
        excess = [share - added * each for share, added in self.shares]
        whole = max(1 - self.freedom * each, 1e-12)
        culprits = self._culprits([min(max(part / whole, 0.0), 1.0) for part in excess])
        columns = [columns() for columns in self.added]
        named = float(np.prod([1 - best.share for best, _ in self.chosen if best.cause.kind != "tip"]))
        return Selection(culprits, *self._with(columns), named)

    def _with(self, columns: list[Float[np.ndarray, "R c"]]) -> tuple[list[Rows], list[Block]]:
        """The equations with further unknowns."""
        if not columns:
            return self.rows, self.relations
        together, start, rows, relations = np.concatenate(columns, axis=1), 0, [], []
        for part in self.rows:
            size = part.residual.size
            more = together[start : start + size].reshape(*part.residual.shape, -1)
            rows.append(part._replace(shared=np.concatenate([part.shared, more], axis=2)))
            start += size
        for block in wider(self.relations, together.shape[1]):
            shared = np.array(block.shared)
            shared[:, -together.shape[1] :] = together[start : start + len(block.residual)]
            relations.append(block._replace(shared=shared))
            start += len(block.residual)
        return rows, relations

    def _take(self, best: Result) -> None:
        """Add the best cause to the model."""
        cause = best.cause
        if cause.of_noise is None:
            self.added.append(self._adding(cause))
            self._extend(self.added[-1]())
            return
        along, whitened = cause.of_noise, []
        for part in self.rows:
            z = along(part)
            covariance = np.eye(z.shape[1]) + best.factor * z @ z.swapaxes(1, 2)
            whitened.append(part.whitened(covariance))
        self.rows = whitened
        self._begin()

    def _adding(self, cause: Cause) -> Callable[[], Float[np.ndarray, "R c"]]:
        """The columns that a cause adds to the model, also where rows are weighted anew."""
        if cause.kind == "pose":
            return lambda: self._of_pose(cause.row)
        if cause.kind != "fixed" or not self.anchor:
            return lambda: self._columns([cause])[0]
        number, lengths = self.parameters.index(cause), self.fixed.lengths
        of_cause, of_anchor = self.fixed.projected[:, number], self.fixed.projected[:, -1]
        part = float(of_cause @ of_anchor) / self._of_anchor() * lengths[number] / lengths[-1]

        def less_anchor() -> Float[np.ndarray, "R c"]:
            columns, anchor = self._columns([cause, *self.anchor])
            return columns - part * anchor

        return less_anchor

    def _results(self) -> list[Result]:
        """All significant causes."""
        causes = [*self.causes, *self.parameters[: len(self.parameters) - len(self.anchor)]]
        tests = [
            *self.candidates.tests(self.left, self.least),
            *self._at_this_scale().tests(self.left, self.least),
        ]
        number = self.sizes = dict.fromkeys((cause.family for cause in causes), 0)
        for cause, test in zip(causes, tests, strict=True):
            number[cause.family] += test.degrees_of_freedom[0] > 0
        results = []
        of_relations = self._in_relations()
        for number_of_cause, (cause, test) in enumerate(zip(causes, tests, strict=True)):
            if not cause.named or (number_of_cause < len(of_relations) and of_relations[number_of_cause]):
                continue
            probability = test.probability * number[cause.family]
            if test.degrees_of_freedom[0] and probability < (LEVEL if cause.family == "function" else SURE):
                results.append(self._of_columns(cause, test, number[cause.family]))
        poses = [
            studentised(part, self.left, rows, private)
            for part, rows, private in zip(self.rows, self.left.slices, self.left.private, strict=False)
        ]
        return [*results, *self._bad_poses(poses), *self._noisy(poses)]

    def _at_their_poses(self, results: Sequence[Result]) -> list[Result]:
        """Causes, the best first, with steps that are nearly as good at the poses where they explain most."""
        refined: dict[tuple[str, str], Result] = {}
        near = results[0].criterion - max(_NEARLY * results[0].share * self.left.degrees_of_freedom, _AS_WELL)
        for result in results:
            term = result.cause.term
            if term is not None and term.first >= 0 and result.criterion > near:
                refined.setdefault((term.kind, term.concerns), result)
        steps_there = [self._at_its_pose(result) for result in list(refined.values())[:_MOST_REFINED]]
        return sorted([*results, *steps_there], key=lambda result: -result.criterion)

    def _at_its_pose(self, best: Result) -> Result:
        """A step at the pose of all near it where it explains most."""
        term, case = best.cause.term, self.case
        assert term is not None
        arm, capture = case.record.calibrated.arm, case.record.recording.capture
        if best.cause.family == "seat":
            terms = shifted_seats(capture, term)
        else:
            gravity = [cause.term for cause in self.causes if cause.term is not None and cause.term.kind == "gravity"]
            terms = steps(arm, capture, gravity, term)
        causes = [best.cause._replace(term=shifted) for shifted in terms]
        tests = Candidates.of(self.left, self._columns(causes)).tests(self.left, self.least)
        cause, test = max(zip(causes, tests, strict=True), key=lambda pair: pair[1].gain)
        return self._of_columns(cause, test, self.sizes[cause.family])

    def _of_columns(self, cause: Cause, test: ScoreTest, number: int) -> Result:
        share, freedom = test.gain / self.left.cost, self.left.degrees_of_freedom
        gain = -freedom * float(np.log(max(1 - share, 1e-12)))
        penalty = test.degrees_of_freedom[0] * np.log(freedom) + 2 * np.log(number)
        return Result(cause, gain - float(penalty), min(test.probability * number, 1.0), share, test)

    def _in_relations(self) -> Bool[np.ndarray, " c"]:
        """Which functions only certified values and lengths see, as a step between two sockets: that these values are
        wrong is then as good an explanation, and a simpler one."""
        count = sum(len(block.residual) for block in self.relations)
        projected, parts = self.candidates.projected, self.candidates.parts
        rows = len(projected) - count
        owner = np.repeat(np.arange(len(parts)), [part.stop - part.start for part in parts])
        squares, below = (
            np.bincount(owner, np.sum(columns**2, axis=0), len(parts)) for columns in (projected, projected[rows:])
        )
        of_values = np.array([cause.kind == "certified" for cause in self.causes])
        return (below > _MOSTLY * squares) & ~of_values

    def _bad_poses(self, poses: Sequence[Studentised]) -> list[Result]:
        """The pose that is farthest from what all others say of it."""
        cost, freedom, worst = self.left.cost, self.left.degrees_of_freedom, None
        for part, pose in zip(self.rows, poses, strict=True):
            gains = np.sum(pose.values**2, axis=1)
            for i in np.argsort(-gains)[:2]:
                gain, added = float(gains[i]), int(pose.present[i])
                if not 0 < added < freedom:
                    continue
                ratio = gain / added / max((cost - gain) / (freedom - added), 1e-300)
                far = ratio > _FAR or (ratio > _NEAR and gain > _MUCH * cost)
                if far and (worst is None or ratio > worst[0]):
                    worst = ratio, gain, added, int(part.poses[i])
        if worst is None:
            return []
        ratio, gain, added, number = worst
        probability = f_tail(ratio, added, freedom - added)
        if probability * len(self.names) >= SURE:
            return []
        test = ScoreTest(gain, ratio, (added, freedom - added), probability, np.zeros(added))
        cause = Cause("pose", "pose", self.names[number], row=number)
        return [self._of_columns(cause, test, len(self.names))]

    def _noisy(self, poses: Sequence[Studentised]) -> list[Result]:
        """Encoders and observations that are noisier than the others."""
        u = np.concatenate([pose.values.ravel() for pose in poses])
        cost, count = float(u @ u), float(sum(pose.present.sum() for pose in poses))
        freedom, results = self.left.degrees_of_freedom, []
        for cause in self.noises:
            along = cause.of_noise
            assert along is not None
            sizes, squares = [], []
            for part, pose in zip(self.rows, poses, strict=True):
                z = along(part)
                if not np.any(z):
                    continue
                z = pose.root @ z
                values, vectors = np.linalg.eigh(z @ z.swapaxes(1, 2))
                sizes.append(values.ravel())
                squares.append((np.einsum("mab,ma->mb", vectors, pose.values) ** 2).ravel())
            size, square = np.concatenate([np.zeros(0), *sizes]), np.concatenate([np.zeros(0), *squares])
            size, square = size[size > 1e-9 * size.max(initial=0.0)], square[size > 1e-9 * size.max(initial=0.0)]
            if not len(size):
                continue
            factors = _FACTORS[:, None] / np.mean(size)
            left = cost - np.sum(factors * size * square / (1 + factors * size), axis=1)
            twice = count * np.log(cost / left) - np.sum(np.log1p(factors * size), axis=1)
            best = int(np.argmax(twice))
            gain = float(twice[best]) * freedom / count
            probability = 0.5 * chi_square_tail(max(gain, 0.0), 1) * len(self.noises)
            if probability < SURE:
                share, penalty = 1 - np.exp(-gain / freedom), np.log(freedom) + 2 * np.log(len(self.noises))
                factor = float(factors[best, 0])
                results.append(Result(cause, gain - float(penalty), probability, float(share), None, factor))
        return results

    def _culprits(self, explains: Sequence[float]) -> tuple[Culprit, ...]:
        """In words."""
        terms = [result for result, _ in self.chosen if result.cause.term is not None]
        coefficients: dict[int, np.ndarray] = {}
        if terms:
            # All together, by the equations as they were weighted last, with the other causes.
            rest = Residuals.of([*(part.block("") for part in self.rows), *self.relations])
            mean, each = [result for result, _ in self.chosen if result.cause.of_noise is None], []
            for result, adding in zip(mean, self.added, strict=True):
                if result.cause.term is None:
                    rest = rest.extended(adding())
                else:
                    each.append(adding())
            (together,) = Candidates.of(rest, [np.concatenate(each, axis=1)]).tests(rest, self.least)
            parts = np.split(together.coefficients, np.cumsum([columns.shape[1] for columns in each])[:-1])
            coefficients = {id(result): part for result, part in zip(terms, parts, strict=True)}
        culprits = []
        for (result, alike), part in zip(self.chosen, explains, strict=True):
            cause = result.cause
            if cause.kind == "tip":  # the seat, whose noise no class of arms states exactly
                continue
            if culprits and part < _NOTHING:
                continue
            culprit = Culprit(cause.kind, cause.name, result.probability, part)
            culprits.append(in_words(self.case, culprit, result, alike, coefficients.get(id(result), np.zeros(0))))
        return tuple(culprits)


@by_equations
def _search(case: Case) -> _Search:
    """The search, which goes on where it was left."""
    return _Search(case)


def _likelier_first(best: Result, alike: list[Result]) -> tuple[Result, list[Result]]:
    """What explains most, with what explains as much; the cause that is likelier by its nature first."""
    term = best.cause.term
    for other in alike:
        found = other.cause.term
        if term is not None and found is not None and (found.kind, found.joint) == (term.rather, term.joint):
            return other, [best, *(rest for rest in alike if rest is not other)]
    return best, alike

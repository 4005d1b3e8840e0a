"""How errors agree with their prediction: of poses and lengths that an arm was not identified from, all together, or
group by group of a cross-validation, which leaves the groups out one after the other."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.distributions import chance, student_quantile
from ..core.text import common_labels
from ..uncertainty.between_groups import BetweenGroups, more_uncertain
from ..uncertainty.coverage import LEVEL

SIGNIFICANCE = 0.01  # probability below which errors beyond their prediction are not put down to chance
_HALF = SIGNIFICANCE / 2  # for single groups of a cross-validation; the other half is for all of them together


class Agreement(NamedTuple):
    """Distances of poses from their geometry, or errors of reference lengths: found, and predicted; mm."""

    count: int  # of poses or lengths
    rms: float  # root mean square, found
    predicted: float  # infinite where the calibration leaves a direction open that matters
    degrees_of_freedom: float  # effective, of the predicted sum of squares
    noise_degrees_of_freedom: float  # of what the prediction rests on; infinite where the noise was given
    reduced_chi: float = math.nan  # root mean square of a residual in standard deviations of the noise alone
    rms_angle: float = math.nan  # of residuals in rad, where there are any
    rms_px: float = math.nan  # in px
    between: BetweenGroups | None = None  # how errors of groups scatter about such a prediction

    @property
    def probability(self) -> float:
        """Of at least such a sum of squares by chance where the prediction is right; NaN where nothing is predicted."""

        def given(of_errors: float, of_prediction: float) -> float:
            freedom = more_uncertain(self.degrees_of_freedom, of_errors)
            return chance(
                self.rms, self.predicted, freedom, more_uncertain(self.noise_degrees_of_freedom, of_prediction)
            )

        return given(0.0, 0.0) if self.between is None else self.between.probability(given)

    def by_groups(self, between: BetweenGroups | None) -> "Agreement":
        """The same, predicted as groups that were held out have shown; as it is where there were none."""
        if between is None or not self.degrees_of_freedom > 0:
            return self
        return self._replace(predicted=self.predicted * math.sqrt(between.ratio), between=between)


NOTHING = Agreement(0, math.nan, math.nan, math.nan, math.inf)  # where there is nothing to compare


class LeftOut(NamedTuple):
    """One group of sockets and observations that an arm was not identified from; mm. Predictions are infinite where the
    other groups leave a direction open that matters."""

    sockets: tuple[str, ...]  # names, also of observations
    poses: int  # in sockets with more than one
    rms: float  # distance from the socket's centroid or the fitted geometry, found
    rms_predicted: float  # what the uncertainty predicts
    length_error: Float[np.ndarray, " l"]
    length_u: Float[np.ndarray, " l"]  # standard uncertainty of that error, predicted
    converged: bool
    # Effective degrees of freedom of both predictions (`prediction`), and of the noise that they rest on. Where they
    # are not known, those of independent errors.
    rms_degrees_of_freedom: float = math.nan
    length_degrees_of_freedom: float = math.nan
    noise_degrees_of_freedom: float = math.inf
    rms_nominal: float | None = None  # distance by the nominal arm, with the geometry fitted to it likewise
    distances: Float[np.ndarray, " m"] | None = None  # of its poses; NaN alone in a socket; None: of an earlier file

    @property
    def normalised_lengths(self) -> np.ndarray:
        """Errors of the lengths that the other groups can predict, in their own standard uncertainties."""
        predicted = np.isfinite(self.length_u) & (self.length_u > 0)
        return self.length_error[predicted] / self.length_u[predicted]

    @property
    def length_ratio(self) -> float:
        """Root mean square of these; NaN where there is none."""
        normalised = self.normalised_lengths
        return float(np.sqrt(np.mean(normalised**2))) if len(normalised) else math.nan

    @property
    def comparisons(self) -> tuple[tuple[float, float, float, float], ...]:
        """Of the poses, then of the lengths: how many, found and predicted root mean squares, degrees of freedom."""
        poses, lengths = self.rms_degrees_of_freedom, self.length_degrees_of_freedom
        count = float(len(self.normalised_lengths))
        of_poses = self.poses, self.rms, self.rms_predicted, poses if math.isfinite(poses) else 3.0 * self.poses
        return of_poses, (count, self.length_ratio, 1.0, lengths if math.isfinite(lengths) else count)

    @property
    def ratio(self) -> float:
        """Mean square distance of the poses over the predicted one; NaN where nothing is predicted."""
        usable = self.poses and 0 < self.rms_predicted < math.inf
        return (self.rms / self.rms_predicted) ** 2 if usable else math.nan

    def probabilities(self, between: BetweenGroups | None = None) -> list[float]:
        """Of such errors of poses, and of lengths, by chance where the predictions are right; NaN where unknown.

        ``between``: how the poses of other groups agree with their prediction.
        """
        poses, lengths = (
            Agreement(int(part[0]), *part[1:], self.noise_degrees_of_freedom) for part in self.comparisons
        )
        return [poses.by_groups(between).probability, lengths.probability]


class CrossValidation(NamedTuple):
    """Every group of sockets left out once. The metrics pool the groups that the others can predict.

    Example:
        >>> left_out = aj.cross_validate(arm, two_bars, bounds)
        >>> for group in left_out.groups:
        ...     print(group.sockets, f"{group.rms:.3f} mm, predicted {group.rms_predicted:.3f} mm")
        ('A', 'B') 0.015 mm, predicted 0.018 mm
        ('C', 'D') 0.017 mm, predicted 0.015 mm
    """

    groups: tuple[LeftOut, ...]

    @property
    def labels(self) -> list[str]:
        """Each group in a few words."""
        return common_labels([group.sockets for group in self.groups])

    @property
    def rms(self) -> float:
        """Root mean square distance from the socket's centroid over the poses of all groups, mm."""
        return self._pooled("rms")

    @property
    def rms_predicted(self) -> float:
        """What the uncertainties of the calibrations without them predicted, mm."""
        return self._pooled("rms_predicted")

    @property
    def rms_nominal(self) -> float:
        """The same distance by the nominal arm, mm; NaN where it is not known."""
        return self._pooled("rms_nominal") if all(group.rms_nominal is not None for group in self.groups) else math.nan

    @property
    def length_rms(self) -> float:
        """Root mean square error of the reference lengths, mm."""
        return self._pooled("length_error")

    @property
    def length_u(self) -> float:
        """Root mean square of the predicted standard uncertainties of these errors, mm."""
        return self._pooled("length_u")

    def _pooled(self, name: str) -> float:
        """Over the poses, or over the lengths, of all groups that the others can predict."""
        if name.startswith("length"):
            values, u = (np.concatenate([getattr(group, n) for group in self.groups]) for n in (name, "length_u"))
            return float(np.sqrt(np.mean(values[np.isfinite(u)] ** 2))) if np.isfinite(u).any() else math.nan
        counted = self._counted
        squares = sum(group.poses * getattr(group, name) ** 2 for group in counted)
        return math.sqrt(squares / sum(group.poses for group in counted)) if counted else math.nan

    @property
    def _counted(self) -> list[LeftOut]:
        """The groups with poses that the others can predict."""
        return [group for group in self.groups if group.poses and np.isfinite(group.rms_predicted)]

    @property
    def distances(self) -> Float[np.ndarray, " m"] | None:
        """Of the poses that `rms` is of, mm; None where the groups do not have them."""
        values = [group.distances for group in self._counted if group.distances is not None]
        if not values or len(values) < len(self._counted):
            return None
        pooled = np.concatenate(values)
        return pooled[np.isfinite(pooled)]

    @property
    def interval(self) -> tuple[float, float] | None:
        """Of `rms` at `coverage.LEVEL`, mm, as it scatters between groups; None of a single group."""
        if (count := len(self._counted)) < 2:
            return None
        poses, squares = (np.array([getattr(group, name) for group in self._counted]) for name in ("poses", "rms"))
        share, squares = poses / poses.sum(), squares**2
        mean = float(share @ squares)
        u = math.sqrt(count / (count - 1) * float(np.sum((share * (squares - mean)) ** 2)))
        half_width = float(student_quantile((1 + LEVEL) / 2, count - 1)) * u
        return math.sqrt(max(mean - half_width, 0.0)), math.sqrt(mean + half_width)

    def between(self, without: int | None = None, *, chosen: bool = False) -> BetweenGroups | None:
        """How the poses of the groups agree with their prediction, or of all but one; None where there are too few.
        ``chosen``: whether the data chose the model."""
        groups = [group for i, group in enumerate(self.groups) if i != without]
        freedom = [group.comparisons[0][3] for group in groups]
        return BetweenGroups.of([group.ratio for group in groups], freedom, chosen=chosen)

    @property
    def probabilities(self) -> list[list[float]]:
        """Of each group: of such errors of poses, and of lengths, by chance, as the other groups have shown it."""
        return [group.probabilities(self.between(without=i)) for i, group in enumerate(self.groups)]

    @property
    def open(self) -> int:
        """How many groups the others cannot predict, because without them something is not determined."""
        return sum(not np.all(np.isfinite(group.length_u)) or group.rms_predicted == np.inf for group in self.groups)

    @property
    def excess(self) -> float:
        """The larger of two ratios of errors to their prediction, of the poses and of the lengths; about 1 is right."""
        pairs = [(self.rms, self.rms_predicted), (self.length_rms, self.length_u)]
        return max((rms / expected for rms, expected in pairs if expected > 0 and np.isfinite(rms)), default=math.nan)

    @property
    def disagreeing(self) -> tuple[int, ...]:
        """Numbers, from 0, of the groups whose errors exceed their prediction by more than chance does in one case of
        two hundred, over all groups together; the most improbable first."""
        probabilities = [[p for p in of_group if math.isfinite(p)] for of_group in self.probabilities]
        least = {i: min(of_group) for i, of_group in enumerate(probabilities) if of_group}
        count = sum(map(len, probabilities))
        return tuple(i for i in sorted(least, key=least.__getitem__) if least[i] < _HALF / count)

    @property
    def surprising(self) -> bool:
        """Whether the errors of a group, or of all groups together, exceed their prediction by more than chance does
        in one case of a hundred."""
        pooled, of_noise = [], min(group.noise_degrees_of_freedom for group in self.groups)
        for parts, between in zip(
            zip(*(group.comparisons for group in self.groups), strict=True), (self.between(), None), strict=True
        ):
            usable = [part for part in parts if part[0] and part[3] > 0 and 0 < part[2] < math.inf]
            if usable:
                # A sum of squares of independent parts with means T and degrees of freedom f has
                # (sum T)^2 / sum (T^2 / f) of them (Satterthwaite).
                count, rms, predicted, freedom = np.array(usable).T
                means = count * predicted**2
                ratio = math.sqrt(np.sum(count * rms**2) / means.sum())

                def given(of_errors: float, _: float, freedom=freedom, means=means, ratio=ratio) -> float:
                    whole = means.sum() ** 2 / np.sum(means**2 / more_uncertain(freedom, of_errors))
                    return chance(ratio, 1.0, float(whole), of_noise)

                pooled.append(given(0.0, 0.0) if between is None else between.probability(given))
        probabilities = [probability for probability in pooled if math.isfinite(probability)]
        return bool(self.disagreeing) or any(probability < _HALF / len(probabilities) for probability in probabilities)

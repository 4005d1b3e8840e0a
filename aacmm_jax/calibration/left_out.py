"""What a cross-validation returns: errors on groups of poses that an arm was not identified from, and their chance."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.distributions import chance
from ..core.text import common_labels

LEVEL = 0.01  # probability below which errors beyond their prediction are not put down to chance
_HALF = LEVEL / 2  # for single groups; the other half is for all of them together


class LeftOut(NamedTuple):
    """One group of sockets and observations that an arm was not identified from; mm. Predictions are infinite where the
    other groups leave a direction open that matters."""

    sockets: tuple[str, ...]  # names, also of observations
    poses: int  # in sockets with more than one
    rms: float  # distance from the socket's centroid or the fitted geometry, found
    rms_predicted: float  # root of the mean square that the uncertainty predicts
    length_error: Float[np.ndarray, " l"]
    length_u: Float[np.ndarray, " l"]  # standard uncertainty of that error, predicted
    converged: bool
    # Effective degrees of freedom of both predictions (`prediction`), and of the noise that they rest on. Where they
    # are not known, those of independent errors.
    rms_degrees_of_freedom: float = math.nan
    length_degrees_of_freedom: float = math.nan
    noise_degrees_of_freedom: float = math.inf

    @property
    def predicted_lengths(self) -> np.ndarray:
        """Which errors of lengths the other groups can predict."""
        return np.isfinite(self.length_u) & (self.length_u > 0)

    @property
    def length_ratio(self) -> float:
        """Root mean square error of the lengths in their own standard uncertainties; NaN where there is none."""
        predicted = self.predicted_lengths
        normalised = self.length_error[predicted] / self.length_u[predicted]
        return float(np.sqrt(np.mean(normalised**2))) if predicted.any() else math.nan

    @property
    def comparisons(self) -> tuple[tuple[float, float, float, float], ...]:
        """Of the poses, then of the lengths: how many, found and predicted root mean squares, degrees of freedom."""
        poses, lengths = self.rms_degrees_of_freedom, self.length_degrees_of_freedom
        count = float(self.predicted_lengths.sum())
        return (
            (self.poses, self.rms, self.rms_predicted, poses if math.isfinite(poses) else 3.0 * self.poses),
            (count, self.length_ratio, 1.0, lengths if math.isfinite(lengths) else count),
        )

    @property
    def probabilities(self) -> list[float]:
        """Of such errors of poses, and of lengths, by chance where the predictions are right; NaN where unknown."""
        return [chance(*parts[1:], self.noise_degrees_of_freedom) for parts in self.comparisons]


class CrossValidation(NamedTuple):
    """Every group of sockets left out once. The metrics pool the groups that the others can predict.

    Example:
        >>> left_out = aj.cross_validate(arm, two_bars, bounds)
        >>> for group in left_out.groups:
        ...     print(group.sockets, f"{group.rms:.3f} mm, predicted {group.rms_predicted:.3f} mm")
        ('A', 'B') 0.015 mm, predicted 0.018 mm
        ('C', 'D') 0.017 mm, predicted 0.014 mm
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

    def _pooled(self, name: str) -> float:
        counted = [group for group in self.groups if group.poses and np.isfinite(group.rms_predicted)]
        squares = sum(group.poses * getattr(group, name) ** 2 for group in counted)
        return math.sqrt(squares / sum(group.poses for group in counted)) if counted else math.nan

    @property
    def length_rms(self) -> float:
        """Root mean square error of the reference lengths, mm."""
        return self._of_lengths("length_error")

    @property
    def length_u(self) -> float:
        """Root mean square of the predicted standard uncertainties of these errors, mm."""
        return self._of_lengths("length_u")

    def _of_lengths(self, name: str) -> float:
        values, u = (np.concatenate([getattr(group, n) for group in self.groups]) for n in (name, "length_u"))
        return float(np.sqrt(np.mean(values[np.isfinite(u)] ** 2))) if np.isfinite(u).any() else math.nan

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
        probabilities = [[p for p in group.probabilities if math.isfinite(p)] for group in self.groups]
        least = {i: min(of_group) for i, of_group in enumerate(probabilities) if of_group}
        count = sum(map(len, probabilities))
        return tuple(i for i in sorted(least, key=least.__getitem__) if least[i] < _HALF / count)

    @property
    def surprising(self) -> bool:
        """Whether the errors of a group, or of all groups together, exceed their prediction by more than chance does
        in one case of a hundred."""
        pooled, of_noise = [], min(group.noise_degrees_of_freedom for group in self.groups)
        for parts in zip(*(group.comparisons for group in self.groups), strict=True):
            usable = [part for part in parts if part[0] and part[3] > 0 and 0 < part[2] < math.inf]
            if usable:
                # A sum of squares of independent parts with means T and degrees of freedom f has
                # (sum T)^2 / sum (T^2 / f) of them (Satterthwaite).
                count, rms, predicted, freedom = np.array(usable).T
                means = count * predicted**2
                ratio = math.sqrt(np.sum(count * rms**2) / means.sum())
                of_sum = float(means.sum() ** 2 / np.sum(means**2 / freedom))
                pooled.append(chance(ratio, 1.0, of_sum, of_noise))
        known = [probability for probability in pooled if math.isfinite(probability)]
        return bool(self.disagreeing) or any(probability < _HALF / len(known) for probability in known)

"""How errors of held-out groups scatter about their prediction: what a further group may be expected to show.

The mean square error that a placement shows is the predicted one times a chi-square variable over its degrees of
freedom, if poses scatter alike everywhere and the model is as certain as its covariance says. Real placements differ by
more: a robot's errors depend on where it is, and a model that was chosen by the data, with scales that they taught it,
predicts other regions less well than it says. Ratios of found to predicted mean squares, of groups that were held
out, show both: their median m, and by what their relative variance exceeds that of chance, tau^2 (by moments, as
DerSimonian and Laird 1986, Controlled Clinical Trials 7, 177-188, without groups that contradict the others, which else
would hide further ones). A further group then has the mean square m times the predicted one, with
1/f' = 1/f + tau^2/2, and m is known as well as so many groups say.
"""

from collections.abc import Sequence
from typing import NamedTuple, Optional

import numpy as np

# Relative variance of mean squares between groups that is expected beforehand, a standard deviation of 11 % of the RMS,
# and how many groups that counts as: two or three groups that agree do not show that all others do.
_EXPECTED, _WEIGHT = 0.05, 2.0
_CONTRADICTS = 3.0  # times the median ratio, above which a group contradicts the others: 1.7 times their RMS


class BetweenGroups(NamedTuple):
    """Found over predicted mean squares of groups that were held out in turn."""

    ratio: float  # their median; at least 1, so that groups that chance favoured promise nothing
    variance: float  # tau^2
    degrees_of_freedom: float  # of the ratio

    @classmethod
    def of(cls, ratios: Sequence[float], degrees_of_freedom: Sequence[float]) -> Optional["BetweenGroups"]:
        """Of groups with these ratios, each with the degrees of freedom of its sum of squares; None of fewer than 2."""
        values, freedom = np.array(ratios, dtype=float), np.array(degrees_of_freedom, dtype=float)
        usable = np.isfinite(values) & (freedom > 0)
        values, number = values[usable], int(usable.sum())
        if number < 2:
            return None
        middle = float(np.median(values))
        alike = values <= _CONTRADICTS * middle
        by_chance, number = float(np.mean(2 / freedom[usable][alike])), int(alike.sum())
        relative = np.var(values[alike], ddof=1) / np.mean(values[alike]) ** 2 if number > 1 else 0.0
        excess = max(float(relative) - by_chance, 0.0)
        variance = ((number - 1) * excess + _WEIGHT * _EXPECTED) / (number - 1 + _WEIGHT)
        return cls(max(middle, 1.0), variance, 2 * number / (variance + by_chance))

    def scatter(self, freedom: float) -> float:
        """Degrees of freedom of a sum of squares with ``freedom`` if all groups scattered alike."""
        return 1 / (1 / freedom + self.variance / 2)

    def certainty(self, freedom: float) -> float:
        """Degrees of freedom of a prediction with ``freedom`` by its noise alone."""
        return 1 / (1 / freedom + 1 / self.degrees_of_freedom)

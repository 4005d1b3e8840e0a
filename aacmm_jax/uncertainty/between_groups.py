"""How errors of held-out groups scatter about their prediction: what a further group may be expected to show.

The mean square error that a placement shows is the predicted one times a chi-square variable over its degrees of
freedom, if poses scatter alike everywhere and the model is as certain as its covariance says. Real placements differ by
more: a robot's errors depend on where it is, and a model that was chosen by the data, with scales that they taught it,
predicts other regions less well than it says. Ratios of found to predicted mean squares, of groups that were held out,
show both: their median m, and the standard deviation tau of their logarithms beyond that of chance, without groups that
contradict the others, which else would hide further ones. Two or three groups that agree do not show that all others
do, so tau has a distribution: beforehand half-Cauchy about what is usual (Gelman 2006, Bayesian Analysis 1, 515-534,
section 7), and then by the likelihood of the ratios (the normal model of random effects: Gelman et al. 2013, "Bayesian
Data Analysis", section 5.4). For each tau, a further group has the mean square m times the predicted one, with
1/f' = 1/f + tau^2/2, and m is known as well as so many groups say.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Optional

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray
from .degrees_of_freedom import Law

# Usual standard deviation of the logarithm of a mean square between groups: hardly any where the model was given. Where
# the data chose it and taught it its scales, only further groups show how far it holds elsewhere: an RMS that is larger
# or smaller by a quarter is as likely as not.
_GIVEN, _CHOSEN = 0.01, 0.5
_TAU = np.geomspace(0.005, 10.0, 50)  # standard deviations that are possible
_LOGS = np.linspace(-6.0, 6.0, 61)  # logarithms of the variance elsewhere, over what is expected
_CONTRADICTS = 3.0  # times the median ratio, above which a group contradicts the others: 1.7 times their RMS


class BetweenGroups(NamedTuple):
    """Found over predicted mean squares of groups that were held out in turn."""

    ratio: float  # their median; at least 1, so that groups that chance favoured promise nothing
    weights: Float[AnyArray, " k"]  # probabilities of standard deviations of the logarithm of a group's ratio, `_TAU`,
    variance: Float[AnyArray, " k"]  # and, with each, the variance of the logarithm of the median
    chosen: bool = False  # whether the data chose the model, which then is part of every U

    @classmethod
    def of(
        cls, ratios: Sequence[float], degrees_of_freedom: Sequence[float], *, chosen: bool = False
    ) -> Optional["BetweenGroups"]:
        """Of groups with these ratios, each with the degrees of freedom of its sum of squares; None of fewer than 2."""
        values, freedom = np.array(ratios, dtype=float), np.array(degrees_of_freedom, dtype=float)
        usable = np.isfinite(values) & (values > 0) & (freedom > 0)
        values, freedom = values[usable], freedom[usable]
        if len(values) < 2:
            return None
        middle = float(np.median(values))
        alike = values <= _CONTRADICTS * middle
        logs, by_chance = np.log(values[alike]), 2 / freedom[alike]
        usual = _CHOSEN if chosen else _GIVEN
        precision = 1 / (_TAU[:, None] ** 2 + by_chance)
        variance = 1 / precision.sum(axis=1)
        away = logs - (variance * (precision @ logs))[:, None]
        weight = 0.5 * (np.sum(np.log(precision) - precision * away**2, axis=1) + np.log(variance))
        weight += np.log(_TAU) - np.log1p((_TAU / usual) ** 2)  # half-Cauchy by the logarithm of tau
        weight = np.exp(weight - weight.max())
        return cls(max(middle, 1.0), weight / weight.sum(), variance, chosen)

    def probability(self, given: Callable[[float, float], float]) -> float:
        """A probability over all that tau may be; ``given`` what is to be added to 2 over the degrees of freedom of a
        sum of squares, and to that of its prediction."""
        cases = zip(self.weights, _TAU, self.variance, strict=True)
        return float(sum(weight * given(float(tau) ** 2, float(variance)) for weight, tau, variance in cases))

    def law(self, degrees_of_freedom: float) -> Law:
        """How well a variance is known elsewhere that is estimated from so many degrees of freedom."""
        sd = np.sqrt(_TAU**2 + np.asarray(self.variance))
        density = np.exp(-0.5 * (_LOGS[:, None] / sd) ** 2)
        weights = (density / density.sum(axis=0)) @ np.asarray(self.weights)
        return Law(np.array([degrees_of_freedom]), self.ratio * np.exp(_LOGS)[None], weights[None])


def more_uncertain(degrees_of_freedom: Any, added: float) -> Any:
    """Degrees of freedom where 2 over them, about the variance of the logarithm, is larger by so much."""
    return 1 / (1 / degrees_of_freedom + added / 2) if added else degrees_of_freedom

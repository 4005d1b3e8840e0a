"""Quantiles and tail probabilities, from ``scipy.special``: ``scipy.stats`` takes a second to import."""

from typing import Any

import numpy as np

_NORMAL = 1e6  # degrees of freedom from which Student's t is normal to all digits that matter


def _special() -> Any:
    from scipy import special  # takes 0.2 s still

    return special


def student_quantile(probability: float, degrees_of_freedom: float | np.ndarray) -> np.ndarray:
    """Quantile of Student's t; of the normal distribution where the degrees of freedom are infinite."""
    infinite = np.isinf(degrees_of_freedom)
    finite = _special().stdtrit(np.where(infinite, 1.0, degrees_of_freedom), probability)
    return np.where(infinite, _special().ndtri(probability), finite)


def student_tail(value: np.ndarray, degrees_of_freedom: np.ndarray) -> np.ndarray:
    """Probability that a variable of Student's t is farther from 0 than a value; normal for infinite degrees."""
    many = np.asarray(degrees_of_freedom) > _NORMAL
    tail = _special().stdtr(np.where(many, 1.0, degrees_of_freedom), -np.abs(value))
    return 2 * np.where(many, _special().ndtr(-np.abs(value)), tail)


def student_density(value: np.ndarray, degrees_of_freedom: np.ndarray) -> np.ndarray:
    """Density of Student's t; normal for infinite degrees of freedom."""
    many = np.asarray(degrees_of_freedom) > _NORMAL
    half = 0.5 * np.where(many, 1.0, degrees_of_freedom)
    gammaln = _special().gammaln
    factor = np.exp(gammaln(half + 0.5) - gammaln(half)) / np.sqrt(2 * np.pi * half)
    density = factor * np.exp(-(half + 0.5) * np.log1p(value**2 / (2 * half)))
    return np.where(many, np.exp(-0.5 * value**2) / np.sqrt(2 * np.pi), density)


def chi_square_quantile(probability: float, degrees_of_freedom: float) -> float:
    """Quantile of the chi-square distribution."""
    return float(_special().chdtri(degrees_of_freedom, 1 - probability))


def chi_square_tail(value: float, degrees_of_freedom: float) -> float:
    """Probability that a chi-square variable exceeds a value."""
    return float(_special().chdtrc(degrees_of_freedom, value))


def f_tail(value: float, numerator: float, denominator: float) -> float:
    """Probability that a variable with the F distribution exceeds a value."""
    return float(_special().fdtrc(numerator, denominator, value))


def detectable(rank: float, degrees_of_freedom: float, level: float, power: float) -> float:
    """Noncentrality from which a test at 1 - level finds a change with this probability: a chi-square test of so many
    combinations, or an F test where the variances have finite degrees of freedom."""
    special = _special()
    if np.isinf(degrees_of_freedom):
        return float(special.chndtrinc(special.chdtri(rank, 1 - level), rank, 1 - power))
    limit = special.fdtri(rank, degrees_of_freedom, level)
    return float(special.ncfdtrinc(rank, degrees_of_freedom, 1 - power, limit))


def chance(rms: float, predicted: float, degrees_of_freedom: float, of_prediction: float) -> float:
    """Probability of a root mean square of at least ``rms`` where ``predicted`` is right, by the F distribution; by
    the chi-square distribution where the prediction is exact (infinite degrees of freedom). NaN where it is unknown."""
    if not (0 < predicted < np.inf and np.isfinite(rms) and np.isfinite(degrees_of_freedom)):
        return float("nan")
    ratio = (rms / predicted) ** 2
    if np.isinf(of_prediction):
        return chi_square_tail(ratio * degrees_of_freedom, degrees_of_freedom)
    return f_tail(ratio, degrees_of_freedom, of_prediction)

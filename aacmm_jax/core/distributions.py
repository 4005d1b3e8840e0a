"""Quantiles and tail probabilities, from ``scipy.special``: ``scipy.stats`` takes a second to import."""

import numpy as np
from scipy import special


def student_quantile(probability: float, degrees_of_freedom: float | np.ndarray) -> np.ndarray:
    """Quantile of Student's t; of the normal distribution where the degrees of freedom are infinite."""
    infinite = np.isinf(degrees_of_freedom)
    finite = special.stdtrit(np.where(infinite, 1.0, degrees_of_freedom), probability)
    return np.where(infinite, special.ndtri(probability), finite)


def chi_square_quantile(probability: float, degrees_of_freedom: float) -> float:
    """Quantile of the chi-square distribution."""
    return float(special.chdtri(degrees_of_freedom, 1 - probability))


def chi_square_tail(value: float, degrees_of_freedom: float) -> float:
    """Probability that a chi-square variable exceeds a value."""
    return float(special.chdtrc(degrees_of_freedom, value))


def f_tail(value: float, numerator: float, denominator: float) -> float:
    """Probability that a variable with the F distribution exceeds a value."""
    return float(special.fdtrc(numerator, denominator, value))

"""The coverage of expanded uncertainties U, probability and factor, in numbers and words; imports nothing, for --help.

The U of a calibration, of a prediction and of a comparison is computed for the probability `LEVEL`, by the degrees of
freedom of each quantity. Before an arm is calibrated there are no degrees of freedom, and standards of acceptance tests
state a factor: the U of what is planned, and that of a test value, is u times `COVERAGE_FACTOR`.
"""

LEVEL = 0.95
COVERAGE_FACTOR = 2.0


def in_percent(level: float) -> str:
    """A coverage probability in words, such as ``95 %``."""
    return f"{100 * level:g} %"


LEVEL_IN_PERCENT = in_percent(LEVEL)
U_AT_LEVEL = f"U ({LEVEL_IN_PERCENT})"
K_IN_WORDS = f"k = {COVERAGE_FACTOR:g}"

"""The coverage probability of the expanded uncertainties U, as a number and in words; imports nothing, for ``--help``.

Every U is computed for `LEVEL`, and every text that names its coverage probability takes the words from here. Test
values of acceptance tests are the exception: the U of these has a coverage factor (``acceptance.judgement``).
"""

LEVEL = 0.95


def in_percent(level: float) -> str:
    """A coverage probability in words, such as ``95 %``."""
    return f"{100 * level:g} %"


LEVEL_IN_PERCENT = in_percent(LEVEL)
U_AT_LEVEL = f"U ({LEVEL_IN_PERCENT})"

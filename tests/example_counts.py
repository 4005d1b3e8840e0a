"""How many examples hypothesis draws: few in the suite, ten times as many in `make test-exhaustive`."""

import os

FACTOR = int(os.environ.get("AACMM_EXAMPLES", "1"))


def example_count(number: int) -> int:
    """So many in the suite."""
    return number * FACTOR

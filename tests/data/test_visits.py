"""Visits to sockets: which numbers are taken, and which are refused."""

import numpy as np
import pytest

import aacmm_jax as aj
from tests.refusals import assert_refused

Q = np.random.default_rng(0).uniform(-1, 1, (4, 6))


def test_visits_are_numbered_over_all_sockets():
    capture = aj.Capture(
        {"A": Q, "B": Q + 0.1, "C": Q + 0.2}, visits={"A": [7, 7, 3, 3], "C": np.array([1.0, 2, 3, 3])}
    )
    assert capture.visits == (1, 1, 0, 0, -1, -1, -1, -1, 2, 3, 4, 4)


@pytest.mark.parametrize(
    ("visits", "sentence"),
    [
        ({"A": ["1", "1", "2", "2"]}, "must be 4 whole numbers"),
        ({"A": [1, 1, 2]}, "must be 4 whole numbers"),
        ({"A": [1, 1, 2, 2.5]}, "must be 4 whole numbers"),
        ({"A": [1, 1, 2, np.nan]}, "must be 4 whole numbers"),
        ({"A": [10**30] * 4}, "must be 4 whole numbers"),
        ({"Z": [1] * 4}, "unknown socket 'Z'"),
    ],
)
def test_what_numbers_no_visits_is_refused(visits, sentence):
    assert_refused(lambda: aj.Capture({"A": Q}, visits=visits), sentence)

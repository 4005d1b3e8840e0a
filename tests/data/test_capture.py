"""Captures: what is refused in words that a user understands, and how visits to sockets are numbered."""

import numpy as np
import pytest

import aacmm_jax as aj

from ..refusals import assert_refused


@pytest.mark.slow
def test_degrees_are_recognized():
    """Of revolute joints; prismatic ones slide by hundreds of mm."""
    said = ["socket 'A' pose 2 joint 1 is 90 rad", "more than four revolutions", "probably in degrees", "numpy.deg2rad"]
    capture, arm = aj.Capture({"A": np.array([[0.0, 1.0], [90.0, 2.0]])}), aj.Arm(alpha=[1, 0], a=[1, 1], d=[0, 0])
    assert_refused(lambda: aj.evaluate(arm, capture), *said)
    aj.evaluate(arm.replace(prismatic=(1,)), capture)


def test_sockets_of_a_batch():
    """Poses are sliced, whatever comes before them."""
    q = np.random.default_rng(0).uniform(-1, 1, (5, 3, 2))
    batch = aj.stack_captures([aj.Capture({"A": rows[:2], "B": rows[2:]}) for rows in q])
    np.testing.assert_array_equal(batch.sockets["A"], q[:, :2])
    np.testing.assert_array_equal(batch.sockets["B"], q[:, 2:])
    assert_refused(lambda: aj.stack_captures([]), "the list of captures is empty")


def test_one_reference_length_needs_no_list():
    q = np.array([[0.1, 0.2]])
    length = aj.ReferenceLength("A", "B", 100.0)
    assert aj.Capture({"A": q, "B": -q}, length).lengths == (length,)


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

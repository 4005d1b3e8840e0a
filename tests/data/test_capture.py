"""Captures: what is refused in words that a user understands."""

import numpy as np

import aacmm_jax as aj

from ..refusals import assert_refused


def test_degrees_are_recognized():
    said = ["socket 'A' pose 2 joint 1 is 90 rad", "more than four revolutions", "look like degrees", "numpy.deg2rad"]
    assert_refused(lambda: aj.Capture({"A": np.array([[0.0, 1.0], [90.0, 2.0]])}), *said)

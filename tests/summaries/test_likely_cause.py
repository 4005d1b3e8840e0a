"""Mistakes of a recording are named by what makes the tips coincide."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.summaries.likely_cause import likely_cause


@pytest.mark.parametrize(
    ("mistake", "cause"),
    [
        (lambda q: q, ""),
        (lambda q: q * [1, 1, -1, 1, 1, 1], "Likely cause: joint 3 read with the wrong sign."),
        (lambda q: q * [1, -1, 1, 1, -1, 1], "Likely cause: joints 2 and 5 read with the wrong sign."),
        (lambda q: q[:, [0, 1, 3, 2, 4, 5]], "Likely cause: the columns of joints 3 and 4 are exchanged."),
        (lambda q: q[:, ::-1], "Likely cause: the columns are in reverse order."),
        (lambda q: q / 0.9, "Likely cause: readings in gon are taken for degrees."),
        (lambda q: np.random.default_rng(0).uniform(-2, 2, q.shape), ""),
    ],
)
def test_cause(paper_arm, noisy_capture, mistake, cause):
    q = mistake(np.asarray(noisy_capture.q))
    capture = aj.Capture({"A": q[:70], "B": q[70:]})
    said = likely_cause(paper_arm, capture)
    assert said.partition(". Corrected")[0] == cause.removesuffix(".")

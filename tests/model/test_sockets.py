"""Metrics of repeatability: which poses are outliers."""

import numpy as np
import pytest

from aacmm_jax.model import pose_outliers


@pytest.mark.parametrize(
    ("distances", "sizes", "expected"),
    [
        ([0.01, 0.012, 0.009, 0.09, 0.095, 0.011, 0.013], (7,), []),  # median 0.012 mm: the limit is 0.096 mm
        ([0.01, 0.012, 0.009, 0.09, 0.097, 0.011, 0.013], (4, 3), [4]),
        ([0.01, 0.0, 0.0, 0.0, 0.012, 0.011], (1, 1, 1, 1, 2), []),  # the only pose of a socket is not counted
        ([1e-12, 1e-12, 1e-10, 1e-12], (4,), []),  # rounding
        ([0.0, 0.0], (1, 1), []),
    ],
)
def test_outliers_by_hand(distances, sizes, expected):
    assert pose_outliers(np.array(distances), sizes)[0].tolist() == expected


def test_normal_errors_along_one_direction_are_no_outliers():
    errors = np.abs(np.random.default_rng(0).normal(size=100_000))
    assert len(pose_outliers(errors, (100_000,))[0]) == 0
    assert np.mean(errors > 4 * np.median(errors)) > 0.005

"""Shared errors, drawn anew: each kind has the covariance over the poses that it states."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.redrawn import draw_shared
from aacmm_jax.uncertainty.covariance import SharedErrors
from aacmm_jax.uncertainty.degrees_of_freedom import Law
from aacmm_jax.uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS

POSES, SD, CORRELATION = (3, 2), 0.1, 2.0
OWNER = np.repeat([0, 1], POSES)
SAME = OWNER[:, None] == OWNER
EXPECTED = {
    PLACES: SAME,
    VISITS: np.array([0, 0, 1, 2, 2])[:, None] == [0, 0, 1, 2, 2],
    SUCCESSIVE: SAME * np.exp(-np.abs(np.arange(5)[:, None] - np.arange(5)) / CORRELATION),
}


@pytest.mark.parametrize("kind", EXPECTED)
def test_covariance_over_the_poses(paper_arm, kind):
    q = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    sockets = {"A": q[:3], "B": q[3:]}
    capture = aj.Capture(sockets, [aj.ReferenceLength("A", "B", value=200.0)], visits={"A": [0, 0, 1], "B": [1, 1]})
    law = Law(np.array([np.inf]), np.array([[0.5, 1.5]]), np.array([[0.5, 0.5]]))
    none = np.zeros((0, 0))
    shared = SharedErrors(
        (kind,), ("mm",), (), np.array([SD]), none, none, np.array(CORRELATION), np.zeros((1, 0, 0)), none[None], law
    )
    drawn = draw_shared(shared, paper_arm, capture, 40_000, np.random.default_rng(1))
    assert drawn is not None
    assert not drawn.joints.any()
    tips = np.moveaxis(drawn.tips, 1, 2).reshape(-1, 5)
    np.testing.assert_allclose(tips.T @ tips / len(tips), SD**2 * EXPECTED[kind], atol=0.02 * SD**2)

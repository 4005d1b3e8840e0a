"""Parameters for captures of targets alone: what the places of the targets replace is fixed, the rest is determined."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.kinematics.corrected_arm import with_corrections
from aacmm_jax.uncertainty.target_parameters import determined_parameters, independent_of_targets, only_targets

BOX = [[400, -400, 200], [800, 400, 800]]
FRAME = (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
LAST = {"alpha_6", "a_6", "d_6", "theta_6", "probe_x", "probe_y", "probe_z"}


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("observation", "wrist"),
    [
        (kinds.SimulatedPoints("T", BOX, 60, FRAME, u=0.01, target="ball", place=(60, 0, 100)), True),
        (kinds.SimulatedPoints("T", BOX, 60, FRAME, u=0.01, target="ball", place=(0, 0, 100)), False),
        (kinds.SimulatedTransforms("T", BOX, 60, (0, 0, 100, 0.1, 0, 0), FRAME, u=0.01, u_angle=1e-4), True),
    ],
    ids=["off the last axis", "on the last axis", "with orientations"],
)
def test_everything_free_is_determined(observation, wrist):
    """Not alpha_5 and theta_5 where the target is on the last axis, unless its orientation is measured."""
    arm = aj.load_arm("ur10e")
    capture = aj.simulate(arm, {}, observations=[observation], poses=1, seed=0, encoder_arcsec=2.0)
    assert only_targets(capture)
    space = independent_of_targets(arm, capture)
    assert not LAST & set(space.names)
    assert {"beta_2", "beta_3"} <= set(space.names)
    assert ({"alpha_5", "theta_5"} <= set(space.names)) == wrist
    np.testing.assert_array_equal(space.base.probe, arm.probe)
    found = aj.observability(arm, capture, space)
    assert found.rank == len(space.names)


def test_a_tip_of_the_arms_own_is_no_target():
    arm = aj.load_arm("ur10e")
    sockets = {"A": (600, 200, 300)}
    assert not only_targets(aj.simulate(arm, sockets, poses=5, seed=0))
    points = kinds.SimulatedPoints("T", BOX, 5, FRAME, u=0.01)
    assert not only_targets(aj.simulate(arm, {}, observations=[points], poses=1, seed=0))


@pytest.mark.slow
def test_expansion_is_free_where_temperatures_vary():
    arm = aj.Arm(alpha=[1.5, 0.1, 0.4], a=[50.0, 300.0, 40.0], d=[20.0, 0.0, 250.0], limits=[(-2, 2)] * 3)
    arm = with_corrections(arm, "expansion")
    q = np.random.default_rng(0).uniform(-1, 1, (8, 3))
    for temperatures, free in ((np.linspace(19.8, 20.9, 8), True), (np.linspace(23.0, 23.5, 8), False)):
        space = determined_parameters(arm, aj.Capture({"A": np.column_stack([q, temperatures])}))
        assert ("expansion" in space.names) == free
        assert "a_2" in space.names

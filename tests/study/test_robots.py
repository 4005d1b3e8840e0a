"""Studies of robots: of the poses of a capture, in which both arms and their contacts take part."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.kinematics.arm import parameter_names
from aacmm_jax.study.blocks import Block
from aacmm_jax.study.trials import draw_trials, run_block
from tests.data.test_contacts import TORSO, TORSO_LINK
from tests.planning.test_robots import TWO
from tests.study.test_joint_models import study

NOISE = aj.Noise(encoder_arcsec=10.0, seating=0.005)
SOCKETS = {"A": (100, 0, 500), "B": (-100, 100, 400), "C": (100, 100, 700)}


def test_a_study_of_a_robot_without_a_capture_is_refused_in_one_sentence():
    nominal = aj.kinematics.ArmSpecification(TWO, "two")
    with pytest.raises(aj.InputError, match="a robot with several chains needs the poses of a capture"):
        aj.study.Study(study({}).specification, nominal)


@pytest.fixture(scope="module")
def made() -> aj.study.Study:
    """A study of two arms on a torso: three common sockets, two lengths between them, and contacts."""
    lengths = [("A", "B", 0.005), ("B", "C", 0.005)]
    capture = aj.simulate(TORSO, SOCKETS, poses=16, lengths=lengths, observations=[TORSO_LINK], noise=NOISE, seed=1)
    free = aj.Parameters.independent(TORSO, capture).names
    tables = {
        "identification": {"held": [name for name in parameter_names(TORSO) if name not in free]},
        "noise": {"encoder_arcsec": 10.0, "seating_mm": 0.005},
        "deviation": {"length_mm": 0.5, "angle_deg": 0.05},
    }
    return aj.study.make_study(arm=TORSO, trials=16, capture=capture, seed=3, **tables)


@pytest.mark.slow
def test_joints_that_carry_both_bodies_are_read_once_in_a_trial(made):
    assert made.settings[0].method == "joint"
    _, batch = draw_trials(made, 0, np.arange(2))
    (contact,) = [part for part in batch.observations if part.kind != "socket"]
    sockets = {part.name: part.q for part in batch.observations if part.kind == "socket"}
    for number, name in enumerate(contact.socket):
        np.testing.assert_array_equal(sockets[name][:, 0, :2], contact.q[:, number, :2])
    assert np.ptp(sockets["A"][:, :, 0], axis=0).min() > 0


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:Poorly determined")
def test_trials_of_a_robot_scatter_as_a_calibration_says(made):
    found = run_block(made, Block(0, 1, 0, 16))
    assert np.all(found["converged"])
    bounds = aj.Bounds.around(TORSO, made.space)
    result = aj.calibrate(TORSO, made.capture, bounds, noise=NOISE, method="joint")
    ratio = (found["estimate"][0] - found["true"][0]) / np.sqrt(np.diag(result.covariance))
    assert 0.85 < np.sqrt(np.mean(ratio**2)) < 1.15

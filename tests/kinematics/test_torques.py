"""Joints that yield to measured torques: what is recorded, where it is missing, and calibrations that use it."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.arm import value_of
from aacmm_jax.kinematics.corrected_arm import holding_torques
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.pipeline.capture_calibration import calibrate_capture
from aacmm_jax.pipeline.model_ladder import default_models
from aacmm_jax.planning.problem import DesignProblem, PlanOptions

BOX, FRAME = [[400, -600, 100], [900, 600, 800]], (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
MASSES = {
    "mass": [7.4, 13.0, 4.0, 2.1, 2.0, 3.6],
    "centre": [(0, 0, 0), (380, 0, 158), (240, 0, 68), *[(0, 7, 18)] * 3],
}
YIELDS = {"torque_2": 0.02, "torque_3": 0.03}


@pytest.fixture(scope="module")
def nominal():
    return aj.load_arm("ur10e").replace(torques=True)


def test_a_joint_yields_to_the_torque_beside_its_reading(nominal):
    random = np.random.default_rng(0)
    q, torques = random.uniform(-1, 1, (5, 6)), random.uniform(-100, 100, (5, 6))
    arm = with_corrections(nominal, ["torque_2", "torque_3"]).replace(**YIELDS)
    moved = q + 1e-3 * torques * np.array([0, 0.02, 0.03, 0, 0, 0])
    for temperature in ([], [np.full((5, 1), 25.0)]):  # which thermal expansion alone makes use of
        warm = arm.replace(thermometer=bool(temperature))
        read = np.concatenate([q, torques, *temperature], axis=1)
        np.testing.assert_allclose(warm.position(read), nominal.position(moved), atol=1e-9)
    np.testing.assert_array_equal(arm.position(q), nominal.position(q))  # without torques and masses nothing is known


def test_torques_that_were_not_recorded_hold_known_masses(nominal):
    """A pendulum of 2 kg at 0.4 m: its drive holds 2 * 9.80665 * 0.4 * cos(30 deg) N m against gravity."""
    arm = aj.Arm(alpha=[np.pi / 2, 0.0], a=[0.0, 400.0], d=[500.0, 0.0], limits=[(-3, 3)] * 2)
    loaded = with_corrections(arm, "torque", mass=[0, 2], centre=[(0, 0, 0), (0, 0, 0)])
    q = np.array([[0.7, np.radians(30)]])
    held = holding_torques(loaded, q)
    np.testing.assert_allclose(held, [[0, 2 * 9.80665 * 0.4 * np.cos(np.radians(30))]], atol=1e-12)
    loaded = loaded.replace(torque_2=0.5)
    np.testing.assert_allclose(loaded.position(q), loaded.position(np.hstack([q, held])), atol=1e-12)
    with pytest.raises(aj.InputError, match="follow from masses, but the masses are unknown"):
        aj.simulate(nominal, {"A": (600, 200, 300)}, poses=2)
    with pytest.raises(aj.InputError, match="torques need an arm with at least two joints"):
        aj.Arm(alpha=[0.0], a=[100.0], d=[0.0], torques=True)


def test_columns_that_an_arm_does_not_have_are_refused(nominal):
    assert (nominal.columns, nominal.possible_columns) == (12, (6, 12))
    assert nominal.replace(thermometer=True).possible_columns == (6, 7, 12, 13)
    with pytest.raises(aj.InputError, match="the arm has 6 joints, their torques; the last axis"):
        nominal.position(np.zeros(7))
    with pytest.raises(aj.InputError, match="an arm with torques=True if columns of torques follow"):
        aj.evaluate(aj.load_arm("ur10e"), aj.Capture({"A": np.zeros((2, 12)) + np.eye(2, 12)}))


@pytest.mark.slow
def test_a_calibration_takes_torques_where_they_were_recorded(nominal):
    """By default, and with a payload that nobody stated: the torques have it."""
    true = aj.perturbed_arm(aj.Parameters.free_of(nominal), length=0.3, angle=5e-4, seed=1)
    true = with_corrections(true, "torque", **MASSES).replace(**YIELDS)
    points = [kinds.SimulatedPoints("T", BOX, 60, FRAME, u=0.02)]
    noise = aj.Noise(encoder_arcsec=5, seating=0.01)
    capture = aj.simulate(true, {}, observations=points, noise=noise, seed=1)
    assert capture.columns == 12
    assert default_models(nominal, capture)[:3] == ("dh", "torque", "gravity")
    record = calibrate_capture(aj.Recording(capture, ArmSpecification(nominal)))
    assert record.decisions[-1].startswith("Model of the joints: torque.")
    for name, value in YIELDS.items():
        number = record.names.index(name)
        assert abs(value_of(record.calibrated.arm, name) - value) < 3 * np.sqrt(record.covariance[number, number])


@pytest.mark.slow
@pytest.mark.parametrize("masses", [{}, MASSES])
def test_plans_determine_torques_by_masses_alone(nominal, masses):
    arm = with_corrections(aj.load_arm("ur10e"), "torque", **masses)
    planned = DesignProblem.of(arm, PlanOptions())
    assert ("torque_2" in planned.space.names) == bool(masses)

"""Residuals with their directions: as long as the distances, and along what each joint does to the tip."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics.pose_residuals import observation_residuals, signed_residuals


@pytest.mark.slow
def test_residuals_of_observations_are_as_long_as_their_distances(observed_record):
    found = signed_residuals(observed_record)
    distance = np.concatenate([one.distance for one in observation_residuals(observed_record)])
    full = np.concatenate([one.weight for one in observation_residuals(observed_record)]) > 0
    np.testing.assert_array_equal(found.poses, np.arange(len(distance)))
    np.testing.assert_allclose(np.linalg.norm(found.vector, axis=1)[full], distance[full], rtol=1e-6)


@pytest.mark.slow
def test_residuals_of_sockets_by_axis_and_along_what_each_joint_does(paper_arm):
    """Against tips less their centroid, and differences of the tip by the reading."""
    true = paper_arm.replace(a_2=63.0)
    capture = aj.simulate(true, {"A": (400, 200, 300), "B": (600, 300, 200)}, poses=12, encoder_arcsec=20.0, seed=4)
    result = aj.identify(paper_arm, capture, aj.Bounds.around(paper_arm, aj.Parameters.free_of(paper_arm)))
    record = aj.calibration.record_of(result, aj.Recording(capture, aj.kinematics.ArmSpecification(paper_arm)))
    found = signed_residuals(record)
    arm, q = record.calibrated.arm, np.asarray(capture.q)
    tips = np.asarray(arm.position(q)).reshape(2, 12, 3)
    expected = (tips - tips.mean(axis=1, keepdims=True)).reshape(-1, 3)
    np.testing.assert_allclose(found.vector, expected, atol=1e-9)
    for joint in range(6):
        step = 1e-5 * np.eye(6)[joint]
        moves = np.asarray(arm.position(q + step)) - np.asarray(arm.position(q - step))
        along = np.sum(expected * moves, axis=1) / np.linalg.norm(moves, axis=1)
        np.testing.assert_allclose(found.along_joint[:, joint], along, atol=1e-7)

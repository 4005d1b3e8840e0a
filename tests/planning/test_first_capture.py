"""What a first capture determines, and how many poses it needs."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data.noise import Noise
from aacmm_jax.kinematics.workspace import arm_reach, closest_approach
from aacmm_jax.planning import first_capture as planned
from aacmm_jax.planning.first_capture import determined_by, first_capture, still_joints


@pytest.mark.slow
def test_numbers_of_determined_parameters(paper_arm):
    """METROLOGY: 27 by positions for six revolute joints, 21 without the base, 20 without the scale."""
    sockets, length, tracker, target = determined_by(paper_arm).values()
    assert [seen.rank for seen in (sockets, length, tracker)] == [20, 21, 21]
    assert target.rank == 18  # without the three coordinates of a target in the last frame
    assert any("the scale" in text for text in sockets.undetermined)


@pytest.mark.slow
def test_a_still_first_joint_hides_the_link_after_it(paper_arm):
    still = still_joints(paper_arm)
    assert {"a_1", "alpha_1"} <= set(still[0])
    assert all(lost is None or lost for lost in still)


@pytest.mark.slow
def test_predictions_follow_poses_and_noise(paper_arm, monkeypatch):
    monkeypatch.setattr(planned, "_PLACEMENTS", 2)
    noise = Noise(encoder_arcsec=2.0, seating=0.005)
    u_reading, expected = first_capture(paper_arm, noise)
    four = next(row for row in expected if row.sockets == 4)
    # The calibration's part falls as the root of the number of poses, down to that of the reference lengths.
    assert four.u[20] / four.u[80] == pytest.approx(2.0, rel=0.05)
    assert four.u[four.enough] <= u_reading
    double_reading, double = first_capture(paper_arm, Noise(encoder_arcsec=4.0, seating=0.01))
    assert double_reading == pytest.approx(2 * u_reading, rel=1e-3)
    assert next(row for row in double if row.sockets == 4).u[40] == pytest.approx(2 * four.u[40], rel=0.05)


@pytest.mark.slow
def test_predictions_are_those_of_calibrations(paper_arm):
    """Against the uncertainty that a calibration of simulated poses has."""
    noise = Noise(encoder_arcsec=2.0, seating=0.005)
    expected = first_capture(paper_arm, noise)[1][1].u[40]
    space = aj.Parameters.independent(paper_arm)
    points = {"A": (500, 300, 300), "B": (500, 0, 300), "C": (-200, 600, 500), "D": (-200, 400, 720)}
    lengths = [("A", "B", 0.002), ("C", "D", 0.002)]
    capture = aj.simulate(paper_arm, points, poses=10, lengths=lengths, noise=noise, seed=1)
    result = aj.calibrate(paper_arm, capture, aj.Bounds.around(paper_arm, space), method="joint", noise=noise)
    volume = aj.volumetric_uncertainty(aj.uncertainty_of(result), points=100)
    assert expected == pytest.approx(float(np.median(volume.u_length)), rel=0.4)


def planar(limits):
    """A vertical axis, and two links of 300 and 100 mm in the plane above it."""
    return aj.Arm(alpha=[np.pi / 2, 0, 0], a=[0, 300, 100], d=[200, 0, 0], limits=[(-3, 3), (-3, 3), limits])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("elbow", "nearest", "farthest"),
    [
        ((-np.pi, np.pi), 200.0, 400.0),
        ((-np.pi / 2, np.pi / 2), np.hypot(300, 100), 400.0),
        ((1.0, np.pi), 200.0, None),
    ],
)
def test_nearest_and_farthest_tip(elbow, nearest, farthest):
    arm = planar(elbow)
    assert closest_approach(arm) == pytest.approx(nearest, abs=1e-6)
    farthest = np.sqrt(300**2 + 100**2 + 2 * 300 * 100 * np.cos(1.0)) if farthest is None else farthest
    assert arm_reach(arm).radius == pytest.approx(farthest, abs=1e-6)

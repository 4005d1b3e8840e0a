"""Where a calibration was tried: distances in joint space, by hand."""

import numpy as np
import pytest

from aacmm_jax.diagnostics.joint_travel import tried_poses
from tests.prismatic_arms import SCARA
from tests.refusals import assert_refused


def test_distances_go_the_shorter_way_round_and_by_joint(paper_arm):
    """A row of poses 0.1 rad apart in one of six joints; root mean squares over the joints."""
    known = np.zeros((11, 6))
    known[:, 0] = np.linspace(0, 1, 11)
    other = np.zeros((3, 6))
    other[:, 0] = (0.55, 2 * np.pi - 0.05, 2.0)
    found = tried_poses(paper_arm, known, other)
    assert found.spacing == pytest.approx(0.1 / np.sqrt(6))
    np.testing.assert_allclose(found.distance, np.array([0.05, 0.05, 1.0]) / np.sqrt(6))
    assert found.tried.tolist() == [True, True, False]


def test_slides_count_in_metres_and_do_not_go_round():
    arm = SCARA
    (slide,) = arm.prismatic
    known = np.zeros((2, arm.joints))
    known[1, slide - 1] = 100.0
    other = np.zeros((1, arm.joints))
    other[0, slide - 1] = -2000 * np.pi
    found = tried_poses(arm, known, other)
    assert found.spacing == pytest.approx(0.1 / np.sqrt(arm.joints))
    assert found.distance[0] == pytest.approx(2 * np.pi / np.sqrt(arm.joints))


def test_temperatures_are_no_distance(paper_arm):
    arm = paper_arm.replace(thermometer=True)
    known = np.zeros((11, 7))
    known[:, 0], known[:, 6] = np.linspace(0, 1, 11), 20 + np.arange(11)
    for other in (np.zeros((1, 6)), np.zeros((1, 7))):
        found = tried_poses(arm, known, other)
        assert found.spacing == pytest.approx(0.1 / np.sqrt(6))
        assert found.distance[0] == 0


def test_one_pose_has_no_distance(paper_arm):
    assert_refused(
        lambda: tried_poses(paper_arm, np.zeros((1, 6)), np.zeros((1, 6))), "needs at least two poses, but there are 1"
    )


def test_a_calibration_tried_its_own_poses_and_says_how_much_else(paper_arm):
    from aacmm_jax.summaries.tables import tried_sentence

    q = np.random.default_rng(0).uniform(-1, 1, (200, 6))
    assert tried_poses(paper_arm, q, q).tried.all()
    said = tried_sentence({"poses": 400, "tried": 30, "spacing_rad": 0.2})
    assert "7.5 % of the joint space is covered" in said
    assert "(11 deg RMS over the joints)" in said

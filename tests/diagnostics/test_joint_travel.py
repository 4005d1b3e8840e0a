"""Joints that stand still are found, with what is lost by it; distances of poses from those of a calibration."""

import warnings

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics.joint_travel import (
    lost_by_standing,
    short_travels,
    standing_joints,
    standing_rows,
    tried_poses,
)
from tests.prismatic_arms import SCARA
from tests.refusals import assert_refused

DEG = np.pi / 180


def test_still_is_less_than_a_degree(paper_arm, paper_capture):
    q = np.array(paper_capture.q)
    assert not standing_joints(paper_arm, q)
    q[:, 4] = 0.3 + np.linspace(0, 0.9 * DEG, len(q)) + 2 * np.pi * (np.arange(len(q)) % 2)  # revolutions do not count
    q[:, 1] = np.linspace(0, 1.1 * DEG, len(q))
    (found,) = standing_joints(paper_arm, q)
    assert (found.joint, found.poses) == (5, len(q))
    assert found.range == pytest.approx(0.9 * DEG)


def test_a_joint_that_turns_by_less_than_20_degrees_is_named(paper_arm):
    """A joint that stands still is not, since `standing_rows` names it; nor is one that goes on beyond a revolution."""
    q = np.tile(np.linspace(0, 1, 5)[:, None], (1, 6))
    q[:, 0] = np.linspace(0.1, 0.1 + 11 * DEG, 5) + 2 * np.pi * np.array([0, 1, 0, 1, 0])
    q[:, 2], q[:, 3] = np.linspace(0, 0.9 * DEG, 5), np.linspace(0, 21 * DEG, 5)
    (row,) = short_travels(paper_arm, aj.Capture({"A": q}))
    assert (row["joint"], row["poses"], row["range_deg"]) == (1, 5, pytest.approx(11))
    assert row["says"].startswith("Joint 1 turns by only 11 deg over 5 poses")


def test_a_slide_may_move_by_millimetres():
    arm = aj.Arm(alpha=[0.0, 0.0], a=[0.0, 100.0], d=[0.0, 0.0], theta=[0.0, 0.0], probe=[0, 0, 0], prismatic=(1,))
    q = np.stack([np.linspace(0, 15, 10), np.linspace(0, 1, 10)], axis=1)
    assert [one.joint for one in standing_joints(arm, q)] == [1]


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("joint", [2, 4, 5])
def test_a_link_between_joints_that_do_not_move_has_four_parameters_too_many(paper_arm, paper_capture, joint):
    """Two links become one, so that of their eight parameters only four can be told apart."""
    (lost,) = lost_by_standing(paper_arm, paper_capture, [joint])
    assert set(lost) == {f"{kind}_{joint}" for kind in ("alpha", "a", "d", "theta")}


def test_two_joints_lose_twice_as_much(paper_arm, paper_capture):
    lost = lost_by_standing(paper_arm, paper_capture, [3, 5])
    assert [len(names) for names in lost] == [4, 4]
    assert not set(lost[0]) & set(lost[1])


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.1, 0.9])
@pytest.mark.parametrize("held", [None, ("theta_1", "d_1", "alpha_6", "a_6", "probe_x", "probe_y")])
def test_the_list_for_held_is_complete(held, width):
    """Joint 5 of a UR5e stands still: with the list a calibration converges, and nothing is left open."""
    nominal = aj.load_arm("ur5e").replace(probe=np.array([0.0, 0.0, 100.0]))
    random = np.random.default_rng(3)
    q = random.uniform(-2.5, 2.5, (60, 6))
    q[:, 4] = 0.7 + np.radians(width) * random.uniform(size=60)
    true = aj.perturbed_arm(aj.Parameters.free_of(nominal), length=1.0, angle=2e-3, seed=1)
    seen = np.asarray(true.position(q)) + random.normal(0, 0.02, (60, 3))
    capture = aj.Capture({}, observations=[aj.data.observations.MeasuredPoints("t", q, seen, u=0.02)])
    specification = aj.kinematics.ArmSpecification(nominal, held=held, free=("beta_2", "beta_3"))
    (row,) = standing_rows(nominal, capture, specification)
    fixed = row["says"].split("--held ")[1].removesuffix(".").split(",")
    proposed = aj.Parameters.free_of(nominal, held=held, free=("beta_2", "beta_3"))
    assert set(proposed.held) - {f"beta_{i}" for i in range(1, 7)} < set(fixed)
    space = aj.Parameters.free_of(nominal, held=fixed, free=("beta_2", "beta_3"))
    found = aj.observability(space.base, capture, space, sigma=0.05)
    assert (found.null.shape[1], found.trade_offs) == (0, ())
    with warnings.catch_warnings():
        warnings.simplefilter("error", aj.IdentifiabilityWarning)
        result = aj.calibrate(space.base, capture, aj.Bounds.around(space.base, space))
    assert result.converged
    assert not np.any(result.active)


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

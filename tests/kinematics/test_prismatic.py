"""Prismatic joints: positions worked by hand, what the data determine, and poses that are made."""

import math

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.kinematics import chain, jacobian
from aacmm_jax.kinematics.inverse_kinematics import project_to_targets
from aacmm_jax.kinematics.workspace import arm_reach, skeleton, total_link_length

from ..prismatic_arms import ARMS, GANTRY, LINEAR_AXIS, QUARTER, SCARA
from .test_chain import random_arm, random_readings

BY_HAND = {
    # Stretched along x; the quill points down, so that its slide and the probe count from the height of the base.
    "scara stretched": (SCARA, (0.0, 0.0, 100.0, 0.0), (350 + 300 + 20, 0.0, 400 - 100 - 60)),
    "scara folded": (SCARA, (QUARTER, -QUARTER, 250.0, 0.0), (300 + 20, 350.0, 400 - 250 - 60)),
    # Seen from above a rotation about the quill, which points down, is clockwise.
    "scara turned": (SCARA, (0.0, 0.0, 100.0, QUARTER), (350 + 300, -20.0, 400 - 100 - 60)),
    # Slides along z, y and x of the base; the wrist goes on along the last one, with x of its frame upwards.
    "gantry": (GANTRY, (700.0, 200.0, 400.0, 0.0, 0.0, 0.0), (400 + 150 + 150, 200.0, 700 + 30)),
    # The linear axis is z of the base: one slide moves the tip along it by as much.
    "linear axis": (LINEAR_AXIS, (800.0, *[0.0] * 6), None),
}


@pytest.mark.parametrize(("arm", "q", "expected"), BY_HAND.values(), ids=BY_HAND)
def test_positions_by_hand(arm, q, expected):
    if expected is None:
        expected = arm.position((0.0, *q[1:])) + np.array([0.0, 0.0, q[0]])
    np.testing.assert_allclose(arm.position(q), expected, atol=1e-12)


def test_rotations_by_readings_and_parameters():
    """A reading of a prismatic joint turns nothing; its theta does."""
    arm = random_arm(4, 5, prismatic=(2,))
    q = random_readings(arm, 1, 3)
    arm = to_numpy(arm)
    forward = chain.forward_pass(arm.geometry, chain.joint_motion(arm.geometry, q))
    rotations = jacobian.rotation_columns(forward, (("q", 1), ("theta", 1), ("q", 2)))
    assert not np.any(rotations[0])
    assert np.all(np.any(np.asarray(rotations[1:]), axis=1))
    np.testing.assert_array_equal(jacobian.reading_rotations(forward)[1:3], np.asarray(rotations)[[0, 2]])


def test_numbers_of_joints_are_checked():
    for wrong in ((0,), (5,)):
        with pytest.raises(aj.InputError, match="prismatic"):
            SCARA.replace(prismatic=wrong)
    assert SCARA.replace(prismatic=(4, 1, 4)).prismatic == (1, 4)
    with pytest.raises(aj.InputError, match=r"limits of joint 3 are 5 to 1 mm"):
        SCARA.replace(limits=[(-1, 1), (-1, 1), (5, 1), (-1, 1)])
    with pytest.raises(aj.InputError, match="joint 3 is prismatic, but the arm has no joint limits"):
        aj.simulate(SCARA.replace(limits=None), {"A": (400, 100, 200)})


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("arm", "expected"),
    [
        # 4 R + 2 P + 6 (Everett and Hollerbach 1988), less 6 of the base and 3 of the probe's orientation.
        (GANTRY, 4 * 3 + 2 * 3 + 6 - 9),
        (LINEAR_AXIS, 4 * 6 + 2 + 6 - 9),
        (SCARA, 4 * 3 + 2 + 6 - 9),
        *((random_arm(6, 3, prismatic=at).replace(limits=[(-3, 3)] * 6), 4 * (6 - len(at)) + 2 * len(at) + 6 - 9)
          for at in ((3,), (6,), (2, 4))),
    ],
)  # fmt: skip
def test_as_many_parameters_are_independent_as_theory_says(arm, expected):
    limits = [(-400.0, 400.0) if i in arm.prismatic else (-3.0, 3.0) for i in range(1, arm.joints + 1)]
    arm = arm.replace(limits=limits)
    assert len(aj.Parameters.free_of(arm).names) == expected
    assert len(aj.Parameters.independent(arm).names) == expected


@pytest.mark.parametrize("name", ARMS)
def test_targets_are_reached_by_slides_too(name):
    arm, limits = ARMS[name], np.asarray(ARMS[name].limits)
    random = np.random.default_rng(0)
    there, start = random.uniform(limits[:, 0], limits[:, 1], (2, 200, arm.joints))
    q, arrived = project_to_targets(arm, start, np.asarray(arm.position(there)), limits)
    assert np.mean(arrived) > 0.6
    assert np.all((q >= limits[:, 0]) & (q <= limits[:, 1]))
    slides = np.abs(q - start)[:, np.array(arm.prismatic) - 1]
    assert np.median(slides[arrived]) > 10  # mm: in units of mm and rad slides would hardly move


def test_corrected_readings_on_a_linear_axis():
    arm = LINEAR_AXIS.replace(d_1=0.3, a_3=420.8, alpha_1=QUARTER + 0.001)
    q = np.random.default_rng(2).uniform([0, *[-1.5] * 6], [1000, *[1.5] * 6], (20, 7))
    found = aj.kinematics.corrected_readings(LINEAR_AXIS, arm, q)
    assert np.all(found.reached)
    np.testing.assert_allclose(arm.pose(found.q), LINEAR_AXIS.pose(q), atol=1e-6)
    np.testing.assert_allclose(found.q, q, atol=5)


def test_reach_skeleton_and_length():
    # Half of the travel of the quill is below its middle; the rest stretched, in a plane that the slide is normal to.
    reach = arm_reach(LINEAR_AXIS)
    assert reach.shoulder[2] == 500
    ends = np.asarray(LINEAR_AXIS.limits)
    random = np.random.default_rng(0).uniform(ends[:, 0], ends[:, 1], (5000, 7))
    distance = np.linalg.norm(np.asarray(LINEAR_AXIS.position(random)) - reach.shoulder, axis=1).max()
    assert distance <= reach.radius + 1e-9
    assert distance > 0.9 * reach.radius
    corners = skeleton(SCARA, np.array([[0.0, 0.0, 100.0, 0.0]]))[0]
    np.testing.assert_allclose(corners[5], (650, 0, 300), atol=1e-9)  # the end of the slide
    assert total_link_length(SCARA) == pytest.approx(350 + 300 + 350 + math.hypot(20, 60))
    assert total_link_length(SCARA.replace(limits=None)) == pytest.approx(350 + 300 + 1000 + math.hypot(20, 60))

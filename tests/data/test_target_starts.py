"""The start of a station's frame and of its target's place: from few poses, and from poses that show little of either.

The true arm, so that a fit that begins where it should leaves no more than the noise.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.data.observations import MeasuredPoints, MeasuredTransforms

ARMS = ("ur10e", "panda", "irb120")


def poses(kind, arm, count, random):
    limits = np.clip(np.asarray(aj.kinematics.arm.joint_limits(arm, None)), -np.pi, np.pi)
    q = random.uniform(limits[:, 0], limits[:, 1], (count, arm.joints))
    if kind == "wrist":  # the wrist's centre stands still
        q[:, :3] = q[0, :3]
    if kind == "small":
        q = q[:1] + random.uniform(-0.2, 0.2, q.shape)
    return q


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(
    ("kind", "count"), [("all", 3), ("all", 4), ("small", 4), ("wrist", 5), ("wrist", 30), ("oriented", 3)]
)
def test_a_target_anywhere(arm, kind, count):
    random, nominal = np.random.default_rng(count), aj.load_arm(arm)
    for _ in range(4):
        q = poses(kind, nominal, count, random)
        offset = random.normal(size=3) * random.choice([30.0, 1000.0])
        transforms = np.asarray(nominal.pose(q))
        seen, turn = transforms[:, :3, :3], Rotation.random(random_state=random.integers(99))
        points = turn.apply(transforms[:, :3, 3] + seen @ offset) + 1000 + 0.1 * random.normal(size=(count, 3))
        target = Rotation.random(random_state=random.integers(99)).as_matrix()
        if kind == "oriented":
            rotations = turn.as_matrix() @ seen @ target
            observation = MeasuredTransforms("tracker", q, points, rotations, u=0.1, u_angle=1e-4)
        else:
            observation = MeasuredPoints("tracker", q, points, u=0.1, target="reflector")
        evaluated = aj.evaluate(nominal, aj.Capture({}, [], [observation])).observed
        assert evaluated.rms[0] < 0.5

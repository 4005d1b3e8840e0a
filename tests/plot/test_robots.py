"""Pictures of robots: all chains, with the axes of joints that they share once."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

import aacmm_jax as aj
from tests.data.test_contacts import TORSO, TWO


@pytest.mark.slow
@pytest.mark.parametrize("robot", [TORSO, TWO], ids=["torso", "two bases"])
def test_every_chain_and_every_axis_is_drawn_once(robot, tmp_path):
    axes = aj.plot.arm_at_zero(robot)
    numbers = [int(text.get_text()) for text in axes.texts]
    assert sorted(numbers) == [i for i in range(1, robot.joints + 1) if i not in robot.fixed]
    tips = [np.array(line.get_data_3d()).T[-1] for line in axes.lines if line.get_marker() == "+"]
    at_zero = np.column_stack([np.zeros((2, robot.joints)), [0, 1]])
    np.testing.assert_allclose(tips, robot.position(at_zero), atol=1e-9)
    aj.plot.save_arm_figure(robot, tmp_path / "robot.svg")
    assert (tmp_path / "robot.svg").stat().st_size > 10_000

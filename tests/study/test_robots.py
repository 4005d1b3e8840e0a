"""Studies are for one chain."""

import pytest

import aacmm_jax as aj
from tests.planning.test_robots import TWO
from tests.study.test_joint_models import study


def test_a_study_of_a_robot_is_refused_in_one_sentence():
    nominal = aj.kinematics.ArmSpecification(TWO, "two")
    with pytest.raises(aj.InputError, match="a study is for a single chain"):
        aj.study.Study(study({}).specification, nominal)

"""What a survey says of the corrections of an arm; the rest is tested on the command line."""

import aacmm_jax as aj
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.summaries.arm_survey import _left_out


def test_terms_that_a_model_leaves_out_are_named_with_the_reason():
    arm = with_corrections(aj.load_arm("panda"), "gravity,harmonics=1")
    found = _left_out(arm, "gravity,harmonics=1")
    assert found[0].startswith("The axis of joint 1 is vertical, so gravity has no moment about it: compliance1_1, ")
    assert "What loads compliance2_2 lies on the axis of joint 2, so it has no moment: left out." in found
    assert any(text.startswith("Left out as constant, or as combinations of other functions") for text in found)
    assert _left_out(arm, None) == []

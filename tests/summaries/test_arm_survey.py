"""What a survey says of the corrections of an arm; the rest is tested on the command line."""

import aacmm_jax as aj
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.summaries.arm_survey import _left_out


def test_terms_that_a_model_leaves_out_are_named_with_the_reason(paper_arm):
    model = "gravity,harmonics=1"
    vertical, *_, others = _left_out(with_corrections(paper_arm, model), model)
    no_moment = "Gravity has no moment about joint {}, because the axis of this joint is vertical or passes "
    no_moment += "through the load; left out: "
    assert vertical.startswith(no_moment.format(1))
    assert others.endswith("constant or a combination of other functions of the same joint: cos1_2, sin1_2.")
    found = _left_out(with_corrections(aj.load_arm("panda"), model), model)
    assert f"{no_moment.format(2)}compliance2_2." in found
    assert _left_out(with_corrections(paper_arm, model), None) == []

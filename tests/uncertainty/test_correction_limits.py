"""What poses do not tell of coefficients of joint corrections, and why."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.uncertainty.observed_identifiability import why_undetermined

RANDOM = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 6))
STILL = RANDOM * np.array([1, 0, 1, 1, 1, 1])  # joint 2 stays at 0
SHORT = RANDOM * np.array([1, 0.05, 1, 1, 1, 1])  # and moves by 9 deg
ALONE = RANDOM * np.array([1, 0, 0, 0, 0, 0])  # joint 1 alone, which does not change what gravity does

CASES = {
    "vertical": ("compliance3_1", RANDOM, (), "the moment of gravity about a vertical axis"),
    "lever": ("compliance2_2", RANDOM, (), "compliance2_2: the correction function is 0 in all 40 poses"),
    "zero": ("coupled2_3", STILL, (), "coupled2_3: the correction function is 0 in all 40 poses"),
    "constant": ("cos2_2", SHORT * 0.5, ("theta_2",), "cannot be separated from the zero offset"),
    "line": ("sin1_2", SHORT, ("theta_2", "gear_2"), "the correction function is nearly a straight line"),
    "gear beside a harmonic": ("gear_2", SHORT, ("sin1_2",), "a straight line over the 8 deg that this joint moves"),
    "moment": ("compliance6_2", ALONE, ("theta_2",), "let the joint move farther, and record poses in more sockets"),
}


@pytest.mark.parametrize("case", CASES)
def test_reasons(paper_arm, case):
    name, q, others, part = CASES[case]
    arm = with_corrections(paper_arm if case != "lever" else paper_arm.replace(a_2=0.0, d_2=0.0), [name])
    sentences, unexplained = why_undetermined(arm, q, [((name,), (name, *others))])
    assert not unexplained
    (sentence,) = sentences
    assert part in sentence
    assert name in sentence


def test_without_a_reason(paper_arm):
    """Where the function does what it can; and arms without corrections have none."""
    arm = with_corrections(paper_arm, ["sin1_2", "compliance4_2"])
    groups = [(("sin1_2", "compliance4_2", "theta_2"), ("sin1_2", "theta_2", "compliance4_2"))]
    assert why_undetermined(arm, RANDOM, groups) == ((), ("sin1_2", "compliance4_2"))
    assert why_undetermined(paper_arm, RANDOM, groups) == ((), ())


def test_short_travel_of_a_capture(paper_arm):
    """Ten degrees of joint 2: its cosine is a zero offset."""
    names = ("cos1_2", "sin1_2")
    arm, centre = with_corrections(paper_arm, list(names)), float(RANDOM[0, 1])
    limits = [(-3.1, 3.1)] * 6
    points = {
        "A": tuple(paper_arm.position(RANDOM[0])),
        "B": tuple(paper_arm.position(RANDOM[0]) + np.array([50.0, 0.0, 0.0])),
    }
    limits[1] = (centre - np.radians(5), centre + np.radians(5))
    capture = aj.simulate(paper_arm, points, poses=40, lengths=[("A", "B", 0.002)], limits=limits)
    space = aj.Parameters(arm, (*aj.Parameters.independent(paper_arm).names, *names))
    (sentence,) = aj.observability(arm, capture, space).corrections
    assert sentence.startswith("cos1_2 cannot be separated from the zero offset of joint 2, because")
    assert "nearly constant over the 10 deg that this joint moves" in sentence
    # With a prior of the coefficients there is nothing to be said of them.
    assert not aj.observability(arm, capture, space, with_prior=names).corrections


@pytest.mark.slow
def test_more_sockets():
    """One socket of a Panda does not tell which link bends; more do."""
    panda = aj.load_arm("panda")
    arm = with_corrections(panda, "gravity")
    free = [name for name in aj.Parameters.independent(panda).names if not name.startswith("beta")]
    names = (*free, *(name for name in aj.kinematics.parameter_names(arm) if name.startswith("compliance")))
    capture = aj.simulate(panda, {"A": (450, 100, 300)}, poses=120)
    sentences = aj.observability(arm, capture, aj.Parameters(arm, names)).sentences()
    assert "Poses in more sockets, distributed over the whole workspace, would determine compliance3_3." in sentences
    assert any("1 mrad/m of compliance3_3" in sentence for sentence in sentences)

"""Priors by group: which parameters they hold, in what units, and what is refused."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.kinematics import default_prior, with_corrections

NAMES = ("alpha_1", "alpha_2", "a_2", "d_2", "d_3", "theta_2", "probe_z")
NOMINAL = np.array([1.0, 2.0, 20.0, 22.0, 23.0, 0.1, 30.0])


def sd_by_name(prior):
    found = prior.of(NAMES, NOMINAL)
    return {NAMES[i]: float(found.sd[i]) for i in found.index}


@pytest.mark.parametrize(
    ("sd", "expected"),
    [
        ({"lengths": 0.5}, {"a_2": 0.5, "d_2": 0.5, "d_3": 0.5, "probe_z": 0.5}),
        ({"angles": 1e-3}, {"alpha_1": 1e-3, "alpha_2": 1e-3, "theta_2": 1e-3}),
        ({"alpha": 2e-3, "probe": 1.0}, {"alpha_1": 2e-3, "alpha_2": 2e-3, "probe_z": 1.0}),
        ({"*_2": 1.0}, {"alpha_2": 1e-3, "a_2": 1.0, "d_2": 1.0, "theta_2": 1e-3}),  # 1 mm and 1 mrad
        ({"d_3": 0.1, "lengths": 0.5, "d": 0.2}, {"a_2": 0.5, "d_2": 0.2, "d_3": 0.1, "probe_z": 0.5}),
        ({"d": 0.2, "d_2": np.inf, "d_1": 3.0}, {"d_3": 0.2}),
    ],
    ids=["lengths", "angles", "kinds", "pattern", "the-closest-name", "nothing-known-and-fixed"],
)
def test_a_group_holds_what_it_names(sd, expected):
    assert sd_by_name(aj.Prior(sd)) == pytest.approx(expected)


def test_a_mean_is_nominal_unless_it_is_given():
    found = aj.Prior({"lengths": 0.5}, mean={"d": 5.0, "d_3": 7.0}).of(NAMES, NOMINAL)
    np.testing.assert_array_equal(found.mean, [1.0, 2.0, 20.0, 5.0, 7.0, 0.1, 30.0])


def test_nothing_known_of_any_parameter_is_no_prior():
    assert aj.Prior({"all": np.inf}).of(NAMES, NOMINAL) is None
    assert aj.Prior({"beta": 0.1}).of(NAMES, NOMINAL) is None


def test_learned_groups():
    assert aj.Prior(learn=True).groups == ("lengths", "angles")
    prior = aj.Prior({"lengths": 0.5, "alpha": 1e-3}, learn=["alpha", "theta_*"])
    assert dict(zip(prior.groups, prior.learned, strict=True)) == {"lengths": False, "alpha": True, "theta_*": True}
    assert aj.Prior({"lengths": 0.5}, learn=True).learned == (True,)
    found = prior.of(NAMES, NOMINAL)
    assert dict(zip(found.groups, found.expected, strict=True)) == {"lengths": False, "alpha": True, "theta_*": False}


CORRECTIONS = ("theta_2", "cos1_2", "sin2_2", "cos3_1", "compliance3_2", "gear_2", "coupled1_2")


@pytest.mark.parametrize(
    ("groups", "expected"),
    [
        (["gravity"], [["compliance3_2"]]),
        (["harmonics=2-3", "harmonics"], [["sin2_2", "cos3_1"], ["cos1_2"]]),
        (["harmonics=1+3", "gear", "angles"],
         [["cos1_2", "cos3_1"], ["gear_2"], ["theta_2", "sin2_2", "compliance3_2", "coupled1_2"]]),
        (["gear", "coupled", "harmonics", "sin2_2"], [["gear_2"], ["coupled1_2"], ["cos1_2", "cos3_1"], ["sin2_2"]]),
    ],
)  # fmt: skip
def test_kinds_of_joint_corrections_are_groups(groups, expected):
    found = aj.Prior(learn=groups).of(CORRECTIONS, np.zeros(len(CORRECTIONS)))
    assert [[CORRECTIONS[i] for i in own] for own in found.members] == expected


def test_the_default_has_the_groups_that_the_arm_has(paper_arm):
    assert default_prior(paper_arm).groups == ("lengths", "angles")
    prior = default_prior(with_corrections(paper_arm, "gravity,gear,harmonics=1-5"))
    assert prior.groups == (
        "lengths", "angles", "gear", "gravity", "harmonics=1", "harmonics=2-3", "harmonics=4-7"
    )  # fmt: skip
    found = prior.of(("a_2", "theta_2", "cos1_2", "cos3_2"), np.zeros(4))
    assert all(found.learned)
    assert all(found.expected)
    np.testing.assert_allclose(found.sd, [1.0, 1e-3, 5e-5, 5e-5])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "at least one"),
        ({"sd": {"lengths": 0.0}}, "must be positive"),
        ({"sd": {"lengths": float("nan")}}, "is nan; it must be positive"),
        ({"sd": {"lengths": [1.0, 2.0]}}, "one number"),
        ({"sd": {"lengths": 1.0}, "mean": {"d_3": np.inf}}, "finite"),
    ],
    ids=["empty", "zero", "nan", "two", "infinite-mean"],
)
def test_refused(arguments, message):
    with pytest.raises(aj.InputError, match=message):
        aj.Prior(**arguments)


def test_a_group_without_a_parameter_is_refused(paper_arm):
    aj.Prior({"beta_2": 1e-3, "probe": 1.0}).check(paper_arm)
    with pytest.raises(aj.InputError, match="did you mean 'lengths'"):
        aj.Prior({"length": 1.0}).check(paper_arm)

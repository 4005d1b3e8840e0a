"""Everything that takes an arm takes a robot, or says in one sentence why it cannot."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.summaries.arm_survey import arm_survey
from tests.data.test_contacts import TWO

SOCKETS = {"A": (250, 150, 300), "B": (250, -200, 350), "C": (200, 0, 450)}
NOISE = aj.Noise(encoder_arcsec=10.0, seating=0.005)


@pytest.fixture(scope="module")
def robot():
    """A robot, what it recorded, bounds, and its calibration."""
    capture = aj.simulate(TWO, SOCKETS, poses=14, lengths=[("A", "B", 0.005)], noise=NOISE, seed=1)
    space = aj.Parameters.independent(TWO, capture)
    bounds = aj.Bounds.around(space.base, space)
    return space.base, capture, bounds, aj.calibrate(space.base, capture, bounds, noise=NOISE)


SERVED = {
    "bootstrap": lambda arm, capture, bounds, result: aj.bootstrap(result, capture, trials=100),
    "evaluate": lambda arm, capture, bounds, result: aj.evaluate(result.arm, capture),
    "fix_scale": lambda arm, capture, bounds, result: aj.fix_scale(result.arm, capture),
    "identify_many": lambda arm, capture, bounds, result: aj.identify_many(
        arm, aj.stack_captures([capture] * 2), bounds.lower, bounds.upper, bounds.space.vector(), space=bounds.space
    ),
    "observability": lambda arm, capture, bounds, result: aj.observability(arm, capture, bounds.space),
    "uncertainty_of": lambda arm, capture, bounds, result: aj.uncertainty_of(result),
    "warnings_of": lambda arm, capture, bounds, result: aj.warnings_of(result, capture),
    "arm_workspace": lambda arm, capture, bounds, result: aj.plot.arm_workspace(arm),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "what", [pytest.param(what, marks=pytest.mark.exhaustive if what == "bootstrap" else ()) for what in SERVED]
)
def test_robots_are_served(robot, what):
    assert SERVED[what](*robot) is not None


BALL = aj.planning.KitItem(aj.data.observations.SimulatedSphere("ball", (250, 0, 300), 25.0, 10), places=2)
REFUSED = {
    "an acceptance test is for a single chain": lambda: aj.acceptance.plan_procedure(TWO, "iso"),
    "a kit is planned for one chain": lambda: aj.planning.plan_kit(TWO, [BALL], poses=20),
    "this survey is for a single chain": lambda: arm_survey(ArmSpecification(TWO), aj.files.load_noise("panda")),
    "choose one": lambda: aj.kinematics.chain_of(TWO, "middle"),
    "the number of a chain": lambda: aj.plot.arm_poses(TWO, np.zeros((1, TWO.joints))),
}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("says", REFUSED)
def test_what_is_for_one_arm_is_refused_in_one_sentence(says):
    with pytest.raises(aj.InputError, match=says) as error:
        REFUSED[says]()
    assert "\n" not in str(error.value)

"""What an evaluation says of the arm that a capture names, against the arm that was calibrated."""

import jax.numpy as jnp
import pytest

import aacmm_jax as aj
from aacmm_jax.acceptance.record import same_arm

TABLE = {kind: [0.1, 0.2] for kind in ("alpha", "a", "d", "theta")}


@pytest.mark.parametrize("kind", ["alpha", "a", "d", "theta", "beta", "probe"])
def test_arms_that_differ_in_one_parameter_differ(kind):
    """Hayati's angle counts as well; an arm that does not use it is one whose beta is zero."""
    arm = aj.Arm(**TABLE, probe=[1.0, 2.0, 3.0])
    zero = arm.replace(beta=jnp.zeros(2))
    assert same_arm(arm, zero)
    values = getattr(zero, kind)
    assert not same_arm(arm, zero.replace(**{kind: values.at[-1].add(1e-9)}))
    assert not same_arm(zero, aj.Arm(**{name: [*row, 0.0] for name, row in TABLE.items()}, probe=[1.0, 2.0, 3.0]))

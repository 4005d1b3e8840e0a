"""What an evaluation says of the arm that a capture names, against the arm that was calibrated."""

import jax.numpy as jnp
import pytest

import aacmm_jax as aj
from aacmm_jax.acceptance.record import _same

TABLE = {kind: [0.1, 0.2] for kind in ("alpha", "a", "d", "theta")}


@pytest.mark.parametrize("kind", ["alpha", "a", "d", "theta", "beta", "probe"])
def test_arms_that_differ_in_one_parameter_differ(kind):
    """Hayati's angle counts as well; an arm that does not use it is one whose beta is zero."""
    arm = aj.Arm(**TABLE, probe=[1.0, 2.0, 3.0])
    zero = arm.replace(beta=jnp.zeros(2))
    assert _same(arm, zero)
    values = getattr(zero, kind)
    assert not _same(arm, zero.replace(**{kind: values.at[-1].add(1e-9)}))
    assert not _same(zero, aj.Arm(**{name: [*row, 0.0] for name, row in TABLE.items()}, probe=[1.0, 2.0, 3.0]))

"""Arms with replaced parameters, and free parameters that do not fit an arm."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from tests.refusals import assert_refused


@pytest.fixture(scope="module")
def panda() -> aj.Arm:
    return aj.load_arm("panda")


def test_replaced_parameters(panda):
    arm = panda.replace(d_3=317.0, probe=(1.0, 2.0, 3.0), probe_z=131.0, beta_2=0.01)
    np.testing.assert_array_equal(arm.d, [333, 0, 317, 0, 384, 0, 107])
    np.testing.assert_array_equal(arm.probe, [1.0, 2.0, 131.0])
    np.testing.assert_array_equal(arm.beta, [0, 0.01, 0, 0, 0, 0, 0])
    assert arm.limits == panda.limits
    assert arm.replace(beta=None).beta is None
    assert panda.replace(limits=None).limits is None


@pytest.mark.slow
def test_replaced_parameters_under_transformations(panda):
    q = jnp.full(7, 0.3)
    slope = jax.jit(jax.jacfwd(lambda value: panda.replace(d_3=value).position(q)))(317.0)
    np.testing.assert_allclose(slope, panda.replace(d_3=317.0).jacobian(q, ["d_3"])[:, 0], atol=1e-12)
    batch = panda.replace(a_6=jnp.array([88.0, 89.0]))
    np.testing.assert_array_equal(batch.a[:, 5], [88.0, 89.0])
    np.testing.assert_allclose(batch.position(q)[1], panda.replace(a_6=89.0).position(q), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"d_8": 1.0}, ("unknown parameter 'd_8' of a 7-joint arm", "did you mean 'd_")),
        ({"d_3": np.nan}, ("d_3 contains a value that is not finite",)),
        ({"d_3": None}, ("d_3 contains a value that is not finite",)),
        ({"d": np.zeros(6)}, ("d has shape (6,); give (..., joints) with 7 joints",)),
    ],
)
def test_refused_replacements(panda, changes, parts):
    assert_refused(lambda: panda.replace(**changes), *parts)


def test_parameters_of_another_arm_are_refused(panda, paper_arm):
    """Seven joints in a space of six: the six that it has would be read in silence."""
    space = aj.Parameters.free_of(paper_arm)
    for use in (lambda: space.vector(panda), lambda: aj.Bounds.around(panda, space)):
        assert_refused(use, "the arm has 7 joints", "an arm with 6", "Parameters.free_of")
    assert_refused(lambda: space.arm(np.zeros(25)), "vector has shape (25,), but 21 parameters are free")


def test_beta_of_an_arm_without():
    """A space that names Hayati's angle writes it into an arm that has none."""
    arm = aj.Arm(alpha=[0.0, 1.0], a=[1.0, 2.0], d=[3.0, 4.0])
    found = aj.Parameters(arm, ("a_1", "beta_1")).arm([5.0, 0.1])
    np.testing.assert_array_equal(found.beta, [0.1, 0.0])
    assert float(found.a[0]) == 5.0

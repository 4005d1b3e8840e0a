"""Inverse kinematics by damped least-norm steps, in NumPy and in JAX."""

import jax
import jax.numpy as jnp
import numpy as np

import aacmm_jax as aj


def test_in_jax_all_go_on_until_the_last_has_arrived():
    """Those near a singularity come closer by it, and seeds of studies rest on which of them count as arrived."""
    arm, random = aj.load_arm("cheng2018-ra7125"), np.random.default_rng(0)
    targets = random.uniform(-600, 600, (256, 3)) + np.array([0.0, 0.0, 300.0])
    start, limits = random.uniform(-np.pi, np.pi, (256, 6)), np.array([(-np.pi, np.pi)] * 6)
    distance = {}
    for name, array in (("numpy", np.asarray), ("jax", jnp.asarray)):
        geometry = jax.tree.map(array, arm.geometry)
        given = (array(part) for part in (start, targets, limits))
        distance[name] = np.asarray(aj.kinematics.solve_to_targets(geometry, *given)[1])
    arrived = distance["jax"] <= 1e-6
    np.testing.assert_array_equal(distance["numpy"] <= 1e-6, arrived)
    assert arrived.sum() > 180
    assert np.mean(distance["jax"][arrived] <= 1e-9) > 0.99

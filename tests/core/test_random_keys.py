"""Random numbers are those of JAX's defaults, whatever its settings are."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.random_keys import random_key

SEED = -(2**40) - 7
SETTINGS = {
    "jax_default_prng_impl": "rbg",
    "jax_random_seed_offset": 7,
    "jax_enable_custom_prng": True,
    "jax_legacy_prng_key": "error",
}


def drawn(key):
    """What the package does with keys: split, folded in batches, and numbers of every type that it draws."""
    keys = jax.vmap(lambda number: jax.random.fold_in(key, number))(jnp.arange(3))
    parts = jax.vmap(lambda one: jax.random.split(one, 2))(keys)
    normal = [jax.vmap(lambda one, t=t: jax.random.normal(one, (2, 3), t))(parts[:, 0]) for t in (jnp.float64, "f4")]
    return [
        jax.random.key_data(parts),
        *normal,
        jax.random.uniform(key, (5,), jnp.float64),
        jax.random.bits(key, (), jnp.uint32),
    ]


@pytest.fixture(scope="module")
def expected():
    return jax.tree.map(np.asarray, jax.jit(lambda seed: drawn(jax.random.key(seed, impl="threefry2x32")))(SEED))


@contextlib.contextmanager
def changed(settings):
    former = {name: getattr(jax.config, name) for name in settings}
    try:
        for name, value in settings.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in former.items():
            jax.config.update(name, value)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("settings", [{}, SETTINGS], ids=["usual", "all changed"])
def test_numbers_are_those_of_the_defaults(settings, expected):
    with changed(settings):
        for one, other in zip(jax.jit(lambda seed: drawn(random_key(seed)))(SEED), expected, strict=True):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(
            jax.random.key_data(random_key(SEED)), jax.jit(lambda seed: jax.random.key_data(random_key(seed)))(SEED)
        )


def test_a_negative_seed_of_a_simulation_is_refused(paper_arm):
    with pytest.raises(aj.InputError, match=r"the seed is -1; it must be zero or positive"):
        aj.simulate(paper_arm, {"A": (400, 200, 300)}, poses=2, seed=-1)


def test_a_setting_that_changes_all_numbers_is_refused():
    with (
        changed({"jax_threefry_partitionable": False}),
        pytest.raises(aj.InputError, match="JAX_THREEFRY_PARTITIONABLE"),
    ):
        random_key(0)

"""Random numbers of a seed: those of `jax.random` with JAX's defaults, whatever settings JAX has.

JAX_DEFAULT_PRNG_IMPL and JAX_RANDOM_SEED_OFFSET would change them without a word, so the generator is named and the
seed not given to JAX; JAX_THREEFRY_PARTITIONABLE would too, and is refused.
"""

import math
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from . import _compat
from .arguments import Range, checked, whole_number
from .errors import InputError
from .jax_setup import LARGEST_INTEGER, check_x64


def random_key(seed: int | Array) -> Array:
    """The key of a seed, or `InputError`; inside jit the seed is an int64."""
    check_x64()
    halves: Any
    if isinstance(seed, jax.Array):
        halves = jnp.stack([seed >> 32, seed & np.int64(0xFFFFFFFF)])
    else:
        if not -LARGEST_INTEGER <= whole_number(seed, "the seed") <= LARGEST_INTEGER:
            raise InputError(f"the seed is {seed}; give a whole number of at most 63 bits.")
        halves = np.array([seed >> 32, seed & 0xFFFFFFFF])
    if not _compat.jax_setting("jax_threefry_partitionable", True):
        raise InputError("JAX_THREEFRY_PARTITIONABLE=0 changes every random number; unset this variable.")
    # `jax.random.key` would add JAX's offset to the seed.
    return jax.random.wrap_key_data(halves.astype(np.uint32), impl="threefry2x32")


def random_generator(seed: int) -> np.random.Generator:
    """The generator of NumPy for a seed, or `InputError`."""
    checked(seed, Annotated[int, Range(least=0)], "the seed")
    return np.random.default_rng(seed)


def random_numbers(kind: Literal["normal", "uniform"], key: Array, shape: tuple[int, ...]) -> np.ndarray:
    """Random numbers of JAX: standard normal, or uniform from 0 to 1; the same as ``jax.random`` draws in this shape.

    A number depends on the key and its place alone, so one compiled size serves all shapes up to it.
    """
    count = math.prod(shape)
    size = max(256, 2 ** math.ceil(math.log2(max(count, 1))))
    return np.asarray(getattr(jax.random, kind)(key, (size,), jnp.float64))[:count].reshape(shape)

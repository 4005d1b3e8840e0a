"""Random numbers of a seed: those of `jax.random` with JAX's defaults, whatever settings JAX has.

JAX_DEFAULT_PRNG_IMPL, JAX_THREEFRY_PARTITIONABLE and JAX_RANDOM_SEED_OFFSET would change them without a word. A key
carries its generator with it, so every number that is drawn with a key from here is Threefry's, by its place alone.
"""

import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from . import _compat
from .errors import InputError
from .x64 import LARGEST_INTEGER, check_x64


def random_key(seed: int | Array) -> Array:
    """The key of a seed, or `InputError`; inside jit the seed is an int64."""
    check_x64()
    halves: Any
    if isinstance(seed, jax.Array):
        halves = jnp.stack([seed >> 32, seed & np.int64(0xFFFFFFFF)])
    else:
        whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
        if not whole or not -LARGEST_INTEGER <= seed <= LARGEST_INTEGER:
            raise InputError(f"the seed is {seed!r}; give a whole number of at most 63 bits.")
        halves = np.array([seed >> 32, seed & 0xFFFFFFFF])
    # `jax.random.key` would add JAX's offset to the seed.
    return jax.random.wrap_key_data(halves.astype(np.uint32), impl=_GENERATOR)


def random_generator(seed: int) -> np.random.Generator:
    """The generator of NumPy for a seed, or `InputError`."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"the seed is {seed!r}; give a whole number, zero or positive.")
    return np.random.default_rng(seed)


def random_numbers(kind: Literal["normal", "uniform"], key: Array, shape: tuple[int, ...]) -> np.ndarray:
    """Random numbers of JAX: standard normal, or uniform from 0 to 1; the same as ``jax.random`` draws in this shape.

    A number depends on the key and its place alone, so one compiled size serves all shapes up to it.
    """
    count = math.prod(shape)
    size = max(256, 2 ** math.ceil(math.log2(max(count, 1))))
    return np.asarray(getattr(jax.random, kind)(key, (size,), jnp.float64))[:count].reshape(shape)


def _hashes(key: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Two words for each place in an array, which has fewer than 2**32."""
    low = jax.lax.iota(np.uint32, math.prod(shape)).reshape(shape)
    return _compat.threefry2x32(key[0], key[1], jnp.zeros_like(low), low)


def _split(key: Array, shape: tuple[int, ...]) -> Array:
    return jnp.stack(_hashes(key, shape), axis=-1)


def _fold_in(key: Array, number: Array) -> Array:
    zero = number ^ number  # a batch under vmap where the number is one, which JAX's loop of rounds needs
    return jnp.stack(_compat.threefry2x32(key[0], key[1], zero, number))


def _bits(key: Array, width: int, shape: tuple[int, ...]) -> Array:
    high, low = _hashes(key, shape)
    if width == 64:
        return high.astype(np.uint64) << np.uint64(32) | low.astype(np.uint64)
    return (high ^ low).astype(f"uint{width}")


def _seeded(_: Any) -> Array:
    raise NotImplementedError("keys come from random_key")


_GENERATOR = _compat.random_generator_of(seed=_seeded, split=_split, random_bits=_bits, fold_in=_fold_in)

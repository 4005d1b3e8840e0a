"""Numbers at the door: what people pass for arrays, made into float64 arrays or refused."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .errors import InputError

# What people pass for an array of numbers; lists are converted and checked.
Numbers = ArrayLike | Sequence[Any]

_KINDS = {"U": "text", "S": "text", "b": "true or false", "c": "complex numbers"}


def is_concrete(*arrays: object) -> bool:
    """Whether values can be looked at now; inside jit, vmap or grad they cannot, and checks of values are left out."""
    return not any(isinstance(array, jax.core.Tracer) for array in arrays)


def as_array(value: Numbers, what: str) -> Array:
    """A float64 array, or `InputError` that names ``what``."""
    try:
        array = value if isinstance(value, jax.Array) else np.asarray(value)
    except jax.errors.TracerArrayConversionError:
        array = jnp.asarray(value)  # a list with traced numbers in it
    except ValueError as error:
        raise InputError(f"{what} has rows of unequal length; give rows of one length.") from error
    if not jnp.issubdtype(array.dtype, jnp.number) or jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise InputError(f"{what} must be real numbers, but holds {_KINDS.get(array.dtype.kind, 'something else')}.")
    return jnp.asarray(array, dtype=jnp.float64)


def joined(rows: Sequence[Array | np.ndarray], axis: int = 0, new: bool = False) -> Array:
    """Arrays concatenated along an axis, or stacked along a new one; by NumPy where values are known.

    At the edges a call of NumPy costs microseconds, and one of JAX outside jit a compiled kernel: 5 to 30 ms in every process.
    """
    known = is_concrete(*rows)
    tools: Any = np if known else jnp
    whole = (tools.stack if new else tools.concatenate)(rows, axis=axis)
    return jax.device_put(whole) if known else whole


def as_floats(value: Numbers, what: str) -> Array:
    """A finite float64 array, or `InputError` that names ``what``."""
    array = as_array(value, what)
    if is_concrete(array) and not np.all(np.isfinite(np.asarray(array))):
        raise InputError(f"{what} holds a value that is not finite; give finite numbers.")
    return array


def in_chunks(work: Callable[[np.ndarray], np.ndarray], rows: np.ndarray) -> np.ndarray:
    """``work`` on whole blocks of rows; the last is filled up with its first row."""
    pieces = []
    for first in range(0, len(rows), _CHUNK):
        block = rows[first : first + _CHUNK]
        filled = np.concatenate([block, np.repeat(block[:1], _CHUNK - len(block), axis=0)])
        pieces.append(work(filled)[: len(block)])
    return np.concatenate(pieces)


_CHUNK = 256  # poses at a time: one compiled program for captures of every size

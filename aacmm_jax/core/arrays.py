"""Conversion of arguments to float64 arrays, with messages that name what is wrong."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from . import _compat
from .errors import InputError
from .jax_setup import check_x64
from .numpy_or_jax import AnyArray, namespace

# What people pass for an array of numbers; lists are converted and checked.
Numbers = ArrayLike | Sequence[Any]

_KINDS = {"U": "text", "S": "text", "b": "true or false values", "c": "complex numbers"}


def is_concrete(*arrays: object) -> bool:
    """Whether values are known now; inside jit, vmap or grad they are not, and checks of values are left out."""
    return not any(_compat.is_traced(array) for array in arrays)


def as_array(value: Any, what: str, like: Any = ()) -> AnyArray:
    """A float64 array, or `InputError` that names ``what``.

    It is NumPy's where ``value`` and ``like``, an array or a tree with at least one, are NumPy's; else JAX's.
    """
    if _is_masked(value):
        raise InputError(f"{what} contains masked values, but the mask would be ignored; remove the masked values.")
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and jax.tree.leaves(like) and namespace(like) is np:
        return np.asarray(value)
    check_x64()
    try:
        array = value if isinstance(value, jax.Array) else np.asarray(value)
    except jax.errors.TracerArrayConversionError:
        array = jnp.asarray(value)  # a list with traced numbers in it
    except ValueError as error:
        raise InputError(f"{what} has rows of unequal length; give rows of equal length.") from error
    if not jnp.issubdtype(array.dtype, jnp.number) or jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise InputError(
            f"{what} must contain real numbers, but contains {_KINDS.get(array.dtype.kind, 'something else')}."
        )
    return jnp.asarray(array, dtype=jnp.float64)


def _is_masked(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return any(_is_masked(item) for item in value if isinstance(item, list | tuple | np.ma.MaskedArray))
    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value))


def joined(rows: Sequence[Array | np.ndarray]) -> Array:
    """Arrays concatenated along their first axis; by NumPy where values are known.

    Outside jit a call of NumPy costs microseconds, and one of JAX a compiled kernel: 5 to 30 ms in every process.
    """
    check_x64()
    return jax.device_put(np.concatenate(rows)) if is_concrete(*rows) else jnp.concatenate(rows)


def as_floats(value: Numbers, what: str) -> AnyArray:
    """A finite float64 array, or `InputError` that names ``what``."""
    array = as_array(value, what)
    if is_concrete(array) and not np.all(np.isfinite(np.asarray(array))):
        raise InputError(f"{what} contains a value that is not finite; give finite numbers.")
    return array

"""Every private or unstable name of JAX, Equinox and Optimistix that the package uses, each behind a name of its own.

A new version of one of them is tried against this module; ruff forbids those names everywhere else (pyproject.toml).
"""

from os import _exit as end_process  # noqa: F401 - at once, whatever threads still do
from typing import Any

import equinox as eqx
import jax
import jax.core
import numpy as np
from jax.custom_derivatives import SymbolicZero as SymbolicZero
from jax.experimental.compilation_cache.compilation_cache import reset_cache as reset_compilation_cache  # noqa: F401
from jaxtyping import Array, Int


def is_traced(value: object) -> bool:
    """Whether a value is a tracer of jit, vmap or a derivative, so that its number is not known yet."""
    return isinstance(value, jax.core.Tracer)


def inside_trace() -> bool:
    """Whether this runs inside jit or vmap, where even what is constant becomes a tracer once JAX computes with it."""
    return is_traced(jax.device_put(0.0))  # the cheapest operation: outside jit it compiles nothing


def jax_setting(name: str, usual: Any) -> Any:
    """A setting of JAX as it is now, or ``usual`` where this version of JAX has none of this name."""
    config: Any = jax.config
    return getattr(config, name, config.values.get(name, usual))  # some have no attribute


def member_numbers(member: Any) -> Int[Array | np.ndarray, "*batch"]:
    """The number of each member in an array of members of an enumeration."""
    return member._value


def members(like: Any, numbers: Any) -> Any:
    """An array of members of the enumeration of ``like``, from their numbers. (Equinox's own constructors take one.)"""
    return eqx.tree_at(lambda item: item._value, like, numbers)


def named_members(enumeration: Any) -> list[tuple[str, Any]]:
    """Every member of an enumeration with its name."""
    return [(name, getattr(enumeration, name)) for name in enumeration._name_to_item]

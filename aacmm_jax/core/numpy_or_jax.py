"""One code for two array libraries: JAX for batches, derivatives and accelerators, NumPy for one calibration at a time.

XLA compiles a program anew for every shape, which takes seconds, and a user's capture always has a new shape. The
arithmetic of one calibration takes milliseconds in NumPy, which compiles nothing. So numerical functions are written
once, against the names that both libraries share (the Python array API standard), and compute with the library that
their arguments come from: `namespace`. What cannot be written with shared names (loops, writing to an element) is here.

At the edge, `to_numpy` decides: values that are known become NumPy's arrays, tracers of jit, vmap and derivatives stay
JAX's; and `to_jax` gives users arrays of JAX.
"""

import dataclasses
from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._compat import is_traced
from .jax_setup import check_x64

# An array of either library; NumPy's sums over all axes are scalars, `np.generic`, for which type
# checkers have no arithmetic.
if TYPE_CHECKING:
    AnyArray = Array | np.ndarray
else:
    AnyArray = Array | np.ndarray | np.generic

_NUMPY = {np.ndarray, np.float64, np.bool_, float, int, bool, str, type(None)}

Tree = TypeVar("Tree")
Function = TypeVar("Function", bound=Callable)
Class = TypeVar("Class", bound=type)


def namespace(*trees: Any) -> Any:
    """``numpy`` where every array in these trees is NumPy's, else ``jax.numpy``.

    Args:
        *trees: Arrays, or PyTrees of them.

    Example:
        >>> print(aj.kinematics.namespace(q) is np, aj.kinematics.namespace(arm) is np)
        True False
    """
    for tree in trees:
        if type(tree) in _NUMPY:  # most arguments, and ten times as fast
            continue
        if isinstance(tree, jax.Array) or any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(tree)):
            return jnp
    return np


def to_numpy(tree: Tree) -> Tree:
    """The tree with its arrays as NumPy's where all values are known; the same tree where one is a tracer."""
    check_x64()
    leaves, structure = jax.tree.flatten(tree)
    if any(is_traced(leaf) for leaf in leaves):
        return tree
    return jax.tree.unflatten(structure, [np.asarray(x) if isinstance(x, jax.Array) else x for x in leaves])


def to_jax(tree: Tree) -> Tree:
    """The tree with its arrays as JAX's, in one transfer."""
    check_x64()
    leaves, structure = jax.tree.flatten(tree)
    # A leaf that occurs twice, as those of stage 1 in a joint result, is transferred once.
    arrays = {id(leaf): leaf for leaf in leaves if isinstance(leaf, (np.ndarray, np.generic))}
    moved = dict(zip(arrays, jax.device_put(list(arrays.values())), strict=True))
    return jax.tree.unflatten(structure, [moved.get(id(leaf), leaf) for leaf in leaves])


def compiled(function: Callable | None = None, *, jit: Callable = jax.jit) -> Any:
    """Decorator: ``jit`` for arrays of JAX; called as it is, without warnings of NaN and 1 / 0, for NumPy's."""

    def decorate(function: Callable) -> Callable:
        fast = jit(function)

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if namespace(args, kwargs) is jnp:
                return fast(*args, **kwargs)
            with np.errstate(all="ignore"):
                return function(*args, **kwargs)

        return call

    return decorate if function is None else decorate(function)


def numpy_if_known(function: Function) -> Function:
    """Decorator for the edge: computes with NumPy where all values are known, and returns arrays of JAX.

    Where all arguments are NumPy's already, so is what it returns.
    """

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        given = to_numpy((args, kwargs))
        if namespace(given) is jnp:
            return function(*args, **kwargs)
        with np.errstate(all="ignore"):
            values = function(*given[0], **given[1])
        return values if namespace(args, kwargs) is np else to_jax(values)

    return call  # pyright: ignore[reportReturnType]


def scan(body: Callable, start: Any, inputs: Any = None, length: int | None = None) -> tuple[Any, Any]:
    """`jax.lax.scan` in either library: ``carry, output = body(carry, row)`` over the rows of ``inputs``."""
    if namespace(start, inputs) is jnp:
        return jax.lax.scan(body, start, inputs, length=length)
    leaves, structure = jax.tree.flatten(inputs)
    carry, outputs, form = start, [], structure
    for row in zip(*leaves, strict=True) if leaves else [()] * (length or 0):
        carry, output = body(carry, structure.unflatten(row))
        values, form = jax.tree.flatten(output)
        outputs.append(values)
    return carry, form.unflatten([np.array(values) for values in zip(*outputs, strict=True)])


def while_loop(condition: Callable, body: Callable, start: Any) -> Any:
    """`jax.lax.while_loop` in either library."""
    if namespace(start) is jnp:
        return jax.lax.while_loop(condition, body, start)
    while condition(start):
        start = body(start)
    return start


def cond(predicate: Any, true: Callable, false: Callable, *operands: Any) -> Any:
    """`jax.lax.cond` in either library."""
    if namespace(predicate, operands) is jnp:
        return jax.lax.cond(predicate, true, false, *operands)
    return (true if predicate else false)(*operands)


def set_at(array: AnyArray, index: Any, value: Any) -> Any:
    """A copy of the array with other values at an index."""
    if namespace(array, value) is jnp:
        return jnp.asarray(array).at[index].set(value)
    changed = np.array(array)
    changed[index] = value
    return changed


def added_to(array: AnyArray, index: Any, value: Any) -> Any:
    """An array that nothing else holds, with values added at an index, which names no element twice.

    NumPy's is changed itself, which saves the copy.
    """
    if namespace(array, value) is jnp:
        return jnp.asarray(array).at[index].add(value)
    array[index] += value
    return array


def stop_gradient(tree: Tree) -> Tree:
    """The tree as a constant of differentiation."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.Array) else leaf, tree)


def in_chunks(work: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, size: int = 256) -> np.ndarray:
    """``work`` on blocks of rows that the processor's cache can hold; an empty array is one block."""
    starts = range(0, max(len(rows), 1), size)
    return np.concatenate([work(rows[first : first + size]) for first in starts])


def static() -> Any:
    """A field that is no leaf, but fixes a compiled program."""
    return dataclasses.field(metadata={"static": True})


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(static,))
def pytree(cls: Class) -> Class:
    """Decorator: a frozen dataclass, registered as a PyTree, for objects with thousands of leaves.

    Each access of a method of an `equinox.Module` makes a module anew, which visits all leaves: 1 ms of an object with
    200 sockets. As with Equinox, one that JAX makes of other leaves (axes, tracers, shapes) is not initialised, and so
    not checked.
    """
    made: Any = dataclasses.dataclass(frozen=True, eq=False)(cls)
    fields = dataclasses.fields(made)
    static_names = tuple(field.name for field in fields if field.metadata.get("static"))
    names = tuple(field.name for field in fields if field.name not in static_names)
    register(made, names, static_names)
    return made


def register(made: Any, names: tuple[str, ...], static_names: tuple[str, ...]) -> None:
    """Make a PyTree of a class whose objects have these fields alone: ``names`` are its leaves."""

    def flatten_with_keys(tree: Any) -> tuple[Any, Any]:
        keyed = tuple((jax.tree_util.GetAttrKey(name), getattr(tree, name)) for name in names)
        return keyed, tuple(getattr(tree, name) for name in static_names)

    def flatten(tree: Any) -> tuple[Any, Any]:
        return tuple(getattr(tree, name) for name in names), tuple(getattr(tree, name) for name in static_names)

    def unflatten(others: Any, leaves: Any) -> Any:
        tree = object.__new__(made)
        for name, value in zip((*static_names, *names), (*others, *leaves), strict=True):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)

"""Dataclasses as PyTrees of JAX, for objects with thousands of leaves.

Each access of a method of an `equinox.Module` makes a module anew, which visits all leaves: 1 ms of an object with 200
sockets. These are plain dataclasses; as with Equinox, one that JAX makes of other leaves (axes, tracers, shapes) is not
initialised, and so not checked.
"""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

Class = TypeVar("Class", bound=type)


def static() -> Any:
    """A field that is no leaf, but fixes a compiled program."""
    return dataclasses.field(metadata={"static": True})


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(static,))
def pytree(cls: Class) -> Class:
    """Decorator: a frozen dataclass, registered as a PyTree."""
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

"""The base of the package's classes: Equinox's module, with attributes at the speed of any other Python object."""

from typing import TYPE_CHECKING

import equinox as eqx


class Module(eqx.Module):
    """A dataclass that is a pytree, as `equinox.Module`; its bound methods are no pytrees.

    Equinox looks up every attribute in a Python function, to make a pytree of each method at each access, so that
    ``jax.jit(item.method)`` traces the item's arrays. Here these are constants of such a program; what traces them is
    ``jax.jit(lambda item, x: item.method(x))``. In exchange a calibration in NumPy takes three quarters of the time.
    """

    if not TYPE_CHECKING:  # a class that defines it has every attribute, for a type checker
        __getattribute__ = object.__getattribute__

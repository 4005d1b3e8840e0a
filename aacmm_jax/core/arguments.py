"""Checks of the arguments of public functions against their annotations, in one place.

A wrong argument (a number in place of a capture, 2.5 trials) would otherwise end in an exception of NumPy or JAX from
deep inside, or in a result that means nothing.
"""

import inspect
import math
from collections.abc import Callable
from functools import wraps
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args

import equinox as eqx
import jax
import numpy as np

from .arrays import is_concrete
from .errors import InputError

Function = TypeVar("Function", bound=Callable)


def checked_arguments(function: Function) -> Function:
    """Decorator: `InputError` for an argument that is not what its annotation says.

    Looked at are annotations of classes of this package, ``int``, ``float`` and ``bool``, also with None; others are
    the function's own business.
    """
    signature = inspect.signature(function)
    kinds = {name: _kinds(parameter.annotation) for name, parameter in signature.parameters.items()}

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if kinds[name]:
                _check(name, value, kinds[name])
        return function(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]


def with_options(options: type[tuple]) -> Callable[[Function], Function]:
    """Decorator: the fields of a NamedTuple are the keyword arguments that a function takes as ``**options``.

    Several functions share them that way; help, completion and `checked_arguments` see each of them.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        own = [one for one in signature.parameters.values() if one.kind is not one.VAR_KEYWORD]
        shared = [one.replace(kind=one.KEYWORD_ONLY) for one in inspect.signature(options).parameters.values()]
        setattr(function, "__signature__", signature.replace(parameters=[*own, *shared]))  # noqa: B010
        return function

    return decorate


def _kinds(annotation: Any) -> tuple[type, ...]:
    """The classes that an annotation allows; none where it allows what is not looked at."""
    kinds = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
    known = [isinstance(kind, type) and (kind in (int, float, bool, NoneType) or _is_own(kind)) for kind in kinds]
    return kinds if all(known) else ()


def _is_own(kind: type) -> bool:
    return issubclass(kind, eqx.Module) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))


def _check(name: str, value: Any, kinds: tuple[type, ...]) -> None:
    if (value is None and NoneType in kinds) or isinstance(value, tuple(kind for kind in kinds if _is_own(kind))):
        return
    if bool in kinds:
        truth_value(value, name)
    elif int in kinds:
        whole_number(value, name)
    elif float in kinds:
        real_number(value, name)
    else:
        wanted = " or ".join(f"{_article(kind.__name__)} {kind.__name__}" for kind in kinds if kind is not NoneType)
        given = type(value).__name__
        raise InputError(f"{name} is {_article(given)} {given}; give {wanted}.")


def truth_value(value: Any, what: str) -> None:
    """Raise `InputError` for what is neither true nor false, such as 1, "yes" or NaN."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{what} is {shown(value)}; give True or False.")


def whole_number(value: Any, what: str) -> None:
    """Raise `InputError` for what is no whole number, such as 2.5, "2" or True."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise InputError(f"{what} is {shown(value)}; give a whole number.")


def real_number(value: Any, what: str) -> None:
    """Raise `InputError` for what is no real number, such as "2", True or NaN; traced values pass."""
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if isinstance(value, jax.Array | np.ndarray) and not isinstance(value, np.ma.MaskedArray):
        number = value.ndim == 0 and value.dtype.kind in "iuf"
    if not number or (is_concrete(value) and math.isnan(float(value))):
        raise InputError(f"{what} is {shown(value)}; give a number.")


def items_of(values: Any, what: str) -> list[Any]:
    """The items of an iterable, or `InputError` for what is none."""
    try:
        return list(values)
    except TypeError:
        raise InputError(f"{what} is {shown(values)}; give a list.") from None


def check_finite(**trees: Any) -> None:
    """Raise `InputError` where a known array in a tree holds a value that is not finite."""
    for what, tree in trees.items():
        for leaf in jax.tree.leaves(tree):
            known = isinstance(leaf, jax.Array | np.ndarray | np.generic) and is_concrete(leaf)
            if known and not np.all(np.isfinite(np.asarray(leaf))):
                raise InputError(f"the {what} holds a value that is not finite; make it anew from finite numbers.")


def shown(value: Any) -> str:
    """A value as a message shows it: in one line, and of a long one its type only."""
    text = " ".join(repr(value).split())
    return text if len(text) < 60 else f"{_article(type(value).__name__)} {type(value).__name__}"


def _article(noun: str) -> str:
    return "an" if noun[:1].lower() in "aeiou" else "a"

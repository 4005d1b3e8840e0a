"""Types checked at run time, by jaxtyping's hook and beartype: the first calls of each function with arguments of each
combination of types, in each worker process.

A check costs about 0.1 ms, ten times as much as many of the functions that it checks, and almost all calls repeat the
types of an earlier one: checked anew in each test, they were a fifth of the suite's CPU. Arrays of NumPy, arrays of JAX
and what is traced have types of their own, so each of them is checked. Preparing a function to be checked costs 2 ms,
so it is prepared when it is first called. A function in another one would be prepared each time the outer one runs, so
it is checked in the first runs only. Small functions are called a million times, almost always with types that are
known after a few hundred; to look for new ones even then made a calibration a third slower (now by a fifth), so that
after many calls a function is left as it is.
"""

import collections
import functools
import inspect
from collections.abc import Callable
from types import CodeType, FunctionType, SimpleNamespace
from typing import Any, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

# Ints are accepted as floats as PEP 484 has it.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True, violation_type=jaxtyping.TypeCheckError))
CALLS = 2  # that are checked, of each function with arguments of these types
MOST_CALLS = 3_000  # of a function in each process, whose types are looked at
RUNS = 10  # of an outer function in which its inner ones are checked, in each process
_runs: collections.Counter[CodeType] = collections.Counter()
_jaxtyped = jaxtyping.jaxtyped


def _resolved(annotation: Any, names: dict[str, Any]) -> Any:
    """What an annotation means; anything, where it names what only pyright imports, or the class of a method."""
    if "typing.Self" in str(annotation):
        return Any
    try:
        return get_type_hints(SimpleNamespace(__annotations__={"it": annotation}), names, include_extras=True)["it"]
    except Exception:
        return Any


def _with_check(function: FunctionType, typechecker: Callable) -> Callable:
    """Arguments and result are checked by one wrapper, where jaxtyping prepares two, in twice the time.

    A generator is left to jaxtyping, which would otherwise forget the shapes of what it yields everywhere.
    """
    if inspect.isgeneratorfunction(function):
        return _jaxtyped(function, typechecker=typechecker)
    names = function.__globals__
    same = FunctionType(function.__code__, names, function.__name__, function.__defaults__, function.__closure__)
    functools.update_wrapper(same, function)
    del same.__wrapped__
    same.__kwdefaults__ = function.__kwdefaults__
    same.__annotations__ = {name: _resolved(it, names) for name, it in function.__annotations__.items()}
    return _jaxtyped(typechecker(same), typechecker=None)


def _jaxtyped_at_first(function=None, *, typechecker) -> Callable:
    if function is None:
        return functools.partial(_jaxtyped_at_first, typechecker=typechecker)
    if inspect.isfunction(function):
        if not function.__annotations__:
            return function
        if "<locals>" in function.__qualname__:
            _runs[function.__code__] += 1
            if _runs[function.__code__] > RUNS:
                return function
    if inspect.isclass(function):
        return _jaxtyped(function, typechecker=typechecker)
    with_check = functools.cache(lambda: _with_check(function, typechecker))
    counts: dict[tuple[type, ...], int] = {}
    calls = 0

    @functools.wraps(function)
    def call(*arguments, **named):
        nonlocal calls
        if calls >= MOST_CALLS:
            return function(*arguments, **named)
        calls += 1
        types = (*map(type, arguments), *map(type, named.values()))
        count = counts.get(types, 0)
        if count < CALLS:
            counts[types] = count + 1
            return with_check()(*arguments, **named)
        return function(*arguments, **named)

    return call


def install() -> None:
    """Check every module of the package, whenever it is imported; the hook is never removed."""
    jaxtyping.jaxtyped = _jaxtyped_at_first
    jaxtyping.install_import_hook("aacmm_jax", "tests.run_time_types.checked")

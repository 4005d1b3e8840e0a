"""Checks of arguments, stated once: in the annotations of a public function, of its fields, or of declared data.

Without them a wrong argument (a number in place of a capture, 2.5 trials) would end in an exception of NumPy or JAX
from deep inside, or in a result that means nothing. A function states what it takes, and `checked_arguments` does the
rest: it converts lists to arrays, compares shapes across arguments, and raises `InputError` with one sentence::

    @checked_arguments(where="sphere '{name}'")
    def sphere(
        name: Name,
        q: Float[AnyArray, "poses joints"],
        u: Annotated[Float[AnyArray, ""] | Float[AnyArray, "poses"], Range(least=0)] = 0.0,
        *,
        diameter: Annotated[float, Range(above=0, unit="mm")],
    ): ...

    sphere("S", [[0.1, 0.2]], diameter=-1)  # diameter of sphere 'S' is -1 mm; it must be positive.
    sphere("S", [[0.1, 0.2]], [1, 2], diameter=9)
    # u of sphere 'S' has shape (2,); give one number, or (poses,) with 1 pose.

| annotation | what passes, and what the function gets |
|---|---|
| ``int``, ``float``, ``bool``, ``str`` | such a value as it is; a ``float`` may be an integer or a scalar array |
| a class of this package | an instance |
| `Float` of `AnyArray` | finite real numbers as float64: NumPy's stay NumPy's. Of one library: always that one's |
| `Literal`, ``Annotated[str, OneOf(names)]`` | one of the names; the sentence has the nearest |
| ``Sequence[X]``, ``Iterable[X]``, ``tuple[X, ...]`` | a tuple, each item checked as X; a string is no list |
| ``Mapping[str, X]`` | a dictionary, each value checked as X |
| ``X or None``, ``X or Y`` | what passes one of them |
| ``Annotated[X, rule, ...]`` | X that also keeps the rules: `Range`, `OneOf`, `ONE_LINE`, `NOT_EMPTY`, `ANY_NUMBER` |
| anything else | is the function's own business |

Dimensions have names, as jaxtyping writes them; a name means the same size in all arguments of one call. Values of
tracers (inside jit, vmap or a derivative) are unknown, so that of these only the shapes are checked.

`checked` does the same for one value, such as an entry of a file, and `checked_fields` for an object's fields.
"""

import dataclasses
import inspect
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial, wraps
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import AbstractArray

from .arrays import as_array, is_concrete
from .errors import InputError, nearest
from .text import pluralise

Function = TypeVar("Function", bound=Callable)
Sizes = dict[str, int]  # of dimensions, by name
# Takes a value and its name for messages; returns the value as it is used, or raises `InputError`. Rules are such.
Check = Callable[[Any, str], Any]


class Range(NamedTuple):
    """A rule: every number is in this range, and finite."""

    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf
    below: float = math.inf
    unit: str = ""
    infinite: bool = False  # whether infinite numbers pass as well

    def __call__(self, value: Any, what: str) -> Any:
        """The value, or `InputError`."""
        if is_concrete(value):
            x = np.asarray(value, dtype=float)
            inside = (self.least <= x) & (x <= self.most) & (self.above < x) & (self.infinite | (x < self.below))
            inside &= np.isfinite(x) | (self.infinite & ~np.isnan(x))
            limits = {"at least": self.least, "above": self.above, "at most": self.most, "below": self.below}
            words = [f"{word} {limit:g}" for word, limit in limits.items() if math.isfinite(limit)]
            usual = {"at least 0": "zero or positive", "above 0": "positive"}
            wanted = " and ".join(usual.get(word, word) for word in words) or "finite"
            _check_each(x, inside, what, f"it must be {wanted}", f" {self.unit}" if self.unit else "")
        return value


class OneOf(NamedTuple):
    """A rule: one of these names."""

    names: Collection[Any]

    def __call__(self, value: Any, what: str) -> Any:
        """The value, or `InputError`."""
        # Only of what compares as a whole: NumPy's arrays compare number by number.
        if not (isinstance(value, str | int | float) and value in self.names):
            raise InputError(f"{what} is {shown(value)}{nearest(str(value), [str(name) for name in self.names])}")
        return value


def _passing(test: Callable[[Any], bool], wanted: str) -> Check:
    """The check that a value passes a test; ``wanted`` says what would."""

    def check(value: Any, what: str) -> Any:
        if not test(value):
            raise InputError(f"{what} is {shown(value)}; give {wanted}.")
        return value

    return check


def _is_number(value: Any) -> bool:
    if isinstance(value, jax.Array | np.ndarray) and not isinstance(value, np.ma.MaskedArray):
        number = value.ndim == 0 and value.dtype.kind in "iuf"
    else:
        number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return number and not (is_concrete(value) and math.isnan(float(value)))


def _is_line(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip()) and value.splitlines() == [value]


# Those with a public name also check a value by hand: ``whole_number(value, "what it is")``.
whole_number = _passing(
    lambda value: isinstance(value, int | np.integer) and not isinstance(value, bool | np.bool_), "a whole number"
)
real_number = _passing(_is_number, "a number")  # not NaN; traced values pass
_SCALARS = {
    bool: _passing(lambda value: isinstance(value, bool | np.bool_), "True or False"),
    int: whole_number,
    float: real_number,
    str: _passing(lambda value: isinstance(value, str), "text"),
}
_LISTS = (Sequence, Iterable, Collection, list, tuple)
_PACKAGE = __name__.partition(".")[0]

ONE_LINE = _passing(_is_line, "text of one line")  # a rule, and so are these
NOT_EMPTY = _passing(lambda value: 0 not in np.shape(value), "at least one")
ANY_NUMBER = _passing(lambda value: True, "any number")  # NaN and infinite ones in an array, which do not pass else

Positive = Annotated[float, Range(above=0)]
NotNegative = Annotated[float, Range(least=0)]
Count = Annotated[int, Range(least=1)]
Name = Annotated[str, ONE_LINE]


@overload
def checked_arguments(function: Function) -> Function: ...
@overload
def checked_arguments(*, where: str) -> Callable[[Function], Function]: ...
def checked_arguments(function: Any = None, *, where: str = "") -> Any:
    """Decorator: each argument as its annotation says (see above), or `InputError`.

    ``where`` says what an argument is of, with names of other arguments in braces.
    """
    if function is None:
        return lambda function: checked_arguments(function, where=where)  # pyright: ignore[reportCallIssue]
    signature = inspect.signature(function)
    annotations = {name: parameter.annotation for name, parameter in signature.parameters.items()}

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound, sizes = signature.bind(*args, **kwargs), {}
        ending = f" of {' '.join(where.format_map(bound.arguments).split())}" if where else ""
        for name, value in bound.arguments.items():
            bound.arguments[name] = checked(value, annotations[name], f"{name}{ending}", sizes)
        return function(*bound.args, **bound.kwargs)

    return call


def with_options(options: type[tuple]) -> Callable[[Function], Function]:
    """Decorator: the fields of a NamedTuple are the keyword arguments that a function takes as ``**options``.

    Several functions share them that way; help, completion and `checked_arguments` see each of them.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        parameters = [given for given in signature.parameters.values() if given.kind is not given.VAR_KEYWORD]
        shared = [field.replace(kind=field.KEYWORD_ONLY) for field in inspect.signature(options).parameters.values()]
        setattr(function, "__signature__", signature.replace(parameters=[*parameters, *shared]))  # noqa: B010
        return function

    return decorate


def checked_fields(thing: Any, where: str = "") -> Any:
    """A NamedTuple or dataclass with each field as its annotation says, or `InputError`.

    A dataclass (`equinox.Module`: in ``__check_init__``) is changed itself. ``where`` says what a field is of.
    """
    sizes: Sizes = {}
    annotations = type(thing).__annotations__
    if dataclasses.is_dataclass(thing):
        annotations = {field.name: field.type for field in dataclasses.fields(thing)}
    for name, annotation in annotations.items():
        value = checked(getattr(thing, name), annotation, f"{name} of {where}" if where else name, sizes)
        if isinstance(thing, tuple):
            thing = thing._replace(**{name: value})  # pyright: ignore[reportAttributeAccessIssue]
        else:
            object.__setattr__(thing, name, value)
    return thing


def checked(value: Any, annotation: Any, what: str, sizes: Sizes | None = None, finite: bool = True) -> Any:
    """A value as an annotation says (see above), or `InputError` that calls it ``what``.

    ``sizes`` holds the sizes of dimensions by name; those that this value determines are added. ``finite`` says whether
    arrays must be.
    """
    sizes = {} if sizes is None else sizes
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        rules = [rule for rule in arguments[1:] if callable(rule)]
        value = checked(value, arguments[0], what, sizes, finite and ANY_NUMBER not in rules)
        for rule in rules:
            value = rule(value, what)
    elif origin is Literal:
        OneOf(arguments)(value, what)
    elif origin in (Union, UnionType):
        return _checked_as_one_of(value, arguments, what, sizes, finite)
    elif origin in _LISTS and _is_checked(annotation):
        if isinstance(value, str):  # whose items are characters
            raise InputError(f"{what} is {shown(value)}; give a list.")
        return tuple(_checked_values(dict(enumerate(items_of(value, what))), arguments[0], what, sizes).values())
    elif origin in (Mapping, dict):
        if not isinstance(value, Mapping):
            raise InputError(f"{what} is {_with_article(type(value).__name__)}; give a dictionary.")
        return _checked_values(value, arguments[1], what, sizes)
    elif isinstance(annotation, type) and annotation in _SCALARS:
        _SCALARS[annotation](value, what)
    elif isinstance(annotation, type) and (issubclass(annotation, AbstractArray) or _is_of_package(annotation)):
        return _checked_as_one_of(value, (annotation,), what, sizes, finite)
    return value


def _is_of_package(kind: type) -> bool:
    return kind.__module__.partition(".")[0] == _PACKAGE


def _is_checked(annotation: Any) -> bool:
    """Whether an annotation, which is neither an array nor a class of this package, states a check."""
    origin = get_origin(annotation)
    if origin is tuple:
        return get_args(annotation)[1:] == (...,)
    return origin in (Annotated, Literal, Mapping, dict, *_LISTS) if origin else annotation in _SCALARS


def _checked_as_one_of(value: Any, annotations: Sequence[Any], what: str, sizes: Sizes, finite: bool) -> Any:
    """What passes one of several annotations; arrays of several shapes count as one, and so do several classes."""
    if value is None and NoneType in annotations:
        return None
    types = [kind for kind in annotations if isinstance(kind, type)]
    arrays = [kind for kind in types if issubclass(kind, AbstractArray)]
    classes = tuple(kind for kind in types if kind not in arrays and _is_of_package(kind))
    others = [x for x in annotations if x not in (*arrays, *classes, NoneType, np.generic)]  # part of `AnyArray`
    if not all(map(_is_checked, others)):
        return value
    checks: list[Callable[[], Any]] = [partial(checked, value, x, what, sizes, finite) for x in others]
    if arrays:
        checks.append(partial(_checked_array, value, arrays, what, sizes, finite))
    if classes:
        wanted = " or ".join(_with_article(kind.__name__) for kind in classes)
        checks.append(partial(_passing(lambda value: isinstance(value, classes), wanted), value, what))
    sentences = []
    for check in checks:
        try:
            return check()
        except InputError as error:
            sentences.append(str(error).removesuffix("."))
    others = [f", or {sentence.rpartition('; ')[2].removeprefix('give ')}" for sentence in sentences[1:]]
    raise InputError("".join([*sentences[:1], *others]) + ".")


def _checked_values(values: Mapping[Any, Any], annotation: Any, what: str, sizes: Sizes) -> dict[Any, Any]:
    """Each of several values as an annotation says."""
    try:
        return {key: checked(value, annotation, what, sizes) for key, value in values.items()}
    except InputError:  # once more, to say which: names take longer to make than most checks
        return {key: checked(value, annotation, _item(what, key), sizes) for key, value in values.items()}


def _checked_array(value: Any, arrays: Sequence[Any], what: str, sizes: Sizes, finite: bool) -> Any:
    """Real numbers in one of the shapes that jaxtyping writes as names, sizes, ``*name`` and ``...``."""
    libraries = {np if array.array_type is np.ndarray else jnp for array in arrays}
    array = as_array(value, what, like=() if libraries == {jnp} else np.zeros(0))
    shapes = [shape.split() for shape in dict.fromkeys(array.dim_str for array in arrays)]
    for names in shapes:
        named = _sizes_by_name(names, array.shape, sizes)
        if named is not None:
            sizes.update(named)
            break
    else:
        wanted = ", or ".join(_shape_in_words(names, sizes) for names in shapes)
        raise InputError(f"{what} has shape {array.shape}; give {wanted}.")
    if not is_concrete(array):
        return array
    numbers = np.asarray(array)
    if finite:
        _check_each(numbers, np.isfinite(numbers), what, "give finite numbers", dimensions=names)
    return numbers if libraries == {np} else array


def _item(what: str, *index: Any) -> str:
    name, _, rest = what.partition(" of ")
    return f"{name}[{', '.join(map(repr, index))}]{' of ' * bool(rest)}{rest}"


def _sizes_by_name(names: Sequence[str], shape: tuple[int, ...], sizes: Sizes) -> Sizes | None:
    """The sizes of the dimensions that an annotation names; None where this shape does not fit it."""
    several = next((i for i, name in enumerate(names) if name[0] in "*."), None)
    if several is not None:  # any number of dimensions, which are not compared
        names = [*names[:several], *["_"] * (len(shape) - len(names) + 1), *names[several + 1 :]]
    if len(names) != len(shape):
        return None
    named: Sizes = {}
    for name, size in zip(names, shape, strict=True):
        if name != "_" and size != (int(name) if name.isdigit() else (sizes | named).get(name, size)):
            return None
        if name.isidentifier() and name != "_":
            named[name] = size
    return named


def _shape_in_words(names: Sequence[str], sizes: Sizes) -> str:
    if not names:
        return "one number"
    counts = [pluralise(sizes[name], name.removesuffix("s")) for name in names if name in sizes]
    return f"({', '.join(names)}{',' if len(names) == 1 else ''}){' with ' * bool(counts)}{', '.join(counts)}"


def _check_each(
    numbers: Any, right: Any, what: str, asked: str, unit: str = "", dimensions: Sequence[str] = ()
) -> None:
    """Raise `InputError` that shows the first number that is not right, and says which it is."""
    if np.all(right):
        return
    index = tuple(int(i) for i in np.argwhere(~right)[0]) if np.ndim(numbers) else ()
    if index and len(dimensions) == len(index) and all(name.endswith("s") for name in dimensions):
        places = " ".join(f"{name[:-1]} {i + 1}" for name, i in zip(dimensions, index, strict=True))
        what = f"{what} {places}"  # such as "pose 2 joint 3"
    elif index:
        what = _item(what, *index)
    raise InputError(f"{what} is {numbers[index]:g}{unit}; {asked}.")


def items_of(values: Any, what: str) -> list[Any]:
    """The items of an iterable, or `InputError`."""
    try:
        return list(values)
    except TypeError:
        raise InputError(f"{what} is {shown(values)}; give a list.") from None


def check_finite(**trees: Any) -> None:
    """Raise `InputError` where an array in a tree holds a value that is not finite; traced ones pass."""
    for what, tree in trees.items():
        arrays = [leaf for leaf in jax.tree.leaves(tree) if isinstance(leaf, jax.Array | np.ndarray | np.generic)]
        if not all(np.all(np.isfinite(np.asarray(array))) for array in arrays if is_concrete(array)):
            raise InputError(f"the {what} contains a value that is not finite; give finite numbers only.")


def shown(value: Any) -> str:
    """A value as a message shows it: in one line, and of a long one its type only."""
    text = " ".join(repr(value).split())
    return text if len(text) < 60 else _with_article(type(value).__name__)


def _with_article(noun: str) -> str:
    return f"{'an' if noun[:1].lower() in 'aeiou' else 'a'} {noun}"

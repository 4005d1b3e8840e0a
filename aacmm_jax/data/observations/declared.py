"""Classes whose constructor, checks and fields follow from what they declare: observations, and what simulates them.

``diameter: Float[AnyArray, ""] | None = declared("certified diameter", "mm", default=None, uncertainty="u")`` in a
class says all that there is to say of a datum: its name, type, meaning, unit, shape and default. The constructor takes
it, files and manifests hold it, reports print it, and nothing else names it.
"""

import abc
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import FrozenInstanceError
from typing import Any, ClassVar, Literal, NamedTuple, get_args, get_origin

import numpy as np
from jaxtyping import Float

from ...core.arguments import Range, Sizes, checked, shown
from ...core.arrays import Numbers, as_array, as_floats, is_concrete
from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray, namespace, numpy_if_known

FREE = 1e12  # standard uncertainty of a value that is only a start: it counts as no equation
MOST_POSES = 100_000  # to simulate, as in a study
REQUIRED = inspect.Parameter.empty
NAME = object()  # as a default: the name of the observation
Content = Literal["number", "count", "text", "truth", "points", "ids"]
Identifiers = tuple[tuple[int, ...], ...]  # whole numbers of each pose, as many for each
_CONTENTS: dict[Any, Content] = {Identifiers: "ids", str: "text", bool: "truth", int: "count", dict: "points"}
_ARGUMENTS = {"number": "Numbers", "count": "int", "text": "str", "truth": "bool", "points": "dict", "ids": "Numbers"}


class Entry(NamedTuple):
    """One of the data of a class, as its constructor takes it, files hold it and a manifest states it."""

    says: str
    unit: str = ""  # none for text and truth values
    dimensions: tuple[str, ...] = ()  # of an array in files: the first is "pose" where there is a row for each pose
    default: Any = REQUIRED
    uncertainty: str = ""  # of a certified value: name of the entry with its standard uncertainty
    positive: bool = False  # a single number may not be 0
    spread: int | None = None  # of an array: with so many of its last dimensions it is the same for all poses
    most: float | None = None  # of numbers: larger ones, infinite ones too, count as this
    of_session: bool = False  # a name that means something else in another session
    moves: Literal["", "point", "vector", "frame"] = ""  # with what is simulated, where that is placed elsewhere
    more: str = ""  # of its description, for whoever calls the constructor
    name: str = ""
    annotation: Any = None

    @property
    def content(self) -> Content:
        """By its type: number, count, text, truth, points (a dictionary of points by name) or ids (whole numbers)."""
        alternatives = [get_origin(self.annotation), self.annotation, *get_args(self.annotation)]
        alternatives += [part for inner in alternatives for part in get_args(inner)]
        contents: list[Content] = [_CONTENTS[kind] for kind in alternatives if kind in _CONTENTS]
        return contents[0] if contents else "number"

    @property
    def described(self) -> str:
        """Its line in the docstring of the class."""
        names = self._sizes
        shape = f" ``({', '.join(names)}{',' * (len(names) == 1)})``" if names else ""
        unit = f", {self.unit}" if self.unit not in ("", "1") else ""
        return f"{self.name}: {self.says[:1].upper()}{self.says[1:]}{shape}{unit}{self.more and '; '}{self.more}."

    @property
    def _sizes(self) -> list[str]:
        """Of its dimensions, as the annotation has them: letters, or numbers where they are fixed."""
        alternatives = (self.annotation, *get_args(self.annotation))
        return next((kind.dim_str for kind in alternatives if getattr(kind, "dim_str", "")), "").split()

    @property
    def row_shape(self) -> tuple[int, ...]:
        """Of an array with a row for each pose, the shape of a row: along each dimension 3, unless annotated."""
        return tuple(map(int, self._sizes[1:])) if self._sizes else (3,) * (len(self.dimensions) - 1)

    def shape(self, sizes: Sizes) -> tuple[int, ...]:
        """Of an array with a row for each pose, its shape, by the ``sizes`` of dimensions; else that of the
        annotation."""
        if not self.of_poses or not any(size.isidentifier() for size in self._sizes[1:]):
            return (sizes["m"], *self.row_shape) if self.of_poses else tuple(sizes[size] for size in self._sizes)
        return tuple(sizes[size] if size in sizes else int(size) for size in self._sizes)

    @property
    def required(self) -> bool:
        """Whether it has no default."""
        return self.default is REQUIRED

    @property
    def of_poses(self) -> bool:
        """Whether it has a row for each pose."""
        return self.dimensions[:1] == ("pose",)


def declared(says: str, unit: str = "", *dimensions: str, **options: Any) -> Any:
    """Declares a datum, whose annotation says what it is; a number is zero or positive, and ``options`` are those of
    `Entry`."""
    return Entry(says, unit, dimensions, **options)


class Part:
    """Declares a part of the unknown geometry, of numbers with these units; its name, made of the fields in braces, is
    the value of the attribute.

    The units are repeated for each row of the field ``repeated``; the part exists only where the field ``when`` is
    true.
    """

    def __init__(self, label: str, *units: str, when: str = "", repeated: str = ""):
        self.label, self.units, self.when, self.repeated = label, units, when, repeated

    def __get__(self, thing: Any, owner: Any = None) -> Any:
        return self if thing is None else self.label.format_map(vars(thing))

    def units_of(self, thing: Any) -> tuple[str, ...]:
        """The unit, mm or rad, of each of its numbers."""
        return self.units * getattr(thing, self.repeated).shape[0] if self.repeated else self.units


class Declared(abc.ABC):
    """A frozen object with a name and with what its class declares.

    The constructor takes what has no default first. A class may have a constructor of its own, which calls this one,
    and whose ``**options`` are then its entries with a default.
    """

    entries: ClassVar[tuple[Entry, ...]] = ()
    parts: ClassVar[dict[str, Part]] = {}
    noun: ClassVar[str] = "observation"  # in messages
    keyword_only: ClassVar[bool] = True  # what has a default
    name: str

    __signature__: ClassVar[inspect.Signature]  # of the constructor, for help and completion
    _parameters: ClassVar[inspect.Signature]  # of the entries

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        types, entries = inspect.get_annotations(cls), {}
        for base in reversed(cls.__mro__[1:]):
            entries |= {entry.name: entry for entry in getattr(base, "entries", ())}
        for name, value in list(vars(cls).items()):
            if isinstance(value, Entry):
                entries[name] = value._replace(name=name, annotation=types[name])
                delattr(cls, name)
        # What all kinds may have comes last.
        cls.entries = tuple(sorted(entries.values(), key=lambda entry: entry.name in ("target", "place")))
        cls.parts = cls.parts | {name: value for name, value in vars(cls).items() if isinstance(value, Part)}
        cls._parameters = _signature(cls.entries, cls.keyword_only)
        parameters = list(cls._parameters.parameters.values())
        if "__init__" in vars(cls):
            _, *stated = inspect.signature(vars(cls)["__init__"]).parameters.values()
            others = [parameter for parameter in parameters if parameter.default is not REQUIRED]
            parameters = [*(parameter for parameter in stated if parameter.kind is not parameter.VAR_KEYWORD), *others]
        cls.__signature__ = inspect.Signature(parameters)
        if cls.__doc__:
            cls.__doc__ = _documented(cls.__doc__, cls.entries)

    def __init__(self, name: str, *values: Any, **options: Any):
        given = self._parameters.bind(name, *values, **options)
        given.apply_defaults()
        article = "an" if self.noun[:1] in "aeiou" else "a"
        where = f"{self.noun} '{checked_name(name, f'{article} {self.noun}')}'"
        vars(self)["name"] = name
        sizes: Sizes = {}
        for entry in self.entries:
            value = given.arguments[entry.name]
            if value is None and entry.default is NAME:
                value = name
            absent = value is None and entry.default is None
            vars(self)[entry.name] = None if absent else _checked(entry, value, where, sizes)
        vars(self).update(self.completed(where))

    def __setattr__(self, name: str, value: Any) -> None:
        raise FrozenInstanceError(f"cannot assign to field '{name}'")

    def changed(self, **fields: Any) -> Any:
        """The same object with other values of some fields, which are not checked."""
        other = object.__new__(type(self))
        vars(other).update(vars(self) | fields)
        return other

    def completed(self, where: str) -> Mapping[str, Any]:
        """Other fields, made of the checked entries; raises `InputError` for data that do not fit together."""
        return {}

    def stored(self) -> dict[str, Any]:
        """The values of the entries, without those that have none; text of each pose as an array."""
        values = {entry.name: getattr(self, entry.name) for entry in self.entries}
        stated = {name: value for name, value in values.items() if value is not None}
        return {name: np.array(value) if isinstance(value, tuple) else value for name, value in stated.items()}


def _documented(doc: str, entries: Sequence[Entry]) -> str:
    """A docstring with the arguments, before the errors and examples; of a constructor of its own the class states
    those without a default itself."""
    stated = "\n    Args:" in doc
    lines = [entry.described for entry in entries if not (stated and entry.required)]
    lines = lines if stated else ["Args:", "    name: Name of the observation.", *(f"    {line}" for line in lines)]
    indent = "\n        " if stated else "\n    "
    divided = [doc.partition(f"\n\n    {word}:") for word in ("Raises", "Example")]
    before, heading, rest = min(divided, key=lambda parts: len(parts[0]))
    return before.rstrip() + ("" if stated else "\n") + "".join(indent + line for line in lines) + heading + rest


def _signature(entries: Sequence[Entry], keyword_only: bool) -> inspect.Signature:
    kind = inspect.Parameter
    parameters = [kind("name", kind.POSITIONAL_OR_KEYWORD, annotation="str")]
    for entry in sorted(entries, key=lambda entry: not entry.required):
        default = None if entry.default is NAME else entry.default
        annotation = _ARGUMENTS[entry.content] + (" | None" if default is None else "")
        place = kind.KEYWORD_ONLY if keyword_only and not entry.required else kind.POSITIONAL_OR_KEYWORD
        parameters.append(kind(entry.name, place, default=default, annotation=annotation))
    return inspect.Signature(parameters)


def _checked(entry: Entry, value: Any, where: str, sizes: Sizes) -> Any:
    """A value as the annotation of its entry says, or `InputError`; ``sizes`` are those of dimensions so far."""
    what, content = f"{entry.name} of {where}", entry.content
    if content == "text" and not entry.dimensions:
        return value if value == "" and entry.default == "" else checked_name(value, what)
    if entry.name == "q":
        value = checked_readings(where, value)
    if entry.most is not None:
        value = numpy_if_known(lambda values: namespace(values).minimum(values, entry.most))(as_array(value, what))
    if entry.spread is not None:
        value = _spread(as_floats(value, what), entry.shape(sizes), entry.spread, what)
    if content == "ids":
        return checked_ids(value, what, sizes)
    value = checked(value, entry.annotation, what, sizes)
    if entry.of_poses and len(value) != sizes["m"]:
        raise InputError(f"{what} has {len(value)} values; give one for each of the {sizes['m']} poses.")
    if content == "points":
        return {name: tuple(map(float, point)) for name, point in value.items()}
    if content == "count":
        Range(least=1, most=MOST_POSES)(value, what)
    elif content == "number" and value is not None and not np.ndim(value) and not entry.dimensions:
        (Range(above=0) if entry.positive else Range(least=0))(value, what)
    return value


def _spread(array: AnyArray, shape: tuple[int, ...], fewest: int, what: str) -> AnyArray:
    """Values of all poses from those of one, or from all: standard uncertainties, or covariances."""
    shapes = [shape[i:] for i in range(len(shape) - fewest, -1, -1)]
    if array.shape not in shapes:
        given = " or ".join(str(alternative) if alternative else "one number" for alternative in shapes)
        raise InputError(f"{what} has shape {array.shape}; give {given}.")
    if not fewest and is_concrete(array) and np.any(np.asarray(array) < 0):
        raise InputError(f"{what} is negative, but a standard uncertainty must be 0 or positive.")
    return numpy_if_known(lambda values: namespace(values).broadcast_to(values, shape))(array)


def checked_name(name: object, what: str) -> str:
    """A name of one line, or `InputError`."""
    if not isinstance(name, str) or not name.strip() or name.splitlines() != [name]:
        raise InputError(f"{what} has the name {shown(name)}; give a text of one line as the name.")
    return name


def checked_readings(where: str, readings: Numbers) -> AnyArray:
    """Joint readings ``(m, n)``, rad, or mm of prismatic joints, or `InputError` that says what is wrong with them."""
    array = as_array(readings, where, like=np.zeros(0))
    if array.ndim != 2 or 0 in array.shape:
        raise InputError(f"{where} has shape {array.shape}; expected (poses, joints), with at least one of each.")
    if is_concrete(array) and len(bad := np.argwhere(~np.isfinite(np.asarray(array)))):
        row, column = bad[0] + 1
        raise InputError(
            f"{where} pose {row} joint {column} is {array[row - 1, column - 1]}; every reading must be finite."
        )
    return array


def checked_ids(value: Any, what: str, sizes: Sizes) -> Identifiers:
    """Whole numbers ``(m, c)``, or `InputError`."""
    array = np.asarray(checked(value, Float[np.ndarray, "m c"], what, sizes))
    if not np.array_equal(array, np.round(array)):
        raise InputError(f"{what} contains a number that is not whole; give whole numbers.")
    return tuple(map(tuple, array.astype(int).tolist()))


def is_known(u: AnyArray) -> Any:
    """Which values are known, and not only a start."""
    return np.asarray(u) < FREE if is_concrete(u) else np.ones(u.shape, dtype=bool)


def is_exact(u: AnyArray) -> bool:
    """Whether a certified value is exact, and not an unknown of its own; a traced uncertainty is not known to be 0."""
    return is_concrete(u) and float(u) == 0

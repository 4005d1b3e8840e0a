"""TOML files, and tables passed from Python, read into pydantic models; errors in one sentence."""

import math
import os
import re
import tomllib
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, field_validator

from ..core.errors import InputError, nearest
from ..core.text import is_control, quoted
from .inputs import InputFile

Model = TypeVar("Model", bound=BaseModel)
Point = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_MOST_CHARACTERS = 4_000_000  # a manifest of ten thousand sockets has less than a tenth of them
_DEEPEST = 16  # levels of tables and lists, and parts of a dotted key
_LARGEST = 1e20  # numbers whose squares are far from the limits of a float, and all seeds
_LONG_KEY = re.compile(
    rf"""(?<![\w."'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{_DEEPEST},}}"""  # possessive: linear
)


class Strict(BaseModel):
    """A table whose keys are all known: any other key is refused. Values cannot be assigned to.

    Numbers are finite numbers: neither quoted ones nor true and false are taken for them.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True, strict=True, allow_inf_nan=False)

    @classmethod
    def other_kind(cls, content: Mapping[str, Any], path: str | os.PathLike) -> str | None:
        """What a file of another kind is, and what reads it, as the rest of a sentence on the file; None where it may
        be of this kind."""
        return None

    @field_validator("*", mode="before")
    @classmethod
    def _no_booleans(cls, value: Any, info: Any) -> Any:
        """Refuse true and false where a number is wanted, in one sentence for all kinds of numbers."""
        wanted = cls.model_fields[str(info.field_name)].annotation
        if wanted is not bool and any(isinstance(x, bool) for x in (value if isinstance(value, list) else [value])):
            raise ValueError("a number is needed, but the value is true or false; give a number.")
        return value


def read_toml(path: str | os.PathLike, model: type[Model]) -> Model:
    """Read a TOML file into a pydantic model. Raises `InputError` that names the file and the place in it."""
    try:
        text = InputFile(path).text
        # What would take a parser gigabytes or minutes.
        if len(text) > _MOST_CHARACTERS:
            raise InputError(
                f"{path} has {len(text):,} characters, more than {_MOST_CHARACTERS:,}; give a shorter file."
            )
        if long_key := _LONG_KEY.search(text):
            line = text.count("\n", 0, long_key.start()) + 1
            raise InputError(f"{path} line {line} has a key of more than {_DEEPEST} parts; correct the key.")
        content = tomllib.loads(text)
    except InputError:
        raise
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not valid TOML: {error}; correct the file at this point.") from error
    except RecursionError as error:
        raise InputError(f"{path} nests tables or lists too deeply; use at most {_DEEPEST} levels.") from error
    except ValueError as error:  # digits beyond those that Python converts
        raise InputError(f"{path} contains a number with thousands of digits; correct the number.") from error
    _check_content(path, content)
    other = model.other_kind(content, path) if issubclass(model, Strict) else None
    if other is not None:
        raise InputError(f"{path} {other}")
    return validated(model, content, str(path))


def _check_content(path: str | os.PathLike, value: Any, place: str = "", depth: int = 0) -> None:
    """Refuse depth, numbers and characters that no file of this package has, with the key at which they are."""
    if depth > _DEEPEST:
        raise InputError(f"{path} nests tables or lists too deeply; use at most {_DEEPEST} levels.")
    for text in (place, value if isinstance(value, str) else ""):
        control = next(filter(is_control, text), None)
        if control is not None:
            raise InputError(
                f"{path}: {quoted(place)} contains the control character U+{ord(control):04X}; remove the character."
            )
    if isinstance(value, Mapping):
        for key, item in value.items():
            _check_content(path, item, f"{place}.{key}" if place else key, depth + 1)
    elif isinstance(value, list):
        for number, item in enumerate(value, start=1):
            _check_content(path, item, f"{place} {number}", depth + 1)
    elif isinstance(value, int | float) and _LARGEST < abs(value) < math.inf:
        raise InputError(f"{path}: '{place}' is implausibly large; correct the value.")


def validated(model: type[Model], content: Mapping[str, Any], where: str) -> Model:
    """A pydantic model of tables. Raises `InputError`, one sentence that begins with ``where``."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        # A misspelt key is also a missing one, and says more; so does an error of or inside a
        # list, compared with "not a number".
        worst = max(
            error.errors(),
            key=lambda item: (item["type"] == "extra_forbidden", len(item["loc"]), item["type"] == "too_short"),
        )
        raise InputError(f"{where}: {_explain(worst, model, content)}") from error


def each_once(items: list[Any]) -> list[Any]:
    """Validator of a list: refuses an entry that is there twice."""
    for item in items:
        if items.count(item) > 1:
            raise ValueError(f"{item!r} is given twice; give it once.")
    return items


def _written(steps: Sequence[Any], content: Any) -> list[Any]:
    """The part of the path to an error that is in the file: other steps are pydantic's ("a number or a list")."""
    kept = []
    for step in steps:
        index = isinstance(step, int)
        if isinstance(content, list | tuple) if index else isinstance(content, Mapping) and step in content:
            kept.append(step)
            content = None if index and step >= len(content) else content[step]
    return kept


def _explain(error: Any, model: Any, content: Any) -> str:
    """One pydantic error as one sentence with its place, counting rows from 1 as people do."""
    kind, given, context = error["type"], error["input"], error.get("ctx", {})
    steps = error["loc"] if kind == "missing" else _written(error["loc"], content)
    place = ""
    for step in steps:
        named = quoted(str(step))[1:-1]  # in short
        place += f" {step + 1}" if isinstance(step, int) else f".{named}" if place else named
    if kind == "extra_forbidden":
        # Field names of the model that the key belongs to.
        for step in [step for step in steps[:-1] if not isinstance(step, int)]:
            fields = getattr(model, "model_fields", {})
            model = fields[step].annotation if step in fields else None
            while model is not None and not hasattr(model, "model_fields"):
                model = next((part for part in typing.get_args(model) if part is not type(None)), None)
        names = [field.alias or name for name, field in getattr(model, "model_fields", {}).items()]
        return f"unknown key '{place}'{nearest(str(steps[-1]), names)}"
    if kind == "missing":
        return f"'{place}' is missing; add it."
    if kind == "value_error":
        return f"{place}: {context['error']}" if place else str(context["error"])
    if kind in ("too_short", "too_long"):
        limit = f"at least {context['min_length']}" if kind == "too_short" else f"at most {context['max_length']}"
        return f"'{place}' has {len(given) or 'no'} entries; give {limit}."
    shown = quoted(given) if isinstance(given, str) else repr(given)
    shown = "a table" if isinstance(given, dict) else "a list" if isinstance(given, list) else shown
    advice = f"; write [[{place}]]" if kind == "list_type" and isinstance(given, dict) else ""
    wanted = {"dict_type": "must be a table", "model_type": "must be a table", "tuple_type": "must be a list"}.get(kind)
    wanted = wanted or error["msg"].replace("Input should", "must").partition(", unable")[0]
    if context.get("class_name") == "Distribution":
        wanted = "must be a number, { uniform = ... } or { normal = ... }"
    return f"'{place}' {wanted}, not {shown}{advice}."

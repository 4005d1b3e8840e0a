"""TOML files, and tables passed from Python, read into pydantic models; errors in one sentence."""

import os
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from ..core.errors import InputError, nearest
from .inputs import InputFile

Model = TypeVar("Model", bound=BaseModel)


class Strict(BaseModel):
    """A table whose keys are all known: any other key is refused. Values cannot be assigned to."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    @field_validator("*", mode="before")
    @classmethod
    def _no_booleans(cls, value: Any, info: Any) -> Any:
        """Refuse true and false where a number is wanted; pydantic takes them for 1 and 0."""
        wanted = cls.model_fields[str(info.field_name)].annotation
        if wanted is not bool and any(isinstance(x, bool) for x in (value if isinstance(value, list) else [value])):
            raise ValueError("true and false are no numbers; give a number.")
        return value


def read_toml(path: str | os.PathLike, model: type[Model]) -> Model:
    """Read a TOML file into a pydantic model. Raises `InputError` that names the file and the place in it."""
    try:
        content = tomllib.loads(InputFile(path).text)
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8, as TOML is; name a TOML file.") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not valid TOML: {error}; correct it there.") from error
    return validated(model, content, str(path))


def validated(model: type[Model], content: Mapping[str, Any], where: str) -> Model:
    """A pydantic model of tables. Raises `InputError`, one sentence that begins with ``where``."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        # A misspelt key is also a missing one, and says more; so does an error of or inside a
        # list, compared with "not a number".
        worst = max(
            error.errors(),
            key=lambda found: (found["type"] == "extra_forbidden", len(found["loc"]), found["type"] == "too_short"),
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
        inside = isinstance(content, list | tuple) if isinstance(step, int) else isinstance(content, Mapping)
        if inside:
            kept.append(step)
            try:
                content = content[step]
            except (KeyError, IndexError):
                content = None
    return kept


def _explain(error: Any, model: Any, content: Any) -> str:
    """One pydantic error as one sentence with its place, counting rows from 1 as people do."""
    kind, given, context = error["type"], error["input"], error.get("ctx", {})
    steps = error["loc"] if kind == "missing" else _written(error["loc"], content)
    place = ""
    for step in steps:
        place += f" {step + 1}" if isinstance(step, int) else (f".{step}" if place else str(step))
    if kind == "extra_forbidden":
        return f"unknown key '{place}'{nearest(str(steps[-1]), _known_keys(model, steps[:-1]))}"
    if kind == "missing":
        return f"'{place}' is missing; add it."
    if kind == "value_error":
        return f"{place}: {context['error']}" if place else str(context["error"])
    if kind in ("too_short", "too_long"):
        limit = f"at least {context['min_length']}" if kind == "too_short" else f"at most {context['max_length']}"
        return f"'{place}' has {len(given) or 'no'} entries; give {limit}."
    shown = "a table" if isinstance(given, dict) else "a list" if isinstance(given, list) else repr(given)
    advice = f"; write [[{place}]]" if kind == "list_type" and isinstance(given, dict) else ""
    wanted = {
        "tuple_type": "must be a list of numbers",
        "dict_type": "must be a table",
        "model_type": "must be a table",
    }.get(kind)
    if context.get("class_name") == "Distribution":
        wanted = "must be a number, { uniform = ... } or { normal = ... }"
    wanted = wanted or error["msg"].replace("Input should", "must").partition(", unable")[0]
    return f"'{place}' {wanted}, not {shown}{advice}."


def _known_keys(model: Any, steps: Sequence[Any]) -> list[str]:
    """Field names of the model that an unknown key belongs to."""
    import typing

    for step in steps:
        if isinstance(step, int):
            continue
        annotation = model.model_fields[step].annotation if step in model.model_fields else None
        while annotation is not None and not hasattr(annotation, "model_fields"):
            inner = [item for item in typing.get_args(annotation) if item is not type(None)]
            annotation = inner[0] if inner else None
        if annotation is None:
            return []
        model = annotation
    return [field.alias or name for name, field in model.model_fields.items()]

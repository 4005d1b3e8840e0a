"""Kits of artefacts and instruments as TOML: a table for each thing, made of what its simulation needs.

Nothing here depends on a kind: the fields of `data.observations.Simulated...` say what may be stated, in mm and rad.
"""

import dataclasses
import math
import os
import typing
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, FiniteFloat, NonNegativeInt, PositiveInt, create_model

from .. import data
from ..core.errors import InputError
from ..data.observations.observation import AbstractSimulated
from ..planning.kit_placement import KitItem
from .toml import Strict, read_toml

_POSES = 20  # where none is stated
_Numbers = list[FiniteFloat] | list[list[FiniteFloat]]
_Point = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


def simulated_kinds() -> dict[str, type[AbstractSimulated]]:
    """Everything that can be simulated, by the name of its tables."""
    found = (getattr(data.observations, name) for name in dir(data.observations))
    return {one.table: one for one in found if isinstance(one, type) and issubclass(one, AbstractSimulated)}


def _stated(annotation: Any) -> Any:
    """The type of a field in TOML, or None for one that is not stated."""
    parts = typing.get_args(annotation)
    if type(None) in parts:
        (inner,) = (part for part in parts if part is not type(None))
        found = None if inner is np.ndarray else _stated(inner)
        return None if found is None else found | None
    if annotation is np.ndarray:
        return _Numbers
    if typing.get_origin(annotation) is dict:
        return Annotated[dict[str, _Point], Field(min_length=1)]
    if typing.get_origin(annotation) is tuple:
        return list[FiniteFloat]
    return FiniteFloat if annotation is float else annotation


def _model(kind: type[AbstractSimulated]) -> type[Strict]:
    fields: dict[str, Any] = {
        "poses": (PositiveInt, _POSES),
        "places": (NonNegativeInt, 0),
        "turned": (Literal["any", "vertical", "not"], "any"),
        "half_angle_deg": (Annotated[float, Field(gt=0, le=180)], 180.0),
        "normal": (_Point, [0.0, 0.0, 1.0]),
    }
    for field in dataclasses.fields(kind):
        stated = _stated(field.type)
        if field.name not in fields and stated is not None:
            missing = field.default is dataclasses.MISSING
            fields[field.name] = (stated, ...) if missing else (stated | None, None)
    return create_model(f"{kind.__name__}Table", __base__=Strict, **fields)


_KINDS = simulated_kinds()
_FIELDS: dict[str, Any] = {
    table: (list[_model(kind)], Field(default_factory=list))  # pyright: ignore[reportInvalidTypeForm]
    for table, kind in _KINDS.items()
}
_Kit = create_model("_Kit", __base__=Strict, **_FIELDS)


def read_kit(path: str | os.PathLike) -> list[KitItem]:
    """Read a kit: what is at hand for a calibration, with its uncertainties.

    Tables are ``[[artefact]]``, ``[[touched_sphere]]``, ``[[touched_cylinder]]``, ``[[planes]]`` (one, or two at a
    ``distance``), ``[[points]]``, ``[[transforms]]``, ``[[distances]]`` and ``[[socket]]``; their keys are the
    arguments of the simulated observation, in mm and rad, and ``places`` (how many placements a plan is to choose; 0
    leaves the thing where it is stated), ``turned`` ("any", "vertical" for turns about the vertical alone, or "not"),
    and the cone from which the tool comes to it: ``half_angle_deg`` about ``normal``, which points out of its seats, in
    an artefact's own frame and for everything else in the base frame (by default (0, 0, 1), and all directions).

    Args:
        path: The TOML file.

    Returns:
        The things, for `planning.plan_kit`; their ``simulated`` for `simulate`.

    Raises:
        InputError: Naming the file and the place in it.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("kit.toml").write_text('''[[socket]]
        ... name = "cone"
        ... point = [400, 200, 300]
        ... poses = 5
        ... places = 3
        ... ''')
        >>> print([(item.simulated.name, item.places) for item in aj.files.read_kit("kit.toml")])
        [('cone', 3)]
    """
    content = read_toml(path, _Kit)
    items: list[KitItem] = []
    for table, kind in _KINDS.items():
        for entry in getattr(content, table):
            stated = {name: value for name, value in entry if value is not None}
            places, turned = stated.pop("places"), stated.pop("turned")
            half_angle, normal = math.radians(stated.pop("half_angle_deg")), stated.pop("normal")
            if not any(normal):
                raise InputError(f"{path}: [[{table}]] '{stated['name']}' has the normal (0, 0, 0); give a direction.")
            items.append(KitItem(_checked(path, table, kind, stated), places, turned, half_angle, tuple(normal)))
    if not items:
        tables = ", ".join(f"[[{table}]]" for table in _KINDS)
        raise InputError(f"{path} names nothing; give tables {tables}.")
    return items


def _checked(
    path: str | os.PathLike, table: str, kind: type[AbstractSimulated], stated: dict[str, Any]
) -> AbstractSimulated:
    """The simulated observation, tried once: shapes that do not fit are an `InputError`."""
    where = f"{path}: [[{table}]] '{stated['name']}'"
    constructor: Any = kind
    try:
        simulated = constructor(**{name: _hashable(value) for name, value in stated.items()})
        random = np.random.default_rng(0)
        tips = simulated.tips(random)
        if tips.ndim != 2 or tips.shape[1] != 3 or not np.all(np.isfinite(tips)):
            raise ValueError
        transforms = np.tile(np.eye(4), (len(tips), 1, 1))
        transforms[:, :3, 3] = tips
        simulated.recorded(np.zeros((len(tips), 1)), transforms, random)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except (ValueError, IndexError, TypeError) as error:
        raise InputError(
            f"{where} has numbers that do not fit together; points are [x, y, z], a box two of them, and a frame six "
            f"numbers (see aj.data.observations.{kind.__name__})."
        ) from error
    return simulated


def _hashable(value: Any) -> Any:
    """Points of an artefact as the constructor keeps them."""
    if isinstance(value, dict):
        return {name: tuple(point) for name, point in value.items()}
    return value if not isinstance(value, Sequence) or isinstance(value, str) else _tuples(value)


def _tuples(value: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(_tuples(one) if isinstance(one, Sequence) else one for one in value)

"""Kits of artefacts and instruments as TOML: a table for each thing, made of what its simulation declares.

Nothing here depends on a kind: the entries of `data.observations.Simulated...` say what may be stated, in mm and rad.
"""

import math
import os
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field, FiniteFloat, NonNegativeInt, PositiveInt, create_model

from ..core.errors import InputError, naming
from ..data.observations.observation import AbstractSimulated, simulated_kinds
from ..planning.kit_placement import KitItem
from .toml import Point, Strict, read_toml

_POSES = 20  # where none is stated
_Numbers = list[FiniteFloat] | list[list[FiniteFloat]]
_CONTENT = {"count": PositiveInt, "text": str, "truth": bool, "number": FiniteFloat}
_CONTENT["points"] = Annotated[dict[str, Point], Field(min_length=1)]


def _model(kind: type[AbstractSimulated]) -> type[Strict]:
    fields: dict[str, Any] = {
        "name": (str, ...),
        "places": (NonNegativeInt, 0),
        "turned": (Literal["any", "vertical", "not"], "any"),
        "half_angle_deg": (Annotated[float, Field(gt=0, le=180)], 180.0),
        "normal": (Point, [0.0, 0.0, 1.0]),
    }
    for entry in kind.entries:
        if entry.name == "errors":  # unknown to whoever has the artefact
            continue
        array = entry.content == "number" and float not in (entry.annotation, *get_args(entry.annotation))
        stated = _Numbers if array else _CONTENT[entry.content]
        fields[entry.name] = (stated, ...) if entry.required else (stated | None, None)
    fields["poses"] = (PositiveInt, _POSES)
    return create_model(f"{kind.__name__}Table", __base__=Strict, **fields)


_KINDS = simulated_kinds()
_FIELDS: dict[str, Any] = {
    table: (list[_model(kind)], Field(default_factory=list))  # pyright: ignore[reportInvalidTypeForm]
    for table, kind in _KINDS.items()
}
_Kit = create_model("_Kit", __base__=Strict, **_FIELDS)


def read_kit(path: str | os.PathLike) -> list[KitItem]:
    """Read a kit: what is at hand for a calibration, with its uncertainties, for `planning.plan_kit`.

    Tables are ``[[artefact]]``, ``[[touched_sphere]]``, ``[[touched_cylinder]]``, ``[[planes]]`` (one, or two at a
    ``distance``), ``[[points]]``, ``[[transforms]]``, ``[[distances]]`` and ``[[socket]]``; their keys are the
    arguments of the simulated observation, in mm and rad, and ``places`` (how many placements a plan is to choose; 0
    leaves the thing where it is stated), ``turned`` ("any", "vertical" for turns about the vertical alone, or "not"),
    and the cone from which the tool comes to it: ``half_angle_deg`` about ``normal``, which points out of its seats, in
    an artefact's own frame and for everything else in the base frame (by default (0, 0, 1), and all directions).

    Args:
        path: The TOML file.

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
            with naming(f"{path}: [[{table}]] '{stated['name']}'"):
                if not any(normal):
                    raise InputError("it has the normal (0, 0, 0); give a direction.")
                # Tried once, so that what cannot be recorded is refused here.
                simulated = kind(**stated)
                tips = simulated.tips(np.random.default_rng(0))
                if not np.all(np.isfinite(tips)):
                    raise InputError("numbers that do not fit together, such as two ends in one point; correct them.")
                transforms = np.tile(np.eye(4), (len(tips), 1, 1))
                transforms[:, :3, 3] = tips
                simulated.recorded(np.zeros((len(tips), 1)), transforms, np.random.default_rng(0))
            items.append(KitItem(simulated, places, turned, half_angle, tuple(normal)))
    if not items:
        tables = ", ".join(f"[[{table}]]" for table in _KINDS)
        raise InputError(f"{path} names nothing; give tables {tables}.")
    return items

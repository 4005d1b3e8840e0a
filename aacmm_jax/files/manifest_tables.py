"""The tables of a manifest that name files: one a kind, made of what the kind declares."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import (
    AfterValidator,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    create_model,
    model_validator,
)

from ..core.errors import InputError
from ..core.text import quoted
from ..data.observations.declared import Entry
from ..data.observations.held import Socket
from ..data.observations.observation import AbstractObservation, kinds
from .text_lines import Column
from .toml import Strict, each_once

NUMBERS_OF_ROTATION = {"vector": 3, "quaternion wxyz": 4, "quaternion xyzw": 4, "matrix": 9}
_EULER = re.compile("[xyz]{3}|[XYZ]{3}")


class Preset(NamedTuple):
    """Columns, units and conventions of tables that people have; a manifest may change each of them."""

    columns: Mapping[str, Sequence[Sequence[Column]]]  # the first choice that a table has
    units: Mapping[str, str] = {}  # where neither the manifest nor the table's header states one
    rotation: str | None = None
    coverage_factor: float = 1.0


PRESETS = {
    # Positions as `aacmm plan` writes them, or with plainer names; readings are found by their names.
    "csv": Preset(
        {
            "points": [["x_mm", "y_mm", "z_mm"], ["x", "y", "z"]],
            "u": [["u_x_mm", "u_y_mm", "u_z_mm"], ["u_x", "u_y", "u_z"]],
        },
        {"q": "deg"},
    ),
    # 6-D export of a laser tracker: U(95) of the coordinates, scalar part of the quaternion first. Names as in the
    # exports of ZhangTeng-Hust/ASTL (T-Mac of 2022): "X  [mm]", "U(95) X  [mm]", "Q0 "; others write "U95 X".
    "leica": Preset(
        {
            "points": [["X", "Y", "Z"]],
            "u": [["U*95* X", "U*95* Y", "U*95* Z"]],
            "rotations": [["Q0", "Q1", "Q2", "Q3"]],
        },
        rotation="quaternion wxyz",
        coverage_factor=2.0,
    ),
    # Point lists with the direction in which a point was probed, which is not needed.
    "xyzijk": Preset({"points": [["X", "Y", "Z"], [1, 2, 3]]}),
    # christianlandgraf/ipa-robot-accuracy; R = Rx(rx) Ry(ry) Rz(rz) is the order that agrees with the robot's joints.
    "ipa": Preset(
        {
            "points": [["x_mm", "y_mm", "z_mm"]],
            "u": [["std_x_mm", "std_y_mm", "std_z_mm"]],
            "rotations": [["rx_deg", "ry_deg", "rz_deg"]],
        },
        {"q": "rad", "rotations": "deg"},
        rotation="XYZ",
    ),
}


def _rotation(text: str) -> str:
    if text not in NUMBERS_OF_ROTATION and not _EULER.fullmatch(text):
        raise ValueError(
            f"'{text}' is not a convention of rotations; give {', '.join(NUMBERS_OF_ROTATION)}, or three axes such as "
            "XYZ (moving axes, R = Rx Ry Rz) or xyz (fixed axes, R = Rz Ry Rx)."
        )
    return text


Picked = PositiveInt | str | Annotated[list[PositiveInt | str], Field(min_length=1)]


def as_list(picked: Column | list[Column]) -> list[Column]:
    """Columns as they are picked: one of them is a list, too."""
    return picked if isinstance(picked, list) else [picked]


class Table(Strict):
    """What all tables of files have in common."""

    file: str | None = None
    files: Annotated[list[str], Field(min_length=1), AfterValidator(each_once)] | dict[str, str] | None = None
    preset: Literal["csv", "leica", "xyzijk", "ipa"] | None = None
    columns: Picked | dict[str, Picked] = Field(default_factory=dict)
    units: dict[str, str] = Field(default_factory=dict)
    delimiter: Literal[",", ";", "\t", " "] | None = None
    decimal: Literal[".", ","] = "."
    skip: NonNegativeInt = 0
    group: PositiveInt | str | None = None
    temperature_C: FiniteFloat | None = None  # of the arm, where the table has no such column

    @model_validator(mode="after")
    def _one_source(self) -> Any:
        if (self.file is None) == (self.files is None):
            raise ValueError("needs either file or files.")
        return self

    @property
    def paths(self) -> list[str]:
        """Its files, for fields in braces."""
        if self.file is not None:
            return [self.file]
        return list(self.files.values() if isinstance(self.files, dict) else self.files or ())


class _Named(Table):
    name: str | None = None
    exclude: list[str] = Field(default_factory=list)
    session: str | None = None  # of all rows; columns.session, of each


class SocketTable(_Named):
    """Poses with the tip in one socket, or in several of which a column (``group``) has the names."""

    target: str | None = None
    visits: Literal["files"] | None = None

    @model_validator(mode="after")
    def _has_name(self) -> "SocketTable":
        if self.files is not None and self.name is None and self.group is None:
            raise ValueError("a socket of several files needs a name.")
        if self.visits is not None and self.target:
            raise ValueError("visits are of the arm's own probe; leave out visits of a socket with a target.")
        return self


class _Table(_Named):
    """What the tables of all other kinds have in common."""

    readings: str | None = None  # file of the readings, in the same order
    rotation: Annotated[str, AfterValidator(_rotation)] | None = None
    coverage_factor: PositiveFloat | None = None  # of the columns of u


def _model(kind: type[AbstractObservation]) -> type[_Named]:
    if kind is Socket:
        return SocketTable
    fields: dict[str, Any] = {}
    for entry in kind.entries:
        stated = _stated(entry)
        if stated is not None:
            fields[entry.name] = (bool, False) if entry.content == "truth" else (stated | None, None)
    return create_model(f"{kind.__name__}Table", __base__=_Table, **fields)


def _stated(entry: Entry) -> Any:
    """The type of an entry that is stated in the manifest itself, or None for one that is in columns only."""
    if not entry.dimensions:
        return {"number": FiniteFloat, "text": str, "truth": bool}[entry.content]
    if entry.dimensions in (("pose",), ("pose", "axis")) and entry.content == "number" and not entry.required:
        return FiniteFloat  # the same for all
    if entry.dimensions[-1:] == ("axis",) and entry.dimensions[0] != "pose":
        return dict[str, Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]]
    return None


TABLES = {kind: _model(kind) for kind in kinds().values()}
FIELDS: dict[str, Any] = {
    kind.table: (list[table], Field(default_factory=list))  # pyright: ignore[reportInvalidTypeForm]
    for kind, table in TABLES.items()
}


class Wanted(NamedTuple):
    """What the manifest states of the readings, or points, in a table."""

    columns: Sequence[Column] | None
    unit: str | None
    usual_unit: str | None  # of the preset, where neither the manifest nor the header states one
    taken: Sequence[int]  # columns, from 0, that hold something else
    temperature: float | None


def checked_unit(
    where: object, what: str, header: str | None, stated: str | None, usual: str | None, units: Iterable[str]
) -> str | None:
    """The unit that the manifest states, or the header, or the preset. Raises `InputError` where the first two differ,
    or it is none of ``units``."""
    if header is not None and stated not in (None, header):
        raise InputError(
            f"{where}: the header of the {what} says {quoted(header)[1:-1]}, but the manifest {stated}; correct one of "
            "them."
        )
    unit = stated or header or usual
    if unit is not None and unit not in units:
        raise InputError(f"{where}: the {what} are in {quoted(unit)}; give one of {', '.join(units)}.")
    return unit

"""What a manifest may hold (TOML): the arm, tables of files, one a kind, made of what it declares, and lengths."""

import datetime
import math
import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    FiniteFloat,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    create_model,
    model_validator,
)

from ..acceptance.standards import Standard
from ..core.errors import InputError
from ..core.units import ANGLE_UNITS, LENGTH_UNITS
from ..data.capture import ReferenceLength
from ..data.observations.held import Socket
from ..data.observations.observation import AbstractObservation, kinds
from ..data.recording import SphereTest
from ..kinematics.arm import Arm, by_joint
from ..kinematics.correction_kinds import REFERENCE_TEMPERATURE
from .table_columns import OF_UR
from .text_lines import Column
from .toml import Point, Strict, each_once

NUMBERS_OF_ROTATION = {"vector": 3, "quaternion wxyz": 4, "quaternion xyzw": 4, "matrix": 9}
_EULER = re.compile("[xyz]{3}|[XYZ]{3}")
_OF_TIME = BeforeValidator(lambda time: time.date() if isinstance(time, datetime.datetime) else time)
_Day = Annotated[datetime.date, Field(strict=False), _OF_TIME]
_ByJoint = PositiveFloat | Annotated[list[PositiveFloat], Field(min_length=1)]


class Preset(NamedTuple):
    """Columns, units and conventions of tables that people have; a manifest may change each of them."""

    columns: Mapping[str, Sequence[Sequence[Column]]]  # the first choice that a table has
    units: Mapping[str, str] = {}  # where neither the manifest nor the table's header states one
    rotation: str | None = None
    coverage_factor: float = 1.0
    decimal: str | None = "."  # None: a comma where the table has one, but no point, between semicolons


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
    # christianlandgraf/ipa-robot-accuracy, its own files (semicolons, decimal commas) and tables with units in their
    # names; R = Rx(rx) Ry(ry) Rz(rz) is the order that agrees with the robot's joints.
    "ipa": Preset(
        {
            "q": [[f"{joint}_joint" for joint in OF_UR]],
            "points": [["x_mm", "y_mm", "z_mm"], ["measurement_x", "measurement_y", "measurement_z"]],
            "u": [
                ["std_x_mm", "std_y_mm", "std_z_mm"],
                ["measurement_std_x", "measurement_std_y", "measurement_std_z"],
            ],
            "rotations": [["rx_deg", "ry_deg", "rz_deg"], ["measurement_rx", "measurement_ry", "measurement_rz"]],
        },
        {"q": "rad", "rotations": "deg"},
        rotation="XYZ",
        decimal=None,
    ),
}


def _rotation(text: str) -> str:
    if text not in NUMBERS_OF_ROTATION and not _EULER.fullmatch(text):
        raise ValueError(
            f"'{text}' is not a convention for rotations; give {', '.join(NUMBERS_OF_ROTATION)}, or three axes such "
            "as XYZ (moving axes, R = Rx Ry Rz) or xyz (fixed axes, R = Rz Ry Rx)."
        )
    return text


Picked = PositiveInt | str | Annotated[list[PositiveInt | str], Field(min_length=1)]


def as_list(picked: Column | list[Column]) -> list[Column]:
    """Columns as they are picked: one of them is a list, too."""
    return picked if isinstance(picked, list) else [picked]


class Angles(Strict):
    """How every column of readings is turned into rad, or mm of a prismatic joint."""

    unit: Literal["rad", "deg", "arcsec", "gon", "mrad", "counts"]
    counts_per_turn: _ByJoint | None = None
    sign: Literal[1, -1] | list[Literal[1, -1]] = 1
    offset: FiniteFloat | list[FiniteFloat] = 0.0
    columns: Picked | None = None
    torques: Picked | None = None  # columns of the joints' torques, N m
    linear_unit: Literal["mm", "m", "um", "inch", "counts"] = "mm"  # of prismatic joints
    counts_per_mm: _ByJoint | None = None

    @model_validator(mode="after")
    def _counts(self) -> "Angles":
        if (self.unit == "counts") != (self.counts_per_turn is not None):
            raise ValueError("counts_per_turn and unit = 'counts' are only possible together; give both or neither.")
        if (self.linear_unit == "counts") != (self.counts_per_mm is not None):
            raise ValueError(
                "counts_per_mm and linear_unit = 'counts' are only possible together; give both or neither."
            )
        return self

    def converted(self, readings: Float[np.ndarray, "N n"], arm: Arm) -> Float[np.ndarray, "N n"]:
        """Readings in rad, and in mm of prismatic joints."""

        def numbers(key: str) -> np.ndarray:
            array = np.asarray(getattr(self, key), dtype=float)
            if array.ndim and array.shape != (arm.joints,):
                raise InputError(
                    f"angles.{key} has {array.size} values, but the arm has {arm.joints} joints; give one value, or "
                    "one value per joint."
                )
            return array

        angular = 2 * math.pi / numbers("counts_per_turn") if self.counts_per_turn else ANGLE_UNITS[self.unit]
        linear = 1 / numbers("counts_per_mm") if self.counts_per_mm else LENGTH_UNITS[self.linear_unit]
        units = np.where(by_joint(arm, False, True), linear, angular)
        return numbers("sign") * (readings - numbers("offset")) * units


class Table(Strict):
    """What all tables of files have in common."""

    file: str | None = None
    files: Annotated[list[str], Field(min_length=1), AfterValidator(each_once)] | dict[str, str] | None = None
    preset: Literal["csv", "leica", "xyzijk", "ipa"] | None = None
    columns: Picked | dict[str, Picked] = Field(default_factory=dict)
    units: dict[str, str] = Field(default_factory=dict)
    delimiter: Literal[",", ";", "\t", " "] | None = None
    decimal: Literal[".", ","] | None = None  # None: that of the preset, else a point
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
            raise ValueError("a socket with several files needs a name; add the key 'name'.")
        if self.visits is not None and self.target:
            raise ValueError(
                "visits apply only to sockets measured with the arm's own probe, but this socket has a target; remove "
                "visits."
            )
        return self


class _Table(_Named):
    """What the tables of all other kinds have in common."""

    readings: str | None = None  # file of the readings, in the same order
    rotation: Annotated[str, AfterValidator(_rotation)] | None = None
    coverage_factor: PositiveFloat | None = None  # of the columns of u


def _model(kind: type[AbstractObservation]) -> type[_Named]:
    """The table of a kind: what is stated in the manifest itself, and not in columns only."""
    if kind is Socket:
        return SocketTable
    fields: dict[str, Any] = {}
    for entry in kind.entries:
        stated: Any = None
        if not entry.dimensions:
            stated = {"number": FiniteFloat, "text": str, "truth": bool}[entry.content]
        elif entry.dimensions in (("pose",), ("pose", "axis")) and entry.content == "number" and not entry.required:
            stated = FiniteFloat  # the same for all
        elif entry.dimensions[-1:] == ("axis",) and not entry.of_poses:
            stated = dict[str, Point]
        if stated is not None:
            fields[entry.name] = (bool, False) if entry.content == "truth" else (stated | None, None)
    return create_model(f"{kind.__name__}Table", __base__=_Table, **fields)


TABLES = {kind: _model(kind) for kind in kinds().values()}


class Length(Strict):
    """A certified length between two sockets."""

    start: str = Field(alias="from")
    end: str = Field(alias="to")
    value: float
    u: NonNegativeFloat = 0.0
    expansion: FiniteFloat = 0.0  # of the artefact, 1/K
    temperature_C: FiniteFloat = REFERENCE_TEMPERATURE  # at which it was measured
    u_expansion: NonNegativeFloat = 0.0
    u_temperature: NonNegativeFloat = 0.0  # K

    def between(self, start: str, end: str) -> ReferenceLength:
        """The length between these sockets, as long as it was when it was measured."""
        return ReferenceLength.at_temperature(
            *(start, end, self.value, self.u),
            expansion=self.expansion,
            temperature=self.temperature_C,
            u_expansion=self.u_expansion,
            u_temperature=self.u_temperature,
        )


class Sphere(Table):
    """A sphere touched for acceptance tests."""

    name: str
    test: SphereTest
    diameter: PositiveFloat
    u: NonNegativeFloat = 0.0
    stylus: NonNegativeFloat = 0.0
    form: NonNegativeFloat = 0.0
    u_form: NonNegativeFloat = 0.0


class PointsTable(Strict):
    """How points are written, and what is known of the arm that reported them."""

    unit: Literal["mm", "m", "um", "inch"] | None = None  # by default that of the header
    columns: Picked | None = None  # of x, y and z
    reach: PositiveFloat | None = None  # mm
    measuring_range: PositiveFloat | None = None  # diameter of the measuring volume as the maker states it, mm
    shoulder: Point | None = None  # mm

    @model_validator(mode="after")
    def _both(self) -> "PointsTable":
        if (self.reach is None) != (self.shoulder is None):
            raise ValueError(
                "reach and shoulder are needed together, because the zones of the test are ranges of distance from the "
                "shoulder; give both or neither (shoulder in the frame of the points)."
            )
        return self


class Recorded(Strict):
    """What manifests of poses and of points have in common."""

    date: _Day | None = None  # day of the measurement
    socket: list[SocketTable] = Field(default_factory=list)
    length: list[Length] = Field(default_factory=list)
    sphere: list[Sphere] = Field(default_factory=list)


class Sessions(Strict):
    """What differs between the sessions that tables name."""

    probe: Literal["remounted", "same"] = "remounted"


class _Poses(Recorded):
    arm: str
    as_found: str | None = None  # the arm with the parameters that its controller had on arrival
    base: str | None = None  # links of a URDF
    tip: str | None = None
    probe: Point | None = None  # mm, from the tip link
    acceptance: Standard | Annotated[list[Standard], AfterValidator(each_once)] = Field(default_factory=list)
    measuring_range: PositiveFloat | None = None  # diameter of the measuring volume as the maker states it, mm
    angles: Angles | None = None
    sessions: Sessions | None = None


_FIELDS: dict[str, Any] = {
    kind.table: (list[table], Field(default_factory=list))  # pyright: ignore[reportInvalidTypeForm]
    for kind, table in TABLES.items()
}
PosesManifest: type[_Poses] = create_model("PosesManifest", __base__=_Poses, **_FIELDS)


class PointsManifest(Recorded):
    """A manifest of points instead of poses."""

    points: PointsTable

    @model_validator(mode="after")
    def _one_tip(self) -> "PointsManifest":
        for entry in (*self.socket, *self.sphere):
            seated = isinstance(entry, SocketTable) and (entry.target or entry.session)
            if seated or entry.temperature_C is not None:
                raise ValueError(
                    "target, session and temperature_C apply only to manifests of joint readings, but "
                    f"'{entry.name or entry.paths[0]}' has points, which are positions of the tip; remove these keys."
                )
        return self

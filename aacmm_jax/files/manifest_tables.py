"""What a manifest may hold (TOML): the arm, tables of files, one a kind, made of what it declares, and lengths."""

import datetime
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    FiniteFloat,
    NonNegativeFloat,
    PositiveFloat,
    PrivateAttr,
    create_model,
    model_validator,
)

from ..acceptance.standards import Standard
from ..core.errors import InputError
from ..core.rotation_conventions import NUMBERS_OF_ROTATION, is_convention
from ..core.rotations import roll_pitch_yaw_matrix
from ..core.units import ANGLE_UNITS, LENGTH_UNITS
from ..data.capture import ReferenceLength
from ..data.observations.contacts import AbstractContact
from ..data.observations.held import Socket
from ..data.observations.observation import AbstractObservation
from ..data.observations.pixels import Pixels
from ..data.observations.simulated import kinds
from ..data.recording import SphereTest
from ..kinematics.arm import Arm, by_joint
from ..kinematics.correction_kinds import REFERENCE_TEMPERATURE
from .manifest_cameras import CameraTable, PixelsTable, TargetTable
from .manifest_files import NamedTable, Picked, Table
from .toml import Point, Strict, each_once

_OF_TIME = BeforeValidator(lambda time: time.date() if isinstance(time, datetime.datetime) else time)
_Day = Annotated[datetime.date, Field(strict=False), _OF_TIME]
_ByJoint = PositiveFloat | Annotated[list[PositiveFloat], Field(min_length=1)]


def _three_or_six(numbers: list[float]) -> list[float]:
    if len(numbers) not in (3, 6):
        raise ValueError("give x, y, z in mm, and roll, pitch, yaw in degrees where the base is turned.")
    return numbers


def _rotation(text: str) -> str:
    if not is_convention(text):
        raise ValueError(
            f"'{text}' is not a convention for rotations; give {', '.join(NUMBERS_OF_ROTATION)}, or three axes such "
            "as XYZ (moving axes, R = Rx Ry Rz) or xyz (fixed axes, R = Rz Ry Rx), each also with ' inverse' after it."
        )
    return text


class Angles(Strict):
    """How every column of readings is turned into rad, or mm of a prismatic joint."""

    unit: Literal["rad", "deg", "arcsec", "gon", "mrad", "counts", "percent"]
    counts_per_turn: _ByJoint | None = None
    sign: Literal[1, -1] | list[Literal[1, -1]] = 1
    offset: FiniteFloat | list[FiniteFloat] = 0.0
    columns: Picked | None = None
    torques: Picked | None = None  # columns of the joints' torques, N m
    directions: Picked | None = None  # columns of the directions from which the joints were moved: 1, -1, or 0
    linear_unit: Literal["mm", "m", "um", "inch", "counts"] = "mm"  # of prismatic joints
    counts_per_mm: _ByJoint | None = None
    coupled: dict[Annotated[str, Field(pattern="^[1-9][0-9]?$")], Annotated[int, Field(ge=-99, le=99)]] | None = None

    calibration: str | None = None  # LeRobot's file of the motors
    _written: "Angles | None" = PrivateAttr(None)

    @model_validator(mode="after")
    def _counts(self) -> "Angles":
        if self.calibration is not None:
            if self.counts_per_turn is not None or self.unit not in ("counts", "deg", "percent"):
                raise ValueError(
                    "calibration states how LeRobot's numbers become angles, so unit must be 'counts', 'deg' or "
                    "'percent', without counts_per_turn."
                )
            return self
        if self.unit == "percent":
            raise ValueError("unit = 'percent' is LeRobot's -100 to 100; add calibration, the file of its motors.")
        if (self.unit == "counts") != (self.counts_per_turn is not None):
            raise ValueError("counts_per_turn and unit = 'counts' are only possible together; give both or neither.")
        if (self.linear_unit == "counts") != (self.counts_per_mm is not None):
            raise ValueError(
                "counts_per_mm and linear_unit = 'counts' are only possible together; give both or neither."
            )
        return self

    @property
    def written(self) -> "Angles | None":
        """As the manifest has it, with the calibration of LeRobot, where these are the counts that it stands for."""
        return self._written

    @property
    def lerobot_unit(self) -> str | None:
        """The unit that [angles] stated for LeRobot's numbers, where these are what its counts were made of."""
        return None if self._written is None else self._written.unit

    def of_lerobot(self, written: "Angles | None") -> "Angles":
        """The same, as what these became that have a calibration of LeRobot."""
        self._written = written
        return self

    def read_as(self, joints: int) -> tuple[int, ...] | None:
        """`Recording.read_as`; None where no sign is stated."""
        if "sign" not in self.model_fields_set:
            return None
        signs = self.sign if isinstance(self.sign, list) else [self.sign] * joints
        return tuple(sign * i for i, sign in enumerate(signs, start=1))

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
        q = numbers("sign") * (readings - numbers("offset")) * units
        for moved, source in (self.coupled or {}).items():  # joint 3 turns by its reading, and by joint 2's: { 3 = 2 }
            joint, other = int(moved), abs(source)
            if not (0 < other <= arm.joints and joint <= arm.joints and joint != other):
                raise InputError(
                    f"angles.coupled has {moved} = {source}, but the arm has {arm.joints} joints; write the number of "
                    "a joint, and that of the joint whose angle is added to its reading, negative to subtract it."
                )
            q[:, joint - 1] += np.sign(source) * q[:, other - 1]
        return q


class SocketTable(NamedTable):
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


class _Table(NamedTable):
    """What the tables of all other kinds have in common."""

    readings: str | None = None  # file of the readings, in the same order
    readings_table: str | None = None  # in that file
    rotation: Annotated[str, AfterValidator(_rotation)] | None = None
    plus: dict[str, Picked] = Field(default_factory=dict)  # columns added to those of an entry, such as deviations
    minus: dict[str, Picked] = Field(default_factory=dict)  # and subtracted from them
    coverage_factor: PositiveFloat | None = None  # of the columns of u


def _model(kind: type[AbstractObservation]) -> type[NamedTable]:
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
    if issubclass(kind, AbstractContact):
        fields["link"] = (int | str | None, None)  # by default the last one of the chain
    return create_model(f"{kind.__name__}Table", __base__=_Table, **fields)


# Corners of images are read in another way than numbers of poses: `manifest_pixels`.
TABLES = {kind: _model(kind) for kind in kinds().values() if kind is not Pixels}


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
    measurements: str | None = None  # one table with the rows of many files
    socket: list[SocketTable] = Field(default_factory=list)
    length: list[Length] = Field(default_factory=list)
    sphere: list[Sphere] = Field(default_factory=list)


class Sessions(Strict):
    """What differs between the sessions that tables name."""

    probe: Literal["remounted", "same"] = "remounted"


Base = Annotated[list[FiniteFloat], AfterValidator(_three_or_six)]


def base_transform(numbers: np.ndarray) -> np.ndarray:
    """The transform of a position in mm, and roll, pitch and yaw in degrees where they are given."""
    base = np.eye(4)
    base[:3, 3] = numbers[:3]
    if len(numbers) > 3:
        base[:3, :3] = roll_pitch_yaw_matrix(np.radians(numbers[3:]))
    return base


class _Poses(Recorded):
    arm: str | Annotated[dict[str, str], Field(min_length=1)]  # or arms by the names of a robot's chains
    bases: dict[str, Base] = Field(default_factory=dict)  # of these arms in that of the first, roughly
    as_found: str | None = None  # the arm with the parameters that its controller had on arrival
    base: str | None = None  # links of a URDF
    tip: str | list[str] | None = None
    probe: Point | None = None  # mm, from the tip link
    load_centre: list[FiniteFloat] | None = None  # likewise: centre of mass of the load
    acceptance: Standard | Annotated[list[Standard], AfterValidator(each_once)] = Field(default_factory=list)
    measuring_range: PositiveFloat | None = None  # diameter of the measuring volume as the maker states it, mm
    angles: Angles | None = None
    sessions: Sessions | None = None
    camera: list[CameraTable] = Field(default_factory=list)
    target: list[TargetTable] = Field(default_factory=list)
    pixels: list[PixelsTable] = Field(default_factory=list)

    @classmethod
    def other_kind(cls, content: Mapping[str, Any], path: str | os.PathLike) -> str | None:
        """The file of an arm, or a manifest of points."""
        if "arm" in content:
            return None
        if "joint" in content or "urdf" in content:
            name = Path(path).name
            return (
                "is an arm file, not a manifest: it lacks the key arm and tables of data such as [[socket]] or "
                f"[[points]]; give a manifest with arm = '{name}', or read the arm with aacmm arm or aj.load_arm."
            )
        if isinstance(content.get("points"), Mapping):
            return "is a manifest of points, without an arm; read it with aj.files.read_points."
        return None


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
            if seated or (entry.temperature_C, entry.load_kg) != (None, None):
                raise ValueError(
                    "target, session, temperature_C and load_kg apply only to manifests of joint readings, but "
                    f"'{entry.name or entry.paths[0]}' has points, which are positions of the tip; remove these keys."
                )
        return self

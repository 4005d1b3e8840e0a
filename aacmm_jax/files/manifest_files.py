"""What a table of a manifest says of its files: paths, columns, units; and presets of these."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import AfterValidator, Field, FiniteFloat, NonNegativeFloat, NonNegativeInt, PositiveInt, model_validator

from .table_columns import OF_UR
from .text_lines import Column
from .toml import Strict, each_once


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
    # Recordings of ROS: m, rad and the order of quaternions as REP 103 and geometry_msgs have them.
    "ros": Preset({"points": [["x", "y", "z"]], "rotations": [["qx", "qy", "qz", "qw"]]}, rotation="quaternion xyzw"),
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


Named = TypeVar("Named", str, int, Column)
Picked = PositiveInt | str | Annotated[list[PositiveInt | str], Field(min_length=1)]


def as_list(picked: Named | list[Named]) -> list[Named]:
    """What is picked: one thing is a list, too."""
    return picked if isinstance(picked, list) else [picked]


class Table(Strict):
    """What all tables of files have in common."""

    file: str | None = None
    files: Annotated[list[str], Field(min_length=1), AfterValidator(each_once)] | dict[str, str] | None = None
    table: str | Annotated[list[str], Field(min_length=1), AfterValidator(each_once)] | None = None  # in the file
    preset: Literal["csv", "leica", "xyzijk", "ipa", "ros"] | None = None
    columns: Picked | dict[str, Picked] = Field(default_factory=dict)
    units: dict[str, str] = Field(default_factory=dict)
    delimiter: Literal[",", ";", "\t", " "] | None = None
    decimal: Literal[".", ","] | None = None  # None: that of the preset, else a point
    skip: NonNegativeInt = 0
    group: PositiveInt | str | None = None
    temperature_C: FiniteFloat | None = None  # of the arm, where the table has no such column
    load_kg: NonNegativeFloat | None = None  # likewise, at the tip

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


class NamedTable(Table):
    """A table whose files may have fields in braces."""

    name: str | None = None
    exclude: list[str] = Field(default_factory=list)
    session: str | None = None  # of all rows; columns.session, of each

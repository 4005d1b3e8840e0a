"""Tables of a manifest for cameras: [[camera]], [[target]] and [[pixels]]."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from .manifest_files import NamedTable, Picked
from .toml import Strict

_Counts = Annotated[list[PositiveInt], Field(min_length=2, max_length=2)]


class Bar(Strict):
    """The bar of a printed board, measured with callipers, mm."""

    nominal: PositiveFloat
    measured: PositiveFloat
    u: NonNegativeFloat


class TargetTable(Strict):
    """A board, tags, or a table of points; lengths in mm."""

    name: str
    kind: Literal["checkerboard", "charuco", "tags", "points"]
    squares: _Counts | None = None  # columns, rows
    tags: _Counts | None = None
    size: PositiveFloat | None = None  # of a square or tag
    marker: PositiveFloat | None = None
    gap: PositiveFloat | None = None
    dictionary: str | None = None
    legacy: bool | None = None
    first: NonNegativeInt | None = None  # id of the first tag
    bar: Bar | None = None
    file: str | None = None  # of points: id, x, y, z
    table: str | None = None  # in that file
    columns: dict[str, Picked] = Field(default_factory=dict)
    units: dict[str, str] = Field(default_factory=dict)

    @property
    def keys(self) -> dict[str, Any]:
        """What `target_of` takes; of a table of points without these."""
        return self.model_dump(exclude_unset=True, exclude={"name", "file", "table", "columns", "units"})


class CameraTable(Strict):
    """A camera: its model, and what is known of its intrinsics, px and 1."""

    name: str
    model: str | None = None
    image_size: _Counts | None = None  # width, height, px
    file: str | None = None  # ROS camera_info, or OpenCV's FileStorage
    intrinsics: dict[str, FiniteFloat] | None = None
    coefficients: Literal[0, 4, 5, 8] | None = None  # of distortion
    u: Literal["free", "exact"] | dict[str, PositiveFloat] = "free"

    @model_validator(mode="after")
    def _one_source(self) -> "CameraTable":
        if self.file is not None and (self.intrinsics is not None or self.coefficients is not None):
            raise ValueError("file states the intrinsics; remove the keys intrinsics and coefficients.")
        if self.u != "free" and self.file is None and self.intrinsics is None:
            raise ValueError("u states the uncertainty of intrinsics that are not given; add intrinsics or file.")
        return self


class PixelsTable(NamedTable):
    """Poses in which a camera saw a target: a table of readings, and images or a table of corners."""

    camera: str
    target: str
    on_arm: Literal["camera", "target"] = "camera"
    images: str | None = None  # path with wildcards
    corners: str | None = None  # table: image, id, u, v; or JSON
    corner_table: str | Annotated[list[str], Field(min_length=1)] | None = None  # in that file
    corner_columns: Mapping[Literal["image", "id", "corners"], Picked] = Field(default_factory=dict)
    u: PositiveFloat | None = None  # px, or mm of a camera that measures points

    @model_validator(mode="after")
    def _one_kind_of_corners(self) -> "PixelsTable":
        if (self.images is None) == (self.corners is None):
            raise ValueError("needs either images or corners.")
        return self

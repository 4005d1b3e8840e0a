"""Targets that a camera sees: boards and tags, with the ids of their corners and where these are on the target.

The frame of a board is that of the print as one looks at it: x to the right, y down, z away from the viewer, in mm, as
OpenCV has it. A marker has four corners, clockwise from the upper left one; their ids are 4 times the id of the marker
plus 0, 1, 2 and 3.

A printer stretches a board by some tenths of a percent. So every target has a ``scale`` by which its nominal sizes are
multiplied, and ``u_scale``, its standard uncertainty; `AbstractTarget.scaled_by_bar` finds both from a measured length.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from jaxtyping import Float, Int

from ..core.arguments import OneOf, Range, checked, checked_arguments, checked_fields, items_of, shown
from ..core.arrays import Numbers
from ..core.errors import InputError, nearest

# Names of the dictionaries of markers: cells on a side of the code, and number of markers.
DICTIONARIES = {
    **{f"{n}x{n}_{count}": (n, count) for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    **{"apriltag_16h5": (4, 30), "apriltag_25h9": (5, 35), "apriltag_36h10": (6, 2320), "apriltag_36h11": (6, 587)},
    **{"aruco_original": (5, 1024), "aruco_mip_36h12": (6, 250)},
}
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])  # of a marker of side 1, in the order of their ids
_LARGEST = 10_000.0  # mm
_SMALLEST = 0.25  # mm: a smaller square was stated in m
_SCALE_FIELDS = ("scale", "u_scale")
_MOST_SCALE_ERROR = 0.2  # of a print, relative
_SQUARES = Annotated[int, Range(least=3, most=200)]  # with fewer there are not four inner corners
_TAGS = Annotated[int, Range(least=1, most=100)]
_SIZE = Annotated[float, Range(above=0, most=_LARGEST, unit="mm")]
_SCALE = Annotated[float, Range(least=1 - _MOST_SCALE_ERROR, most=1 + _MOST_SCALE_ERROR)]
_U_SCALE = Annotated[float, Range(least=0, most=_MOST_SCALE_ERROR)]


def dictionary_name(text: str) -> str:
    """The name of a dictionary of markers as used here; ``DICT_4X4_50`` and ``tag36h11`` are understood."""
    name = text.lower().removeprefix("dict_").removeprefix("tag")
    name = f"apriltag_{name}" if f"apriltag_{name}" in DICTIONARIES else name
    if name not in DICTIONARIES:
        raise InputError(f"'{text}' is not a dictionary of markers{nearest(name, DICTIONARIES, most=30)}")
    return name


@dataclasses.dataclass(frozen=True, kw_only=True)
class AbstractTarget:
    """What all targets have.

    Args:
        scale: What nominal sizes are multiplied by to obtain the true ones.
        u_scale: Standard uncertainty of the scale (relative).
    """

    scale: _SCALE = 1.0
    u_scale: _U_SCALE = 0.0

    def __post_init__(self) -> None:
        checked_fields(self, f"the target '{self.kind}'")
        size = getattr(self, "size", _SMALLEST)
        if size < _SMALLEST:
            raise InputError(
                f"size of the target '{self.kind}' is {size:g} mm; sizes are in mm, so {size:g} m are {1000 * size:g}."
            )
        dictionary = getattr(self, "dictionary", "")
        if dictionary:
            object.__setattr__(self, "dictionary", dictionary_name(dictionary))

    @property
    def kind(self) -> str:
        """The name of this kind of target in manifests and commands."""
        return next(name for name, target in TARGETS.items() if isinstance(self, target))

    @property
    @abstractmethod
    def nominal(self) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k 3"]]:
        """Ids of the corners, and their nominal coordinates, mm."""

    @property
    def markers(self) -> tuple[Int[np.ndarray, " t"], Float[np.ndarray, "t 4 3"]]:
        """Ids of the markers, and the nominal coordinates of their four corners, mm; none where there are none."""
        return np.zeros(0, dtype=int), np.zeros((0, 4, 3))

    @cached_property
    def ids(self) -> Int[np.ndarray, " k"]:
        """Ids of the corners."""
        return self.nominal[0]

    @cached_property
    def points(self) -> Float[np.ndarray, "k 3"]:
        """Where the corners are on the target, mm, with its scale."""
        return self.scale * self.nominal[1]

    def points_of(self, ids: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k 3"]:
        """Nominal coordinates of some corners, mm."""
        order = np.argsort(self.ids)
        return self.nominal[1][order[np.searchsorted(self.ids[order], ids)]]

    @property
    def is_planar(self) -> bool:
        """Whether all corners are in one plane."""
        sizes = np.linalg.svd(self.points - self.points.mean(axis=0), compute_uv=False)
        return bool(sizes[2] <= 1e-9 * sizes[0])

    @checked_arguments(where="the measured bar")
    def scaled_by_bar(self, nominal: _SIZE, measured: _SIZE, u: Annotated[float, Range(least=0, unit="mm")]) -> Self:
        """The target with the scale that a measured length shows.

        Args:
            nominal: Length that the print states, mm.
            measured: Length measured on the print, mm.
            u: Standard uncertainty of the measured length, mm.

        Raises:
            InputError: Where the two lengths differ by more than 20 %.

        Example:
            >>> board = aj.camera.Checkerboard(8, 5, 30.0).scaled_by_bar(nominal=150.0, measured=149.7, u=0.05)
            >>> print(board.scale, board.points.max().round(2))
            0.998 179.64
        """
        scale = measured / nominal
        if abs(scale - 1) > _MOST_SCALE_ERROR:
            raise InputError(
                f"the bar of {nominal:g} mm was measured as {measured:g} mm; a print is not that far from its scale: "
                "give both lengths in mm."
            )
        return dataclasses.replace(self, scale=scale, u_scale=u / nominal)


@dataclasses.dataclass(frozen=True)
class _Board(AbstractTarget):
    """Squares, black and white by turns; the upper left one is black."""

    columns: _SQUARES
    rows: _SQUARES
    size: _SIZE

    @property
    def nominal(self) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k 3"]]:
        """The inner corners, row by row."""
        row, column = np.divmod(np.arange((self.columns - 1) * (self.rows - 1)), self.columns - 1)
        grid = np.stack([column, row, np.zeros_like(row)], axis=1)
        return np.arange(len(grid)), self.size * (grid + self._first_corner)

    _first_corner = np.zeros(3)  # in squares


@dataclasses.dataclass(frozen=True)
class Checkerboard(_Board):
    """A checkerboard. Its corners are the inner ones, row by row from 0; the origin is the first of them.

    In images it is recognised where one of the two numbers of squares is odd and the other is even; other checkerboards
    look the same after half a turn.

    Args:
        columns: Number of squares in a row (not of inner corners).
        rows: Number of rows of squares.
        size: Side of a square, mm.

    Raises:
        InputError: Fewer than 3 squares in a row or column, or a size that is not plausible.

    Example:
        >>> board = aj.camera.Checkerboard(8, 5, 30.0)
        >>> print(len(board.ids), board.points[-1])
        28 [180.  90.   0.]
    """


@dataclasses.dataclass(frozen=True)
class Charuco(_Board):
    """A ChArUco board: a checkerboard with a marker in every white square, so that a part of it can be recognised.

    Its corners are the inner ones of the checkerboard, row by row from 0; the origin is the outer upper left corner.

    Args:
        columns: Number of squares in a row.
        rows: Number of rows of squares.
        size: Side of a square, mm.
        marker: Side of a marker, mm.
        dictionary: Dictionary of the markers (`DICTIONARIES`).
        legacy: Whether it was printed by OpenCV before 4.6, which puts a marker into the upper left square where the
            number of rows is even.

    Raises:
        InputError: Sizes that do not fit, or a dictionary with fewer markers.

    Example:
        >>> board = aj.camera.Charuco(7, 5, 30.0, 22.0)
        >>> print(len(board.ids), board.points[0], len(board.markers[0]))
        24 [30. 30.  0.] 17
    """

    marker: _SIZE
    dictionary: str = "4x4_100"
    legacy: bool = False
    _first_corner = np.array([1.0, 1.0, 0.0])

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.marker > 0.95 * self.size:
            raise InputError(
                f"a marker of {self.marker:g} mm does not fit into a square of {self.size:g} mm with a white margin; "
                f"the marker may have up to {0.95 * self.size:g} mm."
            )
        _check_count(len(self.markers[0]), 0, self.dictionary)

    @property
    def starts_white(self) -> bool:
        """Whether the upper left square is white, and has a marker."""
        return self.legacy and self.rows % 2 == 0

    @property
    def markers(self) -> tuple[Int[np.ndarray, " t"], Float[np.ndarray, "t 4 3"]]:
        """Ids of the markers, numbered row by row, and the nominal coordinates of their four corners, mm."""
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        white = (row + column) % 2 == (0 if self.starts_white else 1)
        first = self.size * np.stack([column, row], axis=1)[white] + (self.size - self.marker) / 2
        return np.arange(len(first)), _with_corners(first, self.marker)


@dataclasses.dataclass(frozen=True)
class TagGrid(AbstractTarget):
    """A grid of ArUco markers or AprilTags. The origin is the upper left corner of the first tag.

    Args:
        columns: Number of tags in a row.
        rows: Number of rows.
        size: Side of the black square of a tag, mm.
        gap: Distance between tags, mm.
        dictionary: Dictionary of the tags (`DICTIONARIES`).
        first: Id of the first tag; the others follow row by row.

    Raises:
        InputError: Sizes that are not plausible, or a dictionary with fewer tags.

    Example:
        >>> grid = aj.camera.TagGrid(4, 3, 40.0, 10.0, "apriltag_36h11")
        >>> print(len(grid.ids), grid.points[5])
        48 [90.  0.  0.]
    """

    columns: _TAGS
    rows: _TAGS
    size: _SIZE
    gap: _SIZE
    dictionary: str = "apriltag_36h11"
    first: Annotated[int, Range(least=0)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_count(self.columns * self.rows, self.first, self.dictionary)

    @property
    def nominal(self) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k 3"]]:
        """The corners of all tags."""
        ids, corners = self.markers
        return (4 * ids[:, None] + np.arange(4)).ravel(), corners.reshape(-1, 3)

    @property
    def markers(self) -> tuple[Int[np.ndarray, " t"], Float[np.ndarray, "t 4 3"]]:
        """Ids of the tags, and the nominal coordinates of their four corners, mm."""
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        first = (self.size + self.gap) * np.stack([column, row], axis=1)
        return self.first + np.arange(len(first)), _with_corners(first, self.size)


@dataclasses.dataclass(frozen=True, eq=False)
class PointTable(AbstractTarget):
    """Any points in space: tags on a cube, reflective dots, corners of an object.

    Args:
        point_ids: Id of each point.
        coordinates: Nominal coordinates of each point, mm, in a frame of the target.
        dictionary: Dictionary of the tags whose corners the points are, for a target that is recognised in images: the
            ids are then 4 times that of the tag plus the number of the corner, and all four corners of a tag are given.

    Raises:
        InputError: Fewer than 4 points, an id that occurs twice, or a tag without all of its corners.

    Example:
        >>> corners = [[0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0], [0, 0, 30]]
        >>> print(aj.camera.PointTable(range(5), corners).is_planar)
        False
    """

    point_ids: Numbers
    coordinates: Numbers
    dictionary: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes: dict[str, int] = {}
        ids = checked(
            items_of(self.point_ids, "ids"), Float[np.ndarray, " points"], "ids of the table of points", sizes
        )
        points = checked(self.coordinates, Float[np.ndarray, "points 3"], "the table of points", sizes)
        object.__setattr__(self, "point_ids", ids)
        object.__setattr__(self, "coordinates", points)
        ids = self.ids
        if len(ids) < 4 or np.any(ids != self.point_ids) or ids.min() < 0 or len(np.unique(ids)) < len(ids):
            raise InputError(
                f"the table of points has {len(ids)} rows with {len(np.unique(self.point_ids))} different ids; give at "
                "least 4 points with different ids, whole numbers from 0."
            )
        if self.dictionary and len(self.markers[0]) * 4 < len(ids):
            complete = {4 * tag + corner for tag in self.markers[0] for corner in range(4)}
            tag = next(point for point in ids if point not in complete) // 4
            raise InputError(
                f"the table of points lacks a corner of tag {tag}; give all four, with the ids {4 * tag} to "
                f"{4 * tag + 3}."
            )

    @property
    def nominal(self) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k 3"]]:
        """The points as given."""
        return np.asarray(self.point_ids).astype(int), np.asarray(self.coordinates)

    @property
    def markers(self) -> tuple[Int[np.ndarray, " t"], Float[np.ndarray, "t 4 3"]]:
        """Ids of the tags of which all corners are given, and their nominal coordinates, mm."""
        if not self.dictionary:
            return super().markers
        ids, points = self.nominal
        tags, counts = np.unique(ids // 4, return_counts=True)
        order = np.argsort(ids)
        return tags[counts == 4], points[order][np.isin(ids[order] // 4, tags[counts == 4])].reshape(-1, 4, 3)


TARGETS: Mapping[str, type[AbstractTarget]] = {
    "checkerboard": Checkerboard,
    "charuco": Charuco,
    "tags": TagGrid,
    "points": PointTable,
}


# By kind, the keys of a manifest that stand for two fields, or that have another name than the field.
_KEYS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "checkerboard": {"squares": ("columns", "rows")},
    "charuco": {"squares": ("columns", "rows")},
    "tags": {"tags": ("columns", "rows")},
    "points": {"ids": ("point_ids",), "points": ("coordinates",)},
}


def keys_of_target(target: AbstractTarget) -> dict[str, Any]:
    """A board in the keys of a manifest (`target_of`), without its scale."""
    two_fields = {key: [getattr(target, name) for name in names] for key, names in _KEYS[target.kind].items()}
    others = [field for field in dataclasses.fields(target) if field.name not in ("columns", "rows", *_SCALE_FIELDS)]
    stated = {field.name: getattr(target, field.name) for field in others}
    usual = {field.name: field.default for field in others if field.name != "dictionary"}
    return {"kind": target.kind, **two_fields} | {
        name: value for name, value in stated.items() if name not in usual or value != usual[name]
    }


@checked_arguments
def target_of(
    kind: Annotated[str, OneOf(("checkerboard", "charuco", "tags", "points"))],
    *,
    bar: Mapping[str, float] | None = None,
    **keys: Any,
) -> AbstractTarget:
    """A target from the keys of a manifest.

    Args:
        kind: ``checkerboard``, ``charuco``, ``tags`` or ``points``.
        bar: Lengths ``nominal`` and ``measured`` and standard uncertainty ``u`` of a bar that was measured, mm.
        **keys: ``squares`` or ``tags`` (columns, rows), or ``ids`` and ``points``; and what the target has besides:
            ``size``, ``marker``, ``gap``, ``dictionary``, ``legacy``, ``first``.

    Raises:
        InputError: A key is missing, unknown or wrong.

    Example:
        >>> bar = {"nominal": 150, "measured": 150.3, "u": 0.05}
        >>> board = aj.camera.target_of("charuco", squares=[7, 5], size=30.0, marker=22.0, bar=bar)
        >>> print(board.points[-1].round(2))
        [180.36 120.24   0.  ]
    """
    made, fields = TARGETS[kind], dict[str, Any]()
    plain = [field for field in dataclasses.fields(made) if field.name not in _SCALE_FIELDS]
    renamed = _KEYS[kind]
    known = [*renamed, *(field.name for field in plain if field.name not in sum(renamed.values(), ()))]
    for key, value in keys.items():
        names = renamed.get(key, (key,))
        if key not in known:
            raise InputError(f"a target '{kind}' has no key '{key}'{nearest(key, [*known, 'bar'])}")
        if len(names) == 2 and not (isinstance(value, list | tuple) and len(value) == 2):
            raise InputError(f"{key} of the target '{kind}' is {shown(value)}; give [columns, rows].")
        fields |= dict(zip(names, value if len(names) == 2 else [value], strict=True))
    required = [field.name for field in plain if field.default is dataclasses.MISSING]
    for key in known:
        if any(name in required and name not in fields for name in renamed.get(key, (key,))):
            raise InputError(f"{key} of the target '{kind}' is missing; state it.")
    target = made(**fields)
    if bar is None:
        return target
    if set(bar) != {"nominal", "measured", "u"}:
        raise InputError("bar, which was measured on the print, needs the keys nominal, measured and u, in mm.")
    return target.scaled_by_bar(**bar)


def _with_corners(first: Float[np.ndarray, "t 2"], size: float) -> Float[np.ndarray, "t 4 3"]:
    """The corners of markers whose upper left corners are these."""
    corners = first[:, None] + size * CORNERS
    return np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=2)


def _check_count(markers: int, first: int, dictionary: str) -> None:
    count = DICTIONARIES[dictionary][1]
    if first + markers > count:
        raise InputError(
            f"the target needs the markers {first} to {first + markers - 1}, but '{dictionary}' has the markers 0 to "
            f"{count - 1}; choose a larger dictionary or fewer markers."
        )

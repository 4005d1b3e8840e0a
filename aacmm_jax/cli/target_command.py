"""The command that prints targets of cameras: ``target``."""

import json
from pathlib import Path
from typing import Any, Literal

from .. import camera
from ..core.errors import InputError
from ..files.outputs import together, write_atomically
from ..summaries.tables import View
from . import options
from .app import command, show_summary
from .options import argument, bad_option, option, output

_MARKER, _GAP = 0.74, 0.25  # of the side of a square, and of a tag, where none is given
_DICTIONARIES = {"charuco": "4x4_100", "aruco": "4x4_100", "april": "apriltag_36h11"}


@command(
    "aacmm target charuco --squares 7x5 --size-mm 30 -o board.pdf",
    "aacmm target april --squares 5x4 --size-mm 40 --paper a3 -o tags.pdf",
)
def target(
    kind: Literal["charuco", "checkerboard", "aruco", "april"] = argument(
        "charuco (recommended: it may be hidden in part), checkerboard, or a grid of aruco or april tags.", "KIND"
    ),
    output: Path = output("Board to write (PDF).", "BOARD.pdf"),
    squares: str = option("Number of squares, or of tags, in a row and in a column, such as 7x5.", "COLUMNSxROWS"),
    size_mm: float = option("Side of a square, or of a tag.", min=0),
    marker_mm: float | None = option("Side of the markers of a ChArUco board. Default: 74 % of a square.", min=0),
    gap_mm: float | None = option("Distance between tags. Default: a quarter of a tag.", min=0),
    dictionary: str | None = option(
        "Dictionary of the markers, such as 4x4_50, 5x5_100, apriltag_36h11. Default: 4x4_100; for april "
        "apriltag_36h11.",
        "NAME",
    ),
    paper: str = option("Paper: a4, a3, a2, a1, a0, letter, tabloid, or WIDTHxHEIGHT in mm.", "PAPER", default="a4"),
    as_json: bool = options.JSON,
) -> None:
    """Print a board for a camera, true to scale (PDF).

    Below the board is a bar to measure with callipers, since printers stretch the paper. The command prints the lines
    that a manifest needs.
    """
    from ..camera.printing import bar_length
    from ..data.targets import keys_of_target

    with together(output):
        columns, cross, rows = squares.lower().partition("x")
        if not (cross and columns.isascii() and columns.isdecimal() and rows.isascii() and rows.isdecimal()):
            bad_option("--squares", squares, "COLUMNSxROWS")
        for name, value, kinds in (("marker", marker_mm, ("charuco",)), ("gap", gap_mm, ("aruco", "april"))):
            if value is not None and kind not in kinds:
                raise InputError(f"--{name}-mm does not apply to {kind}; leave it out.")
        board = _board(kind, int(columns[:6]), int(rows[:6]), size_mm, marker_mm or gap_mm, dictionary)
        with write_atomically(output) as temporary:
            temporary.write_bytes(camera.board_pdf(board, paper))
        summary = {
            "written": str(output),
            "target": keys_of_target(board),
            "corners": len(board.ids),
            "bar_mm": bar_length(board),
            "manifest": _manifest_lines(keys_of_target(board), bar_length(board)),
        }
    show_summary(summary, as_json, _view)


def _board(kind: str, columns: int, rows: int, size: float, inner: float | None, dictionary: str | None) -> Any:
    """The board; ``inner`` is the side of its markers, or the gap between tags, mm."""
    if kind == "checkerboard":
        return camera.Checkerboard(columns, rows, size)
    name = dictionary or _DICTIONARIES[kind]
    if kind == "charuco":
        return camera.Charuco(columns, rows, size, inner or round(_MARKER * size, 1), name)
    return camera.TagGrid(columns, rows, size, inner or round(_GAP * size, 1), name)


def _manifest_lines(keys: dict[str, Any], bar: float) -> list[str]:
    """The table of a board in a manifest (TOML)."""
    # Numbers, texts and lists of numbers are the same in JSON and TOML.
    lines = [f"{key} = {json.dumps(value)}" for key, value in ({"name": "board"} | keys).items()]
    return [
        "[[target]]",
        *lines,
        f"bar = {{ nominal = {bar:g}, measured = {bar:g}, u = 0.05 }}  # mm: put in what you measured",
    ]


def _view(summary: dict[str, Any]) -> View:
    """What people see."""
    yield f"{summary['written']}: a board with {summary['corners']} corners. Print it at 100 %, on a flat, stiff sheet."
    yield f"Measure the bar below the board, which should be {summary['bar_mm']:g} mm. The lines for the manifest:"
    yield ""
    yield from summary["manifest"]

"""A target as a PDF, true to scale, with a bar that is measured after printing."""

import math

import numpy as np

from ..core.arguments import checked_arguments
from ..core.errors import InputError
from ..data.targets import AbstractTarget
from .drawing import patches_of

PAPERS = {  # width and height, mm
    "a4": (210.0, 297.0), "a3": (297.0, 420.0), "a2": (420.0, 594.0), "a1": (594.0, 841.0), "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4), "tabloid": (279.4, 431.8),
}  # fmt: skip
MM = 72 / 25.4  # of a PDF, in 1 mm
_EDGE = 5.0  # mm: what printers leave white
_FOOT = 17.0  # mm below the board: the bar and two lines of text
_BAR = (3.0, 150.0)  # mm: its thickness, and its greatest length, which callipers measure


def bar_length(target: AbstractTarget) -> float:
    """The length of the bar that is printed below a board, mm: a multiple of 10 that is not longer than the board."""
    left, _, right, _ = patches_of(target)[0].paper
    return min(max(math.floor((right - left) / 10) * 10.0, 10.0), _BAR[1])


@checked_arguments
def board_pdf(target: AbstractTarget, paper: str = "a4") -> bytes:
    """A board on a sheet of paper, upright or across, with its name and the bar.

    Args:
        target: The board, with nominal lengths in mm; its scale is not applied.
        paper: ``a4``, ``a3``, ``a2``, ``a1``, ``a0``, ``letter``, ``tabloid``, or width and height such as ``500x400``
            (mm).

    Returns:
        The PDF.

    Raises:
        InputError: The board does not fit on the paper, is not flat, or has markers and OpenCV is not installed.

    Example:
        >>> aj.camera.board_pdf(aj.camera.Checkerboard(8, 5, 30.0))[:8]
        b'%PDF-1.4'
    """
    if target.kind == "points":
        raise InputError("a table of points is not a board that can be printed; give a board or a grid of tags.")
    (patch,) = patches_of(target)
    board = patch.paper[2:] - patch.paper[:2]
    width, height = _oriented(board + np.array([0.0, _FOOT]), paper)
    corner = (np.array([width, height - _FOOT]) - board) / 2
    # In a PDF, y runs upwards from the lower edge of the sheet. One path of all rectangles: no gaps between cells.
    black = patch.black + np.tile(corner - patch.paper[:2], 2)
    foot, bar = corner[1] + board[1] + 3.0, bar_length(target)
    rectangles = [*black, np.array([corner[0], foot, corner[0] + bar, foot + _BAR[0]])]
    path = [
        f"{left * MM:.4f} {(height - lower) * MM:.4f} {(right - left) * MM:.4f} {(lower - upper) * MM:.4f} re"
        for left, upper, right, lower in rectangles
    ]
    lines = [
        f"{_title(target)}. Print at 100 %, without fitting to the page.",
        f"Measure the bar with callipers. It should be {bar:g} mm; state in the manifest what you measure: "
        f"bar = {{ nominal = {bar:g}, measured = ..., u = 0.05 }}",
    ]
    text = [
        f"BT /F1 7 Tf {corner[0] * MM:.2f} {(height - foot - _BAR[0] - 4.0 - 3.5 * number) * MM:.2f} Td ({line}) Tj ET"
        for number, line in enumerate(lines)
    ]
    return pdf_document("\n".join(["0 g", *path, "f", *text]), (width * MM, height * MM))


def _title(target: AbstractTarget) -> str:
    """A board in words."""
    columns, rows, size = (getattr(target, name) for name in ("columns", "rows", "size"))
    if target.kind == "tags":
        return f"{columns} x {rows} tags of {size:g} mm, {getattr(target, 'dictionary')}"  # noqa: B009
    markers = ""
    if target.kind == "charuco":
        marker, dictionary = (getattr(target, name) for name in ("marker", "dictionary"))
        markers = f", markers of {marker:g} mm, {dictionary}"
    return f"{columns} x {rows} squares of {size:g} mm{markers}"


def _oriented(needed: np.ndarray, paper: str) -> tuple[float, float]:
    """Width and height of the sheet in the position in which a board fits; a little wider than needed is enough."""
    sheets = {name: size for name, size in PAPERS.items() if _fits(needed, size)}
    width, cross, height = paper.lower().partition("x")
    if paper.lower() in PAPERS:
        size = PAPERS[paper.lower()]
    elif cross and all(part.strip().replace(".", "", 1).isdecimal() for part in (width, height)):
        size = (float(width), float(height))
    else:
        raise InputError(f"the paper '{paper}' is unknown; give {', '.join(PAPERS)}, or WIDTHxHEIGHT in mm.")
    turned = _fits(needed, size)
    if turned is None:
        advice = f"choose {next(iter(sheets))}" if sheets else "give a larger sheet as WIDTHxHEIGHT in mm"
        raise InputError(
            f"the board needs {needed[0] + 2 * _EDGE:.0f} x {needed[1] + 2 * _EDGE:.0f} mm with its margins, and the "
            f"paper '{paper}' has {size[0]:g} x {size[1]:g} mm; {advice}, or make the board smaller."
        )
    return turned


def _fits(needed: np.ndarray, size: tuple[float, float]) -> tuple[float, float] | None:
    """The sheet in the position in which what is needed fits, upright if possible."""
    fitting = [sheet for sheet in (size, size[::-1]) if np.all(needed + 2 * _EDGE <= np.array(sheet) + 1e-6)]
    return (fitting[0][0], fitting[0][1]) if fitting else None


def pdf_document(content: str, size: tuple[float, float]) -> bytes:
    """A PDF of one page."""
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {size[0]:.4f} {size[1]:.4f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>",
        f"<< /Length {len(content)} >>\nstream\n{content}\nendstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        "<< /Producer (aacmm) >>",
    ]
    text, places = "%PDF-1.4\n", []
    for number, item in enumerate(objects, start=1):
        places.append(len(text))
        text += f"{number} 0 obj\n{item}\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    count = len(objects) + 1
    text += (
        f"xref\n0 {count}\n0000000000 65535 f \n{table}trailer\n<< /Size {count} /Root 1 0 R /Info {count - 1} 0 R >>\n"
        f"startxref\n{len(text)}\n%%EOF\n"
    )
    return text.encode("ascii")

"""What all figures share: colours that stay distinct in grey, new axes, labels, and files written whole."""

import math
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.extras import require
from ..files.atomic_write import write_atomically

_FORMATS = ("png", "svg", "pdf")
_USE = "a figure"
DARK, ACCENT, LIGHT = "#1b3a6b", "#d95f02", "0.65"
# Lines that remain distinct, in grey too.
LINES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (2, 1)), (0, (4, 1, 1, 1)))
MARKERS = "os^Dv<>p"
COLORS = ("#1b3a6b", "#d95f02", "#111111", "#1b7a5a", "#7a3b8f", "#555555", "#a33b3b", "#3a6fb0")


def new_figure(size: tuple[float, float]) -> Any:
    """A figure outside matplotlib's global state, its size in inches; `MissingExtra` without matplotlib."""
    require("plot", _USE)
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def axes_or_new(axes: Any, size: tuple[float, float] = (6.4, 4.2)) -> Any:
    """The given axes, or those of a new figure, its size in inches."""
    return new_figure(size).subplots() if axes is None else axes


def label_axes(axes: Any, x: str, y: str) -> None:
    """Label both axes and add a grid."""
    axes.set(xlabel=x, ylabel=y)
    axes.grid(True, which="major", alpha=0.3)


def logarithmic(axes: Any) -> None:
    """Make the y axis logarithmic, with plain numbers, also between powers of ten where there are few."""
    from matplotlib.ticker import FuncFormatter

    def between(value: float, _: int) -> str:
        low, high = axes.get_ylim()
        leading = round(value / 10.0 ** math.floor(math.log10(value) + 1e-9))
        shown = () if high > 1e3 * low else (2, 5) if high > 10 * low else (2, 3, 4, 5, 6, 8)
        return f"{value:g}" if leading in shown else ""

    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(FuncFormatter(between))


def label_parameters(axes: Any, names: list[str]) -> None:
    """Mark the x axis with the names of parameters or lengths."""
    axes.set_xticks(range(len(names)), names, rotation=60, ha="right")


def check_format(path: Path) -> str:
    """The format of a figure by its file name; `InputError` for any but PNG, SVG and PDF, or without matplotlib."""
    suffix = path.suffix.lower().removeprefix(".")
    if suffix not in _FORMATS:
        raise InputError(f"{path} is no figure that can be drawn; end its name in .png, .svg or .pdf.")
    require("plot", _USE)
    return suffix


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure into a file, whole or not at all, in the format that its name ends in."""
    file_format = check_format(path)
    with write_atomically(path) as temporary:
        figure.savefig(temporary, format=file_format, dpi=150)

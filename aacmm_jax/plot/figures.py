"""Charts drawn with matplotlib into the axes given, or into a figure of their own, and written into files.

Nothing touches matplotlib's global state, and it is imported when something is drawn.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError, require
from ..files.outputs import write_atomically
from .charts import Axis, Marks, Plot

_FORMATS = ("png", "svg", "pdf")
_USE = "a figure"
TONES = {"main": "#1b3a6b", "accent": "#d95f02", "soft": "0.65", "ink": "0.2", "page": "white"}
_SHADES = ("#dbe3ef", "#b3c2da", "#8aa0c3", "#6079a5", "#3a5586", "#14305f")
_MARKERS = {"dot": "o", "square": "s", "triangle": "^", "diamond": "D", "cross": "x", "ring": "o"}
_LINES = {"line": "-", "dashed": "--", "dotted": ":"}
_ROOM = 74  # characters side by side in a legend


def new_figure(size: tuple[float, float]) -> Any:
    """A figure outside matplotlib's global state, its size in inches; `MissingExtra` without matplotlib."""
    require("plot", _USE)
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def draw(plot: Plot, axes: Any = None, size: tuple[float, float] = (6.4, 4.2), *, legend: bool = True) -> Any:
    """Draw a plot into axes, or into those of a new figure of a size in inches; a legend stands above them."""
    axes = new_figure(size).subplots() if axes is None else axes
    before = (axes.get_xlim(), axes.get_ylim()) if axes.has_data() else ((), ())
    for marks in plot.marks:
        _draw_marks(axes, marks)
    _scale(axes, "x", plot.x, before[0])
    _scale(axes, "y", plot.y, before[1])
    if not any(marks.box[1] for marks in plot.marks):
        axes.grid(True, which="major", alpha=0.3)
    axes.set_axisbelow(True)
    if plot.square:
        axes.set_aspect("equal")
    handles, labels = axes.get_legend_handles_labels()
    if legend and labels:
        title = "\n".join(filter(None, (plot.title, *(marks.name for marks in plot.marks if marks.limits))))
        style = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "fontsize": 9, "title_fontsize": 9}
        axes.legend(handles, labels, ncols=_columns(labels), frameon=False, title=title, **style)
    elif plot.title:
        axes.set_title(plot.title, fontsize=9)
    return axes


def draw_all(
    plots: Sequence[Plot], columns: int, panel: tuple[float, float] = (3.1, 2.5), *, legends: bool = False
) -> Any:
    """A figure with a panel for each plot, inches; with one legend above all, or ``legends`` above each."""
    columns = min(columns, len(plots))
    rows = -(-len(plots) // columns)
    figure = new_figure((panel[0] * columns, panel[1] * rows))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for plot, axes in zip(plots, panels, strict=False):
        draw(plot, axes, legend=legends)
    for axes in panels[len(plots) :]:
        axes.remove()
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        entries |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if entries and not legends:
        style = {"loc": "outside upper center", "frameon": False, "ncols": _columns([*entries])}
        figure.legend(entries.values(), entries.keys(), **style)
    return figure


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


def _columns(labels: list[str]) -> int:
    """How many entries of a legend stand side by side."""
    return max(1, min(len(labels), _ROOM // (max(map(len, labels)) + 5)))


def _scale(axes: Any, which: str, axis: Axis, before: Sequence[float]) -> None:
    """Title, range and scale of an axis; with the labels of the chart where these are names, or not evenly spaced."""
    options = {"linear_width": 1.0} if axis.scale == "asinh" else {}
    getattr(axes, f"set_{which}scale")(axis.scale, **options)
    ends = (axis.low, axis.high) if not before else (min(axis.low, *before), max(axis.high, *before))
    axes.set(**{f"{which}label": axis.title, f"{which}lim": ends})
    if axis.named or axis.scale != "linear":
        slanted = {"rotation": 60, "ha": "right", "rotation_mode": "anchor"} if which == "x" and axis.slanted else {}
        size = {"fontsize": 7 if len(axis.ticks) > 16 else 9} if axis.named else {}
        shown = getattr(axes, f"{which}axis")
        shown.set_ticks([at for at, _ in axis.ticks], [words for _, words in axis.ticks], **slanted, **size)
        shown.set_ticks([], minor=True)


def _draw_marks(axes: Any, marks: Marks) -> None:
    """One series: its shades one by one, and after them what is said in words."""
    color, label = TONES.get(marks.tone, marks.tone), marks.name or None
    x, y = np.asarray(marks.x, dtype=float), np.asarray(marks.y, dtype=float)
    span: Any = None if marks.low is None else (np.asarray(marks.low), np.asarray(marks.high))
    if marks.symbol in ("level", "border"):
        across = {"level": axes.axhline, "border": axes.axvline}[marks.symbol]
        style = {"color": "0.4", "linewidth": 0.8, "zorder": 0, "linestyle": "-" if marks.symbol == "level" else "--"}
        for value in y if marks.symbol == "level" else x:
            across(value, **style)
    elif marks.symbol == "text":
        for place in zip(x, y, marks.words, strict=True):
            axes.text(*place, ha="center", va="center", color=color, fontsize=marks.size)
    elif marks.symbol == "band":
        axes.fill_between(x, *span, color=color, alpha=0.2, linewidth=0, label=label)
    elif marks.symbol == "bars":
        axes.vlines(x, *span, color=color, alpha=0.35, linewidth=marks.size, label=label)
    elif marks.symbol in _LINES:
        axes.plot(x, y, color=color, linestyle=_LINES[marks.symbol], linewidth=marks.size / 4, label=label)
    elif marks.symbol == "boxes":
        _draw_boxes(axes, marks, x, y, span)
    else:
        _draw_points(axes, marks, x, y, span)


def _draw_points(axes: Any, marks: Marks, x: np.ndarray, y: np.ndarray, span: tuple | None) -> None:
    style = {"marker": _MARKERS[marks.symbol], "markersize": 0.7 * marks.size, "linestyle": "none"}
    style |= {"markerfacecolor": "none"} if marks.symbol == "ring" else {}
    style |= {"linestyle": "-", "linewidth": marks.size / 4} if marks.joined else {}
    if marks.shade is not None:
        for i, color in enumerate(_SHADES):
            chosen = np.asarray(marks.shade) == i
            shaded = style | {"markersize": 0.7 * (marks.size + 1.6 * i), "markeredgecolor": "0.5"}
            label = marks.shade_names[i] if marks.limits else None
            axes.plot(x[chosen], y[chosen], color=color, label=label, markeredgewidth=0.4, **shaded)
    elif span is not None:
        bars = {"yerr": [y - span[0], span[1] - y], "capsize": 3, "elinewidth": 1.0}
        axes.errorbar(x, y, color=TONES.get(marks.tone, marks.tone), label=marks.name or None, **bars, **style)
    else:
        axes.plot(x, y, color=TONES.get(marks.tone, marks.tone), label=marks.name or None, **style)


def _draw_boxes(axes: Any, marks: Marks, x: np.ndarray, y: np.ndarray, span: tuple | None) -> None:
    width, height = marks.box
    color = TONES.get(marks.tone, marks.tone)
    if not height:
        errors = {} if span is None else {"yerr": [y - span[0], span[1] - y], "capsize": 3, "ecolor": "0.2"}
        axes.bar(x, y, width, color=color, label=marks.name or None, **errors)
        return
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    shade = np.zeros(len(x), dtype=int) if marks.shade is None else np.asarray(marks.shade)
    boxes = [Rectangle((a - width / 2, b - height / 2), width, height) for a, b in zip(x, y, strict=True)]
    faces = [_SHADES[i] for i in shade.tolist()]
    axes.add_collection(PatchCollection(boxes, facecolors=faces, edgecolors="white", linewidths=0.4))
    for i, name in enumerate(marks.shade_names):
        axes.plot([], [], "s", color=_SHADES[i], markersize=8, label=name)

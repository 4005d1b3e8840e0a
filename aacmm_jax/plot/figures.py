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

TONES = {"main": "#1b3a6b", "accent": "#d95f02", "soft": "0.65", "ink": "0.2", "page": "white", "bright": "#ff6a13"}
_SHADES = ("#dbe3ef", "#b3c2da", "#8aa0c3", "#6079a5", "#3a5586", "#14305f")
_MARKERS = {"dot": "o", "square": "s", "triangle": "^", "diamond": "D", "cross": "x", "ring": "o"}
_LINES = {"line": "-", "dashed": "--", "dotted": ":"}
_ROOM = 74  # characters side by side in a legend


def new_figure(size: tuple[float, float]) -> Any:
    """A figure outside matplotlib's global state, its size in inches; `MissingExtra` without matplotlib."""
    require("plot", "a figure")
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
    if plot.square or plot.image:
        axes.set_aspect("equal")
    handles, labels = axes.get_legend_handles_labels()
    if legend and labels:
        title = "\n".join(filter(None, (plot.title, *(marks.name for marks in plot.marks if marks.shade_names))))
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
    if suffix not in ("png", "svg", "pdf"):
        raise InputError(f"a figure cannot be written as {path}; use a file name that ends in .png, .svg or .pdf.")
    require("plot", "a figure")
    return suffix


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure into a file, whole or not at all, in the format that its name ends in."""
    file_format = check_format(path)
    with write_atomically(path) as temporary:
        figure.savefig(temporary, format=file_format, dpi=150)


def _columns(labels: list[str]) -> int:
    return max(1, min(len(labels), _ROOM // (max(map(len, labels)) + 5)))


def _scale(axes: Any, which: str, axis: Axis, before: Sequence[float]) -> None:
    """Title, range and scale of an axis; with the labels of the chart where these are names, or not evenly spaced."""
    getattr(axes, f"set_{which}scale")(axis.scale, **({"linear_width": 1.0} if axis.scale == "asinh" else {}))
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
    style = {"color": TONES.get(marks.tone, marks.tone), "label": marks.name or None}
    x, y = np.asarray(marks.x, dtype=float), np.asarray(marks.y, dtype=float)
    low, high = (None if ends is None else np.asarray(ends) for ends in (marks.low, marks.high))
    errors = {} if low is None or high is None else {"yerr": [y - low, high - y], "capsize": 3}
    if marks.symbol in ("level", "border"):
        across, values, line = {"level": (axes.axhline, y, "-"), "border": (axes.axvline, x, "--")}[marks.symbol]
        for value in values:
            across(value, color="0.4", linewidth=0.8, zorder=0, linestyle=line)
    elif marks.symbol == "text":
        for place in zip(x, y, marks.words, strict=True):
            axes.text(*place, ha="center", va="center", color=style["color"], fontsize=marks.size)
    elif marks.symbol == "band":
        axes.fill_between(x, low, high, alpha=0.2, linewidth=0, **style)
    elif marks.symbol == "bars":
        axes.vlines(x, low, high, alpha=0.35, linewidth=marks.size, **style)
    elif marks.symbol in _LINES:
        axes.plot(x, y, linestyle=_LINES[marks.symbol], linewidth=marks.size / 4, **style)
    elif marks.symbol == "boxes" and not marks.box[1]:
        axes.bar(x, y, marks.box[0], **style, **errors, **({"ecolor": "0.2"} if errors else {}))
    elif marks.symbol == "boxes":
        _draw_table(axes, marks, x, y)
    else:
        style |= {"marker": _MARKERS[marks.symbol], "markersize": 0.7 * marks.size, "linestyle": "none"}
        style |= {"markerfacecolor": "none"} if marks.symbol == "ring" else {}
        style |= {"linestyle": "-", "linewidth": marks.size / 4} if marks.joined else {}
        for i, color in enumerate(() if marks.shade is None else _SHADES):
            chosen = np.asarray(marks.shade) == i
            shaded = {"color": color, "label": marks.shade_names[i] or None if marks.shade_names else None}
            shaded |= {"markersize": 0.7 * (marks.size + 1.6 * i), "markeredgecolor": "0.5", "markeredgewidth": 0.4}
            axes.plot(x[chosen], y[chosen], **(style | shaded))
        if errors:
            axes.errorbar(x, y, elinewidth=1.0, **style, **errors)
        elif marks.shade is None:
            axes.plot(x, y, **style)


def _draw_table(axes: Any, marks: Marks, x: np.ndarray, y: np.ndarray) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    width, height = marks.box
    shade = np.zeros(len(x), dtype=int) if marks.shade is None else np.asarray(marks.shade)
    boxes = [Rectangle((a - width / 2, b - height / 2), width, height) for a, b in zip(x, y, strict=True)]
    faces = [_SHADES[i] for i in shade.tolist()]
    axes.add_collection(PatchCollection(boxes, facecolors=faces, edgecolors="white", linewidths=0.4))
    for i, name in enumerate(marks.shade_names):
        axes.plot([], [], "s", color=_SHADES[i], markersize=8, label=name)

"""Charts drawn as SVG inside HTML, which style and print with the page and need no script.

All marks of a series are one path in coordinates from 0 to 1000, stretched to the width of the page while its lines and
dots keep their size; text stands at percentages. Colours are those of the page's style, light or dark.
"""

import html
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from .charts import Axis, Marks, Plot

_CHARACTER = 6.6  # pixels: mean width of one in a label
_OVERLAP = 16  # pixels: least distance of labels of the vertical axis
_LINES = ("line", "dashed", "dotted")


def drawn(plot: Plot, label: str) -> str:
    """One plot: its axes and marks; ``label`` is the id of what describes it."""
    x, y = plot.x, plot.y
    left = 14 + _CHARACTER * max((len(text) for _, text in y.ticks), default=0)
    below = 20.0
    if x.slanted:
        longest = max((len(text) for _, text in x.ticks), default=0)
        below, left = 14 + 0.9 * _CHARACTER * longest, max(left, 12 + 0.5 * _CHARACTER * min(longest, 8))
    title, y_title, x_title = (
        f'<p class="{kind}">{_text(words)}</p>' if words else ""
        for kind, words in (("plot-title", plot.title), ("axis-title", y.title), ("axis-title below", x.title))
    )
    style = f"padding:6px 12px {below:.0f}px {left:.0f}px"
    ratio = ' square"' if plot.square else '"'
    # Lines across are below everything else.
    ordered = sorted(plot.marks, key=lambda marks: marks.symbol not in ("level", "border"))
    body = "".join((*_grid(plot), *(_marks(plot, marks) for marks in ordered), *_labels(plot)))
    return (
        f'<div class="plot">{title}{y_title}<div class="axes{ratio} style="{style}">'
        f'<svg role="img" aria-labelledby="{label}" style="--height:{plot.height}px">{body}</svg></div>'
        f"{x_title}</div>"
    )


def key(plots: Sequence[Plot]) -> list[tuple[str, str]]:
    """The glyph and the name of every shade, and of every named series where there are others."""
    shades = {
        name: _box(f"boxes s{i}") for plot in plots for marks in plot.marks for i, name in enumerate(marks.shade_names)
    }
    named = {marks.name: _glyph(marks) for plot in plots for marks in plot.marks if marks.name and not marks.limits}
    entries = shades | (named if shades or len(named) > 1 else {})
    return [(glyph, name) for name, glyph in entries.items()]


def points(plot: Plot) -> list[list]:
    """What is said of each mark: its position in thousandths of both axes, and the words."""
    said = []
    for marks in plot.marks:
        if len(marks.words) and marks.symbol != "text":
            places = zip(*_positions(plot, marks.x, marks.y), marks.words, strict=True)
            said += [
                [round(float(x)), round(float(y)), words]
                for x, y, words in places
                if words and np.isfinite(x) and np.isfinite(y)
            ]
    return said


def _text(words: object) -> str:
    return html.escape(str(words))


def _positions(plot: Plot, x: object, y: object) -> tuple[Any, Any]:
    return 1000 * plot.x.at(x), 1000 * (1 - plot.y.at(y))


def _number(value: float) -> str:
    return f"{value:.1f}".removesuffix(".0")


def _path(d: Iterable[str], kind: str, width: float | None = None) -> str:
    """A path in thousandths of the axes, whose lines keep their width."""
    stroke = "" if width is None else f' stroke-width="{width:g}"'
    return (
        '<svg viewBox="0 0 1000 1000" preserveAspectRatio="none" width="100%" height="100%">'
        f'<path class="{kind}" vector-effect="non-scaling-stroke"{stroke} d="{"".join(d)}"/></svg>'
    )


def _grid(plot: Plot) -> Iterable[str]:
    """Frame and grid; a table of boxes has no grid."""
    x, y = (1000 * axis.at([tick for tick, _ in axis.ticks]) for axis in (plot.x, plot.y))
    if not any(marks.symbol == "boxes" and marks.box[1] for marks in plot.marks):
        across = [] if plot.x.named else [f"M{_number(at)} 0V1000" for at in x]
        yield _path([*(f"M0 {_number(1000 - at)}H1000" for at in y), *across], "grid")
    yield _path(["M0 0V1000H1000"], "frame")


def _marks(plot: Plot, marks: Marks) -> str:
    if marks.symbol == "level":
        return _path([f"M0 {_number(y)}H1000" for y in 1000 * (1 - plot.y.at(marks.y))], "level")
    if marks.symbol == "border":
        return _path([f"M{_number(x)} 0V1000" for x in 1000 * plot.x.at(marks.x)], "separate") if len(marks.x) else ""
    tone = f"t-{marks.tone}"
    x, y = _positions(plot, marks.x, marks.y)
    if marks.symbol == "text":
        return "".join(
            f'<text x="{a / 10:.2f}%" y="{b / 10:.2f}%" dy="4" class="middle sign {tone}">{_text(words)}</text>'
            for a, b, words in zip(x, y, marks.words, strict=True)
        )
    if marks.low is None or marks.high is None:
        spans = ""
    elif marks.symbol == "band":
        return _band(plot, marks, tone)
    else:
        thick = marks.symbol == "bars"
        of_box = "bar t-ink" if marks.symbol == "boxes" else f"bar {tone}"
        spans = _spans(plot, marks, f"bars {tone}" if thick else of_box, marks.size if thick else None)
    line = _line(marks, x, y, tone) if marks.joined or marks.symbol in _LINES else ""
    if marks.symbol == "bars" or marks.symbol in _LINES:
        return spans + line
    if marks.symbol == "boxes":
        return "".join(_boxes(plot, marks, x, y, tone)) + spans
    return spans + line + "".join(_points(marks, x, y, tone))


def _line(marks: Marks, x: np.ndarray, y: np.ndarray, tone: str) -> str:
    """A line through the points, interrupted where there is none."""
    finite = np.isfinite(x) & np.isfinite(y)
    begins = [i == 0 or not finite[i - 1] for i in range(len(x))]
    d = [
        f"{'M' if new else 'L'}{_number(a)} {_number(b)}"
        for a, b, new, k in zip(x, y, begins, finite, strict=True)
        if k
    ]
    return _path(d, f"curve {tone}" + (f" {marks.symbol}" if marks.symbol in ("dashed", "dotted") else ""))


def _points(marks: Marks, x: np.ndarray, y: np.ndarray, tone: str) -> Iterable[str]:
    """Dots are lines without length, whose ends are round or square; in PDF, square ends need a direction."""
    finite = np.isfinite(x) & np.isfinite(y)
    if marks.symbol not in ("dot", "square"):
        for a, b in zip(x[finite], y[finite], strict=True):
            yield f'<use href="#{marks.symbol}" x="{a / 10:.2f}%" y="{b / 10:.2f}%" class="{tone}"/>'
        return
    length = "h0" if marks.symbol == "dot" else "h.1"
    shade = np.full(len(x), -1) if marks.shade is None else np.asarray(marks.shade)
    for i in np.unique(shade[finite]).tolist():
        chosen = finite & (shade == i)
        d = [f"M{_number(a)} {_number(b)}{length}" for a, b in zip(x[chosen], y[chosen], strict=True)]
        yield _path(d, f"{marks.symbol}s {tone if i < 0 else f's{i}'}", marks.size + 1.6 * max(i, 0))


def _ends(plot: Plot, marks: Marks) -> list[tuple[float, float, float]]:
    """Abscissa, lower and upper end of each bar, or of each place of a band."""
    x, low = _positions(plot, marks.x, marks.low)
    high = _positions(plot, marks.x, marks.high)[1]
    finite = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    return list(zip(x[finite], low[finite], high[finite], strict=True))


def _spans(plot: Plot, marks: Marks, kind: str, width: float | None) -> str:
    ends = ((x, *np.clip((low, high), 0, 1000)) for x, low, high in _ends(plot, marks))
    return _path([f"M{_number(x)} {_number(low)}V{_number(high)}" for x, low, high in ends], kind, width)


def _band(plot: Plot, marks: Marks, tone: str) -> str:
    ends = _ends(plot, marks)
    around = [(x, low) for x, low, _ in ends] + [(x, high) for x, _, high in reversed(ends)]
    if not around:
        return ""
    return _path(["M", "L".join(f"{_number(x)} {_number(y)}" for x, y in around), "Z"], f"band {tone}")


def _boxes(plot: Plot, marks: Marks, x: np.ndarray, y: np.ndarray, tone: str) -> Iterable[str]:
    width = 1000 * marks.box[0] / abs(plot.x.high - plot.x.low)
    height = 1000 - y
    if marks.box[1]:
        height = np.full(len(y), 1000 * marks.box[1] / abs(plot.y.high - plot.y.low))
        y = y - height / 2
    shade = np.full(len(x), -1) if marks.shade is None else np.asarray(marks.shade)
    for i in np.unique(shade).tolist():
        places = zip(x[shade == i] - width / 2, y[shade == i], height[shade == i], strict=True)
        size = _number(width)
        d = [f"M{_number(a)} {_number(b)}h{size}v{_number(c)}h-{size}z" for a, b, c in places if c > 0]
        yield _path(d, f"boxes {tone if i < 0 else f's{i}'}")


def _labels(plot: Plot) -> Iterable[str]:
    """Numbers and names along both axes."""
    for position, words in _apart(plot.y, plot.height):
        yield f'<text x="-7" y="{position:.2f}%" dy="4" class="end">{_text(words)}</text>'
    for tick, words in plot.x.ticks:
        position = 100 * float(plot.x.at(tick))
        if plot.x.slanted:
            text = f'<text class="end" transform="translate(4 12) rotate(-60)">{_text(words)}</text>'
            yield f'<svg x="{position:.2f}%" y="100%">{text}</svg>'
        else:
            yield f'<text x="{position:.2f}%" y="100%" dy="16" class="middle">{_text(words)}</text>'


def _apart(axis: Axis, height: int) -> list[tuple[float, str]]:
    """The labels of the vertical axis that have room, as percentages from above."""
    labels: list[tuple[float, str]] = []
    for tick, words in axis.ticks:
        position = 100 * (1 - float(axis.at(tick)))
        if not labels or abs(position - labels[-1][0]) * height / 100 >= _OVERLAP:
            labels.append((position, words))
    return labels


def _glyph(marks: Marks) -> str:
    tone = f"t-{marks.tone}"
    if marks.symbol in ("band", "bars", "boxes"):
        return _box(f"{'boxes' if marks.symbol == 'boxes' else 'band'} {tone}")
    if marks.symbol in _LINES:
        inside = f'<path class="curve {tone} {marks.symbol}" d="M1 7H21"/>'
    elif marks.symbol in ("dot", "square"):
        bar = f'<path class="bar {tone}" d="M11 0V14"/>' if marks.low is not None else ""
        inside = f'{bar}<path class="{marks.symbol}s {tone}" stroke-width="{max(marks.size, 6):g}" d="M11 7h.1"/>'
    else:
        inside = f'<use href="#{marks.symbol}" x="11" y="7" class="{tone}"/>'
    return f'<svg width="22" height="14" aria-hidden="true">{inside}</svg>'


def _box(kind: str) -> str:
    return f'<svg width="22" height="14" aria-hidden="true"><path class="{kind}" d="M3 1h16v12h-16z"/></svg>'

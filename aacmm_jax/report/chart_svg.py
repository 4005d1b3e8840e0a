"""Charts drawn as SVG inside HTML, which style and print with the page and need no script.

All marks of a series are one path in coordinates from 0 to 1000, stretched to the width of the page while its lines and
dots keep their size; text stands at percentages. Colours are those of the page's style, light or dark.
"""

import html
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from .charts import Axis, Marks, Plot

_CHARACTER = 6.6  # pixels: mean width of one in a label
_OVERLAP = 16  # pixels: least distance of labels of the vertical axis


def drawn(plot: Plot, label: str) -> str:
    """One plot: its axes and marks; ``label`` is the id of what describes it."""
    x, y = plot.x, plot.y
    left = 14 + _CHARACTER * max((len(text) for _, text in y.ticks), default=0)
    below = 20.0
    if x.slanted:
        longest = max((len(text) for _, text in x.ticks), default=0)
        below, left = 14 + 0.9 * _CHARACTER * longest, max(left, 12 + 0.5 * _CHARACTER * min(longest, 8))
    title = f'<p class="plot-title">{_text(plot.title)}</p>' if plot.title else ""
    y_title = f'<p class="axis-title">{_text(y.title)}</p>' if y.title else ""
    x_title = f'<p class="axis-title below">{_text(x.title)}</p>' if x.title else ""
    style = f"padding:6px 12px {below:.0f}px {left:.0f}px"
    ratio = ' square"' if plot.square else '"'
    body = "".join((*_lines(plot), *map(_marks, [plot] * len(plot.marks), plot.marks), *_labels(plot)))
    return (
        f'<div class="plot">{title}{y_title}<div class="axes{ratio} style="{style}">'
        f'<svg role="img" aria-labelledby="{label}" style="--height:{plot.height}px">{body}</svg></div>'
        f"{x_title}</div>"
    )


def key(plots: Sequence[Plot], least: int = 2) -> list[tuple[str, str]]:
    """The glyph and the name of every named series, where there are at least so many."""
    named = {marks.name: marks for plot in plots for marks in plot.marks if marks.name}
    return [(_glyph(marks), name) for name, marks in named.items()] if len(named) >= least else []


def points(plot: Plot) -> list[list]:
    """What is said of each mark: its position in thousandths of both axes, and the words."""
    found = []
    for marks in plot.marks:
        if not len(marks.hover):
            continue
        x, y = _positions(plot, marks.x, marks.y)
        found += [
            [round(float(a)), round(float(b)), words]
            for a, b, words in zip(x, y, marks.hover, strict=True)
            if words and np.isfinite(a) and np.isfinite(b)
        ]
    return found


def shade_key(limits: Sequence[float], unit: str) -> list[tuple[str, str]]:
    """The key of a sequential scale: each shade with its range."""
    step = 1.01 * max(min(np.diff(limits)), 1e-9)  # so that 0.0999 has the decimals of 0.1
    decimals = max(1 - int(np.floor(np.log10(step))), 0)
    words = [f"{low:.{decimals}f} to {high:.{decimals}f} {unit}".strip() for low, high in pairwise(limits)]
    if np.isinf(limits[-1]):
        words[-1] = f"over {limits[-2]:.{decimals}f} {unit}".strip()
    return [(_box(f"s{i}"), word) for i, word in enumerate(words)]


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


def _lines(plot: Plot) -> Iterable[str]:
    """Frame, grid, and the lines across."""
    x, y = (1000 * axis.at([tick for tick, _ in axis.ticks]) for axis in (plot.x, plot.y))
    boxes = any(marks.symbol == "boxes" and marks.box[1] for marks in plot.marks)
    if not boxes:
        grid = [f"M0 {_number(1000 - at)}H1000" for at in y]
        grid += [] if plot.x.named else [f"M{_number(at)} 0V1000" for at in x]
        yield _path(grid, "grid")
    yield _path(["M0 0V1000H1000"], "frame")
    across = [f"M{_number(1000 * float(plot.x.at(at)))} 0V1000" for at in plot.vertical]
    if across:
        yield _path(across, "separate")
    level = [f"M0 {_number(1000 - 1000 * float(plot.y.at(at)))}H1000" for at in plot.horizontal]
    if level:
        yield _path(level, "level")


def _marks(plot: Plot, marks: Marks) -> str:
    x, y = _positions(plot, marks.x, marks.y)
    known = np.isfinite(x) & np.isfinite(y)
    tone = f"t-{marks.tone}"
    found = []
    if marks.symbol == "band" and marks.low is not None and marks.high is not None:
        return _band(plot, marks, tone)
    if marks.symbol == "bars":
        return _bars(plot, marks, tone, "bars", marks.size)
    if marks.low is not None and marks.high is not None:
        found.append(_bars(plot, marks, tone))
    if marks.symbol in ("line", "dashed"):
        begins = [i == 0 or not known[i - 1] for i in range(len(x))]
        d = [
            f"{'M' if new else 'L'}{_number(a)} {_number(b)}"
            for a, b, new, k in zip(x, y, begins, known, strict=True)
            if k
        ]
        found.append(_path(d, f"curve {tone}{' dashed' if marks.symbol == 'dashed' else ''}"))
    elif marks.symbol in ("dot", "square"):
        found += _dots(marks, x, y, known, tone)
    elif marks.symbol == "boxes":
        found += _boxes(plot, marks, x, y, tone)
    else:
        places = zip(x[known], y[known], strict=True)
        found += [
            f'<use href="#{marks.symbol}" x="{a / 10:.2f}%" y="{b / 10:.2f}%" class="{tone}"/>' for a, b in places
        ]
    return "".join(found)


def _dots(marks: Marks, x: np.ndarray, y: np.ndarray, known: np.ndarray, tone: str) -> Iterable[str]:
    """Dots are lines without length, whose ends are round or square; in PDF, square ends need a direction."""
    length = "h0" if marks.symbol == "dot" else "h.1"
    shade = None if marks.shade is None else np.asarray(marks.shade)
    for i in (None,) if shade is None else np.unique(shade).tolist():
        mine = known if i is None else known & (shade == i)
        d = [f"M{_number(a)} {_number(b)}{length}" for a, b in zip(x[mine], y[mine], strict=True)]
        kind = f"{marks.symbol}s {tone if i is None else f's{i}'}"
        yield _path(d, kind, marks.size if i is None else marks.size + 1.6 * i)


def _bars(plot: Plot, marks: Marks, tone: str, kind: str = "bar", width: float | None = None) -> str:
    x, low = _positions(plot, marks.x, marks.low)
    high = _positions(plot, marks.x, marks.high)[1]
    known = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    ends = zip(x[known], np.clip(low[known], 0, 1000), np.clip(high[known], 0, 1000), strict=True)
    return _path([f"M{_number(a)} {_number(b)}V{_number(c)}" for a, b, c in ends], f"{kind} {tone}", width)


def _band(plot: Plot, marks: Marks, tone: str) -> str:
    x, low = _positions(plot, marks.x, marks.low)
    high = _positions(plot, marks.x, marks.high)[1]
    known = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    there = [*zip(x[known], low[known], strict=True), *reversed(list(zip(x[known], high[known], strict=True)))]
    if not there:
        return ""
    return _path(["M", "L".join(f"{_number(a)} {_number(b)}" for a, b in there), "Z"], f"band {tone}")


def _boxes(plot: Plot, marks: Marks, x: np.ndarray, y: np.ndarray, tone: str) -> Iterable[str]:
    width = 1000 * marks.box[0] / abs(plot.x.high - plot.x.low)
    if marks.box[1]:
        height = np.full(len(y), 1000 * marks.box[1] / abs(plot.y.high - plot.y.low))
        top = y - height / 2
    else:
        height, top = 1000 - y, y
    shade = np.full(len(x), -1) if marks.shade is None else np.asarray(marks.shade)
    for i in np.unique(shade).tolist():
        places = zip(x[shade == i] - width / 2, top[shade == i], height[shade == i], strict=True)
        size = _number(width)
        d = [f"M{_number(a)} {_number(b)}h{size}v{_number(c)}h-{size}z" for a, b, c in places if c > 0]
        yield _path(d, f"boxes {tone if i < 0 else f's{i}'}")


def _labels(plot: Plot) -> Iterable[str]:
    """Numbers and names along both axes, and what is written between them."""
    for position, words in _apart(plot.y, plot.height):
        yield f'<text x="-7" y="{position:.2f}%" dy="4" class="end">{_text(words)}</text>'
    for tick, words in plot.x.ticks:
        position = 100 * float(plot.x.at(tick))
        if plot.x.slanted:
            text = f'<text class="end" transform="translate(4 12) rotate(-60)">{_text(words)}</text>'
            yield f'<svg x="{position:.2f}%" y="100%">{text}</svg>'
        else:
            yield f'<text x="{position:.2f}%" y="100%" dy="16" class="middle">{_text(words)}</text>'
    for x, y, words in plot.written:
        a, b = (float(value) / 10 for value in _positions(plot, x, y))
        yield f'<text x="{a:.2f}%" y="{b:.2f}%" dy="4" class="middle sign">{_text(words)}</text>'


def _apart(axis: Axis, height: int) -> list[tuple[float, str]]:
    """The labels of the vertical axis that have room, as percentages from above."""
    found: list[tuple[float, str]] = []
    for tick, words in axis.ticks:
        position = 100 * (1 - float(axis.at(tick)))
        if not found or abs(position - found[-1][0]) * height / 100 >= _OVERLAP:
            found.append((position, words))
    return found


def _glyph(marks: Marks) -> str:
    tone = f"t-{marks.tone}"
    if marks.symbol in ("diamond", "cross"):
        inside = f'<use href="#{marks.symbol}" x="11" y="7" class="{tone}"/>'
    elif marks.symbol in ("line", "dashed"):
        inside = f'<path class="curve {tone}{" dashed" if marks.symbol == "dashed" else ""}" d="M1 7H21"/>'
    elif marks.symbol in ("band", "bars", "boxes"):
        return _box(f"{'boxes' if marks.symbol == 'boxes' else 'band'} {tone}")
    else:
        bar = f'<path class="bar {tone}" d="M11 0V14"/>' if marks.low is not None else ""
        inside = f'{bar}<path class="{marks.symbol}s {tone}" stroke-width="{max(marks.size, 6):g}" d="M11 7h.1"/>'
    return f'<svg width="22" height="14" aria-hidden="true">{inside}</svg>'


def _box(kind: str) -> str:
    fill = kind if " " in kind else f"boxes {kind}"
    return f'<svg width="22" height="14" aria-hidden="true"><path class="{fill}" d="M3 1h16v12h-16z"/></svg>'

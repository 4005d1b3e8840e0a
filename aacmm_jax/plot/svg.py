"""Charts drawn as SVG inside HTML, which style and print with the page and need no script.

All marks of a series are one path in coordinates from 0 to 1000, stretched to the width of the page while its lines and
dots keep their size; text stands at percentages. Colours are those of the page's style, light or dark.
"""

import html
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from .charts import Marks, Plot

_CHARACTER = 6.6  # pixels: mean width of one in a label
_OVERLAP = 16  # pixels: least distance of labels of the vertical axis
_WHOLE = 'preserveAspectRatio="none" width="100%" height="100%"'
_LONGEST = 20  # characters of a slanted name; the middle of longer ones is left out
_NARROW = 280  # pixels: axes on a telephone
_LINES = ("line", "dashed", "dotted")


def drawn(plot: Plot, label: str) -> str:
    """One plot: its axes and marks; ``label`` is the id of what describes it."""
    x, y = plot.x, plot.y
    left, below = 14 + _CHARACTER * max((len(text) for _, text in y.ticks), default=0), 20.0
    if x.slanted:  # by 60 degrees, to the left of their ticks
        names = [(len(_short(text)), float(x.at(tick))) for tick, text in x.ticks]
        below = 14 + 0.9 * _CHARACTER * max(length for length, _ in names)
        left = max(left, *(12 + 0.5 * _CHARACTER * length - _NARROW * at for length, at in names))
    title, y_title, x_title = (
        f'<p class="{kind}">{html.escape(words)}</p>' if words else ""
        for kind, words in (("plot-title", plot.title), ("axis-title", y.title), ("axis-title below", x.title))
    )
    style = f"padding:6px 12px {below:.0f}px {left:.0f}px"
    ratio = abs((x.high - x.low) / (y.high - y.low))
    size = f"--ratio:{ratio:.3f}" if plot.image else f"--height:{plot.height}px"
    kind = " square" if plot.square else " image" if plot.image else ""
    # Lines across are below everything else.
    ordered = sorted(plot.marks, key=lambda marks: marks.symbol not in ("level", "border"))
    picture = f'<image href="data:image/jpeg;base64,{html.escape(plot.picture)}" {_WHOLE}/>' if plot.picture else ""
    body = "".join(
        (picture, *_grid(plot), *(part for marks in ordered for part in _marks(plot, marks)), *_labels(plot))
    )
    return (
        f'<div class="plot">{title}{y_title}<div class="axes{kind}" style="{style}">'
        f'<svg role="img" aria-labelledby="{label}" style="{size}">{body}</svg></div>'
        f"{x_title}</div>"
    )


def key(plots: Sequence[Plot]) -> list[tuple[str, str]]:
    """The glyph and the name of every shade, and of every named series where there are others."""
    series = [marks for plot in plots for marks in plot.marks]
    shades = {words: box for marks in series for box, words in shade_keys(marks, "s")}
    named = {marks.name: _glyph(marks) for marks in series if marks.name and not marks.shade_names}
    entries = shades | (named if shades or len(named) > 1 else {})
    return [(glyph, name) for name, glyph in entries.items()]


def shade_keys(marks: Marks, name: str) -> list[tuple[str, str]]:
    """The box and the range of each shade of marks, by the name of their colours."""
    return [(_box(f"boxes {name}{i}"), words) for i, words in enumerate(marks.shade_names) if words]


def points(plot: Plot) -> list[list]:
    """What is said of each mark: its position in thousandths of both axes, and the words."""
    said = []
    for marks in plot.marks:
        if len(marks.words) and marks.symbol != "text":
            places = zip(*_positions(plot, marks.x, marks.y), marks.words, strict=True)
            said += [
                [round(float(x)), round(float(y)), words] for x, y, words in places if words and np.isfinite(x + y)
            ]
    return said


def _positions(plot: Plot, x: object, y: object) -> tuple[Any, Any]:
    return 1000 * plot.x.at(x), 1000 * (1 - plot.y.at(y))


def _number(value: float) -> str:
    return f"{value:.1f}".removesuffix(".0")


def _path(d: Iterable[str], kind: str, width: float | None = None) -> str:
    """A path in thousandths of the axes, whose lines keep their width."""
    stroke = "" if width is None else f' stroke-width="{width:g}"'
    return (
        f'<svg viewBox="0 0 1000 1000" {_WHOLE}>'
        f'<path class="{kind}" vector-effect="non-scaling-stroke"{stroke} d="{"".join(d)}"/></svg>'
    )


def _grid(plot: Plot) -> Iterator[str]:
    x, y = (1000 * axis.at([tick for tick, _ in axis.ticks]) for axis in (plot.x, plot.y))
    if not any(marks.symbol == "boxes" and marks.box[1] for marks in plot.marks):
        across = [] if plot.x.named else [f"M{_number(at)} 0V1000" for at in x]
        yield _path([*(f"M0 {_number(1000 - at)}H1000" for at in y), *across], "grid")
    yield _path(["M0 0V1000H1000"], "frame")


def _marks(plot: Plot, marks: Marks) -> Iterator[str]:
    """One series: bars and bands, lines, and points."""
    symbol, tone = marks.symbol, f"t-{marks.tone}"
    x, y = _positions(plot, marks.x if symbol != "level" else 0.0, marks.y if symbol != "border" else 1.0)
    if symbol == "level":
        yield _path([f"M0 {_number(at)}H1000" for at in y], "level")
    elif symbol == "border":
        yield _path([f"M{_number(at)} 0V1000" for at in x], "separate") if len(x) else ""
    elif symbol == "text":
        for a, b, words in zip(x, y, marks.words, strict=True):
            place = f'x="{a / 10:.2f}%" y="{b / 10:.2f}%" dy="4"'
            yield f'<text {place} class="middle sign {tone}">{html.escape(words)}</text>'
    elif symbol == "boxes":
        yield from _boxes(plot, marks, x, y)
    if marks.low is not None and marks.high is not None:
        yield _spans(plot, marks)
    finite = np.isfinite(x) & np.isfinite(y)
    if marks.joined or symbol in _LINES:
        # Interrupted where there is no point.
        begins = [i == 0 or not finite[i - 1] for i in range(len(x))]
        places = zip(x, y, begins, finite, strict=True)
        d = [f"{'M' if new else 'L'}{_number(a)} {_number(b)}" for a, b, new, there in places if there]
        yield _path(d, f"curve {tone}" + (f" {symbol}" if symbol in ("dashed", "dotted") else ""))
    if symbol in ("dot", "square"):
        # Dots are lines without length, whose ends are round or square; in PDF, square ends need a direction.
        length = "h0" if symbol == "dot" else "h.1"
        for i, chosen in _by_shade(marks, finite):
            d = [f"M{_number(a)} {_number(b)}{length}" for a, b in zip(x[chosen], y[chosen], strict=True)]
            yield _path(d, f"{symbol}s {tone if i < 0 else f's{i}'}", marks.size + 1.6 * max(i, 0))
    elif symbol in ("triangle", "diamond", "cross", "ring"):
        for a, b in zip(x[finite], y[finite], strict=True):
            yield f'<use href="#{symbol}" x="{a / 10:.2f}%" y="{b / 10:.2f}%" class="{tone}"/>'


def _by_shade(marks: Marks, among: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """The marks of each shade, -1 without any."""
    shade = np.full(len(among), -1) if marks.shade is None else np.asarray(marks.shade)
    for i in np.unique(shade[among]).tolist():
        yield i, among & (shade == i)


def _spans(plot: Plot, marks: Marks) -> str:
    x, low = _positions(plot, marks.x, marks.low)
    high = _positions(plot, marks.x, marks.high)[1]
    finite = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    ends = list(zip(x[finite], low[finite], high[finite], strict=True))
    tone, thick = f"t-{marks.tone}", marks.symbol == "bars"
    if marks.symbol == "band":
        around = [(a, b) for a, b, _ in ends] + [(a, b) for a, _, b in reversed(ends)]
        return (
            _path(["M", "L".join(f"{_number(a)} {_number(b)}" for a, b in around), "Z"], f"band {tone}") if ends else ""
        )
    kind = f"bars {tone}" if thick else "bar t-ink" if marks.symbol == "boxes" else f"bar {tone}"
    d = [f"M{_number(a)} {_number(b)}V{_number(c)}" for a, b, c in ((a, *np.clip(pair, 0, 1000)) for a, *pair in ends)]
    return _path(d, kind, marks.size if thick else None)


def _boxes(plot: Plot, marks: Marks, x: np.ndarray, y: np.ndarray) -> Iterator[str]:
    width = 1000 * marks.box[0] / abs(plot.x.high - plot.x.low)
    height = 1000 - y
    if marks.box[1]:
        height = np.full(len(y), 1000 * marks.box[1] / abs(plot.y.high - plot.y.low))
        y = y - height / 2
    for i, chosen in _by_shade(marks, np.ones(len(x), dtype=bool)):
        places, size = zip(x[chosen] - width / 2, y[chosen], height[chosen], strict=True), _number(width)
        d = [f"M{_number(a)} {_number(b)}h{size}v{_number(c)}h-{size}z" for a, b, c in places if c > 0]
        yield _path(d, f"boxes {f't-{marks.tone}' if i < 0 else f's{i}'}")


def _labels(plot: Plot) -> Iterator[str]:
    """Numbers and names along both axes; of the vertical one those that have room."""
    last = np.inf
    for tick, words in plot.y.ticks:
        position = 100 * (1 - float(plot.y.at(tick)))
        if abs(position - last) * plot.height / 100 >= _OVERLAP:
            last = position
            yield f'<text x="-7" y="{position:.2f}%" dy="4" class="end">{html.escape(words)}</text>'
    for tick, words in plot.x.ticks:
        position = f"{100 * float(plot.x.at(tick)):.2f}%"
        words = html.escape(_short(words) if plot.x.slanted else words)
        if plot.x.slanted:
            text = f'<text class="end" transform="translate(4 12) rotate(-60)">{words}</text>'
            yield f'<svg x="{position}" y="100%">{text}</svg>'
        else:
            yield f'<text x="{position}" y="100%" dy="16" class="middle">{words}</text>'


def _short(name: str) -> str:
    half = _LONGEST // 2
    return name if len(name) <= _LONGEST else f"{name[:half]}…{name[1 - half :]}"


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

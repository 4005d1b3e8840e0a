"""Charts as data: marks of a few symbols and tones on two axes, with a caption and the table of their numbers.

Each chart is described once: `svg` draws it into the page of a report, `figures` with matplotlib into a file. Symbols
and tones remain distinct in grey, and positions along an axis are fractions of it, so that one description fits every
width of a screen and of paper.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np

from ..summaries.tables import Table

Numbers = Sequence[float] | np.ndarray
SHADES = 6  # of a sequential colour scale, from little to much
# Series that remain distinct from each other.
SERIES: tuple[dict[str, Any], ...] = (
    {"symbol": "dot", "tone": "main"}, {"symbol": "square", "tone": "accent"}, {"symbol": "triangle", "tone": "ink"},
    {"symbol": "diamond", "tone": "main"}, {"symbol": "cross", "tone": "accent"}, {"symbol": "ring", "tone": "ink"},
    {"symbol": "square", "tone": "main"}, {"symbol": "triangle", "tone": "accent"},
)  # fmt: skip
_SCALES: dict[str, Any] = {"linear": np.asarray, "log": np.log10, "asinh": np.arcsinh}
_WITHIN = 0.98  # of the values have shades that divide their range evenly
_MOST_NAMES = 45  # along an axis; more would overlap
_MOST_TICKS = 6  # along an axis of numbers


class Marks(NamedTuple):
    """One series of a chart; numbers that are not finite are left out."""

    name: str  # in the key; empty: not in it; of shades: the title of the key
    x: Numbers
    y: Numbers
    # Points (dot, square, triangle, diamond, cross, ring); line, dashed, dotted; what is between low and high (band, or
    # thick vertical bars); boxes from the axis up to y, or about y; level and border: thin lines across at each y or x;
    # text: its words, centred.
    symbol: str = "dot"
    tone: str = "main"  # "main", "accent", "soft", "ink", "page"; "bright" on pictures; in figures any colour
    words: Sequence[str] = ()  # said of each mark under the pointer, or written
    low: Numbers | None = None  # ends of bars, or of a band
    high: Numbers | None = None
    size: float = 6.0  # pixels
    shade: Sequence[int] | np.ndarray | None = None  # of each mark or box, 0 to SHADES - 1, instead of the tone
    limits: tuple[float, ...] = ()  # of the shades, for the key
    unit: str = ""  # of the limits
    classes: tuple[str, ...] = ()  # names of the shades instead of limits; empty for a shade that is not used
    box: tuple[float, float] = (1.0, 0.0)  # width and height of boxes; height 0: from the axis up to y
    joined: bool = False  # points with a line through them

    @property
    def shade_names(self) -> list[str]:
        """The range of each shade in words, or its class."""
        if not self.limits:
            return [*self.classes]
        step = 1.01 * max(min(np.diff(self.limits)), 1e-9)  # so that 0.0999 has the decimals of 0.1
        whole = all(limit == round(limit) for limit in self.limits)
        decimals = 0 if whole else max(1 - int(np.floor(np.log10(step))), 0)
        return [f"{low:.{decimals}f} to {high:.{decimals}f} {self.unit}".strip() for low, high in pairwise(self.limits)]


class Axis(NamedTuple):
    """One axis: its range, and the positions that are labelled."""

    title: str
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...] = ()
    scale: Literal["linear", "log", "asinh"] = "linear"
    named: bool = False  # the labels are names, not numbers

    @property
    def slanted(self) -> bool:
        """Whether names have no room side by side."""
        return self.named and sum(len(words) + 2 for _, words in self.ticks) > 40

    def at(self, values: Any) -> Any:
        """Positions as fractions of the axis; NaN for what has none on a logarithmic one."""
        values = np.asarray(values, dtype=float)
        if self.scale == "log":
            values = np.where(values > 0, values, np.nan)
        low, high = _SCALES[self.scale]([self.low, self.high])
        return (_SCALES[self.scale](values) - low) / (high - low)


class Plot(NamedTuple):
    """One pair of axes with everything drawn in it."""

    x: Axis
    y: Axis
    marks: tuple[Marks, ...]
    title: str = ""
    height: int = 300  # pixels, of the axes
    square: bool = False  # both axes equally long
    image: bool = False  # an image plane: as wide and high as its numbers, on a page too
    picture: str = ""  # behind the marks, on a page only: JPEG, in base64


class Chart(NamedTuple):
    """One or several plots side by side, a description, and the table of their numbers."""

    id: str
    title: str
    description: str
    plots: tuple[Plot, ...]
    table: Table | None = None
    printed: bool = False  # whether the table is printed on paper as well


def level(*values: float) -> Marks:
    """Thin lines across at these ordinates."""
    return Marks("", (), values, "level", "soft")


def borders(values: Numbers) -> Marks:
    """Thin dotted lines across at these abscissas."""
    return Marks("", values, (), "border", "soft")


def histogram(counts: np.ndarray, edges: np.ndarray, name: str = "") -> Marks:
    """Boxes of counts between equally spaced edges."""
    width = float(edges[1] - edges[0])
    words = [f"{low:+.3g} to {low + width:+.3g}: {count}" for low, count in zip(edges, counts, strict=False)]
    return Marks(name, (edges[:-1] + edges[1:]) / 2, counts, "boxes", "soft", words, box=(width, 0.0))


def linear(title: str, *values: Any, zero: bool = False, margin: float = 0.06) -> Axis:
    """An axis around values, with round numbers; ``zero``: it begins at 0, for numbers that are not negative."""
    low, high = _range(values)
    if low == high:
        low, high = low - (abs(low) or 1.0) / 2, high + (abs(high) or 1.0) / 2
    space = margin * (high - low)
    low, high = (0.0 if zero else low - space), high + space
    return Axis(title, low, high, round_ticks(low, high))


def round_ticks(low: float, high: float) -> tuple[tuple[float, str], ...]:
    """A few round numbers between two, with as many decimals as they need."""
    raw = (high - low) / _MOST_TICKS
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(step for step in (1, 2, 5, 10) if step * power >= raw * (1 - 1e-9)) * power
    numbers = np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    decimals = max(-math.floor(math.log10(step) + 1e-9), 0)
    style = "g" if decimals > 5 or abs(high) >= 1e6 else f"z.{decimals}f"
    return tuple((float(n * step), f"{n * step:{style}}".replace("-", "−")) for n in numbers)


def logarithmic(title: str, *values: Any) -> Axis:
    """A logarithmic axis with plain numbers at every decade, and at 2 and 5 if there are few decades."""
    shown = _finite(values)
    shown = shown[shown > 0]
    low, high = (float(shown.min()) / 1.4, float(shown.max()) * 1.4) if len(shown) else (0.1, 1.0)
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1, 2, 5) if last - first <= 3 else (1,)
    every = max(1, (last - first) // 6)
    marks = (step * 10.0**power for power in range(first, last + 1, every) for step in steps)
    return Axis(title, low, high, tuple((mark, f"{mark:g}") for mark in marks if low <= mark <= high), "log")


def names(title: str, labels: Sequence[str]) -> Axis:
    """An axis of names at 0, 1, 2, ...; of very many, as many as have room."""
    every = -(-len(labels) // _MOST_NAMES)
    ticks = tuple((float(i), label) for i, label in enumerate(labels) if i % max(every, 1) == 0)
    return Axis(title, -0.6, len(labels) - 0.4, ticks, named=True)


def runs(words: Sequence[str], first: float = 0.0) -> tuple[tuple[tuple[float, str], ...], np.ndarray]:
    """Labels at the middle of each run of equal words at first, first + 1, ..., and the borders between the runs."""
    last = [i for i, word in enumerate(words) if i + 1 == len(words) or words[i + 1] != word]
    edges = first + 0.5 + np.array([-1, *last])
    middles = ((edges[:-1] + edges[1:]) / 2).tolist()
    return tuple((at, words[i]) for at, i in zip(middles, last, strict=True)), edges[1:-1]


def shades(values: Any, number: int = SHADES) -> tuple[np.ndarray, tuple[float, ...]]:
    """The shade of each value, and the limits between them, which divide the range of most values evenly: few that are
    much larger would leave the other shades unused, and share the last one."""
    values = np.asarray(values, dtype=float)
    low, high = _range((values,))
    most = float(np.quantile(values[np.isfinite(values)], _WITHIN)) if np.any(np.isfinite(values)) else high
    limits = np.append(np.linspace(low, most, number + 1)[:-1], high)
    shade = np.clip(np.digitize(np.nan_to_num(values, nan=low), limits[1:-1]), 0, number - 1)
    return shade, tuple(float(limit) for limit in limits)


def thinned(count: int, most: int) -> np.ndarray:
    """Indices of ``count`` things, or of ``most`` of them, evenly chosen."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _finite(values: Sequence[Any]) -> np.ndarray:
    shown = np.concatenate([np.asarray(part, dtype=float).ravel() for part in values] or [np.zeros(0)])
    return shown[np.isfinite(shown)]


def _range(values: Sequence[Any]) -> tuple[float, float]:
    shown = _finite(values)
    return (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)

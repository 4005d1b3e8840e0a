"""Charts of a report as data: marks of a few symbols and tones on two axes; `chart_svg` draws them.

Symbols and tones remain distinct in grey, and positions along an axis are fractions of it, so that one drawing fits
every width of a screen and of paper.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

Symbol = Literal["dot", "square", "diamond", "cross", "line", "dashed", "band", "bars", "boxes"]
Tone = Literal["main", "accent", "soft", "ink"]
SHADES = 6  # of a sequential colour scale, from little to much
_WITHIN = 0.98  # of the values have shades that divide their range evenly
_MOST_NAMES = 45  # along an axis; more would overlap


class Marks(NamedTuple):
    """One series of a chart; numbers that are not finite are left out."""

    name: str  # in the key; empty: not in it
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    symbol: Symbol = "dot"
    tone: Tone = "main"
    hover: Sequence[str] = ()  # said of each mark under the pointer
    low: Sequence[float] | np.ndarray | None = None  # ends of bars, or of a band
    high: Sequence[float] | np.ndarray | None = None
    size: float = 6.0  # pixels
    shade: Sequence[int] | np.ndarray | None = None  # of each mark or box, 0 to SHADES - 1, instead of the tone
    box: tuple[float, float] = (1.0, 0.0)  # width and height of boxes; height 0: from the axis up to y


class Axis(NamedTuple):
    """One axis: its range, and the positions that are labelled."""

    title: str
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    log: bool = False
    named: bool = False  # the labels are names, not numbers

    @property
    def slanted(self) -> bool:
        """Whether names have no room side by side."""
        return self.named and sum(len(words) + 2 for _, words in self.ticks) > 40

    def at(self, values: Any) -> Any:
        """Positions as fractions of the axis; NaN for what has none on a logarithmic one."""
        values, low, high = np.asarray(values, dtype=float), self.low, self.high
        if self.log:
            with np.errstate(invalid="ignore", divide="ignore"):
                values, low, high = np.log10(np.where(values > 0, values, np.nan)), math.log10(low), math.log10(high)
        return (values - low) / (high - low)


class Plot(NamedTuple):
    """One pair of axes with everything drawn in it."""

    x: Axis
    y: Axis
    marks: tuple[Marks, ...]
    vertical: Sequence[float] | np.ndarray = ()  # thin lines at these abscissas
    horizontal: Sequence[float] = ()
    title: str = ""
    written: Sequence[tuple[float, float, str]] = ()  # characters at positions
    height: int = 300  # pixels, of the axes
    square: bool = False  # both axes equally long


def linear(title: str, *values: Any, zero: bool = False, margin: float = 0.06) -> Axis:
    """An axis around values, with round numbers; ``zero``: it begins at 0, for numbers that are not negative."""
    low, high = _range(values)
    if low == high:
        low, high = low - (abs(low) or 1.0) / 2, high + (abs(high) or 1.0) / 2
    space = margin * (high - low)
    low, high = (0.0 if zero else low - space), high + space
    return Axis(title, low, high, round_ticks(low, high))


def round_ticks(low: float, high: float, most: int = 6) -> tuple[tuple[float, str], ...]:
    """At most ``most`` round numbers between two, with as many decimals as they need."""
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(step for step in (1, 2, 5, 10) if step * power >= raw * (1 - 1e-9)) * power
    numbers = np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    decimals = max(-math.floor(math.log10(step) + 1e-9), 0)
    if decimals > 5 or abs(high) >= 1e6:
        return tuple((float(n * step), f"{n * step:g}".replace("-", "−")) for n in numbers)
    return tuple((float(n * step), f"{n * step:z.{decimals}f}".replace("-", "−")) for n in numbers)


def logarithmic(title: str, *values: Any) -> Axis:
    """A logarithmic axis with plain numbers at every decade, and at 2 and 5 if there are few decades."""
    shown = np.concatenate([np.asarray(part, dtype=float).ravel() for part in values] or [np.zeros(0)])
    shown = shown[np.isfinite(shown) & (shown > 0)]
    low, high = (float(shown.min()) / 1.4, float(shown.max()) * 1.4) if len(shown) else (0.1, 1.0)
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1, 2, 5) if last - first <= 3 else (1,)
    every = max(1, (last - first) // 6)
    marks = (step * 10.0**power for power in range(first, last + 1, every) for step in steps)
    return Axis(title, low, high, tuple((mark, f"{mark:g}") for mark in marks if low <= mark <= high), log=True)


def names(title: str, labels: Sequence[str]) -> Axis:
    """An axis of names at 0, 1, 2, ...; of very many, as many as have room."""
    every = -(-len(labels) // _MOST_NAMES)
    ticks = tuple((float(i), label) for i, label in enumerate(labels) if i % max(every, 1) == 0)
    return Axis(title, -0.6, len(labels) - 0.4, ticks, named=True)


def shades(values: Any, number: int = SHADES) -> tuple[np.ndarray, tuple[float, ...]]:
    """The shade of each value, and the limits between them, which divide the range of most values evenly: few that are
    much larger would leave the other shades unused, and share the last one."""
    values = np.asarray(values, dtype=float)
    low, high = _range((values,))
    most = float(np.quantile(values[np.isfinite(values)], _WITHIN)) if np.any(np.isfinite(values)) else high
    limits = np.append(np.linspace(low, most, number + 1)[:-1], high)
    shade = np.clip(np.digitize(np.nan_to_num(values, nan=low), limits[1:-1]), 0, number - 1)
    return shade, tuple(float(limit) for limit in limits)


def correlations(parameters: Sequence[str], table: np.ndarray) -> Plot:
    """Correlations by their size, with the sign written where it is at least 0.5."""
    strength, count = np.abs(np.asarray(table, dtype=float)), len(parameters)
    rows, columns = np.nonzero(strength > 0.05)
    shade = np.minimum((strength[rows, columns] * SHADES).astype(int), SHADES - 1)
    said = strength[rows, columns] >= 0.3
    hover = [
        f"{parameters[i]} with {parameters[j]}: {table[i, j]:+.3f}".replace("-", "−") if known and i != j else ""
        for i, j, known in zip(rows.tolist(), columns.tolist(), said, strict=True)
    ]
    boxes = Marks("", columns, rows, "boxes", hover=hover, shade=shade, box=(1.0, 1.0))
    signs = [(float(j), float(i), "+" if table[i, j] > 0 else "−") for i, j in np.argwhere(strength >= 0.5) if i != j]
    x = names("", parameters)
    y = Axis("", count - 0.5, -0.5, x.ticks, named=True)
    return Plot(x._replace(low=-0.5, high=count - 0.5), y, (boxes,), written=signs, height=560, square=True)


def _range(values: Sequence[Any]) -> tuple[float, float]:
    shown = np.concatenate([np.asarray(part, dtype=float).ravel() for part in values] or [np.zeros(0)])
    shown = shown[np.isfinite(shown)]
    return (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)

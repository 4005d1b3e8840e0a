"""Charts of a report, as plain dictionaries for Plotly; shapes and shades remain distinct in grey."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .elements import escaped

DARK, WARM, LIGHT = "#1b3a6b", "#c8560a", "#9aa3ad"
_FONT = {"family": "system-ui, sans-serif", "size": 13, "color": "#1a1a1a"}


def layout(x: str, y: str, **more: Any) -> dict[str, Any]:
    """Layout with titled axes and narrow margins, so that it fits a narrow screen."""
    axis = {
        "showgrid": True,
        "gridcolor": "#dde2e8",
        "zeroline": False,
        "linecolor": "#555",
        "ticks": "outside",
        "automargin": True,
    }
    found: dict[str, Any] = {
        "xaxis": axis | {"title": {"text": x, "standoff": 8}},
        "yaxis": axis | {"title": {"text": y, "standoff": 6}},
        "margin": {"l": 10, "r": 10, "t": 36, "b": 10},
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "xanchor": "left"},
        "font": _FONT,
        "paper_bgcolor": "#fff",
        "plot_bgcolor": "#fff",
        "hovermode": "closest",
    }
    for key, value in more.items():
        found[key] = found[key] | value if isinstance(found.get(key), dict) else value
    return found


def markers(
    name: str,
    x: Any,
    y: Any,
    color: str,
    symbol: str,
    *,
    hover: Sequence[str] = (),
    bars: Any = None,
    size: int = 7,
    **more: Any,
) -> dict[str, Any]:
    """Markers, perhaps with error bars."""
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": list(x),
        "y": _numbers(y),
        "marker": {"color": color, "symbol": symbol, "size": size, "line": {"width": 1, "color": color}},
    }
    if len(hover):
        trace |= {"text": [escaped(line) for line in hover], "hoverinfo": "text"}
    if bars is not None:
        trace["error_y"] = {"type": "data", "array": _numbers(bars), "color": color, "thickness": 1.2, "width": 4}
    return trace | more


def logarithmic(*values: Any) -> dict[str, Any]:
    """A logarithmic axis with plain numbers at every decade, and at 2 and 5 if there are few decades."""
    shown = np.concatenate([np.asarray(part, dtype=float).ravel() for part in values])
    shown = shown[np.isfinite(shown) & (shown > 0)]
    low, high = (float(shown.min()), float(shown.max())) if len(shown) else (0.1, 1.0)
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    steps = (1, 2, 5) if last - first <= 3 else (1,)
    marks = [step * 10.0**power for power in range(first, last + 1) for step in steps]
    return {
        "type": "log",
        "tickvals": marks,
        "ticktext": [f"{mark:g}" for mark in marks],
        "range": [float(np.log10(low / 1.4)), float(np.log10(high * 1.4))],
    }


def vertical(positions: Sequence[float]) -> list[dict[str, Any]]:
    """Thin vertical lines over the whole height."""
    line = {"color": "#777", "width": 1, "dash": "dot"}
    return [
        {"type": "line", "xref": "x", "yref": "paper", "x0": x, "x1": x, "y0": 0, "y1": 1, "line": line}
        for x in positions
    ]


def horizontal(positions: Sequence[float], dash: str = "dash") -> list[dict[str, Any]]:
    """Thin horizontal lines over the whole width."""
    line = {"color": "#444", "width": 1, "dash": dash}
    return [
        {"type": "line", "xref": "paper", "yref": "y", "x0": 0, "x1": 1, "y0": y, "y1": y, "line": line}
        for y in positions
    ]


def correlation_heatmap(names: Sequence[str], table: np.ndarray) -> list[dict[str, Any]]:
    """Correlations: darker is stronger, with the sign written where it is at least 0.5."""
    strength = np.abs(table)
    written = [
        ["" if i == j or strength[i, j] < 0.5 else ("+" if table[i, j] > 0 else "−") for j in range(len(names))]
        for i in range(len(names))
    ]
    hover = [
        [f"{escaped(one)} with {escaped(other)}: {table[i, j]:+.3f}" for j, other in enumerate(names)]
        for i, one in enumerate(names)
    ]
    labels = [escaped(name) for name in names]
    return [
        {
            "type": "heatmap",
            "x": labels,
            "y": labels,
            "z": [_numbers(row) for row in strength],
            "zmin": 0,
            "zmax": 1,
            "colorscale": [[0, "#ffffff"], [0.5, "#b9c4d6"], [1, "#1b3a6b"]],
            "text": written,
            "texttemplate": "%{text}",
            "customdata": hover,
            "hovertemplate": "%{customdata}<extra></extra>",
            "colorbar": {"title": {"text": "|r|"}, "thickness": 12, "len": 0.8},
            "xgap": 1,
            "ygap": 1,
        }
    ]


def _numbers(values: Any) -> list[float | None]:
    """Numbers for JSON, which has no infinity."""
    return [float(f"{value:.7g}") if np.isfinite(value) else None for value in np.asarray(values, dtype=float)]

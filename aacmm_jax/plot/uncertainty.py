"""Figures of uncertainty and observability: over the working volume, correlations, singular values."""

from typing import Any

import numpy as np

from ..core.errors import InputError
from ..summaries.tables import two_digits
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.identifiability import Observability
from ..uncertainty.volume import VolumetricUncertainty
from .style import ACCENT, DARK, axes_or_new, label_axes, logarithmic

_MANY = 25  # parameters of which correlations are drawn larger
_WITHIN = 0.98  # of the lengths are within the colour scale; the others have its last colour


def volumetric_uncertainty_map(volume: VolumetricUncertainty, axes: Any = None) -> Any:
    """Plot U (95 %) of lengths over the working volume: larger and darker marks are more uncertain.

    Each length is marked at the height and the distance from the first axis where it starts.

    Args:
        volume: The result of `volumetric_uncertainty`.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If no length has a finite uncertainty.

    Example:
        >>> volume = aj.volumetric_uncertainty(aj.uncertainty_of(result), points=20)
        >>> axes = aj.plot.volumetric_uncertainty_map(volume)
        >>> print(axes.get_xlabel())
        distance from the first axis [mm]
    """
    axes = axes_or_new(axes)
    expanded = volume.expanded_length
    known = np.isfinite(expanded)
    if not np.any(known):
        raise InputError("no length over the volume is determined, so there is no uncertainty to draw.")
    start, expanded = volume.start[known], expanded[known]
    # Few places that are much worse than all others would leave the rest of the scale unused.
    low, high = float(expanded.min()), float(np.quantile(expanded, _WITHIN))
    size = 8 + 60 * np.clip((expanded - low) / max(high - low, 1e-12), 0, 1) ** 2
    style = {"cmap": "Blues", "vmin": low, "vmax": high, "edgecolors": "0.4", "linewidths": 0.4}
    marks = axes.scatter(np.hypot(start[:, 0], start[:, 1]), start[:, 2], s=size, c=expanded, **style)
    beyond = "max" if high < expanded.max() else "neither"
    label = f"U of a {volume.length:g} mm length [mm], at most {two_digits(float(expanded.max()))}"
    axes.figure.colorbar(marks, ax=axes, label=label, extend=beyond)
    label_axes(axes, "distance from the first axis [mm]", "height [mm]")
    return axes


def correlation_matrix(uncertainty: Uncertainty, axes: Any = None) -> Any:
    """Plot the correlations of the parameters: darker is stronger, with the sign written where it is at least 0.5.

    Of more than 45 parameters, those that are correlated most are drawn.

    Args:
        uncertainty: Uncertainty of a calibrated arm (`uncertainty_of`).
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Example:
        >>> axes = aj.plot.correlation_matrix(aj.uncertainty_of(result))
        >>> print(len(axes.get_xticklabels()), "parameters")
        21 parameters
    """
    table, names, chosen = np.asarray(uncertainty.correlation), uncertainty.names, uncertainty.most_correlated()
    axes = axes_or_new(axes, (6.8, 5.8) if len(chosen) <= _MANY else (9.0, 7.8))
    if len(chosen) < len(names):
        axes.set_title(f"the {len(chosen)} parameters of {len(names)} that are correlated most", fontsize=9)
    table, names = table[np.ix_(chosen, chosen)], [names[i] for i in chosen]
    image = axes.imshow(np.abs(table), cmap="Blues", vmin=0, vmax=1)
    axes.set_xticks(np.arange(len(names)), names, rotation=90, fontsize=7)
    axes.set_yticks(np.arange(len(names)), names, fontsize=7)
    size = 10 if len(chosen) <= _MANY else 7
    for i, j in np.argwhere(np.abs(table) >= 0.5):
        if i != j:
            color = "w" if abs(table[i, j]) > 0.7 else "k"
            axes.text(j, i, "+" if table[i, j] > 0 else "-", ha="center", va="center", color=color, fontsize=size)
    axes.figure.colorbar(image, ax=axes, label="|r|", shrink=0.8)
    return axes


def singular_values(observed: Observability, axes: Any = None) -> Any:
    """Plot the singular values of the identification Jacobian, in steps of 1 mm and 1 mrad; zero ones are crosses.

    Args:
        observed: The result of `observability`.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Example:
        >>> axes = aj.plot.singular_values(aj.observability(arm, capture, space))
        >>> print(axes.get_ylabel())
        singular value
    """
    axes = axes_or_new(axes)
    values = np.maximum(observed.singular, 1e-12 * observed.singular.max())
    numbers, rank = np.arange(1, len(values) + 1), observed.rank
    axes.plot(numbers[:rank], values[:rank], "o", color=DARK, label="determined")
    if rank < len(values):
        axes.plot(numbers[rank:], values[rank:], "x", color=ACCENT, label="not determined")
        axes.legend(frameon=False)
    logarithmic(axes)
    axes.xaxis.get_major_locator().set_params(integer=True)
    label_axes(axes, "number", "singular value")
    return axes

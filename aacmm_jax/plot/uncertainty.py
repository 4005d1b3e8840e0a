"""Uncertainty and observability: over the working volume, correlations, singular values; where poses were tried."""

from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.units import DEG
from ..diagnostics.joint_travel import TriedPoses
from ..summaries.tables import decimals_for, format_number
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.identifiability import Observability
from ..uncertainty.volume import VolumetricUncertainty
from .charts import SHADES, Axis, Chart, Marks, Plot, linear, logarithmic, names, shades, thinned
from .figures import draw

_ACROSS, _UP = "distance from the first axis [mm]", "height [mm]"
_TIPS = 400  # most tips of the calibration that are drawn
_LEAST = 1e-12  # of the largest singular value: a zero on a logarithmic axis
_SAID, _SIGNED = 0.3, 0.5  # correlations from which they are said under the pointer, and their sign is written


def volume_chart(volume: VolumetricUncertainty) -> Chart:
    """U of lengths over the working volume: half a section through it."""
    finite = np.isfinite(volume.expanded_length)
    expanded, start = volume.expanded_length[finite], volume.start[finite]
    shade, limits = shades(expanded)
    order = np.argsort(shade, kind="stable")
    words = [
        f"({', '.join(f'{x:.0f}' for x in point)}) mm: U = {format_number(u, decimals_for(u))} mm"
        for point, u in zip(start[order], expanded[order].tolist(), strict=True)
    ]
    radius = np.hypot(start[:, 0], start[:, 1])
    shaded = {"shade": shade[order], "limits": limits if np.any(finite) else (), "unit": "mm"}
    name = f"U of a {volume.length:g} mm length"
    marks = Marks(name, radius[order], start[order, 2], words=words, **shaded)
    axes = linear(_ACROSS, np.hypot(volume.start[:, 0], volume.start[:, 1]), [0.0]), linear(_UP, volume.start[:, 2])
    return Chart(
        "volume",
        f"{name} over the volume",
        "The larger the mark, the more uncertain; height against distance from the first axis.",
        (Plot(*axes, (marks,), height=380),),
    )


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
    if not np.any(np.isfinite(volume.expanded_length)):
        raise InputError("no length over the volume is determined, so there is no uncertainty to draw.")
    return draw(volume_chart(volume).plots[0], axes)


def tried_chart(volume: VolumetricUncertainty, tips: np.ndarray, poses: TriedPoses) -> Chart:
    """Half a section through the volume: random poses by their distance from the nearest calibrated one, and the tips
    of the calibration, mm."""
    ratio = poses.distance / max(poses.spacing, 1e-12)
    shade, limits = tried_shades(ratio)
    order = np.argsort(shade, kind="stable")
    radius, height = np.hypot(volume.start[:, 0], volume.start[:, 1]), volume.start[:, 2]
    words = [
        f"({', '.join(f'{x:.0f}' for x in volume.start[i])}) mm: {poses.distance[i] / DEG:.0f} deg from the nearest "
        f"pose, {ratio[i]:.1f} times their spacing"
        for i in order
    ]
    tips = tips[thinned(len(tips), _TIPS)]
    across = np.hypot(tips[:, 0], tips[:, 1])
    marks = (
        Marks("", radius[order], height[order], words=words, shade=shade[order], limits=limits, size=5),
        Marks("tips of the calibration", across, tips[:, 2], "square", "accent", size=4),
    )
    plot = Plot(linear(_ACROSS, radius, across, [0.0]), linear(_UP, height, tips[:, 2]), marks, height=380)
    description = (
        "Random poses all over the volume by their distance in joint space from the nearest pose of the calibration, "
        "in multiples of the spacing of its own poses: up to 1 it was tried there; the larger the mark, the less."
    )
    return Chart("tried", "Coverage of the working volume", description, (plot,))


def tried_shades(ratio: np.ndarray) -> tuple[np.ndarray, tuple[float, ...]]:
    """The shade of each multiple of the spacing: the first ends at 1, the others divide what is beyond."""
    beyond = ratio > 1.0
    if np.all(beyond) or not np.any(beyond):
        return shades(ratio)
    shade = np.zeros(len(ratio), dtype=int)
    shade_beyond, limits = shades(ratio[beyond], SHADES - 1)
    shade[beyond] = shade_beyond + 1
    return shade, (0.0, 1.0, *limits[1:])


def correlation_plot(labels: list[str], table: np.ndarray, title: str = "") -> Plot:
    """Correlations by their size, with the sign written where it is at least 0.5."""
    strength, count = np.abs(np.asarray(table, dtype=float)), len(labels)
    rows, columns = np.nonzero(strength > 0.05)
    shade = np.minimum((strength[rows, columns] * SHADES).astype(int), SHADES - 1)
    words = [
        f"{labels[i]} with {labels[j]}: {table[i, j]:+.3f}".replace("-", "−")
        if strength[i, j] >= _SAID and i != j
        else ""
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
    ]
    limits = tuple(i / SHADES for i in range(SHADES + 1))
    boxes = Marks("|r|", columns, rows, "boxes", words=words, shade=shade, limits=limits, box=(1.0, 1.0))
    signed = [(j, i) for i, j in np.argwhere(strength >= _SIGNED) if i != j]
    signs = Marks("", [j for j, _ in signed], [i for _, i in signed], "text", "page",
                  ["+" if table[i, j] > 0 else "−" for j, i in signed], size=10 if count <= 25 else 6)  # fmt: skip
    x = names("", labels)._replace(low=-0.5, high=count - 0.5)
    y = Axis("", count - 0.5, -0.5, x.ticks, named=True)
    return Plot(x, y, (boxes, signs), title=title, height=560, square=True)


def correlation_chart(uncertainty: Uncertainty) -> Chart:
    """Correlations of the parameters; of very many, of those that are correlated most."""
    labels, chosen = list(uncertainty.names), uncertainty.most_correlated()
    most = f"the {len(chosen)} parameters of {len(labels)} that are correlated most"
    description = (
        "The colour is the size of the correlation; its sign is written from 0.5 on. Strongly correlated "
        "parameters are determined better in combination than one by one."
    )
    part = np.asarray(uncertainty.correlation)[np.ix_(chosen, chosen)]
    few = len(chosen) < len(labels)
    plot = correlation_plot([labels[i] for i in chosen], part, most if few else "")
    return Chart("correlations", "Correlation of the parameters", description, (plot,))


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
    return draw(correlation_chart(uncertainty).plots[0], axes, (7.4, 7.6))


def singular_chart(observed: Observability) -> Chart:
    """Singular values of the identification Jacobian; zero ones are crosses at the least that the axis shows."""
    values, rank = np.maximum(observed.singular, _LEAST * observed.singular.max()), observed.rank
    order = np.arange(1, len(values) + 1)
    words = [f"{i}: {value:.3g}" for i, value in zip(order, observed.singular.tolist(), strict=True)]
    marks = [Marks("determined", order[:rank], values[:rank], words=words[:rank])]
    if rank < len(values):
        marks.append(Marks("not determined", order[rank:], values[rank:], "cross", "accent", words[rank:]))
    axes = linear("number", order), logarithmic("singular value", values)
    return Chart(
        "singular",
        "Singular values",
        "Sensitivity of the data to each independent direction of the parameters, in steps of 1 mm and 1 mrad.",
        (Plot(*axes, tuple(marks), height=240),),
    )


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
    return draw(singular_chart(observed).plots[0], axes)

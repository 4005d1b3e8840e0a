"""The figure of patterns in the residuals of a calibration."""

from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.errors import InputError
from ..core.units import DEG
from ..diagnostics.pose_residuals import signed_residuals
from ..kinematics.arm import by_joint
from .style import ACCENT, DARK, LIGHT, new_figure

_COLUMNS = 4
_BINS = 8  # of which the mean is drawn


def residual_patterns(record: CalibrationRecord) -> Any:
    """Plot the residuals with their sign, mm: along what each joint does to the tip against its reading, and along x, y
    and z in the order of the poses; and their histogram, in standard deviations.

    Noise scatters evenly about zero; the means of neighbouring poses, with twice their standard errors, show what the
    model lacks: a wave is an eccentric encoder or a bending link, a slope a wrong gear ratio, a step something that
    moved.

    Args:
        record: The calibration.

    Returns:
        The figure.

    Raises:
        InputError: If no pose has a residual with a direction.

    Example:
        >>> figure = aj.plot.residual_patterns(record)
        >>> figure.savefig("residuals.svg")
    """
    found = signed_residuals(record)
    if found is None:
        raise InputError("no pose has a residual with a direction, as no socket has several poses; record more poses.")
    q = np.asarray(record.recording.capture.readings)[found.poses]
    order = np.arange(1, len(found.poses) + 1)
    drawn = [
        *(
            (q[:, i] / unit, found.along_joint[:, i], f"joint {i + 1}", f"reading [{name}]")
            for i, (unit, name) in enumerate(by_joint(record.calibrated.arm, (DEG, "deg"), (1.0, "mm")))
        ),
        *(
            (order, found.vector[:, i], f"along {name}, in the order of the poses", "pose")
            for i, name in enumerate("xyz")
        ),
    ]
    rows = -(-(len(drawn) + 1) // _COLUMNS)
    figure = new_figure((3.1 * _COLUMNS, 2.5 * rows))
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    values = np.concatenate([y[np.isfinite(y)] for _, y, *_ in drawn])
    limit = 1.1 * float(np.quantile(np.abs(values), 0.995)) or 1.0
    for panel, (x, y, title, x_title) in zip(panels, drawn, strict=False):
        _panel(panel, x, np.clip(y, -limit, limit))
        panel.set(ylim=(-limit, limit), xlabel=x_title)
        panel.set_title(title, fontsize=9)
    for panel in panels[: len(drawn) : _COLUMNS]:
        panel.set_ylabel("residual [mm]")
    _histogram(panels[len(drawn)], found.normalised[np.isfinite(found.normalised)])
    for panel in panels[len(drawn) + 1 :]:
        panel.remove()
    return figure


def _panel(panel: Any, x: np.ndarray, y: np.ndarray) -> None:
    known = np.isfinite(y)
    x, y = x[known], y[known]
    panel.axhline(0, color="0.4", linewidth=0.8)
    panel.plot(x, y, linestyle="none", marker=".", markersize=3, color=LIGHT)
    if len(x) < 3 * _BINS:
        return
    parts = np.array_split(np.argsort(x, kind="stable"), _BINS)
    mean = [y[part].mean() for part in parts]
    twice = [2 * y[part].std(ddof=1) / np.sqrt(len(part)) for part in parts]
    panel.errorbar(
        [x[part].mean() for part in parts], mean, yerr=twice, color=DARK, marker="o", markersize=3, capsize=2
    )


def _histogram(panel: Any, values: np.ndarray) -> None:
    edges = np.linspace(-4.5, 4.5, 31)
    panel.hist(np.clip(values, edges[0], edges[-1]), bins=edges, color="0.75", edgecolor="0.5", linewidth=0.4)
    normal = len(values) * (edges[1] - edges[0]) * np.exp(-(edges**2) / 2) / np.sqrt(2 * np.pi)
    panel.plot(edges, normal, color=ACCENT)
    panel.set_title("histogram, and the normal distribution", fontsize=9)
    panel.set_xlabel("residual [standard deviations]")

"""The figure of acceptance tests."""

from collections.abc import Sequence
from typing import Any

from ..acceptance.results import AcceptanceTest
from ..core.errors import InputError
from .style import DARK, axes_or_new, label_axes


def acceptance_metrics(tests: Sequence[AcceptanceTest], axes: Any = None) -> Any:
    """Plot the worst value of every metric that has a limit, divided by the limit, with its expanded uncertainty.

    Where a decision takes the uncertainty into account, a metric conforms whose bar lies below 1.

    Args:
        tests: Acceptance tests of one arm (`acceptance.run`).
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If no metric has a limit.

    Example:
        >>> measured = aj.acceptance.measured_by(result.arm, aj.Recording(two_bars, nominal))
        >>> tests = aj.acceptance.run(measured, limits={"SPAT": 0.1, "Length": 0.05})
        >>> axes = aj.plot.acceptance_metrics(tests)
        >>> axes.figure.savefig("acceptance.svg")
    """
    metrics = [metric for test in tests for metric in test.metrics if metric.worst.limit]
    if not metrics:
        raise InputError("no metric has a limit to be drawn against; give limits to accept.")
    axes = axes_or_new(axes)
    limits = [metric.worst.limit or 1.0 for metric in metrics]
    ratios = [abs(metric.value) / limit for metric, limit in zip(metrics, limits, strict=True)]
    bars = [metric.worst.expanded / limit for metric, limit in zip(metrics, limits, strict=True)]
    axes.errorbar(range(len(metrics)), ratios, yerr=bars, fmt="s", color=DARK, capsize=4)
    axes.axhline(1, color="0.2", linewidth=1)
    axes.set_xticks(range(len(metrics)), [f"{metric.name}\n{metric.decision}" for metric in metrics])
    axes.set_xlim(-0.6, len(metrics) - 0.4)
    axes.set_ylim(0, max(1.2, 1.1 * max(ratio + bar for ratio, bar in zip(ratios, bars, strict=True))))
    label_axes(axes, "", "|value| / MPE")
    return axes

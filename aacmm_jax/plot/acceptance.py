"""Metrics of acceptance tests against their limits."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..acceptance.results import AcceptanceTest
from ..core.errors import InputError
from ..summaries.tables import format_number
from .charts import Chart, Marks, Plot, level, linear, names
from .figures import draw

_LEAST = 1e-6  # mm: drawn for a limit of zero


def metrics_chart(tests: Sequence[AcceptanceTest]) -> Chart:
    """The worst value of every metric with U, divided by its limit if limits were given."""
    metrics = [metric for test in tests for metric in test.metrics]
    limited = [metric for metric in metrics if metric.worst.limit is not None]
    if limited:
        metrics, y, lines = limited, "|value| / MPE", [1.0]
        divisors = [max(metric.worst.limit or 0.0, _LEAST) for metric in metrics]
        title = "Metrics against their limits"
        description = (
            "The value of each metric, divided by its limit, with U. The decisions are in the tables: they follow the "
            "rule stated above, whose guard band may be less than U."
        )
    else:
        y, lines, divisors = "|value| [mm]", [], [1.0] * len(metrics)
        title, description = "Metrics", "The value of each metric, with U. No limit was given."
    values = np.array([abs(metric.value) / divisor for metric, divisor in zip(metrics, divisors, strict=True)])
    bars = np.array([metric.worst.expanded / divisor for metric, divisor in zip(metrics, divisors, strict=True)])
    words = [f"{metric.name}: {format_number(metric.value)} mm at {metric.worst.where}" for metric in metrics]
    labels = [f"{metric.name}: {metric.decision}" if metric.decision else metric.name for metric in metrics]
    # An absolute value is not negative, so a bar that is longer than its value ends at 0.
    low, high = np.maximum(values - bars, 0.0), values + bars
    marks = Marks("", np.arange(len(metrics)), values, "square", "main", words, low, high, size=8)
    axes = names("", labels), linear(y, high, lines, [0.0], zero=True)
    return Chart("margins", title, description, (Plot(*axes, (marks, level(*lines)), height=240),))


def acceptance_metrics(tests: Sequence[AcceptanceTest], axes: Any = None) -> Any:
    """Plot the worst value of every metric that has a limit, divided by the limit, with its expanded uncertainty.

    The decision beside each name follows its rule, whose guard band may be less than the bar.

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
    if not any(metric.worst.limit for test in tests for metric in test.metrics):
        raise InputError("no metric has a limit to be drawn against; give limits to accept.")
    return draw(metrics_chart(tests).plots[0], axes)

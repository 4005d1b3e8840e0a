"""JJF 1408-2013 as Cheng et al. 2018 use it: Deltam of sockets, and deviations of lengths."""

import numpy as np

from ..core.arrays import Numbers
from .judgement import Influences
from .lengths import deviation_metrics, length_readings
from .requirements import CALIBRATED, CONDITIONS, Requirement, StandardTest, of_bars
from .results import Measured, Metric, metric_value
from .spheres import points_of
from .standards import JJF_1408

_SOCKET_POSES = 10  # of one socket, for a complete test
_LENGTH_POSITIONS = 30  # of a length: Cheng et al. 2018, section 4.4
_PAPER = "Cheng et al. 2018, section 4"


def half_range(points: Numbers) -> float:
    """Deltam: the largest over the axes of (max - min) / 2.

    Source: Cheng et al. 2018, equations 11 and 12.

    Args:
        points: Points ``(m, 3)`` of one socket, mm.

    Returns:
        Deltam, mm.

    Raises:
        InputError: ``points`` has another shape, or no rows.

    Example:
        >>> print(aj.acceptance.half_range([[0.0, 0.0, 0.0], [0.02, 0.01, 0.0], [0.01, 0.0, 0.03]]))
        0.015
    """
    return float(np.ptp(points_of(points, "points of a socket"), axis=0).max() / 2)


def _metrics(measured: Measured, influences: Influences) -> list[Metric]:
    """Deltam in every socket, and the deviations of lengths (Cheng et al. 2018, section 4, after reference 17)."""
    sockets = {name: points for name, points in measured.tested.items() if len(points) > 1}
    deltam = tuple(metric_value(name, half_range(points), influences.u) for name, points in sockets.items())
    readings = length_readings(measured, influences)
    return [
        Metric("Deltam", deltam),
        *deviation_metrics(readings, influences, ("Length", "Length_Range", "Length_2RMS")),
    ]


def _socket_lacking(measured: Measured) -> str:
    if any(len(points) >= _SOCKET_POSES for points in measured.tested.values()):
        return ""
    return f"A socket measured in {_SOCKET_POSES} poses or more is required."


TESTS = (
    StandardTest(
        JJF_1408,
        "single point and length, as in Cheng et al. 2018",
        _metrics,
        (
            Requirement(
                "a socket in 10 poses or more; the paper's Table 3 has 70",
                _PAPER,
                "own reading",
                _socket_lacking,
            ),
            of_bars("positions", _LENGTH_POSITIONS, (f"{_PAPER}: a length measured 30 times", "own reading")),
            CALIBRATED,
            CONDITIONS,
        ),
    ),
)

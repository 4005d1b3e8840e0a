"""JJF 1408-2013 as Cheng et al. 2018 use it: Deltam of sockets, and deviations of lengths."""

import numpy as np

from ..core.arrays import Numbers
from .lengths import deviation_metrics, distinct_lengths, length_readings
from .results import AcceptanceTest, Measured, Metric, acceptance_test, metric_value
from .spheres import points_of
from .standards import JJF_1408

_SOCKET_POSES = 10  # of one socket, for a complete test
_LENGTH_POSITIONS = 30  # of a length: Cheng et al. 2018, section 4.4


def half_range(points: Numbers) -> float:
    """Deltam: the largest over the axes of (max - min) / 2.

    Source: Cheng et al. 2018, equations 11 and 12.

    Args:
        points: Points ``(m, 3)`` of one socket, mm.

    Returns:
        Deltam, mm.

    Raises:
        InputError: ``points`` has another shape, or no rows.
    """
    return float(np.ptp(points_of(points, "points of a socket"), axis=0).max() / 2)


def single_point_and_length(measured: Measured, u_test: float = 0.0) -> AcceptanceTest | None:
    """Deltam in every socket, and the deviations of lengths (section 4 of Cheng et al. 2018, after their reference 17).

    The paper's verification measures a length in 30 positions; its Table 3 gives Deltam of 70 poses.
    """
    sockets = {name: points for name, points in measured.tested.items() if len(points) > 1}
    deltam = tuple(metric_value(name, half_range(points), u_test) for name, points in sockets.items())
    lengths = deviation_metrics(length_readings(measured), u_test, ("Length", "Length_Range", "Length_2RMS"))
    missing = []
    if not any(len(points) >= _SOCKET_POSES for points in sockets.values()):
        missing.append(f"a socket measured in {_SOCKET_POSES} poses or more")
    positions = len(distinct_lengths(measured.lengths))
    if positions < _LENGTH_POSITIONS:
        missing.append(f"a length in {_LENGTH_POSITIONS} positions ({positions} given)")
    title = "single point and length, as in Cheng et al. 2018"
    return acceptance_test(JJF_1408, title, [Metric("Deltam", deltam), *lengths], missing)

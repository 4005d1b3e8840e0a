"""The day by which an arm is to be calibrated again, as far as its calibrations until now say (ILAC-G24, OIML D 10)."""

import datetime
import math
from collections.abc import Sequence
from typing import NamedTuple

_YEAR = datetime.timedelta(days=365.25)
_LEAST = datetime.timedelta(days=1)  # between the first and the last calibration: less shows no trend


class Due(NamedTuple):
    """When lengths will have changed by a limit since the last calibration, at the rate seen until now.

    Example:
        >>> import datetime
        >>> due = aj.drift.next_due([datetime.datetime(2025 + i, 3, 1) for i in range(2)], [0.010], limit=0.1)
        >>> print(f"{due.date:%Y-%m-%d}", due.capped)
        2027-03-01 True
    """

    date: datetime.datetime
    rate: float  # root mean square change of lengths, mm a year
    limit: float  # mm
    capped: bool  # whether the limit is so far away that the time over which the arm was observed decides


def next_due(dates: Sequence[datetime.datetime], changes: Sequence[float], limit: float) -> Due | None:
    """The day by which the next calibration is due; None if the dates or changes do not show it.

    The rate is that of a line through the first calibration, fitted to the changes. These contain the uncertainty of
    both calibrations, which counts as drift, so that the day is rather too early. It is no farther from the last
    calibration than this is from the first: nothing is known of a longer time.

    Args:
        dates: Dates of the calibrations, the first and later ones.
        changes: Root mean square change of lengths from the first calibration to each later one, mm.
        limit: Change that is allowed, mm.

    Example:
        >>> import datetime
        >>> year = [datetime.datetime(2025 + i, 3, 1) for i in range(3)]
        >>> due = aj.drift.next_due(year, [0.010, 0.020], limit=0.005)
        >>> print(f"{due.date:%Y-%m-%d}, {1000 * due.rate:.0f} um a year")
        2027-08-30, 10 um a year
    """
    first, last = dates[0], dates[-1]
    years = [(date - first) / _YEAR for date in dates[1:]]
    known = [(time, change) for time, change in zip(years, changes, strict=True) if math.isfinite(change)]
    if last - first < _LEAST or not known or not limit > 0:
        return None
    rate = sum(time * change for time, change in known) / sum(time**2 for time, _ in known)
    span = (last - first) / _YEAR
    left = limit / rate if rate > 0 else math.inf
    return Due(last + min(left, span) * _YEAR, rate, limit, left > span)

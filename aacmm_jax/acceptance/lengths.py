"""Lengths as single readings: their deviations from the calibrated values, and the metrics of these."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError
from ..data.capture import ReferenceLength
from .judgement import Influences
from .results import Measured, Metric, MetricValue, metric_value

_SAME_ARTEFACT = 0.01  # lengths that differ by less (relative) belong to one artefact


class LengthReading(NamedTuple):
    """One reading of a length, mm."""

    where: str
    deviation: float
    u: float
    length: float

    def as_value(self, influences: Influences) -> MetricValue:
        """The deviation at 20 C, with the uncertainties of the artefact and of the test."""
        return metric_value(self.where, self.deviation, self.u, influences.u_of(self.length))._replace(
            length=self.length
        )


def length_readings(measured: Measured, influences: Influences) -> list[LengthReading]:
    """Every length as single readings: the i-th point at one end with the i-th at the other; thermal expansion of
    artefact and arm, where it is stated, is corrected."""
    readings = []
    for length in measured.lengths:
        start, end = (measured.sockets[name] for name in (length.start, length.end))
        pairs = min(len(start), len(end))
        value = float(length.value)
        deviations = np.linalg.norm(end[:pairs] - start[:pairs], axis=1) - value + influences.correction(value)
        for number, deviation in enumerate(deviations, start=1):
            where = f"{length.start} - {length.end}" + (f", reading {number}" if pairs > 1 else "")
            readings.append(LengthReading(where, float(deviation), float(length.u), value))
    return readings


def deviation_metrics(
    readings: Sequence[LengthReading], influences: Influences, names: tuple[str, str, str]
) -> tuple[Metric, ...]:
    """Largest deviation, range and twice the RMS; only the first of a single reading.

    The calibration error is common to lengths of one artefact and independent between artefacts, and nothing states
    which lengths share one. So U of the range takes the errors as independent, and U of the RMS as fully correlated (by
    the Cauchy-Schwarz inequality it cannot be larger).
    """
    largest = Metric(names[0], tuple(reading.as_value(influences) for reading in readings))
    if len(readings) < 2:
        return (largest,)
    deviations = np.array([reading.deviation for reading in readings])
    u = np.array([reading.u for reading in readings])
    low, high = readings[int(deviations.argmin())], readings[int(deviations.argmax())]
    test = np.array([influences.u_of(reading.length) for reading in readings])
    ends = (low.u, high.u, test[int(deviations.argmin())], test[int(deviations.argmax())])
    span = metric_value(f"{low.where} to {high.where}", high.deviation - low.deviation, *ends)
    rms_u = (2 * float(np.sqrt(np.mean(part**2))) for part in (u, test))
    rms = metric_value(f"{len(readings)} readings", two_rms(deviations), *rms_u)
    return largest, Metric(names[1], (span,)), Metric(names[2], (rms,))


def two_rms(deviations: Numbers) -> float:
    """Twice the root mean square of deviations from calibrated values.

    Source: ASME B89.4.22-2004, volumetric test, stated from background knowledge; Cheng et al. 2018, section 4.4.

    Args:
        deviations: Deviations of any shape, mm.

    Returns:
        Twice the root mean square, mm.

    Raises:
        InputError: There are no deviations.

    Example:
        >>> print(f"{aj.acceptance.two_rms([0.01, -0.02, 0.005]):.4f} mm")
        0.0265 mm
    """
    given = np.asarray(as_floats(deviations, "deviations"))
    if not given.size:
        raise InputError("there are no deviations, so they have no root mean square; measure some.")
    return 2 * math.sqrt(float(np.mean(given**2)))


def distinct_lengths(lengths: Sequence[ReferenceLength]) -> list[ReferenceLength]:
    """One length for each pair of sockets."""
    return list({frozenset((length.start, length.end)): length for length in lengths}.values())


def values_by_artefact(lengths: Sequence[ReferenceLength]) -> list[Float[np.ndarray, " k"]]:
    """Calibrated values in ascending order, those of one artefact in one array."""
    values = np.sort([float(length.value) for length in lengths])
    if not len(values):
        return []
    return np.split(values, np.flatnonzero(np.diff(values) > _SAME_ARTEFACT * values[1:]) + 1)

"""By which factor the lengths of a calibrated arm differ from nominal.

An instrument, artefact or reference length whose scale is wrong leaves no residual, but all lengths of the arm follow.

With the free lengths x, of covariance C by the calibration, and their nominal values n, x - n = f n + d: the deviations
d that manufacture leaves are independent, with a variance that restricted maximum likelihood estimates with the factor
f. So arms whose lengths differ much from nominal tell little of a scale, and links of which the drawing says 0 count as
well: they have deviations, but no part in f.
"""

from typing import NamedTuple

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.distributions import student_tail
from ..kinematics.arm import is_length, value_of

_FEWEST = 5  # lengths
KEPT = 2e-3  # of all lengths together: what a maker, and the temperature of the arm, keep
_LEAST, _MOST, _TRIED = 1e-3, 30.0, 60  # mm: standard deviations of manufacture that are compared


class Size(NamedTuple):
    """All lengths of an arm, over nominal."""

    factor: float  # less 1
    u: float
    probability: float  # of a factor as far beyond what a maker keeps


def size_of(record: CalibrationRecord) -> Size | None:
    """The common factor of the free lengths of a calibrated arm; None where there are too few."""
    nominal, slides = record.recording.nominal.arm, record.calibrated.arm.prismatic
    number = [
        i
        for i, name in enumerate(record.names)
        # The probe and the zero of a slide depend on what is mounted; those left undetermined, on their start.
        if is_length(name) and name[0] in "ad" and record.determined[i] and int(name[2:]) not in slides
    ]
    lengths = np.array([float(value_of(nominal, record.names[i])) for i in number], dtype=float)
    if len(number) < _FEWEST or not np.any(lengths):
        return None
    changes = np.array([float(value_of(record.calibrated.arm, record.names[i])) for i in number], dtype=float) - lengths
    covariance = np.asarray(record.covariance)[np.ix_(number, number)]
    best: tuple[float, float, float] | None = None
    for deviation in np.geomspace(_LEAST, _MOST, _TRIED):
        values, vectors = np.linalg.eigh(covariance + deviation**2 * np.eye(len(number)))
        white = vectors / np.sqrt(np.maximum(values, 1e-300))
        n, x = lengths @ white, changes @ white
        information = float(n @ n)
        factor = float(n @ x) / information
        cost = float(np.sum(np.log(values))) + np.log(information) + float(np.sum((x - factor * n) ** 2))
        if best is None or cost < best[0]:
            best = cost, factor, information**-0.5
    if best is None:
        return None
    _, factor, u = best
    beyond = max(abs(factor) - KEPT, 0.0) / u
    return Size(factor, u, float(student_tail(np.array([beyond]), np.array([len(number) - 1.0]))[0]))


def u_of_size(record: CalibrationRecord) -> float:
    """Relative standard uncertainty with which a calibration knows all lengths of the arm together."""
    number = [i for i, name in enumerate(record.names) if is_length(name)]
    lengths = np.array([float(value_of(record.calibrated.arm, record.names[i])) for i in number])
    square = float(lengths @ lengths)
    variance = float(lengths @ np.asarray(record.covariance)[np.ix_(number, number)] @ lengths)
    return float(np.sqrt(max(variance, 0.0))) / square if square else 0.0

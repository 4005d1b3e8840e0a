"""Errors of places that few reference lengths cannot exclude, where they decide how large U is."""

import numpy as np

from ..calibration.record import uncertainty_of
from ..core.random_keys import random_generator
from ..uncertainty.shared_kinds import PLACES
from .findings import Case, Finding

ORDER, NEEDS = 68, "fit"
_WIDER = 1.5  # times U without them, from which a sentence says so
_PAIRS = 100  # of poses


def test(case: Case) -> list[Finding]:
    """U of lengths between poses of the calibration, with errors of places and without, where the two differ much."""
    uncertainty = uncertainty_of(case.record)
    components, q = uncertainty.components, np.asarray(case.record.recording.capture.readings)
    if components is None or PLACES not in components.names:
        return []
    start, end = random_generator(0).integers(len(q), size=(2, _PAIRS))
    tips = np.asarray(uncertainty.arm.position(q))
    apart = np.linalg.norm(tips[end] - tips[start], axis=1)
    apart = apart > np.max(apart) / 2  # not two poses of one socket
    parts = np.array(uncertainty.length_parts(q[start[apart]], q[end[apart]]))
    stated = float(np.median(uncertainty.expanded_by_parts(parts)))
    parts[:, 1 + components.names.index(PLACES)] = 0.0
    without = float(np.median(uncertainty.expanded_by_parts(parts)))
    if not stated > _WIDER * without:
        return []
    lengths = len(case.record.recording.capture.lengths)
    return [
        Finding(
            "errors-of-places",
            f"U is {stated / without:.1f} times as large because of errors that all poses of a socket may share, as "
            f"far as {lengths} reference lengths show them: U of a length from one pose to another far from "
            f"it (not of 300 mm; without the noise of both readings) is {stated:.2g} mm with such errors, and "
            f"{without:.2g} mm without them.",
            advice="Measure the reference length in further placements.",
        )
    ]

"""Poses that are far from their socket, beside what is typical."""

import numpy as np

from ..core.text import shorten
from ..model.sockets import pose_outliers
from .findings import Case, Finding

ORDER, NEEDS = 90, "scale"


def test(case: Case) -> list[Finding]:
    """The finding, of a calibration from sockets alone: robust losses list the poses of all observations."""
    capture = case.record.recording.capture
    if capture.observations:
        return []
    distances, owner = np.asarray(case.record.evaluations()["calibrated"].distances), capture.owner
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    far, typical = pose_outliers(distances, capture.sizes)
    if not len(far):
        return []
    worst = sorted(far, key=lambda i: -distances[i])
    poses = [f"{capture.names[owner[i]]} pose {i - first[owner[i]] + 1}" for i in worst]
    texts = [f"{pose} ({distances[i]:.3g} mm)" for pose, i in zip(poses, worst, strict=True)]
    return [
        Finding(
            "outlying-poses",
            f"Poses far from their socket, where {typical:.2g} mm is typical: {shorten(texts)}.",
            advice="Was the tip seated?",
            concerns=tuple(poses),
        )
    ]

"""What a camera cannot tell: a place along rotations about one axis, a focal length without tilt; and its noise."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.rotations import rotation_vector
from ..core.text import listed
from ..data.observations.pixels import Pixels
from ..uncertainty.linearisation import ObservationRows
from .equations import linearisation_of
from .findings import Case, Finding, rounded

ORDER, NEEDS = 25, "nothing"
_LEAST_TURN = 0.05  # rad, across the axis about which poses turn most: with less, places along this axis are open
_FOCAL_U = 0.02  # relative standard uncertainty of a focal length from which it is worth a sentence
_SCATTER = (0.7, 1.4)  # ratios of the scatter of corners to what was stated, between which nothing is said
_FEWEST = 50  # equations that show the scatter


def test(case: Case) -> list[Finding]:
    """Of every camera of a calibration."""
    record = case.record
    cameras = [one for one in record.recording.capture.observations if isinstance(one, Pixels)]
    if not cameras:
        return []
    parts = linearisation_of(record, record.names, noise=record.given_noise).parts()
    rows = {part.observation.name: part for part in parts}
    findings: list[Finding] = []
    for camera in cameras:
        turns = np.asarray(record.calibrated.arm.pose(np.asarray(camera.q)))[:, :3, :3]
        u = _u_of_intrinsics(camera, record.observed)
        found = (
            _parallel(camera, turns),
            _focal(camera, u),
            _undetermined(camera, u),
            _scatter(camera, rows[camera.name]),
        )
        findings += [finding for finding in found if finding is not None]
    return findings


def _parallel(camera: Pixels, turns: Float[np.ndarray, "m 3 3"]) -> Finding | None:
    """Poses that differ by rotations about one axis."""
    between = np.array([rotation_vector(turns[0].T @ turn) for turn in turns])
    sizes = np.linalg.svd(between, compute_uv=False) / np.sqrt(len(turns))
    if len(sizes) > 1 and sizes[1] >= _LEAST_TURN:
        return None
    return Finding(
        "parallel-rotations",
        f"The poses of '{camera.name}' turn '{camera.target}' about parallel axes only.",
        f"The position of '{camera.target}' along these axes cannot be told apart from that of '{camera.still}'.",
        "Add poses in which it is tilted in other directions.",
        severity="doubt",
        doubt="rotations about parallel axes",
        concerns=(camera.name,),
    )


def _u_of_intrinsics(camera: Pixels, metrics: Any) -> dict[str, float]:
    """Standard uncertainties of those that are not exact; NaN where the images do not determine one."""
    return {
        camera.camera_model.names[i]: float(np.sqrt(metrics.geometry_covariance[part][place, place]))
        for part, places in camera.optical.items()
        for place, i in enumerate(places)
    }


def _undetermined(camera: Pixels, u_of: Mapping[str, float]) -> Finding | None:
    """Intrinsics that imitate each other in these images."""
    names = [name for name, u in u_of.items() if not np.isfinite(u)]
    if not names:
        return None
    also = "; all others have their own U" if len(names) < len(u_of) else ", since all of them imitate each other"
    return Finding(
        "intrinsics-undetermined",
        f"The images of '{camera.name}' do not determine {listed(names)} of '{camera.camera}' one by one{also}.",
        "Only what they do to the corners together is determined.",
        "Calibrate fewer distortion coefficients, state some of them, or let the target appear near the edges of the "
        "image and at several tilts.",
        concerns=(camera.name,),
    )


def _focal(camera: Pixels, u_of: Mapping[str, float]) -> Finding | None:
    """A focal length that the images do not show."""
    u = u_of.get("fx", 0.0) / float(camera.intrinsics[0]) if u_of else 0.0
    if u < _FOCAL_U:
        return None
    known = f"to {100 * float(rounded(u)):g} % only" if np.isfinite(u) else "not at all"
    return Finding(
        "focal-length",
        f"The images of '{camera.name}' show the focal length {known}.",
        "A flat target that is seen head-on looks the same from farther away with a longer focal length, and the "
        "place of the camera is as uncertain.",
        "Tilt the target by 30 degrees and more, in several directions and at several distances, or state intrinsics.",
        concerns=(camera.name,),
    )


def _scatter(camera: Pixels, part: ObservationRows) -> Finding | None:
    """Corners that scatter more or less than was stated."""
    counts = camera.equations
    assert counts is not None
    count = int(counts[-1].sum())
    if count < _FEWEST:
        return None
    ratio = float(np.sqrt(np.sum(np.asarray(part.white)[-1] ** 2) / count))
    if _SCATTER[0] < ratio < _SCATTER[1] or not np.isfinite(ratio):
        return None
    stated, unit = float(np.mean(np.asarray(camera.u)[camera.seen])), camera.camera_model.unit
    more = ratio > 1
    return Finding(
        "corner-noise",
        f"Within each image, the corners of '{camera.name}' scatter by {rounded(ratio * stated)} {unit}, but "
        f"u = {rounded(stated)} {unit} is stated.",
        "The stated uncertainties are too small." if more else "The stated uncertainties are too large.",
        "State this u, or leave it out to take it from the corners"
        + ("; check target, focus and the number of distortion coefficients." if more else "."),
        severity="doubt" if more else "note",
        doubt="corners scatter more than stated" if more else "",
        concerns=(camera.name,),
    )

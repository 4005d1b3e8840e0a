"""What a camera cannot tell is said, and not of a camera that can."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data.observations.pixels import Pixels

from ..calibration.test_cameras import EXACT, NONE_FREE, TRUE, seen


def codes(capture):
    result = aj.calibrate(TRUE, capture, NONE_FREE)
    return {finding.code for finding in aj.diagnostics.findings_of(result, capture)}


def one_axis(eye):
    """With the last joint alone, about the line of sight."""
    q = np.array(eye.q)
    q[:, :5] = q[0, :5]
    return eye.changed(q=q)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "change", "code"),
    [
        ({"u_intrinsics": np.inf}, None, None),
        ({"tilt": 0.3, "poses": 6, "u_intrinsics": np.inf, "distance": (370, 430), "u": 3.0}, None, "focal-length"),
        ({}, one_axis, "parallel-rotations"),
        ({}, lambda eye: eye.changed(u=0.3 * eye.u), "corner-noise"),
        ({}, lambda eye: eye.changed(u=3 * eye.u), "corner-noise"),
    ],
    ids=["sound", "head-on", "one axis", "u too small", "u too large"],
)
def test_limits_of_cameras(options, change, code):
    capture = aj.simulate(TRUE, {}, observations=[seen(**options)], noise=EXACT, seed=3)
    (eye,) = capture.observations
    assert isinstance(eye, Pixels)
    if change is not None:
        capture = aj.Capture({}, observations=[change(eye)])
    found = codes(capture) & {"focal-length", "parallel-rotations", "corner-noise"}
    assert (code is None and not found) or code in found

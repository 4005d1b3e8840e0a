"""64-bit floats turned off after the import: every entry point says so, and none computes in float32."""

import jax
import numpy as np
import pytest

import aacmm_jax as aj

SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300)}


@pytest.mark.parametrize(
    "entry",
    [
        lambda arm, capture, bounds: aj.identify(arm, capture, bounds),
        lambda arm, capture, bounds: aj.identify(arm, capture, bounds, start=np.zeros(21)),
        lambda arm, capture, bounds: aj.calibrate(arm, capture, bounds),
        lambda arm, capture, bounds: aj.evaluate(arm, capture),
        lambda arm, capture, bounds: aj.observability(arm, capture, bounds.space),
        lambda arm, capture, bounds: aj.identify_many(arm, capture, bounds, start=np.zeros((2, 21))),
        lambda arm, capture, bounds: aj.calibrate_many(arm, capture, bounds, start=np.zeros((2, 21))),
        lambda arm, capture, bounds: aj.simulate(arm, SOCKETS),
        lambda arm, capture, bounds: arm.position(np.zeros(6)),
        lambda arm, capture, bounds: aj.perturbed_arm(bounds.space, length=1.0, angle=1e-3),
        lambda arm, capture, bounds: aj.Arm(alpha=[0.0], a=[1.0], d=[1.0]),
        lambda arm, capture, bounds: aj.Capture({"A": np.zeros((3, 6))}),
        lambda arm, capture, bounds: aj.Noise(encoder_arcsec=1.0),
        lambda arm, capture, bounds: aj.scale_from_lengths([1.0], 1.0),
    ],
)
def test_refused(paper_arm, noisy_capture, entry):
    bounds = aj.Bounds.around(paper_arm, aj.Parameters.free_of(paper_arm))
    with jax.enable_x64(False), pytest.raises(aj.InputError, match=r"64-bit floats were turned off .*jax_enable_x64"):
        entry(paper_arm, noisy_capture, bounds)

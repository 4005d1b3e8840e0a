"""Simulated captures: the noise in both of its forms, for all encoders and one a joint."""

import inspect

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.units import ARCSEC

from ..refusals import assert_refused

SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300)}


def recorded(arm: "aj.Arm", **noise) -> "aj.Capture":
    simulate = inspect.unwrap(aj.simulate)  # refusals as users see them, without the types checked in tests
    return simulate(arm, SOCKETS, poses={"A": 6, "B": 2}, lengths=[("A", "B", 0.002)], seed=5, **noise)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("short", "noise"),
    [
        ({}, aj.Noise()),
        ({"encoder_arcsec": 2.0}, aj.Noise(encoder_arcsec=2.0)),
        ({"seating": 0.005}, aj.Noise(seating=0.005)),
        ({"encoder_arcsec": 2.0, "seating": 0.005}, aj.Noise(encoder_arcsec=2.0, seating=0.005)),
        ({"encoder_arcsec": 2.0, "seating": 0.005}, aj.Noise(encoder_arcsec=[2.0] * 6, seating=0.005)),
        ({"encoder_arcsec": [2.0] * 6}, aj.Noise(encoder_arcsec=2.0)),
    ],
    ids=["none", "encoders", "seat", "both", "one a joint", "short one a joint"],
)
@pytest.mark.parametrize("resolution", [0.0, 1.0])
def test_both_forms_give_the_same_capture(paper_arm, short, noise, resolution):
    short, long = (recorded(paper_arm, resolution_arcsec=resolution, **form) for form in (short, {"noise": noise}))
    np.testing.assert_array_equal(short.q, long.q)
    np.testing.assert_array_equal(short.lengths[0].value, long.lengths[0].value)


def test_every_encoder_has_its_own_noise(paper_arm):
    """The draws do not depend on the noise: each joint's error is the same multiple of its standard deviation."""
    each = np.array([0.0, 1.0, 2.0, 5.0, 0.0, 10.0])
    exact, unit, noisy = (
        np.asarray(recorded(paper_arm, noise=aj.Noise(encoder_arcsec=encoders)).q) for encoders in (0.0, 1.0, each)
    )
    assert np.abs(unit - exact).max() > ARCSEC
    np.testing.assert_allclose(noisy - exact, each * (unit - exact), atol=1e-14)
    np.testing.assert_array_equal(noisy[:, [0, 4]], exact[:, [0, 4]])


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("noise", "parts"),
    [
        (
            {"noise": aj.Noise(seating=0.1), "seating": 0.1},
            ["simulate is given both noise and seating", "state all standard deviations in"],
        ),
        ({"noise": aj.Noise(), "encoder_arcsec": 0.0, "seating": 0.0}, ["noise and encoder_arcsec and seating"]),
        ({"noise": aj.Noise(encoder_arcsec=[1.0, 2.0])}, ["encoder_arcsec has 2 values", "6 joints"]),
        ({"encoder_arcsec": -1.0}, ["encoder_arcsec is -1", "zero or positive"]),
    ],
    ids=["both", "both, zero", "two encoders", "negative"],
)
def test_noise_is_refused(paper_arm, noise, parts):
    assert_refused(lambda: recorded(paper_arm, **noise), *parts)

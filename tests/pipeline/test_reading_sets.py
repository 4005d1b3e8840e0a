"""Where tables hold commanded and measured readings, a calibration says which of them fit better."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data.recording import ReadingSet

SOCKETS = {"A": (400, 200, 300), "B": (500, -200, 300), "C": (300, 300, 500)}


@pytest.fixture(scope="module")
def recordings():
    """With the commanded readings, which the joints miss by 60 arcsec; and with the measured ones."""
    nominal = aj.files.load_specification("cheng2018-simulation")
    noise = aj.Noise(encoder_arcsec=2, seating=0.005)
    measured = aj.simulate(nominal.arm, SOCKETS, poses=15, lengths=[("A", "B", 0.005)], noise=noise, seed=1)
    random = np.random.default_rng(0)
    missed = {name: q + random.normal(0, 60 * aj.units.ARCSEC, q.shape) for name, q in measured.sockets.items()}
    commanded = aj.Capture(missed, measured.lengths)
    return {
        "commanded": aj.Recording(
            commanded, nominal, other_readings=ReadingSet("measured", measured, ("columns = ...",))
        ),
        "measured": aj.Recording(measured, nominal, other_readings=ReadingSet("commanded", commanded, ("columns",))),
    }


@pytest.mark.slow
@pytest.mark.parametrize("taken", ["commanded", "measured"])
def test_the_better_ones_are_named(recordings, taken):
    record = aj.calibrate_capture(recordings[taken], model="dh", cross_validate=False)
    said = [says for says in record.decisions if "commanded" in says]
    assert len(said) == (taken == "commanded")
    assert all(says.endswith("To use the measured readings, write columns = ....") for says in said)
    assert np.array_equal(record.recording.capture.readings, recordings[taken].capture.readings)


def test_not_of_other_poses(recordings):
    """Some of the poses are held out."""
    record = aj.calibrate_capture(recordings["commanded"], model="dh", cross_validate=False, hold_out=0.3)
    assert not any("commanded" in says for says in record.decisions)

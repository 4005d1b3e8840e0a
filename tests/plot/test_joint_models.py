"""Figures of models of the joints, on an arm with two eccentric encoders that a tracker saw."""

import io

import numpy as np
import pytest

import aacmm_jax as aj
from tests.refusals import assert_refused

kinds = aj.data.observations
COEFFICIENTS = {"cos1_2": 3e-4, "sin1_3": -4e-4}  # rad


@pytest.fixture(scope="module")
def capture():
    true = aj.kinematics.with_corrections(aj.load_arm("cheng2018-simulation"), list(COEFFICIENTS))
    true = true.replace(coefficients=list(COEFFICIENTS.values()))
    box, station = [[200, -300, 100], [600, 300, 500]], (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
    points = kinds.SimulatedPoints("tracker", box, 120, station, u=0.015)
    return aj.simulate(true, {}, observations=[points], noise=aj.Noise(encoder_arcsec=1.0, seating=0.005), seed=3)


@pytest.fixture(scope="module")
def compared(capture):
    return aj.compare_models(aj.load_arm("cheng2018-simulation"), capture, models=("dh", "harmonics=1"))


@pytest.fixture(scope="module")
def records(capture, compared):
    nominal = aj.files.load_specification("cheng2018-simulation")
    return [
        aj.calibration.record_of(model.result, aj.Recording(capture, nominal._replace(arm=model.result.space.base)))
        for model in compared.models
    ]


@pytest.mark.slow
def test_bars_of_compared_models(compared):
    axes = aj.plot.model_comparison(compared)
    inside, outside = ([bar.get_height() for bar in bars] for bars in axes.containers if len(bars) == 2 and bars[0])
    assert inside == [model.rms_inside for model in compared.models]
    assert outside == [model.rms_outside for model in compared.models]
    assert ["✓" in label.get_text() for label in axes.get_xticklabels()] == [False, True]
    axes.figure.savefig(io.BytesIO())


@pytest.mark.slow
@pytest.mark.parametrize(("model", "joint"), [(0, 2), (0, 3), (1, 2), (1, 3)])
def test_marks_and_curve_are_the_error_of_the_encoder(records, model, joint):
    """Of Denavit-Hartenberg alone the marks keep what its parameters cannot take up, most of the waves; of the right
    model they lie on its curve, which is true within its uncertainty."""
    record = records[model]
    axes = aj.plot.joint_function(record, joint)
    q = np.asarray(record.recording.capture.readings)[:, joint - 1]
    function, amplitude = {2: (np.cos, 0.3), 3: (np.sin, -0.4)}[joint]
    marks = axes.containers[0].lines[0]
    expected = amplitude * (function(np.deg2rad(marks.get_xdata())) - function(q).mean())
    if model == 0:
        assert np.corrcoef(marks.get_ydata(), expected)[0, 1] > 0.6
        return
    curve = axes.lines[0]
    true = amplitude * (function(np.deg2rad(curve.get_xdata())) - function(q).mean())
    edges = axes.collections[0].get_paths()[0].vertices
    U = np.array([np.ptp(edges[np.isclose(edges[:, 0], x), 1]) for x in curve.get_xdata()]) / 2
    assert np.all(np.abs(curve.get_ydata() - true) < 1.5 * U)
    assert U.max() < 0.1
    assert np.sqrt(np.mean((marks.get_ydata() - expected) ** 2)) < 0.1


@pytest.mark.slow
def test_what_cannot_be_drawn(records):
    assert_refused(lambda: aj.plot.joint_function(records[0], 7), "joints 1 to 6")

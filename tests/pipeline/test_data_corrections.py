"""What `calibrate_capture` corrects where nothing is stated: too few data, and readings that are not the arm's."""

import re
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.data.observations import MeasuredPoints
from aacmm_jax.diagnostics.usability import on_bounds

ROOT = Path(__file__).parents[2]

OFFSET = np.array([40.0, -20.0, 90.0])  # of the reflector in the last frame, mm
OPTIONS = {"cross_validate": False, "shared_errors": False}


def real_arm(name, random):
    """An arm of this kind, a millimetre and a milliradian off."""
    nominal = aj.load_arm(name)
    sizes = {"alpha": 0.001, "theta": 0.001, "a": 1.0, "d": 1.0}
    return nominal.replace(
        **{kind: np.asarray(getattr(nominal, kind)) + sd * random.normal(size=6) for kind, sd in sizes.items()}
    )


def tips(arm, q, offset=OFFSET):
    transforms = np.asarray(arm.pose(q))
    return transforms[:, :3, 3] + transforms[:, :3, :3] @ offset


def recorded(name, count, changed=lambda q, points: (q, points)):
    """Points of a reflector by a tracker anywhere, and the true arm; with mistakes of the readings, or points."""
    random = np.random.default_rng(count)
    true, turn = real_arm(name, random), Rotation.random(random_state=4)
    q = random.uniform(-2.0, 2.0, (count, 6))
    points = turn.apply(tips(true, q)) + [1500.0, -800.0, 300.0] + 0.02 * random.normal(size=(count, 3))
    q, points = changed(q, points)
    capture = aj.Capture({}, [], [MeasuredPoints("tracker", q, points, u=0.02, target="reflector")])
    return aj.Recording(capture, aj.files.load_specification(name, capture=capture)), true


def errors(record, true):
    """RMS errors of lengths between random places, mm, by the nominal and by the calibrated arm."""
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (2, 200, 6))
    found = record.observed.geometry["offset of reflector"]
    arms = {"nominal": (record.recording.nominal.arm, OFFSET), "calibrated": (record.calibrated.arm, found)}
    measured = {
        stage: np.linalg.norm(tips(arm, q[0], at) - tips(arm, q[1], at), axis=1) for stage, (arm, at) in arms.items()
    }
    lengths = np.linalg.norm(tips(true, q[0]) - tips(true, q[1]), axis=1)
    return [float(np.sqrt(np.mean((values - lengths) ** 2))) for values in measured.values()]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count", "ratio"), [("ur10e", 5, 0.9), ("ur10e", 8, 0.4), ("irb120", 8, 0.4)])
def test_too_few_points_have_a_prior(name, count, ratio):
    recording, true = recorded(name, count)
    with pytest.raises(aj.InputError, match="equations"):
        aj.calibrate_capture(recording, automatic=False, **OPTIONS)
    record = aj.calibrate_capture(recording, **OPTIONS)
    nominal, calibrated = errors(record, true)
    assert calibrated < ratio * nominal
    assert record.converged
    assert "equations for" in record.decisions[0]
    assert record.prior is not None
    assert record.given_noise is not None


@pytest.mark.slow
def test_what_is_stated_stays():
    recording, _ = recorded("ur10e", 8)
    with pytest.raises(aj.InputError, match="equations"):
        aj.calibrate_capture(recording, method="joint", **OPTIONS)
    prior, noise = aj.Prior({"lengths": 0.5, "angles": 0.0005}), aj.Noise(encoder_arcsec=3.0, seating=0.01)
    record = aj.calibrate_capture(recording, prior=prior, noise=noise, **OPTIONS)
    assert not record.decisions
    assert record.recording.nominal.prior == prior


def test_no_prior_where_none_is_asked_for():
    with pytest.raises(aj.InputError, match="equations"):
        aj.calibrate_capture(recorded("ur10e", 8)[0], prior=None, **OPTIONS)


def test_enough_points_have_none():
    record = aj.calibrate_capture(recorded("ur10e", 14)[0], model="dh", **OPTIONS)
    assert record.prior is None
    assert not record.decisions


def exchanged(q, points):
    return q[:, [0, 2, 1, 3, 4, 5]], points


def turned(q, points):
    return q * np.array([1, 1, -1, 1, 1, 1]), points


def shifted(q, points):
    return q + np.array([0, 0, 0.5, 0, 0, 0]), points


def in_metres(q, points):
    return q, points / 1000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (exchanged, "columns in the order 1, 3, 2, 4, 5 and 6"),
        (turned, "[angles] sign = [1, 1, -1, 1, 1, 1]"),
        (shifted, "[angles] offset = [0.0, 0.0, 28"),
        (in_metres, 'units = { points = "m" }'),
    ],
)
def test_wrong_readings_are_corrected(mistake, says):
    recording, true = recorded("ur10e", 40, mistake)
    record = aj.calibrate_capture(recording, model="dh", **OPTIONS)
    assert record.converged
    assert not record.implausible_residual
    assert says in record.decisions[0]
    read_as = {exchanged: (1, 3, 2, 4, 5, 6), turned: (1, 2, -3, 4, 5, 6)}.get(mistake, (1, 2, 3, 4, 5, 6))
    assert record.recording.read_as == read_as
    if mistake is shifted:  # the calibrated arm holds the zero, with the readings as they are
        q = np.asarray(record.recording.capture.observations[0].q)
        assert np.array_equal(q, recording.capture.observations[0].q)
        assert float(record.calibrated.arm.theta[2] - true.theta[2]) == pytest.approx(-0.5, abs=2e-4)
    else:
        assert errors(record, true)[1] < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mistake", "stated", "said"),
    [
        (exchanged, ("columns",), "columns of [angles]"),
        (turned, ("columns", "sign"), "sign of [angles]"),
        (shifted, ("offset",), "offset of [angles]"),
        (in_metres, ("unit", "units"), "units of the points"),
        (shifted, "bounds", "bounds of theta_3"),
        (shifted, "parameters", "theta_3 as fixed"),
    ],
)
def test_what_is_stated_by_hand_is_not_corrected(mistake, stated, said):
    recording, _ = recorded("ur10e", 40, mistake)
    if isinstance(stated, str):  # of the arm
        nominal = recording.nominal._replace(stated=(stated,))
        held = (*nominal.space().held, "theta_3") if stated == "parameters" else nominal.held
        recording = recording._replace(nominal=nominal._replace(held=held))
    else:
        recording = recording._replace(stated=stated)
    record = aj.calibrate_capture(recording, model="dh", **OPTIONS)
    assert any(f"because this differs from what is stated: {said}." in says for says in record.decisions)
    # A zero that is not in the readings is found as one of the arm, within default bounds that are widened.
    assert record.implausible_residual != (stated == ("offset",))
    read, given = record.recording.capture.observations[0], recording.capture.observations[0]
    assert np.array_equal(read.q, given.q)
    assert np.array_equal(read.points, given.points)


@pytest.mark.slow
def test_right_readings_stay():
    recording, _ = recorded("ur10e", 40)
    record = aj.calibrate_capture(recording, model="dh", **OPTIONS)
    assert not record.decisions
    assert np.array_equal(record.recording.capture.observations[0].q, recording.capture.observations[0].q)


@pytest.mark.slow
@pytest.mark.parametrize("at_calibration", [False, True])
def test_the_readings_of_an_evaluation_are_those_of_the_calibration(at_calibration):
    """Wrong signs in the capture of the calibration are in that of the evaluation, too; or in the latter alone."""
    recording, _ = recorded("ur10e", 40, turned if at_calibration else lambda q, points: (q, points))
    record = aj.calibrate_capture(recording, model="dh", **OPTIONS)
    observation = recorded("ur10e", 40, turned)[0].capture.observations[0]
    wrong = aj.Capture({}, [], [observation.select(np.arange(25))])
    evaluation = aj.evaluate_capture(record, recording._replace(capture=wrong))
    assert not evaluation.independent
    assert "column 3 has the opposite sign" in evaluation.warnings[0]
    assert aj.evaluate(record.calibrated.arm, evaluation.recording.capture).observed.rms[0] < 0.1
    assert not any("check that the arm is the same" in warning for warning in evaluation.warnings)


@pytest.mark.slow
def test_zeros_of_an_evaluation_are_not_corrected():
    recording, _ = recorded("ur10e", 40)
    record = aj.calibrate_capture(recording, model="dh", **OPTIONS)
    wrong = recorded("ur10e", 40, shifted)[0]
    evaluation = aj.evaluate_capture(record, wrong)
    assert "unless the zero of joint 3 is -28" in evaluation.warnings[0]
    assert np.array_equal(evaluation.recording.capture.observations[0].q, wrong.capture.observations[0].q)


@pytest.mark.slow
def test_no_parameter_stays_on_a_bound_that_was_widened(tmp_path):
    """An SO-101 from its URDF: theta_2 stayed on a bound of 1.75 deg that was set here, so U took it as exact."""
    pytest.importorskip("cv2")
    urdf = next((f for f in metadata.files("example-robot-data") or () if f.name == "so101.urdf"), None)
    if urdf is None:
        pytest.skip("the SO-101 of example-robot-data is not installed")
    page = (ROOT / "docs" / "readers" / "hobby_arm.md").read_text()
    manifest = re.search(r"```toml\n(arm = .*?)```", page, re.DOTALL)[1]
    arm = f'arm = "{urdf.locate()}"\ntip = "gripper_frame_link"'
    manifest = re.sub('arm = "so100".*', arm, manifest).replace("examples/", f"{ROOT / 'examples'}/")
    (tmp_path / "my-arm.toml").write_text(manifest)
    record = aj.calibrate_capture(aj.files.read_manifest(tmp_path / "my-arm.toml"), model="dh")
    assert any(decision.startswith("Default bounds were widened") for decision in record.decisions)
    assert on_bounds(record) == {}
    assert record.observed.rms < 0.5

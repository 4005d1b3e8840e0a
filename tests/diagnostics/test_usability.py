"""A calibration is refused only for a reason that remains, and the reason is the most likely one."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data.observations import MeasuredPoints
from aacmm_jax.diagnostics.findings import findings_of
from aacmm_jax.diagnostics.usability import why_unusable

SOCKETS = {"A": (400, 200, 300), "B": (500, -200, 300), "C": (300, 300, 500)}
LENGTHS = [aj.ReferenceLength("A", "B", 412.3106, 0.005), aj.ReferenceLength("A", "C", 244.949, 0.005)]


@pytest.fixture(scope="module")
def readings(paper_arm):
    noise = aj.Noise(encoder_arcsec=5, seating=0.01)
    capture = aj.simulate(paper_arm, SOCKETS, poses=60, noise=noise, seed=1)  # more than are checked
    return {name: np.asarray(q) for name, q in capture.sockets.items()}


def as_read(q):
    return q


def one_pose(q):
    """A pose of B that was taken elsewhere."""
    moved = q["B"].copy()
    moved[3, 2] += np.radians(30)
    return q | {"B": moved}


def one_joint(q):
    random = np.random.default_rng(0)
    return {name: part + random.normal(0, 0.004, part.shape) * (np.arange(6) == 3) for name, part in q.items()}


def wrong_sign(q):
    return {name: part * np.where(np.arange(6) == 3, -1, 1) for name, part in q.items()}


def wrong_zero(q):
    return {name: part + np.radians(45) * (np.arange(6) == 2) for name, part in q.items()}


def exchanged(q):
    """The rows of B belong to other poses."""
    return q | {"B": np.random.default_rng(0).uniform(-2, 2, q["B"].shape)}


def made(readings, changed, stated=None):
    nominal = aj.files.load_specification("cheng2018-simulation")
    if stated is not None:
        arm = nominal.arm.replace(a=np.asarray(nominal.arm.a) + 3.0, d=np.asarray(nominal.arm.d) - 2.0)
        nominal = nominal._replace(arm=arm, length=stated, stated=("bounds",))
    recording = aj.Recording(aj.Capture(changed(readings), LENGTHS), nominal)
    return aj.calibrate_capture(recording, automatic=False, cross_validate=False)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("changed", "stated", "severity", "reason"),
    [
        (as_read, None, None, ""),
        (one_pose, None, "unusable", "Likely cause: B pose 4: "),
        (one_joint, None, "doubt", "Most likely: play or a loose encoder in joint 4."),
        (wrong_sign, None, "unusable", "Likely cause: joint 4 was read with the wrong sign."),
        (wrong_zero, None, "unusable", "Likely cause: the zero of joint 3 is -45 deg off."),
        (exchanged, None, "unusable", "Most likely: errors in B."),
        (as_read, 0.05, "doubt", "Likely cause: the arm differs from what is stated in its file by more than"),
    ],
)
def test_reasons(readings, changed, stated, severity, reason):
    """Columns, units and signs are named only where another choice of them fits."""
    record = made(readings, changed, stated)
    findings = [finding for finding in findings_of(record) if finding.code.endswith("residuals")]
    assert [finding.severity for finding in findings] == ([] if severity is None else [severity])
    assert (why_unusable(record) is not None) == (severity == "unusable")
    for finding in findings:
        assert reason in finding.sentence
        assert ("Check the columns" in finding.sentence) == (changed in (wrong_sign, wrong_zero))


@pytest.mark.slow
def test_what_was_stated_never_condemns(paper_arm, readings):
    """Points of a poor instrument: residuals of 8 mm RMS are within a stated u of 5 mm a coordinate."""
    q = np.concatenate(list(readings.values()))
    points = np.asarray(paper_arm.position(q)) + np.random.default_rng(0).normal(0, 5.0, (len(q), 3))
    nominal = aj.files.load_specification("cheng2018-simulation")
    for u, usable in ((5.0, True), (0.01, False)):
        capture = aj.Capture({}, [], [MeasuredPoints("camera", q, points, u=u)])
        record = aj.calibrate_capture(aj.Recording(capture, nominal), automatic=False)
        assert 7.4 < record.residual < 8.9
        assert (record.residual < record.largest_usual_residual) == usable
        assert (why_unusable(record) is None) == usable


def test_a_scale_that_is_not_plausible_is_not_said_to_have_converged(readings):
    lengths = [aj.ReferenceLength("A", "B", 4123.1, 0.1)]  # ten times too long
    nominal = aj.files.load_specification("cheng2018-simulation")._replace(length=1e5)
    record = aj.calibrate_capture(aj.Recording(aj.Capture(readings, lengths), nominal), automatic=False)
    assert not record.converged
    assert record.reason.startswith("Not usable: the scale factor k = 0.1")
    assert [finding.code for finding in findings_of(record) if finding.severity == "unusable"] == ["implausible-scale"]
    assert why_unusable(record) == "the reference lengths give an implausible scale"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("moved", "says"), [((0, 1), "joints 3, 4, 5 and 6"), ((0, 1, 2, 4, 5), "joint 4"), (range(6), "")]
)
def test_joints_that_stand_still_are_named_first(paper_arm, moved, says):
    random = np.random.default_rng(1)
    q = np.full((40, 6), 0.3)
    q[:, moved] = random.uniform(-1.5, 1.5, (40, len(moved)))
    points = np.array(paper_arm.position(q)) + 0.01 * random.normal(size=(40, 3))
    seen = MeasuredPoints("tracker", q + 1e-5 * random.normal(size=q.shape), points, u=0.01)
    capture = aj.Capture({}, [], [seen])
    recording = aj.Recording(capture, aj.files.load_specification("cheng2018-simulation", capture=capture))
    record = aj.calibrate_capture(recording, model="dh", automatic=False, cross_validate=False, shared_errors=False)
    first = findings_of(record)[:1]
    assert [finding.doubt for finding in first if finding.code == "standing-joints"] == [
        f"{says} moved too little"
    ] * bool(says)

"""Delivered parameters tested on a handful of poses: verdicts, their error rate, what is counted, and bad input."""

import json
import re

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.agreement import CrossValidation, LeftOut
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.pipeline.verification import MARGIN, Accuracy, Verification, _paired, _Rows
from aacmm_jax.summaries.verification import Calibrated, mark_of, verification, verification_summary

PROBE = np.array([20.0, -40.0, 120.0])
NAMES = tuple(f"{kind}_{i}" for kind in ("a", "d", "theta", "alpha") for i in range(1, 7))
SIZES = np.repeat([0.5, 1e-3], 12)  # mm and rad
SOCKETS = {"A": (-400.0, -250.0, 100.0), "B": (-300.0, -250.0, 100.0), "C": (300.0, 350.0, 400.0)}


def arms(seed: int, true: float, other: float):
    """The nominal arm, the true one, and one with ``true`` of its errors and ``other`` of another robot's."""
    random, nominal = np.random.default_rng(seed), aj.load_arm("ur5e").replace(probe=PROBE)
    space = aj.Parameters(nominal, NAMES)
    own, foreign = (random.normal(size=len(NAMES)) * SIZES for _ in "ab")
    start = np.asarray(space.vector())
    return nominal, space.arm(start + own), space.arm(start + true * own + other * foreign)


def recording(nominal, true, poses=8, lengths=(), sockets="ABC"):
    noise = aj.Noise(encoder_arcsec=5.0, seating=0.03)
    return aj.Recording(
        aj.simulate(true, {name: SOCKETS[name] for name in sockets}, poses=poses, lengths=lengths, noise=noise, seed=1),
        ArmSpecification(nominal, "UR5e"),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("true", "other", "verdict"),
    [(1.0, 0.2, "better"), (1.0, 0.0, "better"), (-1.0, 0.0, "worse"), (0.0, 4.0, "worse"), (0.5, 0.8, "equivalent")],
)
def test_verdicts(true, other, verdict):
    nominal, real, delivered = arms(1, true, other)
    checked = aj.verify(recording(nominal, real), delivered)
    assert checked.verdict == verdict
    assert checked.nominal.lower < checked.nominal.rms < checked.nominal.upper
    assert (checked.verdict == "equivalent") == (checked.share_lower < 0.5 < checked.share_upper)
    if (true, other) == (1.0, 0.0):  # repeatability alone is left: seat, and encoders at arm's length
        assert checked.delivered.rms == pytest.approx(np.sqrt(3) * 0.03, rel=0.3)
        assert checked.share == pytest.approx(1.0, abs=0.05)
        assert checked.volume < 0.3 * checked.nominal.rms


@pytest.mark.slow
def test_a_difference_that_does_not_matter_is_shown_by_enough_poses():
    """The ratio of the true errors over all joint limits, with base and tip fitted, is 1.03 for the first, and 1.36 for
    the second, of which few poses in one place do not show that it is within the margin."""
    (nominal, real, delivered), second = arms(2, 0.5, 0.8), arms(1, 0.5, 0.8)
    near = aj.verify(recording(nominal, real), delivered)
    few = aj.verify(recording(second[0], second[1], 4, sockets="AB"), second[2])
    assert (near.verdict, few.verdict) == ("equivalent", "not decided")
    assert MARGIN < near.ratio_lower < 1.03 < near.ratio_upper < 1 / MARGIN < few.ratio_upper
    assert verification_summary(near, "", "")["says"].startswith("No difference that matters")


@pytest.mark.slow
def test_poses_in_one_place_do_not_decide_about_the_working_volume():
    nominal, real, delivered = arms(1, 0.0, 1.0)
    checked = aj.verify(recording(nominal, real, sockets="AB"), delivered)
    assert (checked.verdict, checked.verdict_here) == ("not decided", "worse")
    assert "Record poses in other places" in verification_summary(checked, "", "")["poses_say"]


@pytest.mark.slow
def test_a_board():
    """The noise of many corners knows no arm, and is not taken for that of the poses."""
    nominal, real, delivered = arms(1, 1.0, 0.2)
    grid = [(40.0 * i, 40.0 * j, 0.0) for j in range(3) for i in range(4)]
    lens = (620.0, 615.0, 322.0, 241.0, -0.1, 0.05, 0.001, -0.001, 0.02)
    eye = aj.data.observations.SimulatedPixels(
        *("eye", 12, "webcam", "board", grid, lens, (640, 480)), on_arm=True, distance=(250, 450), u=0.2,
        frame=(3.08, 0.1, 0.0, -400.0, -150.0, 0.0), mount=(60.0, -10.0, 20.0, 0.0, 0.0, 0.3),
    )  # fmt: skip
    capture = aj.simulate(real, {}, observations=[eye], noise=aj.Noise(encoder_arcsec=5.0, seating=0.03), seed=1)
    checked = aj.verify(aj.Recording(capture, ArmSpecification(nominal, "")), delivered)
    assert (checked.verdict, checked.poses) == ("better", 12)
    assert checked.recalibrated < checked.nominal.rms


@pytest.mark.slow
def test_exchanged_arms_have_the_opposite_verdict():
    nominal, real, delivered = arms(2, 1.0, 0.3)
    forward = aj.verify(recording(nominal, real), delivered)
    backward = aj.verify(recording(delivered, real), nominal)
    assert (forward.verdict, backward.verdict) == ("better", "worse")
    assert backward.share == pytest.approx(1 - forward.share, abs=0.01)
    assert backward.nominal.rms == pytest.approx(forward.delivered.rms)


@pytest.mark.slow
def test_what_is_counted():
    """Two sockets: 3 coordinates a pose, less the tip and two positions; a length is one more equation."""
    nominal, real, delivered = arms(3, 1.0, 0.3)
    plain = aj.verify(recording(nominal, real, 4, (), "AB"), delivered)
    assert (plain.poses, plain.equations, plain.unknowns) == (8, 24, 9)
    measured = aj.verify(recording(nominal, real, 4, [aj.ReferenceLength("A", "B", 100.0, u=0.01)], "AB"), delivered)
    assert (measured.equations, measured.unknowns) == (25, 9)
    assert measured.length_errors.shape == (2, 1)
    assert abs(measured.length_errors[0, 0]) > 0.05  # between centroids; the fitted positions agree to 0.01 mm
    q = np.random.default_rng(0).uniform(-2, 2, (8, 6))
    seen = aj.data.observations.MeasuredPoints("tracker", q, real.position(q) + 500.0, u=0.02, target="ball")
    tracked = aj.verify(aj.Recording(aj.Capture({}, [], [seen]), ArmSpecification(nominal, "")), delivered)
    assert (tracked.poses, tracked.equations, tracked.unknowns) == (8, 24, 9)


@pytest.mark.slow
def test_the_same_parameters_are_compared_with_a_calibration():
    """Parameters off by 0.5 mm and 1 mrad are not good, the true ones are, and one row and no infinity tell it."""
    nominal, real, _ = arms(3, 1.0, 0.0)
    bad, good = (aj.verify(recording(arm, real), arm) for arm in (nominal, real))
    assert (bad.same, bad.verdict, bad.decided_by, good.verdict) == (True, "not good", None, "good")
    assert bad.distances.shape == (2, 24)
    assert np.sqrt(np.mean(bad.distances[1] ** 2)) == pytest.approx(bad.delivered.rms, rel=0.1)
    summary = verification_summary(bad, "", "", scaled=False)
    said = " ".join(str(line) for line in verification(summary))
    assert summary["share"] == {"value": None, "lower": None, "upper": None}
    assert "Infinity" not in json.dumps(summary)
    assert not any(text in said for text in ("inf", "times as much", "Real share"))
    assert len(summary["accuracy"]) == 1
    assert re.fullmatch(
        r"Not good: .* with the tip fitted; a calibration .* at least .* mm: calibrate\.", summary["says"]
    )
    assert any("scale" in part for part in summary["not_tested"])
    low, high = bad.delivered.lower, bad.delivered.upper
    for limit, enough, does in ((0.9 * low, "no", "calibrate"), (1.01 * high, "yes", "keep the parameters")):
        judged = verification_summary(bad, "", "", max_rms=limit)
        assert (judged["enough"], judged["achieved"], judged["do"]) == (enough, enough == "yes", does)
        beyond = int((bad.distances[1] > limit).sum())
        assert f"ood enough for {limit:g} mm RMS: {beyond} of 24 poses beyond {limit:g} mm" in judged["says"]
    between = verification_summary(bad, "", "", max_rms=(low + high) / 2)
    assert (between["enough"], between["achieved"]) == ("not decided", False)


@pytest.mark.slow
def test_the_uncertainty_of_a_length_counts_in_what_a_calibration_would_leave():
    """The scale is u / length, whatever the nominal arm errs by in these poses: over the working volume of a UR5e
    (reach 850 mm), whose base and tip are fitted, 1e-3 are some tenths of a millimetre. A u that says nothing of the
    scale leaves what is left without a length."""
    nominal, real, _ = arms(3, 1.0, 0.0)

    def left(*u):
        measured = [aj.ReferenceLength("A", "B", 100.0, u=x) for x in u]
        return aj.verify(recording(nominal, real, 24, measured), nominal).recalibrated

    known, *uncertain = (left(u) for u in (0.01, 0.05, 0.1))
    reach = [np.sqrt(found**2 - known**2) / (u / 100) for found, u in zip(uncertain, (0.05, 0.1), strict=True)]
    assert 250 < min(reach) < max(reach) < 600
    assert left(20.0) == pytest.approx(left(), rel=0.02)


def of_nominal_parameters(rms: float) -> Verification:
    """Of 4 poses, by the nominal parameters, which were delivered; a calibration would leave 0.1 mm."""
    found = Accuracy(rms, 0.9 * rms, 1.1 * rms, 100.0)
    distances = np.full((2, 4), rms)
    return Verification(
        *("not good", found, found, 0.5, 0.0, 1.0, 1.0, 4, 13, 6, None, np.array([[0.2], [0.2]]), distances),
        *(rms, 0.1, 1.0, 1.0, "not decided", True),
    )


def calibrated_at(rms: float, spread: float, corrections: bool = False) -> Calibrated:
    """Two held-out groups of two poses each; the first errs less than the second by twice the spread."""
    groups = []
    for name, size in (("A", rms - spread), ("B", rms + spread)):
        distances = np.array([0.8, np.sqrt(2 - 0.8**2)]) * size
        group = LeftOut((name,), 2, size, size, np.zeros(0), np.zeros(0), True, distances=distances)
        groups.append(group)
    return Calibrated(CrossValidation(tuple(groups)), "c.h5", corrections, "c.h5: To be used with care.")


def test_the_calibrated_arm_gets_a_verdict_of_its_own():
    """As found by a reader: beside a tested calibration, one was predicted, and the task was to calibrate."""
    checked, calibration = of_nominal_parameters(3.0), calibrated_at(0.2, 0.001)
    low, high = calibration.validation.interval
    summary = verification_summary(checked, "arm", "arm", max_rms=1.0, calibrated=calibration, lengths=["left"])
    assert summary["says"] == (
        f"Calibrated, good enough for 1 mm RMS: 0.2 mm RMS (95 %: {low:.3g} to {high:.3g} mm) in held-out poses, "
        "0 of 4 beyond 1 mm, largest error 0.234 mm. As delivered, not good enough: 3 mm RMS (95 %: 2.7 to 3.3 mm) "
        "with the tip fitted, 4 of 4 beyond 1 mm."
    )
    assert (summary["enough"], summary["calibrated"]["enough"], summary["do"]) == ("no", "yes", "use the calibration")
    assert (summary["achieved"], mark_of(summary)) == (True, "good")
    assert (summary["calibrated"]["beyond"], summary["calibrated"]["poses"]) == (0, 4)
    said = " ".join(map(str, verification(summary)))
    assert not any(text in said for text in ("come on top", "at least", "would", "To do: calibrate"))
    for text in ("aacmm correct c.h5", "not what your controller computes", "To be used with care", "left 0.200"):
        assert text in said
    assert "of a calibration with --model dh" not in said
    corrected = verification_summary(checked, "", "", max_rms=1.0, calibrated=calibrated_at(0.2, 0.001, True))
    assert "of a calibration with --model dh" in corrected["next"]


@pytest.mark.parametrize(
    ("delivered", "rms", "spread", "enough", "begins", "does"),
    [
        (3.0, 2.0, 0.01, "no", "Calibrated, not good", "find the cause of the remaining errors"),
        (3.0, 0.9, 0.1, "not decided", "Calibrated, not decided", "record more poses in other places"),
        (0.5, 2.0, 0.01, "no", "As delivered, good enough", "keep the parameters"),
    ],
)
def test_verdicts_on_the_calibrated_arm(delivered, rms, spread, enough, begins, does):
    calibration = calibrated_at(rms, spread)
    summary = verification_summary(of_nominal_parameters(delivered), "", "", max_rms=1.0, calibrated=calibration)
    assert summary["calibrated"]["enough"] == enough
    assert summary["says"].startswith(begins)
    assert (summary["do"], summary["achieved"]) == (does, delivered < 1)
    if enough == "no":
        assert "4 of 4 beyond 1 mm" in calibration.says(1.0)


def test_a_calibration_without_a_limit_and_without_single_poses():
    """Of a file of an earlier version, or a single group, less is said."""
    calibration = calibrated_at(0.2, 0.001)
    summary = verification_summary(of_nominal_parameters(3.0), "", "", calibrated=calibration)
    assert summary["says"].startswith("Not good: 3 mm RMS")
    assert "calibration with these poses" not in summary["says"]
    assert summary["do"] == "use the calibration"
    group = calibration.validation.groups[0]._replace(distances=None)
    one = calibration._replace(validation=CrossValidation((group,)))
    summary = verification_summary(of_nominal_parameters(3.0), "", "", max_rms=1.0, calibrated=one)
    assert summary["says"].startswith("Calibrated, good enough for 1 mm RMS: 0.199 mm RMS in held-out poses. As del")
    assert (summary["calibrated"]["beyond"], summary["calibrated"]["upper_mm"]) == (None, None)
    worse = verification_summary(of_nominal_parameters(0.25), "", "", calibrated=calibration)
    assert worse["do"] == "keep the parameters"


def drawn(random: np.random.Generator, share: float, clusters: int = 12) -> tuple[_Rows, _Rows]:
    """Residuals of two arms, of which the second has so much of what lies between them, with unknowns eliminated."""
    basis = np.linalg.qr(random.normal(size=(3 * clusters, 4)))[0]
    step, error = random.normal(size=(2, 3 * clusters))
    error *= np.repeat(np.exp(random.normal(size=clusters) / 2), 3)  # some poses err more
    nominal = share * step + error
    pose = np.repeat(np.arange(clusters), 3)
    rows = [_Rows(values - basis @ (basis.T @ values), basis, pose, clusters) for values in (nominal, nominal - step)]
    return rows[0], rows[1]


def test_the_standard_error_is_that_of_leaving_out_each_pose():
    """CR3 is the jackknife of the regression, unknowns included, about the estimate of all poses."""
    nominal, delivered = drawn(np.random.default_rng(0), 0.8)
    step = nominal.residual - delivered.residual
    columns = np.column_stack([step, nominal.basis])
    shares = []
    for pose in range(12):
        kept = nominal.pose != pose
        shares.append(np.linalg.lstsq(columns[kept], nominal.residual[kept], rcond=None)[0][0])
    whole = np.linalg.lstsq(columns, nominal.residual, rcond=None)[0][0]
    found = _paired(nominal, delivered)
    assert found.share == pytest.approx(whole)
    assert found.u == pytest.approx(np.sqrt(11 / 12 * np.sum((np.array(shares) - whole) ** 2)))


@pytest.mark.slow
def test_equally_good_parameters_are_told_apart_as_rarely_as_stated():
    random = np.random.default_rng(1)
    decided = [_paired(*drawn(random, 0.5)).verdict != "not decided" for _ in range(400)]
    assert np.mean(decided) < 0.05 + 2 * np.sqrt(0.05 * 0.95 / 400)


@pytest.mark.slow
def test_what_cannot_be_verified():
    nominal, real, delivered = arms(5, 1.0, 0.3)
    recorded = recording(nominal, real)
    with pytest.raises(aj.InputError, match="--delivered, or the nominal arm, or as_found"):
        aj.verify(recorded)
    with pytest.raises(aj.InputError, match="has 7 joints"):
        aj.verify(recorded, aj.load_arm("panda"))
    few = recorded._replace(capture=aj.Capture({"A": recorded.capture.sockets["A"][:3]}))
    with pytest.raises(aj.InputError, match="at least four poses"):
        aj.verify(few, delivered)

"""Calibrations by what cameras saw: mounts, targets, intrinsics and the arm, and a camera by itself."""

from types import SimpleNamespace

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.redrawn import truth_of
from aacmm_jax.calibration.reprojection import reprojection
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.data.cameras.views import calibrated_camera, started_intrinsics
from aacmm_jax.data.observations.observation import Tips
from aacmm_jax.diagnostics.pose_residuals import observation_residuals
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.summaries.cameras import camera_rows
from aacmm_jax.summaries.observations import observed_summary

kinds = aj.data.observations
LENS = (620.0, 615.0, 322.0, 241.0, -0.1, 0.05, 0.001, -0.001, 0.02)
SIZE = (640, 480)
BOARD = [(30.0 * i, 30.0 * j, 0.0) for j in range(4) for i in range(5)]
ON_ARM = dict(frame=(3.08, 0.1, 0.0, -700.0, -200.0, 0.0), mount=(60.0, -10.0, 20.0, 0.05, -0.1, 0.3))
FIXED = dict(frame=(0.1, 0.0, 0.0, -650.0, -150.0, -250.0), mount=(10.0, -20.0, 60.0, 0.05, -0.1, 0.3))
TRUE = aj.load_arm("ur10e")
NONE_FREE = aj.Bounds(aj.Parameters(TRUE, ()), np.zeros(0), np.zeros(0))
EXACT = aj.Noise(encoder_arcsec=0.0, seating=0.0)
NOISE = aj.Noise(encoder_arcsec=20.0, seating=0.02)


def seen(name="eye", poses=15, on_arm=True, camera="webcam", board="board", **options):
    places = (ON_ARM | {"distance": (300, 500)}) if on_arm else (FIXED | {"distance": (300, 700)})
    return kinds.SimulatedPixels(name, poses, camera, board, BOARD, LENS, SIZE, on_arm=on_arm, **places | options)


def record_of(result, capture):
    return aj.calibration.record_of(result, aj.Recording(capture, ArmSpecification(TRUE)))


def check_geometry(result, expected):
    parts, covariance = result.observed.geometry, result.observed.geometry_covariance
    for part, value in expected.items():
        ratio = (np.asarray(parts[part]) - value) / np.sqrt(np.diag(covariance[part]))
        assert np.abs(ratio).max() < 4.5, part


@pytest.mark.slow
@pytest.mark.parametrize("on_arm", [True, False], ids=["on the arm", "fixed"])
def test_hand_eye_with_an_exact_arm(on_arm):
    eye = seen(on_arm=on_arm, poses=8, u_intrinsics=np.inf)
    capture = aj.simulate(TRUE, {}, observations=[eye], noise=EXACT, seed=1)
    result = aj.calibrate(TRUE, capture, NONE_FREE)
    held, still = ("webcam", "board") if on_arm else ("board", "webcam")
    places = ON_ARM if on_arm else FIXED
    expected = {f"offset of {held}": places["mount"][:3], f"orientation of {held}": places["mount"][3:]}
    check_geometry(result, expected | {f"frame of {still}": places["frame"], "intrinsics of webcam": LENS})
    assert 0.8 < float(result.observed.reduced_chi_of_all) < 1.2
    assert result.parameters.shape == (0,)


@pytest.mark.slow
@pytest.mark.parametrize("on_arm", [True, False], ids=["on the arm", "fixed"])
def test_an_arm_that_is_held_and_errs_makes_the_mount_uncertain(on_arm):
    """Zeros off by 0.2 deg, axes by 0.1 deg, lengths by 0.5 mm: the true mount is within U, which an exact arm's is not
    near, and the residuals are said to show it."""
    names = [f"{kind}_{i}" for kind in ("theta", "alpha", "a", "d") for i in range(1, 7)]
    space, sizes = aj.Parameters(TRUE, tuple(names)), np.repeat([0.0035, 0.0017, 0.5], [6, 6, 12])
    built = space.arm(np.asarray(space.vector()) + sizes * np.random.default_rng(3).normal(size=24))
    held, places = ("webcam", ON_ARM) if on_arm else ("board", FIXED)
    capture = aj.simulate(built, {}, observations=[seen(on_arm=on_arm)], noise=NOISE, seed=1)
    result = aj.calibrate(TRUE, capture, NONE_FREE)
    alone = aj.calibrate(TRUE, capture, NONE_FREE, shared_errors=False)
    still = "board" if on_arm else "webcam"
    expected = {f"offset of {held}": places["mount"][:3], f"orientation of {held}": places["mount"][3:]}
    expected[f"frame of {still}"] = places["frame"]
    ratios = []
    for one in (result, alone):
        parts, covariance = one.observed.geometry, one.observed.geometry_covariance
        pairs = [(np.asarray(parts[part]) - value, np.diag(covariance[part])) for part, value in expected.items()]
        ratios.append(np.concatenate([np.abs(error) / np.sqrt(variance) for error, variance in pairs]))
    assert ratios[0].max() < 3.0 < ratios[1].max()
    found = {finding.code: finding for finding in aj.diagnostics.findings_of(result, capture)}
    assert "--arm-fixed" in found["held-arm"].advice
    assert "px RMS off" in found["held-arm"].says
    assert "wrong-fixed" not in found


@pytest.mark.slow
def test_two_cameras_and_two_boards_and_the_arm():
    """Cameras share what they name: here one board, and one camera."""
    other = (3.0, 0.0, 0.2, -600.0, 300.0, 20.0)
    second = seen("second", camera="side", mount=(-50.0, 20.0, 10.0, -0.1, 0.1, -0.2))
    third = seen("third", board="wall", frame=other)
    capture = aj.simulate(TRUE, {}, observations=[seen(), second, third], noise=NOISE, seed=2)
    space = aj.Parameters(TRUE, ("theta_2", "theta_3", "theta_4", "a_2", "a_3"))
    nominal = aj.perturbed_arm(space, length=1.0, angle=0.003, seed=1)
    bounds = aj.Bounds.around(nominal, aj.Parameters(nominal, space.names))
    result = aj.calibrate(nominal, capture, bounds, noise=NOISE, undetermined="ignore")
    check_geometry(result, {"frame of board": ON_ARM["frame"], "frame of wall": other})
    check_geometry(result, {"offset of webcam": ON_ARM["mount"][:3], "offset of side": (-50.0, 20.0, 10.0)})
    ratio = (np.asarray(result.parameters) - np.asarray(space.vector(TRUE))) / np.sqrt(np.diag(result.covariance))
    assert np.abs(ratio).max() < 4.5


@pytest.mark.slow
def test_intrinsics_that_are_stated_and_free_ones_are_parts_of_their_own():
    """A free one is no certified value, from which the found one may differ, and no equation."""
    u = (1.0, 1.0, np.inf, np.inf, 0.01, 0.0, 0.0, 0.0, np.inf)
    capture = aj.simulate(TRUE, {}, observations=[seen(u_intrinsics=u)], noise=EXACT, seed=1)
    (eye,) = capture.observations
    assert [*eye.certified] == ["intrinsics of webcam"]
    assert np.asarray(eye.certified["intrinsics of webcam"][1]).tolist() == [1.0, 1.0, 0.01]
    result = aj.calibrate(TRUE, capture, NONE_FREE)
    check_geometry(result, {"intrinsics of webcam": [LENS[i] for i in (0, 1, 4)]})
    check_geometry(result, {"free intrinsics of webcam": [LENS[i] for i in (2, 3, 8)]})
    (row,) = camera_rows(record_of(result, capture))
    assert [entry["u"] > 0 for entry in row["intrinsics"]] == [one > 0 for one in u]


@pytest.mark.slow
def test_poorly_determined_coefficients_leave_the_others_their_u():
    """Radial coefficients of a quotient imitate each other; focal lengths and centre have their own u."""
    lens = (*LENS[:8], 0.02, 0.0, 0.0, 0.0)
    eye = kinds.SimulatedPixels("eye", 20, "webcam", "board", BOARD, lens, SIZE, u_intrinsics=np.inf,
                                **ON_ARM | {"distance": (250, 500)})  # fmt: skip
    capture = aj.simulate(TRUE, {}, observations=[eye], noise=EXACT, seed=1)
    result = aj.calibrate(TRUE, capture, NONE_FREE)
    u = np.sqrt(np.diag(result.observed.geometry_covariance["intrinsics of webcam"]))
    error = np.abs(np.asarray(result.observed.geometry["intrinsics of webcam"]) - lens)
    np.testing.assert_array_equal(np.isnan(u), np.isin(np.arange(12), (4, 5, 8, 9, 10, 11)))
    assert np.all(error[:4] < 4.5 * u[:4])
    assert np.all(u[:4] < 5.0)
    found = {finding.code: finding.says for finding in aj.diagnostics.findings_of(result, capture)}
    assert "k1, k2, k3, k4, k5 and k6 of 'webcam'" in found["intrinsics-undetermined"]


@pytest.mark.slow
def test_residuals_in_pixels_are_those_of_the_corners():
    """Whatever each corner's standard deviation, and however many an image has."""
    (eye,) = aj.simulate(TRUE, {}, observations=[seen(poses=8)], noise=NOISE, seed=1).observations
    u = np.random.default_rng(0).uniform(0.1, 0.9, np.shape(eye.corners))
    ids = np.array(eye.ids)
    ids[2, 6:] = -1
    capture = aj.Capture({}, observations=[eye.changed(u=u).changed(ids=tuple(map(tuple, ids.tolist())))])
    result = aj.calibrate(TRUE, capture, NONE_FREE)
    record = record_of(result, capture)
    corners = reprojection(record.calibrated.arm, capture.observations[0], record.observed.geometry)
    counts = corners.seen.sum(axis=1)
    assert counts.tolist() == [20, 20, 6, 20, 20, 20, 20, 20]
    expected = np.sqrt(np.sum(corners.residual**2, axis=(1, 2)) / counts)
    (part,) = observation_residuals(record)
    np.testing.assert_allclose(part.other["px"], expected)
    np.testing.assert_allclose(aj.residuals_of(record).pixels, expected, rtol=1e-6)
    (row,) = observed_summary(record, record.evaluations()["nominal"])["observations"]
    assert row["rms_px"] == pytest.approx(corners.rms)


@pytest.mark.slow
def test_an_uncertain_scale_of_the_target_is_carried_into_all_lengths():
    exact, uncertain = (
        aj.calibrate(TRUE, aj.simulate(TRUE, {}, observations=[seen(u_scale=u, poses=5)], seed=1), NONE_FREE)
        for u in (0.0, 1e-3)
    )
    scale = uncertain.observed.geometry_covariance["scale of board"]
    assert 0 < np.sqrt(scale[0, 0]) < 1.01e-3
    u = [np.sqrt(np.diag(one.observed.geometry_covariance["offset of webcam"])) for one in (exact, uncertain)]
    assert np.all(u[1] >= 0.999 * u[0])


def test_one_bad_image_does_not_spoil_the_start():
    (eye,) = aj.simulate(TRUE, {}, observations=[seen(poses=12)], seed=1).observations
    q = np.array(eye.q)
    q[3] += 0.7  # the arm stood elsewhere
    bad = eye.changed(q=q)
    arm = np.asarray(TRUE.replace(probe=np.zeros(3)).pose(q))
    tips = Tips(arm[:, :3, 3].T, tuple(arm[:, :3, i].T for i in range(3)))
    parts = to_numpy(bad).start(tips, np.zeros(3))
    np.testing.assert_allclose(parts["offset of webcam"], ON_ARM["mount"][:3], atol=5.0)


@pytest.fixture(scope="module")
def alone():
    (eye,) = aj.simulate(TRUE, {}, observations=[seen(poses=12, tilt=0.8)], seed=4).observations
    corners = eye.as_corners()
    # As OpenCV takes them.
    return corners._replace(values=corners.values.astype(np.float32).astype(float))


def test_intrinsics_alone_are_those_of_opencv(alone):
    cv2 = pytest.importorskip("cv2")
    ours = calibrated_camera(alone, started_intrinsics(alone, 9, np.array(SIZE, dtype=float)))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 1000, 1e-15)
    points = [part.astype(np.float32) for part in alone.points]
    images = [part.astype(np.float32)[:, None] for part in alone.values]
    rms, *_ = cv2.calibrateCamera(points, images, SIZE, None, None, criteria=criteria)
    assert ours.rms == pytest.approx(rms, abs=1e-6)
    assert np.all(np.abs(ours.intrinsics - LENS) < 4.5 * ours.u)


def long_table(eye):
    m, c = np.array(eye.ids).shape
    image = np.repeat(np.arange(m), c)
    order = np.random.default_rng(0).permutation(m * c)[: m * c - 7]
    ids = np.array(eye.ids).ravel()
    corners = np.asarray(eye.corners).reshape(m * c, -1)
    return image[order], ids[order], corners[order]


TARGET = SimpleNamespace(ids=np.arange(20), points=np.array(BOARD), u_scale=0.0)


@pytest.mark.slow
def test_a_table_of_corners_gives_intrinsics_and_noise():
    """Nothing is stated of the camera: start and standard deviation come from the corners, which are all kept."""
    (eye,) = aj.simulate(TRUE, {}, observations=[seen(poses=12)], seed=1).observations
    image, ids, corners = long_table(eye)
    table = kinds.CornerTable(image, ids, corners, names=[f"{i}.png" for i in range(12)])
    made = kinds.pixels_of("eye", eye.q, table, TARGET, kinds.Camera("webcam", image_size=SIZE))
    assert made.seen.sum() == len(ids)
    assert float(np.asarray(made.u)[made.seen].mean()) == pytest.approx(0.3, rel=0.15)
    np.testing.assert_allclose(np.asarray(made.intrinsics)[:4], LENS[:4], rtol=0.05)
    assert made.images[3] == "3.png"


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda i, k, c: (i, np.where(k == 3, 99, k), c), "shows the point 99, which the target does not have"),
        (lambda i, k, c: (i, np.where(k == 3, 4, k), c), "shows the point 4 twice"),
        (lambda i, k, c: (i + 1, k, c), "there is an image 13, but 12 poses"),
        (lambda i, k, c: (i[i != 2], k[i != 2], c[i != 2]), "image 3 has no corner"),
        (lambda i, k, c: (i, k, c + 600), "outside of the image"),
    ],
)
def test_bad_tables_of_corners(change, message):
    (eye,) = aj.simulate(TRUE, {}, observations=[seen(poses=12)], seed=1).observations
    table = kinds.CornerTable(*change(*long_table(eye)), u=0.3)
    camera = kinds.Camera("webcam", intrinsics=LENS, u=0, image_size=SIZE)
    with pytest.raises(aj.InputError, match=message):
        kinds.pixels_of("eye", eye.q, table, TARGET, camera)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(intrinsics=(*LENS[:4], -40.0, 0, 0, 0)), "folds back"),
        (dict(intrinsics=(*LENS[:2], 960.0, 540.0)), "those of another image size"),
        (dict(intrinsics=LENS[:6]), "has 6 intrinsics"),
        (dict(u=0.0), "give the standard deviation"),
    ],
)
def test_bad_cameras(fields, message):
    (eye,) = aj.simulate(TRUE, {}, observations=[seen(poses=5)], seed=1).observations
    stored = {name: value for name, value in eye.stored().items() if name != "views"} | fields
    stored = {name: value for name, value in stored.items() if name != "u_intrinsics"}
    with pytest.raises(aj.InputError, match=message):
        kinds.Pixels.rebuilt("eye", stored)


@pytest.mark.slow
def test_trials_drawn_anew_scatter_as_the_covariance_says():
    """With stated, free and exact intrinsics and an uncertain scale, which a batch has as parts of its own too."""
    options = {"u_intrinsics": (1.0, 1.0, np.inf, np.inf, 0.01, 0.0, 0.0, 0.0, 0.0), "u_scale": 1e-4}
    capture = aj.simulate(TRUE, {}, observations=[seen(**options)], noise=NOISE, seed=2)
    space = aj.Parameters(TRUE, ("theta_2", "theta_3", "a_2"))
    bounds = aj.Bounds.around(TRUE, space)
    result = aj.calibrate(TRUE, capture, bounds, noise=NOISE, undetermined="ignore")
    drawn, _ = truth_of(result, capture).drawn(200, NOISE, np.random.default_rng(0))
    many = aj.calibrate_many(result.arm, drawn, bounds, noise=NOISE)
    u = np.sqrt(np.diag(result.covariance))
    error = np.asarray(many.parameters) - np.asarray(result.parameters)
    np.testing.assert_allclose(error.std(axis=0), u, rtol=0.2)
    assert np.all(np.abs(error.mean(axis=0)) < 4 * u / np.sqrt(200))
    # Of poses drawn with replacement.
    sampled = aj.bootstrap(result, capture, trials=100)
    np.testing.assert_allclose(sampled.u[:3], u, rtol=0.6)

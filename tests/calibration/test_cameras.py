"""Calibrations by what cameras saw: mounts, targets, intrinsics and the arm, and a camera by itself."""

from types import SimpleNamespace

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.data.cameras.views import calibrated_camera, started_intrinsics
from aacmm_jax.data.observations.observation import Tips

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


def check_geometry(result, expected):
    parts, covariance = result.observed.geometry, result.observed.geometry_covariance
    for part, value in expected.items():
        ratio = (np.asarray(parts[part]) - value) / np.sqrt(np.diag(covariance[part]))
        assert np.abs(ratio).max() < 4.5, part


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

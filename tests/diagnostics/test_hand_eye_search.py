"""Signs and zeros of joints by the poses of what the arm carries, wherever it is mounted and the base stands."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.diagnostics import hand_eye_search
from aacmm_jax.diagnostics.capture_check import check_capture
from aacmm_jax.diagnostics.hand_eye_search import hand_eye_hypotheses

from ..conftest import EXAMPLES

SIZE = 460.0  # mm
MANIFEST = """
arm = "so100"
angles = {{ unit = "deg", calibration = "{folder}/motors.json", columns = "*_*.pos" }}
target = [{{ name = "board", kind = "charuco", squares = [7, 5], size = 20, marker = 15, dictionary = "4x4_50" }}]
camera = [{{ name = "webcam", image_size = [640, 480] }}]
pixels = [{{ camera = "webcam", target = "board", file = "{folder}/lerobot.csv", images = "{folder}/webcam/*.jpg" }}]
"""


def carried(name, poses, seed):
    """An arm, joint values, and the poses of what it carries in the frame of what stands still."""
    generator, arm = np.random.default_rng(seed), aj.load_arm(name)
    low, high = np.asarray(arm.limits).reshape(-1, 2).T
    q = generator.uniform(np.maximum(low, -2), np.minimum(high, 2), (poses, arm.joints))
    mount, place = Rotation.from_rotvec(generator.normal(0, 1, (2, 3)))
    frames = np.asarray(arm.pose(q))
    points = frames[:, :3, :3] @ generator.normal(0, 40, 3) + frames[:, :3, 3] - generator.normal(0, 300, 3)
    return arm, q, place.inv().apply(points), place.inv().as_matrix() @ frames[:, :3, :3] @ mount.as_matrix()


@pytest.mark.parametrize(
    ("name", "signs", "zeros", "most", "within"),
    [
        ("so100", (1, 1, -1, 1, 1), (0, 100, 90, -20, 0), 3000, 45),
        pytest.param("so100", (-1, 1, 1, -1, 1), (0, -100, 90, 37, 0), 20_000, 22.5, marks=pytest.mark.slow),
        pytest.param("ur5e", (1, -1, 1, 1, 1, 1), (0, 90, -80, 100, 0, 0), 20_000, 45, marks=pytest.mark.slow),
    ],
)
def test_signs_and_zeros_are_among_the_likely_ones(monkeypatch, name, signs, zeros, most, within):
    monkeypatch.setattr(hand_eye_search, "_MOST", most)
    arm, q, points, axes = carried(name, 18, 1)
    recorded = (q - np.radians(zeros)) * signs
    found = hand_eye_hypotheses(arm, recorded, points, axes, SIZE)
    off = [np.angle(np.exp(1j * (np.array(each.offsets) - np.radians(zeros))), deg=True) for each in found]
    assert any(each.signs == signs and np.abs(d).max() <= within for each, d in zip(found, off, strict=True))
    assert all(each.order == tuple(range(arm.joints)) for each in found)


def test_too_many_joints_are_left_to_the_search_of_orders(monkeypatch):
    monkeypatch.setattr(hand_eye_search, "_MOST", 10)
    assert hand_eye_hypotheses(*carried("so100", 6, 0), SIZE) == []


@pytest.mark.slow
def test_readings_of_lerobot_whose_zeros_and_first_sign_are_not_the_model_s(tmp_path):
    pytest.importorskip("cv2")
    path = tmp_path / "arm.toml"
    path.write_text(MANIFEST.format(folder=(EXAMPLES / "webcam").as_posix()))  # elsewhere: images have whole paths
    recording = aj.files.read_manifest(path)
    check = check_capture(recording.nominal.arm, recording.capture, recording.usual)
    assert (check.explained, check.best.signs, check.others) == (True, (-1, 1, 1, 1, 1), ())
    np.testing.assert_allclose(np.degrees(check.best.offsets), [0, 100.4, -90.7, -37.3, 0], atol=1.5)
    assert check.best.rms_fitted < 0.5
    # With the play of hobby servos, too; but not of an arm of which nothing is known.
    (seen,) = recording.capture.observations
    scattered = np.asarray(seen.q) + np.radians(0.6) * np.random.default_rng(1).normal(size=seen.q.shape)
    capture = aj.Capture({}, observations=[seen.changed(q=scattered)])
    check = check_capture(recording.nominal.arm, capture, recording.usual)
    assert (check.explained, check.best.signs) == (True, (-1, 1, 1, 1, 1))
    np.testing.assert_allclose(np.degrees(check.best.offsets), [0, 100.4, -90.7, -37.3, 0], atol=10)
    assert not check_capture(recording.nominal.arm, capture).explained

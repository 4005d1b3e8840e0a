"""Noise that arm files state for plans: classes, published repeatability, values, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data.noise import CLASSES, class_noise, noise_of_repeatability
from aacmm_jax.files import load_noise, usual_noise

TABLE = """\
length_unit = "mm"
angle_unit = "deg"
joint = [
  { alpha = 90.0, a = 0.0, d = 300.0 },
  { alpha = 0.0, a = 400.0, d = 0.0 },
  { alpha = 90.0, a = 0.0, d = 0.0 },
]
probe = [0.0, 0.0, 300.0]
"""


def encoder(found) -> float:
    return float(np.asarray(found.noise.encoder_arcsec))


def test_repeatability_is_what_simulated_visits_show():
    """ISO 9283 over many visits of many poses: the mean distance from the barycentre plus three standard deviations."""
    arm, random = aj.load_arm("panda"), np.random.default_rng(0)
    noise = noise_of_repeatability(arm, 0.1)
    limits = np.asarray(arm.limits)
    q = random.uniform(limits[:, 0], limits[:, 1], (300, 7))
    visits = q[:, None] + float(noise.encoder) * random.normal(size=(300, 60, 7))
    tips = np.asarray(arm.position(visits.reshape(-1, 7))).reshape(300, 60, 3)
    distance = np.linalg.norm(tips - tips.mean(axis=1, keepdims=True), axis=2)
    found = distance.mean(axis=1) + 3 * distance.std(axis=1, ddof=1)
    # The tip scatters more along some directions than along others, which isotropic components do not.
    assert np.sqrt(np.mean(found**2)) == pytest.approx(0.1, rel=0.12)


@pytest.mark.slow
def test_shipped_arms():
    """Robots by their data sheets, measuring arms by their class."""
    assert load_noise("panda").arm_class == "robot"
    assert "ISO 9283" in load_noise("panda").source
    assert encoder(load_noise("panda")) == pytest.approx(
        float(noise_of_repeatability(aj.load_arm("panda"), 0.1).encoder_arcsec)
    )
    assert encoder(load_noise("cheng2018-simulation")) == pytest.approx(2.0)
    for name in aj.files.shipped_arms():
        expected = {"cheng2018": "measuring arm", "so100": "hobby arm"}.get(name.split("-")[0], "robot")
        stated = usual_noise(name)
        assert stated is not None, name
        assert stated.arm_class == expected, name
    assert encoder(load_noise("ur5e")) == pytest.approx(
        float(noise_of_repeatability(aj.load_arm("ur5e"), 0.03).encoder_arcsec)
    )
    assert encoder(load_noise("so100")) == pytest.approx(288, rel=0.01)  # a step of a servo with 4096 counts is 316


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::aacmm_jax.core.errors.IdentifiabilityWarning")
def test_a_hobby_arm_may_leave_residuals_that_no_measuring_arm_leaves():
    """Its class says so; without it a mistake is looked for. Exchanged joints leave more than any class does."""
    arm = aj.load_arm("so100")
    bounds = aj.Bounds.around(arm, aj.Parameters.free_of(arm, held=("theta_1", "d_1", "d_2", "d_3", "alpha_5", "a_5")))
    sockets = {"A": (0, -200, 150), "B": (0, -230, 230), "C": (80, -180, 120)}
    right = aj.simulate(arm, sockets, poses=8, encoder_arcsec=500, seed=1)
    wrong = aj.Capture({name: np.asarray(q)[:, [0, 1, 3, 2, 4]] for name, q in right.sockets.items()})
    for capture, usual, looked_into, implausible in (
        (right, None, True, False),
        (right, load_noise("so100"), False, False),
        (wrong, load_noise("so100"), True, True),
    ):
        recording = aj.Recording(capture, aj.kinematics.ArmSpecification(arm, "test"), usual=usual)
        record = aj.calibration.record_of(aj.identify(arm, capture, bounds), recording)
        assert (record.residual > record.largest_usual_residual, record.implausible_residual) == (
            looked_into,
            implausible,
        )


@pytest.mark.slow
def test_a_simulated_capture_keeps_what_is_usual_for_its_arm(aacmm, tmp_path):
    aacmm("simulate", "so100", "-o", "c.h5", "--socket", "A=0,-200,150", "--poses", 2)
    usual = aj.files.load_capture(tmp_path / "c.h5").usual
    assert usual is not None
    assert usual.arm_class == "hobby arm"


@pytest.mark.parametrize(
    ("stated", "arm_class", "arcsec", "seating"),
    [
        ("", "measuring arm", 2.0, 0.005),
        ('[noise]\nclass = "robot"\nencoder_arcsec = 7.0', "robot", 7.0, 0.005),
        ("[noise]\nencoder_arcsec = [1.0, 2.0, 3.0]\nseating_mm = 0.01", "measuring arm", [1.0, 2.0, 3.0], 0.01),
        ('[noise]\nclass = "hobby arm"', "hobby arm", None, 0.005),
        ("[noise]\nrepeatability_mm = 0.2", "measuring arm", 0.2, 0.005),
    ],
)
def test_tables(tmp_path, stated, arm_class, arcsec, seating):
    (tmp_path / "arm.toml").write_text(TABLE + stated)
    found, arm = load_noise(tmp_path / "arm.toml"), aj.load_arm(tmp_path / "arm.toml")
    if arcsec is None:
        arcsec = class_noise(arm, arm_class).encoder_arcsec
    elif arcsec == 0.2:
        arcsec = noise_of_repeatability(arm, 0.2).encoder_arcsec
    assert found.arm_class == arm_class
    np.testing.assert_allclose(found.noise.encoder_arcsec, arcsec, rtol=1e-12)
    assert float(found.noise.seating) == seating


def test_a_urdf_is_a_robots():
    file = Path(__file__).with_name("six_axis.urdf")
    found = load_noise(file, tip="tool0")
    expected = noise_of_repeatability(aj.load_arm(file, tip="tool0"), CLASSES["robot"].repeatability)
    assert found.arm_class == "robot"
    assert encoder(found) == pytest.approx(float(expected.encoder_arcsec))


@pytest.mark.parametrize(
    ("stated", "text"),
    [
        ("[noise]\nrepeatability_mm = 0.1\nencoder_arcsec = 3.0", "repeatability_mm and encoder_arcsec both state"),
        ("[noise]\nencoder_arcsec = [1.0, 2.0]", "encoder_arcsec has 2 values, but the arm has 3 joints"),
        ("[noise]\nencoder_arcsec = 0.0\nseating_mm = 0.0", "every standard deviation of the noise is zero"),
        ("[noise]\nrepeatability_mm = -0.1", "greater than 0"),
        ('[noise]\nclass = "crane"', "class"),
        ("[noise]\nrepeatability = 0.1", "repeatability"),
    ],
)
def test_refused(tmp_path, stated, text):
    (tmp_path / "arm.toml").write_text(TABLE + stated)
    with pytest.raises(aj.InputError, match=text):
        load_noise(tmp_path / "arm.toml")

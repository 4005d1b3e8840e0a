"""Backlash, and loads at the tip: what joints do by direction of approach, by gravity and by what the tip carries."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics.findings import findings_of, sentences
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.arm import value_of
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.pipeline.capture_calibration import calibrate_capture
from aacmm_jax.pipeline.model_ladder import default_models

QUICKLY = {"cross_validate": False, "automatic": False}
PLAY = {"play_2": np.radians(0.2), "play_5": np.radians(0.2)}
SOCKETS = {"A": (400, 200, 300), "B": (700, -200, 200), "C": (300, -500, 500), "D": (-400, 400, 300)}


@pytest.fixture(scope="module")
def nominal():
    return aj.load_arm("ur10e").replace(directions=True)


def test_a_joint_lags_by_half_its_play(nominal):
    random = np.random.default_rng(0)
    q, directions = random.uniform(-1, 1, (9, 6)), random.choice([-1.0, 0.0, 1.0], (9, 6))
    arm = with_corrections(nominal, "backlash").replace(**PLAY)
    moved = q - 0.5 * directions * np.radians([0, 0.2, 0, 0, 0.2, 0])
    np.testing.assert_allclose(arm.position(np.hstack([q, directions])), nominal.position(moved), atol=1e-9)
    np.testing.assert_array_equal(arm.position(q), nominal.position(q))  # without directions nothing is known


@pytest.mark.parametrize(
    ("angle", "side"), [(30, -0.5), (150, 0.5), (90, 0.0), (88, -0.5 * np.cos(np.radians(88)) / 0.1)]
)
def test_a_joint_hangs_to_the_side_of_gravity(angle, side):
    """A pendulum: beyond the vertical it falls to the other side, and where gravity hardly decides to neither."""
    arm = aj.Arm(alpha=[np.pi / 2, 0.0], a=[0.0, 400.0], d=[500.0, 0.0], limits=[(-3, 3)] * 2)
    hangs = with_corrections(arm, ["hang_2"]).replace(hang_2=0.01)
    q = np.array([0.7, np.radians(angle)])
    np.testing.assert_allclose(hangs.position(q), arm.position(q + 0.01 * np.array([0, side])), atol=1e-9)
    assert not hangs.beside.possible  # nothing need be recorded


def test_a_joint_yields_to_the_load(nominal):
    """5 kg at 0.4 m, level: 19.6 N m, at 0.5 rad/(kN m)."""
    arm = aj.Arm(alpha=[np.pi / 2, 0.0], a=[0.0, 400.0], d=[500.0, 0.0], limits=[(-3, 3)] * 2)
    soft = with_corrections(arm, "load").replace(payload_2=0.5)
    for load in (0.0, 5.0):
        moved = arm.position([0.7, -0.5e-3 * load * 9.80665 * 0.4])
        np.testing.assert_allclose(soft.position([0.7, 0.0, load]), moved, atol=1e-9)
    np.testing.assert_array_equal(soft.position([0.7, 0.0]), arm.position([0.7, 0.0]))


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("chains", [(), {"one": (1, 2), "other": (3, 4)}], ids=["arm", "robot"])
def test_a_load_acts_at_its_centre(chains):
    """3 kg, 350 mm along the link and 20 mm across it, which is turned by q: its lever is 350 cos q - 20 sin q."""
    rows = {"alpha": [np.pi / 2, 0.0], "a": [0.0, 300.0], "d": [100.0, 0.0]}
    rows = {kind: values * (2 if chains else 1) for kind, values in rows.items()}
    arm = aj.Arm(**rows, probe=(10, 0, 0), load=True, load_centre=(50, 20, 5), chains=chains)
    soft = with_corrections(arm, ["payload_2", *["payload_4"] * bool(chains)])
    chain = (1,) if chains else ()
    for q in (0.4, -1.0):
        moment = 3 * 9.80665e-3 * 1e-3 * (350 * np.cos(q) - 20 * np.sin(q))  # kN m
        joints = np.array([0.3, q])
        at = np.concatenate([np.zeros(2), joints] if chains else [joints])
        bent = at + np.eye(len(at))[-1] * -0.5 * moment
        yields = soft.replace(**{f"payload_{len(at)}": 0.5})
        np.testing.assert_allclose(yields.position([*at, *chain, 3.0]), arm.position([*bent, *chain, 3.0]), atol=1e-9)
    names = [name for name in aj.kinematics.parameter_names(yields) if not name.startswith("gravity")]
    by_names = np.asarray(yields.jacobian([*at, *chain, 3.0], names))
    for name, column in zip(names, by_names.T, strict=True):
        value = value_of(yields, name)
        up, down = (yields.replace(**{name: value + step}).position([*at, *chain, 3.0]) for step in (1e-4, -1e-4))
        np.testing.assert_allclose(column, (np.asarray(up) - np.asarray(down)) / 2e-4, atol=1e-4)
    if chains:
        alone = aj.kinematics.chain_of(yields, "other")
        assert alone.arm.load_centre == (50.0, 20.0, 5.0)
        np.testing.assert_allclose(alone.arm.position([*joints, 3.0]), yields.position([*at, 1, 3.0]), atol=1e-9)


@pytest.mark.slow
def test_files_keep_the_centre_of_a_load(tmp_path):
    arm = aj.load_arm("ur10e").replace(load=True, load_centre=(1.0, 2.0, 60.0))
    aj.files.save_arm(arm, tmp_path / "arm.toml")
    assert aj.load_arm(tmp_path / "arm.toml").load_centre == arm.load_centre
    capture = aj.simulate(arm, {"A": (500, 200, 300)}, poses=3, load=[0, 2])
    aj.files.save_capture(tmp_path / "c.h5", aj.Recording(capture, ArmSpecification(arm)))
    assert aj.files.load_capture(tmp_path / "c.h5").nominal.arm.load_centre == arm.load_centre
    with pytest.raises(aj.InputError, match="load_centre"):
        arm.replace(load_centre=(1.0, 2.0))


URDF = (
    '<robot name="one"><link name="base"/><link name="post"/><link name="upper"/><link name="flange"/>'
    '<joint name="turn" type="revolute"><parent link="base"/><child link="post"/><axis xyz="0 0 1"/>'
    '<limit lower="-1" upper="1"/></joint>'
    '<joint name="lean" type="revolute"><parent link="post"/><child link="upper"/><axis xyz="0 1 0"/>'
    '<limit lower="-1" upper="1"/></joint><joint name="end" type="fixed"><parent link="upper"/><child link="flange"/>'
    '<origin xyz="0.3 0 0.1"/></joint></robot>'
)


@pytest.mark.slow
def test_a_manifest_states_the_centre_of_a_load_from_the_flange(tmp_path):
    """Of a URDF from its tip link: 2 kg, 50 mm beyond the flange, which is 300 mm from the axis."""
    (tmp_path / "one.urdf").write_text(URDF)
    (tmp_path / "a.csv").write_text("q_1 [rad],q_2 [rad],load_kg\n0.0,0.0,2.0\n0.1,0.1,0.0\n")
    lines = ['arm = "one.urdf"', "probe = [0, 0, 20]", "load_centre = [50, 0, 0]", 'socket = [{ file = "a.csv" }]']
    (tmp_path / "m.toml").write_text("\n".join(lines))
    arm = aj.files.read_manifest(tmp_path / "m.toml").nominal.arm
    soft = with_corrections(arm, ["payload_2"]).replace(payload_2=1.0)
    ends = np.asarray(soft.position([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]))
    turned = np.linalg.norm(ends[0] - ends[1]) / np.hypot(300, 120)
    assert turned == pytest.approx(2 * 9.80665 * 0.35 * 1e-3, rel=1e-4)
    (tmp_path / "a.csv").write_text("q_1 [rad],q_2 [rad]\n0.0,0.0\n0.1,0.1\n")
    with pytest.raises(aj.InputError, match="load_centre is given, but no table has load_kg"):
        aj.files.read_manifest(tmp_path / "m.toml")


def recorded(nominal, coefficients, seed=1, encoder=72):
    """80 poses of an arm that differs from its drawing; noise of the encoders of 0.02 deg, by default."""
    true = aj.perturbed_arm(aj.Parameters.free_of(nominal), length=0.3, angle=5e-4, seed=seed)
    if coefficients:
        true = with_corrections(true, list(coefficients)).replace(**coefficients)
    noise = aj.Noise(encoder_arcsec=encoder, seating=0.01)
    lengths = [("A", "B", 0.01), ("C", "D", 0.01)]
    return aj.simulate(true, SOCKETS, poses=20, lengths=lengths, noise=noise, seed=seed)


@pytest.mark.slow
def test_backlash_is_named_and_found(nominal):
    capture = recorded(nominal, PLAY)
    assert capture.columns == 12
    assert default_models(nominal, capture)[:4] == ("dh", "backlash", "gravity", "gravity,backlash")
    recording = aj.Recording(capture, ArmSpecification(nominal))
    plain = calibrate_capture(recording, model="dh", **QUICKLY)
    text = " ".join(sentences(findings_of(plain)))
    assert "the direction of approach of joint" in text
    assert "--model dh,backlash" in text
    record = calibrate_capture(recording, model="dh,backlash", **QUICKLY)
    for name, value in PLAY.items():
        number = record.names.index(name)
        assert abs(value_of(record.calibrated.arm, name) - value) < 3 * np.sqrt(record.covariance[number, number])


@pytest.mark.slow
def test_play_that_gravity_decides_is_named_without_directions():
    """Nothing is recorded but the readings; half of 0.2 deg is 360 arcsec."""
    specification = aj.files.load_specification("ur10e")  # holds what parallel axes do not determine
    capture = recorded(specification.arm, {"hang_2": np.radians(0.2), "hang_3": np.radians(0.2)})
    record = calibrate_capture(aj.Recording(capture, specification), model="dh", **QUICKLY)
    text = " ".join(sentences(findings_of(record)))
    assert "the side to which gravity turns joint 3 (360 arcsec)" in text
    assert "try --model dh,backlash=gravity" in text


@pytest.mark.slow
def test_without_play_nothing_is_named(nominal):
    record = calibrate_capture(aj.Recording(recorded(nominal, {}), ArmSpecification(nominal)), model="dh", **QUICKLY)
    assert not [sentence for sentence in sentences(findings_of(record)) if "backlash" in sentence]


@pytest.mark.parametrize(
    ("model", "message"), [("backlash=weight", "backlash=weight is unknown"), ("load=2", "load takes")]
)
def test_models_that_are_unknown(nominal, model, message):
    with pytest.raises(aj.InputError, match=message):
        with_corrections(nominal, model)


@pytest.mark.slow
def test_a_calibration_judges_a_capture_with_other_columns(nominal):
    """Directions that the calibrated arm does not know are left out; those that a capture lacks are unknown."""
    plain = aj.load_arm("ur10e")
    sides, none = recorded(nominal, {}), recorded(plain, {}, seed=2)
    for arm, capture, other, given in ((plain, none, sides, nominal), (nominal, sides, none, plain)):
        record = calibrate_capture(aj.Recording(capture, ArmSpecification(arm)), model="dh", **QUICKLY)
        judged = aj.evaluate_capture(record, aj.Recording(other, ArmSpecification(given)))
        assert len(judged.recording.capture.readings) == 80

"""Arms with joint corrections in files: they come back to the bit, with the nominal arm that their functions are of."""

import h5py
import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.arm_tables import with_model
from aacmm_jax.files.arms import load_specification, save_arm, specification_toml
from aacmm_jax.files.controllers.tables import python_program
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.arm import correction_names
from tests.prismatic_arms import SCARA

MASSES = {"mass": [1.0, 2.0, 0.5], "centre": np.arange(9.0).reshape(3, 3)}


def corrected(**masses) -> aj.Arm:
    """An arm whose parameters have changed since its corrections were chosen."""
    arm = aj.Arm(alpha=[1.5, 0.1, 0.4], a=[50.0, 300.0, 40.0], d=[20.0, 0.0, 250.0], beta=[0, 0.1, 0])
    arm = with_corrections(
        arm.replace(limits=[(-2, 2)] * 3), f"gravity{'=masses' * bool(masses)},harmonics=1,gear", **masses
    )
    return arm.replace(coefficients=1e-3 * np.arange(len(arm.coefficients)), d_3=251.0, gravity=(0, 0.1, -1))


def same(one: aj.Arm, other: aj.Arm) -> bool:
    leaves = jax.tree.leaves(one), jax.tree.leaves(other)
    return jax.tree.structure(one) == jax.tree.structure(other) and all(map(np.array_equal, *leaves))


@pytest.mark.slow
@pytest.mark.parametrize("masses", [pytest.param({}, marks=pytest.mark.slow), MASSES])
def test_files_bring_the_same_arm_back(masses, tmp_path):
    arm = corrected(**masses)
    save_arm(arm, tmp_path / "arm.toml")
    assert same(arm, aj.load_arm(tmp_path / "arm.toml"))
    specification = load_specification(tmp_path / "arm.toml")
    capture = aj.Capture({"A": np.zeros((4, 3))})
    aj.files.save_capture(tmp_path / "capture.h5", aj.Recording(capture, specification))
    assert same(arm, aj.files.load_capture(tmp_path / "capture.h5").nominal.arm)


@pytest.mark.slow
@pytest.mark.parametrize("torques", [False, True])
def test_an_arm_with_a_thermometer_comes_back(torques, tmp_path):
    """Readings in every table, with what was recorded beside them; and the arm, with and without expansion."""
    plain = SCARA.replace(torques=torques, thermometer=True)
    q = np.random.default_rng(0).uniform(-1, 1, (12, plain.columns)) + 21.5 * (np.arange(plain.columns) > 3)
    points = aj.data.observations.MeasuredPoints("T", q[4:8], q[4:8, :3], u=0.01)
    ball = aj.data.ProbedSphere("ball", "probing", (q[8:],), 25.0)
    for arm in (plain, with_corrections(plain, "expansion,gear").replace(expansion=12e-6)):
        save_arm(arm, tmp_path / "arm.toml")
        assert same(arm, aj.load_arm(tmp_path / "arm.toml"))
        recording = aj.Recording(aj.Capture({"A": q[:4]}, [], [points]), load_specification(tmp_path / "arm.toml"))
        aj.files.save_capture(tmp_path / "capture.h5", recording._replace(spheres=(ball,)))
        found = aj.files.load_capture(tmp_path / "capture.h5")
        assert same(arm, found.nominal.arm)
        np.testing.assert_array_equal(found.capture.readings, q[:8])
        np.testing.assert_array_equal(found.spheres[0].groups[0], q[8:])
    with h5py.File(tmp_path / "capture.h5") as file:
        assert file["capture/angle"].shape == (4, 4)
        assert dict(file["capture/temperature"].attrs)["units"] == "degC"
        assert ("torque" in file["capture"]) == torques


def plain_toml():
    arm = corrected().replace(coefficients=None, gravity=None, corrections=None)
    return specification_toml(aj.kinematics.ArmSpecification(arm), proposed=False)


@pytest.mark.slow
def test_a_model_in_an_arm_file(tmp_path):
    plain = plain_toml()
    file = tmp_path / "arm.toml"
    file.write_text(plain + '\n[corrections]\nmodel = "harmonics=2"\ngravity = [0, 1, 0]\n')
    specification = load_specification(file)
    assert correction_names(specification.arm) == tuple(f"{word}2_{i}" for i in (1, 2, 3) for word in ("cos", "sin"))
    assert "sin2_2" in specification.space().names  # free where data determine it
    for text, sentence in {
        'model = "gear"\ncoefficients = {gear_1 = 1e-3}': "exactly one of model and coefficients",
        'model = "gears"': "unknown model 'gears'; did you mean 'gear'",
        "coefficients = {gear_4 = 1e-3}": "'gear_4' must name a joint from 1 to 3",
        'model = "gravity=masses"\nmass = [1, 2, 3]': "give both or neither",
        'model = "gravity"\nmass = [1, 2, 3]': "apply only to the models gravity=masses and torque",
        "coefficients = {gear_1 = 1e-3}\nnominal = {alfa = [1, 2, 3]}": "nominal has the unknown key 'alfa'",
    }.items():
        file.write_text(f"{plain}\n[corrections]\n{text}\n")
        with pytest.raises(aj.InputError, match=sentence):
            aj.load_arm(file)


@pytest.mark.slow
def test_expansion_of_an_arm_file_is_free_at_several_temperatures(tmp_path):
    """Of a manifest, also with the same model on the command line, and of a study."""
    (tmp_path / "arm.toml").write_text(plain_toml() + '\n[corrections]\nmodel = "expansion"\n')
    manifest = tmp_path / "capture.toml"
    manifest.write_text('arm = "arm.toml"\n[angles]\nunit = "rad"\n[[socket]]\nname = "A"\nfile = "A.csv"\n')
    q = np.random.default_rng(0).uniform(-1, 1, (8, 3))
    header, rows = "q1,q2,q3,temperature_C", np.column_stack([q, np.linspace(15.0, 25.0, len(q))])
    np.savetxt(tmp_path / "A.csv", rows, delimiter=",", header=header, comments="")
    recording = aj.files.read_manifest(manifest)
    study = aj.study.make_study(arm=tmp_path / "arm.toml", trials=1, capture=recording.capture)
    for specification in (recording.nominal, with_model(recording.nominal, "expansion"), study.nominal):
        assert "expansion" in specification.space().names


def test_formats_without_a_place_for_corrections_refuse_them():
    with pytest.raises(aj.InputError, match="joint corrections, which this format cannot store"):
        python_program(corrected(), title="")

"""Arms with joint corrections in files: they come back to the bit, with the nominal arm that their functions are of."""

import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.arms import arm_toml, load_specification, save_arm
from aacmm_jax.files.controllers import dh_table
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.arm import correction_names

MASSES = {"mass": [1.0, 2.0, 0.5], "centre": np.arange(9.0).reshape(3, 3)}


def corrected(**masses) -> aj.Arm:
    """An arm whose parameters have changed since its corrections were chosen."""
    arm = aj.Arm(alpha=[1.5, 0.1, 0.4], a=[50.0, 300.0, 40.0], d=[20.0, 0.0, 250.0], beta=[0, 0.1, 0])
    arm = with_corrections(arm.replace(limits=[(-2, 2)] * 3), "gravity,harmonics=1,gear", **masses)
    return arm.replace(coefficients=1e-3 * np.arange(len(arm.coefficients)), d_3=251.0, gravity=(0, 0.1, -1))


def same(one: aj.Arm, other: aj.Arm) -> bool:
    leaves = jax.tree.leaves(one), jax.tree.leaves(other)
    return jax.tree.structure(one) == jax.tree.structure(other) and all(map(np.array_equal, *leaves))


@pytest.mark.parametrize("masses", [pytest.param({}, marks=pytest.mark.slow), MASSES])
def test_files_bring_the_same_arm_back(masses, tmp_path):
    arm = corrected(**masses)
    save_arm(arm, tmp_path / "arm.toml")
    assert same(arm, aj.load_arm(tmp_path / "arm.toml"))
    specification = load_specification(tmp_path / "arm.toml")
    capture = aj.Capture({"A": np.zeros((4, 3))})
    aj.files.save_capture(tmp_path / "capture.h5", aj.Recording(capture, specification))
    assert same(arm, aj.files.load_capture(tmp_path / "capture.h5").nominal.arm)


def test_a_model_in_an_arm_file(tmp_path):
    plain = arm_toml(corrected().replace(coefficients=None, gravity=None, corrections=None))
    file = tmp_path / "arm.toml"
    file.write_text(plain + '\n[corrections]\nmodel = "harmonics=2"\ngravity = [0, 1, 0]\n')
    specification = load_specification(file)
    assert correction_names(specification.arm) == tuple(f"{word}2_{i}" for i in (1, 2, 3) for word in ("cos", "sin"))
    assert "sin2_2" in specification.space().names  # free where data determine it
    for text, sentence in {
        'model = "gear"\ncoefficients = {gear_1 = 1e-3}': "give either model",
        'model = "gears"': "unknown model 'gears'; did you mean 'gear'",
        "coefficients = {gear_4 = 1e-3}": "'gear_4' is of a joint from 1 to 3",
        'model = "gravity"\nmass = [1, 2, 3]': "give both mass and centre",
        "coefficients = {gear_1 = 1e-3}\nnominal = {alfa = [1, 2, 3]}": "nominal has no 'alfa'",
    }.items():
        file.write_text(f"{plain}\n[corrections]\n{text}\n")
        with pytest.raises(aj.InputError, match=sentence):
            aj.load_arm(file)


def test_formats_of_dh_tables_refuse_corrections():
    with pytest.raises(aj.InputError, match="joint corrections, which this format cannot hold"):
        dh_table(corrected())

"""The template of an arm file: valid as it stands, with every key that an arm file may have."""

import re
import tomllib

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.arm_tables import (
    ArmFile,
    CorrectionsTable,
    Identification,
    JointTable,
    NoiseTable,
    PriorTable,
    arm_template,
)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("joints", [1, 2, 3, 6, 7, 20])
def test_the_template_loads(tmp_path, joints):
    (tmp_path / "my.toml").write_text(arm_template(joints))
    arm = aj.files.load_specification(tmp_path / "my.toml").arm
    assert arm.joints == joints
    assert not {i for i in range(joints - 1) if np.sin(float(arm.alpha[i])) == 0}  # no axis is parallel to the next


def test_every_key_is_in_it_and_valid(tmp_path):
    text = arm_template(6)
    for model in (ArmFile, JointTable, Identification, NoiseTable, PriorTable, CorrectionsTable):
        for name, field in model.model_fields.items():
            key = field.alias or name
            assert re.search(rf"\b{key}\b", text), key
    # Keys that are commented out can be used as they are written.
    uncommented = re.sub(r"^# (\[identification\]|(?:held|free|length|angle|override) = )", r"\1", text, flags=re.M)
    assert tomllib.loads(uncommented)["identification"].keys() == Identification.model_fields.keys()
    (tmp_path / "my.toml").write_text(uncommented)
    specification = aj.files.load_specification(tmp_path / "my.toml")
    assert specification.override == {"probe_z": 60.0}
    # Without its comments it is the same file.
    assert tomllib.loads(re.sub(r"#.*", "", text)) == tomllib.loads(text)


def test_what_a_first_user_fills_in_is_short_and_complete(tmp_path):
    """All that is not a comment stands before the optional part, and is an arm file by itself."""
    needed, mark, optional = arm_template(6).partition("\n# Optional")
    assert mark
    assert len(needed.split()) <= 320
    rows = needed.index("joint = [")
    assert len(needed[:rows].split()) <= 170
    assert [line for line in optional.splitlines()[1:] if line and not line.startswith("#")] == []
    (tmp_path / "my.toml").write_text(needed)
    (tmp_path / "all.toml").write_text(arm_template(6))
    first, whole = (aj.files.load_specification(tmp_path / name) for name in ("my.toml", "all.toml"))
    np.testing.assert_array_equal(first.arm.alpha, whole.arm.alpha)
    assert set(tomllib.loads(needed)) == {
        "name", "source", "convention", "length_unit", "angle_unit", "probe", "joint"
    }  # fmt: skip


@pytest.mark.parametrize("joints", [0, 21])
def test_numbers_of_joints_that_no_arm_has(joints):
    with pytest.raises(aj.InputError, match="from 1 to 20"):
        arm_template(joints)

"""The README's Python runs as printed, and its manifest and arm file are read as printed."""

import re
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj

README = (Path(__file__).resolve().parents[1] / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def table_with(text: str) -> str:
    """The one TOML block in which a text stands."""
    (found,) = (block for block in blocks("toml") if text in block)
    return found


@pytest.mark.exhaustive
@pytest.mark.optimised  # it computes more than it compiles
def test_python_runs(capsys, tmp_path, monkeypatch):
    """The blocks continue one another, so they run as one program."""
    monkeypatch.chdir(tmp_path)
    exec(compile("\n".join(blocks("python")), "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "Converged" in printed
    assert "\nTrue " in printed


def test_no_command_overwrites_an_earlier_result():
    written = re.findall(r"^aacmm .*? -o (\S+)", README, flags=re.MULTILINE)
    assert "calibration.h5" in written
    # A report of one calibration may be written again, with the laboratory's data.
    assert len({*written}) == len(written) - written.count("report.html") + 1


def test_study_is_read(tmp_path):
    (tmp_path / "study.toml").write_text(table_with("trials = 1000"))
    assert len(aj.study.read_study(tmp_path / "study.toml").cells) == 6


def test_administrative_data_is_read(tmp_path):
    # The table of conformity is commented out, because few certificates have one.
    uncommented = re.sub(r"^# (\[conformity\]|\w+ = )", r"\1", table_with("[conformity]"), flags=re.MULTILINE)
    (tmp_path / "laboratory.toml").write_text(uncommented)
    data = aj.files.read_administrative_data(tmp_path / "laboratory.toml")
    # The example has every key.
    stated = data.model_dump(exclude_unset=True)
    for part, model in ((name, field.annotation) for name, field in type(data).model_fields.items()):
        entry = stated[part][0] if isinstance(stated[part], list) else stated[part]
        if part not in ("customer", "person", "reference", "conformity"):
            assert set(entry) == set(model.model_fields), part


def test_arm_file_is_read(tmp_path):
    (tmp_path / "arm.toml").write_text(blocks("toml")[1])
    assert aj.load_arm(tmp_path / "arm.toml").joints == 3


def test_the_manifest_is_the_one_of_the_examples(mukca):
    assert blocks("toml")[0] == (mukca / "capture.toml").read_text()
    assert blocks("toml")[2] == (mukca.parent / "ipa_ur10" / "positions.toml").read_text()


def test_the_shipped_arms_are_named():
    (paragraph,) = re.findall(r"^Shipped arms: .*?\n\n", README, flags=re.DOTALL | re.MULTILINE)
    assert set(re.findall(r"`([a-z0-9-]+)`", paragraph)) == set(aj.files.shipped_arms())


def test_the_manifest_of_a_robot_is_read(tmp_path):
    (manifest,) = re.findall(r"```\n(arm = \"robot.urdf\"\n.*?)```", README, flags=re.DOTALL)
    (tmp_path / "robot.toml").write_text(manifest)
    urdf = (Path(__file__).parent / "files" / "six_axis.urdf").read_text()
    (tmp_path / "robot.urdf").write_text(urdf)
    random = np.random.default_rng(0)
    rows = np.hstack([random.uniform(-60, 60, (9, 6)), random.uniform(-500, 500, (9, 3))])
    header = "J1,J2,J3,J4,J5,J6,x,y,z"
    np.savetxt(tmp_path / "tracker.csv", rows, delimiter=",", header=header, comments="")
    recording = aj.files.read_manifest(tmp_path / "robot.toml")
    (points,) = recording.capture.observations
    np.testing.assert_allclose(points.q, np.deg2rad(rows[:, :6]))
    np.testing.assert_allclose(points.covariance, np.broadcast_to(0.02**2 * np.eye(3), (9, 3, 3)))


def test_the_kit_can_be_read(tmp_path):
    (tmp_path / "kit.toml").write_text(table_with("ball bar"))
    assert [(item.simulated.name, item.places) for item in aj.files.read_kit(tmp_path / "kit.toml")] == [
        ("ball bar", 3),
        ("tracker", 0),
    ]


def test_the_cell_and_the_noise_can_be_read(tmp_path):
    (tmp_path / "cell.toml").write_text(table_with("cabinet"))
    assert [one.name for one in aj.files.load_cell("panda", tmp_path / "cell.toml").cell.obstacles] == [
        "wall", "cabinet"
    ]  # fmt: skip
    (tmp_path / "arm.toml").write_text(table_with("joint = [") + table_with("repeatability_mm"))
    assert aj.files.load_noise(tmp_path / "arm.toml").source == "data sheet"

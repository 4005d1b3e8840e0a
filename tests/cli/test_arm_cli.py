"""``aacmm arm``: an arm looked at, a template, readings compared with an arm."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics import reading_check, reading_search
from aacmm_jax.files.table_columns import read_poses
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.planning import first_capture
from aacmm_jax.summaries import arm_survey

URDF = Path(__file__).parents[1] / "files" / "six_axis.urdf"
Q = np.random.default_rng(1).uniform(-1.4, 1.4, (12, 6))  # rad


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(reading_search, "_MOST", 20_000)
    monkeypatch.setattr(reading_check, "_REFITTED", 6)


def write(path, header, rows):
    path.write_text("\n".join([",".join(header)] * bool(header) + [",".join(map(str, row)) for row in rows]) + "\n")


@pytest.mark.slow
def test_a_template_is_written_looked_at_and_not_overwritten(aacmm, tmp_path, monkeypatch):
    monkeypatch.setattr(first_capture, "_PLACEMENTS", 1)
    assert "Written: my.toml" in aacmm("arm", "--new", "my.toml", "--joints", 4).stdout
    assert "my.toml already exists" in aacmm("arm", "--new", "my.toml", expect=2).stderr
    said = aacmm("arm", "my.toml", "--figure", "arm.png")
    assert (tmp_path / "arm.png").read_bytes().startswith(b"\x89PNG")
    printed = " ".join(said.stdout.split())
    for part in (
        "Reach: ",
        "Redundant",
        "a_4 and probe_x trade off",
        "sockets and a reference length",
        "enough",
        "Record",
        "of 2 arcsec (encoders) and 0.005 mm (seating; class measuring arm: ",  # as aacmm plan assumes it
        "u = 0.002 mm (reference lengths)",
    ):
        assert part in printed, part


@pytest.mark.slow
def test_a_urdf_in_its_base_link(aacmm, monkeypatch):
    monkeypatch.setattr(arm_survey, "still_joints", lambda arm: [])  # half of the time
    monkeypatch.setattr(first_capture, "_PLACEMENTS", 1)
    found = json.loads(aacmm("arm", URDF, "--tip", "tool0", "--encoder-arcsec", 5, "--json").stdout)
    chain = aj.files.urdf_chain(aj.files.load_specification(URDF, tip="tool0").urdf)
    tip = found["frames"][-1]
    np.testing.assert_allclose(tip["origin_mm"], (chain.base @ chain.arm.pose(np.zeros(6)))[:3, 3], atol=1e-9)
    assert [row["joint"] for row in found["frames"]] == [1, 2, 3, 4, 5, 6, None]
    (needed,) = found["needed"]
    assert (needed["encoder_arcsec"], needed["seating_mm"]) == (pytest.approx(5), 0.005)
    assert (needed["class"], needed["noise_source"]) == ("robot", "as given")
    assert found["reach_mm"]["nearest"] < found["reach_mm"]["farthest"] < found["reach_mm"]["links"]
    assert set(found["free"]) | set(found["fixed"]) <= set(aj.kinematics.arm.parameter_names(chain.arm)) | {
        f"beta_{i}" for i in range(1, 7)
    }


@pytest.mark.slow
def test_an_arm_of_which_nothing_can_be_said(aacmm):
    aacmm("arm", "--new", "my.toml", "--joints", 1)
    assert "cannot be computed for this arm" in aacmm("arm", "my.toml").stdout


@pytest.mark.slow
def test_the_check_names_a_joint_that_moves_too_little(aacmm, tmp_path, few):
    arm, q = aj.load_arm("cheng2018-simulation"), Q.copy()
    q[:, 0] = np.linspace(0.0, 11.0, len(q)) * np.pi / 180
    header = [*(f"q_{i}_rad" for i in range(1, 7)), "x_mm", "y_mm", "z_mm"]
    write(tmp_path / "poses.csv", header, np.hstack([q, np.asarray(arm.position(q))]))
    said = aacmm("arm", "cheng2018-simulation", "--check", "poses.csv").stdout
    assert "Joint 1 turns by only 11 deg over 12 poses" in " ".join(said.split())


@pytest.mark.slow
def test_a_table_of_known_positions(aacmm, tmp_path, few):
    arm = aj.load_arm("cheng2018-simulation")
    columns = (Q * [1, 1, -1, 1, 1, 1])[:, [0, 1, 2, 4, 3, 5]]
    header = [*(f"q_{i}_deg" for i in range(1, 7)), "x_m", "y_m", "z_m"]
    write(tmp_path / "poses.csv", header, np.hstack([np.rad2deg(columns), np.asarray(arm.position(Q)) / 1000]))
    said = aacmm("arm", "cheng2018-simulation", "--check", "poses.csv").stdout
    assert said.startswith("Columns 4 and 5 are exchanged; column 3 has the opposite sign. Correcting this")
    angles = tomllib.loads(said[said.index("[angles]") : said.index("12 poses")])["angles"]
    assert angles == {"unit": "deg", "columns": [1, 2, 3, 5, 4, 6], "sign": [1, 1, -1, 1, 1, 1]}


@pytest.mark.slow
def test_positions_in_metres_are_no_matter_of_the_angles(aacmm, tmp_path, few, monkeypatch):
    """The line that is missing is printed, not the table [angles], which is right; px_m in a table is read as m."""
    monkeypatch.setattr(reading_search, "_MOST", 1000)
    points = np.asarray(aj.load_arm("cheng2018-simulation").position(Q)) / 1000
    header = [*(f"q_{i}" for i in range(1, 7)), "px_m", "py_m", "pz_m"]
    write(tmp_path / "p.csv", header, np.hstack([Q, points]))
    tables = '[[points]]\nfile = "p.csv"\ncolumns = { points = "p*_m" }\n'
    (tmp_path / "m.toml").write_text(f'arm = "cheng2018-simulation"\nangles = {{ unit = "rad" }}\n{tables}')
    said = aacmm("arm", "cheng2018-simulation", "--check", "m.toml").stdout
    assert said.startswith("The positions are in m, but were read as mm. Correcting this")
    assert 'units = { points = "m" }' in said
    assert "[angles]" not in said
    arm = aj.load_arm("cheng2018-simulation")
    np.testing.assert_allclose(
        read_poses(tmp_path / "p.csv", arm, unit="rad", recorded=True).poses[:, :3, 3], 1000 * points
    )


@pytest.mark.slow
def test_poses_of_a_urdf_are_in_its_base_link(aacmm, tmp_path, few):
    chain = aj.files.urdf_chain(aj.files.load_specification(URDF, base="shoulder", tip="tool0").urdf)
    q = Q[:, : chain.arm.joints]
    poses = chain.base @ np.asarray(chain.arm.pose(q))
    write(tmp_path / "poses.csv", [], np.hstack([q, poses[:, :3, 3]]))
    options = ("--base", "shoulder", "--tip", "tool0", "--check", "poses.csv", "--unit", "rad", "--json")
    found = json.loads(aacmm("arm", URDF, *options).stdout)
    assert (found["fits"], found["angles"]) == (True, None)
    assert found["given"]["rms_mm"] < 1e-6


@pytest.mark.slow
def test_what_is_found_corrects_the_manifest(aacmm, tmp_path, few):
    """Columns, signs and offsets that the manifest states already are taken into account."""
    capture = aj.simulate(aj.load_arm("cheng2018-simulation"), {"A": (400, 200, 300), "B": (600, 0, 400)}, poses=15)
    for name, q in capture.sockets.items():
        counts = (q - np.deg2rad([0, 90, 0, 0, 0, 0])) * [1, 1, 1, -1, 1, 1]
        write(tmp_path / f"{name}.csv", [], np.rad2deg(counts[:, [0, 1, 2, 3, 5, 4]]))
    sockets = '[[socket]]\nname = "{s}"\nfile = "{s}.csv"\n'
    stated = "sign = [1, 1, 1, 1, 1, -1]\noffset = [0, 0, 0, 0, 30, 0]\n"
    (tmp_path / "m.toml").write_text(f'arm = "cheng2018-simulation"\n[angles]\nunit = "deg"\n{stated}{sockets}')
    found = json.loads(aacmm("arm", "cheng2018-simulation", "--check", "m.toml", "--json").stdout)
    assert found["explained"]
    assert not found["fits"]
    (tmp_path / "m.toml").write_text(f'arm = "cheng2018-simulation"\n{found["angles"]}{sockets}')
    corrected = aj.files.read_manifest(tmp_path / "m.toml").capture
    # The arm is known to about a degree, and its mirror image is as good.
    evaluated = json.loads(aacmm("arm", "cheng2018-simulation", "--check", "m.toml", "--json").stdout)
    assert evaluated["fits"]
    assert corrected.columns == 6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("header", "size", "angles"),
    [
        (" [deg]", 180 / np.pi, ""),
        (" [rad]", 1.0, ""),
        ("", 180 / np.pi, 'unit = "deg"'),
        ("", 10_000 / np.pi, 'unit = "counts"\ncounts_per_turn = 20000'),
    ],
)
def test_the_printed_table_passes_the_check(aacmm, tmp_path, few, header, size, angles):
    """Column 3 runs the other way, and joint 4 has its zero a quarter of a revolution off."""
    capture = aj.simulate(aj.load_arm("cheng2018-simulation"), {"A": (400, 200, 300), "B": (600, 0, 400)}, poses=15)
    for name, q in capture.sockets.items():
        columns = (np.asarray(q) - np.deg2rad([0, 0, 0, -90, 0, 0])) * [1, 1, -1, 1, 1, 1] * size
        write(tmp_path / f"{name}.csv", [f"J{i}{header}" for i in range(1, 7)], columns)
    sockets = '[[socket]]\nname = "{s}"\nfile = "{s}.csv"\n'
    (tmp_path / "m.toml").write_text(
        'arm = "cheng2018-simulation"\n' + (f"[angles]\n{angles}\n" if angles else "") + sockets
    )
    found = json.loads(aacmm("import", "m.toml", "--check", "--json").stdout)["check"]
    assert (found["explained"], found["fits"]) == (True, False)
    (tmp_path / "m.toml").write_text(f'arm = "cheng2018-simulation"\n{found["angles"]}{sockets}')
    again = json.loads(aacmm("import", "m.toml", "--check", "--json").stdout)["check"]
    assert (again["fits"], again["angles"]) == (True, None)
    turns = np.array(tomllib.loads(found["angles"])["angles"]["offset"]) / (2 * np.pi * size)
    assert np.all(np.abs(turns) <= 0.5 + 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("zero", "warned"), [(101.0, False), (0.0, True)])
def test_limits_that_the_proposed_zeros_keep_are_no_warning(aacmm, tmp_path, few, zero, warned):
    """Columns stay as the manifest names them; readings that are outside and fit as they are keep the warning."""
    arm = aj.load_arm("so100")
    low, high = np.array(arm.limits).T
    q = np.random.default_rng(2).uniform(low + 0.2, high - 0.2, (20, 5))
    q[:4, 1] += 4.0 * warned  # rad, beyond the limits of joint 2
    rows = np.hstack([np.degrees(q) - [0, zero, 0, 0, 0], np.asarray(arm.position(q))])
    write(tmp_path / "p.csv", [*(f"J{i}" for i in range(1, 6)), "x_mm", "y_mm", "z_mm"], rows)
    tables = 'angles = { unit = "deg", columns = "J*" }\n[[points]]\nfile = "p.csv"\ncolumns = { points = "*_mm" }\n'
    (tmp_path / "m.toml").write_text(f'arm = "so100"\n{tables}')
    found = json.loads(aacmm("import", "m.toml", "--check", "--json").stdout)
    assert found["check"]["fits"] is warned
    assert any("lie outside its limits" in text for text in found["warnings"]) is warned
    if not warned:
        assert tomllib.loads(found["check"]["angles"])["angles"]["columns"] == "J*"


@pytest.mark.slow
def test_readings_that_nothing_explains(aacmm, tmp_path, few):
    write(tmp_path / "poses.csv", [], np.random.default_rng(0).uniform(-3, 3, (30, 6)))
    said = aacmm("arm", "cheng2018-simulation", "--check", "poses.csv", expect=1)
    assert said.stdout.startswith("No permutation, sign or zero offset of the columns explains these readings")


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ((), "name an arm"),
        (("panda", "--new", "x.toml"), "leave out the arm"),
        (("panda", "--joints", 6), "give --new too"),
        (("panda", "--unit", "deg"), "--check"),
        (("panda", "--check", "x.csv", "--figure", "a.png"), "leave out --figure"),
        (("panda", "--check", "x.toml", "--unit", "deg"), "states the unit"),
        (("panda", "--check", "none.csv"), "none.csv"),
        (("panda", "--figure", "a.gif"), ".png, .svg or .pdf"),
        (("panda", "--probe", "1,2"), "--probe"),
        (("panda", "--check", "x.csv", "--model", "gear"), "leave out --model"),
        (("panda", "--model", "grvity"), "did you mean 'gravity'"),
        (("no-arm",), "neither a file"),
    ],
)
def test_refusals(aacmm, arguments, part):
    assert part in aacmm("arm", *arguments, expect=2).stderr


def test_a_model_of_which_nothing_is_left_out():
    """All coefficients of gear are independent of each other, so that there is nothing to explain."""
    assert arm_survey._left_out(with_corrections(aj.load_arm("panda"), "gear"), "gear") == []


@pytest.mark.slow
def test_a_capture_of_another_number_of_joints(aacmm, mukca):
    said = aacmm("arm", "cheng2018-simulation", "--check", mukca / "panda_3.toml", expect=2).stderr
    assert "7 joints" in said


@pytest.mark.slow
def test_import_checks_the_readings(aacmm, tmp_path, few, paper_arm, paper_capture):
    """Joint 5 moves by 0.1 deg; commanded readings differ from measured ones. Nothing is written without -o."""
    q = np.array(paper_capture.q)[:60]
    q[:, 4] = 0.4 + np.radians(np.linspace(0, 0.1, len(q)))
    commanded = q + 1e-6 * np.random.default_rng(0).normal(size=q.shape)
    table = np.hstack([commanded, q, np.asarray(paper_arm.position(q))])
    header = [*(f"target_q_{i}" for i in range(6)), *(f"actual_q_{i}" for i in range(6)), "x", "y", "z"]
    np.savetxt(tmp_path / "t.csv", table, delimiter=",", header=",".join(header), comments="", fmt="%.9f")
    (tmp_path / "m.toml").write_text(
        'arm = "cheng2018-simulation"\nangles = { unit = "rad" }\n[[points]]\nfile = "t.csv"\nu = 0.02\n'
        'columns = { q = "actual_q_*", points = ["x", "y", "z"] }\n'
    )
    before = sorted(tmp_path.iterdir())
    shown = " ".join(aacmm("import", "m.toml", "--check").stdout.split())
    assert sorted(tmp_path.iterdir()) == before
    assert "The readings fit as they are" in shown
    assert (
        "Joint 5 moves too little (0.1 deg over 60 poses): alpha_5, a_5, d_5 and theta_5 cannot be identified;" in shown
    )
    assert "the manifest uses the readings that fit better: a calibration with the measured readings leaves" in shown
    assert "--check" in aacmm("import", "m.toml", expect=2).stderr

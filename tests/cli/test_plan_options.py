"""Options of ``aacmm plan`` that say what the arm can do: cones, obstacles, approach points, noise, units."""

import csv
import json
import os

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.cli.plan_commands import _probe_axis, arm_for

PLAN = (
    *("plan", "panda", "-o", "plan.csv", "--poses", 16, "--candidates", 120),
    *("--socket", "A=450,100,200", "--socket", "B=450,-300,200", "--length", "A,B,0.002"),
)
CELL = '[body]\nradius = 50.0\n[[box]]\nname = "cabinet"\ncentre = [0, 700, 300]\nsize = [400, 200, 600]\n'


@pytest.mark.slow
def test_cones_obstacles_and_radians(aacmm, tmp_path):
    (tmp_path / "cell.toml").write_text(CELL)
    options = (
        *("--cone-deg", 50, "--cone-deg", "A=35", "--normal", "B=0.5,0,1", "--cell", "cell.toml"),
        *("--angles", "rad", "--unconstrained", "--manifest", "capture.toml", "--retract-mm", 30),
    )
    summary = json.loads(aacmm(*PLAN, *options, "--json").stdout)
    rows = {row["socket"]: row for row in summary["sockets"]}
    assert {name: row["cone_deg"] for name, row in rows.items()} == pytest.approx({"A": 35, "B": 50})
    assert all(row["largest_tilt_deg"] <= row["cone_deg"] + 1e-6 for row in rows.values())
    assert rows["B"]["normal"] == pytest.approx((np.array([0.5, 0, 1]) / np.sqrt(1.25)).tolist())
    assert summary["collisions"]["obstacles"] == ["table", "cabinet"]
    assert summary["unconstrained"]["largest_mm"] < summary["predicted"]["largest_mm"]
    assert summary["encoder_arcsec"] == pytest.approx(9.045, abs=0.01)
    # Readings as the plan has them come back through its manifest, approach rows left out.
    with open(tmp_path / "plan.csv", newline="") as file:
        planned = [row for row in csv.DictReader(file) if row["move"] == "pose"]
    for name in rows:
        q = [[row[f"q_{i}_rad"] for i in range(1, 8)] for row in planned if row["socket"] == name]
        (tmp_path / f"{name}.csv").write_text("\n".join(",".join(row) for row in q))
    capture = aj.files.read_manifest(tmp_path / "capture.toml").capture
    assert sum(capture.sizes) == 16
    tips = np.asarray(aj.load_arm("panda").position(capture.sockets["A"]))
    np.testing.assert_allclose(tips, np.tile([450, 100, 200], (len(tips), 1)), atol=2e-3)


@pytest.mark.slow
def test_a_robot_by_default(aacmm):
    """Cones of 55 deg, approach points 50 mm above, the noise of its data sheet; no obstacles unless asked for."""
    printed = " ".join(aacmm(*PLAN, "--collisions").stdout.split())
    for text in (
        "noise of 9.04 arcsec (encoders)",
        "Franka Emika data sheet",
        "via approach points 50 mm above the sockets",
        "the arm's body with itself and with obstacles (table)",
        "Not checked for collisions, because these parts touch in every pose of the arm: offset d_1 and table.",
        "Note: every link is assumed to be a capsule with a radius of 60 mm",
    ):
        assert text in printed
    assert "Limits: tool (axis z of the last frame) within 55 deg of the socket normal (--cone-deg)." in printed
    assert "55" in printed.split("largest tilt [deg]")[1].split("Reference")[0]


@pytest.mark.parametrize(
    ("probe", "axis"), [((0, 0, 102), "z"), ((0, 0, 0), "z"), ((-90, 5, 40), "-x"), ((0, 9, 8), "y")]
)
def test_a_measuring_arm_points_along_its_probe(paper_arm, probe, axis):
    assert _probe_axis(paper_arm.replace(probe=np.array(probe, dtype=float))) == axis


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--model", "grvity"), "unknown model 'grvity'; did you mean 'gravity'"),
        (("--cone-deg", "wide"), "--cone-deg 'wide' is not of the form DEG or NAME=DEG"),
        (("--cone-deg", "50", "--cone-deg", "40"), "--cone-deg is given twice for all sockets"),
        (("--cone-deg", "Q=40"), "unknown socket 'Q'"),
        (("--cone-deg", "200"), "half_angle[0] is 200 deg"),
        (("--normal", "A=1,2"), "--normal 'A=1,2' is not of the form X,Y,Z or NAME=X,Y,Z"),
        (("--normal", "0,0,0"), "has the length 0"),
        (("--tool-axis", "w"), "--tool-axis 'w' is not of the form"),
        (("--link-radius-mm", "0"), "radius is 0 mm; it must be positive"),
        (("--cell", "none.toml"), "none.toml"),
        (("--acceptance", "iso", "--cone-deg", "50"), "and --cone-deg would have no effect; leave out"),
        (("--cone-deg", "A=20", "--normal", "A=0,0,-1"), "socket 'A' at (450, 100, 200) mm cannot be reached"),
    ],
)
def test_refused(aacmm, arguments, text):
    assert text in aacmm(*PLAN, *arguments, expect=2).stderr


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--acceptance", "iso", "--farthest", 0.95), "so --farthest would have no effect; leave out --farthest"),
        (("--acceptance", "iso", "--collisions"), "so --collisions would have no effect"),
        # The default, stated, is ignored too.
        (("--acceptance", "iso", "--poses", 30, "--candidates", 200), "leave out --poses and --candidates"),
        (("--acceptance", "iso", "--kit", "kit.toml"), "so --kit would have no effect"),
        (
            ("--kit", "kit.toml", "--length-mm", 400, "--u-mm", 0.01, "--sockets", 3),
            "leave out --length-mm, --u-mm and --sockets",
        ),
        (("--sphere-mm", 40), "--sphere-mm applies to acceptance tests only; give --acceptance too"),
        (("--held", "d_9"), "unknown parameter 'd_9'"),
    ],
)
def test_options_that_would_be_ignored_are_refused(aacmm, options, text):
    assert text in aacmm("plan", "panda", "-o", "plan.csv", *options, expect=2).stderr


def test_a_manifest_names_the_arm_relative_to_itself_where_it_can(tmp_path, monkeypatch):
    arm = tmp_path / "arms" / "arm.toml"
    arm.parent.mkdir()
    arm.write_text("")
    assert arm_for(tmp_path / "manifests" / "plan.toml", str(arm)) == "../arms/arm.toml"
    assert arm_for(tmp_path / "plan.toml", "panda") == "panda"

    def other_drive(*_):
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", other_drive)  # as Windows does
    assert arm_for(tmp_path / "plan.toml", str(arm)) == arm.as_posix()

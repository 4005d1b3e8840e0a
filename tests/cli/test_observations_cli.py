"""The command line with observations: import, calibrate, robust losses, sessions, random parts, and refusals."""

import contextlib
import csv
import io
import json
import re

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.model.loss_names import LOSSES

NOISE = aj.Noise(encoder_arcsec=2, seating=0.005)
BOX = [[200, -300, 100], [600, 300, 500]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, paper_arm):
    """Captures of one arm: a tracker's, spheres', and two sessions with sockets, the second with bad poses."""
    folder = tmp_path_factory.mktemp("observed")
    nominal = aj.kinematics.ArmSpecification(paper_arm, "paper's")
    space = nominal.space()
    true = aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=1)
    points = {"A": (400, 200, 300), "B": (500, 300, 100), "C": (300, -300, 300), "D": (400, -300, 300)}
    lengths = [("A", "B", 0.001), ("C", "D", 0.001)]

    def save(name, capture):
        aj.files.save_capture(folder / f"{name}.h5", aj.Recording(capture, nominal))

    tracker = kinds.SimulatedPoints("tracker", BOX, 60, (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), u=0.01)
    sphere = kinds.SimulatedSphere("ball", (300, 0, 300), 50.0, 25, u=0.001)
    save("tracker", aj.simulate(true, {}, observations=[tracker, sphere], noise=NOISE))
    monday = aj.simulate(true, points, poses=20, lengths=lengths, noise=NOISE, seed=1)
    save("monday", monday)
    remounted = true.replace(probe=np.asarray(true.probe) + np.array([0.3, -0.2, 0.1]))
    tuesday = aj.simulate(remounted, points, poses=20, lengths=lengths, noise=NOISE, seed=2)
    save("tuesday", tuesday)
    q = np.array(monday.sockets["C"])
    q[4] += 0.01
    save("bad", aj.Capture({**monday.sockets, "C": q}, monday.lengths))
    save("free", aj.Capture(monday.sockets))
    again = [kinds.SimulatedPoints("camera", BOX, 30, (0.3, 0.0, 0.1, -500.0, 900.0, 100.0), u=0.02), sphere]
    unseen = {"E": (450, 100, 250), "F": (550, 100, 250)}
    fresh = aj.simulate(true, unseen, poses=12, lengths=[("E", "F", 0.001)], observations=again, noise=NOISE, seed=7)
    save("fresh", fresh)
    moved = aj.simulate(remounted, unseen, poses=12, lengths=[("E", "F", 0.001)], noise=NOISE, seed=8)
    save("moved", moved)
    save("few", aj.Capture({}, [], [fresh.observations[1].select(range(2))]))
    return folder


@pytest.mark.slow
def test_a_tracker_and_a_sphere(aacmm, folder, tmp_path):
    held = aacmm("show", folder / "tracker.h5").stdout
    for part in ("tracker", "frame of tracker", "centre of ball, radius of ball", "ball: certified diameter "):
        assert part in held
    rows = json.loads(aacmm("show", folder / "tracker.h5", "--json").stdout)["observations"]
    assert [(row["observation"], row["kind"], row["poses"], row["fixes_scale"]) for row in rows] == [
        ("tracker", "points", 60, True),
        ("ball", "sphere", 25, True),
    ]
    assert [(one["quantity"], one["u"], one["unit"]) for one in rows[1]["certified"]] == [
        ("certified diameter", 0.001, "mm")
    ]
    shown = aacmm(
        "calibrate", folder / "tracker.h5", "-o", "c.h5", "--only-poses", 60, "--seed", 1, "--figure", "r.svg"
    ).stdout
    for part in (
        "joint: converged",
        "RMS residuals by observation",
        "points",
        "sphere",
        "frame of tracker",
        "Held-out poses by observation",
    ):
        assert part in shown
    assert aacmm("show", "c.h5").stdout in shown
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    assert found["scale_k"] is None
    assert [row["kind"] for row in found["observations"]] == ["points", "sphere"]
    assert all(row["rms_after_mm"] < 0.1 < row["rms_before_mm"] for row in found["observations"])
    held_out = found["held_out_poses"]
    assert (found["poses"], held_out["used"]["poses"], held_out["held_out"]["poses"]) == (60, 60, 25)
    assert held_out["held_out"]["rms_mm"] < 0.1
    record = aj.files.load_calibration(tmp_path / "c.h5")
    aj.files.save_calibration(tmp_path / "again.h5", record)
    again = aj.files.load_calibration(tmp_path / "again.h5")
    assert record.observed is not None
    assert again.observed is not None
    assert np.array_equal(record.observed.rms_after, again.observed.rms_after)
    for part, values in record.observed.geometry.items():
        assert np.array_equal(values, again.observed.geometry[part])
    assert record.held_out is not None
    assert again.held_out is not None
    assert np.array_equal(record.held_out.distance, again.held_out.distance)
    assert np.all(np.isfinite(aj.uncertainty_of(record).u))
    # Without the summary that the command stored, the same is computed.
    assert json.loads(aacmm("show", "again.h5", "--json").stdout) == found
    assert "alpha" in aacmm("export", "c.h5").stdout
    assert json.loads(aacmm("export", "c.h5", "--format", "json").stdout) == found
    assert "residual [standard deviations]" in (tmp_path / "r.svg").read_text()
    assert found["scale_from"] == ["tracker (points)", "ball (sphere)"]
    parts = {row["part"]: row for row in found["geometry"]}
    assert [one["quantity"] for one in parts["frame of tracker"]["quantities"]] == [
        "position of the origin",
        "rotation vector",
    ]
    assert parts["radius of ball"]["certified"] == pytest.approx([25], abs=0.01)
    assert parts["radius of ball"]["certified_u"] == [0.0005]


@pytest.mark.slow
def test_names_of_points_are_shown_as_they_are(aacmm, folder, observed_record):
    """Brackets are markup for the terminal's library."""
    from aacmm_jax.cli import views
    from aacmm_jax.cli.display import display
    from aacmm_jax.summaries.calibration import calibration_summary

    capture = observed_record.recording.capture
    points = {"[b]near": [0, 0, 0], "[red]far": [300, 0, 0]}
    bar = kinds.Artefact("[i]bar", points, {name: capture.q[:2] + i for i, name in enumerate(points)}, u=0.001)
    recording = observed_record.recording._replace(capture=aj.Capture({}, [], [bar]))
    aj.files.save_capture(folder / "names.h5", recording)
    shown = aacmm("show", folder / "names.h5").stdout
    for part in ("[i]bar", "placement [i]bar", "coordinates of [b]near (0.0000", "coordinates of [red]far (300.0000"):
        assert part in " ".join(shown.split())
    summary = calibration_summary(observed_record)
    for row in summary["geometry"]:
        for quantity in row["quantities"]:
            quantity["quantity"] = f"[b]{quantity['quantity']}"
    with contextlib.redirect_stdout(io.StringIO()) as written:
        display(views.calibration(summary))
    assert "[b]normal" in written.getvalue()


@pytest.mark.slow
def test_a_robust_loss_lists_what_lost_weight(aacmm, folder, tmp_path):
    aacmm("calibrate", folder / "bad.h5", "-o", "plain.h5", "--method", "joint")
    shown = aacmm("calibrate", folder / "bad.h5", "-o", "c.h5", "--robust", "tukey").stdout
    assert "Robust loss tukey" in shown
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    assert {key: found["less_weight"][0][key] for key in ("observation", "pose")} == {"observation": "C", "pose": 5}
    assert found["less_weight"][0]["weight"] < 1e-6
    assert found["less_weight"][0]["residual_mm"] > 1
    assert found["less_weight"][0]["normalised"] > 50
    plain, robust = (aj.files.load_calibration(tmp_path / name) for name in ("plain.h5", "c.h5"))
    assert robust.observed is not None
    assert 5 * float(robust.observed.sigma) < float(
        aj.evaluate(plain.calibrated.arm, plain.recording.capture).repeatability.rms
    )


class SeenFromAbove(kinds.MeasuredPoints):
    """A kind with two rows a pose: of points, what lies in the base's plane."""

    rows = 2

    def residual(self, tips, unknowns):
        rows = super().residual(tips, unknowns)
        by_unknowns = {part: columns[:, :2] for part, columns in rows.by_unknowns.items()}
        return rows._replace(
            values=rows.values[:2],
            by_tip=rows.by_tip[:2],
            by_unknowns=by_unknowns,
            measured=rows.measured[:, :2, :2],
        )


@pytest.fixture(scope="module")
def several_rows(folder):
    """Observations of 1, 3 and 6 rows a pose."""
    recording = aj.files.load_capture(folder / "tracker.h5")
    arm, points = recording.nominal.arm, recording.capture.observations[0]
    target, frame = (10, 20, 80, 0.1, 0.2, 0.3), (0.3, 0.0, 0.1, -500.0, 900.0, 100.0)
    turned = kinds.SimulatedTransforms("T6", BOX, 20, target, frame, u=0.01, u_angle=1e-4)
    more = aj.simulate(arm, {}, observations=[turned], noise=NOISE).observations
    capture = aj.Capture({}, observations=[*recording.capture.observations, *more])
    assert [observation.rows for observation in capture.observations] == [3, 1, 6]
    aj.files.save_capture(folder / "several.h5", recording._replace(capture=capture))
    above = SeenFromAbove("above", points.q[40:], points.points[40:], u=0.01, station=points.station)
    with_two = [points.select(range(40)), *capture.observations[1:], above]
    return arm, capture, aj.Capture({}, observations=with_two)


@pytest.mark.slow
@pytest.mark.parametrize("robust", LOSSES)
def test_every_loss_is_for_python_and_the_command_line(aacmm, folder, several_rows, tmp_path, robust):
    arm, capture, with_two = several_rows
    aacmm("calibrate", folder / "several.h5", "-o", "c.h5", "--robust", robust)
    found = aj.calibrate(arm, capture, robust=robust)
    assert found.converged
    record = aj.files.load_calibration(tmp_path / "c.h5")
    assert record.robust == robust
    np.testing.assert_allclose(record.covariance, found.covariance, rtol=1e-5, atol=1e-12)
    assert aj.calibrate(arm, with_two, robust=robust).converged


@pytest.mark.slow
def test_a_loss_that_is_none_is_refused_with_the_list(aacmm, folder):
    for loss in LOSSES:
        assert loss in aacmm("calibrate", folder / "bad.h5", "--robust", "hubert", expect=2).stderr
        assert loss in aacmm("calibrate", "--help").stdout


@pytest.mark.slow
def test_sessions_have_a_probe_each(aacmm, folder):
    apart = aacmm("calibrate", folder / "monday.h5", folder / "tuesday.h5", "-o", "c.h5").stdout
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    names = [row["observation"] for row in found["observations"]]
    assert names == [f"{day}/{socket}" for day in ("monday", "tuesday") for socket in "ABCD"]
    assert max(row["rms_after_mm"] for row in found["observations"]) < 0.1
    assert "offset of probe of tuesday" in apart
    assert [row["session"] for row in found["sessions"]] == ["monday", "tuesday"]
    assert "contradict" not in " ".join(found["warnings"])
    both = folder / "monday.h5", folder / "tuesday.h5"
    said = aacmm("calibrate", *both, "-o", "d.h5", "--same-probe", "--method", "joint", expect=1).stdout
    together = json.loads(aacmm("show", "d.h5", "--json").stdout)
    assert together["calibrated"]["rms_mm"] > 0.1
    assert any("Session tuesday contradicts the other sessions" in says for says in together["warnings"])
    offsets = re.search(r"probe seems displaced by (\S+), (\S+), (\S+) mm", " ".join(together["warnings"]))
    assert offsets is not None
    np.testing.assert_allclose([float(offset) for offset in offsets.groups()], [0.3, -0.2, 0.1], atol=0.005)
    assert "Sessions: RMS distance of poses" in " ".join(said.split())
    assert all(row["rms_alone_mm"] < 0.02 < 0.1 < row["rms_mm"] for row in together["sessions"])


@pytest.mark.slow
def test_what_contradicts_is_left_out_on_request(aacmm, folder, tmp_path):
    recording = aj.files.load_capture(folder / "tracker.h5")
    points, ball = recording.capture.observations
    parts = [points.select(range(20 * i, 20 * i + 20)) for i in range(3)]
    renamed = [kinds.MeasuredPoints(f"t{i}", one.q, one.points, u=0.01) for i, one in enumerate(parts)]
    shifted = kinds.MeasuredPoints("t1", np.asarray(parts[1].q) + 1e-3 * np.eye(6)[2], parts[1].points, u=0.01)
    for name, second in (("clean", renamed[1]), ("wrong", shifted)):
        capture = aj.Capture({}, [], [renamed[0], second, renamed[2], ball])
        aj.files.save_capture(tmp_path / f"{name}.h5", recording._replace(capture=capture))
    aacmm("calibrate", "clean.h5", "-o", "c.h5", "--remove-contradicting")
    assert json.loads(aacmm("show", "c.h5", "--json").stdout)["removed"] == []
    said = aacmm("calibrate", "wrong.h5", "-o", "d.h5", "--remove-contradicting").stdout
    found = json.loads(aacmm("show", "d.h5", "--json").stdout)
    assert [(row["group"], row["members"]) for row in found["removed"]] == [("t1", ["t1"])]
    assert "Left out: " in " ".join(said.split())
    assert [row["observation"] for row in found["observations"]] == ["t0", "t2", "ball"]
    assert aj.files.load_calibration(tmp_path / "d.h5").removed[0].probability < 1e-6


@pytest.mark.slow
def test_the_scale_of_the_nominal_arm(aacmm, folder):
    assert "no reference length" in aacmm("calibrate", folder / "free.h5", "-o", "c.h5", expect=2).stderr
    shown = aacmm("calibrate", folder / "free.h5", "-o", "c.h5", "--scale", "nominal").stdout
    assert "repeatability: converged" in shown
    assert "The scale is taken from the nominal arm" in shown
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    assert found["scale_k"] is None
    assert found["calibrated"]["rms_mm"] < 0.1


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("command", "parts"),
    [
        ("calibrate tracker.h5 -o x.h5 --method two-stage", ["method='two-stage' applies only to sockets"]),
        ("calibrate tracker.h5 -o x.h5 --scale nominal", ["--scale nominal is for captures that do not fix the scale"]),
        ("calibrate free.h5 -o x.h5 --scale nominal --method joint", ["stage 1 only; omit --method"]),
        ("calibrate free.h5 -o x.h5 --scale nominal --cross-validate", ["needs a calibrated scale"]),
        (
            "calibrate bad.h5 -o x.h5 --robust huber --monte-carlo",
            ["--monte-carlo cannot be combined with --robust"],
        ),
        ("calibrate monday.h5 -o x.h5 --leave-out A", ["give both"]),
        ("calibrate monday.h5 -o x.h5 --cross-validate --leave-out '*'", ["'*' leaves out all data"]),
        ("calibrate monday.h5 -o x.h5 --cross-validate --leave-out [AC]", ["without '[AC]', no data fix the scale"]),
        ("calibrate monday.h5 -o x.h5 --same-probe", ["--same-probe applies to several captures"]),
        ("calibrate monday.h5 monday.h5 -o x.h5", ["two captures have the file name 'monday'"]),
        ("calibrate monday.h5 -o x.h5 --only-poses 80", ["80 of 80 poses cannot be selected", "1 to 79"]),
        ("calibrate monday.h5 -o x.h5 --hold-out 2", ["--hold-out 2", "between 0 and 1"]),
        ("calibrate monday.h5 -o x.h5 --hold-out F", ["no socket or observation matches --hold-out 'F'"]),
        ("calibrate monday.h5 -o x.h5 --hold-out 0.2 --only-poses 9", ["give one of them"]),
        ("calibrate tracker.h5 -o x.h5 --without 'no*'", ["no socket matches"]),
        ("evaluate c.h5 few.h5", ["sphere 'ball' has 2 touches"]),
        ("evaluate c.h5 monday.h5 --acceptance din", ["'din'", "jjf, asme, iso"]),
        ("export n.h5 --format dcc", ["the scale is not traceable (--scale nominal)"]),
    ],
)
def test_what_cannot_take_observations_says_so(aacmm, folder, calibrated, command, parts):
    words = [word.strip("'") for word in command.split()]
    places = {"c.h5": calibrated / "c.h5", "n.h5": calibrated / "n.h5"}
    arguments = [places.get(word, folder / word if word.endswith(".h5") and word != "x.h5" else word) for word in words]
    errors = aacmm(*arguments, expect=2).stderr
    assert all(part in " ".join(errors.split()) for part in parts), errors


@pytest.fixture(scope="module")
def calibrated(folder, paper_arm):
    """A calibration from observations, and one of stage 1."""
    for name, source in (("c", "tracker"), ("n", "free")):
        recording = aj.files.load_capture(folder / f"{source}.h5")
        solve = aj.calibrate if name == "c" else aj.identify
        result = solve(paper_arm, recording.capture, recording.nominal.bounds())
        aj.files.save_calibration(folder / f"{name}.h5", aj.calibration.record_of(result, recording))
    return folder


@pytest.mark.slow
def test_an_evaluation_stands_beside_its_prediction(aacmm, folder, calibrated, tmp_path):
    """All kinds on a capture of the same arm: as predicted; with the probe remounted: beyond chance, and said."""
    shown = " ".join(aacmm("evaluate", calibrated / "c.h5", folder / "fresh.h5", "-o", "e.h5").stdout.split())
    for part in ("camera points 30", "ball sphere 25", "socket 24", "error / U", "predicted", "E 12"):
        assert part in shown
    assert "Warning" not in shown
    assert "standard" not in shown.replace("standard deviation", "")  # no procedure was asked for
    found = json.loads(aacmm("show", "e.h5", "--json").stdout, parse_constant=lambda text: pytest.fail(text))
    part = found["held_out"]
    assert found["identified_from"] is None
    assert {row["kind"]: row["poses"] for row in part["kinds"]} == {"socket": 24, "points": 30, "sphere": 25}
    for row in (*part["kinds"], *part["groups"], *part["observations"], *part["sockets"]):
        assert 0.5 < row["rms_mm"] / row["rms_predicted_mm"] < 1.7
        assert 0.5 < row["reduced_chi"] < 2.0
    assert [row["members"] for row in part["groups"]] == [["E", "F"], ["camera"], ["ball"]]
    assert part["calibrated"]["observed_rms_mm"] < 0.1 < part["nominal"]["observed_rms_mm"]
    (length,) = part["lengths"]
    assert length["error_over_expanded"] == pytest.approx(length["error_mm"] / length["expanded_mm"])
    assert abs(length["error_over_expanded"]) < 1.5
    aacmm("evaluate", calibrated / "c.h5", folder / "fresh.h5", "--max-rms-mm", 0.001, expect=1)
    # What the file holds gives the same again.
    record = aj.files.load_evaluation(tmp_path / "e.h5")
    aj.files.save_evaluation(tmp_path / "again.h5", record)
    assert json.loads(aacmm("show", "again.h5", "--json").stdout) == found
    moved = json.loads(aacmm("evaluate", calibrated / "c.h5", folder / "moved.h5", "--json", expect=1).stdout)
    (warning,) = moved["warnings"]
    assert "disagree with it by more than chance" in warning
    assert "E (" in warning
    assert "the tip was remounted or exchanged" in warning
    assert moved["held_out"]["predicted"]["poses"]["probability"] < 1e-6


@pytest.mark.slow
def test_poses_that_a_calibration_did_not_use_are_held_out(aacmm, folder):
    aacmm("calibrate", folder / "tracker.h5", "-o", "c.h5", "--only-poses", 60, "--seed", 1)
    found = json.loads(aacmm("evaluate", "c.h5", folder / "tracker.h5", "--json").stdout)
    unseen, seen = (found[group]["observations"] for group in ("held_out", "identified_from"))
    assert sum(row["poses"] for row in unseen) == 25
    assert {row["observation"] for row in unseen} == {f"{row['observation']}, held out" for row in seen}
    assert found["warnings"] == []


@pytest.mark.slow
def test_residuals_are_written_pose_by_pose(aacmm, folder, tmp_path):
    """By `calibrate` and by `evaluate`: the same distances of the poses that were used, whose geometry is the same."""
    command = ("calibrate", folder / "tracker.h5", "-o", "c.h5", "--hold-out", "ball", "--residuals", "c.csv")
    found = json.loads(aacmm(*command, "--json").stdout)
    aacmm("evaluate", "c.h5", folder / "tracker.h5", "--residuals", "e.csv")
    tables = [list(csv.DictReader((tmp_path / name).read_text().splitlines())) for name in ("c.csv", "e.csv")]
    uses = [[(row["observation"], row["pose"], row["use"]) for row in rows] for rows in tables]
    assert uses[0] == uses[1]
    assert [use for *_, use in uses[0]] == ["used"] * 60 + ["held out"] * 25
    for row, again in zip(*tables, strict=True):
        vector = [float(row[f"residual_{axis}_mm"]) for axis in "xyz"]
        assert float(row["distance_mm"]) == pytest.approx(np.linalg.norm(vector), rel=1e-6)
        assert float(row["distance_mm"]) == pytest.approx(float(again["distance_mm"]), abs=2e-3)
    held_out = np.array([float(row["distance_mm"]) for row in tables[0][60:]])
    summary = found["held_out_poses"]["held_out"]
    assert summary["mean_mm"] == pytest.approx(held_out.mean())
    assert summary["largest_mm"] == pytest.approx(held_out.max())
    shown = aacmm("show", "c.h5").stdout
    says = "RMS distance from their geometry, as the other poses determine it,"
    found = f"{summary['rms_nominal_mm']:.3g} mm nominal, {summary['rms_mm']:.3g} mm calibrated (predicted"
    assert f"Held out: 25 poses; {says} {found}" in " ".join(shown.split())
    assert "--residuals" in aacmm("evaluate", "points.toml", "--residuals", "p.csv", expect=2).stderr


@pytest.mark.slow
def test_a_robust_cross_validation_names_the_group(aacmm, folder):
    """The group with a bad pose comes first, with a robust loss too."""
    aacmm("calibrate", folder / "bad.h5", "-o", "c.h5", "--cross-validate", "--robust", "huber")
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    first, second = found["cross_validation"]["left_out"]
    assert (first["members"], second["members"]) == (["C", "D"], ["A", "B"])
    assert first["disagrees"]
    assert first["rms_mm"] > 5 * first["rms_predicted_mm"]
    assert any("held out in turn" in text and "C, D (" in text for text in found["warnings"])


@pytest.mark.slow
def test_cross_validation_is_printed_group_by_group(aacmm, folder):
    """What is named, or what shares no geometry and no length."""
    left = [word for pattern in ("[AB]", "D") for word in ("--leave-out", pattern)]
    options = (folder / "monday.h5", "-o", "c.h5", "--cross-validate", *left)
    rows = json.loads(aacmm("calibrate", *options, "--json").stdout)["cross_validation"]["left_out"]
    assert {row["group"]: row["poses"] for row in rows} == {"A, B": 40, "D": 20}
    assert all(0.5 < row["rms_mm"] / row["rms_predicted_mm"] < 1.7 for row in rows)
    shown = " ".join(aacmm("calibrate", folder / "tracker.h5", "-o", "c.h5", "--cross-validate").stdout.split())
    assert "group held out poses RMS distance predicted" in shown
    assert "held out once, with its geometry (frame, target, ...) fitted to it again [mm]" in shown
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)["cross_validation"]
    assert {row["group"]: row["poses"] for row in found["left_out"]} == {"tracker": 60, "ball": 25}
    assert all(0.5 < row["rms_mm"] / row["rms_predicted_mm"] < 1.7 for row in found["left_out"])
    assert not found["surprising"]


@pytest.mark.slow
def test_the_robot_of_the_examples(aacmm, mukca):
    """500 poses drawn at random predict the others to 0.117 mm by default, where the D-H model alone leaves 0.49 mm."""
    aacmm("import", mukca.parent / "ipa_ur10" / "positions.toml", "-o", "ur10.h5")
    chosen = ("--only-poses", 500, "--seed", 0)
    plain = json.loads(aacmm("calibrate", "ur10.h5", "-o", "dh.h5", *chosen, "--model", "dh", "--json").stdout)
    assert plain["held_out_poses"]["held_out"]["rms_mm"] == pytest.approx(0.487, abs=0.001)
    aacmm("calibrate", "ur10.h5", "-o", "c.h5", *chosen)
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    held_out = found["held_out_poses"]["held_out"]
    assert (found["poses"], held_out["poses"]) == (500, 2272)
    assert held_out["rms_mm"] == pytest.approx(0.117, abs=0.001)
    assert "beta_2" in [row["parameter"] for row in found["parameters"]]
    judged = json.loads(aacmm("evaluate", "c.h5", "ur10.h5", "--json").stdout)["identified_from"]["observations"][0]
    # The nominal arm is as far from its points in both: 1.15 mm where its errors count as noise of the readings.
    assert judged["nominal_rms_mm"] == pytest.approx(found["observations"][0]["rms_before_mm"], rel=1e-4)
    shown = aacmm("show", "c.h5").stdout
    assert "on 500 poses in 1 observation" in shown
    assert "position [mm]" in shown


@pytest.mark.slow
def test_a_plan_with_a_kit(aacmm, tmp_path):
    """A bar that stands and a tracker: the plan, its manifest, and what each part adds."""
    (tmp_path / "kit.toml").write_text(
        '[[artefact]]\nname = "bar"\npoints = { a = [300, 0, 200], b = [600, 0, 200] }\nu = 0.001\n'
        '[[points]]\nname = "tracker"\nbox = [[200, -300, 100], [600, 300, 500]]\nu = 0.02\n'
    )
    options = ("--kit", "kit.toml", "--poses", 16, "--candidates", 120, "--manifest", "capture.toml")
    held = ("--held", "theta_1,d_1,a_6,alpha_6,probe_x,probe_y,d_2")
    shown = aacmm("plan", "cheng2018-simulation", "-o", "plan.csv", *options, *held).stdout
    for part in ("bar", "tracker", "without tracker: ", "16 random poses in the same places"):
        assert part in shown
    assert len((tmp_path / "plan.csv").read_text().splitlines()) == 17
    assert 'a = "bar-a.csv"' in (tmp_path / "capture.toml").read_text()
    refused = aacmm("plan", "cheng2018-simulation", "-o", "p.csv", "--kit", "kit.toml", "--sockets", 3, expect=2)
    assert "--kit itself determines the artefacts and their placement, so --sockets" in refused.stderr


@pytest.mark.slow
def test_a_kit_is_simulated(aacmm, tmp_path):
    kit = '[[points]]\nname = "tracker"\nbox = [[200, -300, 100], [600, 300, 500]]\nposes = 12\nu = 0.02\n'
    (tmp_path / "kit.toml").write_text(kit)
    aacmm("simulate", "ur10e", "-o", "c.h5", "--kit", "kit.toml", "--seed", 3)
    (observation,) = aj.files.load_capture(tmp_path / "c.h5").capture.observations
    assert (observation.name, len(observation.q)) == ("tracker", 12)
    assert "--kit" in aacmm("simulate", "ur10e", "-o", "d.h5", expect=2).stderr

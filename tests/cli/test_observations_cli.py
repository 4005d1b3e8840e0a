"""The command line with observations: import, calibrate, robust losses, sessions, random parts, and refusals."""

import contextlib
import io
import json

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds

NOISE = aj.Noise(encoder_arcsec=2, seating=0.005)
BOX = [[200, -300, 100], [600, 300, 500]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, paper_arm):
    """Captures of one arm: a tracker's, spheres', and two sessions with sockets, the second with bad poses."""
    folder = tmp_path_factory.mktemp("observed")
    nominal = aj.kinematics.ArmSpecification(paper_arm, "paper's")
    space = nominal.space()
    true = aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=1)
    points = {"A": (400, 200, 300), "B": (500, 300, 100), "C": (300, -300, 300)}

    def save(name, capture):
        aj.files.save_capture(folder / f"{name}.h5", aj.Recording(capture, nominal))

    tracker = kinds.SimulatedPoints("tracker", BOX, 60, (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), u=0.01)
    sphere = kinds.SimulatedSphere("ball", (300, 0, 300), 50.0, 25, u=0.001)
    save("tracker", aj.simulate(true, {}, observations=[tracker, sphere], noise=NOISE))
    monday = aj.simulate(true, points, poses=20, lengths=[("A", "B", 0.001)], noise=NOISE, seed=1)
    save("monday", monday)
    remounted = true.replace(probe=np.asarray(true.probe) + np.array([0.3, -0.2, 0.1]))
    tuesday = aj.simulate(remounted, points, poses=20, lengths=[("A", "B", 0.001)], noise=NOISE, seed=2)
    save("tuesday", tuesday)
    q = np.array(monday.sockets["C"])
    q[4] += 0.01
    save("bad", aj.Capture({**monday.sockets, "C": q}, monday.lengths))
    save("free", aj.Capture(monday.sockets))
    return folder


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
    for part in ("joint: converged", "Observations, RMS", "points", "sphere", "frame of tracker", "Other poses"):
        assert part in shown
    assert aacmm("show", "c.h5").stdout in shown
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    assert found["scale_k"] is None
    assert [row["kind"] for row in found["observations"]] == ["points", "sphere"]
    assert all(row["rms_after_mm"] < 0.1 < row["rms_before_mm"] for row in found["observations"])
    assert (found["poses"], found["other_poses"]["poses"]) == (60, 25)
    assert found["other_poses"]["rms_mm"] < 0.1
    record = aj.files.load_calibration(tmp_path / "c.h5")
    aj.files.save_calibration(tmp_path / "again.h5", record)
    again = aj.files.load_calibration(tmp_path / "again.h5")
    assert record.observed is not None
    assert again.observed is not None
    assert np.array_equal(record.observed.rms_after, again.observed.rms_after)
    for part, values in record.observed.geometry.items():
        assert np.array_equal(values, again.observed.geometry[part])
    assert record.others is not None
    assert again.others is not None
    assert np.array_equal(record.others.rms, again.others.rms)
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


def test_names_of_points_are_shown_as_they_are(aacmm, folder, observed_record):
    """Brackets are markup for the terminal's library."""
    from aacmm_jax.cli import calibration_display
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
        calibration_display.calibration(summary)
    assert "[b]normal" in written.getvalue()


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


def test_sessions_have_a_probe_each(aacmm, folder):
    apart = aacmm("calibrate", folder / "monday.h5", folder / "tuesday.h5", "-o", "c.h5").stdout
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    names = [row["observation"] for row in found["observations"]]
    assert names == [f"{day}/{socket}" for day in ("monday", "tuesday") for socket in "ABC"]
    assert max(row["rms_after_mm"] for row in found["observations"]) < 0.1
    assert "offset of probe of tuesday" in apart
    aacmm("calibrate", folder / "monday.h5", folder / "tuesday.h5", "-o", "d.h5", "--same-probe", "--method", "joint")
    together = json.loads(aacmm("show", "d.h5", "--json").stdout)
    assert together["calibrated"]["rms_mm"] > 0.1


def test_the_scale_of_the_nominal_arm(aacmm, folder):
    assert "no reference length" in aacmm("calibrate", folder / "free.h5", "-o", "c.h5", expect=2).stderr
    shown = aacmm("calibrate", folder / "free.h5", "-o", "c.h5", "--scale", "nominal").stdout
    assert "repeatability: converged" in shown
    assert "The scale is that of the nominal arm" in shown
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    assert found["scale_k"] is None
    assert found["calibrated"]["rms_mm"] < 0.1


@pytest.mark.parametrize(
    ("command", "parts"),
    [
        ("calibrate tracker.h5 -o x.h5 --method two-stage", ["method='two-stage' is for sockets"]),
        ("calibrate tracker.h5 -o x.h5 --scale nominal", ["--scale nominal is for captures without a scale"]),
        ("calibrate free.h5 -o x.h5 --scale nominal --method joint", ["stage 1 alone; leave out --method"]),
        ("calibrate tracker.h5 -o x.h5 --monte-carlo", ["--monte-carlo takes sockets"]),
        ("calibrate tracker.h5 -o x.h5 --cross-validate", ["cross-validation takes sockets"]),
        ("calibrate monday.h5 -o x.h5 --same-probe", ["--same-probe is for several captures"]),
        ("calibrate monday.h5 monday.h5 -o x.h5", ["two captures have the name 'monday'"]),
        ("calibrate monday.h5 -o x.h5 --only-poses 60", ["60 of 60 poses cannot be drawn", "1 to 59"]),
        ("calibrate tracker.h5 -o x.h5 --without 'no*'", ["no socket matches"]),
        ("evaluate c.h5 tracker.h5", ["an evaluation takes sockets"]),
        ("export n.h5 --format dcc", ["a certificate states a scale that is traceable"]),
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


def test_the_robot_of_the_examples(aacmm, mukca):
    """500 poses drawn at random predict the others; 0.490 mm is what the D-H model can do, by SciPy too."""
    aacmm("import", mukca.parent / "ipa_ur10" / "positions.toml", "-o", "ur10.h5")
    aacmm("calibrate", "ur10.h5", "-o", "c.h5", "--only-poses", 500, "--seed", 0)
    found = json.loads(aacmm("show", "c.h5", "--json").stdout)
    assert (found["poses"], found["other_poses"]["poses"]) == (500, 2272)
    assert found["other_poses"]["rms_mm"] == pytest.approx(0.487, abs=0.001)
    assert "beta_2" in [row["parameter"] for row in found["parameters"]]

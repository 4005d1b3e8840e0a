"""Delivered parameters verified, and a plate with sockets made, from the command line."""

import json
import tomllib

import numpy as np
import pytest

import aacmm_jax as aj

SOCKETS = {"A": (-400.0, -250.0, 100.0), "B": (-300.0, -250.0, 100.0), "C": (300.0, 350.0, 400.0)}


@pytest.fixture
def robot(tmp_path):
    """A manifest of poses of an arm whose parameters are those of true.toml."""
    nominal = aj.load_arm("ur5e").replace(probe=np.array([20.0, -40.0, 120.0]))
    names = tuple(f"{kind}_{i}" for kind in ("a", "d", "theta", "alpha") for i in range(1, 7))
    true = aj.perturbed_arm(aj.Parameters(nominal, names), length=0.8, angle=0.002, seed=0)
    worse = aj.perturbed_arm(aj.Parameters(nominal, names), length=1.6, angle=0.004, seed=1)
    for name, arm in {"nominal": nominal, "true": true, "worse": worse}.items():
        aj.files.save_arm(arm, tmp_path / f"{name}.toml", name=name)
    capture = aj.simulate(true, SOCKETS, poses=7, noise=aj.Noise(encoder_arcsec=5.0, seating=0.03), seed=0)
    for name, q in capture.sockets.items():
        header = ",".join(f"q_{i} [rad]" for i in range(1, 7))
        np.savetxt(tmp_path / f"socket_{name}.csv", q, delimiter=",", header=header, comments="")
    (tmp_path / "poses.toml").write_text(
        'arm = "nominal.toml"\n[[socket]]\nname = "{socket}"\nfile = "socket_{socket}.csv"\n'
        '[[length]]\nfrom = "A"\nto = "B"\nvalue = 100.0\nu = 0.05\n'
    )
    return tmp_path


@pytest.mark.slow
def test_a_good_and_a_bad_delivery(aacmm, robot):
    good = json.loads(aacmm("verify", "poses.toml", "--delivered", "true.toml", "--json").stdout)
    assert good["verdict"] == "better"
    assert good["accuracy"][1]["rms_mm"] < 0.1 < good["accuracy"][0]["rms_mm"]
    assert len(good["accuracy"][1]["length_errors_mm"]) == 1
    printed = " ".join(aacmm("verify", "poses.toml", "--delivered", "worse.toml", expect=1).stdout.split())
    for part in ("are worse than the nominal ones", "21 poses", "2.5 % worse", "it would gain", "Real share"):
        assert part in printed
    aacmm("verify", "poses.toml", "--delivered", "nominal.toml", "-o", "page.html", expect=1)
    page = (robot / "page.html").read_text("utf-8")
    for part in (
        "<b>Not good (calibrate)</b>",
        "at least",
        "tip fitted",
        "What was not tested",
        "Distance of every pose",
        "poses.toml",
    ):
        assert part in page
    assert "as_found" in aacmm("verify", "poses.toml", expect=2).stderr


@pytest.mark.slow
def test_another_robot_is_refused_and_another_name_is_said(aacmm, robot):
    assert "is another robot than 'nominal'" in aacmm("verify", "poses.toml", "--delivered", "ur10e", expect=2).stderr
    found = json.loads(aacmm("verify", "poses.toml", "--delivered", "ur5e", "--json", expect=1).stdout)
    assert "is not the arm 'nominal' of the recording" in found["warnings"][-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unit", "length", "warning"), [("deg", "100.0", "read as degrees"), ("rad", "1000.0", "The scale factor")]
)
def test_data_that_do_not_match_the_arm_get_no_verdict(aacmm, robot, unit, length, warning):
    """As found by hand: a wrong unit or length was "good", since a calibration did not gain much either."""
    manifest = (robot / "poses.toml").read_text("utf-8")
    for path in robot.glob("socket_*.csv"):
        path.write_text(path.read_text("utf-8").replace("[rad]", f"[{unit}]"), "utf-8")
    (robot / "poses.toml").write_text(manifest.replace("value = 100.0", f"value = {length}"), "utf-8")
    printed = aacmm("verify", "poses.toml", "--delivered", "nominal.toml", "-o", "page.html", expect=1).stdout
    page = (robot / "page.html").read_text("utf-8")
    assert printed.startswith("Not decided: ")
    for text in (printed, page):
        assert warning in " ".join(text.split())
    assert "<b>Not decided (correct the recording or the manifest)</b>" in page
    assert "After a calibration" not in page


@pytest.mark.slow
def test_the_held_out_result_of_a_calibration_stands_beside_the_verdict(aacmm, robot, mukca):
    """As found by a reader: verdict and held-out error had to be put together from two commands."""
    recorded = mukca / "panda_6.toml"
    aacmm("calibrate", recorded, "-o", "c.h5", "--model", "dh")
    options = ("verify", recorded, "--delivered", "panda", "--calibration")
    summary = json.loads(aacmm(*options, "c.h5", "-o", "page.html", "--json", expect=1).stdout)
    known = json.loads(aacmm("show", "c.h5", "--json").stdout)["cross_validation"]
    assert (summary["calibrated"]["rms_mm"], summary["calibrated"]["groups"]) == (known["rms_mm"], known["groups"])
    page, says = " ".join((robot / "page.html").read_text("utf-8").split()), "Held-out poses: 3 groups, each held out"
    assert summary["says"].startswith("Not good: ")
    assert f"Calibrated: {known['rms_mm']:.3g} mm RMS (95 %: " in summary["says"]
    assert "would" not in summary["says"]
    assert says in summary["calibrated"]["says"]
    for text in (says, "Calibrated, held-out poses", "Of the calibrated arm: each pose when it was held out"):
        assert text in page
    assert "Tested as delivered: the published nominal parameters, not what your controller computes." in page
    assert page.index("<h2") < page.index(" equations, ")  # the colleague reads the verdict first
    assert all(
        f"{name} {error:.3f}" in page
        for name, error in zip(summary["lengths"], summary["accuracy"][0]["length_errors_mm"], strict=True)
    )
    good = json.loads(aacmm(*options, "c.h5", "--max-rms-mm", "1", "--json").stdout)
    assert good["says"].startswith("Calibrated, good enough for 1 mm RMS: ")
    assert (good["calibrated"]["poses"], good["calibrated"]["beyond"]) == (good["poses"], 0)
    assert good["calibrated"]["largest_mm"] > good["calibrated"]["rms_mm"] > good["calibrated"]["lower_mm"]
    shown = json.loads(aacmm("show", "c.h5", "--json").stdout)
    assert ("To be used with care" in shown["verdict"]["says"]) == ("To be used with care" in good["warnings"][-1])
    assert f"Lengths over {shown['lengths_tested']['longest_mm']:.4g} mm are untested." in good["warnings"][-1]
    other = aacmm("verify", "poses.toml", "--delivered", "nominal.toml", "--calibration", "c.h5", expect=2)
    assert "and not of 'nominal', the arm of the recording" in " ".join(other.stderr.split())
    aacmm("calibrate", recorded, "-o", "plain.h5", "--model", "dh", "--no-cross-validate")
    assert "has no cross-validation" in " ".join(aacmm(*options, "plain.h5", expect=2).stderr.split())


def test_a_plate_is_made_with_the_lines_of_its_manifest(aacmm, tmp_path):
    printed = aacmm("sockets", "-o", "plate.stl", "--drawing", "plate.pdf", "--distance-mm", 80).stdout
    assert (tmp_path / "plate.pdf").read_bytes().startswith(b"%PDF")
    assert len((tmp_path / "plate.stl").read_bytes()) > 10_000
    manifest = tomllib.loads(printed[printed.index("[[socket]]") :])
    assert manifest["length"] == [{"from": "A", "to": "B", "value": 80, "u": 0.05}]


def test_a_plate_that_cannot_be_made_is_one_sentence_and_no_file(aacmm, tmp_path):
    assert "at least" in aacmm("sockets", "-o", "plate.stl", "--distance-mm", 5, expect=2).stderr
    assert not list(tmp_path.iterdir())

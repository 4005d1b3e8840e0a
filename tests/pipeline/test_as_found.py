"""The arm as found: a file that the manifest names, kept, and shown beside the nominal arm only where it is known."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.arms import specification_toml
from aacmm_jax.report import write_report
from tests.refusals import assert_refused

ARM = 'arm = "cheng2018-simulation"\n'
SOCKETS = 'socket = [{ name = "A", file = "A.csv" }, { name = "B", file = "B.csv" }]\n'
LENGTH = 'length = [{ from = "A", to = "B", value = 200.0, u = 0.001 }]\n'


@pytest.fixture
def folder(tmp_path, paper_arm):
    """Readings of an arm whose controller has other parameters than the nominal ones."""
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300)}
    true = paper_arm.replace(a=np.asarray(paper_arm.a) + 0.3)
    capture = aj.simulate(true, sockets, poses=30, encoder_arcsec=2.0, seating=0.005, seed=5)
    for name, q in capture.sockets.items():
        header = ",".join(f"q_{joint}_deg" for joint in range(1, 7))
        np.savetxt(tmp_path / f"{name}.csv", np.degrees(q), delimiter=",", header=header, comments="")
    installed = paper_arm.replace(a=np.asarray(paper_arm.a) + 0.25)
    specification = aj.files.load_specification("cheng2018-simulation")._replace(arm=installed, name="as it came")
    (tmp_path / "installed.toml").write_text(specification_toml(specification))
    return tmp_path


def imported(folder, line=""):
    (folder / "capture.toml").write_text(ARM + line + SOCKETS + LENGTH)
    return aj.files.read_manifest(folder / "capture.toml")


@pytest.mark.slow
@pytest.mark.parametrize("there", [False, True])
def test_columns(folder, there, capsys):
    recording = imported(folder, 'as_found = "installed.toml"\n' if there else "")
    aj.files.save_capture(folder / "c.h5", recording)
    recording = aj.files.load_capture(folder / "c.h5")
    assert (recording.as_found is not None) == there
    record = aj.calibrate_capture(recording, automatic=False, cross_validate=False)
    aj.files.save_calibration(folder / "k.h5", record)
    record = aj.files.load_calibration(folder / "k.h5")
    evaluation = aj.evaluate_capture(record, recording, limits={"SPAT": 0.1})
    aj.files.save_evaluation(folder / "e.h5", evaluation)
    tests = aj.files.load_evaluation(folder / "e.h5").acceptance()
    assert list(tests) == ["nominal", *["as_found"] * there, "calibrated"]
    if there:
        values = {stage: tests[stage][0].metrics[0].value for stage in tests}
        assert values["calibrated"] < values["as_found"] < values["nominal"]
    text = aj.certificate.dcc_xml(record, aj.files.AdministrativeData(), created="2026-01-31", evaluation=evaluation)
    assert text.count("beforeAdjustment") == 2 * there
    assert ("parameters as found" in text.lower()) == there
    assert "those before the calibration" not in text
    for kind in "ke":
        write_report(folder / f"{kind}.h5", folder / "r.html")
        assert ("as found" in (folder / "r.html").read_text(encoding="utf-8")) == there


@pytest.mark.slow
def test_terminal(folder, aacmm):
    imported(folder, 'as_found = "installed.toml"\n')
    aacmm("import", "capture.toml", "-o", "c.h5")
    shown = aacmm("calibrate", "c.h5", "-o", "k.h5", "--no-automatic").stdout
    assert "as found" in shown
    shown = " ".join(aacmm("evaluate", "k.h5", "c.h5", "--mpe", "SPAT=0.1").stdout.split())
    assert "the arm as found fails (SPAT)" in shown
    assert "nominal as found worst at" in shown


def test_another_arm_is_refused(folder):
    assert_refused(lambda: imported(folder, 'as_found = "so100"\n'), "as_found", "5 joints", "6")


@pytest.mark.slow
def test_a_report_without_tests_states_no_conformity(folder):
    record = aj.calibrate_capture(imported(folder), automatic=False, cross_validate=False)
    aj.files.save_calibration(folder / "k.h5", record)
    conformity = {"verdict": "pass", "specification": "a standard", "decision_rule": "a rule"}
    about = aj.files.AdministrativeData(conformity=conformity)
    assert_refused(lambda: write_report(folder / "k.h5", folder / "r.html", about), "conformity is stated", "remove")
    assert not (folder / "r.html").exists()

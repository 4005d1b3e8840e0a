"""The command line: the whole path, what is printed for people and for machines, and exit codes."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib

import h5py
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data.recording import Recording
from aacmm_jax.files.hdf5_content import seal

from ..conftest import EXAMPLES, command_line

COMMANDS = (
    *("arm", "demo", "simulate", "import", "calibrate", "evaluate", "export", "correct", "show", "plan", "compare"),
    "report",
    "target",
    "verify",
    "sockets",
)
SIMULATE = (
    *("simulate", "cheng2018-simulation", "-o", "capture.h5", "--seed", 4),
    *("--socket", "A=400,200,300", "--socket", "B=600,200,300", "--socket", "C=500,400,400"),
    *("--poses", 70, "--poses", "B=4", "--poses", "C=4", "--length", "A,B,0.002", "--length", "A,C,0.002"),
    *("--encoder-arcsec", 2, "--seating-mm", 0.005, "--deviate-length-mm", 1, "--deviate-angle-deg", 0.1),
)


@pytest.mark.first_rows(3)
@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(aacmm, command):
    text = aacmm(command, "--help").stdout
    assert re.search(rf"Examples?: aacmm {command}", " ".join(text.split()))


@pytest.mark.slow
def test_demo_recovers_the_truth_and_leaves_its_files(aacmm, tmp_path):
    result = json.loads(aacmm("demo", "out", "--json", "--seed", 3).stdout)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(result["files"])
    # Stage 1 corrects repeatability, stage 2 the lengths; 2 arcsec at 1.2 m and 5 um leave about 0.02 mm in a length.
    assert result["stage1"]["de_mm"] < 0.02 < result["nominal"]["de_mm"]
    assert result["calibrated"]["check_rms_mm"] < 0.03 < result["stage1"]["check_rms_mm"]
    assert (tmp_path / "out" / "calibration.png").stat().st_size > 10_000
    printed = aacmm("demo", "out", "--seed", 3).stdout
    assert "stage 2" in printed
    assert "largest error of a length parameter [mm]" in printed
    true, calibrated = (aj.load_arm(tmp_path / "out" / f"{name}.toml") for name in ("true", "calibrated"))
    np.testing.assert_allclose(calibrated.a, true.a, atol=0.1)


@pytest.mark.slow
def test_whole_path(aacmm, tmp_path):
    summary = json.loads(aacmm(*SIMULATE, "--json").stdout)
    assert summary["poses"] == 78
    done = aacmm("calibrate", "capture.h5", "-o", "calibration.h5", "--without", "C", "--json")
    result = json.loads(done.stdout)
    assert result["converged"]
    assert result["sockets_used"] == ["A", "B"]
    assert (
        result["truth"]["calibrated"]["length_error_largest_mm"]
        < 0.1
        < result["truth"]["stage1"]["length_error_largest_mm"]
    )
    # Python reads the same calibration.
    record = aj.files.load_calibration(tmp_path / "calibration.h5")
    assert record.k == result["scale_k"]
    space = aj.Parameters(record.recording.nominal.arm, record.names)
    values = [row["calibrated"] for row in result["parameters"]]
    np.testing.assert_array_equal(space.vector(record.calibrated.arm), values)
    # Held-out sockets are told apart from those that were used, and a limit decides the exit code.
    evaluated = json.loads(aacmm("evaluate", "calibration.h5", "capture.h5", "--json").stdout)
    assert [row["socket"] for row in evaluated["held_out"]["sockets"]] == ["C"]
    assert evaluated["held_out"]["calibrated"]["rms_mm"] < 0.05
    aacmm("evaluate", "calibration.h5", "capture.h5", "--max-rms-mm", 0.05)
    failed = aacmm("evaluate", "calibration.h5", "capture.h5", "--max-rms-mm", 0.001, expect=1)
    assert "over the limit of 0.001 mm" in " ".join(failed.stdout.split())
    # The only length identified from fixed the scale: its error is zero by construction, and nothing that was measured.
    assert [evaluated[group]["fixed_by_one_length"] for group in ("held_out", "identified_from")] == [False, True]
    assert failed.stdout.count("fixed the scale") == 3
    # Three ways out, with the same numbers.
    arm = tomllib.loads(aacmm("export", "calibration.h5").stdout)
    assert arm["joint"][2]["d"] == float(record.calibrated.arm.d[2])
    assert json.loads(aacmm("export", "calibration.h5", "--format", "json").stdout)["scale_k"] == record.k
    aacmm("export", "calibration.h5", "--format", "csv", "-o", "parameters.csv")
    rows = (tmp_path / "parameters.csv").read_text().splitlines()
    assert rows[0] == "parameter,unit,nominal,calibrated,u"
    assert [float(row.split(",")[3]) for row in rows[1:]] == values
    for file in ("capture.h5", "calibration.h5", "panda"):
        assert json.loads(aacmm("show", file, "--json").stdout)["kind"] in ("capture", "calibration", "arm")
        assert aacmm("show", file).stdout


@pytest.mark.slow
def test_not_converged_is_exit_code_1_and_still_written(aacmm, tmp_path, monkeypatch):
    """A solve that is stopped by its step limit has not converged."""
    aacmm(*SIMULATE)
    done = aacmm("calibrate", "capture.h5", "-o", "calibration.h5", "--max-steps", 2, "--json", expect=1)
    result = json.loads(done.stdout)
    assert not result["converged"]
    assert "step limit" in result["reason"]
    assert (tmp_path / "calibration.h5").exists()


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("calibrate", "none.h5", "-o", "x.h5"), "none.h5 does not exist"),
        (("show", "pandda"), "did you mean 'panda'?"),
        (("simulate", "panda", "-o", "x.h5", "--socket", "A=1,2"), "--socket 'A=1,2' is not of the form NAME=X,Y,Z"),
        (
            ("simulate", "panda", "-o", "x.h5", "--socket", "A=5000,0,0"),
            "socket 'A' at (5000, 0, 0) mm cannot be reached",
        ),
        (("simulate", "panda", "-o", "x.h5", "--socket", "A=400,0,300", "--poses", "B=2"), "unknown socket 'B'"),
        (
            ("simulate", "panda", "-o", "no/where.h5", "--socket", "A=400,0,300", "--poses", "2"),
            "no/where.h5 cannot be written",
        ),
        (
            ("simulate", "cheng2018-simulation", "-o", "x.h5", "--true-arm", "panda", "--socket", "A=400,0,300"),
            "has 7 joints, but 'Cheng 2018, simulated arm' has 6",
        ),
        (("simulate", "panda", "-o", "x.h5", "--socket", "A=400,0,300", "--seed", 2**63), "Invalid value for '--seed'"),
        (("demo", "/dev/null/x"), "/dev/null/x cannot be used as a folder"),
        (("simulate", "panda", "--socket", "A=400,0,300"), "Missing option"),
        (("frobnicate",), "No such command"),
    ],
)
def test_bad_input_is_exit_code_2_and_one_sentence(aacmm, tmp_path, arguments, message):
    failed = aacmm(*arguments, expect=2)
    error = " ".join(failed.stderr.replace("│", " ").split())
    assert message in error
    assert "Traceback" not in failed.stderr
    assert failed.stdout == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (("calibrate", "c.h5", "--hold-out", "A", "--hold-out", "B"), "--hold-out"),
        (("calibrate", "c.h5", "-o", "a.h5", "--output", "b.h5"), "--output"),
        (("calibrate", "c.h5", "--automatic", "--no-automatic"), "--automatic"),
        (("evaluate", "c.h5", "d.h5", "--max-rms-mm=1", "--max-rms-mm", "2"), "--max-rms-mm"),
    ],
)
def test_an_option_of_one_value_given_twice_is_refused(aacmm, arguments, option):
    assert f"{option} is given 2 times, but has one value" in aacmm(*arguments, expect=2).stderr


def test_debug_shows_the_traceback(aacmm_process):
    assert "Traceback" in aacmm_process("calibrate", "none.h5", "-o", "x.h5", "--debug", expect=1).stderr


@pytest.mark.slow
def test_float32_is_refused_at_import(aacmm_process, monkeypatch, tmp_path):
    monkeypatch.setenv("JAX_ENABLE_X64", "0")
    script = tmp_path / "aacmm"  # as pip writes the console script
    script.write_text("from aacmm_jax.cli import main\n\nmain()\n")
    by_script = subprocess.run([sys.executable, script, "show", "panda"], capture_output=True, text=True, check=False)
    for done in (aacmm_process("show", "panda", expect=2), by_script):
        assert done.stderr.startswith("Error: aacmm_jax needs 64-bit floats, but JAX_ENABLE_X64=0")
        assert (done.returncode, done.stdout, "Traceback" in done.stderr) == (2, "", False)


@pytest.mark.slow
def test_a_process_of_its_own(aacmm_process, cache, tmp_path, monkeypatch):
    """Exit codes of real processes, and the folder in which compiled programs are kept for the next one."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    # Every program is kept, however fast this machine compiles it.
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    aacmm_process("simulate", "panda", "-o", "capture.h5", "--socket", "A=400,0,300", "--poses", 2)
    assert (tmp_path / "capture.h5").exists()
    assert list((cache / "aacmm_jax").iterdir())
    assert "No such command" in aacmm_process("frobnicate", expect=2).stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "redirection", "encoding", "code", "error"),
    [
        ("show panda", "| true", "utf-8", 141, ""),
        pytest.param("show panda --json", "| true", "utf-8", 141, "", marks=pytest.mark.slow),
        pytest.param(
            *("show panda", "> /dev/full", "utf-8", 1, "Error: standard output cannot be written: no space left"),
            marks=pytest.mark.slow,
        ),
        pytest.param("show named.toml", "> out.txt", "ascii", 0, "", marks=pytest.mark.slow),
    ],
)
def test_standard_output(tmp_path, arguments, redirection, encoding, code, error):
    """A pipe that nobody reads, a full device, and an encoding without the letters of a name."""
    arm = aj.load_arm("panda")
    aj.files.save_arm(arm, tmp_path / "named.toml", name="Meßarm")
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} -m aacmm_jax {arguments} {redirection}; exit ${{PIPESTATUS[0]}}"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONIOENCODING": encoding},
        capture_output=True,
        text=True,
    )
    assert done.returncode == code
    assert done.stderr.startswith(error)
    assert done.stderr.count("\n") == bool(error)
    if encoding == "ascii":
        assert "Me\\xdfarm" in (tmp_path / "out.txt").read_text()


PLAN = (
    *("plan", "cheng2018-simulation", "-o", "plan.csv", "--poses", 12, "--candidates", 120),
    *("--socket", "A=400,200,300", "--socket", "B=700,500,500", "--length", "A,B,0.002"),
)


def test_plan(aacmm, tmp_path, monkeypatch):
    summary = json.loads(aacmm(*PLAN, "--json").stdout)
    assert summary["poses"] == 12
    assert sum(row["poses"] for row in summary["sockets"]) == 12
    assert summary["predicted"]["largest_mm"] < summary["random"]["largest_mm"]
    rows = (tmp_path / "plan.csv").read_text().splitlines()
    assert len(rows) == 13
    printed = aacmm(*PLAN, "--manifest", "capture.toml").stdout
    assert "random poses in the same sockets" in printed
    assert 'arm = "cheng2018-simulation"' in (tmp_path / "capture.toml").read_text()
    assert "Not checked: obstacles" in " ".join(printed.split())


@pytest.mark.slow
def test_uncertainties_are_printed(aacmm):
    """Known noise, what the data determine, uncertainty over the volume, cross-validation of two placements."""
    aacmm(
        *(
            "simulate",
            "cheng2018-simulation",
            "-o",
            "two.h5",
            "--poses",
            16,
            "--encoder-arcsec",
            2,
            "--seating-mm",
            0.005,
        ),
        *(
            "--socket",
            "A=400,200,300",
            "--socket",
            "B=600,200,300",
            "--socket",
            "C=500,400,400",
            "--socket",
            "D=300,400,600",
        ),
        *("--length", "A,B,0.002", "--length", "C,D,0.002"),
    )
    known = ("--encoder-arcsec", 2, "--seating-mm", 0.005, "--method", "joint")
    done = aacmm("calibrate", "two.h5", "-o", "c.h5", *known, "--cross-validate", "--json")
    summary = json.loads(done.stdout, parse_constant=lambda text: pytest.fail(f"{text} is no JSON"))
    uncertainty = summary["uncertainty"]
    assert (uncertainty["form"], uncertainty["rank"], uncertainty["parameters"]) == ("given", 21, 21)
    assert 0.8 < uncertainty["misfit"] < 1.2
    assert 0.001 < uncertainty["volume"]["u_length_largest_mm"] < 0.1
    assert summary["cross_validation"]["groups"] == 2
    assert summary["cross_validation"]["excess"] < 2.5
    shown = " ".join(aacmm("show", "c.h5").stdout.split())
    assert shown.index("Cross-validation: each") < shown.index("Errors in the poses used for identification")
    # More than 1.96: with two lengths, errors of places have a probability.
    assert "Expanded uncertainty U over all joint limits (95 %, coverage factor 1.97 to 2.02)" in shown
    assert "Observability: rank 21 of 21" in shown


@pytest.mark.slow
def test_what_cannot_be_determined_is_a_warning_or_with_strict_an_error(aacmm):
    aacmm(*SIMULATE)
    free = ("calibrate", "capture.h5", "-o", "c.h5", "--free", "alpha_6")
    assert "alpha_6 and d_6 trade off" in " ".join(aacmm(*free).stdout.split())
    refused = aacmm(*free, "--strict", expect=2)
    assert "alpha_6 and d_6 trade off" in refused.stderr
    one = aacmm("calibrate", "capture.h5", "-o", "c.h5", "--encoder-arcsec", 2, expect=2)
    assert one.stderr.startswith("Error: --seating-mm is missing")


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--sockets", 2, "--socket", "A=1,2,3"), "give only one of these options"),
        (("--region", "z=1"), "not of the form AXIS=LOW:HIGH"),
        (("--length-mm", "long"), "not of the form L or L:M"),
        (("--length", "A,B"), "--length needs two sockets given with --socket"),
        (("-o", "missing/plan.csv"), "cannot be written"),
        (("--region", "z=0:1", "--region", "z=0:2"), "--region names an axis twice"),
    ],
)
def test_plan_refuses(aacmm, arguments, text):
    output = () if "-o" in arguments else ("-o", "plan.csv")
    refused = aacmm("plan", "cheng2018-simulation", *output, *arguments, expect=2)
    assert text in refused.stderr


SOCKETS = ("--socket", "A=400,0,300", "--socket", "B=300,400,400")


@pytest.fixture(scope="module")
def panda_files(tmp_path_factory):
    """A folder with a capture of the Panda and its calibration, as the command line writes them."""
    folder = tmp_path_factory.mktemp("panda")
    command_line(folder, "simulate", "panda", "-o", "p.h5", *SOCKETS, "--length", "A,B")
    command_line(folder, "calibrate", "p.h5", "-o", "c.h5", "--no-cross-validate")
    return folder


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("option", [("--rule", "simple"), ("--test-u-mm", "0.001"), ("--range-mm", "800")])
def test_options_without_an_acceptance_test_are_refused(aacmm, panda_files, tmp_path, option):
    shutil.copytree(panda_files, tmp_path, dirs_exist_ok=True)
    chosen = ("--only", "A", "--acceptance", "iso")  # one socket, which is too little for any test
    said = aacmm("evaluate", "c.h5", "p.h5", "-o", "e.h5", *chosen, *option, expect=2).stderr
    assert re.search(rf"{option[0]} \(\w+\) applies to acceptance tests only", said)
    assert not (tmp_path / "e.h5").exists()


@pytest.mark.slow
def test_the_stored_summary_is_what_is_computed(aacmm, panda_files, tmp_path):
    """``show`` prints the summary in the file; without one, or with that of another version, it computes the same."""
    shutil.copytree(panda_files, tmp_path, dirs_exist_ok=True)
    aacmm("evaluate", "c.h5", "p.h5", "-o", "e.h5")
    for name in ("p.h5", "c.h5", "e.h5"):
        stored = json.loads(aacmm("show", name, "--json").stdout)
        with h5py.File(tmp_path / name, "a") as file:
            file.attrs["package_version"] = "0.0.1"
            del file["summary"]
            file["summary"] = '{"kind": "of another version"}'
        with open(tmp_path / name, "rb+") as stream:
            seal(stream)
        assert json.loads(aacmm("show", name, "--json").stdout) == stored


_IMPORTED = """
import sys
from aacmm_jax.cli import main
try:
    main()
finally:
    print(*sys.modules, file=sys.stderr)
"""
_PLOTS = "matplotlib jinja2"
_NEVER_NEEDED = "optimistix lineax jax.experimental.pallas xarray matplotlib"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "absent"),
    [
        ("--help", f"jax scipy h5py {_PLOTS}"),
        ("--version", f"jax scipy h5py {_PLOTS}"),
        ("calibrate --help", f"jax scipy h5py {_PLOTS}"),
        ("show c.h5", f"jax scipy {_PLOTS}"),
        ("calibrate p.h5 -o again.h5", f"{_NEVER_NEEDED} jinja2"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("evaluate c.h5 p.h5 -o e.h5", f"{_NEVER_NEEDED} jinja2 scipy"),
                ("compare c.h5 c.h5", f"{_NEVER_NEEDED} jinja2"),
                ("report c.h5 -o r.html", _NEVER_NEEDED),
            )
        ),
    ],
)
def test_a_command_imports_and_compiles_no_more_than_it_needs(panda_files, tmp_path, monkeypatch, arguments, absent):
    shutil.copytree(panda_files, tmp_path, dirs_exist_ok=True)
    monkeypatch.setenv("JAX_LOG_COMPILES", "1")
    command = [sys.executable, "-c", _IMPORTED, *arguments.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    *messages, imported = done.stderr.splitlines()
    assert (done.returncode, [line for line in messages if "ompil" in line]) == (0, [])
    assert set(absent.split()) & set(imported.split()) == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mistake", "cause"),
    [
        (lambda q: q * [1, 1, -1, 1, 1, 1], "joint 3 was read with the wrong sign."),
        pytest.param(
            lambda q: q[:, [0, 2, 1, 3, 4, 5]],
            "the columns of joints 2 and 3 are exchanged.",
            marks=pytest.mark.slow,
        ),
        pytest.param(lambda q: q / 0.9, "readings are in gon, but were read as degrees.", marks=pytest.mark.slow),
    ],
    ids=["sign", "order", "gon"],
)
def test_data_of_another_arm_are_no_calibration(aacmm, tmp_path, noisy_capture, mistake, cause):
    """Exit code 1, and what would make the data fit."""
    sockets = {name: mistake(np.asarray(q)) for name, q in noisy_capture.sockets.items()}
    capture = aj.Capture(sockets, noisy_capture.lengths)
    nominal = aj.files.load_specification("cheng2018-simulation")
    aj.files.save_capture(tmp_path / "c.h5", Recording(capture, nominal))
    shown = aacmm("calibrate", "c.h5", "-o", "k.h5", expect=1).stdout
    assert f"Likely cause: {cause}" in " ".join(shown.split())
    evaluated = aacmm("evaluate", "k.h5", "c.h5", "--json", expect=1).stdout
    says = "Not usable, because the calibration is not: the data do not match the arm."
    assert json.loads(evaluated)["verdict"] == {"mark": "bad", "says": says, "achieved": False}
    refused = " ".join(aacmm("export", "k.h5", "-o", "arm.toml", expect=2).stderr.split())
    assert "not usable: the data do not match the arm; calibrate again, or give --force" in refused
    assert not (tmp_path / "arm.toml").exists()
    aacmm("export", "k.h5", "-o", "nominal.toml", "--arm", "nominal")
    assert "not usable" in aacmm("export", "k.h5", "-o", "arm.toml", "--force").stderr
    assert (tmp_path / "arm.toml").exists()


@pytest.mark.slow
def test_a_manifest_is_calibrated_as_its_capture_is(aacmm, tmp_path):
    manifest, plain = EXAMPLES / "simulated_robot" / "plate.toml", ("--no-automatic", "--no-cross-validate", "--json")
    aacmm("import", manifest, "-o", "plate.h5")
    of_capture, of_manifest = (
        json.loads(aacmm("calibrate", source, *plain).stdout) for source in ("plate.h5", manifest)
    )
    assert (of_capture.pop("written"), of_manifest.pop("written")) == ("plate-calibration.h5", "plate-calibration.h5")
    assert of_capture == of_manifest
    assert aj.files.load_calibration(tmp_path / "plate-calibration.h5").recording.sources


@pytest.mark.slow
def test_a_manifest_is_evaluated_as_the_capture_that_it_makes(aacmm):
    of_arm = EXAMPLES / "measuring_arm"
    aacmm("calibrate", of_arm / "session.toml", "-o", "arm.h5", "--model", "dh", "--no-cross-validate")
    aacmm("import", of_arm / "bar.toml", "-o", "bar.h5")
    stored, read = (
        json.loads(aacmm("evaluate", "arm.h5", capture, "--json").stdout) for capture in ("bar.h5", of_arm / "bar.toml")
    )
    assert read["held_out"]["sockets"]
    assert read == stored


@pytest.mark.slow
def test_an_evaluation_says_how_a_certificate_states_its_decision(aacmm):
    of_arm = EXAMPLES / "measuring_arm"
    aacmm("calibrate", of_arm / "session.toml", "-o", "arm.h5", "--model", "dh", "--no-cross-validate")
    for limit, verdict in ((0.05, "pass"), (0.001, "fail"), (None, None)):
        chosen = () if limit is None else ("--mpe", f"Deltam={limit}")
        said = aacmm("evaluate", "arm.h5", of_arm / "bar.toml", *chosen, expect=int(verdict == "fail")).stdout
        assert (f'conformity.verdict = "{verdict}"' in " ".join(said.split())) == (verdict is not None)
        assert ("conformity.verdict" in said) == (verdict is not None)

"""Without an extra, what needs it says so in one sentence with the command that installs it; the rest works."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import aacmm_jax as aj
from aacmm_jax.core import errors as extras

PROJECT = tomllib.loads((Path(__file__).resolve().parents[1] / "pyproject.toml").read_text())["project"]

# `None` among the imported modules is what Python understands as a module that cannot be imported.
COMMAND = """
import sys
sys.modules.update(dict.fromkeys(sys.argv.pop(1).split(",")))
from aacmm_jax.cli import main
main()
"""


def run_without(modules: str, *arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", COMMAND, modules, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


def test_the_extras_are_those_of_the_project():
    declared = PROJECT["optional-dependencies"]
    for extra, package in extras._PACKAGES.items():
        distributions = {"distributed": r"dask\[distributed\]", "cv2": "opencv-python-headless"}
        assert re.match(distributions.get(package, package), declared[extra][0])
    assert declared["all"] == [f"aacmm_jax[{','.join(extras._PACKAGES)}]"]


@pytest.mark.parametrize(
    ("module", "extra", "use"),
    [
        ("matplotlib", "plot", lambda: aj.plot.arm_workspace(aj.load_arm("panda"))),
        ("jinja2", "report", lambda: aj.report.write_report("calibration.h5", "report.html")),
        ("xarray", "data", lambda: aj.study.open_study("study.h5")),
        ("cv2", "camera", lambda: aj.camera.detect("board.png", aj.camera.Charuco(7, 5, 30.0, 22.0))),
        ("distributed", "dask", lambda: aj.study.dask_executor("tcp://127.0.0.1:1").__enter__()),
    ],
)
def test_a_missing_extra_is_one_sentence_in_python(module, extra, use, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    message = rf'^[^.]* needs {module}; install {module} with: pip install "aacmm_jax\[{extra}\]"$'
    with pytest.raises(aj.InputError, match=message):
        use()
    with pytest.raises(ImportError, match=message):
        use()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "extra", "arguments"),
    [
        ("matplotlib", "plot", ("arm", "panda", "--figure", "arm.png")),
        ("cv2", "camera", ("target", "aruco", "--squares", "4x3", "--size-mm", "30", "-o", "board.pdf")),
        pytest.param("jinja2", "report", ("report", "c.h5", "-o", "r.html"), marks=pytest.mark.slow),
    ],
)
def test_a_missing_extra_is_one_sentence_on_the_command_line(module, extra, arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run_without(module, *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(rf'Error: .* needs {module}; install {module} with: .*"aacmm_jax\[{extra}\]"\n', done.stderr)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_demonstration_does_the_rest(tmp_path):
    done = run_without("matplotlib,jinja2,xarray,distributed", "demo", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["calibrated"]["check_rms_mm"] < 0.02
    assert {path.name for path in tmp_path.iterdir()} == {*summary["files"]}
    assert "calibration.h5" in summary["files"]
    left_out = {name: re.search(r'"aacmm_jax\[(\w+)\]"', text)[1] for name, text in summary["left_out"].items()}
    assert left_out == {"calibration.png": "plot", "report.html": "report"}

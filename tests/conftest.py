"""Strictness for all tests: shapes checked at run time, no silent promotion of rank or dtype; and common fixtures.

`make test-slow` leaves the checks of types, which take a tenth of the time, to `make test` and `make test-exhaustive`
(AACMM_TYPES=0).
"""

import collections
import contextlib
import functools
import gc
import io
import os
import subprocess
import sys
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest

from . import run_time_types
from .example_counts import example_count

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
gc.set_threshold(100_000, 20, 50)  # walks through all that JAX and pytest keep took 8 % of the CPU
if os.environ.get("AACMM_TYPES", "1") == "1":
    run_time_types.install()
hypothesis.settings.register_profile(
    "tests", deadline=None, max_examples=example_count(30)
)  # a busy machine is no failure
hypothesis.settings.load_profile("tests")
import aacmm_jax as aj  # noqa: E402 - the hook checks every module imported after it
from aacmm_jax.cli import main  # noqa: E402

SLOW = [pytest.param(None, id="slow", marks=pytest.mark.slow)]  # params of a fixture: all tests that use it are slow
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="session")
def mukca() -> Path:
    """Folder of the real captures, with a manifest for each set."""
    return EXAMPLES / "mukca"


@pytest.fixture(scope="session")
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cache")


def command_line(folder: Path, *arguments: object, expect: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command line in this process, in a folder; returns exit code, output and error text.

    Programs that this process has compiled are used again. A Python warning is an error, as in all tests.
    """
    output, errors = io.StringIO(), io.StringIO()
    command = ["aacmm", *map(str, arguments)]
    thresholds, compile_time = gc.get_threshold(), jax.config.jax_persistent_cache_min_compile_time_secs
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.chdir(folder),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
    ):
        patch.setattr(sys, "argv", list(command))
        patch.setattr(gc, "freeze", lambda: None)  # for a process that ends; here it would keep garbage for ever
        patch.setenv("COLUMNS", "110")
        try:
            main()
            code = 0
        except SystemExit as ended:
            code = int(ended.code or 0)
        finally:
            gc.set_threshold(*thresholds)
            jax.config.update("jax_persistent_cache_min_compile_time_secs", compile_time)
    assert code == expect, output.getvalue() + errors.getvalue()
    return subprocess.CompletedProcess(command, code, output.getvalue(), errors.getvalue())


@pytest.fixture
def aacmm(tmp_path):
    """The command line in this process, in an empty folder."""
    return functools.partial(command_line, tmp_path)


@pytest.fixture
def aacmm_process(tmp_path, cache):
    """The same in a fresh process, for tests of start-up, exit codes, caches and streams of a real one."""

    def run(*arguments: object, expect: int = 0) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"XDG_CACHE_HOME": str(cache), "COLUMNS": "110"}
        done = subprocess.run(
            [sys.executable, "-m", "aacmm_jax", *map(str, arguments)],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=600,
        )
        assert done.returncode == expect, done.stdout + done.stderr
        return done

    return run


@pytest.fixture(scope="session")
def paper_arm() -> "aj.Arm":
    return aj.load_arm("cheng2018-simulation")


@pytest.fixture(scope="session")
def paper_capture(paper_arm) -> "aj.Capture":
    """70 noise-free poses in one socket, and a second socket that only carries a length: the paper's simulation."""
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300)}
    return aj.simulate(paper_arm, sockets, poses={"A": 70, "B": 1}, lengths=[("A", "B")], seed=5)


@pytest.fixture(scope="session")
def noisy_capture(paper_arm) -> "aj.Capture":
    """The paper's simulation with the noise of a real arm: 2 arcsec and 5 um."""
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300)}
    return aj.simulate(
        paper_arm,
        sockets,
        poses={"A": 70, "B": 5},
        lengths=[("A", "B", 0.002)],
        encoder_arcsec=2.0,
        seating=0.005,
        seed=5,
    )


@pytest.fixture(scope="session")
def observed_record(paper_arm) -> "aj.calibration.CalibrationRecord":
    """A calibration from two sockets and other observations of several kinds, with a robust loss and one bad pose."""
    from aacmm_jax.data import observations as kinds

    station, box = (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), [[200, -300, 100], [600, 300, 500]]
    bar = {"near": (0, 0, 0), "far": (300, 0, 0)}
    simulated = [
        kinds.SimulatedTransforms("tracker", box, 25, (10, 20, 80, 0.3, 0.2, -0.7), station, u=0.01, u_angle=2e-4),
        kinds.SimulatedSphere("ball", (300, 0, 300), 50.0, 12, u=0.001),
        kinds.SimulatedPlanes("block", (300, -200, 150), [[80, 0, 0], [0, 80, 0]], 8, distance=100.0, u=0.001),
        kinds.SimulatedArtefact("bar", bar, 8, (0, 0, 0.7, 300, -200, 300), u=0.0005),
    ]
    nominal = aj.kinematics.ArmSpecification(paper_arm, "paper's")
    true = aj.perturbed_arm(nominal.space(), length=1.0, angle=1e-3, seed=1)
    sockets = {"A": (400, 200, 300), "B": (500, 300, 100)}
    capture = aj.simulate(
        true, sockets, poses={"A": 15, "B": 8}, observations=simulated, encoder_arcsec=2.0, seating=0.005, seed=3
    )
    q = np.array(capture.sockets["A"])
    q[4] += 0.01
    capture = aj.Capture(capture.sockets | {"A": q}, [], capture.observations)
    result = aj.calibrate(paper_arm, capture, nominal.bounds(), robust="tukey")
    return aj.calibration.record_of(result, aj.Recording(capture, nominal), robust="tukey")


@pytest.fixture(scope="session")
def camera_records(paper_arm) -> "dict[str, aj.calibration.CalibrationRecord]":
    """Calibrations of two joints with a camera: a pinhole on the arm, and a fixed fisheye; both with distortion."""
    from aacmm_jax.data.observations import SimulatedPixels

    points = [(60 * column, 60 * row, 0) for row in range(2) for column in range(3)]
    on_arm = {"intrinsics": (600, 602, 321, 238, -0.25, 0.08, 0.001, -0.0005), "mount": (60, 0, 20, 0, 0, 0.3)}
    on_arm |= {"camera": "webcam", "frame": (np.pi, 0, 0, 400, 200, 300)}
    fixed = {"intrinsics": (330, 330, 320, 240, 0.05, -0.02, 0.004, 0), "mount": (20, 0, 40, 0, 0.2, 0.3)}
    fixed |= {"camera": 'the "<b>webcam</b>"', "frame": (0, np.pi / 2, 0, -100, 200, 300), "on_arm": False}
    nominal = aj.kinematics.ArmSpecification(paper_arm, "paper's")
    bounds = aj.Bounds.around(paper_arm, aj.Parameters(paper_arm, ("theta_2", "theta_3")), angle=0.02)
    records = {}
    for name, stated in (("on the arm", on_arm), ("fixed", fixed | {"model": "fisheye"})):
        webcam = SimulatedPixels("images", 12, board="board", points=points, image_size=(640, 480), **stated)
        capture = aj.simulate(paper_arm, {}, observations=[webcam], encoder_arcsec=2.0, seed=3)
        recording = aj.Recording(capture, nominal)
        records[name] = aj.calibration.record_of(aj.calibrate(paper_arm, capture, bounds), recording)
    return records


@pytest.fixture(params=["on the arm", "fixed"])
def camera_record(request, camera_records):
    return camera_records[request.param]


@pytest.fixture(scope="module", autouse=True)
def _few_memory_maps():
    """Forget compiled programs before Linux refuses more memory maps (65,530 a process), which ends in a crash."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 20_000:
        jax.clear_caches()
        gc.collect()


# Modules in decreasing order of their run time: a long one started last would keep a single worker busy at the end.
LONGEST = (
    *("test_notebooks", "files/test_example_robots", "test_readme", "test_hostile"),  # of the slow tests
    "study",  # the whole folder
    "cli/test_cli",
    "solver/test_solver",
    "report/test_report",
    "calibration/test_prior_fit",
    "pipeline/test_single",
    "calibration/test_observed",
    *("core/test_numpy_or_jax", "core/test_linear_algebra", "core/test_deadlock"),
    *("calibration/test_observed_batch", "calibration/test_redrawn", "calibration/test_sampling", "planning/test_kit"),
    "diagnostics/test_reading_check",
    "calibration/test_stages",
    "certificate/test_document",
    "kinematics/test_corrections",
    "files/test_hdf5",
    "uncertainty/test_uncertainty",
    "data/test_observations",
    "drift/test_drift",
    "diagnostics/test_shared_errors",
    "acceptance/test_acceptance",
    "cli/test_observations_cli",
    "cli/test_arm_cli",
    "pipeline/test_observed_cross_validation",
    "acceptance/test_requirements",
    "kinematics/test_chain",
    "calibration/test_batch",
    "diagnostics/test_likely_cause",
    "planning/test_constraints",
    "uncertainty/test_observed_identifiability",
    "calibration/test_prismatic",
    "test_package",
    "planning/test_design",
    "diagnostics/test_contradictions",
    "diagnostics/test_noisy_encoders",
    "pipeline/test_model_ladder",
    "test_real_captures",
    "plot/test_plot",
    "test_layout",
    "diagnostics/test_model_errors",
    "test_inputs",
    "files/test_content_digest",
    "cli/test_outputs",
    "cli/test_models_cli",
)


def pytest_collection_finish():
    """What is imported stays to the end, so that the collector leaves it out."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A module's tests share its fixtures, so one worker runs them all, and the tests of studies share their programs;
    notebooks share nothing, and take long."""
    if config.getvalue("dist") != "loadscope":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class ByModule(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            if nodeid.startswith("tests/study/"):
                return "tests/study"
            return nodeid if nodeid.startswith("tests/test_notebooks.py") else super()._split_scope(nodeid)

    return ByModule(config, log)


@pytest.hookimpl(tryfirst=True)  # before pytest deselects by markers
def pytest_collection_modifyitems(items):
    """Sort the modules by run time (needs ``--no-loadscope-reorder``); the order within a module is kept.

    Rows of a table beyond the number that `first_rows` gives are slow.
    """
    here, rank = Path(__file__).parent, {name: number for number, name in enumerate(LONGEST)}
    rows = collections.Counter()
    for item in items:
        quick = item.get_closest_marker("first_rows")
        if quick and not item.get_closest_marker("slow") and not item.get_closest_marker("exhaustive"):
            rows[item.path, item.originalname] += 1
            if rows[item.path, item.originalname] > quick.args[0]:
                item.add_marker(pytest.mark.slow)

    def of(item):
        module = item.path.relative_to(here).with_suffix("")
        return rank.get(module.as_posix(), rank.get(module.parent.as_posix(), len(rank)))

    items.sort(key=of)

"""The benchmark scripts run, measure the same thing for every contender, and name those that are absent."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def contenders():
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import contenders

    return contenders


def test_contenders_minimise_the_same_residual(contenders):
    """NumPy's chain, the textbook chain and the package's agree; NumPy's Jacobian is its residual's derivative."""
    task = contenders.Task()
    vector = task.starts(1, 0)[0]
    residual, jacobian = contenders.numpy_functions(task)
    arm = task.space.arm(vector)
    tips = np.asarray(arm.position(task.q))
    np.testing.assert_allclose(residual(vector).reshape(-1, 3), tips - tips.mean(axis=0), atol=1e-9)
    plain = jax.vmap(lambda row: contenders.product_of_matrices(arm, row))(task.capture.q)
    np.testing.assert_allclose(plain, tips, atol=1e-9)
    centred = np.asarray(arm.jacobian(task.q, task.space.names))
    np.testing.assert_allclose(jacobian(vector), (centred - centred.mean(axis=0)).reshape(-1, 21), atol=1e-9)


@pytest.mark.slow
def test_a_part_runs_and_names_who_is_absent(tmp_path):
    options = ["--rounds", "1", "--only", "kinematics", "--results", tmp_path]
    command = [sys.executable, ROOT / "benchmarks/throughput.py", *options]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=tmp_path, timeout=600)
    (file,) = tmp_path.glob("throughput-*.json")
    rows = json.loads(file.read_text())["results"]["kinematics"]
    peers = [row for row in rows if "Pinocchio" in row["what"]]
    installed = importlib.util.find_spec("pinocchio") is not None
    assert len(peers) == 3
    assert all(row.get("absent", False) != installed for row in peers)
    assert ("absent" in done.stdout) != installed


@pytest.mark.slow
@pytest.mark.parametrize(("placements", "most"), [(3, 1.6), (8, 1.3)])
def test_intervals_from_few_placements_hold(placements, most):
    """64 trials of the benchmark, whose 1,000 are the measure; the errors of one trial are alike (+-5 %)."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import degrees_of_freedom

    trials = degrees_of_freedom.placed(placements)
    found = degrees_of_freedom.covered(trials, 0.01, range(64))
    assert found.inside > 0.88
    assert np.median(found.over_oracle) < most
    # What made it necessary: the normal factor covers less.
    assert np.mean(np.abs(found.errors) <= 1.96 * found.u) < found.inside


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("seed", range(6))
def test_geometry_is_found_from_any_start(seed):
    """A few of the benchmark's 300 trials: any frame and offset, 10 to 2,000 points, 6 and 7 joints."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import starts

    assert starts.geometry_found(starts.drawn(seed))

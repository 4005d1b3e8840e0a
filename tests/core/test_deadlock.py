"""Programs that hold several independent factorisations, or calibrations, end: jaxlib's batched LAPACK calls can stall
forever.

Stalls are a matter of chance (in the program below with NumPy's names of jax.numpy.linalg after some thirty rounds on
two cores), so the programs are also searched for calls of LAPACK.
"""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core import linear_algebra

PROGRAM = """
import jax, jax.numpy as jnp, numpy as np
import aacmm_jax as aj
from aacmm_jax.core import linear_algebra
from tests.core.test_deadlock import batches_of_calibrations
rows = np.random.default_rng(0).normal(size=(4, 100, 40, 21))
matrices = jnp.asarray(np.swapaxes(rows, -1, -2) @ rows)
@jax.jit
def factorisations(matrices):
    a, b, c, d = matrices
    return (linear_algebra.semidefinite_eigen(a), linear_algebra.inverse_positive_definite(b),
            linear_algebra.inverse_cholesky(c), linear_algebra.singular_values(d))
for _ in range(20):
    jax.block_until_ready(factorisations(matrices))
calibrations, starts = batches_of_calibrations("joint", 2)
for _ in range(10):
    found = jax.block_until_ready(calibrations(starts))
print("finite:", all(bool(jnp.all(jnp.isfinite(values))) for values in jax.tree.leaves(found)))
"""


def batches_of_calibrations(method, count):
    """Calibrations that do not depend on each other, each over a batch of starts, in one program; and the starts."""
    arm = aj.load_arm("cheng2018-simulation")
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300)}
    poses, lengths = {"A": 30, "B": 5}, [("A", "B", 0.002)]
    captures = [
        aj.simulate(arm, sockets, poses=poses, lengths=lengths, encoder_arcsec=2.0, seed=seed) for seed in range(count)
    ]
    bounds = aj.Bounds.around(arm, aj.Parameters.free_of(arm))
    starts = np.asarray(bounds.space.vector(arm)) + 1e-4 * np.random.default_rng(0).normal(size=(4, 21))

    @jax.jit
    def program(starts):
        def calibrated(capture):
            return jax.vmap(lambda start: aj.calibrate(arm, capture, bounds, start=start, method=method))(starts)

        return [(found.parameters, found.covariance) for found in map(calibrated, captures)]

    return program, jnp.asarray(starts)


@pytest.mark.exhaustive
def test_independent_factorisations_and_calibrations_in_one_program_end():
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, timeout=600, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "finite: True\n"), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("method", [pytest.param("two-stage", marks=pytest.mark.slow), "joint"])
def test_a_batch_of_calibrations_calls_no_lapack(method):
    program, starts = batches_of_calibrations(method, 1)
    assert "lapack" not in program.lower(starts).as_text()


@pytest.mark.slow
def test_derivatives_of_a_solve_and_the_factorisations_call_no_lapack():
    def optimum(target):
        return aj.least_squares(
            lambda y, target: jnp.append(y**2 - target, y[0] * y[1]), jnp.ones(3), target, throw=False
        ).value

    targets = jnp.asarray(np.random.default_rng(0).uniform(1, 2, size=(4, 3)))
    assert "lapack" not in jax.jit(jax.vmap(jax.jacrev(optimum))).lower(targets).as_text()
    matrices = jnp.broadcast_to(jnp.eye(3), (4, 3, 3))
    for name in ("semidefinite_eigen", "inverse_positive_definite", "inverse_cholesky", "singular_values"):
        assert "lapack" not in jax.jit(getattr(linear_algebra, name)).lower(matrices).as_text()
    assert "lapack" in jax.jit(jnp.linalg.eigh).lower(matrices).as_text()

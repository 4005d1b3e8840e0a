"""The paper's method: an interior-point search that minimises DE itself within the box (section 3.2).

The paper's description fits MATLAB's `fmincon`; SciPy's `trust-constr` is the nearest open interior-point method. It is
given exact gradients and 300 iterations, about what fmincon's default of 3,000 evaluations allows with 21 finite
differences.

    python benchmarks/cheng2018/paper_method.py      # all 1,000 sets of both simulations, about 20 minutes on 2 cores

writes results/paper_method.csv. `make reproduce` runs a few of them again. They need not end at the stored k: 300
iterations magnify the last bit of a processor. What does not depend on it is checked (`ends_as_stored`).
"""

import csv
import multiprocessing
import os
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import partial

os.environ.setdefault("OMP_NUM_THREADS", "1")

import aacmm_jax as aj  # noqa: I001 - must come before arrays are made
import jax
import jax.numpy as jnp
import numpy as np
from paper import (
    HERE,
    NAMES,
    SETS,
    box,
    metrics_of,
    is_length,
    pose_sets,
    random_starts,
    scale_to,
    simulated_arm,
    tips_of,
    vector,
)

FILE = HERE / "results" / "paper_method.csv"
COLUMNS = ("simulation", "set", "de_mm", "deltam_mm", "k", "length_error_mm", "angle_error_rad", "iterations")
ITERATIONS = 300
RESIDUAL = 0.05  # mm: how far from a scaled copy of the truth noise-free searches end at most, ten times what is seen


@jax.jit
def de_and_gradient(values: jax.Array, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The paper's objective (eq. 15) and its gradient."""

    def de(point: jax.Array) -> jax.Array:
        tips = aj.Parameters(simulated_arm(), NAMES).arm(point).position(q)
        return jnp.mean(jnp.linalg.norm(tips - jnp.mean(tips, axis=0, keepdims=True), axis=-1))

    return jax.value_and_grad(de)(values)


def minimise(q: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, int]:
    """The parameters with the least DE that the search finds, and its iterations."""
    from scipy.optimize import Bounds, minimize

    def objective(point: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = de_and_gradient(jnp.asarray(point), jnp.asarray(q))
        return float(value), np.asarray(gradient)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SciPy warns of every quasi-Newton update that it skips
        found = minimize(
            objective,
            start,
            jac=True,
            method="trust-constr",
            bounds=Bounds(lower, upper),
            options={"maxiter": ITERATIONS},
        )
    return found.x, int(found.nit)


def problem(simulation: int, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Readings, box and start of one rerun."""
    lower, upper = box("simulation", str(simulation))
    return pose_sets(number + 1)[number], lower, upper, random_starts(lower, upper, SETS, simulation)[number]


def one_in_box(given: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """`minimise` for one (readings, lower, upper, start): the parameters."""
    return minimise(*given)[0]


def many_in_boxes(problems: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Parameters that the method finds in many problems, on all cores."""
    with ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn")) as pool:
        return np.array(list(pool.map(one_in_box, problems)))


def one(simulation: int, q: np.ndarray, number: int) -> dict[str, float]:
    """One rerun, as a row of the file."""
    lower, upper = box("simulation", str(simulation))
    values, iterations = minimise(q, lower, upper, random_starts(lower, upper, SETS, simulation)[number])
    truth = vector("simulation", "nominal")
    de, deltam = (float(x[0]) for x in metrics_of(tips_of(values[None], q[None])))
    error = np.abs(values - truth)
    numbers = (de, deltam, float(scale_to(values, truth)), error[is_length()].max(), error[~is_length()].max())
    return dict(zip(COLUMNS, (simulation, number, *(float(f"{x:.6g}") for x in numbers), iterations), strict=True))


def rerun(count: int) -> list[dict[str, float]]:
    """The first reruns of both simulations, on all cores."""
    q = pose_sets(count)
    rows = []
    with ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn")) as pool:
        for simulation in (1, 2):
            rows += pool.map(partial(one, simulation), q, range(count), chunksize=max(1, count // 20))
    return rows


def ends_as_stored(values: np.ndarray, q: np.ndarray, box: tuple[np.ndarray, np.ndarray], runs: list[dict]) -> bool:
    """Whether a noise-free search ends as those stored: inside its box, at a copy of the truth, with a DE like theirs.

    The copy may have any scale that fits the box, since DE does not determine it.
    """
    truth, lengths = vector("simulation", "nominal"), is_length()
    de = float(metrics_of(tips_of(values[None], q[None]))[0][0])
    inside = np.all((box[0] <= values) & (values <= box[1]))
    copy = np.abs(values - scale_to(values, truth) * truth)[lengths].max() < RESIDUAL
    return bool(inside and copy and de <= 2 * max(line["de_mm"] for line in runs))


def stored() -> list[dict[str, float]]:
    """The reruns of the file."""
    with FILE.open(newline="") as file:
        return [{key: float(value) for key, value in line.items()} for line in csv.DictReader(file)]


def main() -> None:
    rows = rerun(SETS)
    FILE.parent.mkdir(exist_ok=True)
    with FILE.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()

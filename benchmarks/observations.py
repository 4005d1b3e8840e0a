"""Calibrations from observations of all kinds: coverage of 95 % intervals by kind and pair of kinds, and throughput.

``python benchmarks/observations.py coverage [KIND ...] [--pairs] [--trials 2000]`` and
``python benchmarks/observations.py throughput [--rounds 5]`` print a line for each measurement and write
``results/observations-DATE-PART.json``.
"""

import argparse
import datetime
import itertools
import json
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import equinox as eqx
import numpy as np

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds

NOISE = aj.Noise(encoder_arcsec=2, seating=0.005)
BOX = [[200, -300, 100], [600, 300, 500]]
FRAME = (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
BAR = {"a": (0, 0, 0), "b": (300, 0, 0)}
PLATE = {f"{i}{j}": (150.0 * i, 150.0 * j, 0.0) for i in range(3) for j in range(3)}
PLACEMENTS = [(0, 0, 0, 300, 0, 200), (0, 0, 1.5, 300, -200, 250), (0, 1.5, 0, 400, 100, 500)]
CENTRES = [(300, 0, 300), (500, 200, 200), (300, -300, 150)]
SIMULATED: dict[str, list[Any]] = {
    "points": [kinds.SimulatedPoints("T", BOX, 60, FRAME, u=0.01)],
    "transforms": [kinds.SimulatedTransforms("T6", BOX, 60, (10, 20, 80, 0.1, 0.2, 0.3), FRAME, u=0.01, u_angle=1e-4)],
    "spheres": [kinds.SimulatedSphere(f"s{i}", centre, 50.0, 25, u=0.001) for i, centre in enumerate(CENTRES)],
    "planes": [
        kinds.SimulatedPlanes("pair", (200, -200, 100), [(300, 0, 0), (0, 400, 0)], 30, distance=150.0, u=0.001),
        kinds.SimulatedPlanes("wall", (300, -200, 100), [(0, 300, 0), (0, 0, 400)], 30),
    ],
    "bars": [
        kinds.SimulatedArtefact(f"bar{i}", BAR, 10, frame, u=0.001, artefact="bar")
        for i, frame in enumerate(PLACEMENTS)
    ],
    "plate": [kinds.SimulatedArtefact("plate", PLATE, 8, (0, 0, 0.3, 250, -150, 200), u=0.001)],
    "distances": [
        kinds.SimulatedDistances("d", BOX, 60, (900, 300, 100), u=0.003),
        kinds.SimulatedDistances("e", BOX, 60, (100, 700, 100), u=0.003),
    ],
}
# A target in an unknown place of the last frame, with unknown orientation, leaves these of the last link open.
OPEN_WITH_A_TARGET = ("probe_z", "alpha_6", "theta_6", "a_6", "d_6")


class Trials:
    """Captures of one true arm, 1 mm and 0.1 degrees from the nominal one, that differ in their errors only."""

    def __init__(self, chosen: tuple[str, ...]):
        self.nominal = aj.load_arm("cheng2018-simulation")
        space = aj.Parameters.independent(self.nominal)
        if chosen == ("transforms",):
            names = tuple(name for name in space.names if name not in OPEN_WITH_A_TARGET)
            space = aj.Parameters(space.base, names)
        self.space, self.bounds = space, aj.Bounds.around(self.nominal, space)
        self.true = aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=1)
        self.simulated = [one for kind in chosen for one in SIMULATED[kind]]
        exact = aj.simulate(self.true, {}, observations=self.simulated, noise=aj.Noise(), seed=3)
        self.exact = []
        for one, observation in zip(self.simulated, exact.observations, strict=True):
            arm = self.true if one.offset is None else self.true.replace(probe=one.offset)
            q = np.asarray(observation.q)
            inverse = np.linalg.pinv(np.asarray(arm.jacobian(q, tuple(f"q_{i + 1}" for i in range(q.shape[1])))))
            self.exact.append((q, np.asarray(arm.pose(q)), inverse))

    def captures(self, count: int, seed: int) -> aj.Capture:
        """A batch of captures, each with errors of its own in readings, seat and everything measured."""
        random = np.random.default_rng(seed)
        found = []
        for _ in range(count):
            errors: dict[str, np.ndarray] = {}  # of certified coordinates, which all placements of an artefact share
            recorded = []
            for one, (q, transforms, inverse) in zip(self.simulated, self.exact, strict=True):
                seat = float(NOISE.seating) * random.normal(size=(len(q), 3))
                # The seat moves the tip by a few micrometres, which the readings follow to first order.
                read = q + np.einsum("mnc,mc->mn", inverse, seat) + float(NOISE.encoder) * random.normal(size=q.shape)
                if isinstance(one, kinds.SimulatedArtefact):
                    drawn = one.u * random.normal(size=(len(one.points), 3))
                    shared = errors.setdefault(one.artefact or one.name, drawn)
                    one = eqx.tree_at(lambda s: s.errors, one, shared, is_leaf=lambda leaf: leaf is None)
                recorded.append(one.recorded(read, transforms, random))
            found.append(aj.Capture({}, [], recorded))
        return aj.stack_captures(found)


def coverage_of(chosen: tuple[str, ...], trials: int, noise: aj.Noise | None) -> dict[str, Any]:
    """How often 95 % intervals hold the true parameters, and the true value of 80 lengths over the volume."""
    task, begun = Trials(chosen), time.process_time()
    captures = task.captures(trials, 1)
    drawn = time.process_time() - begun
    many = aj.calibrate_many(task.nominal, captures, task.bounds, noise=noise, covariance=True)
    space, good = task.space, many.converged
    errors = many.parameters - np.asarray(space.vector(task.true))
    pairs = [
        aj.uncertainty.sample_lengths(task.nominal, 60, length=300.0, seed=5),
        aj.uncertainty.sample_lengths(task.nominal, 20, length=None, seed=6),
    ]
    start, end = (np.concatenate(column) for column in zip(*pairs, strict=True))

    def measured(arm: aj.Arm) -> np.ndarray:
        return np.linalg.norm(np.asarray(arm.position(end)) - np.asarray(arm.position(start)), axis=-1)

    between = np.asarray(task.true.position(end)) - np.asarray(task.true.position(start))
    direction = between / np.linalg.norm(between, axis=1, keepdims=True)
    change = np.asarray(task.true.jacobian(end, space.names)) - np.asarray(task.true.jacobian(start, space.names))
    slopes = np.einsum("lc,lcp->lp", direction, change)
    length_errors = np.stack([measured(space.arm(row)) for row in many.parameters]) - measured(task.true)
    length_u = np.sqrt(np.einsum("lp,bpq,lq->bl", slopes, many.covariance, slopes))
    inside = np.abs(np.concatenate([errors, length_errors], axis=1)) <= 1.96 * np.concatenate(
        [many.u, length_u], axis=1
    )
    share = 100 * inside[good].mean(axis=0)
    p = len(space.names)
    return {
        "kinds": " + ".join(chosen),
        "noise": "estimated" if noise is None else "given",
        "trials": trials,
        "converged": float(good.mean()),
        "parameters": [round(float(x), 2) for x in (share[:p].min(), share[:p].mean(), share[:p].max())],
        "lengths": [round(float(x), 2) for x in (share[p:].min(), share[p:].mean(), share[p:].max())],
        "least": space.names[int(np.argmin(share[:p]))],
        "standard_error": round(100 * float(np.sqrt(0.95 * 0.05 / trials)), 2),
        "largest_U_mm": round(float(2 * length_u[good].mean(axis=0).max()), 4),
        "reduced_chi": round(float(many.reduced_chi[good].mean()), 4),
        "cpu_s": [round(drawn, 1), round(time.process_time() - begun - drawn, 1)],
    }


def coverage(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Each kind alone, and with ``--pairs`` each pair of them."""
    names = tuple(given.kinds or SIMULATED)
    chosen = [(name,) for name in names] if not given.pairs else list(itertools.combinations(names, 2))
    found = []
    for combination in chosen:
        for noise in (NOISE, None) if given.estimated else (NOISE,):
            found.append(coverage_of(combination, given.trials, noise))
            print(found[-1], flush=True)
    return found


PARTS = {"coverage": coverage}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=list(PARTS))
    parser.add_argument("kinds", nargs="*", choices=[*SIMULATED, []], default=[], help="of coverage; by default all")
    parser.add_argument("--pairs", action="store_true", help="pairs of kinds instead of each alone")
    parser.add_argument("--estimated", action="store_true", help="also with the noise estimated from the residuals")
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--results", type=Path, default=Path(__file__).parent / "results", help="folder of the JSON file"
    )
    given = parser.parse_args()
    found = PARTS[given.part](given)
    path = given.results / f"observations-{datetime.date.today()}-{given.part}.json"
    path.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

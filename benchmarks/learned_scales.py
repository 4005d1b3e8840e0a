"""Whether intervals hold where the scales of a prior are learned, and what learning costs a batch.

``python benchmarks/learned_scales.py [--trials N]`` draws true arms from a prior about the paper's arm (0.3 mm,
0.5 mrad), records a few poses of each (2 arcsec, 5 um), calibrates them with both scales learned, and writes
``results/learned-scales-DATE.json``: the part of the 21 parameters within their 95 % intervals and the mean of
(error / u)^2, with the noise given and estimated. Then the time of a batch of 64 calibrations of 80 poses, jointly,
with learned scales and without a prior, compiled. Ten minutes of CPU time with 200 trials.
"""

import argparse
import datetime
import json
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import aacmm_jax as aj

NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
LENGTH, ANGLE = 0.3, 5e-4  # mm and rad: standard deviations of the true parameters
SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300), "D": (500, 300, 100)}
POSES = (6, 12, 20)  # in each of the first two sockets
BATCH = 64


def coverage(poses: int, trials: int, given: bool) -> dict[str, Any]:
    """Of the parameters, and the mean square of their errors over u."""
    specification = aj.files.load_specification("cheng2018-simulation")
    space = specification.space()
    bounds = aj.Bounds.around(specification.arm, space, length=10.0, angle=0.02)
    nominal, sd = np.asarray(space.vector()), np.where(space.lengths, LENGTH, ANGLE)
    two = {name: SOCKETS[name] for name in ("A", "B")}
    inside, squares, factors = [], [], []
    for seed in range(trials):
        vector = nominal + sd * np.random.default_rng(seed).normal(size=len(sd))
        options = {"poses": poses, "lengths": [("A", "B", 0.002)], "noise": NOISE, "seed": seed}
        capture = aj.simulate(space.arm(vector), two, **options)
        found = aj.calibrate(
            specification.arm,
            capture,
            bounds,
            method="joint",
            prior=aj.Prior(learn=True),
            noise=NOISE if given else None,
            undetermined="ignore",
        )
        factor = aj.uncertainty_of(found).factor(0.95)
        z = (np.asarray(found.parameters) - vector) / np.sqrt(np.diag(np.asarray(found.covariance)))
        inside.append(np.mean(np.abs(z) <= factor))
        squares.append(np.mean(z**2))
        factors.append(np.median(factor))
    return {
        "inside": round(float(np.mean(inside)), 4),
        "standard_error": round(float(np.std(inside) / np.sqrt(trials)), 4),
        "mean_square": round(float(np.mean(squares)), 3),
        "factor": round(float(np.median(factors)), 2),
    }


def batches() -> dict[str, float]:
    """Seconds of CPU a batch, the best of three, after one that compiles."""
    specification = aj.files.load_specification("cheng2018-simulation")
    bounds = specification.bounds()
    options = {"poses": 20, "lengths": [("A", "B", 0.002)], "noise": NOISE}
    captures = [aj.simulate(specification.arm, SOCKETS, **options, seed=seed) for seed in range(BATCH)]
    many, found = aj.stack_captures(captures), {}
    for name, prior in (("plain", None), ("learned", aj.Prior(learn=True))):
        times = []
        for _ in range(4):
            begun = time.process_time()
            result = aj.calibrate_many(specification.arm, many, bounds, method="joint", covariance=True, prior=prior)
            np.asarray(result.parameters)
            times.append(time.process_time() - begun)
        found[name] = round(min(times[1:]), 3)
    found["ratio"] = round(found["learned"] / found["plain"], 2)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--only", choices=("coverage", "batches"))
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    found: dict[str, Any] = {}
    for poses in POSES if arguments.only != "batches" else ():
        for given in (True, False):
            name = f"{poses} poses in each of two sockets, noise {'given' if given else 'estimated'}"
            found[name] = coverage(poses, arguments.trials, given)
            print(name, found[name], flush=True)
    if arguments.only != "coverage":
        found["batches, CPU s"] = batches()
        print(found["batches, CPU s"])
    arguments.results.mkdir(parents=True, exist_ok=True)
    path = arguments.results / f"learned-scales-{datetime.date.today()}.json"
    path.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

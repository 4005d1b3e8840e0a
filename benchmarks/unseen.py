"""How often honest data that a calibration has not seen are said to disagree with it (`calibration.prediction`).

``python benchmarks/unseen.py [--trials N]`` simulates calibrations of the paper's arm (2 arcsec, 5 um; 1 mm and 0.1 deg
off), evaluates each on a capture of the same arm, and writes ``results/unseen-DATE.json``. Four minutes of CPU time.
"""

import argparse
import datetime
import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds

NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300), "D": (500, 300, 100)}
LENGTHS = [("A", "B", 0.002), ("C", "D", 0.002)]
UNSEEN = {"E": (-300, 600, 400), "F": (-100, 600, 500), "G": (500, -100, 500)}
PLACES = {"a": (300, 200, 300), "b": (300, -300, 300), "c": (-300, 500, 300)}
HOLES = {f"{place}/{hole}": (x + 100 * hole, y, z) for place, (x, y, z) in PLACES.items() for hole in (0, 1)}
STATION = kinds.SimulatedPoints(
    "tracker", [[200, -300, 100], [600, 300, 500]], 30, (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), u=0.01
)
SPHERE = kinds.SimulatedSphere("sphere", (400, 0, 300), 50.0, 20, u=0.001)
LEVELS = (0.01, 0.05, 0.2, 0.5)


def probabilities(arm: aj.Arm, true: aj.Arm, bounds: aj.Bounds, seed: int, known: bool, observations: list) -> list:
    """Of the poses, and of the lengths, of a capture that was not used."""
    seen = aj.simulate(true, SOCKETS, poses=20, lengths=LENGTHS, noise=NOISE, seed=2 * seed)
    sockets = {} if observations else UNSEEN
    lengths = [] if observations else [("E", "F", 0.002)]
    new = aj.simulate(
        true, sockets, poses=15, lengths=lengths, observations=observations, noise=NOISE, seed=2 * seed + 1
    )
    noise = NOISE if known else None
    result = aj.calibrate(arm, seen, bounds, method="joint", noise=noise, undetermined="ignore")
    found = aj.calibration.unseen_errors(aj.uncertainty_of(result), new)
    return [found.of(found.parts).probability, found.of_lengths().probability]


def cross_validated(arm: aj.Arm, true: aj.Arm, bounds: aj.Bounds, seed: int) -> list:
    """0 where three placements, each left out once, are said to disagree, 1 where not."""
    lengths = [(f"{place}/0", f"{place}/1", 0.002) for place in PLACES]
    capture = aj.simulate(true, HOLES, poses=15, lengths=lengths, noise=NOISE, seed=seed)
    return [float(not aj.cross_validate(arm, capture, bounds, method="joint").surprising)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=400)
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    arm = aj.load_arm("cheng2018-simulation")
    space = aj.Parameters.independent(arm)
    bounds = aj.Bounds.around(arm, space, length=10.0, angle=0.0175)
    cases: dict[str, Callable] = {
        "sockets, noise given": lambda true, i: probabilities(arm, true, bounds, i, True, []),
        "sockets, noise estimated": lambda true, i: probabilities(arm, true, bounds, i, False, []),
        "tracker and sphere, noise estimated": lambda true, i: probabilities(
            arm, true, bounds, i, False, [STATION, SPHERE]
        ),
        "cross-validation, noise estimated": lambda true, i: cross_validated(arm, true, bounds, i),
    }
    found = {}
    for name, case in cases.items():
        start, rows = time.process_time(), []
        for i in range(given.trials):
            rows.append(case(aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=i), i))
        columns = zip(("poses", "lengths"), np.transpose(rows), strict=False)
        found[name] = {
            what: {str(level): float(np.mean(values < level)) for level in LEVELS}
            for what, values in columns
            if np.all(np.isfinite(values))
        } | {"trials": len(rows), "cpu_s": round(time.process_time() - start, 1)}
        print(name, json.dumps(found[name]), flush=True)
    given.results.mkdir(parents=True, exist_ok=True)
    path = given.results / f"unseen-{datetime.date.today()}.json"
    path.write_text(json.dumps({"below_level": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Whether intervals hold where poses share errors that the model does not have (`calibration.shared_errors`).

``python benchmarks/shared_errors.py [--trials N] [--only simulated|mukca|ur10]`` writes
``results/shared-errors-DATE.json``. Simulated: captures of the paper's arm (2 arcsec, 5 um, 80 poses in four sockets),
half of the trials in two stages, half joint; lengths of 300 mm over its volume within their 95 % intervals, with the
noise given and estimated, and with ``shared_errors=False`` ("plain"). MUKCa: `examples/mukca`, one placement left out in
turn. UR10: `examples/ipa_ur10`, 500 poses of series C, tested on A. Ten minutes of CPU time with 100 trials.
"""

import argparse
import datetime
import json
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from model_warnings import PAPER, Errors, Trials, bending, eccentric, geared

import aacmm_jax as aj
from aacmm_jax.kinematics.prior_scales import default_prior
from aacmm_jax.uncertainty.volume import sample_lengths

EXAMPLES = Path(__file__).parent.parent / "examples"
VISIT = 5  # poses
NOISY = np.ones(6)
NOISY[2] = 5.0
SCENARIOS: dict[str, dict[str, Any]] = {
    "nothing wrong, 1 length": {"lengths": 1},
    "nothing wrong, 2 lengths": {"lengths": 2},
    "nothing wrong, 4 lengths": {"lengths": 4},
    "seats, 4 visits of 5, marked, 1 length": {"lengths": 1, "shift": 0.02, "visit": 5, "marked": True},
    "seats, 4 visits of 5, marked": {"lengths": 2, "shift": 0.02, "visit": 5, "marked": True},
    "seats, 4 visits of 5": {"lengths": 2, "shift": 0.02, "visit": 5},
    "seats, one visit, 2 lengths": {"lengths": 2, "shift": 0.02, "visit": 20},
    "seats, one visit, 4 lengths": {"lengths": 4, "shift": 0.02, "visit": 20},
    "seats, one visit, 4 lengths, marked": {"lengths": 4, "shift": 0.02, "visit": 20, "marked": True},
    "two eccentric encoders, 10 arcsec": {"lengths": 2, "errors": eccentric(10.0)},
    "bending joints 2 and 3, 10 arcsec": {"lengths": 2, "errors": bending(10.0)},
    "gear ratio 0.01 % off": {"lengths": 2, "errors": geared(1e-4)},
}


def with_visits(capture: aj.Capture, poses: int) -> aj.Capture:
    """The same with its visits marked."""
    visits = {name: np.arange(len(q)) // poses for name, q in capture.sockets.items()}
    return aj.Capture(capture.sockets, capture.lengths, visits=visits)


def simulated(scenario: Mapping[str, Any], number: int) -> dict[str, Any]:
    """Part of the lengths within their intervals, their errors and uncertainties, and what was found how often."""
    made = dict(scenario)
    trials, marked = Trials(PAPER, made.pop("lengths")), made.pop("marked", False)
    found: dict[str, Any] = {}
    for given in (False, True):
        rows, kinds, begun = {"shared": [], "plain": []}, {}, time.process_time()
        for seed in range(number):
            functions: list[Callable] = []
            errors: Errors | None = made.get("errors")

            def kept(rng: np.random.Generator, arm: aj.Arm, q: np.ndarray, errors=errors, functions=functions) -> Any:
                assert errors is not None
                functions.append(errors(rng, arm, q))
                return functions[-1]

            capture = trials.capture(seed, **{**made, **({"errors": kept} if errors else {})})
            capture = with_visits(capture, made["visit"]) if marked else capture
            true = trials.true[seed % len(trials.true)]
            start, end = sample_lengths(true, 40, length=300.0, seed=seed)
            turned = [q + functions[0](q) if functions else q for q in (start, end)]
            lengths = np.linalg.norm(np.subtract(*(np.asarray(true.position(q)) for q in turned)), axis=1)
            noise = PAPER.noise if given else None
            method = ("two-stage", "joint")[seed % 2]
            for name, shared in (("shared", True), ("plain", False)):
                result = aj.calibrate(
                    trials.specification.arm,
                    capture,
                    trials.bounds,
                    method=method,
                    noise=noise,
                    check_identifiability=False,
                    shared_errors=shared,
                )
                uncertainty = aj.uncertainty_of(result)
                u = np.asarray(uncertainty.length(start, end))
                between = np.subtract(*(np.asarray(result.arm.position(q)) for q in (start, end)))
                error = np.linalg.norm(between, axis=1) - lengths
                inside = np.abs(error) <= uncertainty.factor(0.95) * u
                rows[name].append((np.mean(inside), np.mean(error**2), np.mean(u**2)))
                for kind in () if result.shared is None else result.shared.kinds:
                    kinds[kind] = kinds.get(kind, 0) + 1 / number
        for name, each in rows.items():
            inside, error, u = np.mean(each, axis=0)
            found[f"{name}, noise {'given' if given else 'estimated'}"] = {
                "inside": round(float(inside), 3),
                "error_um": round(1e3 * float(np.sqrt(error)), 2),
                "u_um": round(1e3 * float(np.sqrt(u)), 2),
            }
        found[f"found, noise {'given' if given else 'estimated'}"] = {k: round(v, 2) for k, v in kinds.items()}
        found["cpu_s"] = round(found.get("cpu_s", 0) + time.process_time() - begun, 1)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--only", choices=("simulated", "mukca", "ur10"))
    parser.add_argument("--scenario", action="append", default=[], help="Beginning of a scenario's name; repeatable.")
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    found: dict[str, Any] = {}
    for name, scenario in SCENARIOS.items() if given.only in (None, "simulated") else ():
        if given.scenario and not name.startswith(tuple(given.scenario)):
            continue
        found[name] = simulated(scenario, given.trials)
        print(name, *(f"\n  {key}: {value}" for key, value in found[name].items()), flush=True)
    if given.only in (None, "mukca"):
        found["mukca"] = mukca()
    if given.only in (None, "ur10"):
        found["ur10"] = ur10()
    given.results.mkdir(parents=True, exist_ok=True)
    path = given.results / f"shared-errors-{datetime.date.today()}.json"
    path.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

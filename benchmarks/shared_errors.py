"""Whether intervals hold where poses share errors that the model does not have (`diagnostics.shared_errors`).

``python benchmarks/shared_errors.py [--trials N] [--only simulated|mukca|ur10]`` writes
``results/shared-errors-DATE.json``. Simulated: captures of the paper's arm (2 arcsec, 5 um, 80 poses in four sockets),
half of the trials in two stages, half joint; lengths of 300 mm over its volume within their 95 % intervals, with the
noise given and estimated, and with ``shared_errors=False`` ("plain"). MUKCa: `examples/mukca`, one placement left out
in turn. UR10: `examples/ipa_ur10`, 500 poses of series C, tested on A. Ten minutes of CPU time with 100 trials.
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
from aacmm_jax.data.capture import draw_poses
from aacmm_jax.kinematics.arm import correction_names
from aacmm_jax.kinematics.priors import default_prior
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
                    undetermined="ignore",
                    shared_errors=shared,
                )
                uncertainty = aj.uncertainty_of(result)
                u = np.asarray(uncertainty.length(start, end))
                between = np.subtract(*(np.asarray(result.arm.position(q)) for q in (start, end)))
                error = np.linalg.norm(between, axis=1) - lengths
                inside = np.abs(error) <= uncertainty.expanded_length(start, end)
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


def with_model(specification: Any, model: str) -> tuple[aj.Arm, aj.Bounds]:
    """The arm with a model of its joints, and bounds of its Denavit-Hartenberg parameters only."""
    bounds = specification.bounds()
    arm = aj.kinematics.with_corrections(bounds.space.base, model)
    added = tuple(name for name in correction_names(arm) if not name.startswith("gravity_"))
    space, endless = aj.Parameters(arm, (*bounds.space.names, *added)), np.full(len(added), np.inf)
    return arm, aj.Bounds(space, np.r_[bounds.lower, -endless], np.r_[bounds.upper, endless])


def mukca() -> dict[str, Any]:
    """Tips and lengths of placements that were left out, of three sets and of all five."""
    found: dict[str, Any] = {}
    sets = ("capture", "panda_3", "panda_3_bis", "panda_6", "kuka_14")
    for model in ("dh", "gravity,harmonics=1"):
        for shared in (True, False):
            normalised: dict[str, np.ndarray] = {}
            for name in sets:
                begun = time.process_time()
                recording = aj.files.read_manifest(EXAMPLES / "mukca" / f"{name}.toml")
                arm, bounds = with_model(recording.nominal, model)
                crossed = aj.cross_validate(
                    arm, recording.capture, bounds, method="joint", prior=default_prior(arm), shared_errors=shared
                )
                error = np.concatenate([group.length_error for group in crossed.groups])
                u = np.concatenate([group.length_u for group in crossed.groups])
                normalised[name] = np.array([error, u])
                found[f"{model}, {name}, {'shared' if shared else 'plain'}"] = row = {
                    "tips_mm": round(crossed.rms, 4),
                    "tips_predicted_mm": round(crossed.rms_predicted, 4),
                    "lengths_mm": round(crossed.length_rms, 4),
                    "lengths_mean_mm": round(float(np.mean(np.abs(error))), 4),
                    "lengths_predicted_mm": round(crossed.length_u, 4),
                    "inside": f"{int(np.sum(np.abs(error) <= 1.96 * u))} of {len(u)}",
                    "cpu_s": round(time.process_time() - begun, 1),
                }
                print(model, name, "shared" if shared else "plain", row, flush=True)
            for part in (sets[:3], sets):
                error, u = np.concatenate([normalised[name] for name in part], axis=1)
                row = {
                    "found_over_predicted": round(float(np.sqrt(np.mean(error**2) / np.mean(u**2))), 3),
                    "normalised": round(float(np.sqrt(np.mean((error / u) ** 2))), 3),
                    "inside": f"{int(np.sum(np.abs(error) <= 1.96 * u))} of {len(u)}",
                }
                found[f"{model}, {len(part)} sets, {'shared' if shared else 'plain'}"] = row
                print(model, len(part), "sets", "shared" if shared else "plain", row, flush=True)
    return found


def ur10() -> dict[str, Any]:
    """Series A predicted from 500 poses of C."""
    found: dict[str, Any] = {}
    series = [aj.files.read_manifest(EXAMPLES / "ipa_ur10" / f"{name}.toml") for name in ("positions", "series_a")]
    for model in ("dh", "gravity,functions"):
        for seed in range(3):
            begun = time.process_time()
            part = draw_poses(series[0].capture, 500, seed)
            arm, bounds = with_model(series[0].nominal, model)
            for shared in (True, False):
                result = aj.calibrate(
                    arm,
                    part,
                    bounds,
                    method="joint",
                    prior=default_prior(arm),
                    shared_errors=shared,
                    undetermined="ignore",
                )
                unseen = aj.calibration.unseen_errors(aj.uncertainty_of(result), series[1].capture)
                every = unseen.of(unseen.parts)
                row = {
                    "found_mm": round(every.rms, 4),
                    "predicted_mm": round(every.predicted, 4),
                    "ratio": round((every.rms / every.predicted) ** 2, 3),
                    "kinds": {}
                    if result.shared is None
                    else dict(zip(result.shared.kinds, np.round(result.shared.sd, 6).tolist(), strict=True)),
                    "cpu_s": round(time.process_time() - begun, 1),
                }
                found[f"{model}, seed {seed}, {'shared' if shared else 'plain'}"] = row
                print(model, seed, "shared" if shared else "plain", row, flush=True)
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

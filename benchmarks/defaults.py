"""Real captures calibrated by default without one placement, which is then predicted.

``python benchmarks/defaults.py [--set NAME]`` leaves out each placement of the captures of `examples/mukca` in turn,
calibrates the others as `calibrate_capture` does it by default ("default") and with Denavit-Hartenberg parameters alone
("dh"), and writes ``results/defaults-DATE.json``: distances of the poses and errors of the length of the placement,
what was predicted of them, and how often errors contradict their prediction. Six minutes of CPU time.
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
from aacmm_jax.data.capture import part_of
from aacmm_jax.pipeline.cross_validation import groups_of

EXAMPLES = Path(__file__).parent.parent / "examples" / "mukca"
SETS = ("capture", "panda_3", "panda_3_bis", "panda_6", "kuka_14")
WAYS: dict[str, dict[str, Any]] = {"default": {}, "dh": {"automatic": False, "cross_validate": False}}
IMPROBABLE = 0.01


def predicted(recording: aj.Recording, group: tuple[str, ...], options: dict[str, Any]) -> dict[str, Any]:
    """What a calibration without a placement predicts of it, and what is found, mm."""
    begun, names = time.process_time(), tuple(name for name in recording.capture.names if name not in group)
    record = aj.calibrate_capture(recording._replace(capture=part_of(recording.capture, names)), **options)
    errors = aj.calibration.unseen_errors(aj.uncertainty_of(record), part_of(recording.capture, group))
    poses = errors.of(errors.parts)
    return {
        "group": group[0],
        "tips": poses.rms,
        "tips_predicted": poses.predicted,
        "tips_probability": poses.probability,
        "length_error": float(errors.length_error[0]),
        "length_u": float(errors.length_u[0]),
        "length_U": float(errors.expanded()[0]),
        "decisions": record.decisions,
        "cpu_s": time.process_time() - begun,
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of all placements together."""
    error, u, expanded = (np.array([row[key] for row in rows]) for key in ("length_error", "length_u", "length_U"))
    return {
        "placements": len(rows),
        "tips_contradict": sum(row["tips_probability"] < IMPROBABLE for row in rows),
        "tips_rms": float(np.sqrt(np.mean([row["tips"] ** 2 for row in rows]))),
        "lengths_outside_U": int(np.sum(np.abs(error) > expanded)),
        "largest_error_over_U": float(np.max(np.abs(error) / expanded)),
        "found_over_predicted_squared": float(np.mean(error**2) / np.mean(u**2)),
        "normalised_squared": float(np.mean((error / u) ** 2)),
        "median_U": float(np.median(expanded)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--set", action="append", choices=SETS, default=[])
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    rows: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
    for name in given.set or SETS:
        recording = aj.files.read_manifest(EXAMPLES / f"{name}.toml")
        for group in groups_of(recording.capture):
            for way, options in WAYS.items():
                rows[way].append({"set": name} | predicted(recording, group, options))
                print(way, {key: value for key, value in rows[way][-1].items() if key != "decisions"}, flush=True)
    results = {way: {"all": summary(of_way), "placements": of_way} for way, of_way in rows.items()}
    for way, of_way in results.items():
        print(way, of_way["all"])
    given.results.mkdir(parents=True, exist_ok=True)
    path = given.results / f"defaults-{datetime.date.today()}.json"
    path.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Which model of its joints a simulated measuring arm is found to need, and what of it is recovered.

``python benchmarks/model_selection.py [--trials N] [--first SEED] [--fault NAME]`` simulates what a laboratory would
record in a day: 204 poses of the arm of Cheng et al. 2018 (encoders of 2 arcsec, a seat of 5 um) in six sockets, each
visited in four rounds, three reference lengths (u 1 um), and a room between 15 and 25 C. Each fault alone, and all
together: two eccentric encoders (10 arcsec), links that bend under their weight about joints 2 and 3 (10 arcsec), a
gear ratio 1 % off, an arm that expands by 11.5 um/(m K). Written: how often `compare_models` recommends the right
model, normalised errors of the coefficients and coverage of lengths with the right model, and how often plain
Denavit-Hartenberg is warned of; into ``results/model-selection-DATE.json``.
"""

import argparse
import collections
import datetime
import json
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import aacmm_jax as aj
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.arm import correction_names, joint_limits, value_of
from aacmm_jax.kinematics.inverse_kinematics import project_to_targets, random_configurations

SOCKETS = {
    "A": (400, 200, 300),
    "B": (600, 200, 300),
    "C": (300, -400, 200),
    "D": (500, 300, 0),
    "E": (-300, 500, 300),
    "F": (200, -700, 400),
}
LENGTHS = [("A", "B"), ("C", "D"), ("E", "F")]
ROUNDS, POSES, U_LENGTH = 4, 34, 0.001
NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
ARCSEC = aj.units.ARCSEC
RIGHT = {
    "nothing": "dh",
    "eccentric": "harmonics=1",
    "bending": "gravity",
    "gear": "gear",
    "expansion": "expansion",
    "all": "expansion,gear,gravity,harmonics=1",
}
KINDS = ("expansion", "gear", "gravity", "harmonics=1")
MODELS = ("dh", *KINDS, *(",".join(kind for kind in KINDS if kind != out) for out in KINDS[::-1]), ",".join(KINDS))
# Codes of findings that only state how a capture is made.
STATEMENTS = (
    "one-reference-length", "little-redundancy", "hardly-determined", "undetermined",
)  # fmt: skip
NEW, LENGTH = 20, 300.0  # lengths whose coverage is asked, mm


def true_arm(fault: str, random: np.random.Generator) -> aj.Arm:
    """An arm 0.5 mm and 0.05 deg off the nominal one, with what is wrong."""
    plain = aj.load_arm("cheng2018-simulation").replace(thermometer=True)
    space = aj.Parameters.free_of(plain)
    shift = random.uniform(-1, 1, len(space.names)) * np.where(space.lengths, 0.5, np.deg2rad(0.05))
    changes = dict(zip(space.names, np.asarray(space.vector()) + shift, strict=True))
    if fault in ("eccentric", "all"):
        for joint in random.choice(4, 2, replace=False) + 1:
            phase = random.uniform(0, 2 * np.pi)
            changes |= {f"cos1_{joint}": 10 * ARCSEC * np.cos(phase), f"sin1_{joint}": 10 * ARCSEC * np.sin(phase)}
    if fault in ("bending", "all"):
        # The upper arm and the forearm: 10 arcsec for the longest lever, about 0.75 m and 0.6 m.
        changes |= {"compliance3_2": -10 * ARCSEC / 0.75 / 2, "compliance5_2": -10 * ARCSEC / 1.3 / 2}
        changes |= {"compliance5_3": -10 * ARCSEC / 0.6}
    if fault in ("gear", "all"):
        changes |= {f"gear_{random.integers(4) + 1}": 0.01}
    if fault in ("expansion", "all"):
        changes |= {"expansion": 11.5e-6}
    coefficients = [name for name in changes if name not in space.names]
    return (with_corrections(plain, coefficients) if coefficients else plain).replace(**changes)


def day(random: np.random.Generator) -> dict[str, np.ndarray]:
    """Temperatures of each socket's poses: the sockets are visited one after the other, in several rounds."""
    each = np.array_split(np.arange(POSES), ROUNDS)
    start, found = random.uniform(0, 1), {name: np.zeros(POSES) for name in SOCKETS}
    for round_number, poses in enumerate(each):
        for place, name in enumerate(SOCKETS):
            time_of_day = (round_number + (place + np.linspace(0, 1, len(poses))) / len(SOCKETS)) / ROUNDS
            found[name][poses] = 20 + 5 * np.sin(2 * np.pi * (time_of_day + start))
    return found


def record(arm: aj.Arm, seed: int) -> aj.Capture:
    """A day's capture, with noise."""
    random = np.random.default_rng([seed, 1])
    q, points = {}, {name: np.array(point, dtype=float) for name, point in SOCKETS.items()}
    limits = np.asarray(joint_limits(arm, None))
    temperatures = day(random)
    growth = float(value_of(arm, "expansion")) if "expansion" in correction_names(arm) else 0.0
    for number, (name, point) in enumerate(points.items()):
        target = point + random.normal(0, float(NOISE.seating), (POSES, 3))
        scale = 1 + growth * (temperatures[name] - 20)
        key = jax.random.fold_in(jax.random.key(seed), number)
        angles = np.asarray(random_configurations(arm, target / scale[:, None], key, limits))
        angles = angles + 2 * ARCSEC * random.normal(size=angles.shape)
        q[name] = np.column_stack([angles, temperatures[name]])
    lengths = []
    for one, other in LENGTHS:
        value = np.linalg.norm(points[one] - points[other]) + random.normal(0, U_LENGTH)
        lengths.append(aj.ReferenceLength(one, other, value, U_LENGTH))
    return aj.Capture(q, lengths)


def of_lengths(result: aj.Calibration, true: aj.Arm, random: np.random.Generator) -> np.ndarray:
    """Errors of new lengths, over their standard uncertainties."""
    limits = np.asarray(joint_limits(true, None))
    start = random.uniform(limits[:, 0], limits[:, 1], (NEW, true.joints))
    away = random.normal(size=(NEW, 3))
    target = np.asarray(true.position(start)) + LENGTH * away / np.linalg.norm(away, axis=1, keepdims=True)
    end, reached = project_to_targets(true, start, target)
    pairs = [np.column_stack([q, np.full(NEW, random.uniform(15, 25))])[reached] for q in (start, end)]
    found, truth = (
        np.linalg.norm(np.asarray(arm.position(pairs[1])) - np.asarray(arm.position(pairs[0])), axis=1)
        for arm in (result.arm, true)
    )
    return (found - truth) / np.asarray(aj.uncertainty_of(result).length(*pairs))


def trial(fault: str, seed: int) -> dict[str, Any]:
    """What one capture leads to."""
    number = list(RIGHT).index(fault)
    true = true_arm(fault, np.random.default_rng([seed, number]))
    capture, plain = record(true, 1000 * number + seed), aj.load_arm("cheng2018-simulation").replace(thermometer=True)
    bounds, begun = aj.Bounds.around(plain, aj.Parameters.free_of(plain)), time.process_time()
    compared = aj.compare_models(plain, capture, bounds, models=MODELS)
    spent = time.process_time() - begun
    right = compared.models[MODELS.index(RIGHT[fault])].result
    u = np.sqrt(np.diag(np.asarray(right.covariance)))
    wrong = [name for name in correction_names(true) if not name.startswith("gravity_")]
    # Bending about joint 2 is a harmonic of its reading too: what the model leaves out is in another coefficient.
    elsewhere = {name.rpartition("_")[2] for name in wrong if name not in right.space.names}
    errors = [
        (float(value_of(right.arm, name)) - float(value_of(true, name))) / u[right.space.index(name)]
        for name in wrong
        if name.rpartition("_")[2] not in elsewhere
    ]
    alone = aj.calibrate(plain, capture, bounds, undetermined="ignore")
    findings = [one for one in aj.diagnostics.findings_of(alone, capture) if one.code not in STATEMENTS]
    said = [finding.sentence for finding in findings]
    return {
        "recommended": compared.recommended.model,
        "largest_evidence": max(compared.models, key=lambda model: model.log_evidence).model,
        "smallest_outside": compared.models[compared.best].model,
        "coefficients": errors,
        "lengths": of_lengths(right, true, np.random.default_rng([seed, number, 2])).tolist(),
        "warned": bool(said),
        "warnings": [text[:60] for text in said],
        "cpu_s": spent,
    }


def summarised(fault: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rates over the trials of one fault."""
    coefficients = np.array([error for row in rows for error in row["coefficients"]])
    lengths = np.abs([error for row in rows for error in row["lengths"]])
    share = lambda truth: round(float(np.mean(truth)), 4)  # noqa: E731
    found: dict[str, Any] = {
        "trials": len(rows),
        "right": share([row["recommended"] == RIGHT[fault] for row in rows]),
        "right by evidence alone": share([row["largest_evidence"] == RIGHT[fault] for row in rows]),
        "right by regions alone": share([row["smallest_outside"] == RIGHT[fault] for row in rows]),
        "others": dict(collections.Counter(row["recommended"] for row in rows if row["recommended"] != RIGHT[fault])),
        "lengths within U95": share(lengths <= 1.96),
        "D-H warned": share([row["warned"] for row in rows]),
        "cpu_s": round(float(np.mean([row["cpu_s"] for row in rows])), 1),
    }
    if len(coefficients):
        found["coefficients, rms of error/u"] = round(float(np.sqrt(np.mean(coefficients**2))), 3)
        found["coefficients within 2 u"] = share(np.abs(coefficients) <= 2)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--fault", choices=tuple(RIGHT))
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    found = {}
    for fault in RIGHT if given.fault is None else (given.fault,):
        rows = []
        for seed in range(given.first, given.first + given.trials):
            rows.append(trial(fault, seed))
            print(fault, seed, json.dumps(rows[-1]), flush=True)
        found[fault] = summarised(fault, rows)
        print(fault, json.dumps(found[fault]), flush=True)
    given.results.mkdir(parents=True, exist_ok=True)
    name = "-".join(["model-selection", str(datetime.date.today()), *([given.fault] if given.fault else [])])
    (given.results / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

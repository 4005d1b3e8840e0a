"""Arms with prismatic joints: how often 95 % intervals of their calibration hold the truth, by simulation.

A SCARA (11 parameters, Hayati's angles among them) and a six-axis arm on a linear axis (23), each off by up to 0.5 mm
and 0.1 deg, are calibrated in every trial from four sockets and one reference length, jointly, with the noise given and
with it estimated. Prints a row for each and writes benchmarks/results/prismatic.json.

    python benchmarks/prismatic.py [--trials 2000]
"""

import argparse
import json
import math
import sys
import time
from pathlib import Path

import numpy as np

import aacmm_jax as aj
from aacmm_jax.kinematics.parameters import ArmSpecification

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.prismatic_arms import LINEAR_AXIS, SCARA

RESULTS = Path(__file__).resolve().parent / "results"
NOISE = aj.Noise(encoder_arcsec=2.0, linear_encoder=0.005, seating=0.005)
CASES = {
    "SCARA": (
        SCARA,
        [[400, 200, 150], [250, -350, 250], [500, -100, 50], [-300, 350, 100]],
        [[300, 300, 100], [300, -200, 200]],
    ),
    "six axes on a linear axis": (
        LINEAR_AXIS,
        [[500, 200, 300], [-300, 500, 800], [400, -300, 600], [-400, -300, 100]],
        [[300, 300, 100], [300, -200, 700]],
    ),
}
POSES, END_POSES = 20, 10


def study_of(name: str, trials: int) -> aj.study.Study:
    """Twenty poses in each of four sockets, ten at each end of a length with u = 2 um."""
    arm, sockets, ends = CASES[name]
    space = aj.Parameters.independent(arm)
    held = tuple(name for name in space.held if not name.startswith("beta_"))
    free = tuple(name for name in space.names if name.startswith("beta_"))
    return aj.study.make_study(
        arm=ArmSpecification(arm, name, held=held, free=free),
        trials=trials,
        seed=1,
        deviation={"length_mm": 0.5, "angle_deg": 0.1},
        capture={"positions_mm": [sockets], "poses": POSES, "pool": 4096},
        noise={"encoder_arcsec": 2, "linear_encoder_mm": 0.005, "seating_mm": 0.005},
        reference={"ends_mm": [[ends]], "poses": END_POSES, "u_mm": 0.002},
    )


def captures_of(study: aj.study.Study, drawn: aj.study.DrawnTrials) -> aj.Capture:
    """Every trial's capture, in one batch."""
    sizes = (*[POSES] * 4, END_POSES, END_POSES)
    ends = np.cumsum(sizes)
    names = ("A", "B", "C", "D", "E", "F")
    return aj.stack_captures([
        aj.Capture(
            {name: q[end - size : end] for name, size, end in zip(names, sizes, ends, strict=True)},
            aj.ReferenceLength("E", "F", float(value[0]), 0.002),
        )
        for q, value in zip(drawn.q, drawn.value, strict=True)
    ])  # fmt: skip


def coverage(name: str, trials: int, noise: aj.Noise | None) -> dict:
    """Shares of trials, in per cent, in which the 95 % interval holds the truth: of parameters, and of lengths in the
    volume."""
    begun = time.perf_counter()
    study = study_of(name, trials)
    drawn, space = aj.study.draw_trials(study, 0, np.arange(trials))[0], study.space
    bounds = aj.Bounds(space, drawn.lower[0], drawn.upper[0])
    many = aj.calibrate_many(space.base, captures_of(study, drawn), bounds, noise=noise, covariance=True)
    errors, covariance = np.asarray(many.parameters) - drawn.true, np.asarray(many.covariance)
    u = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    start, end = aj.uncertainty.sample_lengths(study.nominal.arm, 40, length=200.0, seed=5)
    moved = [np.asarray(space.base.jacobian(q, space.names)) for q in (start, end)]
    between = np.asarray(study.nominal.arm.position(end)) - np.asarray(study.nominal.arm.position(start))
    direction = between / np.linalg.norm(between, axis=1, keepdims=True)
    slopes = np.einsum("lc,lcp->lp", direction, moved[1] - moved[0])
    inside = np.abs(errors) <= 1.96 * u
    of_lengths = np.abs(errors @ slopes.T) <= 1.96 * np.sqrt(np.einsum("lp,tpq,lq->tl", slopes, covariance, slopes))
    by_parameter, by_length = (100 * part.mean(axis=0) for part in (inside, of_lengths))
    return {
        "arm": name,
        "noise": "estimated" if noise is None else "given",
        "trials": trials,
        "parameters": len(space.names),
        "converged": float(np.mean(many.converged)),
        "on a bound": float(np.mean(np.any(many.active != 0, axis=1))),
        "coverage of parameters": [
            round(float(x), 2) for x in (by_parameter.min(), by_parameter.mean(), by_parameter.max())
        ],
        "least": space.names[int(np.argmin(by_parameter))],
        "coverage of lengths": [round(float(x), 2) for x in (by_length.min(), by_length.mean(), by_length.max())],
        "standard error": round(100 * math.sqrt(0.95 * 0.05 / trials), 2),
        "seconds": round(time.perf_counter() - begun, 1),
    }


def main() -> None:
    """Run all cases."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=2000)
    trials = parser.parse_args().trials
    rows = []
    for name in CASES:
        for noise in (NOISE, None):
            rows.append(coverage(name, trials, noise))
            print(rows[-1], flush=True)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "prismatic.json").write_text(json.dumps({"trials": trials, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()

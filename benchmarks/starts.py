"""How often the unknown geometry of a tracker's points is found from any frame and offset.

``python benchmarks/starts.py [--trials N] [--calibrate N]`` draws frames of the instrument (any rotation, origin up to
3 m away), offsets of the target in the last frame (up to 3 m, any direction), 10 to 2,000 points, and arms with 6 and 7
joints whose parameters are about a millimetre and a milliradian off. Found is a geometry of the nominal arm whose
residuals are no larger than with the true geometry, and for the first N trials that are calibrated too, a calibrated
arm whose residuals are no larger than those of the true arm. Prints what was not found; two minutes of CPU time.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.data.observations import MeasuredPoints
from aacmm_jax.kinematics.arm import joint_limits

ARMS = ("ur10e", "irb120", "gen3-lite", "panda", "iiwa14", "gen3")
FARTHEST = 3000.0  # mm
POINTS = 10, 2000
SIZES = {"alpha": 0.001, "theta": 0.001, "a": 1.0, "d": 1.0}  # standard deviations of the parameters, mm and rad
NOISE, ENCODER = 0.02, 5e-5  # standard deviations of a coordinate, mm, and of a reading, rad
ROUNDING = 1 + 1e-9
OPTIONS: dict[str, Any] = {"model": "dh", "cross_validate": False, "shared_errors": False}


class Trial(NamedTuple):
    """A capture, and the RMS residuals (mm) of the nominal and of the true arm with the true frame and offset."""

    words: str
    recording: aj.Recording
    nominal: float
    true: float


def drawn(seed: int) -> Trial:
    """One capture at random."""
    random = np.random.default_rng(seed)
    name, count = ARMS[seed % len(ARMS)], int(np.exp(random.uniform(*np.log(POINTS))))
    arm = to_numpy(aj.load_arm(name))
    true = arm.replace(**{kind: getattr(arm, kind) + sd * random.normal(size=arm.joints) for kind, sd in SIZES.items()})
    offset, origin = (random.uniform(0, FARTHEST) * Rotation.random(random_state=random).apply([1, 0, 0]) for _ in "ab")
    frame = Rotation.random(random_state=random)
    limits = np.clip(np.asarray(joint_limits(arm, None)), -np.pi, np.pi)
    q = random.uniform(limits[:, 0], limits[:, 1], (count, arm.joints))

    def seen(of: aj.Arm, q: np.ndarray) -> np.ndarray:
        transforms = np.array(of.replace(probe=offset).pose(q))
        return frame.apply(transforms[:, :3, 3]) + origin

    points = seen(true, q) + NOISE * random.normal(size=(count, 3))
    readings = q + ENCODER * random.normal(size=q.shape)
    capture = aj.Capture({}, [], [MeasuredPoints("tracker", readings, points, u=NOISE, target="reflector")])
    rms = [float(np.sqrt(np.mean(np.sum((points - seen(of, readings)) ** 2, axis=1)))) for of in (arm, true)]
    words = f"seed {seed}: {name}, {count} points, offset {np.linalg.norm(offset):.0f} mm"
    return Trial(words, aj.Recording(capture, aj.files.load_specification(name, capture=capture)), *rms)


def geometry_found(trial: Trial) -> bool:
    """Whether an evaluation finds the frame and the offset, with the nominal arm."""
    observed = aj.evaluate(trial.recording.nominal.arm, trial.recording.capture).observed
    assert observed is not None
    return float(observed.rms[0]) <= ROUNDING * trial.nominal


def arm_found(trial: Trial) -> bool:
    """Whether a calibration does, with the arm; by its defaults, but for models of the joints."""
    record = aj.calibrate_capture(trial.recording, **OPTIONS)
    enough = len(trial.recording.capture.readings) >= 20  # with fewer, a prior holds the parameters
    return record.converged and record.observed.rms <= (1.2 if enough else 5.0) * trial.true


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--calibrate", type=int, default=60)
    chosen = parser.parse_args()
    trials = [drawn(seed) for seed in range(chosen.trials)]
    for what, found, part in (
        ("geometry", geometry_found, trials),
        ("calibrated arm", arm_found, trials[: chosen.calibrate]),
    ):
        missed = [trial.words for trial in part if not found(trial)]
        print(f"{what}: found {len(part) - len(missed)} of {len(part)}", *missed, sep="\n  ", flush=True)


if __name__ == "__main__":
    main()

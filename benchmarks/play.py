"""How often backlash is found, how well, and how often it is suspected of a joint that has none.

``python benchmarks/play.py [--trials N] [--first SEED]`` simulates a UR10e with encoders of 0.02 deg that was moved to
each of 80 poses in four sockets from recorded sides, with two lengths: with play of 0.2 deg in two joints, and without.
Written, one line a trial and a table at the end: whether a calibration by Denavit-Hartenberg parameters alone names
backlash, and whether the play found agrees within 2 u; of sound arms, how often backlash is named.
"""

import argparse
import json
import warnings

import numpy as np

import aacmm_jax as aj
from aacmm_jax.diagnostics.findings import findings_of, sentences
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.arm import value_of
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.pipeline.capture_calibration import calibrate_capture

SOCKETS = {"A": (400, 200, 300), "B": (700, -200, 200), "C": (300, -500, 500), "D": (-400, 400, 300)}
LENGTHS = [("A", "B", 0.01), ("C", "D", 0.01)]
NOISE = aj.Noise(encoder_arcsec=72, seating=0.01)
PLAY = np.radians(0.2)


def recorded(nominal: aj.Arm, joints: tuple[int, ...], seed: int) -> aj.Recording:
    """A capture of an arm near the nominal one, with play in these joints."""
    true = aj.perturbed_arm(aj.Parameters.free_of(nominal), length=0.3, angle=5e-4, seed=seed)
    if joints:
        play = {f"play_{joint}": PLAY for joint in joints}
        true = with_corrections(true, list(play)).replace(**play)
    capture = aj.simulate(true, SOCKETS, poses=20, lengths=LENGTHS, noise=NOISE, seed=seed)
    return aj.Recording(capture, ArmSpecification(nominal))


def names_backlash(recording: aj.Recording) -> bool:
    """Whether a calibration by Denavit-Hartenberg parameters alone says that residuals follow directions."""
    said = " ".join(
        sentences(findings_of(calibrate_capture(recording, model="dh", cross_validate=False, automatic=False)))
    )
    return "the direction of approach" in said


def trial(nominal: aj.Arm, seed: int) -> dict:
    """One arm with play in two joints, and the same one without."""
    random = np.random.default_rng(seed)
    joints = tuple(sorted(random.choice(np.arange(1, 6), 2, replace=False).tolist()))
    recording = recorded(nominal, joints, seed)
    record = calibrate_capture(recording, model="dh,backlash", cross_validate=False, automatic=False)
    found = {}
    for i in range(1, 6):  # play of the last joint turns the tip about itself
        if (name := f"play_{i}") in record.names:
            number = record.names.index(name)
            error = value_of(record.calibrated.arm, name) - PLAY * (i in joints)
            found[name] = float(error / np.sqrt(record.covariance[number, number]))
    return {
        "joints": joints,
        "warned": names_backlash(recording),
        "errors in u": {name: found[name] for name in found if int(name[-1]) in joints},
        "others in u": {name: found[name] for name in found if int(name[-1]) not in joints},
        "false alarm": names_backlash(recorded(nominal, (), seed)),
    }


def main() -> None:
    """Print the trials and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    nominal, rows = aj.load_arm("ur10e").replace(directions=True), []
    for seed in range(given.first, given.first + given.trials):
        rows.append(trial(nominal, seed))
        print(seed, json.dumps(rows[-1]), flush=True)
    within = [abs(error) <= 2 for row in rows for error in row["errors in u"].values()]
    others = [abs(error) <= 2 for row in rows for error in row["others in u"].values()]
    for what, share in (
        ("D-H warned of backlash", np.mean([row["warned"] for row in rows])),
        ("play within 2 u", np.mean(within)),
        ("no play within 2 u of 0", np.mean(others)),
        ("sound arms of which backlash is named", np.mean([row["false alarm"] for row in rows])),
    ):
        print(f"{what:40s} {100 * share:5.1f} %")


if __name__ == "__main__":
    main()

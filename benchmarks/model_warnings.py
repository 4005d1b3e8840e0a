"""How often calibrations are warned of: where nothing is wrong, and where something is (`diagnostics.model_tests`).

``python benchmarks/model_warnings.py [--trials N]`` calibrates simulated captures of the paper's arm (2 arcsec, 5 um)
and of the Panda (20 arcsec, 20 um), with new errors in every trial, and writes ``results/model-warnings-DATE.json``:
the part of the trials in which each warning is given, without those that only state how a capture is made (one length,
too few poses, what poses leave open). Half of the trials give the noise, half solve jointly. Ten minutes of CPU time
with 200 trials.
"""

import argparse
import collections
import datetime
import json
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import aacmm_jax as aj
from aacmm_jax.diagnostics.findings import findings_of
from aacmm_jax.diagnostics.missing_terms import missing_terms

# Codes of the findings that chance or an error can raise.
FINDINGS = {
    "missing term": ("missing-terms",),
    "misfit": ("residuals-not-as-given", "residuals-unusual", "noisy-observations"),
    "noisy joint": ("noisy-encoder", "noisy-encoders-replaced"),
    "successive poses": ("successive-poses",),
    "lengths": ("lengths-disagree",),
    "contradictions": ("contradiction",),
    "pose far away": ("outlying-poses",),
    "on a bound": ("on-bounds", "weak-on-bounds", "many-on-bounds", "scale-stopped-by-bounds"),
    "scale": ("implausible-scale", "scale-far-from-1"),
}
# Those that only state how a capture is made.
STATEMENTS = (
    "one-reference-length", "little-redundancy", "hardly-determined", "undetermined",
    "outside-limits", "errors-of-places",
)  # fmt: skip
POSE_SETS = 8


class Setup(NamedTuple):
    """An arm, where its sockets are, and its noise."""

    arm: str
    sockets: Mapping[str, tuple[float, float, float]]
    poses: int
    noise: aj.Noise


PAPER = Setup(
    "cheng2018-simulation",
    {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300), "D": (500, 300, 100)},
    20,
    aj.Noise(encoder_arcsec=2.0, seating=0.005),
)
PANDA = Setup(
    "panda",
    {"A": (400, -200, 300), "B": (550, 200, 300), "C": (450, 0, 500), "D": (350, 300, 200)},
    20,
    aj.Noise(encoder_arcsec=20.0, seating=0.02),
)
LENGTHS = [("A", "B"), ("C", "D"), ("A", "C"), ("B", "D")]
Errors = Callable[[np.random.Generator, aj.Arm, np.ndarray], np.ndarray]  # what joints do beyond the model, rad


class Trials:
    """Captures of one arm with new errors each; the poses are simulated a few times only."""

    def __init__(self, setup: Setup, lengths: int):
        self.setup, self.specification = setup, aj.files.load_specification(setup.arm)
        self.bounds = self.specification.bounds()
        self.lengths = LENGTHS[:lengths]
        self.true, self.exact = [], []
        for i in range(POSE_SETS):
            self.true.append(aj.perturbed_arm(self.bounds.space, length=0.5, angle=np.deg2rad(0.05), seed=i))
            capture = aj.simulate(self.true[i], setup.sockets, poses=setup.poses, seed=i)
            self.exact.append({name: np.asarray(q) for name, q in capture.sockets.items()})

    def capture(
        self,
        seed: int,
        noise: aj.Noise | None = None,
        errors: Errors | None = None,
        shift: float = 0.0,
        visit: int = 0,
    ) -> aj.Capture:
        """With noise, with what joints do beyond the model, and with seats that shift at each visit (poses), mm."""
        rng, noise = np.random.default_rng(seed), self.setup.noise if noise is None else noise
        true, exact = self.true[seed % POSE_SETS], self.exact[seed % POSE_SETS]
        moved, q = [], np.concatenate(list(exact.values()))
        for readings in exact.values():
            at = rng.normal(0.0, float(noise.seating), (len(readings), 3))
            if visit:
                at = at + np.repeat(rng.normal(0.0, shift, (len(readings) // visit, 3)), visit, axis=0)
            moved.append(at)
        target = np.asarray(true.position(q)) + np.concatenate(moved)
        for _ in range(4):  # one step is not exact where the arm is nearly stretched
            slopes = np.asarray(true.jacobian(q, tuple(f"q_{i + 1}" for i in range(true.joints))))
            missed = target - np.asarray(true.position(q))
            q = q + np.einsum("nab,nb->na", np.linalg.pinv(slopes), missed)
        if errors is not None:
            function = errors(rng, true, q)
            read = q
            for _ in range(20):
                read = q - function(read)
            q = read
        q = q + rng.normal(size=q.shape) * np.broadcast_to(np.asarray(noise.encoder), q.shape[1:])
        places = {name: np.array(place, dtype=float) for name, place in self.setup.sockets.items()}
        lengths = [
            aj.ReferenceLength(one, other, np.linalg.norm(places[one] - places[other]) + rng.normal(0, 0.002), 0.002)
            for one, other in self.lengths
        ]
        parts = np.split(q, np.cumsum([len(readings) for readings in exact.values()])[:-1])
        return aj.Capture(dict(zip(exact, parts, strict=True)), lengths)

    def codes(self, seed: int, capture: aj.Capture, method: str, given: bool) -> list[str]:
        """Codes of the findings of a calibration."""
        result = aj.calibrate(
            self.specification.arm,
            capture,
            self.bounds,
            method=method,
            noise=self.setup.noise if given else None,
            undetermined="ignore",
        )
        record = aj.calibration.record_of(result, aj.Recording(capture, self.specification))
        return [finding.code for finding in findings_of(record) if finding.code not in STATEMENTS]


def kind_of(code: str) -> str:
    """Which warning a finding is."""
    return next((kind for kind, codes in FINDINGS.items() if code in codes), code)


def eccentric(arcsec: float) -> Any:
    """Two encoders of the first four joints, which move the tip most, that are eccentric."""

    def errors(rng: np.random.Generator, arm: aj.Arm, q: np.ndarray) -> Callable:
        joints, phase = rng.choice(4, 2, replace=False), rng.uniform(0, 2 * np.pi, 2)

        def error(q: np.ndarray) -> np.ndarray:
            found = np.zeros_like(q)
            found[:, joints] = arcsec * aj.units.ARCSEC * np.cos(q[:, joints] + phase)
            return found

        return error

    return errors


def geared(relative: float) -> Any:
    """One of the first four joints whose gear ratio is wrong."""

    def errors(rng: np.random.Generator, arm: aj.Arm, q: np.ndarray) -> Callable:
        joint = rng.integers(4)
        return lambda q: relative * q * (np.arange(arm.joints) == joint)

    return errors


def bending(arcsec: float) -> Any:
    """Joints 2 and 3 that bend under masses of the links behind them; by ``arcsec`` at most."""

    def errors(rng: np.random.Generator, arm: aj.Arm, q: np.ndarray) -> Callable:
        masses = {joint: rng.uniform(0.2, 1.0, arm.joints + 1) for joint in (2, 3)}

        def moments(q: np.ndarray) -> dict[int, np.ndarray]:
            terms = [one for one in missing_terms(arm, q) if one.kind == "gravity" and one.joint in masses]
            return {one.joint: one.values @ masses[one.joint][: one.values.shape[1]] for one in terms}

        size = {joint: np.ptp(values) / 2 for joint, values in moments(q).items()}

        def error(q: np.ndarray) -> np.ndarray:
            found = np.zeros_like(q)
            for joint, values in moments(q).items():
                found[:, joint - 1] = arcsec * aj.units.ARCSEC * values / size[joint]
            return found

        return error

    return errors


def faults(setup: Setup) -> dict[str, dict[str, Any]]:
    """What is wrong -> how captures are made."""
    typical = float(np.asarray(setup.noise.encoder_arcsec))
    factors = np.ones(aj.load_arm(setup.arm).joints)
    factors[2] = 5.0
    return {
        f"two eccentric encoders, {5 * typical:g} arcsec": {"errors": eccentric(5 * typical)},
        "gear ratio 1 % off": {"errors": geared(0.01)},
        "gear ratio 0.01 % off": {"errors": geared(1e-4)},
        f"bending joints 2 and 3, {5 * typical:g} arcsec": {"errors": bending(5 * typical)},
        # Of the Panda, 50 um at the tip: too little to be seen in most captures.
        f"bending joints 2 and 3, {1.25 * typical:g} arcsec": {"errors": bending(1.25 * typical)},
        "seats that shift by 20 um, visits of 5": {"shift": 0.02, "visit": 5},
        "encoder 3 five times as noisy": {
            "noise": aj.Noise(encoder_arcsec=typical * factors, seating=float(setup.noise.seating))
        },
    }


def rates(trials: Trials, number: int, **made: Any) -> dict[str, Any]:
    """The part of the trials in which each warning is given: of all, and any by method and by how noise is known."""
    start, counts, of = time.process_time(), collections.Counter(), collections.Counter()
    for seed in range(number):
        method, given = ("two-stage", "joint")[seed % 2], (seed // POSE_SETS) % 2 == 0
        said = {kind_of(text) for text in trials.codes(seed, trials.capture(seed, **made), method, given)}
        subsets = ["any", f"any, {method}", f"any, noise {'given' if given else 'estimated'}"]
        of.update(subsets)
        counts.update([*said, *(subsets if said else [])])
    every = {kind: number for kind in FINDINGS} | {kind: number for kind in counts} | dict(of)
    return {
        "trials": number,
        **{kind: round(counts[kind] / total, 4) for kind, total in every.items() if counts[kind] or kind in of},
        "cpu_s": round(time.process_time() - start, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--only", choices=("right", "wrong"))
    parser.add_argument("--arm", choices=(PAPER.arm, PANDA.arm))
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    found: dict[str, Any] = {}
    for setup in (setup for setup in (PAPER, PANDA) if given.arm in (None, setup.arm)):
        for lengths in (1, 2, 3, 4) if given.only != "wrong" else ():
            name = f"{setup.arm}, {lengths} lengths"
            found[name] = rates(Trials(setup, lengths), given.trials)
            print(name, json.dumps(found[name]), flush=True)
        trials = Trials(setup, 2)
        for fault, made in faults(setup).items() if given.only != "right" else ():
            found[f"{setup.arm}, {fault}"] = rates(trials, given.trials, **made)
            print(setup.arm, fault, json.dumps(found[f"{setup.arm}, {fault}"]), flush=True)
    given.results.mkdir(parents=True, exist_ok=True)
    parts = "-".join(part for part in ("", given.only, given.arm) if part is not None)
    path = given.results / f"model-warnings-{datetime.date.today()}{parts}.json"
    path.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

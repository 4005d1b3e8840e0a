"""Coverage of lengths where shared errors were learned from few placements, against an oracle.

``python benchmarks/degrees_of_freedom.py [--trials N]`` writes ``results/degrees-of-freedom-DATE.json``: the paper's
arm (2 arcsec, 5 um), and a bar of 300 mm that stands in 1 to 8 places, 12 poses at each of its ends, which share an
error of the tip (its standard deviation in each coordinate is that of the scenario; single poses scatter by 10 um).
Half of the trials give the noise, half take two stages. 300 mm lengths over the volume: the part within their 95 %
intervals, and the median of U over that of an oracle, 1.96 times the standard deviation of the errors of the same
length over all trials with the same poses; and the ratio that 95 of 100 captures do not exceed (of each capture, the
median over its lengths). "no effect" has none, to see what is paid where nothing is wrong.

No interval that holds at every size of the effect can be shorter than Student's where the effect is all of the
variance: the ratio is then 1.83, 1.30 and 1.15 for 2, 4 and 7 degrees of freedom.
"""

import argparse
import datetime
import json
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from model_warnings import PAPER, POSE_SETS, Setup, Trials

import aacmm_jax as aj
from aacmm_jax.uncertainty.volume import sample_lengths

POSES, LENGTHS = 12, 24
BAR, U_BAR = 300.0, 0.001  # mm
MIDDLES = (
    *((450, 250, 300), (500, -250, 150), (350, -350, 400), (600, 50, 250)),
    *((300, 400, 150), (450, 0, 500), (250, -450, 250), (550, 200, 450)),
)
DIRECTIONS = ((1, 0, 0), (0, 1, 0), (1, 1, 0), (0, 0, 1), (1, -1, 0), (0, 1, 1), (1, 0, 1), (1, 1, 1))
EFFECTS = {"no effect": 0.0, "5 um": 0.005, "10 um": 0.01, "20 um": 0.02, "40 um": 0.04}
PLACEMENTS = (1, 2, 3, 4, 5, 8)


class Coverage(NamedTuple):
    """Errors and expanded uncertainties of some lengths, a row a trial; mm."""

    errors: np.ndarray
    expanded: np.ndarray
    u: np.ndarray
    sets: np.ndarray  # which poses each trial has

    @property
    def inside(self) -> float:
        """Part of the lengths whose error is within U."""
        return float(np.mean(np.abs(self.errors) <= self.expanded))

    @property
    def over_oracle(self) -> np.ndarray:
        """U over what an oracle states."""
        numbers = np.unique(self.sets)
        of_sets = np.array([np.sqrt(np.mean(self.errors[self.sets == number] ** 2, axis=0)) for number in numbers])
        return self.expanded / (1.959964 * of_sets[np.searchsorted(numbers, self.sets)])

    def row(self) -> dict[str, float]:
        """What is reported."""
        return {
            "inside": round(self.inside, 4),
            "by_1.96_u": round(float(np.mean(np.abs(self.errors) <= 1.959964 * self.u)), 4),
            "median_U_over_oracle": round(float(np.median(self.over_oracle)), 3),
            "95_of_100_captures": round(float(np.quantile(np.median(self.over_oracle, axis=1), 0.95)), 3),
            "error_um": round(1e3 * float(np.sqrt(np.mean(self.errors**2))), 2),
            "median_U_um": round(1e3 * float(np.median(self.expanded)), 2),
            "median_factor": round(float(np.median(self.expanded / self.u)), 3),
        }


def placed(placements: int) -> Trials:
    """Captures of the bar in so many places."""
    ends = {}
    for number in range(placements):
        along = 0.5 * BAR * np.array(DIRECTIONS[number]) / np.linalg.norm(DIRECTIONS[number])
        for end, sign in enumerate((-1, 1)):
            ends[f"{number}/{end}"] = tuple(np.array(MIDDLES[number]) + sign * along)
    trials = Trials(Setup(PAPER.arm, ends, POSES, PAPER.noise), 0)
    trials.lengths = [(f"{number}/0", f"{number}/1") for number in range(placements)]
    return trials


def covered(trials: Trials, effect: float, seeds: range) -> Coverage:
    """Of some trials with an error of the tip that the poses of a socket share, mm."""
    ends = [sample_lengths(true, LENGTHS, length=BAR, seed=i) for i, true in enumerate(trials.true)]
    exact = [
        np.linalg.norm(np.subtract(*(np.asarray(true.position(q)) for q in pair)), axis=1)
        for true, pair in zip(trials.true, ends, strict=True)
    ]
    rows = []
    for seed in seeds:
        capture = trials.capture(seed, shift=effect, visit=POSES)
        number = seed % POSE_SETS
        method, given = ("two-stage", "joint")[seed // POSE_SETS % 2], seed // POSE_SETS % 4 > 1
        noise = trials.setup.noise if given else None
        result = aj.calibrate(
            trials.specification.arm, capture, trials.bounds, method=method, noise=noise, undetermined="ignore"
        )
        uncertainty, (start, end) = aj.uncertainty_of(result), ends[number]
        between = np.subtract(*(np.asarray(result.arm.position(q)) for q in (start, end)))
        error = np.linalg.norm(between, axis=1) - exact[number]
        rows.append((error, uncertainty.expanded_length(start, end), np.asarray(uncertainty.length(start, end))))
    return Coverage(*np.moveaxis(np.array(rows), 1, 0), np.array(seeds) % POSE_SETS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--effect", action="append", choices=tuple(EFFECTS), default=[])
    parser.add_argument("--placements", action="append", type=int, choices=PLACEMENTS, default=[])
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    found: dict[str, Any] = {"trials": given.trials}
    for placements in given.placements or PLACEMENTS:
        trials = placed(placements)
        for name in given.effect or EFFECTS:
            begun = time.process_time()
            row = covered(trials, EFFECTS[name], range(given.trials)).row()
            found[f"{placements} placements, {name}"] = row | {"cpu_s": round(time.process_time() - begun, 1)}
            print(placements, "placements,", name, row, flush=True)
    given.results.mkdir(parents=True, exist_ok=True)
    path = given.results / f"degrees-of-freedom-{datetime.date.today()}.json"
    path.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

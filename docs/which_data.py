"""Predicts what each kind of data determines of an arm: python docs/which_data.py (which_data.json and the table).

For each arm and kind of data, a capture at random poses is simulated with the arm's noise, and calibrated with that
noise given. What is kept is the uncertainty that the calibration states (JCGM 100), not its errors. Numbers are medians
over the seeds. The page which_data.md includes the table; tests/docs/test_which_data.py recomputes a part of it.
"""

import json
import math
import textwrap
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.data.noise import SEATING, class_noise
from aacmm_jax.uncertainty.target_parameters import determined_parameters
from aacmm_jax.uncertainty.volume import default_length

DOCS = Path(__file__).resolve().parent
RESULTS, TABLE = DOCS / "which_data.json", DOCS / "which_data_table.txt"
COUNTS, SEEDS = (30, 60, 120), (1, 2, 3)
VOLUME = 200  # lengths all over it
TARGET = (0.03, -0.02, 0.05)  # in sizes: a tracker's target in the last frame
STATION = (0.0, 0.0, 2.1, 2.5, -1.5, 0.3)  # rotation vector, rad; origin, sizes
BOX = ((0.3, -0.4, 0.05), (0.65, 0.4, 0.55))  # sizes from the shoulder
kinds = aj.data.observations


class Case(NamedTuple):
    """An arm with the noise and the artefacts that are usual for it; mm."""

    title: str
    arm: aj.Arm
    noise: aj.Noise
    u_artefact: float  # of a length, a diameter, a coordinate
    u_tracker: float  # of a coordinate
    size: float  # of what is placed
    facing: float  # of the arm, from x about the vertical, rad
    prior: aj.Prior | None  # the maker's tolerance, where data alone would leave too much open

    @property
    def unseated(self) -> aj.Noise:
        """Of the readings alone: an instrument's scatter is stated with it."""
        return aj.Noise(encoder_arcsec=np.asarray(self.noise.encoder_arcsec), seating=0.0)

    def at(self, *places: Iterable[float]) -> np.ndarray:
        """Places in sizes from the shoulder, x to where the arm faces, as positions in the base frame, mm."""
        turned = Rotation.from_rotvec([0, 0, self.facing]).apply(np.array(places))
        return np.asarray(aj.kinematics.arm_reach(self.arm).shoulder) + self.size * turned

    def frame(self, turn: Iterable[float], place: Iterable[float]) -> np.ndarray:
        """A frame at a place, turned by a rotation vector (rad) before it is turned to where the arm faces."""
        rotation = Rotation.from_rotvec([0, 0, self.facing]) * Rotation.from_rotvec(np.array(turn))
        return np.concatenate([rotation.as_rotvec(), self.at(place)[0]])

    def box(self) -> np.ndarray:
        """Where a target may go: lowest and highest coordinates, mm."""
        corners = self.at(*BOX)
        return np.stack([corners.min(axis=0), corners.max(axis=0)])


def cases() -> dict[str, Case]:
    """A measuring arm, robots with six and with seven joints, and a hobby arm."""
    by_name = {}
    for key, name, title, of_class, u_artefact, u_tracker, part, facing in (
        ("measuring", "cheng2018-simulation", "Measuring arm", "measuring arm", 0.002, 0.015, 1.0, 0.0),
        ("robot", "ur5e", "Robot", "robot", 0.01, 0.03, 1.0, 0.0),
        ("robot7", "panda", "Robot with seven joints", "robot", 0.01, 0.03, 1.0, 0.0),
        ("hobby", "so100", "Hobby arm", "hobby arm", 0.05, 0.1, 0.8, -np.pi / 2),
    ):
        arm = aj.load_arm(name)
        noise = aj.Noise(encoder_arcsec=np.asarray(class_noise(arm, of_class).encoder_arcsec), seating=SEATING)
        prior = aj.Prior({"lengths": 1.0, "angles": np.radians(1.0)}) if key == "hobby" else None
        size = part * float(aj.kinematics.arm_reach(arm).radius)
        by_name[key] = Case(title, arm, noise, u_artefact, u_tracker, size, facing, prior)
    return by_name


def _sockets(case: Case, number: int, poses: int, seed: int, lengths: bool) -> aj.Capture:
    places = case.at((0.35, -0.2, 0.1), (0.6, 0.15, 0.3), (0.2, 0.5, 0.3), (0.5, -0.4, 0.0))
    sockets = dict(zip("ABCD", places[:number], strict=False))
    ends = [(*pair, case.u_artefact) for pair in ("AB", "CD")[: number // 2]] if lengths else []
    return aj.simulate(case.arm, sockets, poses=poses // number, lengths=ends, noise=case.noise, seed=seed)


def _observed(case: Case, seed: int, *observations: Any, seated: bool = True) -> aj.Capture:
    noise = case.noise if seated else case.unseated
    return aj.simulate(case.arm, {}, observations=observations, noise=noise, seed=seed)


def _bars(case: Case, poses: int, seed: int) -> aj.Capture:
    bar = {"a": (0.0, 0.0, 0.0), "b": (0.3 * case.size, 0.0, 0.0)}
    frames = [((0, 0, 0.4), (0.3, -0.2, 0.1)), ((0, 0, 1.6), (0.45, 0.1, 0.2)), ((0, -1.2, 0.3), (0.4, -0.1, 0.1))]
    return _observed(
        case,
        seed,
        *(
            kinds.SimulatedArtefact(
                f"bar {i}", bar, poses // 6, case.frame(turn, place), u=case.u_artefact, artefact="bar"
            )
            for i, (turn, place) in enumerate(frames)
        ),
    )


def _plate(case: Case, poses: int, seed: int) -> aj.Capture:
    places = [(0, 0, 0), (2, 0, 0), (0, 1.5, 0), (2, 1.5, 0), (1, 0.75, 0), (1.6, 1.1, 0.4)]
    holes = {f"h{i}": tuple((0.15 * case.size * np.array(place)).tolist()) for i, place in enumerate(places)}
    frame = case.frame((0, 0, 0.4), (0.3, -0.25, 0.1))
    plate = kinds.SimulatedArtefact("plate", holes, poses // 6, frame, u=case.u_artefact)
    return _observed(case, seed, plate)


def _spheres(case: Case, poses: int, seed: int) -> aj.Capture:
    centres = case.at((0.4, 0.0, 0.2), (0.55, 0.25, 0.1), (0.35, -0.35, 0.3))
    spheres = (
        kinds.SimulatedSphere(f"S{i}", centre, 50.0, poses // 3, u=case.u_artefact) for i, centre in enumerate(centres)
    )
    return _observed(case, seed, *spheres)


def _planes(case: Case, poses: int, seed: int) -> aj.Capture:
    corner, first, second = case.at((0.3, -0.2, 0.1), (0.65, -0.2, 0.1), (0.3, 0.15, 0.1))
    sides = np.stack([first, second]) - corner
    planes = kinds.SimulatedPlanes("planes", corner, sides, poses // 2, 0.25 * case.size, case.u_artefact)
    return _observed(case, seed, planes)


def _distances(case: Case, poses: int, seed: int) -> aj.Capture:
    box, pivots = case.box(), case.at((0.2, -0.6, -0.1), (0.7, 0.5, 0.0))
    u = case.u_artefact
    distances = (kinds.SimulatedDistances(f"pivot {i}", box, poses // 2, pivot, u) for i, pivot in enumerate(pivots))
    return _observed(case, seed, *distances)


def _station(case: Case) -> np.ndarray:
    return np.array([*STATION[:3], *(case.size * np.array(STATION[3:]))])  # anywhere: it is found


def _points(case: Case, poses: int, seed: int) -> aj.Capture:
    place = tuple((case.size * np.array(TARGET)).tolist())
    points = kinds.SimulatedPoints("tracker", case.box(), poses, _station(case), case.u_tracker, "ball", place)
    return _observed(case, seed, points, seated=False)


def _transforms(case: Case, poses: int, seed: int) -> aj.Capture:
    held = (*(case.size * np.array(TARGET)), 0.1, -0.2, 0.3)
    target = kinds.SimulatedTransforms("6-D", case.box(), poses, held, _station(case), case.u_tracker, 2e-4)
    return _observed(case, seed, target, seated=False)


SIX = "a tracker with a 6-D target"
DATA: dict[str, Callable[[Case, int, int], aj.Capture]] = {
    "one socket, nothing else": lambda case, poses, seed: _sockets(case, 1, poses, seed, lengths=False),
    "two sockets, one certified length": lambda case, poses, seed: _sockets(case, 2, poses, seed, lengths=True),
    "four sockets, two certified lengths": lambda case, poses, seed: _sockets(case, 4, poses, seed, lengths=True),
    "a ball bar in three places": _bars,
    "a plate of six certified holes, in one place": _plate,
    "three spheres of certified diameter, touched": _spheres,
    "two parallel planes at a certified distance, touched": _planes,
    "a telescoping ball bar on two pivots": _distances,
    "a tracker, its target anywhere on the flange": _points,
    SIX: _transforms,
}


def predicted(case: Case, data: str, poses: int, seed: int) -> dict[str, float | int | None]:
    """What one capture determines: numbers of parameters, and U (95 %) of lengths over the volume, mm."""
    capture = DATA[data](case, poses, seed)
    space = determined_parameters(case.arm, capture)
    seen = aj.observability(case.arm, capture, space)
    well = seen.rank - len(seen.trade_offs)
    prediction: dict[str, float | int | None] = {"parameters": well, "median": None, "largest": None}
    if not (capture.lengths or capture.observations):
        return prediction  # whose scale is unknown
    noise = case.noise if all(observation.target == "" for observation in capture.observations) else case.unseated
    options: dict[str, Any] = {"replace_noise": False, "shared_errors": False, "prior": case.prior}
    bounds = aj.Bounds.around(case.arm, space)
    try:
        result = aj.calibrate(case.arm, capture, bounds, method="joint", noise=noise, **options)
    except aj.InputError as error:
        if "equations, but there are" not in str(error):
            raise
        return prediction  # too few poses for so many parameters
    uncertainty = aj.uncertainty_of(result)
    expanded = aj.volumetric_uncertainty(uncertainty, points=VOLUME, seed=0).expanded_length
    return prediction | {"median": float(np.median(expanded)), "largest": float(np.max(expanded))}


def predictions() -> list[dict]:
    """All rows, each with the medians over the seeds."""
    rows = []
    for key, case in cases().items():
        for name in DATA:
            if case.arm.joints < 6 and name == SIX:  # a target cannot be moved to a transform by fewer than six joints
                continue
            row: dict[str, Any] = {"arm": key, "data": name, "parameters": 0, "median": {}, "largest": {}}
            for poses in COUNTS:
                by_seed = [predicted(case, name, poses, seed) for seed in SEEDS]
                row["parameters"] = max(row["parameters"], *(prediction["parameters"] for prediction in by_seed))
                for what in ("median", "largest"):
                    values = [value for prediction in by_seed if (value := prediction[what]) is not None]
                    row[what][str(poses)] = round(float(np.median(values)), 4) if values else None
            rows.append(row)
    return rows


def table(rows: list[dict]) -> str:
    """The rows as Markdown, a table for each arm."""
    parts = ["<!-- Written by docs/which_data.py; do not edit. -->\n"]
    for key, case in cases().items():
        every = len(aj.Parameters.independent(case.arm).names)
        length = default_length(case.arm)
        says = (
            f"{case.arm.joints} joints, {_noise(case)}; artefacts u = {1000 * case.u_artefact:g} um, tracker u = "
            f"{1000 * case.u_tracker:g} um per coordinate{_tolerance(case)}. Sockets and a length determine {every} "
            f"parameters at most. U (95 %) of a length of {length:.0f} mm, mm: median over the volume, largest in "
            "brackets."
        )
        parts.append(f"### {case.title}\n\n{textwrap.fill(says, 120)}\n")
        lines = [f"| what you have | parameters | scale | {' | '.join(f'{poses} poses' for poses in COUNTS)} |"]
        lines.append("|---|---|---|" + "---|" * len(COUNTS))
        for row in (row for row in rows if row["arm"] == key):
            cells = [_cell(row["median"][str(poses)], row["largest"][str(poses)]) for poses in COUNTS]
            scale = "no" if row["median"][str(COUNTS[-1])] is None else "yes"
            lines.append(f"| {row['data']} | {row['parameters']} | {scale} | {' | '.join(cells)} |")
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _tolerance(case: Case) -> str:
    return "" if case.prior is None else ", and the maker's tolerance as a prior, 1 mm and 1 deg"


def _noise(case: Case) -> str:
    arcsec = np.unique(np.asarray(case.noise.encoder_arcsec).round(1))
    return (
        f"encoders {', '.join(f'{value:g}' for value in arcsec)} arcsec, seat {1000 * float(case.noise.seating):g} um"
    )


def _cell(median: float | None, largest: float | None) -> str:
    if median is None or largest is None:
        return "-"
    return "not determined" if not median < 10 else f"{_two(median)}\N{NO-BREAK SPACE}({_two(largest)})"


def _two(value: float) -> str:
    digits = max(0, 1 - math.floor(math.log10(value)))
    return f"{value:.{digits}f}"


def main() -> None:
    """Compute, store, and write the table."""
    warnings.simplefilter("ignore", aj.IdentifiabilityWarning)  # what is left open shows in the table
    rows = predictions()
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    TABLE.write_text(table(rows), encoding="utf-8")


if __name__ == "__main__":
    main()

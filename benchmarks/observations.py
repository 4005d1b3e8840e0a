"""Calibrations from observations of all kinds: coverage of 95 % intervals by kind and pair, platforms, throughput.

``python benchmarks/observations.py coverage [KIND ...] [--pairs] [--trials 2000]`` (with two kinds, that pair),
``python benchmarks/observations.py platform`` (one ball bar on an indexed platform against one alone) and
``python benchmarks/observations.py throughput [--rounds 5]`` print a line for each measurement and write
``results/observations-DATE-PART.json``.
"""

import argparse
import datetime
import itertools
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import equinox as eqx
import numpy as np
from contenders import build_ceres
from scipy.optimize import least_squares

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.core.rotations import rotation_matrix, rotation_vector
from aacmm_jax.data import observations as kinds

NOISE = aj.Noise(encoder_arcsec=2, seating=0.005)
BOX = [[200, -300, 100], [600, 300, 500]]
FRAME = (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
BAR = {"a": (0, 0, 0), "b": (300, 0, 0)}
PLATE = {f"{i}{j}": (150.0 * i, 150.0 * j, 0.0) for i in range(3) for j in range(3)}
PLACEMENTS = [(0, 0, 0, 300, 0, 200), (0, 0, 1.5, 300, -200, 250), (0, 1.5, 0, 400, 100, 500)]
CENTRES = [(300, 0, 300), (500, 200, 200), (300, -300, 150)]
SOCKETS = [(400, 100, 300), (300, -250, 200), (500, 150, 450)]
SIMULATED: dict[str, list[Any]] = {
    "sockets": [kinds.SimulatedSocket(f"socket{i}", point, 20) for i, point in enumerate(SOCKETS)],
    "points": [kinds.SimulatedPoints("T", BOX, 60, FRAME, u=0.01)],
    "transforms": [kinds.SimulatedTransforms("T6", BOX, 60, (10, 20, 80, 0.1, 0.2, 0.3), FRAME, u=0.01, u_angle=1e-4)],
    "spheres": [kinds.SimulatedSphere(f"s{i}", centre, 50.0, 25, u=0.001) for i, centre in enumerate(CENTRES)],
    "cylinders": [
        kinds.SimulatedCylinder("ring", [(300, 0, 300), (330, 40, 330)], 80.0, 30, u=0.001, stylus=6.0, inside=True),
        kinds.SimulatedCylinder("pin", [(500, 200, 150), (500, 200, 250)], 40.0, 30, u=0.001, stylus=6.0),
        kinds.SimulatedCylinder("bar", [(250, -300, 200), (400, -300, 220)], 50.0, 30, certified=False),
    ],
    "planes": [
        kinds.SimulatedPlanes("pair", (200, -200, 100), [(300, 0, 0), (0, 400, 0)], 30, distance=150.0, u=0.001),
        kinds.SimulatedPlanes("wall", (300, -200, 100), [(0, 300, 0), (0, 0, 400)], 30),
    ],
    "bars": [
        kinds.SimulatedArtefact(f"bar{i}", BAR, 10, frame, u=0.001, artefact="bar")
        for i, frame in enumerate(PLACEMENTS)
    ],
    "plate": [kinds.SimulatedArtefact("plate", PLATE, 8, (0, 0, 0.3, 250, -150, 200), u=0.001)],
    "distances": [
        kinds.SimulatedDistances("d", BOX, 60, (900, 300, 100), u=0.003),
        kinds.SimulatedDistances("e", BOX, 60, (100, 700, 100), u=0.003),
    ],
}
ALONE = tuple(name for name in SIMULATED if name != "sockets")  # which see no scale
PAIRED = tuple(name for name in SIMULATED if name != "plate")  # whose kind is that of the bars
# A target in an unknown place of the last frame, with unknown orientation, leaves these of the last link open.
OPEN_WITH_A_TARGET = ("probe_z", "alpha_6", "theta_6", "a_6", "d_6")


class Trials:
    """Captures of one true arm, 1 mm and 0.1 degrees from the nominal one, that differ in their errors only."""

    def __init__(self, chosen: tuple[str, ...]):
        self.nominal = aj.load_arm("cheng2018-simulation")
        space = aj.Parameters.independent(self.nominal)
        if chosen == ("transforms",):
            names = tuple(name for name in space.names if name not in OPEN_WITH_A_TARGET)
            space = aj.Parameters(space.base, names)
        self.space, self.bounds = space, aj.Bounds.around(self.nominal, space)
        self.true = aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=1)
        # Of a pair each kind has half of its poses, so that a pair has about as many as a kind alone.
        self.simulated = [one.changed(poses=-(-one.poses // len(chosen))) for kind in chosen for one in SIMULATED[kind]]
        exact = aj.simulate(self.true, {}, observations=self.simulated, noise=aj.Noise(), seed=3)
        self.exact = []
        for one, observation in zip(self.simulated, exact.observations, strict=True):
            arm = self.true if one.offset is None else self.true.replace(probe=one.offset)
            q = np.asarray(observation.q)
            inverse = np.linalg.pinv(np.asarray(arm.jacobian(q, tuple(f"q_{i + 1}" for i in range(q.shape[1])))))
            self.exact.append((q, np.asarray(arm.pose(q)), inverse))

    def captures(self, count: int, seed: int) -> aj.Capture:
        """A batch of captures, each with errors of its own in readings, seat and everything measured."""
        random = np.random.default_rng(seed)
        found = []
        for _ in range(count):
            errors: dict[str, np.ndarray] = {}  # of certified coordinates, which all placements of an artefact share
            recorded = []
            for one, (q, transforms, inverse) in zip(self.simulated, self.exact, strict=True):
                seat = float(NOISE.seating) * random.normal(size=(len(q), 3))
                # The seat moves the tip by a few micrometres, which the readings follow to first order.
                read = q + np.einsum("mnc,mc->mn", inverse, seat) + float(NOISE.encoder) * random.normal(size=q.shape)
                if isinstance(one, kinds.SimulatedArtefact):
                    drawn = one.u * random.normal(size=(len(one.points), 3))
                    shared = errors.setdefault(one.artefact or one.name, drawn)
                    one = eqx.tree_at(lambda s: s.errors, one, shared, is_leaf=lambda leaf: leaf is None)
                recorded.append(one.recorded(read, transforms, random))
            found.append(aj.Capture({}, [], recorded))
        return aj.stack_captures(found)


def coverage_of(chosen: tuple[str, ...], trials: int, noise: aj.Noise | None) -> dict[str, Any]:
    """How often 95 % intervals hold the true parameters, and the true value of 80 lengths over the volume."""
    task, begun = Trials(chosen), time.process_time()
    captures = task.captures(trials, 1)
    drawn = time.process_time() - begun
    many = aj.calibrate_many(task.nominal, captures, task.bounds, noise=noise, covariance=True)
    space, good = task.space, many.converged
    errors = many.parameters - np.asarray(space.vector(task.true))
    pairs = [
        aj.uncertainty.sample_lengths(task.nominal, 60, length=300.0, seed=5),
        aj.uncertainty.sample_lengths(task.nominal, 20, length=None, seed=6),
    ]
    start, end = (np.concatenate(column) for column in zip(*pairs, strict=True))

    def measured(arm: aj.Arm) -> np.ndarray:
        return np.linalg.norm(np.asarray(arm.position(end)) - np.asarray(arm.position(start)), axis=-1)

    between = np.asarray(task.true.position(end)) - np.asarray(task.true.position(start))
    direction = between / np.linalg.norm(between, axis=1, keepdims=True)
    change = np.asarray(task.true.jacobian(end, space.names)) - np.asarray(task.true.jacobian(start, space.names))
    slopes = np.einsum("lc,lcp->lp", direction, change)
    length_errors = np.stack([measured(space.arm(row)) for row in many.parameters]) - measured(task.true)
    length_u = np.sqrt(np.einsum("lp,bpq,lq->bl", slopes, many.covariance, slopes))
    inside = np.abs(np.concatenate([errors, length_errors], axis=1)) <= 1.96 * np.concatenate(
        [many.u, length_u], axis=1
    )
    share = 100 * inside[good].mean(axis=0)
    p = len(space.names)
    return {
        "kinds": " + ".join(chosen),
        "noise": "estimated" if noise is None else "given",
        "trials": trials,
        "converged": float(good.mean()),
        "parameters": [round(float(x), 2) for x in (share[:p].min(), share[:p].mean(), share[:p].max())],
        "lengths": [round(float(x), 2) for x in (share[p:].min(), share[p:].mean(), share[p:].max())],
        "least": space.names[int(np.argmin(share[:p]))],
        "standard_error": round(100 * float(np.sqrt(0.95 * 0.05 / trials)), 2),
        "largest_U_mm": round(float(2 * length_u[good].mean(axis=0).max()), 4),
        "reduced_chi": round(float(many.reduced_chi[good].mean()), 4),
        "cpu_s": [round(drawn, 1), round(time.process_time() - begun - drawn, 1)],
    }


def coverage(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Each kind alone, or with ``--pairs`` each pair of them; what is finished is written at once."""
    if given.pairs:
        chosen = list(itertools.combinations(given.kinds or PAIRED, 2))
    else:
        chosen = [(name,) for name in given.kinds or ALONE]
    found = []
    for combination in chosen:
        for noise in (NOISE, None) if given.estimated else (NOISE,):
            found.append(coverage_of(combination, given.trials, noise))
            print(found[-1], flush=True)
            write(given, found, "coverage-of-pairs" if given.pairs else "coverage")
    return found


INDICES = 6
# Places of the bar, of indices, and poses at each of the two balls in each.
PLATFORMS = [(1, 1, 10), (1, 1, 60), (1, INDICES, 10), (3, 1, 20), (3, INDICES, 10)]


def platform(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Largest U of lengths of 300 mm over the volume: one ball bar alone, and with the arm on a platform that turns it
    by sixths of a revolution, whose frames are unknown; the bar in one place, and in three."""
    nominal = aj.load_arm("cheng2018-simulation")
    space = aj.Parameters.independent(nominal)
    bounds = aj.Bounds.around(nominal, space)
    true = aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=1)
    turned = [(0.0, 0.0, i * 2 * np.pi / INDICES, 0.0, 0.0, 0.0) for i in range(INDICES)]
    found = []
    for places, indices, poses in PLATFORMS:
        observations = [
            kinds.SimulatedArtefact(
                f"bar/{place}/{index}", BAR, poses, composed(turned[index], PLACEMENTS[place]), u=0.001,
                artefact="bar", placement=f"place {place}", index=f"index {index}" if indices > 1 else None,
            )
            for place in range(places) for index in range(indices)
        ]  # fmt: skip
        largest, median, determined = [], [], []
        for seed in range(given.rounds):
            capture = aj.simulate(true, {}, observations=observations, noise=NOISE, seed=seed)
            result = aj.calibrate(nominal, capture, bounds, noise=NOISE)
            volume = aj.volumetric_uncertainty(aj.uncertainty_of(result), points=400, length=300.0)
            largest.append(2 * float(volume.u_length.max()))
            median.append(2 * float(np.median(volume.u_length)))
            determined.append(int(np.sum(result.determined)) if result.converged else 0)
        row = {
            "places": places,
            "indices": indices,
            "poses": 2 * places * indices * poses,
            "determined": [min(determined), len(space.names)],
            "largest_U_mm": [round(x, 4) for x in (min(largest), float(np.median(largest)), max(largest))],
            "median_U_mm": round(float(np.median(median)), 4),
        }
        found.append(row)
        print(row, flush=True)
    return found


def composed(outer: tuple[float, ...], inner: tuple[float, ...]) -> np.ndarray:
    """Rotation vector and origin of a frame that is stated in another."""
    rotation = rotation_matrix(np.array(outer[:3]))
    both = rotation @ rotation_matrix(np.array(inner[:3]))
    return np.concatenate([rotation_vector(both), rotation @ np.array(inner[3:]) + np.array(outer[3:])])


class Tracker:
    """Five hundred points of a tracker whose frame is unknown: 21 parameters and 6 numbers, from random starts."""

    def __init__(self, poses: int = 500):
        self.arm = aj.load_arm("cheng2018-simulation")
        self.space = aj.Parameters.free_of(self.arm)
        self.bounds = aj.Bounds.around(self.arm, self.space)
        true = aj.perturbed_arm(self.space, length=1.0, angle=np.deg2rad(0.1), seed=1)
        simulated = kinds.SimulatedPoints("T", BOX, poses, FRAME, u=0.01)
        self.capture = aj.simulate(true, {}, observations=[simulated], noise=NOISE, seed=3)
        observation = self.capture.observations[0]
        self.q, self.points = np.asarray(observation.q), np.asarray(observation.points)

    def starts(self, count: int, seed: int) -> np.ndarray:
        """Half a millimetre and half a milliradian about the nominal arm."""
        random = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, len(self.space.names)))
        return np.asarray(self.space.vector()) + random * np.asarray(self.space.scale)

    def whole(self, starts: np.ndarray) -> np.ndarray:
        """With a start for the frame, which the others need: that of the true frame, a little off."""
        rough = np.array(FRAME) + np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0])
        return np.concatenate([starts, np.tile(rough, (len(starts), 1))], axis=1)


def ours(task: Tracker, starts: np.ndarray) -> tuple[float, np.ndarray]:
    """With weights from the noise, so that each problem is solved twice."""
    begun = time.perf_counter()
    found = aj.calibrate_many(task.arm, task.capture, task.bounds, start=starts, noise=NOISE)
    return time.perf_counter() - begun, found.parameters


def ceres(task: Tracker, starts: np.ndarray) -> tuple[float, np.ndarray]:
    """C++ with automatic differentiation, the frame among the unknowns, all points with one weight; two threads."""
    arm, n = task.arm, task.arm.joints
    offsets = {"alpha": 0, "a": n, "d": 2 * n, "theta": 3 * n, "probe": 4 * n}
    slots = [offsets[kind] + i for kind, i in task.space.indices()]
    base = [np.asarray(getattr(arm, kind)) for kind in offsets]
    whole = task.whole(starts)
    parts = ([n, len(task.q), len(starts), 2], *base, slots, task.q, task.points, whole)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in", Path(folder) / "out"
        np.concatenate([np.ravel(np.asarray(part, dtype=float)) for part in parts]).tofile(source)
        subprocess.run([Path(__file__).parent / "peers/ceres/build/peer_tracker", source, target], check=True)
        out = np.fromfile(target)
    return float(out[0]), out[1:].reshape(whole.shape)[:, : starts.shape[1]]


def scipy_trf(task: Tracker, starts: np.ndarray) -> tuple[float, np.ndarray]:
    """SciPy with finite differences, the same unknowns, one core."""
    space, p = to_numpy(task.space), len(task.space.names)
    scale = np.concatenate([np.asarray(space.scale), np.full(3, 1e-3), np.ones(3)])

    def residual(z: np.ndarray) -> np.ndarray:
        frame = z[p:]
        seen = task.points @ rotation_matrix(frame[:3]).T + frame[3:]
        return (space.arm(z[:p]).position(task.q) - seen).ravel()

    begun = time.perf_counter()
    tolerances = {"xtol": 1e-12, "ftol": 1e-14, "gtol": 1e-14}
    found = [least_squares(residual, z, x_scale=scale, method="trf", **tolerances).x for z in task.whole(starts)]
    return time.perf_counter() - begun, np.array(found)[:, :p]


def throughput(given: argparse.Namespace) -> dict[str, Any]:
    """Problems a second, in turns, the median of the rounds; and how far the solutions are from the first's."""
    task, rates, others = Tracker(), {}, {}
    built = build_ceres() is not None
    entrants = {"aacmm_jax.calibrate_many": (ours, 128), "SciPy TRF, finite differences": (scipy_trf, 2)}
    entrants |= {"Ceres, 2 threads": (ceres, 64)} if built else {}
    for run, count in entrants.values():
        run(task, task.starts(count, 0))  # compile, warm up
    for number in range(1, given.rounds + 1):
        for name, (run, count) in entrants.items():
            seconds, found = run(task, task.starts(count, number))
            rates.setdefault(name, []).append(count / seconds)
            others[name] = found[0]
    first = others["aacmm_jax.calibrate_many"]
    steps = np.asarray(task.space.scale)
    result = {
        name: {
            "per_second": round(float(np.median(values)), 2),
            "range": [round(min(values), 2), round(max(values), 2)],
            "largest_difference_steps": float(np.abs((others[name] - first) / steps).max()),
        }
        for name, values in rates.items()
    }
    print(json.dumps(result, indent=1), flush=True)
    return result


PARTS = {"coverage": coverage, "platform": platform, "throughput": throughput}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=list(PARTS))
    parser.add_argument("kinds", nargs="*", choices=[*SIMULATED, []], default=[], help="of coverage; by default all")
    parser.add_argument("--pairs", action="store_true", help="pairs of kinds instead of each alone")
    parser.add_argument("--estimated", action="store_true", help="also with the noise estimated from the residuals")
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--results", type=Path, default=Path(__file__).parent / "results", help="folder of the JSON file"
    )
    given = parser.parse_args()
    found = PARTS[given.part](given)
    if given.part != "coverage":
        write(given, found, given.part)


def write(given: argparse.Namespace, found: Any, part: str) -> None:
    """Store what was measured; of coverage beside what was measured before on the same day, so that it can be done in
    parts."""
    path = given.results / f"observations-{datetime.date.today()}-{part}.json"
    if part.startswith("coverage") and path.exists():
        new = {(row["kinds"], row["noise"]) for row in found}
        found = [row for row in json.loads(path.read_text()) if (row["kinds"], row["noise"]) not in new] + found
    path.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

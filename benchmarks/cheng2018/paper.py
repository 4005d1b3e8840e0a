"""Cheng et al. 2018 (doi 10.1155/2018/1760190): printed numbers, arms and boxes, and the rows of the reproduction."""

import csv
import inspect
import itertools
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import aacmm_jax as aj

HERE = Path(__file__).resolve().parent
PUBLISHED: dict[str, Any] = tomllib.loads((HERE / "published.toml").read_text())
NAMES: tuple[str, ...] = tuple(PUBLISHED["parameter_order"])
POSES: int = PUBLISHED["simulation"]["poses"]
SOCKET = (400.0, 200.0, 300.0)  # mm; the paper does not print the position of its simulated socket
SETS = 1_000  # independent sets of poses


class Tolerance(NamedTuple):
    """How far numbers of a row may be from the stored ones, besides one unit of the last digit shown; and why."""

    reason: str
    relative: float = 0.0
    absolute: float = 0.0  # mm, rad or 1

    def __str__(self) -> str:
        limits = [f"{self.relative:g} relative"] * (self.relative > 0) + [f"{self.absolute:g}"] * (self.absolute > 0)
        return f"{' or '.join(limits) or 'last digit'}: {self.reason}"


ARITHMETIC = Tolerance("arithmetic of printed numbers")
CONVERGED = Tolerance("minima that the solver reaches to 1e-8, of random numbers from fixed seeds")
ROUNDING = Tolerance(
    "noise-free minima end at DE and errors of 1e-10 to 1e-15, which are rounding errors; the paper's method as stored",
    relative=0.01,
    absolute=1e-8,
)
FITTED = Tolerance("the noise of the twins is a fit by a simplex, which stops within 0.5 %", relative=0.01)
STORED = Tolerance("searches of 300 iterations magnify the last bit of a processor: stored, and a sample is run again")


class Row(NamedTuple):
    """One published number and its recomputed values; each column holds text ready to print."""

    what: str
    printed: str
    recomputed: str = "-"  # from the printed vectors
    method: str = "-"  # the paper's method, rerun
    toolkit: str = "-"
    verdict: str = ""
    tolerance: Tolerance | None = None
    where: str = ""  # line of code that made the row


def row(
    what: str,
    printed: Any,
    *,
    recomputed: Any = "-",
    method: Any = "-",
    toolkit: Any = "-",
    verdict: str,
    tolerance: Tolerance,
) -> Row:
    """A row with the line of code that made it."""
    caller = inspect.stack()[1]
    columns = (value if isinstance(value, str) else f"{value:.6g}" for value in (printed, recomputed, method, toolkit))
    return Row(what, *columns, verdict, tolerance, f"{Path(caller.filename).name}:{caller.lineno}")


def read_table(path: Path) -> list[dict[str, float]]:
    """A table of numbers, from CSV."""
    with path.open(newline="") as file:
        return [{key: float(value) for key, value in line.items()} for line in csv.DictReader(file)]


def write_table(path: Path, table: list[dict]) -> None:
    """As CSV, to six digits: beyond them processors differ."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in line.items()}
            for line in table
        )


def vector(*keys: str) -> np.ndarray:
    """A printed vector, in the paper's order."""
    found: Any = PUBLISHED
    for key in keys:
        found = found[key]
    return np.array(found, dtype=float)


@cache
def simulated_arm() -> aj.Arm:
    """Section 3's arm, as printed."""
    return arm_of(vector("simulation", "nominal"))


def arm_of(values: np.ndarray) -> aj.Arm:
    """The arm with the paper's 21 parameters; the other four fixed as in the paper."""
    fixed = PUBLISHED["fixed"]
    base = aj.Arm(
        alpha=[0.0] * 5 + [fixed["alpha_6"]],
        a=[0.0] * 5 + [fixed["a_6"]],
        d=[fixed["d_1"]] + [0.0] * 5,
        theta=[fixed["theta_1"]] + [0.0] * 5,
        probe=[0.0, 0.0, 0.0],
    )
    return aj.Parameters(base, NAMES).arm(values)


def is_length() -> np.ndarray:
    """Which of the 21 are lengths."""
    return aj.Parameters(simulated_arm(), NAMES).lengths


def scale_to(values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The k for which k times the true lengths come closest; ``(..., 21) -> (...)``."""
    lengths = truth[is_length()]
    return values[..., is_length()] @ lengths / (lengths @ lengths)


def pose_sets(count: int = SETS) -> np.ndarray:
    """The first ``count`` of ``SETS`` independent sets of noise-free poses of the simulated arm, ``(count, 70, 6)``."""
    return _all_sets()[:count]


@cache
def _all_sets() -> np.ndarray:
    return simulated(simulated_arm(), {"A": SOCKET}, POSES * SETS, seed=1)["A"].reshape(SETS, POSES, 6)


def simulated(arm: aj.Arm, sockets: dict[str, tuple[float, ...]], poses: int, seed: int) -> dict[str, np.ndarray]:
    """Noise-free poses in every socket, ``(poses, 6)`` each."""
    targets = np.repeat(np.array(list(sockets.values()), dtype=float), poses, axis=0)
    found = configurations(arm, targets, jax.random.split(jax.random.key(seed), 4)[0])
    return dict(zip(sockets, np.split(found, len(sockets)), strict=True))


def configurations(arm: aj.Arm, targets: np.ndarray, key: jax.Array) -> np.ndarray:
    """A random configuration for each target, ``(m, 3) -> (m, 6)``, exact to 1e-9 mm.

    `aj.simulate` may draw others in another version. These are those that the stored searches were run on: every round
    tries the first targets that are missing from random starts.
    """
    found, missing, size = np.zeros((len(targets), arm.joints)), np.arange(len(targets)), 256
    geometry, limits = jax.tree.map(jnp.asarray, arm.geometry), jnp.array([(-jnp.pi, jnp.pi)] * arm.joints)
    for number in itertools.count():
        tried = np.resize(missing, size)
        uniform = jax.random.uniform(jax.random.fold_in(key, number), (2048,))[: size * arm.joints]
        start = 2 * np.pi * np.asarray(uniform).reshape(size, arm.joints) - np.pi
        tried_now = jnp.asarray(start), jnp.asarray(targets[tried])
        solved, distance = aj.kinematics.solve_to_targets(geometry, *tried_now, limits)
        good = np.flatnonzero(np.asarray(distance) <= 1e-9)[::-1]
        found[tried[good]] = np.asarray(solved)[good]
        missing = np.setdiff1d(missing, tried[good])
        if not len(missing):
            break
    return found


def box(*keys: str) -> tuple[np.ndarray, np.ndarray]:
    """Printed bounds, repaired where print lost an element."""
    return vector(*keys, "lower"), vector(*keys, "upper")


def random_starts(lower: np.ndarray, upper: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Uniform in the box: the paper does not print where its searches began."""
    return lower + (upper - lower) * np.random.default_rng(seed).uniform(size=(count, len(lower)))


def metrics_of(tips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """DE and Deltam (eq. 11-15) of tips ``(..., poses, 3)`` of one socket each, mm."""
    from_centre = np.linalg.norm(tips - tips.mean(axis=-2, keepdims=True), axis=-1)
    return from_centre.mean(axis=-1), np.max(np.ptp(tips, axis=-2), axis=-1) / 2


def tips_of(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Tips of many arms, each on its own readings: ``(b, 21), (b, poses, 6) -> (b, poses, 3)``.

    From the probe back to the base, T = Rz(q + theta) Tz(d) Tx(a) Rx(alpha): written out, as building thousands of arms
    takes longer than their arithmetic.
    """
    base, known = simulated_arm(), dict(zip(NAMES, np.moveaxis(values, -1, 0)[..., None], strict=True))

    def of(kind: str, joint: int) -> np.ndarray | float:
        return known.get(f"{kind}_{joint + 1}", float(getattr(base, kind)[joint]))

    x, y, z = np.zeros(q.shape[:-1]), np.zeros(q.shape[:-1]), known["probe_z"]
    for joint in reversed(range(q.shape[-1])):
        angle, alpha = q[..., joint] + of("theta", joint), of("alpha", joint)
        x, y, z = (
            x + of("a", joint),
            np.cos(alpha) * y - np.sin(alpha) * z,
            np.sin(alpha) * y + np.cos(alpha) * z + of("d", joint),
        )
        x, y = np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y
    return np.stack([x, y, z], axis=-1)


def position_in(value: float, sample: np.ndarray) -> str:
    """Position of a printed number in a sample of reruns: its percentile, and the middle 95 % of the sample."""
    low, middle, high = (number(x) for x in np.percentile(sample, [2.5, 50, 97.5]))
    share = 100 * np.mean(sample <= value)
    inside = "within" if 2.5 <= share <= 97.5 else "outside"
    return f"{inside} the 95 % of {len(sample):,} ({low} to {high}); {share:.0f} % are smaller, median {middle}"


def number(value: float) -> str:
    """Three digits, or three decimals where the value is large and its decimals are what matters."""
    return f"{value:.3f}" if 100 <= abs(value) < 1000 else f"{value:.5f}" if 0.9 < abs(value) < 1.1 else f"{value:.3g}"

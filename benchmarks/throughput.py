"""Identifications a second, every contender on the same problems, tolerance and machine, in one run and in turns.

The problem is the paper's: 70 noise-free poses, 21 parameters, random starts in simulation 1's box, DE <= 1e-9 mm asked of every
problem. Prints a table (median and spread over the rounds) and writes it as JSON into benchmarks/results/. Contenders that
are not installed are named as absent.

    python benchmarks/throughput.py [--rounds 5]
"""

import argparse
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # SciPy's contenders are one core by definition

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from rich.console import Console
from rich.table import Table

import aacmm_jax as aj

HERE = Path(__file__).resolve().parent
LOWER = [*[-1.5883] * 5, -10, 52, -10, 52, -10, -10, 740, -10, 490, 1.5, *[-0.0175] * 5, 92]
UPPER = [*[-1.5533] * 5, 10, 72, 10, 72, 10, 10, 760, 10, 510, 21.5, *[0.0175] * 5, 112]
ASKED_DE = 1e-9


class Task:
    """The problems, in the forms that the contenders take."""

    def __init__(self, poses: int = 70, hold: str | None = None):
        self.arm = aj.load_arm("cheng2018-simulation")
        self.space = aj.Parameters.free_of(self.arm)
        self.capture = aj.simulate(self.arm, {"A": (400, 200, 300)}, poses=poses, seed=5)
        self.q = np.asarray(self.capture.q)
        self.lower, self.upper = np.array(LOWER, dtype=float), np.array(UPPER, dtype=float)
        self.hold = hold

    def starts(self, count: int, seed: int) -> np.ndarray:
        share = np.random.default_rng(seed).uniform(size=(count, len(self.lower)))
        return self.lower + (self.upper - self.lower) * share

    def de(self, vectors: np.ndarray) -> np.ndarray:
        tips = jax.vmap(lambda v: self.space.arm(v).position(self.capture.q))(jnp.asarray(vectors))
        return np.asarray(jnp.mean(jnp.linalg.norm(tips - jnp.mean(tips, axis=1, keepdims=True), axis=-1), axis=1))


def ours(task: Task, starts: np.ndarray) -> tuple[float, np.ndarray]:
    begin = time.perf_counter()
    many = aj.identify_many(task.arm, task.capture, task.lower, task.upper, starts, hold=task.hold)
    return time.perf_counter() - begin, many.parameters


def ceres(binary: Path) -> Callable:
    """C++ with automatic differentiation, bounds, DENSE_NORMAL_CHOLESKY; problems over 2 threads."""

    def run(task: Task, starts: np.ndarray) -> tuple[float, np.ndarray]:
        arm, n = task.arm, task.arm.joints
        offsets = {"alpha": 0, "a": n, "d": 2 * n, "theta": 3 * n, "probe": 4 * n}
        slots = [offsets[kind] + i for kind, i in task.space.entries()]
        base = [np.asarray(getattr(arm, kind)) for kind in offsets]
        held = -1 if task.hold is None else task.space.index(task.hold)
        parts = ([n, len(task.q), len(starts), 2, held], *base, slots, task.q, task.lower, task.upper, starts)
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder) / "in", Path(folder) / "out"
            np.concatenate([np.ravel(np.asarray(part, dtype=float)) for part in parts]).tofile(source)
            subprocess.run([binary, source, target], check=True)
            out = np.fromfile(target)
        return float(out[0]), out[1 : 1 + starts.size].reshape(starts.shape)

    return run


def scipy_trf(analytic: bool) -> Callable:
    """SciPy's bounded trust region, one core, vectorised NumPy residual."""

    def run(task: Task, starts: np.ndarray) -> tuple[float, np.ndarray]:
        from scipy.optimize import least_squares

        scale = np.asarray(task.space.scale)
        residual, jacobian = numpy_functions(task)
        begin = time.perf_counter()
        found = [
            least_squares(
                residual,
                start,
                jac=jacobian if analytic else "2-point",
                bounds=(task.lower, task.upper),
                x_scale=scale,
                xtol=1e-13,
                ftol=1e-15,
                gtol=1e-15,
            ).x
            for start in starts
        ]
        return time.perf_counter() - begin, np.array(found)

    return run


def numpy_functions(task: Task) -> tuple[Callable, Callable]:
    """Residual and Jacobian in NumPy, all poses at once."""
    entries, arm, q = task.space.entries(), task.arm, task.q
    n, poses = arm.joints, len(q)
    base = {kind: np.asarray(getattr(arm, kind)) for kind in ("alpha", "a", "d", "theta", "probe")}

    def walk(vector: np.ndarray):
        values = {kind: array.copy() for kind, array in base.items()}
        for value, (kind, i) in zip(vector, entries, strict=True):
            values[kind][i] = value
        x, y, z = (np.tile(axis, (poses, 1)) for axis in np.eye(3))
        origin, axes = np.zeros((poses, 3)), []
        for i in range(n):
            turn = q[:, i] + values["theta"][i]
            c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
            new_x, turned = c * x + s * y, c * y - s * x
            new_origin = origin + values["d"][i] * z + values["a"][i] * new_x
            ca, sa = np.cos(values["alpha"][i]), np.sin(values["alpha"][i])
            axes.append((z, origin, new_x, new_origin))
            x, y, z, origin = new_x, ca * turned + sa * z, ca * z - sa * turned, new_origin
        return origin + values["probe"][0] * x + values["probe"][1] * y + values["probe"][2] * z, axes, (x, y, z)

    def residual(vector: np.ndarray) -> np.ndarray:
        tip = walk(vector)[0]
        return (tip - tip.mean(axis=0)).ravel()

    def jacobian(vector: np.ndarray) -> np.ndarray:
        tip, axes, frame = walk(vector)
        columns = []
        for kind, i in entries:
            if kind == "probe":
                column = frame[i]
            else:
                z, before, x, after = axes[i]
                column = {"a": x, "d": z}.get(kind)
                if column is None:
                    column = np.cross(x, tip - after) if kind == "alpha" else np.cross(z, tip - before)
            columns.append((column - column.mean(axis=0)).ravel())
        return np.stack(columns, axis=1)

    return residual, jacobian


def stock_optimistix() -> Callable:
    """`optimistix.LevenbergMarquardt` under vmap, as a user would write it: no bounds, QR, JAX's own derivatives."""

    def residual(z, args):
        task_scale, q, space = args
        tips = space.arm(z * task_scale).position(q)
        return tips - jnp.mean(tips, axis=0, keepdims=True)

    @jax.jit
    def solve(starts, args):
        solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
        one = lambda start: optx.least_squares(residual, solver, start, args, max_steps=200, throw=False).value  # noqa: E731
        return jax.vmap(one)(starts)

    def run(task: Task, starts: np.ndarray) -> tuple[float, np.ndarray]:
        scale = task.space.scale
        begin = time.perf_counter()
        found = solve(jnp.asarray(starts) / scale[None], (scale, task.capture.q, task.space))
        found.block_until_ready()
        return time.perf_counter() - begin, np.asarray(found * scale[None])

    return run


def build_ceres() -> Path | None:
    """The Ceres peer, built where cmake and libceres-dev are installed; None where they are not."""
    if shutil.which("cmake") is None:
        return None
    build = HERE / "peers" / "ceres" / "build"
    for command in (["cmake", "-S", build.parent, "-B", build], ["cmake", "--build", build]):
        if subprocess.run(command, capture_output=True).returncode:
            return None
    return build / "peer_ceres"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    binary = build_ceres()
    contenders: dict[str, tuple[Callable | None, int]] = {
        "aacmm_jax.identify_many": (ours, 10_000),
        "Ceres, 2 threads": (None if binary is None else ceres(binary), 500),
        "SciPy TRF, analytic Jacobian, 1 core": (scipy_trf(True), 20),
        "SciPy TRF, finite differences, 1 core": (scipy_trf(False), 10),
        "stock Optimistix LM, vmapped": (stock_optimistix(), 100),
    }
    results = []
    for hold in (None, "d_3"):
        task = Task(hold=hold)
        usable = {name: pair for name, pair in contenders.items() if hold is None or name.startswith(("aacmm", "Ceres"))}
        for run, count in usable.values():
            if run:
                run(task, task.starts(count, 0))  # compile, warm up
        rates: dict[str, list[float]] = {name: [] for name in usable}
        worst: dict[str, float] = dict.fromkeys(usable, 0.0)
        solved: dict[str, list[float]] = {name: [] for name in usable}
        for turn in range(1, rounds + 1):
            for name, (run, count) in usable.items():
                if run is None:
                    continue
                seconds, found = run(task, task.starts(count, turn))
                de = task.de(found)
                rates[name].append(count / seconds)
                worst[name] = max(worst[name], float(de.max()))
                solved[name].append(float(np.mean(de <= ASKED_DE)))
        for name, (run, count) in usable.items():
            row = {"contender": name, "held": hold, "batch": count, "absent": run is None}
            if run is not None:
                row |= {
                    "rate_median": statistics.median(rates[name]),
                    "rate_lowest": min(rates[name]),
                    "rate_highest": max(rates[name]),
                    "worst_de_mm": worst[name],
                    "share_within_de": statistics.mean(solved[name]),
                }
            results.append(row)
    report(results)


def report(results: list[dict]) -> None:
    table = Table(title="Identifications a second (70 poses, 21 parameters, DE <= 1e-9 mm asked)", box=None)
    for heading in ("contender", "held", "median", "lowest", "highest", "ours / it", "solved", "worst DE [mm]"):
        table.add_column(heading, justify="left" if heading == "contender" else "right")
    for row in results:
        if row["absent"]:
            table.add_row(row["contender"], str(row["held"]), "absent")
            continue
        own = next(r for r in results if r["held"] == row["held"] and r["contender"].startswith("aacmm"))
        numbers = [f"{row[key]:,.0f}" for key in ("rate_median", "rate_lowest", "rate_highest")]
        ratio, share = f"{own['rate_median'] / row['rate_median']:.1f}", f"{100 * row['share_within_de']:.1f} %"
        table.add_row(row["contender"], str(row["held"]), *numbers, ratio, share, f"{row['worst_de_mm']:.0e}")
    Console(width=130).print(table)
    folder = HERE / "results"
    folder.mkdir(exist_ok=True)
    versions = {"python": platform.python_version(), "jax": jax.__version__, "numpy": np.__version__}
    content = {"when": datetime.now(UTC).isoformat(timespec="seconds"), "cores": os.cpu_count(), **versions, "results": results}
    path = folder / f"throughput-{content['when'][:10]}.json"
    path.write_text(json.dumps(content, indent=2) + "\n")
    print(f"Written: {path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}", file=sys.stderr)


if __name__ == "__main__":
    main()

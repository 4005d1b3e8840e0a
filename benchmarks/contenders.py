"""Solvers of the paper's problem: this toolkit, Ceres, SciPy, stock Optimistix, pybotics; each takes a `Task`."""

import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import aacmm_jax as aj

HERE = Path(__file__).resolve().parent
LOWER = [*[-1.5883] * 5, -10, 52, -10, 52, -10, -10, 740, -10, 490, 1.5, *[-0.0175] * 5, 92]
UPPER = [*[-1.5533] * 5, 10, 72, 10, 72, 10, 10, 760, 10, 510, 21.5, *[0.0175] * 5, 112]
ASKED_DE = 1e-9


class Task:
    """The problems, in the forms that the contenders need."""

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


Found = tuple[float, np.ndarray]  # seconds of solving, and the parameters of every problem
Contender = Callable[["Task", np.ndarray], Found]


def ours(task: Task, starts: np.ndarray) -> Found:
    begin = time.perf_counter()
    many = aj.identify_many(task.arm, task.capture, task.lower, task.upper, starts, hold=task.hold)
    return time.perf_counter() - begin, many.parameters


def ours_alone(task: Task, starts: np.ndarray) -> Found:
    """One identification at a time, as `identify` does it."""
    bounds = aj.Bounds(task.space, task.lower, task.upper)
    begin = time.perf_counter()
    found = [aj.identify(task.arm, task.capture, bounds, hold=task.hold, start=start).parameters for start in starts]
    return time.perf_counter() - begin, np.array(jax.block_until_ready(found))


def ceres(binary: Path, threads: int = 2) -> Contender:
    """C++ with automatic differentiation, bounds, DENSE_NORMAL_CHOLESKY; problems distributed over threads."""

    def run(task: Task, starts: np.ndarray) -> Found:
        arm, n = task.arm, task.arm.joints
        offsets = {"alpha": 0, "a": n, "d": 2 * n, "theta": 3 * n, "probe": 4 * n}
        slots = [offsets[kind] + i for kind, i in task.space.indices()]
        base = [np.asarray(getattr(arm, kind)) for kind in offsets]
        held = -1 if task.hold is None else task.space.index(task.hold)
        parts = ([n, len(task.q), len(starts), threads, held], *base, slots, task.q, task.lower, task.upper, starts)
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder) / "in", Path(folder) / "out"
            np.concatenate([np.ravel(np.asarray(part, dtype=float)) for part in parts]).tofile(source)
            subprocess.run([binary, source, target], check=True)
            out = np.fromfile(target)
        return float(out[0]), out[1 : 1 + starts.size].reshape(starts.shape)

    return run


def scipy_trf(analytic: bool) -> Contender:
    """SciPy's bounded trust region, one core, vectorised NumPy residual."""

    def run(task: Task, starts: np.ndarray) -> Found:
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
    indices, arm, q = task.space.indices(), task.arm, task.q
    n, poses = arm.joints, len(q)
    base = {kind: np.asarray(getattr(arm, kind)) for kind in ("alpha", "a", "d", "theta", "probe")}

    def forward_pass(vector: np.ndarray):
        values = {kind: array.copy() for kind, array in base.items()}
        for value, (kind, i) in zip(vector, indices, strict=True):
            values[kind][i] = value
        x, y, z = (np.tile(axis, (poses, 1)) for axis in np.eye(3))
        origin, axes = np.zeros((poses, 3)), []
        for i in range(n):
            angle = q[:, i] + values["theta"][i]
            c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
            new_x, rotated_y = c * x + s * y, c * y - s * x
            new_origin = origin + values["d"][i] * z + values["a"][i] * new_x
            ca, sa = np.cos(values["alpha"][i]), np.sin(values["alpha"][i])
            axes.append((z, origin, new_x, new_origin))
            x, y, z, origin = new_x, ca * rotated_y + sa * z, ca * z - sa * rotated_y, new_origin
        return origin + values["probe"][0] * x + values["probe"][1] * y + values["probe"][2] * z, axes, (x, y, z)

    def residual(vector: np.ndarray) -> np.ndarray:
        tip = forward_pass(vector)[0]
        return (tip - tip.mean(axis=0)).ravel()

    def jacobian(vector: np.ndarray) -> np.ndarray:
        tip, axes, frame = forward_pass(vector)
        columns = []
        for kind, i in indices:
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


def stock_optimistix(own_rule: bool) -> Contender:
    """`optimistix.LevenbergMarquardt` under vmap, as a user would write it: no bounds, QR.

    ``own_rule``: with this package's arm and its analytic derivative; else with a chain of 4 x 4 matrices in plain JAX.
    """

    def residual(z, args):
        scale, q, space = args
        arm = space.arm(z * scale)
        tips = arm.position(q) if own_rule else jax.vmap(lambda row: product_of_matrices(arm, row))(q)
        return tips - jnp.mean(tips, axis=0, keepdims=True)

    @jax.jit
    def solve(starts, args):
        solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)

        def one(start):
            return optx.least_squares(residual, solver, start, args, max_steps=200, throw=False).value

        return jax.vmap(one)(starts)

    def run(task: Task, starts: np.ndarray) -> Found:
        scale = task.space.scale
        begin = time.perf_counter()
        found = solve(jnp.asarray(starts) / scale[None], (scale, task.capture.q, task.space))
        found.block_until_ready()
        return time.perf_counter() - begin, np.asarray(found * scale[None])

    return run


def product_of_matrices(arm: aj.Arm, q: jax.Array) -> jax.Array:
    """The tip as in a textbook: the product of one homogeneous matrix a joint."""
    transform = jnp.eye(4)
    for i in range(arm.joints):
        c, s = jnp.cos(q[i] + arm.theta[i]), jnp.sin(q[i] + arm.theta[i])
        ca, sa, a, d = jnp.cos(arm.alpha[i]), jnp.sin(arm.alpha[i]), arm.a[i], arm.d[i]
        rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        transform = transform @ jnp.stack([jnp.stack([jnp.asarray(x, dtype=float) for x in row]) for row in rows])
    return (transform @ jnp.append(arm.probe, 1.0))[:3]


def pybotics(python: Path) -> Contender:
    """pybotics' chain and forward kinematics under SciPy's solver, in its own environment."""

    def run(task: Task, starts: np.ndarray) -> Found:
        kinds, indices = zip(*task.space.indices(), strict=True)
        boxes = {"lower": task.lower, "upper": task.upper, "scale": np.asarray(task.space.scale), "starts": starts}
        solved = run_peer(python, HERE / "peers/pybotics/solve.py", task, kinds=kinds, indices=indices, **boxes)
        return float(solved["seconds"]), solved["found"]

    return run


def run_peer(python: Path, script: Path, task: Task, **more: Any) -> Any:
    """Run a peer's script in its own environment; the arm, the readings and what else is given go in and out as npz."""
    parts = {kind: np.asarray(getattr(task.arm, kind)) for kind in ("alpha", "a", "d", "theta", "probe")}
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(source, q=task.q, **parts, **more)
        subprocess.run([python, script, source, target], check=True)
        return dict(np.load(target))


def peer_python(name: str) -> Path | None:
    """The interpreter of a peer's own environment, made by `make peers`; None where it is not there."""
    python = HERE / "peers" / name / ".venv/bin/python"
    return python if python.exists() else None


def build_ceres() -> Path | None:
    """The Ceres peer, built where cmake and libceres-dev are installed; None where they are not."""
    if shutil.which("cmake") is None:
        return None
    build = HERE / "peers" / "ceres" / "build"
    for command in (["cmake", "-S", build.parent, "-B", build], ["cmake", "--build", build]):
        if subprocess.run(command, capture_output=True).returncode:
            return None
    return build / "peer_ceres"


def everyone() -> dict[str, tuple[Contender | None, int]]:
    """Contenders by name, None for one that is not installed, with the batch that suits each."""
    binary, snake = build_ceres(), peer_python("pybotics")
    return {
        "aacmm_jax.identify_many": (ours, 10_000),
        "Ceres, 2 threads": (None if binary is None else ceres(binary), 500),
        "SciPy TRF, analytic Jacobian, 1 core": (scipy_trf(True), 20),
        "SciPy TRF, finite differences, 1 core": (scipy_trf(False), 10),
        "stock Optimistix LM, vmapped": (stock_optimistix(own_rule=False), 100),
        "stock Optimistix LM, vmapped, our derivatives": (stock_optimistix(own_rule=True), 100),
        "pybotics 3.1.2 and SciPy, 1 core": (None if snake is None else pybotics(snake), 2),
    }

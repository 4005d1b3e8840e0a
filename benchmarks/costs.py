"""Costs: kinematics per pose, identifications by size of problem, memory, calls and whole processes, arithmetic."""

import importlib.util
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from contenders import HERE, Task, numpy_functions, ours, run_peer

import aacmm_jax as aj

Row = dict[str, Any]
ARM = "cheng2018-simulation"


def seconds_of(call: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - begin


def alternating(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Seconds of every call; the calls alternate, so that all see the same load, and a first call is not counted."""
    for call in calls.values():
        jax.block_until_ready(call())
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            times[name].append(seconds_of(call))
    return times


def kinematics(rounds: int, poses: int = 10_000) -> list[Row]:
    """Microseconds per pose for the tip, and for the tip with its derivative: by q, and by the D-H parameters."""
    task = Task()
    task.q = np.random.default_rng(0).uniform(-np.pi, np.pi, (poses, task.arm.joints))
    vector = np.asarray(task.space.vector())
    residual, jacobian = numpy_functions(task)
    names, joints = task.space.names, [f"q_{i + 1}" for i in range(task.arm.joints)]
    times = alternating(
        {
            "tip: aacmm_jax": lambda: task.arm.position(task.q),
            "tip: NumPy, vectorised": lambda: residual(vector),
            "Jacobian by q, 6 columns: aacmm_jax": lambda: task.arm.jacobian(task.q, joints),
            "Jacobian by D-H, 21 columns: aacmm_jax": lambda: task.arm.jacobian(task.q, names),
            "Jacobian by D-H, 21 columns: NumPy, vectorised": lambda: jacobian(vector),
        },
        rounds,
    )
    python = Path(sys.executable) if importlib.util.find_spec("pinocchio") else None
    named = {
        "position": "tip",
        "jacobian": "Jacobian by q, 6 columns",
        "regressor": "regressor by placements, 36 columns",
    }
    if python:
        peer = run_peer(python, HERE / "peers/pinocchio/measure.py", task, rounds=rounds)
        difference = float(np.max(np.abs(peer["tips"] - np.asarray(task.arm.position(task.q)))))
        assert difference < 1e-9, f"Pinocchio's tips differ by {difference} mm"
        times |= {f"{what}: Pinocchio": peer[key].tolist() for key, what in named.items()}
    rows = [{"what": what, "microseconds_a_pose": 1e6 * statistics.median(t) / poses} for what, t in times.items()]
    return rows if python else [*rows, *({"what": f"{what}: Pinocchio", "absent": True} for what in named.values())]


def identifications(rounds: int) -> list[Row]:
    """Identifications a second against batch size, poses and joints."""
    rows = []
    on_cpu = jax.devices()[0].platform == "cpu"
    task = Task(hold="d_3")
    batches = (100, 1_000, 10_000, 100_000) if on_cpu else (100, 1_000, 10_000, 100_000, 1_000_000)
    tasks = {f"batch {count:,}": (task, count) for count in batches}
    tasks |= {
        f"{poses:,} poses": (Task(poses, hold="d_3"), max(16, min(2_000, 140_000 // poses)))
        for poses in (70, 700, 7_000)
    }
    tasks["70,000 poses"] = (Task(70_000, hold="d_3"), 4)
    tasks |= {f"{joints} joints": (joints_task(joints), 1_000) for joints in range(3, 10)}
    starts = {name: each.starts(count, 1) for name, (each, count) in tasks.items()}

    def many(name: str) -> aj.calibration.ManyIdentifications:
        each = tasks[name][0]
        return aj.identify_many(each.arm, each.capture, each.lower, each.upper, starts[name], hold=each.hold)

    solved = {name: many(name) for name in tasks}
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for number in range(rounds):
        for name in tasks:
            if number < 3 or "100,000" not in name:
                # A short batch is repeated for 0.3 s, so that clock and scheduler do not matter.
                repeats = max(1, round(0.3 / max(min(times[name], default=0.3), 1e-3)))
                times[name].append(
                    seconds_of(lambda name=name, repeats=repeats: [many(name) for _ in range(repeats)]) / repeats
                )
    for name, (each, count) in tasks.items():
        seconds, steps = statistics.median(times[name]), float(np.mean(solved[name].steps))
        poses, free = len(each.q), len(each.lower)
        rows.append(
            {
                "what": name,
                "batch": count,
                "poses": poses,
                "free": free,
                "rate": count / seconds,
                "evaluations": steps,
                "nanoseconds_a_pose_and_evaluation": 1e9 * seconds / count / steps / poses,
                "converged": float(np.mean(solved[name].converged)),
            }
        )
    return rows


def joints_task(joints: int) -> Task:
    """An arm of so many joints, in the pattern of the paper's; from 4 joints on its poses hold one point."""
    task = Task.__new__(Task)
    index = np.arange(joints)
    a, d = np.where(index % 2 == 1, 62.0, 0.0), np.where(index % 2 == 0, 400.0, 0.0)
    task.arm = aj.Arm(alpha=np.where(index % 2 == 1, np.pi / 2, -np.pi / 2), a=a, d=d, probe=(0, 0, 102))
    task.space = aj.Parameters.free_of(task.arm)
    if joints > 3:
        task.capture = aj.simulate(task.arm, {"A": (250, 150, 500)}, poses=70, seed=1)
    else:  # three joints reach a point in a few poses only: then the readings are random, and the tips scatter
        task.capture = aj.Capture({"A": np.random.default_rng(1).uniform(-np.pi, np.pi, (70, joints))})
    bounds = aj.Bounds.around(task.arm, task.space)
    task.q, task.lower, task.upper = np.asarray(task.capture.q), np.asarray(bounds.lower), np.asarray(bounds.upper)
    task.hold = "longest"
    return task


def memory() -> list[Row]:
    """Peak memory of a process that solves one batch, GiB."""
    rows = []
    for count in (1_000, 10_000, 100_000):
        program = f"from costs import peak; print(peak({count}))"
        done = subprocess.run([sys.executable, "-c", program], cwd=HERE, check=True, capture_output=True, text=True)
        rows.append({"what": f"batch {count:,}", "peak_gib": float(done.stdout.split()[-1])})
    return rows


def peak(count: int) -> float:
    task = Task(hold="d_3")
    ours(task, task.starts(count, 1))
    # Not getrusage: its maximum is inherited from the parent that started this process.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) / 2**20


def calls() -> list[Row]:
    """First and second call in a fresh process without a compilation cache, seconds."""
    program = (
        "import time, numpy as np\nfrom contenders import Task\nimport aacmm_jax as aj\n"
        "t = Task(hold='d_3'); s = t.starts(1000, 1)\n"
        "b = aj.Bounds(t.space, t.lower, t.upper)\n"
        "one = lambda: float(aj.identify(t.arm, t.capture, b, hold='d_3', start=s[0]).de)\n"
        "many = lambda: aj.identify_many(t.arm, t.capture, t.lower, t.upper, s, hold='d_3')\n"
        "for call in (one, many):\n    for _ in range(2):\n"
        "        begin = time.perf_counter(); call(); print(time.perf_counter() - begin)\n"
    )
    environment = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=HERE, check=True, capture_output=True, text=True, env=environment
    )
    names = ("identify, first", "identify, second", "identify_many of 1,000, first", "identify_many of 1,000, second")
    return [{"what": what, "seconds": float(text)} for what, text in zip(names, done.stdout.split(), strict=True)]


def commands(rounds: int) -> list[Row]:
    """Whole processes, alternating: `aacmm calibrate` on 70 poses, cold and warm, and its heaviest imports."""
    program = str(Path(sys.executable).with_name("aacmm"))
    with tempfile.TemporaryDirectory() as folder:
        sockets = ["--socket", "A=400,200,300", "--socket", "B=600,200,300", "--poses", "70", "--poses", "B=1"]
        noise = ["--length", "A,B,0.002", "--encoder-arcsec", "2", "--seating-mm", "0.005"]
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": f"{folder}/cache"}

        def run(*command: str, **changed: str) -> float:
            begin = time.perf_counter()
            subprocess.run(command, cwd=folder, check=True, capture_output=True, env=environment | changed)
            return time.perf_counter() - begin

        run(program, "simulate", ARM, "-o", "capture.h5", *sockets, *noise)
        calibrate = (program, "calibrate", "capture.h5", "-o", "calibration.h5")
        run(*calibrate)
        times: dict[str, list[float]] = {"cold": [], "warm": [], "import": []}
        for number in range(rounds):
            if number < 3:
                times["cold"].append(run(*calibrate, JAX_COMPILATION_CACHE_DIR=f"{folder}/cold-{number}"))
            times["warm"].append(run(*calibrate))
            times["import"].append(run(sys.executable, "-c", "import jax, optimistix"))
    named = {
        "cold": "aacmm calibrate, cold",
        "warm": "aacmm calibrate, warm",
        "import": "python -c 'import jax, optimistix'",
    }
    base = statistics.median(times["import"])
    return [
        {"what": named[key], "seconds": statistics.median(t), "of_the_import": statistics.median(t) / base}
        for key, t in times.items()
    ]


def arithmetic(rounds: int) -> list[Row]:
    """Operations a second in evaluations, against the machine's own matrix product, both on all cores.

    Counted for one evaluation of N poses, n joints and p free parameters: the chain 33 n N, a cross product and a
    difference for each of 2n rotations 24 n N, and the Gram matrix with the gradient 2 p (p + 1) 3 N. What a step adds
    (factorisation, acceptance) is time but not counted, so the share is a lower bound.
    """
    task, count = Task(hold="d_3"), 10_000
    starts = task.starts(count, 1)
    side = 1024
    matrix = jax.device_put(np.random.default_rng(0).uniform(size=(side, side)))
    product = jax.jit(lambda m: m @ m)
    many = lambda: aj.identify_many(task.arm, task.capture, task.lower, task.upper, starts, hold="d_3")  # noqa: E731
    evaluations = float(np.sum(many().steps))
    times = alternating({"evaluations": lambda: many().de, "product": lambda: product(matrix)}, rounds)
    poses, n, p = len(task.q), task.arm.joints, len(task.space.names) - 1
    operations = poses * (57 * n + 6 * p * (p + 1))
    reached = operations * evaluations / statistics.median(times["evaluations"]) / 1e9
    limit = 2 * side**3 / statistics.median(times["product"]) / 1e9
    return [{"what": "evaluations", "gflops": reached, "limit_gflops": limit, "share": reached / limit}]

"""Monte Carlo studies: speed against identifications alone, memory, equal results however run, full disks, Dask.

    python benchmarks/studies.py                 # all of it, about ten minutes on 2 quiet cores
    python benchmarks/studies.py speed memory    # some of it: speed, memory, same, disk, dask

writes results/studies-DATE.json and prints it. The study is `bound-sensitivity`, with other numbers of trials in its 20
cells.
"""

import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from datetime import datetime
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np

HERE = Path(__file__).resolve().parent
CELLS = 20


def sized(trials: int):
    """The study with so many trials in each cell."""
    import aacmm_jax as aj

    study = aj.study.read_study("bound-sensitivity")
    return aj.study.Study(study.specification.model_copy(update={"trials": trials}), study.nominal)


def fresh(name: str, *arguments: object, cores: str | None = None) -> dict:
    """A function of this file in a process of its own; what it returns."""
    pinned = ["taskset", "-c", cores] if cores else []
    line = [*pinned, sys.executable, __file__, "--call", name, *map(str, arguments)]
    done = subprocess.run(line, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def once(trials: int, repeats: int, bare: int) -> dict:
    """Run the study of so many trials, compiled beforehand; with ``bare``, also time the identifications alone."""
    import aacmm_jax as aj

    found = {"total": CELLS * trials, "seconds": [], "bare_seconds": []}
    with tempfile.TemporaryDirectory() as folder:
        aj.study.run_study(sized(1000), Path(folder) / "first.h5")
        aj.study.clear_pools()
        for number in range(repeats):
            began = time.perf_counter()
            aj.study.run_study(sized(trials), Path(folder) / f"{number}.h5")
            found["seconds"].append(time.perf_counter() - began)
            found["bytes"] = (Path(folder) / f"{number}.h5").stat().st_size
            aj.study.clear_pools()
            if bare:
                found["bare_seconds"].append(bare_seconds(sized(trials)))
    found["peak_gib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return found


def bare_seconds(study) -> float:
    """`identify_many` alone on the problems of every cell."""
    import aacmm_jax as aj

    total = 0.0
    for cell in range(CELLS):
        setting = study.settings[cell]
        drawn, captures = aj.study.draw_trials(study, cell, np.arange(study.trials))
        problem = (study.nominal.arm, captures, drawn.lower, drawn.upper, drawn.start)
        if cell < 2:  # both ways of holding, compiled
            aj.identify_many(*problem, space=study.space, hold=setting.hold)
        began = time.perf_counter()
        aj.identify_many(*problem, space=study.space, hold=setting.hold)
        total += time.perf_counter() - began
    return total


def speed() -> dict:
    small, large = fresh("once", 500, 3, 0), fresh("once", 5000, 3, 1)
    seconds, bare = float(np.median(large["seconds"])), float(np.median(large["bare_seconds"]))
    slope = (seconds - float(np.median(small["seconds"]))) / (large["total"] - small["total"])
    return {
        "trials": large["total"],
        "seconds": large["seconds"],
        "bare_seconds": large["bare_seconds"],
        "trials_per_second": large["total"] / seconds,
        "bare_per_second": large["total"] / bare,
        "share_of_bare": float(np.median(np.array(large["bare_seconds"]) / np.array(large["seconds"]))),
        "seconds_10000": small["seconds"],
        "seconds_1000000_extrapolated": seconds + slope * (1_000_000 - large["total"]),
        "bytes_per_trial": large["bytes"] / large["total"],
    }


def memory() -> dict:
    return {f"peak_gib_{CELLS * trials}": fresh("once", trials, 1, 0)["peak_gib"] for trials in (500, 5000, 20_000)}


def differs(one: Path, other: Path) -> float:
    """The largest difference between the results of two studies; exactly 0 for the same bits."""
    largest = 0.0
    with h5py.File(one) as a, h5py.File(other) as b:
        for name in a["trials"]:
            x, y = a["trials"][name][()], b["trials"][name][()]
            if x.dtype.kind != "O" and x.tobytes() != y.tobytes():
                largest = max(largest, float(np.nanmax(np.abs(x.astype(float) - y)))) or 1e-300
    return largest


def run_into(path: str, trials: str, chunk: str, devices: str, processes: str) -> dict:
    import jax

    jax.config.update("jax_num_cpu_devices", int(devices))
    import aacmm_jax as aj

    if processes != "0":
        with ProcessPoolExecutor(int(processes), mp_context=get_context("spawn")) as executor:
            outcome = aj.study.run_study(sized(int(trials)), path, executor=executor, chunk=int(chunk))
    else:
        outcome = aj.study.run_study(sized(int(trials)), path, chunk=int(chunk))
    return {"finished": outcome.finished}


def same() -> dict:
    ways = {
        "chunk 256": (256, 1, 0),
        "2 devices": (1000, 2, 0),
        "2 devices, chunk 256": (256, 2, 0),
        "2 processes": (1000, 1, 2),
        "2 processes, chunk 256": (256, 1, 2),
    }
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "first.h5"
        fresh("run_into", first, 1000, 1000, 1, 0)
        found = {}
        for number, (name, way) in enumerate(ways.items()):
            fresh("run_into", Path(folder) / f"{number}.h5", 1000, *way)
            found[name] = differs(first, Path(folder) / f"{number}.h5")
    return {"trials": 1000 * CELLS, "largest_difference": found}


def command(folder: str, *arguments: object) -> subprocess.Popen:
    line = [sys.executable, "-m", "aacmm_jax", "study", "bound-sensitivity", *map(str, arguments)]
    return subprocess.Popen(line, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def disk() -> dict:
    """A small tmpfs that fills: needs the right to mount."""
    with tempfile.TemporaryDirectory() as folder:
        small = Path(folder) / "small"
        small.mkdir()
        if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", small], capture_output=True).returncode:
            return {"skipped": "no right to mount a tmpfs"}
        try:
            arguments = ("-o", small / "s.h5", "--trials", 1000)
            process = command(folder, *arguments)
            _, errors = process.communicate()
            shown = subprocess.run(
                [sys.executable, "-m", "aacmm_jax", "show", small / "s.h5", "--json"], capture_output=True, text=True
            )
            kept = json.loads(shown.stdout)["trials_run"]
            subprocess.run(["mount", "-o", "remount,size=60m", small], check=True)
            again = command(folder, *arguments)
            output, _ = again.communicate()
            whole = Path(folder) / "whole.h5"
            command(folder, "-o", whole, "--trials", 1000).communicate()
            difference = differs(whole, small / "s.h5")
        finally:
            subprocess.run(["umount", "-l", small], check=False)
        return {
            "exit": process.returncode, "error": errors.replace(str(small), "SMALL"), "trials_kept_and_read": kept,
            "resumed_exit": again.returncode, "difference": difference, "output": output.replace(str(small), "SMALL"),
        }  # fmt: skip


def dask() -> dict:
    """Real workers, `dask worker`, each pinned to one core by taskset: one against two."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for count in (1, 2):
            address = f"tcp://127.0.0.1:{8900 + count}"
            port = str(8900 + count)
            started = [
                subprocess.Popen(
                    ["dask", "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"],
                    cwd=folder,
                    stderr=subprocess.DEVNULL,
                )
            ]
            for core in cores[:count]:
                line = ["taskset", "-c", str(core), "dask", "worker", address, "--nthreads", "1", "--no-dashboard"]
                started.append(subprocess.Popen(line, cwd=folder, stderr=subprocess.DEVNULL))
            try:
                found[count] = fresh("on_dask", address, count, folder)["seconds"]
            finally:
                for process in started:
                    process.terminate()
                for process in started:
                    process.wait()
    return {
        "seconds_1_worker": found[1],
        "seconds_2_workers": found[2],
        "times": float(np.median(found[1]) / np.median(found[2])),
    }


def on_dask(address: str, count: str, folder: str) -> dict:
    from distributed import Client

    import aacmm_jax as aj

    with Client(address) as client:
        client.wait_for_workers(int(count))
    seconds = []
    with aj.study.dask_executor(address) as (executor, workers):
        for number in range(4):
            path = Path(folder) / f"{count}-{number}.h5"
            began = time.perf_counter()
            aj.study.run_study(sized(1000 if number == 0 else 2000), path, executor=executor, workers=workers)
            if number:  # the first compiles
                seconds.append(time.perf_counter() - began)
    return {"seconds": seconds}


PARTS = {"speed": speed, "memory": memory, "same": same, "disk": disk, "dask": dask}
CALLS = {"once": lambda *a: once(*map(int, a)), "run_into": run_into, "on_dask": on_dask}


def main() -> None:
    if sys.argv[1:2] == ["--call"]:
        print(json.dumps(CALLS[sys.argv[2]](*sys.argv[3:])))
        return
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", tempfile.mkdtemp())
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    found = {"machine": {"python": platform.python_version(), "cores": len(os.sched_getaffinity(0))}}
    for name in sys.argv[1:] or PARTS:
        print(f"{name} ...", flush=True)
        found[name] = PARTS[name]()
        print(json.dumps(found[name], indent=1), flush=True)
    path = HERE / "results" / f"studies-{datetime.now():%Y-%m-%d-%H%M}.json"
    path.write_text(json.dumps(found, indent=1) + "\n")
    print(f"Written: {path}")


if __name__ == "__main__":
    main()

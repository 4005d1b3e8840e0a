"""What an installation weighs, and how long a new user waits for help, import, arm and first result: first and later.

Run as `python benchmarks/weight.py [--waits] [--extras]`: the wheel is built, and installed in an empty environment;
`--waits` measures commands in it, `--extras` installs each extra, too, and all of them. CPU seconds of each command
with its children, and wall time. The first time, Python compiles what it imports, and JAX's compilation cache is empty.
"""

import importlib.machinery
import importlib.util
import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PANDA = ROOT / "examples" / "mukca" / "capture.toml"
BATCH = """
import aacmm_jax as aj, numpy as np
arm = aj.load_arm("cheng2018-simulation"); space = aj.Parameters.free_of(arm); bounds = aj.Bounds.around(arm, space)
capture = aj.simulate(arm, sockets={"A": (400, 200, 300)}, poses=70, encoder_arcsec=2.0, seed=0)
starts = np.random.default_rng(0).uniform(bounds.lower, bounds.upper, (1000, len(space.names)))
aj.identify_many(arm, capture, bounds.lower, bounds.upper, starts, hold="d_3")
"""
POSITION = "import aacmm_jax as aj; aj.load_arm('panda').position([0.0] * 7)"
WAITS = {
    "`aacmm --help`": ["aacmm", "--help"],
    "`import aacmm_jax`": ["python", "-c", "import aacmm_jax"],
    "a position of an arm in Python": [
        "python",
        "-c",
        POSITION,
    ],
    "`aacmm calibrate`, Panda, 497 poses, `--model dh`": ["aacmm", "calibrate", PANDA, "-o", "a.h5", "--model", "dh"],
    "`aj.identify_many`, 1,000 problems": ["python", "-c", BATCH],
}


def waits(package, programs: Path, folder: Path) -> None:
    print("| | first: CPU s | wall s | later: CPU s | wall s |\n|---|---|---|---|---|")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "JAX", "XLA", "AACMM"))}
    where = {"cwd": folder, "env": kept | {"HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache")}}
    for what, (program, *arguments) in WAITS.items():
        seconds = []
        for _ in range(2):
            before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            package.run(programs / program, *arguments, **where)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
            seconds.append(time.perf_counter() - start)
            for result in folder.glob("*.h5"):
                result.unlink()
        print(f"| {what} | {' | '.join(f'{second:.1f}' for second in seconds)} |", flush=True)


def weight(package, programs: Path) -> tuple[float, int]:
    megabytes, packages, *_ = json.loads(package.run(programs / "python", "-c", package.WEIGH, cwd=programs))
    return megabytes, packages


def main() -> None:
    loader = importlib.machinery.SourceFileLoader("try_package", str(ROOT / ".ci" / "try_package"))
    package = importlib.util.module_from_spec(importlib.util.spec_from_loader("try_package", loader))
    sys.dont_write_bytecode = True
    loader.exec_module(package)
    python = package.pythons()[0]
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        wheel = package.build(scratch, python)
        programs = package.environment(scratch / "core", python, wheel)
        (scratch / "work").mkdir()
        if "--waits" in sys.argv:
            waits(package, programs, scratch / "work")
        core, count = weight(package, programs)
        print(f"\n| extra | MB | packages |\n|---|---|---|\n| core | {core:.0f} | {count} |", flush=True)
        for extra in package.USERS if "--extras" in sys.argv else ():
            programs = package.environment(scratch / extra, python, f"{wheel}[{extra}]")
            megabytes, packages = weight(package, programs)
            print(f"| `{extra}` | + {megabytes - core:.1f} | + {packages - count} |", flush=True)


if __name__ == "__main__":
    main()

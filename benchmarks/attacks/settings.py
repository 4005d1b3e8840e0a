"""Studies and simulations under every setting of JAX, XLA and NumPy that the environment can make.

A study is begun under one setting, killed when half of its blocks are kept, and resumed under another: it is the same
to the bit as one that was not killed, or refused in one sentence. Simulated captures and perturbed arms have no earlier
part to mix with: they are the same to the bit, or to rounding. A setting under which JAX itself stops is none that
changes numbers.
"""

import itertools
import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from aacmm_jax.study import blocks

from .kills import differences
from .outcomes import DONE, OTHER, REFUSED, SAME, SILENT, UNEXPECTED, Attempt, is_sentence

SECONDS = 600
STUDY = """
arm = "cheng2018-simulation"
trials = 16
seed = 5
deviation = { length_mm = 1.0, angle_deg = 0.1 }
capture = { positions_mm = [[400, 200, 300], [300, -300, 400]], poses = 10, pool = 4096 }
noise = { encoder_arcsec = 2, eccentricity_arcsec = 1 }
bounds = { length_mm = 10 }
identification = { start = "random" }
"""
# Arguments: the study's file, and after how many trials the process is killed (0: not at all). Prints whether it was
# refused, and saves what is simulated beside the study.
PROGRAM = """
import json, os, sys
import numpy as np
import aacmm_jax as aj
path, stop = sys.argv[1], int(sys.argv[2])
arm = aj.load_arm("cheng2018-simulation")
space = aj.Parameters.free_of(arm)
built = aj.perturbed_arm(space, length=1.0, angle=0.001, seed=1)
capture = aj.simulate(arm, {"A": (400, 200, 300), "B": (700, 100, 300)}, poses=40, lengths=[("A", "B", 0.01)],
                      encoder_arcsec=2.0, seating=0.005, seed=3)
lengths = [float(length.value) for length in capture.lengths]
np.savez(path + ".npz", built=np.asarray(space.vector(built)), q=np.asarray(capture.q), lengths=lengths)
study, refused = aj.study.read_study("study.toml"), None
watch = lambda progress: os._exit(0) if stop and progress.done >= stop else None
try:
    aj.study.run_study(study, path, chunk=4, workers=1, watch=watch)
except aj.InputError as error:
    refused = str(error)
print(json.dumps(refused))
"""
PINNED = {
    "JAX_THREEFRY_PARTITIONABLE": "0",
    "JAX_DEFAULT_PRNG_IMPL": "rbg",
    "JAX_RANDOM_SEED_OFFSET": "7",
    "JAX_ENABLE_CUSTOM_PRNG": "1",
    "JAX_LEGACY_PRNG_KEY": "error",
}
# Of settings that are not true or false: other values. What they would need (other hardware, a cluster) is left out.
VALUES = {
    "JAX_DEFAULT_PRNG_IMPL": ["rbg", "unsafe_rbg"],
    "JAX_RANDOM_SEED_OFFSET": ["7"],
    "JAX_LEGACY_PRNG_KEY": ["error"],
    "JAX_DEFAULT_MATMUL_PRECISION": ["highest", "bfloat16", "tensorfloat32"],
    "JAX_OPTIMIZATION_LEVEL": ["O0", "O3"],
    "JAX_MEMORY_FITTING_LEVEL": ["O0"],
    "JAX_EXEC_TIME_OPTIMIZATION_EFFORT": ["-1.0"],
    "JAX_MEMORY_FITTING_EFFORT": ["-1.0"],
    "JAX_EMBEDDED_CONSTANTS_MAX_BYTES": ["1000000"],
    "JAX_NUMPY_DTYPE_PROMOTION": ["strict"],
    "JAX_NUMPY_RANK_PROMOTION": ["raise"],
    "JAX_EXPLICIT_X64_DTYPES": ["error"],
    "JAX_DEFAULT_DTYPE_BITS": ["32"],
    "JAX_ERROR_CHECKING_BEHAVIOR_NAN": ["raise"],
    "JAX_NUM_CPU_DEVICES": ["2"],
    "JAX_PLATFORMS": ["cpu"],
    "JAX_TRANSFER_GUARD": ["disallow"],
    "JAX_XLA_PROFILE_VERSION": ["1"],
    "JAX_LOGGING_LEVEL": ["ERROR"],
    "JAX_TRACEBACK_FILTERING": ["off"],
    "XLA_FLAGS": [
        "--xla_cpu_max_isa=AVX2",
        "--xla_cpu_max_isa=SSE4_2",
        "--xla_backend_optimization_level=0",
        "--xla_cpu_enable_fast_math=true",
        "--xla_allow_excess_precision=false",
        "--xla_cpu_prefer_vector_width=128",
        "--xla_force_host_platform_device_count=2",
        "--xla_cpu_multi_thread_eigen=false",
        "--xla_cpu_parallel_codegen_split_count=1",
        "--xla_dump_to=dump --xla_force_host_platform_device_count=2",
        "flags.txt",
    ],
    "OPENBLAS_CORETYPE": ["Nehalem"],
    "OPENBLAS_NUM_THREADS": ["2"],
    "NPY_DISABLE_CPU_FEATURES": ["AVX512F AVX512CD AVX512_SKX"],
    "GLIBC_TUNABLES": ["glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F"],
}
LEFT_OUT = ("JAX_ENABLE_X64",)  # refused at import
ALONE = ("JAX_NO_TRACING", "JAX_NO_EXECUTION", "JAX_TRANSFER_GUARD", "JAX_THREAD_GUARD")  # JAX may stop
TOGETHER = 8  # settings that are tried in one process; each alone where their study is not the same
UNREFUSED = "without it"


def settings() -> list[tuple[str, str]]:
    """Every setting of this JAX with another value than the usual one, and those of XLA and NumPy."""
    usual = {name.upper(): value for name, value in jax.config.values.items()}
    switches = {name: [str(int(not value))] for name, value in usual.items() if isinstance(value, bool)}
    known = {name: values for name, values in VALUES.items() if not name.startswith("JAX_") or name in usual}
    return [(name, value) for name, values in (switches | known).items() for value in values if name not in LEFT_OUT]


def run(folder: Path, path: Path, stop: int, changes: dict[str, str]) -> tuple[int, str, str]:
    """Exit code, output and errors of the program in a process of its own."""
    line, environment = [sys.executable, "-c", PROGRAM, str(path), str(stop)], os.environ | changes
    done = subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=SECONDS)
    return done.returncode, done.stdout, done.stderr


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """All settings in a random order, or the first so many of them; then studies that are begun under one."""
    (folder / "study.toml").write_text(STUDY)
    (folder / "flags.txt").write_text("--xla_cpu_max_isa=AVX2")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "cache"))
    whole, begun = folder / "whole.h5", folder / "begun" / "s.h5"
    run(folder, whole, 0, {})
    begun.parent.mkdir()
    run(folder, begun, 8, {})
    assert len(list(begun.with_name("s.h5.parts").glob("*.h5"))) == 2
    tried = settings()
    random.Random(seed).shuffle(tried)
    number = itertools.count()
    for group in groups(tried[:count]):
        found = list(resumed(folder, whole, begun, dict(group), folder / str(next(number))))
        if len(group) == 1:
            yield from found
        elif all(one.outcome == SAME for one in found):
            yield from (one._replace(detail=f"{name}={value}") for one in found for name, value in group)
        else:
            for name, value in group:
                yield from resumed(folder, whole, begun, {name: value}, folder / str(next(number)))
    for number, (before, after) in enumerate([(PINNED, {}), ({"XLA_FLAGS": "--xla_cpu_max_isa=AVX2"}, {})]):
        path = folder / f"other{number}" / "s.h5"
        path.parent.mkdir()
        run(folder, path, 8, before)
        yield from resumed(folder, whole, path, after, folder / f"again{number}")
        if before is not PINNED:  # under the same setting as before it is continued
            yield from resumed(folder, None, path, before, folder / f"back{number}")


def groups(tried: list[tuple[str, str]]) -> list[list[tuple[str, str]]]:
    """Settings that are expected to change nothing, some at a time, each name once; the others alone."""
    by_name: dict[str, list[tuple[str, str]]] = {}
    for name, value in tried:
        by_name.setdefault(name, []).append((name, value))
    kept = {*map(str.upper, blocks._SETTINGS), *blocks._ENVIRONMENT, blocks._FLAGS, *ALONE}
    alone = [[one] for name, values in by_name.items() if name in kept for one in values]
    others = [one for name, values in by_name.items() if name not in kept for one in values]
    found: list[list[tuple[str, str]]] = []
    for one in others:
        free = next((group for group in found if len(group) < TOGETHER and one[0] not in dict(group)), None)
        found.append([one]) if free is None else free.append(one)
    return alone + found


def resumed(folder: Path, whole: Path | None, begun: Path, changes: dict[str, str], copy: Path) -> Iterator[Attempt]:
    """A copy of the unfinished study, resumed; and what the same process simulated. ``whole``: what it should be."""
    shutil.copytree(begun.parent, copy)
    path, what = copy / "s.h5", " ".join(f"{name}={value}" for name, value in changes.items()) or UNREFUSED
    code, output, errors = run(folder, path, 0, changes)
    simulated = Path(f"{path}.npz")
    if code:
        # JAX stops: of a study and a simulation nothing is there that could be wrong.
        yield Attempt("stopped by JAX", DONE, f"{what}: {errors[-300:]}")
    elif (refused := json.loads(output)) is not None:
        yield Attempt("resumed", REFUSED if is_sentence(refused) and whole else UNEXPECTED, f"{what}: {refused}")
    elif whole is not None:
        different = differences(whole, path)
        yield Attempt("resumed", SILENT if different else SAME, f"{what}: {different}")
    else:
        yield Attempt("resumed under the same", SAME, what)
    if whole is not None and simulated.exists():
        yield Attempt("simulated", *same_numbers(Path(f"{whole}.npz"), simulated, what))
    shutil.rmtree(copy)


def same_numbers(one: Path, other: Path, what: str) -> tuple[str, str]:
    """Whether arrays are the same to the bit, to rounding, or not."""
    with np.load(one) as a, np.load(other) as b:
        pairs = [(a[name], b[name]) for name in a.files]
    if all(x.tobytes() == y.tobytes() for x, y in pairs):
        return SAME, what
    close = all(np.allclose(x, y, rtol=1e-9, atol=1e-9) for x, y in pairs)
    return (OTHER if close else SILENT), what

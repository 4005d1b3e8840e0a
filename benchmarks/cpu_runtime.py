"""What XLA's runtime on the CPU costs a batch, and how near the batch is to what the processor can do.

Run as `python benchmarks/cpu_runtime.py [--rounds 5] [--batch 2000]`. Each setting of XLA is a process of its own that
stays, and the processes take turns, so that all see the same load: identifications a second of `identify_many`, and
microseconds of a loop of many small kernels, on which others saw a slow-down after JAX 0.4.30. A setting that this
version of XLA refuses is named. Then the roofline: operations and bytes of the compiled batch, as XLA counts them for
one pass through its loop, and what this processor reaches on a matrix product and on a copy of memory.
"""

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

SETTINGS = {
    "default": "",
    "no thunk runtime": "--xla_cpu_use_thunk_runtime=false",
    "one thread": "--xla_cpu_multi_thread_eigen=false",
    "concurrency-optimised scheduler": "--xla_cpu_enable_concurrency_optimized_scheduler=true",
    "no fusion emitters": "--xla_cpu_use_fusion_emitters=false",
}


def prepared(batch: int) -> dict[str, Any]:
    """The calls that are timed: each takes a seed."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import aacmm_jax as aj

    arm = aj.load_arm("cheng2018-simulation")
    space = aj.Parameters.free_of(arm)
    bounds = aj.Bounds.around(arm, space)
    capture = aj.simulate(arm, sockets={"A": (400, 200, 300)}, poses=70, seed=0)
    generator = np.random.default_rng(0)
    starts = [generator.uniform(bounds.lower, bounds.upper, (batch, len(space.names))) for _ in range(4)]
    matrices = jnp.asarray(generator.normal(size=(1000, 3, 3)) * 0.1)

    @jax.jit
    def small_kernels(first):
        return jax.lax.scan(lambda total, matrix: (jnp.linalg.norm(total) * matrix @ total, None), first, matrices)[0]

    def identifications(seed: int) -> int:
        """Solve a batch; returns the number of evaluations of all problems."""
        many = aj.identify_many(arm, capture, bounds.lower, bounds.upper, starts[seed % 4])
        return int(np.sum(many.steps))

    return {
        "identifications": identifications,
        "small": lambda seed: small_kernels(jnp.eye(3) + seed).block_until_ready(),
    }


def worker(batch: int) -> None:
    """Time a call each time that a line is read."""
    calls = prepared(batch)
    for call in calls.values():
        call(0)
    print("ready", flush=True)
    for number, line in enumerate(sys.stdin, start=1):
        begin = time.perf_counter()
        calls[line.strip()](number)
        print(time.perf_counter() - begin, flush=True)


def race(rounds: int, batch: int) -> None:
    workers = {}
    for name, flags in SETTINGS.items():
        environment = os.environ | {"XLA_FLAGS": flags, "AACMM_JAX_CACHE": "0", "OPENBLAS_NUM_THREADS": "1"}
        workers[name] = subprocess.Popen(
            [sys.executable, __file__, "--worker", "--batch", str(batch)],
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
    times: dict[str, dict[str, list[float]]] = {}
    for name, process in workers.items():
        if process.stdout.readline().strip() == "ready":
            times[name] = {"identifications": [], "small": []}
        else:
            print(f"{name}: refused by this version of XLA")
    for number in range(rounds):
        for name in list(times)[:: 1 if number % 2 else -1]:
            for call, seconds in times[name].items():
                for _ in range(1 if call == "identifications" else 20):
                    workers[name].stdin.write(call + "\n")
                    workers[name].stdin.flush()
                    seconds.append(float(workers[name].stdout.readline()))
    for process in workers.values():
        process.kill()
    print("| setting of XLA | identifications/s | default over it | 1,000 small steps [us] | it over default |")
    print("|---|---|---|---|---|")
    first = times["default"]
    for name, taken in times.items():
        pairs = [own / other for own, other in zip(taken["identifications"], first["identifications"], strict=True)]
        small, default = (1e6 * min(every["small"]) for every in (taken, first))
        rate = batch / statistics.median(taken["identifications"])
        print(f"| {name} | {rate:,.0f} | {statistics.median(pairs):.2f} | {small:.0f} | {small / default:.2f} |")


def roofline(batch: int) -> None:
    """Operations and bytes of the compiled batch as XLA counts them, its loop once; and the processor's limits."""
    import jax
    import numpy as np

    from aacmm_jax.calibration import batch as engine

    counted, solve_chunk = [], engine.solve_chunk

    def counting(*arguments: Any) -> Any:
        if not counted:
            form = arguments[0]
            counted.append((form, solve_chunk.lower(*arguments).compile().compiled.cost_analysis()))
        return solve_chunk(*arguments)

    engine.solve_chunk = counting
    identifications = prepared(batch)["identifications"]
    evaluations = identifications(1)
    seconds = min(_seconds(lambda: identifications(1)) for _ in range(3))
    side = 1024
    matrix = jax.device_put(np.random.default_rng(0).uniform(size=(side, side)))
    product = jax.jit(lambda m: m @ m)
    source, target = np.ones(2**25), np.ones(2**25)
    product(matrix).block_until_ready()
    flops = 2 * side**3 / min(_seconds(lambda: product(matrix).block_until_ready()) for _ in range(5))
    copied = 2 * source.nbytes / min(_seconds(lambda: np.copyto(target, source)) for _ in range(5))
    form, cost = counted[0]  # threads call it at the same time
    print({"form": {name: value for name, value in form._asdict().items() if isinstance(value, int)}})
    print({name: cost[name] for name in ("flops", "transcendentals", "bytes accessed") if name in cost})
    print(f"batch of {batch}: {seconds:.3f} s, {evaluations} evaluations")
    print(f"matrix product {flops / 1e9:.1f} Gflop/s; copy {copied / 1e9:.1f} GB/s")


def _seconds(call: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--batch", type=int, default=2000)
    parser.add_argument("--worker", action="store_true")
    parser.add_argument("--roofline", action="store_true")
    given = parser.parse_args()
    if given.worker:
        worker(given.batch)
    elif given.roofline:
        roofline(given.batch)
    else:
        race(given.rounds, given.batch)


if __name__ == "__main__":
    main()

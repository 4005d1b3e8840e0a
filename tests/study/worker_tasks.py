"""What tests run in worker processes."""

import os
import signal
from pathlib import Path

import jax
import jax.numpy as jnp

from aacmm_jax.study import runner, trials

from . import prepared_blocks


def die_once(marker: Path) -> str:
    if marker.exists():
        return "done"
    marker.touch()
    os.kill(os.getpid(), signal.SIGKILL)


def die(_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def take_blocks(whole: Path | None) -> None:
    """Blocks of this process are read from a finished study from now on, or computed."""
    runner.run_block = prepared_blocks.prepared if whole else trials.run_block
    if whole:
        os.environ.update(WHOLE=str(whole), SECONDS="0", STARTED=str(whole.with_name("started")))


def misses() -> list[str]:
    """Compile something; what the compilation cache did not have."""
    found = []
    jax.monitoring.register_event_listener(lambda event, **_: found.append(event))
    jax.jit(lambda x: jnp.sin(x) + 1)(jnp.ones(3)).block_until_ready()
    assert any(event.endswith("compile_requests_use_cache") for event in found), found
    return [event for event in found if event.endswith("/cache_misses")]


def listening(_: object = None) -> list[str]:
    """Sockets of this process that wait for connections, by their lines in /proc."""
    inodes = set()
    for file in Path("/proc/self/fd").iterdir():
        try:
            target = os.readlink(file)
        except OSError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    found = []
    for name, state, inode, wanted in (("tcp", 3, 9, "0A"), ("tcp6", 3, 9, "0A"), ("unix", 3, 6, "00010000")):
        for line in Path(f"/proc/self/net/{name}").read_text().splitlines()[1:]:
            columns = line.split()
            if columns[inode] in inodes and columns[state] == wanted:
                found.append(f"{name} {line}")
    return found

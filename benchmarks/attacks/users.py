"""Another user of the machine against the compilation cache, studies, commands and the files that they write.

The other user is a fork of this process that gives up the superuser's rights; it lists, opens and connects to whatever
it can find. What it leaves for others to find is in `planted`.
"""

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from . import planted
from .outcomes import REFUSED, SILENT, UNEXPECTED, Attempt
from .work_as import OTHER_USER, as_user

SECRETS = ("mem", "environ", "maps", "fd", "cwd", "root", "exe")  # of a process, in /proc
PRINT_FOLDER = "import aacmm_jax, jax; print(jax.config.jax_compilation_cache_dir)"


def succeeded(tries: dict[str, Callable[[], object]]) -> list[str]:
    """The names of what was not refused by the operating system."""
    found = []
    for name, attempt in tries.items():
        try:
            attempt()
        except OSError:
            continue
        found.append(name)
    return found


def against_the_cache(folder: Path) -> Iterator[Attempt]:
    """Whether another user can put a program into the cache, or offer a folder that is then used."""

    def used(cache: Path, name: str = "XDG_CACHE_HOME") -> tuple[str, str]:
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "XDG_"))}
        line = [sys.executable, "-c", PRINT_FOLDER]
        done = subprocess.run(line, env=kept | {name: str(cache)}, capture_output=True, text=True, check=True)
        return done.stdout.strip(), done.stderr

    own = folder / "own"
    own.mkdir(mode=0o755)
    used_folder, _ = used(own)
    cache = own / "aacmm_jax"
    assert used_folder == str(cache)
    (cache / "program-cache").write_bytes(b"native code")
    tries = {
        "listed": lambda: os.listdir(cache),
        "read": lambda: (cache / "program-cache").read_bytes(),
        "replaced": lambda: (cache / "program-cache").write_bytes(b"poison"),
        "added": lambda: (cache / "other-cache").write_bytes(b"poison"),
        "renamed": lambda: cache.rename(own / "away"),
        "opened": lambda: cache.chmod(0o777),
    }
    done = as_user(OTHER_USER, lambda: succeeded(tries))
    for name in tries:
        yield Attempt("cache", SILENT if name in done else REFUSED, f"the other user: {name}")
    offered = Path(tempfile.mkdtemp(dir="/tmp"))  # where everybody may make folders
    offered.chmod(0o1777)
    made = as_user(OTHER_USER, lambda: succeeded({"made": lambda: (offered / "aacmm_jax").mkdir(mode=0o755)}))
    assert made == ["made"]
    for name, cache in (("XDG_CACHE_HOME", offered), ("JAX_COMPILATION_CACHE_DIR", offered / "aacmm_jax")):
        used_folder, warning = used(cache, name)
        refused = used_folder == "None" and "it belongs to another user" in warning and warning.count("\n") == 1
        yield Attempt("cache", REFUSED if refused else SILENT, f"a folder of another user in {name}: {warning}")
    (offered / "aacmm_jax").rmdir()
    offered.rmdir()
    above = folder / "above"
    for what, reason in {
        "a group may write to the folder above": f"other users may write to {above}",
        "an entry of another user": "other users may have written planted-cache in this folder",
        "a link": "other users may have written planted-cache in this folder",
        "an entry that others may write to": "other users may have written planted-cache in this folder",
    }.items():
        cache = above / "aacmm_jax"
        cache.mkdir(parents=True, mode=0o700)
        entry = cache / "planted-cache"
        if what == "a link":
            entry.symlink_to(folder)
        elif "entry" in what:
            entry.write_bytes(b"native code")
            entry.chmod(0o602 if "others" in what else 0o600)
            cache.chmod(0o755 if "others" in what else 0o700)
            os.chown(entry, 0 if "others" in what else OTHER_USER, 0)
        else:
            above.chmod(0o770)
            os.chown(above, 0, OTHER_USER)
        used_folder, warning = used(above)
        refused = used_folder == "None" and reason in warning and warning.count("\n") == 1
        yield Attempt("cache", REFUSED if refused else SILENT, f"{what}: {warning}")
        shutil.rmtree(above)


def descendants(process: int) -> list[int]:
    """A process and all that it has started."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            children.setdefault(parent, []).append(int(entry.name))
    found = [process]
    for one in found:
        found.extend(children.get(one, []))
    return found


def listening(processes: list[int]) -> list[tuple[str, str]]:
    """The sockets on which processes wait for connections: the table in /proc/net and the line's address."""
    inodes = set()
    for process in processes:
        for file in Path(f"/proc/{process}/fd").iterdir():
            try:
                inodes.add(os.readlink(file).removeprefix("socket:[").removesuffix("]"))
            except OSError:
                continue
    found = []
    for table, inode, state, waiting, address in (
        ("tcp", 9, 3, "0A", 1), ("tcp6", 9, 3, "0A", 1), ("udp", 9, 3, "07", 1), ("unix", 6, 3, "00010000", 7)
    ):  # fmt: skip
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            columns = line.split()
            if columns[inode] in inodes and columns[state] == waiting:
                found.append((table, columns[address] if len(columns) > address else ""))
    return found


def connected(table: str, address: str) -> None:
    """Connect to a socket, or raise `OSError`."""
    if table == "unix":
        with socket.socket(socket.AF_UNIX) as one:
            one.connect("\0" + address[1:] if address.startswith("@") else address)
        return
    with socket.create_connection(("localhost", int(address.rpartition(":")[2], 16)), timeout=5):
        pass


def against_a_study(folder: Path) -> Iterator[Attempt]:
    """Whether another user can reach a study that runs."""
    folder.chmod(0o755)
    line = [sys.executable, "-m", "aacmm_jax", "study", "bound-sensitivity", "--trials", "4000", "-o", "study.h5"]
    line += ["--workers", "2"]
    process = subprocess.Popen(line, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        parts, deadline = folder / "study.h5.parts", time.monotonic() + 300
        while process.poll() is None and time.monotonic() < deadline and not any(parts.glob("*.npz")):
            time.sleep(0.05)
        if process.poll() is not None:
            yield Attempt("study", UNEXPECTED, process.stderr.read() if process.stderr else "")
            return
        processes = descendants(process.pid)
        sockets = listening(processes)
        tries: dict[str, Callable[[], object]] = {}
        for one in processes:
            for name in SECRETS:
                path = Path(f"/proc/{one}/{name}")
                tries[str(path)] = lambda path=path: (
                    os.listdir(path) if path.name == "fd" else os.readlink(path)
                    if path.name in ("cwd", "root", "exe") else path.read_bytes()
                )  # fmt: skip
            tries[f"signal to {one}"] = lambda one=one: os.kill(one, 0)
        tries |= {f"connected to {one}": lambda one=one: connected(*one) for one in sockets}
        block = next(parts.glob("*.npz"))
        tries |= {
            "a block replaced": lambda: block.write_bytes(b"poison"),
            "a block added": lambda: (parts / "x.h5").write_bytes(b"poison"),
            "the study replaced": lambda: (folder / "study.h5").write_bytes(b"poison"),
        }
        done = as_user(OTHER_USER, lambda: succeeded(tries))
        yield Attempt("study: sockets", SILENT if sockets else REFUSED, str(sockets))
        for name in tries:
            yield Attempt("study: tries", SILENT if name in done else REFUSED, f"the other user: {name}")
    finally:
        process.kill()
        process.communicate()


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """Everything once, where the superuser runs it on Linux; ``seed`` and ``count`` change nothing."""
    if not hasattr(os, "getuid") or os.getuid() != 0 or not sys.platform.startswith("linux"):
        return
    folder.chmod(0o755)
    yield from against_the_cache(folder)
    (folder / "study").mkdir()
    yield from against_a_study(folder / "study")
    yield from planted.attack(folder)

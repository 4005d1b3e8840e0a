"""The process that reads HDF5 files first: what it must survive, and what it must not be blamed for."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import h5py
import numpy as np
import pytest

from aacmm_jax.files import hdf5_content, reader_process
from aacmm_jax.files.hdf5 import Table, columns, read_tables, write_tables
from tests.refusals import assert_refused

KIND = ("capture",)
TABLES = {"t": Table(columns("row", name=([f"name {i}" for i in range(50)], "", "name")))}


@pytest.fixture
def path(tmp_path):
    """An intact file that this process has not written, as far as it knows."""
    write_tables(tmp_path / "f.h5", "capture", TABLES, {"scale": 2.0})
    reader_process._vouched_for.clear()
    return tmp_path / "f.h5"


@pytest.fixture
def endless(path, tmp_path):
    """A file on which HDF5 loops for ever: an object of no size in the heap of texts, with the seal computed again."""
    content = bytearray(path.read_bytes())
    place = content.index(b"GCOL") + 16
    content[place : place + 16] = bytes(16)
    (tmp_path / "endless.h5").write_bytes(content[: content.rindex(b"\naacmm_jax: SHA-256")])
    with open(tmp_path / "endless.h5", "rb+") as file:
        hdf5_content.seal(file)
    return tmp_path / "endless.h5"


def process():
    return reader_process._reader._process


def assert_readable(path):
    reader_process._vouched_for.clear()
    assert read_tables(path, KIND).attributes["scale"] == 2.0


@pytest.mark.slow
@pytest.mark.parametrize("limit", ["CPU time", "clock"])
def test_an_endless_file_is_damaged(path, endless, monkeypatch, limit):
    monkeypatch.setattr(reader_process, "_CPU_SECONDS", 0.2 if limit == "CPU time" else 10)
    monkeypatch.setattr(reader_process, "_CLOCK_PER_CPU", 300 if limit == "CPU time" else 0.02)
    assert_refused(lambda: read_tables(endless, KIND), endless, "is damaged", "create it again")
    monkeypatch.undo()
    assert_readable(path)


@pytest.mark.slow
def test_ctrl_c_ends_waiting_for_an_endless_file(path, endless, monkeypatch):
    assert_readable(path)
    monkeypatch.setattr(reader_process, "_CPU_SECONDS", 60)
    # Processes that a shell starts in the background ignore it.
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            read_tables(endless, KIND)
    finally:
        signal.signal(signal.SIGINT, former)
    assert_readable(path)


@pytest.mark.slow
def test_memory_is_limited(path, monkeypatch):
    """A large array of zeros that HDF5 has not stored."""
    with h5py.File(path, "a") as file:
        file["t"].create_dataset("zeros", (2**21,), "f8")
    with open(path, "rb+") as file:
        hdf5_content.seal(file)
    reader_process._vouched_for.clear()
    assert read_tables(path, KIND).tables["t"]["zeros"].size == 2**21
    reader_process._reader.stop()  # which has memory left from reading it
    reader_process._vouched_for.clear()
    monkeypatch.setattr(reader_process, "_MEMORY", -(2**25))  # less than a new one has
    assert_refused(lambda: read_tables(path, KIND), path, "is damaged", "create it again")


@pytest.mark.slow
def test_a_child_that_has_ended_is_replaced(path):
    assert_readable(path)
    first = process()
    first.kill()
    first.wait()
    assert_readable(path)
    assert process().pid != first.pid
    assert first.stdin.closed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("executable", "reason"),
    [("/no/such/program", "no such file"), (shutil.which("false"), "exit status 1")],
)
def test_a_child_that_does_not_start_is_no_damage(path, monkeypatch, executable, reason):
    monkeypatch.setattr(sys, "executable", executable)
    reader_process._reader.stop()
    assert_refused(lambda: read_tables(path, KIND), path, "cannot be read", "does not start", reason, "import h5py")
    monkeypatch.undo()
    assert_readable(path)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("executable", ["", None])
def test_without_an_interpreter_files_with_their_sha256_are_read(path, monkeypatch, executable):
    monkeypatch.setattr(sys, "executable", executable)
    monkeypatch.setattr(reader_process, "_vouched_for", set())
    reader_process._reader.stop()
    assert_readable(path)
    assert process() is None


def test_nothing_is_imported_from_the_current_folder(path, tmp_path, monkeypatch):
    for name in ("h5py", "json", "aacmm_jax"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", ".", *sys.path])
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    reader_process._reader.stop()
    assert_readable(path)
    assert not (tmp_path / "imported").exists()


@pytest.mark.slow
def test_threads_take_turns(path):
    reader_process._reader.stop()
    found = []
    threads = [threading.Thread(target=lambda: found.append(read_tables(path, KIND).tables["t"])) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [len(table["name"]) for table in found] == [50] * 4


@pytest.mark.slow
@pytest.mark.parametrize("end", ["exit()", "os._exit(0)", "os.kill(os.getpid(), 9)"])
def test_the_child_ends_with_its_parent(path, end):
    program = (
        "import os, sys\n"
        "from aacmm_jax.files import hdf5, reader_process\n"
        f"hdf5.read_tables({str(path)!r}, ('capture',))\n"
        "print(reader_process._reader._process.pid, flush=True)\n" + end
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, timeout=60)
    assert done.stderr == ""
    for _ in range(100):
        try:
            os.kill(int(done.stdout), 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    raise AssertionError("it still runs")


@pytest.mark.slow
def test_a_fork_starts_a_child_of_its_own(path):
    program = (
        "import os\n"
        "from aacmm_jax.files import hdf5, reader_process\n"
        f"read = lambda: (reader_process._vouched_for.clear(), hdf5.read_tables({str(path)!r}, ('capture',)))\n"
        "read()\n"
        "pid = os.fork()\n"
        "read()\n"
        "if pid:\n"
        "    print(os.waitpid(pid, 0)[1])\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("0\n", "")


def test_large_files_are_opened_by_the_child(path, monkeypatch, tmp_path):
    """By a path that does not depend on the current folder, which the child has left."""
    from aacmm_jax.files import hdf5

    monkeypatch.setattr(hdf5, "_IN_MEMORY", 100)
    monkeypatch.chdir(tmp_path)
    np.testing.assert_array_equal(read_tables("f.h5", KIND).tables["t"]["row"], np.arange(1, 51))

"""Worker processes: closed to other users, with a compilation cache, replaced when they die; Ctrl-C."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor

import jax
import pytest

import aacmm_jax as aj
from aacmm_jax.study import executors
from aacmm_jax.study.blocks import parts_of
from aacmm_jax.study.executors import CacheSettings, LocalProcesses, use_compilation_cache

from . import worker_tasks
from .small_study import CHUNK, ROOT, command, same, until, until_parts


@pytest.fixture(scope="module")
def processes():
    with aj.study.dask_executor("local", 1) as (executor, count):
        assert count == 1
        yield executor


@pytest.mark.slow
@pytest.mark.parametrize("blocks", ["read", "computed"])
def test_local_processes_write_the_same_study(home, study, tmp_path, processes, blocks):
    """Also where blocks are read there: to trace their programs in a fresh process takes seconds."""
    processes.submit(worker_tasks.take_blocks, home / "whole.h5" if blocks == "read" else None).result()
    outcome = aj.study.run_study(study, tmp_path / "s.h5", executor=processes, workers=1, chunk=CHUNK, shards=True)
    assert outcome.ran == 96
    same(home / "whole.h5", tmp_path / "s.h5")


def test_what_a_process_raises_is_raised_here(processes):
    with pytest.raises(ValueError, match="invalid literal"):
        processes.submit(int, "x").result()
    with pytest.raises(RuntimeError, match="pickle"):
        processes.submit(eval, "lambda: 0").result()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_local_processes_wait_for_no_connection(processes):
    """The whole reason for pipes: a port is open to all users of a machine, whoever owns the process."""
    assert processes.submit(worker_tasks.listening).result() == []
    assert worker_tasks.listening() == []


@pytest.mark.slow
def test_processes_import_nothing_from_the_working_folder(tmp_path):
    """Others may have put a module there; multiprocessing starts its processes by ``python -c``, which looks there."""
    (tmp_path / "multiprocessing.py").write_text("import pathlib; pathlib.Path('ran').touch()")
    script = tmp_path / "script" / "aacmm"
    script.parent.mkdir()
    script.write_text(
        "import os\nfrom aacmm_jax.study.executors import LocalProcesses\n"
        "if __name__ == '__main__':\n    print(LocalProcesses(1).submit(os.getcwd).result())\n"
        "    print('PYTHONSAFEPATH' in os.environ)"
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    line, environment = [sys.executable, script], environment | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(tmp_path), "False"]
    assert not (tmp_path / "ran").exists()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_listening_sockets_are_seen():
    import socket

    with socket.create_server(("127.0.0.1", 0)):
        assert len(worker_tasks.listening()) == 1


@pytest.mark.slow
def test_a_process_that_dies_is_replaced(processes, tmp_path, monkeypatch):
    first = processes.submit(os.getpid).result()
    assert processes.submit(worker_tasks.die_once, tmp_path / "marker").result() == "done"
    assert processes.submit(os.getpid).result() not in (first, os.getpid())
    monkeypatch.setattr(executors, "_RETRIES", 0)
    with pytest.raises(RuntimeError, match="died 1 times"):
        processes.submit(worker_tasks.die, None).result()


@pytest.mark.slow
def test_fresh_workers_find_what_others_have_compiled(tmp_path, monkeypatch):
    settings = CacheSettings(str(tmp_path / "cache"), 0.0)
    monkeypatch.setattr(CacheSettings, "current", lambda: settings)
    for compiled in (True, False):
        executor = LocalProcesses(1)
        try:
            assert bool(executor.submit(worker_tasks.misses).result()) == compiled
        finally:
            executor.shutdown(wait=False)


def test_the_cache_of_a_worker_is_that_of_its_environment(tmp_path, monkeypatch):
    """Dask sets variables of a worker when JAX is imported already."""
    before = CacheSettings.current()
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        use_compilation_cache()
        assert CacheSettings.current() == (str(tmp_path), 0.0)
    finally:
        use_compilation_cache(before)
    assert CacheSettings.current() == before


@pytest.mark.exhaustive
def test_dask_workers_find_what_others_have_compiled(home, study, tmp_path):
    """Two clusters, one after the other, whose workers have imported JAX before they hear of a study."""
    distributed = pytest.importorskip("distributed")
    environment = {"XDG_CACHE_HOME": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    environment |= {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    kept = []
    for name in ("s.h5", "t.h5"):
        with (
            distributed.LocalCluster(
                n_workers=1, threads_per_worker=1, dashboard_address=None, env=environment, preload=["jax"]
            ) as cluster,
            aj.study.dask_executor(cluster.scheduler_address) as (executor, count),
        ):
            outcome = aj.study.run_study(study, tmp_path / name, executor=executor, workers=count, chunk=CHUNK)
        assert outcome.finished
        same(home / "whole.h5", tmp_path / name)
        kept.append({item.name for item in (tmp_path / "cache").iterdir() if not item.name.endswith("-atime")})
    assert any("solve_chunk" in item for item in kept[0])
    assert kept[0] == kept[1]


@pytest.mark.slow
@pytest.mark.parametrize("where", [(), ("--dask", "local")], ids=["threads", "processes"])
def test_an_interrupt_is_answered_while_programs_compile(home, tmp_path, prepared, where):
    """First blocks that would take an hour, as a compilation that Python cannot interrupt; Ctrl-C reaches all."""
    path = tmp_path / "s.h5"
    process = command(home, "-o", path, *where, "--workers", 1, start_new_session=True, **prepared(3600))
    until((tmp_path / "started").exists, process)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 130, errors
    expected = f"Stopped; 0 of 96 trials are kept. Continue with: aacmm study --resume -o {path}\n"
    assert errors == expected
    assert {item.name for item in tmp_path.iterdir()} == {"s.h5", "s.h5.parts", "started"}
    aj.study.open_study(path).close()
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:  # no process of it is left
            return
        time.sleep(0.05)
    pytest.fail("worker processes outlive the command")


@pytest.mark.slow
@pytest.mark.parametrize(
    "where", [(), pytest.param(("--dask", "local"), marks=pytest.mark.exhaustive)], ids=["threads", "processes"]
)
def test_an_interrupt_lets_running_blocks_end(home, tmp_path, prepared, where):
    path = tmp_path / "s.h5"
    options = ("--chunk", CHUNK, "--workers", 1, *where)
    process = command(home, "-o", path, *options, start_new_session=True, **prepared(1.0))
    until_parts(path, 2, process)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    kept = len(list(parts_of(path).glob("*.npz")))
    assert 2 < kept < 12
    assert errors == (f"Stopped; {kept * CHUNK} of 96 trials are kept. Continue with: aacmm study --resume -o {path}\n")
    assert process.returncode == 130


@pytest.mark.slow
def test_an_interrupt_is_answered_in_the_middle_of_xla(home, tmp_path):
    """A real compilation: the process ends before the program is compiled, which nobody would otherwise see."""
    # Optimised, so that it takes seconds, however late this process learns of its beginning.
    environment = {"JAX_ENABLE_COMPILATION_CACHE": "0", "JAX_LOG_COMPILES": "1", "XLA_FLAGS": ""}
    process = command(home, "-o", tmp_path / "s.h5", env=environment, start_new_session=True)
    assert any("Compiling jit(_draw)" in line for line in process.stderr)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 130
    assert "Finished XLA compilation of jit(_draw)" not in errors
    assert "Stopped; 0 of 96 trials are kept" in errors


@pytest.mark.exhaustive
def test_any_executor(home, study, tmp_path):
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert aj.study.run_study(study, tmp_path / "s.h5", executor=pool, chunk=CHUNK).finished
    same(home / "whole.h5", tmp_path / "s.h5")


def test_an_executor_that_forks_is_refused(study, tmp_path):
    with (
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as pool,
        pytest.raises(aj.InputError, match="the executor forks, which JAX does not survive"),
    ):
        aj.study.run_study(study, tmp_path / "t.h5", executor=pool)


def test_nobody_answers(aacmm, home, monkeypatch):
    distributed = pytest.importorskip("distributed")
    client = distributed.Client
    monkeypatch.setattr(distributed, "Client", lambda **given: client(**given | {"timeout": given["timeout"] / 10}))
    done = aacmm("study", home / "spec.toml", "-o", "s.h5", "--dask", "tcp://127.0.0.1:1", expect=2)
    assert done.stderr.count("\n") == 1
    assert "no Dask scheduler answers at tcp://127.0.0.1:1; start one, or use --dask local" in done.stderr

"""Executors, the compilation cache of their workers, and Ctrl-C."""

import multiprocessing
import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import jax
import pytest

import aacmm_jax as aj
from aacmm_jax.core._compat import reset_compilation_cache
from aacmm_jax.files.outputs import OutputFile
from aacmm_jax.study import runner
from aacmm_jax.study.runner import use_compilation_cache
from aacmm_jax.study.store import parts_of

from .small_study import CHUNK, command, same, until, until_parts


def test_the_cache_of_a_worker_is_that_of_its_environment(tmp_path, monkeypatch):
    """Dask sets variables of a worker when JAX is imported already."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = [getattr(jax.config, name) for name in names]
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        use_compilation_cache()
        assert [getattr(jax.config, name) for name in names] == [str(tmp_path), 0.0]
    finally:
        for name, value in zip(names, before, strict=True):
            jax.config.update(name, value)
        reset_compilation_cache()


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
def test_an_interrupt_is_answered_while_programs_compile(home, tmp_path, prepared):
    """First blocks that would take an hour, as a compilation that Python cannot interrupt; Ctrl-C reaches all."""
    path = tmp_path / "s.h5"
    process = command(home, "-o", path, "--workers", 1, start_new_session=True, **prepared(3600))
    until((tmp_path / "started").exists, process)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 130, errors
    expected = f"Stopped; 0 of 96 trials are saved. Continue with: aacmm study --resume -o {path}\n"
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
def test_an_interrupt_lets_submitted_blocks_end(home, tmp_path, prepared):
    path = tmp_path / "s.h5"
    options = ("--chunk", CHUNK, "--workers", 1)
    process = command(home, "-o", path, *options, start_new_session=True, **prepared(1.0))
    until_parts(path, 2, process)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    kept = len(list(parts_of(path).glob("*.npz")))
    assert 2 < kept < 12
    assert errors == (
        f"Stopped; {kept * CHUNK} of 96 trials are saved. Continue with: aacmm study --resume -o {path}\n"
    )
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
    assert "Stopped; 0 of 96 trials are saved" in errors


@pytest.mark.exhaustive
def test_any_executor(home, study, tmp_path):
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert aj.study.run_study(study, tmp_path / "s.h5", executor=pool, chunk=CHUNK).finished
    same(home / "whole.h5", tmp_path / "s.h5")


def test_an_executor_that_forks_is_refused(study, tmp_path):
    with (
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as pool,
        pytest.raises(aj.InputError, match="the executor forks its processes, which does not work with JAX"),
    ):
        aj.study.run_study(study, tmp_path / "t.h5", executor=pool)


@pytest.mark.slow
def test_nobody_answers(aacmm, home, monkeypatch):
    distributed = pytest.importorskip("distributed")
    client = distributed.Client
    monkeypatch.setattr(distributed, "Client", lambda **given: client(**given | {"timeout": given["timeout"] / 10}))
    done = aacmm("study", home / "spec.toml", "-o", "s.h5", "--dask", "tcp://127.0.0.1:1", expect=2)
    assert done.stderr.count("\n") == 1
    assert "no Dask scheduler answers at tcp://127.0.0.1:1; start a scheduler, or omit --dask" in done.stderr


def test_a_lock_that_cannot_be_removed_while_it_is_held_is_left(tmp_path, monkeypatch):
    """As on Windows, where the lock removes its file itself when it is released."""

    def refuse(self, missing_ok=False):
        raise PermissionError(13, "in use")

    monkeypatch.setattr(Path, "unlink", refuse)
    for _ in range(2):
        with runner._locked(OutputFile(tmp_path / "study.h5")):
            pass
        assert list(tmp_path.iterdir())

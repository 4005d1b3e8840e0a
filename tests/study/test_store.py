"""A study's file: complete at every moment, continued after any stop, the same however it was run."""

import inspect
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.study import runner, store
from aacmm_jax.study.blocks import Layout, parts_of

ROOT = Path(__file__).resolve().parents[2]
SPECIFICATION = """
name = "small"
arm = "cheng2018-simulation"
trials = 60
seed = 5
[deviation]
length_mm = 1.0
angle_deg = 0.1
[capture]
positions_mm = [[400, 200, 300]]
poses = 20
pool = 4096
[noise]
encoder_arcsec = [1, 4]
[bounds]
length_mm = [2, 10]
[identification]
method = "stage1"
"""


@pytest.fixture(scope="module", autouse=True)
def compiled(cache):
    """Every process that a test starts keeps its compiled programs for the next."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(cache / "aacmm_jax"))
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        yield


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A folder with the specification, and the study run through at once."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "spec.toml").write_text(SPECIFICATION)
    outcome = aj.study.run_study(aj.study.read_study(folder / "spec.toml"), folder / "whole.h5", chunk=16)
    assert outcome.finished
    return folder


@pytest.fixture
def study(home):
    return aj.study.read_study(home / "spec.toml")


def same(one: Path, other: Path) -> None:
    """Every array of two studies, to the bit."""
    with h5py.File(one) as a, h5py.File(other) as b:
        assert set(a) == set(b)
        for group in a:
            assert list(a[group]) == list(b[group])
            for name in a[group]:
                x, y = a[group][name][()], b[group][name][()]
                np.testing.assert_array_equal(x, y, err_msg=f"{group}/{name}")
                assert dict(a[group][name].attrs).keys() == dict(b[group][name].attrs).keys()


def command(home: Path, cache: Path, *arguments: object, **options) -> subprocess.Popen:
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(ROOT)}
    line = [sys.executable, "-m", "aacmm_jax", "study", "spec.toml", *map(str, arguments)]
    return subprocess.Popen(
        line, cwd=home, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )


def until_parts(path: Path, count: int, process: subprocess.Popen) -> None:
    """Wait until so many blocks are kept, or the process has ended."""
    deadline = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < deadline:
        if len(list(parts_of(path).glob("*.h5"))) >= count:
            return
        time.sleep(0.002)


def interrupted_at(count: int):
    """A callback for a study that interrupts it, once."""
    sent = []

    def watch(progress):
        if progress.done >= count and not sent:
            sent.append(True)
            os.kill(os.getpid(), signal.SIGINT)

    return watch


@pytest.mark.parametrize("chunk", [1, 7, 500])
def test_the_chunk_changes_no_bit(home, study, tmp_path, chunk):
    trials = study.trials if chunk > 1 else 3
    if chunk == 1:
        specification = study.specification.model_copy(update={"trials": trials})
        study = aj.study.Study(specification, study.nominal)
    aj.study.run_study(study, tmp_path / "s.h5", chunk=chunk)
    with h5py.File(home / "whole.h5") as whole, h5py.File(tmp_path / "s.h5") as part:
        for name in whole["trials"]:
            if name != "trial":
                cut = (slice(None), slice(trials)) if whole["trials"][name].ndim > 1 else ...
                np.testing.assert_array_equal(whole["trials"][name][cut], part["trials"][name][()], err_msg=name)


def test_blocks_cover_every_trial_once(study):
    for chunk in (1, 7, 16, 60, 100, 125, 10_000):
        layout = Layout.of(study, chunk)
        seen = np.zeros((layout.cells, layout.trials), dtype=int)
        for block in layout.blocks():
            seen[block.first_cell : block.last_cell, block.first_trial : block.last_trial] += 1
        assert (seen == 1).all()


def test_cells_of_different_settings_share_no_block():
    """Numbers of poses compile to different programs; so do scale anchors."""
    capture = {"positions_mm": [[400, 200, 300]], "poses": [10, 20], "pool": 4096}
    study = aj.study.make_study(
        arm="cheng2018-simulation", trials=10, capture=capture, identification={"hold": ["none", "longest"]}
    )
    assert Layout.of(study, 1000).block_cells == 1
    widths = aj.study.make_study(
        arm="cheng2018-simulation",
        trials=10,
        capture=capture,
        noise={"encoder_arcsec": [1, 2, 3]},
        bounds={"length_mm": [1, 2]},
    )
    assert Layout.of(widths, 1000).block_cells == 6


def test_stopped_is_resumed(home, study, tmp_path):
    """Stopped by its callback: all finished blocks are kept, read while unfinished, and continued."""
    path = tmp_path / "s.h5"

    outcome = aj.study.run_study(study, path, chunk=16, watch=interrupted_at(48))
    assert not outcome.finished
    assert 48 <= outcome.done < outcome.total
    data = aj.study.open_study(path)
    ran = data.converged.values >= 0
    assert ran.sum() == outcome.done
    np.testing.assert_array_equal(np.isnan(data.de_stage1.values), ~ran)
    data.close()
    again = aj.study.run_study(study, path)
    assert (again.finished, again.ran) == (True, again.total - outcome.done)
    assert not parts_of(path).exists()
    same(home / "whole.h5", path)
    assert aj.study.run_study(study, path).ran == 0


def test_a_second_run_at_the_same_time_is_refused(study, tmp_path):
    refused = []

    def second(_):
        if not refused:
            with pytest.raises(aj.InputError, match=r"s\.h5 is being written by another process; wait for it"):
                aj.study.run_study(study, tmp_path / "s.h5")
            refused.append(True)

    assert aj.study.run_study(study, tmp_path / "s.h5", chunk=16, watch=second).finished
    assert refused
    assert [item.name for item in tmp_path.iterdir()] == ["s.h5"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 6}, "s.h5 holds another study .seed differs.; choose another output"),
        ({"trials": 61}, "holds another study .trials differs."),
        ({"chunk": 20}, "was begun with chunks of 16 trials; leave the chunk out"),
        ({"chunk": 0}, "chunk is 0; give a whole number of at least 1"),
        ({"version": "9.9"}, "was begun with aacmm_jax .*; continue with that version"),
    ],
    ids=str,
)
def test_what_a_file_was_begun_with_stays(study, tmp_path, change, message, monkeypatch):
    path = tmp_path / "s.h5"
    store.create(path, study, Layout.of(study, 16), 16)
    change = dict(change)
    options = {"chunk": change.pop("chunk")} if "chunk" in change else {}
    if "version" in change:
        version = change.pop("version")
        monkeypatch.setattr("importlib.metadata.version", lambda _: version)
    other = aj.study.Study(study.specification.model_copy(update=change), study.nominal)
    with pytest.raises(aj.InputError, match=message):
        aj.study.run_study(other, path, **options)
    assert parts_of(path).is_dir()


def test_other_files_are_not_overwritten(study, tmp_path, noisy_capture):
    aj.files.save_capture(
        tmp_path / "c.h5", aj.Recording(noisy_capture, aj.files.load_specification("cheng2018-simulation"))
    )
    with pytest.raises(aj.InputError, match=r"c\.h5 holds a capture; name a study file"):
        aj.study.run_study(study, tmp_path / "c.h5")
    aj.files.load_capture(tmp_path / "c.h5")


def test_results_without_their_parts_are_missed(home, study, tmp_path):
    path = tmp_path / "s.h5"
    store.create(path, study, Layout.of(study, 16), 16)
    for use in (aj.study.open_study, lambda path: aj.study.run_study(study, path)):
        path = path.rename(tmp_path / "t.h5")
        with pytest.raises(
            aj.InputError, match=r"t\.h5 was renamed, but its results are in s\.h5\.parts; rename it back to s\.h5"
        ):
            use(path)
        path = path.rename(tmp_path / "s.h5")
    shutil.rmtree(parts_of(path))
    for use in (aj.study.open_study, lambda path: aj.study.run_study(study, path)):
        with pytest.raises(
            aj.InputError, match=r"results in the folder s\.h5\.parts, which is missing; put it next to the file"
        ):
            use(path)
    with pytest.raises(aj.InputError, match="does not exist"):
        aj.study.open_study(tmp_path / "none.h5")


def test_blocks_of_a_study_whose_file_is_gone_are_not_taken_for_anothers(home, study, tmp_path):
    path = tmp_path / "s.h5"
    other = aj.study.Study(study.specification.model_copy(update={"seed": 6}), study.nominal)
    aj.study.run_study(other, path, chunk=16, keep_parts=True)
    path.unlink()
    assert aj.study.run_study(study, path, chunk=16).ran == 240
    same(home / "whole.h5", path)


def test_a_moved_and_oddly_named_study_still_reads(home, study, tmp_path):
    """The folder is found next to the file wherever both are moved; percent signs are no patterns."""
    path = tmp_path / "50% of it.h5"
    aj.study.run_study(study, path, chunk=16, watch=interrupted_at(1))
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for item in (path, parts_of(path)):
        item.rename(moved / item.name)
    assert (aj.study.open_study(moved / path.name).converged.values >= 0).any()
    assert aj.study.run_study(study, moved / path.name).finished
    same(home / "whole.h5", moved / path.name)


def test_killed_and_resumed_it_is_the_same(home, cache, tmp_path):
    """SIGKILL at random moments of the real command, start-up and finishing included."""
    path, generator = tmp_path / "s.h5", np.random.default_rng(1)
    kills, blocks = 6, 16
    for number in range(kills):
        process = command(home, cache, "-o", path, "--chunk", 16)
        until_parts(path, 1 + number * blocks // kills, process)
        time.sleep(generator.uniform(0, 0.05))
        process.kill()
        process.communicate()
        if path.exists():
            shown = aj.study.open_study(path)
            assert shown.sizes["trial"] == 60
            shown.close()
    process = command(home, cache, "-o", path, "--chunk", 16)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert "Written" in output
    same(home / "whole.h5", path)
    assert [item.name for item in tmp_path.iterdir()] == ["s.h5"]


@pytest.mark.slow
def test_an_interrupt_finishes_the_blocks_in_work_and_says_how_to_go_on(home, cache, tmp_path):
    path = tmp_path / "s.h5"
    process = command(home, cache, "-o", path, "--chunk", 4, "--trials", 600, "--workers", 1)
    until_parts(path, 3, process)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    kept = len(list(parts_of(path).glob("*.h5")))
    assert kept >= 3
    assert f"Stopped; {4 * kept:,} of 2,400 trials are kept. Continue with: aacmm study --resume -o {path}" in errors
    assert "Traceback" not in errors
    process = subprocess.Popen(
        [sys.executable, "-m", "aacmm_jax", "study", "--resume", "-o", path, "--json"],
        env=os.environ | {"XDG_CACHE_HOME": str(cache)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert f'"trials_this_run": {2400 - 4 * kept}' in output


@pytest.mark.slow
def test_a_full_disk_is_one_sentence_and_loses_nothing(home, cache, tmp_path):
    """A limit on the size of files fails a write as a full disk does: first of a block, then of the file at the end."""
    path = tmp_path / "s.h5"
    limited = (
        "import os, resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2); "
        "os.execv(sys.executable, [sys.executable, '-m', 'aacmm_jax', *sys.argv[2:]])"
    )
    store.create(
        path, aj.study.read_study(home / "spec.toml"), Layout.of(aj.study.read_study(home / "spec.toml"), 16), 16
    )
    for limit, what in (
        (10_000, "cell00000-trial0000000000.h5 cannot"),
        ((home / "whole.h5").stat().st_size - 10_000, "s.h5 cannot"),
    ):
        done = subprocess.run(
            [sys.executable, "-c", limited, str(limit), "study", "spec.toml", "-o", str(path), "--workers", "1"],
            cwd=home, env=os.environ | {"PYTHONPATH": str(ROOT), "JAX_ENABLE_COMPILATION_CACHE": "0"},
            capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert done.returncode == 2, done.stderr
        assert done.stderr.count("\n") == 1
        assert what in done.stderr
        assert (
            "cannot be written: file too large; free some space there, then run the same command again" in done.stderr
        )
        aj.study.open_study(path).close()
    process = command(home, cache, "-o", path)
    process.communicate(timeout=300)
    assert process.returncode == 0
    same(home / "whole.h5", path)


PROGRAM = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import aacmm_jax as aj
assert len(jax.devices()) == int(sys.argv[1])
aj.study.run_study(aj.study.read_study(sys.argv[2]), sys.argv[3], chunk=16)
"""


@pytest.mark.slow
def test_the_number_of_devices_changes_nothing(home, cache, tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run(
        [sys.executable, "-c", PROGRAM, "2", str(home / "spec.toml"), str(tmp_path / "s.h5")],
        check=True, env=environment, timeout=300,
    )  # fmt: skip
    with h5py.File(home / "whole.h5") as one, h5py.File(tmp_path / "s.h5") as two:
        for name in store.VARIABLES:
            np.testing.assert_allclose(
                one["trials"][name][()], two["trials"][name][()], rtol=0, atol=1e-9, err_msg=name
            )


def test_parts_may_stay(home, study, tmp_path):
    path = tmp_path / "s.h5"
    assert aj.study.run_study(study, path, chunk=16, keep_parts=True).finished
    assert aj.study.run_study(study, path).ran == 0
    same(home / "whole.h5", path)
    assert aj.study.open_study(path).attrs["finished"]
    parts = sorted(parts_of(path).iterdir())
    assert len(parts) == 16
    parts[3].unlink()
    with pytest.raises(
        aj.InputError, match=r"1 blocks are missing in s\.h5\.parts; put them there, or run the study again"
    ):
        aj.study.open_study(path)
    assert aj.study.run_study(study, path).ran == 15
    same(home / "whole.h5", path)


def test_a_spoilt_block_runs_again(home, study, tmp_path):
    """Whatever the disk did to it: a bit, the middle, the end, all of it."""
    path = tmp_path / "s.h5"
    aj.study.run_study(study, path, chunk=16, watch=interrupted_at(96))
    parts = sorted(parts_of(path).glob("*.h5"))
    assert len(parts) >= 6
    whole = parts[0].read_bytes()
    dataset = h5py.File(parts[0])["estimate"].id.get_chunk_info(0).byte_offset
    spoilt = (
        whole[: dataset + 9] + bytes([whole[dataset + 9] ^ 1]) + whole[dataset + 10 :],
        whole[:2000], whole[:500] + bytes(4000) + whole[4500:], b"",
    )  # fmt: skip
    for part, content in zip(parts, spoilt, strict=False):
        part.write_bytes(content)
    aj.study.run_study(study, path)
    same(home / "whole.h5", path)


def test_reading_needs_no_more_files_than_one(home, study, tmp_path):
    """Where a process may open few files, HDF5 would show the others as not run."""
    path = tmp_path / "s.h5"
    specification = study.specification.model_copy(update={"trials": 40})
    aj.study.run_study(aj.study.Study(specification, study.nominal), path, chunk=1, keep_parts=True)
    program = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_NOFILE, (60, int(sys.argv[2])))\n"
        "import aacmm_jax as aj\n"
        "print(aj.study.study_summary(aj.study.Results.of(sys.argv[1]))['trials_run'])\n"
        "print((aj.study.open_study(sys.argv[1]).converged.values >= 0).sum())\n"
    )
    for hard, said in ((1000, ""), (60, "more files than this process may open (60)")):
        done = subprocess.run(
            [sys.executable, "-c", program, str(path), str(hard)],
            env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert done.stdout.split() == (["160"] if said else ["160", "160"])
        assert said in done.stderr


def test_any_executor(home, study, tmp_path):
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert aj.study.run_study(study, tmp_path / "s.h5", executor=pool, chunk=16).finished
    same(home / "whole.h5", tmp_path / "s.h5")
    with (
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as pool,
        pytest.raises(aj.InputError, match="the executor forks, which JAX does not survive"),
    ):
        aj.study.run_study(study, tmp_path / "t.h5", executor=pool)


def test_dask_workers_that_die_lose_nothing_and_shards_are_the_same(home, study, tmp_path):
    """Two Dask processes, one killed in the middle; blocks come back, or workers write them themselves."""
    with aj.study.dask_executor("local", 2) as (executor, count):
        assert count == 2
        client = executor._client
        processes = client.run(os.getpid)
        killed = []

        def kill(progress):
            if not killed and progress.done >= 32:
                killed.append(next(iter(processes.values())))
                os.kill(killed[0], signal.SIGKILL)

        outcome = aj.study.run_study(study, tmp_path / "s.h5", executor=executor, workers=count, chunk=16, watch=kill)
        assert killed
        assert (outcome.finished, outcome.ran) == (True, 240)
        same(home / "whole.h5", tmp_path / "s.h5")
        assert aj.study.run_study(
            study, tmp_path / "t.h5", executor=executor, workers=count, chunk=16, shards=True
        ).finished
        same(home / "whole.h5", tmp_path / "t.h5")


def test_a_worker_that_fails_stops_the_study_and_keeps_the_rest(study, tmp_path, monkeypatch):
    real = runner.run_block

    def fails(study, block, **options):
        if block.first_cell == 2:
            raise MemoryError("no room")
        return real(study, block, **options)

    monkeypatch.setattr(runner, "run_block", fails)
    with pytest.raises(RuntimeError, match=r"failed on its worker .MemoryError: no room.; finished blocks are kept"):
        aj.study.run_study(study, tmp_path / "s.h5", chunk=16, workers=1)
    assert len(list(parts_of(tmp_path / "s.h5").glob("*.h5"))) == 8
    monkeypatch.setattr(runner, "run_block", real)
    assert aj.study.run_study(study, tmp_path / "s.h5").ran == 120


def test_an_interrupt_of_the_whole_terminal_reaches_no_dask_worker(home, cache, tmp_path):
    """Ctrl-C goes to every process of the terminal."""
    path = tmp_path / "s.h5"
    options = ("--chunk", 4, "--trials", 900, "--dask", "local", "--workers", 1)
    process = command(home, cache, "-o", path, *options, start_new_session=True)
    until_parts(path, 2, process)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "trials are kept. Continue with: aacmm study --resume" in errors
    assert errors.count("\n") == 1, errors


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": -1}, "workers is -1; give a whole number of at least 1"),
        ({"chunk": 2.5}, "chunk is 2.5; give a whole number"),
        ({"executor": "dask"}, "executor is a str; give a concurrent.futures.Executor"),
    ],
    ids=str,
)
def test_strange_arguments_are_refused_before_anything_is_written(study, tmp_path, options, message):
    with pytest.raises(aj.InputError, match=message):
        inspect.unwrap(aj.study.run_study)(study, tmp_path / "s.h5", **options)  # without the types checked in tests
    assert not list(tmp_path.iterdir())


def test_nobody_answers(aacmm_process, home):
    done = aacmm_process("study", home / "spec.toml", "-o", "s.h5", "--dask", "tcp://127.0.0.1:1", expect=2)
    assert done.stderr.count("\n") == 1
    assert "no Dask scheduler answers at tcp://127.0.0.1:1; start one, or use --dask local" in done.stderr

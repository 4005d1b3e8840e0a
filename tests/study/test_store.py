"""A study's file: complete at every moment, continued after any stop, the same however it was run."""

import inspect
import os
import shutil
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.report import write_report
from aacmm_jax.study import runner
from aacmm_jax.study.blocks import VARIABLES, blocks_of
from aacmm_jax.study.store import parts_of

from .small_study import CHUNK, ROOT, begun, command, interrupted_at, same, until_parts, written_in_blocks


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize(
    ("chunk", "trials"),
    [(1, 3), pytest.param(7, 24, marks=pytest.mark.slow), pytest.param(500, 24, marks=pytest.mark.exhaustive)],
)
def test_the_chunk_changes_no_bit(home, study, tmp_path, chunk, trials):
    study = aj.study.Study(study.specification.model_copy(update={"trials": trials}), study.nominal)
    aj.study.run_study(study, tmp_path / "s.h5", chunk=chunk)
    with h5py.File(home / "whole.h5") as whole, h5py.File(tmp_path / "s.h5") as part:
        for name in whole["trials"]:
            if name != "trial":
                cut = (slice(None), slice(trials)) if whole["trials"][name].ndim > 1 else ...
                np.testing.assert_array_equal(whole["trials"][name][cut], part["trials"][name][()], err_msg=name)


def test_blocks_cover_every_trial_once(study):
    for chunk in (1, 7, 16, 60, 100, 125, 10_000):
        seen = np.zeros((len(study.cells), study.trials), dtype=int)
        for block in blocks_of(study, chunk):
            seen[block.slices] += 1
        assert (seen == 1).all()


def test_cells_of_different_settings_share_no_block():
    """Numbers of poses compile to different programs; so do scale anchors."""
    capture = {"positions_mm": [[400, 200, 300]], "poses": [10, 20], "pool": 4096}
    study = aj.study.make_study(
        arm="cheng2018-simulation", trials=10, capture=capture, identification={"hold": ["none", "longest"]}
    )
    assert [block.shape for block in blocks_of(study, 1000)] == [(1, 10)] * 4
    widths = aj.study.make_study(
        arm="cheng2018-simulation",
        trials=10,
        capture=capture,
        noise={"encoder_arcsec": [1, 2, 3]},
        bounds={"length_mm": [1, 2]},
    )
    assert [block.shape for block in blocks_of(widths, 1000)] == [(6, 10)] * 2


@pytest.mark.slow
def test_stopped_is_resumed(home, study, tmp_path):
    """Stopped by its callback: all finished blocks are kept, read while unfinished, and continued."""
    path = tmp_path / "s.h5"

    outcome = aj.study.run_study(study, path, chunk=CHUNK, watch=interrupted_at(48))
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


@pytest.mark.slow
@pytest.mark.usefixtures("read_blocks")
def test_a_second_run_at_the_same_time_is_refused(study, tmp_path):
    refused = []

    def second(_):
        if not refused:
            with pytest.raises(aj.InputError, match=r"s\.h5 is being written by another process; wait until"):
                aj.study.run_study(study, tmp_path / "s.h5")
            refused.append(True)

    assert aj.study.run_study(study, tmp_path / "s.h5", chunk=CHUNK, watch=second).finished
    assert refused
    assert [item.name for item in tmp_path.iterdir()] == ["s.h5"]


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 6}, "s.h5 contains another study .seed differs.; choose another output"),
        ({"trials": 61}, "contains another study .trials differs."),
        ({"chunk": 20}, "was begun with chunks of 16 trials; omit the chunk size"),
        ({"chunk": 0}, "chunk is 0; give a whole number of at least 1"),
        (
            {"version": "9.9"},
            "was begun with aacmm_jax .*, but this process has aacmm_jax 9.9, which can change the results",
        ),
    ],
    ids=str,
)
def test_what_a_file_was_begun_with_stays(study, tmp_path, change, message, monkeypatch):
    path = tmp_path / "s.h5"
    begun(path, study, 16)
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
    with pytest.raises(aj.InputError, match=r"c\.h5 contains a capture; give a study file"):
        aj.study.run_study(study, tmp_path / "c.h5")
    aj.files.load_capture(tmp_path / "c.h5")


@pytest.mark.slow
def test_results_without_their_parts_are_missed(home, study, tmp_path):
    path = tmp_path / "s.h5"
    begun(path, study, 16)
    for use in (aj.study.open_study, lambda path: aj.study.run_study(study, path)):
        path = path.rename(tmp_path / "t.h5")
        with pytest.raises(
            aj.InputError,
            match=r"t\.h5 was renamed, but its results are in s\.h5\.parts; rename the file back to s\.h5",
        ):
            use(path)
        path = path.rename(tmp_path / "s.h5")
    shutil.rmtree(parts_of(path))
    for use in (aj.study.open_study, lambda path: aj.study.run_study(study, path)):
        with pytest.raises(
            aj.InputError,
            match=r"s\.h5 are in the folder s\.h5\.parts, which is missing; put this folder next to the file",
        ):
            use(path)
    with pytest.raises(aj.InputError, match="does not exist"):
        aj.study.open_study(tmp_path / "none.h5")


@pytest.mark.slow
def test_blocks_of_a_study_whose_file_is_gone_are_not_taken_for_anothers(home, study, tmp_path):
    path = tmp_path / "s.h5"
    other = aj.study.Study(study.specification.model_copy(update={"seed": 6}), study.nominal)
    written_in_blocks(home, other, path, CHUNK)
    path.unlink()
    assert aj.study.run_study(study, path, chunk=CHUNK).ran == 96
    same(home / "whole.h5", path)


@pytest.mark.slow
def test_a_moved_and_oddly_named_study_still_reads(home, study, tmp_path):
    """The folder is found next to the file wherever both are moved; percent signs are no patterns."""
    path = tmp_path / "50% of it.h5"
    aj.study.run_study(study, path, chunk=CHUNK, watch=interrupted_at(1))
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for item in (path, parts_of(path)):
        item.rename(moved / item.name)
    assert (aj.study.open_study(moved / path.name).converged.values >= 0).any()
    assert aj.study.run_study(study, moved / path.name).finished
    same(home / "whole.h5", moved / path.name)


@pytest.mark.slow
@pytest.mark.parametrize(
    "computed", [pytest.param(False, marks=pytest.mark.slow), pytest.param(True, marks=pytest.mark.exhaustive)]
)
def test_killed_and_resumed_it_is_the_same(home, tmp_path, prepared, computed):
    """SIGKILL at random moments of the real command, start-up and finishing included."""
    path, generator = tmp_path / "s.h5", np.random.default_rng(1)
    options = {} if computed else prepared(0.03)
    blocks = 12
    for count in np.linspace(1, blocks, 3 if computed else 2).astype(int):
        process = command(home, "-o", path, "--chunk", CHUNK, **options)
        until_parts(path, count, process)
        time.sleep(generator.uniform(0, 0.05))
        process.kill()
        process.communicate()
        if path.exists():
            shown = aj.study.open_study(path)
            assert shown.sizes["trial"] == 24
            shown.close()
    assert aj.study.run_study(aj.study.read_study(home / "spec.toml"), path).finished
    same(home / "whole.h5", path)
    assert {item.name for item in tmp_path.iterdir()} <= {"s.h5", "started"}


@pytest.mark.exhaustive
def test_an_interrupt_finishes_the_blocks_in_work_and_says_how_to_go_on(home, tmp_path):
    path = tmp_path / "s.h5"
    process = command(home, "-o", path, "--chunk", 4, "--trials", 200, "--workers", 1)
    until_parts(path, 3, process)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 130, errors
    kept = len(list(parts_of(path).glob("*.npz")))
    assert kept >= 3
    assert f"Stopped; {4 * kept:,} of 800 trials are saved. Continue with: aacmm study --resume -o {path}" in errors
    assert "Traceback" not in errors
    process = subprocess.Popen(
        [sys.executable, "-m", "aacmm_jax", "study", "--resume", "-o", path, "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    output, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    assert f'"trials_this_run": {800 - 4 * kept}' in output


@pytest.mark.slow
def test_a_full_disk_is_one_sentence_and_loses_nothing(home, tmp_path):
    """A limit on the size of files fails a write as a full disk does: first of a block, then of the file at the end."""
    path = tmp_path / "s.h5"
    limited = (
        "import os, resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2); "
        "os.execv(sys.executable, [sys.executable, '-m', 'aacmm_jax', *sys.argv[2:]])"
    )
    begun(path, aj.study.read_study(home / "spec.toml"), 16)
    for limit, what in (
        (10_000, "cell00000-trial0000000000.npz cannot"),
        ((home / "whole.h5").stat().st_size - 10_000, "s.h5 cannot"),
    ):
        done = subprocess.run(
            [sys.executable, "-c", limited, str(limit), "study", "spec.toml", "-o", str(path), "--workers", "1"],
            cwd=home, env=os.environ | {"PYTHONPATH": str(ROOT), "JAX_ENABLE_COMPILATION_CACHE": "0"},
            capture_output=True, text=True, timeout=600,
        )  # fmt: skip
        assert done.returncode == 2, done.stderr
        assert done.stderr.count("\n") == 1
        assert what in done.stderr
        assert "cannot be written: file too large; free some disk space, then run the same command again" in done.stderr
        aj.study.open_study(path).close()
    process = command(home, "-o", path)
    process.communicate(timeout=600)
    assert process.returncode == 0
    same(home / "whole.h5", path)


PROGRAM = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import aacmm_jax as aj
assert len(jax.devices()) == int(sys.argv[1])
aj.study.run_study(aj.study.read_study(sys.argv[2]), sys.argv[3], chunk=8)
"""


@pytest.mark.exhaustive
def test_the_number_of_devices_changes_nothing(home, tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run(
        [sys.executable, "-c", PROGRAM, "2", str(home / "spec.toml"), str(tmp_path / "s.h5")],
        check=True, env=environment, timeout=600,
    )  # fmt: skip
    with h5py.File(home / "whole.h5") as one, h5py.File(tmp_path / "s.h5") as two:
        for name in VARIABLES:
            np.testing.assert_allclose(
                one["trials"][name][()], two["trials"][name][()], rtol=0, atol=1e-9, err_msg=name
            )


@pytest.mark.slow
def test_results_in_blocks_are_those_in_the_file(home, study, tmp_path):
    path = tmp_path / "s.h5"
    written_in_blocks(home, study, path, CHUNK)
    whole, kept = (aj.study.open_study(file) for file in (home / "whole.h5", path))
    assert not kept.attrs["finished"]
    for name in VARIABLES:
        np.testing.assert_array_equal(whole[name], kept[name], err_msg=name)
        assert whole[name].attrs["units"] == kept[name].attrs["units"]
    parts = sorted(parts_of(path).iterdir())
    assert len(parts) == 12
    before = parts[5].read_bytes()
    with pytest.raises(aj.InputError, match="one of the files that this command reads"):
        write_report(path, parts[5])
    assert parts[5].read_bytes() == before
    parts[3].unlink()
    assert aj.study.run_study(study, path).ran == CHUNK
    same(home / "whole.h5", path)


@pytest.mark.slow
def test_a_spoilt_block_runs_again(home, study, tmp_path):
    """Whatever the disk did to it: a bit, the middle, the end, all of it."""
    path = tmp_path / "s.h5"
    aj.study.run_study(study, path, chunk=CHUNK, watch=interrupted_at(56))
    parts = sorted(parts_of(path).glob("*.npz"))
    assert len(parts) >= 6
    whole = parts[0].read_bytes()
    dataset = whole.index(b"estimate.npy") + 200
    spoilt = (
        whole[: dataset + 9] + bytes([whole[dataset + 9] ^ 1]) + whole[dataset + 10 :],
        whole[:2000], whole[:500] + bytes(4000) + whole[4500:], b"",
    )  # fmt: skip
    for part, content in zip(parts, spoilt, strict=False):
        part.write_bytes(content)
    aj.study.run_study(study, path)
    same(home / "whole.h5", path)


@pytest.mark.slow
@pytest.mark.usefixtures("read_blocks")
def test_a_worker_that_fails_stops_the_study_and_keeps_the_rest(study, tmp_path, monkeypatch):
    real = runner.run_block

    def fails(study, block, **options):
        if block.first_cell == 2:
            raise MemoryError("no room")
        return real(study, block, **options)

    monkeypatch.setattr(runner, "run_block", fails)
    with pytest.raises(RuntimeError, match=r"failed on its worker .MemoryError: no room.; finished blocks are kept"):
        aj.study.run_study(study, tmp_path / "s.h5", chunk=CHUNK, workers=1)
    assert len(list(parts_of(tmp_path / "s.h5").glob("*.npz"))) == 6
    monkeypatch.setattr(runner, "run_block", real)
    assert aj.study.run_study(study, tmp_path / "s.h5").ran == 48


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

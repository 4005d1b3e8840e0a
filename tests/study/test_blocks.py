"""What a study's numbers depend on besides the study is kept, and nothing else continues it."""

import json

import h5py
import jax
import pytest

import aacmm_jax as aj
from aacmm_jax.study import blocks, runner
from aacmm_jax.study.blocks import check_same, computed_with

from .small_study import begun


@pytest.fixture(autouse=True)
def plain(monkeypatch):
    """The environment sets nothing: the tests' own flags are gone."""
    for name in (blocks._FLAGS, *blocks._ENVIRONMENT):
        monkeypatch.delenv(name, raising=False)


FLAGS = {
    "none": ("", ""),
    "order and number": ("--xla_b=2 --xla_a=1 --xla_b=2", "--xla_a=1 --xla_b=2"),
    "harmless": ("--xla_dump_to=x --xla_force_host_platform_device_count=8", ""),
    "a file": ("/flags.txt", "/flags.txt"),
}


@pytest.mark.parametrize("case", FLAGS)
def test_flags_are_a_set(case, monkeypatch):
    given, expected = FLAGS[case]
    monkeypatch.setenv("XLA_FLAGS", given)
    assert json.loads(computed_with()).get("XLA_FLAGS", "") == expected


DIFFERENT = {
    "jax": ({"jax": "0.1"}, r"with jax 0\.1, but this process has jax .*; use the same environment, or choose"),
    "platform": ({"platform": "gpu"}, r"with platform gpu, but this process has platform cpu, "),
    "set then": ({"XLA_FLAGS": "--xla_a=1"}, r"with XLA_FLAGS=--xla_a=1, but this process has no XLA_FLAGS, "),
    "set now": ({"JAX_DISABLE_JIT": None}, r"with no JAX_DISABLE_JIT, but this process has JAX_DISABLE_JIT=True, "),
}


@pytest.mark.parametrize("case", DIFFERENT)
def test_the_difference_is_named(case):
    changes, message = DIFFERENT[case]
    with jax.disable_jit(None in changes.values()):
        begun = json.loads(computed_with()) | changes
        begun = json.dumps({name: value for name, value in begun.items() if value is not None}, sort_keys=True)
        with pytest.raises(aj.InputError, match=f"^s.h5 was begun {message}"):
            check_same(begun, "s.h5", "choose another output path")


@pytest.mark.slow
def test_what_was_begun_otherwise_is_read_but_not_continued(study, tmp_path):
    settings = json.dumps(json.loads(computed_with()) | {"XLA_FLAGS": "--xla_a=1"}, sort_keys=True)
    message = r"s\.h5 was begun with XLA_FLAGS=--xla_a=1, but this process has no XLA_FLAGS"
    stored = begun(tmp_path / "s.h5", study, 16, settings)
    with pytest.raises(aj.InputError, match=message):
        aj.study.run_study(study, tmp_path / "s.h5")
    found = aj.study.Results.of(tmp_path / "s.h5")
    assert (found.finished, found.mark) == (False, stored.mark)


def test_blocks_of_other_settings_are_other_blocks(study, tmp_path, monkeypatch):
    """A study's file was removed, its blocks stayed: they are used again only under the settings of then."""
    here = begun(tmp_path / "s.h5", study)
    monkeypatch.setenv("XLA_FLAGS", "--xla_a=1")
    assert begun(tmp_path / "t.h5", study).mark != here.mark


def test_a_worker_with_other_settings_computes_nothing(study, monkeypatch):
    settings, block = computed_with(), blocks.blocks_of(study, 16)[0]
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Nehalem")
    monkeypatch.setattr(runner, "run_block", lambda *_, **__: pytest.fail("computed"))
    with pytest.raises(
        aj.InputError, match=r"on the worker .*: the study was begun with no OPENBLAS_CORETYPE, but this process"
    ):
        runner._run(study, settings, block, None)


@pytest.mark.slow
def test_the_file_says_what_it_was_computed_with(home):
    with h5py.File(home / "whole.h5") as file:
        kept = json.loads(file.attrs["computed_with"])
    assert {"jax", "jaxlib", "numpy", "scipy", "platform"} <= set(kept)

"""The small study, run once a process."""

from pathlib import Path

import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.study import configuration_pool, runner
from tests.conftest import SLOW

from . import prepared_blocks
from .small_study import CHUNK, SPECIFICATION


@pytest.fixture(scope="session", autouse=True)
def pools_built_once():
    """Studies of one arm, seed and fixture have the same pool (`test_pools_are_the_same_in_every_study_of_a_seed`)."""
    build, built = configuration_pool._fixture_table, {}

    def built_once(study, *fixture):
        arm = tuple(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(study.nominal.arm))
        key = arm, study.specification.seed, *fixture
        if key not in built:
            built[key] = build(study, *fixture)
        return built[key]

    built_once.cache_clear = build.cache_clear
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(configuration_pool, "_fixture_table", built_once)
        yield build


@pytest.fixture(scope="session")
def begun_home(tmp_path_factory) -> Path:
    """A folder with the specification."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "spec.toml").write_text(SPECIFICATION)
    return folder


@pytest.fixture(scope="session", params=SLOW)
def home(begun_home) -> Path:
    """The same with the study run through at once."""
    study = aj.study.read_study(begun_home / "spec.toml")
    assert aj.study.run_study(study, begun_home / "whole.h5", chunk=CHUNK).finished
    return begun_home


@pytest.fixture
def study(begun_home):
    return aj.study.read_study(begun_home / "spec.toml")


@pytest.fixture
def prepared(home, tmp_path):
    """Options of `small_study.command`: blocks that take so many seconds and are read instead of computed."""

    def options(seconds: float) -> dict:
        environment = {"WHOLE": home / "whole.h5", "SECONDS": seconds, "STARTED": tmp_path / "started"}
        program = (str(Path(__file__).with_name("prepared_blocks.py")),)
        return {"program": program, "env": {name: str(value) for name, value in environment.items()}}

    return options


@pytest.fixture
def read_blocks(home, monkeypatch):
    """Blocks are read from the finished study, where what is tested is how they are kept."""
    for name, value in {"WHOLE": home / "whole.h5", "SECONDS": 0, "STARTED": home / "started"}.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(runner, "run_block", prepared_blocks.prepared)

"""The small study, run once a process."""

from pathlib import Path

import pytest

import aacmm_jax as aj

from .small_study import CHUNK, SPECIFICATION


@pytest.fixture(scope="session")
def home(tmp_path_factory) -> Path:
    """A folder with the specification, and the study run through at once."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "spec.toml").write_text(SPECIFICATION)
    outcome = aj.study.run_study(aj.study.read_study(folder / "spec.toml"), folder / "whole.h5", chunk=CHUNK)
    assert outcome.finished
    return folder


@pytest.fixture
def study(home):
    return aj.study.read_study(home / "spec.toml")


@pytest.fixture
def prepared(home, tmp_path):
    """Options of `small_study.command`: blocks that take so many seconds and are read instead of computed."""

    def options(seconds: float) -> dict:
        environment = {"WHOLE": home / "whole.h5", "SECONDS": seconds, "STARTED": tmp_path / "started"}
        program = (str(Path(__file__).with_name("prepared_blocks.py")),)
        return {"program": program, "env": {name: str(value) for name, value in environment.items()}}

    return options

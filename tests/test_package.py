"""The package as it is imported: names that are loaded late, shapes checked in every module, a readable description."""

import importlib
import importlib.util
import os
import pickle
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import aacmm_jax as aj

ROOT = Path(__file__).resolve().parents[1]


def test_an_unknown_name_is_an_attribute_error():
    assert set(aj.__all__) <= set(dir(aj))
    assert pickle.loads(pickle.dumps(aj.load_arm)) is aj.load_arm
    with pytest.raises(AttributeError, match=r"attribute '?lod_arm"):
        aj.lod_arm  # noqa: B018


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        "from aacmm_jax import *; print(load_arm('panda').joints)",
        "import aacmm_jax; print(aacmm_jax.files.load_arm('panda').joints)",
    ],
)
def test_late_names_in_a_fresh_process(line):
    done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout) == (0, "7\n"), done.stderr


def test_every_module_is_checked_at_run_time():
    """The hook of ``conftest.py`` checks the types of every module, whenever it is imported."""
    without_dask = importlib.util.find_spec("distributed") is None
    for info in pkgutil.walk_packages(aj.__path__, "aacmm_jax."):
        needs_dask = info.name.rpartition(".")[2].startswith("dask")
        if info.name != "aacmm_jax.__main__" and not (needs_dask and without_dask):
            loader = importlib.import_module(info.name).__spec__.loader
            assert type(loader).__name__ == "_JaxtypingLoader", info.name


LATE = """
import sys
import tests.conftest  # as pytest does, before anything else
import aacmm_jax as aj, jax.numpy as jnp, jaxtyping, numpy as np

assert "aacmm_jax.model.sockets" not in sys.modules
measured = aj.model.repeatability
assert "aacmm_jax.model.sockets" in sys.modules
assert float(measured(jnp.zeros((4, 3)), (4,)).de) == 0.0
try:
    sys.modules["aacmm_jax.model.sockets"].pose_outliers(np.zeros((4, 2)), (4,))
except jaxtyping.TypeCheckError:
    print("caught")
"""


@pytest.mark.slow
def test_a_wrong_shape_is_caught_in_a_module_that_is_imported_late():
    environment = os.environ | {"AACMM_TYPES": "1"}
    command = [sys.executable, "-c", LATE]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout) == (0, "caught\n"), done.stderr


@pytest.mark.parametrize("link", ["docs/start.md", "docs/demo.png"])
def test_the_description_on_an_index_has_no_relative_links(link):
    """It is the README, whose links to files and images become paths in the source distribution."""
    readme = (ROOT / "README.md").read_text()
    assert f"]({link})" in readme
    hook = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]["hooks"][
        "fancy-pypi-readme"
    ]
    for substitution in hook["substitutions"]:
        readme = re.sub(substitution["pattern"], substitution["replacement"], readme)
    assert all(target.startswith("https://") for target in re.findall(r"\]\(([^)]*)\)", readme))
    assert f"`{link}`" in readme

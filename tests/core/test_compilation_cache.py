"""Compiled programs are kept in the user's own folder, from Python as from the command line."""

import os
import stat
import subprocess
import sys

import pytest

PRINT = "print(jax.config.jax_compilation_cache_dir, jax.config.jax_enable_x64)"


@pytest.mark.parametrize("imports", ["import aacmm_jax, jax", "import jax, aacmm_jax"])
@pytest.mark.parametrize(
    ("settings", "mode", "expected"),
    [
        ({}, None, "{home}/aacmm_jax True"),
        ({}, 0o700, "{home}/aacmm_jax True"),
        ({}, 0o777, "None True"),  # anybody could put a program there
        ({"AACMM_JAX_CACHE": "0"}, None, "None True"),
        ({"JAX_COMPILATION_CACHE_DIR": "/elsewhere"}, None, "/elsewhere True"),
    ],
)
def test_folder(tmp_path, imports, settings, mode, expected):
    folder = tmp_path / "aacmm_jax"
    if mode is not None:
        folder.mkdir()
        folder.chmod(mode)
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment = inherited | {"XDG_CACHE_HOME": str(tmp_path)} | settings
    done = subprocess.run(
        [sys.executable, "-c", f"{imports}; {PRINT}"], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == expected.format(home=tmp_path)
    if mode is None and not settings:
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700

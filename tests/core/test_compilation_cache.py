"""Compiled programs are kept in a folder that nobody else can write to, and damaged ones are replaced."""

import os
import stat
import subprocess
import sys
import zlib
from types import SimpleNamespace

import pytest

from aacmm_jax.core.jax_setup import _remove_damaged, _unsafe

JAX = "print(jax.config.jax_compilation_cache_dir, jax.config.jax_enable_x64)"
IMPORTS = {
    "aacmm_jax, jax": f"import aacmm_jax, jax; {JAX}",
    "jax, aacmm_jax": f"import jax, aacmm_jax; {JAX}",
    # What JAX would read, without waiting a second for its import.
    "aacmm_jax": "import aacmm_jax; from os import environ as at; "
    "print(at.get('JAX_COMPILATION_CACHE_DIR'), at['JAX_ENABLE_X64'])",
}
COMPILE = """
import jax, jax.numpy as jnp
from aacmm_jax.core import numpy_or_jax
print(float(jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))(jnp.arange(9.0))))
"""


def python(program, folder, *before, **settings):
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XDG_"))}
    environment = inherited | {"XDG_CACHE_HOME": str(folder)} | settings
    command = [*before, sys.executable, "-c", program]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)


FOLDERS = {
    "default": ({}, "{home}/aacmm_jax True"),
    "left alone": ({"AACMM_JAX_CACHE": "0"}, "None True"),
    "left alone, JAX's own": ({"AACMM_JAX_CACHE": "0", "JAX_COMPILATION_CACHE_DIR": "/elsewhere"}, "/elsewhere True"),
    "JAX's own": ({"JAX_COMPILATION_CACHE_DIR": "{home}/other"}, "{home}/other True"),
    "bucket": ({"JAX_COMPILATION_CACHE_DIR": "gs://bucket/x"}, "gs://bucket/x True"),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "imports"),
    [
        *((case, "aacmm_jax") for case in FOLDERS),
        *(
            pytest.param(case, imports, marks=pytest.mark.slow)
            for case in FOLDERS
            for imports in ("aacmm_jax, jax", "jax, aacmm_jax")
        ),
    ],
)
def test_folder(tmp_path, case, imports):
    settings, expected = FOLDERS[case]
    settings = {name: value.format(home=tmp_path) for name, value in settings.items()}
    done = python(IMPORTS[imports], tmp_path, **settings)
    found = done.stdout.strip().removesuffix(" 1") + " True" * (imports == "aacmm_jax")
    assert (found, done.stderr) == (expected.format(home=tmp_path), "")
    for folder in tmp_path.iterdir():
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "above", "settings", "reason"),
    [
        (0o777, 0o700, {}, "other users may write to it (mode 0777)"),
        (0o720, 0o700, {}, "other users may write to it (mode 0720)"),
        (0o700, 0o777, {}, "(mode 0777)"),
        (0o777, 0o700, {"JAX_COMPILATION_CACHE_DIR": "{home}/aacmm_jax"}, "other users may write to it (mode 0777)"),
        (0o700, 0o700, {"XDG_CACHE_HOME": "."}, "its path is relative"),
        (0o700, 0o700, {"XDG_CACHE_HOME": "", "HOME": "."}, "its path is relative"),
        (0o700, 0o700, {"JAX_COMPILATION_CACHE_DIR": "aacmm_jax"}, "its path is relative"),
    ],
    ids=[
        "mode",
        "mode for the group",
        "mode above",
        "JAX's own",
        "relative XDG",
        "relative HOME",
        "JAX's own relative",
    ],
)
def test_a_folder_of_others_is_not_used(tmp_path, mode, above, settings, reason):
    """One sentence says so; processes that are started from this one do not use it either."""
    folder = tmp_path / "aacmm_jax"
    folder.mkdir()
    folder.chmod(mode)
    tmp_path.chmod(above)
    settings = {name: value.format(home=tmp_path) for name, value in settings.items()}
    imports = "jax, aacmm_jax" if mode == 0o720 else "aacmm_jax"
    kept = "import os; print(os.environ.get('JAX_COMPILATION_CACHE_DIR'), os.environ['AACMM_JAX_CACHE'])"
    done = python(f"{IMPORTS[imports]}; {kept}", tmp_path, **settings)
    assert done.stdout.split() == ["None", "True" if mode == 0o720 else "1", "None", "0"]
    assert done.stderr.count("\n") == 1
    assert "is not used, because" in done.stderr
    assert reason in done.stderr


root = pytest.mark.skipif(
    not hasattr(os, "getuid") or os.getuid() != 0, reason="only the superuser can act for two users"
)
# What is done to the cache's folder and the entry in it, and why it is not used then.
PLANTED = {
    "folder": (lambda folder, entry: os.chown(folder, 65534, 65534), "it belongs to another user"),
    "entry": (
        lambda folder, entry: os.chown(entry, 65534, 65534),
        "other users may have written x-cache in this folder",
    ),
    "open entry": (
        lambda folder, entry: (folder.chmod(0o755), entry.chmod(0o666)),
        "other users may have written x-cache in this folder",
    ),
    "open entry that nobody else reaches": (lambda folder, entry: entry.chmod(0o666), ""),
    "link": (
        lambda folder, entry: entry.with_name("y-cache").symlink_to(entry),
        "other users may have written y-cache in this folder",
    ),
    "group above": (
        lambda folder, entry: (os.chown(folder.parent, 0, 65534), folder.parent.chmod(0o770)),
        "other users may write to {above} (mode 0770)",
    ),
    "private group above": (lambda folder, entry: folder.parent.chmod(0o770), ""),
}


@pytest.mark.slow
@root
@pytest.mark.parametrize("case", PLANTED)
def test_what_another_user_can_have_written_is_not_used(tmp_path, case):
    plant, reason = PLANTED[case]
    folder, entry = tmp_path / "aacmm_jax", tmp_path / "aacmm_jax" / "x-cache"
    folder.mkdir(mode=0o700)
    entry.touch(mode=0o600)
    plant(folder, entry)
    assert reason.format(above=tmp_path) in _unsafe(folder)
    assert bool(reason) == bool(_unsafe(folder))


@pytest.mark.slow
def test_a_truncated_program_is_replaced(tmp_path):
    """It is compiled again without a warning, and the next process reads it."""
    settings = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    first = python(COMPILE, tmp_path, **settings)
    entries = {path: path.read_bytes() for path in (tmp_path / "aacmm_jax").glob("*-cache")}
    assert entries
    for path, content in entries.items():
        path.write_bytes(content[: len(content) // 2])
    second = python(COMPILE, tmp_path, **settings)
    assert (second.stdout, second.stderr) == (first.stdout, "")
    for path, content in entries.items():
        assert len(path.read_bytes()) > len(content) // 2


def test_entries_are_read_once(tmp_path):
    """What was written since the last check is read: whole entries stay, cut ones go, and what is no entry stays."""
    whole = zlib.compress(bytes(range(256)) * 40)
    contents = {"a-cache": whole, "b-cache": whole[:-1], "c-cache": b"", "d-cache": b"another form", "e-other": b""}

    def left():
        _remove_damaged(tmp_path)
        return sorted(path.name for path in tmp_path.iterdir())

    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    assert left() == ["a-cache", "checked", "d-cache", "e-other"]
    before = (tmp_path / "checked").stat().st_mtime_ns
    (tmp_path / "a-cache").write_bytes(b"")
    for time, expected in ((before, ["a-cache", "checked"]), (before + 1, ["checked"])):
        os.utime(tmp_path / "a-cache", ns=(time, time))
        assert left()[: len(expected)] == expected
    assert left() == ["checked", "d-cache", "e-other"]


def test_a_process_with_zstandard_tells_its_entries(tmp_path, monkeypatch):
    class ZstdError(Exception):
        pass

    def decompress(content):
        if content != b"whole":
            raise ZstdError

    monkeypatch.setitem(sys.modules, "zstandard", SimpleNamespace(decompress=decompress, ZstdError=ZstdError))
    for name, content in {"a-cache": b"whole", "b-cache": b"who"}.items():
        (tmp_path / name).write_bytes(content)
    _remove_damaged(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a-cache", "checked"]


@pytest.mark.slow
def test_no_function_of_jax_is_replaced():
    """Whatever of the package is imported, JAX's own modules keep their own functions."""
    program = """
import importlib, pkgutil, sys, types
import aacmm_jax
for module in pkgutil.walk_packages(aacmm_jax.__path__, "aacmm_jax."):
    if "__main__" not in module.name:
        importlib.import_module(module.name)
for name, module in list(sys.modules.items()):
    if name.split(".")[0] in {"jax", "equinox", "optimistix", "lineax"}:
        for key, value in vars(module).items():
            if isinstance(value, types.FunctionType) and value.__module__.startswith("aacmm_jax"):
                print(name, key)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == ""

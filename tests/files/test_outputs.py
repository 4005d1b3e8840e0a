"""Files written whole or not at all: what is written through a link, and what is no ordinary file."""

import os

import pytest

from aacmm_jax.files.outputs import as_path, write_text
from tests.refusals import assert_refused


@pytest.mark.parametrize("exists", [True, False], ids=["of a file", "of nothing"])
def test_a_link_is_followed(tmp_path, exists):
    (tmp_path / "folder").mkdir()
    target, link = tmp_path / "folder" / "target.txt", tmp_path / "link.txt"
    if exists:
        target.write_text("before")
    link.symlink_to(target)
    write_text(link, "after")
    assert link.is_symlink()
    assert target.read_text() == "after"
    assert os.listdir(tmp_path / "folder") == ["target.txt"]


def test_what_is_no_ordinary_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("fifo")
    (tmp_path / "loop").symlink_to("loop")
    reading, writing = os.pipe()
    try:
        for name in ("fifo", "link", "loop", f"/proc/self/fd/{writing}"):
            assert_refused(lambda name=name: write_text(tmp_path / name, ""), f"{name} cannot be written", "ordinary")
    finally:
        os.close(reading)
        os.close(writing)
    assert_refused(lambda: write_text(tmp_path, ""), "it is a folder")
    assert sorted(os.listdir(tmp_path)) == ["fifo", "link", "loop"]


@pytest.mark.parametrize("path", [2.5, 1, [1.0], b"arm.toml", None], ids=repr)
def test_what_is_no_path_is_refused(path):
    """A number would name an open file, such as standard output."""
    assert_refused(lambda: as_path(path), f"the path of a file is of type {type(path).__name__}", "as text")

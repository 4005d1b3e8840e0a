"""Whose blocks are believed: the user's own, and of a study that is read those of its owner."""

import os
import shutil

import pytest

import aacmm_jax as aj
from aacmm_jax.core.file_owners import keeps_owners
from aacmm_jax.study.store import check_owners, parts_of

from .small_study import begun, written_in_blocks

OTHER = 65534
root = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only the superuser can act for two users"
)


def give(*paths):
    for path in paths:
        os.chown(path, OTHER, OTHER, follow_symlinks=False)


def link_folder(path):
    parts_of(path).rename(path.parent / "elsewhere")
    parts_of(path).symlink_to(path.parent / "elsewhere")


def link_block(path):
    block = min(parts_of(path).iterdir())
    block.rename(path.parent / "elsewhere.h5")
    block.symlink_to(path.parent / "elsewhere.h5")


def colleague(path):
    give(path, parts_of(path), *parts_of(path).iterdir())


FOLDER = r"s\.h5\.parts belongs to nobody, "
BLOCK = r"cell.*\.npz belongs to nobody, who is not the owner of its folder, so the block is not read; remove the file"
OURS = ("a link to a folder", "a link to a block", "an open folder")  # which need no second user
# What is done to a study of the user with blocks, and how running it and reading it is refused; None: it is not.
PLANTED = {
    "a link to a folder": (link_folder, *[r"s\.h5\.parts is a link, so the blocks in it are not read"] * 2),
    "a link to a block": (link_block, *[r"cell.*\.npz is a link, so the block is not read; remove the file"] * 2),
    "an open folder": (
        lambda path: parts_of(path).chmod(0o777),
        *[r"other users may write to .*s\.h5\.parts \(mode 0777\), .* yours, run chmod go-w '.*\.parts'"] * 2,
    ),
    "a folder": (
        lambda path: give(parts_of(path)),
        FOLDER + r"so the study is not continued; choose another output path",
        FOLDER + r"but s\.h5 belongs to root, so the blocks are not read; make one user the owner of both",
    ),
    "a block": (lambda path: give(min(parts_of(path).iterdir())), BLOCK, BLOCK),
    "a colleague's": (colleague, r"s\.h5 belongs to nobody, so the study is not continued", None),
}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("case", [case if case in OURS else pytest.param(case, marks=root) for case in PLANTED])
def test_what_others_could_have_written_is_refused(case, home, study, tmp_path):
    plant, running, reading = PLANTED[case]
    path = tmp_path / "s.h5"
    written_in_blocks(home, study, path, 16)
    plant(path)
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(aj.InputError, match=running):
        aj.study.run_study(study, path)
    assert sorted(os.listdir(tmp_path)) == before
    if reading is None:
        aj.study.Results.of(path)
        return
    for read in (aj.study.Results.of, aj.study.open_study):
        with pytest.raises(aj.InputError, match=reading):
            read(path)


@pytest.mark.parametrize("umask", [0o022, 0o077, 0])
def test_nobody_else_may_write_into_a_new_folder(study, tmp_path, umask):
    former = os.umask(umask)
    try:
        begun(tmp_path / "s.h5", study)
    finally:
        os.umask(former)
    assert parts_of(tmp_path / "s.h5").stat().st_mode & 0o777 == 0o755 & ~umask


@pytest.mark.slow
def test_nobody_else_may_change_a_block(home, study, tmp_path):
    former = os.umask(0)
    try:
        written_in_blocks(home, study, tmp_path / "s.h5", 16)
    finally:
        os.umask(former)
    assert {block.stat().st_mode & 0o777 for block in parts_of(tmp_path / "s.h5").iterdir()} == {0o644}


@pytest.mark.slow
def test_a_file_system_without_owners_is_a_warning(home, study, tmp_path, monkeypatch):
    """As shares and drives of other systems, which show all files alike."""
    path = tmp_path / "s.h5"
    written_in_blocks(home, study, path, 16)
    parts_of(path).chmod(0o777)
    monkeypatch.setattr("aacmm_jax.study.store.keeps_owners", lambda folder: False)
    with pytest.warns(UserWarning, match="does not record who owns a file"):
        check_owners(path)
    with pytest.warns(UserWarning, match="does not record who owns a file"):
        aj.study.Results.of(path)


def test_this_file_system_keeps_owners(tmp_path):
    assert keeps_owners(tmp_path)


@root
def test_a_folder_that_another_user_made_first_is_left_as_it_is(study, tmp_path):
    parts = parts_of(tmp_path / "s.h5")
    parts.mkdir()
    (parts / "old.npz").touch()
    give(parts)
    for check in (check_owners, lambda path: begun(path, study)):
        with pytest.raises(aj.InputError, match=r"s\.h5\.parts belongs to nobody"):
            check(tmp_path / "s.h5")
    assert os.listdir(parts) == ["old.npz"]


def test_without_a_folder_there_is_nothing_to_check(tmp_path):
    (tmp_path / "s.h5").touch()
    check_owners(tmp_path / "s.h5")
    check_owners(tmp_path / "s.h5", reading=True)
    shutil.rmtree(tmp_path)

"""The digest of a file's content, and what of HDF5 is not read: links, other files, arrays larger than the file."""

import os
import shutil
import sys

import h5py
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files import hdf5, hdf5_content, reader_process
from aacmm_jax.files.hdf5 import Table, Variable, columns, read_summary, read_tables, write_tables
from aacmm_jax.files.inputs import LARGEST_FILE, InputFile, fingerprint
from tests.refusals import assert_refused

KIND = ("capture",)
TABLES = {
    "t": Table(
        columns("row", x=(np.linspace(0, 1, 2000), "mm", "position"), name=(["é"] * 2000, "", "name")),
        {"note": "text", "pair": [1.0, 2.0]},
    )
}


@pytest.fixture
def path(tmp_path):
    """A file with a table, an attribute of each type and a summary."""
    write_tables(tmp_path / "f.h5", "capture", TABLES, {"scale": 2.0, "names": ["a", "b"]}, summary={"n": 1})
    return tmp_path / "f.h5"


def changed(path, change):
    with h5py.File(path, "a") as file:
        change(file)
    return path


def resealed(path):
    with open(path, "rb+") as file:
        hdf5_content.seal(file)


def set_value(name, index, value):
    def change(file):
        file[name][index] = value

    return change


CHANGES = {
    "value": set_value("t/x", 3, 7.0),
    "text": set_value("t/name", 3, "e"),
    "summary": set_value("summary", (), '{"n": 2}'),
    "attribute": lambda file: file.attrs.modify("scale", 3.0),
    "type of an attribute": lambda file: file.attrs.create("scale", 2.0, dtype="f4"),
    "attribute of a table": lambda file: file["t"].attrs.modify("note", "Text"),
    "unit": lambda file: file["t/x"].attrs.modify("units", "m"),
    "attribute added": lambda file: file.attrs.modify("more", 1),
    "attribute removed": lambda file: file.attrs.pop("scale"),
    "table removed": lambda file: file.pop("t"),
    "table added": lambda file: file.create_group("true_arm"),
    "array renamed": lambda file: file.move("t/x", "t/y"),
    "no scale": lambda file: file["t/x"].dims[0].detach_scale(file["t/row"]),
    "kind": lambda file: file.attrs.modify("seed", 4),
}


@pytest.mark.first_rows(13)
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_changed_content_is_refused(path, change):
    changed(path, change)
    for read in (read_tables, read_summary):
        assert_refused(lambda read=read: read(path, KIND), path, "changed by another program", "create it again")


def test_files_of_other_versions_are_refused_by_name(path):
    for version, words in {5: "format version 5, older", 7: "format version 7, newer", 0: "0", 1.0: "1.0"}.items():
        changed(path, lambda file, version=version: file.attrs.create("format_version", version))
        resealed(path)
        assert_refused(lambda: read_tables(path, KIND), path, "format version", words)


def link_to(kind):
    def change(file):
        del file["t/x"]
        file["t/x"] = h5py.ExternalLink("other.h5", "/x") if kind == "external" else h5py.SoftLink("/t/row")

    return change


def external_storage(file):
    del file["t/x"]
    file["t"].create_dataset("x", (3,), "u1", external=[("/etc/passwd", 0, 3)])


def virtual(file):
    del file["t/x"]
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "x", (3,))
    file["t"].create_virtual_dataset("x", layout)


def replaced(*arguments, **keywords):
    def change(file):
        del file["t/x"]
        file["t"].create_dataset("x", *arguments, **keywords)

    return change


HOSTILE = {
    "external link": (link_to("external"), "a link to something else"),
    "soft link": (link_to("soft"), "a link to something else"),
    "external storage": (external_storage, "stored in another file"),
    "virtual": (virtual, "stored in another file"),
    "nothing stored": (replaced((2**33,), "f8"), "far more than the file can contain"),
    "nothing stored, chunks": (replaced((2**17, 2**16), "f8", chunks=(2, 2**16)), "far more than the file can contain"),
    "compressed": (
        replaced(data=np.zeros(2**21), compression="gzip", chunks=(2**21,)),
        "far more than the file can contain",
    ),
    "compound": (replaced((3,), [("a", "f8"), ("b", "i4")]), "of a type that does not occur in files of aacmm"),
    "reference": (replaced((3,), h5py.ref_dtype), "of a type that does not occur in files of aacmm"),
    "lists": (replaced((3,), h5py.vlen_dtype("f8")), "of a type that does not occur in files of aacmm"),
    "texts": (replaced(data=[["a", "b"]], dtype=h5py.string_dtype()), "an array of texts with more than one dimension"),
    "group": (lambda file: (file.pop("t/x"), file.create_group("t/x")), "is not an array"),
    "itself": (lambda file: file.__setitem__("t/t", file["t"]), "is not an array"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("change", "part"), HOSTILE.values(), ids=HOSTILE.keys())
def test_nothing_leads_out_of_a_file(path, change, part, monkeypatch):
    """Whoever makes such a file on purpose can seal it, too."""
    if part.startswith("far more"):  # 16 MB of zeros are written sooner than 256; in this process
        monkeypatch.setattr(hdf5_content, "_ALWAYS_READ", 2**20)
        monkeypatch.setattr(sys, "executable", "")
    changed(path, change)
    resealed(path)
    assert_refused(lambda: read_tables(path, KIND), path, part, "give a file written by aacmm")


@pytest.mark.slow
def test_many_texts_that_are_one(path, monkeypatch):
    """Text is counted while it is read: a thousand elements may refer to the same long text."""
    write_tables(path, "capture", {"t": Table(columns("row", name=(["é" * 40] * 2000, "", "name")))}, {})
    monkeypatch.setattr(hdf5_content, "_ALWAYS_READ", 49_000 - 100 * path.stat().st_size)
    monkeypatch.setattr(sys, "executable", "")
    monkeypatch.setattr(reader_process, "_vouched_for", set())
    assert_refused(lambda: read_tables(path, KIND), path, "'name' is an array of 2000", "far more than the file")


def test_large_files_are_read_in_parts(path, monkeypatch):
    before = read_tables(path, KIND)
    monkeypatch.setattr(hdf5, "_IN_MEMORY", 100)
    after = read_tables(path, KIND)
    np.testing.assert_array_equal(after.tables["t"]["x"], before.tables["t"]["x"])
    content = bytearray(path.read_bytes())
    content[content.index(b"mm")] ^= 1
    path.write_bytes(content)
    assert_refused(lambda: read_tables(path, KIND), path, "create it again")


def test_only_ordinary_files_of_limited_size(path, tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name in (tmp_path / "fifo", tmp_path / "link", "/dev/zero"):
        for read in (InputFile, fingerprint, aj.files.load_capture, aj.files.read_manifest):
            assert_refused(lambda name=name, read=read: read(name), name, "a pipe or a device", "give an ordinary file")
    with open(tmp_path / "long", "wb") as file:
        file.truncate(3 * 2**20)
    monkeypatch.setenv(LARGEST_FILE, "2")
    assert_refused(lambda: InputFile(tmp_path / "long"), "has 3 MiB, more than the limit of 2 MiB", LARGEST_FILE)
    assert_refused(lambda: aj.files.load_capture(tmp_path / "long"), LARGEST_FILE)
    for wrong in ("much", "0", "-1", ""):
        monkeypatch.setenv(LARGEST_FILE, wrong)
        assert_refused(lambda: InputFile(path), LARGEST_FILE, "give a whole number of MiB")


def test_the_fingerprint_is_of_what_was_read(path, tmp_path):
    """Also where the file changes meanwhile."""
    before, read = fingerprint(path), InputFile(path)
    table = {"t": Table({"row": Variable(("row",), np.arange(3), "1", "row number")})}
    write_tables(tmp_path / "new.h5", "capture", table, {"scale": 1.0})
    shutil.move(tmp_path / "new.h5", path)
    assert read_tables(read, KIND).attributes["scale"] == 2.0
    assert fingerprint(read) == before != fingerprint(path)


def test_a_damaged_file_is_not_given_to_hdf5(path, monkeypatch):
    """Damaged metadata of virtual arrays crashed the HDF5 library, and the process with it."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    monkeypatch.setattr(h5py, "File", None)
    assert_refused(lambda: read_tables(path, KIND), path, "does not match its SHA-256; create it again.")

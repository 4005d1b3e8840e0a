"""What a command writes: never a file that it reads, all files or none, with the permissions of what they replace."""

import contextlib
import os
import re
import stat
import subprocess
import sys

import h5py
import pytest

import aacmm_jax as aj
from aacmm_jax.data.recording import Recording
from aacmm_jax.files import outputs
from aacmm_jax.files.arms import specification_toml
from aacmm_jax.files.hdf5_content import seal
from aacmm_jax.files.outputs import asking
from tests.conftest import EXAMPLES
from tests.refusals import assert_refused

POINTS = '[points]\nunit = "mm"\n[[socket]]\nfile = "PA.csv"\n'
MANIFEST = 'arm = "arm.toml"\n[angles]\nunit = "rad"\n[[socket]]\nname = "{h}"\nfile = "{h}.csv"\n'
STUDY = 'arm = "arm.toml"\ntrials = 1\n[capture]\nfile = "c.h5"\n'


@pytest.fixture
def inputs(tmp_path, paper_capture):
    """One file of every kind that a command reads."""
    arm = aj.files.load_specification("cheng2018-simulation")
    for name in ("arm.toml", "other.toml"):
        (tmp_path / name).write_text(specification_toml(arm))
    (tmp_path / "A.csv").write_text("0.1,0.2,0.3,0.4,0.5,0.6\n0.2,0.3,0.4,0.5,0.6,0.7\n")
    (tmp_path / "PA.csv").write_text("100.0,0.5,0.25\n100.5,0.5,0.5\n100.5,0.25,0.125\n")
    (tmp_path / "m.toml").write_text(MANIFEST)
    (tmp_path / "p.toml").write_text(POINTS)
    (tmp_path / "lab.toml").write_text('[laboratory]\nname = "L"\n')
    (tmp_path / "study.toml").write_text(STUDY)
    recording = Recording(paper_capture, arm)
    aj.files.save_capture(tmp_path / "c.h5", recording)
    (tmp_path / "link.csv").symlink_to("A.csv")
    os.link(tmp_path / "arm.toml", tmp_path / "same.toml")
    return tmp_path


@pytest.fixture
def calibrated(inputs, aacmm):
    """And a calibration."""
    aacmm("calibrate", "c.h5", "-o", "y.h5")
    return inputs


def content(folder):
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


SIMULATE = ("simulate", "arm.toml", "--socket", "A=400,200,300", "--poses", 2)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    "command",
    [
        ("import", "m.toml", "-o", "m.toml"),
        ("import", "m.toml", "-o", "A.csv"),
        ("import", "m.toml", "-o", "link.csv"),
        ("import", "m.toml", "-o", "arm.toml"),
        ("import", "m.toml", "-o", "same.toml"),
        (*SIMULATE, "-o", "arm.toml"),
        (*SIMULATE, "-o", "./../{folder}/arm.toml"),
        (*SIMULATE, "--true-arm", "other.toml", "-o", "other.toml"),
        ("calibrate", "c.h5", "-o", "c.h5"),
        ("evaluate", "p.toml", "-o", "p.toml"),
        ("evaluate", "p.toml", "-o", "PA.csv"),
        ("evaluate", "c.h5", "c.h5", "-o", "c.h5"),
        ("report", "c.h5", "-o", "c.h5"),
        ("report", "c.h5", "--about", "lab.toml", "-o", "lab.toml"),
        ("export", "c.h5", "-o", "c.h5"),
        ("plan", "arm.toml", "-o", "arm.toml"),
        ("plan", "arm.toml", "-o", "plan.csv", "--acceptance", "iso", "--manifest", "arm.toml"),
        ("compare", "c.h5", "c.h5", "--csv", "c.h5"),
        ("study", "study.toml", "-o", "study.toml"),
        ("study", "study.toml", "-o", "arm.toml"),
        ("study", "study.toml", "-o", "c.h5"),
    ],
    ids=lambda command: " ".join(map(str, command)),
)
def test_an_input_is_no_output(aacmm, inputs, command):
    before = content(inputs)
    done = aacmm(*(str(part).format(folder=inputs.name) for part in command), expect=2)
    assert re.search("is one of the files that this command reads;", done.stderr)
    assert content(inputs) == before


@pytest.mark.slow
def test_one_path_is_not_two_outputs(aacmm, inputs):
    before = content(inputs)
    for first, second in (("x.png", "./x.png"), ("x.png", "link.png")):
        (inputs / "link.png").unlink(missing_ok=True)
        (inputs / "link.png").symlink_to("x.png")
        done = aacmm("calibrate", "c.h5", "-o", first, "--figure", second, expect=2)
        assert "is given for two outputs" in done.stderr
    assert content(inputs) == before


@pytest.mark.slow
def test_demo_leaves_other_files_alone(aacmm, inputs):
    """Neither a folder of other files, nor one that holds a capture of the same name."""
    before = content(inputs)
    assert "contains files that aacmm demo did not write (A.csv" in aacmm("demo", ".", expect=2).stderr
    (inputs / "own").mkdir()
    (inputs / "c.h5").rename(inputs / "own" / "capture.h5")
    assert "aacmm demo did not write (capture.h5)" in aacmm("demo", "own", expect=2).stderr
    assert sorted(content(inputs).values()) == sorted(before.values())


FOREIGN = b"a,b\n1,2\n"


def replaced(path, old: bytes, new: bytes) -> bool:
    path.write_bytes(old)
    with asking(), contextlib.suppress(aj.InputError), outputs.write_atomically(path) as temporary:
        temporary.write_bytes(new)
    return path.read_bytes() == new


@pytest.mark.parametrize(
    ("new", "own", "foreign"),
    [
        (b"\x89HDF 1 aacmm_jax", b"\x89HDF 2 aacmm_jax", b"\x89HDF of another program"),
        (b"\x89HDF 1 aacmm_jax", b"", b"# Written by aacmm_jax"),
        (b"\x89PNG Matplotlib 1", b"\x89PNG Matplotlib 2", b"\x89PNG of another program"),
        (b"# Written by aacmm_jax\n1", b"# Written by aacmm_jax\n2", b"import numpy\n"),
        (b'{\n  "kind": "arm",\n  1}', b'{\n  "kind": "arm",\n  2}', b'{\n  "mine": 1}'),
        (b"parameter,u\n1", b"parameter,u\n2", b"a,b\n1,2"),
        (b'<?xml?>\n<robot name="a">1', b'<?xml?>\n<robot name="a">2', b'<?xml?>\n<robot name="b">1'),
    ],
)
def test_what_a_command_replaces(tmp_path, new, own, foreign):
    path = tmp_path / "output"
    assert replaced(path, own, new)
    assert replaced(path, new, new)
    assert not replaced(path, foreign, new)
    assert [item.name for item in tmp_path.iterdir()] == ["output"]
    with outputs.write_atomically(path) as temporary:  # from Python
        temporary.write_bytes(new)


@pytest.mark.slow
def test_a_capture_of_somebody_else_is_not_replaced(aacmm, inputs):
    (inputs / "x.h5").write_bytes(FOREIGN)
    assert "x.h5 exists and is not an earlier output" in aacmm(*SIMULATE, "-o", "x.h5", expect=2).stderr
    assert (inputs / "x.h5").read_bytes() == FOREIGN
    aacmm(*SIMULATE, "-o", "x.h5", "--overwrite")
    aacmm(*SIMULATE, "-o", "x.h5")
    with h5py.File(inputs / "x.h5", "a") as file:  # a file of aacmm, but of another kind
        file.attrs["kind"] = "calibration"
    with open(inputs / "x.h5", "rb+") as stream:
        seal(stream)
    assert "x.h5 exists and is not an earlier output" in aacmm(*SIMULATE, "-o", "x.h5", expect=2).stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "output", "foreign"),
    [
        (("calibrate", "c.h5", "-o", "y.h5", "--figure"), "x.png", b"\x89PNG\r\n\x1a\n of another program"),
        (("report", "y.h5", "-o"), "x.html", b"<!doctype html>\n<html lang='en'>a page of mine</html>"),
        (("export", "y.h5", "-o"), "x.toml", b'name = "My arm"\n'),
        (("export", "y.h5", "--format", "json", "-o"), "x.json", b'{\n  "mine": 1}'),
        (("export", "y.h5", "--format", "offsets", "-o"), "x.txt", FOREIGN),
        (("export", "y.h5", "--format", "python", "-o"), "x.py", b"import numpy\n"),
        (("correct", "y.h5", "A.csv", "--unit", "rad", "-o"), "x.csv", FOREIGN),
        (("compare", "y.h5", "y.h5", "--csv"), "x.csv", FOREIGN),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else None,
)
def test_a_file_of_somebody_else_is_not_replaced(aacmm, calibrated, command, output, foreign):
    """But the output of the same command is, and an empty file, and any with --overwrite."""
    path = calibrated / output
    path.write_bytes(foreign)
    done = aacmm(*command, output, expect=2)
    assert f"{output} exists and is not an earlier output of the same kind" in done.stderr
    assert path.read_bytes() == foreign
    aacmm(*command, output, "--overwrite")
    written = path.read_bytes()
    assert written != foreign
    path.write_bytes(b"")
    aacmm(*command, output)
    aacmm(*command, output)
    assert path.read_bytes()[:64] == written[:64]
    path.unlink()


@pytest.mark.slow
def test_the_robot_of_the_user_is_not_replaced(aacmm, tmp_path):
    for file in ("robot.urdf", "tracker.toml", "tracker.csv"):
        (tmp_path / file).write_bytes((EXAMPLES / "simulated_robot" / file).read_bytes())
    before = (tmp_path / "robot.urdf").read_bytes()
    aacmm("import", "tracker.toml", "-o", "c.h5")
    aacmm("calibrate", "c.h5", "-o", "y.h5")
    assert (
        "robot.urdf is the file from which the arm was read"
        in aacmm("export", "y.h5", "-o", "robot.urdf", expect=2).stderr
    )
    assert (tmp_path / "robot.urdf").read_bytes() == before
    for _ in range(2):
        aacmm("export", "y.h5", "-o", "calibrated.urdf")


@pytest.mark.slow
@pytest.mark.parametrize("failing", ["figure", "replace"])
def test_all_outputs_or_none(aacmm, inputs, monkeypatch, failing):
    """A command that fails at its second output, or while it puts them in place, leaves the first as it was."""
    aacmm("calibrate", "c.h5", "-o", "old.h5")
    before = content(inputs)

    def refused(*_):
        raise OSError(28, "No space left on device")

    if failing == "figure":
        monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: refused())
    else:
        replace = os.replace
        monkeypatch.setattr(os, "replace", lambda a, b: refused() if str(b).endswith(".png") else replace(a, b))
    for output in ("old.h5",) if failing == "figure" else ("old.h5", "new.h5"):
        done = aacmm("calibrate", "c.h5", "-o", output, "--figure", "f.png", expect=2)
        assert "f.png cannot be written: no space left on device" in done.stderr
        assert content(inputs) == before


@pytest.mark.slow
def test_outputs_are_checked_before_any_work(aacmm, inputs):
    (inputs / "old.png").touch(0o444)
    done = aacmm("calibrate", "none.h5", "-o", "c2.h5", "--figure", "old.png", expect=2)
    assert "old.png cannot be written: it is read-only; choose another output path." in done.stderr


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o644, 0o755])
@pytest.mark.parametrize("named", ["file", "link"])
def test_permissions_are_kept(tmp_path, mode, named):
    (tmp_path / "file").touch()
    (tmp_path / "file").chmod(mode)
    (tmp_path / "link").symlink_to("file")
    outputs.write_text(tmp_path / named, "after")
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == mode
    assert (tmp_path / "file").read_text() == "after"
    assert (tmp_path / "link").is_symlink()


def test_a_read_only_file_is_refused(tmp_path):
    (tmp_path / "file").touch(0o444)
    assert_refused(lambda: outputs.write_text(tmp_path / "file", ""), "it is read-only", "another output path")


@pytest.mark.slow
def test_leftovers_of_killed_processes_are_removed(tmp_path):
    """Those of the same output only, and not that of a process that is still writing."""
    program = (
        "import os, signal, sys; from aacmm_jax.files.outputs import write_atomically\n"
        "with write_atomically(sys.argv[1]): os.kill(os.getpid(), signal.SIGKILL)"
    )
    for name in ("a.txt", "b.txt"):
        subprocess.run([sys.executable, "-c", program, tmp_path / name], check=False)
    assert len(list(tmp_path.glob(".*.part"))) == 2
    with outputs.write_atomically(tmp_path / "a.txt") as being_written:
        being_written.write_text("first")
        outputs.write_text(tmp_path / "a.txt", "second")
        assert being_written.exists()
    assert (tmp_path / "a.txt").read_text() == "first"
    assert [path.name[:7] for path in tmp_path.glob(".*.part")] == [".b.txt."]


@pytest.mark.slow
@pytest.mark.parametrize("before", [(), ("--",)])
def test_overwrite_is_an_option_only_before_two_hyphens(aacmm, inputs, before):
    (inputs / "x.h5").write_bytes(FOREIGN)
    said = aacmm(*SIMULATE, "-o", "x.h5", *before, "--overwrite", expect=2 if before else 0)
    assert ((inputs / "x.h5").read_bytes() == FOREIGN) == bool(before), said.stderr


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    "command", ["import", "simulate", "calibrate", "evaluate", "report", "export", "plan", "study"]
)
def test_help_of_o_says_what_is_kept(aacmm, command):
    said = " ".join(aacmm(command, "--help").stdout.split())
    assert "An existing file that aacmm did not write is replaced only with --overwrite." in said

"""HDF5 files: damaged and foreign ones, whole-or-nothing writing, round trips, and xarray's view of tables."""

import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import h5py
import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import aacmm_jax as aj
from aacmm_jax.calibration.agreement import CrossValidation, LeftOut
from aacmm_jax.core.text import printable
from aacmm_jax.files.arms import specification_toml
from aacmm_jax.files.hdf5 import write_tables
from aacmm_jax.files.hdf5_content import seal
from aacmm_jax.kinematics.independence import nearly_parallel
from tests.example_counts import example_count
from tests.refusals import assert_refused
from tests.renamed_sockets import renamed_sockets

FULL = OSError(28, "No space left on device")
LOAD = {"capture": aj.files.load_capture, "calibration": aj.files.load_calibration}


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> SimpleNamespace:
    """A small calibration and its capture, in Python and in files that no test changes."""
    arm = aj.Arm(
        alpha=[np.pi / 2, 0.4, -1.0],
        a=[10.0, 400.0, 300.0],
        d=[300.0, 20.0, 10.0],
        probe=[1.0, 2.0, 100.0],
        limits=[(-3, 3)] * 3,
    )
    held = ("theta_1", "d_1", "d_2", "alpha_3", "a_3", "probe_x", "probe_y")
    nominal = aj.kinematics.ArmSpecification(arm, "small", held=held, override={"probe_z": 3.0})
    sockets = {"A": (450, 150, 350), "B": (300, 350, 400)}
    capture = aj.simulate(arm, sockets, poses={"A": 12, "B": 3}, lengths=[("A", "B", 0.01)], encoder_arcsec=2.0, seed=4)
    recording = aj.Recording(capture, nominal, nominal, seed=1)
    record = aj.calibration.record_of(aj.calibrate(arm, capture, nominal.bounds()), recording)
    folder = tmp_path_factory.mktemp("good")
    aj.files.save_capture(folder / "capture.h5", recording)
    aj.files.save_calibration(folder / "calibration.h5", record)
    files = {kind: folder / f"{kind}.h5" for kind in LOAD}
    writers = {
        "capture": lambda path: aj.files.save_capture(path, recording),
        "calibration": lambda path: aj.files.save_calibration(path, record),
        "arm": lambda path: aj.files.save_arm(arm, path),
    }
    return SimpleNamespace(recording=recording, record=record, files=files, writers=writers)


def edit(change):
    """A maker of a bad file: a copy of a good one, changed through h5py, with its SHA-256 computed again."""

    def make(path, source):
        shutil.copy(source, path)
        with h5py.File(path, "a") as file:
            change(file)
        with open(path, "rb+") as stream:
            seal(stream)

    return make


def set_attribute(name, value):
    return edit(lambda file: file.attrs.modify(name, value))


def remove(name):
    return edit(lambda file: file.pop(name))


def replace(name, value):
    def change(file):
        del file[name]
        file[name] = value

    return edit(change)


def make_foreign(path, source):
    with h5py.File(path, "w") as file:
        file["temperature"] = np.arange(3.0)


BAD = {
    "missing": (lambda path, source: None, ["does not exist", "check the path"]),
    "folder": (lambda path, source: path.mkdir(), ["is a folder", "give a file"]),
    "text": (
        lambda path, source: path.write_text("q1,q2\n1,2\n"),
        ["is not an HDF5 file", "give a file written by aacmm"],
    ),
    "empty": (lambda path, source: path.touch(), ["is not an HDF5 file"]),
    "foreign": (make_foreign, ["was not written by aacmm", "give a "]),
    "newer": (set_attribute("format_version", 7), ["format version 7, newer", "(6)", "update aacmm_jax"]),
    "older": (set_attribute("format_version", 5), ["format version 5, older", "(6)", "create it again"]),
    "no version": (edit(lambda file: file.attrs.pop("format_version")), ["damaged", "create it again"]),
    "other kind": (set_attribute("kind", "study"), ["contains a study", "give a "]),
    "no table": (remove("capture"), ["has no table 'capture'", "create it again"]),
    "no arm": (remove("nominal_arm"), ["has no table 'nominal_arm'", "create it again"]),
    "no entry": (remove("capture/angle"), ["has no entry 'angle'", "create it again"]),
    "short entry": (replace("capture/angle", np.zeros((2, 3))), ["damaged", "create it again"]),
    "text for numbers": (replace("reference/value", "long"), ["damaged", "create it again"]),
    "group for numbers": (
        edit(lambda file: (file.pop("capture/angle"), file.create_group("capture/angle"))),
        ["'angle' is not an array"],
    ),
    "no partner": (remove("nominal_arm/highest"), ["damaged", "create it again"]),
    "not finite": (replace("nominal_arm/alpha", [0.0, np.nan, 0.0]), ["alpha[1] is nan; give finite numbers"]),
}


@pytest.mark.first_rows(19)
@pytest.mark.parametrize("kind", LOAD)
@pytest.mark.parametrize(("make", "parts"), BAD.values(), ids=BAD.keys())
def test_bad_file(tmp_path, good, kind, make, parts):
    path = tmp_path / "bad.h5"
    make(path, good.files[kind])
    assert_refused(lambda: LOAD[kind](path), path, *parts)


@pytest.mark.slow
def test_a_capture_is_no_calibration(tmp_path, good):
    path = good.files["capture"]
    assert_refused(lambda: aj.files.load_calibration(path), path, "contains a capture", "give a calibration file")
    # The other way round is meant: a calibration holds its capture.
    assert aj.files.load_capture(good.files["calibration"]).capture.names == ("A", "B")
    for name in ("stage1_arm", "parameters", "observed"):
        remove(name)(tmp_path / "bad.h5", good.files["calibration"])
        assert_refused(
            lambda: aj.files.load_calibration(tmp_path / "bad.h5"), f"has no table '{name}'", "create it again"
        )
    path = good.files["capture"] / "below.h5"
    assert_refused(lambda: aj.files.load_capture(path), path, "cannot be read: not a directory", "give another")


@pytest.mark.parametrize("kind", LOAD)
def test_cut_short(tmp_path, good, kind):
    content = good.files[kind].read_bytes()
    path = tmp_path / "cut.h5"
    # Without the last bytes alone, the SHA-256, the file is complete for HDF5.
    seal = len(content) - content.index(b"\naacmm_jax: SHA-256")
    inside = np.linspace(2000, len(content) - 200, 12).astype(int)
    for size in (1, 7, 8, 40, 96, 1000, *inside, *(len(content) - cut for cut in (seal, seal - 1, 66, 1))):
        path.write_bytes(content[:size])
        assert_refused(lambda: LOAD[kind](path), path, "damaged", "give a file" if size < 8 else "create it again")


def folder_of(path: Path) -> list[str]:
    return sorted(item.name for item in path.iterdir())


WRITERS = ("capture", "calibration", "arm")


@pytest.mark.first_rows(7)
@pytest.mark.parametrize("what", WRITERS)
@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ("missing/out", "no such file or directory"),
        ("folder", "it is a folder"),
        # Read-only for everyone, root included.
        ("file/out", "not a directory"),
        ("/proc/out", "no such file or directory"),
        ("/dev/null", "it is not an ordinary file"),
        ("x" * 300, "file name too long"),
    ],
    ids=["missing folder", "folder", "below a file", "read-only", "device", "long name"],
)
def test_unwritable_place(tmp_path, good, what, place, reason):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    path = tmp_path / place
    assert_refused(
        lambda: good.writers[what](path), f"{path} cannot be written: {reason}", "choose another output path"
    )
    assert folder_of(tmp_path) == ["file", "folder"]
    assert Path("/dev/null").is_char_device()


@pytest.mark.first_rows(3)
@pytest.mark.parametrize(
    ("error", "existing"),
    [
        *((error, True) for error in (FULL, KeyboardInterrupt())),
        (FULL, False),
        pytest.param(RuntimeError("HDF5"), True, marks=pytest.mark.slow),
        *(pytest.param(error, False, marks=pytest.mark.slow) for error in (RuntimeError("HDF5"), KeyboardInterrupt())),
    ],
    ids=lambda value: {True: "over a file", False: "new file"}[value] if isinstance(value, bool) else repr(value),
)
@pytest.mark.parametrize(
    ("what", "step"),
    # An arm's text is built before any file is touched. A capture is written as a calibration is, and sooner.
    [
        pytest.param(what, step, marks=pytest.mark.slow if what == "calibration" and step != "replace" else ())
        for what in WRITERS
        for step in ("build", "write", "replace")
        if (what, step) != ("arm", "build")
    ],
)
def test_failure_midway_changes_nothing(tmp_path, monkeypatch, good, what, step, error, existing):
    path = tmp_path / "out"
    if existing:
        path.write_bytes(b"as it was")
    tables = iter(range(6))
    places = {
        "build": (h5py.Group, "create_dataset"),
        "write": (Path, "write_bytes"),
        "replace": (os, "replace"),
    }
    owner, name = places[step]
    original = getattr(owner, name)

    def failing(*arguments, **keywords):
        if step == "build" and next(tables) < 5:
            return original(*arguments, **keywords)
        if step == "write":
            file, content = arguments
            original(file, content[: len(content) // 2])
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, failing)
        if isinstance(error, OSError):
            assert_refused(lambda: good.writers[what](path), f"{path} cannot be written: no space left on device")
        else:
            with pytest.raises(type(error)):
                good.writers[what](path)
    assert folder_of(tmp_path) == (["out"] if existing else [])
    assert not existing or path.read_bytes() == b"as it was"
    good.writers[what](path)
    assert folder_of(tmp_path) == ["out"]
    # As any program would make it: readable by others where the umask lets it be.
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


CHILD = """
import signal, sys, time
import aacmm_jax as aj
signal.alarm(600)
source, target = sys.argv[1:]
recording = aj.files.load_capture(source)
"""


def child(script: str, *arguments: object) -> subprocess.Popen:
    command = [sys.executable, "-c", CHILD + script, *map(str, arguments)]
    return subprocess.Popen(command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.mark.slow
def test_full_disk(tmp_path, good):
    """HDF5 itself dies of a full disk (segmentation fault); a limit on the size of files stands in for one."""
    script = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
try:
    aj.files.save_capture(target, recording)
except aj.InputError as error:
    print(error)
"""
    target = tmp_path / "capture.h5"
    target.write_bytes(b"as it was")
    output, errors = child(script, good.files["capture"], target).communicate(timeout=600)
    assert output == f"{target} cannot be written: file too large; choose another output path.\n", errors
    assert folder_of(tmp_path) == ["capture.h5"]
    assert target.read_bytes() == b"as it was"


@pytest.mark.slow
def test_interrupted_by_a_real_signal(tmp_path, good):
    """Ctrl-C at any moment of writing a larger capture over an old one leaves the old or the new one.

    The writes of benchmarks/hostile.py are its long version.
    """
    script = """
import itertools
import numpy as np

def strike(*_):
    global struck
    struck = True
    raise KeyboardInterrupt

signal.signal(signal.SIGINT, strike)
q = np.resize(np.asarray(recording.capture.q), (6000, 3)) + 1e-9 * np.arange(6000)[:, None]
both = [aj.Recording(aj.Capture({name: q}), recording.nominal, seed=seed) for seed, name in enumerate(("old", "new"))]
aj.files.save_capture(target, both[0])
began = time.perf_counter()
aj.files.save_capture(target, both[0])
print(time.perf_counter() - began, flush=True)
while True:
    struck = False
    try:
        first = int(sys.stdin.readline())
        print("started", flush=True)
        # Python swallows an exception that strikes inside a weak reference's callback; the loop must end then, too.
        for i in itertools.count(first):
            if struck:
                break
            aj.files.save_capture(target, both[i % 2])
    except KeyboardInterrupt:
        pass
    # Said only now that the exception, and with it every frame that it held, is gone.
    print("stopped", flush=True)
"""
    target = tmp_path / "capture.h5"
    writer = child(script, good.files["capture"], target)
    random, seen, attempt = np.random.default_rng(0), set(), 0
    try:
        one_file = float(writer.stdout.readline())  # s
        while attempt < 8 or (seen != {0, 1} and attempt < 100):
            print(attempt % 2, file=writer.stdin, flush=True)
            assert writer.stdout.readline() == "started\n", writer.stderr.read()
            # From within one file to several, however slow the machine is.
            time.sleep(random.uniform(0, one_file * min(attempt + 1, 8)))
            writer.send_signal(signal.SIGINT)
            assert writer.stdout.readline() == "stopped\n", writer.stderr.read()
            assert folder_of(tmp_path) == ["capture.h5"]
            recording = aj.files.load_capture(target)
            assert recording.capture.names == (("old", "new")[recording.seed],)
            assert recording.capture.sizes == (6000,)
            seen.add(recording.seed)
            attempt += 1
    finally:
        writer.kill()
        writer.communicate()
    assert seen == {0, 1}


numbers = st.floats(-1e20, 1e20)  # larger ones are refused in TOML
lengths = st.floats(-2e4, 2e4)  # arms of more than 50 m are refused there
twists = st.floats(-2 * np.pi, 2 * np.pi)  # others are refused as meant in degrees
positive = st.floats(1e-9, 1e9)
angles = st.floats(-8 * np.pi, 8 * np.pi)
# Everything that UTF-8 can hold, except NUL.
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=8)


# Strategies draw plain values, for JAX may not run inside them.
@st.composite
def arms(draw) -> dict:
    joints = draw(st.integers(1, 3))
    row, long = (st.lists(values, min_size=joints, max_size=joints) for values in (numbers, lengths))
    limits = st.lists(numbers, min_size=2, max_size=2, unique=True).map(sorted)
    arm = {kind: draw(values) for kind, values in (("a", long), ("d", long), ("theta", row))}
    arm["alpha"] = draw(st.lists(twists, min_size=joints, max_size=joints))
    arm["beta"] = draw(st.none() | row)
    arm["probe"] = draw(st.lists(lengths, min_size=3, max_size=3))
    arm["limits"] = draw(st.none() | st.lists(limits, min_size=joints, max_size=joints))
    names = [f"{kind}_{i + 1}" for kind in ("alpha", "a", "d", "theta") for i in range(joints)]
    held = draw(st.none() | st.lists(st.sampled_from(names), unique=True))
    free = ["probe_z"] if held is None else [name for name in (*names, "probe_x") if name not in held]
    override = draw(st.dictionaries(st.sampled_from(free), positive, max_size=2))
    return {
        "arm": arm,
        "name": draw(texts.filter(lambda text: printable(text) == text)),  # a terminal's control characters are escaped
        "held": None if held is None else tuple(held),
        "length": draw(positive),
        "angle": draw(positive),
        "override": override,
    }


@st.composite
def captures(draw, joints: int) -> dict:
    pose = st.lists(angles, min_size=joints, max_size=joints)
    of_one_line = texts.filter(lambda text: text.strip() and text.splitlines() == [text])
    sockets = draw(st.dictionaries(of_one_line, st.lists(pose, min_size=1, max_size=3), min_size=1, max_size=3))
    assume(len({str(poses) for poses in sockets.values()}) == len(sockets))  # a capture refuses a file given twice
    ends = st.lists(st.sampled_from(list(sockets)), min_size=2, max_size=2, unique=True)
    lengths = st.lists(st.tuples(ends, positive, st.floats(0, 1e9)), max_size=2) if len(sockets) > 1 else st.just([])
    return {"sockets": sockets, "lengths": draw(lengths)}


def specification_of(drawn: dict) -> aj.kinematics.ArmSpecification:
    return aj.kinematics.ArmSpecification(**(drawn | {"arm": aj.Arm(**drawn["arm"])}))


def plain(value):
    """Down to the last bit: arrays as their bytes, and the rest as it stands."""
    if isinstance(value, aj.kinematics.ArmSpecification):
        return plain(value.arm), value.name, value.held, value.length, value.angle, dict(value.override)
    if isinstance(value, aj.Arm):
        return [plain(array) for array in value.geometry], value.limits
    if isinstance(value, aj.Capture):
        lengths = [(length.start, length.end, plain(length.value), plain(length.u)) for length in value.lengths]
        return value.names, value.sizes, plain(value.q), lengths
    return None if value is None else np.asarray(value).tobytes()


quickly = settings(max_examples=example_count(8), suppress_health_check=[HealthCheck.too_slow])


@pytest.mark.slow
@given(st.data())
@quickly
def test_round_trip_of_a_capture(tmp_path_factory, data):
    nominal = specification_of(data.draw(arms()))
    drawn = data.draw(captures(nominal.arm.joints))
    lengths = [aj.ReferenceLength(*ends, value, u) for ends, value, u in drawn["lengths"]]
    true = nominal._replace(name="true") if data.draw(st.booleans()) else None
    seed = data.draw(st.none() | st.integers(0, 2**63 - 1))
    recording = aj.Recording(aj.Capture(drawn["sockets"], lengths), nominal, true, seed)
    path = tmp_path_factory.mktemp("round") / "capture.h5"
    aj.files.save_capture(path, recording)
    read = aj.files.load_capture(path)
    assert [plain(item) for item in read[:3]] == [plain(item) for item in recording[:3]]
    assert read.seed == seed


@pytest.mark.slow
@given(arms())
@quickly
def test_round_trip_of_an_arm(tmp_path_factory, drawn):
    specification = specification_of(drawn)
    path = tmp_path_factory.mktemp("round") / "arm.toml"
    path.write_text(specification_toml(specification), encoding="utf-8", newline="")
    try:
        read = aj.files.load_specification(path)
    except aj.InputError as error:
        if "are the lengths in m" in str(error):  # mm that can only be m, and the reverse
            return
        raise
    assert plain(read) == plain(specification)
    aj.files.save_arm(specification.arm, path, name=specification.name)
    arm = specification.arm
    if not any(abs(float(arm.d[i - 1])) > 10_000 for i in nearly_parallel(arm)):  # other frames are read, the same arm
        assert plain(aj.load_arm(path)) == plain(arm)


def test_round_trip_of_a_calibration(tmp_path, good):
    read = aj.files.load_calibration(good.files["calibration"])
    for name, expected in good.record._asdict().items():
        value = getattr(read, name)
        if isinstance(expected, np.ndarray):
            np.testing.assert_array_equal(value, expected, err_msg=name)
        elif isinstance(expected, aj.kinematics.ArmSpecification):
            assert plain(value) == plain(expected), name
        elif name == "shared":
            assert jax.tree.structure(value) == jax.tree.structure(expected)
            jax.tree.map(np.testing.assert_array_equal, value, expected)
        elif name == "noise":  # written in arc seconds and mm
            jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-15), value, expected)
        elif name != "recording":
            assert value == (str(expected) if name == "reason" else expected), name


@pytest.mark.slow
@pytest.mark.parametrize("held", [(), ("d_1", "theta_1")], ids=["nothing held", "two held"])
def test_names_with_a_comma(tmp_path, good, held):
    """Lists of names are lists in the file."""
    names = ("plate, left", "B")
    record = renamed_sockets(good.record, *names)
    group = LeftOut(names, 15, 0.1, 0.1, np.array([0.2]), np.array([0.1]), True)
    recording = record.recording._replace(nominal=good.recording.nominal._replace(held=held))
    record = record._replace(recording=recording, held=held, validation=CrossValidation((group, group)))
    path = tmp_path / "calibration.h5"
    aj.files.save_calibration(path, record)
    read = aj.files.load_calibration(path)
    assert read.recording.capture.names == names
    assert [part.sockets for part in read.validation.groups] == [names, names]
    expected = (group.rms_degrees_of_freedom, group.length_degrees_of_freedom)
    groups = read.validation.groups
    stored = [(part.rms_degrees_of_freedom, part.length_degrees_of_freedom) for part in groups]
    np.testing.assert_equal(stored, [expected] * 2)  # NaN here
    assert (read.held, read.recording.nominal.held) == (held, held)


@pytest.mark.parametrize("name", ["a\0b", "h\udcf6le"], ids=["NUL", "not UTF-8"])
def test_names_that_no_file_can_hold(tmp_path, good, name):
    """File names may be any bytes, and sockets take their names from files."""
    q = good.recording.capture.q
    socket = good.recording._replace(capture=aj.Capture({name: q}))
    arm = good.recording._replace(nominal=good.recording.nominal._replace(name=name))
    for recording in (socket, arm):
        assert_refused(
            lambda recording=recording: aj.files.save_capture(tmp_path / "c.h5", recording),
            repr(name),
            "choose another name",
        )
    assert_refused(
        lambda: aj.files.save_arm(arm.nominal.arm, tmp_path / "a.toml", name=name), repr(name), "choose another name"
    )
    assert folder_of(tmp_path) == []


def test_texts_of_numpy(tmp_path):
    """Names that come from an array of NumPy, such as that of the scale anchor."""
    write_tables(tmp_path / "c.h5", "capture", {}, {"hold": np.str_("d_3"), "sources": [np.str_("a.csv")]})
    with h5py.File(tmp_path / "c.h5") as file:
        assert (file.attrs["hold"], file.attrs["sources"].tolist()) == ("d_3", ["a.csv"])


JOINTS = {"joint": 3, "axis": 3}
DIMENSIONS = {
    "capture": {"pose": 15, "joint": 3},
    "reference": {"length": 1},
    "nominal_arm": JOINTS,
    "true_arm": JOINTS,
    "stage1_arm": JOINTS,
    "calibrated_arm": JOINTS,
    "parameters": {"parameter": 8, "parameter_2": 8},
    "sockets": {"socket": 2, "axis": 3},
    "observed": {"observation": 2, "pose": 15},
    "geometry": {"number": 6, "entry": 18},
    "shared_errors": {
        "shared_kind": 4,
        "shared_kind_variance": 1,
        "coefficient": 23,
        "coefficient_2": 23,
        "function_kind": 4,
        "shared_parameter": 8,
        "shared_parameter_2": 8,
        "tip_kind": 0,
    },
    "components": {
        "component": 2,
        "component_variance": 1,
        "component_parameter": 8,
        "component_parameter_2": 8,
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", LOAD)
def test_xarray_reads_every_table(good, kind):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    path = good.files[kind]
    with h5py.File(path) as file:
        groups = list(file)
    assert groups == list(DIMENSIONS)[: 4 if kind == "capture" else None]
    tables = {}
    for group in groups:
        with xarray.open_dataset(path, group=group, engine="h5netcdf") as table:
            tables[group] = table.load()
        assert dict(table.sizes) == DIMENSIONS[group], group
        for name, variable in table.variables.items():
            assert variable.attrs["long_name"], (group, name)
            # Names have no unit.
            assert ("units" in variable.attrs) == (variable.dtype.kind == "f" or variable.dtype.kind == "i"), (
                group,
                name,
            )
    poses = tables["capture"]
    assert poses["angle"].dims == ("pose", "joint")
    assert poses["angle"].attrs["units"] == "rad"
    np.testing.assert_array_equal(poses["angle"], good.recording.capture.q)
    assert poses["socket"].values.tolist() == ["A"] * 12 + ["B"] * 3
    assert tables["reference"]["value"].attrs["units"] == "mm"
    assert tables["nominal_arm"].attrs["name"] == "small"
    np.testing.assert_array_equal(tables["nominal_arm"]["d"], good.recording.nominal.arm.d)
    if kind == "calibration":
        parameters = tables["parameters"].set_index(parameter="parameter", parameter_2="parameter_2")
        assert tuple(parameters["parameter"].values) == good.record.names
        variance = parameters["covariance"].sel(parameter="d_3", parameter_2="d_3")
        assert float(variance) == pytest.approx(float(parameters["u"].sel(parameter="d_3")) ** 2, rel=1e-12)
        assert tables["sockets"]["centroid"].dims == ("socket", "axis")


def test_files_say_where_they_come_from(good):
    for kind, path in good.files.items():
        with h5py.File(path) as file:
            attributes = dict(file.attrs)
        assert (attributes["format"], attributes["kind"], attributes["format_version"]) == ("aacmm_jax", kind, 6)
        assert attributes["seed"] == 1
        for name in ("package_version", "created", "command"):
            assert attributes[name]

"""Capture manifests: every unit gives the same angles, many files and patterns of files, and bad manifests."""

from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from tests.refusals import assert_refused

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
TURN = 2 * np.pi
HEAD = 'arm = "cheng2018-simulation"\n'
ANGLES = '[angles]\nunit = "rad"\n'
SOCKET = '[[socket]]\nfile = "a.csv"\n'
SMALL = HEAD + ANGLES + SOCKET


@pytest.fixture
def motion(tmp_path) -> np.ndarray:
    """Four poses of six joints in rad, also in a.csv."""
    q = np.random.default_rng(0).uniform(-3, 3, (4, 6))
    record(tmp_path / "a.csv", q)
    return q


def record(path, readings: np.ndarray, delimiter: str = ",", header: str = "") -> None:
    """Write readings with digits enough to read back the same numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [delimiter.join(repr(float(reading)) for reading in row) for row in readings]
    path.write_text(header + "\n".join(lines) + "\n")


def read(tmp_path, text: str) -> aj.Capture:
    path = tmp_path / "capture.toml"
    path.write_text(text)
    return aj.files.read_manifest(path).capture


@pytest.mark.parametrize(
    ("name", "read", "says"),
    [
        (
            "ur5/ur5.toml",
            aj.files.read_manifest,
            "is an arm file, not a manifest: it lacks the key arm and tables of data such as [[socket]] or [[points]]; "
            "give a manifest with arm = 'ur5.toml', or read the arm with aacmm arm or aj.load_arm.",
        ),
        (
            "ur5/positions.toml",
            aj.load_arm,
            "is a manifest, not an arm file; give the arm that it names (arm = 'ur5.toml'), or read the manifest with "
            "aacmm import or aj.files.read_manifest.",
        ),
        ("points.toml", aj.load_arm, "is a manifest of points, not an arm file"),
        ("points.toml", aj.files.read_manifest, "is a manifest of points, without an arm; read it with aj.files.read"),
    ],
)
def test_a_file_of_another_kind_is_named(tmp_path, name, read, says):
    path = EXAMPLES / name
    if name == "points.toml":
        path = tmp_path / name
        path.write_text('points = { unit = "mm" }\n' + SOCKET)
    assert_refused(lambda: read(path), f"{path} {says}")


JOINTS = np.arange(1.0, 7.0)
SIGNS = np.array([1, -1, 1, 1, -1, -1])


def test_temperatures(tmp_path, motion):
    """A column by its name in one table, one number for another; the artefact has its own."""
    warm = np.column_stack([motion[:, :2], [21.0, 22.0, 23.0, 24.0], motion[:, 2:]])
    record(tmp_path / "warm.csv", warm, header="q1,q2,temperature_C,q3,q4,q5,q6\n")
    sockets = '[[socket]]\nfile = "warm.csv"\n[[socket]]\nfile = "b.csv"\ntemperature_C = 22.5\n'
    record(tmp_path / "b.csv", motion + 0.1)
    length = '[[length]]\nfrom = "warm"\nto = "b"\nvalue = 500\nu = 0.001\ntemperature_C = 23\n'
    artefact = "expansion = 11.5e-6\nu_expansion = 1e-6\nu_temperature = 0.5\n"
    capture = read(tmp_path, HEAD + ANGLES + sockets + length + artefact)
    assert capture.columns == 7
    np.testing.assert_array_equal(capture.sockets["warm"], np.column_stack([motion, warm[:, 2]]))
    np.testing.assert_array_equal(capture.sockets["b"][:, 6], np.full(4, 22.5))
    (found,) = capture.lengths  # 3 K and 11.5 um/(m K): 17.25 um longer
    np.testing.assert_allclose([found.value, found.u], [500.01725, np.hypot(0.001, np.hypot(0.0015, 0.002875))])
    # The sessions of a file keep that it is corrected, and a test corrects it no second time.
    recording = aj.files.read_manifest(tmp_path / "capture.toml")
    recording = recording._replace(capture=aj.join_sessions({"monday": capture}))
    aj.files.save_capture(tmp_path / "warm.h5", recording)
    again = aj.acceptance.measured_by(recording.nominal.arm, aj.files.load_capture(tmp_path / "warm.h5"))
    bar = aj.acceptance.Influences(artefact=aj.acceptance.Expansion(11.5e-6, 1e-6, 23.0, 0.5))
    assert_refused(
        lambda: aj.acceptance.run(again, influences=bar), "'monday/warm' to 'monday/b'", "--expansion", "twice"
    )
    plain = again._replace(lengths=(aj.ReferenceLength("monday/warm", "monday/b", 500.0),))
    assert aj.acceptance.run(plain, influences=bar)
    for text, sentence in (
        (SMALL + "temperature_C = 295.6\n", "temperature of 295.6 C, which is not between"),
        (
            SMALL + "temperature_C = 22\n" + SOCKET.replace("a.csv", "b.csv"),
            "b.csv has no temperatures, but .*a.csv has",
        ),
        (SMALL.replace("a.csv", "warm.csv") + "temperature_C = 22\n", "but the manifest also states temperature_C"),
        (HEAD + ANGLES + '[[socket]]\nname = "A"\nfiles = ["b.csv", "warm.csv"]\n', "b.csv has no temperatures, but"),
        (HEAD + ANGLES + "columns = [1, 2, 3, 4, 5, 6]\n" + SOCKET.replace("a.csv", "warm.csv"), "column 3 is"),
        (
            HEAD + ANGLES + sockets + length.replace("23", "296") + artefact,
            "temperature of 296 C, which is not between",
        ),
        (HEAD + ANGLES + sockets + length + "expansion = 11.5", "expansion of 11.5 /K"),
        (HEAD + ANGLES + sockets + length + "expansion = 1e-5\nu_expansion = 1", "with u = 1 /K"),
    ):
        with pytest.raises(aj.InputError, match=sentence):
            read(tmp_path, text)


def test_torques(tmp_path, motion):
    """Columns with their usual names, or those that the manifest names; before a temperature, wherever they are."""
    loads = 10 * motion
    usual = ",".join(f"torque_{i}_Nm" for i in range(1, 7))
    table = np.column_stack([motion[:, :3], [21.0, 22.0, 23.0, 24.0], loads, motion[:, 3:]])
    record(tmp_path / "a.csv", table, header=f"q1,q2,q3,temperature_C,{usual},q4,q5,q6\n")
    socket = '[[socket]]\nfile = "a.csv"\n'
    (tmp_path / "capture.toml").write_text(HEAD + ANGLES + socket)
    recording = aj.files.read_manifest(tmp_path / "capture.toml")
    expected = np.column_stack([motion, loads, table[:, 3]])
    np.testing.assert_array_equal(recording.capture.sockets["a"], expected)
    assert recording.nominal.arm.recorded == ("torques", "thermometer")
    record(tmp_path / "b.csv", np.column_stack([motion, loads]), header="q1,q2,q3,q4,q5,q6,l1,l2,l3,l4,l5,l6\n")
    chosen = read(tmp_path, HEAD + ANGLES + 'torques = "l*"\n' + socket.replace("a.csv", "b.csv"))
    np.testing.assert_array_equal(chosen.sockets["b"], expected[:, :12])
    record(tmp_path / "c.csv", motion)
    both = HEAD + ANGLES + socket + socket.replace("a.csv", "c.csv")
    few = HEAD + ANGLES + 'torques = ["l1", "l2"]\n' + socket.replace("a.csv", "b.csv")
    for text, sentence in (
        (both, "c.csv has no torques, but .*a.csv has torques; add columns torque_1_Nm"),
        (few, "b.csv has 2 columns of torques, but the arm has 6 joints"),
    ):
        with pytest.raises(aj.InputError, match=sentence):
            read(tmp_path, text)


def test_directions_and_loads(tmp_path, motion):
    """Recorded, named, or by the order of the rows; a load for every row, or one for the table."""
    sides = np.tile([1.0, -1.0, 0.0, 1.0], (6, 1)).T
    usual = ",".join(f"direction_{i}" for i in range(1, 7))
    record(
        tmp_path / "a.csv",
        np.column_stack([motion, sides, [0, 1, 2, 3]]),
        header=f"q1,q2,q3,q4,q5,q6,{usual},load_kg\n",
    )
    socket = '[[socket]]\nfile = "a.csv"\n'
    expected = np.column_stack([motion, sides, [0, 1, 2, 3]])
    np.testing.assert_array_equal(read(tmp_path, HEAD + ANGLES + socket).sockets["a"], expected)
    assert aj.files.read_manifest(tmp_path / "capture.toml").nominal.arm.recorded == ("directions", "load")
    rises, stays, falls = 0.5, 0.501, 0.2  # a joint that hardly moves stays on its side
    record(
        tmp_path / "b.csv", np.add.outer([0.0, rises, stays, falls], 0.1 * np.arange(6)), header="q1,q2,q3,q4,q5,q6\n"
    )
    ordered = HEAD + ANGLES + 'directions = "order"\n[[socket]]\nfile = "b.csv"\nload_kg = 2.5\n'
    found = read(tmp_path, ordered).sockets["b"]
    np.testing.assert_array_equal(found[:, 6:], np.repeat([[0, 2.5], [1, 2.5], [1, 2.5], [-1, 2.5]], [6, 1], axis=1))
    record(tmp_path / "c.csv", np.column_stack([motion, 2 * sides]), header=f"q1,q2,q3,q4,q5,q6,{usual}\n")
    with pytest.raises(aj.InputError, match="socket 'c' pose 1 has the direction 2 of joint 1; give 1 where"):
        read(tmp_path, HEAD + ANGLES + socket.replace("a.csv", "c.csv"))


def test_visits_of_sessions_and_targets(tmp_path, motion):
    """Each file is a visit, in sessions too; of a socket with another tip than the probe they are refused."""
    record(tmp_path / "b.csv", motion + 0.1)
    record(tmp_path / "c.csv", motion + 0.2)
    socket = '[[socket]]\nname = "{}"\nfiles = ["a.csv", "b.csv"]\nvisits = "files"\n'
    other = '[[socket]]\nfile = "c.csv"\n'
    assert read(tmp_path, HEAD + ANGLES + socket.format("A")).visits == (0, 0, 0, 0, 1, 1, 1, 1)
    text = HEAD + ANGLES + socket.format("day/A") + 'session = "day"\n' + other + 'session = "day"\n'
    assert read(tmp_path, text).visits == (0, 0, 0, 0, 1, 1, 1, 1, -1, -1, -1, -1)
    with pytest.raises(aj.InputError, match="visits apply only to sockets measured with the arm's own probe"):
        read(tmp_path, HEAD + ANGLES + socket.format("A") + 'target = "ball"\n' + other)


@pytest.mark.first_rows(4)
@pytest.mark.parametrize(
    ("angles", "reading"),
    [
        ('unit = "rad"', lambda q: q),
        ('unit = "deg"', np.rad2deg),
        ('unit = "arcsec"', lambda q: q / aj.units.ARCSEC),
        ('unit = "counts"\ncounts_per_turn = 4096', lambda q: q / TURN * 4096),
        (f'unit = "counts"\ncounts_per_turn = {(1000 * JOINTS).tolist()}', lambda q: q / TURN * 1000 * JOINTS),
        ('unit = "deg"\nsign = -1\noffset = 90', lambda q: 90 - np.rad2deg(q)),
        (f'unit = "rad"\nsign = {SIGNS.tolist()}', lambda q: q * SIGNS),
        (f'unit = "deg"\noffset = {JOINTS.tolist()}', lambda q: np.rad2deg(q) + JOINTS),
        (
            f'unit = "counts"\ncounts_per_turn = 4096\nsign = {SIGNS.tolist()}\noffset = {JOINTS.tolist()}',
            lambda q: q / TURN * 4096 * SIGNS + JOINTS,
        ),
        (
            'unit = "rad"\ncolumns = [7, 2, 3, 4, 5, 6]\noffset = [0.5, 0, 0, 0, 0, 0]',
            lambda q: np.column_stack([np.full(4, 99.0), q[:, 1:], q[:, 0] + 0.5]),
        ),
    ],
    ids=[
        *("rad", "deg", "arcsec", "counts", "counts a joint", "sign and offset", "sign a joint", "offset a joint"),
        *("counts with sign and offset", "columns"),
    ],
)
def test_every_unit_gives_the_same_angles(tmp_path, motion, angles, reading):
    """Angle = sign * (reading - offset), both in the stated unit."""
    record(tmp_path / "a.csv", reading(motion))
    capture = read(tmp_path, f"{HEAD}[angles]\n{angles}\n{SOCKET}")
    np.testing.assert_allclose(capture.q, motion, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("delimiter", "header"),
    [
        (",", ""),
        (", ", "q1, q2, q3, q4, q5, q6\n"),
        (";", "joint 1;joint 2;joint 3;joint 4;joint 5;joint 6\nrad;rad;rad;rad;rad;rad\n"),
        ("\t", "# recorded on Monday\n\n"),
        ("   ", "\ufeff"),
    ],
    ids=["comma", "header", "semicolon and two headers", "tab and comment", "blank and byte order mark"],
)
def test_text_tables(tmp_path, motion, delimiter, header):
    record(tmp_path / "a.csv", motion, delimiter, header)
    np.testing.assert_array_equal(read(tmp_path, SMALL).q, motion)


def test_several_files_make_one_socket(tmp_path, motion):
    record(tmp_path / "b.csv", -motion)
    capture = read(tmp_path, f'{HEAD}{ANGLES}[[socket]]\nname = "plate"\nfiles = ["a.csv", "b.csv"]\n')
    assert (capture.names, capture.sizes) == (("plate",), (8,))
    np.testing.assert_array_equal(capture.q, np.concatenate([motion, -motion]))


@pytest.mark.parametrize("prefix", ["", "./", "{folder}/"], ids=["relative", "dotted", "absolute"])
@pytest.mark.parametrize("inside", [True, False], ids=["inside the folder", "from elsewhere"])
def test_braces_make_a_socket_a_file(tmp_path, monkeypatch, motion, prefix, inside):
    """As for the MUKCa captures: one socket a file, one length a placement; other files and folders are left alone."""
    for number, (place, hole) in enumerate([("left", 0), ("left", 1), ("mid-high", 0), ("mid-high", 1)]):
        record(tmp_path / "run_1" / place / f"hole_{hole}.csv", motion + number)
    record(tmp_path / "run_1" / "left" / "notes.csv", motion)
    prefix = prefix.format(folder=tmp_path.as_posix())
    text = f"""{HEAD}{ANGLES}
        [[socket]]
        name = "{{place}}/{{hole}}"
        file = "{prefix}run_1/{{place}}/hole_{{hole}}.csv"
        [[length]]
        from = "{{place}}/0"
        to = "{{place}}/1"
        value = 50.0
        u = 0.01
    """
    (tmp_path / "capture.toml").write_text(text)
    monkeypatch.chdir(tmp_path if inside else tmp_path.parent)
    recording = aj.files.read_manifest("capture.toml" if inside else f"{tmp_path.name}/capture.toml")
    capture = recording.capture
    assert capture.names == ("left/0", "left/1", "mid-high/0", "mid-high/1")
    np.testing.assert_array_equal(capture.sockets["mid-high/0"], motion + 2)
    assert [(length.start, length.end) for length in capture.lengths] == [
        ("left/0", "left/1"),
        ("mid-high/0", "mid-high/1"),
    ]
    assert {(float(length.value), float(length.u)) for length in capture.lengths} == {(50.0, 0.01)}
    assert recording.nominal.name == "Cheng 2018, simulated arm"


FILES = (
    "front_left/hole_0.csv",
    "front_left/hole_0_pose.csv",
    "front_left/hole_1.csv",
    "mid-high/hole_0.csv",
    "old/hole_0.csv",
)


@pytest.mark.first_rows(5)
@pytest.mark.parametrize(
    ("name", "file", "exclude", "expected"),
    [
        # A field beside other text is one word: what lies beside a recording under a longer name is another file.
        ("{place}/{hole}", "{place}/hole_{hole}.csv", [], {"front_left/0", "front_left/1", "mid-high/0", "old/0"}),
        ("{place}/{hole}", "{place}/hole_{hole}.csv", ["old/*"], {"front_left/0", "front_left/1", "mid-high/0"}),
        ("{place}/{hole}", "{place}/hole_{hole}.csv", ["hole_1.csv", "old/*"], {"front_left/0", "mid-high/0"}),
        # One that is a whole name, but for the extension, may hold anything.
        ("{file}", "front_left/{file}.csv", [], {"hole_0", "hole_0_pose", "hole_1"}),
        ("{file}", "front_left/{file}.csv", ["*_pose.csv"], {"hole_0", "hole_1"}),
        ("{file}", "front_left/{file}", ["*_pose.csv"], {"hole_0.csv", "hole_1.csv"}),
        ("{side}/{h}", "{side}-high/hole_{h}.csv", [], {"mid/0"}),
        ("{h}", "front_left/hole_{h}_pose.csv", [], {"0"}),
    ],
)
def test_what_a_field_matches(tmp_path, motion, name, file, exclude, expected):
    for number, path in enumerate(FILES):
        record(tmp_path / path, motion + 0.1 * number)
    text = f'{HEAD}{ANGLES}[[socket]]\nname = "{name}"\nfile = "{file}"\nexclude = {exclude}\n'
    assert set(read(tmp_path, text).names) == expected


@pytest.mark.parametrize(
    ("file", "exclude", "parts"),
    [
        ("hole_{hole}.csv", [], ["names are 'hole_0_pose.csv', 'hole_1_pose.csv'.", "only letters, digits and '-'"]),
        ("{hole}_pose.csv", ["*_pose.csv"], ["except 'hole_0_pose.csv'", "leaves these files out; change exclude"]),
        ("hole_{hole}_poze.csv", [], ["similar names: 'hole_1_pose.csv', 'hole_0_pose.csv'", "check the path"]),
        ("plate/{hole}.csv", [], ["no file matches 'plate/{hole}.csv'", "check the path"]),
    ],
    ids=["longer name", "excluded", "misspelt", "no such folder"],
)
def test_what_nearly_matches_is_named(tmp_path, motion, file, exclude, parts):
    for number in range(2):
        record(tmp_path / f"hole_{number}_pose.csv", motion + number)
    text = f'{HEAD}{ANGLES}[[socket]]\nname = "{{hole}}"\nfile = "{file}"\nexclude = {exclude}\n'
    assert_refused(lambda: read(tmp_path, text), tmp_path / "capture.toml", *parts)


def test_a_field_that_returns_is_the_same_text(tmp_path, motion):
    record(tmp_path / "left" / "left.csv", motion)
    record(tmp_path / "left" / "right.csv", motion)
    text = f'{HEAD}{ANGLES}[[socket]]\nname = "{{side}}"\nfile = "{{side}}/{{side}}.csv"\n'
    assert read(tmp_path, text).names == ("left",)


def test_an_arm_beside_the_manifest(tmp_path, motion):
    aj.files.save_arm(aj.load_arm("cheng2018-simulation"), tmp_path / "arm.toml", name="ours")
    # With the mark that some editors put before UTF-8.
    (tmp_path / "capture.toml").write_text(SMALL.replace("cheng2018-simulation", "arm.toml"), encoding="utf-8-sig")
    assert aj.files.read_manifest(tmp_path / "capture.toml").nominal.name == "ours"


LENGTH = '[[length]]\nfrom = "a"\nto = "b"\nvalue = 200.0\n'
PATTERN = '[[socket]]\nname = "{place}"\nfile = "{place}.csv"\n'


@pytest.mark.first_rows(16)
@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (SMALL.replace("a.csv", "z.csv"), ["z.csv does not exist", "check the path"]),
        (SMALL.replace("a.csv", "folder"), ["folder is a folder", "give a file"]),
        (
            SMALL.replace("rad", "grad"),
            ["'angles.unit' must be 'rad', 'deg', 'arcsec', 'gon', 'mrad', 'counts' or 'percent', not 'grad'"],
        ),
        (HEAD + SOCKET, ["'angles' is missing", "unit of the readings", "add [angles]"]),
        (HEAD + ANGLES, ["no [[socket]] and no other observation", "add at least one"]),
        (SMALL.replace("file", "flie"), ["unknown key 'socket 1.flie'", "did you mean 'file'?"]),
        (SMALL.replace("unit", "unti"), ["unknown key 'angles.unti'", "did you mean 'unit'?"]),
        (SMALL + LENGTH.replace("from", "form"), ["unknown key 'length 1.form'", "did you mean 'from'?"]),
        (SMALL.replace("[[socket]]", "[socket]"), ["'socket' must be a valid list, not a table", "write [[socket]]"]),
        (SMALL + 'name = "{place}"', ["name '{place}'", "file 'a.csv' has no field", "use the same fields"]),
        (
            SMALL + 'exclude = ["b*"]',
            ["exclude applies only to file names with a field in braces", "'a.csv' has no such field; remove exclude"],
        ),
        (SMALL + 'files = ["a.csv"]', ["socket 1", "either file or files"]),
        (HEAD + ANGLES + '[[socket]]\nfiles = ["a.csv"]', ["socket 1", "needs a name"]),
        (HEAD + ANGLES + '[[socket]]\nname = "a"\nfiles = []', ["'socket 1.files' has no entries", "give at least 1"]),
        (SMALL + SOCKET, ["socket 'a' is defined twice", "in one [[socket]]"]),
        (SMALL + LENGTH, ["'a' to 'b'", "unknown socket 'b'", "choose one of a."]),
        (SMALL + LENGTH.replace("200.0", "-200.0"), ["'a' to 'b' is -200 mm", "positive"]),
        (SMALL + LENGTH.replace("200.0", '"long"'), ["'length 1.value' must be a valid number, not 'long'"]),
        (SMALL + LENGTH + "u = -1", ["'length 1.u' must be greater than or equal to 0, not -1"]),
        (SMALL + LENGTH.replace('"b"', '"{x}"'), ["from 'a' to '{x}'", "field that no [[socket]] has"]),
        (
            SMALL + LENGTH.replace("200.0", "true"),
            ["length 1.value: a number is needed, but the value is true or false"],
        ),
        (SMALL + SOCKET.replace("file", 'name = "b"\nfile') + 2 * LENGTH, ["from 'a' to 'b' of 200 mm is given twice"]),
        (
            HEAD + ANGLES + '[[socket]]\nname = "a"\nfiles = ["a.csv", "a.csv"]',
            ["socket 1.files: 'a.csv' is given twice"],
        ),
        (SMALL.replace('"a.csv"', '"a.csv"\nname = ""'), ["a socket has the name ''"]),
        (SMALL.replace("rad", "counts"), ["angles", "counts_per_turn and unit = 'counts' are only possible together"]),
        (SMALL.replace(SOCKET, "counts_per_turn = 9\n" + SOCKET), ["angles", "only possible together"]),
        (
            SMALL.replace('"rad"', '"counts"\ncounts_per_turn = [9, 9]'),
            ["angles.counts_per_turn has 2 values", "6 joints"],
        ),
        (
            SMALL.replace('"rad"', '"counts"\ncounts_per_turn = "many"'),
            ["'angles.counts_per_turn' must be", "not 'many'"],
        ),
        (
            SMALL.replace('"rad"', '"counts"\ncounts_per_turn = inf'),
            ["'angles.counts_per_turn' must be a finite number"],
        ),
        (SMALL.replace('"rad"', '"counts"\ncounts_per_turn = 0'), ["'angles.counts_per_turn' must be greater than 0"]),
        (SMALL.replace('"rad"', '"counts"\ncounts_per_turn = []'), ["'angles.counts_per_turn' has no entries"]),
        (
            SMALL.replace('"rad"', '"rad"\ncolumns = [1, 1, 2, 3, 4, 5]'),
            ["a.csv: 1, 1, 2, 3, 4 and 1 more pick the same column twice"],
        ),
        (SMALL.replace('"rad"', '"rad"\nsign = 2'), ["'angles.sign' must be 1 or -1, not 2"]),
        (SMALL.replace('"rad"', '"rad"\nsign = [1, 1, 0, 1, 1, 1]'), ["'angles.sign 3' must be 1 or -1, not 0"]),
        (
            SMALL.replace('"rad"', '"rad"\noffset = [1, 2]'),
            ["angles.offset has 2 values", "give one value, or one value per joint"],
        ),
        (
            SMALL.replace('"rad"', '"rad"\ncolumns = [1, 2, 3]'),
            ["3 columns are picked", "6 joints", "pick one column per joint"],
        ),
        (
            SMALL.replace('"rad"', '"rad"\ncolumns = [1, 2, 3, 4, 5, 9]'),
            ["a.csv has no column '9'; the table has 6 columns without names; pick another column"],
        ),
        (SMALL.replace('"rad"', '"rad"\ncolumns = [0, 2, 3, 4, 5, 6]'), ["'angles.columns 1' must be greater than 0"]),
        (HEAD + ANGLES + PATTERN.replace(".csv", ".txt"), ["no file matches '{place}.txt'", "check the path"]),
        (HEAD + ANGLES + PATTERN.replace('name = "{place}"\n', ""), ['add name = "{place}" to']),
        (
            HEAD + ANGLES + PATTERN.replace('file = "{place}.csv"', 'files = ["{place}.csv", "{palce}_2.csv"]'),
            ["file '{palce}_2.csv' has {palce}", "'{place}.csv' has {place}", "use the same fields"],
        ),
        (
            SMALL.replace("simulation", "simulaton"),
            ["'cheng2018-simulaton' is neither", "did you mean 'cheng2018-simulation'?"],
        ),
        (SMALL.replace("cheng2018-simulation", "ours.toml"), ["ours.toml does not exist"]),
        ("arm = ", ["not valid TOML", "end of document"]),
        (SMALL + LENGTH.replace("200.0", "'200.0'"), ["'length 1.value' must be a valid number, not '200.0'"]),
        (
            SMALL.replace('"rad"', '"rad"\ncolumns = ["1", 2, 3, 4, 5, 6]'),
            ["a.csv has no column '1'; the table has 6 columns without names"],
        ),
        (
            SMALL.replace('"rad"', '"rad"\noffset = true'),
            ["angles.offset: a number is needed, but the value is true or false"],
        ),
        (SMALL + LENGTH.replace("200.0", "1e300"), ["'length 1.value' is implausibly large"]),
        (SMALL + LENGTH + "u = inf", ["'length 1.u' must be a finite number"]),
        (SMALL + LENGTH.replace("200.0", "9" * 5001), ["contains a number with thousands of digits"]),
        (
            SMALL.replace('"a.csv"', '"a.csv"\nname = "a\\u0000b"'),
            ["'socket 1.name' contains the control character U+0000"],
        ),
        (SMALL.replace('"a.csv"', '"a.csv"\nname = "a\\u001b[2J"'), ["control character U+001B; remove the character"]),
        (SMALL + '"\\u001b" = 1', ["control character U+001B"]),
        (SMALL + "x = " + "[" * 900 + "]" * 900, ["nests tables or lists too deeply"]),
        (SMALL + "x = " + "[" * 90 + "]" * 90, ["nests tables or lists too deeply; use at most 16 levels"]),
        (SMALL + ".".join(["a"] * 20_000) + " = 1", ["line 6 has a key of more than 16 parts"]),
        (SMALL + "[" + ' . "a" . '.join(["x"] * 20_000) + "]", ["line 6 has a key of more than 16 parts"]),
        (SMALL + "#" * 5_000_000, ["has 5,000,", "characters, more than 4,000,000"]),
        (
            HEAD + ANGLES + PATTERN.replace("place", "1"),
            ["the field {1} in '{1}' has a name that does not begin with a letter; rename the field"],
        ),
        (HEAD + ANGLES + PATTERN.replace("{place}", "{a}{b}"), ["two fields with nothing between them"]),
        (HEAD + ANGLES + PATTERN.replace("{place}", "/".join(f"{{f{i}}}" for i in range(9))), ["more than 8 fields"]),
    ],
    ids=[
        *("missing file", "folder", "unit", "no angles", "no socket", "misspelt in socket", "misspelt in angles"),
        *(
            "misspelt in length",
            "socket as a table",
            "field in the name only",
            "exclude without field",
            "file and files",
            "files without name",
        ),
        *(
            "no files",
            "socket twice",
            "length to unknown",
            "length negative",
            "length text",
            "u negative",
            "length field",
            "length true",
            "length twice",
            "file twice",
            "empty name",
        ),
        *(
            "counts without per turn",
            "per turn without counts",
            "per turn of two",
            "per turn text",
            "per turn infinite",
            "per turn zero",
            "per turn of none",
            "column twice",
            "sign",
            "sign of one",
        ),
        *(
            "offset of two",
            "columns of three",
            "column beyond",
            "column 0",
            "pattern without match",
            "pattern without name",
        ),
        *(
            "pattern of two",
            "arm",
            "arm file",
            "not TOML",
            "quoted number",
            "quoted column",
            "offset true",
            "too large",
        ),
        *(
            "u infinite",
            "digits",
            "NUL",
            "escape",
            "escape in a key",
            "deep",
            "less deep",
            "dotted key",
            "dotted table",
        ),
        *("long", "field of a number", "adjacent fields", "many fields"),
    ],
)
def test_bad_manifest(tmp_path, motion, text, parts):
    (tmp_path / "folder").mkdir()
    assert_refused(lambda: read(tmp_path, text), tmp_path / "capture.toml", *parts)


@pytest.mark.first_rows(9)
@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (b"1,2,3,4,5.5\n", ["has 5 columns", "the arm's 6 joints", "one column per joint", "columns = [...]"]),
        (b"1,2,3,4,5.5,6\n1,2,3,4,5.5\n", ["line 2 has 5 columns", "before it have 6", "give all lines the same"]),
        (b"q\n1,2,3,4,5.5,6\n\n1,2,x,4,5,6\n", ["line 4 column 3", "'x' is not a number", "write the number"]),
        (b"1,2,3,4,5.5,6\n1,2,3,4,5.5,1_0\n", ["line 2 column 6", "'1_0' is not a number"]),
        (b"1,2,3,4,5.5,\n", ["has 5 columns without names", "the arm's 6 joints"]),
        (b"1,2,3,4,5.5,6\n1,2,3,4,5.5,\n", ["line 2 column 6", "'' is not a number"]),
        (b"1,2,3,4,5.5,6\n1,2,3,4,nan,6\n", ["line 2 column 5", "'nan' is not finite", "correct the number"]),
        (b"q1,q2,q3,q4,q5,q6\n", ["contains no numbers", "one line per pose"]),
        (b"", ["contains no numbers", "one line per pose"]),
        (b"0,5;1,5;2,5;0,5;1,5;2,5\n", ["line 1 column 1: '0,5' is not a number", 'or add decimal = ","']),
        (
            b"1,2,3,4,5,6\n",
            [
                "line 1 contains the column numbers 1 to 6;",
                "add skip = 1 and columns = [1, 2, 3, 4, 5, 6], or, if these numbers are measured values, write",
            ],
        ),
        (b"0 1 2 3 4 5\n", ["line 1 contains the column numbers 0 to 5;"]),
        (b"0.1x,0.2x,a,b,c,d\n1,2,3,4,5.5,6\n", ["line 1 column 1: '0.1x' is not a number"]),
        (b'"0.1,0.2,0.3,0.4,0.5,0.6\n1,2,3,4,5.5,6\n', ["line 1 column 1: '\"0.1' is not a number", "without quotes"]),
        (b"1,2,3,4,5.5,'6'\n", ["line 1 column 6: ''6'' is not a number", "without quotes"]),
        ("1,2,3,4,5.5,\u0666\n".encode(), ["line 1 column 6: '\u0666' is not a number"]),
        (
            "\u0660\u066b\u0661,\u0662,\u0663,\u0664,\u0665,\u0666\n1,2,3,4,5.5,6\n".encode(),
            ["line 1 column 1: '\u0660\u066b\u0661' is not a number"],
        ),
        (b"True,2,3,4,5.5,6\n", ["line 1 column 1: 'True' is not a number"]),
        (b"1,2,3,4,5.5,0x6\n", ["line 1 column 6: '0x6' is not a number"]),
        (b"1,2,3,4,5.5,1e300\n", ["'1e300' is not finite, or is implausibly large"]),
        (b"1,2,3,4,5.5," + b"9" * 5001 + b"\n", ["line 1 column 6: '999", "...' is not finite"]),
        (b"1,2,3,4,5.5,6\x1b[2J\n", ["line 1 column 6: '6\\x1b[2J' is not a number"]),
        (b"1,2,3,4,5.5\x1c,6\n", ["line 1 column 5: '5.5\\x1c' is not a number"]),
        (b"q1,q2,q3,q4,q5,q1\n1,2,3,4,5.5,6\n", ["'q5', 'q1'; add columns = [1, 6, 2, 3, 4, 5]", "each column once"]),
        (
            b"1,2,3,4,2,6\n2,3,4,5,3,7\n0,0,0,1,0,1\n",
            ["has the same numbers in columns 2 and 5", "give each column once"],
        ),
        (bytes(range(256)), ["cannot be read as text", "UTF-8"]),
    ],
    ids=[
        "columns",
        "ragged",
        "text",
        "underscore",
        "last column empty",
        "last cell empty",
        "nan",
        "header only",
        "empty",
        "decimal commas",
        "columns numbered from 1",
        "columns numbered from 0",
        "half words",
        "opening quote",
        "quoted number",
        "Arabic digit",
        "Arabic first row",
        "boolean",
        "hexadecimal",
        "too large",
        "digits",
        "escape",
        "separator",
        "name twice",
        "column twice",
        "binary",
    ],
)
def test_bad_table(tmp_path, content, parts):
    """The message names the manifest, the file and the place in it."""
    (tmp_path / "a.csv").write_bytes(content)
    assert_refused(lambda: read(tmp_path, SMALL), tmp_path / "capture.toml", tmp_path / "a.csv", *parts)


def test_degrees_taken_for_radians(tmp_path, motion):
    record(tmp_path / "a.csv", np.rad2deg(motion))
    assert_refused(
        lambda: read(tmp_path, SMALL),
        tmp_path / "capture.toml",
        "a.csv pose 2 joint 6",
        "degrees",
        'write unit = "deg" in [angles]',
    )


def test_what_is_not_a_manifest(tmp_path):
    assert_refused(lambda: aj.files.read_manifest(tmp_path / "none.toml"), "none.toml does not exist", "check the path")
    assert_refused(lambda: aj.files.read_manifest(tmp_path), tmp_path, "is a folder", "give a file")


@pytest.mark.parametrize(
    ("angles", "socket", "stated"),
    [
        ('unit = "deg"', "", ("unit",)),
        ('unit = "deg", sign = 1, offset = 0', "", ("offset", "sign", "unit")),
        ('unit = "deg"', 'units = { q = "deg" }, columns = { q = "*" }', ("columns", "unit")),
    ],
)
def test_what_is_stated_of_the_readings(tmp_path, motion, angles, socket, stated):
    np.savetxt(tmp_path / "a.csv", np.degrees(motion), delimiter=",")
    socket = f'{{ name = "A", file = "a.csv"{", " if socket else ""}{socket} }}'.replace('"*"', str([*range(1, 7)]))
    text = f'arm = "cheng2018-simulation"\nangles = {{ {angles} }}\nsocket = [{socket}]\n'
    (tmp_path / "capture.toml").write_text(text)
    recording = aj.files.read_manifest(tmp_path / "capture.toml")
    assert recording.stated == stated
    aj.files.save_capture(tmp_path / "capture.h5", recording)
    again = aj.files.load_capture(tmp_path / "capture.h5")
    assert again.stated == stated
    assert again.read_as == ((1, 2, 3, 4, 5, 6) if "sign" in stated else None)


def test_the_time_of_day_of_a_date_is_left_out(tmp_path, motion):
    (tmp_path / "capture.toml").write_text("date = 2026-01-02T10:00:00\n" + SMALL)
    assert aj.files.read_manifest(tmp_path / "capture.toml").measured == "2026-01-02"


def test_lengths_between_sockets_that_a_column_names(tmp_path, motion):
    """Fields of a length are filled in by the names in the column; a place with one seat has no length."""
    names = ["bar 1/left", "bar 1/right", "bar 2/left", "bar 2/right", "bar 3/left"]
    rows = [[name, *map(repr, row)] for i, name in enumerate(names) for row in (motion + 0.1 * i).tolist()]
    header = "socket," + ",".join(f"q{joint}" for joint in range(1, 7))
    (tmp_path / "bar.csv").write_text("\n".join([header, *map(",".join, rows)]) + "\n")
    grouped = HEAD + ANGLES + '[[socket]]\nfile = "bar.csv"\ngroup = "socket"\n[[length]]\nvalue = 500\nu = 0.001\n'
    capture = read(tmp_path, grouped + 'from = "{place}/left"\nto = "{place}/right"\n')
    assert [(length.start, length.end) for length in capture.lengths] == [
        ("bar 1/left", "bar 1/right"),
        tuple(names[2:4]),
    ]
    for ends in ('from = "{place}/left"\nto = "{other}/right"\n', 'from = "{place}/top"\nto = "{place}/right"\n'):
        assert_refused(lambda ends=ends: read(tmp_path, grouped + ends), "uses a field that no")

"""Tables as recorders and spreadsheets write them: imported by a manifest of ten lines, or refused with the line that
makes it one; and headers that contradict the manifest, files that are cut, texts that are no tables."""

import codecs

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.units import ANGLE_UNITS
from aacmm_jax.files.manifest_readings import Readings, Wanted
from aacmm_jax.files.manifest_tables import Angles
from aacmm_jax.files.text_table import TextTable
from tests.refusals import assert_refused, refusal

Q = np.random.default_rng(0).uniform(-1.5, 1.5, (4, 7)).round(5)  # rad
D = np.rad2deg(Q).round(4)
SOCKET = '[[socket]]\nfile = "a.csv"\n'
DEGREES, RADIANS = '[angles]\nunit = "deg"\n', '[angles]\nunit = "rad"\n'
ARM = "cheng2018-simulation"
COMMA = 'decimal = ","\n'


def table(header, rows, delimiter=",", decimal=".", before="", end="\n"):
    """The text of a table; numbers with all digits."""
    lines = [] if header is None else [delimiter.join(header) if isinstance(header, list) else header]
    for row in rows:
        cells = [x if isinstance(x, str) else repr(float(x)).replace(".", decimal) for x in row]
        lines.append(delimiter.join(cells))
    return before + "\n".join(lines) + end


def stamped(q, stamps=("10:00:01,250", "10:00:02,500", "10:01:00,125", "10:01:07,000"), after=()):
    return [[stamp, *row, *after] for stamp, row in zip(stamps, q, strict=True)]


def numbered(name, count=6, first=1):
    return [name.format(i) for i in range(first, first + count)]


HOLES = ("A", "A", "B", "B")
LOGGED = [[f"{0.008 * i:.3f}", *Q[i, :6], *np.zeros(6)] for i in range(4)]
ROS = [[f"{1.6e9 + i:.6f}", *np.stack([Q[i], 0.1 * Q[::-1][i]], axis=1).ravel()] for i in range(4)]

# Name: arm, text of the table (or its bytes), the manifest after the arm, and the line that the refusal says to add.
RECORDERS: dict[str, tuple[str, str | bytes, str, str | None]] = {
    "measuring arm, one table for all sockets": (
        ARM,
        table(["Time", "Socket", *numbered("Enc{} [deg]"), ""],
              [[t, hole, *row, ""] for t, hole, row in zip("1234", HOLES, D[:, :6], strict=True)], ";", ","),
        SOCKET + 'group = "Socket"\n' + COMMA + '[[length]]\nfrom = "A"\nto = "B"\nvalue = 200\n', None),
    "measuring arm, decimal commas not stated": (
        ARM, table(["Time", *numbered("Enc{} [deg]")], stamped(D[:, :6]), ";", ","), SOCKET, COMMA),
    "measuring arm, units in a row of their own": (
        ARM,
        table(["Point", *numbered("J{}"), "T"], stamped(D[:, :6], after=[21.5]), "\t").replace(
            "T\n", "T\n-\t" + "\t".join(["\u00b0"] * 6) + "\t\u00b0C\n").encode("latin-1"),
        SOCKET, None),
    "measuring arm, counts": (
        ARM, table(["t_ms", *numbered("Encoder {} [counts]")], stamped(Q[:, :6] / 2 / np.pi), ";"),
        SOCKET + '[angles]\nunit = "counts"\ncounts_per_turn = 1\n', None),
    "ABB, jointtargets with external axes": (
        ARM, table("Date Time " + " ".join(numbered("rax_{}")) + " eax_a",
                        stamped(D[:, :6], ["2024-05-03 10:00:0" + i for i in "1234"], ["9E+09"]), " "),
        DEGREES + SOCKET, None),
    "ABB, lines about the recording": (
        ARM, table(["Time", *numbered("J{}")], stamped(D[:, :6]), "\t", before="Rate\t125\nTool\ttool0\n"),
        DEGREES + SOCKET, "skip = 2\n"),
    "KUKA, $AXIS_ACT with external axes": (
        ARM,
        table(["Zeit", *numbered("$AXIS_ACT.A{}"), "$AXIS_ACT.E1"], stamped(D[:, :6], after=["0,0"]), ";", ","),
        DEGREES + SOCKET + COMMA, None),
    "KUKA, axes from the last": (
        ARM, table(["Zeit", *numbered("A{}")[::-1]], stamped(D[:, 5::-1]), ";"),
        DEGREES + SOCKET, "columns = [7, 6, 5, 4, 3, 2]\n"),
    "KUKA, FRI": (
        "iiwa14", table(["index", "time", *numbered("mp{}", 7), *numbered("ip{}", 7)],
                        [[str(i), *row] for i, row in enumerate(stamped(np.hstack([Q, Q + 0.01]), "0123"))]),
        RADIANS + SOCKET, "columns = [3, 4, 5, 6, 7, 8, 9]\n"),
    "UR, RTDE": (
        ARM, table("timestamp " + " ".join(numbered("actual_q_{}", 6, 0) + numbered("actual_qd_{}", 6, 0)),
                      LOGGED, " "),
        RADIANS + SOCKET, None),
    "UR, RTDE, targets and actual values": (
        ARM, table(["timestamp", *numbered("target_q_{}", 6, 0), *numbered("actual_q_{}", 6, 0)],
                      [[*row[:1], *row[7:], *row[1:7]] for row in LOGGED]),
        RADIANS + SOCKET, "columns = [8, 9, 10, 11, 12, 13]\n"),
    "Franka, q and O_T_EE": (
        "panda", table(["time", *numbered("q_{}", 7, 0), *numbered("dq_{}", 7, 0), *numbered("O_T_EE_{}", 16, 0)],
                       stamped(np.hstack([Q, 0 * Q, np.ones((4, 16))]), "0123")),
        RADIANS + SOCKET, None),
    "Franka, libfranka's log": (
        "panda", table(", ".join(["duration", *numbered("state.q[{}]", 7, 0), *numbered("state.q_d[{}]", 7, 0)]),
                       stamped(np.hstack([Q, Q + 0.001]), "0123"), ","),
        RADIANS + SOCKET, "columns = [2, 3, 4, 5, 6, 7, 8]\n"),
    "ROS, PlotJuggler": (
        "panda", table(["__time", *(f"/joint_states/panda_joint{i}/{x}" for i in range(1, 8)
                                    for x in ("position", "velocity"))], ROS),
        RADIANS + SOCKET, None),
    "ROS, rostopic echo -p": (
        "panda", table(["%time", "field.header.frame_id", *numbered("field.name{}", 7, 0),
                        *numbered("field.position{}", 7, 0)],
                       [[str(i), "", *numbered("panda_joint{}", 7), *Q[i]] for i in range(4)]),
        RADIANS + SOCKET, "columns = [10, 11, 12, 13, 14, 15, 16]\n"),
    "spreadsheet, Unicode text": (
        ARM, codecs.BOM_UTF16_LE + table(["Zeit", *numbered("Achse {} [\u00b0]")], stamped(D[:, :6]), "\t", ",",
                                            end="\r\n").encode("utf-16-le"),
        SOCKET + COMMA, None),
    "spreadsheet, sep= and names that hold the delimiter": (
        ARM, "sep=;\r\n" + table(['"Time; UTC"', *numbered('"Joint {} (deg)"'), '"Remark"'],
                                    stamped(D[:, :6], after=['"good; seated"']), ";", before="\r\n"),
        SOCKET, None),
    "spreadsheet, everything in quotes": (
        ARM, table(["Pose", *numbered("J{} [rad]")], stamped(Q[:, :6], "1234")).replace(",", '","').replace(
            "\n", '"\n"').join('""')[:-1],
        SOCKET, None),
    "spreadsheet, joints by words": (
        ARM, table(["Time", "Base", "Shoulder", "Elbow", "Roll", "Pitch", "Yaw"],
                      stamped(D[:, :6], ["2024-05-03T10:00:0" + i for i in "1234"]), ";"),
        DEGREES + SOCKET, "columns = [2, 3, 4, 5, 6, 7]\n"),
    "spreadsheet, columns numbered": (
        ARM, table([str(i) for i in range(1, 7)], D[:, :6], ";"), DEGREES + SOCKET, "skip = 1\n"),
    "spreadsheet, joints by words and nothing else": (
        ARM, table(["Base", "Shoulder", "Elbow", "Roll", "Pitch", "Yaw"], D[:, :6]),
        DEGREES + SOCKET, "columns = [1, 2, 3, 4, 5, 6]\n"),
    "ROS, joints of a UR in the order of the alphabet": (
        ARM, table(["elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", *numbered("wrist_{}_joint", 3)],
                   D[:, [2, 1, 0, 3, 4, 5]]),
        DEGREES + SOCKET, "columns = [3, 2, 1, 4, 5, 6]\n"),
    "spreadsheet, types below the names": (
        ARM, table(numbered("J{}")[::-1], D[:, 5::-1]).replace("J1\n", "J1\n" + ",".join(["float"] * 6) + "\n"),
        DEGREES + SOCKET, "columns = [6, 5, 4, 3, 2, 1]\n"),
    "spreadsheet, descriptions above the names": (
        ARM, table(["Base", "Arm", "Elbow", "R", "P", "Y"], []) + table(["a", "b", "c", "d", "e", "f"], D[:, :6]),
        DEGREES + SOCKET + "columns = [1, 2, 3, 4, 5, 6]\n", "skip = 1\n"),
    "spreadsheet, descriptions above the names that are picked": (
        ARM, table(["Base", "Arm", "Elbow", "R", "P", "Y"], []) + table(["a", "b", "c", "d", "e", "f"], D[:, :6]),
        DEGREES + SOCKET + 'columns = ["a", "b", "c", "d", "e", "f"]\n', None),
    "spreadsheet, units above the names": (
        ARM, table(["hh:mm", *["degrees"] * 6], []) + table(["Time", *numbered("J{}")], stamped(D[:, :6], "1234")),
        SOCKET, None),
    "spreadsheet, a title below the names": (
        ARM, table(numbered("J{}")[::-1], []) + table("end of header", D[:, 5::-1]),
        DEGREES + SOCKET, "columns = [6, 5, 4, 3, 2, 1]\n"),
    "spreadsheet, decimal commas in quotes": (
        ARM, table(numbered("J{} [deg]"), [[f'"{x}"'.replace(".", ",") for x in row] for row in D[:, :6]]),
        SOCKET, COMMA),
    "spreadsheet, columns numbered and one name": (
        ARM, table(["Socket", *"123456"], [["A", *row] for row in D[:, :6]]),
        DEGREES + SOCKET + "group = 1\n", "skip = 1\n"),
    "spreadsheet, holes named #1 and #2": (
        ARM, table(["Hole", *numbered("J{}_degrees")], [[f"#{i // 2}", *row] for i, row in enumerate(D[:, :6])]),
        SOCKET + 'group = "Hole"\n', None),
    "German spreadsheet": (
        ARM, table(numbered("Achse {} (Grad)"), D[:, :6]), SOCKET, 'units = { q = "deg" }\n'),
    "two joints of one motor": (
        ARM, table(numbered("J{}"), D[:, [0, 1, 1, 3, 4, 5]]),
        DEGREES + SOCKET, "columns = [1, 2, 3, 4, 5, 6]\n"),
    "unit within the names": (
        ARM, table(numbered("q_deg_{}"), D[:, :6]), SOCKET, None),
    "unit before a word": (
        ARM, table(numbered("J{} (deg) raw"), D[:, :6]), SOCKET, None),
    "numpy.savetxt with a header": (
        ARM, table("# " + " ".join(numbered("q_{}_deg")), D[:, :6], " ", before="# recorded on Monday\n"),
        SOCKET, None),
    "MATLAB, fixed width": (
        ARM, table("     t [s]   " + "   ".join(numbered("theta_{} [deg]")), stamped(D[:, :6], "1234"), "   "),
        SOCKET, None),
}  # fmt: skip


def read(tmp_path, content, manifest, arm=ARM):
    (tmp_path / "a.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    (tmp_path / "m.toml").write_text(f'arm = "{arm}"\n{manifest}')
    return aj.files.read_manifest(tmp_path / "m.toml").capture


@pytest.mark.first_rows(3)
@pytest.mark.parametrize("recorder", RECORDERS)
def test_tables_of_recorders(tmp_path, recorder):
    """The line that a refusal names is the one that makes the table be read."""
    arm, content, manifest, line = RECORDERS[recorder]
    if line is not None:
        sentence = refusal(lambda: read(tmp_path, content, manifest, arm))
        assert f"add {line.strip()}" in sentence or f"or {line.strip()}" in sentence, sentence
        assert len(sentence.replace(str(tmp_path), "")) < 500
        manifest += line
    assert len(f"arm\n{manifest}".splitlines()) <= 10
    capture = read(tmp_path, content, manifest, arm)
    joints = aj.load_arm(arm).joints
    expected = Q[:, [0, 1, 1, 3, 4, 5]] if "one motor" in recorder else Q[:, :joints]
    np.testing.assert_allclose(np.concatenate(list(capture.sockets.values())), expected, atol=2e-6)
    if "all sockets" in recorder:
        assert (capture.names, capture.sizes, len(capture.lengths)) == (("A", "B"), (2, 2), 1)


def test_there_are_twenty_of_them():
    assert len(RECORDERS) >= 20


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("columns", "stated"),
    [
        ('columns = ["A1", "A2", "A3", "A4", "A5", "A6"]', ""),
        ('columns = "a[1-6]"', ""),
        ("columns = { q = [3, 4, 5, 6, 7, 8] }", ""),
        ("", 'columns = "A*"'),
        ("", 'columns = ["A1", "A2", 5, 6, 7, "A6"]'),
        ('preset = "csv"', ""),
    ],
)
def test_columns_by_name_pattern_and_number(tmp_path, columns, stated):
    """In [[socket]], [[sphere]] and [angles]."""
    rows = [[hole, 1.0, *row] for hole, row in zip(HOLES, D[:, :6], strict=True)]
    text = table(["Hole", "A1 speed", *numbered("A{}")], rows)
    text = text.replace("A1 speed", "Speed of A1") if "*" in stated else text
    socket = f'{SOCKET}name = "plate"\ngroup = "Hole"\n{columns}\n'
    sphere = f'[[sphere]]\nname = "S"\ntest = "probing"\ndiameter = 25\nfile = "a.csv"\ngroup = 1\n{columns}\n'
    capture = read(tmp_path, text, DEGREES + stated + "\n" + socket)
    assert capture.names == ("plate/A", "plate/B")
    np.testing.assert_allclose(capture.q, Q[:, :6], atol=2e-6)
    read(tmp_path, text, DEGREES + stated + "\n" + socket + sphere)
    (found,) = aj.files.read_manifest(tmp_path / "m.toml").spheres
    assert [len(group) for group in found.groups] == [2, 2]


def test_order_stated_by_hand_is_taken(tmp_path):
    text = table(numbered("A{}")[::-1], D[:, 5::-1])
    as_stated = read(tmp_path, text, DEGREES + SOCKET + "columns = [1, 2, 3, 4, 5, 6]\n")
    np.testing.assert_allclose(as_stated.q, Q[:, 5::-1], atol=2e-6)
    for line in ("", 'columns = "A*"\n'):
        assert_refused(lambda line=line: read(tmp_path, text, DEGREES + SOCKET + line), "columns = [6, 5, 4, 3, 2, 1]")


HEADERS = ["rad", "deg", "gon", "grad", "mrad", "arcsec", "counts", "mm", "m", "um", "inch", "cm", "\u00b0", "Nm", "A",
           "V", "s", "rad/s", "\u00b0C", "%", "rev", "dge", "radd", "ticks", "urad", "K"]  # fmt: skip
SAME = {"\u00b0": "deg"}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("header", HEADERS)
def test_units_that_contradict_the_manifest(tmp_path, header):
    """In brackets of both kinds, at the end of names and in a row of their own; alone they serve, or are refused."""
    unit = SAME.get(header, header)
    texts = [table(numbered(name.format("{}", header)), Q[:, :6]) for name in ("q{} [{}]", "q{} ({})")]
    if header not in ("dge", "radd"):
        texts.append(table(numbered("q{}"), Q[:, :6]).replace("q6\n", "q6\n" + ",".join([header] * 6) + "\n"))
    if unit in ANGLE_UNITS:
        texts.append(table(numbered(f"q{{}}_{unit}"), Q[:, :6]))
    arm = aj.load_arm(ARM)
    for text in texts:
        (tmp_path / "a.csv").write_text(text)
        file = TextTable(tmp_path / "a.csv")
        for stated in sorted({"deg", "rad", "gon"} - {unit}):
            if unit == "grad" and stated != "rad":
                continue
            for angles, of_table in ((Angles(unit=stated), None), (None, stated)):
                wanted = Wanted(None, of_table, None, [])
                sentence = refusal(lambda file=file, angles=angles, wanted=wanted: Readings(arm, angles)(file, wanted))
                assert {"ticks": "counts"}.get(unit, unit).casefold() in sentence, sentence
                assert stated in sentence, sentence
        nothing = Wanted(None, None, None, [])
        if unit in ANGLE_UNITS:
            np.testing.assert_allclose(Readings(arm, None)(file, nothing), ANGLE_UNITS[unit] * Q[:, :6])
        else:
            refusal(lambda file=file, nothing=nothing: Readings(arm, None)(file, nothing))
    stated = "rad" if unit in ("deg", "grad") else "deg"
    refusal(lambda: read(tmp_path, texts[0], f'{SOCKET}units = {{ q = "{stated}" }}\n'))


@pytest.mark.parametrize(
    ("header", "unit", "parts"),
    [
        (["X [inch]", "Y [inch]", "Z [inch]"], "mm", ["the header of the points says inch, but the manifest says mm"]),
        (["x_m", "y_m", "z_m"], "mm", ["says m, but the manifest says mm"]),
        (["X [deg]", "Y [deg]", "Z [deg]"], None, ["points are in 'deg'", "mm, m, um, inch"]),
        (["X", "Y", "Z"], None, ["does not state the unit of its points", 'add unit = "mm" to [points]']),
        (["P3", "P2", "P1"], "mm", ["in the order 'P3', 'P2', 'P1'; add columns = [3, 2, 1]"]),
        (["n", "X", "Y", "W"], "mm", ["has the columns x, y, but no column 'z'"]),
        (["t", "a", "b", "c"], "mm", ["the columns 1 't', 2 'a'", "add columns = [2, 3, 4] with these three"]),
        (["Z [mm]", "Y [mm]", "X [mm]", "Hole"], None, None),
    ],
)
def test_points_of_manifests_of_points(tmp_path, header, unit, parts):
    rows = np.random.default_rng(1).uniform(-900, 900, (4, 3)).round(3)
    cells = [[*("0123"[i] for _ in range(header.index(next(x for x in header if x not in ("n", "t"))))), *row]
             for i, row in enumerate(rows)]  # fmt: skip
    cells = [[*row, hole] for row, hole in zip(cells, HOLES, strict=True)] if "Hole" in header else cells
    (tmp_path / "a.csv").write_text(table(header, cells, ";", ","))
    stated = "" if unit is None else f'unit = "{unit}"\n'
    (tmp_path / "p.toml").write_text(f"[points]\n{stated}{SOCKET}{COMMA}" + ('group = "Hole"' if parts is None else ""))
    if parts is not None:
        assert_refused(lambda: aj.files.read_points(tmp_path / "p.toml"), *parts)
        return
    found = aj.files.read_points(tmp_path / "p.toml").sockets
    assert list(found) == ["A", "B"]
    np.testing.assert_array_equal(found["B"], rows[2:, ::-1])


JOINTS = ",".join(numbered("J{}")) + "\n"
SIX = ",".join(f"{x}" for x in Q[0, :6]) + "\n"


@pytest.mark.first_rows(10)
@pytest.mark.parametrize(
    ("content", "stated", "parts"),
    [
        *((",".join(numbered("J{}")[::-1]) + "\n" + ",".join([word] * 6) + "\n" + SIX, "", ["in the order 'J6'"])
          for word in ("float", "raw")),
        *((JOINTS + ",".join([word] * 6) + "\n" + SIX, "", ["line 2 column 1", "is not a number"])
          for word in ("NA", "null", "None", "N/A", "-", "\u22120.5", "(0.5)", "=0.5", "$0.5")),
        (JOINTS + ",".join(["radiants"] * 6) + "\n" + SIX, "", ["has readings of revolute joints in 'radiants'"]),
        (JOINTS + "deg,deg,deg,dge,deg,deg\n" + SIX, "", ["mixes units: 'J6 [deg]' is in deg, 'J4 [dge]' is in dge"]),
        (",".join(["meter"] + ["deg"] * 5) + "\n" + JOINTS + SIX, "", ["mixes units: 'J1 [meter]' is in m"]),
        (",".join(["rads"] * 6) + "\n" + JOINTS + SIX, "", ["says rad, but the manifest says deg"]),
        ("Base,Arm,Elbow,R,P,Y\n" + ",".join(["int"] * 6) + "\n" + SIX, "",
         ["line 1 ('Base, Arm, Elbow and 3 more') and line 2", "add skip = 1 if line 2 contains the names"]),
        ("# J6,J5,J4,J3,J2,J1\n# by hand\n" + SIX, "", ["in the order 'J6'"]),
        ("F,E,D,C,B,A\n" + SIX, "", [
            "add columns = [1, 2, 3, 4, 5, 6] if these columns are the readings of the joints"
        ]),
        *((",".join(numbered(name)) + "\n" + SIX, "", ["says rad, but the manifest says deg"])
          for name in ("J{}_radians", "q_rad_{}", "J{} (rad) raw", "J{}.rad")),
        (",".join(numbered("J{}_mdeg")) + "\n" + SIX, "", ["has readings of revolute joints in 'mdeg'"]),
        (",".join(numbered("J{} [Grad]")) + "\n" + SIX, 'units = { q = "rad" }\n', ["grad means deg in German"]),
        (JOINTS + SIX + "#" + SIX, "", ["line 3 begins with #", "remove the # from its first cell"]),
        (JOINTS + "#N/A" + SIX[SIX.index(","):] + SIX, "", ["line 2 begins with #"]),
        ("J1,J2,J3,J4,J5,J6,Load\n" + SIX.replace("\n", ",1\n"), 'group = "J1"\n',
         ["column 1 'J1' is one of the joint readings, but is also picked as group"]),
        (JOINTS + SIX, 'group = "J1"\ncolumns = "J*"\n', ["column 1 'J1' is one of the joint readings"]),
        ("Socket,1,2,3,4,5,6\nA," + SIX, 'group = "Socket"\n', ["no column 'Socket'; the table has 7 columns"]),
        (",".join(numbered("q{}_rad/s")) + "\n" + SIX, "", ["readings of revolute joints in 'rad/s' (column 'q1_"]),
        ("J6,J5,J4,J3,J2,J1\nbegin,data\n" + SIX, "", ["in the order 'J6'"]),
        ("Time,J6,J5,J4,J3,J2,J1\n" + SIX, "", ["6 columns, but 7 names in the header", "correct the header"]),
        ("a,b\n1,2\n", "", ["[[socket]] 'a': "]),
    ],
)  # fmt: skip
def test_headers_that_are_not_ignored(tmp_path, content, stated, parts):
    assert_refused(lambda: read(tmp_path, content, DEGREES + SOCKET + stated), *parts)


@pytest.mark.parametrize(
    ("names", "stated", "part"),
    [
        ("z_mm,y_mm,x_mm", 'columns = { points = "[xyz]_mm" }', "in the order of the axes: [9, 8, 7]"),
        ("z_mm,y_mm,x_mm", 'preset = "csv"', None),
        ("z_mm,y_mm,x_mm", 'preset = "ipa"', None),
        ("z_cm,y_cm,x_cm", 'columns = { points = ["x_cm", "y_cm", "z_cm"] }', "the points are in 'cm'"),
        ("z_inches,y_inches,x_inches", 'columns = { points = [9, 8, 7] }', None),
    ],
)  # fmt: skip
def test_columns_of_positions(tmp_path, names, stated, part):
    text = ",".join(numbered("q{}")) + f",{names}\n" + 3 * SIX.replace("\n", ",300,200,100\n")
    points = f"{RADIANS}[[points]]\nfile = 'a.csv'\n{stated}\n"
    if part is not None:
        assert_refused(lambda: read(tmp_path, text, points), part)
        return
    (found,) = read(tmp_path, text, points).observations
    np.testing.assert_allclose(found.points[0], np.array([100, 200, 300]) * (25.4 if "inch" in names else 1))


NUMBERS = "0.12345,1.12345,2.12345,3.12345,4.12345,-2.12345\n"


@pytest.mark.first_rows(9)
@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (
            3 * NUMBERS + NUMBERS[:-3],
            ["line 4: the last number, '-2.123', has fewer digits", "add a line break if the file is"],
        ),
        (
            3 * NUMBERS.replace("\n", "e-05\n") + NUMBERS[:-1] + "e-0",
            ["line 4: the last number", "copy the file again"],
        ),
        (3 * NUMBERS.replace("\n", "e-05\n") + NUMBERS[:-1] + "e-", ["'-2.12345e-', has fewer digits"]),
        (3 * NUMBERS + NUMBERS[:30], ["line 4 has 4 columns", "copy the file again if it is incomplete"]),
        (
            "J1,J2,J3,J4,J5,J6\n" + 6 * "0,5,1,5" + "\n",
            ["but 6 names in the header", "if it was confused with a decimal comma"],
        ),
        (
            "J1,J2,J3,J4,J5,J6,J7\n0.5," + NUMBERS,
            ["7 'J7', but it is not clear", "pick one column per joint with"],
        ),
        (
            "6,5,4,3,2,1\n" + NUMBERS,
            ["line 1 contains the column numbers 6 to 1", "add skip = 1 and columns = [6, 5, 4, 3, 2, 1]"],
        ),
        ("q1,q2,q3,q4,q5,q7\n" + NUMBERS, ["the columns 1 'q1'", "add columns = [1, 2, 3, 4, 5, 6] if"]),
        ("x,y,z,rx,ry,rz\n" + NUMBERS, ["6 'rz', but it is not clear which columns", "add columns = [1, 2"]),
        ("x,".replace("x", "n" * 10**5) * 6 + "\n" + "0.5,1,2,3,4,5,6\n", ["1 'nnnnnnnnnnnnnnnnnnnnn', 2"]),
        (",".join(f"s {i}" for i in range(2000)) + "\n" + ",".join(["0.5"] * 2000), ["1 's 0'", "1988 more"]),
        ("0.5,1,2,3,4," + "x" * 10**4, ["line 1 column 6: 'xxx", "...' is not a number"]),
        (
            "0.5;1;2;3;4;1.234,5\n",
            ["column 6: '1.234,5' is not a number", "without quotes and thousands separators"],
        ),
        (bytes(10**6), ["cannot be read as text; save it as text in UTF-8"]),
        (NUMBERS.encode("utf-16-le"), ["cannot be read as text"]),
        (NUMBERS.encode("utf-32"), ["cannot be read as text"]),
        ("\u0394,".encode("cp1253") * 6 + b"\n", ["cannot be read as text; save it as text in UTF-8"]),
        (b"0\n" * 2_000_001, ["has more than the 2,000,000 lines that a text table may have; split the table"]),
        (NUMBERS + "0.5," * 300_000, ["line 2 is longer than 1 MiB", "not a row of a table"]),
    ],
)
def test_what_is_no_table(tmp_path, content, parts):
    """In one sentence that is short, whatever the file holds."""
    sentence = refusal(lambda: read(tmp_path, content, RADIANS + SOCKET))
    assert all(part in sentence for part in parts), sentence
    assert len(sentence.replace(str(tmp_path), "")) < 500


def test_decimal_commas_stated_where_there_are_points(tmp_path):
    parts = ("is not a number with the decimal mark ','", "or remove decimal")
    assert_refused(lambda: read(tmp_path, NUMBERS.replace(",", ";"), RADIANS + SOCKET + COMMA), *parts)


def test_a_complete_file_without_the_end_of_its_last_line(tmp_path):
    other = NUMBERS.replace("1.", "7.")
    for text in (NUMBERS[:-1], NUMBERS + other[:-2], 3 * other + NUMBERS[:-1]):
        assert read(tmp_path, text, RADIANS + SOCKET).q.shape[1] == 6


def test_large_files_are_refused_before_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setenv("AACMM_LARGEST_FILE_MB", "8")
    with open(tmp_path / "a.csv", "wb") as stream:
        stream.truncate(2**21)
    sentence = "has 2 MiB, more than the limit of 1 MiB"
    assert_refused(lambda: TextTable(tmp_path / "a.csv"), sentence, "AACMM_LARGEST_FILE_MB")
    (tmp_path / "m.toml").write_text(f'arm = "panda"\n{RADIANS}{SOCKET}')
    assert_refused(lambda: aj.files.read_manifest(tmp_path / "m.toml"), sentence)


@pytest.mark.slow
@hypothesis.settings(
    deadline=None, max_examples=25, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture]
)
@hypothesis.given(
    q=st.lists(st.lists(st.floats(-6, 6), min_size=6, max_size=6), min_size=1, max_size=5),
    marks=st.sampled_from([(",", "."), (";", "."), ("\t", "."), (" ", "."), (";", ","), ("\t", ","), (" ", ",")]),
    unit=st.sampled_from(sorted(ANGLE_UNITS)),
    named=st.sampled_from(["q{} [{}]", "Joint{}_{}", "A{} ({})", None]),
    stamp=st.sampled_from([None, "10:00:01", "0.25", "2024-05-03T10:00:00Z"]),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]),
)
def test_readings_come_back(tmp_path, q, marks, unit, named, stamp, end, encoding):
    """However they are written: delimiter, decimal mark, unit, time stamps, names, ends of lines, encoding."""
    (delimiter, decimal), values = marks, np.array(q) / ANGLE_UNITS[unit]
    hypothesis.assume(len({*map(tuple, values)}) == len(q))
    hypothesis.assume(len(q) < 3 or len({*map(tuple, values.T)}) == 6)
    header = None if named is None else [*["Time"] * (stamp is not None), *(named.format(i, unit) for i in range(1, 7))]
    rows = [[*[stamp] * (stamp is not None), *row] for row in values]
    manifest = "" if named else f'[angles]\nunit = "{unit}"\n'
    manifest += SOCKET + (COMMA if decimal == "," else "")
    manifest += "columns = [2, 3, 4, 5, 6, 7]\n" if stamp and not named else ""
    text = table(header, rows, delimiter, decimal).replace("\n", end)
    np.testing.assert_allclose(read(tmp_path, text.encode(encoding), manifest).q, q, rtol=1e-14)

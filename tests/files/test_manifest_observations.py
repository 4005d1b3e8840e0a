"""Observations in a manifest: columns of text tables of every make, conventions of rotations, presets, bad columns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.data.observations.pixels import Pixels
from aacmm_jax.data.observations.simulated import kinds as known_kinds
from aacmm_jax.files.manifest_tables import TABLES
from tests.refusals import assert_refused

HEAD = 'arm = "cheng2018-simulation"\n[angles]\nunit = "rad"\n'
RANDOM = np.random.default_rng(0)
Q = RANDOM.uniform(-3, 3, (5, 6))
P = RANDOM.uniform(-900, 900, (5, 3))
U = RANDOM.uniform(0.01, 0.1, (5, 3))
R = Rotation.random(5, random_state=0)
NAMES = ["q1", "q2", "q3", "q4", "q5", "q6", "x", "y", "z", "ux", "uy", "uz"]
NUMBERS = "columns = { q = [1, 2, 3, 4, 5, 6], points = [7, 8, 9], u = [10, 11, 12] }\n"
ALL = 'columns = { q = "q?", points = ["x", "y", "z"], u = ["ux", "uy", "uz"] }\n'


def write(path, values, header=NAMES, delimiter=",", decimal=".", before=""):
    lines = [delimiter.join(header)] if header is not None else []
    for row in values:
        cells = [cell if isinstance(cell, str) else repr(float(cell)).replace(".", decimal) for cell in row]
        lines.append(delimiter.join(cells))
    path.write_text(before + "\n".join(lines) + "\n")


def read(tmp_path, text):
    (tmp_path / "capture.toml").write_text(HEAD + text)
    return aj.files.read_manifest(tmp_path / "capture.toml").capture.observations


def test_every_kind_has_a_table():
    assert set(TABLES) == set(known_kinds().values()) - {Pixels}  # tests/files/test_manifest_pixels.py


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("table", "stated", "factor"),
    [
        ({}, "", 1.0),
        ({"delimiter": ";", "decimal": ","}, 'decimal = ","\n', 1.0),
        ({"delimiter": "\t"}, "", 1.0),
        ({"delimiter": " ", "decimal": ","}, 'decimal = ","\ndelimiter = " "\n', 1.0),
        ({"before": "7 points\nof 1.5 m\n"}, "skip = 2\n", 1.0),
        ({}, 'units = { points = "inch", u = "um" }\n', 25.4),
        ({}, 'units = { points = "m" }\ncoverage_factor = 2.0\n', 1000.0),
        # By number, with a header, or without one.
        ({}, NUMBERS, 1.0),
        ({"header": None}, NUMBERS, 1.0),
        # Other case, more blanks, quotes, units in brackets or in a line of their own.
        ({"header": [*(f"Q{i} [rad]" for i in range(1, 7)), *NAMES[6:]]}, "", 1.0),
        ({"header": ["Q1", "Q2", "Q3", "Q4", "Q5", "Q6", *NAMES[6:]]}, ALL.replace("q?", "q[1-6]"), 1.0),
        ({"header": [*NAMES[:6], "X (m)", "Y (m)", "Z (m)", "UX  [mm]", "UY [mm]", '"uz"']}, "", 1000.0),
        ({"header": [*NAMES[:6], "x [\u00b5m]", "y [\u03bcm]", "z [um]", "ux", "uy", "uz"]}, "", 1e-3),
        ({"header": [*NAMES[:6], "x [in]", "y [in]", "z [in]", "ux", "uy", "uz"]}, "", 25.4),
        ({"before": ",".join(NAMES) + "\n", "header": ["rad"] * 6 + ["m"] * 3 + ["mm"] * 3}, "", 1000.0),
        # Half the rows, then the other half, by a column of names.
        ({"groups": True}, 'group = "when"\n', 1.0),
    ],
)
def test_tables_of_every_make(tmp_path, table, stated, factor):
    rows, options = np.hstack([Q, P, U]).tolist(), {"header": NAMES} | table
    groups = options.pop("groups", False)
    if groups:
        rows, options["header"] = [[*row, "ab"[i % 2]] for i, row in enumerate(rows)], [*NAMES, "when"]
    write(tmp_path / "a.csv", rows, **options)
    columns = stated if "columns" in stated else f"{stated}{ALL}"
    found = read(tmp_path, f'[[points]]\nfile = "a.csv"\ntarget = "ball"\n{columns}')
    assert [one.name for one in found] == (["a/a", "a/b"] if groups else ["a"])
    assert {(one.target, one.kind) for one in found} == {("ball", "points")}
    order = [0, 2, 4, 1, 3] if groups else list(range(5))
    assert np.array_equal(np.concatenate([one.q for one in found]), Q[order])
    assert np.allclose(np.concatenate([one.points for one in found]), factor * P[order], rtol=1e-15)
    scale = 1e-3 if '"um"' in stated else 0.5 if "coverage" in stated else 1.0
    covariance = np.concatenate([one.covariance for one in found])
    assert np.allclose(np.sqrt(np.einsum("mii->mi", covariance)), scale * U[order], rtol=1e-12)


def test_readings_have_signs_and_offsets(tmp_path):
    """reading -> sign * (reading - offset), a joint each, in the unit of the table."""
    sign, offset = np.array([1, -1, 1, 1, -1, 1]), np.array([0, 90, 0, -30, 0, 0.5])
    write(tmp_path / "a.csv", np.hstack([np.rad2deg(Q), P, U]))
    angles = f'arm = "cheng2018-simulation"\n[angles]\nunit = "deg"\nsign = {sign.tolist()}\n'
    text = f'offset = {offset.tolist()}\n[[points]]\nfile = "a.csv"\n{ALL}'
    (tmp_path / "capture.toml").write_text(angles + text)
    (one,) = aj.files.read_manifest(tmp_path / "capture.toml").capture.observations
    assert np.allclose(one.q, sign * (Q - np.deg2rad(offset)), rtol=1e-12)
    assert np.array_equal(one.points, P)


# Header, rows from readings and measured values, and the table of the manifest that names the preset.
LEICA = ["X  [mm]", "Y  [mm]", "Z  [mm]", "U(95)  [mm]", "U(95) X  [mm]", "U(95) Y  [mm]", "U(95) Z  [mm]"]
LEICA += ["Tilt  [deg]", "Q0 ", "Q1 ", "Q2 ", "Q3 ", "Image RMS  [\u00b5m]", "Target", "Temperature  [\u00b0C]"]
PRESETS = {
    "csv as planned": ([*(f"q_{i}_deg" for i in range(1, 7)), "x_mm", "y_mm", "z_mm", "u_x_mm", "u_y_mm", "u_z_mm"],
                       lambda i: [*np.rad2deg(Q[i]), *P[i], *U[i]], 'preset = "csv"'),
    "csv in rad": ([*(f"Q{i}_rad" for i in range(1, 7)), "X", "Y", "Z", "u_x", "u_y", "u_z"],
                   lambda i: [*Q[i], *P[i], *U[i]], 'preset = "csv"'),
    "ipa": ([*(f"q{i}_rad" for i in range(1, 7)), "x_mm", "y_mm", "z_mm", "std_x_mm", "std_y_mm", "std_z_mm"],
            lambda i: [*Q[i], *P[i], *U[i]], 'preset = "ipa"'),
    "leica": (LEICA, lambda i: [*P[i], 0.01, *2 * U[i], 30.0, *R[i].as_quat(scalar_first=True), 0.2, "TMC 30-B #53",
                                22.8], 'preset = "leica"\nreadings = "q.csv"'),
    "older leica": (["Name", "X", "Y", "Z", "U95 X", "U95 Y", "U95 Z"], lambda i: [f"m{i}", *P[i], *2 * U[i]],
                    'preset = "leica"\nreadings = "q.csv"'),
    "xyzijk": (["X", "Y", "Z", "I", "J", "K"], lambda i: [*P[i], 0.0, 0.0, 1.0],
               'preset = "xyzijk"\nreadings = "q.csv"'),
    "xyzijk after a name": (["Point", "x [mm]", "y [mm]", "z [mm]", "I", "J", "K"],
                            lambda i: [f"P{i}", *P[i], 0.0, 0.0, 1.0], 'preset = "xyzijk"\nreadings = "q.csv"'),
    "xyzijk without a header": (None, lambda i: [*P[i], 0.0, 0.0, 1.0], 'preset = "xyzijk"\nreadings = "q.csv"'),
}  # fmt: skip


@pytest.mark.first_rows(3)
@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("delimiter", [",", ";"])
def test_presets(tmp_path, name, delimiter):
    header, row, stated = PRESETS[name]
    write(tmp_path / "q.csv", Q, header=[f"q{i} [rad]" for i in range(6)])
    write(tmp_path / "a.csv", [row(i) for i in range(5)], header=header, delimiter=delimiter)
    text = f'arm = "cheng2018-simulation"\n[[points]]\nfile = "a.csv"\n{stated}\n'  # the unit is in the header
    (tmp_path / "capture.toml").write_text(text)
    (one,) = aj.files.read_manifest(tmp_path / "capture.toml").capture.observations
    assert np.allclose(one.q, Q, rtol=1e-14)
    assert np.allclose(one.points, P, rtol=1e-14)
    has_u = not name.startswith("xyzijk")
    assert np.allclose(np.sqrt(np.einsum("mii->mi", one.covariance)), U if has_u else 0.0)


def test_columns_by_number_and_readings_in_a_file_of_their_own(tmp_path):
    write(tmp_path / "q.csv", np.rad2deg(Q), header=None)
    write(tmp_path / "p.csv", [[f"P{i}", *row] for i, row in enumerate(P)], header=None, delimiter=";")
    text = '[[points]]\nfile = "p.csv"\nreadings = "q.csv"\nu = 0.02\nname = "tracker"\nstation = "S1"\n'
    (one,) = read(tmp_path, text + 'columns = { points = [2, 3, 4] }\nunits = { q = "deg" }\n')
    assert np.allclose(one.q, Q)
    assert np.array_equal(one.points, P)
    assert np.allclose(one.covariance, 0.02**2 * np.eye(3))
    assert (one.name, one.station) == ("tracker", "S1")


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("rotation", "numbers", "unit"),
    [
        ("XYZ", R.as_euler("XYZ", degrees=True), "deg"),
        ("zyx", R.as_euler("zyx", degrees=True), "deg"),
        ("ZYZ", R.as_euler("ZYZ"), "rad"),
        ("vector", R.as_rotvec(), "rad"),
        ("quaternion wxyz", R.as_quat(scalar_first=True), None),
        ("quaternion xyzw", R.as_quat(), None),
        ("matrix", R.as_matrix().reshape(-1, 9), None),
    ],
)
def test_rotations(tmp_path, rotation, numbers, unit):
    names = [f"r{i}" for i in range(numbers.shape[1])]
    write(tmp_path / "a.csv", np.hstack([Q, P, numbers]), header=[*NAMES[:9], *names])
    units = f'units = {{ rotations = "{unit}" }}\n' if unit else ""
    columns = 'columns = { q = "q?", points = ["x", "y", "z"], rotations = "r*" }\n'
    (one,) = read(
        tmp_path, f'[[transforms]]\nfile = "a.csv"\nu_angle = 0.001\nrotation = "{rotation}"\n{units}{columns}'
    )
    assert np.allclose(one.rotations, R.as_matrix(), atol=1e-12)
    assert float(one.u_angle) == 0.001


def test_moving_axes_are_turned_in_the_order_of_their_columns(tmp_path):
    """The convention as the documents state it, without the library that computes it."""
    write(tmp_path / "a.csv", np.hstack([Q, P, np.tile([30.0, 0.0, 90.0], (5, 1))]), header=[*NAMES[:9], "a", "b", "c"])
    columns = 'columns = { q = "q?", points = ["x", "y", "z"], rotations = ["a", "b", "c"] }\n'
    text = '[[transforms]]\nfile = "a.csv"\nu_angle = 0.001\nunits = { rotations = "deg" }\nrotation = "XYZ"\n'
    (one,) = read(tmp_path, text + columns)
    c, s = np.cos(np.pi / 6), 0.5
    about_x, about_z = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert np.allclose(one.rotations[0], about_x @ about_z, atol=1e-15)


def test_a_tracker_export(tmp_path):
    """U(95) is twice the standard uncertainty, and the scalar part of the quaternion comes first."""
    write(tmp_path / "q.csv", Q, header=None)
    header = ["Name", "X", "Y", "Z", "U95 X", "U95 Y", "U95 Z", "Q0", "Q1", "Q2", "Q3"]
    rows = [[f"m{i}", *P[i], *2 * U[i], *R[i].as_quat(scalar_first=True)] for i in range(5)]
    write(tmp_path / "t.csv", rows, header=header, delimiter=";")
    text = '[[transforms]]\nfile = "t.csv"\nreadings = "q.csv"\npreset = "leica"\nu_angle = 2.0\n'
    (one,) = read(tmp_path, text + 'units = { u_angle = "arcsec" }\n')
    assert np.allclose(one.rotations, R.as_matrix())
    assert np.allclose(np.sqrt(np.einsum("mii->mi", one.covariance)), U)
    assert np.isclose(float(one.u_angle), 2 * aj.units.ARCSEC)


def test_a_point_list(tmp_path):
    write(tmp_path / "q.csv", Q, header=None)
    write(tmp_path / "p.txt", np.hstack([P, R.as_rotvec()]), header=["X", "Y", "Z", "I", "J", "K"], delimiter=" ")
    (one,) = read(tmp_path, '[[points]]\nfile = "p.txt"\nreadings = "q.csv"\npreset = "xyzijk"\n')
    assert np.array_equal(one.points, P)


def test_groups_and_names_of_points(tmp_path):
    held = ["a", "b", "a", "b", "b"]
    rows = [[*Q[i], held[i], "left" if i < 3 else "right", P[i, 0] + 1000] for i in range(5)]
    write(tmp_path / "a.csv", rows, header=[*NAMES[:6], "ball", "place", "d"])
    left, right = read(
        tmp_path,
        '[[artefact]]\nname = "bar"\nfile = "a.csv"\nartefact = "bar 1"\nu = 1.0\nunits = { u = "um" }\n'
        'group = "place"\ncolumns = { point = "ball" }\ncoordinates = { a = [0.0, 0.0, 0.0], b = [300.5, 0.0, 0.0] }\n',
    )
    assert (left.name, right.name, left.artefact) == ("bar/left", "bar/right", "bar 1")
    assert np.array_equal(left.q, Q[[0, 2, 1]])
    assert (left.point, right.point) == (("a", "a", "b"), ("b", "b"))
    assert np.array_equal(left.coordinates[1], [300.5, 0, 0])
    assert float(left.u) == 0.001
    (distances,) = read(
        tmp_path, '[[distances]]\nfile = "a.csv"\nu = 0.003\nconstant = true\ncolumns = { values = "d" }\n'
    )
    assert np.array_equal(distances.values, P[:, 0] + 1000)
    assert distances.constant


def test_touched_surfaces_and_files_by_name(tmp_path):
    write(tmp_path / "one_a.csv", Q[:3], header=None)
    write(tmp_path / "other_a.csv", Q[3:], header=None)
    write(tmp_path / "ball.csv", Q, header=None)
    planes, sphere, cylinder, plane, socket = sorted(
        read(
            tmp_path,
            '[[parallel_planes]]\nname = "block {x}"\nfiles = { one = "one_{x}.csv", other = "other_{x}.csv" }\n'
            "distance = 100.0\nu = 0.001\nstylus = 6.0\ninside = true\n"
            '[[touched_sphere]]\nfile = "ball.csv"\ndiameter = 1.0\nunits = { diameter = "inch" }\n'
            '[[touched_cylinder]]\nname = "ring"\nfile = "ball.csv"\ndiameter = 20.0\nstylus = 6.0\n'
            'inside = true\nform = 2.0\nunits = { form = "um" }\n'
            '[[plane]]\nname = "wall"\nfile = "ball.csv"\n[[socket]]\nname = "z"\nfile = "ball.csv"\ntarget = "T"\n',
        ),
        key=lambda one: ["parallel planes", "sphere", "cylinder", "plane", "socket"].index(one.kind),
    )
    assert (planes.name, planes.side.count("one"), float(planes.certified_size)) == ("block a", 3, 94.0)
    assert float(sphere.radius) == 12.7
    assert (float(cylinder.radius), float(cylinder.form)) == (7.0, 0.002)
    assert (plane.name, socket.target) == ("wall", "T")


@pytest.mark.first_rows(10)
@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (ALL.replace('"x"', '"xx"'), ["a.csv has no column 'xx'; the table has the columns 1 'q1', 2 'q2'"]),
        (ALL.replace('"x"', "20"), ["a.csv has no column '20'; the table has"]),
        (ALL.replace('"x"', '"y"'), ["pick the same column twice"]),
        (ALL.replace('"q?"', '"q[1-3]"'), ["3 columns are picked for the readings", "6 joints"]),
        (ALL.replace("points =", "point ="), ["no 'point'", "did you mean 'points'?"]),
        (ALL.replace(', "z"]', "]"), ["points needs 3 columns, but 2 are picked"]),
        ('columns = { q = "q?" }', ["no 'points' (measured point)", "pick its columns"]),
        (ALL + 'units = { points = "cm" }', ["the points are in 'cm'", "mm, m, um, inch"]),
        # Mixed units: in one header, or in header and manifest.
        (
            ALL.replace('"x", "y"', '"x [m]", "y [mm]"'),
            ["mixes units: 'x [m]' is in m, 'y [mm]' is in mm", "convert the columns to the same unit"],
        ),
        (
            ALL.replace('"x", "y"', '"y", "y_mm"') + 'units = { points = "inch" }',
            ["the header of the points says mm, but the manifest says inch"],
        ),
        (ALL.replace('"x", "y", "z"', '"a", "b", "c"'), ["the points are in 'cm'", "one of mm, m, um, inch"]),
        (ALL.replace('"q?"', '"p?"'), ["the header of the readings says deg, but the manifest says rad"]),
        (ALL + 'units = { q = "degrees" }', ["the readings are in 'degrees'", "rad, deg"]),
        (ALL + "u = 0.1", ["u is given both as a key and in columns"]),
        (ALL + 'readings = "short.csv"', ["5 rows of 'points'", "2 readings"]),
        (ALL + 'files = ["a.csv"]', ["needs either file or files"]),
        (ALL + "group = 99", ["no column '99'"]),
        (ALL + "skip = -1", ["'points 1.skip' must be greater"]),
        (ALL + 'preset = "excel"', ["'points 1.preset' must be"]),
        (ALL + "dimaeter = 3", ["unknown key 'points 1.dimaeter'"]),
        (ALL + 'delimiter = ";"', ["has no column"]),
        (ALL + "coverage_factor = 0", ["greater than 0"]),
        (ALL + 'target = "{x}"', ["target uses the field x"]),
        (ALL + "[[points]]", ["needs either file or files"]),
    ],
)
def test_bad_columns(tmp_path, text, parts):
    more = ["x [m]", "y [mm]", "y_mm", "a [cm]", "b [cm]", "c [cm]", *(f"p{i} [deg]" for i in range(6))]
    mixed = "x [m]" in text or "y_mm" in text or '"a"' in text or "p?" in text
    header = [*NAMES, *more] if mixed else NAMES
    write(tmp_path / "a.csv", np.hstack([Q, P, U, np.ones((5, len(header) - 12))]), header=header)
    write(tmp_path / "short.csv", np.hstack([Q, P, U])[:2])
    assert_refused(lambda: read(tmp_path, f'[[points]]\nfile = "a.csv"\n{text}\n'), tmp_path / "capture.toml", *parts)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ('rotation = "euler"', ["'euler' is not a convention for rotations", "XYZ (moving axes"]),
        ("", ["does not state the convention of its rotations"]),
        ('rotation = "XYZ"', ["angles without a unit", "rotations = 'deg'"]),
        ('rotation = "quaternion wxyz"', ["rotations needs 4 columns, but 3 are picked"]),
    ],
)
def test_bad_rotations(tmp_path, text, parts):
    write(tmp_path / "a.csv", np.hstack([Q, P, U]))
    columns = ALL.replace("u =", "rotations =")
    table = f'[[transforms]]\nfile = "a.csv"\nu_angle = 0.01\n{text}\n{columns}'
    assert_refused(lambda: read(tmp_path, table), tmp_path / "capture.toml", *parts)


@pytest.mark.parametrize(
    ("header", "parts"),
    [
        (NAMES[:11], ["no column 'q?'; the table has 12 columns, but 11 names in the header; pick"]),
        (None, ["no column 'q?'; the table has 12 columns without names; pick another column"]),
        (
            [*NAMES[:9], "u_x", "U95 Y", "U(95) Z"],
            ["has the columns U*95* Y, U*95* Z, but no column 'U*95* X'; correct"],
        ),
    ],
)
def test_bad_headers(tmp_path, header, parts):
    write(tmp_path / "a.csv", np.hstack([Q, P, U]), header=header)
    columns = 'preset = "leica"\ncolumns = { q = "q?" }\n'
    assert_refused(lambda: read(tmp_path, f'[[points]]\nfile = "a.csv"\n{columns}'), tmp_path / "a.csv", *parts)


def test_bad_cells(tmp_path):
    rows = np.hstack([Q, P, U]).tolist()
    rows[2][7] = "n/a"
    write(tmp_path / "a.csv", rows)
    assert_refused(
        lambda: read(tmp_path, f'[[points]]\nfile = "a.csv"\n{ALL}'), "a.csv line 4 column 8: 'n/a'", "number"
    )
    rows[2][7] = "3,5"
    write(tmp_path / "a.csv", rows, delimiter=";")
    assert_refused(lambda: read(tmp_path, f'[[points]]\nfile = "a.csv"\n{ALL}'), "line 4 column 8", 'decimal = ","')
    (tmp_path / "a.csv").write_text("q1,q2\n")
    assert_refused(lambda: read(tmp_path, f'[[points]]\nfile = "a.csv"\n{ALL}'), "a.csv contains no numbers")


@pytest.mark.slow
def test_the_robot_of_the_examples(mukca):
    """R = Rx(rx) Ry(ry) Rz(rz): the angle between two poses is that of the robot's, to its accuracy."""
    recording = aj.files.read_manifest(mukca.parent / "ipa_ur10" / "transforms.toml")
    one = recording.capture.observations[0]
    arm, few = recording.nominal.arm, slice(0, 200)
    measured = Rotation.from_matrix(one.rotations[few])
    moved = Rotation.from_matrix(np.asarray(arm.pose(one.q[few]))[:, :3, :3])
    between = [(turned[:-1].inv() * turned[1:]).magnitude() for turned in (measured, moved)]
    assert np.sqrt(np.mean(np.subtract(*between) ** 2)) < np.deg2rad(0.06)
    assert one.q.shape == (2772, 6)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("mark", [",", "."])
def test_the_robots_own_files(tmp_path, mark):
    """As their authors published them: semicolons and decimal commas, standard deviations beside each coordinate."""
    joints = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
    measured = [f"measurement_{kind}{axis}" for axis in "xyz" for kind in ("", "std_")]
    header = ["Timestamp", "Goal x", *(f"{joint}_joint" for joint in joints), "measurement_temperature", *measured]
    rows = [[2.02011e13, 0.1, *Q[i], 21.68, *np.stack([P[i], U[i]], axis=1).ravel()] for i in range(5)]
    lines = [";".join(header), *(";".join(map(repr, map(float, row))).replace(".", mark) for row in rows)]
    (tmp_path / "c.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "capture.toml").write_text('arm = "ur10"\n[[points]]\nfile = "c.csv"\npreset = "ipa"\n')
    (seen,) = aj.files.read_manifest(tmp_path / "capture.toml").capture.observations
    assert np.array_equal(seen.q, Q)
    assert np.array_equal(seen.points, P)
    assert np.allclose(np.sqrt(np.einsum("mii->mi", seen.covariance)), U)


def test_sessions_of_tables_and_of_rows(tmp_path):
    """As `join_sessions` makes them; a probe each, unless the manifest says otherwise."""
    for day in ("monday", "tuesday"):
        for hole in range(2):
            write(tmp_path / f"{day}_{hole}.csv", RANDOM.uniform(-1, 1, (4, 6)), header=None)
    days = np.array([["monday"], ["tuesday"], ["monday"], ["tuesday"], ["tuesday"]])
    write(tmp_path / "t.csv", np.hstack([Q, P, U, days]).astype(object), header=[*NAMES, "day"])
    text = """
[[socket]]
name = "{hole}"
file = "{day}_{hole}.csv"
session = "{day}"
[[length]]
from = "{day}/0"
to = "{day}/1"
value = 50.0
"""
    rows = f'[[points]]\nname = "T"\nfile = "t.csv"\n{ALL}'.replace("points = [", 'session = "day", points = [')
    for probe, targets in ((None, {"probe of tuesday"}), ("same", set())):
        (tmp_path / "capture.toml").write_text(
            HEAD + (f'[sessions]\nprobe = "{probe}"\n' if probe else "") + text + rows
        )
        capture = aj.files.read_manifest(tmp_path / "capture.toml").capture
        assert capture.sessions == ("monday", "tuesday")
        names = {*capture.names, *(one.name for one in capture.observations)}
        assert names == {f"{day}/{x}" for day in capture.sessions for x in ("0", "1", "T")}
        assert {one.target for one in capture.observations} - {""} == targets
        assert {(one.start, one.end) for one in capture.lengths} == {
            (f"{day}/0", f"{day}/1") for day in capture.sessions
        }
        stations = {one.name: one.station for one in capture.observations if one.kind == "points"}
        assert stations == {"monday/T": "monday/T", "tuesday/T": "tuesday/T"}
    both = next(one for one in capture.observations if one.name == "tuesday/T")
    assert np.array_equal(both.q, Q[[1, 3, 4]])


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ('[[points]]\nfile = "a.csv"\n[[points]]\nname = "b"\nfile = "a.csv"\nsession = "x"\n', ["a has no session"]),
        (
            '[sessions]\nprobe = "same"\n[[points]]\nfile = "a.csv"\n',
            ["[sessions] applies only to tables with a session"],
        ),
        ('[[points]]\nfile = "a.csv"\nsession = "{day}"\n', ["session uses the field day"]),
        (
            '[[points]]\nfile = "a.csv"\nsession = "x"\ncolumns = { session = "x" }\n',
            ["session is given both as a key and in columns"],
        ),
    ],
)
def test_bad_sessions(tmp_path, text, parts):
    write(tmp_path / "a.csv", np.hstack([Q, P, U]))
    with_columns = text.replace('file = "a.csv"\n', f'file = "a.csv"\n{ALL if "columns" not in text else ""}')
    with pytest.raises(aj.InputError) as refused:
        read(tmp_path, with_columns)
    assert all(part in str(refused.value) for part in parts), refused.value


def test_known_coordinates_of_sockets(tmp_path):
    """A plate or plant whose holes a CMM has measured: an artefact with one placement, with a file for each hole."""
    for hole in "abc":
        write(tmp_path / f"{hole}.csv", RANDOM.uniform(-1, 1, (4, 6)), header=None)
    (plant,) = read(
        tmp_path,
        '[[artefact]]\nname = "plant"\nfiles = { a = "a.csv", b = "b.csv", c = "c.csv" }\nu = 0.002\n'
        "coordinates = { a = [0, 0, 0], b = [400, 0, 0], c = [0, 400, 50] }\n",
    )
    assert (plant.kind, plant.placement, plant.names, plant.q.shape) == ("artefact", "plant", ("a", "b", "c"), (12, 6))
    assert np.array_equal(plant.coordinates, [[0, 0, 0], [400, 0, 0], [0, 400, 50]])

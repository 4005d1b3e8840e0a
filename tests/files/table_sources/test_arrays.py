"""Files of MATLAB, NumPy, JSON and Excel: the same readings from each, through a manifest; what is missing; damage."""

import datetime
import io
import json
import pathlib
import zipfile

import h5py
import numpy as np
import openpyxl
import pytest
import scipy.io

import aacmm_jax as aj
from aacmm_jax.files import reader_process
from aacmm_jax.files.text_table import TextTable
from tests.files.table_sources.damage import refused_when_damaged
from tests.refusals import assert_refused

RNG = np.random.default_rng(0)
Q, POINTS = RNG.uniform(-90, 90, (9, 6)), RNG.uniform(-500, 500, (9, 3))
NAMES = [f"q_{i}" for i in range(1, 7)]
MATLAB = pathlib.Path(scipy.io.__file__).parent / "matlab" / "tests" / "data"


def matlab_73(path, q, points):
    """As MATLAB writes it: its user block, columns first, texts as codes, fields of structures by reference."""
    with h5py.File(path, "w", userblock_size=512) as file:
        session = file.create_group("session")
        session["q"], session["points"] = q.T, points.T
        text = file.create_dataset("operator", data=np.array([[ord(c)] for c in "someone"], np.uint16))
        text.attrs["MATLAB_class"] = np.bytes_("char")
        for i, row in enumerate(q):
            file[f"#refs#/{i}"] = row[:, None]
        records = file.create_group("records")
        references = [[file[f"#refs#/{i}"].ref for i in range(len(q))]]
        records.create_dataset("q", data=np.array(references, h5py.ref_dtype).T, dtype=h5py.ref_dtype)
    with open(path, "rb+") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def matlab_5(path, q, points):
    scipy.io.savemat(path, {"session": {"q": q, "points": points}, "q0": q[:1], "scale": 2.0, "note": "a text"})


def spreadsheet(path, q, points, sheet="session"):
    book = openpyxl.Workbook()
    book.active.title = "about"
    rows = book.create_sheet(sheet)
    rows.append(["Session of Monday", None])
    rows.append([])
    rows.append([*(f"{name} [deg]" for name in NAMES), "X", "Y", "Z", "day"])
    for line in np.concatenate([q, points], axis=1).tolist():
        rows.append([*line, datetime.date(2026, 1, 31)])
    book["about"]["A1"] = "nothing to read"
    book.save(path)


WRITERS = {
    "v5.mat": matlab_5,
    "v73.mat": matlab_73,
    "a.npz": lambda path, q, points: np.savez(path, q=q, points=points, scale=2.0),
    "a.json": lambda path, q, points: path.write_text(json.dumps({"session": {"q": q.tolist(), "p": points.tolist()}})),
    "records.json": lambda path, q, points: path.write_text(
        json.dumps([{"q": a, "points": b, "day": "Mo"} for a, b in zip(q.tolist(), points.tolist(), strict=True)])
    ),
    "a.xlsx": spreadsheet,
}
TABLES = {
    "v5.mat": "session",
    "v73.mat": ["session.q", "session.points"],
    "a.npz": ["q", "points"],
    "a.xlsx": "session",
}


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("name", WRITERS)
def test_every_format_gives_the_same_observation(tmp_path, name):
    WRITERS[name](tmp_path / name, Q, POINTS)
    picked = '"X", "Y", "Z"' if name == "a.xlsx" else f'"*p{"oints" * (name != "a.json")}_*"'
    table = f"table = {json.dumps(TABLES[name])}\n" if name in TABLES else ""
    (tmp_path / "capture.toml").write_text(
        f'arm = "ur10e"\nangles = {{ unit = "deg" }}\n[[points]]\nfile = "{name}"\n{table}'
        f'columns = {{ points = [{picked}] }}\ntarget = "ball"\n'
    )
    recording = aj.files.read_manifest(tmp_path / "capture.toml")
    (points,) = recording.capture.observations
    np.testing.assert_allclose(points.q, np.radians(Q), rtol=1e-15)
    np.testing.assert_allclose(points.points, POINTS, rtol=1e-15)
    assert [source.partition(" ")[0] for source in recording.sources] == ["capture.toml", name]


def test_readings_may_be_in_another_sheet(tmp_path):
    book = openpyxl.Workbook()
    for title, names, rows in (("joints", NAMES, Q), ("tracker", "xyz", POINTS)):
        sheet = book.create_sheet(title)
        sheet.append(list(names))
        for row in rows.tolist():
            sheet.append(row)
    book.save(tmp_path / "a.xlsx")
    (tmp_path / "capture.toml").write_text(
        'arm = "ur10e"\nangles = { unit = "deg" }\n[[points]]\nfile = "a.xlsx"\ntable = "tracker"\n'
        'readings = "a.xlsx"\nreadings_table = "joints"\ncolumns = { points = ["x", "y", "z"] }\ntarget = "ball"\n'
    )
    (points,) = aj.files.read_manifest(tmp_path / "capture.toml").capture.observations
    np.testing.assert_allclose(points.q, np.radians(Q), rtol=1e-14)


@pytest.mark.parametrize(
    ("content", "header", "first"),
    [
        (Q, [], Q[0]),  # a list of rows
        ({"q": Q, "t": np.arange(9.0)}, [*NAMES, "t"], [*Q[0], 0]),
        ({"q": Q, "t": np.arange(9.0)[None]}, [*NAMES, "t"], [*Q[0], 0]),  # a vector that lies
        ({"T": np.moveaxis(np.tile(np.eye(4), (9, 1, 1)), 0, 2)}, [f"T_{i}" for i in range(1, 17)], np.eye(4).ravel()),
        ({"q": Q, "R": np.tile(np.eye(3), (9, 1, 1))}, [*NAMES, *(f"R_{i}" for i in range(1, 10))], None),
        ({"1st": np.arange(9.0), "on": np.ones(9, bool)}, ["_1st", "on"], [0, 1]),
    ],
)
def test_columns_of_arrays(tmp_path, content, header, first):
    if isinstance(content, dict):
        np.savez(tmp_path / "a.npz", **content)
    else:
        np.save(tmp_path / "a.npy", content)
    table = TextTable(next(tmp_path.iterdir()))
    assert (table.header, table.length) == (header, 9)
    if first is not None:
        np.testing.assert_array_equal(table.numbers(range(table.width))[0], first)


@pytest.mark.parametrize(
    ("file", "header", "length"),
    [
        ("testmatrix_4.2c_SOL2.mat", [f"testmatrix_{i}" for i in range(1, 6)], 3),
        ("testmatrix_6.5.1_GLNX86.mat", [f"testmatrix_{i}" for i in range(1, 6)], 3),
        ("testdouble_7.4_GLNX86.mat", ["testdouble"], 9),
        ("testhdf5_7.4_GLNX86.mat", ["testdouble"], 9),
        ("teststructarr_7.4_GLNX86.mat", ["teststructarr.one", "teststructarr.two"], 2),
    ],
)
def test_files_that_matlab_wrote(file, header, length):
    """Those of SciPy's own tests, where they are installed."""
    if not (MATLAB / file).exists():
        pytest.skip("SciPy was installed without its tests")
    table = TextTable(MATLAB / file)
    assert (table.header, table.length) == (header, length)
    if length == 9:  # 0 to 2 pi in eight steps
        np.testing.assert_allclose(table.numbers([0])[:, 0], np.linspace(0, 2 * np.pi, 9), atol=1e-14)


def book_with(path, cells, sheets=("Sheet",)):
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title in sheets:
        sheet = book.create_sheet(title)
        for key, value in cells.items():
            sheet[key] = value
    book.save(path)


def objects(path):
    np.savez(path, q=np.array([{}], dtype=object))


def linked(path):
    """Of v7.3: the data are in another file, which is not opened."""
    matlab_73(path.with_name("other.mat"), Q, POINTS)
    with h5py.File(path, "w", userblock_size=512) as file:
        file["q"] = h5py.ExternalLink("other.mat", "/session/q")
        file["s"] = h5py.SoftLink("/session/q")
        layout = h5py.VirtualLayout(Q.T.shape, "f8")
        layout[:] = h5py.VirtualSource("other.mat", "session/q", Q.T.shape, "f8")
        file.create_virtual_dataset("v", layout)


def unwritten(path):
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("q", (6, 2**40), "f8", chunks=(6, 1024))


REFUSED = [
    ("a.mat", lambda path: matlab_5(path, Q, POINTS), ["nothing"], ["no variable 'nothing'", "session.q (9 x 6)"]),
    ("a.mat", lambda path: scipy.io.savemat(path, {"z": 1j}), [], ["no variable with numbers"]),
    ("a.npz", lambda path: np.savez(path, q=Q, p=POINTS[:5]), [], ["lengths: q (9 x 6), p (5 x 3)", "table ="]),
    ("a.npz", lambda path: np.savez(path, q=Q), ["q.x"], ["no array 'q.x'; it has q (9 x 6)"]),
    ("a.npz", objects, [], ["Python objects only"]),
    ("a.json", lambda path: path.write_text("[[1, 2], [3]]"), [], ["lists of different lengths"]),
    ("a.json", lambda path: path.write_text("[" * 100_000), [], ["not valid JSON"]),
    ("a.json", lambda path: path.write_text('{"q": ['), [], ["not valid JSON"]),
    ("a.mat", linked, [], ["no variable with numbers"]),
    ("a.mat", unwritten, [], ["more than 512 MiB in '/q'"]),
    ("a.xlsx", lambda path: book_with(path, {"A1": 1.0}, ("one", "two")), [], ["2 sheets", "add table = 'one'"]),
    ("a.xlsx", lambda path: book_with(path, {"A1": 1.0}), ["two"], ["no sheet 'two'", "'Sheet'"]),
    ("a.xlsx", lambda path: book_with(path, {}), [], ["0 sheets with cells"]),
    ("a.csv", lambda path: path.write_text("1,2\n"), ["q"], ["is a text file", "remove table"]),
    ("a.npz", lambda path: path.write_bytes(b"PK\x03\x04 and no more"), [], ["is damaged or incomplete"]),
    ("a.mat", lambda path: path.write_bytes(b""), [], ["is damaged or incomplete"]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "write", "tables", "parts"), REFUSED, ids=lambda value: str(value)[:20])
def test_what_is_missing_is_one_sentence(tmp_path, name, write, tables, parts):
    write(tmp_path / name)
    assert_refused(lambda: TextTable(tmp_path / name, tables=tables), tmp_path / name, *parts)


@pytest.mark.parametrize(
    ("cell", "part"), [(None, "row 3 column 2 is empty"), ("12,5", "'12,5' is not a number"), ("=A1*2", "is empty")]
)
def test_a_cell_that_is_no_number_is_named_by_its_row(tmp_path, cell, part):
    book_with(tmp_path / "a.xlsx", {"A1": "J1", "B1": "J2", "A2": 1.5, "B2": 2.5, "A3": 3.5, "B3": cell})
    table = TextTable(tmp_path / "a.xlsx")
    assert_refused(lambda: table.numbers([0, 1]), part, "correct the cell, or delete the row")


@pytest.mark.parametrize("options", [{"delimiter": ";"}, {"decimal": ","}, {"skip": 1}])
def test_keys_of_text_tables_do_not_apply(tmp_path, options):
    np.savez(tmp_path / "a.npz", q=Q)
    assert_refused(lambda: TextTable(tmp_path / "a.npz", **options), "not a text table", "remove these keys")


def zeros(path, size):
    """A compressed array of zeros, a thousandth of its size."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("q.npy", "w", force_zip64=True) as out,
    ):
        np.lib.format.write_array_header_1_0(out, {"descr": "<f8", "fortran_order": False, "shape": (size, 8)})
        for _ in range(size * 64 // 2**20):
            out.write(bytes(2**20))


def sheet_of(path, size):
    book_with(path, {"A1": 1.0})
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("xl/more.xml", "w") as out,
    ):
        for _ in range(size // 2**20):
            out.write(bytes(2**20))


BOMBS = {
    "zeros.npz": lambda path: zeros(path, 2**22),
    "huge.npy": lambda path: path.write_bytes(header_of((2**40, 6))),
    "huge.mat": lambda path: path.write_bytes(matlab_header_of(2**30)),
    "book.xlsx": lambda path: sheet_of(path, 600 * 2**20),
    "deep.json": lambda path: path.write_text('{"a":' * 50_000),
}


def header_of(shape):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue() + bytes(100)


def matlab_header_of(rows):
    stream = io.BytesIO()
    scipy.io.savemat(stream, {"q": np.zeros((3, 6))})
    content = bytearray(stream.getvalue())
    content[136 + 24 : 136 + 28] = rows.to_bytes(4, "little")  # the first dimension
    return bytes(content)


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_what_unpacks_to_more_than_fits_is_refused(tmp_path, name, monkeypatch):
    monkeypatch.setattr(reader_process, "_TABLE_MEMORY", 2**27)
    BOMBS[name](tmp_path / name)
    assert_refused(lambda: TextTable(tmp_path / name), tmp_path / name)


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_damage_is_one_sentence_or_other_cells(tmp_path, name):
    WRITERS[name](tmp_path / name, Q, POINTS)
    assert len(refused_when_damaged(tmp_path / name, np.atleast_1d(TABLES.get(name, [])).tolist())) > 5


def test_without_an_interpreter_tables_are_read_here(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", q=Q)
    monkeypatch.setattr(reader_process.sys, "executable", "")
    assert TextTable(tmp_path / "a.npz").header == NAMES
    assert_refused(lambda: TextTable(tmp_path / "a.npz", tables=["p"]), "no array 'p'")

"""One table in place of the files of a manifest gives the same recording as the files."""

import csv

import jax
import numpy as np
import pytest

import aacmm_jax as aj
from tests.refusals import assert_refused

MANIFEST = """arm = "cheng2018-simulation"
acceptance = "iso"
{}
angles = {{ unit = "deg" }}
socket = [{{ name = "bar1/{{position}}/{{side}}", file = "bar1/{{position}}/{{side}}.csv" }}]
length = [{{ from = "bar1/{{position}}/a", to = "bar1/{{position}}/b", value = 500.0, u = 0.002 }}]

[[sphere]]
name = "sphere1"
test = "articulation"
files = ["sphere1/touches-1.csv", "sphere1/touches-2.csv"]
diameter = 25.0
"""
POINTS = """{}
points = {{ unit = "mm" }}
socket = [{{ name = "bar1/{{position}}/{{side}}", file = "bar1/{{position}}/{{side}}.csv" }}]
"""
FILES = {f"bar1/{number}/{side}": 3 for number in ("01", "02") for side in "ab"}
SPHERES = {f"sphere1/touches-{number}": 5 for number in (1, 2)}


def rows_of(files: dict[str, int], columns: int) -> list[tuple[str, list[str]]]:
    random = np.random.default_rng(0)
    return [(x, [f"{v:.4f}" for v in random.uniform(-90, 90, columns)]) for x, n in files.items() for _ in range(n)]


def written(folder, rows, manifest, heading):
    """The manifest with a file for each label."""
    for label in dict.fromkeys(label for label, _ in rows):
        path = folder / f"{label}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = [",".join(heading), *(",".join(values) for name, values in rows if name == label)]
        path.write_text("\n".join(lines))
    (folder / "files.toml").write_text(manifest.format(""))
    return folder / "files.toml"


def as_csv(path, heading, rows, delimiter=",", decimal="."):
    with open(path, "w", newline="") as stream:
        writer = csv.writer(stream, delimiter=delimiter)
        writer.writerow(heading)
        writer.writerows([[x.replace(".", decimal) if x[-1:].isdigit() else x for x in row] for row in rows])


def as_excel(path, heading, rows):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(heading)
    for row in rows:
        numbers = [float(x) if "." in x and not x.endswith(".csv") else x for x in row]
        book.active.append(numbers)
    book.save(path)


def by_parts(label: str) -> list[str]:
    return [*label.split("/"), ""][:3]


WAYS = {
    "file": (["file"], lambda label: [f"{label}.csv"], as_csv, "t.csv"),
    "parts": (["Artefact", "Position", "End"], by_parts, as_csv, "t.csv"),
    "semicolons": (
        ["artefact", "position", "end"],
        by_parts,
        lambda *args: as_csv(*args, delimiter=";", decimal=","),
        "t.csv",
    ),
    "excel": (["file"], lambda label: [f"{label}.csv"], as_excel, "t.xlsx"),
}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("way", WAYS)
def test_one_table_is_read_as_the_files_are(tmp_path, way):
    """Rows of different files may be mixed, as long as those of one are in order."""
    heading, label, write, name = WAYS[way]
    readings = [f"q_{i}_deg" for i in range(1, 7)]
    rows = rows_of(FILES | SPHERES, 6)
    files = aj.files.read_manifest(written(tmp_path, rows, MANIFEST, readings))
    folder = tmp_path / "one"
    folder.mkdir()
    within = [[x for x, _ in rows[:i]].count(row[0]) for i, row in enumerate(rows)]
    mixed = [rows[i] for i in np.argsort(within, kind="stable")] if way == "file" else rows
    write(folder / name, [*heading, *readings], [[*label(x), *v] for x, v in mixed])
    (folder / "one.toml").write_text(MANIFEST.format(f'measurements = "{name}"'))
    one = aj.files.read_manifest(folder / "one.toml")
    assert jax.tree.all(jax.tree.map(np.array_equal, one.capture.sockets, files.capture.sockets))
    assert [(x.start, x.end) for x in one.capture.lengths] == [(x.start, x.end) for x in files.capture.lengths]
    assert len(one.capture.lengths) == 2
    for first, second in zip(one.spheres[0].groups, files.spheres[0].groups, strict=True):
        np.testing.assert_array_equal(first, second)
    assert [source.split()[0] for source in one.sources] == ["one.toml", name]


def test_points_and_files_beside_the_table(tmp_path):
    """What the table does not have is read from its own file."""
    rows = rows_of(FILES, 3)
    files = aj.files.read_points(written(tmp_path, rows, POINTS, ["x", "y", "z"]))
    as_csv(tmp_path / "t.csv", ["file", "x", "y", "z"], [[x, *v] for x, v in rows])
    (tmp_path / "one.toml").write_text(POINTS.format('measurements = "t.csv"'))
    one = aj.files.read_points(tmp_path / "one.toml")
    assert one.sockets.keys() == files.sockets.keys() == FILES.keys()
    assert all(np.array_equal(one.sockets[name], files.sockets[name]) for name in FILES)


@pytest.mark.parametrize(
    ("heading", "change", "parts"),
    [
        (["place"], lambda label: [label], ["neither a column 'file'", "'artefact', 'position' and 'end'"]),
        (["file"], lambda label: [label.replace("02/b", "O2/b/x")], ["'bar1/O2/b/x'", "no table of the manifest"]),
        (["file"], lambda label: [label.replace("bar1/02/b", "")], ["row 10", "fill in its file"]),
        (["file"], lambda label: [label.replace("sphere1/touches-2", "sphere1/touches-3")], ["touches-2", "exist"]),
    ],
)
def test_rows_that_no_file_has_are_refused(tmp_path, heading, change, parts):
    rows = rows_of(FILES | SPHERES, 6)
    readings = [f"q_{i}_deg" for i in range(1, 7)]
    as_csv(tmp_path / "t.csv", [*heading, *readings], [[*change(x), *v] for x, v in rows])
    (tmp_path / "one.toml").write_text(MANIFEST.format('measurements = "t.csv"'))
    assert_refused(lambda: aj.files.read_manifest(tmp_path / "one.toml"), tmp_path / "one.toml", *parts)

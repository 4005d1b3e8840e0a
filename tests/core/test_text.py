"""Cells of tables that a spreadsheet would calculate, and what a message shows of a long text."""

import csv

import pytest

import aacmm_jax as aj
from aacmm_jax.core.text import csv_text, in_short
from aacmm_jax.files.text_table import TextTable

CALCULATED = ["=1+1.h5", "+A1", "-A1", "@SUM(A1)", "\t=1", "-", '=cmd|"/c x"!A1']


@pytest.mark.parametrize("cell", CALCULATED)
def test_no_cell_is_a_formula(cell):
    (found,) = csv.reader([csv_text([[cell, "name"]])])
    assert found == [f"'{cell}", "name"]


@pytest.mark.parametrize("cell", ["\\r=1", "-1.5", "+2e3", "A", "a=b", "'quoted", "", "1-2"])
def test_other_cells_stay(cell):
    (found,) = csv.reader([csv_text([[cell, 1.5]])])
    assert found == [cell, "1.5"]


def test_they_are_read_as_they_were(tmp_path):
    path = tmp_path / "plan.csv"
    path.write_text(csv_text([["socket", "=q"], ["=1+1", 2.5], ["-A", -3.5]]))
    table = TextTable(path)
    assert table.header == ["socket", "=q"]
    assert table.texts("socket").tolist() == ["=1+1", "-A"]
    assert table.numbers(table.pick(["'=q"]))[:, 0].tolist() == [2.5, -3.5]


LONG, SPACED = 10_000 * "n", 5_000 * "n "


def test_a_sentence_keeps_its_ends():
    assert in_short("a short one.") == "a short one."
    for name in (LONG, SPACED):
        found = str(aj.InputError(f"file.toml: {name!r} is unknown; correct it."))
        assert found.startswith("file.toml: 'n")
        assert found.endswith("is unknown; correct it.")
        assert "..." in found
        assert len(found) <= 1000


@pytest.mark.parametrize("name", [LONG, SPACED])
@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("arm.toml", '"{}" = 1'),
        ("arm.toml", 'length_unit = "{}"'),
        ("arm.urdf", '<robot><joint name="{}"/></robot>'),
        ("arm.urdf", '<robot><joint name="j" type="{}"><parent link="a"/><child link="b"/></joint></robot>'),
        ("kinematics.yaml", "dh_a: {}"),
    ],
)  # fmt: skip
def test_long_names_in_files(tmp_path, file, text, name):
    (tmp_path / file).write_text(text.format(name))
    with pytest.raises(aj.InputError) as caught:
        aj.load_arm(tmp_path / file)
    assert len(str(caught.value)) < 600

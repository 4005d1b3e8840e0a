"""The reproduction of the paper: REPRODUCTION.md is complete, traceable, and what the code gives."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from . import published

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks/cheng2018"


@pytest.fixture(scope="module")
def rows():
    return json.loads((FOLDER / "results/rows.json").read_text())


@pytest.fixture(scope="module")
def paper():
    sys.path.insert(0, str(FOLDER))
    import paper

    return paper


def test_every_row_has_a_verdict_and_a_line_of_code(rows):
    page = (FOLDER / "REPRODUCTION.md").read_text()
    assert len(rows) > 100
    for row in rows:
        assert row["verdict"], row["what"]
        file, line = row["where"].split(":")
        source = (FOLDER / file).read_text().splitlines()
        near = "\n".join(source[max(0, int(line) - 12) : int(line) + 12])
        assert "row(" in near, row["where"]
        assert row["what"].replace("|", "\\|") in page


def test_every_published_number_has_its_row(rows):
    """All that sections 3 and 4 and the tables print: number by number, and the vectors element by element."""
    what = [row["what"] for row in rows]
    for prefix, count in (("eq. 16: ", 22), ("eq. 17: ", 22), ("eq. 18: ", 21), ("Table 2: ", 25), ("4.2 length ", 4)):
        assert sum(name.startswith(prefix) for name in what) == count, prefix
    tables = (
        "Table 1, simulation 1",
        "Table 1, simulation 2",
        *(f"Table 3 {x}" for x in ("Data1", "Data2", "Data3", "mean")),
    )
    plate = ("largest length", "smallest", "largest deviation", "range", "two RMS", "improvement")
    others = ("3.1 Deltam, nominal", "3.1 Deltam, same", "4.1 DE", "4.1 Deltam", "4.2 four lengths: mean")
    for name in (*tables, *others, *(f"4.4 {x}" for x in plate)):
        assert any(row.startswith(name) for row in what), name


def test_the_quick_parts_give_the_stored_rows(rows, paper):
    import table2

    stored = {row["what"]: row for row in rows}
    for row in table2.run()[0]:
        assert stored[row.what] == row._asdict()


def test_the_papers_method_gives_its_stored_run(paper):
    """One search of the thousand, from the same poses and start, ends at the same scale."""
    import paper_method

    first = next(line for line in paper_method.stored() if line["simulation"] == 2 and line["set"] == 0)
    again = paper_method.one(2, paper.pose_sets(1)[0], 0)
    assert again["k"] == pytest.approx(first["k"], abs=1e-3)


def test_printed_numbers_that_are_recomputed():
    """Against the paper's text instead of this project's output: eq. 16 and 17 are scaled copies of the true arm."""
    truth = np.array(published.NOMINAL)
    for number, k, error in ((1, 0.99946, 0.403), (2, 1.00882, 6.618)):
        values, lengths = np.array(published.IDENTIFIED[number]), published.LENGTHS
        assert values[lengths] @ truth[lengths] / (truth[lengths] @ truth[lengths]) == pytest.approx(k, abs=5e-6)
        assert np.abs(values - truth)[lengths].max() == pytest.approx(error, abs=5e-4)

"""The notebooks run from beginning to end, as a reader would run them."""

import re
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


# A small version of what the long ones show is in the other tests.
SLOW = ("01", "03", "04", "05", "06", "07")
LONG = (pytest.mark.slow, pytest.mark.optimised)  # they compute more than they compile


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=LONG if path.stem[:2] in SLOW else ()) for path in NOTEBOOKS],
    ids=lambda path: path.stem,
)
def test_notebook_runs(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the notebook machinery, not of the package: that runs in the kernel
        import nbclient
        import nbformat

        notebook = nbformat.read(path, 4)
        assert all(cell.get("outputs") or not cell.source for cell in notebook.cells[-1:] if cell.cell_type == "code")
        nbclient.NotebookClient(notebook, timeout=1800, resources={"metadata": {"path": str(path.parent)}}).execute()


def test_all_are_there_with_their_outputs():
    assert [path.stem[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06", "07"]
    for path in NOTEBOOKS:
        assert '"image/png"' in path.read_text()


@pytest.mark.parametrize("path", [*NOTEBOOKS, ROOT / "README.md"], ids=lambda path: path.stem)
def test_readers_are_shown_public_names_only(path):
    assert not re.findall(r"from aacmm_jax[.\w]* import|import aacmm_jax\.\w+", path.read_text())

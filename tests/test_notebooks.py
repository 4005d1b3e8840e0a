"""The notebooks run from beginning to end, as a reader would run them."""

import re
import warnings
from pathlib import Path

import pytest

import aacmm_jax as aj

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


# A small version of what the long ones show is in the other tests. Those compute more than they compile.
LONG = ("01", "03", "04", "05", "06", "07", "08")
MARKS = {True: (pytest.mark.exhaustive, pytest.mark.optimised), False: pytest.mark.slow}


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=MARKS[path.stem[:2] in LONG]) for path in NOTEBOOKS],
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
    assert [path.stem[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06", "07", "08"]
    for path in NOTEBOOKS:
        assert '"image/png"' in path.read_text()


@pytest.mark.parametrize("path", [*NOTEBOOKS, ROOT / "README.md"], ids=lambda path: path.stem)
def test_readers_are_shown_public_names_only(path):
    assert not re.findall(r"from aacmm_jax[.\w]* import|import aacmm_jax\.\w+", path.read_text())


def test_every_name_that_readers_are_shown_exists():
    """A small version of running them: what stands behind ``aj.``, up to the first call."""
    for path in (*NOTEBOOKS, ROOT / "README.md"):
        for name in set(re.findall(r"\baj((?:\.[A-Za-z_]\w*+)++)(?!\.\.)", path.read_text())):
            found = aj
            for part in name[1:].split("."):
                found = getattr(found, part)

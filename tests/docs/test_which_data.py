"""The tables of docs/which_data.md are those that docs/which_data.py computes."""

import importlib.util
import json
import warnings
from pathlib import Path
from types import ModuleType

import pytest

import aacmm_jax as aj

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    found = importlib.util.spec_from_file_location("which_data", DOCS / "which_data.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_table_is_of_the_stored_results(script: ModuleType) -> None:
    rows = json.loads(script.RESULTS.read_text(encoding="utf-8"))
    assert script.table(rows) == script.TABLE.read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "data"),
    [
        ("measuring", "two sockets, one certified length"),
        ("measuring", "three spheres of certified diameter, touched"),
        ("robot", "a tracker, its target anywhere on the flange"),
        ("robot7", "two sockets, one certified length"),
        ("hobby", "a plate of six certified holes, in one place"),
    ],
)
def test_stored_results_are_those_computed_now(script: ModuleType, arm: str, data: str) -> None:
    rows = json.loads(script.RESULTS.read_text(encoding="utf-8"))
    (stored,) = (row for row in rows if (row["arm"], row["data"]) == (arm, data))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", aj.IdentifiabilityWarning)
        found = [script.predicted(script.cases()[arm], data, 30, seed) for seed in script.SEEDS]
    for what in ("median", "largest"):
        middle = sorted(one[what] for one in found)[1]
        assert middle == pytest.approx(stored[what]["30"], rel=0.02, abs=1e-4)
    assert max(one["parameters"] for one in found) <= stored["parameters"]

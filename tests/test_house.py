"""The house: imports go down the floors and never up, and modules stay small."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "aacmm_jax"
FLOORS = tuple(
    set(line.split())
    for line in """
    errors _float64
    arrays storage toml
    chain arm parameters capture recording arm_files manifest capture_files noise simulate independence
    metrics steps weights residuals solver
    covariance scale propagation observability checks results evaluate calibrate lanes batch calibration_files uncertainty sampling validation exchange placing refining planning plan_files reach poses spheres decision acceptance_figures acceptance procedure procedure_files points_files evaluation_files points_evaluation about differences drift
    cautions summary evaluation_summary figures demo study certificate certificate_results dcc_xml drift_summary drift_figure plot
    cli report
    """.strip().splitlines()
)
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name not in ("__init__.py", "__main__.py"))


def floor_of(name: str) -> int:
    return next(number for number, names in enumerate(FLOORS) if name in names)


def imported(path: Path) -> set[str]:
    """Modules of the package that a module imports, wherever in it, by the name of their top module."""
    depth = len(path.relative_to(PACKAGE).parts)
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == depth:
            found |= {node.module.split(".")[0]} if node.module else {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_imports_go_down(path):
    here = floor_of(path.relative_to(PACKAGE).parts[0].removesuffix(".py"))
    for name in imported(path):
        assert floor_of(name) <= here, f"{path.name} imports {name} from a floor above"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_a_module_is_read_in_one_sitting(path):
    assert len(path.read_text().splitlines()) <= 420

"""Every public name has a reference entry, a list of its arguments, units, and an example that runs."""

import ast
import doctest
import inspect
import re
import shutil
import sys
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS / "extensions"))
from public_names import namespaces, public_names  # noqa: E402

from ..own_kinds import forgotten_kinds  # noqa: E402

NAMES = {item.name.replace("aacmm_jax", "aj", 1): item for item in public_names()}
# What the examples use, and what those of studies use besides.
SETUP, STUDY_SETUP = re.findall(r"```python\n(.*?)```", (DOCS / "reference" / "index.md").read_text(), flags=re.DOTALL)
PARSER = doctest.DocTestParser()
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
# Examples of more than 0.3 s of CPU, with what they compile.
LONG = {
    "aj.acceptance.EvaluationRecord",
    "aj.acceptance.plan_procedure",
    "aj.acceptance.Procedure",
    "aj.acceptance.simulate_procedure",
    "aj.bootstrap",
    "aj.calibrate_capture",
    "aj.calibrate_many",
    "aj.calibration.CrossValidation",
    "aj.calibration.ManyCalibrations",
    "aj.calibration.ManyIdentifications",
    "aj.camera.detect",
    "aj.compare_models",
    "aj.data.observations.SimulatedPixels",
    "aj.diagnostics.check_readings",
    "aj.diagnostics.Explanation",
    "aj.diagnostics.ReadingCheck",
    "aj.files.load_calibration",
    "aj.files.load_compared_models",
    "aj.files.save_compared_models",
    "aj.files.save_evaluation",
    "aj.files.save_plan",
    "aj.identify_many",
    "aj.kinematics.clearances",
    "aj.kinematics.solve_to_targets",
    "aj.least_squares",
    "aj.live.serving",
    "aj.live.Session",
    "aj.model.repeatability",
    "aj.pipeline.Accuracy",
    "aj.pipeline.CalibrationOptions",
    "aj.pipeline.CaptureOptions",
    "aj.pipeline.ComparedModels",
    "aj.pipeline.EvaluationOptions",
    "aj.pipeline.Verification",
    "aj.planning.KitPlan",
    "aj.planning.Motion",
    "aj.planning.plan",
    "aj.planning.Plan",
    "aj.planning.plan_kit",
    "aj.plot.drift_trend",
    "aj.plot.joint_function",
    "aj.plot.model_comparison",
    "aj.plot.residual_patterns",
    "aj.plot.residuals_by_kind",
    "aj.plot.save_arm_figure",
    "aj.plot.save_drift_trend",
    "aj.plot.volumetric_uncertainty_map",
    "aj.Prior",
    "aj.report.write_plan",
    "aj.report.write_report",
    "aj.residuals_of",
    "aj.solver.BoundedLevenbergMarquardt",
    "aj.solver.QuadraticModel",
    "aj.uncertainty.Uncertainty",
    "aj.verify",
    "aj.volumetric_uncertainty",
}
# More than 10 s: the fewest trials that they allow are 10,000.
EXHAUSTIVE = {"aj.calibration.Sampled", "aj.monte_carlo"}


def examples_of(name: str) -> list[doctest.Example]:
    return PARSER.get_examples(NAMES[name].docstring, name)


def needs_a_study(name: str) -> bool:
    source = "".join(example.source for example in examples_of(name))
    names = {node.id for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name)}
    return '"study.h5"' in source or bool(names & {"study", "results"})


@pytest.fixture(scope="session")
def namespace() -> dict[str, object]:
    """What the reference says that its examples use."""
    found: dict[str, object] = {}
    exec(compile(SETUP, "docs/reference/index.md", "exec"), found)
    return found


@pytest.fixture(scope="session")
def study_namespace(namespace, tmp_path_factory) -> tuple[dict[str, object], Path]:
    """The same with the study, and its file."""
    found, folder = dict(namespace), tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(compile(STUDY_SETUP, "docs/reference/index.md", "exec"), found)
    return found, folder / "study.h5"


def marks(name: str) -> list[pytest.MarkDecorator]:
    if name in EXHAUSTIVE:
        return [pytest.mark.exhaustive]
    return [pytest.mark.slow] if name in LONG or needs_a_study(name) else []


@pytest.mark.parametrize("name", [pytest.param(name, marks=marks(name)) for name in NAMES])
def test_example_runs(name, namespace, request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(DOCS / "reference" / "robot.urdf", tmp_path)
    if needs_a_study(name):
        namespace, path = request.getfixturevalue("study_namespace")
        shutil.copy(path, tmp_path)
    examples = examples_of(name)
    assert examples
    assert f"{name}" in "".join(example.source for example in examples) or inspect.isclass(NAMES[name].value)
    report: list[str] = []
    test = doctest.DocTest(examples, dict(namespace), name, str(NAMES[name].source), 0, None)
    # As readers have it: the tests forbid a sum of a matrix and a row.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"), forgotten_kinds():
        found = doctest.DocTestRunner(optionflags=OPTIONS, verbose=False).run(test, out=report.append)
    plt.close("all")
    assert not found.failed, "".join(report)


def test_names_that_take_long_exist():
    assert NAMES.keys() >= LONG | EXHAUSTIVE


def arguments_of(value) -> set[str]:
    return {*inspect.signature(value).parameters}


FUNCTIONS = [name for name, item in NAMES.items() if inspect.isfunction(inspect.unwrap(item.value))]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_says_what_each_argument_is(name):
    listed = re.findall(r"^    \*{0,2}(\w+): ", NAMES[name].docstring.partition("Args:")[2], flags=re.MULTILINE)
    missing = arguments_of(NAMES[name].value) - set(listed)
    assert not missing or "like all arguments that are not named here" in NAMES[name].docstring, missing


NUMBERS = re.compile(r"\b(Numbers|Float|float|Transform)\b")
UNIT = re.compile(r"\b(mm|rad|mrad|arcsec|kg|C|1/K|unit|units|deg)\b")


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_of_numbers_states_their_units(name):
    (node,) = ast.parse(inspect.getsource(inspect.unwrap(NAMES[name].value))).body
    if NUMBERS.search(ast.unparse(node.args)):
        assert UNIT.search(NAMES[name].docstring)


def test_every_namespace_is_in_the_contents():
    text = (DOCS / "reference" / "index.md").read_text()
    pages = {namespace.partition(".")[2] or "aj" for namespace in namespaces()}
    assert set(re.findall(r"^api/(.*)$", text, flags=re.MULTILINE)) == pages

"""The structure that a newcomer relies on: folders, direction of imports, size of modules, public and foreign names."""

import ast
import importlib
import inspect
import re
import runpy
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "aacmm_jax"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MODULES = sorted(PACKAGE.rglob("*.py"))
STUBS = sorted(PACKAGE.rglob("__init__.pyi"))
# From the top: a folder imports from those below it only.
LAYERS = (
    {"cli"},
    {"live"},
    {"report"},
    {"plot", "certificate"},
    {"study"},
    {"files", "summaries"},
    {"camera"},
    {"pipeline"},
    {"acceptance", "drift", "planning"},
    {"diagnostics"},
    {"calibration"},
    {"uncertainty"},
    {"model"},
    {"data"},
    {"kinematics", "solver"},
    {"core"},
)


def dotted(path: Path) -> str:
    """The name under which a file of the package is imported."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def parsed(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text())


def public_names(stub: Path) -> list[str]:
    """What a stub exports: every import in it, each under its own name."""
    imports = [node for node in parsed(stub).body if isinstance(node, ast.ImportFrom)]
    assert imports
    return [alias.asname or alias.name for node in imports for alias in node.names]


@cache
def functions_and_classes() -> dict[str, object]:
    """Public functions and classes by their full name."""
    found = {}
    for stub in STUBS:
        module = importlib.import_module(dotted(stub))
        for name in public_names(stub):
            value = getattr(module, name)
            if inspect.isclass(value) or (callable(value) and not inspect.ismodule(value)):
                found[f"{module.__name__}.{name}"] = value
    return found


# Folders and imports


def test_the_folders_are_those_of_the_layers():
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders == set().union(*LAYERS)
    files = {path.name for path in PACKAGE.iterdir() if path.is_file()}
    assert files == {"__init__.py", "__init__.pyi", "__main__.py", "py.typed"}
    (contract,) = (each for each in PROJECT["tool"]["importlinter"]["contracts"] if each["type"] == "layers")
    assert [set(layer.split(" | ")) for layer in contract["layers"]] == list(LAYERS)
    assert contract["exhaustive"]


def test_import_contracts_are_kept(capsys):
    status = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True, no_logo=True)
    assert status == 0, capsys.readouterr().out


@pytest.mark.slow
def test_the_picture_of_the_layout_is_current():
    drawn = runpy.run_path(str(ROOT / "docs" / "layout_picture.py"))["picture"]()
    assert drawn == (ROOT / "docs" / "layout.svg").read_text(), "make it anew: python docs/layout_picture.py"


def lines_of_docstrings(tree: ast.AST) -> int:
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    found = [node.body[0] for node in ast.walk(tree) if isinstance(node, kinds) and ast.get_docstring(node)]
    return sum(node.end_lineno - node.lineno + 1 for node in found)


@pytest.mark.parametrize("path", MODULES, ids=dotted)
def test_a_module_is_at_most_420_lines(path):
    """The arguments and examples in docstrings are read one function at a time; they count towards 520 only."""
    text = path.read_text()
    assert len(text.splitlines()) <= 520
    assert len(text.splitlines()) - lines_of_docstrings(parsed(path)) <= 420


# Public names


@pytest.mark.parametrize("stub", STUBS, ids=dotted)
def test_every_public_name_resolves(stub):
    module, names = importlib.import_module(dotted(stub)), public_names(stub)
    assert len(set(names)) == len(names)
    assert set(module.__all__) == set(names)
    for name in names:
        assert getattr(module, name) is not None


@pytest.mark.parametrize(("name", "value"), functions_and_classes().items(), ids=functions_and_classes())
def test_every_public_name_has_a_docstring(name, value):
    text = value.__doc__ or ""
    # What `NamedTuple` and `dataclass` write where there is none is the signature.
    assert text.strip()
    assert not text.startswith(f"{name.rsplit('.', 1)[1]}(")


def test_no_module_is_named_like_a_public_function():
    """A reader asks which one is meant; and importing a module hides a function of that name in the same folder."""
    functions = {
        name.rsplit(".", 1)[1] for name, value in functions_and_classes().items() if not inspect.isclass(value)
    }
    assert not functions & {dotted(path).rsplit(".", 1)[-1] for path in MODULES}


# Names that JAX and its libraries do not promise to keep

FOREIGN = ("jax", "jaxlib", "equinox", "optimistix", "lineax")
UNSTABLE = re.compile(r"^(_.*|internal|interpreters|core)$")
# Documented methods of every NamedTuple.
NAMED_TUPLE = {"_asdict", "_field_defaults", "_fields", "_make", "_replace"}


@cache
def own_private_names() -> set[str]:
    """Private names that the package itself defines: functions, classes, attributes, fields."""
    found = set(NAMED_TUPLE)
    for path in MODULES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                found.add(node.id)
            elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                found.add(node.attr)
    return found


def unstable_imports(tree: ast.AST) -> list[str]:
    """Imports of a private or internal module, or of a private name, of JAX and the libraries on it."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            root, *rest = name.split(".")
            if root in FOREIGN and any(map(UNSTABLE.match, rest)):
                found.append(name)
    return found


def private_attributes(tree: ast.AST, own: set[str]) -> list[str]:
    """Private attributes that are read of something other than the package's own objects."""
    attributes = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    names = [node.attr for node in attributes if node.attr.startswith("_") and not node.attr.startswith("__")]
    return [name for name in names if name not in own]


@pytest.mark.parametrize("path", [path for path in MODULES if path.name != "_compat.py"], ids=dotted)
def test_foreign_private_names_are_in_compat_only(path):
    tree = parsed(path)
    assert unstable_imports(tree) == []
    assert private_attributes(tree, own_private_names()) == []


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("import equinox.internal as eqxi", ["equinox.internal"]),
        ("from jax._src import core", ["jax._src.core"]),
        ("from optimistix.internal import implicit_jvp", ["optimistix.internal.implicit_jvp"]),
        ("import jax.numpy as jnp\nfrom .core import errors", []),
    ],
)
def test_unstable_imports_are_found(code, found):
    assert unstable_imports(ast.parse(code)) == found


def test_private_attributes_are_found():
    assert private_attributes(ast.parse("member._value + self._own + text.__doc__"), {"_own"}) == ["_value"]


# Dependencies

EXTRAS = PROJECT["project"]["optional-dependencies"]
DEPENDENCIES = PROJECT["project"]["dependencies"] + EXTRAS["plot"] + EXTRAS["report"]


def test_the_lowest_versions_are_the_lower_caps():
    pinned = dict(
        line.split("==") for line in (ROOT / "requirements/lowest.txt").read_text().splitlines() if "==" in line
    )
    pinned.pop("jaxlib")  # comes with jax, in the same version
    capped = (re.fullmatch(r"([\w-]+)>=([\d.]+),<[\d.]+", each) for each in DEPENDENCIES)
    assert pinned == dict(found.groups() for found in capped)


def test_every_import_of_another_package_is_declared():
    needed = {
        "PIL",  # comes with matplotlib
        "xarray",  # the extra data
        "distributed",  # the extra dask
        "cv2",  # the extra camera
        "openpyxl",  # the extra excel
        "rosbags",  # the extra ros
        *("backports", "compression"),  # comes with rosbags; of Python 3.14
        "pyarrow",  # the extra lerobot
        *("starlette", "uvicorn", "serial", "regex"),  # the extra live
        "typst",  # the extra certificate
        "yaml",  # PyYAML
        *(each.split(">=")[0] for each in DEPENDENCIES),
    }
    imported = set()
    for path in MODULES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                imported.add(node.module.split(".")[0])
    assert imported - set(sys.stdlib_module_names) - needed == set()


def test_the_reading_path_exists_and_is_short():
    """Every file that the page names is there, and the modules of its numbered list are read in an afternoon."""
    page = (ROOT / "docs" / "explanation" / "reading_the_code.md").read_text()
    steps = re.findall(r"^\d+\. `(\w+/\w+\.py)`", page, flags=re.MULTILINE)
    assert 6 <= len(steps) <= 8
    assert sum(len((PACKAGE / step).read_text().splitlines()) for step in steps) <= 3000
    names = {path.name for path in MODULES}
    missing = [path for path in re.findall(r"`([\w/]+\.py)`", page) if Path(path).name not in names]
    missing += [path for path in re.findall(r"`(\w+/\w+\.py)`", page) if not (PACKAGE / path).is_file()]
    assert not missing

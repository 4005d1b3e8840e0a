"""The page docs/warnings.md has an entry for each warning in the code, and none for others."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from aacmm_jax.diagnostics.findings import diagnostics

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "aacmm_jax"
PAGE = (ROOT / "docs" / "warnings.md").read_text(encoding="utf-8")
# Where warnings are worded: of a module all functions, or those that are named.
SOURCES: dict[str, tuple[str, ...]] = {
    "diagnostics/corrections.py": ("likely_cause",),
    "summaries/arm_survey.py": ("arm_survey",),
    "summaries/compared_models.py": ("_warnings",),
    "summaries/correction.py": ("correction_summary",),
    "cli/calibration_commands.py": ("_compared",),
    "drift/comparison.py": ("_warnings",),
    "data/capture_data.py": ("sentences",),
    "uncertainty/identifiability.py": ("sentences", "by_more_sockets"),
    "acceptance/record.py": ("unstated_uncertainty_warning", "SIMULATED"),
    "pipeline/capture_evaluation.py": ("_warnings",),
    "acceptance/procedure.py": ("_socket_in_zone",),
    "report/studies.py": ("_warnings",),
    "solver/reason.py": ("Reason",),
    "core/jax_setup.py": ("set_up",),
}
# Parts of sentences, by their beginning, and what is no warning.
PARTS = (
    "Converged",
    "The solve has not ended",
    "... mm RMS, ... times",
    "... (... times)",
    "... (... mm, ... times)",
    "... (... of ... poses)",
    "... (... %)",
    "... pose ... (",
    "... ... mm RMS, ... times",
    "... combinations of",
    "... more combinations",
    "... by ... mm",
    "... mm",
    "... (u = ... um)",
    "... is not a plausible scale",
    "k = ... is not a plausible scale",
    "No Reason",
    "Fix one parameter of each combination (--held).",
)


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "..." for part in node.values)
    return ""


def _sentences(node: ast.AST) -> Iterator[str]:
    """The strings of a function that begin a sentence: not its docstring, nor what is added to another string."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        yield from _sentences(node.left)
        return
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    text = _text(node)
    if text:
        if re.match(r"[A-Z]|\.\.\.|k = |the ", text) and text.count(" ") > 2:
            yield text
        return
    for child in ast.iter_child_nodes(node):
        yield from _sentences(child)


def _name(node: ast.AST) -> str:
    if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
        return node.name
    return ast.unparse(node.targets[0]) if isinstance(node, ast.Assign) else ""


def _findings(every: bool = False) -> Iterator[str]:
    """What the findings of all diagnostics say, where it is worded in their place; or every text of a diagnostic."""
    for module in diagnostics():
        tree = ast.parse(Path(module.__file__ or "").read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if every:
                yield _text(node)
            elif not every and isinstance(node, ast.Call) and ast.unparse(node.func) == "Finding":
                yield from _sentences(node.args[1])


def _warnings() -> list[str]:
    found = [text for text in _findings() if not text.startswith("...")]
    for name, functions in SOURCES.items():
        tree = ast.parse((PACKAGE / name).read_text(encoding="utf-8"))
        # A function goes before a variable of its name.
        nodes = sorted(ast.walk(tree), key=lambda node: not isinstance(node, ast.Assign))
        named = {_name(node): node for node in nodes if _name(node)}
        gone = sorted(set(functions) - set(named))
        assert not gone, f"{name} has no {gone}; name what took its place."
        everything = [node for node in named.values() if isinstance(node, ast.FunctionDef)]
        for node in [named[function] for function in functions] or everything:
            found += [text for child in ast.iter_child_nodes(node) for text in _sentences(child)]
    return [text for text in dict.fromkeys(found) if not text.startswith(PARTS)]


def _entries() -> dict[str, re.Pattern[str]]:
    titles = re.findall(r"^### `(.+)`$", PAGE, flags=re.MULTILINE)
    assert len(set(titles)) == len(titles), "an entry stands twice"
    return {title: re.compile(".+?".join(map(re.escape, title.split("…")))) for title in titles}


@pytest.mark.parametrize("warning", _warnings())
def test_each_warning_has_an_entry(warning: str) -> None:
    assert any(entry.match(warning) for entry in _entries().values()), f"docs/warnings.md lacks: {warning}"


def test_each_entry_is_of_a_warning() -> None:
    warnings = [*_warnings(), *_findings(every=True)]
    unused = [title for title, entry in _entries().items() if not any(entry.match(text) for text in warnings)]
    assert not unused, f"docs/warnings.md has entries that no warning begins with: {unused}"


def test_each_entry_says_something() -> None:
    parts = re.split(r"^### `.+`$", PAGE, flags=re.MULTILINE)[1:]
    assert all(len(part.split()) >= 5 for part in parts)

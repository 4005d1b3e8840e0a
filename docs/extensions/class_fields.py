"""What docstrings have beside their text: the fields of a class, with the comment after each (shape, type, unit)."""

import ast
import enum
import inspect
import io
import re
import textwrap
import tokenize
from functools import cache


def _comments(source: str) -> dict[int, str]:
    """Comments by line."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {token.start[0]: token.string.lstrip("#: ").strip() for token in tokens if token.type == tokenize.COMMENT}


@cache
def _fields_of(cls: type) -> dict[str, tuple[str, str]]:
    """Fields that one class itself states: annotation and comment; none of a class that is made at run time."""
    try:
        source = textwrap.dedent(inspect.getsource(cls))
    except OSError:
        return {}
    comments = _comments(source)
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    named = {}
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.end_lineno is not None:
            comment = comments.get(node.end_lineno, "")
            named[node.target.id] = (ast.unparse(node.annotation), comment)
    return named


def fields(cls: type) -> dict[str, tuple[str, str]]:
    """Public fields of a class of this package and of its bases: name to annotation and comment."""
    public: dict[str, tuple[str, str]] = {}
    for base in reversed(inspect.getmro(cls)):
        if base.__module__.startswith("aacmm_jax") and not issubclass(base, enum.Enum):
            public |= {name: field for name, field in _fields_of(base).items() if not name.startswith("_")}
    return public


def lines_of(cls: type, stated: str) -> list[str]:
    """A list of fields as reStructuredText; those without a comment only where the docstring does not list them."""
    lines = []
    for name, (annotation, comment) in fields(cls).items():
        if comment or f"\n    {name}: " not in stated:
            text = f": {comment}" if comment else ""
            lines.append(f"* **{name}** (``{annotation}``){text}")
    return ["", "**Fields**", "", *lines, ""] if lines else []


def without_substitutions(text: str) -> str:
    """Vertical bars outside code are signs of mathematics, and no substitution of reStructuredText."""
    return "".join(
        part if part.startswith("`") else part.replace("|", r"\|") for part in re.split("(``.*?``|`.*?`)", text)
    )


def add_fields(app, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Append the fields of a class to its docstring."""
    if what == "class" and inspect.isclass(value):
        lines += lines_of(value, value.__doc__ or "")
    lines[:] = map(without_substitutions, lines)


def skip_foreign(app, what: str, name: str, value: object, skip: bool, options: object) -> bool | None:
    """A member that another package defines, such as the fields of a named tuple, is none to document here."""
    function = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
    module = getattr(inspect.unwrap(function), "__module__", None) if callable(function) else None
    return None if module and module.startswith("aacmm_jax") else True


def setup(app) -> dict[str, object]:
    """Called by Sphinx; after napoleon, which sees the docstring alone."""
    app.connect("autodoc-process-docstring", add_fields, priority=900)
    app.connect("autodoc-skip-member", skip_foreign)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

"""Signatures as they are written: `Numbers` and `Float[Array, "poses joints"]`, and not what these stand for."""

import ast
import contextlib
import inspect
import textwrap

from class_fields import fields


def _arguments(node: ast.FunctionDef) -> str:
    """The arguments as in the source, without ``self`` and ``cls``."""
    arguments = node.args
    if arguments.args and arguments.args[0].arg in ("self", "cls"):
        arguments.args = arguments.args[1:]
        arguments.defaults = arguments.defaults[-len(arguments.args) :] if arguments.args else []
    return f"({ast.unparse(arguments)})"


def _definition(value: object) -> ast.FunctionDef | None:
    """The definition of a function whose signature no decorator has changed, as a syntax tree."""
    if not inspect.isfunction(inspect.unwrap(value)) or hasattr(value, "__signature__"):
        return None
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(value)))).body
    return node if isinstance(node, ast.FunctionDef) else None


def _constructor(cls: type) -> str:
    """The constructor's arguments; nothing for a class that users do not make, whose fields are listed below it."""
    if "Args:" not in (cls.__doc__ or ""):
        return ""
    written = vars(cls).get("__init__")
    if written is not None and written.__qualname__ == f"{cls.__qualname__}.__init__":
        with contextlib.suppress(OSError):
            node = _definition(written)
            if node is not None:
                return _arguments(node)
    annotations, parameters = fields(cls), inspect.signature(cls).parameters.values()
    parts = [
        f"{parameter.name}: {annotations.get(parameter.name, ('Any', ''))[0]}"
        + ("" if parameter.default is parameter.empty else " = ...")
        for parameter in parameters
    ]
    return f"({', '.join(parts)})"


def as_written(app, what: str, name: str, value: object, options: object, signature: str, returns: str):
    """The signature of a function, a method, or a class with a constructor of its own."""
    if what == "class":
        return None if issubclass(value, BaseException) else (_constructor(value), None)
    node = _definition(getattr(value, "__func__", value))
    if node is None:
        return None
    return _arguments(node), ast.unparse(node.returns) if node.returns else None


def setup(app) -> dict[str, object]:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", as_written)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

"""Every public name of the package, once, with the namespaces that have it: what the stubs `__init__.pyi` list."""

import ast
import importlib
import inspect
import textwrap
from pathlib import Path
from typing import NamedTuple

import aacmm_jax

PACKAGE = Path(aacmm_jax.__file__).parent


class PublicName(NamedTuple):
    """A function, class or value, under its shortest full name."""

    name: str  # such as aacmm_jax.files.load_capture
    value: object
    also: tuple[str, ...]  # other names of the same function or class
    source: Path  # of the module in which it is written

    @property
    def namespace(self) -> str:
        """The namespace of the shortest name."""
        return self.name.rpartition(".")[0]

    @property
    def short(self) -> str:
        """The name alone."""
        return self.name.rpartition(".")[2]

    @property
    def directive(self) -> str:
        """What documents it."""
        if inspect.isclass(self.value):
            return "autoclass"
        return "autofunction" if callable(self.value) else "py:data"

    @property
    def docstring(self) -> str:
        """Its docstring; of a value, the comment before it."""
        return (inspect.getdoc(self.value) or "") if callable(self.value) else _comment_before(self.short, self.source)


def _comment_before(name: str, source: Path) -> str:
    """The comment lines right above the assignment of a value."""
    lines = source.read_text(encoding="utf-8").splitlines()
    number = next(i for i, line in enumerate(lines) if line.startswith((f"{name} =", f"{name}:")))
    first = number
    while lines[first - 1].startswith("# "):
        first -= 1
    return textwrap.dedent("\n".join(line.removeprefix("# ") for line in lines[first:number]))


def namespaces() -> list[str]:
    """The package and every folder of it that has public names, the package first."""
    stubs = sorted(PACKAGE.rglob("__init__.pyi"), key=lambda path: path.parts[:-1])
    return [".".join(("aacmm_jax", *path.parent.relative_to(PACKAGE).parts)) for path in stubs]


def _sources(namespace: str) -> dict[str, Path]:
    """The file that each name of a namespace is written in, as its stub says."""
    stub = PACKAGE.joinpath(*namespace.split(".")[1:]) / "__init__.pyi"
    imports = [node for node in ast.parse(stub.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom)]
    return {
        alias.name: stub.parent.joinpath(*node.module.split(".")).with_suffix(".py")
        for node in imports
        if node.module and node.level == 1
        for alias in node.names
    }


def public_names() -> list[PublicName]:
    """Functions, classes and values that a namespace exports, namespaces themselves left out."""
    names: dict[object, list[str]] = {}
    defined: dict[object, tuple[object, Path]] = {}
    for namespace in namespaces():
        module, sources = importlib.import_module(namespace), _sources(namespace)
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.ismodule(value):
                continue
            key = value if callable(value) else f"{namespace}.{name}"
            names.setdefault(key, []).append(f"{namespace}.{name}")
            path = inspect.getsourcefile(inspect.unwrap(value)) if callable(value) else sources[name]
            assert path is not None
            defined.setdefault(key, (value, Path(path)))
    return [PublicName(full[0], defined[key][0], tuple(full[1:]), defined[key][1]) for key, full in names.items()]

"""The pages of the reference that are generated: one for each subject; and the notebooks, linked where Sphinx looks.

A name of ``aj`` itself is described with the subject whose folder it is written in. The pages are written to
docs/reference/api when a build begins, and git ignores them.
"""

import importlib
import inspect
import shutil
from pathlib import Path

from class_fields import without_substitutions
from public_names import PACKAGE, PublicName, namespaces, public_names

DOCS = Path(__file__).resolve().parents[1]
ROOT = PACKAGE.name


def _link(name: str) -> str:
    return f":py:obj:`~{name}`"


def _underlined(title: str, line: str) -> list[str]:
    return [title, line * len(title), ""]


def _entry(item: PublicName) -> list[str]:
    """One name with its docstring; a value that is a dictionary with its contents."""
    lines = [f".. {item.directive}:: {item.name}"]
    if item.directive == "autoclass":
        lines += ["   :members:", "   :inherited-members: tuple, Module, BaseModel, str, int, Enumeration, Enum"]
    lines.append("")
    if isinstance(item.value, dict):
        lines += [f"   {line}" for line in item.docstring.splitlines()] + [""]
        lines += [f"   * ``{key}``: {text}" for key, text in item.value.items()] + [""]
    if item.also:
        lines += ["Also: " + ", ".join(f"``{other}``" for other in item.also) + ".", ""]
    return [*lines, f"*Written in* ``{item.source.relative_to(PACKAGE.parent)}``.", ""]


def _summary(item: PublicName) -> str:
    return without_substitutions(item.docstring.partition("\n\n")[0].replace("\n", " "))


def subject(item: PublicName) -> str:
    """The namespace on whose page a name is described."""
    if item.namespace != ROOT:
        return item.namespace
    folder = ".".join((ROOT, *item.source.relative_to(PACKAGE).parts[:-1]))
    return max((name for name in namespaces() if f"{folder}.".startswith(f"{name}.")), key=len)


def page(namespace: str, names: list[PublicName]) -> str:
    """The reference of one namespace as reStructuredText."""
    module = importlib.import_module(namespace)
    of_namespace = [item for item in names if subject(item) == namespace]
    others = [item for item in names if any(name.rpartition(".")[0] == namespace for name in item.also)]
    title = namespace.replace("aacmm_jax", "aj", 1)
    lines = [*_underlined(title, "="), inspect.getdoc(module) or "", ""]
    if namespace == ROOT:
        lines += ["| " + f"{_link(item.name)}: {_summary(item)}" for item in names if item.namespace == ROOT] + [""]
    elif of_namespace:
        lines += ["| " + f"{_link(item.name)}: {_summary(item)}" for item in of_namespace] + [""]
    if others:
        lines += ["Here too: " + ", ".join(_link(item.name) for item in others) + ".", ""]
    for item in of_namespace:
        lines += [*_underlined(item.short, "-"), *_entry(item)]
    return "\n".join(lines) + "\n"


def write_if_changed(path: Path, text: str) -> None:
    """An unchanged page keeps its time, so that Sphinx does not read it again."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def write_pages(app) -> None:
    """Write the page of every namespace."""
    names = public_names()
    for namespace in namespaces():
        name = namespace.partition(".")[2] or "aj"
        write_if_changed(DOCS / "reference" / "api" / f"{name}.rst", page(namespace, names))


def link_notebooks(app) -> None:
    """Sphinx reads what is below docs/: a link, or a copy on a system that does not let this user make links."""
    link = DOCS / "notebooks"
    if not link.exists():
        try:
            link.symlink_to(Path("..") / "notebooks", target_is_directory=True)
        except OSError:
            shutil.copytree(DOCS.parent / "notebooks", link)


def setup(app) -> dict[str, object]:
    """Called by Sphinx."""
    app.connect("builder-inited", link_notebooks)
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

"""The gallery: every figure of the site with the code that draws it, written to docs/reference/gallery.md."""

import ast
import base64
import json
from pathlib import Path

from api_pages import link_notebooks, write_if_changed

DOCS = Path(__file__).resolve().parents[1]
PAGE = DOCS / "reference" / "gallery.md"
OPENING = """# Gallery

Every figure of this site, with the code that draws it.
"""
WHOLE = {"layout_picture": ["layout.svg"], "pictures": ["demo.png", "report.png"]}  # by module, drawn by all of it


def _code(module: str, function: str = "") -> list[str]:
    part = f":pyobject: {function}\n" if function else ""
    block = f"```{{literalinclude}} ../{module}.py\n:language: python\n{part}```"
    return [f"<details><summary>Code: docs/{module}.py</summary>", block, "</details>"]


def _drawn(module: str) -> list[str]:
    """The figures that the functions of a module draw, each with its docstring."""
    parts = []
    for node in ast.parse((DOCS / f"{module}.py").read_text(encoding="utf-8")).body:
        names = [child.value for child in ast.walk(node) if isinstance(child, ast.Constant)]
        names = [name for name in names if isinstance(name, str) and name and (DOCS / f"{name}.svg").is_file()]
        if isinstance(node, ast.FunctionDef) and names:
            text = (ast.get_docstring(node) or "").replace("\n", " ")
            parts += [f"![{text}](../{names[0]}.svg)", text, *_code(module, node.name)]
    return parts


def _of_notebooks() -> list[str]:
    """The first figure of each notebook, as the notebook is stored."""
    parts = []
    for path in sorted((DOCS / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        outputs = (output.get("data", {}) for cell in cells for output in cell.get("outputs", ()))
        image = next((data["image/png"] for data in outputs if "image/png" in data), None)
        if image:
            picture = PAGE.parent / "gallery" / f"{path.stem}.png"
            picture.parent.mkdir(exist_ok=True)
            picture.write_bytes(base64.b64decode(image))
            parts += [f"![The first figure of the notebook](gallery/{picture.name})"]
            parts += [f"Code: {{doc}}`../notebooks/{path.stem}`"]
    return parts


def page() -> str:
    """The whole page."""
    parts = [OPENING, "## Set-ups and conventions", *_drawn("drawings"), "## Results", *_drawn("figures")]
    for module, names in WHOLE.items():
        for name in names:
            parts += [f"![Drawn by docs/{module}.py](../{name})"]
        parts += _code(module)
    return "\n\n".join([*parts, "## Notebooks", *_of_notebooks()]) + "\n"


def _write(app) -> None:
    link_notebooks(app)
    write_if_changed(PAGE, page())


def setup(app) -> dict[str, object]:
    """Called by Sphinx."""
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

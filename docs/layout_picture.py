"""Makes docs/layout.svg, the package's folders with the imports between them: python docs/layout_picture.py.

A row is a folder, a column a folder that it imports, a number how many of the row's modules do; on the diagonal, how
many modules there are. The order is that of the layers in pyproject.toml: as long as imports go down, every other
number is to the right of the diagonal.
"""

import ast
import re
import tomllib
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "docs" / "layout.svg"
PACKAGE = "aacmm_jax"
CELL, NAME, TEXT, TOP = 31, 96, 470, 92  # pixels: a cell, where names and texts begin, the first row
STYLE = """
  text { font: 13px system-ui, sans-serif; fill: #222 }
  .small { font-size: 11.5px; fill: #555 } .number { font-size: 12px }
  .paper { fill: #fff } .layer { fill: #f2f4f8 } .used { fill: #1b3a6b } .own { fill: #d7dce6 }
  @media (prefers-color-scheme: dark) {
    text { fill: #ddd } .small { fill: #aaa } .paper { fill: #16181d } .layer { fill: #20242c } .used { fill: #7fa3e0 }
    .own { fill: #3a404c }
  }
"""


def layers() -> list[list[str]]:
    """The folders of each layer, from the top."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (folders,) = (contract["layers"] for contract in contracts if contract["type"] == "layers")
    return [sorted(layer.split(" | ")) for layer in folders]


def modules(folder: str) -> list[Path]:
    """The Python files of a folder and those below it."""
    return sorted((ROOT / PACKAGE / folder).rglob("*.py"))


def imported_folders(path: Path) -> set[str]:
    """The folders of the package from which a module imports, inside of functions too."""
    package = path.relative_to(ROOT).parts[:-1]  # of the module; of an __init__.py the package itself
    imported = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1] + tuple(node.module.split(".") if node.module else ())
            named = [base] if len(base) > 1 else [(*base, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            named = [tuple(node.module.split("."))]
        elif isinstance(node, ast.Import):
            named = [tuple(alias.name.split(".")) for alias in node.names]
        else:
            continue
        imported |= {name[1] for name in named if name[0] == PACKAGE and len(name) > 1}
    return imported


def imports(folders: list[str]) -> dict[tuple[str, str], int]:
    """By importing and imported folder, how many modules of the first import the second."""
    counts: dict[tuple[str, str], int] = {}
    for folder in folders:
        for path in modules(folder):
            for other in (imported_folders(path) & {*folders}) - {folder}:
                counts[folder, other] = counts.get((folder, other), 0) + 1
    return counts


def contents(folder: str) -> str:
    """The beginning of a folder's docstring, as much as a row has room for."""
    text = ast.get_docstring(ast.parse((ROOT / PACKAGE / folder / "__init__.py").read_text(encoding="utf-8"))) or ""
    short = re.split(r"[:;(.]\s|\s\(|\.$", " ".join(text.split()))[0].replace("``", "")
    return short if len(short) <= 66 else short[:66].rpartition(",")[0]


def picture() -> str:
    """The whole SVG."""
    order = layers()
    folders = [folder for layer in order for folder in layer]
    counts = imports(folders)
    width, height = TEXT + CELL * len(folders) + 20, TOP + CELL * len(folders) + 14
    most = max(counts.values())
    drawn = [f'<rect class="paper" width="{width}" height="{height}"/>']
    drawn.append(f'<text class="small" x="12" y="{TOP - 12}">layer, folder, what it holds</text>')
    row = 0
    for number, layer in zip(range(len(order), 0, -1), order, strict=True):
        y = TOP + CELL * row
        drawn.append(f'<rect class="layer" x="8" y="{y + 1}" width="{width - 16}" height="{CELL * len(layer) - 2}"/>')
        drawn.append(f'<text class="small" x="14" y="{y + 20}">{number}</text>')
        row += len(layer)
    for row, folder in enumerate(folders):
        x, y = TEXT + CELL * row, TOP + CELL * row
        drawn.append(f'<text x="36" y="{y + 20}">{folder}</text>')
        drawn.append(f'<text class="small" x="{NAME + 28}" y="{y + 20}">{escape(contents(folder))}</text>')
        drawn.append(f'<text transform="translate({x + 20} {TOP - 8}) rotate(-50)">{folder}</text>')
        drawn.append(_cell(x, y, "own", 1.0, len(modules(folder))))
        for column, other in enumerate(folders):
            if count := counts.get((folder, other)):
                strength = 0.15 + 0.5 * (count / most) ** 0.5
                drawn.append(_cell(TEXT + CELL * column, y, "used", strength, count))
    body = "\n".join(drawn)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}">\n'
        f"<title>Folders of {PACKAGE} and the imports between them</title>\n<style>{STYLE}</style>\n{body}\n</svg>\n"
    )


def _cell(x: int, y: int, kind: str, opacity: float, number: int) -> str:
    return (
        f'<rect class="{kind}" x="{x + 1}" y="{y + 1}" width="{CELL - 2}" height="{CELL - 2}" opacity="{opacity:.2f}"/>'
        f'<text class="number" text-anchor="middle" x="{x + CELL // 2}" y="{y + 20}">{number}</text>'
    )


if __name__ == "__main__":
    TARGET.write_text(picture(), encoding="utf-8")

"""The size of the package: lines by folder, long and wide functions, modules with one user, comments with reasons.

Run as `python benchmarks/size.py [FOLDER]`; a folder of the package limits the lists to it.
"""

import ast
import io
import re
import sys
import tokenize
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "aacmm_jax"
MODULES = sorted(PACKAGE.rglob("*.py"))
COMMENTED = ("core", "solver", "model", "calibration", "uncertainty", "kinematics")
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def own_lines(node: ast.AST) -> int:
    """Lines of a function without its docstring."""
    assert isinstance(node, FUNCTIONS)
    lines = (node.end_lineno or 0) - node.body[0].lineno + 1
    if ast.get_docstring(node):
        lines -= (node.body[0].end_lineno or 0) - node.body[0].lineno + 1
    return lines


def parameters(node: ast.AST) -> int:
    assert isinstance(node, FUNCTIONS)
    arguments = node.args
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return len([argument for argument in every if argument.arg not in ("self", "cls")])


def imports(path: Path) -> set[Path]:
    """Modules of the package that a module imports."""
    imported = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.ImportFrom) or not node.level:
            continue
        folder = path.parents[node.level - 1]
        base = folder.joinpath(*(node.module or "").split("."))
        for alias in node.names:
            for target in (base / alias.name, base):
                if target.with_suffix(".py").is_file():
                    imported.add(target.with_suffix(".py"))
                    break
    return imported


def comments(path: Path) -> tuple[int, int]:
    """Lines with a comment, and lines of code."""
    text, with_comment, code = path.read_text(), set(), set()
    skipped = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and not re.match(r"#\s*(noqa|pyright|type:)", token.string):
            with_comment.add(token.start[0])
        elif token.type not in skipped and not (token.type == tokenize.STRING and token.line.strip().startswith('"""')):
            code.update(range(token.start[0], token.end[0] + 1))
    return len(with_comment), len(code)


def main() -> None:
    chosen = PACKAGE / sys.argv[1] if len(sys.argv) > 1 else PACKAGE
    lines: dict[str, int] = defaultdict(int)
    for path in [*MODULES, *PACKAGE.rglob("*.pyi")]:
        parts = path.relative_to(PACKAGE).parts
        lines[parts[0] if len(parts) > 1 else "."] += len(path.read_text().splitlines())
    for folder, count in sorted(lines.items()):
        print(f"{count:7,} {folder}")
    texts = [path.read_text() for path in MODULES]
    written = [line for text in texts for line in text.splitlines()]
    statements = sum(isinstance(node, ast.stmt) for text in texts for node in ast.walk(ast.parse(text)))
    print(f"{sum(lines.values()):7,} lines in {len(MODULES)} modules")
    characters = sum(map(len, written)) / len(written)
    print(f"{statements / len(written):7.3f} statements and {characters:.1f} characters a line")
    users = defaultdict(set)
    for path in MODULES:
        for target in imports(path):
            users[target].add(path)
    wide, long = [], []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, FUNCTIONS):
                where = f"{path.relative_to(PACKAGE)}:{node.lineno} {node.name}"
                wide.append((parameters(node), where, path))
                long.append((own_lines(node), where, path))
    for title, rows, limit in (("parameters", wide, 8), ("lines without the docstring", long, 60)):
        over = sorted((row for row in rows if row[0] > limit), reverse=True)
        print(f"\n{len(over)} functions with more than {limit} {title}")
        for count, where, path in over:
            if path.is_relative_to(chosen):
                print(f"{count:5} {where}")
    single = [path for path in MODULES if len(users[path]) == 1]
    print(f"\n{len(single)} modules imported by exactly one other")
    for path in single:
        if path.is_relative_to(chosen):
            print(f"      {path.relative_to(PACKAGE)} by {next(iter(users[path])).relative_to(PACKAGE)}")
    both = [comments(path) for path in MODULES if path.relative_to(PACKAGE).parts[0] in COMMENTED]
    commented, code = (sum(counts) for counts in zip(*both, strict=True))
    print(f"\n{100 * commented / code:.1f} lines with a comment per 100 lines of code in {', '.join(COMMENTED)}")


if __name__ == "__main__":
    main()

"""Every snippet of every page runs, from the top of the page to its end; docs/conf.py says which blocks are run."""

import contextlib
import os
import re
import shlex
import sys
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import pytest

from ..conftest import command_line
from ..own_kinds import forgotten_kinds

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
GENERATED = {"_build", "notebooks", "api"}
PAGES = sorted(
    path.relative_to(DOCS).as_posix()
    for path in DOCS.rglob("*.md")
    if not GENERATED & {*path.relative_to(DOCS).parts} and path.name not in ("command_line.md", "hdf5.md")
)
BLOCK = re.compile(
    r"^(?:<!-- (?:file: (?P<file>\S+)|(?P<not_run>not run: [^\n]+)) -->\n+)?"
    r"(?P<fence>`{3,}|:{3,})(?P<language>[\w{}-]*)[^\n]*\n(?P<text>.*?)^(?P=fence) *$",
    flags=re.MULTILINE | re.DOTALL,
)
# Pages with nothing to run are read here; of the others, each costs a calibration or more, and these more than 10 s.
EXHAUSTIVE = {"explanation/random_splits.md", "how_to/planning.md", "how_to/studies.md"}
COMPARED = {"readers/measuring_arm_worked.md", "readers/robot_with_tracker.md"}  # pages whose outputs are compared


class Snippet(NamedTuple):
    """One block of a page."""

    language: str
    text: str
    file: str | None


def snippets(page: str) -> list[Snippet]:
    """The blocks of a page that are run or written."""
    found = [
        Snippet(match["language"], match["text"], match["file"])
        for match in BLOCK.finditer((DOCS / page).read_text("utf-8"))
        if not match["not_run"]
    ]
    return [each for each in found if each.language in ("python", "console") or each.file]


def commands(text: str) -> list[list[str]]:
    """The ``aacmm`` commands of a console block; a line that ends with a backslash goes on."""
    lines = text.replace("\\\n", " ").splitlines()
    return [shlex.split(line[2:], comments=True) for line in lines if line.startswith("$ aacmm")]


def variables(text: str) -> list[str]:
    """The environment variables that a console block sets."""
    return re.findall(r"^\$ export (\w+=.*)$", text, flags=re.MULTILINE)


def outputs(text: str) -> list[re.Pattern[str]]:
    """What a console block shows below each command, a word after the other; ``...`` is any text, or none."""
    shown = re.split(r"^\$ aacmm.*\n", text.replace("\\\n", " "), flags=re.MULTILINE)[1:]
    return [re.compile(".*".join(re.escape(" ".join(x.split())) for x in part.split("..."))) for part in shown]


def marks(page: str) -> list[pytest.MarkDecorator]:
    if page in EXHAUSTIVE:
        return [pytest.mark.exhaustive]
    return [pytest.mark.slow] if snippets(page) else []


@pytest.mark.first_rows(3)
@pytest.mark.parametrize("page", [pytest.param(page, marks=marks(page)) for page in PAGES])
def test_snippets_run(page, tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    for extra in (DOCS / page).parent.glob("*.urdf"):
        (tmp_path / extra.name).write_bytes(extra.read_bytes())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(os.environ, "MPLBACKEND", "agg")
    monkeypatch.syspath_prepend(tmp_path)
    with forgotten_kinds(), forgotten_modules(tmp_path):
        run_snippets(page, tmp_path, monkeypatch)
    plt.close("all")


def run_snippets(page, tmp_path, monkeypatch):
    namespace: dict[str, object] = {"__name__": page}
    for number, (language, text, file) in enumerate(snippets(page), start=1):
        if file is not None:
            assert not Path(file).is_absolute()
            assert ".." not in Path(file).parts
            Path(file).parent.mkdir(parents=True, exist_ok=True)
            Path(file).write_text(text, encoding="utf-8")
        elif language == "python":
            with contextlib.redirect_stdout(None):
                exec(compile(text, f"{page}, block {number}", "exec"), namespace)
        else:
            for variable in variables(text):
                monkeypatch.setenv(*variable.split("=", 1))
            for example in re.findall(r"^\$ cd (examples/\S+)$", text, flags=re.MULTILINE):
                copy_missing(ROOT / example, folder=tmp_path)
            for command, output in zip(commands(text), outputs(text), strict=True):
                printed = " ".join(command_line(tmp_path, *command[1:]).stdout.split())
                assert page not in COMPARED or output.search(printed), (output.pattern, printed)


def copy_missing(example, folder):
    """Files of an example, beside those that the page has written."""
    for path in example.iterdir():
        if path.is_file() and not (folder / path.name).exists():
            (folder / path.name).write_bytes(path.read_bytes())


@contextlib.contextmanager
def forgotten_modules(folder):
    """Modules that a page writes, and imports, are not those of another page."""
    yield
    for name, module in list(sys.modules.items()):
        if Path(getattr(module, "__file__", None) or "/").parent == folder:
            del sys.modules[name]


def test_blocks_are_found(tmp_path, monkeypatch):
    text = "<!-- file: a.toml -->\n```toml\nx = 1\n```\n\n```text\nno\n```\n"
    text += "<!-- not run: a reason -->\n```python\nx\n```\n"
    text += "```console\n$ aacmm show \\\n  a.h5  # b\nprinted\n```\n"
    (tmp_path / "page.md").write_text(text)
    monkeypatch.setattr(f"{__name__}.DOCS", tmp_path)
    file, console = snippets("page.md")
    assert file == ("toml", "x = 1\n", "a.toml")
    assert commands(console.text) == [["aacmm", "show", "a.h5"]]
    (output,) = outputs(console.text.replace("printed", "a ...\nprinted"))
    assert output.search("a b printed")
    assert not output.search("a b painted")


def test_pages_that_take_long_exist():
    assert set(PAGES) >= EXHAUSTIVE

"""The README is short, leads somewhere, and its Python and commands print what it says."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^aacmm (.*)$", README, flags=re.MULTILINE)


def test_it_is_short():
    lines = README.splitlines()
    assert len(lines) <= 80
    assert max(map(len, lines)) <= 120


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_links_lead_somewhere(page):
    links = [
        link for link in re.findall(r"\]\(([^)]*)\)", (ROOT / page).read_text(encoding="utf-8")) if "://" not in link
    ]
    assert links
    assert not [link for link in links if not (ROOT / link.partition("#")[0]).is_file()]


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A folder in which the paths of the README are right."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("clone")
def test_python_prints_what_it_says(capsys):
    (program,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    exec(compile(program, "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 2
    assert all(f"`{line}`" in README for line in printed)


@pytest.mark.exhaustive
@pytest.mark.usefixtures("clone")
def test_commands_print_what_it_says(aacmm, tmp_path):
    demo, *commands = COMMANDS
    assert demo == "demo"
    printed = [" ".join(aacmm(*re.sub('"', "", command).split()).stdout.split()) for command in commands]
    said = "held-out poses are 0.245 mm RMS from their geometry, predicted 0.401 mm"
    assert said in printed[2]
    assert said in " ".join(README.split())
    assert (tmp_path / "report.html").stat().st_size > 1e5

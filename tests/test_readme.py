"""The README is short, leads somewhere, and its Python and commands print what it says."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
TARGETS = (
    " ".join(re.findall(r"^\.PHONY: (.*?[^\\])$", MAKEFILE, flags=re.DOTALL | re.MULTILINE)).replace("\\", "").split()
)
# Of the documentation only what the repository holds: building it makes more.
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/[!_]*/*.md")]
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


def test_it_gives_two_commands_that_make_knows():
    (block,) = re.findall(r"^## Two commands\n.*?```\n(.*?)```", README, flags=re.DOTALL | re.MULTILINE)
    assert [line.split("#")[0].strip() for line in block.splitlines()] == ["make demo", "make test"]


@pytest.mark.first_rows(3)
@pytest.mark.parametrize("target", TARGETS)
def test_a_shell_can_read_what_make_runs(target):
    line = ["make", "--no-print-directory", "--dry-run", "--always-make", target, "NOTEBOOKS=stored"]
    commands = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert commands
    subprocess.run(["bash", "-n"], input=commands, text=True, check=True)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_targets_that_pages_name_exist(page):
    named = re.findall(r"(?:^|`)make ([a-z][a-z-]+)", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert set(named) <= {*TARGETS}


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
    printed = [" ".join(aacmm(*re.sub('"', "", command).split()).stdout.split()) for command in COMMANDS]
    number = "([0-9.]+)"  # of the nominal arm, of the calibrated arm, predicted
    three = " ".join([number] * 3)
    rows = f"their socket's centroid or geometry {three} .*?RMS error of reference lengths - {number}"
    nominal, found, predicted, length = map(float, re.findall(rows, printed[0])[0])
    assert f"nominal ones are {nominal:.2f} mm off" in " ".join(README.split())
    said = f"{found:.2f} mm RMS, where {predicted:.2f} mm was expected, and its length of 50 mm to {length:.2f} mm"
    assert said in " ".join(README.split())
    assert (tmp_path / "report.html").stat().st_size > 1e5

"""What assistants read: the skill names commands, options, arms, extras and tables of manifests that exist."""

import re
import tomllib
from pathlib import Path

import pytest

from aacmm_jax.data import observations
from aacmm_jax.files import arms

from ..conftest import command_line

ROOT = Path(__file__).resolve().parents[2]
SKILL = (ROOT / "skills" / "calibrate" / "SKILL.md").read_text("utf-8")
CODE = re.findall(r"`([^`\n]+)`|^    (aacmm .+)$", SKILL, flags=re.MULTILINE)
COMMANDS = sorted({match.group() for part in CODE for match in re.finditer(r"aacmm [a-z][a-z-]+", "".join(part))})


@pytest.mark.first_rows(3)
@pytest.mark.parametrize("command", COMMANDS)
def test_commands_and_their_options_exist(command, tmp_path):
    printed = command_line(tmp_path, *command.split()[1:], "--help").stdout
    used = {option for part in CODE if command in "".join(part) for option in re.findall(r"--[a-z-]+", "".join(part))}
    assert {option for option in used if option not in printed} == set()


def test_options_arms_extras_and_tables_exist(tmp_path):
    printed = command_line(tmp_path, "calibrate", "--help").stdout
    assert all(option in printed for option in ("--encoder-arcsec", "--seating-mm", "--scale", "--model", "--robust"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (extras,) = re.findall(r"For images add the extra (.*?); a message", SKILL, flags=re.DOTALL)
    assert {*re.findall(r"`(\w+)`", extras)} <= {*project["optional-dependencies"]}
    (row,) = re.findall(r"^\| (`cheng2018.*?) \|", SKILL, flags=re.MULTILINE)
    assert {*re.findall(r"`([\w-]+)`", row)} == {*arms.shipped_arms()}
    tables = {*re.findall(r"\[\[(\w+)\]\]", SKILL)}
    kinds = {getattr(getattr(observations, name), "table", None) for name in observations.__all__}
    assert tables - {"socket", "length"} <= kinds
    assert SKILL.startswith("---\nname: calibrate\ndescription:")

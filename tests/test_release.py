"""`make release`: which versions and changelogs are refused, what is rewritten, and that metadata agree."""

import datetime
import importlib.machinery
import importlib.util
import json
import re
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
DAY = datetime.date(2027, 1, 31)


@pytest.fixture(scope="module")
def release():
    loader = importlib.machinery.SourceFileLoader("release", str(ROOT / ".ci" / "release"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("release", loader))
    written, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    loader.exec_module(module)
    sys.dont_write_bytecode = written
    return module


@pytest.fixture(scope="module")
def texts(release):
    return {name: (ROOT / name).read_text("utf-8") for name in release.STATED}


def test_a_version_is_written_wherever_it_is_stated(release, texts):
    new = release.stated("9.0.0rc1", DAY, texts)
    cited, described = yaml.safe_load(new["CITATION.cff"]), json.loads(new["codemeta.json"])
    recipe = yaml.safe_load(new["recipe/recipe.yaml"])
    versions = (
        tomllib.loads(new["pyproject.toml"])["project"]["version"],
        cited["version"],
        cited["preferred-citation"]["version"],
        described["version"],
        recipe["context"]["version"],
        release.HEADING.search(new["CHANGELOG.md"])[1],
    )
    assert {*versions} == {"9.0.0rc1"}
    assert recipe["package"]["version"] == "${{ version }}"
    assert cited["date-released"] == DAY
    assert {described["datePublished"], release.HEADING.search(new["CHANGELOG.md"])[2]} == {"2027-01-31"}
    again = release.stated("9.0.0rc1", DAY, new)
    assert again == new
    today = tomllib.loads(texts["pyproject.toml"])["project"]["version"]
    changed = {name: len({*new[name].splitlines()} ^ {*texts[name].splitlines()}) for name in texts}
    assert today == "9.0.0rc1" or max(changed.values()) <= 5, "more than versions and dates changed"


@pytest.mark.parametrize(
    ("version", "changelog", "part"),
    [
        ("", "## 1.0.0 (unreleased)\n\ntext", "is not a version"),
        ("v2.0", "## 1.0.0 (unreleased)\n\ntext", "is not a version"),
        ("0.0.1", "## 1.0.0 (unreleased)\n\ntext", "comes before"),
        ("9.0.0", "## 1.0.0 (2026-01-01)\n\ntext", "unreleased"),
        ("9.0.0", "## 1.0.0 (unreleased)\n\n## 0.9.0 (2026-01-01)\n\ntext", "is empty"),
        ("9.0.0", "## 1.0.0 (unreleased)\n\ntext", ""),
    ],
)
def test_refusals(release, texts, version, changelog, part):
    reason = release.refusal(version, texts | {"CHANGELOG.md": f"# Changelog\n\n{changelog}\n"})
    assert (part in reason) if part else not reason


def test_a_candidate_comes_before_its_release(release):
    ordered = ["0.9.0", "0.10.0rc1", "0.10.0rc2", "0.10.0", "1.0.0"]
    assert sorted(ordered, key=release.order) == ordered


def test_the_stated_files_agree_with_each_other(release, texts):
    """Of pyproject.toml: codemeta.json, which `release.codemeta` makes, and the recipe, but for the names of conda."""
    project = tomllib.loads(texts["pyproject.toml"])["project"]
    assert json.loads(texts["codemeta.json"]) == release.codemeta(project, yaml.safe_load(texts["CITATION.cff"]))
    recipe = yaml.safe_load(texts["recipe/recipe.yaml"])
    assert recipe["context"]["version"] == project["version"]
    assert recipe["about"]["summary"] == project["description"]
    needed = {requirement.lower() for requirement in project["dependencies"]} | {f"python{project['requires-python']}"}
    assert {re.sub(" ", "", run) for run in recipe["requirements"]["run"]} == needed
    assert {*tomllib.loads(texts["pyproject.toml"])["build-system"]["requires"]} < {*recipe["requirements"]["host"]}

"""Files that the pages state, and that no command there reads, are as the package and the examples have them."""

import re
import tomllib
from pathlib import Path

import pytest

import aacmm_jax as aj

DOCS = Path(__file__).resolve().parents[2] / "docs"


def table_with(page: str, text: str) -> str:
    """The one block of a page in which a text stands."""
    blocks = re.findall(r"```\w*\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    (found,) = (block for block in blocks if text in block)
    return found


@pytest.mark.parametrize(
    ("page", "text", "example"),
    [
        ("start.md", "[[socket]]", "mukca/capture.toml"),
        ("how_to/manifests.md", "{place}/{hole}", "mukca/capture.toml"),
        ("how_to/manifests.md", "series_c.csv", "ipa_ur10/positions.toml"),
    ],
)
def test_manifests_are_those_of_the_examples(page, text, example, mukca):
    assert tomllib.loads(table_with(page, text)) == tomllib.loads((mukca.parent / example).read_text())


@pytest.mark.parametrize("name", ["session.toml", "bar.toml", "laboratory.toml"])
def test_files_of_the_measuring_arm_are_those_of_its_page(name):
    """To the letter: the page's commands are run in the folder of the example."""
    page = (DOCS / "readers" / "measuring_arm_worked.md").read_text(encoding="utf-8")
    (block,) = re.findall(rf"<!-- file: {re.escape(name)} -->\n```toml\n(.*?)```", page, flags=re.DOTALL)
    assert block == (DOCS.parent / "examples" / "measuring_arm" / name).read_text(encoding="utf-8")


def test_the_shipped_arms_are_named():
    text = (DOCS / "how_to" / "manifests.md").read_text(encoding="utf-8")
    (sentence,) = re.findall(
        r"These arms ship with the package: (.*?) which end at their flange", text, flags=re.DOTALL
    )
    assert {*re.findall(r"`([a-z0-9-]+)`", sentence)} == {*aj.files.shipped_arms()}


def test_the_noise_can_be_read(tmp_path):
    arm = table_with("how_to/manifests.md", "joint = [") + table_with("how_to/planning.md", "repeatability_mm")
    (tmp_path / "arm.toml").write_text(arm)
    assert aj.files.load_noise(tmp_path / "arm.toml").source == "data sheet"


def test_administrative_data_is_read(tmp_path):
    """The example has every key; conformity is commented out, because few certificates state one."""
    text = table_with("readers/measuring_arm_laboratory.md", "[laboratory]")
    uncommented = re.sub(r"^# (\[conformity\]|\w+ = )", r"\1", text, flags=re.MULTILINE)
    (tmp_path / "laboratory.toml").write_text(uncommented)
    data = aj.files.read_administrative_data(tmp_path / "laboratory.toml")
    stated = data.model_dump(exclude_unset=True)
    assert "conformity" in stated
    for part, model in ((name, field.annotation) for name, field in type(data).model_fields.items()):
        entry = stated[part][0] if isinstance(stated[part], list) else stated[part]
        if part not in ("customer", "person", "reference", "conformity"):
            assert {*entry} == {*model.model_fields}, part

"""The generated part of the reference has every command with its options, and every key of every file."""

import re
import sys
from pathlib import Path

import pytest

from aacmm_jax.data.observations.simulated import kinds

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs" / "extensions"))
import command_pages
import file_pages


@pytest.mark.parametrize("name", file_pages.FORMATS)
def test_every_key_that_a_reader_accepts_is_described(name):
    title, purpose, model = file_pages.FORMATS[name]
    page = file_pages.page(title, purpose, model)
    for path, (table, _) in file_pages.tables(model).items():
        for field_name, field in table.model_fields.items():
            key = field.alias or field_name
            assert file_pages.description(table, key, field_name), (path, key)
            assert re.search(rf"^\| `{key}` \| [^|]", page, flags=re.MULTILINE), (path, key)


def test_every_command_has_its_options_and_an_example():
    page = command_pages.page()
    commands = command_pages._commands()
    assert len(commands) > 10
    for name, command in commands.items():
        (section,) = re.findall(rf"^## aacmm {name}\n(.*?)(?=^## |\Z)", page, flags=re.MULTILINE | re.DOTALL)
        assert f"aacmm {name}" in section
        for parameter in command.params:
            if parameter.param_type_name == "option" and not parameter.hidden and parameter.name != "help":
                assert f"`{parameter.opts[0]}`" in section


@pytest.mark.slow
def test_contents_of_hdf5_files_are_listed():
    page = file_pages.hdf5_page()
    for array in ("capture/angle", "calibrated_arm/alpha", "parameters/parameter"):
        assert f"| `{array}` |" in page


def test_the_guide_to_manifests_names_every_kind_of_observation():
    guide = (Path(__file__).resolve().parents[2] / "docs/how_to/manifests.md").read_text()
    assert [kind.table for kind in kinds().values() if f"`[[{kind.table}]]`" not in guide] == []

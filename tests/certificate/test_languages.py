"""Languages of the printed certificate: what a procedure lacks is said in each of them."""

import ast
import inspect
import re
from pathlib import Path

import pytest

from aacmm_jax.acceptance import requirements
from aacmm_jax.certificate import languages
from aacmm_jax.certificate.languages import language_of
from aacmm_jax.diagnostics import misplaced_poses
from tests.refusals import assert_refused


def sentences() -> list[str]:
    """Every sentence on what a procedure lacks, with 7 for what it is filled with."""
    found = []
    for function in ast.parse(inspect.getsource(requirements)).body:
        if isinstance(function, ast.FunctionDef) and not function.name.startswith("requirements"):
            for node in ast.walk(function):
                parts = node.values if isinstance(node, ast.JoinedStr) else [node]
                texts = [part.value if isinstance(part, ast.Constant) else "7" for part in parts]
                if len(texts) > 1 or isinstance(node, ast.Constant):
                    found.append("".join(map(str, texts)))
            found = [text for text in found if text != ast.get_docstring(function, clean=False)]
    kinds = [says.format(*"77", "77", what) for _, says, _ in requirements._KINDS.values()
             for what in ("repeats", "orientations")]  # fmt: skip
    found = [text for text in found if text.endswith(".") and text[0].isupper() and text.count(" ") > 3]
    return list(dict.fromkeys([*found, *(text for text in kinds if text.endswith("."))]))


def test_german_says_what_a_procedure_lacks():
    german = language_of("de")
    assert len(sentences()) > 20
    assert [text for text in sentences() if not german.translated(text)] == []
    both = "30 different positions are required (4 given). 5 different lengths are required (2.5 given)."
    assert german.translated(both) == (
        "Gefordert sind 30 verschiedene Orte (vorhanden: 4). Gefordert sind 5 verschiedene Längen (vorhanden: 2,5)."
    )
    assert german.translated(f"{both} Something else is required.") == ""
    assert language_of("en").translated(both) == both


@pytest.mark.parametrize(("missing", "said"), [("", ""), ('"{1} are required." = "il faut {1}."', "il faut 3.")])
def test_a_language_may_lack_these_sentences(tmp_path, missing, said):
    path = tmp_path / "fr.toml"
    english = (Path(languages.__file__).parent / "en.toml").read_text().replace('"en"', '"fr"')
    path.write_text(english + f"\n[missing]\n{missing}\n")
    assert language_of(path).translated("3 are required.") == said
    path.write_text(english + '\n[missing]\n"{1} are required." = "{2}"\n')
    assert_refused(lambda: language_of(path), path, "[missing]", "other names in braces")


@pytest.mark.parametrize(
    ("says", "german"),
    [
        ("recorded under b-1, but B.2 fits", "aufgezeichnet unter b-1, passend zu B.2"),
        ("A and B are exchanged: poses of each fit the other", "A und B vertauscht"),
        ("the readings of A pose 1 and A pose 2 are exchanged: each fits with those of the other", "ihre Ablesungen"),
        ("the readings are 1 row late: these poses fit with those of the next row", "kommen 1 Zeile zu spät"),
        ("the readings are 2 rows early: these poses fit with those of 2 rows further", "kommen 2 Zeilen zu früh"),
        ("0.31 mm off", "0,31 mm entfernt"),
        ("5 mm off, as if the reading of joint 3 were wrong by -1.5 deg", "von Gelenk 3 um −1,5° falsch"),
    ],
)
def test_german_says_why_poses_were_left_out(says, german):
    finding = f"Left out: A (1) pose 1 ({says}), which contradicts the other data (F = 9 with 6 and 42 degrees)."
    assert german in language_of("de").reason(finding)
    assert language_of("en").reason(finding) == ""
    assert language_of("de").reason("Left out: socket A, which contradicts the other data (F = 9).") == ""
    source = inspect.getsource(misplaced_poses)
    written = languages.read_toml(Path(languages.__file__).parent / "de.toml", languages._File).reasons
    parts = [
        part
        for key in written
        for part in re.split(r"\{\d\}| rows? late: | rows? early: |(?<=off)(?=,)", key)
        if len(part) > 4
    ]
    assert [part for part in parts if part not in source] == []

"""YAML of cameras' and controllers' files: what is read, and one sentence for what is not."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aacmm_jax.core.errors import InputError
from aacmm_jax.files.yaml_text import yaml_content
from tests.refusals import assert_refused

LAUGHS = "a: &a [x, x]\n" + "".join(f"{n}: &{n} [*{m}, *{m}]\n" for m, n in zip("abcdefgh", "bcdefghi", strict=True))


def test_numbers_stay_text_and_tags_are_ignored():
    text = "%YAML:1.0\n---\nk: !!opencv-matrix\n  data: [ 1., .5,\n  1e-3 ]\nlist:\n- on\n- 012\ntable: {x: {y: ''}}\n"
    expected = {"k": {"data": ["1.", ".5", "1e-3"]}, "list": ["on", "012"], "table": {"x": {"y": ""}}}
    assert yaml_content(text) == expected


@pytest.mark.first_rows(8)
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no 'key: value'"),
        ("- 1\n- 2\n", "no 'key: value'"),
        ("a: 1\nb: 2\na: 3\n", "line 3: 'a' occurs twice"),
        ("a: 1\n? [b]\n: 2\n", "line 2 has a list or table as key"),
        ("a: [1, 2\nb: 3\n", "line 2: the file is not valid YAML"),
        ("a: 1\n\x01", "not valid YAML"),
        ("a: 1\n---\nb: 2\n", "line 2: the file is not valid YAML"),
        (LAUGHS, "line 2 refers to another part"),
        ("a: " + "[" * 100_000, "more than 20 levels"),
        ("a: " + "{b: " * 30 + "}" * 30, "more than 20 levels"),
    ],
)
def test_refusals(text, says):
    assert_refused(lambda: yaml_content(text), says)


@given(st.text(st.sampled_from("ab:-[]{}*&!|>'\"#%,? \n\t0") | st.characters(), max_size=60))
def test_any_text_is_read_or_refused(text):
    with contextlib.suppress(InputError):
        assert isinstance(yaml_content(text), dict)

"""How the tests read a refusal: `InputError` with one sentence that names what is wrong, where, and what to do."""

from collections.abc import Callable

import pytest

import aacmm_jax as aj


def refusal(call: Callable[[], object]) -> str:
    """The sentence with which a call is refused."""
    with pytest.raises(aj.InputError) as caught:
        call()
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence.endswith((".", "?"))
    return sentence


def assert_refused(call: Callable[[], object], *parts: object) -> None:
    """The call is refused, and its sentence holds every part."""
    sentence = refusal(call)
    for part in parts:
        assert str(part) in sentence, sentence

"""What tests of live captures have in common."""

import pytest

from aacmm_jax.live import guidance
from tests.live.unguided import NoGuide


@pytest.fixture
def unguided(monkeypatch):
    """Sessions without guidance."""
    monkeypatch.setattr(guidance, "Guide", NoGuide)

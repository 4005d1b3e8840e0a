"""What tests of live captures have in common."""

import pytest

from aacmm_jax.live import guidance


@pytest.fixture
def unguided(monkeypatch):
    """Sessions without guidance, which takes most of the time and has tests of its own."""
    monkeypatch.setattr(guidance, "calibrated", lambda *_: None)
    monkeypatch.setattr(guidance, "next_pose", lambda *_: None)

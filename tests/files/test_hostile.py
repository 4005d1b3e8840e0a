"""A small part of benchmarks/hostile.py: damaged files give the same result or one sentence, never other numbers."""

import numpy as np
import pytest

from benchmarks import hostile


@pytest.fixture(scope="module")
def attacked(tmp_path_factory):
    return hostile.targets(tmp_path_factory.mktemp("hostile"))


@pytest.mark.parametrize(
    ("kind", "count"),
    {"capture": 40, "calibration": 20, "evaluation": 20, "points": 40, "study": 16, "block": 8}.items(),
)
def test_a_flipped_bit_is_harmless_or_refused(attacked, kind, count):
    found = [result for _, _, result, _ in hostile.flips(attacked[kind], count, np.random.default_rng(0))]
    assert set(found) <= {hostile.SAME, hostile.REFUSED}
    assert hostile.REFUSED in found


@pytest.mark.parametrize("kind", ["capture"])
def test_so_it_is_on_the_command_line(attacked, kind):
    found = [result for _, _, result, _ in hostile.commands(attacked[kind], 4, np.random.default_rng(1))]
    assert set(found) <= {hostile.SAME, hostile.REFUSED}

"""A small part of benchmarks/hostile.py: nothing gives other numbers, fails unexpectedly, or hangs.

Its kills of a study have their small part in tests/study/test_store.py.

In processes of their own: the run-time checks of types that the other tests run with would refuse hostile arguments
before the package sees them, and a fork needs a process in which JAX has not computed.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("attacks", "count"),
    [
        pytest.param(("flips", "texts", "headers", "calls"), 6, marks=pytest.mark.slow),
        pytest.param(("writes",), 36, marks=pytest.mark.exhaustive),
        pytest.param(("users",), 0, marks=pytest.mark.exhaustive),
        pytest.param(("damage", "flips", "texts", "headers", "structure", "calls"), 60, marks=pytest.mark.exhaustive),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else str(value),
)
def test_an_attack_fails(attacks, count):
    line = [
        sys.executable,
        ROOT / "benchmarks" / "hostile.py",
        "--seed",
        "0",
        "--count",
        str(count),
        "--only",
        *attacks,
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(line, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    for attack in attacks:
        assert sum(found[attack]["total"].values()) >= count
        if attack not in ("writes", "users"):
            assert found[attack]["total"]["refused in one sentence"] > count / 4

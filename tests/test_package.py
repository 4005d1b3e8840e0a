"""The package's face: every name is there, whether it is imported at once or when first asked for."""

import pickle
import subprocess
import sys

import pytest

import aacmm_jax as aj


def test_every_public_name_is_there():
    for name in aj.__all__:
        assert getattr(aj, name) is not None
    assert set(aj.__all__) <= set(dir(aj))
    assert pickle.loads(pickle.dumps(aj.load_arm)) is aj.load_arm
    with pytest.raises(AttributeError, match="no attribute 'lod_arm'"):
        aj.lod_arm  # noqa: B018


@pytest.mark.parametrize(
    "line",
    [
        "from aacmm_jax import *; print(load_arm('panda').joints)",
        "import aacmm_jax; print(aacmm_jax.arm_files.load_arm('panda').joints)",
    ],
)
def test_late_names_in_a_fresh_process(line):
    done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "7\n"), done.stderr

"""A JAX that cannot start has a sentence of its own, and a command goes on on the CPU; where 64-bit floats were turned
off after the import, every entry point says so, and none computes in float32."""

import os
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core import jax_setup as backend
from aacmm_jax.files.hdf5 import undamaged
from tests.refusals import assert_refused

SENTENCE = (
    "JAX cannot start, because this installation of JAX finds no device for JAX_PLATFORMS=cuda; remove this setting, "
    "or set JAX_PLATFORMS=cpu."
)


@pytest.fixture
def without_gpu(monkeypatch):
    """A JAX that is told to use a GPU where there is none."""
    settings = {"jax_platforms": "cuda"}

    def devices():
        assert settings["jax_platforms"] == "cpu"
        return ["CPU"]

    config = SimpleNamespace(update=settings.__setitem__)
    monkeypatch.setitem(sys.modules, "jax", SimpleNamespace(devices=devices, config=config))
    monkeypatch.delenv("JAX_PLATFORM_NAME", raising=False)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    backend.check_setting.cache_clear()
    yield
    backend.check_setting.cache_clear()


def sentence(call):
    with pytest.raises(RuntimeError) as caught:
        call()
    return str(caught.value)


def failing(error):
    with undamaged("capture.h5"):
        raise error


def test_only_failures_of_reading_blame_the_file(without_gpu):
    for error in (AssertionError(), KeyError("angle"), RuntimeError()):  # whatever it led to
        assert sentence(lambda error=error: failing(error)) == SENTENCE
    backend.prepare_command()
    assert_refused(lambda: failing(KeyError("angle")), "capture.h5 is damaged")
    assert_refused(lambda: failing(MemoryError()), "capture.h5 cannot be read", "out of memory")
    jax_error = type("JaxRuntimeError", (RuntimeError,), {"__module__": "jax.errors"})
    for kind in (AssertionError, ImportError, FloatingPointError, jax_error, KeyboardInterrupt):
        with pytest.raises(kind):
            failing(kind())


def test_a_command_goes_on_on_the_cpu(without_gpu, monkeypatch):
    monkeypatch.setenv("JAX_TRANSFER_GUARD", "disallow")
    assert backend.prepare_command() == f"Warning: {SENTENCE.partition(';')[0]}; computing on the CPU instead."
    assert os.environ["JAX_PLATFORMS"] == "cpu"
    assert "JAX_TRANSFER_GUARD" not in os.environ
    assert backend.prepare_command() is None


def test_python_is_told(without_gpu):
    assert sentence(backend.check_setting) == SENTENCE
    backend.prepare_command()
    backend.check_setting()


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["JAX_PLATFORMS=cuda", "JAX_PLATFORM_NAME=tpu"])
def test_commands_without_the_device_that_is_asked_for(aacmm_process, monkeypatch, setting):
    monkeypatch.setenv(*setting.split("="))
    simulate = ("simulate", "panda", "-o", "c.h5", "--socket", "A=400,0,300", "--poses", 10)
    for command in (simulate, ("import", "none.toml", "-o", "i.h5"), ("show", "panda")):
        done = aacmm_process(*command, expect=2 if command[0] == "import" else 0)
        assert done.stderr.startswith(
            f"Warning: JAX cannot start, because this installation of JAX finds no device for {setting};"
        )
        assert "damaged" not in done.stderr
    assert aacmm_process("show", "c.h5").stderr == ""


SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300)}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    "entry",
    [
        lambda arm, capture, bounds: aj.identify(arm, capture, bounds),
        lambda arm, capture, bounds: aj.identify(arm, capture, bounds, start=np.zeros(21)),
        lambda arm, capture, bounds: aj.calibrate(arm, capture, bounds),
        lambda arm, capture, bounds: aj.evaluate(arm, capture),
        lambda arm, capture, bounds: aj.observability(arm, capture, bounds.space),
        lambda arm, capture, bounds: aj.identify_many(arm, capture, bounds, start=np.zeros((2, 21))),
        lambda arm, capture, bounds: aj.calibrate_many(arm, capture, bounds, start=np.zeros((2, 21))),
        lambda arm, capture, bounds: aj.simulate(arm, SOCKETS),
        lambda arm, capture, bounds: arm.position(np.zeros(6)),
        lambda arm, capture, bounds: aj.perturbed_arm(bounds.space, length=1.0, angle=1e-3),
        lambda arm, capture, bounds: aj.Arm(alpha=[0.0], a=[1.0], d=[1.0]),
        lambda arm, capture, bounds: aj.Capture({"A": np.zeros((3, 6))}),
        lambda arm, capture, bounds: aj.Noise(encoder_arcsec=1.0),
        lambda arm, capture, bounds: aj.scale_from_lengths([1.0], 1.0),
    ],
)
def test_refused(paper_arm, noisy_capture, entry):
    bounds = aj.Bounds.around(paper_arm, aj.Parameters.free_of(paper_arm))
    with jax.enable_x64(False), pytest.raises(aj.InputError, match=r"64-bit floats were turned off .*jax_enable_x64"):
        entry(paper_arm, noisy_capture, bounds)

"""`aj.simulate_capture` against the command, and what it refuses."""

import inspect

import numpy as np
import pytest

import aacmm_jax as aj
from tests.refusals import assert_refused

SOCKETS = {"A": (400.0, 200.0, 300.0), "B": (600.0, 200.0, 300.0)}


@pytest.fixture(scope="module")
def nominal():
    return aj.files.load_specification("cheng2018-simulation")


def test_the_command_does_what_the_call_does(aacmm, nominal, tmp_path):
    sockets = (f"--socket={name}={','.join(map(str, point))}" for name, point in SOCKETS.items())
    deviation, poses = ("--deviate-length-mm", 1, "--deviate-angle-deg", 0.1), ("--poses", 5, "--poses", "B=2")
    noise = ("--encoder-arcsec", 2, "--seating-mm", 0.005, "--resolution-arcsec", 1)
    command = ("simulate", "cheng2018-simulation", "-o", "c.h5", *sockets, *poses, *deviation, *noise)
    aacmm(*command, "--length", "A,B,0.002", "--seed", 3)
    written = aj.files.load_capture(tmp_path / "c.h5")
    made = aj.simulate_capture(
        nominal,
        SOCKETS,
        poses={"A": 5, "B": 2},
        deviate_length=1.0,
        deviate_angle=np.radians(0.1),
        noise=aj.Noise(encoder_arcsec=2, seating=0.005),
        resolution_arcsec=1.0,
        lengths=[("A", "B", 0.002)],
        seed=3,
    )
    np.testing.assert_array_equal(written.capture.q, made.capture.q)
    assert float(written.capture.lengths[0].value) == float(made.capture.lengths[0].value)
    np.testing.assert_array_equal(written.true.arm.d, made.true.arm.d)
    assert (written.true.name, written.seed) == (made.true.name, 3)
    assert not np.array_equal(made.true.arm.d, nominal.arm.d)


def test_the_help_states_the_default_of_the_call():
    from aacmm_jax.cli.capture_commands import simulate

    (poses,) = (option for name, option in inspect.signature(simulate).parameters.items() if name == "poses")
    assert f"Default: {aj.pipeline.SimulationOptions().poses}." in poses.default.help


@pytest.mark.slow
def test_an_acceptance_test_is_simulated(nominal):
    recorded = aj.simulate_capture(nominal, acceptance="asme", seed=1)
    assert recorded.acceptance == ("asme",)
    assert {float(length.u) for length in recorded.capture.lengths} == {0.001}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("sockets", "options", "parts"),
    [
        (None, {}, ("no socket is given",)),
        (SOCKETS, {"acceptance": "iso"}, ("leave out --socket",)),
        *(
            (None, {"acceptance": "iso", name: value}, ("leave out --socket, --poses",))
            for name, value in {
                "poses": 5,
                "lengths": [("A", "B")],
                "temperature": 20.0,
                "resolution_arcsec": (0.0, 0.001),
            }.items()
        ),
        (SOCKETS, {"true": "panda"}, ("has 7 joints, but 'Cheng 2018, simulated arm' has 6",)),
        (SOCKETS, {"deviate_length": -1.0}, ("deviate_length is -1",)),
        (SOCKETS, {"acceptance": "jjf"}, ("leave out --socket",)),
        (None, {"acceptance": "vdi"}, ("acceptance is 'vdi'",)),
    ],
)
def test_refused(nominal, sockets, options, parts):
    if "true" in options:
        options = options | {"true": aj.files.load_specification(options["true"])}
    assert_refused(lambda: aj.simulate_capture(nominal, sockets, **options), *parts)

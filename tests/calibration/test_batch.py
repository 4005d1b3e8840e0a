"""Many identifications at once: the same results as one by one, whatever the chunk, the neighbours and the devices."""

import inspect
import os
import subprocess
import sys
import threading
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration import batch
from tests import published

BATCH = 50


@pytest.fixture(scope="module")
def box():
    return tuple(np.array(side, dtype=float) for side in published.BOXES[1])


@pytest.fixture(scope="module")
def starts(box):
    lower, upper = box
    return lower + (upper - lower) * np.random.default_rng(3).uniform(size=(BATCH, 21))


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["d_3", pytest.param(None, marks=pytest.mark.slow)])
def test_equals_single_identifications(paper_arm, noisy_capture, box, starts, hold):
    many = aj.identify_many(paper_arm, noisy_capture, *box, starts, hold=hold)
    assert np.all(many.converged)
    assert many.parameters.shape == (BATCH, 21)
    bounds = aj.Bounds(aj.Parameters.free_of(paper_arm), *box)
    lengths = bounds.space.lengths
    for i in range(0, BATCH, 7):
        single = aj.identify(paper_arm, noisy_capture, bounds, start=starts[i], hold=hold)
        assert many.de[i] == pytest.approx(float(single.de), abs=1e-9)
        assert many.deltam[i] == pytest.approx(float(single.deltam), abs=1e-9)
        scaled, alone = many.parameters[i] / many.k[i], np.asarray(single.parameters) / float(single.scale.value)
        np.testing.assert_allclose(scaled[lengths], alone[lengths], rtol=0, atol=1e-7)
        np.testing.assert_array_equal(many.active[i], single.active)
        assert many.k[i] == pytest.approx(float(single.scale.value), rel=1e-10)


@pytest.mark.slow
@pytest.mark.optimised
def test_the_chunk_changes_no_bit(paper_arm, noisy_capture, box, starts):
    whole = aj.identify_many(paper_arm, noisy_capture, *box, starts, slots=8)
    for chunk in (20, 24):  # 20 is no multiple of the slots, and neither divides the batch
        parts = aj.identify_many(paper_arm, noisy_capture, *box, starts, slots=8, chunk=chunk)
        for field in ("parameters", "de", "deltam", "k", "steps", "active"):
            np.testing.assert_array_equal(getattr(whole, field), getattr(parts, field))


@pytest.mark.slow
def test_batches_of_arms_and_captures(paper_arm):
    """Every problem its own arm and its own recording: each finds its own truth."""
    space = aj.Parameters.free_of(paper_arm)
    true = [aj.perturbed_arm(space, length=1.0, angle=1e-3, seed=seed) for seed in range(4)]
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300)}
    captures = [
        aj.simulate(arm, sockets, poses={"A": 30, "B": 1}, lengths=[("A", "B")], seed=i) for i, arm in enumerate(true)
    ]
    nominal = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), paper_arm)
    bounds = aj.Bounds.around(paper_arm, space)
    many = aj.identify_many(nominal, aj.stack_captures(captures), bounds.lower, bounds.upper, hold="d_3")
    assert np.all(many.converged)
    for i, arm in enumerate(true):
        lengths = (many.parameters[i] / many.k[i])[space.lengths]
        np.testing.assert_allclose(lengths, np.asarray(space.vector(arm))[space.lengths], atol=1e-7)


@pytest.mark.slow
def test_bounds_of_a_space_equal_arrays(paper_arm, noisy_capture, box, starts):
    """A space of fewer parameters in another order, and what is fixed taken from the arm."""
    space = aj.Parameters(paper_arm, tuple(reversed([n for n in aj.Parameters.free_of(paper_arm).names if n != "a_2"])))
    index = [aj.Parameters.free_of(paper_arm).names.index(name) for name in space.names]
    lower, upper, start = box[0][index], box[1][index], starts[:3, index]
    arrays = aj.identify_many(paper_arm, noisy_capture, lower, upper, start, space=space)
    together = aj.identify_many(paper_arm, noisy_capture, aj.Bounds(space, lower, upper), start=start)
    np.testing.assert_array_equal(together.parameters, arrays.parameters)
    assert together.space.names == space.names
    calibrated = aj.calibrate_many(paper_arm, noisy_capture, aj.Bounds(space, lower, upper), start=start)
    np.testing.assert_array_equal(calibrated.k, arrays.k)


def test_bounds_and_what_they_hold_already(paper_arm, noisy_capture, box, starts):
    bounds = aj.Bounds(aj.Parameters.free_of(paper_arm), *box)
    for many in (aj.identify_many, aj.calibrate_many):
        with pytest.raises(aj.InputError, match=r"a Bounds object and upper bounds are both given, .* start=\.\.\."):
            many(paper_arm, noisy_capture, bounds, starts)
        with pytest.raises(aj.InputError, match="a Bounds object and a space are both given"):
            many(paper_arm, noisy_capture, bounds, start=starts, space=bounds.space)
        with pytest.raises(aj.InputError, match="without upper bounds"):
            many(paper_arm, noisy_capture, box[0], start=starts)


def test_failure_is_data(paper_arm, noisy_capture, box, starts):
    """A problem that cannot be solved spoils no other: one problem gets a capture with NaN, and steps may run out."""
    q = np.tile(np.asarray(noisy_capture.q), (3, 1, 1))
    q[1, 5, 2] = np.nan
    broken = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), noisy_capture)
    broken = eqx.tree_at(lambda capture: capture.q, broken, jnp.asarray(q))
    many = aj.identify_many(paper_arm, broken, *box, starts[:3], hold="d_3")
    np.testing.assert_array_equal(many.converged, [True, False, True])
    np.testing.assert_array_equal(many.result == aj.Reason.nonfinite, [False, True, False])
    short = aj.identify_many(paper_arm, noisy_capture, *box, starts, hold="d_3", max_steps=2)
    assert not np.any(short.converged)
    assert np.all(short.steps == 2)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": np.zeros((5, 20))}, r"start has shape \(5, 20\); give \(21,\) or \(batch, 21\)"),
        ({"start": None}, "no argument is a batch"),
        ({"start": np.zeros((0, 21))}, "the batch is empty"),
        ({"lower": np.full((BATCH + 1, 21), -1e9)}, "batches of 50 and 51 problems cannot be combined"),
        ({"upper": np.full(21, -1e9)}, "lower bound of alpha_1 is above its upper bound"),
        ({"chunk": 0}, "chunk is 0; it must be at least 1"),
        ({"slots": -1}, "slots is -1; it must be at least 1"),
    ],
)
def test_bad_input(paper_arm, noisy_capture, box, starts, change, message):
    arguments = {"lower": box[0], "upper": box[1], "start": starts} | change
    with pytest.raises(aj.InputError, match=message):
        aj.identify_many(paper_arm, noisy_capture, **arguments)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("function", [aj.identify_many, aj.calibrate_many])
def test_shared_options_are_named(function, paper_arm, noisy_capture, box):
    named = inspect.signature(function).parameters
    assert {name: named[name].default for name in batch.BatchOptions._fields} == batch.BatchOptions()._asdict()
    with pytest.raises(TypeError, match="unexpected keyword argument 'slot'"):
        function(paper_arm, noisy_capture, *box, slot=8)
    with pytest.raises(aj.InputError, match=r"slots is 2\.5; give a whole number"):
        function(paper_arm, noisy_capture, *box, slots=2.5)


PROGRAM = """
import sys
import threading
import time
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import numpy as np
import aacmm_jax as aj
from aacmm_jax.calibration import batch
from tests import published
assert len(jax.devices()) == int(sys.argv[1])
arm = aj.load_arm("cheng2018-simulation")
capture = aj.simulate(arm, {"A": (400, 200, 300)}, poses=30, encoder_arcsec=2.0, seed=1)
lower, upper = (np.array(side, dtype=float) for side in published.BOXES[1])
starts = lower + (upper - lower) * np.random.default_rng(0).uniform(size=(64, 21))
many = aj.identify_many(arm, capture, lower, upper, starts, hold="d_3", slots=8, chunk=16)
np.save(sys.argv[2], many.parameters)
"""


@pytest.mark.exhaustive
def test_the_number_of_devices_changes_nothing(tmp_path):
    root = Path(__file__).resolve().parents[2]
    for devices in ("1", "2"):
        environment = os.environ | {"PYTHONPATH": str(root)}
        command = [sys.executable, "-c", PROGRAM, devices, str(tmp_path / devices)]
        subprocess.run(command, check=True, cwd=root, env=environment, timeout=600)
    one, two = (np.load(tmp_path / f"{devices}.npy") for devices in ("1", "2"))
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-9)


def test_no_more_chunks_in_work_than_workers_and_a_failure_stops_the_rest():
    at_once, most, ran, lock = 0, 0, [], threading.Lock()
    two = threading.Barrier(2, timeout=600)  # each chunk waits for another one

    def run(piece, device):
        nonlocal at_once, most
        with lock:
            at_once, most = at_once + 1, max(most, at_once + 1)
        if device != "alone":
            two.wait()
        with lock:
            at_once -= 1
            ran.append(piece.start)
        if piece.start == 1:
            raise RuntimeError("chunk 1")
        return piece.start

    pieces = [range(i, i + 1) for i in range(20)]
    assert batch._run(run, pieces[2:], ["one", "two"], 2) == list(range(2, 20))
    assert most == 2
    ran.clear()
    with pytest.raises(RuntimeError, match="chunk 1"):
        batch._run(run, pieces, ["alone"], 1)
    assert ran == [0, 1]

"""Rows that were mixed up are named, with what was done to them; a fit that is far from the arm's file says so."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics.corrections import likely_cause
from aacmm_jax.diagnostics.findings import case_of, findings_of
from aacmm_jax.diagnostics.misplaced_poses import misplaced_poses
from aacmm_jax.diagnostics.mistakes import single_mistake
from aacmm_jax.diagnostics.rough_fit import rough_fit

SOCKETS = {"A": (400, 200, 300), "B": (500, -200, 300), "C": (300, 300, 500)}
LENGTHS = [aj.ReferenceLength("A", "B", 412.3106, 0.005), aj.ReferenceLength("A", "C", 244.949, 0.005)]
NOISE = aj.Noise(encoder_arcsec=2, seating=0.005)
HOLES = {"a": (0, 0, 0), "b": (200, 0, 0), "c": (200, 150, 0), "d": (0, 150, 0)}
PLATES = [
    kinds.SimulatedArtefact(name, HOLES, 8, frame, artefact="plate")
    for name, frame in (("one", (0, 0, 0.3, 350, -250, 250)), ("two", (0.2, 0.4, 0.9, 400, 100, 350)))
]


@pytest.fixture(scope="module")
def nominal():
    return aj.files.load_specification("cheng2018-simulation")


@pytest.fixture(scope="module")
def true(nominal):
    return aj.perturbed_arm(nominal.space(), length=0.5, angle=np.radians(0.05), seed=1)


@pytest.fixture(scope="module")
def sockets(true):
    capture = aj.simulate(true, SOCKETS, poses=15, noise=NOISE, seed=1)
    return {name: np.array(q) for name, q in capture.sockets.items()}


@pytest.fixture(scope="module")
def plates(true):
    return aj.simulate(true, {}, observations=PLATES, noise=NOISE, seed=1).observations


def as_read(q):
    return q


def off(q):
    """One joint of one pose by a degree."""
    q["B"][3, 2] += np.radians(1.0)
    return q


def mislabelled(q):
    return q | {"A": q["A"][:-1], "B": np.concatenate([q["B"], q["A"][-1:]])}


def twice_mislabelled(q):
    """Two at a border, which fit those of two rows further, too."""
    return q | {"A": q["A"][:-2], "B": np.concatenate([q["A"][-2:], q["B"]])}


def exchanged(q):
    q["A"][2], q["C"][5] = q["C"][5].copy(), q["A"][2].copy()
    return q


def late(q):
    readings = np.roll(np.concatenate(list(q.values())), 1, axis=0)
    return dict(zip(q, np.split(readings, 3), strict=True))


FIRST_POSES = ("A pose 1", "B pose 1", "C pose 1")


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("mistake", "poses", "says"),
    [
        (as_read, (), ""),
        (off, ("B pose 4",), "off, as if the reading of joint 3 were wrong by 1 deg"),
        (mislabelled, ("B pose 16",), "recorded under B, but A fits"),
        (twice_mislabelled, ("B pose 1", "B pose 2"), "recorded under B, but A fits"),
        (exchanged, ("A pose 3", "C pose 6"), "the readings of A pose 3 and C pose 6 are exchanged: each fits"),
        (late, FIRST_POSES, "the readings are 1 row late: these poses fit with those of the next row"),
    ],
)
def test_poses_of_sockets(nominal, sockets, mistake, poses, says):
    capture = aj.Capture(mistake({name: q.copy() for name, q in sockets.items()}))
    mistakes = misplaced_poses(rough_fit(nominal, capture), capture)
    assert [name for found in mistakes for name in found.names] == [*poses]
    assert all(says in found.says for found in mistakes)


@pytest.mark.slow
def test_two_points_of_a_plate_under_each_other_s_name(nominal, plates):
    one, two = plates
    renamed = tuple({"b": "c", "c": "b"}.get(point, point) for point in one.point)
    capture = aj.Capture({}, (), [one.changed(point=renamed), two])
    (found,) = misplaced_poses(rough_fit(nominal, capture), capture)
    assert len(found.poses) == 16
    assert found.concerns[0] == "one"
    # A plate that is turned over has b and c where a and d were.
    assert found.says.startswith(("b of one and c of one are", "a of one and d of one are"))


def record_of(nominal, capture):
    return aj.calibrate_capture(aj.Recording(capture, nominal), automatic=False, cross_validate=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "says", "concerns"),
    [
        ({}, "", ()),
        ({"B": "C", "C": "B"}, "the names of sockets B and C are exchanged", ("B", "C")),
        pytest.param(
            "cm", "measured values are in cm, but were read as mm (reference lengths)", (), marks=pytest.mark.slow
        ),
        ("tool", "mm from where it is stated in the arm's file, near 0, -1, 102 mm", ("probe_z",)),
    ],
)
def test_names_lengths_and_tool(nominal, sockets, changed, says, concerns):
    names = changed if isinstance(changed, dict) else {}
    size = 0.1 if changed == "cm" else 1.0
    lengths = [aj.ReferenceLength(x.start, x.end, size * float(x.value), 0.005) for x in LENGTHS]
    if changed == "tool":
        probe = np.asarray(nominal.arm.probe) + np.array([72.0, -57.6, 76.8])
        nominal = nominal._replace(arm=nominal.arm.replace(probe=probe))
    capture = aj.Capture({names.get(name, name): q for name, q in sockets.items()}, lengths)
    found = case_of(record_of(nominal, capture)).once(single_mistake)
    assert (found is None) == (not says)
    if found is not None:
        assert says in found.says
        assert set(concerns) <= set(found.concerns)


@pytest.mark.slow
def test_a_calibration_leaves_out_what_was_mixed_up(nominal, true, sockets):
    """As `aacmm calibrate` does: what is left out is named first, and the arm is as good as without the mistake."""
    recording = aj.Recording(aj.Capture(exchanged({n: q.copy() for n, q in sockets.items()}), LENGTHS), nominal)
    record = aj.calibrate_capture(recording, model="dh", cross_validate=False)
    first, *_ = findings_of(record)
    assert first.code == "left-out"
    assert first.concerns[:2] == ("A pose 3", "C pose 6")
    assert first.says.startswith("Left out: A pose 3, C pose 6 (the readings of A pose 3 and C pose 6 are exchanged")
    (removed,) = record.removed
    assert removed.rms_without < 0.05 < 5 < removed.rms_with
    q = np.concatenate(list(sockets.values()))
    assert np.abs(np.linalg.norm(record.calibrated.arm.position(q) - true.position(q), axis=1)).max() < 0.1


@pytest.mark.slow
def test_nothing_is_left_out_where_poses_scatter_without_a_gap(nominal, sockets):
    random = np.random.default_rng(0)
    loose = {name: q + random.normal(0, 0.004, q.shape) * (np.arange(6) == 3) for name, q in sockets.items()}
    capture = aj.Capture(loose)
    assert misplaced_poses(rough_fit(nominal, capture), capture) == []


@pytest.mark.slow
def test_readings_that_are_late_at_an_instrument(true, nominal):
    """No pose fits, so that the nominal arm shows it."""
    box = [[200, -300, 100], [600, 300, 500]]
    tracker = kinds.SimulatedPoints("tracker", box, 25, (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), u=0.01)
    (points,) = aj.simulate(true, {}, observations=[tracker], noise=NOISE, seed=1).observations
    capture = aj.Capture({}, (), [points.changed(q=np.roll(np.asarray(points.q), -2, axis=0))])
    assert rough_fit(nominal, capture) is None
    found = likely_cause(nominal.arm, capture)
    assert found.says.startswith("Likely cause: the readings are 2 rows early.")
    assert not found.of_readings

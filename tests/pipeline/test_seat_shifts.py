"""Sockets whose seat shifted amid their poses: divided where that happened, and nowhere else."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics.findings import findings_of
from aacmm_jax.pipeline.seat_shifts import Division, divided, divided_alike, with_divided_sockets

NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
SOCKETS = {"a/0": (400, 200, 300), "a/1": (600, 200, 300), "b/0": (300, -300, 300), "b/1": (500, -300, 300)}
LENGTHS = [("a/0", "a/1", 0.002), ("b/0", "b/1", 0.002)]
SHIFT, FIRST = np.array([0.1, -0.06, 0.05]), 8
LATER = f"a/0 (from pose {FIRST + 1})"


@pytest.fixture(scope="module")
def recorded():
    """A recording with a shift of the seat of a/0, or a sound one; poses of other sockets are the same."""
    nominal = aj.load_arm("cheng2018-simulation")
    true = aj.perturbed_arm(aj.Parameters.free_of(nominal), length=0.5, angle=5e-4, seed=3)

    def recording(shift):
        places = SOCKETS | {"later": np.array(SOCKETS["a/0"]) + shift}
        capture = aj.simulate(true, places, poses=20, lengths=LENGTHS, noise=NOISE, seed=0)
        readings = dict(capture.sockets)
        readings["a/0"] = np.concatenate([readings["a/0"][:FIRST], readings.pop("later")[FIRST:]])
        return aj.Recording(aj.Capture(readings, capture.lengths), aj.kinematics.ArmSpecification(nominal, "arm"))

    return recording


def divided_record(recording):
    def solved(part):
        return aj.calibrate(part.nominal.arm, part.capture, part.nominal.bounds())

    recorded = aj.calibration.record_of
    return with_divided_sockets(recorded(solved(recording), recording), solved, recorded)


@pytest.mark.slow
def test_a_socket_is_divided_where_its_seat_shifted(recorded):
    record, (division,) = divided_record(recorded(SHIFT))
    assert division == Division("a/0", LATER, FIRST, frozenset())
    (shift,) = record.removed
    assert shift.members == ("a/0", LATER)
    assert shift.probability < 0.002
    assert shift.rms_without < 0.8 * shift.rms_with
    capture = record.recording.capture
    assert {name: len(q) for name, q in capture.sockets.items()} == {
        "a/0": FIRST, LATER: 20 - FIRST, "a/1": 20, "b/0": 20, "b/1": 20
    }  # fmt: skip
    # The sound length, 200 mm, ends where the arm measures it so.
    assert (capture.lengths[0].start, capture.lengths[0].end) == ("a/0", "a/1")
    (finding,) = [found for found in findings_of(record) if found.code == "shifted-seat"]
    assert f"a/0 from pose {FIRST + 1} on by" in finding.says


@pytest.mark.slow
def test_a_sound_capture_is_not_divided(recorded):
    record, divisions = divided_record(recorded(np.zeros(3)))
    assert (record.removed, divisions) == ((), ())


@pytest.mark.slow
def test_held_out_poses_belong_to_the_part_in_which_they_were_recorded(recorded):
    recording = recorded(SHIFT)
    options = {"model": "dh", "cross_validate": False}
    record = aj.calibrate_capture(recording, hold_out=0.3, seed=1, **options)
    part, whole = record.recording.capture, recording.capture
    assert part.names == ("a/0", f"a/0 (from pose {len(part.sockets['a/0']) + 1})", "a/1", "b/0", "b/1")
    rows = record.held_out
    assert rows is not None
    assert rows.pose.size == 24
    # Those after the shift would be 0.13 mm from where the others were.
    assert np.max(rows.distance) < 0.08
    assert len(whole.sockets["a/0"]) == 20


@pytest.mark.parametrize("joined", [frozenset(), frozenset({("a/0", "a/1")})])
def test_divided_captures_keep_every_pose_and_length(recorded, joined):
    capture = recorded(np.zeros(3)).capture
    visits = {name: np.arange(len(q)) // 5 for name, q in capture.sockets.items()}
    target = kinds.Socket("hole", capture.sockets["b/1"] + 1e-3, target="ball")
    capture = aj.Capture(capture.sockets, capture.lengths, [target], visits=visits)
    parts = divided(capture, [Division("a/0", "x", 7, joined), Division("hole", "y", 3, frozenset())])
    assert parts.names == ("a/0", "x", "a/1", "b/0", "b/1")
    assert np.array_equal(parts.readings, capture.readings)
    assert np.unique(np.array(parts.visits)[:7]).tolist() == [0, 1]
    assert [(o.name, o.target, o.q.shape[0]) for o in parts.observations] == [("hole", "ball", 3), ("y", "ball", 17)]
    assert [length.start for length in parts.lengths] == ["x" if joined else "a/0", "b/0"]


def test_masks_are_divided_between_the_poses_that_were_kept(recorded):
    capture, masks = recorded(np.zeros(3)).capture, {name: np.zeros(20, dtype=bool) for name in SOCKETS}
    masks["a/0"][[1, 5, 6, 7]] = True
    # Kept are 0, 2, 3, 4, 8, ...: of these the fourth is the last before the shift, the fifth the first after it.
    whole, again = divided_alike(capture, masks, [Division("a/0", "x", 4, frozenset())])
    assert [len(q) for q in whole.sockets.values()][:2] == [6, 14]
    assert np.flatnonzero(again["a/0"]).tolist() == [1, 5]
    assert np.flatnonzero(again["x"]).tolist() == [0, 1]

"""Poses that are held out of a calibration, and the residuals of all poses beside their prediction."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.pipeline.hold_out import held_out_poses

NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
SOCKETS = {"a/0": (400, 200, 300), "a/1": (600, 200, 300), "b/0": (300, -300, 300), "b/1": (500, -300, 300)}
LENGTHS = [("a/0", "a/1", 0.002), ("b/0", "b/1", 0.002)]
TRACKER = kinds.SimulatedPoints(
    "tracker", [[200, -300, 100], [600, 300, 500]], 40, (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), u=0.01
)


@pytest.fixture(scope="module")
def arms():
    nominal = aj.load_arm("cheng2018-simulation")
    parameters = aj.Parameters.free_of(nominal)
    return nominal, aj.perturbed_arm(parameters, length=1.0, angle=0.001, seed=3)


def recorded(arms, seed=0, observations=(), lengths=LENGTHS):
    nominal, true = arms
    capture = aj.simulate(true, SOCKETS, poses=20, lengths=lengths, observations=observations, noise=NOISE, seed=seed)
    specification = aj.kinematics.ArmSpecification(nominal, "arm")
    return aj.Recording(capture, specification)


def calibrated(arms, seed=0, observations=(), **options):
    return aj.calibrate_capture(recorded(arms, seed, observations), noise=NOISE, automatic=False, **options)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("hold_out", "counts"),
    [
        (0.3, {"a/0": 6, "a/1": 6, "b/0": 6, "b/1": 6}),
        (0.01, {"b/0": 1}),  # one of eighty poses, drawn where the sum of the shares reaches a half
        ("b", {"b/0": 20, "b/1": 20}),
        ("b/*", {"b/0": 20, "b/1": 20}),
        ("a/1", {"a/1": 20}),
    ],
)
def test_a_share_of_each_observation_or_a_group_is_held_out(arms, hold_out, counts):
    masks = held_out_poses(recorded(arms).capture, hold_out, None, 0)
    assert {name: int(mask.sum()) for name, mask in masks.items() if mask.any()} == counts


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"hold_out": 1.5}, ["1.5", "between 0 and 1"]),
        ({"hold_out": 0.001}, ["less than one pose", "larger share"]),
        ({"hold_out": "c"}, ["no socket or observation matches", "'c'"]),
        ({"hold_out": "*"}, ["leaves no pose"]),
        ({"hold_out": 0.1, "only_poses": 50}, ["--hold-out", "--only-poses", "one of them"]),
    ],
)
def test_impossible_shares_and_groups_are_refused(arms, options, words):
    with pytest.raises(aj.InputError) as error:
        calibrated(arms, **options)
    assert all(word in str(error.value) for word in words), error.value


@pytest.mark.slow
def test_every_pose_is_listed_once_under_its_own_number(arms):
    rows = aj.residuals_of(calibrated(arms, hold_out=0.3))
    listed = list(zip(rows.observation, rows.pose.tolist(), strict=True))
    assert listed == [(name, number) for name in SOCKETS for number in range(1, 21)]
    assert rows.use.count("held out") == 24
    assert np.allclose(np.linalg.norm(rows.residual, axis=1), rows.distance)


@pytest.mark.slow
def test_held_out_poses_are_compared_with_the_position_that_the_others_have(arms):
    record = calibrated(arms, hold_out=0.3)
    rows = aj.residuals_of(record)
    capture, arm = recorded(arms).capture, record.calibrated.arm
    for name in SOCKETS:
        of_socket = np.array(rows.observation) == name
        position = np.asarray(record.observed.geometry[f"position of {name}"])
        tips = np.asarray(arm.position(capture.sockets[name]))
        assert np.allclose(tips - position, rows.residual[of_socket], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["two-stage", "joint"])
@pytest.mark.parametrize("hold_out", [0.3, "b"])
def test_distances_are_as_large_as_predicted(arms, method, hold_out):
    squares = {"used": [], "held out": []}
    for seed in range(4):
        rows = aj.residuals_of(calibrated(arms, seed, method=method, hold_out=hold_out))
        for use, ratios in squares.items():
            part = rows.used_as(use)
            ratios.append(np.sum(part.distance**2) / np.sum(part.u**2))
    for ratios in squares.values():  # of 200 degrees of freedom at least; over 60 seeds 0.99 and 1.00
        assert np.sqrt(np.mean(ratios)) == pytest.approx(1, abs=0.13)


@pytest.mark.slow
def test_points_of_a_tracker_keep_the_frame_of_the_station(arms):
    squares = []
    for seed in range(3):
        record = calibrated(arms, seed, (TRACKER,), hold_out=0.5)
        part = aj.residuals_of(record).used_as("held out")
        part = part.select(np.array(part.observation) == "tracker")
        assert len(part.pose) == 20
        squares.append(np.sum(part.distance**2) / np.sum(part.u**2))
    assert np.sqrt(np.mean(squares)) == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_a_group_that_was_held_out_tests_the_uncertainty(arms):
    record = calibrated(arms, hold_out="b", method="joint")
    assert record.validation is not None
    (group,) = record.validation.groups
    assert group.sockets == ("b/0", "b/1")
    assert len(group.length_error) == 1
    rows = aj.residuals_of(record).used_as("held out")
    assert group.rms == pytest.approx(np.sqrt(np.mean(rows.distance**2)), rel=0.02)


@pytest.mark.slow
def test_the_nominal_arm_is_tested_as_by_a_calibration_with_the_arm_held(arms, tmp_path):
    """Sockets by the centroid of their used poses; without lengths, which a held arm would not divide by."""
    recording = recorded(arms, observations=(TRACKER,), lengths=())
    held = recording.nominal._replace(held=tuple(aj.kinematics.parameter_names(arms[0])))
    record, of_held = (
        aj.calibrate_capture(part, noise=NOISE, automatic=False, hold_out=0.3)
        for part in (recording, recording._replace(nominal=held))
    )
    assert np.allclose(record.held_out_nominal, of_held.held_out.distance, rtol=1e-6)
    assert np.sqrt(np.mean(record.held_out_nominal**2)) > 20 * np.sqrt(np.mean(record.held_out.distance**2))
    assert of_held.held_out_nominal is None  # nothing was calibrated
    aj.files.save_calibration(tmp_path / "c.h5", record)
    assert np.array_equal(aj.files.load_calibration(tmp_path / "c.h5").held_out_nominal, record.held_out_nominal)


@pytest.mark.slow
def test_held_out_residuals_are_kept_in_the_file(arms, tmp_path):
    record = calibrated(arms, hold_out=0.3)
    aj.files.save_calibration(tmp_path / "c.h5", record)
    before, after = (aj.residuals_of(r) for r in (record, aj.files.load_calibration(tmp_path / "c.h5")))
    assert before.use == after.use
    assert np.array_equal(before.distance, after.distance)
    assert np.array_equal(before.u, after.u)


@pytest.mark.slow
def test_an_evaluation_lists_the_poses_too(arms):
    record = calibrated(arms, hold_out="b")
    rows = aj.residuals_of(aj.evaluate_capture(record, recorded(arms)))
    uses = dict(zip(rows.observation, rows.use, strict=True))
    assert uses == {"a/0": "used", "a/1": "used", "b/0": "held out", "b/1": "held out"}

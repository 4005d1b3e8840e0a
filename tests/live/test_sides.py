"""Sides from which joints come, and poses that are taken from both sides."""

import itertools
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import aacmm_jax as aj
from aacmm_jax.live.places import TakenPose, capture_of
from aacmm_jax.live.proposals import NextPose
from aacmm_jax.live.sides import Sides, from_both_sides, sides_of

ARM = aj.load_arm("ur10e")
TREMOR = 4e-4  # rad, below the least reversal of 0.1 deg


def read(turns, seed=0):
    """The sides after motions of every joint from one of some readings to the next, by a trembling hand."""
    sides, random = Sides(ARM), np.random.default_rng(seed)
    for start, end in itertools.pairwise(turns):
        for s in np.linspace(0, 1, 30):
            sides.add(np.full(6, start + s * (end - start)) + TREMOR * random.uniform(-1, 1, 6))
    for _ in range(100):
        sides.add(np.full(6, turns[-1]) + TREMOR * random.uniform(-1, 1, 6))
    return sides


@given(st.lists(st.floats(0.01, 0.5), min_size=1, max_size=6), st.sampled_from([-1.0, 1.0]), st.integers(0, 99))
def test_the_side_is_that_of_the_last_motion(steps, first, seed):
    signs = first * (-1.0) ** np.arange(len(steps))
    turns = [0.0, *np.cumsum(signs * steps)]
    assert np.all(read(turns, seed).now == signs[-1])


def test_a_joint_that_trembles_only_has_no_side():
    assert np.all(read([0.3, 0.3]).now == 0)
    assert read([0.0, 1.0]).columns() == {f"direction_{i}": 1.0 for i in range(1, 7)}


def pose(number, q, sides, place="tracker"):
    columns = {f"direction_{i}": float(side) for i, side in enumerate(sides, start=1)}
    return TakenPose(number, place, 0.0, np.asarray(q), np.zeros(6), columns)


def test_a_pose_that_was_reached_once_is_asked_for_from_the_other_sides():
    q, other, up = np.full(6, 0.2), np.full(6, 0.9), np.array([1.0, 1, -1, 1, -1, 1])
    proposed = NextPose("tracker", other, "why", 0.5)
    again = from_both_sides(ARM, proposed, [pose(1, q, up)])
    np.testing.assert_array_equal(again.q, q)
    np.testing.assert_array_equal(np.sign(again.q - again.approach), -up)
    twice = from_both_sides(ARM, proposed, [pose(1, q, up), pose(2, q + 1e-3, -up)])
    np.testing.assert_array_equal(twice.q, other)
    assert np.all(np.abs(twice.q - twice.approach) >= np.radians(1.9))
    assert from_both_sides(ARM, proposed, [pose(1, q, up)], [again]).q is other  # another pose was asked for
    assert from_both_sides(ARM, None, []) is None


def test_where_something_holds_the_tip_it_is_refused(tmp_path):
    kit = [aj.data.observations.SimulatedSocket("cone", (500, 200, 300), 5)]
    setup = aj.live.setup_of(aj.files.load_specification("ur10e"), aj.files.load_noise("ur10e"), kit)
    with pytest.raises(aj.InputError, match="'cone' is touched"):
        aj.live.Session(setup, ["simulated:"], path=tmp_path / "capture.h5", both_sides=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_capture_has_every_pose_from_both_sides(tmp_path):
    box = [(300, -500, 200), (800, 500, 800)]
    kit = [aj.data.observations.SimulatedPoints("tracker", box, 12, u=0.02)]
    setup = aj.live.setup_of(aj.files.load_specification("ur10e"), aj.files.load_noise("ur10e"), kit)
    device = "simulated:?seed=3&speed=10&bad=0&play_arcsec=1000"
    with aj.live.Session(setup, [device], path=tmp_path / "capture.h5", both_sides=True) as session:
        until = time.monotonic() + 300
        while len(session.state()["poses"]) < 8 and time.monotonic() < until:
            time.sleep(0.05)
        poses = list(session._captured.poses)[:8]
    assert len(poses) == 8
    for first, second in zip(poses[::2], poses[1::2], strict=True):
        before, after = (sides_of(one.columns, 6) for one in (first, second))
        np.testing.assert_array_equal(after, -before)
        assert np.all(np.abs(before) == 1)
        # Readings differ by the play that the joints have, since the arm went to the same place.
        assert np.abs(first.q - second.q).max() < np.radians(1)
    readings = aj.kinematics.with_corrections(setup.specification.arm, "backlash")
    played = setup._replace(specification=setup.specification._replace(arm=readings))
    capture, _ = capture_of(played, poses)
    (points,) = capture.observations
    np.testing.assert_array_equal(points.q[:, 6:12], [sides_of(one.columns, 6) for one in poses])

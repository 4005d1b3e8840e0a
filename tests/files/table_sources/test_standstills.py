"""Standstills are found from the readings alone, whatever their noise, steps and rate."""

import numpy as np
import pytest

from aacmm_jax.files.table_sources.standstills import standstills
from tests.files.table_sources.ros_recordings import visited

POSES = np.random.default_rng(5).uniform(-1.5, 1.5, (15, 6))


def means(t, q):
    return np.array([q[first : last + 1].mean(axis=0) for first, last in standstills(t, q)]).reshape(-1, q.shape[1])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"noise": 1e-7},
        {"noise": 1e-3},
        {"rate": 10.0},
        {"rate": 500.0},
        {"stand": 3.0, "move": 0.6},
        {"stand": 1.0, "move": 8.0},
    ],
    ids=str,
)
def test_every_pose_is_found_once(options):
    t, q, held = visited(POSES, **{"noise": 1e-5} | options)
    found = standstills(t, q)
    assert len(found) == len(POSES)
    for (first, last), (begin, end) in zip(found, held, strict=True):
        assert begin <= t[first] < t[last] <= end + 1e-9
    np.testing.assert_allclose(means(t, q), POSES, atol=2 * options.get("noise", 1e-5))


def test_steps_of_an_encoder_are_no_motion():
    t, q, _ = visited(POSES, noise=2e-4)
    step = 2 * np.pi / 4096
    np.testing.assert_allclose(means(t, np.round(q / step) * step), POSES, atol=0.6 * step)


def test_a_joint_that_never_moves_is_allowed():
    t, q, _ = visited(np.concatenate([POSES[:, :5], np.ones((15, 1))], axis=1))
    assert len(standstills(t, q)) == len(POSES)


def test_an_arm_that_hunts_about_its_pose_stands():
    """A controller that swings slowly by more than the noise of the encoders."""
    t, q, _ = visited(POSES, noise=1e-6, stand=2.0)
    swinging = q + 5e-5 * np.sin(2 * np.pi * 3 * t)[:, None]
    np.testing.assert_allclose(means(t, swinging), POSES, atol=2e-5)


def test_a_second_look_at_the_same_pose_counts_once_but_a_return_counts_again():
    t, q, _ = visited(POSES[[0, 1, 1, 2, 0]])
    np.testing.assert_allclose(means(t, q), POSES[[0, 1, 2, 0]], atol=1e-5)


@pytest.mark.parametrize("kind", ["slow", "waving", "short"])
def test_an_arm_that_never_stands_has_no_pose(kind):
    t = np.arange(0, 30, 0.02)
    slow = t[:, None] * np.full(6, 1e-3) + np.random.default_rng(0).normal(0, 1e-6, (len(t), 6))
    q = {"slow": slow, "waving": np.sin(t[:, None] * np.arange(1, 7)), "short": slow[:8]}[kind]
    assert standstills(t[: len(q)], q) == []


def test_an_arm_that_only_stands_has_one_pose():
    t, q = np.arange(0, 30, 0.02), np.random.default_rng(0).normal(0.3, 1e-5, (1500, 6))
    assert len(standstills(t, q)) == 1


def test_a_pause_of_the_recording_is_no_standstill():
    """Between two runs of a recorder the arm may have gone anywhere."""
    t, q, _ = visited(POSES[:2], stand=2.0)
    t = np.where(t < 1001, t, t + 60)
    found = standstills(t, q)
    assert all(t[last] - t[first] < 10 for first, last in found)

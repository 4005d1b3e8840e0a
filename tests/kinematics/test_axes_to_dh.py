"""Any chain of axes as D-H with Hayati's beta and back, against the direct product of transforms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import aacmm_jax as aj
from aacmm_jax.core.rotations import roll_pitch_yaw, roll_pitch_yaw_matrix
from aacmm_jax.kinematics.arm import arm_of
from aacmm_jax.kinematics.axes_to_dh import (
    Axes,
    calibrated_frames,
    canonical_origins,
    dh_of_axes,
    geometry_of,
    inverse,
    rotation,
    tip_frame,
)
from aacmm_jax.kinematics.chain import JointKinds
from tests.example_counts import example_count

# A right angle, as the makers round it, and nearly none: where D-H, Hayati's form or Euler angles are singular.
ANGLES = st.one_of(
    st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi, 1.5708, 3.1415927, 1e-3, 1e-6, 1e-9, 1e-14, 0.0199, 0.0201]),
    st.floats(-np.pi, np.pi),
)
LENGTHS = st.one_of(st.sampled_from([0.0, 1e-9, -425.0]), st.floats(-500, 500))
TRANSFORMS = st.tuples(ANGLES, ANGLES, ANGLES, LENGTHS, LENGTHS, LENGTHS)
DIRECTIONS = st.one_of(
    st.sampled_from([(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0)]),
    st.tuples(*3 * [st.floats(-1, 1)]).filter(lambda axis: np.linalg.norm(axis) > 0.1),
)


def transform(numbers) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = roll_pitch_yaw_matrix(np.array(numbers[:3], dtype=float)), numbers[3:]
    return result


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result = np.eye(4)
    result[:3, :3] += np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
    return result


def along(axis: np.ndarray, distance: float) -> np.ndarray:
    result = np.eye(4)
    result[:3, 3] = distance * axis
    return result


def product(origins: list, axes: np.ndarray, tip: np.ndarray, q: np.ndarray, slides: list | None = None) -> np.ndarray:
    """The tip in the base, by the definition of a chain of joints, of which some slide."""
    pose = np.eye(4)
    for origin, axis, reading, slide in zip(origins, axes, q, slides or [False] * len(q), strict=True):
        pose = pose @ origin @ (along if slide else about)(axis, reading)
    return pose @ tip


def lines_of(origins: list, directions: np.ndarray, tip: np.ndarray) -> Axes:
    frames, frame = [], np.eye(4)
    for origin in origins:
        frame = frame @ origin
        frames.append(frame)
    z = np.array([frame[:3, :3] @ axis for frame, axis in zip(frames, directions, strict=True)])
    return Axes(z, np.array([frame[:3, 3] for frame in frames]), frames[-1] @ tip)


def assert_same(poses, expected):
    np.testing.assert_allclose(poses[:3, 3], expected[:3, 3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(poses[:3, :3], expected[:3, :3], rtol=0, atol=1e-12)


@pytest.mark.slow
@settings(max_examples=example_count(20))
@given(
    chain=st.lists(st.tuples(TRANSFORMS, DIRECTIONS, st.booleans()), min_size=1, max_size=8),
    last=TRANSFORMS,
    seed=st.integers(0, 2**32 - 1),
    keep_points=st.booleans(),
)
def test_any_chain_is_an_arm_and_its_calibration_a_chain(chain, last, seed, keep_points):
    origins, tip = [transform(numbers) for numbers, *_ in chain], transform(last)
    directions = np.array([np.array(axis) / np.linalg.norm(axis) for _, axis, _ in chain])
    slides = [slide for *_, slide in chain]
    random = np.random.default_rng(seed)
    q = random.uniform(-np.pi, np.pi, len(chain)) * np.where(slides, 100.0, 1.0)
    base, geometry = dh_of_axes(lines_of(origins, directions, tip), keep_points=keep_points)
    geometry = geometry._replace(kinds=JointKinds(tuple(slides)) if any(slides) else None)
    assert_same(base @ np.asarray(arm_of(geometry).pose(q)), product(origins, directions, tip, q, slides))
    np.testing.assert_allclose(tip_frame(geometry, base), product(origins, directions, tip, 0 * q), atol=1e-9)
    # Nothing changed: the same objects.
    assert all(
        one is other for one, other in zip(calibrated_frames(origins, geometry, geometry, base), origins, strict=True)
    )
    steps = {"alpha": 1e-3, "a": 1.0, "d": 1.0, "theta": 1e-3, "beta": 1e-3, "probe": 1.0}
    calibrated = geometry._replace(
        **{kind: (0.0 if (x := getattr(geometry, kind)) is None else x) + step * random.normal(size=np.shape(
            geometry.alpha if x is None else x)) for kind, step in steps.items()}
    )  # fmt: skip
    moved = calibrated_frames(origins, geometry, calibrated, base)
    last_joint = product(moved, directions, np.eye(4), 0 * q)
    new_tip = inverse(last_joint) @ tip_frame(calibrated, base)
    assert_same(product(moved, directions, new_tip, q, slides), base @ np.asarray(arm_of(calibrated).pose(q)))


def test_a_zero_offset_of_a_slide_moves_its_origin_alone():
    origins = [transform((0, 0, 0, 0, 0, 100)), transform((np.pi / 2, 0, 0, 50, 0, 0)), transform((1, 0, 0, 9, 80, 7))]
    base, geometry = dh_of_axes(lines_of(origins, np.tile([0.0, 0.0, 1.0], (3, 1)), np.eye(4)))
    geometry = geometry._replace(kinds=JointKinds((False, True, False)))
    moved = calibrated_frames(origins, geometry, geometry._replace(d=geometry.d + np.array([0.0, 2.0, 0.0])), base)
    assert [one is other for one, other in zip(moved, origins, strict=True)] == [True, False, True]
    np.testing.assert_allclose(inverse(origins[1]) @ moved[1], along(np.array([0.0, 0.0, 1.0]), 2.0), atol=1e-12)


def test_each_parameter_moves_one_origin():
    """theta_3 turns the origin of joint 3 about its axis, a_2 moves it; joints beyond keep theirs to the bit."""
    origins = [
        transform((0, 0, 0, 0, 0, 100)),
        transform((np.pi / 2, 0, 0, 0, 0, 0)),
        transform((0, 0, 0.3, 400, 0, 20)),
    ]
    origins += [transform((-np.pi / 2, 0, 0, 300, 0, 0)), transform((np.pi / 2, 0, 0, 0, 0, 90))]
    directions = np.tile([0.0, 0.0, 1.0], (5, 1))
    base, geometry = dh_of_axes(lines_of(origins, directions, np.eye(4)))
    for kind, joint, step in (("theta", 2, 0.01), ("a", 1, 2.0), ("alpha", 1, 0.003)):
        values = getattr(geometry, kind).copy()
        values[joint] += step
        moved = calibrated_frames(origins, geometry, geometry._replace(**{kind: values}), base)
        assert [one is other for one, other in zip(moved, origins, strict=True)] == [True, True, False, True, True]
        change = inverse(origins[2]) @ moved[2]
        if kind == "theta":
            np.testing.assert_allclose(change, rotation(2, step), atol=1e-12)
        if kind == "a":
            np.testing.assert_allclose(moved[2][:3, 3] - origins[2][:3, 3], [2, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("second", "expected"),
    [
        # theta, d, a, alpha, beta of joint 1: by hand.
        ((0, 0, 0, 300, 0, 20), (0, 20, 300, 0, 0)),  # parallel
        ((np.pi, 0, 0, 300, 0, 20), (0, 20, 300, np.pi, 0)),  # antiparallel
        ((0, 0, 0, 0, 0, 20), (0, 20, 0, 0, 0)),  # the same line
        ((np.pi / 2, 0, 0, 0, -50, 20), (0, 20, 0, np.pi / 2, 0)),  # crossing at a right angle
        ((np.pi / 2, 0, 0, 10, 0, 20), (0, 20, 10, np.pi / 2, 0)),  # skew
        ((0, 0.01, 0, 300, 0, 20), (0, 20, 300, 0, 0.01)),  # nearly parallel
    ],
)
def test_neighbouring_axes_by_hand(second, expected):
    origins = [np.eye(4), transform(second)]
    base, geometry = dh_of_axes(lines_of(origins, np.tile([0.0, 0.0, 1.0], (2, 1)), np.eye(4)))
    assert np.array_equal(base, np.eye(4))
    beta = 0.0 if geometry.beta is None else geometry.beta[0]
    found = geometry.theta[0], geometry.d[0], geometry.a[0], geometry.alpha[0], beta
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_first_frame_is_the_base_where_it_can_be():
    down = [transform((np.pi, 0, 0, 0, 0, 300))]
    base, _ = dh_of_axes(lines_of(down, np.array([[0.0, 0.0, 1.0]]), np.eye(4)))
    np.testing.assert_allclose(base, np.diag([1, -1, -1, 1]), atol=1e-12)


def test_far_frames_come_back_and_keep_the_probe():
    """Axes at 1 mrad, whose common normal is 300 m away: the frame comes back, and a tool stays a tool."""
    far = aj.Arm(
        alpha=[np.pi / 2, 0.001, np.pi / 2], a=[0, 20, 30], d=[100, 300_000, -299_900], theta=[0, 1.5, -1.5],
        probe=(1, 2, 100), limits=[(-3, 3)] * 3,
    )  # fmt: skip
    near = aj.kinematics.without_far_frames(far)
    assert np.abs(near.d).max() < 1000
    assert np.array_equal(near.probe, far.probe)
    assert near.limits == far.limits
    q = np.random.default_rng(0).uniform(-3, 3, (20, 3))
    np.testing.assert_allclose(near.pose(q), far.pose(q), rtol=0, atol=1e-9)


@given(st.tuples(ANGLES, ANGLES, ANGLES))
@settings(max_examples=example_count(30))
def test_roll_pitch_yaw_reproduce_the_rotation(angles):
    matrix = roll_pitch_yaw_matrix(np.array(angles))
    again = roll_pitch_yaw_matrix(roll_pitch_yaw(matrix))
    np.testing.assert_allclose(again, matrix, rtol=0, atol=1e-15 * 4)


def test_canonical_origins_are_the_arm():
    arm = aj.load_arm("panda")
    *origins, tip = canonical_origins(geometry_of(arm))
    q = np.random.default_rng(0).uniform(-2, 2, arm.joints)
    assert_same(product(origins, np.tile([0.0, 0.0, 1.0], (7, 1)), tip, q), np.asarray(arm.pose(q)))

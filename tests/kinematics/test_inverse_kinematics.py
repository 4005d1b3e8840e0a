"""Inverse kinematics by damped least-norm steps, in NumPy and in JAX, and the corrected readings that rest on it: the
calibrated arm is where the controller computes the nominal one to be, or the row says no."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from tests.example_counts import example_count

from ..refusals import assert_refused

ARMS = {name: to_numpy(aj.load_arm(name)) for name in ("panda", "cheng2018-simulation", "ur10")}
MM, RAD = 1e-3, 1e-9  # what is asked of a pose that is reached


def deviating(arm: aj.Arm, seed: int) -> aj.Arm:
    """Parameters off by some 0.5 mm and 0.5 mrad, as a calibration finds them."""
    random = np.random.default_rng(seed)
    size = {"a": 0.5, "d": 0.5, "probe": 0.5, "alpha": 5e-4, "theta": 5e-4}
    return to_numpy(
        arm.replace(**{k: getattr(arm, k) + random.normal(0, s, getattr(arm, k).shape) for k, s in size.items()})
    )


def within_limits(arm: aj.Arm, seed: int, count: int, part: float = 0.8) -> np.ndarray:
    limits = np.asarray(arm.limits if arm.limits is not None else [(-np.pi, np.pi)] * arm.joints)
    middle, half = limits.mean(axis=1), np.ptp(limits, axis=1) / 2
    return np.random.default_rng(seed).uniform(middle - part * half, middle + part * half, (count, arm.joints))


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("name", ARMS)
@settings(max_examples=example_count(3))
@given(seed=st.integers(0, 2**31))
def test_the_calibrated_arm_has_the_pose_that_the_controller_means(name, seed):
    nominal = ARMS[name]
    calibrated, q = deviating(nominal, seed), within_limits(nominal, seed, 100)
    found = aj.kinematics.corrected_readings(nominal, calibrated, q)
    difference = calibrated.pose(found.q) - nominal.pose(q)
    good = found.reached
    assert np.linalg.norm(difference[good, :3, 3], axis=1).max() < MM
    assert np.abs(difference[good, :3, :3]).max() < RAD
    # Where the pose is missed, a joint is at its limit or axes align, which few of random configurations are near.
    assert good.mean() > 0.8
    missed = np.linalg.norm(difference[~good, :3, 3], axis=1)
    np.testing.assert_allclose(found.distance[~good], missed, rtol=0, atol=1e-9)
    if nominal.limits is not None:
        low, high = np.asarray(nominal.limits).T
        assert np.all((low <= found.q) & (found.q <= high))


def test_an_arm_without_errors_keeps_its_readings_to_the_bit():
    nominal = ARMS["panda"]
    q = within_limits(nominal, 0, 50)
    found = aj.kinematics.corrected_readings(nominal, nominal, q)
    np.testing.assert_allclose(found.q, q, rtol=0, atol=1e-12)
    assert found.reached.all()


@pytest.mark.slow
def test_seven_joints_change_least():
    nominal = ARMS["panda"]
    calibrated, q = deviating(nominal, 3), np.array([0.1, 0.3, -0.2, -1.8, 0.2, 1.9, 0.6])
    found = aj.kinematics.corrected_readings(nominal, calibrated, q)
    columns = np.asarray(calibrated.jacobian(found.q, [f"q_{i}" for i in range(1, 8)]))
    pose = jax.jacfwd(lambda q: calibrated.pose(q)[:3, :3].ravel())(jnp.asarray(found.q))
    idle = np.linalg.svd(np.concatenate([columns, 500 * np.asarray(pose)]))[2][-1]  # moves nothing but the elbow
    change = found.q - q
    # To second order in the change: the direction that moves the elbow alone turns on the way.
    assert abs(idle @ change) < 5 * np.sum(change**2)


def test_fewer_than_six_joints_correct_the_position():
    nominal = aj.Arm(alpha=(np.pi / 2, 0, 0, 0.1), a=(0, 300, 250, 80), d=(200, 0, 0, 0), probe=(0, 0, 20))
    calibrated, q = deviating(to_numpy(nominal), 1), within_limits(nominal, 1, 20, 0.3) + 0.5
    found = aj.kinematics.corrected_readings(nominal, calibrated, q)
    good = np.asarray(found.reached)
    assert good.all()
    assert np.asarray(found.angle).max() > 1e-5
    np.testing.assert_allclose(calibrated.position(found.q), nominal.position(q), rtol=0, atol=MM)


def test_a_redundant_joint_at_its_limit_leaves_the_correction_to_the_others():
    nominal = ARMS["panda"]
    calibrated, q = deviating(nominal, 3), within_limits(nominal, 3, 10)
    free = np.asarray(aj.kinematics.corrected_readings(nominal, calibrated, q).q)
    reached = 0
    for start, end in zip(q, free, strict=True):
        joint = np.argmax(np.abs(end - start))
        limits = [(-7.0, 7.0)] * 7
        # The side to which the joint that moves most wants to go is closed.
        limits[joint] = (start[joint], 7.0) if end[joint] < start[joint] else (-7.0, start[joint])
        found = aj.kinematics.corrected_readings(nominal, calibrated, start, limits)
        reached += bool(found.reached)
        assert limits[joint][0] <= found.q[joint] <= limits[joint][1]
    assert reached >= 7  # clipping alone, without leaving the joint out, reaches at most one


def test_outside_the_reach_is_said_with_the_distance():
    nominal = ARMS["cheng2018-simulation"]
    q = within_limits(nominal, 0, 3, 0.5)
    poses = np.array(nominal.pose(q))
    poses[1, :3, 3] += (3000.0, 0, 0)
    found = aj.kinematics.readings_at_poses(nominal, q + 0.05, poses, nominal.limits)
    assert found.reached.tolist() == [True, False, True]
    assert found.distance[1] > 500
    assert np.isfinite(found.q).all()


@pytest.mark.slow
def test_one_row_or_several_under_jit_and_vmap_and_its_derivative():
    nominal = ARMS["cheng2018-simulation"]
    calibrated, q = deviating(nominal, 0), within_limits(nominal, 0, 3, 0.5)
    expected = aj.kinematics.corrected_readings(nominal, calibrated, q)

    def corrected(alpha_2, q):
        return aj.kinematics.corrected_readings(nominal, calibrated.replace(alpha_2=alpha_2), q).q

    alpha_2 = calibrated.alpha[1]
    both = jax.jit(jax.vmap(lambda x, q: jax.jvp(lambda x: corrected(x, q), (x,), (jnp.ones(()),)), (None, 0)))
    by_jax, slope = both(alpha_2, q)
    np.testing.assert_allclose(by_jax, expected.q, rtol=0, atol=1e-11)
    ends = [np.asarray(corrected(alpha_2 + change, q)) for change in (-1e-5, 1e-5)]
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / 2e-5, rtol=1e-5, atol=1e-6)


def test_refusals():
    panda, paper = ARMS["panda"], ARMS["cheng2018-simulation"]
    q, correct = np.zeros(6), aj.kinematics.corrected_readings
    assert_refused(lambda: correct(panda, paper, np.zeros(7)), "7 and 6 joints")
    assert_refused(lambda: aj.kinematics.readings_at_poses(paper, q, np.eye(4)[None]), "one pose per configuration")
    assert_refused(lambda: correct(paper, paper, q, [(0.0, 1.0)]), "6 rows")
    batch = paper.replace(d_1=np.array([1.0, 2.0]))
    assert_refused(lambda: aj.kinematics.readings_at_poses(batch, q, np.eye(4)), "a batch")


def test_an_arm_that_has_expanded():
    """At 25 C the calibrated arm reaches what the nominal one means at the readings, whatever the temperature then."""
    nominal = aj.load_arm("ur5e")
    calibrated = aj.kinematics.with_corrections(nominal, "expansion").replace(expansion=23e-6)
    q = np.random.default_rng(0).uniform(-1, 1, (5, 6)) + np.array([0, -1, 1.2, 0, 1.3, 0])
    warm = np.column_stack([q, np.full(5, 25.0)])
    found = aj.kinematics.corrected_readings(nominal, calibrated, warm, limits=[(-7.0, 7.0)] * 6)
    assert found.reached.all()
    assert found.q.shape == (5, 6)
    reached = calibrated.pose(np.column_stack([found.q, warm[:, 6]]))
    np.testing.assert_allclose(reached, nominal.pose(q), atol=1e-8)
    assert np.abs(found.q - q).max() > 1e-5
    np.testing.assert_allclose(aj.kinematics.corrected_readings(nominal, calibrated, q).q, q, atol=1e-12)


@pytest.mark.slow
def test_in_jax_all_go_on_until_the_last_has_arrived():
    """Those near a singularity come closer by it, and seeds of studies rest on which of them count as arrived."""
    arm, random = aj.load_arm("cheng2018-ra7125"), np.random.default_rng(0)
    targets = random.uniform(-600, 600, (256, 3)) + np.array([0.0, 0.0, 300.0])
    start, limits = random.uniform(-np.pi, np.pi, (256, 6)), np.array([(-np.pi, np.pi)] * 6)
    distance = {}
    for name, array in (("numpy", np.asarray), ("jax", jnp.asarray)):
        geometry = jax.tree.map(array, arm.geometry)
        given = (array(part) for part in (start, targets, limits))
        distance[name] = np.asarray(aj.kinematics.solve_to_targets(geometry, *given)[1])
    arrived = distance["jax"] <= 1e-6
    np.testing.assert_array_equal(distance["numpy"] <= 1e-6, arrived)
    assert arrived.sum() > 180
    assert np.mean(distance["jax"][arrived] <= 1e-9) > 0.99

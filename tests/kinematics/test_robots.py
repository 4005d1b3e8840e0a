"""Robots of several chains: one arm whose poses are each of one chain, against the plain arms of its chains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.kinematics.arm import correction_names, parameter_names
from aacmm_jax.kinematics.axes_to_dh import rotation
from aacmm_jax.kinematics.chain import forward_pass, joint_motion
from aacmm_jax.kinematics.jacobian import pose_columns, rotation_columns
from aacmm_jax.kinematics.robots import ChainOf, chains_of, default_names, mount_names, with_bases, with_chain


def rows(seed: int, count: int, **first: float) -> dict[str, np.ndarray]:
    """Parameters of some joints; those of the first may be given."""
    random = np.random.default_rng(seed)
    made = {"alpha": random.choice([-1.5, 1.4, 0.7], count), "a": 100 * random.normal(size=count)}
    made |= {"d": 200 * random.normal(size=count), "theta": 0.1 * random.normal(size=count)}
    for kind, value in first.items():
        made[kind][0] = value
    return made


def arm(*parts: dict[str, np.ndarray], **facts) -> aj.Arm:
    """A plain arm of some joints after each other."""
    return aj.Arm(**{kind: np.concatenate([part[kind] for part in parts]) for kind in parts[0]}, **facts)


TRUNK = rows(1, 1)
LEFT = arm(TRUNK, rows(2, 5), probe=(10.0, 20.0, 30.0))
RIGHT = arm(TRUNK, rows(3, 6), probe=(-5.0, 0.0, 60.0))
RAIL = [[-500.0, 500.0], *[[-2.0, 2.0]] * 6]
NAMES = {"left": ["t", "s", *"abcd"], "right": ["t", "r", *"efghi"]}
TWO = {"left": LEFT, "right": RIGHT}
BASE = np.eye(4)
BASE[:3, :3], BASE[:3, 3] = Rotation.from_euler("xyz", [0.4, -0.9, 2.0]).as_matrix(), (300.0, -800.0, 50.0)
WALL = rotation(0, np.pi / 2)  # the first axis is along -y, where one of the constant angles is undetermined

ROBOTS = {
    "trunk": (TWO, aj.kinematics.together(TWO, joints=NAMES), {}),
    "rail": (
        rail := {name: one.replace(prismatic=(1,), limits=RAIL[: one.joints]) for name, one in TWO.items()},
        aj.kinematics.together(rail, joints=NAMES),
        {},
    ),
    "two bases": (TWO, aj.kinematics.together(TWO, bases={"right": BASE}), {"right": BASE}),
    "wall": (TWO, aj.kinematics.together(TWO, bases={"right": WALL}), {"right": WALL}),
}
"""By name: the plain arms, the robot, and the bases."""


@pytest.fixture(params=ROBOTS)
def robot(request) -> tuple[dict[str, aj.Arm], aj.Arm, dict]:
    """Plain arms, the robot, and bases."""
    return ROBOTS[request.param]


def readings(robot: aj.Arm, count: int) -> np.ndarray:
    """Readings of all joints, with a chain that takes turns."""
    q = np.random.default_rng(0).uniform(-1, 1, (count, robot.joints))
    return np.column_stack([q, np.arange(count) % len(robot.chains)])


def test_poses_are_those_of_the_plain_arms(robot):
    arms, whole, bases = robot
    for name, plain in arms.items():
        chain: ChainOf = aj.kinematics.chain_of(whole, name)
        q = np.random.default_rng(1).uniform(-1, 1, (5, plain.joints))
        poses = bases.get(name, np.eye(4)) @ np.asarray(plain.pose(q))
        given = chain.readings(q)
        np.testing.assert_allclose(whole.pose(given), poses, atol=1e-9)
        np.testing.assert_allclose(chain.base @ np.asarray(chain.arm.pose(chain.of_robot(given))), poses, atol=1e-9)
        given[:, : whole.joints][given[:, : whole.joints] == 0] = 0.7  # what other joints read is no matter
        np.testing.assert_allclose(whole.pose(given), poses, atol=1e-9)


@pytest.mark.slow
def test_derivatives_are_exact(robot):
    whole = robot[1]
    q, space = readings(whole, 6), aj.Parameters(whole, parameter_names(whole))
    vector = np.asarray(space.vector()) + 1e-3
    bent = space.arm(vector)
    columns = np.asarray(bent.jacobian(q))
    by_readings = np.asarray(bent.jacobian(q, [f"q_{i}" for i in range(1, whole.joints + 1)]))
    position = lambda vector, q: space.arm(vector).position(q)  # noqa: E731
    for derive in (jax.jacfwd, jax.jacrev):
        by_vector, by_q = derive(position, argnums=(0, 1))(jnp.asarray(vector), jnp.asarray(q))
        np.testing.assert_allclose(by_vector, columns, atol=1e-9)
        np.testing.assert_allclose(np.einsum("ncnq->ncq", by_q)[..., :-1], by_readings, atol=1e-9)
    motion, geometry = joint_motion(bent.geometry, q), space.geometry(vector)
    frames = np.stack(forward_pass(geometry, motion).frame)
    turned = rotation_columns(forward_pass(geometry, motion), space.indices())
    for i in range(0, len(vector), 4):
        step = 1e-6 * (np.arange(len(vector)) == i)
        ends = [np.stack(forward_pass(space.geometry(vector + sign * step), motion).frame) for sign in (1, -1)]
        change = 0.5 * np.cross(frames, (ends[0] - ends[1]) / 2e-6, axis=1).sum(axis=0)
        np.testing.assert_allclose(change, turned[i], atol=1e-8)


@pytest.mark.slow
def test_a_batch_has_the_columns_of_each_robot():
    whole = ROBOTS["trunk"][1]
    space, q = aj.Parameters.free_of(whole), readings(whole, 6)
    motion, vectors = joint_motion(whole.geometry, jnp.asarray(q)), np.add(space.vector(), [[0.0], [1e-2]])
    many = jax.vmap(lambda vector: pose_columns(space.geometry(vector), motion, space.indices(), True))(vectors)
    for i, vector in enumerate(vectors):
        one = pose_columns(space.geometry(vector), joint_motion(whole.geometry, q), space.indices(), True)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, atol=1e-9), many, one)


@pytest.mark.slow
def test_joints_that_follow_others_have_no_reading_of_their_own():
    plain = arm(rows(4, 4))
    whole = plain.replace(fixed=(2,), mimic=[(4, 3, -0.5, 0.1)])
    q = np.random.default_rng(0).uniform(-1, 1, (5, 4))
    moved = q.copy()
    moved[:, 1], moved[:, 3] = 0.0, 0.1 - 0.5 * q[:, 2]
    np.testing.assert_allclose(whole.position(q), plain.position(moved), atol=1e-9)
    derivative = np.asarray(jax.vmap(jax.jacfwd(whole.position))(jnp.asarray(q)))
    np.testing.assert_allclose(whole.jacobian(q, [f"q_{i}" for i in range(1, 5)]), derivative, atol=1e-9)
    assert not np.any(derivative[..., [1, 3]])


def test_a_gear_ratio_is_that_of_the_joint_that_follows():
    whole = arm(rows(4, 4)).replace(mimic=[(4, 3, -0.5, 0.1)])
    geared = aj.kinematics.with_corrections(whole, "gear").replace(gear_4=0.01)
    q = np.random.default_rng(0).uniform(-1, 1, (5, 4))
    expected = arm(rows(4, 4)).position(np.column_stack([q[:, :3], 1.01 * (0.1 - 0.5 * q[:, 2])]))
    np.testing.assert_allclose(geared.position(q), expected, atol=1e-9)


@pytest.mark.first_rows(1)
def test_default_parameters_are_independent(robot):
    whole = robot[1]
    names = default_names(whole)
    q = np.random.default_rng(0).uniform(*np.asarray(aj.kinematics.arm.joint_limits(whole, None)).T, (90, whole.joints))
    q = np.column_stack([q, np.arange(90) % 2])
    space = aj.Parameters.free_of(whole)
    assert space.names == names
    moved = aj.perturbed_arm(space, length=5.0, angle=0.01)
    columns = np.asarray(moved.jacobian(q, names)) * np.asarray(space.scale)
    rigid = np.concatenate(
        [np.tile(np.eye(3), (90, 1, 1)), np.cross(np.eye(3), np.asarray(moved.position(q))[:, None]).swapaxes(1, 2)],
        axis=2,
    )
    both = np.concatenate([columns, rigid * [1, 1, 1, 1e-3, 1e-3, 1e-3]], axis=2).reshape(270, -1)
    rank = np.linalg.matrix_rank(both, tol=1e-8 * np.linalg.norm(both, 2))
    everything = np.asarray(moved.jacobian(q)).reshape(270, -1)
    most = np.linalg.matrix_rank(np.hstack([everything, rigid.reshape(270, -1)]), tol=1e-9 * np.linalg.norm(everything))
    assert rank == both.shape[1] == most


@pytest.mark.first_rows(3)
def test_what_data_determine_is_as_many(robot):
    whole = robot[1]
    assert len(aj.Parameters.independent(whole).names) == len(default_names(whole))


def test_bases_and_chains_are_changed_and_read_back():
    whole = ROBOTS["two bases"][1]
    np.testing.assert_allclose(
        aj.kinematics.chain_of(with_bases(whole, {"right": WALL}), "right").base, WALL, atol=1e-9
    )
    assert mount_names(aj.kinematics.chain_of(whole, "right"))[0] == "d_7"
    chain = aj.kinematics.chain_of(whole, "right")
    changed = with_chain(whole, "right", chain.arm.replace(a_2=123.0))
    assert float(aj.kinematics.chain_of(changed, "right").arm.a[1]) == pytest.approx(123.0)
    np.testing.assert_array_equal(aj.kinematics.chain_of(changed, "left").arm.a, LEFT.a)


REFUSED = {
    "no such chain": lambda: aj.kinematics.chain_of(ROBOTS["trunk"][1], "middle"),
    "tied parameters differ": lambda: aj.kinematics.together(
        {"left": LEFT.replace(alpha_1=0.5), "right": RIGHT.replace(alpha_1=0.4)},
        joints={"left": ["t", "s", *"abcd"], "right": ["t", "s", *"efghi"]},
    ),
    "chains meet again": lambda: aj.kinematics.together(TWO, joints=NAMES | {"right": ["t", "r", *"efgh", "c"]}),
    "mimics a joint that is not there": lambda: aj.kinematics.together(TWO, mimic={"a": ("x", 1.0, 0.0)}, joints=NAMES),
    "mimics itself": lambda: LEFT.replace(mimic=[(2, 2, 1.0, 0.0)]),
    "base is no rigid transform": lambda: aj.kinematics.together(TWO, bases={"right": 2 * np.eye(4)}),
    "chain without joints": lambda: LEFT.replace(chains={"left": ()}),
    "joint of no chain": lambda: LEFT.replace(chains={"left": (1, 2)}),
    "chain that goes back": lambda: LEFT.replace(chains={"left": (1, 3, 2, 4, 5, 6)}),
    "number of no chain": lambda: ROBOTS["trunk"][1].position(np.full(ROBOTS["trunk"][1].joints + 1, 2.0)),
    "number between chains": lambda: ROBOTS["trunk"][1].position(np.full(ROBOTS["trunk"][1].joints + 1, 0.5)),
    "readings without the chain": lambda: ROBOTS["trunk"][1].position(np.zeros(ROBOTS["trunk"][1].joints)),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refused_in_one_sentence(what):
    with pytest.raises(aj.InputError) as error:
        REFUSED[what]()
    assert "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize("mimic", [[], [(11, 3, 0.5, 0.1)]], ids=["", "a joint follows one of the other chain"])
def test_calibrated_together_within_their_uncertainty(mimic):
    whole = ROBOTS["two bases"][1].replace(mimic=mimic)
    space = aj.Parameters.independent(whole)
    true = aj.perturbed_arm(space, length=1.0, angle=0.002, seed=1)
    capture = aj.simulate(
        true,
        {"A": (500, -300, 300), "B": (0, -500, 400), "C": (300, -200, 0), "D": (200, -600, 200)},
        poses=24,
        lengths=[("A", "B")],
        encoder_arcsec=5.0,
        chains={"D": "right"},
        seed=3,
    )
    assert set(np.asarray(capture.sockets["D"])[:, -1]) == {1.0}
    assert len(set(np.asarray(capture.q)[:, -1])) == 2
    result = aj.calibrate(whole, capture, aj.Bounds.around(whole, space), method="joint")
    z = (np.asarray(space.vector(result.arm)) - np.asarray(space.vector(true))) / np.sqrt(np.diag(result.covariance))
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.35)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("model", ["harmonics=1,gear,coupled=2-3+10-11", "gravity", "backlash=gravity"])
def test_a_chain_keeps_its_joint_corrections(model):
    _, whole, _ = ROBOTS["two bases"]
    if "backlash" in model:  # which is for an upright base
        with pytest.raises(aj.InputError, match="base of chain 'right' is tilted"):
            aj.kinematics.chain_of(aj.kinematics.with_corrections(whole, model), "right")
        whole = aj.kinematics.together(TWO, bases={"right": (300.0, -800.0, 50.0)})
    corrected = aj.kinematics.with_corrections(whole, model)
    assert corrected.corrections is not None
    names = corrected.corrections.functions.names
    corrected = corrected.replace(coefficients=1e-3 * np.random.default_rng(0).normal(size=len(names)))
    for name in ("left", "right"):
        chain = aj.kinematics.chain_of(corrected, name)
        q = np.random.default_rng(1).uniform(-1, 1, (5, len(chain.joints)))
        poses = np.asarray(corrected.pose(chain.readings(q)))
        np.testing.assert_allclose(chain.base @ np.asarray(chain.arm.pose(q)), poses, atol=1e-9)
        plain = aj.kinematics.chain_of(whole, name)
        assert np.abs(plain.base @ np.asarray(plain.arm.pose(q)) - poses).max() > 1e-3
        assert set(correction_names(chain.arm)) & set(chain.names)


def test_masses_of_a_robot_belong_to_no_chain_alone():
    _, whole, _ = ROBOTS["two bases"]
    loads = {"mass": np.ones(whole.joints), "centre": np.zeros((whole.joints, 3))}
    heavy = aj.kinematics.with_corrections(whole, "gravity=masses", **loads)
    with pytest.raises(aj.InputError, match="masses of all links"):
        aj.kinematics.chain_of(heavy, "left")
    assert set(chains_of(heavy)) == {"left", "right"}

"""The chain against an independent product of 4x4 matrices, JAX's differentiation, and a maker's URDF."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.kinematics import chain, jacobian


def random_arm(
    joints: int, seed: int, *, beta: bool = False, batch: tuple[int, ...] = (), prismatic: tuple[int, ...] = ()
) -> aj.Arm:
    random = np.random.default_rng(seed)
    shape = (*batch, joints)
    return aj.Arm(
        alpha=random.uniform(-np.pi, np.pi, shape),
        a=random.uniform(-500, 500, shape),
        d=random.uniform(-500, 500, shape),
        theta=random.uniform(-0.1, 0.1, shape),
        beta=random.uniform(-0.1, 0.1, shape) if beta else None,
        probe=random.uniform(-100, 100, (*batch, 3)),
        prismatic=prismatic,
    )


def random_readings(arm: aj.Arm, seed: int, *batch: int) -> np.ndarray:
    """Rad, or mm of prismatic joints."""
    random = np.random.default_rng(seed)
    return random.uniform(-3, 3, (*batch, arm.joints)) * chain.reading_units(arm.geometry)


def by_matrices(arm: aj.Arm, q: np.ndarray) -> np.ndarray:
    """Pose of the tip by the textbook: a product of elementary 4x4 matrices, one pose."""

    def turn(axis: int, angle: float) -> np.ndarray:
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix = np.eye(4)
        matrix[i, i] = matrix[j, j] = np.cos(angle)
        matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
        return matrix

    def slide(x: float, y: float, z: float) -> np.ndarray:
        matrix = np.eye(4)
        matrix[:3, 3] = x, y, z
        return matrix

    pose = np.eye(4)
    for i in range(arm.joints):
        angle, along = (0.0, q[i]) if i + 1 in arm.prismatic else (q[i], 0.0)
        pose = pose @ turn(2, angle + arm.theta[i]) @ slide(0, 0, arm.d[i] + along)
        pose = pose @ slide(arm.a[i], 0, 0) @ turn(0, arm.alpha[i])
        if arm.beta is not None:
            pose = pose @ turn(1, arm.beta[i])
    return pose @ slide(*np.asarray(arm.probe))


@pytest.mark.first_rows(4)
@pytest.mark.parametrize("beta", [False, True])
@pytest.mark.parametrize(
    ("joints", "prismatic"), [(1, ()), (2, ()), (6, ()), (9, ()), (1, (1,)), (4, (3,)), (6, (1, 2, 3)), (7, (1, 7))]
)
def test_pose_is_the_textbook_product(joints, prismatic, beta):
    arm = random_arm(joints, joints, beta=beta, prismatic=prismatic)
    q = random_readings(arm, 0, 5)
    expected = np.stack([by_matrices(arm, row) for row in q])
    np.testing.assert_allclose(arm.pose(q), expected, atol=1e-11)
    np.testing.assert_allclose(arm.position(q), expected[:, :3, 3], atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("beta", "prismatic"), [(False, ()), pytest.param(True, (), marks=pytest.mark.slow), (True, (1, 4))]
)
def test_the_tips_and_columns_of_a_batch_are_those_of_the_loop(beta, prismatic):
    arm = random_arm(6, 1, beta=beta, batch=(4,), prismatic=prismatic)
    q = random_readings(arm, 0, 5)
    kinds = ("alpha", "a", "d", "theta", "q", *(("beta",) if beta else ()))
    indices = (*((kind, i) for kind in kinds for i in (0, 3, 5)), ("probe", 2))
    given = arm.geometry, chain.joint_motion(arm.geometry, q)
    batch = jax.vmap(lambda *given: jacobian.pose_columns(*given, indices, True), in_axes=(0, None))
    compiled = jax.jit(batch).lower(*given).compile()
    found = compiled(*given)
    for i in range(4):
        geometry = jax.tree.map(lambda leaf, i=i: leaf[i], arm.geometry)
        forward = chain.forward_pass(geometry, given[1])
        np.testing.assert_allclose(found.tip[i], forward.tip, rtol=0, atol=1e-11)
        expected = jacobian.stacked_jacobian_columns(forward, indices)
        np.testing.assert_allclose(found.columns[i], expected, rtol=0, atol=1e-11)
        np.testing.assert_allclose(found.turned[i], jacobian.rotation_columns(forward, indices), rtol=0, atol=1e-11)
    # XLA has not simplified the condition that keeps it from computing the chain again for every column.
    assert jax.default_backend() != "cpu" or " conditional(" in compiled.as_text()


@pytest.mark.parametrize(
    ("joints", "prismatic"),
    [
        (4, (1, 3)),
        *(pytest.param(n, (), marks=pytest.mark.slow) for n in (2, 7)),
        *(pytest.param(n, (), marks=pytest.mark.exhaustive) for n in (3, 4, 5, 6, 8, 9)),
    ],
)
def test_jacobian_is_jax_own_differentiation(joints, prismatic):
    """Analytic columns; JAX's forward and reverse modes through the custom rule; and the plain chain: all equal."""
    arm = random_arm(joints, joints, beta=True, prismatic=prismatic)
    q = jnp.asarray(random_readings(arm, joints, 4))
    names = (*aj.kinematics.parameter_names(arm), *(f"q_{i}" for i in range(1, joints + 1)))

    def flattened(derivative):
        geometry, by_q = derivative
        by_kind = [getattr(geometry, kind) for kind in ("alpha", "a", "d", "theta", "beta", "probe")]
        return jnp.concatenate([*by_kind, by_q], axis=-1)

    def one(q):
        def plain(geometry, q):
            return chain.forward_pass(geometry, chain.joint_motion(geometry, q)).tip[:, 0]

        modes = [
            jax.jacfwd(jacobian.tip_position, (0, 1)),
            jax.jacrev(jacobian.tip_position, (0, 1)),
            jax.jacfwd(plain, (0, 1)),
        ]
        return [arm.jacobian(q, names), *(flattened(mode(arm.geometry, q)) for mode in modes)]

    analytic, *others = jax.jit(jax.vmap(one))(q)
    assert analytic.shape == (4, 3, len(names))
    # Relative to the arm's size: a column is a difference of positions, so single entries may cancel.
    size = float(jnp.max(jnp.abs(analytic)))
    for other in others:
        np.testing.assert_allclose(analytic, other, rtol=0, atol=1e-12 * size)


@pytest.mark.slow
def test_second_derivatives_pass_through_the_rule():
    arm = random_arm(3, 1, prismatic=(2,))
    q = jnp.array([0.3, -70.0, 1.1])

    def of_rule(q):
        return jnp.sum(arm.position(q) ** 2)

    def of_chain(q):
        return jnp.sum(chain.forward_pass(arm.geometry, chain.joint_motion(arm.geometry, q)).tip ** 2)

    modes = jax.hessian(of_chain), jax.hessian(of_rule), jax.jacrev(jax.jacrev(of_rule))
    plain, *others = jax.jit(lambda q: [mode(q) for mode in modes])(q)
    for other in others:
        np.testing.assert_allclose(other, plain, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize(("arm_batch", "pose_batch"), [((), (2, 3)), ((3,), ()), ((2, 1), (2, 3)), ((2, 3), (3,))])
def test_batches_broadcast(arm_batch, pose_batch):
    arm = random_arm(3, 7, batch=arm_batch)
    q = np.random.default_rng(1).uniform(-3, 3, (*pose_batch, 3))
    shape = np.broadcast_shapes(arm_batch, pose_batch)
    position = arm.position(q)
    assert position.shape == (*shape, 3)
    assert arm.pose(q).shape == (*shape, 4, 4)
    assert arm.jacobian(q, ("alpha_1", "probe_y")).shape == (*shape, 3, 2)
    full = {
        kind: np.broadcast_to(np.asarray(getattr(arm, kind)), (*shape, 3))
        for kind in ("alpha", "a", "d", "theta", "probe")
    }
    angles = np.broadcast_to(q, (*shape, 3))
    for index in np.ndindex(*shape):
        single = aj.Arm(**{kind: value[index] for kind, value in full.items()})
        np.testing.assert_allclose(position[index], by_matrices(single, angles[index])[:3, 3], atol=1e-11)


def test_a_method_passed_to_jit_traces_the_arm():
    """As of any module of Equinox: another arm's method is no new program, and has that arm's values."""
    traced = []

    @eqx.filter_jit
    def at(function, q):
        traced.append(function)
        return function(q)

    q = jnp.zeros(2)
    for a in (300.0, 310.0):
        arm = aj.Arm(alpha=[0.0, 0.0], a=[a, 200.0], d=[0.0, 0.0])
        for tips in (at(arm.position, q), jax.jit(lambda function, q: function(q))(arm.position, q)):
            np.testing.assert_allclose(tips, [a + 200, 0, 0], atol=1e-12)
    assert len(traced) == 1


def test_unknown_parameter_suggests_the_nearest():
    with pytest.raises(aj.InputError, match=r"unknown parameter 'alhpa_2' of a 3-joint arm; did you mean 'alpha_2'\?"):
        random_arm(3, 0).jacobian(np.zeros(3), ["alhpa_2"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_panda_equals_its_urdf():
    """Standard D-H against the maker's URDF, read by an independent library."""
    yourdfpy = pytest.importorskip("yourdfpy")
    path = Path(__file__).with_name("panda.urdf")
    model = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True)
    arm = aj.load_arm("panda")
    flange_arm = aj.Arm(alpha=arm.alpha, a=arm.a, d=arm.d, theta=arm.theta)
    low, high = np.array(arm.limits).T
    q = np.random.default_rng(0).uniform(low, high, (1000, arm.joints))
    expected = np.empty((1000, 4, 4))
    for i, row in enumerate(q):
        model.update_cfg(dict(zip(model.actuated_joint_names, row, strict=True)))
        expected[i] = model.get_transform("flange", model.base_link)
    expected[:, :3, 3] *= 1000
    poses = np.asarray(flange_arm.pose(q))
    np.testing.assert_allclose(poses[:, :3, 3], expected[:, :3, 3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(poses[:, :3, :3], expected[:, :3, :3], rtol=0, atol=1e-12)

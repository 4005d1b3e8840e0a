"""Plans for robots of several chains: poses of every chain, the others at rest, and no arm in the other's way."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.files.plans import plan_csv, plan_manifest
from aacmm_jax.kinematics.collisions import capsule_ends, clearances
from aacmm_jax.kinematics.workspace import lowest_point, reached, search_region, skeleton
from aacmm_jax.planning.motion import joint_weights
from aacmm_jax.planning.problem import DesignProblem, PlanOptions

LIMITS = [[-2.5, 2.5]] * 6
ARM = aj.Arm(
    alpha=[1.57, 0.05, 1.5, -1.4, 1.3, 0.2], a=[30, 300, 250, 20, 10, 5], d=[90, 10, 20, 60, 80, 40],
    probe=(20, 0, 80), limits=LIMITS,
)  # fmt: skip
BASE = np.diag([-1.0, -1.0, 1.0, 1.0]) + np.array([[0, 0, 0, 400.0]] + 3 * [[0] * 4])  # opposite the other arm
TWO = to_numpy(aj.kinematics.together({"left": ARM, "right": ARM}, bases={"right": BASE}))
TORSO = to_numpy(
    aj.kinematics.together({"left": ARM, "right": ARM}, joints={"left": ["t", *"abcde"], "right": ["t", *"ghijk"]})
)
SOCKETS = {"A": (200, 100, 250), "B": (200, -150, 300), "C": (150, 0, 450)}
BODY = aj.kinematics.body_along_links(TWO, 15.0)


def configurations(robot: aj.Arm, count: int) -> np.ndarray:
    """Random readings of all joints, with chains that take turns."""
    q = np.random.default_rng(0).uniform(-1, 1, (count, robot.joints))
    return np.column_stack([q, np.arange(count) % 2])


@pytest.mark.slow
@pytest.mark.parametrize("robot", [TWO, TORSO], ids=["two bases", "torso"])
def test_the_body_is_that_of_each_chain_wherever_the_others_are(robot):
    body, q = aj.kinematics.body_along_links(robot, 15.0), configurations(robot, 6)
    start, end = capsule_ends(body, robot, q)
    for name in ("left", "right"):
        chain = aj.kinematics.chain_of(robot, name)
        own = aj.kinematics.body_along_links(chain.arm, 15.0)
        expected = capsule_ends(own, chain.arm, chain.of_robot(q))
        for text, *ends in zip(own.names, *expected, strict=True):
            kind, _, row = text.partition(" ")
            i = body.names.index(f"{kind} {chain.names[row]}" if row else f"probe of {name}")
            for found, plain in zip((start[i], end[i]), ends, strict=True):
                np.testing.assert_allclose(found, chain.base[:3, :3] @ plain + chain.base[:3, 3:], atol=1e-9)
    pairs = {frozenset((body.names[i], body.names[j])) for i, j in body.pairs}
    assert frozenset(("probe of left", "probe of right")) in pairs


def test_an_arm_at_rest_is_in_the_way():
    cell = aj.kinematics.Cell(BODY, clearance=15.0)
    region, targets = search_region(TWO, None, 0.1, -np.inf, 0), np.tile(np.array(SOCKETS["A"], dtype=float), (60, 1))
    starts = np.random.default_rng(1).uniform(-2, 2, (60, TWO.joints + 1))
    starts[:, -1] = 1
    q, good = reached(region, starts, targets)
    starts[:, 6:-1], starts[:, -1] = q[good][0, 6:-1], 0  # the right arm rests in the socket
    q, good = reached(region, starts, targets)
    assert good.sum() > 5
    assert np.all(clearances(cell, TWO, q[good]) < 15.0)  # both tips are in one place
    assert not reached(region._replace(cell=cell), starts, targets)[1].any()
    np.testing.assert_array_equal(q[:, 9:], starts[:, 9:])  # the other arm stays where it was


@pytest.mark.slow
def test_random_configurations_are_of_the_chains_asked_for_and_leave_the_others_at_rest():
    rest = np.full(TWO.joints, 0.2)
    problem = DesignProblem.of(TWO, PlanOptions(chains=("right",), rest=rest))
    q = problem.region.draw(10)
    assert set(q[:, -1]) == {1.0}
    assert np.all(q[:, :6] == 0.2)
    assert len(np.unique(q[:, 10])) == 10
    moved = problem.moved(q, 0.1)
    np.testing.assert_array_equal(moved[:, [*range(6), 15]], q[:, [*range(6), 15]])
    of_right = aj.kinematics.chain_of(TWO, "right").names.values()
    assert set(problem.space.names) <= set(of_right)  # nothing tells where a single arm's base is
    whole = DesignProblem.of(TWO, PlanOptions())
    assert set(whole.region.draw(10)[:, -1]) == {0.0, 1.0}
    assert len(joint_weights(TWO)) == TWO.joints


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: aj.planning.plan(TWO, sockets=SOCKETS, poses=30, chains=("middle",)), "no chain 'middle'"),
        (lambda: aj.planning.plan(ARM, sockets=SOCKETS, poses=30, chains=("left",)), "the arm has no chains"),
        (lambda: aj.planning.plan(ARM, sockets=SOCKETS, poses=30, rest=[0.0] * 6), "no chains"),
        (lambda: aj.planning.plan(TWO, sockets=SOCKETS, poses=30, rest=[0.0] * 3), "rest"),
        (
            lambda: aj.planning.plan(
                aj.kinematics.together({"left": ARM, "right": ARM}, bases={"right": (5e3, 0.0, 0.0)}),
                sockets=SOCKETS,
                poses=30,
                candidates=60,
            ),
            "chain 'right' reaches none",
        ),
        (lambda: aj.planning.plan(TWO, sockets=SOCKETS, poses=9), "3 sockets and 2 chains"),
        (
            lambda: aj.planning.plan_kit(
                TWO, [aj.data.observations.SimulatedPoints("t", [[0, 0, 0], [300, 300, 300]], 20)], poses=30
            ),
            "one chain of a robot",
        ),
        (lambda: aj.acceptance.plan_procedure(TWO, "iso"), "single chain"),
    ],
)
def test_refused(make, match):
    with pytest.raises(aj.InputError, match=match):
        make()


@pytest.mark.slow
def test_a_plan_determines_both_arms_and_the_base_between_them():
    cell, rest = aj.kinematics.Cell(BODY, clearance=5.0), np.zeros(TWO.joints)
    rest[[0, 9]] = 2.0
    space = aj.Parameters.independent(TWO)
    planned = aj.planning.plan(
        TWO,
        sockets=SOCKETS,
        lengths=[("A", "B")],
        poses=30,
        cell=cell,
        candidates=600,
        above=-np.inf,
        rest=rest,
        space=space,
    )
    chains = np.asarray(planned.q)[:, -1]
    for i in range(3):
        assert set(chains[planned.owner == i]) == {0.0, 1.0}
        tips = np.asarray(TWO.position(planned.q[planned.owner == i]))
        np.testing.assert_allclose(tips, np.tile(list(planned.sockets.values())[i], (len(tips), 1)), atol=1e-6)
    assert planned.motion.clearance is not None
    assert np.all(planned.motion.clearance >= 5.0)
    assert np.isfinite(planned.predicted.largest)
    assert np.all(planned.q[chains == 0][:, 6:-1] == rest[6:])
    assert np.all(planned.q[chains == 1][:, :6] == rest[:6])
    groups = planned.owner * 2 + chains
    assert len(np.flatnonzero(np.diff(groups))) == 5  # poses of one arm in one socket follow each other
    rows = plan_csv(planned).splitlines()
    assert rows[0].split(",")[:4] == ["pose", "socket", "chain", "x_mm"]
    assert len(rows) == 31
    manifest = plan_manifest(planned, "two.toml")
    assert manifest.count('chain = "left"') == manifest.count('chain = "right"') == 3
    assert 'file = "left_A.csv"' in manifest


def corners(line: np.ndarray) -> np.ndarray:
    """The corners of a line that are not where the one before is."""
    return line[np.append(True, np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-6)]


def test_lines_and_heights_are_those_of_the_chain_of_a_pose():
    low = to_numpy(aj.kinematics.together({"left": ARM, "right": ARM}, bases={"right": (400.0, 0.0, -300.0)}))
    q = configurations(low, 4)
    for name, rows in (("left", q[::2]), ("right", q[1::2])):
        chain = aj.kinematics.chain_of(low, name)
        expected = chain.base[:3, 3] + skeleton(chain.arm, chain.of_robot(rows))
        lines = skeleton(low, rows)
        for line, plain in zip(lines, expected, strict=True):
            np.testing.assert_allclose(line[0], chain.base[:3, 3], atol=1e-9)
            np.testing.assert_allclose(corners(line), corners(plain), atol=1e-9)
        heights = chain.base[2, 3] + lowest_point(chain.arm, chain.of_robot(rows))
        np.testing.assert_allclose(lowest_point(low, rows), heights, atol=1e-9)

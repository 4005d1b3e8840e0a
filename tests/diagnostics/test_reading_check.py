"""Order, signs, zeros and units of joint readings are found again, on recorded and on simulated data."""

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.diagnostics import reading_check, reading_search
from aacmm_jax.diagnostics.reading_check import check_readings, explanation_words
from aacmm_jax.diagnostics.reading_fit import Explanation, ReadingFit
from aacmm_jax.diagnostics.reading_search import Evidence, Hypothesis, search
from aacmm_jax.files.reading_checks import angles_toml

DEG = np.pi / 180
NONE = (0.0,) * 7
PLAIN = tuple(range(7))


def recorded(q, order, signs, offsets):
    """Columns of which the hypothesis makes the readings q."""
    columns = np.empty_like(q)
    columns[:, list(order)] = (q - np.array(offsets)) * np.array(signs)
    return columns


@pytest.fixture
def few(monkeypatch):
    """A search of one or two mistakes, in a tenth of the time."""
    monkeypatch.setattr(reading_search, "_MOST", 65_000)
    monkeypatch.setattr(reading_check, "_REFITTED", 8)


@pytest.fixture(scope="module")
def panda(mukca):
    """The arm, and every fourth of its recorded poses in five sockets."""
    recording = aj.files.read_manifest(mukca / "capture.toml")
    rows = np.flatnonzero(np.isin(recording.capture.owner, (0, 3, 6, 9, 12)))[::4]
    return recording.nominal.arm, np.asarray(recording.capture.q)[rows], recording.capture.owner[rows]


# The search: no approximation in its costs, and nothing left out


def residual(arm, hypothesis, evidence, lever):
    """The RMS residual by the definition, pose by pose."""
    pose = np.asarray(arm.pose(hypothesis.readings(evidence.q)))
    tips = pose[:, :3, 3]
    if evidence.points is None:
        means = np.stack([tips[evidence.owner == i].mean(axis=0) for i in evidence.owner])
        return np.sqrt(np.mean(np.sum((tips - means) ** 2, axis=1)))
    if evidence.own_frame:
        centred, points = tips - tips.mean(axis=0), evidence.points - evidence.points.mean(axis=0)
        return Rotation.align_vectors(centred, points)[1] / np.sqrt(len(tips))
    squares = np.sum((tips - evidence.points) ** 2, axis=1)
    if evidence.rotations is not None:
        # Half the squared Frobenius norm of the difference of two rotations.
        squares += lever**2 * np.sum((pose[:, :3, :3] - evidence.rotations) ** 2, axis=(1, 2)) / 2
    return np.sqrt(np.mean(squares))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sockets", "base", "poses", "own frame"])
def test_costs_of_halves_are_those_of_whole_chains(kind):
    random = np.random.default_rng(3)
    arm = aj.Arm(alpha=[-1.5, 0.3, 1.2], a=[50, 300, 20], d=[200, 10, 250], theta=[0.1, 0, 0.2], probe=(10, 20, 90))
    q, owner = random.uniform(-2, 2, (9, 3)), np.array([0, 0, 0, 0, 1, 1, 1, 1, 1])
    points = None if kind == "sockets" else random.normal(size=(9, 3)) * 300
    rotations = Rotation.random(9, random_state=1).as_matrix() if kind == "poses" else None
    if kind != "sockets":
        owner = np.zeros(9, dtype=int)
    evidence = Evidence(q, owner, points, rotations, kind == "own frame")
    rms, hypotheses, tried = search(arm, evidence, 150.0)
    assert rms == sorted(rms)
    expected = [residual(arm, hypothesis, evidence, 150.0) for hypothesis in hypotheses[::40]]
    np.testing.assert_allclose(rms[::40], expected, rtol=1e-6, atol=1e-4)
    # Of all orders, signs and quarters, the best is among what was tried.
    zeros = [(0.0,) if kind in ("sockets", "own frame") else np.arange(4) * np.pi / 2, *[np.arange(4) * np.pi / 2] * 2]
    every = [
        Hypothesis(order, signs, offsets)
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
        for offsets in itertools.product(*zeros)
    ]
    if kind != "own frame":  # where every order is tried with one zero alone
        assert rms[0] <= min(residual(arm, one, evidence, 150.0) for one in every[::7]) + 1e-4
        assert tried >= len(every)


@pytest.mark.parametrize(
    ("order", "signs", "offsets", "changes"),
    [
        ((0, 1, 2, 3), (1, 1, 1, 1), (0, 0, 0, 0), 0),
        ((1, 0, 2, 3), (1, -1, 1, 1), (0, 0, 0, 0), 2),
        ((1, 2, 0, 3), (1, 1, 1, 1), (0, 0, 0, 2.0), 3),
        ((3, 2, 1, 0), (-1, -1, -1, -1), (1.0, 0, 0, 0), 7),
    ],
)
def test_number_of_changes(order, signs, offsets, changes):
    assert Hypothesis(order, signs, offsets).changes == changes


# What is found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "signs", "offsets"),
    [
        pytest.param(PLAIN, (1,) * 7, NONE, marks=pytest.mark.slow),
        pytest.param(PLAIN, (1, 1, -1, 1, 1, 1, 1), NONE, marks=pytest.mark.slow),
        ((0, 1, 2, 3, 5, 4, 6), (1, 1, -1, 1, 1, 1, 1), (0, np.pi / 2, 0, 0, 0, 0, 0)),
        pytest.param(PLAIN, (1,) * 7, (0, 0, 0, 37 * DEG, 0, 0, 0), marks=pytest.mark.slow),
    ],
)
def test_mistakes_in_a_recorded_capture(panda, few, order, signs, offsets):
    arm, q, sockets = panda
    found = check_readings(arm, recorded(q, order, signs, offsets), sockets=sockets)
    assert found.explained
    assert found.fits == (found.best.changes == 0) == ((order, signs, offsets) == (PLAIN, (1,) * 7, NONE))
    assert (found.best.order, found.best.signs) == (order, signs)
    np.testing.assert_allclose(found.best.offsets, offsets, rtol=0, atol=2.5 * DEG)
    assert found.best.rms_fitted < 0.3  # mm, as a calibration of these poses
    assert found.best.rms < 15
    assert found.fits or found.given.rms > 10 * found.best.rms
    # An arm without lateral offsets is its own mirror image: sockets alone cannot tell that.
    assert any(other.mirrored and other.signs[4] == -signs[4] for other in found.others)


@pytest.mark.slow
def test_an_order_that_nobody_makes(panda):
    arm, q, sockets = panda
    order, signs = (2, 4, 0, 3, 1, 6, 5), (1, -1, 1, 1, -1, 1, 1)
    found = check_readings(arm, recorded(q, order, signs, NONE), sockets=sockets)
    assert (found.best.order, found.best.signs, found.best.offsets) == (order, signs, NONE)


@pytest.fixture(scope="module")
def ur10(mukca):
    recording = aj.files.read_manifest(mukca.parent / "ipa_ur10" / "positions.toml")
    (one,) = recording.capture.observations
    rows = np.random.default_rng(0).permutation(one.q.shape[0])[:60]
    return recording.nominal.arm, np.asarray(one.q)[rows], np.asarray(one.points)[rows]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "signs", "offsets"),
    [
        pytest.param(range(6), (1,) * 6, (0,) * 6, marks=pytest.mark.slow),
        ((2, 1, 0, 3, 4, 5), (1, 1, 1, -1, 1, 1), (0,) * 6),
    ],
)
def test_a_tracker_at_an_unknown_place(ur10, few, order, signs, offsets):
    arm, q, points = ur10
    columns = recorded(q, order, signs, offsets)
    found = check_readings(arm, columns, positions=points, own_frame=True, free_tip=True)
    assert found.explained
    assert (found.best.order, found.best.signs, found.best.offsets) == (tuple(order), signs, offsets)
    assert found.best.rms_fitted < 0.6
    assert found.fits == (signs == (1,) * 6)


@pytest.mark.slow
def test_units(paper_arm, few):
    q = np.random.default_rng(2).uniform(-1.5, 1.5, (12, 6))
    positions = np.asarray(paper_arm.position(q))
    found = check_readings(paper_arm, q / DEG, positions=positions)
    assert found.best.angle == pytest.approx(DEG)
    assert found.best.changes == 1


@pytest.mark.slow
def test_units_of_readings_and_positions(paper_arm, few):
    q = np.random.default_rng(2).uniform(-1.5, 1.5, (12, 6))
    found = check_readings(paper_arm, q * DEG, positions=np.asarray(paper_arm.position(q)) / 1000)
    assert found.best.angle == pytest.approx(1 / DEG)
    assert (found.best.length, found.best.changes) == (1000.0, 2)


@pytest.mark.slow
def test_one_position_leaves_several_explanations_and_orientations_fewer(paper_arm, few):
    q = np.random.default_rng(5).uniform(-1.5, 1.5, (2, 6))
    poses = np.asarray(paper_arm.pose(q))
    columns = recorded(q, range(6), (1, 1, -1, 1, 1, 1), (0,) * 6)
    one = check_readings(paper_arm, columns[:1], positions=poses[:1, :3, 3])
    assert len(one.others) > 3
    two = check_readings(paper_arm, columns, positions=poses[:, :3, 3], rotations=poses[:, :3, :3])
    assert two.best.signs == (1, 1, -1, 1, 1, 1)
    assert len(two.others) < len(one.others)


@pytest.mark.slow
def test_a_wrist_that_is_flipped_is_the_same_arm(few):
    """Rz(q4 + pi) Ry(-q5) Rz(q6 + pi) = Rz(q4) Ry(q5) Rz(q6), so this explanation is no other one."""
    arm = aj.load_arm("iiwa14").replace(probe=(30, 0, 80))
    q = np.random.default_rng(1).uniform(-1, 1, (15, 7))
    found = check_readings(arm, recorded(q, PLAIN, (1, 1, 1, 1, 1, -1, 1), NONE), positions=np.asarray(arm.position(q)))
    assert (found.best.signs, found.best.offsets) == ((1, 1, 1, 1, 1, -1, 1), NONE)
    assert found.equal > 0
    assert all(other.rms > 50 for other in found.others)  # with another probe, perhaps: twice as far as its offset


@pytest.mark.slow
def test_readings_of_another_arm_are_not_explained(paper_arm, few):
    random = np.random.default_rng(0)
    q, sockets = random.uniform(-2, 2, (60, 6)), np.repeat([0, 1], 30)
    found = check_readings(paper_arm, q, sockets=sockets)
    assert not found.explained
    assert not found.fits
    assert found.others == ()


@pytest.mark.parametrize(
    ("q", "options", "part"),
    [
        (np.zeros((3, 5)), {"sockets": [0, 0, 0]}, "6 columns"),
        (np.zeros((3, 6)), {}, "either the sockets"),
        (np.zeros((3, 6)), {"sockets": [0, 0, 0], "positions": np.zeros((3, 3))}, "either the sockets"),
        (np.zeros((3, 6)), {"sockets": [0, 1]}, "each of 3 poses"),
        (np.zeros((3, 6)), {"sockets": [0, 1, 2]}, "no socket has two poses"),
        (np.full((3, 6), np.nan), {"sockets": [0, 0, 0]}, "finite"),
        (np.zeros((3, 6)), {"positions": np.zeros((2, 3))}, "positions has shape"),
        (np.zeros((3, 6)), {"positions": np.zeros((3, 3)), "own_frame": True}, "four positions"),
    ],
)
def test_refusals(paper_arm, q, options, part):
    with pytest.raises(aj.InputError, match=part):
        check_readings(paper_arm, q, **options)


@pytest.mark.parametrize(
    ("limits", "offset", "expected"),
    [
        (None, 1.5, -0.5),
        (None, -0.5, -0.5),
        ((-math.pi, math.pi), 1.5, -0.5),
        ((0.0, 2 * math.pi), -0.5, 1.5),
        ((-2 * math.pi, 2 * math.pi), 1.5, -0.5),
    ],
)
def test_the_turn_of_a_zero_keeps_readings_within_the_limits(paper_arm, limits, offset, expected):
    """Zeros in half turns."""
    arm = paper_arm if limits is None else paper_arm.replace(limits=(limits,) * 6)
    q = np.random.default_rng(0).uniform(0.6 * math.pi, 0.9 * math.pi, (5, 6))
    if limits == (0.0, 2 * math.pi):
        q = q - math.pi
    evidence = reading_search.Evidence(q, np.zeros(5, dtype=int), np.zeros((5, 3)))
    one = Explanation(PLAIN[:6], (1,) * 6, (0, 0, offset * math.pi, 0, 0, 0), 1.0, 1.0, 0.1, 0.1, 0)
    found = ReadingFit(arm, evidence, 1000.0, False).within_limits(one)
    assert found.offsets[2] == pytest.approx(expected * math.pi)


@pytest.mark.slow
def test_alternatives_leave_alone_a_joint_that_stands_still(paper_arm, few):
    q = np.random.default_rng(5).uniform(-1.5, 1.5, (6, 6))
    q[:, 4] = 0.4
    found = check_readings(paper_arm, q, positions=np.asarray(paper_arm.position(q)), own_frame=True)
    assert [(one.order, one.signs) for one in found.others] == [(PLAIN[:6], (-1, 1, 1, 1, 1, 1))]


@pytest.mark.slow
@pytest.mark.parametrize("own_frame", [True, False])
def test_servos_have_one_middle(few, own_frame):
    """Counts of servos whose middle, 2048 of 4096, was not stated: a zero common to all joints, within the limits."""
    arm, random = aj.load_arm("so100"), np.random.default_rng(2)
    low, high = np.asarray(arm.limits).T
    q = random.uniform(0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high, (40, 5))
    check = aj.diagnostics.check_readings(arm, q + np.pi, positions=np.array(arm.position(q)), own_frame=own_frame)
    assert np.allclose(check.best.offsets, -np.pi, atol=0.02)
    assert check.best.outside == 0
    assert not check.others
    assert explanation_words(check.best) == "the zeros of all joints are 180 deg off"
    assert angles_toml(check.best, "deg") == '[angles]\nunit = "deg"\noffset = [180, 180, 180, 180, 180]\n'

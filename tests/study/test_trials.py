"""Trials of a study: what is drawn is what was asked, depends on its key alone, and is identified as one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.units import ARCSEC
from aacmm_jax.study import configuration_pool, trial_simulation
from aacmm_jax.study.blocks import Block
from aacmm_jax.study.trials import run_block

from ..prismatic_arms import LINEAR_AXIS
from .small_study import CAPTURE, DEVIATION, NOISE, REFERENCE, made

AT_A_TIME = 64  # trials of one call: more are drawn by several, since another number would be compiled anew


def drawn(study: "aj.study.Study", count: int = AT_A_TIME, cell: int = 0) -> "aj.study.DrawnTrials":
    numbers = np.split(np.arange(count), range(AT_A_TIME, count, AT_A_TIME))
    parts = [aj.study.draw_trials(study, cell, part)[0] for part in numbers]
    return aj.study.DrawnTrials(*map(np.concatenate, zip(*parts, strict=True)))


def tips(study: "aj.study.Study", trials: "aj.study.DrawnTrials") -> np.ndarray:
    arms = jax.vmap(study.space.arm)(jnp.asarray(trials.true))
    return np.asarray(jax.vmap(lambda arm, q: arm.position(q))(arms, jnp.asarray(trials.q)))


def hayati() -> "aj.Arm":
    panda = aj.load_arm("panda")
    return aj.Arm(alpha=panda.alpha, a=panda.a, d=panda.d, theta=panda.theta, probe=panda.probe, beta=0.01 * np.ones(7))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "deviation"),
    [
        ("cheng2018-simulation", DEVIATION),
        ("cheng2018-simulation", {"length_mm": 10.0, "angle_deg": 1.0}),
        pytest.param("panda", DEVIATION, marks=pytest.mark.exhaustive),
        pytest.param(hayati(), DEVIATION, marks=pytest.mark.slow),
    ],
    ids=["paper", "far off", "panda", "beta"],
)
def test_without_noise_every_true_tip_is_at_its_point(arm, deviation):
    study = made(arm=arm, deviation=deviation, reference=REFERENCE | {"u_mm": 0.0})
    trials = drawn(study)
    found = tips(study, trials)
    assert np.abs(found[:, :12] - [400, 200, 300]).max() < 1e-8
    assert np.abs(found[:, 12:24] - [300, -300, 400]).max() < 1e-8
    ends = found[:, 24:].reshape(64, 2, 2, 3, 3)
    assert np.abs(np.ptp(ends, axis=3)).max() < 1e-8  # the poses of one end agree
    length = np.linalg.norm(ends[:, :, 0, 0] - ends[:, :, 1, 0], axis=-1)
    np.testing.assert_allclose(length, 300, atol=1e-8)
    np.testing.assert_allclose(trials.value, 300, atol=1e-8)
    assert np.ptp(trials.true, axis=0).min() > 0.5 * 2 * study.cell_values.width[0].min()


@pytest.mark.slow
def test_true_tips_of_an_arm_on_a_linear_axis_are_at_their_points():
    """The true arm's slide, twists and angles of the slide are others; readings stay near the limits of the arm."""
    points = [[500, 200, 300], [-300, 500, 800]]
    study = made(
        arm=LINEAR_AXIS,
        deviation=DEVIATION,
        reference=None,
        capture={"positions_mm": [points], "poses": 6, "pool": 4096},
    )
    trials = drawn(study)
    found = tips(study, trials).reshape(64, 2, 6, 3)
    assert np.abs(found - np.array(points)[None, :, None]).max() < 1e-8
    low, high = np.array(LINEAR_AXIS.limits).T
    assert np.all((trials.q > low - 10) & (trials.q < high + 10))
    assert np.ptp(trials.q[..., 0]) > 500


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "spread"), [({"linear_encoder_mm": 0.05}, 0.05), ({"encoder_arcsec": 10.0}, 1e4 * np.pi / 648_000)]
)
def test_slides_have_noise_of_their_own(noise, spread):
    """In mm, or what the other encoders have at 1 m."""
    given = {"arm": LINEAR_AXIS, "reference": None, "deviation": None}
    given["capture"] = {"positions_mm": [[[500, 200, 300]]], "poses": 40, "pool": 4096}
    exact, noisy = (drawn(made(**given, noise=of)).q[..., 0] for of in (None, noise))
    assert np.std(noisy - exact) == pytest.approx(spread, rel=0.05)


@pytest.mark.slow
def test_no_pose_twice_and_all_within_the_limits():
    limits = [[-170, 170], [-100, 100], [-150, 150], [-120, 120], [-170, 170], [-90, 90]]
    q = drawn(made(capture=CAPTURE | {"joint_limits_deg": limits}, deviation=None)).q
    for trial in q:
        assert len(np.unique(trial.round(9), axis=0)) == trial.shape[0]
    low, high = np.radians(limits).T
    assert (q >= low).all()
    assert (q <= high).all()
    # Trials of different batches share no pose.
    first, second = ({tuple(pose) for t in range(batch, 64, 32) for pose in q[t].round(9)} for batch in (0, 1))
    assert not first & second


@pytest.mark.slow
def test_no_row_of_the_pool_is_chosen_twice():
    """Most of a small pool: 70 of the 128 poses of each part."""
    static = trial_simulation._Static(((0, 1, 1, 128, 70),), (), (), False, None, False, False)
    keys = jax.random.split(jax.random.key(0), trial_simulation._WIDTH)
    for first in (0, 16):
        trials = first + jnp.arange(trial_simulation._WIDTH)
        for trial, rows in zip(
            trials.tolist(), np.asarray(trial_simulation._chosen(static, keys, trials)), strict=True
        ):
            assert len(set(rows)) == 70
            assert set(rows // 128) == {trial % 32}


@pytest.mark.slow
def test_deviations_have_their_distributions():
    study = made(deviation={"length_mm": 1.0, "d_mm": {"normal": 0.3}, "angle_deg": 0.1, "theta_deg": 0.0})
    trials = drawn(study, 2048)
    off = (trials.true - np.asarray(study.space.vector())) / np.where(study.space.lengths, 1.0, np.pi / 180)
    kinds = {
        kind: off[:, [n.startswith(kind + "_") for n in study.space.names]] for kind in ("a", "d", "alpha", "theta")
    }
    assert 0.99 < np.abs(kinds["a"]).max() <= 1
    assert kinds["a"].std() == pytest.approx(1 / 3**0.5, rel=0.02)
    assert kinds["d"].std() == pytest.approx(0.3, rel=0.02)
    assert np.abs(kinds["d"]).max() > 0.9
    assert kinds["alpha"].std() == pytest.approx(0.1 / 3**0.5, rel=0.02)
    np.testing.assert_array_equal(kinds["theta"], 0)
    correlation = np.corrcoef(off[:, :15].T)
    assert np.abs(correlation - np.eye(15)).max() < 0.08


@pytest.mark.slow
@pytest.mark.parametrize(
    "part",
    ["encoder_arcsec", "seating_mm", "resolution_arcsec", pytest.param("eccentricity_arcsec", marks=pytest.mark.slow)],
)
def test_noise_is_what_was_asked(part):
    """The same keys with and without one part of the noise differ by that part."""
    level = {"encoder_arcsec": 2.0, "seating_mm": 0.005, "resolution_arcsec": 20.0, "eccentricity_arcsec": 5.0}[part]
    without, with_it = (made(deviation=DEVIATION, noise={part: value}) for value in (0.0, level))
    exact, noisy = drawn(without), drawn(with_it)
    np.testing.assert_array_equal(exact.true, noisy.true)
    change = noisy.q - exact.q
    if part == "encoder_arcsec":
        assert change.std() == pytest.approx(2 * ARCSEC, rel=0.03)
    elif part == "seating_mm":
        moved = tips(with_it, noisy) - tips(without, exact)
        assert moved.std() == pytest.approx(0.005, rel=0.03)
    elif part == "resolution_arcsec":
        step = 20 * ARCSEC
        np.testing.assert_allclose(noisy.q / step, np.round(noisy.q / step), atol=1e-6)
        assert np.abs(change).max() <= step / 2 * 1.001
    else:
        # A first harmonic, its two parts the same in all readings of one joint in one trial.
        parts = []
        for trial, moved in zip(exact.q[:16], change[:16], strict=True):
            for joint in range(6):
                harmonics = np.stack([np.sin(trial[:, joint]), np.cos(trial[:, joint])], axis=1)
                found, left, *_ = np.linalg.lstsq(harmonics, moved[:, joint])
                assert left[0] < 1e-24
                parts.append(found)
        assert np.std(parts) == pytest.approx(5 * ARCSEC, rel=0.2)


@pytest.mark.slow
def test_reference_lengths_err_by_their_u():
    study = made(reference=REFERENCE)
    trials = drawn(study, 1024)
    assert (trials.value - 300).std() == pytest.approx(0.01, rel=0.05)
    np.testing.assert_array_equal(trials.u, 0.01)


@pytest.mark.slow
def test_starts_at_random_fill_the_box():
    study = made(identification={"start": "random", "hold": "none"}, bounds={"length_mm": 2.0, "length_shift_mm": 1.0})
    trials = drawn(study, 1024)
    share = (trials.start - trials.lower) / (trials.upper - trials.lower)
    assert share.min() >= 0
    assert share.max() <= 1
    assert share.mean() == pytest.approx(0.5, abs=0.01)
    d_3 = study.space.index("d_3")
    assert (trials.lower[0, d_3], trials.upper[0, d_3]) == (749.0, 753.0)
    held = drawn(made(identification={"start": "random"}))
    assert np.ptp(held.start, axis=0)[d_3] == 0
    assert np.delete(np.ptp(held.start, axis=0), d_3).min() > 0


@pytest.mark.slow
def test_a_recording_gives_its_poses(noisy_capture):
    study = made(arm=aj.load_arm("cheng2018-simulation"), capture=noisy_capture, reference=None)
    trials = drawn(study, 20)
    assert np.abs(trials.q - np.asarray(noisy_capture.q)).max() < 0.03
    centres = tips(study, trials)[:, :70].mean(axis=1)
    assert np.ptp(centres, axis=0).max() < 1e-8
    np.testing.assert_array_equal(trials.u, 0.002)


STUDIES = {
    "two-stage": {"method": "two-stage"},
    "joint": {"method": "joint"},
    "stage1": {"method": "stage1", "hold": "none"},
}


@pytest.fixture(
    scope="module",
    params=[
        ("two-stage", 8),
        pytest.param(("joint", 8), marks=pytest.mark.slow),
        pytest.param(("stage1", 8), marks=pytest.mark.exhaustive),
        pytest.param(("two-stage", 40), marks=pytest.mark.exhaustive),  # another size of program
    ],
    ids=str,
)
def whole(request):
    method, count = request.param
    tables = {"noise": NOISE, "bounds": {"length_mm": [3, 10]}, "identification": STUDIES[method]}
    if method == "stage1":
        tables["reference"] = None
    study = made(**tables)
    return study, count, run_block(study, Block(0, 2, 0, count))


@pytest.mark.slow
@pytest.mark.optimised
def test_equals_one_by_one(whole):
    study, _, results = whole
    method = study.settings[0].method
    trials = drawn(study, 3, cell=1)
    names, sizes = [], study.settings[1].sizes
    names = [f"s{i}" for i in range(len(sizes))]
    for i in range(3):
        sockets = dict(zip(names, np.split(trials.q[i], np.cumsum(sizes)[:-1]), strict=True))
        pairs = trial_simulation.ends_of(study, study.settings[1])
        lengths = [
            aj.ReferenceLength(names[a], names[b], value, u)
            for (a, b), value, u in zip(pairs, trials.value[i], trials.u[i], strict=True)
        ]
        bounds = aj.Bounds(study.space, trials.lower[i], trials.upper[i])
        capture = aj.Capture(sockets, lengths)
        hold = study.settings[1].hold
        if method == "stage1":
            alone = aj.identify(study.nominal.arm, capture, bounds, hold=hold)
            figures = {"de_stage1": alone.de, "deltam_stage1": alone.deltam, "estimate": alone.parameters}
        else:
            alone = aj.calibrate(study.nominal.arm, capture, bounds, method=method, hold=hold)
            figures = {"de": alone.de, "deltam": alone.deltam, "k": alone.scale.value, "estimate": alone.parameters}
        for name, value in figures.items():
            np.testing.assert_allclose(results[name][1, i], value, rtol=1e-8, atol=1e-7)
        np.testing.assert_array_equal(results["active"][1, i], alone.active)
        np.testing.assert_array_equal(results["true"][1, i], trials.true[i])
        error = np.abs(np.asarray(alone.parameters) - trials.true[i])[study.space.lengths].max()
        there = "length_error_stage1" if method == "stage1" else "length_error"
        assert results[there][1, i] == pytest.approx(error, abs=1e-7)


@pytest.mark.slow
@pytest.mark.optimised
def test_a_trial_depends_on_its_key_alone(whole):
    """To the bit, whatever block a trial is in."""
    study, count, results = whole
    for block in (Block(1, 2, 0, count), Block(0, 1, 3, 7), Block(1, 2, count - 1, count)):
        part = run_block(study, block, device=jax.local_devices()[0])
        for name, values in part.items():
            cells, trials = slice(block.first_cell, block.last_cell), slice(block.first_trial, block.last_trial)
            np.testing.assert_array_equal(values, results[name][cells, trials])


def test_trials_are_drawn_one_by_one():
    study = made(noise=NOISE, bounds={"length_mm": [3, 10]})
    all_, (some, captures) = drawn(study, cell=1), aj.study.draw_trials(study, 1, [5, 2])
    jax.tree.map(lambda one, other: np.testing.assert_array_equal(one, other[[5, 2]]), some, all_)
    np.testing.assert_array_equal(captures.q, some.q)
    np.testing.assert_array_equal(captures.lengths[0].value, some.value[:, 0])
    np.testing.assert_array_equal(captures.lengths[0].u, some.u[:, 0])
    with pytest.raises(aj.InputError, match=r"cell is -1, but the study has \d+ cells"):
        aj.study.draw_trials(study, -1, [0])


@pytest.mark.slow
def test_pools_are_the_same_in_every_study_of_a_seed(pools_built_once, monkeypatch):
    monkeypatch.setattr(configuration_pool, "_fixture_table", pools_built_once)
    one_socket = {"capture": CAPTURE | {"positions_mm": [[400, 200, 300]]}, "reference": None}
    one, two, other = (
        configuration_pool.pool_of(study, study.settings[0])[0]
        for study in (made(**one_socket, noise={}), made(**one_socket, noise=NOISE), made(**one_socket, seed=4))
    )
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)

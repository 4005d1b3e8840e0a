"""Uncertainties against independent ways to them: derivatives of whole calibrations, dense least squares, simulated
trials."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import aacmm_jax as aj
from aacmm_jax.calibration.stages import identified, in_two_stages, jointly
from aacmm_jax.calibration.task import Solving, task_of, without_lengths
from aacmm_jax.core.linear_algebra import inverse_cholesky
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.core.units import ARCSEC
from aacmm_jax.data.noise import tip_covariances
from aacmm_jax.kinematics.chain import joint_motion
from aacmm_jax.kinematics.inverse_kinematics import project_to_centroids

NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
UNEVEN = aj.Noise(encoder_arcsec=[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], seating=0.003)
SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, 500, 100)}


@pytest.fixture(scope="module")
def space(paper_arm) -> aj.Parameters:
    return aj.Parameters.free_of(paper_arm)


@pytest.fixture(scope="module")
def bounds(paper_arm, space) -> aj.Bounds:
    return aj.Bounds.around(paper_arm, space)


@pytest.fixture(scope="module")
def capture(paper_arm) -> aj.Capture:
    """Three sockets, two lengths that share one, noise that differs from pose to pose."""
    pairs = [("A", "B", 0.002), ("B", "C", 0.004)]
    poses = {"A": 30, "B": 5, "C": 8}
    return aj.simulate(paper_arm, SOCKETS, poses=poses, lengths=pairs, encoder_arcsec=2.0, seating=0.005, seed=5)


@pytest.fixture(scope="module")
def result(paper_arm, capture, bounds) -> aj.Calibration:
    return aj.calibrate(paper_arm, capture, bounds, method="joint", noise=NOISE, shared_errors=False)


@pytest.mark.slow
def test_small_inverse_roots_are_those_of_cholesky():
    random = np.random.default_rng(0)
    for size in (1, 2, 3):
        factors = random.normal(size=(50, size, size))
        matrices = factors @ np.swapaxes(factors, 1, 2) + 0.1 * np.eye(size)
        expected = np.linalg.inv(np.linalg.cholesky(matrices))
        np.testing.assert_allclose(inverse_cholesky(matrices), expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(inverse_cholesky(jnp.asarray(matrices)), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_weighted_solve_is_the_dense_generalised_least_squares(paper_arm, space, bounds, capture, result):
    """At the solution the gradient of the textbook's objective, sockets as unknowns, is zero; its curvature is the
    covariance."""
    noise = tip_covariances(result.stage1.arm.geometry, joint_motion(paper_arm.geometry, capture.q), NOISE)
    inverse = jnp.linalg.inv(jnp.moveaxis(noise, -1, 0))
    ends = capture.ends()

    def objective(both):
        vector, points = both[:21] * space.scale, both[21:].reshape(3, 3)
        gap = space.arm(vector).position(capture.q) - points[capture.owner]
        measured = jnp.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=-1)
        nominal = jnp.stack([length.value for length in capture.lengths])
        u = jnp.stack([length.u for length in capture.lengths])
        return 0.5 * jnp.einsum("Na,Nab,Nb->", gap, inverse, gap) + 0.5 * jnp.sum(((measured - nominal) / u) ** 2)

    # The sockets' positions that belong to the solution, by Newton's method on them alone.
    vector = result.parameters / space.scale
    start = jnp.concatenate([vector, aj.evaluate(result.arm, capture).repeatability.centroids.ravel()])
    derivatives = jax.jit(lambda point: (jax.grad(objective)(point), jax.hessian(objective)(point)))
    for _ in range(3):
        slope, curve = derivatives(start)
        start = start.at[21:].add(-jnp.linalg.solve(curve[21:, 21:], slope[21:]))
    slope, curve = map(np.asarray, derivatives(start))
    step = np.linalg.solve(curve, slope)
    covariance = np.linalg.inv(curve)[:21, :21] * np.outer(space.scale, space.scale)
    u = np.sqrt(np.diag(covariance))
    assert np.abs(step[:21] * np.asarray(space.scale) / u).max() < 1e-3  # weights of the start, and lengths linearised
    np.testing.assert_allclose(np.sqrt(np.diag(result.covariance)), u, rtol=5e-3)
    np.testing.assert_allclose(result.covariance / np.outer(u, u), covariance / np.outer(u, u), atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "noise"),
    [pytest.param("two-stage", None, id="even"), pytest.param("joint", UNEVEN, id="weighted", marks=pytest.mark.slow)],
)
def test_sensitivities_are_derivatives_of_the_whole_calibration(paper_arm, space, bounds, method, noise):
    """What the propagation says of readings is what central differences of whole calibrations say."""
    pairs, poses = [("A", "B", 0.002), ("B", "C", 0.004)], {"A": 30, "B": 5, "C": 8}
    capture = aj.simulate(paper_arm, SOCKETS, poses=poses, lengths=pairs, encoder_arcsec=0.1, seating=0.0002, seed=5)
    random, step = np.random.default_rng(2), 1e-6
    q, values = np.asarray(capture.q), np.array([float(length.value) for length in capture.lengths])
    turns = random.normal(size=(6, *q.shape))

    def parameters(q, values):
        blocks = {name: q[capture.owner == j] for j, name in enumerate(capture.names)}
        lengths = [
            aj.ReferenceLength(length.start, length.end, value, length.u)
            for length, value in zip(capture.lengths, values, strict=True)
        ]
        moved = aj.Capture(blocks, lengths)
        return aj.calibrate(paper_arm, moved, bounds, method=method, noise=noise, undetermined="ignore").parameters

    slopes = np.stack([parameters(q + step * turn, values) - parameters(q - step * turn, values) for turn in turns]) / (
        2 * step
    )
    found = aj.calibrate(paper_arm, capture, bounds, method=method, noise=noise)
    # With arrays of NumPy, which compiles nothing; tests/core/test_numpy_or_jax.py has both libraries.
    found, arm, space, capture, noise = to_numpy((found, paper_arm, space, capture, noise))
    solving = Solving(noise=noise)
    first = to_numpy(task_of(arm, without_lengths(capture), bounds, solving))
    stage1 = identified(first, capture)
    if method == "joint":
        whole = jointly(to_numpy(task_of(arm, capture, bounds, solving)), capture, stage1, "joint")
    else:
        whole = in_two_stages(stage1, capture)
    follow = whole.sensitivities()
    mine = np.einsum("pnN,tNn->tp", follow.joints, turns)
    # They differ only as residuals turn with the parameters: by 4 % with the noise of a real arm, which here is a
    # twentieth.
    assert np.abs((mine - slopes) / np.abs(slopes).max(axis=0)).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("method", [pytest.param("two-stage", marks=pytest.mark.exhaustive), "joint"])
def test_many_weighted_calibrations_equal_single_ones(paper_arm, bounds, capture, method):
    shifts = 1e-6 * np.random.default_rng(0).normal(size=(3, *capture.q.shape))
    readings = np.asarray(capture.q) + shifts
    values = np.tile([float(length.value) for length in capture.lengths], (3, 1))
    captures = aj.calibration.batch_of_captures(capture, readings, values)
    many = aj.calibrate_many(paper_arm, captures, bounds, method=method, noise=UNEVEN)
    for i, q in enumerate(readings):
        blocks = {name: q[capture.owner == j] for j, name in enumerate(capture.names)}
        one = aj.calibrate(paper_arm, aj.Capture(blocks, capture.lengths), bounds, method=method, noise=UNEVEN)
        np.testing.assert_allclose(many.parameters[i], one.parameters, atol=1e-10)
        assert many.k[i] == pytest.approx(float(one.scale.value), abs=1e-13)


# Least share of the worst parameter; a share of 95 % of 400 scatters by 1.1 %: 3.8 of it for the worst of 21.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("trials", "noise", "noise_model", "least", "most"),
    [
        (12, None, "estimated", 0.55, 1.0),
        pytest.param(50, None, "estimated", 0.82, 1.0, marks=pytest.mark.slow),
        pytest.param(400, None, "estimated", 0.91, 1.0, marks=pytest.mark.exhaustive),
        pytest.param(400, NOISE, "given", 0.91, 1.0, marks=pytest.mark.exhaustive),
        pytest.param(400, None, "common", 0.0, 0.91, marks=pytest.mark.exhaustive),
        pytest.param(400, None, "robust", 0.92, 1.0, marks=pytest.mark.exhaustive),
    ],
    ids=["handful-estimated", "few-estimated", "estimated", "given", "common", "robust"],
)
def test_coverage(paper_arm, space, bounds, trials, noise, noise_model, least, most):
    """Simulated calibrations: 95 % intervals of noise given, or estimated from the residuals, hold the truth; a
    common variance does not (86 % for some), which is why it is not the default. The 10,000 trials of
    benchmarks/uncertainty.py are the sharp version."""
    pairs, poses = [("A", "B", 0.0)], {"A": 70, "B": 10}
    sockets = {"A": (400, 200, 300), "B": (700, 500, 500)}
    exact = aj.simulate(paper_arm, sockets, poses=poses, lengths=pairs, seed=2)
    moves = np.linalg.pinv(np.asarray(paper_arm.jacobian(exact.q, [f"q_{i}" for i in range(1, 7)])))
    random = np.random.default_rng(4)
    seats = 0.005 * random.normal(size=(trials, 80, 3))
    readings = (
        np.asarray(exact.q) + np.einsum("Nic,tNc->tNi", moves, seats) + 2 * ARCSEC * random.normal(size=(trials, 80, 6))
    )
    values = float(exact.lengths[0].value) + 0.002 * random.normal(size=trials)

    def covered(q, value):
        capture = aj.Capture({"A": q[:70], "B": q[70:]}, [aj.ReferenceLength("A", "B", value, 0.002)])
        options = {"noise": noise, "noise_model": noise_model, "undetermined": "ignore"}
        found = aj.calibrate(paper_arm, capture, bounds, **options)
        return np.abs(found.parameters - space.vector()) <= 1.97 * np.sqrt(np.diag(found.covariance))

    share = np.mean([covered(*row) for row in zip(readings, values, strict=True)], axis=0)
    assert least < share.min() <= most, dict(zip(space.names, share, strict=True))
    if noise_model in ("given", "estimated"):
        width = 0.015 * math.sqrt(400 / trials)
        assert 0.953 - width < share.mean() < 0.953 + width


@pytest.mark.slow
def test_tips_and_lengths(paper_arm, space, result):
    """Covariances of functions are those of their derivatives, found by JAX without the package's formulas."""
    uncertainty = aj.uncertainty_of(result)
    q = np.random.default_rng(0).uniform(-2, 2, (2, 6))
    slopes = jax.jacfwd(lambda v: space.arm(v).position(q))(result.parameters)
    expected = slopes[0] @ result.covariance @ slopes[0].T
    np.testing.assert_allclose(uncertainty.tip(q)[0], expected, rtol=1e-9)
    reading = np.asarray(paper_arm.jacobian(q, [f"q_{i}" for i in range(1, 7)])) * 2 * ARCSEC
    more = np.asarray(uncertainty.tip(q, reading=True) - uncertainty.tip(q))
    np.testing.assert_allclose(more, reading @ np.swapaxes(reading, 1, 2) + 25e-6 * np.eye(3), rtol=2e-3, atol=1e-8)
    along = jax.grad(lambda v: jnp.linalg.norm(space.arm(v).position(q[0]) - space.arm(v).position(q[1])))(
        result.parameters
    )
    assert float(uncertainty.length(q[0], q[1])) == pytest.approx(float(jnp.sqrt(along @ result.covariance @ along)))
    assert float(uncertainty.length(q[0], q[1], reading=True)) > float(uncertainty.length(q[0], q[1]))


@pytest.mark.slow
def test_over_the_volume(result):
    uncertainty = aj.uncertainty_of(result)
    volume = aj.volumetric_uncertainty(uncertainty, points=50, length=250.0)
    np.testing.assert_allclose(
        np.linalg.norm(volume.start - volume.end, axis=1), 250, atol=0.5
    )  # by an arm beside the nominal
    np.testing.assert_allclose(volume.u_length, uncertainty.length(volume.q, volume.q_end), rtol=1e-9)
    assert volume.summary["u_length_largest_mm"] == volume.u_length.max()
    for wrong in ({"length": 1e5}, {"length": -1.0}, {"points": 0}):
        with pytest.raises(aj.InputError):
            aj.volumetric_uncertainty(uncertainty, **wrong)


@pytest.mark.slow
def test_near_poses_lengths_begin_and_end_near_to_them(result, capture):
    """A and B are 200 mm apart: lengths of 210 mm between them end 10 mm from a pose."""
    uncertainty, q = aj.uncertainty_of(result), np.asarray(capture.q)
    volume = aj.volumetric_uncertainty(uncertainty, points=80, length=210.0, near=q)
    assert len(volume.u_length) == 80
    np.testing.assert_allclose(np.linalg.norm(volume.end - volume.start, axis=1), 210, atol=0.5)
    positions = np.array(list(SOCKETS.values()))
    for tips, most in ((volume.start, 2), (volume.end, 12)):
        assert np.linalg.norm(tips[:, None] - positions, axis=2).min(axis=1).max() < most
    everywhere = aj.volumetric_uncertainty(uncertainty, points=80, length=210.0)
    assert np.median(volume.u_length) < np.median(everywhere.u_length)
    with pytest.raises(aj.InputError, match="hardly any two of these poses"):
        aj.volumetric_uncertainty(uncertainty, length=210.0, near=capture.sockets["A"])


@pytest.mark.slow
def test_what_is_open_has_no_uncertainty(paper_arm, capture):
    """With alpha_6 and d_6 both free neither is determined; the tip is, and so are lengths. Without a length the scale
    is open."""
    free = aj.Parameters.free_of(paper_arm, held=("d_1", "theta_1", "a_6", "probe_x", "probe_y"))
    identified = aj.identify(paper_arm, capture, aj.Bounds.around(paper_arm, free), hold="d_3", noise=NOISE)
    uncertainty = aj.uncertainty_of(identified)
    u = dict(zip(uncertainty.names, np.asarray(uncertainty.u), strict=True))
    assert {name for name, value in u.items() if np.isinf(value)} == {"alpha_6", "d_6"}
    q = np.random.default_rng(0).uniform(-2, 2, (2, 5, 6))
    assert np.all(np.isfinite(uncertainty.length(q[0], q[1])))
    poses = aj.Capture({"A": capture.q[:30]})
    loose = aj.uncertainty_of(aj.identify(paper_arm, poses, aj.Bounds.around(paper_arm, free), hold=None, noise=NOISE))
    active = np.asarray(loose.covariance).diagonal() == 0
    assert np.all(np.isinf(loose.length(q[0], q[1]))) or active.any()  # a bound stops the slide, or the scale is open


def test_intervals_and_correlations(result):
    given = aj.uncertainty_of(result)
    np.testing.assert_allclose(given.factor(0.95), 1.959964, atol=1e-6)
    table = np.asarray(given.correlation)
    np.testing.assert_allclose(np.diag(table), 1.0)
    (one, other, r), *rest = given.correlated(0.5)
    assert abs(r) == pytest.approx(np.abs(table - np.eye(21)).max())
    assert all(abs(r) >= abs(pair[2]) >= 0.5 for pair in rest)
    assert one != other
    with pytest.raises(aj.InputError, match="level is 95"):
        given.factor(95)


@pytest.mark.slow
def test_degrees_of_freedom_follow_the_noise_model(paper_arm, capture, bounds):
    """43 poses in three sockets give 120 equations, less the 20 that stage 1 fits."""
    for noise_model, expected in (("estimated", 100), ("common", 100), ("robust", 40 - 20 / 3)):
        uncertainty = aj.uncertainty_of(aj.calibrate(paper_arm, capture, bounds, noise_model=noise_model))
        assert uncertainty.scatter_degrees_of_freedom == pytest.approx(expected)
        angle = uncertainty.names.index("theta_3")
        assert uncertainty.factor(0.95)[angle] == pytest.approx(stats.t.ppf(0.975, expected), rel=1e-4)
        # Two lengths that disagree by more than predicted set the scale, and a single difference says by how much.
        assert uncertainty.degrees_of_freedom.min() < 0.5 * expected


@pytest.mark.slow
def test_estimated_noise_is_that_of_the_simulation(paper_arm, bounds):
    """Over 30 captures: encoders of 4 arcsec and a seat of 10 um, from the residuals alone."""
    found = []
    for seed in range(30):
        noisy = aj.simulate(
            paper_arm, {"A": (400, 200, 300)}, poses=70, encoder_arcsec=4.0, seating=0.010, seed=seed
        )  # fmt: skip
        noise = aj.identify(paper_arm, noisy, bounds).noise
        found.append([float(noise.encoder_arcsec) ** 2, float(noise.seating) ** 2])
    mean, error = np.mean(found, axis=0), np.std(found, axis=0) / np.sqrt(30)
    # One that would be negative is cut off at 0, which lifts the means a little.
    assert np.all(np.abs(mean - [16.0, 1e-4]) < 4 * error)


@pytest.mark.slow
def test_reduced_chi_shows_that_the_noise_is_wrong(paper_arm, capture, bounds):
    right = aj.calibrate(paper_arm, capture, bounds, noise=NOISE)
    wrong = aj.calibrate(paper_arm, capture, bounds, noise=aj.Noise(encoder_arcsec=1.0, seating=0.0025))
    assert 0.85 < float(right.stage1.reduced_chi) < 1.15
    assert float(wrong.stage1.reduced_chi) == pytest.approx(2 * float(right.stage1.reduced_chi), rel=1e-3)
    assert aj.calibrate(paper_arm, capture, bounds).stage1.reduced_chi is None


def test_projected_poses_meet_in_their_sockets(paper_arm, capture):
    tips = np.asarray(paper_arm.position(project_to_centroids(paper_arm, capture)))
    for i in range(3):
        assert np.ptp(tips[capture.owner == i], axis=0).max() < 1e-6


REFUSED = {
    "negative": (lambda arm, capture, bounds: aj.Noise(encoder_arcsec=-1), "zero or positive"),
    "not finite": (lambda arm, capture, bounds: aj.Noise(seating=np.inf), "finite numbers"),
    "nothing": (
        lambda arm, capture, bounds: aj.calibrate(arm, capture, bounds, noise=aj.Noise()),
        "every standard deviation of the noise is zero",
    ),
    "another unit": (
        lambda arm, capture, bounds: aj.identify(arm, capture, bounds, noise=aj.Noise(encoder_arcsec=1e5)),
        "in another unit",
    ),
    "joints": (
        lambda arm, capture, bounds: aj.identify(arm, capture, bounds, noise=aj.Noise(encoder_arcsec=[1, 2])),
        "2 values, but the arm has 6 joints",
    ),
    "given without": (
        lambda arm, capture, bounds: aj.identify(arm, capture, bounds, noise_model="given"),
        "needs the noise",
    ),
    "estimated with": (
        lambda arm, capture, bounds: aj.identify(arm, capture, bounds, noise=NOISE, noise_model="estimated"),
        "cannot be combined with a given noise",
    ),
}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("case", REFUSED)
def test_refused(paper_arm, capture, bounds, case):
    ask, text = REFUSED[case]
    with pytest.raises(aj.InputError, match=text):
        ask(paper_arm, capture, bounds)


@pytest.mark.slow
def test_the_working_volume_has_the_u_of_its_lengths(result):
    """One by one, with the coverage factor of each."""
    uncertainty = aj.uncertainty_of(result)
    volume = aj.volumetric_uncertainty(uncertainty, points=5, length=200.0)
    lengths = uncertainty.expanded_length(volume.q, volume.q_end)
    np.testing.assert_allclose(volume.expanded_length, lengths, rtol=1e-9)

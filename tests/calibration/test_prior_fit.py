"""Calibrations with a prior: the product of two Gaussians, its limits, what is learned, coverage, exact derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration import record_of, sampling
from aacmm_jax.calibration.prior_fit import Rounds
from aacmm_jax.data import observations as kinds
from aacmm_jax.summaries.calibration import calibration_summary, prior_sentence

NOISE = aj.Noise(encoder_arcsec=10, seating=0.02)
POINTS = {"A": (400, 200, 300), "B": (500, 300, 100)}
LENGTH = ("A", "B", 0.002)
BOX = [[200, -300, 100], [600, 300, 500]]
MAKER = aj.Prior({"lengths": 0.3, "angles": 5e-4})


@pytest.fixture(scope="module")
def space(paper_arm):
    return aj.Parameters.independent(paper_arm)


@pytest.fixture(scope="module")
def bounds(paper_arm, space):
    return aj.Bounds.around(paper_arm, space)


@pytest.fixture(scope="module")
def true(space):
    return aj.perturbed_arm(space, length=0.3, angle=5e-4, seed=1)


@pytest.fixture(scope="module")
def capture(true):
    return aj.simulate(true, POINTS, poses=12, lengths=[LENGTH], noise=NOISE)


def calibrate(arm, capture, bounds, **options):
    """Without what tests of the residuals change: solves that agree to rounding may lie on either side of a level."""
    unchanged = {"undetermined": "ignore", "replace_noise": False, "shared_errors": False}
    return aj.calibrate(arm, capture, bounds, **unchanged | options)


def u_of(result):
    return np.sqrt(np.diag(result.covariance))


def test_posterior_is_the_product_of_both_gaussians(paper_arm, space, bounds, capture):
    """Near its minimum the least squares is linear: information adds, and means are weighted by it."""
    plain = calibrate(paper_arm, capture, bounds, noise=NOISE, method="joint")
    start = np.asarray(plain.parameters)
    shift = 1e-3 * u_of(plain) * np.random.default_rng(0).standard_normal(len(start))
    prior = aj.Prior(
        {"lengths": 0.01, "angles": 2e-5},
        mean={name: value for name, value in zip(space.names, (start + shift).tolist(), strict=True)},
    )
    found = calibrate(plain.arm, capture, bounds, noise=NOISE, prior=prior)
    data, known = np.linalg.inv(plain.covariance), np.diag(1 / np.where(space.lengths, 0.01, 2e-5) ** 2)
    expected = np.linalg.inv(data + known)
    np.testing.assert_allclose(u_of(found), np.sqrt(np.diag(expected)), rtol=1e-3)
    step = expected @ known @ shift
    np.testing.assert_allclose((found.parameters - start) / u_of(found), step / u_of(found), atol=1e-5)
    effective = np.diag(expected @ data)
    np.testing.assert_allclose(
        found.prior.effective, [effective[space.lengths].sum(), effective[~space.lengths].sum()], rtol=1e-3
    )


@pytest.mark.slow
def test_infinite_standard_deviations_are_no_prior(paper_arm, bounds, true):
    points = [kinds.SimulatedPoints("T", BOX, 40, (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), u=0.01)]
    capture = aj.simulate(true, {}, observations=points, noise=NOISE, seed=3)
    plain = calibrate(paper_arm, capture, bounds)
    same = calibrate(paper_arm, capture, bounds, prior=aj.Prior({"all": np.inf}))
    np.testing.assert_allclose(same.parameters, plain.parameters, rtol=1e-12)
    assert same.prior is None
    # And a very wide one is nearly none; the sockets' solve without a prior is another one.
    wide = calibrate(paper_arm, capture, bounds, prior=aj.Prior({"lengths": 1e5, "angles": 1e3}))
    np.testing.assert_allclose((wide.parameters - plain.parameters) / u_of(plain), 0.0, atol=1e-4)
    np.testing.assert_allclose(u_of(wide), u_of(plain), rtol=1e-4)


@pytest.mark.slow
def test_joint_solve_of_sockets_is_met(paper_arm, bounds, capture):
    plain = calibrate(paper_arm, capture, bounds, method="joint")
    wide = calibrate(paper_arm, capture, bounds, prior=aj.Prior({"lengths": 1e5, "angles": 1e3}))
    np.testing.assert_allclose((wide.parameters - plain.parameters) / u_of(plain), 0.0, atol=1e-6)
    assert wide.degrees_of_freedom == pytest.approx(plain.degrees_of_freedom, abs=1e-3)


@pytest.mark.slow
def test_a_tight_prior_fixes_a_parameter(paper_arm, space, bounds, capture):
    rest = aj.Parameters(paper_arm, tuple(name for name in space.names if not name.startswith("alpha_")))
    fixed = calibrate(paper_arm, capture, aj.Bounds.around(paper_arm, rest), method="joint")
    tight = calibrate(paper_arm, capture, bounds, prior=aj.Prior({"alpha": 1e-9}))
    index = [space.names.index(name) for name in rest.names]
    np.testing.assert_allclose((tight.parameters[np.array(index)] - fixed.parameters) / u_of(fixed), 0.0, atol=1e-4)
    np.testing.assert_allclose(u_of(tight)[index], u_of(fixed), rtol=1e-4)
    assert tight.prior.effective[0] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.slow
def test_stage_one(paper_arm, space, bounds, capture):
    """The scale anchor stays; without one, the prior of lengths sets the scale."""
    held = aj.identify(paper_arm, capture, bounds, prior=MAKER)
    i = space.names.index(held.hold)
    assert held.parameters[i] == space.vector()[i]
    assert held.prior.parameters == (10, 10)
    free = aj.identify(paper_arm, capture, bounds, prior=MAKER, hold=None)
    assert free.converged
    assert np.all(u_of(free)[space.lengths] < 0.3)
    assert not free.active_names()


def test_bounds_still_hold(paper_arm, space, capture):
    bounds = aj.Bounds.around(paper_arm, space, override={"d_3": 0.05})
    found = calibrate(paper_arm, capture, bounds, prior=MAKER)
    assert found.active_names() == {"d_3": "lower"}


@pytest.mark.slow
def test_the_prior_determines_what_too_few_poses_do_not(paper_arm, bounds, true):
    capture = aj.simulate(true, POINTS, poses=4, lengths=[LENGTH], noise=NOISE)
    for options in ({}, {"prior": MAKER}):  # a prior does not say how much tips scatter
        with pytest.raises(aj.InputError, match="equations"):
            aj.calibrate(paper_arm, capture, bounds, **options)
    with pytest.warns(aj.IdentifiabilityWarning, match="Determined by the prior, and hardly"):
        found = aj.calibrate(paper_arm, capture, bounds, prior=MAKER, noise=NOISE)
    assert found.converged
    assert np.all(found.determined)
    assert float(np.sum(found.prior.effective)) < 19  # 25 equations less 6 coordinates of sockets


@pytest.mark.slow
def test_learned_scales(paper_arm, space, bounds):
    """Lengths that err by 0.3 mm, and angles that are right."""
    arm = aj.perturbed_arm(
        aj.Parameters(paper_arm, tuple(name for name in space.names if name[:2] in ("a_", "d_", "pr"))),
        length=0.3,
        angle=0.0,
    )
    capture = aj.simulate(arm, POINTS, poses=30, lengths=[LENGTH], noise=NOISE, seed=2)
    found = calibrate(paper_arm, capture, bounds, prior=aj.Prior(learn=True))
    lengths, angles = found.prior.sd
    assert lengths == pytest.approx(
        np.sqrt(np.mean((space.vector(arm) - space.vector())[space.lengths] ** 2)), rel=0.05
    )
    assert angles < 3e-5
    assert found.prior.effective[1] < 4
    assert np.all(u_of(found) < 1.05 * u_of(calibrate(paper_arm, capture, bounds, method="joint")))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a_1", "alpha_2"])
def test_learned_scales_settle_where_a_bound_is_reached(name):
    """A bound that is met with some scales and not with those that these lead to is on the way of the rounds."""
    rng = np.random.default_rng(2)
    right = np.pi / 2
    twists = [right, 0, right, -right, right, 0]
    arm = aj.Arm(alpha=twists, a=[0, 300, 50, 0, 0, 0], d=[200, 0, 0, 250, 0, 80], probe=(0, 0, 30))
    bending = aj.kinematics.with_corrections(arm, "gravity")
    q = rng.uniform(-1, 1, (60, 6))
    true = bending.replace(coefficients=rng.normal(size=len(bending.coefficients)) * 2e-3)
    seen = np.asarray(true.position(q)) + rng.normal(size=(60, 3)) * 0.3
    capture = aj.Capture({}, observations=[kinds.MeasuredPoints("tracker", q, seen)])
    prior = aj.kinematics.default_prior(bending)
    free = calibrate(bending, capture, None, prior=prior)
    space, i = free.space, free.space.index(name)
    start, end = (float(vector[i]) for vector in (space.vector(), free.parameters))
    lower, upper = np.array(free.bounds.lower), np.array(free.bounds.upper)
    (lower if end < start else upper)[i] = start + 0.99 * (end - start)
    assert calibrate(space.base, capture, aj.Bounds(space, lower, upper), prior=prior).converged


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prior": MAKER, "method": "two-stage"}, "cannot be combined with a robust loss, a prior or"),
        ({"prior": aj.Prior({"length": 0.3})}, "did you mean 'lengths'"),
        ({"prior": aj.Prior({"d_3": 0.3}, mean={"d_3": 0.4})}, "outside its bounds"),
    ],
    ids=["two-stage", "group", "mean"],
)
def test_refused(paper_arm, bounds, capture, options, message):
    with pytest.raises(aj.InputError, match=message):
        calibrate(paper_arm, capture, bounds, **options)


@pytest.mark.slow
def test_trials_draw_the_means_of_the_prior(paper_arm, space, bounds, capture):
    """About the calibrated parameters, with the prior's standard deviations; other parameters stay."""
    found = calibrate(paper_arm, capture, bounds, prior=aj.Prior({"lengths": 0.3}))
    task = sampling.Repeated.of(found, capture, None)
    means = task.prior_means(20_000, np.random.default_rng(0))
    np.testing.assert_allclose(means.std(axis=0), np.where(space.lengths, 0.3, 0.0), rtol=0.03, atol=1e-9)
    np.testing.assert_allclose(means.mean(axis=0), found.parameters, atol=0.01)


@pytest.mark.slow
@pytest.mark.optimised
def test_trials_scatter_as_the_posterior_does(paper_arm, true):
    """Of an arm with corrections, a prior that the data hardly exceed (without its errors the trials would scatter too
    little), and noise that is estimated in each trial."""
    true = aj.kinematics.with_corrections(true, "harmonics=1").replace(cos1_2=5e-5, sin1_3=-4e-5)
    arm = aj.kinematics.with_corrections(paper_arm, "harmonics=1")
    names = (*aj.Parameters.independent(paper_arm).names, "cos1_2", "sin1_2", "cos1_3", "sin1_3")
    space = aj.Parameters(arm, names)
    bounds = aj.Bounds.around(arm, space)
    capture = aj.simulate(true, POINTS, poses=20, lengths=[LENGTH], noise=NOISE)
    prior = aj.Prior({"lengths": 0.1, "angles": 2e-4, "harmonics": 5e-5}, learn=["angles"])
    found = calibrate(arm, capture, bounds, prior=prior)
    task = sampling.Repeated.of(found, capture, None)
    random = np.random.default_rng(1)
    captures, _ = sampling.truth_of(found, capture).drawn(1200, found.noise, random)
    values, failed = task.solved(captures, task.prior_means(1200, random))
    assert failed == 0
    sampled = task.sampled(values, failed, 0.95, 1)
    np.testing.assert_allclose(sampled.u, sampled.linear_u, rtol=0.1)
    assert set(sampled.quantities) >= {"cos1_2", "sin1_3", "d_3"}
    drawn = aj.bootstrap(found, capture, trials=400)
    assert 0.75 < np.median(drawn.u / drawn.linear_u) < 1.25


@pytest.mark.slow
def test_cross_validation_takes_the_prior(paper_arm, bounds, true):
    points = {name: np.add(POINTS["A"], (0, 60 * i, 20 * i)) for i, name in enumerate("ABCD")}
    lengths = [("A", "B", 0.002), ("C", "D", 0.002)]
    capture = aj.simulate(true, points, poses=14, lengths=lengths, noise=NOISE)
    exact = aj.Prior({"all": 1e-6})  # the nominal arm, whose error is that of its lengths
    found = aj.cross_validate(paper_arm, capture, bounds, prior=exact)
    nominal = aj.evaluate(paper_arm, capture)
    np.testing.assert_allclose([g.length_error[0] for g in found.groups], nominal.error, atol=1e-3)


@pytest.mark.slow
def test_file_and_summary(tmp_path, paper_arm, space, bounds, capture):
    found = calibrate(paper_arm, capture, bounds, prior=aj.Prior({"lengths": 0.3, "d_3": np.inf}, learn=["alpha"]))
    nominal = aj.kinematics.ArmSpecification(paper_arm, "arm", prior=MAKER)
    record = record_of(found, aj.Recording(capture, nominal))
    summary = calibration_summary(record)
    aj.files.save_calibration(tmp_path / "c.h5", record, summary)
    loaded = aj.files.load_calibration(tmp_path / "c.h5")
    assert jax.tree.structure(loaded.prior) == jax.tree.structure(record.prior)
    assert all(map(np.array_equal, jax.tree.leaves(loaded.prior), jax.tree.leaves(record.prior)))
    assert loaded.degrees_of_freedom == found.degrees_of_freedom
    again = loaded.recording.nominal.prior
    assert (again.groups, again.learned, again.sd) == (MAKER.groups, MAKER.learned, MAKER.sd)
    rows = summary["prior"]
    assert [(row["group"], row["parameters"], row["learned"]) for row in rows] == [
        ("lengths", 10, False),
        ("alpha", 5, True),
    ]
    assert prior_sentence(rows[0]).startswith("lengths: given, 0.3 mm; ")


# Of whole calibrations with JAX, whose compilation takes a minute each.


@pytest.mark.slow
def test_many_are_as_one(paper_arm, space, bounds, true):
    captures = [aj.simulate(true, POINTS, poses=12, lengths=[LENGTH], noise=NOISE, seed=seed) for seed in range(3)]
    prior = aj.Prior({"lengths": 0.3}, learn=["angles"])
    many = aj.calibrate_many(paper_arm, aj.stack_captures(captures), bounds, prior=prior, covariance=True)
    assert many.converged.all()
    for i, capture in enumerate(captures):
        one = calibrate(paper_arm, capture, bounds, prior=prior)
        np.testing.assert_allclose((many.parameters[i] - one.parameters) / u_of(one), 0.0, atol=1e-6)
        np.testing.assert_allclose(many.u[i], u_of(one), rtol=1e-5)
        np.testing.assert_allclose(many.prior.sd[i], one.prior.sd, rtol=1e-5)


@pytest.mark.exhaustive
@pytest.mark.parametrize("active", [False, True])
def test_derivatives_are_exact(paper_arm, space, active):
    """By readings, bounds, the length, the prior's mean and scale: of parameters, learned scales and effective numbers;
    against differences of calibrations in NumPy. With two bounds active too."""
    true = aj.perturbed_arm(space, length=0.3, angle=5e-4, seed=1)
    capture = aj.simulate(true, POINTS, poses=10, lengths=[LENGTH], noise=NOISE)
    around = aj.Bounds.around(paper_arm, space, override={"d_3": 0.05, "alpha_2": 1e-5} if active else None)
    step, length = np.asarray(space.scale), float(capture.lengths[0].value)
    draw = np.random.default_rng(0)
    change = {name: 1e-4 * draw.standard_normal(q.shape) for name, q in capture.sockets.items()}

    def found(x):
        readings, bound, longer, mean, sd = x
        moved = {name: q + readings * change[name] for name, q in capture.sockets.items()}
        lengths = [aj.ReferenceLength("A", "B", value=length + longer, u=0.002)]
        bounds = aj.Bounds(space, around.lower + 0.01 * bound * step, around.upper + 0.02 * bound * step)
        means = {"d_2": float(paper_arm.d[1]) + 0.1 + mean}
        prior = aj.Prior({"d": 0.4 + sd, "alpha": 1e-3, "a": 0.2 + sd}, mean=means, learn=["a", "theta", "probe"])
        result = calibrate(paper_arm, aj.Capture(moved, lengths), bounds, prior=prior)
        return jnp.concatenate([result.parameters / step, result.prior.sd, result.prior.effective])

    jacobian = np.asarray(jax.jacfwd(found)(jnp.zeros(5)))
    h = np.array([1e-3, 1e-2, 1e-3, 1e-2, 1e-3])
    moved = {k: [np.asarray(found(k * h[i] * e)) for i, e in enumerate(np.eye(5))] for k in (-1, -0.5, 0.5, 1)}
    differences = [(8 * (moved[0.5][i] - moved[-0.5][i]) - (moved[1][i] - moved[-1][i])) / (6 * h[i]) for i in range(5)]
    size = np.maximum(np.abs(jacobian).max(axis=0), 0.01)
    np.testing.assert_allclose(jacobian / size, np.transpose(differences) / size, atol=1e-6)
    if not active:
        reverse = jax.jacrev(found)(jnp.zeros(5))
        np.testing.assert_allclose(reverse, jacobian, atol=1e-10 * np.abs(jacobian).max())


@pytest.mark.exhaustive
def test_coverage_where_the_truth_is_drawn_from_the_prior(paper_arm, space):
    """Six poses in each of two sockets, so that half of the angles are the prior's."""
    draw, nominal = np.random.default_rng(0), np.asarray(space.vector())
    sd = np.where(space.lengths, 0.3, 5e-4)
    truth = nominal + sd * draw.standard_normal((500, len(nominal)))
    noise = aj.Noise(encoder_arcsec=20, seating=0.05)
    captures = [
        aj.simulate(space.arm(x), POINTS, poses=6, lengths=[("A", "B", 0.01)], noise=noise, seed=i)
        for i, x in enumerate(truth)
    ]
    bounds = aj.Bounds(space, nominal - 30 * sd, nominal + 30 * sd)
    many = aj.calibrate_many(paper_arm, aj.stack_captures(captures), bounds, prior=MAKER, noise=noise, covariance=True)
    inside = np.abs(many.parameters - truth) < 1.96 * many.u
    assert many.converged.all()
    assert 0.94 < inside.mean() < 0.96


def test_rounds_that_follow_each_other_are_extrapolated():
    """A fixed point that is reached by turns, eleven times closer each second round, takes a dozen rounds."""
    turn = 0.3 * np.array([[0.0, 1.0, 0.1], [-1.0, 0.0, 0.0], [0.0, 0.2, 0.5]])
    point, rounds = np.array([1.0, -2.0, 0.5]), Rounds.begun(np.zeros(3))
    while rounds.change > 1e-12:
        away = rounds.scales - point
        rounds = rounds.after(point + turn @ away + 0.01 * away**2)
    np.testing.assert_allclose(rounds.scales, point, atol=1e-12)
    assert rounds.count <= 12

"""Stage 1, stage 2, both and the joint solve: what they recover, what they report, and their derivatives."""

import re
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.units import ARCSEC


@pytest.fixture(scope="module")
def space(paper_arm):
    return aj.Parameters.free_of(paper_arm)


@pytest.fixture(scope="module")
def bounds(paper_arm, space):
    return aj.Bounds.around(paper_arm, space)


@pytest.fixture(scope="module")
def start(space, bounds):
    """Well off the truth: 3 mm and a third of a degree."""
    return space.vector() + jnp.where(jnp.asarray(space.lengths), 3.0, 0.005)


@pytest.fixture(scope="module")
def calibrations(paper_arm, noisy_capture, bounds, start):
    return {
        (method, hold): aj.calibrate(paper_arm, noisy_capture, bounds, start=start, method=method, hold=hold)
        for method in ("two-stage", "joint")
        for hold in ("longest", None)
    }


def test_recovers_the_truth_within_its_uncertainty(calibrations, space, paper_arm):
    truth = np.asarray(space.vector(paper_arm))
    for (method, hold), result in calibrations.items():
        error = np.asarray(result.parameters) - truth
        u = np.sqrt(np.diag(result.covariance))
        free = np.asarray(result.active) == 0
        assert result.converged
        assert np.all(u[free] > 0)
        if hold == "longest":
            # 21 normalised errors: none beyond 4, and their mean square near 1.
            normalised = error[free] / u[free]
            assert np.max(np.abs(normalised)) < 4, method
            assert 0.2 < np.mean(normalised**2) < 3, method
        # DE of a fitted cloud whose coordinates scatter by 5 um and 2 arcsec over about 1 m.
        assert 0.005 < float(result.de) < 0.02


def test_stage_2_makes_every_way_agree(calibrations, paper_arm, noisy_capture):
    """Whatever length was held, and whether any was, lengths between sockets agree afterwards."""
    lengths = [float(result.length_after[0]) for result in calibrations.values()]
    reference = float(noisy_capture.lengths[0].value)
    np.testing.assert_allclose(lengths, reference, atol=0.01)
    two_stage = calibrations["two-stage", "longest"]
    assert float(two_stage.length_after[0]) == pytest.approx(reference, abs=1e-9)
    fixed = aj.fix_scale(two_stage.stage1.arm, noisy_capture)
    np.testing.assert_allclose(fixed.arm.d, two_stage.arm.d, rtol=1e-14)
    assert float(fixed.scale.value) == pytest.approx(float(two_stage.scale.value), rel=1e-14)


@pytest.mark.slow
def test_free_lengths_slide_to_a_bound_and_the_result_says_so(calibrations):
    """AUDIT: shrinking the arm lowers the misfit, so with noise and nothing held stage 1 shrinks until a bound stops
    it."""
    stage1 = calibrations["two-stage", None].stage1
    assert float(stage1.scale.value) < 0.999
    assert "lower" in stage1.active_names().values()
    assert stage1.hold is None
    held = calibrations["two-stage", "longest"].stage1
    assert held.hold == "d_3"
    assert held.active_names() == {}
    assert abs(float(held.scale.value) - 753 / 750) < 1e-4  # held at its start, 3 mm too long


@pytest.mark.slow
def test_joint_solve_is_the_weighted_minimum(calibrations, space, noisy_capture):
    """Its gradient vanishes: recomputed here with the weights the contract states, by JAX and not by the package's
    model."""
    result = calibrations["joint", "longest"]
    sizes = np.array(noisy_capture.sizes)
    sigma = float(result.stage1.after.sigma / result.stage1.scale.value)
    reference = noisy_capture.lengths[0]
    weight = 1 / np.sqrt(float(reference.u) ** 2 + sigma**2 * np.sum(1 / sizes))

    def cost(vector):
        tips = space.arm(vector).position(noisy_capture.q)
        centroids = [jnp.mean(block, axis=0) for block in jnp.split(tips, [sizes[0]])]
        spread = tips - jnp.repeat(jnp.stack(centroids), jnp.asarray(sizes), axis=0)
        length = jnp.linalg.norm(centroids[0] - centroids[1])
        return 0.5 * (jnp.sum(spread**2) / sigma**2 + weight**2 * (length - reference.value) ** 2)

    decrease = np.asarray(jax.grad(cost)(result.parameters)) * np.sqrt(np.diag(result.covariance))
    assert np.max(np.abs(decrease)) < 1e-6  # standard deviations that the minimum could still move


def test_several_lengths_are_averaged_by_weight(paper_arm):
    """k of an arm stretched by a known factor, from two lengths that disagree: the precise one decides."""
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (400, 500, 300)}
    capture = aj.simulate(paper_arm, sockets, poses=4, seed=1)
    lengths = [aj.ReferenceLength("A", "B", 200.0, 0.001), aj.ReferenceLength("A", "C", 300.3, 0.3)]
    scale = aj.fix_scale(paper_arm, aj.Capture(capture.sockets, lengths)).scale
    ratio, u = np.array([1.0, 300 / 300.3]), np.array([0.001 / 200, 300 / 300.3 * 0.3 / 300.3])
    expected = np.sum(ratio / u**2) / np.sum(1 / u**2)
    assert float(scale.value) == pytest.approx(expected, rel=1e-9)
    assert float(scale.u) == pytest.approx(np.sum(1 / u**2) ** -0.5, rel=1e-3)
    assert float(scale.u) < 5.01e-6


def test_scale_leaves_the_base_offset_alone(paper_arm, paper_capture):
    """d_1 shifts the whole base frame; neither lengths nor k say anything about it (Table 2 keeps 376.5)."""
    doubled = aj.Arm(
        alpha=paper_arm.alpha, a=2 * paper_arm.a, d=2 * paper_arm.d, theta=paper_arm.theta, probe=2 * paper_arm.probe
    )
    fixed = aj.fix_scale(doubled, paper_capture)
    assert float(fixed.scale.value) == pytest.approx(2, rel=1e-12)
    np.testing.assert_allclose(fixed.arm.d[1:], paper_arm.d[1:], atol=1e-9)
    assert float(fixed.arm.d[0]) == float(doubled.d[0])


def test_metrics_by_hand():
    """One socket with tips (0,0,0), (2,0,0), (0,4,0), (2,4,0): centroid (1,2,0), every distance sqrt(5), half range
    2."""
    tips = jnp.array([[0.0, 0, 0], [2, 0, 0], [0, 4, 0], [2, 4, 0], [7, 7, 7]])
    figures = aj.model.repeatability(tips, (4, 1))
    assert float(figures.de) == pytest.approx(np.sqrt(5))
    assert float(figures.rms) == pytest.approx(np.sqrt(5))
    assert float(figures.deltam) == 2
    assert float(figures.sigma) == pytest.approx(np.sqrt(20 / 9))
    np.testing.assert_allclose(figures.socket_de, [np.sqrt(5), 0])
    np.testing.assert_allclose(figures.centroids, [[1, 2, 0], [7, 7, 7]])


@pytest.mark.slow  # tests/core/test_numpy_or_jax.py compares whole calibrations
def test_identify_under_vmap_equals_single_runs(paper_arm, noisy_capture, bounds, space):
    starts = jnp.stack([space.vector() + shift * space.scale for shift in (-2.0, 0.5, 3.0)])
    run = lambda start: aj.identify(paper_arm, noisy_capture, bounds, start=start, hold="d_3")  # noqa: E731
    together = eqx.filter_jit(eqx.filter_vmap(run))(starts)
    assert together.de.shape == (3,)
    assert np.all(together.converged)
    for i, start in enumerate(starts):
        single = run(start)
        np.testing.assert_allclose(together.parameters[i], single.parameters, atol=1e-8)
        assert float(together.de[i]) == pytest.approx(float(single.de), rel=1e-9)


def central(function, point, direction, step=2e-3):
    """Directional derivative by central differences of sixth order (error of order step^6)."""

    def at(n):
        return function(*(value + n * step * change for value, change in zip(point, direction, strict=True)))

    return sum(w * (at(n) - at(-n)) for n, w in ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))) / step


@pytest.fixture(scope="module", params=["identify", pytest.param("calibrate", marks=pytest.mark.exhaustive)])
def differentiated(request, paper_arm, noisy_capture, space):
    """Both stages, or the first, as a function of angles, bounds, length and start; and its derivatives."""
    solve = {"identify": aj.identify, "calibrate": aj.calibrate}[request.param]

    def run(q, box, length, start):
        cut = noisy_capture.sizes[0]
        # Two lengths of different u, measured on the same sockets, so that their weights matter.
        references = [aj.ReferenceLength("A", "B", length, 0.002), aj.ReferenceLength("A", "B", 200.005, 0.004)]
        capture = aj.Capture({"A": q[:cut], "B": q[cut:]}, references)
        bounds = aj.Bounds(space, box[0], box[1])
        inside = jnp.clip(start, box[0], box[1])
        return solve(paper_arm, capture, bounds, start=inside, hold="d_3").parameters / space.scale

    forward = jax.jit(lambda point, direction: jax.jvp(run, point, direction)[1])
    reverse = jax.jit(lambda point, cotangent: jax.vjp(run, *point)[1](cotangent))
    return request.param, run, forward, reverse


# Reverse has forward within it, and takes all inputs at once; the suite compiles reverse alone.
@pytest.mark.slow
@pytest.mark.parametrize("mode", ["reverse", pytest.param("forward", marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("case", ["inactive", "active", "repeated"])
@pytest.mark.parametrize("by", ["angles", "bounds", "length"])
def test_derivatives_of_a_calibration(paper_arm, noisy_capture, space, start, differentiated, by, case, mode):
    """Forward and reverse against central differences, relative to the largest component, with bounds active and
    not; and repeated from where it ended, so that k = 1 before the scale anchor is adjusted."""
    boxed = case != "inactive"
    what, run, forward, reverse = differentiated
    bounds = aj.Bounds.around(paper_arm, space)
    lower, upper = np.array(bounds.lower), np.array(bounds.upper)
    if boxed:  # the box cuts off the minima of a_2 and alpha_3, which then end on a bound
        upper[space.index("a_2")] = 61.99
        lower[space.index("alpha_3")] = float(paper_arm.alpha[2]) + 1e-4
    point = (noisy_capture.q, jnp.asarray(np.stack([lower, upper])), noisy_capture.lengths[0].value, start)
    if case == "repeated":
        point = (*point[:3], run(*point) * space.scale)
    random = np.random.default_rng(0)
    directions = {  # of about 1e-4 rad an angle; a hundredth of a unknown's natural step a bound; 1 mm
        "angles": 1e-4 * random.normal(size=point[0].shape),
        "bounds": 0.01 * random.normal(size=(2, len(space.names))) * np.asarray(space.scale),
        "length": np.ones(()),
    }
    direction = tuple(
        jnp.asarray(directions[name]) if name == by else jnp.zeros_like(value)
        for name, value in zip(("angles", "bounds", "length", "start"), point, strict=True)
    )
    expected = central(run, point, direction)
    size = float(jnp.max(jnp.abs(expected)))
    # A bound that does not bind has no influence, and a length none on the first stage.
    assert (size > 1e-3) == (boxed if by == "bounds" else by == "angles" or what == "calibrate")
    if mode == "forward":
        found = forward(point, direction)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * size + 1e-8)
    else:  # a vector-Jacobian product with a random cotangent, along the direction
        cotangent = random.normal(size=len(space.names))
        pulled = reverse(point, jnp.asarray(cotangent))
        total = sum(float(jnp.vdot(gradient, change)) for gradient, change in zip(pulled, direction, strict=True))
        largest = size * np.abs(cotangent).sum()
        assert total == pytest.approx(float(cotangent @ expected), rel=0, abs=1e-5 * largest + 1e-8)


@pytest.mark.slow
def test_hayatis_angle_tells_parallel_axes_apart():
    """Two parallel axes: d_2 and d_3 trade off exactly, so one is held, and the tilt that D-H lacks is found as
    beta."""
    parallel = aj.Arm(
        alpha=[np.pi / 2, 0.0, -np.pi / 2, np.pi / 2],
        a=[30.0, 400.0, 60.0, 0.0],
        d=[300.0, 0.0, 0.0, 350.0],
        probe=[0.0, 40.0, 100.0],
    )
    held = ["theta_1", "d_1", "alpha_4", "a_4", "theta_4", "d_4", "d_2"]
    space = aj.Parameters.free_of(parallel, held=held, free=["beta_2"])
    assert "beta_2" in space.names
    truth = space.arm(space.vector().at[space.index("beta_2")].set(2e-3).at[space.index("a_2")].add(0.5))
    sockets = {"A": (450, 150, 350), "B": (300, 350, 400)}
    capture = aj.simulate(truth, sockets, poses=40, lengths=[("A", "B")], seed=3)
    result = aj.calibrate(space.base, capture, aj.Bounds.around(space.base, space), hold="a_2")
    assert result.converged
    assert float(result.de) < 1e-6
    assert float(result.arm.beta[1]) == pytest.approx(2e-3, abs=1e-8)


@pytest.mark.exhaustive
def test_uncertainties_are_those_that_trials_show(paper_arm, space, bounds):
    """150 simulated calibrations with lengths that share sockets: normalised errors of every parameter, of k and of a
    length elsewhere have a root mean square near 1, for each method and whether a length is held or not."""
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (400, 500, 300), "D": (450, 250, 600)}
    pairs = [("A", "B"), ("A", "C"), ("A", "D"), ("B", "C")]
    exact = aj.simulate(paper_arm, sockets, poses=20, lengths=pairs, seed=2)
    check = aj.simulate(paper_arm, {"E": (650, 350, 150), "F": (150, 450, 650)}, poses=1, seed=2).q
    by_q = paper_arm.jacobian(exact.q, [f"q_{i}" for i in range(1, 7)])
    truth, true_length = space.vector(), jnp.linalg.norm(paper_arm.position(check)[0] - paper_arm.position(check)[1])

    def length_of(vector):
        ends = space.arm(vector).position(check)
        return jnp.linalg.norm(ends[0] - ends[1])

    @partial(jax.jit, static_argnames=("method", "hold"))
    def trials(keys, method, hold):
        def one(key):
            encoder, seat, reference = jax.random.split(key, 3)
            # A seat off by s moves the readings by the least-norm q that moves the tip by s.
            off = 0.005 * jax.random.normal(seat, (exact.q.shape[0], 3))
            seated = exact.q + jnp.einsum(
                "nji,nj->ni", by_q, jnp.linalg.solve(by_q @ jnp.swapaxes(by_q, 1, 2), off[..., None])[..., 0]
            )
            q = seated + 2.0 * ARCSEC * jax.random.normal(encoder, seated.shape)
            ends = np.cumsum(exact.sizes)
            blocks = {name: q[end - 20 : end] for name, end in zip(exact.names, ends, strict=True)}
            errors = 0.002 * jax.random.normal(reference, (len(pairs),))
            lengths = [
                aj.ReferenceLength(r.start, r.end, r.value + error, 0.002)
                for r, error in zip(exact.lengths, errors, strict=True)
            ]
            result = aj.calibrate(paper_arm, aj.Capture(blocks, lengths), bounds, method=method, hold=hold)
            slope = jax.grad(length_of)(result.parameters)
            u_length = jnp.sqrt(slope @ result.covariance @ slope)
            u = jnp.sqrt(jnp.diagonal(result.covariance))
            return (result.parameters - truth) / u, (length_of(result.parameters) - true_length) / u_length

        return jax.lax.map(one, keys, batch_size=15)

    keys = jax.random.split(jax.random.key(11), 150)
    for method, hold in (("two-stage", "d_3"), ("two-stage", None), ("joint", "d_3")):
        normalised, length = trials(keys, method, hold)
        spread = np.sqrt(np.mean(np.asarray(normalised) ** 2, axis=0))
        # With 150 trials an RMS of 1 scatters by 0.06; encoder noise is not the same in every pose, which adds a
        # little.
        assert np.all((spread > 0.75) & (spread < 1.35)), (
            method,
            hold,
            dict(zip(space.names, spread.round(2), strict=True)),
        )
        assert 0.75 < np.sqrt(np.mean(np.asarray(length) ** 2)) < 1.3, (method, hold)


def test_uncertainty_of_k_is_unknown_without_any_scatter(paper_arm, noisy_capture):
    """One pose at each end shows no scatter: u(k) is NaN unless stage 1's sigma is given, and then the textbook's."""
    single = aj.Capture(
        {name: q[:1] for name, q in noisy_capture.sockets.items()}, [aj.ReferenceLength("A", "B", 200.0)]
    )
    assert np.isnan(float(aj.fix_scale(paper_arm, single).scale.u))
    known = aj.fix_scale(paper_arm, single, sigma=0.01).scale
    assert float(known.u) == pytest.approx(0.01 * np.sqrt(2) / 200, rel=1e-6)
    assert np.isnan(float(aj.evaluate(paper_arm, single).repeatability.de))


@pytest.mark.slow
def test_a_known_length_leaves_nothing_more_to_hold(paper_arm, space):
    """With d_3 held by the user the scale is known, so "longest" holds nothing; a redundant held length changes
    nothing."""
    held = (*space.held, "d_3")
    known = aj.Parameters.free_of(paper_arm, held=held)
    longer = known.arm(known.vector().at[known.index("d_5")].add(1.0))
    capture = aj.simulate(longer, {"A": (400, 200, 300)}, seed=1)
    result = aj.identify(paper_arm, capture, aj.Bounds.around(paper_arm, known))
    assert result.hold is None
    assert float(result.de) < 1e-9
    assert float(result.arm.d[4]) == pytest.approx(501, abs=1e-8)


@pytest.mark.slow
def test_what_data_cannot_tell_apart_is_marked(paper_arm, noisy_capture):
    """With everything free: d_1 and theta_1 only move the base frame, and (a_6, theta_6), (alpha_6, d_6) trade off
    (AUDIT)."""
    everything = aj.Parameters.free_of(paper_arm, held=())
    bounds = aj.Bounds.around(paper_arm, everything)
    result = aj.identify(paper_arm, noisy_capture, bounds, hold="d_3")
    unknown = {name for name, known in zip(everything.names, np.asarray(result.determined), strict=True) if not known}
    assert {"d_1", "theta_1", "a_6", "theta_6", "alpha_6", "d_6"} <= unknown
    assert not unknown & {"a_2", "d_5", "alpha_2", "theta_3"}
    assert np.all(
        np.asarray(
            aj.identify(
                paper_arm, noisy_capture, aj.Bounds.around(paper_arm, aj.Parameters.free_of(paper_arm))
            ).determined
        )
    )


@pytest.mark.slow
def test_what_does_not_converge_names_what_trades_off(paper_arm, noisy_capture, bounds, space):
    found = aj.calibrate(paper_arm, noisy_capture, bounds, max_steps=1)
    record = aj.calibration.record_of(found, aj.Recording(noisy_capture, aj.kinematics.ArmSpecification(paper_arm)))
    assert not record.converged
    sentence = (
        r"Not converged: the step limit was reached; (.*) trade off; fix one of these parameters, or give it a prior\."
    )
    names = re.fullmatch(sentence, record.reason)[1].split(", ")
    assert 2 <= len(names) <= 4
    assert set(names) <= set(space.names)


@pytest.mark.slow
def test_the_true_arm_may_have_other_corrections(observed_record, paper_arm):
    """Or none: a parameter that it lacks is 0, and not that of another coefficient in its place."""
    nominal = aj.kinematics.with_corrections(paper_arm, "gear,gravity")
    true = aj.kinematics.with_corrections(paper_arm, "harmonics=1").replace(cos1_1=0.1, d_1=7.0)
    arms = {name: observed_record.calibrated._replace(arm=nominal) for name in ("stage1", "calibrated")}
    recording = observed_record.recording._replace(
        nominal=arms["stage1"], true=observed_record.calibrated._replace(arm=true)
    )
    record = observed_record._replace(recording=recording, names=("d_1", "gear_1", "gravity_z"), **arms)
    np.testing.assert_array_equal(record.vectors()["true"], [7.0, 0.0, -1.0])

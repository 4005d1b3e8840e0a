"""Monte Carlo after JCGM 101, the bootstrap, and cross-validation: against published examples and errors made up."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration import sampling
from aacmm_jax.calibration.agreement import CrossValidation, LeftOut
from aacmm_jax.calibration.sampling import numerical_tolerance
from aacmm_jax.diagnostics.findings import findings_of, sentences
from aacmm_jax.pipeline.cross_validation import groups_of

NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)


@pytest.fixture(scope="module")
def arm(paper_arm) -> aj.Arm:
    return paper_arm


@pytest.fixture(scope="module")
def bounds(arm) -> aj.Bounds:
    """Six free parameters, so that trials are quick."""
    return aj.Bounds.around(arm, aj.Parameters(arm, ("a_1", "d_3", "d_5", "theta_2", "theta_3", "probe_z")))


@pytest.fixture(scope="module")
def capture(arm) -> aj.Capture:
    """Three placements of one length."""
    sockets, pairs = {}, []
    for i, (x, y, z) in enumerate([(450, 150, 350), (300, 350, 400), (-200, 400, 250)]):
        sockets |= {f"{i}/0": (x, y, z), f"{i}/1": (x, y, z + 150)}
        pairs.append((f"{i}/0", f"{i}/1", 0.01))
    return aj.simulate(arm, sockets, poses=12, lengths=pairs, encoder_arcsec=2.0, seating=0.005, seed=1)


# JCGM 101:2008, 7.9.2, examples 1 to 3.
@pytest.mark.parametrize(
    ("u", "digits", "delta"), [(0.00035, 2, 0.000005), (0.00035, 1, 0.00005), (2.0, 1, 0.5), (0.0096, 1, 0.005)]
)
def test_tolerance_of_the_standard(u, digits, delta):
    assert numerical_tolerance(np.array([u]), digits) == pytest.approx(delta)


@pytest.fixture(scope="module")
def sampled(arm, bounds, capture) -> aj.calibration.Sampled:
    """Two blocks of trials: stable to four tolerances (`_REFINED`), where the standard's fifth of one takes minutes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampling, "_REFINED", 0.25)
        result = aj.calibrate(arm, capture, bounds, method="joint", noise=NOISE, shared_errors=False)
        return aj.monte_carlo(result, capture, most=40_000, seed=3)


# The tests after it are its small version: fewer trials, and a case where the linear result fails. All of them compute
# more than they compile.
@pytest.mark.exhaustive
@pytest.mark.optimised
def test_monte_carlo_agrees_with_the_linear_result_and_is_stable(arm, sampled):
    assert (sampled.stable, sampled.trials) == (True, 20_000)
    np.testing.assert_allclose(sampled.u, sampled.linear_u, rtol=0.03)
    # The tolerance of one digit is as small as a 20th of u; the ends themselves are known to a fifth of it.
    assert np.mean(sampled.agrees) > 0.9
    assert "JCGM 101" in sampled.sentences()[-1]
    # The numbers of a normal distribution: 1.96 standard deviations on both sides.
    np.testing.assert_allclose((sampled.high - sampled.low) / sampled.u, 3.92, rtol=0.03)
    assert "k" not in sampled.quantities  # a joint solve divides by none
    assert np.all((sampled.low < sampled.estimate) & (sampled.estimate < sampled.high))


@pytest.mark.exhaustive
@pytest.mark.optimised
def test_two_stages_with_fixed_lengths(arm, capture, bounds):
    """Most lengths are fixed here, and set the scale: stage 2 changes nothing, in the linear result and in every
    trial."""
    with pytest.warns(aj.IdentifiabilityWarning, match="already set the scale"):
        result = aj.calibrate(arm, capture, bounds, noise=NOISE, shared_errors=False)
    assert result.method == "two-stage"
    assert result.scale_set_by
    sampled = aj.monte_carlo(result, capture, most=10_000)
    np.testing.assert_allclose(sampled.u, sampled.linear_u, rtol=0.05)


@pytest.mark.slow
@pytest.mark.optimised
def test_monte_carlo_says_where_the_linear_result_fails(arm, capture, bounds):
    """A bound a third of a standard uncertainty beside a parameter cuts its distribution off."""
    free = aj.calibrate(arm, capture, bounds, method="joint", noise=NOISE)
    space, u = free.space, np.sqrt(np.diag(free.covariance))
    i = space.index("d_5")
    lower, upper, found = np.array(bounds.lower), np.array(bounds.upper), float(free.parameters[i])
    nominal = float(space.vector(arm)[i])
    if found < nominal:  # the bound lies on the side away from the nominal value, where the solve starts
        lower[i] = found - u[i] / 3
    else:
        upper[i] = found + u[i] / 3
    narrow = aj.calibrate(arm, capture, aj.Bounds(space, lower, upper), method="joint", noise=NOISE)
    assert not narrow.active_names()
    sampled = aj.monte_carlo(narrow, capture, most=10_000)
    assert not sampled.agrees[i]
    assert lower[i] <= sampled.low[i] < sampled.high[i] <= upper[i]
    assert "differ from the Monte Carlo intervals by more than the tolerance of JCGM 101 for" in sampled.sentences()[-1]
    assert "d_5" in " ".join(sampled.sentences())


@pytest.mark.slow
@pytest.mark.optimised
def test_bootstrap_sees_the_noise(arm, bounds, capture):
    """Poses drawn with replacement scatter the result about as the noise does."""
    result = aj.calibrate(arm, capture, bounds, method="joint")
    sampled = aj.bootstrap(result, capture, trials=400)
    ratio = sampled.u / sampled.linear_u
    assert 0.75 < np.median(ratio) < 1.25
    with pytest.raises(aj.InputError, match="at least 100"):
        aj.bootstrap(result, capture, trials=10)


def test_groups_are_what_lengths_join(capture):
    assert groups_of(capture) == (("0/0", "0/1"), ("1/0", "1/1"), ("2/0", "2/1"))
    chained = aj.Capture(capture.sockets, [*capture.lengths, aj.ReferenceLength("0/1", "2/0", 700.0)])
    assert groups_of(chained) == (("0/0", "0/1", "2/0", "2/1"), ("1/0", "1/1"))


def test_cross_validation_of_honest_data(arm, bounds, capture):
    """Errors of placements left out are what the uncertainty predicts, of poses and of lengths."""
    checked = aj.cross_validate(arm, capture, bounds, method="joint", noise=NOISE)
    assert len(checked.groups) == 3
    assert all(group.converged for group in checked.groups)
    # The found RMS rests on 3 x 24 poses in 3 dimensions, the lengths' on three values.
    assert 0.8 < checked.rms / checked.rms_predicted < 1.25
    assert 0.2 < checked.length_rms / checked.length_u < 2.2
    assert len(checked.distances) == 3 * 24
    assert np.sqrt(np.mean(checked.distances**2)) == pytest.approx(checked.rms)


@pytest.mark.slow
def test_cross_validation_shows_what_the_uncertainty_misses(arm, bounds, capture):
    """Errors that all poses of a placement share, as of an arm that gives way: the lengths come out wrong by far more
    than their u."""
    wrong = [
        aj.ReferenceLength(r.start, r.end, float(r.value) + off, 0.01)
        for r, off in zip(capture.lengths, (0.15, -0.1, -0.1), strict=True)
    ]
    bent = aj.Capture(capture.sockets, wrong)
    options = {"method": "joint", "noise": NOISE}
    assert aj.cross_validate(arm, bent, bounds, **options).excess < 1.5  # shared errors are in the prediction
    checked = aj.cross_validate(arm, bent, bounds, **options, shared_errors=False)
    assert checked.surprising
    assert checked.excess > 3
    result = aj.calibrate(arm, bent, bounds, **options, shared_errors=False)
    record = aj.calibration.record_of(result, aj.Recording(bent, aj.kinematics.ArmSpecification(arm, "bent")))
    found = sentences(findings_of(record._replace(validation=checked)))
    larger = "When each placement is held out in turn, the errors are larger than predicted"
    held_out = next(sentence for sentence in found if sentence.startswith(larger))
    assert f"{checked.rms / checked.rms_predicted:.1f} times the predicted {checked.rms_predicted:.3g} mm;" in held_out
    assert f"{checked.length_rms / checked.length_u:.1f} times the predicted {checked.length_u:.3g} mm" in held_out
    assert "Measure the reference lengths again" in held_out
    assert found[0].startswith("A certified value differs from what the poses and the other values say")


def left_out(rms, errors, u, poses=24, predicted=0.01) -> LeftOut:
    return LeftOut(("A", "B"), poses, rms, predicted, np.array(errors), np.array(u), True)


# Groups of sockets, and whether their errors are more than chance: a ratio of 1.5 with two lengths is nothing special,
# with fifty it is.
SURPRISES = {
    "as predicted": ([left_out(0.01, [0.02], [0.02])] * 3, 1.0, False),
    "few lengths": ([left_out(0.01, [0.035], [0.02])] * 2, 1.75, False),
    "many lengths": ([left_out(0.01, [0.035] * 25, [0.02] * 25)] * 2, 1.75, True),
    "poses": ([left_out(0.016, [0.01], [0.02])] * 2, 1.6, True),
    "a single pose an end": ([left_out(0.01, [0.02], [0.02]), left_out(np.nan, [0.02], [0.02], 0, np.nan)], 1.0, False),
    "open": ([left_out(0.01, [0.02], [0.02]), left_out(10.0, [2.0], [np.inf], 24, np.inf)], 1.0, False),
}


@pytest.mark.parametrize("case", SURPRISES)
def test_what_is_surprising(case):
    groups, excess, surprising = SURPRISES[case]
    checked = CrossValidation(tuple(groups))
    assert checked.excess == pytest.approx(excess)
    assert checked.surprising == surprising
    assert checked.open == (case == "open")


def test_the_interval_of_held_out_poses_covers_as_stated():
    """Mean squares that scatter between groups, as independent ones do; of one group there is no interval."""
    random, covered, trials = np.random.default_rng(0), 0, 2000
    for _ in range(trials):
        groups = [left_out(np.sqrt(1 + 0.2 * random.normal()), [], [], poses=20) for _ in range(4)]
        low, high = CrossValidation(tuple(groups)).interval
        covered += low < 1.0 < high
    assert covered / trials == pytest.approx(0.95, abs=2 * np.sqrt(0.95 * 0.05 / trials))
    assert CrossValidation(tuple(groups[:1])).interval is None


def test_held_out_poses_are_those_that_count():
    """Without groups that the others cannot predict, and without the only poses of sockets."""
    known, alone = np.array([0.3, 0.4]), np.array([np.nan, 0.5])
    groups = [left_out(0.1, [], [])._replace(distances=values) for values in (known, alone, np.ones(3))]
    groups[2] = groups[2]._replace(rms_predicted=np.inf)
    assert CrossValidation(tuple(groups)).distances.tolist() == [0.3, 0.4, 0.5]
    assert CrossValidation((groups[0], groups[1]._replace(distances=None))).distances is None


@pytest.mark.slow
def test_one_placement_cannot_be_cross_validated(arm, bounds, capture):
    alone = capture.select(only=["0/*"])
    with pytest.raises(aj.InputError, match="at least two groups of sockets"):
        aj.cross_validate(arm, alone, bounds)


@pytest.mark.first_rows(1)
@pytest.mark.filterwarnings("ignore:.* the scale, so the reference lengths have no effect")
@pytest.mark.parametrize(
    ("options", "text"), [({"digits": 3}, "digits is 3; choose one of 1, 2"), ({"level": 95}, "level is 95")]
)
def test_refused(arm, bounds, capture, options, text):
    with pytest.raises(aj.InputError, match=text):
        aj.monte_carlo(aj.calibrate(arm, capture, bounds), capture, **options)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* the scale, so the reference lengths have no effect")
def test_files_keep_all_of_it(arm, bounds, capture, tmp_path):
    sampled = aj.bootstrap(aj.calibrate(arm, capture, bounds, method="joint", noise=NOISE), capture, trials=100)
    nominal = aj.kinematics.ArmSpecification(arm, "small")
    result = aj.calibrate(
        arm, capture, bounds, noise=aj.Noise(encoder_arcsec=[1.0, 2.0, 3.0, 2.0, 1.0, 4.0], seating=0.004)
    )
    record = aj.calibration.record_of(result, aj.Recording(capture, nominal))._replace(
        validation=aj.cross_validate(arm, capture, bounds), sampled=sampled.table(), sampled_says="It agrees."
    )
    aj.files.save_calibration(tmp_path / "c.h5", record)
    loaded = aj.files.load_calibration(tmp_path / "c.h5")
    np.testing.assert_array_equal(loaded.noise.encoder_arcsec, record.noise.encoder_arcsec)
    assert float(loaded.noise.seating) == 0.004
    assert (loaded.noise_model, loaded.degrees_of_freedom, loaded.reduced_chi) == (
        "given",
        np.inf,
        float(result.stage1.reduced_chi),
    )
    np.testing.assert_array_equal(loaded.open, result.parameter_covariance.open)
    for found, kept in zip(loaded.validation.groups, record.validation.groups, strict=True):
        assert found.sockets == kept.sockets
        assert (found.rms, found.rms_predicted, found.converged) == (kept.rms, kept.rms_predicted, kept.converged)
        np.testing.assert_array_equal(found.length_error, kept.length_error)
        np.testing.assert_array_equal(found.distances, kept.distances)
    np.testing.assert_array_equal(loaded.sampled["high"], sampled.high)
    assert loaded.sampled_says == "It agrees."
    # A calibration that failed leaves residuals of any size; its file is read all the same.
    aj.files.save_calibration(
        tmp_path / "failed.h5", record._replace(noise=aj.Noise(encoder_arcsec=1e6, seating=500.0))
    )
    assert float(aj.files.load_calibration(tmp_path / "failed.h5").noise.seating) == 500.0
    again = aj.uncertainty_of(loaded)
    np.testing.assert_allclose(again.u, aj.uncertainty_of(result).u)

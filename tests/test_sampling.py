"""Monte Carlo after JCGM 101, the bootstrap, and cross-validation: against published examples and errors made up."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.sampling import numerical_tolerance
from aacmm_jax.validation import groups_of

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
def sampled(arm, bounds, capture) -> aj.Sampled:
    return aj.monte_carlo(aj.calibrate(arm, capture, bounds, method="joint", noise=NOISE), capture, seed=3)


def test_monte_carlo_agrees_with_the_linear_result_and_is_stable(arm, sampled):
    assert sampled.stable
    assert sampled.trials >= 20_000
    np.testing.assert_allclose(sampled.u, sampled.linear_u, rtol=0.03)
    assert sampled.agrees.all()
    assert sampled.sentences() == [
        "The linear 95 % intervals agree with the Monte Carlo ones within the tolerance of JCGM 101."
    ]
    # The numbers of a normal distribution: 1.96 standard deviations on both sides.
    np.testing.assert_allclose((sampled.high - sampled.low) / sampled.u, 3.92, rtol=0.03)
    assert "k" in sampled.quantities
    assert np.all((sampled.low < sampled.estimate) & (sampled.estimate < sampled.high))


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
    sampled = aj.monte_carlo(narrow, capture, most=20_000)
    assert not sampled.agrees[i]
    assert lower[i] <= sampled.low[i] < sampled.high[i] <= upper[i]
    assert "differ from the Monte Carlo ones by more than the tolerance of JCGM 101 for" in sampled.sentences()[-1]
    assert "d_5" in " ".join(sampled.sentences())


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


def test_cross_validation_shows_what_the_model_misses(arm, bounds, capture):
    """An arm that gives way by 80 arcsec, at one end of a length to this side and at the other to that: all poses of a socket share it."""
    shift = np.array([0.0, 4e-4, 0.0, 0.0, 0.0, 0.0])
    sag = {name: np.asarray(q) + shift * (-1) ** i for i, (name, q) in enumerate(capture.sockets.items())}
    bent = aj.Capture(sag, capture.lengths)
    checked = aj.cross_validate(arm, bent, bounds)
    assert checked.excess > 1.5
    record = aj.record_of(aj.calibrate(arm, bent, bounds), aj.Recording(bent, aj.ArmSpecification(arm, "bent")))
    from aacmm_jax import cautions

    first = cautions.of_calibration(record._replace(validation=checked))[0]
    assert first.startswith("Sockets left out one placement after the other err")
    assert "Trust the cross-validated figures" in first


def test_one_placement_cannot_be_cross_validated(arm, bounds, capture):
    alone = capture.select(only=["0/*"])
    with pytest.raises(aj.InputError, match="needs two groups of sockets"):
        aj.cross_validate(arm, alone, bounds)


@pytest.mark.parametrize(("options", "text"), [({"digits": 3}, "1 or 2 significant"), ({"level": 95}, "level is 95")])
def test_refused(arm, bounds, capture, options, text):
    with pytest.raises(aj.InputError, match=text):
        aj.monte_carlo(aj.calibrate(arm, capture, bounds), capture, **options)


def test_files_keep_all_of_it(arm, bounds, capture, sampled, tmp_path):
    nominal = aj.ArmSpecification(arm, "small")
    result = aj.calibrate(arm, capture, bounds, noise=aj.Noise(encoder_arcsec=[1.0, 2.0, 3.0, 2.0, 1.0, 4.0], seating=0.004))
    record = aj.record_of(result, aj.Recording(capture, nominal))._replace(
        validation=aj.cross_validate(arm, capture, bounds), sampled=sampled.table(), sampled_says="It agrees."
    )
    aj.save_calibration(tmp_path / "c.h5", record)
    loaded = aj.load_calibration(tmp_path / "c.h5")
    np.testing.assert_array_equal(loaded.noise.encoder_arcsec, record.noise.encoder_arcsec)
    assert float(loaded.noise.seating) == 0.004
    assert (loaded.form, loaded.freedom, loaded.misfit) == ("given", np.inf, float(result.stage1.misfit))
    np.testing.assert_array_equal(loaded.open, result.spread.open)
    for found, kept in zip(loaded.validation.groups, record.validation.groups, strict=True):
        assert found.sockets == kept.sockets
        assert (found.rms, found.rms_predicted, found.converged) == (kept.rms, kept.rms_predicted, kept.converged)
        np.testing.assert_array_equal(found.length_error, kept.length_error)
    np.testing.assert_array_equal(loaded.sampled["high"], sampled.high)
    assert loaded.sampled_says == "It agrees."
    again = aj.uncertainty_of(loaded)
    np.testing.assert_allclose(again.u, aj.uncertainty_of(result).u)

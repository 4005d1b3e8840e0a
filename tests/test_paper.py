"""Cheng et al. 2018: its noise-free simulations from random starts, and its published experiment."""

import numpy as np
import pytest

import aacmm_jax as aj

from . import published

STARTS = 300  # benchmarks/cheng2018 has the 1,000 of the paper


def box(space: aj.Parameters, number: int) -> aj.Bounds:
    return aj.Bounds(space, *published.BOXES[number])


def test_default_parameters_are_the_papers(paper_arm):
    assert aj.Parameters.free_of(paper_arm).names == published.ORDER


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "hold"),
    [(1, None), pytest.param(2, "d_3", marks=pytest.mark.slow)]
    + [pytest.param(*case, marks=pytest.mark.exhaustive) for case in ((1, "d_3"), (2, None))],
)
def test_noise_free_simulation_from_random_starts(paper_arm, paper_capture, number, hold):
    """Table 1: DE is rounding error from every start (paper: 7e-5 and 8e-5 mm), then one length gives the others."""
    space = aj.Parameters.free_of(paper_arm)
    bounds, truth = box(space, number), np.asarray(space.vector(paper_arm))
    fraction = np.random.default_rng(number).uniform(size=(STARTS, len(space.names)))
    lower, upper = np.asarray(bounds.lower), np.asarray(bounds.upper)
    many = aj.calibrate_many(paper_arm, paper_capture, lower, upper, lower + (upper - lower) * fraction, hold=hold)
    error = np.abs(many.parameters - truth)
    assert np.all(many.stage1.converged)
    assert np.max(many.stage1.de) <= 1e-9
    assert np.max(error[:, space.lengths]) <= 1e-8
    assert np.max(error[:, ~space.lengths]) <= 1e-11


@pytest.mark.slow
def test_scale_from_the_centre_of_the_second_box(paper_arm, paper_capture):
    """With no length held the least-squares step has no component along the true lengths, so stage 1 ends at the
    projection of the start on them: k = <start, truth> / <truth, truth> over the lengths. That is Table 1's 6.6 mm."""
    space = aj.Parameters.free_of(paper_arm)
    bounds = box(space, 2)
    centre = (bounds.lower + bounds.upper) / 2
    result = aj.identify(paper_arm, paper_capture, bounds, start=centre, hold=None)
    truth = np.asarray(space.vector(paper_arm))[space.lengths]
    projection = np.asarray(centre)[space.lengths] @ truth / (truth @ truth)
    assert result.converged
    assert result.active_names() == {}
    assert float(result.scale.value) == pytest.approx(projection, abs=1e-7)
    assert float(result.scale.value) == pytest.approx(1.00895, abs=5e-6)
    largest = np.max(np.abs(np.asarray(result.parameters)[space.lengths] - truth))
    assert largest == pytest.approx(6.711, abs=0.005)


def test_published_scale_gives_table_2():
    """Eq. 18 divided by the printed k gives all 11 lengths of Table 2; its angles do not follow from eq. 18 at all."""
    space = aj.Parameters.free_of(aj.load_arm("cheng2018-ra7125"))
    scale = aj.scale_from_lengths(measured=published.LENGTH_MEAN, nominal=published.LENGTH_NOMINAL)
    lengths = published.EQUATION_18[space.lengths] / float(scale.value)
    np.testing.assert_array_equal(np.round(lengths, 4), published.TABLE_2_LENGTHS)
    angles = np.rad2deg(published.EQUATION_18[~space.lengths])
    assert not np.any(np.abs(angles - published.TABLE_2_ANGLES_DEG) < 5e-5)


def test_scale_from_the_four_printed_lengths():
    """Their mean is 200.7585; the paper rounded it to 200.759 before dividing. The rounding is well inside u(k)."""
    scale = aj.scale_from_lengths(measured=published.LENGTH_MEASURED, nominal=published.LENGTH_NOMINAL)
    assert float(scale.value) == pytest.approx(200.7585 / 201.513, rel=1e-15)
    # JCGM 100, 4.2.3: experimental standard deviation of the mean, relative to the nominal value.
    expected = np.std(published.LENGTH_MEASURED, ddof=1) / 2 / published.LENGTH_NOMINAL
    assert float(scale.u) == pytest.approx(expected, rel=1e-12)
    assert abs(float(scale.value) - published.LENGTH_MEAN / published.LENGTH_NOMINAL) < float(scale.u)
    space = aj.Parameters.free_of(aj.load_arm("cheng2018-ra7125"))
    lengths = published.EQUATION_18[space.lengths] / float(scale.value)
    np.testing.assert_allclose(lengths, published.TABLE_2_LENGTHS, rtol=0, atol=0.002)


def test_uncertainty_of_the_reference_enters_k():
    exact = aj.scale_from_lengths(measured=[200.0, 200.002], nominal=200.0)
    known = aj.scale_from_lengths(measured=[200.0, 200.002], nominal=200.0, u=0.01)
    combined = np.hypot(float(exact.u), float(known.value) * 0.01 / 200.0)
    assert float(known.u) == pytest.approx(combined, rel=1e-12)

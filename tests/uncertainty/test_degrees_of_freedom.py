"""Degrees of freedom of quantities, by what the parts of their variance rest on, and their coverage factors."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import aacmm_jax as aj
from aacmm_jax.uncertainty.between_groups import BetweenGroups
from aacmm_jax.uncertainty.degrees_of_freedom import (
    Components,
    Law,
    coverage_factor,
    degrees_of_freedom,
    effective_degrees_of_freedom,
)

# Two-sided Student's t and normal quantiles, from printed tables (JCGM 100, table G.2, 95.00 %).
TABLE = {3: 3.18, 10: 2.23, 20: 2.09, 100: 1.984, math.inf: 1.960}


def spread(ratios, weights, others=()):
    """Parts estimated from so many degrees of freedom, and then one whose variance has a distribution."""
    law = Law(np.array([np.inf]), np.array([ratios], dtype=float), np.array([weights], dtype=float))
    return Law.of(np.array(others, dtype=float)).joined(law) if others else law


def inverse_chi_square(nu, count=400):
    """A variance that was estimated from so many degrees of freedom, as possible variances."""
    return nu / stats.chi2.ppf((np.arange(count) + 0.5) / count, nu), np.full(count, 1 / count)


@pytest.mark.parametrize("nu", TABLE)
def test_coverage_factors_are_those_of_the_guide(nu):
    law = Law.of(np.array([float(nu)]))
    assert coverage_factor(0.95, np.ones((1, 1)), law)[0] == pytest.approx(TABLE[nu], abs=5e-3)
    assert degrees_of_freedom(np.ones((1, 1)), law)[0] == pytest.approx(nu)


@pytest.mark.parametrize(
    ("u", "nu", "expected"),
    [
        ((1.0, 1.0), (10.0, 10.0), 20.0),
        ((1.0, 1.0), (10.0, math.inf), 40.0),
        ((3e-7, 4e-7), (5.0, 8.0), 625 / (81 / 5 + 256 / 8)),  # Welch and Satterthwaite by hand
        ((0.0, 2.0), (5.0, 8.0), 8.0),
        ((1.0, 1.0), (math.inf, math.inf), math.inf),
        ((0.0, 0.0), (5.0, 5.0), math.inf),
    ],
)
def test_effective_degrees_of_freedom(u, nu, expected):
    assert effective_degrees_of_freedom(np.square(u), np.array(nu)) == pytest.approx(expected, rel=1e-12)


@given(st.floats(0.01, 100), st.floats(1, 500), st.floats(1, 500))
def test_effective_degrees_of_freedom_are_between_the_smaller_and_the_sum(ratio, one, two):
    found = float(effective_degrees_of_freedom(np.array([1.0, ratio**2]), np.array([one, two])))
    assert min(one, two) * (1 - 1e-9) <= found <= (one + two) * (1 + 1e-9)


@pytest.mark.parametrize("nu", [3.0, 5.0, 20.0])
@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_a_variance_with_the_distribution_of_an_estimate_gives_student(nu, level):
    found = coverage_factor(level, np.ones((1, 1)), spread(*inverse_chi_square(nu)))[0]
    assert found == pytest.approx(stats.t.ppf(0.5 + level / 2, nu), rel=0.02)
    assert degrees_of_freedom(np.ones((1, 1)), spread(*inverse_chi_square(nu)))[0] == pytest.approx(nu, rel=0.06)


def test_mixtures_cover_what_they_say():
    """Half the arms have three times the variance in one part, a fifth of the rest was estimated from 6."""
    law, variances = spread((0.5, 1.5), (0.5, 0.5), (6.0, math.inf)), np.array([[0.2, 0.8, 2.0]])
    factor = float(coverage_factor(0.95, variances, law)[0])
    random = np.random.default_rng(0)
    count = 400_000
    last = 2.0 * np.where(random.random(count) < 0.5, 0.5, 1.5)
    estimated = 0.2 * 6 / random.chisquare(6, count)  # the variance, given its estimate
    errors = random.normal(size=count) * np.sqrt(estimated + 0.8 + last)
    assert np.mean(np.abs(errors) <= factor * math.sqrt(3.0)) == pytest.approx(0.95, abs=0.004)


def test_several_distributions_are_combined():
    law = spread((0.2, 1.0, 3.0), (0.3, 0.5, 0.2)).joined(spread((0.5, 1.5), (0.6, 0.4)))
    factor = float(coverage_factor(0.95, np.array([[1.0, 1.0]]), law)[0])
    random, count = np.random.default_rng(0), 400_000
    one = random.choice([0.2, 1.0, 3.0], count, p=[0.3, 0.5, 0.2])
    two = random.choice([0.5, 1.5], count, p=[0.6, 0.4])
    errors = random.normal(size=count) * np.sqrt(one + two)
    assert np.mean(np.abs(errors) <= factor * math.sqrt(2.0)) == pytest.approx(0.95, abs=0.01)


def test_parts_add_up_and_factors_follow_the_largest(paper_arm):
    """A parameter of the scatter alone has its degrees of freedom, one of the other part nearly those of that."""
    names = ("a_2", "a_3")
    part = np.diag([0.0, 0.99e-4])
    components = Components.of({"few": (part, 4.0)})
    covariance = np.diag([1e-4, 1e-4])
    found = aj.uncertainty.Uncertainty(
        paper_arm, covariance, np.zeros((2, 2)), aj.Noise(seating=0.01), None, names, 50.0, components=components
    )
    np.testing.assert_allclose(found.parts(np.eye(2)).sum(axis=1), 1e-4)
    np.testing.assert_allclose(found.degrees_of_freedom, [50.0, 1 / (0.01**2 / 50 + 0.99**2 / 4)])
    np.testing.assert_allclose(found.expanded(), found.factor() * 0.01)
    np.testing.assert_allclose(found.expanded_of(np.eye(2)), found.expanded())
    assert found.factor()[1] > stats.t.ppf(0.975, 4.2)


def test_levels_outside_their_range_are_refused():
    with pytest.raises(aj.InputError, match="level is 95"):
        coverage_factor(95, np.ones((1, 1)), Law.of(np.array([5.0])))


@pytest.mark.parametrize(
    ("ratios", "expected"),
    [
        ([1.0] * 2, 2.175),
        ([1.0] * 3, 2.04),
        ([1.0] * 8, 1.981),
        ([0.5, 1.0, 2.0], 2.673),
        ([2.0] * 8, 1.981 * math.sqrt(2)),  # errors are larger than predicted everywhere
        ([1.0] * 8 + [10.0], 1.981),  # one contradicts all others
    ],
)
def test_a_chosen_model_is_as_certain_as_groups_that_were_held_out_show(ratios, expected):
    """Factors of u by a finer quadrature, where each group has 60 degrees of freedom and the noise 200."""
    between = BetweenGroups.of(ratios, [60.0] * len(ratios), chosen=True)
    assert float(coverage_factor(0.95, np.ones((1, 1)), between.law(200.0))[0]) == pytest.approx(expected, rel=0.01)

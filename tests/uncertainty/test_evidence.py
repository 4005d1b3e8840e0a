"""Effective parameters and learned standard deviations against closed forms and a maximiser of the evidence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from aacmm_jax.uncertainty.evidence import (
    Groups,
    PriorModel,
    effective_parameters,
    eliminated,
    learned_log_variances,
)

LEAST = 2 * np.log(1e-4)
BROAD = 2 * np.log(10.0)


def model_of(information, right, deviation=None, pinned=None):
    k = len(right)
    deviation = np.zeros(k) if deviation is None else np.asarray(deviation, dtype=float)
    pinned = np.zeros(k, dtype=bool) if pinned is None else np.asarray(pinned)
    return PriorModel(np.asarray(information, dtype=float), np.asarray(right, dtype=float), deviation, pinned)


def learned(model, members, first=BROAD, which=True, expected=False):
    """Log variances of groups, of which all are learned unless others are named."""
    shape = (len(members),)
    flags = [np.broadcast_to(np.asarray(flag), shape) for flag in (which, expected)]
    return learned_log_variances(
        model, Groups(members, np.broadcast_to(np.asarray(first, float), shape), *flags, LEAST)
    )


def random_model(seed, k=6):
    """Of 20 rows: y = J e + noise."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((20, k)) * np.array([1.0, 0.3, 3.0, 1.0, 0.5, 2.0])[:k]
    e = np.repeat([2.0, 0.7], [k // 2, k - k // 2]) * rng.standard_normal(k)
    return model_of(rows.T @ rows, rows.T @ (rows @ e + rng.standard_normal(20)))


def log_evidence(model, sd):
    """Of the data, but for a constant: -log det(1 + S A S) / 2 + c (A + P)^-1 c / 2."""
    inner = np.eye(len(sd)) + sd[:, None] * model.information * sd[None, :]
    scaled = sd * model.right
    return -0.5 * np.linalg.slogdet(inner)[1] + 0.5 * scaled @ np.linalg.solve(inner, scaled)


def test_one_parameter():
    """With information 4 and sd 0.5 the data determine half. An estimate of 2 with u = 1 has variance 2^2 - 1 left."""
    assert effective_parameters(model_of([[4.0]], [1.0]), np.array([0.5])) == pytest.approx([0.5])
    found = learned(model_of([[1.0]], [2.0]), np.ones((1, 1)))
    assert np.exp(found) == pytest.approx([3.0], rel=1e-12)


@pytest.mark.parametrize(("information", "right"), [([[1.0]], [0.9]), ([[1.0]], [0.0]), ([[0.0]], [0.0])])
def test_what_the_data_do_not_support_shrinks_to_the_least(information, right):
    """An estimate of 0.9 with u = 1 is what a deviation of nothing gives."""
    model = model_of(information, right)
    found = learned(model, np.ones((1, 1)))
    assert found == pytest.approx([LEAST])


@pytest.mark.parametrize("seed", range(3))
def test_learned_scales_maximise_the_evidence(seed):
    model, members = random_model(seed), np.repeat(np.eye(2), 3, axis=1)
    best = minimize(
        lambda t: -log_evidence(model, np.exp(0.5 * t @ members)), np.zeros(2), method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-13},
    )  # fmt: skip
    found = learned(model, members)
    np.testing.assert_allclose(found, best.x, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_expected_scales_maximise_the_evidence_with_their_prior(seed):
    model, members, first = random_model(seed), np.repeat(np.eye(2), 3, axis=1), np.array([-4.0, 1.0])
    best = minimize(
        lambda t: -log_evidence(model, np.exp(0.5 * t @ members)) + np.sum((t - first) ** 2) / 18, first,
        method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-13},
    )  # fmt: skip
    np.testing.assert_allclose(learned(model, members, first, expected=True), best.x, atol=1e-6)


def test_what_nothing_is_seen_of_stays_as_expected():
    assert learned(model_of([[0.0]], [0.0]), np.ones((1, 1)), -3.0, expected=True) == pytest.approx([-3.0])


def test_a_given_scale_stays():
    model, members = random_model(0), np.repeat(np.eye(2), 3, axis=1)
    found = learned(model, members, [0.3, BROAD], [False, True])
    best = minimize(lambda t: -log_evidence(model, np.exp(0.5 * np.array([0.3, t[0]]) @ members)), [0.0], tol=1e-10)
    assert found[0] == 0.3
    assert found[1] == pytest.approx(best.x[0], abs=1e-4)


def test_a_parameter_on_a_bound_keeps_its_deviation():
    """With the other at sqrt(3), the variance is the mean of 9 and of what that one has."""
    pinned = model_of(1e12 * np.eye(2), [0.0, np.sqrt(3) * 1e12], [3.0, 0.0], [True, False])
    assert effective_parameters(pinned, np.ones(2)) == pytest.approx([1.0, 1.0])
    found = learned(pinned, np.ones((1, 2)))
    assert np.exp(found) == pytest.approx([(9 + 3) / 2])


@pytest.mark.parametrize("chosen", range(6))
def test_nothing_jumps_where_a_parameter_reaches_its_bound(chosen):
    """With a bound where the parameter would be without one, the learned variances are the same."""
    model, members = random_model(0), np.repeat(np.eye(2), 3, axis=1)
    free = learned(model, members)
    most_probable = np.linalg.solve(model.information + np.diag(np.exp(-free @ members)), model.right)
    on_bound = np.arange(6) == chosen
    right = np.where(on_bound, 0.0, model.right - model.information[:, chosen] * most_probable[chosen])
    pinned = model_of(model.information, right, most_probable, on_bound)
    np.testing.assert_allclose(learned(pinned, members), free, atol=1e-10)


def test_elimination_is_the_marginal():
    """The information left of two of five unknowns is the inverse of their part of the covariance."""
    rows = np.random.default_rng(1).standard_normal((9, 5))
    gram, index = rows.T @ rows, np.array([3, 1])
    model = eliminated(gram, np.zeros(5), np.array([0.5, -1.0]), index, np.zeros(5, dtype=bool))
    marginal = np.linalg.inv(np.linalg.inv(gram)[np.ix_(index, index)])
    np.testing.assert_allclose(model.information, marginal, rtol=1e-12)
    np.testing.assert_allclose(model.right, marginal @ [0.5, -1.0], rtol=1e-12)


@pytest.mark.slow
def test_the_same_under_jit_and_vmap():
    models, members = [random_model(seed) for seed in range(3)], np.repeat(np.eye(2), 3, axis=1)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)
    many = jax.jit(jax.vmap(lambda m: learned(m, members)))(stacked)
    one = [learned(model, members) for model in models]
    np.testing.assert_allclose(many, one, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_effective_parameters():
    model = random_model(0)

    def spent(log_sd):
        return effective_parameters(jax.tree.map(jnp.asarray, model), jnp.exp(log_sd))

    at, step = np.linspace(-1.0, 1.0, 6), 1e-6
    forward, reverse = jax.jit(lambda x: (jax.jacfwd(spent)(x), jax.jacrev(spent)(x)))(at)
    moved = [[effective_parameters(model, np.exp(at + sign * step * e)) for e in np.eye(6)] for sign in (1, -1)]
    np.testing.assert_allclose(forward, reverse, atol=1e-12)
    np.testing.assert_allclose(forward, (np.transpose(moved[0]) - np.transpose(moved[1])) / (2 * step), atol=1e-8)


def test_what_is_left_of_the_information_takes_pinned_parameters_as_known():
    """A bound that is reached is knowledge: the Schur complement is by the other parameters alone."""
    rows = np.random.default_rng(0).normal(size=(30, 5)) * [1.0, 10.0, 0.1, 30.0, 1.0]
    gram, pinned = rows.T @ rows, np.array([False, False, False, True, False])
    model = eliminated(gram, np.zeros(5), np.zeros(1), np.array([0]), pinned)
    free = [1, 2, 4]
    expected = gram[0, 0] - gram[0, free] @ np.linalg.solve(gram[np.ix_(free, free)], gram[free, 0])
    np.testing.assert_allclose(model.information, [[expected]])

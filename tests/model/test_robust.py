"""Robust losses: their efficiency for normal residuals, and the relations between cost, weight and residual."""

import jax
import numpy as np
import pytest
from scipy import stats

from aacmm_jax.model.loss_names import LOSSES
from aacmm_jax.model.robust import _SHAPES, Loss, bounded_square, median_square, tuning_constant

# Holland and Welsch 1977, table 1.
PUBLISHED = {"huber": 1.345, "cauchy": 2.385, "tukey": 4.685}


def test_every_loss_has_a_name_functions_and_a_published_constant():
    assert set(LOSSES) == set(_SHAPES) == set(PUBLISHED)


@pytest.mark.parametrize(("name", "constant"), PUBLISHED.items())
def test_tuning_constants_of_one_row_are_the_published_ones(name, constant):
    assert tuning_constant(name, 1) == constant


@pytest.mark.first_rows(12)
@pytest.mark.parametrize("rows", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("name", LOSSES)
def test_tuning_constants_give_95_percent(name, rows):
    """Efficiency of the estimate of a shift, A^2 / B with A = E[w + 2/r w' |x|^2] and B = E[w^2 |x|^2] / r; more where
    the constant is the least, with which a quarter of good poses has a smaller residual."""
    loss = Loss(name)
    root = np.linspace(1e-6, 9.0, 200_001)
    square = root**2
    density = stats.chi(rows).pdf(root)
    white = np.zeros((rows, len(root)))
    white[0] = root
    weight = loss.cost_and_weight(white)[1]
    slope = np.gradient(weight, square)
    a = np.trapezoid((weight + 2 / rows * slope * square) * density, root)
    b = np.trapezoid(weight**2 * square * density, root) / rows
    least = tuning_constant(name, rows) <= stats.chi(rows).ppf(0.25) + 1e-3
    assert a**2 / b > 0.948 if least else a**2 / b == pytest.approx(0.95, abs=2e-3)


@pytest.mark.parametrize("rows", [40, 1000])
@pytest.mark.parametrize("name", LOSSES)
def test_many_rows_keep_a_quarter_of_good_poses(name, rows):
    quarter, middle = stats.chi(rows).ppf([0.25, 0.5])
    assert quarter - 1e-3 <= tuning_constant(name, rows) < 3 * middle
    assert (tuning_constant(name, rows) > 1.1 * middle) == (name == "tukey")  # which rejects what is beyond it


@pytest.mark.parametrize("rows", [1, 2, 3, 6, 40])
def test_bounded_squares_of_normal_residuals(rows):
    assert median_square(rows) == pytest.approx(stats.chi2(rows).median(), abs=1e-5)
    most, expected = bounded_square(rows)
    distribution = stats.chi2(rows)
    assert most == pytest.approx(distribution.ppf(0.95), abs=1e-5)
    assert expected == pytest.approx(distribution.expect(lambda x: np.minimum(x, most)) / rows, abs=1e-5)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("name", LOSSES)
def test_cost_weight_and_transformed_residual(name):
    """The weight is the derivative of the cost by half the square; transformed residuals have that cost."""
    loss, white = Loss(name), np.random.default_rng(0).normal(size=(3, 50)) * np.geomspace(1e-9, 30, 50)
    cost, weight = loss.cost_and_weight(white)
    gradient = jax.jit(jax.grad(lambda x: loss.cost_and_weight(x)[0].sum()))(white)
    np.testing.assert_allclose(gradient, weight * white, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.sum(loss.transformed(white) ** 2, axis=0), 2 * cost, rtol=1e-8)
    by_transformed = jax.jit(jax.grad(lambda x: 0.5 * (loss.transformed(x) ** 2).sum()))(white)
    np.testing.assert_allclose(by_transformed, gradient, rtol=1e-6, atol=1e-12)
    for of_zero in (lambda x: loss.cost_and_weight(x)[0].sum(), lambda x: loss.transformed(x).sum()):
        assert np.all(np.isfinite(jax.grad(of_zero)(np.zeros((3, 2)))))  # a root of 0 has no derivative
    assert np.all(np.diff(weight[np.argsort(np.sum(white**2, axis=0))]) <= 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOSSES)
def test_the_curvature_is_that_of_the_cost(name):
    """Along a residual and across it, up to where it is no longer positive."""
    loss, c = Loss(name), tuning_constant(name, 3)
    direction = np.array([2.0, -1.0, 2.0]) / 3
    hessian = jax.hessian(lambda residual: loss.cost_and_weight(residual[:, None])[0][0])
    for size in (0.1, 0.3, 0.42, 0.6, 0.9, 1.5, 4.0):
        white = size * c * direction
        across = float(loss.cost_and_weight(white[:, None])[1][0])
        along = direction @ np.asarray(hessian(white)) @ direction
        square = float(loss.along(white[:, None])[0] ** 2)
        if along > 0.02 * across:
            assert square == pytest.approx(along / across, rel=1e-9)
        else:
            assert square == pytest.approx(0.01)

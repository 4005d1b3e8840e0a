"""Score tests, quadratic forms and relations against the whole least squares, with every unknown in one matrix."""

import numpy as np
import pytest
from scipy import linalg, stats

from aacmm_jax.diagnostics.equations import Block
from aacmm_jax.diagnostics.residual_tests import Residuals, alike, consistency, form_test, score_tests

SIZES, PARAMETERS = (12, 9, 15), 4


@pytest.fixture
def problem(rng):
    """Blocks with two unknowns of their own, and all columns in one matrix."""
    blocks = [
        Block(i, "", rng.normal(size=size), rng.normal(size=(size, PARAMETERS)), rng.normal(size=(size, 2)))
        for i, size in enumerate(SIZES)
    ]
    rows, own = np.concatenate([block.shared for block in blocks]), np.zeros((sum(SIZES), 2 * len(SIZES)))
    for i, (block, end) in enumerate(zip(blocks, np.cumsum(SIZES), strict=True)):
        own[end - SIZES[i] : end, 2 * i : 2 * i + 2] = block.private
    return blocks, np.concatenate([rows, own], axis=1)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def annihilator(columns):
    return np.eye(len(columns)) - columns @ np.linalg.pinv(columns)


def test_score_tests_are_f_tests_of_the_larger_model(problem, rng):
    blocks, columns = problem
    left = Residuals.of(blocks)
    everything = np.concatenate([block.residual for block in blocks])
    spare = sum(SIZES) - columns.shape[1]
    assert left.degrees_of_freedom == spare
    np.testing.assert_allclose(left.values, annihilator(columns) @ everything, atol=1e-12)
    candidates = [1e-3 * rng.normal(size=(sum(SIZES), 2)), columns[:, :1] * 5, 1e4 * rng.normal(size=(sum(SIZES), 1))]
    candidates.append(np.concatenate([candidates[2], candidates[2]], axis=1))  # one column, twice
    tests = score_tests(left, candidates)
    for test, candidate in zip(tests, candidates, strict=True):
        larger = np.concatenate([columns, candidate / np.linalg.norm(candidate, axis=0)], axis=1)
        cost = float(everything @ annihilator(larger) @ everything)
        added = np.linalg.matrix_rank(larger) - columns.shape[1]
        assert test.degrees_of_freedom == (added, spare - added)
        if added:
            ratio = (left.cost - cost) / added / (cost / (spare - added))
            assert test.ratio == pytest.approx(ratio)
            assert test.probability == pytest.approx(stats.f.sf(ratio, added, spare - added))
            wider = left.extended(candidate)
            assert (wider.cost, wider.degrees_of_freedom) == (pytest.approx(cost), spare - added)
            unexplained = left.values - left.unexplained(candidate) @ test.coefficients
            np.testing.assert_allclose(unexplained, wider.values, atol=1e-9)
        else:
            assert test.probability == 1.0
    assert score_tests(left, []) == []


def test_a_column_of_which_the_model_leaves_too_little_is_its_own(problem, rng):
    """As the zero of a joint, which the frame of a station imitates but for the size of the residuals; also one that is
    tiny itself."""
    blocks, columns = problem
    left = Residuals.of(blocks)
    nearly = 10 * columns[:, :1] + 0.01 * left.values[:, None]
    other = rng.normal(size=(sum(SIZES), 1))
    tiny = np.concatenate([1e-17 * rng.normal(size=(sum(SIZES), 1)), other], axis=1)
    least = 0.02 * float(np.sqrt(left.cost))
    found, without = score_tests(left, [nearly, tiny], least), score_tests(left, [nearly, tiny])
    assert [test.degrees_of_freedom[0] for test in found] == [0, 1]
    assert [test.degrees_of_freedom[0] for test in without] == [1, 2]
    assert found[0].probability == 1.0 > 1e-10 > without[0].probability
    assert found[1].ratio == pytest.approx(score_tests(left, [other])[0].ratio)


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize("positive", [True, False])
def test_quadratic_forms_have_the_distribution_of_their_draws(problem, rng, relative, positive):
    """With a block for each pose of three rows, none, and one block for five poses."""
    blocks, columns = problem
    by_pose = rng.normal(size=(4, 3, 3))
    tips, near = rng.normal(size=(5, 3, 2)), np.eye(5) if positive else np.eye(5, k=1) + np.eye(5, k=-1)
    by_pose = by_pose @ by_pose.swapaxes(1, 2) if positive else by_pose + by_pose.swapaxes(1, 2)
    kernels = [by_pose, None, alike(tips, near)]
    pairs = np.einsum("mac,mn,nbc->manb", tips, near, tips)
    np.testing.assert_allclose(kernels[2][0], pairs.reshape(15, 15), atol=1e-12)
    matrix = linalg.block_diag(*by_pose, np.zeros((SIZES[1], SIZES[1])), kernels[2][0])
    projector = annihilator(columns)
    errors = projector @ rng.normal(size=(sum(SIZES), 20_000))
    draws = np.einsum("rn,rs,sn->n", errors, matrix, errors)
    residual = projector @ np.concatenate([block.residual for block in blocks])
    value = residual @ matrix @ residual
    if relative:
        draws, value = draws / np.sum(errors**2, axis=0), value / (residual @ residual)
    found = form_test(Residuals.of(blocks), kernels, relative)
    assert found.probability == pytest.approx(np.mean(draws > value), abs=0.02)
    product = projector @ matrix
    assert found.degrees_of_freedom == pytest.approx(np.trace(product) ** 2 / np.trace(product @ product))
    if positive:
        assert found.ratio == pytest.approx(value / draws.mean(), rel=0.03)


@pytest.mark.parametrize("opened", [False, True])
def test_relations_are_a_generalised_least_squares(problem, rng, opened):
    """The drop of the cost without them, or without one of them; an unknown that only they determine costs one."""
    blocks, columns = problem
    number = 3
    root = np.diag([0.5, 2.0, 1.0]) + np.tri(number, k=-1)
    relations = Block("", None, rng.normal(size=number), rng.normal(size=(number, PARAMETERS)), np.zeros((number, 0)))
    direction = (np.zeros(sum(SIZES)), rng.normal(size=number)) if opened else None
    found = consistency(blocks, relations, root @ root.T, direction)
    poses = np.concatenate([block.residual for block in blocks])

    def cost(kept):
        rows = np.zeros((number, columns.shape[1]))
        rows[:, :PARAMETERS] = relations.shared
        every = np.concatenate([columns, rows])
        if opened:
            every = np.concatenate([every, np.concatenate(direction)[:, None]], axis=1)
        # What is left out has an unknown of its own.
        free = np.eye(len(every))[:, [sum(SIZES) + i for i in range(number) if i not in kept]]
        every = np.concatenate([every, free], axis=1)
        inverse = np.eye(len(every))
        inverse[sum(SIZES) :, sum(SIZES) :] = np.linalg.inv(root)
        white = inverse @ np.concatenate([poses, relations.residual])
        return float(white @ annihilator(inverse @ every) @ white)

    assert found.degrees_of_freedom == number - opened
    assert found.square == pytest.approx(cost(range(number)) - cost(()))
    for i in range(number):
        others = [j for j in range(number) if j != i]
        assert found.gains[i] == pytest.approx(cost(range(number)) - cost(others))
